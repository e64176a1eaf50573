"""A trial in the Rerun viewer: frames, differences, forces, labels and what networks say of it, on one clock."""

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Float, Int, UInt8
from matplotlib.colors import to_rgba

from sliplens.codec import open_parquet
from sliplens.errors import InputError
from sliplens.extras import require_packages
from sliplens.images import absolute_difference, encode_png
from sliplens.plots.audit import Fact, audit_facts, end_of_ratio, force_ratio
from sliplens.plots.contact_sheet import STATE_COLOURS, TIMES, brighten, brightening
from sliplens.plots.saliency import full_colour, overlay_relevance
from sliplens.plots.style import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, YELLOW, method_name, written_whole
from sliplens.progress import OnProgress, visible
from sliplens.recordings import Dataset, Recording, TrialFacts, TrialInfo
from sliplens.recordings.capture import Capture, Forces, Frame
from sliplens.recordings.dataset import trial_path
from sliplens.recordings.labelling import LabelBasis
from sliplens.recordings.store import (
    TruthHeader,
    decode_pixels,
    forces_path,
    load_forces,
    load_recording,
    read_header,
    reading,
    stream_frames,
)
from sliplens.recordings.trial import OUTSIDE, SLIPS, STICKS, Labels, labels_of_margins
from sliplens.results.explanation import Explanation

if TYPE_CHECKING:
    from rerun import AsComponents, ComponentColumn, RecordingStream
    from rerun.blueprint import Blueprint, TimeSeriesView


@dataclass(frozen=True, kw_only=True)
class Viewed:
    """A trial as the viewer reads it, a few frames in memory at a time."""

    trial: Recording
    """Times and labels; without pixels."""
    read_frames: Callable[[], Iterator[Frame]]
    pick: Callable[[Sequence[int]], Iterable[Frame]]
    """Gives frames of rising numbers."""
    split: str = ""
    forces: Forces | None = None
    path: Path | None = None
    """File of a stored trial, which may hold the truth."""
    files: tuple[str, ...] = ()
    """Names of the images of a folder."""


@dataclass(frozen=True, kw_only=True)
class Beside:
    """What networks and trackers say of trials, to be shown beside their frames."""

    predictions: Path | None = None
    """Table that `sliplens predict` or `sliplens evaluate` wrote (Parquet)."""
    maps: Explanation | None = None
    tracks: Path | None = None
    """Table that `sliplens track` wrote."""


def view_stored(data: Dataset, info: TrialInfo) -> Viewed:
    """Trial of a data set for the viewer."""
    path = trial_path(data.folder, info.trial)
    return Viewed(
        trial=load_recording(path, pixels=False),
        read_frames=partial(stream_frames, path),
        pick=lambda places: stream_frames(path, set(places)),
        split=info.split,
        forces=load_forces(forces_path(data.folder, info.trial)) if info.forces_sha256 else None,
        path=path,
    )


def view_capture(capture: Capture) -> Viewed:
    """Recording of any source for the viewer; without an untouched sensor its first frame stands for it."""
    count, labels = len(capture), capture.labels or labels_of_margins(np.full(len(capture), np.nan))
    reference = next(capture.read_frames()) if capture.read_reference is None else capture.read_reference()
    time_s = np.arange(count) / capture.frame_rate_hz if capture.time_s is None else capture.time_s
    facts = {one.name: getattr(capture, one.name) for one in fields(TrialFacts)}
    known = {one.name: getattr(labels, one.name) for one in fields(Labels)}
    frames = np.broadcast_to(reference, (count, *reference.shape))
    return Viewed(
        trial=Recording(**facts, **known, time_s=time_s, reference=reference, frames=frames),
        read_frames=capture.read_frames,
        pick=lambda places: (frame for at, frame in enumerate(capture.read_frames()) if at in set(places)),
        forces=capture.forces,
        files=capture.files or (),
    )


