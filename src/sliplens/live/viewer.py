"""A recording in the Rerun viewer: frames with margins, maps and markers, played into the sink of `live`."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sliplens.codec import Result, open_parquet
from sliplens.errors import InputError
from sliplens.extras import require_keywords
from sliplens.files import require_new_file
from sliplens.live.reading import Reading
from sliplens.live.sinks import RerunSink
from sliplens.plots.style import written_whole
from sliplens.progress import OnProgress, open_stage, report_each, reporting
from sliplens.recordings.capture import Capture
from sliplens.recordings.source import SourceOptions, open_source
from sliplens.results.explanation import Explanation, full_colour, load_explanation, overlay_relevance

_ARROWS = [(240, 228, 66)]
_HALF_PX = 0.5  # a pixel's centre is a whole number here, and a half more in Rerun


@dataclass(frozen=True, kw_only=True)
class ViewedTrial(Result):
    """Trial that is shown: its name and number of frames."""

    trial: str
    frames: int


def view(
    source: Path | str,
    *,
    predictions: Path | str | None = None,
    maps: Path | str | Explanation | None = None,
    tracks: Path | str | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **source_options: Unpack[SourceOptions],
) -> ViewedTrial:
    """Show a trial in the Rerun viewer: frames, margins, maps and markers on one clock.

    The viewer opens on this machine and listens to it alone. Needs the extra `view`.

    Parameters
    ----------
    source
        Any source of `open_source`.
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
    >>> sl.view("cup.mp4", out="cup.rrd").trial  # doctest: +SKIP
    'cup'
    """
    require_keywords(view, source_options)
    path = None if out is None else Path(out)
    if path is not None:
        require_new_file(path, suffix=".rrd", overwrite=overwrite)
    sink = RerunSink(lossless=True)
    capture = open_source(source, **source_options)[0]
    maps = load_explanation(Path(maps)) if isinstance(maps, Path | str) else maps
    failure = "the Rerun viewer was closed too early; leave it open"
    with reporting(on_progress), open_stage(f"Reading {capture.trial}"), ExitStack() as stack:
        if path is None:
            sink.stream.connect_grpc(start_viewer())
        else:
            failure = f"{path} could not be written; see what space is left"
            part = stack.enter_context(written_whole(path))
            part.touch()  # Rerun reports a file that cannot be written in its own way
            sink.stream.save(part)
        stack.callback(sink.stream.disconnect)
        try:
            _play(capture, sink, predictions=predictions, maps=maps, tracks=tracks)
            sink.stream.flush()
        except RuntimeError as error:
            raise InputError(f"{failure} ({error})") from None
    return ViewedTrial(trial=capture.trial, frames=len(capture))


def _play(
    capture: Capture,
    sink: RerunSink,
    *,
    predictions: Path | str | None,
    maps: Explanation | None,
    tracks: Path | str | None,
) -> None:
    """Send a trial and the results beside it to a sink, a frame in memory at a time."""
    rerun, stream, unknown = sink.rerun, sink.stream, np.full((len(capture), 3), np.nan)
    margins, markers = unknown.copy(), {}
    if predictions is not None:
        table = _rows_of(capture, Path(predictions), ("prediction", "low_90", "high_90"), command="sliplens predict")
        margins[table[:, 0].astype(int)] = table[:, 1:]
    if tracks is not None:
        columns = ("rest_x_px", "rest_y_px", "x_px", "y_px")
        table = _rows_of(capture, Path(tracks), columns, command="sliplens track")
        table = table[np.isfinite(table).all(axis=1)]
        markers = {number: table[table[:, 0] == number, 1:] for number in np.unique(table[:, 0]).tolist()}
    truth = unknown[:, 0] if capture.safety_margin is None else capture.safety_margin
    explained = {} if maps is None else _rows_of_maps(capture, maps)
    scales = {} if maps is None else {method: full_colour(maps.relevance[method]) for method in maps.methods}
    stream.send_recording_name(capture.trial)
    sink.send_layout(scales)
    times_s = np.arange(len(capture)) / capture.frame_rate_hz if capture.time_s is None else capture.time_s
    for number, frame in zip(report_each(range(len(capture))), capture.read_frames(), strict=True):
        values = (None if np.isnan(value) else float(value) for value in (*margins[number], truth[number]))
        margin, low, high, true_margin = values
        clock = {"number": number, "time_s": float(times_s[number]), "captured_s": np.nan}
        sink.send(Reading(**clock, margin=margin, low=low, high=high, true_margin=true_margin), frame)
        if number in markers:
            start_px, end_px = np.split(markers[number], 2, axis=1)
            arrows = rerun.Arrows2D(origins=start_px + _HALF_PX, vectors=end_px - start_px, colors=_ARROWS)
            stream.log("frame/markers", arrows)
        for method, scale in scales.items():
            if (row := explained.get(number)) is not None and maps is not None:
                image = overlay_relevance(maps.pictures[row], maps.relevance[method][row] / scale)
                sink.log_image(f"map/{method}", image)
            elif number - 1 in explained:  # a map describes its own frame alone
                stream.log(f"map/{method}", rerun.Clear(recursive=False))


def _rows_of(capture: Capture, path: Path, columns: Sequence[str], *, command: str) -> np.ndarray:
    """Load the numbers of the frames of a trial and some columns, (rows, 1 + columns); NaN where there is none."""
    kinds: dict[str, Any] = dict.fromkeys(columns, "numbers") | {"trial": "texts", "frame": "whole numbers"}
    with open_parquet(path, kinds, cure=f"name a table that {command} wrote") as file:
        table = file.read(columns=list(kinds))
    names = table["trial"].unique().to_pylist()
    rows = table.filter(pc.field("trial") == capture.trial)
    if not len(rows):
        raise InputError(f"{path} has no frame of {capture.trial}; it has {', '.join(map(str, names[:3]))}")
    values = np.stack([rows[name].cast(pa.float64()).to_numpy() for name in ("frame", *columns)], axis=1)
    last = int(values[:, 0].max())
    if values[:, 0].min() < 0 or last >= len(capture):
        raise InputError(f"{path} has frame {last} of {capture.trial}, which has {len(capture)}; predict it again")
    return values


def _rows_of_maps(capture: Capture, maps: Explanation) -> dict[int, int]:
    """Return the rows of the maps by the numbers of the trial's frames."""
    numbers = {f"{capture.trial}-f{number:04d}": number for number in range(len(capture))}
    numbers |= {Path(name).stem: number for number, name in enumerate(capture.files or ())}
    rows = {numbers[frame.id]: row for row, frame in enumerate(maps.frames) if frame.id in numbers}
    if not rows:
        raise InputError(f"the maps are of no frame of {capture.trial}; they are of {maps.frames[0].id} and others")
    return rows


_PATIENCE_S, _GRACE_S = 30.0, 1.0  # a graphics driver takes its time; a viewer listens, and then looks for a screen


def start_viewer() -> str:
    """Start a viewer that outlives this process; gives the address to which data are sent."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    # rerun.spawn would have the viewer listen on every network of the machine, and seeks it on the PATH only
    command = [sys.executable, "-m", "rerun_cli", "--bind", "127.0.0.1", "--port", str(port), "--expect-data-soon"]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
        give_up = time.monotonic() + _PATIENCE_S
        while process.poll() is None and time.monotonic() < give_up:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=0.2):
                time.sleep(_GRACE_S)
                if process.poll() is None:
                    return f"rerun+http://127.0.0.1:{port}/proxy"
            time.sleep(0.05)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)  # the viewer is a child of the process that was started
        log.seek(0)
        lines = [line.strip() for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    why = lines[-1] if lines else "it gave no reason"
    raise InputError(f"the Rerun viewer did not start ({why}); write a file with --output and open it elsewhere")
