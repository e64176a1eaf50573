"""Explanations of frames by one or several methods, and a strip of one trial."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
from jaxtyping import Float, Float32, Float64, Shaped, UInt8

from sliplens.codec import UNKNOWN, Columns, Result, load_record, load_result
from sliplens.errors import InputError, SaliencyError
from sliplens.files import RUN_FILE, Provenance, require_folder
from sliplens.images import write_png
from sliplens.progress import number_of
from sliplens.results.evaluation import AMOUNT, ANSWER, MARGIN, TIME, OfOutput

MARGIN_LEVELS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
"""Safety margins at which the thesis explains frames (section 4)."""
BaselineName: TypeAlias = Literal["untouched", "stick", "given", "black", "mean", "blurred"]
"""Kind of a baseline."""
BASELINES: dict[BaselineName, str] = {
    "untouched": "the untouched sensor",
    "stick": "the last frame before the pull",
    "given": "the given frame",
    "black": "a black image",
    "mean": "an image of the mean colour of the frames",
    "blurred": "the blurred image",
}
"""Baselines in words."""
FrameU8: TypeAlias = UInt8[np.ndarray, "height width 3"]
"""A picture, RGB."""
DIM = 0.55  # of the picture's lightness: leaves the bright end of the colours to the relevance
_LOWERS, _RAISES = np.array([[0xE6, 0x9F, 0x00], [0x56, 0xB4, 0xE9]]) / 255  # orange and sky blue of `plots.style`
CLOSE = 0.02
"""Change of the prediction in margin units below which there is nothing to explain: a regressor's error is larger."""


@dataclass(frozen=True, kw_only=True)
class ExplainedFrame:
    """An explained frame: label (None if unknown), prediction, and prediction of its baseline, in margin units."""

    id: str
    trial: str
    condition: str
    safety_margin: Annotated[float, MARGIN] | None
    prediction: Annotated[float, ANSWER]
    reference_prediction: Annotated[float, ANSWER]
    day: int = 1
    withheld: str | None = None
    """Reason not to trust the prediction as a margin; None if it can be trusted."""
    baseline_frame: int | None = None
    """Number of the stick frame in its trial; None where the baseline is no frame of the trial."""


@dataclass(frozen=True, kw_only=True)
class MethodNotes:
    """Cost, meaning and warnings of one method's maps."""

    seconds_per_frame: float
    warnings: tuple[str, ...]
    target: str = "f(x) - f(reference)"
    """Quantity that the relevance adds up to, in words."""
    raises_only: bool = False
    """True if the maps only hold what raises the prediction, such as published maps with a ReLU."""
    completeness_gap: tuple[float, ...] | None = None
    """|sum of the relevance - (f(x) - f(reference))| of each frame; None where the sum is not promised."""


