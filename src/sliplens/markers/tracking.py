"""Markers of whole sources, followed into one table."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from sliplens._version import __version__
from sliplens.codec import write_tables
from sliplens.errors import InputError
from sliplens.extras import import_cv2
from sliplens.files import require_new_file
from sliplens.markers.detect import get_kind
from sliplens.markers.tracker import Tracker
from sliplens.markers.tracks import MarkerStatus, TrackedFrame
from sliplens.progress import OnProgress, note, stage
from sliplens.recordings import Dataset
from sliplens.recordings.capture import Capture
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.sensor import SensorProfile
from sliplens.recordings.source import Frame, Frames, open_source

OnTracked: TypeAlias = Callable[[Frame, TrackedFrame, Float[np.ndarray, "markers 2"]], None]
"""Takes a frame, its markers and where they were at rest, in pixels."""

_ROW_GROUP = 50_000
_NUMBERS = ("x_px", "y_px", "rest_x_px", "rest_y_px", "dx_px", "dy_px", "radius_px", "deviation_px")
_STATUS = [status.name.lower() for status in MarkerStatus]
_COLUMNS = {
    "trial": pa.string(),
    "frame": pa.int32(),
    "time_s": pa.float64(),
    "marker": pa.int32(),
    "status": pa.dictionary(pa.int8(), pa.string()),
    **dict.fromkeys(_NUMBERS, pa.float32()),
}


@dataclass(frozen=True, kw_only=True)
class TrialTracking:
    """Outcome of following the markers of one trial."""

    trial: str
    frames: int
    markers: int
    """Whole markers of the reference frame."""
    followed_share: float
    """Share of them that was followed, over all frames in which they were in view."""
    lost_frames: int
    """Frames in which no marker could be told from the next."""

    def __str__(self) -> str:
        lost = f", lost in {self.lost_frames} frames" if self.lost_frames else ""
        return f"{self.trial}: {self.markers} markers, {100 * self.followed_share:.1f} % followed while in view{lost}"


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """Markers followed through the trials of a source, a row for each marker of each frame."""

    trials: tuple[TrialTracking, ...]
    path: Path | None
    """Parquet file of the rows; None where they are kept in memory."""
    rows: pa.Table | None
    """The rows; None where they are in the file."""

    @property
    def frames(self) -> int:
        """Frames of all trials."""
        return sum(trial.frames for trial in self.trials)

    def frame(self) -> pa.Table:
        """Arrow table; `.to_pandas()` where pandas is installed.

        Columns are `trial`, `frame`, `time_s`, `marker`, `status` (`MarkerStatus`), and in pixels, x to the right and y
        down, `x_px`, `y_px`, `rest_x_px`, `rest_y_px`, `dx_px`, `dy_px`, `radius_px` and `deviation_px`. What is not
        known is null: the place of a marker that was not seen, the displacement of one that was not followed, the place
        at rest of a new one.
        """
        return pq.read_table(self.path) if self.rows is None else self.rows


def track(
    source: Path | str | Frames | Dataset | Sequence[Capture],
    *,
    markers: str = "auto",
    reference: Path | str | Frame | None = None,
    reference_frame: int | None = None,
    split: str | None = None,
    trial: str | None = None,
    format: str | None = None,
    options: ReadOptions | None = None,
    sensor: SensorProfile | Path | str | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    on_tracked: OnTracked | None = None,
    on_progress: OnProgress | None = None,
) -> Tracking:
    """Follow the markers of every trial of a source.

    Parameters
    ----------
    source
        Data set, folder of images, video, bag, uint8 RGB frames (frames, height, width, 3), or what `open_source` gave.
    markers
        Row of `KINDS`.
    reference, reference_frame
        The sensor untouched: image, or number of the frame that shows it. Where neither is named and the source brings
        none, displacements count from the first frame.
    split, trial, format, options, sensor
        As `open_source` takes them.
    out
        Parquet file to write, whole or not at all; rows are kept in memory if None.

    Raises
    ------
    InputError
        If something named is missing or does not fit, OpenCV is missing, or one frame is all there is.
    ImageError
        If a reference frame shows fewer than 4 whole markers, or frames are of another size.
    RecordingError
        If the source cannot be read.
    """
    path = None if out is None else Path(out)
    if path is not None:
        require_new_file(path, suffix=".parquet", overwrite=overwrite)
    get_kind(markers)
    import_cv2()
    if isinstance(source, Path | str | np.ndarray | Dataset):
        source = open_source(
            source,
            reference=reference,
            reference_frame=reference_frame,
            split=split,
            trial=trial,
            format=format,
            options=options,
            sensor=sensor,
        )
    notes = dict.fromkeys(words for one in source for words in (*one.notes, *_require_movement(one)))
    metadata = {"sliplens.version": __version__, "sliplens.source": source[0].opened, "sliplens.markers": markers}
    schema = pa.schema(list(_COLUMNS.items()), metadata=metadata)
    outcomes: list[TrialTracking] = []
    with stage(on_progress, "Following markers") as count:
        for sentence in notes:
            note(on_progress, sentence)
        tables = _tables(source, markers, schema=schema, outcomes=outcomes, on_tracked=on_tracked, on_progress=count)
        rows = write_tables(tables, path, schema)
    return Tracking(trials=tuple(outcomes), path=path, rows=rows)


def _require_movement(trial: Capture) -> Iterator[str]:
    """Refuse a trial that cannot have moved; gives what is assumed of one without a reference."""
    if trial.read_reference is not None:
        return
    if trial.frames == 1:
        raise InputError(
            f"{trial.name} has one frame only, which cannot have moved against itself; name the untouched sensor "
            "with --reference IMAGE"
        )
    yield f"{trial.name}: no untouched frame was named, so displacements count from the first frame."


def _tables(
    trials: Sequence[Capture],
    markers: str,
    *,
    schema: pa.Schema,
    outcomes: list[TrialTracking],
    on_tracked: OnTracked | None,
    on_progress: OnProgress,
) -> Iterator[pa.Table]:
    """Row groups of all trials; appends the outcome of each."""
    total, done, waiting = sum(trial.frames for trial in trials), 0, [schema.empty_table()]
    for trial in trials:
        read_reference = trial.read_reference or (lambda trial=trial: next(trial.read_frames()))
        tracker = Tracker(read_reference(), markers)
        rest, followed, seen, lost = tracker.rest.centre_px, 0, 0, 0
        for number, frame in enumerate(trial.read_frames()):
            tracked = tracker.update(frame)
            time_s = None if trial.time_s is None else float(trial.time_s[number])
            waiting.append(_frame_table(trial.name, number, tracked, rest_px=rest, time_s=time_s))
            if sum(map(len, waiting)) >= _ROW_GROUP:
                yield pa.concat_tables(waiting)
                waiting = [schema.empty_table()]
            if on_tracked is not None:
                on_tracked(frame, tracked, rest)
            status = tracked.status[: len(rest)]
            followed += int((status == MarkerStatus.FOLLOWED).sum())
            seen += int((status != MarkerStatus.OUTSIDE).sum())
            lost += bool((status == MarkerStatus.LOST).all())
            done += 1
            on_progress(done, total)
        shown = {"trial": trial.name, "frames": trial.frames, "markers": len(rest)}
        outcomes.append(TrialTracking(**shown, followed_share=followed / max(1, seen), lost_frames=lost))
    yield pa.concat_tables(waiting)


def _frame_table(
    trial: str, frame: int, tracked: TrackedFrame, *, rest_px: Float[np.ndarray, "markers 2"], time_s: float | None
) -> pa.Table:
    count = len(tracked.status)
    rest = np.full((count, 2), np.nan)
    rest[: len(rest_px)] = rest_px
    followed = (tracked.status == MarkerStatus.FOLLOWED)[:, None]
    shift = np.where(followed, tracked.position_px - rest, np.nan)
    numbers = np.concatenate(
        [tracked.position_px, rest, shift, tracked.radius_px[:, None], tracked.deviation_px[:, None]], axis=1
    )
    columns: dict[str, Any] = {
        "trial": pa.array([trial] * count),
        "frame": pa.array(np.full(count, frame, dtype=np.int32)),
        "time_s": pa.nulls(count, pa.float64()) if time_s is None else pa.array(np.full(count, time_s)),
        "marker": pa.array(np.arange(count, dtype=np.int32)),
        "status": pa.DictionaryArray.from_arrays(pa.array(tracked.status.astype(np.int8)), _STATUS),
        **{name: pa.array(numbers[:, at].astype(np.float32), from_pandas=True) for at, name in enumerate(_NUMBERS)},
    }
    return pa.table(columns, schema=pa.schema(_COLUMNS))
