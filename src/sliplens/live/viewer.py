"""A recorded trial in the Rerun viewer: frames, forces, labels, predictions, maps and markers on one clock."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float
from matplotlib.colors import to_rgba

from sliplens.codec import Result, open_parquet
from sliplens.errors import InputError
from sliplens.files import require_new_file
from sliplens.images import absolute_difference
from sliplens.live.sinks import RerunSink
from sliplens.plots.contact_sheet import TIMES, brighten
from sliplens.plots.saliency import full_colour, overlay_relevance
from sliplens.plots.style import BLUE, GREY, ORANGE, PURPLE, SKY, VERMILLION, YELLOW, method_name, written_whole
from sliplens.progress import OnProgress, open_stage, report_each, reporting
from sliplens.recordings import Recording, TrialFacts, load_dataset
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
    """A trial that is shown (times, labels, truth), its frames read one at a time."""

    trial: Recording
    read_frames: Callable[[], Iterator[Frame]]
    files: tuple[str, ...] = ()
    """Names of the images of a folder."""


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

    See Also
    --------
    plot : Draw the figure of a result.

    Examples
    --------
    >>> import sliplens as sl
    >>> sl.view("data", out="trial.rrd")  # doctest: +SKIP
    """
    path = None if out is None else Path(out)
    if path is not None:
        require_new_file(path, overwrite=overwrite)
        if path.suffix.lower() != ".rrd":
            raise InputError(f"{path} does not end in .rrd; name a file of the Rerun viewer, such as trial.rrd")
    sink = RerunSink(lossless=True)
    if isinstance(source, Path | str):
        source = Path(source)
        if source.suffix == ".parquet":
            predictions = source
            source, first = _source_of(source)
            source_options.setdefault("trial", first)
        elif is_explanation(source):
            source = load_explanation(source)
    maps = source if isinstance(source, Explanation) else maps
    viewed = _open_trial(source, source_options)
    maps = load_explanation(Path(maps)) if isinstance(maps, Path | str) else maps
    failure = "the Rerun viewer was closed too early; leave it open"
    with reporting(on_progress), open_stage(f"Reading {viewed.trial.trial}"):
        address = start_viewer() if path is None else ""
        with nullcontext() if path is None else written_whole(path) as part:
            if part is None:
                sink.stream.connect_grpc(address)
            else:
                part.touch()  # Rerun reports a file that cannot be written in its own way
                failure = f"{path} could not be written; see what space is left"
                sink.stream.save(part)
            try:
                _play(viewed, sink, predictions=predictions, maps=maps, tracks=tracks)
                sink.stream.flush()
            except RuntimeError as error:
                raise InputError(f"{failure} ({error})") from None
            finally:
                sink.stream.disconnect()
    return viewed


def _open_trial(source: Path | Explanation, options: SourceOptions) -> ViewedTrial:
    """Open a trial; only simulated ones are loaded whole, for their truth."""
    from sliplens.recordings.source import open_source  # noqa: PLC0415 (readers of video come with it)

    if isinstance(source, Explanation):
        first, margins = source.frames[0], [frame.safety_margin for frame in source.frames]
        labels = labels_of_margins(np.array(margins, dtype=np.float64))
        facts = {"trial": first.trial, "condition": first.condition, "day": first.day}
        viewed = _without_truth(replace(open_source(source.pictures)[0], **facts, labels=labels))
        return replace(viewed, files=tuple(f"{frame.id}.png" for frame in source.frames))
    if not (source / DATASET_FILE).is_file():
        return _without_truth(open_source(source, **options)[0])
    data, trial = load_dataset(source), options.get("trial")
    info = data.select(split=options.get("split"))[0] if trial is None else data.find(trial)
    path = trial_path(data.folder, info.trial)
    recording = load_recording(path, pixels=read_header(path).truth is not None)
    simulated = recording.truth is not None
    return ViewedTrial(
        trial=recording, read_frames=(lambda: iter(recording.frames)) if simulated else partial(stream_frames, path)
    )


def _without_truth(capture: Capture) -> ViewedTrial:
    """Make the trial of any other source; its first frame is the reference where it names none."""
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


# colours that are read on a dark ground and on a light one: the viewer has both, so nothing is black
_LINES = {
    "force/normal": ("F_n (N)", BLUE),
    "force/tangential": ("F_t (N)", VERMILLION),
    "force/limit": ("μ F_n (N)", GREY),
    "label/margin": ("true Γ", SKY),
    "label/high": ("true Γ + \N{GREEK SMALL LETTER SIGMA}", PURPLE),
    "label/low": ("true Γ \N{MINUS SIGN} \N{GREEK SMALL LETTER SIGMA}", PURPLE),
    "margin": ("predicted Γ", VERMILLION),
    "interval/high": ("upper end of its 90 % interval", VERMILLION),
    "interval/low": ("lower end of its 90 % interval", VERMILLION),
}
"""Name and colour of the numbers of a frame, by entity."""
_BRIGHTER = 4.0
"""Factor of the brightness of differences."""
_ZONE_OPACITY = 0.3
_HALF_PX = 0.5  # a pixel's centre is a whole number here, and a half more in Rerun


def _rgba(colour: str) -> list[int]:
    return [round(255 * part) for part in to_rgba(colour)]


