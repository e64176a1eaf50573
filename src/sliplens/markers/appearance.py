"""How the markers of a frame look: found once, on the untouched sensor."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from sliplens.errors import ImageError
from sliplens.markers.kinds import Appearance, Contrast, MarkerKind
from sliplens.markers.opencv import import_cv2

FEWEST = 4
"""Markers without which a pattern cannot be told from dirt."""
_BRIGHT, _DARK, _EXPOSED = 250, 5, 0.5
_GREY = np.array([1, 1, 1], dtype=np.float32) / 3


@dataclass(frozen=True, kw_only=True)
class _Spots:
    """Round spots that stand out in one way."""

    labels: Int[np.ndarray, "height width"]
    """Number of the component that each pixel belongs to."""
    chosen: Int[np.ndarray, " spots"]
    """Components that are round."""
    radius_px: float
    score: float
    """How well they agree with markers: many, alike, and little else."""


def find_appearance(frame: UInt8[np.ndarray, "height width 3"], kind: MarkerKind) -> Appearance:
    """Find the colour, size and contrast of a frame's markers.

    Spots are what passes Otsu's threshold over the local background; those that are round and of one size tell the
    colour in which markers differ from what surrounds them. Its direction is the weight of the channels, unless the
    kind names them.

    Parameters
    ----------
    frame
        Of the untouched sensor, or nearly so: RGB.
    kind
        What to look for.

    Raises
    ------
    ImageError
        If the frame is over- or underexposed, or fewer than 4 round spots are found.
    """
    _require_exposed(frame)
    tries: list[tuple[Contrast, _Spots]] = [
        (contrast, spots) for contrast in kind.contrasts if (spots := _find_spots(frame, kind, contrast))
    ]
    if not tries:
        raise ImageError(
            f"fewer than {FEWEST} markers of kind {kind.name} were found in a frame of {frame.shape[0]} x "
            f"{frame.shape[1]} pixels; name another kind, or use a frame in which the markers are seen"
        )
    contrast, spots = max(tries, key=lambda one: one[1].score)
    weights = _weights(frame, spots, kind, contrast)
    signal = frame.astype(np.float32) @ weights
    inside = np.isin(spots.labels, spots.chosen)
    level = float(np.median(signal[inside]) - np.median(signal[spots.labels == 0]))
    # spots end where they pass the threshold, markers where half of their contrast is left: measured when refined
    return Appearance(weights=weights, radius_px=spots.radius_px, contrast=max(level, 1.0))


def refine_appearance(
    appearance: Appearance, *, radius_px: Float[np.ndarray, " markers"], contrast: Float[np.ndarray, " markers"]
) -> Appearance:
    """Correct a first impression by what was measured on the markers themselves."""
    return replace(appearance, radius_px=float(np.median(radius_px)), contrast=float(np.median(contrast)))


def _require_exposed(frame: UInt8[np.ndarray, "height width 3"]) -> None:
    for what, share in (
        ("saturated", np.mean(frame.min(axis=-1) >= _BRIGHT)),
        ("black", np.mean(frame.max(axis=-1) <= _DARK)),
    ):
        if share > _EXPOSED:
            raise ImageError(
                f"{100 * share:.0f} % of the frame is {what}, so that no marker can be told; mend the exposure or name "
                "another frame"
            )


def _find_spots(frame: UInt8[np.ndarray, "height width 3"], kind: MarkerKind, contrast: Contrast) -> _Spots | None:
    cv2 = import_cv2()
    height, width = frame.shape[:2]
    pixels = frame.astype(np.float32)
    # odd, and wide enough that markers make up little of what they are compared with
    side = 2 * (min(height, width) // 6) + 1
    if contrast == "colour":
        chroma = np.stack([pixels[..., 0] - pixels[..., 1], pixels[..., 2] - pixels[..., :2].mean(axis=-1)], axis=-1)
        chroma = cv2.GaussianBlur(chroma, (0, 0), 1.0)
        over = np.linalg.norm(chroma - cv2.blur(chroma, (side, side)), axis=-1)
    else:
        grey = cv2.GaussianBlur(pixels @ _GREY, (0, 0), 0.8)
        over = (grey - cv2.blur(grey, (side, side))) * (1 if contrast == "light" else -1)
    over = np.maximum(over, 0)
    top = float(np.percentile(over, 99.5))
    if top < 4:  # grey levels: less is noise
        return None
    scaled = np.minimum(over * (255 / top), 255).astype(np.uint8)
    _, mask = cv2.threshold(scaled, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    if count <= FEWEST:
        return None
    round_ones = _round(stats, kind, (height, width))
    if round_ones.sum() < FEWEST:
        return None
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    # weighed by area: specks are many, and small
    alike = round_ones & (np.abs(np.log(area / _weighted_median(area[round_ones]))) < np.log(2.5))
    chosen = np.flatnonzero(alike)
    if len(chosen) < FEWEST:
        return None
    spread = float(np.std(np.log(area[chosen])))
    share = float(area[chosen].sum() / area[1:].sum())
    outstanding = float(np.median(over[np.isin(labels, chosen)]) / (np.median(over[mask == 0]) + 1))
    return _Spots(
        labels=labels.astype(np.int64),
        chosen=chosen,
        radius_px=float(np.sqrt(np.median(area[chosen]) / np.pi)),
        score=np.sqrt(len(chosen)) * share * outstanding / (0.1 + spread),
    )


def _round(stats: np.ndarray, kind: MarkerKind, size: tuple[int, int]) -> Bool[np.ndarray, " components"]:
    left, top, width, height, area = stats[:, :5].astype(float).T
    radius = np.sqrt(area / np.pi)
    low, high = kind.radius_px
    inside = (left > 0) & (top > 0) & (left + width < size[1]) & (top + height < size[0])
    fill = area / (width * height)
    shape = (np.maximum(width, height) < 1.7 * np.minimum(width, height)) & (fill > 0.55) & (fill < 0.95)
    return inside & shape & (radius >= low) & (radius <= min(high, min(size) / 8)) & (np.arange(len(stats)) > 0)


def _weighted_median(area: Float[np.ndarray, " spots"]) -> float:
    order = np.sort(area)
    return float(order[np.searchsorted(np.cumsum(order), order.sum() / 2)])


def _weights(
    frame: UInt8[np.ndarray, "height width 3"], spots: _Spots, kind: MarkerKind, contrast: Contrast
) -> Float32[np.ndarray, "3"]:
    cv2 = import_cv2()
    if kind.channels is not None and contrast != "colour":
        weights = np.array(kind.channels) / sum(kind.channels)
        return (weights if contrast == "light" else -weights).astype(np.float32)
    core = np.isin(spots.labels, spots.chosen).astype(np.uint8)
    reach = 2 * round(spots.radius_px) + 1
    near = cv2.dilate(core, np.ones((reach, reach), np.uint8)) > 0
    around = near & (spots.labels == 0)
    colour = np.median(frame[core > 0], axis=0) - np.median(frame[around], axis=0)
    if contrast == "colour":
        # shadows change the brightness alone: what is left tells markers from them
        colour = colour - colour.mean()
    # a step from background to marker keeps its size in grey levels
    return (colour / np.abs(colour).sum()).astype(np.float32)
