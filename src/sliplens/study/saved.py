"""Explanations on disk: maps without loss, the very inputs they explain, and a table of the frames."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from sliplens.arrays import require_saliency
from sliplens.errors import InputError
from sliplens.images.files import write_png
from sliplens.provenance import RUN_FILE, read_json, require_folder, write_json

RESULT_FILE = "result.json"
MAPS_FILE = "maps.npz"
INPUTS_FILE = "inputs.npz"
_SALIENCY = ".saliency"


@dataclass(frozen=True, kw_only=True)
class ExplainedFrame:
    """One explained frame; `safety_margin` is None where there is no label."""

    id: str
    trial: str
    condition: str
    safety_margin: float | None
    prediction: float
    reference_prediction: float


@dataclass(frozen=True, kw_only=True)
class Explained:
    """A folder of explanations, loaded.

    Attributes
    ----------
    images
        The network's inputs before normalisation, 8 bits.
    relevance, saliency
        By method: signed maps in margin units, and the same in [0, 1] for viewing and for ranking pixels.
    weights_sha256
        Hash of the network that was explained.
    """

    input: str
    source: str
    frames: tuple[ExplainedFrame, ...]
    images: UInt8[Tensor, "frames 3 size size"]
    relevance: Mapping[str, Float32[np.ndarray, "frames size size"]]
    saliency: Mapping[str, Float32[np.ndarray, "frames size size"]]
    weights_sha256: str


def save_explained(
    explained: Explained, folder: Path, *, pictures: UInt8[Tensor, "frames 3 size size"], methods: Mapping[str, Any]
) -> None:
    """Write maps, inputs, a picture of each input, and the table.

    Parameters
    ----------
    explained
        What was found.
    folder
        Must exist.
    pictures
        The normalised inputs, 8 bits, for people to look at.
    methods
        What the report says of each method: seconds a frame and warnings.
    """
    maps = dict(explained.relevance) | {name + _SALIENCY: value for name, value in explained.saliency.items()}
    np.savez_compressed(folder / MAPS_FILE, allow_pickle=False, **maps)
    np.savez_compressed(folder / INPUTS_FILE, allow_pickle=False, images=explained.images.numpy())
    (folder / "frames").mkdir(exist_ok=True)
    for frame, picture in zip(explained.frames, pictures, strict=True):
        write_png(folder / "frames" / f"{frame.id}.png", picture.permute(1, 2, 0).contiguous().numpy())
    write_json(
        folder / RESULT_FILE,
        {
            "input": explained.input,
            "source": explained.source,
            "image_size": explained.images.shape[-1],
            "frames": list(explained.frames),
            "methods": methods,
        },
    )


def load_explained(folder: Path) -> Explained:
    """Read a folder that `sliplens explain` wrote.

    Raises
    ------
    InputError
        If the folder or one of its files is missing or damaged.
    SaliencyError
        If a map has another shape than its frame, or is not finite.
    """
    require_folder(folder, what="the explanations")
    result = read_json(folder / RESULT_FILE)
    run = read_json(folder / RUN_FILE)
    if not isinstance(result, dict) or run.get("stage") != "explain":
        raise InputError(f"{folder} holds no explanations; make them with sliplens explain")
    images = read_arrays(folder / INPUTS_FILE)["images"]
    maps = read_arrays(folder / MAPS_FILE)
    names = [frame["id"] for frame in result["frames"]]
    for method, stack in maps.items():
        if len(stack) != len(names):
            raise InputError(
                f"{folder / MAPS_FILE} has {len(stack)} {method} maps for {len(names)} frames; explain again"
            )
        for name, one in zip(names, stack, strict=True):
            require_saliency(one, images.shape[-2:], where=f"the {method} map of {name} in {folder / MAPS_FILE}")
    return Explained(
        input=result["input"],
        source=result["source"],
        frames=tuple(ExplainedFrame(**frame) for frame in result["frames"]),
        images=torch.from_numpy(images),
        relevance={name: value for name, value in maps.items() if not name.endswith(_SALIENCY)},
        saliency={name.removesuffix(_SALIENCY): value for name, value in maps.items() if name.endswith(_SALIENCY)},
        weights_sha256=run["config"]["weights_sha256"],
    )


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read arrays of one file by name.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise InputError(f"{path} is missing; explain the frames again") from None
    except (zipfile.BadZipFile, OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} is damaged ({error}); explain the frames again") from None


def mean_of_known(values: Float[np.ndarray, " values"]) -> float | None:
    """Mean of what is defined; None where nothing is, since JSON knows no NaN."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
