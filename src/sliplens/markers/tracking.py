"""Tracking of the markers of whole sources into one table."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

import numpy as np
import pyarrow as pa

from sliplens._version import __version__
from sliplens.codec import Result, read_written, regrouped, write_tables
from sliplens.errors import InputError
from sliplens.extras import import_cv2, pick, require_keywords
from sliplens.files import require_new_table
from sliplens.images import Images
from sliplens.markers.detect import KINDS
from sliplens.markers.tracker import MarkerStatus, Tracker
from sliplens.progress import OnProgress, add_note, number_of, report_progress, reporting
from sliplens.recordings import Dataset
from sliplens.recordings.capture import Capture
from sliplens.recordings.sensor import load_profile
from sliplens.recordings.source import Frame, SourceOptions, Trials, open_trials
from sliplens.runner import MakePart, Work, run_table

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
    """Result of tracking the markers of one trial."""

    trial: str
    frames: int
    markers: int
    """Whole markers of the reference frame."""
    followed_share: float
    """Share of them that were followed, over all frames in which they were in view."""
    lost_frames: int
    """Frames in which markers could not be identified."""

    def __str__(self) -> str:
        lost = f", lost in {number_of(self.lost_frames, 'frame')}" if self.lost_frames else ""
        return f"{self.trial}: {self.markers} markers, {100 * self.followed_share:.1f} % followed while in view{lost}"


@dataclass(frozen=True, kw_only=True)
class Tracking(Result):
    """Tracked markers of the trials of a source, a row for each marker of each frame."""

    trials: tuple[TrialTracking, ...]
    path: Path | None
    """Parquet file of the rows; None where they are in memory."""
    rows: pa.Table | None
    """The rows; None where they are in the file."""

    @property
    def frames(self) -> int:
        """Frames of all trials."""
        return sum(trial.frames for trial in self.trials)

    def to_arrow(self) -> pa.Table:
        """Arrow table, a row for each marker of each frame.

        Columns are `trial`, `frame`, `time_s`, `marker`, `status` (`MarkerStatus`), and in pixels, x to the right and y
        down, `x_px`, `y_px`, `rest_x_px`, `rest_y_px`, `dx_px`, `dy_px`, `radius_px` and `deviation_px`. Unknown
        values are null: the place of a marker that was not detected, the displacement of one that was not followed.
        """
        if self.rows is not None:
            return self.rows
        assert self.path is not None  # one of the two is given
        return read_written(self.path, pa.schema(_COLUMNS))


def track(
    source: Path | str | Dataset | Sequence[Capture] | Images,
    *,
    markers: str = "auto",
    on: str = "serial",
    out: Path | str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **source_options: Unpack[SourceOptions],
) -> Tracking:
    """Track the markers of every trial of a source.

    Parameters
    ----------
    source
        Data set, folder of images, video, bag, uint8 RGB frames (frames, height, width, 3), or captures of
        `open_source`.
    markers
        Kind of markers (docs/markers.md).
    source_options
        `reference`, `reference_frame`, `split`, `trial`, `format`, `options` and `sensor` of `open_source`. Without a
        reference, displacements count from the first frame.
    on
        Where the trials are tracked: `serial`, `processes`, `processes=4`, `ray`.
    out
        Parquet file to write; without a suffix a folder, a Parquet data set with a file a trial. It appears when
        complete, and an interrupted call continues after its last trial. If None, rows stay in memory.

    Raises
    ------
    InputError
        If the source is missing or an option does not fit, OpenCV is missing, or a trial has a single frame.
    ImageError
        If a reference frame shows fewer than 4 whole markers, or frames are of another size.
    RecordingError
        If the source cannot be read.
    PartError
        If some of many trials failed repeatedly, after all others are complete.

    See Also
    --------
    plot : Plot the displacement.
    view : Show markers over the frames.

    Examples
    --------
    >>> import sliplens as sl
    >>> table = sl.track("clip.avi", markers="gelsight-mini").frame()  # doctest: +SKIP
    >>> list(table.columns)[:4]  # doctest: +SKIP
    ['trial', 'frame', 'time_s', 'marker']
    """
    require_keywords(track, source_options)
    path = None if out is None else Path(out)
    if path is not None and path.suffix:
        require_new_table(path, suffix=".parquet", overwrite=overwrite)
    pick(KINDS, markers, noun="kind of markers")
    import_cv2()
    if (sensor := source_options.get("sensor")) is not None:
        source_options["sensor"] = load_profile(sensor)
    trials = open_trials(source, on=on, resumable=path is not None, **source_options)
    metadata = {"sliplens.markers": markers}
    schema = pa.schema(list(_COLUMNS.items()), metadata={"sliplens.version": __version__, **metadata})
    recipe = {**metadata, "source": trials.recipe}
    outcomes: list[TrialTracking] = []
    with reporting(on_progress):
        for note in dict.fromkeys(note for kind in trials.kinds for note in kind.notes):
            add_note(note)
        for trial in trials.kinds:
            if trial.read_reference is not None:
                continue
            if len(trial) == 1:
                raise InputError(
                    f"{trial.trial} has one frame and no reference to measure displacements from; name the untouched "
                    "sensor with --reference IMAGE"
                )
            add_note(f"{trial.trial}: no untouched frame was named, so displacements count from the first frame.")
        _, rows = run_table(
            _Following(trials=trials, markers=markers, schema=schema),
            # a marker is followed from the first frame on: a trial is not cut
            trials.parts(recipe, longest=None),
            path,
            title="Following markers",
            recipe=recipe,
            resumable=trials.travels,
            on=on,
            overwrite=overwrite,
            on_rows=lambda trial_rows: outcomes.append(_outcome(trial_rows)),
        )
    return Tracking(trials=tuple(outcomes), path=path, rows=rows)


@dataclass(frozen=True, kw_only=True)
class _Following(Work):
    """Tracking of whole trials: a Parquet file with a row for each marker of each frame."""

    trials: Trials
    markers: str
    schema: pa.Schema

    def begin(self) -> MakePart:
        read = self.trials.reader()

        def make(item: tuple[str, int, int], path: Path) -> None:
            capture, frames = read(*item)
            write_tables(regrouped(self._tables(capture, frames), rows=_ROW_GROUP), path, self.schema)

        return make

    def _tables(self, trial: Capture, frames: Iterator[tuple[int, Frame]]) -> Iterator[pa.Table]:
        tracker = Tracker((trial.read_reference or (lambda: next(trial.read_frames())))(), self.markers)
        for number, frame in frames:
            tracked = tracker.update(frame)
            time_s = None if trial.time_s is None else float(trial.time_s[number])
            count = len(tracked.status)
            places = tracked.position_px, tracked.rest_px, tracked.displacement_px
            numbers = np.column_stack([*places, tracked.radius_px, tracked.deviation_px]).astype(np.float32)
            columns: dict[str, pa.Array] = {
                "trial": pa.array([trial.trial] * count),
                "frame": pa.array(np.full(count, number, dtype=np.int32)),
                "time_s": pa.array([time_s] * count, pa.float64()),
                "marker": pa.array(np.arange(count, dtype=np.int32)),
                "status": pa.DictionaryArray.from_arrays(pa.array(tracked.status.astype(np.int8)), _STATUS),
                **{name: pa.array(numbers[:, at], from_pandas=True) for at, name in enumerate(_NUMBERS)},
            }
            yield pa.table(columns, schema=pa.schema(_COLUMNS))
            report_progress(number + 1, len(trial))


def _outcome(rows: pa.Table) -> TrialTracking:
    """Summarise a trial from its rows."""
    markers = int((rows["frame"].to_numpy() == 0).sum())
    status = rows["status"].combine_chunks().indices.to_numpy().reshape(-1, markers)
    followed, in_view = status == MarkerStatus.FOLLOWED, status != MarkerStatus.OUTSIDE
    return TrialTracking(
        trial=rows["trial"][0].as_py(),
        frames=len(status),
        markers=markers,
        followed_share=int(followed.sum()) / max(1, int(in_view.sum())),
        lost_frames=int((status == MarkerStatus.LOST).all(axis=1).sum()),
    )
