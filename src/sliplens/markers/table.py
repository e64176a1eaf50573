"""Tracks on disk: a Parquet file with a row for each marker of each frame."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from sliplens.errors import InputError
from sliplens.markers.tracks import MarkerStatus, TrackedFrame

_ROW_GROUP = 50_000
_NUMBERS = ("x_px", "y_px", "rest_x_px", "rest_y_px", "dx_px", "dy_px", "radius_px", "deviation_px")
_STATUS = [status.name.lower() for status in MarkerStatus]
TRACK_COLUMNS = {
    "trial": pa.string(),
    "frame": pa.int32(),
    "time_s": pa.float64(),
    "marker": pa.int32(),
    "status": pa.dictionary(pa.int8(), pa.string()),
    **dict.fromkeys(_NUMBERS, pa.float32()),
}
"""Columns and types. Places are in pixels, x to the right and y down; what is not known is null: the place of a marker
that was not seen, the displacement (dx, dy) of one that was not followed, the place at rest of a new one."""


class TrackWriter:
    """Writes the markers of frame after frame; made by `track_writer`."""

    def __init__(self, writer: pq.ParquetWriter) -> None:
        self._writer = writer
        self._waiting: list[pa.Table] = []
        self._rows = 0

    def add(
        self,
        trial: str,
        frame: int,
        tracked: TrackedFrame,
        *,
        rest_px: Float[np.ndarray, "markers 2"],
        time_s: float | None,
    ) -> None:
        """Add the markers of one frame.

        Parameters
        ----------
        trial, frame
            Name of the trial, number of the frame in it.
        tracked
            What the tracker gave.
        rest_px
            Where the markers of the reference frame were; new markers have no place at rest.
        time_s
            When the frame was taken; None if not known.
        """
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
        self._waiting.append(pa.table(columns, schema=pa.schema(TRACK_COLUMNS)))
        self._rows += count
        if self._rows >= _ROW_GROUP:
            self.flush()

    def flush(self) -> None:
        """Write what waits as a row group."""
        if self._waiting:
            self._writer.write_table(
                pa.concat_tables(self._waiting).replace_schema_metadata(self._writer.schema.metadata)
            )
            self._waiting, self._rows = [], 0


@contextmanager
def track_writer(path: Path, *, metadata: Mapping[str, str]) -> Iterator[TrackWriter]:
    """Write a Parquet file of tracks; it appears when complete, and not at all when something fails.

    Parameters
    ----------
    path
        File to write; one that is there is replaced.
    metadata
        Kept in the file.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    schema = pa.schema(list(TRACK_COLUMNS.items()), metadata=dict(metadata))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(part, schema, compression="zstd") as writer:
            tracks = TrackWriter(writer)
            yield tracks
            tracks.flush()
        part.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror or error}); choose another file") from None
    finally:
        with suppress(OSError):  # it has its name by now, or could not be made
            part.unlink()
