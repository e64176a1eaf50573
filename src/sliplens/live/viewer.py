"""A recorded trial in the Rerun viewer: frames, forces, labels, predictions, maps and markers on one clock."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float
from matplotlib.colors import to_rgba

from sliplens.codec import Result, open_parquet
from sliplens.errors import InputError
from sliplens.extras import require_packages
from sliplens.files import require_new_file
from sliplens.images import absolute_difference
from sliplens.live.reading import Reading
from sliplens.live.sinks import RerunSink
from sliplens.plots.audit import end_of_ratio, force_ratio
from sliplens.plots.contact_sheet import STATE_COLOURS, TIMES, brighten, brightening
from sliplens.plots.saliency import full_colour, overlay_relevance
from sliplens.plots.style import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, YELLOW, method_name, written_whole
from sliplens.progress import OnProgress, open_stage, report_each, reporting
from sliplens.recordings import Dataset, Recording, TrialFacts, TrialInfo, load_dataset
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import DATASET_FILE, trial_path
from sliplens.recordings.source import SourceOptions
from sliplens.recordings.store import load_recording, read_header, stream_frames
from sliplens.recordings.trial import OUTSIDE, SLIPS, STICKS, Labels, labels_of_margins
from sliplens.results.explanation import Explanation, is_explanation, load_explanation

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint


@dataclass(frozen=True, kw_only=True)
class ViewedTrial(Result):
    """A trial to show (times, labels, truth), its frames read one at a time, and the results beside them."""

    trial: Recording
    read_frames: Callable[[], Iterator[Frame]]
    files: tuple[str, ...] = ()
    """Names of the images of a folder."""
    predictions: Path | None = None
    """Table that `sliplens predict` or `sliplens evaluate` wrote (Parquet)."""
    maps: Explanation | None = None
    tracks: Path | None = None
    """Table that `sliplens track` wrote."""


def view(
    source: Path | str | Explanation,
    *,
    predictions: Path | str | None = None,
    maps: Path | str | Explanation | None = None,
    tracks: Path | str | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **source_options: Unpack[SourceOptions],
) -> ViewedTrial:
    """Show a trial in the Rerun viewer: frames, differences, forces, labels, predictions and maps on one clock.

    The viewer opens on this machine and listens to it alone. Needs the extra `view`.

    Parameters
    ----------
    source
        Any source of `open_source`, a table of `predict` (which names its source), or maps of `explain`.
    predictions
        Margins with their intervals, as `predict` or `evaluate` wrote them (Parquet).
    maps
        Maps of `explain`, or their folder.
    tracks
        Markers, as `track` wrote them (Parquet).
    out
        File to write (`.rrd`) instead of opening the viewer.
    overwrite
        Replace an existing file.
    source_options
        As `open_source` takes them; `trial` is the first if None.

    Raises
    ------
    InputError
        If something is missing, does not fit, or the extra is not installed.
    """
    require_rerun()
    path = None if out is None else Path(out)
    if path is not None:
        require_new_file(path, overwrite=overwrite)
    table = None if predictions is None else Path(predictions)
    if isinstance(source, Path | str):
        source = Path(source)
        if source.suffix == ".parquet":
            table = source
            source, first = _source_of(source)
            source_options.setdefault("trial", first)
        elif is_explanation(source):
            source = load_explanation(source)
    maps = source if isinstance(source, Explanation) else maps
    viewed = replace(
        view_explained(source) if isinstance(source, Explanation) else _open_trial(source, source_options),
        predictions=table,
        maps=load_explanation(Path(maps)) if isinstance(maps, Path | str) else maps,
        tracks=None if tracks is None else Path(tracks),
    )
    with reporting(on_progress), open_stage(f"Reading {viewed.trial.trial}"):
        if path is None:
            address, failure = start_viewer(), "the Rerun viewer was closed too early; leave it open"
            _play_into(viewed, lambda stream: stream.connect_grpc(address), failure=failure)
        else:
            write_rrd(viewed, path)
    return viewed


def _open_trial(source: Path, options: SourceOptions) -> ViewedTrial:
    trial = options.get("trial")
    if (source / DATASET_FILE).is_file():
        data = load_dataset(source)
        infos = data.select(split=options.get("split"))
        return view_stored(data, infos[0] if trial is None else data.find(trial))
    from sliplens.recordings.source import open_source  # noqa: PLC0415 (readers of video come with it)

    return view_capture(open_source(source, **options)[0])


def _source_of(table: Path) -> tuple[Path, str | None]:
    """Return the source of a table of predictions, and its first trial."""
    with open_parquet(table, {"trial": "texts"}, cure="name a table that sliplens predict wrote") as file:
        source = (file.schema_arrow.metadata or {}).get(b"sliplens.source", b"").decode()
        trials = next(file.iter_batches(1, columns=["trial"]), None)
    if not source or not Path(source).exists():
        raise InputError(
            f"{table} was predicted from {source or 'an unknown source'}, which does not exist; name the source first, "
            f"and the table with --predictions {table}"
        )
    return Path(source), None if trials is None else trials["trial"][0].as_py()


def view_stored(data: Dataset, info: TrialInfo) -> ViewedTrial:
    """Prepare a trial of a data set for the viewer; only simulated trials are loaded whole, for their truth."""
    path = trial_path(data.folder, info.trial)
    trial = load_recording(path, pixels=read_header(path).truth is not None)
    read_frames = partial(stream_frames, path) if trial.truth is None else lambda: iter(trial.frames)
    return ViewedTrial(trial=trial, read_frames=read_frames)


def view_capture(capture: Capture) -> ViewedTrial:
    """Prepare a recording of any source for the viewer; its first frame is the reference where it names none."""
    count, labels = len(capture), capture.labels or labels_of_margins(np.full(len(capture), np.nan))
    reference = next(capture.read_frames()) if capture.read_reference is None else capture.read_reference()
    trial = Recording(
        **{field.name: getattr(capture, field.name) for field in fields(TrialFacts)},
        **{field.name: getattr(labels, field.name) for field in fields(Labels)},
        time_s=np.arange(count) / capture.frame_rate_hz if capture.time_s is None else capture.time_s,
        reference=reference,
        frames=np.broadcast_to(reference, (count, *reference.shape)),
    )
    return ViewedTrial(trial=trial, read_frames=capture.read_frames, files=capture.files or ())


def view_explained(explained: Explanation) -> ViewedTrial:
    """Prepare explained frames for the viewer, as their network saw them."""
    from sliplens.recordings.source import open_source  # noqa: PLC0415 (readers of video come with it)

    (capture,) = open_source(explained.pictures)
    first = explained.frames[0]
    margins = [np.nan if frame.safety_margin is None else frame.safety_margin for frame in explained.frames]
    facts = {"trial": first.trial, "condition": first.condition, "day": first.day}
    viewed = view_capture(replace(capture, **facts, labels=labels_of_margins(np.array(margins))))
    return replace(viewed, files=tuple(f"{frame.id}.png" for frame in explained.frames))


def require_rerun() -> ModuleType:
    """Import Rerun, which only the viewer needs."""
    require_packages("rerun", extra="view", purpose="the viewer")
    import rerun  # noqa: PLC0415 (an extra, and large)

    if not rerun.RecordingStream("sliplens").is_enabled():
        raise InputError("the environment variable RERUN switches Rerun off; unset it")
    return rerun


def write_rrd(viewed: ViewedTrial, path: Path) -> None:
    """Write a trial as a file of the Rerun viewer; it appears when complete."""
    if path.suffix.lower() != ".rrd":
        raise InputError(f"{path} does not end in .rrd; name a file of the Rerun viewer, such as trial.rrd")
    require_rerun()
    with written_whole(path) as part:
        part.touch()  # Rerun reports a file that cannot be written in its own way
        failure = f"{path} could not be written; see what space is left"
        _play_into(viewed, lambda stream: stream.save(part), failure=failure)


def _play_into(viewed: ViewedTrial, connect: Callable[[Any], None], *, failure: str) -> None:
    sink = RerunSink(connect, lossless=True)
    try:
        play_trial(viewed, sink)
        sink.stream.flush()
    except RuntimeError as error:
        raise InputError(f"{failure} ({error})") from None
    finally:
        sink.stream.disconnect()


# colours that are read on a dark ground and on a light one: the viewer has both, so nothing is black
_LINES = {
    "force/normal": ("F_n (N)", BLUE),
    "force/tangential": ("F_t (N)", VERMILLION),
    "force/limit": ("μ F_n (N)", GREY),
    "ratio/tangential_to_normal": ("F_t / F_n", BLUE),
    "ratio/friction": ("friction coefficient", GREEN),
    "label/margin": ("true Γ", SKY),
    "label/high": ("true Γ + \N{GREEK SMALL LETTER SIGMA}", PURPLE),
    "label/low": ("true Γ \N{MINUS SIGN} \N{GREEK SMALL LETTER SIGMA}", PURPLE),
    "label/stick_ratio": ("stick ratio", ORANGE),
    "margin": ("predicted Γ", VERMILLION),
    "interval/high": ("upper end of its 90 % interval", VERMILLION),
    "interval/low": ("lower end of its 90 % interval", VERMILLION),
}
"""Name and colour of the numbers of a frame, by entity."""
_LABEL_COLOURS = {"valid": GREEN, "not valid": GREY}
_STATE_COLOURS = {str(state): GREY if colour == "white" else colour for state, colour in STATE_COLOURS.items()}
_ZONE_OPACITY = 0.3
_SAMPLED_FRAMES = 32  # from which the brightness of all differences is chosen
_HALF_PX = 0.5  # a pixel's centre is a whole number here, and a half more in Rerun


def _rgba(colour: str) -> list[int]:
    return [round(255 * part) for part in to_rgba(colour)]


def play_trial(viewed: ViewedTrial, sink: RerunSink) -> None:
    """Send a trial, the results beside it and the viewer's layout to a sink, a frame in memory at a time."""
    trial, rerun = viewed.trial, require_rerun()
    readings = {} if viewed.predictions is None else _load_readings(trial, viewed.predictions)
    followed = {} if viewed.tracks is None else _load_tracks(trial, viewed.tracks)
    maps = {} if viewed.maps is None else _find_maps(viewed, viewed.maps)
    sampled = np.stack(list(islice(viewed.read_frames(), 0, None, -(-len(trial) // _SAMPLED_FRAMES))))
    factor = brightening([absolute_difference(sampled, trial.reference)])
    numbers = _frame_numbers(trial)
    methods = () if viewed.maps is None else tuple(viewed.maps.methods)

    sink.stream.send_recording_name(trial.trial)
    sink.stream.send_blueprint(_lay_out(viewed, factor, numbers["ratio/friction"], methods))
    sink.log_image("reference", trial.reference, static=True)
    _set_styles(sink, rerun, trial, [*numbers, *(["margin", "interval/high", "interval/low"] if readings else [])])
    _log_states(sink, rerun, trial)
    for number, frame in zip(report_each(range(len(trial))), viewed.read_frames(), strict=True):
        time_s = float(trial.time_s[number])
        if number in readings:
            sink.send(replace(readings[number], time_s=time_s), frame)
        else:
            sink.set_frame(number, time_s)
            sink.log_image("frame", frame)
        sink.log_image("difference", brighten(absolute_difference(frame, trial.reference), factor))
        for entity, values in numbers.items():
            sink.stream.log(entity, rerun.Scalars(values[number]))
        if number in followed:
            sink.stream.log("frame/followed", rerun.Points2D(followed[number]))
        if trial.truth is not None:
            places, rest = trial.truth.marker_px[number], trial.truth.marker_rest_px
            zones = rerun.SegmentationImage(trial.truth.contact_map[number], opacity=_ZONE_OPACITY)
            sink.stream.log("frame/zones", zones)
            sink.stream.log("frame/markers", rerun.Points2D(places + _HALF_PX))
            arrows = rerun.Arrows2D(vectors=places - rest, origins=rest + _HALF_PX)
            sink.stream.log("frame/displacements", arrows)
        for method in methods:
            if number in maps:
                sink.log_image(f"map/{method}", maps[number][method])
            elif number - 1 in maps:  # a map describes its own frame alone
                sink.stream.log(f"map/{method}", rerun.Clear(recursive=False))


def _set_styles(sink: RerunSink, rerun: ModuleType, trial: Recording, lines: Iterable[str]) -> None:
    """Send names and colours of lines, markers and zones."""
    styles: dict[str, Any] = {
        entity: rerun.SeriesLines(
            names=_LINES[entity][0],
            colors=[_rgba(_LINES[entity][1])],
            widths=1.0 if entity.endswith(("high", "low")) else 2.0,
        )
        for entity in lines
    }
    for entity, colour, radius in (("frame/followed", GREEN, 2.5), ("frame/markers", YELLOW, 2.0)):
        styles[entity] = rerun.Points2D.from_fields(colors=[_rgba(colour)], radii=[rerun.Radius.ui_points(radius)])
    if trial.truth is not None:
        thin = [rerun.Radius.ui_points(1.0)]
        styles["frame/displacements"] = rerun.Arrows2D.from_fields(colors=[_rgba(YELLOW)], radii=thin)
        zones = [(OUTSIDE, "no contact", [0] * 4), (SLIPS, "slips", _rgba(ORANGE)), (STICKS, "sticks", _rgba(SKY))]
        styles["frame/zones"] = rerun.AnnotationContext(zones)
    for entity, style in styles.items():
        sink.stream.log(entity, style, static=True)


def _log_states(sink: RerunSink, rerun: ModuleType, trial: Recording) -> None:
    """Log when the contact changes its state, and when labels begin and cease to be valid."""
    lanes = {"state/contact": ([str(state) for state in trial.contact_state], _STATE_COLOURS)}
    if trial.valid is not None:
        lanes["state/label"] = (["valid" if valid else "not valid" for valid in trial.labelled], _LABEL_COLOURS)
    for entity, (states, colours) in lanes.items():
        style = rerun.StateConfiguration(values=list(colours), colors=[_rgba(colour) for colour in colours.values()])
        sink.stream.log(entity, style, static=True)
        for number, (before, state) in enumerate(pairwise(["", *states])):
            if state != before:
                sink.set_frame(number, float(trial.time_s[number]))
                sink.stream.log(entity, rerun.StateChange(state=state))


def _frame_numbers(trial: Recording) -> dict[str, Float[np.ndarray, " frames"]]:
    """Forces and labels of every frame, by entity."""
    normal, margin, sigma = trial.normal_force_n, trial.safety_margin, trial.safety_margin_sigma
    basis = trial.labelling.basis if trial.labelling else None
    if trial.truth is not None:
        friction = trial.truth.static_friction
    else:
        friction = trial.friction_coefficient if basis is None else np.full(len(trial), basis.friction.mu)
    numbers = {
        "force/normal": normal,
        "force/tangential": trial.tangential_force_n,
        "force/limit": trial.friction_coefficient * normal,
        "ratio/tangential_to_normal": force_ratio(trial),
        "ratio/friction": friction,
        "label/margin": margin,
        "label/stick_ratio": trial.stick_ratio,
    }
    return numbers if sigma is None else numbers | {"label/high": margin + sigma, "label/low": margin - sigma}


def _load_readings(trial: Recording, path: Path) -> dict[int, Reading]:
    """Load the predictions of a trial, by frame."""
    names = "frame", "prediction", "low_90", "high_90"
    rows = _rows_of(trial, path, names, command="sliplens predict")
    return {
        number: Reading(number=number, time_s=np.nan, captured_s=np.nan, margin=margin, low=low, high=high)
        for number, margin, low, high in zip(*(rows[name].to_pylist() for name in names), strict=True)
    }


def _load_tracks(trial: Recording, path: Path) -> dict[int, Float[np.ndarray, "markers 2"]]:
    """Load the places of the markers seen in each frame of a trial."""
    rows = _rows_of(trial, path, ("frame", "x_px", "y_px"), command="sliplens track")
    frames = rows["frame"].to_numpy()
    points = np.stack([rows[name].to_numpy().astype(np.float64) for name in ("x_px", "y_px")], axis=-1) + _HALF_PX
    visible_points = np.isfinite(points).all(axis=1)
    return {int(number): points[(frames == number) & visible_points] for number in np.unique(frames)}


def _rows_of(trial: Recording, path: Path, columns: Sequence[str], *, command: str) -> pa.Table:
    """Load the rows of a table that belong to a trial, in the order of its frames."""
    kinds = dict.fromkeys(columns, "numbers") | {"trial": "texts", "frame": "whole numbers"}
    with open_parquet(path, kinds, cure=f"name a table that {command} wrote") as file:
        table = file.read(columns=list(kinds))
    names = table["trial"].unique().to_pylist()
    rows = table.filter(pc.field("trial") == trial.trial).sort_by("frame")
    if not len(rows):
        raise InputError(f"{path} has no frame of {trial.trial}; it has {', '.join(map(str, names[:3]))}")
    last = rows["frame"][-1].as_py()
    if rows["frame"][0].as_py() < 0 or last >= len(trial):
        raise InputError(f"{path} has frame {last} of {trial.trial}, which has {len(trial)}; predict it anew")
    return rows


def _find_maps(viewed: ViewedTrial, maps: Explanation) -> dict[int, dict[str, Frame]]:
    """Draw the maps of the trial's frames, by frame and method, each method on one scale."""
    trial = viewed.trial
    numbers = {f"{trial.trial}-f{number:04d}": number for number in range(len(trial))}
    # names of files go first: of maps alone the files are the frames that were explained
    numbers |= {Path(name).stem: number for number, name in enumerate(viewed.files)}
    rows = {numbers[frame.id]: row for row, frame in enumerate(maps.frames) if frame.id in numbers}
    if not rows:
        raise InputError(f"the maps are of no frame of {trial.trial}; they are of {maps.frames[0].id} and others")
    scales = {method: full_colour(maps.relevance[method]) for method in maps.methods}
    return {
        number: {
            method: overlay_relevance(maps.pictures[row], maps.relevance[method][row] / scale)
            for method, scale in scales.items()
        }
        for number, row in rows.items()
    }


def _lay_out(
    viewed: ViewedTrial, factor: float, friction: Float[np.ndarray, " frames"], methods: Sequence[str]
) -> "Blueprint":
    """Lay out the views of a trial; `factor` multiplies the brightness of its differences."""
    rrb, trial = require_rerun().blueprint, viewed.trial
    height, width = trial.reference.shape[:2]
    bounds = rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height))
    view = partial(rrb.Spatial2DView, visual_bounds=bounds)
    camera = view(origin="frame", name=f"camera T_n{': contact, stick zone, markers' if trial.truth else ''}")
    difference = view(origin="difference", name=f"difference |T_n \N{MINUS SIGN} T_0| {TIMES} {factor:g}")
    reference = view(origin="reference", name="reference T_0")

    def chart(origin: str, name: str, legend: str = "RightBottom", **settings: Any) -> object:
        corner, across = rrb.PlotLegend(corner=legend), rrb.TimeAxis(link="LinkToGlobal")
        return rrb.TimeSeriesView(origin=origin, name=name, axis_x=across, plot_legend=corner, **settings)

    contents = ["/margin", "/interval/**", "/label/**"]
    margins = "safety margin Γ (1 sticks, 0 slips), stick ratio"
    charts = [chart("/", margins, "LeftBottom", contents=contents, axis_y=rrb.ScalarAxis(range=(-0.05, 1.05)))]
    if np.isfinite(trial.normal_force_n).any():
        highest = float(np.max(friction, where=np.isfinite(friction), initial=0))
        span = rrb.ScalarAxis(range=(0.0, end_of_ratio(force_ratio(trial), highest)))
        charts += [chart("force", "forces (N)"), chart("ratio", "F_t / F_n in contact, beside friction", axis_y=span)]
    # a map is as large as the network's image, whatever the camera's
    named = {f"map/{method}": f"map by {method_name(method)}, at its frame" for method in methods}
    maps = [rrb.Spatial2DView(origin=origin, name=name) for origin, name in named.items()]
    states = rrb.StateTimelineView(origin="state", name="contact state")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(camera, difference, rrb.Tabs(*maps, reference)),
            rrb.Vertical(states, *charts, row_shares=[0.6, *(1 for _ in charts)]),
            column_shares=[2, 3],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        # the first frame shows an untouched fingertip, so it plays
        rrb.TimePanel(state="collapsed", timeline="time", play_state="playing", loop_mode="off"),
        auto_views=False,
    )


_LOOPBACK = "127.0.0.1"
_PATIENCE_S, _GRACE_S = 30.0, 1.0  # a graphics driver takes its time; a viewer listens, and then looks for a screen


def start_viewer() -> str:
    """Start a viewer that outlives this process; gives the address to which data are sent."""
    with socket.socket() as free:
        free.bind((_LOOPBACK, 0))
        port = free.getsockname()[1]
    # rerun.spawn would have the viewer listen on every network of the machine, and seeks it on the PATH only
    command = [sys.executable, "-m", "rerun_cli", "--bind", _LOOPBACK, "--port", str(port), "--expect-data-soon"]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
        give_up = time.monotonic() + _PATIENCE_S
        while time.monotonic() < give_up and process.poll() is None:
            with suppress(OSError), socket.create_connection((_LOOPBACK, port), timeout=0.2):
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_GRACE_S)
                    break
                return f"rerun+http://{_LOOPBACK}:{port}/proxy"
            time.sleep(0.05)
        if process.poll() is None:
            if hasattr(os, "killpg"):  # the viewer is a child of the process that was started
                os.killpg(process.pid, signal.SIGTERM)
            process.kill()
            process.wait()
        log.seek(0)
        words = log.read().decode(errors="replace").strip().splitlines()
    why = words[-1].strip() if words else "it gave no reason"
    raise InputError(f"the Rerun viewer did not start ({why}); write a file with --output and open it elsewhere")
