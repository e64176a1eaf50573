"""Files of Rerun, read back with its own reader."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest


def read_rrd(path: Path) -> dict[str, list[pa.RecordBatch]]:
    """Chunks of the one recording of a file, by entity."""
    reader, found = pytest.importorskip("rerun.chunk").RrdReader(path), {}
    assert [entry.application_id for entry in reader.recordings()] == ["sliplens"]
    for chunk in reader.stream():
        found.setdefault(chunk.entity_path.removeprefix("/"), []).append(chunk.to_record_batch())
    return found


def shown(
    entities: dict[str, list[pa.RecordBatch]], entity: str, component: str, clock: str = "frame"
) -> tuple[list[int], list[Any]]:
    """Frames (or nanoseconds of the clock `time`) with a value of a component, in their order, and these values."""
    rows = []
    for batch in entities[entity]:
        if component in batch.schema.names:
            times = batch.column(clock).to_numpy(zero_copy_only=False).astype(np.int64).tolist()
            rows += zip(times, batch.column(component).to_pylist(), strict=True)
    rows = sorted((row for row in rows if row[1] is not None), key=lambda row: row[0])
    return [at for at, _ in rows], [value for _, value in rows]