@dataclass(frozen=True, kw_only=True)
class Explanation(OfOutput):
    """Explanations of some frames by one or several methods: why the network predicts f(x) rather than f(baseline)."""

    weights_sha256: str
    """Hash of the network that was explained."""
    frames: tuple[ExplainedFrame, ...]
    methods: dict[str, MethodNotes]
    images: UInt8[np.ndarray, "frames colours size size"]
    """Network inputs before normalisation, 8 bits."""
    references: UInt8[np.ndarray, "frames colours size size"]
    """Network inputs of the baseline, which each frame is compared with; as `images`."""
    pictures: UInt8[np.ndarray, "frames size size 3"]
    """Normalised inputs, 8 bits, for viewing."""
    relevance: dict[str, Annotated[Float32[np.ndarray, "frames size size"], ANSWER]]
    """Maps by method: signed contribution of each pixel in margin units, above zero where it raises the prediction."""
    baseline: BaselineName = "untouched"
    """Kind of the baseline; trials whose stick frame was not found are compared with the untouched sensor."""

    def influence(self, method: str) -> Float64[np.ndarray, "frames size size"]:
        """Return the relevance along the change of the prediction, which ranks pixels.

        Maps that hold only what raises the prediction are ranked as they were published, whichever way it went.
        """
        relevance = self.relevance[method].astype(np.float64)
        return relevance if self.methods[method].raises_only else relevance * self.towards[:, None, None]

    @cached_property
    def saliency(self) -> dict[str, Float32[np.ndarray, "frames size size"]]:
        """Supporting evidence in [0, 1] by method, for viewing: 1 at the strongest pixel of each frame."""
        maps = {}
        for method in self.relevance:
            supporting = np.maximum(self.influence(method).astype(np.float32), 0)
            peak = supporting.max(axis=(1, 2), keepdims=True)
            maps[method] = supporting / np.where(peak > 0, peak, np.float32(1))
        return maps

    @property
    def summary(self) -> str:
        """Content in a sentence."""
        change = max((frame.prediction - frame.reference_prediction for frame in self.frames), key=abs)
        frames = f"{number_of(len(self.frames), 'frame')} of {number_of(len(self.trials), 'trial')}"
        return (
            f"maps of {', '.join(self.methods) or 'no method'} for {frames}; the prediction changes "
            f"by up to {change:+.3g} {self.unit_words} from that of {BASELINES[self.baseline]}"
        )

    def baseline_words(self, row: int) -> str:
        """Return the baseline of a frame in words."""
        lacks_stick = self.baseline == "stick" and self.frames[row].baseline_frame is None
        return BASELINES["untouched" if lacks_stick else self.baseline]

    @property
    def scale(self) -> float:
        """Difference of predictions that counts as all: 1 for margins, the largest explained change for other units."""
        largest = max(abs(frame.prediction - frame.reference_prediction) for frame in self.frames)
        return 1.0 if self.unit == "margin" or largest == 0 else largest

    @property
    def method(self) -> str:
        """Name of the first method."""
        return next(iter(self.methods))

    @property
    def image_size(self) -> int:
        """Side of the images, in pixels."""
        return self.images.shape[-1]

    @property
    def towards(self) -> Float64[np.ndarray, " frames"]:
        """Sign of f(x) - f(reference) of each frame."""
        return np.array([np.sign(frame.prediction - frame.reference_prediction) for frame in self.frames])

    @property
    def clusters(self) -> Shaped[np.ndarray, "2 frames"]:
        """Day and trial of each frame, the units that an interval resamples."""
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
            references=self.references[chosen],
            pictures=self.pictures[chosen],
            methods={
                name: replace(
                    notes, completeness_gap=(gap := notes.completeness_gap) and tuple(gap[row] for row in chosen)
                )
                for name, notes in self.methods.items()
            },
            relevance={name: maps[chosen] for name, maps in self.relevance.items()},
        )


def full_colour(relevance: Float[np.ndarray, "*any"]) -> float:
    """Size of signed values that gets the full colour, in the unit of the values; 1 where all are zero."""
    sizes = np.abs(relevance)
    # a few outlying pixels would leave the rest of the map black
    return float(np.percentile(sizes, 99.5)) or float(sizes.max()) or 1.0