def view_explained(explained: Explanation) -> Viewed:
    """Frames that were explained, one after another, as their network saw them."""
    from sliplens.recordings.source import open_source  # noqa: PLC0415 (readers of video come with it)

    (capture,) = open_source(explained.pictures)
    first = explained.frames[0]
    capture = replace(capture, trial=first.trial, condition=first.condition, day=first.day)
    labels = [np.nan if one.safety_margin is None else one.safety_margin for one in explained.frames]
    known = replace(capture, labels=labels_of_margins(np.array(labels)))
    return replace(view_capture(known), files=tuple(f"{one.id}.png" for one in explained.frames))


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
    "margin/read": ("Γ as read (%)", VERMILLION),
    "margin/read/high": ("upper end of its 90 % interval (%)", VERMILLION),
    "margin/read/low": ("lower end of its 90 % interval (%)", VERMILLION),
}
"""Entity, name and colour of each number of a frame."""
SAMPLE_LINES = {"x (N), as recorded": VERMILLION, "y (N), as recorded": GREEN, "z (N), as recorded": BLUE}
"""The same of each axis of the force sensor."""


def lay_out(
    viewed: Viewed,
    *,
    factor: float,
    friction: Float[np.ndarray, " frames"] | None,
    truth: bool,
    methods: Sequence[str] = (),
) -> "Blueprint":
    """Lay out a trial: what is seen at first sight, before anything is moved.

    `factor`: of the brightness of its differences; `friction`: the static one of each frame, where that is known.
    """
    rrb, trial = require_rerun().blueprint, viewed.trial
    height, width = trial.reference.shape[:2]
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
    charts = [_chart("margin", "safety margin Γ and stick ratio (%)", "LeftBottom", (-5.0, 105.0))]
    if np.isfinite(trial.normal_force_n).any():
        frictions = trial.friction_coefficient if friction is None else friction
        highest = float(np.max(frictions, where=np.isfinite(frictions), initial=0))
        span = 0.0, end_of_ratio(force_ratio(trial), highest)
        charts.append(_chart("force", "forces (N)", "RightBottom"))
        charts.append(_chart("ratio", "F_t / F_n in contact, beside friction", "RightBottom", span))
    if viewed.forces is not None:
        charts.append(_chart("sensor", "force sensor, as recorded (N)", "RightBottom"))
    # a map is as large as the network's image, whatever the camera's
    maps = [
        rrb.Spatial2DView(origin=f"map/{method}", name=f"map by {method_name(method)}, at its frame")
        for method in methods
    ]
    about = rrb.TextDocumentView(origin="about", name="about this trial")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(camera, difference, *([rrb.Tabs(*maps)] if maps else [])),
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


def describe_trial(trial: Recording, truth: TruthHeader | None, *, split: str = "") -> str:
    """Tell in Markdown what a trial is, and what its labels rest on."""
    span = float(trial.time_s[-1] - trial.time_s[0])
    height, width = trial.reference.shape[:2]
    told = {
        "sensor": trial.sensor,
        "object": trial.object,
        "condition": trial.condition,
        "day": str(trial.day),
        "split": split,
        "frames": f"{len(trial):,} of {width} × {height} pixels in {span:.2f} s",  # noqa: RUF001 (times is meant)
    }
    about = [f"- {name}: {_plain(value)}" for name, value in told.items() if value]
    lines = [f"# {_plain(trial.trial)}", *about, "", "## What its labels rest on"]
    for fact in _facts(trial, truth):
        lines.append(f"\n**{'▲ ' if fact.doubts else ''}{_plain(fact.head)}**\n")
        lines += [f"- {_plain(words)}" for words in fact.lines if words]
    return "\n".join(lines)


def _facts(trial: Recording, truth: TruthHeader | None) -> list[Fact]:
    if truth is not None:
        nominal = "nominal" if truth.displacement == "calibrated" else "exact"
        moved = f"markers moved as {truth.displacement}: the stick zone is {nominal}"
        return [Fact("Simulated", ["labels are the mechanics' own, without error", moved])]
    labelling = trial.labelling
    if labelling is None:
        return [Fact("Not told", [], ("nothing is kept of where they come from",))]
    sources = [words for words in (labelling.source, labelling.forces) if words]
    return [Fact("Recorded", sources), *audit_facts(trial, labelling)]


