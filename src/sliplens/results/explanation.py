"""Saved explanations: frames, what was answered on them, and a map of each by every method; a trial at a glance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Float64, Shaped, UInt8

from sliplens.codec import UNKNOWN, Columns, load_record, load_result
from sliplens.errors import InputError, SaliencyError
from sliplens.files import RUN_FILE, Provenance, require_folder
from sliplens.results.evaluation import ANSWER, MARGIN, SHARE, TIME, OfNetwork


@dataclass(frozen=True, kw_only=True)
class ExplainedFrame:
    """Frame that was explained: label (None if unknown), answer, and the answer on its reference, in margin units."""

    id: str
    trial: str
    condition: str
    safety_margin: Annotated[float, MARGIN] | None
    prediction: Annotated[float, ANSWER]
    reference_prediction: Annotated[float, ANSWER]
    day: int = 1
    withheld: str | None = None
    """Reason for which the prediction is not to be believed as a margin; None where it is."""


@dataclass(frozen=True, kw_only=True)
class MethodNotes:
    """Cost of a method in seconds a frame, and what it complained about."""

    seconds_per_frame: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Explanation(OfNetwork):
    """Explanations of some frames by several methods."""

    weights_sha256: str
    """Hash of the network that was explained."""
    frames: tuple[ExplainedFrame, ...]
    methods: dict[str, MethodNotes]
    images: UInt8[np.ndarray, "frames colours size size"]
    """Inputs of the network before normalisation, 8 bits."""
    pictures: UInt8[np.ndarray, "frames size size 3"]
    """The normalised inputs, 8 bits, for people to look at."""
    relevance: dict[str, Annotated[Float32[np.ndarray, "frames size size"], ANSWER]]
    saliency: dict[str, Annotated[Float32[np.ndarray, "frames size size"], SHARE]]
    """By method: signed maps in margin units, and the same in [0, 1] for viewing and for ranking pixels."""

    def __post_init__(self) -> None:
        """Hold the arrays against the frames that they are of."""
        if not self.frames:
            raise ValueError("names no frame")
        if len(self.images) != len(self.frames):
            raise ValueError(f"holds {len(self.images)} images of {len(self.frames)} frames")
        for kind, maps in (("relevance", self.relevance), ("saliency", self.saliency)):
            absent = [name for name in self.methods if name not in maps]
            if absent:
                raise ValueError(f"holds no {kind} of {', '.join(absent)}")

    @property
    def image_size(self) -> int:
        """Side of the images, in pixels."""
        return self.images.shape[-1]

    @property
    def towards(self) -> Float64[np.ndarray, " frames"]:
        """Sign of each answer's change from that on the untouched sensor, which the maps explain."""
        return np.array([np.sign(frame.prediction - frame.reference_prediction) for frame in self.frames])

    @property
    def clusters(self) -> Shaped[np.ndarray, "2 frames"]:
        """Day and trial of each frame, which an interval resamples."""
        return np.array([[str(frame.day) for frame in self.frames], [frame.trial for frame in self.frames]])

    @property
    def trials(self) -> dict[str, list[int]]:
        """Numbers of the frames of each trial."""
        rows: dict[str, list[int]] = {}
        for row, frame in enumerate(self.frames):
            rows.setdefault(frame.trial, []).append(row)
        return rows

    def take(self, rows: Sequence[int]) -> "Explanation":
        """Explanations of some of the frames, by their numbers."""
        chosen = list(rows)
        return replace(
            self,
            frames=tuple(self.frames[row] for row in chosen),
            images=self.images[chosen],
            pictures=self.pictures[chosen],
            relevance={name: maps[chosen] for name, maps in self.relevance.items()},
            saliency={name: maps[chosen] for name, maps in self.saliency.items()},
        )


def require_saliency(
    saliency: Float[np.ndarray, "height width"], shape: Sequence[int], *, where: str = "the saliency map"
) -> Float[np.ndarray, "height width"]:
    """Return the map unchanged when it is finite and has the image's height and width, its shape in pixels.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.results.explanation import require_saliency
    >>> require_saliency(np.array([[0.0, np.nan]]), (1, 2))
    Traceback (most recent call last):
        ...
    sliplens.errors.SaliencyError: the saliency map holds NaN or infinity in 1 of 2 pixels; explain the frame again, ...
    """
    height, width = shape
    if saliency.shape != (height, width):
        raise SaliencyError(
            f"{where} has shape {tuple(saliency.shape)} but its image is {height} x {width} pixels; "
            "explain the same frames that are scored"
        )
    bad = int(np.size(saliency) - np.count_nonzero(np.isfinite(saliency)))
    if bad:
        raise SaliencyError(
            f"{where} holds NaN or infinity in {bad} of {saliency.size} pixels; "
            "explain the frame again, or drop it from the set"
        )
    return saliency


def is_explanation(folder: Path) -> bool:
    """Whether a folder is one that `sliplens explain` wrote."""
    path = folder / RUN_FILE
    return path.is_file() and load_record(path, Provenance, command="sliplens explain").stage == "explain"


def load_explanation(folder: Path) -> Explanation:
    """Read a folder that `sliplens explain` wrote.

    Raises
    ------
    InputError
        If the folder or one of its files is missing or damaged, or holds something else, such as a map that is not
        finite.
    """
    require_folder(folder, what="the explanations")
    if not is_explanation(folder):
        raise InputError(f"{folder} holds no explanations; make them with sliplens explain")
    return load_result(folder, Explanation, command="sliplens explain")


@dataclass(frozen=True, kw_only=True)
class StripReadings(Columns):
    """True and read safety margin of every frame of a trial; NaN where the sensor touches nothing."""

    time_s: Annotated[Float64[np.ndarray, " frames"], TIME]
    contact_state: np.ndarray
    safety_margin: Annotated[Float64[np.ndarray, " frames"], MARGIN, UNKNOWN]
    """Margin of the label."""
    prediction: Annotated[Float64[np.ndarray, " frames"], ANSWER, UNKNOWN]
    """Margin that the network reads."""
    low: Annotated[Float64[np.ndarray, " frames"], MARGIN, UNKNOWN]
    """Lower end of its 90 % interval; NaN for a network that was never calibrated."""
    high: Annotated[Float64[np.ndarray, " frames"], MARGIN, UNKNOWN]
    """Upper end of its 90 % interval."""
    withheld: Shaped[np.ndarray, " frames"]
    """Reason for which the margin is not to be believed, with the cure; empty where it is. Margin and interval of such
    a frame are NaN."""


@dataclass(frozen=True, kw_only=True)
class Strip:
    """One trial from stick to slip: true margin, read margin, and the map of a few frames."""

    trial: str
    condition: str
    source: str
    input: str
    method: str
    readings: StripReadings
    shown: tuple[int, ...]
    """Numbers of the frames that have pictures and maps."""
    pictures: UInt8[np.ndarray, "shown height width 3"]
    relevance: Annotated[Float32[np.ndarray, "shown rows columns"], ANSWER]
    """Signed contribution of each pixel to f(x) - f(untouched sensor), in margin units."""