def overlay_relevance(picture: FrameU8, share: Float[np.ndarray, "rows columns"]) -> FrameU8:
    """Picture in dimmed grey under a signed map in [-1, 1]: orange lowers, blue raises, the stronger the less grey.

    A map of another height and width than the picture's is repeated.
    """
    places = [np.arange(side) * count // side for side, count in zip(picture.shape, share.shape, strict=False)]
    value = np.clip(share[np.ix_(*places)].astype(np.float64), -1, 1)[..., None]
    colour = np.where(value < 0, _LOWERS, _RAISES)
    lightness = picture @ np.array([0.299, 0.587, 0.114]) / 255  # luma by ITU-R BT.601
    mixed = (1 - np.abs(value)) * DIM * lightness[..., None] + np.abs(value) * colour
    return np.round(255 * mixed).astype(np.uint8)


_LEAST = 0.2
"""Least full colour, in points of margin per 1 % of the image: 2 points, which is nothing to explain, on a tenth."""


def full_points(relevance: Float[np.ndarray, "frames height width"], *, scale: float = 1.0) -> float:
    """Return the relevance that gets the full colour in all frames, in points of margin per 1 % of the image."""
    return max(full_colour(relevance * relevance[0].size), _LEAST * scale)


def overlay_points(
    pictures: Iterable[FrameU8], relevance: Float[np.ndarray, "frames height width"], *, scale: float = 1.0
) -> list[FrameU8]:
    """Overlay pictures with signed maps on one scale, in points of margin (`full_points`)."""
    limit = full_points(relevance, scale=scale)
    return [
        overlay_relevance(picture, values * values.size / limit)
        for picture, values in zip(pictures, relevance, strict=True)
    ]


def write_overlays(
    folder: Path,
    names: Sequence[str],
    pictures: Iterable[FrameU8],
    relevance: Float[np.ndarray, "frames height width"],
    *,
    scale: float,
) -> list[FrameU8]:
    """Write an overlay of every map (`overlay_points`, in points of margin) into a folder, each whole or not at all."""
    overlays, part = overlay_points(pictures, relevance, scale=scale), folder / f".{os.getpid()}"
    folder.mkdir(parents=True, exist_ok=True)
    for name, overlay in zip(names, overlays, strict=True):
        write_png(part, overlay)
        part.replace(folder / f"{name}.png")
    return overlays


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


def load_explanation(folder: Path) -> Explanation:
    """Read a folder that `sliplens explain` wrote.

    Raises
    ------
    InputError
        If the folder or one of its files is missing or damaged, or holds something else, such as a map that is not
        finite.
    """
    require_folder(folder, what="the explanations")
    path = folder / RUN_FILE
    if not (path.is_file() and load_record(path, Provenance, command="sliplens explain").stage == "explain"):
        raise InputError(f"{folder} holds no explanations; make them with sliplens explain")
    return load_result(folder, Explanation, command="sliplens explain")


@dataclass(frozen=True, kw_only=True)
class StripReadings(Columns):
    """True and predicted safety margin of every frame of a trial; NaN where the sensor touches nothing."""

    time_s: Annotated[Float64[np.ndarray, " frames"], TIME]
    contact_state: Shaped[np.ndarray, " frames"]
    safety_margin: Annotated[Float64[np.ndarray, " frames"], MARGIN, UNKNOWN]
    """Margin of the label."""
    prediction: Annotated[Float64[np.ndarray, " frames"], ANSWER, UNKNOWN]
    """Predicted margin."""
    low_90: Annotated[Float64[np.ndarray, " frames"], MARGIN, UNKNOWN]
    high_90: Annotated[Float64[np.ndarray, " frames"], MARGIN, UNKNOWN]
    """Ends of its 90 % interval; NaN for a network that was never calibrated."""
    withheld: Shaped[np.ndarray, " frames"]
    """Reason not to trust the predicted margin, with the cure; empty if it can be trusted. Otherwise margin and
    interval are NaN."""


@dataclass(frozen=True, kw_only=True)
class MovedMarkers:
    """Proof of a map: the frame drawn again with the markers that it ranks first moved back to the stick frame.

    Changes are predictions of the frame less those of the frame drawn again, in margin units.
    """

    frame: Annotated[int, AMOUNT]
    """Number of the frame in its trial."""
    prediction: Annotated[float, ANSWER]
    change: Annotated[float, ANSWER]
    """By the moved markers."""
    change_all: Annotated[float, ANSWER]
    """By all markers."""
    change_random: Annotated[float, ANSWER]
    """Mean over random sets of as many markers."""
    random_sets: Annotated[int, AMOUNT]
    markers: Annotated[int, AMOUNT]
    """Markers that lie wholly in the image."""
    from_px: tuple[tuple[float, float], ...]
    """Places of the moved markers in the frame, x and y in camera pixels."""


@dataclass(frozen=True, kw_only=True)
class Strip(Result):
    """One trial from stick to slip: true and predicted margin, and the maps of a few frames."""

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
    """Signed contribution of each pixel to f(x) - f(baseline), in margin units."""
    baseline: BaselineName = "untouched"
    moved: MovedMarkers | None = None
    """Of the last frame that is shown; None where no stick frame was found or the trial cannot be drawn again."""
    redrawn: UInt8[np.ndarray, "redrawn rows_px columns_px 3"] = field(
        default_factory=lambda: np.zeros((0, 1, 1, 3), dtype=np.uint8)
    )
    """That frame drawn again, or none."""