def _plain(words: str) -> str:
    """Escape what Markdown would read as its own."""
    return _MARKS.sub(r"\\\1", visible(words.removeprefix("• ")))


_STATE_COLOURS = {str(state): colour for state, colour in STATE_COLOURS.items()}
_LABEL_COLOURS = {"valid": GREEN, "not valid": GREY}
_SAMPLES_TOGETHER = 2**16
_PNG = "image/png"
_TOGETHER = 8  # frames that are sent together: a megabyte or so, as much as Rerun itself sends at once
_OPACITY = 0.35
_HALF_PX = 0.5  # Rerun's pixels reach from one whole number to the next, ours have their centres there
_PREDICTED = {
    "trial": "texts", "frame": "whole numbers", "prediction": "numbers", "low_90": "numbers", "high_90": "numbers"
}  # fmt: skip
_TRACKED = {"trial": "texts", "frame": "whole numbers", "x_px": "numbers", "y_px": "numbers", "marker": "whole numbers"}


def rgba(colour: str) -> list[int]:
    """Red, green, blue and opacity of a colour, 0 to 255."""
    return [round(255 * part) for part in to_rgba(colour)]


@dataclass(frozen=True, kw_only=True)
class _Log:
    """Stream of a trial, on both timelines: `time`, on the clock of the camera, and `frame`.

    What is not known is NaN: there a line breaks.
    """

    stream: "RecordingStream"
    rerun: ModuleType
    trial: Recording

    def fixed(self, entity: str, what: "AsComponents") -> None:
        """Log what no frame changes."""
        self.stream.log(entity, what, static=True)

    def send(self, entity: str, frames: Int[np.ndarray, " _"], columns: "Iterable[ComponentColumn]") -> None:
        """Log something of some frames."""
        time = self.rerun.TimeColumn("time", duration=_nanoseconds(self.trial.time_s[frames]))
        self.stream.send_columns(entity, [time, self.rerun.TimeColumn("frame", sequence=frames)], columns)

    def lines(self, lines: dict[str, Float[np.ndarray, " _"]], frames: Int[np.ndarray, " _"]) -> None:
        """Log numbers of some frames, a line each."""
        for entity, values in lines.items():
            name, colour = LINES[entity]
            width = 1.0 if entity.endswith(("high", "low")) else 2.0
            self.fixed(entity, self.rerun.SeriesLines(names=name, colors=[rgba(colour)], widths=width))
            self.send(entity, frames, self.rerun.Scalars.columns(scalars=values))

    def numbers(self, static_friction: Float[np.ndarray, " _"] | None) -> None:
        """Log forces, their ratio where something touches, and labels."""
        trial, normal = self.trial, self.trial.normal_force_n
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
        self.lines(lines, np.arange(len(trial)))

    def predictions(self, path: Path) -> None:
        """Log the margins that a network read, with the ends of their 90 % intervals where it tells any."""
        rows, frames = _rows_of(self.trial, path, _PREDICTED, command="sliplens predict")
        columns = {"margin/read": "prediction", "margin/read/high": "high_90", "margin/read/low": "low_90"}
        lines = {entity: 100 * rows[name].to_numpy().astype(np.float64) for entity, name in columns.items()}
        self.lines({entity: values for entity, values in lines.items() if np.isfinite(values).any()}, frames)

    def tracks(self, path: Path) -> None:
        """Log where markers were followed to, over the camera frames."""
        rows, frames = _rows_of(self.trial, path, _TRACKED, command="sliplens track")
        places, starts = np.unique(frames, return_index=True)
        points = np.stack([rows[name].to_numpy().astype(np.float32) for name in ("x_px", "y_px")], axis=-1) + _HALF_PX
        seen = np.isfinite(points).all(axis=1)
        counts = np.add.reduceat(seen.astype(np.int64), starts)
        self.dots("camera/followed", GREEN, 2.5)
        self.send("camera/followed", places, self.rerun.Points2D.columns(positions=points[seen]).partition(counts))

    def dots(self, entity: str, colour: str, radius: float) -> None:
        """Say how the points of an entity look, their radius in points of the screen."""
        size = self.rerun.Radius.ui_points(radius)
        self.fixed(entity, self.rerun.Points2D.from_fields(colors=[rgba(colour)], radii=[size]))

    def maps(self, maps: Explanation, files: Sequence[str]) -> None:
        """Log the maps of the trial's frames, each until the next frame, on one scale."""
        rerun, trial = self.rerun, self.trial
        numbers = {f"{trial.trial}-f{at:04d}": at for at in range(len(trial))}
        # given names go before made ones: of maps alone the files are the frames that were explained
        numbers |= {Path(name).stem: at for at, name in enumerate(files)}
        found = {numbers[frame.id]: row for row, frame in enumerate(maps.frames) if frame.id in numbers}
        if not found:
            raise InputError(f"the maps are of no frame of {trial.trial}; they are of {maps.frames[0].id} and others")
        for method in maps.methods:
            scale = full_colour(maps.relevance[method])
            for at, row in sorted(found.items()):
                picture = overlay_relevance(maps.pictures[row], maps.relevance[method][row] / scale)
                self.pictures(f"map/{method}", np.array([at]), [encode_png(picture)])
                if at + 1 < len(trial) and at + 1 not in found:  # a map says nothing of the frames after its own
                    self.send(f"map/{method}", np.array([at + 1]), rerun.Clear.columns(is_recursive=[False]))

    def pictures(self, entity: str, frames: Int[np.ndarray, " _"], blobs: Sequence[bytes]) -> None:
        """Log a PNG of each of some frames."""
        columns = self.rerun.EncodedImage.columns(blob=list(blobs), media_type=[_PNG] * len(blobs))
        self.send(entity, frames, columns)

    def states(self) -> None:
        """Log when the contact changes its state, and when labels begin and cease to be valid."""
        rerun, trial = self.rerun, self.trial
        lanes = [("state/contact", [str(state) for state in trial.contact_state], _STATE_COLOURS)]
        if trial.valid is not None:
            lanes.append(("state/label", ["valid" if one else "not valid" for one in trial.labelled], _LABEL_COLOURS))
        for entity, states, colours in lanes:
            style = rerun.StateConfiguration(values=list(colours), colors=[rgba(colour) for colour in colours.values()])
            self.fixed(entity, style)
            begins = np.flatnonzero([at == 0 or state != states[at - 1] for at, state in enumerate(states)])
            self.send(entity, begins, rerun.StateChange.columns(state=[states[at] for at in begins]))

    def samples(self, forces: Forces, basis: LabelBasis | None) -> None:
        """Log what the force sensor recorded, on the clock of the camera if its lag was applied to the labels."""
        rerun = self.rerun
        late_s = basis.lag.lag_s if basis and basis.lag and basis.lag_applied else 0.0
        names, colours = list(SAMPLE_LINES), [rgba(colour) for colour in SAMPLE_LINES.values()]
        self.fixed("sensor/force", rerun.SeriesLines(names=names, colors=colours, widths=[1.0] * len(names)))
        for begin in range(0, len(forces.time_s), _SAMPLES_TOGETHER):
            some = slice(begin, begin + _SAMPLES_TOGETHER)
            time = rerun.TimeColumn("time", duration=_nanoseconds(forces.time_s[some] + late_s))
            self.stream.send_columns("sensor/force", [time], rerun.Scalars.columns(scalars=forces.force_n[some]))

    def frames(self, read: Iterator[Frame], factor: float, on_progress: OnProgress | None) -> None:
        """Log camera frames and their bright differences from the reference, losslessly.

        As PNG: two thirds the size of raw pixels, in the file and in the viewer's memory, for some 5 ms a picture.
        """
        reference, done = self.trial.reference, 0

        def encode(frame: UInt8[np.ndarray, "_ _ 3"]) -> tuple[bytes, bytes]:
            return encode_png(frame), encode_png(brighten(absolute_difference(frame, reference), factor))

        self.fixed("reference", self.rerun.EncodedImage(contents=encode_png(reference), media_type=_PNG))
        with ThreadPoolExecutor() as pool:
            while some := list(islice(read, _TOGETHER)):
                both = zip(*pool.map(encode, some), strict=True)
                for entity, blobs in zip(("camera/frame", "difference"), both, strict=True):
                    self.pictures(entity, np.arange(done, done + len(some)), blobs)
                done += len(some)
                if on_progress is not None:
                    on_progress(done, len(self.trial))

    def truth(self, path: Path, truth: TruthHeader) -> None:
        """Log contact and stick zone, and markers with how far they went, over the frames of a simulated trial."""
        rerun, done = self.rerun, 0
        rest_px = np.array(truth.marker_rest_px, dtype=np.float32).reshape(-1, 2)
        height, width = self.trial.reference.shape[:2]
        zones = [(OUTSIDE, "no contact", [0, 0, 0, 0]), (SLIPS, "slips", rgba(ORANGE)), (STICKS, "sticks", rgba(SKY))]
        self.fixed("camera/zones", rerun.AnnotationContext(zones))
        form = rerun.components.ImageFormat(width=width, height=height, channel_datatype="U8")
        self.fixed("camera/zones", rerun.SegmentationImage.from_fields(format=form, opacity=_OPACITY))
        self.dots("camera/markers", YELLOW, 2.0)
        arrows = rerun.Arrows2D.from_fields(colors=[rgba(YELLOW)], radii=[rerun.Radius.ui_points(1.0)])
        self.fixed("camera/displacements", arrows)
        for rows in _stored_rows(path):
            places, lengths = np.arange(done, done + rows.num_rows), [len(rest_px)] * rows.num_rows
            markers = rows.column("marker_px").flatten().to_numpy().reshape(rows.num_rows, len(rest_px), 2)
            begin = np.tile(rest_px + _HALF_PX, (rows.num_rows, 1))
            points = rerun.Points2D.columns(positions=markers.reshape(-1, 2) + _HALF_PX).partition(lengths)
            self.send("camera/markers", places, points)
            ways = rerun.Arrows2D.columns(vectors=(markers - rest_px).reshape(-1, 2), origins=begin)
            self.send("camera/displacements", places, ways.partition(lengths))
            stored, size = zip(places, rows.column("contact_map"), strict=True), (height, width)
            maps = [
                decode_pixels(one.as_buffer(), size=size, where=f"frame {at} (contact map) of {path}").tobytes()
                for at, one in stored
            ]
            self.send("camera/zones", places, rerun.SegmentationImage.columns(buffer=maps))
            done += rows.num_rows


