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
    batches = [batch for batch in entities[entity] if component in batch.schema.names]
    columns = [(batch.column(clock).to_numpy().astype(np.int64), batch.column(component)) for batch in batches]
    rows = [(at, value.as_py()) for times, values in columns for at, value in zip(times.tolist(), values, strict=True)]
    rows = sorted(((at, value) for at, value in rows if value is not None), key=lambda row: row[0])
    return [at for at, _ in rows], [value for _, value in rows]
