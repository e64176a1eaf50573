"""A trial in the Rerun viewer: frames, differences, forces and labels on one clock, streamed from its file."""

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, Int, UInt8
from matplotlib.colors import to_rgba

from sliplens.errors import InputError
from sliplens.extras import require_packages
from sliplens.images import absolute_difference, encode_png
from sliplens.plots.audit import Fact, audit_facts, end_of_ratio, force_ratio
from sliplens.plots.contact_sheet import STATE_COLOURS, TIMES, brighten, brightening
from sliplens.plots.layout import written_whole
from sliplens.plots.style import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, YELLOW
from sliplens.progress import OnProgress
from sliplens.recordings import Dataset, Recording, TrialInfo
from sliplens.recordings.capture import Forces
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.labelling import LabelBasis
from sliplens.recordings.store import (
    TruthHeader,
    decode_pixels,
    forces_path,
    load_forces,
    load_recording,
    read_frames,
    read_header,
    reading,
    stream_frames,
)
from sliplens.recordings.trial import OUTSIDE, SLIPS, STICKS

if TYPE_CHECKING:
    from rerun import RecordingStream, TimeColumn
    from rerun.blueprint import Blueprint, TimeSeriesView


_LOOPBACK = "127.0.0.1"
_PATIENCE_S = 30.0  # a graphics driver may take its time
_GRACE_S = 1.0


def require_rrd_path(path: Path) -> None:
    """Check that a file is named as one of the Rerun viewer."""
    if path.suffix.lower() != ".rrd":
        raise InputError(f"{path} does not end in .rrd; name a file of the Rerun viewer, such as trial.rrd")


def require_rerun() -> ModuleType:
    """Import Rerun, which only the viewer needs."""
    require_packages("rerun", extra="view", purpose="the viewer")
    import rerun  # noqa: PLC0415 (an extra, and large)

    if not hasattr(rerun, "StateChange"):
        raise InputError(
            f"Rerun is too old for the viewer ({rerun.__version__}); upgrade it with "
            '`pip install --upgrade "sliplens[view]"`'
        )
    return rerun


def start_viewer() -> str:
    """Start a viewer that outlives this process; give the address to which data are sent."""
    with socket.socket() as one:
        one.bind((_LOOPBACK, 0))
        port = one.getsockname()[1]
    # rerun.spawn would have the viewer listen on every network of the machine, and seeks it on the PATH only
    command = [sys.executable, "-m", "rerun_cli", "--bind", _LOOPBACK, "--port", str(port), "--expect-data-soon"]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True)
        give_up = time.monotonic() + _PATIENCE_S
        while time.monotonic() < give_up and process.poll() is None:
            if _listens(port) and _stays(process):
                return f"rerun+http://{_LOOPBACK}:{port}/proxy"
            time.sleep(0.05)
        if process.poll() is None:
            if hasattr(os, "killpg"):  # the viewer is a child of the process that was started
                os.killpg(process.pid, signal.SIGTERM)
            process.kill()
            process.wait()
        said.seek(0)
        words = said.read().decode(errors="replace").strip().splitlines()
    why = words[-1].strip() if words else "it said nothing"
    raise InputError(f"the Rerun viewer did not start ({why}); write a file with --output and open it elsewhere")


def _listens(port: int) -> bool:
    try:
        socket.create_connection((_LOOPBACK, port), timeout=0.2).close()
    except OSError:
        return False
    return True


def _stays(process: subprocess.Popen[bytes]) -> bool:
    """Tell whether a viewer that listens also finds a screen: it looks for one only then."""
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        return True
    return False


# colours that are read on a dark ground and on a light one: the viewer has both, so nothing is black
LINES = {
    "force/normal": ("F_n (N)", BLUE),
    "force/tangential": ("F_t (N)", VERMILLION),
    "force/limit": ("μ F_n (N)", GREY),
    "ratio/tangential_to_normal": ("F_t / F_n", BLUE),
    "ratio/static_friction": ("μ_s", GREEN),
    "ratio/friction": ("μ, sticking or slipping", GREEN),
    "margin/gamma": ("Γ (%)", SKY),
    "margin/band/high": ("Γ + \N{GREEK SMALL LETTER SIGMA} (%)", PURPLE),
    "margin/band/low": ("Γ \N{MINUS SIGN} \N{GREEK SMALL LETTER SIGMA} (%)", PURPLE),
    "margin/stick_ratio": ("stick ratio (%)", ORANGE),
}
"""Entity, name and colour of each number of a frame."""
SAMPLE_LINES = {"x (N), as recorded": VERMILLION, "y (N), as recorded": GREEN, "z (N), as recorded": BLUE}
"""The same of each axis of the force sensor."""