def _rows_of(trial: Recording, path: Path, kinds: dict[str, str], *, command: str) -> tuple[pa.Table, np.ndarray]:
    """Rows of a table that are of a trial, in the order of its frames, and the frames' numbers."""
    with open_parquet(path, kinds, cure=f"name a table that {command} wrote") as file:
        table = file.read(columns=list(kinds))
    names = table["trial"].unique().to_pylist()
    rows = table.filter(pc.field("trial") == trial.trial).sort_by("frame")
    frames = rows["frame"].to_numpy().astype(np.int64)
    if not len(frames):
        raise InputError(f"{path} has no frame of {trial.trial}; it has {', '.join(map(str, names[:3]))}")
    if frames[0] < 0 or frames[-1] >= len(trial):
        raise InputError(f"{path} has frame {frames[-1]} of {trial.trial}, which has {len(trial)}; predict it anew")
    return rows, frames


def _nanoseconds(time_s: Float[np.ndarray, " _"]) -> np.ndarray:
    # rounded here: Rerun cuts off, and a third of a second could come back a nanosecond short
    return np.round(1e9 * time_s).astype("timedelta64[ns]")


def _stored_rows(path: Path) -> Iterator[pa.RecordBatch]:
    with reading(path), pq.ParquetFile(path) as file:
        yield from file.iter_batches(_TOGETHER, columns=["marker_px", "contact_map"])


