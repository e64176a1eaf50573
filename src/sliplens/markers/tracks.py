"""Markers followed through a trial."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, UInt8

from sliplens.errors import InputError


class MarkerStatus(IntEnum):
    """Knowledge of a marker in a frame; only what was followed has a displacement."""

    UNSEEN = 0
    """Not there yet: a marker that appears later."""
    FOLLOWED = 1
    """Seen, and the same as in the reference frame."""
    MISSING = 2
    """Should be in view but was not found."""
    BROKEN = 3
    """Seen, but its size or shape has changed, or it strays from its neighbours: its centre is not to be relied on."""
    OUTSIDE = 4
    """Cut by the edge of the frame, or beyond it."""
    LOST = 5
    """The pattern jumped so far that no marker can be told from the next."""
    NEW = 6
    """Seen, but not in the reference frame: it has a place and no displacement."""


SEEN = (MarkerStatus.FOLLOWED, MarkerStatus.BROKEN, MarkerStatus.NEW)
"""With a measured place."""


@dataclass(frozen=True, kw_only=True)
class TrackedFrame:
    """Markers of one frame, in the order of the reference frame, new ones after them."""

    position_px: Float[np.ndarray, "markers 2"]
    """x, y; NaN where a marker was not seen whole."""
    radius_px: Float[np.ndarray, " markers"]
    deviation_px: Float[np.ndarray, " markers"]
    """Distance of a marker's displacement from what its neighbours' tell; NaN where either is not known."""
    status: UInt8[np.ndarray, " markers"]
    """`MarkerStatus` of each."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Markers of a trial; pixel coordinates are (x, y), pixel centres at whole numbers."""

    rest_px: Float[np.ndarray, "markers 2"]
    """Places in the reference frame T_0; NaN for markers that it does not show."""
    rest_radius_px: Float[np.ndarray, " markers"]
    position_px: Float[np.ndarray, "frames markers 2"]
    """NaN where a marker was not seen whole."""
    radius_px: Float[np.ndarray, "frames markers"]
    deviation_px: Float[np.ndarray, "frames markers"]
    status: UInt8[np.ndarray, "frames markers"]

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.status)

    @property
    def followed(self) -> Bool[np.ndarray, "frames markers"]:
        """Markers that have a displacement, frame by frame."""
        return self.status == MarkerStatus.FOLLOWED

    @property
    def displacement_px(self) -> Float[np.ndarray, "frames markers 2"]:
        """T_n less T_0, x and y; NaN where a marker was not followed."""
        return np.where(self.followed[..., None], self.position_px - self.rest_px, np.nan)

    @property
    def from_reference(self) -> Bool[np.ndarray, " markers"]:
        """Markers that the reference frame shows."""
        return np.all(np.isfinite(self.rest_px), axis=1)


def stack_tracks(
    frames: list[TrackedFrame],
    *,
    rest_px: Float[np.ndarray, "markers 2"],
    rest_radius_px: Float[np.ndarray, " markers"],
) -> Tracks:
    """Join the frames of a trial; markers that came later are unseen before."""
    count = max(len(frame.status) for frame in frames)

    def padded(values: np.ndarray, fill: float | int) -> np.ndarray:
        missing = [(0, count - len(values)), *((0, 0) for _ in values.shape[1:])]
        return np.pad(values, missing, constant_values=fill)

    return Tracks(
        rest_px=padded(rest_px, np.nan),
        rest_radius_px=padded(rest_radius_px, np.nan),
        position_px=np.stack([padded(frame.position_px, np.nan) for frame in frames]),
        radius_px=np.stack([padded(frame.radius_px, np.nan) for frame in frames]),
        deviation_px=np.stack([padded(frame.deviation_px, np.nan) for frame in frames]),
        status=np.stack([padded(frame.status, int(MarkerStatus.UNSEEN)) for frame in frames]),
    )


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