def lay_out(*, size: tuple[int, int], factor: float, highest_ratio: float, truth: bool, sensor: bool) -> "Blueprint":
    """Lay out a trial: what is seen at first sight, before anything is moved."""
    rrb = require_rerun().blueprint
    height, width = size
    bounds = rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height))
    pictures = (
        ("camera", f"camera T_n{': contact, stick zone, markers' if truth else ''}"),
        ("difference", f"difference |T_n \N{MINUS SIGN} T_0| {TIMES} {factor:g}"),
        ("reference", "reference T_0"),
    )
    camera, difference, reference = (
        rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds) for origin, name in pictures
    )
    states = rrb.StateTimelineView(origin="state", name="contact state")
    charts = [
        _chart("margin", "safety margin Γ and stick ratio (%)", "LeftBottom", (-5.0, 105.0)),
        _chart("force", "forces (N)", "RightBottom"),
        _chart("ratio", "F_t / F_n in contact, beside friction", "RightBottom", (0.0, highest_ratio)),
        *([_chart("sensor", "force sensor, as recorded (N)", "RightBottom")] if sensor else []),
    ]
    about = rrb.TextDocumentView(origin="about", name="about this trial")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(camera, difference),
            rrb.Vertical(states, *charts, row_shares=[0.6, *(1 for _ in charts)]),
            rrb.Vertical(about, reference, row_shares=[2, 1]),
            column_shares=[2, 3, 1.4],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        # the fingertip untouched tells nothing, so it plays
        rrb.TimePanel(state="collapsed", timeline="time", play_state="playing", loop_mode="off"),
        auto_views=False,
    )


def _chart(origin: str, name: str, legend: str, span: tuple[float, float] | None = None) -> "TimeSeriesView":
    rrb = require_rerun().blueprint
    across, up = rrb.TimeAxis(link="LinkToGlobal"), rrb.ScalarAxis(range=span) if span else None
    corner = rrb.PlotLegend(corner=legend)
    return rrb.TimeSeriesView(origin=origin, name=name, axis_x=across, axis_y=up, plot_legend=corner)


_MARKS = re.compile(r"([\\`*_{}\[\]<>#|~])")


def describe_trial(trial: Recording, info: TrialInfo, truth: TruthHeader | None) -> str:
    """Tell in Markdown what a trial is, and what its labels rest on."""
    span = float(trial.time_s[-1] - trial.time_s[0])
    told = {
        "sensor": info.sensor,
        "object": info.object,
        "condition": info.condition,
        "day": str(info.day),
        "split": info.split,
        "frames": f"{info.frames:,} of {info.width} × {info.height} pixels in {span:.2f} s",  # noqa: RUF001 (times is meant)
    }
    about = [f"- {name}: {_plain(value)}" for name, value in told.items() if value]
    lines = [f"# {_plain(info.trial)}", *about, "", "## What its labels rest on"]
    for fact in _facts(trial, truth):
        lines.append(f"\n**{'▲ ' if fact.doubtful else ''}{_plain(fact.head)}**\n")
        lines += [f"- {_plain(words)}" for words in fact.words if words]
    return "\n".join(lines)


def _facts(trial: Recording, truth: TruthHeader | None) -> list[Fact]:
    if truth is not None:
        nominal = "nominal" if truth.displacement == "calibrated" else "exact"
        moved = f"markers moved as {truth.displacement}: the stick zone is {nominal}"
        return [Fact("Simulated", ["labels are the mechanics' own, without error", moved])]
    labelling = trial.labelling
    if labelling is None:
        return [Fact("Not told", ["nothing is kept of where they come from"], doubtful=True)]
    sources = [words for words in (labelling.source, labelling.forces) if words]
    return [Fact("Recorded", sources), *audit_facts(trial, labelling)]


