"""Files beside `result.json`: tables, maps and pictures, each checked as it is read."""

import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, UInt8

from sliplens.arrays import require_saliency
from sliplens.errors import ImageError, InputError, SaliencyError
from sliplens.images import read_image
from sliplens.results.explanation import ExplainedFrame
from sliplens.results.faithfulness import DeletionCurve


def read_deletion(path: Path, *, command: str) -> dict[str, DeletionCurve]:
    """Read the deletion curves of each method.

    Several rows of one frame, method and step (repeated random orders) are averaged.

    Raises
    ------
    InputError
        If the file is missing or damaged, lacks a column, or a frame lacks steps that others have.
    """
    table = read_table(path, ("frame_id", "method", "step", "pixels_removed", "prediction", "score"), command=command)
    method = np.array(table["method"].to_pylist(), dtype=str)
    frame = np.array(table["frame_id"].to_pylist(), dtype=str)
    step = table["step"].to_numpy().astype(np.int64)
    removed = table["pixels_removed"].to_numpy().astype(np.int64)
    score = table["score"].to_numpy().astype(np.float64)
    prediction = table["prediction"].to_numpy().astype(np.float64)
    curves = {}
    for name in dict.fromkeys(method.tolist()):
        rows = method == name
        ids, frame_at = np.unique(frame[rows], return_inverse=True)
        steps, step_at = np.unique(step[rows], return_inverse=True)
        total, answers, count = np.zeros((3, len(ids), len(steps)))
        np.add.at(total, (frame_at, step_at), score[rows])
        np.add.at(answers, (frame_at, step_at), prediction[rows])
        np.add.at(count, (frame_at, step_at), 1)
        if not count.all():
            raise InputError(f"{path} lacks steps of some frames under {name!r}; make it again with `{command}`")
        pixels = np.zeros(len(steps), dtype=np.int64)
        pixels[step_at] = removed[rows]
        curves[name] = DeletionCurve(
            frame_ids=tuple(ids.tolist()), pixels_removed=pixels, scores=total / count, predictions=answers / count
        )
    return curves


def read_saliency(
    path: Path, methods: tuple[str, ...], shape: tuple[int, int, int], *, command: str
) -> dict[str, Float[np.ndarray, "frames height width"]]:
    """Saliency in [0, 1] of each method, checked to have the shape of the pictures.

    Raises
    ------
    InputError
        If the file is missing or damaged, or a map is missing, of another size or not finite.
    """
    cure = f"make the folder again with `{command}`"
    try:
        with np.load(path, allow_pickle=False) as archive:
            absent = [name for name in methods if f"{name}.saliency" not in archive]
            if absent:
                raise InputError(f"{path} holds no saliency of {', '.join(absent)}; {cure}")
            maps = {name: archive[f"{name}.saliency"].astype(np.float32) for name in methods}
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; {cure}") from None
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} cannot be read as maps ({error}); {cure}") from None
    for name, saliency in maps.items():
        if saliency.ndim != 3 or len(saliency) != shape[0]:
            raise InputError(f"{path} holds {saliency.shape} as {name!r} where {shape} belongs; {cure}")
        try:
            for index, one in enumerate(saliency):
                require_saliency(one, shape[1:], where=f"{path}: map {index} of {name!r}")
        except SaliencyError as error:
            raise InputError(str(error)) from None
    return {name: np.clip(saliency, 0, 1) for name, saliency in maps.items()}


def read_pictures(
    folder: Path, frames: tuple[ExplainedFrame, ...], *, size: int, command: str
) -> UInt8[np.ndarray, "frames height width 3"]:
    """Pictures of the explained frames, as the network saw them.

    Raises
    ------
    InputError
        If a frame's id is no plain file name, or its picture is missing or of another size.
    """
    pictures = []
    for frame in frames:
        if Path(frame.id).name != frame.id:
            raise InputError(f"{frame.id!r} in {folder.parent} is no file name; make the folder again with `{command}`")
        try:
            pictures.append(read_image(folder / f"{frame.id}.png", size=(size, size)))
        except ImageError as error:
            raise InputError(str(error)) from None
    return np.stack(pictures)


def read_table(path: Path, columns: tuple[str, ...], *, command: str, may_be_empty: bool = False) -> pa.Table:
    """Read a Parquet file that has these columns, without empty cells, and at least one row unless it may be empty.

    Raises
    ------
    InputError
        If it is missing or damaged, lacks a column, or has an empty cell or no row.
    """
    cure = f"make the folder again with `{command}`"
    try:
        table = pq.ParquetFile(path).read()
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; {cure}") from None
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path} cannot be read as Parquet ({str(error).splitlines()[0]}); {cure}") from None
    absent = [name for name in columns if name not in table.column_names]
    if absent:
        raise InputError(f"{path} lacks the column {', '.join(absent)}; {cure}")
    if any(table[name].null_count for name in columns):
        raise InputError(f"{path} has empty cells; {cure}")
    if table.num_rows == 0 and not may_be_empty:
        raise InputError(f"{path} has no row; {cure}")
    return table