_APPLICATION = "sliplens"
_SAMPLED = 32  # frames that are looked at for the brightness of all


def write_rrd(viewed: Viewed, path: Path, *, beside: Beside = Beside(), on_progress: OnProgress | None = None) -> None:
    """Write a trial as a file of the Rerun viewer; it appears when complete."""
    require_rrd_path(path)
    stream = _new_stream()
    with written_whole(path) as part:
        part.touch()  # Rerun would tell of a file that cannot be written in its own way
        stream.save(part)
        _log_whole(
            stream, viewed, beside, on_progress, otherwise=f"{path} could not be written; see what space is left"
        )


def open_viewer(viewed: Viewed, *, beside: Beside = Beside(), on_progress: OnProgress | None = None) -> None:
    """Open a trial in a Rerun viewer of its own, which stays when this process ends."""
    stream = _new_stream()
    stream.connect_grpc(start_viewer())
    _log_whole(stream, viewed, beside, on_progress, otherwise="the Rerun viewer was closed too early; leave it open")


def log_trial(
    stream: "RecordingStream", viewed: Viewed, beside: Beside, *, on_progress: OnProgress | None = None
) -> None:
    """Log a trial, what is beside it, and its layout to a Rerun stream, a few frames in memory at a time."""
    trial, path = viewed.trial, viewed.path
    log = _Log(stream=stream, rerun=(rerun := require_rerun()), trial=trial)
    truth = None if path is None else read_header(path).truth
    basis = trial.labelling.basis if trial.labelling else None
    friction = _static_friction(path, trial, truth, basis)
    if beside.maps is not None:
        log.maps(beside.maps, viewed.files)
    if beside.predictions is not None:
        log.predictions(beside.predictions)
    if beside.tracks is not None:
        log.tracks(beside.tracks)
    some = np.stack(list(viewed.pick(range(0, len(trial), -(-len(trial) // _SAMPLED)))))
    factor = brightening([absolute_difference(some, trial.reference)])
    stream.send_recording_name(trial.trial)
    methods = () if beside.maps is None else tuple(beside.maps.methods)
    stream.send_blueprint(lay_out(viewed, factor=factor, friction=friction, truth=truth is not None, methods=methods))
    about = describe_trial(trial, truth, split=viewed.split)
    log.fixed("about", rerun.TextDocument(about, media_type=rerun.MediaType.MARKDOWN))
    log.numbers(friction)
    log.states()
    if viewed.forces is not None:
        log.samples(viewed.forces, basis)
    if path is not None and truth is not None:
        log.truth(path, truth)
    log.frames(viewed.read_frames(), factor, on_progress)


def _log_whole(
    stream: "RecordingStream", viewed: Viewed, beside: Beside, on_progress: OnProgress | None, *, otherwise: str
) -> None:
    try:
        log_trial(stream, viewed, beside, on_progress=on_progress)
        stream.flush()
    except RuntimeError as error:
        raise InputError(f"{otherwise} ({error})") from None
    finally:
        stream.disconnect()


def _static_friction(
    path: Path | None, trial: Recording, truth: TruthHeader | None, basis: LabelBasis | None
) -> Float[np.ndarray, " frames"] | None:
    """mu_s of each frame: that of the simulator, or what was estimated; None where neither is told."""
    if truth is None or path is None:
        return None if basis is None else np.full(len(trial), basis.friction.mu)
    with reading(path):
        return pq.read_table(path, columns=["static_friction"])["static_friction"].to_numpy().astype(np.float64)


def _new_stream() -> "RecordingStream":
    stream = require_rerun().RecordingStream(_APPLICATION)
    if not stream.is_enabled():
        raise InputError("the environment variable RERUN switches Rerun off; unset it")
    return stream
