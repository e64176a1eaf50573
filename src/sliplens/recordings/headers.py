"""What a stored trial says of itself, read without its frames."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from jaxtyping import UInt8

from sliplens.errors import RecordingError
from sliplens.images.files import decode_png
from sliplens.recordings.parquet import reading

DESCRIPTION = ("trial", "sensor", "day", "condition")
"""What every trial tells in its metadata."""
OBJECT = "object"
"""And what it may tell."""


@dataclass(frozen=True, kw_only=True)
class StoredTrial:
    """What a trial's file says without its frames being read."""

    trial: str
    sensor: str
    day: int
    condition: str
    object: str
    frames: int
    height: int
    width: int
    recipe: str | None
    """Hash of the recipe of a simulated trial."""


def read_header(path: Path) -> StoredTrial:
    """Read what a trial is, without its frames.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or no trial.
    ImageError
        If its reference frame is damaged.
    """
    metadata = _read_metadata(path)
    missing = {"reference", *DESCRIPTION} - set(metadata)
    if missing:
        raise RecordingError(f"{path} lacks {', '.join(sorted(missing))}; write it with save_recording")
    height, width, _ = decode_png(metadata["reference"], where=f"the reference frame of {path}").shape
    return StoredTrial(
        trial=metadata["trial"].decode(),
        sensor=metadata["sensor"].decode(),
        day=int(metadata["day"]),
        condition=metadata["condition"].decode(),
        object=metadata.get(OBJECT, b"").decode(),
        frames=int(metadata["frames"]),
        height=height,
        width=width,
        recipe=json.loads(metadata["truth"])["recipe"] if "truth" in metadata else None,
    )


def read_reference(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read the reference frame of a trial.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or no trial.
    ImageError
        If the image is damaged.
    """
    metadata = _read_metadata(path)
    if "reference" not in metadata:
        raise RecordingError(f"{path} lacks a reference frame; write it with save_recording")
    return decode_png(metadata["reference"], where=f"the reference frame of {path}")


def read_labelling(path: Path) -> dict[str, Any] | None:
    """What the labels of an imported trial rest on, as `import_trial` found it; None where nothing is kept.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or what it tells of its labels is.
    """
    metadata = _read_metadata(path)
    if "labelling" not in metadata:
        return None
    try:
        labelling = json.loads(metadata["labelling"])
    except ValueError:
        labelling = None
    require_labelling(labelling, where=str(path))
    return labelling


def require_labelling(labelling: object, *, where: str) -> None:
    """Check that what is told of labels has the parts that pages and tables show.

    Raises
    ------
    RecordingError
        If a part is missing or of another kind.
    """

    def fits(value: object, parts: dict[str, Any]) -> bool:
        return isinstance(value, dict) and all(name in value and kind(value[name]) for name, kind in parts.items())

    def number(value: object) -> bool:
        return value is None or (isinstance(value, int | float) and not isinstance(value, bool))

    def words(value: object) -> bool:
        return isinstance(value, list) and all(isinstance(one, str) for one in value)

    def counts(value: object) -> bool:
        return isinstance(value, dict) and all(isinstance(one, int) and one >= 0 for one in value.values())

    def maybe(**parts: Any) -> Any:
        return lambda value: value is None or fits(value, parts)

    def text(value: object) -> bool:
        return value is None or isinstance(value, str)

    def three(value: object) -> bool:
        return isinstance(value, list) and len(value) == 3 and all(map(number, value))

    seen = {f"{name}_found": text for name in ("normal", "sign", "tare")}
    axes = maybe(
        notes=words,
        normal=text,
        sign=number,
        still_until_s=number,
        tare_n=three,
        tare_sigma_n=three,
        noise_n=three,
        **seen,
    )
    parts = {
        "source": text,
        "forces": text,
        "frames_by_reason": counts,
        "notes": words,
        "axes": axes,
        "friction": maybe(mu=number, low=number, high=number, found=text, method=text, image_sigmas=number),
        "lag": maybe(lag_s=number, sigma_s=number, doubt=text, correlation=number),
        "lag_applied": lambda value: isinstance(value, bool),
        "reference": lambda value: fits(
            value, {"index": number, "method": text, "contact_energy": number, "drift": number}
        ),
        **dict.fromkeys(("slip_s", "contact_threshold_n", "window_s", "gap_s", "force_range_n"), number),
    }
    if not fits(labelling, parts):
        wrong = [
            name for name, kind in parts.items() if not (isinstance(labelling, dict) and fits(labelling, {name: kind}))
        ]
        raise RecordingError(
            f"{where} tells nothing usable of how its labels were made ({', '.join(wrong[:3])}); import the trial again"
        )


def _read_metadata(path: Path) -> dict[str, bytes]:
    with reading(path):
        file = pq.read_metadata(path)
    metadata = {key.decode(): value for key, value in (file.metadata or {}).items()}
    return {**metadata, "frames": str(file.num_rows).encode()}