def _plain(words: str) -> str:
    """Escape what Markdown would read as its own."""
    return _MARKS.sub(r"\\\1", words.removeprefix("• "))


_STATE_COLOURS = {str(state): colour for state, colour in STATE_COLOURS.items()}
_LABEL_COLOURS = {"valid": GREEN, "not valid": GREY}
_SAMPLES_TOGETHER = 2**16


def clock(time_s: Float[np.ndarray, " _"], frames: Int[np.ndarray, " _"]) -> "list[TimeColumn]":
    """Both timelines of some frames: `time`, on the clock of the camera, and `frame`."""
    rerun = require_rerun()
    return [rerun.TimeColumn("time", duration=_nanoseconds(time_s)), rerun.TimeColumn("frame", sequence=frames)]


def rgba(colour: str) -> list[int]:
    """Red, green, blue and opacity of a colour, 0 to 255."""
    return [round(255 * part) for part in to_rgba(colour)]


def log_numbers(stream: "RecordingStream", trial: Recording, static_friction: Float[np.ndarray, " _"] | None) -> None:
    """Log forces, their ratio where something touches, and labels: a line each."""
    rerun = require_rerun()
    normal = trial.normal_force_n
    margin, sigma = 100 * trial.safety_margin, trial.safety_margin_sigma
    lines = {
        "force/normal": normal,
        "force/tangential": trial.tangential_force_n,
        "force/limit": trial.friction_coefficient * normal,
        "ratio/tangential_to_normal": force_ratio(trial),
        "margin/gamma": margin,
        "margin/stick_ratio": 100 * trial.stick_ratio,
    }
    if static_friction is None:
        lines["ratio/friction"] = trial.friction_coefficient
    else:
        lines["ratio/static_friction"] = static_friction
    if sigma is not None:
        lines |= {"margin/band/high": margin + 100 * sigma, "margin/band/low": margin - 100 * sigma}
    times = clock(trial.time_s, np.arange(len(trial)))
    for entity, values in lines.items():
        name, colour = LINES[entity]
        width = 1.0 if "band" in entity else 2.0
        stream.log(entity, rerun.SeriesLines(names=name, colors=[rgba(colour)], widths=width), static=True)
        stream.send_columns(entity, times, rerun.Scalars.columns(scalars=values))


def log_states(stream: "RecordingStream", trial: Recording) -> None:
    """Log when the contact changes its state, and when labels begin and cease to be valid."""
    rerun = require_rerun()
    lanes = [("state/contact", [str(state) for state in trial.contact_state], _STATE_COLOURS)]
    if trial.valid is not None:
        lanes.append(("state/label", ["valid" if one else "not valid" for one in trial.labelled], _LABEL_COLOURS))
    for entity, states, colours in lanes:
        style = rerun.StateConfiguration(values=list(colours), colors=[rgba(colour) for colour in colours.values()])
        stream.log(entity, style, static=True)
        begins = np.flatnonzero([at == 0 or state != states[at - 1] for at, state in enumerate(states)])
        columns = rerun.StateChange.columns(state=[states[at] for at in begins])
        stream.send_columns(entity, clock(trial.time_s[begins], begins), columns)


def log_samples(stream: "RecordingStream", forces: Forces, basis: LabelBasis | None) -> None:
    """Log what the force sensor recorded, on the clock of the camera if its lag was applied to the labels."""
    rerun = require_rerun()
    late_s = basis.lag.lag_s if basis and basis.lag and basis.lag_applied else 0.0
    names, colours = list(SAMPLE_LINES), [rgba(colour) for colour in SAMPLE_LINES.values()]
    stream.log("sensor/force", rerun.SeriesLines(names=names, colors=colours, widths=[1.0] * len(names)), static=True)
    for begin in range(0, len(forces.time_s), _SAMPLES_TOGETHER):
        some = slice(begin, begin + _SAMPLES_TOGETHER)
        time = rerun.TimeColumn("time", duration=_nanoseconds(forces.time_s[some] + late_s))
        stream.send_columns("sensor/force", [time], rerun.Scalars.columns(scalars=forces.force_n[some]))


