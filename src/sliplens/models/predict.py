"""Safety margins of any number of frames, from a source into a Parquet file, in the memory of one batch."""

from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32
from torch import Tensor

from sliplens.models import TrainedModel
from sliplens.models.checkpoint import Estimate
from sliplens.models.engines import Engine
from sliplens.models.sources import Frame, FrameSource, FrameTrial

LEVEL = 0.9
"""Of the intervals."""
_ROW_GROUP = 8192
_FIELDS = {
    "trial": pa.string(),
    "frame": pa.int64(),
    "file": pa.string(),
    "time_s": pa.float64(),
    "safety_margin": pa.float64(),
    "prediction": pa.float64(),
    "sigma": pa.float64(),
    "low_90": pa.float64(),
    "high_90": pa.float64(),
}


def write_predictions(
    engine: Engine,
    source: FrameSource,
    path: Path,
    *,
    metadata: Mapping[str, str],
    batch_size: int = 8,
    on_frames: Callable[[int, int], None] | None = None,
) -> None:
    """Predict all frames of a source into a Parquet file, a row a frame; whole or not at all.

    Columns are `trial`, `frame`, `file` (of a folder of images), `time_s`, `safety_margin` (where the source has
    labels), `prediction`, `sigma`, `low_90` and `high_90`. What is not known is null: the time of images without a
    rate, sigma of a network that answers with one number, intervals of one that was never calibrated. Predictions are
    not clipped to [0, 1].

    Parameters
    ----------
    engine
        The network, ready.
    source
        What to predict.
    path
        File to write; one that is there is replaced.
    metadata
        Kept in the file.
    batch_size
        Frames that are encoded and predicted together.
    on_frames
        Called with the frames done and the frames in all.

    Raises
    ------
    SliplensError
        If a frame cannot be read, is of another size than the network's sensor has, or the engine fails.
    """
    left_out = ({"file"} if not source.files else set()) | ({"safety_margin"} if not source.labelled else set())
    fields = [pa.field(name, kind) for name, kind in _FIELDS.items() if name not in left_out]
    schema = pa.schema(fields, metadata=dict(metadata))
    path.parent.mkdir(parents=True, exist_ok=True)
    part, done = path.with_name(path.name + ".part"), 0
    try:
        with pq.ParquetWriter(part, schema, compression="zstd") as writer:
            # plain numbers: small arrays kept between the large ones of each batch would leave holes in the memory
            waiting: dict[str, list] = {name: [] for name in schema.names}
            for rows in _all_rows(engine, source, batch_size):
                for name, values in waiting.items():
                    values.extend(rows[name].to_pylist())
                done += len(rows["frame"])
                if len(waiting["frame"]) >= _ROW_GROUP:
                    writer.write_table(pa.Table.from_pydict(waiting, schema))
                    waiting = {name: [] for name in schema.names}
                if on_frames is not None:
                    on_frames(done, source.frames)
            if waiting["frame"]:
                writer.write_table(pa.Table.from_pydict(waiting, schema))
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _all_rows(engine: Engine, source: FrameSource, batch_size: int) -> Iterator[dict[str, pa.Array]]:
    for trial in source.open_trials():
        first, frames = 0, trial.read_frames()
        while batch := list(islice(frames, batch_size)):
            yield _rows(engine(_encode(engine.trained, batch, trial.reference)), trial, first)
            first += len(batch)


def _encode(trained: TrainedModel, batch: list[Frame], reference: Frame | None) -> Float32[Tensor, "batch 3 size size"]:
    frames = np.stack(batch)
    if reference is not None:
        return trained.encode(frames, reference)
    trained.require_frame_size(frames.shape[1:3])
    encoding = trained.encoding
    return encoding.normalise(encoding.resize(frames, image_size=trained.manifest.image_size))


def _rows(estimate: Estimate, trial: FrameTrial, first: int) -> dict[str, pa.Array]:
    count = len(estimate.margin)
    here = slice(first, first + count)
    low, high = estimate.interval(LEVEL) or (None, None)
    return {
        "trial": pa.array([trial.name] * count),
        "frame": pa.array(np.arange(first, first + count)),
        "file": pa.array(trial.files[here]) if trial.files else pa.nulls(count, pa.string()),
        "time_s": _numbers(trial.time_s, here, count),
        "safety_margin": _numbers(trial.safety_margin, here, count),
        "prediction": pa.array(estimate.margin),
        **{
            name: _numbers(values, slice(None), count)
            for name, values in (("sigma", estimate.sigma), ("low_90", low), ("high_90", high))
        },
    }


def _numbers(values: np.ndarray | None, rows: slice, count: int) -> pa.Array:
    """As Arrow keeps them, NaN as null: nothing is known."""
    return pa.nulls(count, pa.float64()) if values is None else pa.array(values[rows], from_pandas=True)