def _play(
    viewed: ViewedTrial,
    sink: RerunSink,
    *,
    predictions: Path | str | None,
    maps: Explanation | None,
    tracks: Path | str | None,
) -> None:
    """Send a trial, the results beside it and the viewer's layout to a sink, a frame in memory at a time."""
    trial, rerun, stream, numbers = viewed.trial, sink.rerun, sink.stream, np.arange(len(viewed.trial))
    margin, normal, sigma = trial.safety_margin, trial.normal_force_n, trial.safety_margin_sigma
    lines = {
        "force/normal": (numbers, normal),
        "force/tangential": (numbers, trial.tangential_force_n),
        "force/limit": (numbers, trial.friction_coefficient * normal),
        "label/margin": (numbers, margin),
    }
    if sigma is not None:
        lines |= {"label/high": (numbers, margin + sigma), "label/low": (numbers, margin - sigma)}
    if predictions is not None:
        columns = {"prediction": "margin", "low_90": "interval/low", "high_90": "interval/high"}
        rows = _rows_of(trial, Path(predictions), ("frame", *columns), command="sliplens predict")
        lines |= {entity: (rows["frame"].astype(int), rows[name]) for name, entity in columns.items()}
    markers = {}
    if tracks is not None:
        rows = _rows_of(trial, Path(tracks), ("frame", "x_px", "y_px"), command="sliplens track")
        points = np.stack([rows["x_px"], rows["y_px"]], axis=-1)[np.isfinite(rows["x_px"])]
        number = rows["frame"][np.isfinite(rows["x_px"])].astype(int)
        markers = {at: points[number == at] for at in np.unique(number).tolist()}
    elif trial.truth is not None:
        markers = dict(enumerate(trial.truth.marker_px))
    drawn = {} if maps is None else _draw_maps(viewed, maps)

    stream.send_recording_name(trial.trial)
    stream.send_blueprint(_lay_out(rerun.blueprint, trial, () if maps is None else maps.methods))
    sink.log_image("reference", trial.reference, static=True)
    for entity, (frames, values) in lines.items():
        name, colour = _LINES[entity]
        stream.log(entity, rerun.SeriesLines(names=name, colors=[_rgba(colour)]), static=True)
        if np.isfinite(values).any():
            clock = rerun.TimeColumn("time", duration=sink.in_ns(trial.time_s[frames]))
            times = [clock, rerun.TimeColumn("frame", sequence=frames)]
            stream.send_columns(entity, times, rerun.Scalars.columns(scalars=values))
    zones = [(OUTSIDE, "no contact", [0] * 4), (SLIPS, "slips", _rgba(ORANGE)), (STICKS, "sticks", _rgba(SKY))]
    stream.log("frame/zones", rerun.AnnotationContext(zones), static=True)
    for number, frame in zip(report_each(range(len(trial))), viewed.read_frames(), strict=True):
        sink.set_frame(number, float(trial.time_s[number]))
        sink.log_image("frame", frame)
        sink.log_image("difference", brighten(absolute_difference(frame, trial.reference), _BRIGHTER))
        if number in markers:
            points = rerun.Points2D(markers[number] + _HALF_PX, colors=_rgba(YELLOW), radii=rerun.Radius.ui_points(2))
            stream.log("frame/markers", points)
        if trial.truth is not None:
            zones = rerun.SegmentationImage(trial.truth.contact_map[number], opacity=_ZONE_OPACITY)
            stream.log("frame/zones", zones)
        for method in () if number in drawn else drawn.get(number - 1, {}):  # a map describes its own frame alone
            stream.log(f"map/{method}", rerun.Clear(recursive=False))
        for method, image in drawn.get(number, {}).items():
            sink.log_image(f"map/{method}", image)


def _lay_out(rrb: Any, trial: Recording, methods: Iterable[str]) -> "Blueprint":
    """Lay out the views of a trial."""
    height, width = trial.reference.shape[:2]
    view = partial(rrb.Spatial2DView, visual_bounds=rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height)))
    chart = partial(rrb.TimeSeriesView, axis_x=rrb.TimeAxis(link="LinkToGlobal"))
    # a map is as large as the network's image, whatever the camera's
    maps = {method: f"map by {method_name(method)}, at its frame" for method in methods}
    margins, contents = "safety margin Γ (1 sticks, 0 slips)", ["/margin", "/interval/**", "/label/**"]
    charts = [chart(name=margins, contents=contents, axis_y=rrb.ScalarAxis(range=(-0.05, 1.05)))]
    if np.isfinite(trial.normal_force_n).any():
        charts.append(chart(origin="force", name="forces (N)"))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                view(origin="frame", name=f"camera T_n{': contact, stick zone, markers' if trial.truth else ''}"),
                view(origin="difference", name=f"difference |T_n \N{MINUS SIGN} T_0| {TIMES} {_BRIGHTER:g}"),
                rrb.Tabs(
                    *(rrb.Spatial2DView(origin=f"map/{method}", name=name) for method, name in maps.items()),
                    view(origin="reference", name="reference T_0"),
                ),
            ),
            rrb.Vertical(*charts),
            column_shares=[2, 3],
        ),
        # the first frame shows an untouched fingertip, so it plays
        rrb.TimePanel(state="collapsed", timeline="time", play_state="playing", loop_mode="off"),
        collapse_panels=True,
    )


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


def _rows_of(
    trial: Recording, path: Path, columns: Sequence[str], *, command: str
) -> dict[str, Float[np.ndarray, " rows"]]:
    """Load columns of the rows that belong to a trial, in the order of its frames; NaN where there is no number."""
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
    return {name: rows[name].cast(pa.float64()).to_numpy() for name in columns}


def _draw_maps(viewed: ViewedTrial, maps: Explanation) -> dict[int, dict[str, Frame]]:
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
            os.killpg(process.pid, signal.SIGKILL)  # the viewer is a child of the process that was started
            process.wait()
        log.seek(0)
        words = log.read().decode(errors="replace").split("\n")
    why = next((line.strip() for line in reversed(words) if line.strip()), "it gave no reason")
    raise InputError(f"the Rerun viewer did not start ({why}); write a file with --output and open it elsewhere")