def _nanoseconds(time_s: Float[np.ndarray, " _"]) -> np.ndarray:
    # rounded here: Rerun cuts off, and a third of a second could come back a nanosecond short
    return np.round(1e9 * time_s).astype("timedelta64[ns]")


_PNG = "image/png"
_TOGETHER = 8  # frames that are sent together: a megabyte or so, as much as Rerun itself sends at once


def log_frames(
    stream: "RecordingStream", path: Path, trial: Recording, factor: float, on_progress: OnProgress | None
) -> None:
    """Log camera frames and their bright differences from the reference, losslessly.

    As PNG: two thirds the size of raw pixels, in the file and in the viewer's memory, for some 5 ms a picture.
    """
    rerun, frames, done = require_rerun(), stream_frames(path), 0

    def encode(frame: UInt8[np.ndarray, "_ _ 3"]) -> tuple[bytes, bytes]:
        return encode_png(frame), encode_png(brighten(absolute_difference(frame, trial.reference), factor))

    stream.log("reference", rerun.EncodedImage(contents=encode_png(trial.reference), media_type=_PNG), static=True)
    with ThreadPoolExecutor() as pool:
        while some := list(islice(frames, _TOGETHER)):
            places = np.arange(done, done + len(some))
            times, pictures = clock(trial.time_s[places], places), zip(*pool.map(encode, some), strict=True)
            for entity, blobs in zip(("camera/frame", "difference"), pictures, strict=True):
                columns = rerun.EncodedImage.columns(blob=list(blobs), media_type=[_PNG] * len(blobs))
                stream.send_columns(entity, times, columns)
            done += len(some)
            if on_progress is not None:
                on_progress(done, len(trial))


_OUTLINES_TOGETHER = 8  # frames whose maps are held and sent together
_OPACITY = 0.35
_HALF_PX = 0.5  # Rerun's pixels reach from one whole number to the next, ours have their centres there


def log_truth(stream: "RecordingStream", path: Path, trial: Recording, truth: TruthHeader) -> None:
    """Log contact and stick zone, and markers with how far they went, over the camera frames of a simulated trial."""
    rerun, done = require_rerun(), 0
    rest_px = np.array(truth.marker_rest_px, dtype=np.float32).reshape(-1, 2)
    height, width = trial.reference.shape[:2]
    zones = [(OUTSIDE, "no contact", [0, 0, 0, 0]), (SLIPS, "slips", rgba(ORANGE)), (STICKS, "sticks", rgba(SKY))]
    stream.log("camera/zones", rerun.AnnotationContext(zones), static=True)
    form = rerun.components.ImageFormat(width=width, height=height, channel_datatype="U8")
    stream.log("camera/zones", rerun.SegmentationImage.from_fields(format=form, opacity=_OPACITY), static=True)
    dots = rerun.Points2D.from_fields(colors=[rgba(YELLOW)], radii=[rerun.Radius.ui_points(2.0)])
    stream.log("camera/markers", dots, static=True)
    arrows = rerun.Arrows2D.from_fields(colors=[rgba(YELLOW)], radii=[rerun.Radius.ui_points(1.0)])
    stream.log("camera/displacements", arrows, static=True)
    for rows in _stored_rows(path):
        places = np.arange(done, done + rows.num_rows)
        times, lengths = clock(trial.time_s[places], places), [len(rest_px)] * rows.num_rows
        markers = rows.column("marker_px").flatten().to_numpy().reshape(rows.num_rows, len(rest_px), 2)
        moved = (markers - rest_px).reshape(-1, 2)
        begin = np.tile(rest_px + _HALF_PX, (rows.num_rows, 1))
        points = rerun.Points2D.columns(positions=markers.reshape(-1, 2) + _HALF_PX).partition(lengths)
        stream.send_columns("camera/markers", times, points)
        columns = rerun.Arrows2D.columns(vectors=moved, origins=begin).partition(lengths)
        stream.send_columns("camera/displacements", times, columns)
        maps = [
            decode_pixels(one.as_buffer(), size=(height, width), where=f"frame {at} (contact map) of {path}").tobytes()
            for at, one in zip(places, rows.column("contact_map"), strict=True)
        ]
        stream.send_columns("camera/zones", times, rerun.SegmentationImage.columns(buffer=maps))
        done += rows.num_rows


def _stored_rows(path: Path) -> Iterator[pa.RecordBatch]:
    with reading(path), pq.ParquetFile(path) as file:
        yield from file.iter_batches(_OUTLINES_TOGETHER, columns=["marker_px", "contact_map"])


_APPLICATION = "sliplens"
_SAMPLED = 32  # frames that are looked at for the brightness of all


def write_rrd(data: Dataset, info: TrialInfo, path: Path, *, on_progress: OnProgress | None = None) -> None:
    """Write a trial as a file of the Rerun viewer; it appears when complete."""
    require_rrd_path(path)
    stream = _new_stream()
    with written_whole(path) as part:
        part.touch()  # Rerun would tell of a file that cannot be written in its own way
        stream.save(part)
        _log_whole(stream, data, info, on_progress, otherwise=f"{path} could not be written; see what space is left")


def open_viewer(data: Dataset, info: TrialInfo, *, on_progress: OnProgress | None = None) -> None:
    """Open a trial in a Rerun viewer of its own, which stays when this process ends."""
    stream = _new_stream()
    read_header(trial_path(data.folder, info.trial))  # no window for a trial that is not there
    stream.connect_grpc(start_viewer())
    _log_whole(stream, data, info, on_progress, otherwise="the Rerun viewer was closed too early; leave it open")


def log_trial(
    stream: "RecordingStream", data: Dataset, info: TrialInfo, *, on_progress: OnProgress | None = None
) -> None:
    """Log a trial and its layout to a Rerun stream, a few frames in memory at a time.

    Timelines are `time`, on the clock of the camera, and `frame`. What is not known is NaN: there a line breaks.
    """
    rerun = require_rerun()
    path, samples = trial_path(data.folder, info.trial), forces_path(data.folder, info.trial)
    trial, truth, sensor = load_recording(path, pixels=False), read_header(path).truth, bool(info.forces_sha256)
    basis = trial.labelling.basis if trial.labelling else None
    friction = _static_friction(path, trial, truth, basis)
    some = read_frames(path, range(0, len(trial), -(-len(trial) // _SAMPLED)))
    size, factor = trial.reference.shape[:2], brightening([absolute_difference(some, trial.reference)])
    frictions = trial.friction_coefficient if friction is None else friction
    highest = end_of_ratio(force_ratio(trial), float(np.max(frictions, where=np.isfinite(frictions), initial=0)))
    stream.send_recording_name(info.trial)
    stream.send_blueprint(
        lay_out(size=size, factor=factor, highest_ratio=highest, truth=truth is not None, sensor=sensor)
    )
    about = describe_trial(trial, info, truth)
    stream.log("about", rerun.TextDocument(about, media_type=rerun.MediaType.MARKDOWN), static=True)
    log_numbers(stream, trial, friction)
    log_states(stream, trial)
    if sensor:
        log_samples(stream, load_forces(samples), basis)
    if truth is not None:
        log_truth(stream, path, trial, truth)
    log_frames(stream, path, trial, factor, on_progress)


def _log_whole(
    stream: "RecordingStream", data: Dataset, info: TrialInfo, on_progress: OnProgress | None, *, otherwise: str
) -> None:
    try:
        log_trial(stream, data, info, on_progress=on_progress)
        stream.flush()
    except RuntimeError as error:
        raise InputError(f"{otherwise} ({error})") from None
    finally:
        stream.disconnect()


def _static_friction(
    path: Path, trial: Recording, truth: TruthHeader | None, basis: LabelBasis | None
) -> Float[np.ndarray, " frames"] | None:
    """mu_s of each frame: that of the simulator, or what was estimated; None where neither is told."""
    if truth is None:
        return None if basis is None else np.full(len(trial), basis.friction.mu)
    with reading(path):
        return pq.read_table(path, columns=["static_friction"])["static_friction"].to_numpy().astype(np.float64)


def _new_stream() -> "RecordingStream":
    stream = require_rerun().RecordingStream(_APPLICATION)
    if not stream.is_enabled():
        raise InputError("the environment variable RERUN switches Rerun off; unset it")
    return stream
