"""Markers of a frame: where they are, how large, and how well they are seen."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from sliplens.errors import ImageError
from sliplens.markers.appearance import FEWEST, find_appearance, refine_appearance
from sliplens.markers.kinds import Appearance, MarkerKind, get_kind
from sliplens.markers.opencv import import_cv2
from sliplens.markers.refine import Shapes, measure_spots

_SMALL_RADIUS = 3.0  # pixels: spots are looked for in frames reduced so far, and measured in the frame itself
_LEAST_RESPONSE = 0.15  # of the markers' own
_LEAST_CONTRAST = 0.3  # of the markers' own
_LEAST_OVER_NOISE = 4.0
_RADII = (0.55, 1.6)  # of the markers' own
_LEAST_ROUNDNESS = 0.4


@dataclass(frozen=True, kw_only=True)
class Markers:
    """Markers of one frame; pixel coordinates are (x, y), pixel centres at whole numbers."""

    centre_px: Float[np.ndarray, "markers 2"]
    radius_px: Float[np.ndarray, " markers"]
    """Of the disc of the same area."""
    contrast: Float[np.ndarray, " markers"]
    """Against the background around it, in weighted grey levels."""
    roundness: Float[np.ndarray, " markers"]
    """Shorter over longer axis, 1 for a disc."""
    whole: Bool[np.ndarray, " markers"]
    """False where the edge of the frame cuts a marker, so that its centre is not seen."""
    appearance: Appearance
    """What they had in common."""

    def __len__(self) -> int:
        """Count the markers."""
        return len(self.centre_px)


def detect_markers(
    frame: UInt8[np.ndarray, "height width 3"], kind: str | MarkerKind = "auto", *, appearance: Appearance | None = None
) -> Markers:
    """Find the markers of a frame, and measure them to a fraction of a pixel.

    Places are maxima of a difference of blurs at the markers' size; centre and radius are centroid and area of what
    passes half of the contrast with the local background (`measure_spots`).

    Parameters
    ----------
    frame
        RGB.
    kind
        Row of `KINDS`, or a kind of one's own.
    appearance
        What was found before on the same sensor, in place of `kind`: saves the time to find it, and keeps what is a
        marker the same through a recording. No marker at all is then an answer, not an error.

    Raises
    ------
    InputError
        If the kind is not known, or OpenCV is missing.
    ImageError
        If no appearance is given and the frame is over- or underexposed, or shows fewer than 4 markers.
    """
    if appearance is not None:
        return _detect(frame, appearance)
    first = find_appearance(frame, get_kind(kind) if isinstance(kind, str) else kind)
    # the first impression errs in size by the threshold's place on the edge: measure, correct, measure again
    for _ in range(2):
        found = _detect(frame, first)
        sound = found.whole & (found.roundness > 0.7)
        if sound.sum() < FEWEST:
            raise ImageError(
                f"only {int(sound.sum())} markers were found whole, at least {FEWEST} are needed; name another kind, "
                "or use a frame in which the markers are seen"
            )
        first = refine_appearance(first, radius_px=found.radius_px[sound], contrast=found.contrast[sound])
    return _detect(frame, first)


def _detect(frame: UInt8[np.ndarray, "height width 3"], appearance: Appearance) -> Markers:
    signal = frame.astype(np.float32) @ appearance.weights
    near = _find_places(signal, appearance)
    shapes = measure_spots(signal, near, radius_px=appearance.radius_px)
    keep = _sound(shapes, near, appearance)
    keep[keep] = _first_of_each(shapes.centre_px[keep], reach_px=appearance.radius_px)
    centre, radius = shapes.centre_px[keep], shapes.radius_px[keep]
    height, width = signal.shape
    # a pixel beyond the disc: its blurred edge counts too
    whole = (centre >= radius[:, None] + 1) & (centre <= np.array([width - 2, height - 2]) - radius[:, None])
    return Markers(
        centre_px=centre,
        radius_px=radius,
        contrast=shapes.contrast[keep],
        roundness=shapes.roundness[keep],
        whole=np.all(whole, axis=1),
        appearance=appearance,
    )


def _find_places(signal: Float32[np.ndarray, "height width"], appearance: Appearance) -> Float[np.ndarray, "places 2"]:
    """Maxima of a difference of blurs at the markers' size, to a pixel of the reduced frame, strongest first."""
    cv2 = import_cv2()
    factor = max(1, int(appearance.radius_px / _SMALL_RADIUS))
    radius = appearance.radius_px / factor
    height, width = signal.shape[0] // factor, signal.shape[1] // factor
    small = signal[: height * factor, : width * factor]
    if factor > 1:
        small = cv2.resize(small, (width, height), interpolation=cv2.INTER_AREA)
    side = 2 * int(3 * radius) + 1
    response = cv2.GaussianBlur(small, (0, 0), 0.6 * radius) - cv2.blur(small, (side, side))
    reach = 2 * round(0.8 * radius) + 1
    highest = cv2.dilate(response, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    # what a disc of the full contrast answers is about 0.65 of it: 1 - exp(-r^2 / 2 (0.6 r)^2), less what the box sees
    rows, columns = np.nonzero((response == highest) & (response > _LEAST_RESPONSE * appearance.contrast))
    order = np.argsort(-response[rows, columns], kind="stable")
    # pixel centres are whole numbers in both frames
    return (np.stack([columns, rows], axis=1)[order] + 0.5) * factor - 0.5


def _sound(shapes: Shapes, near: Float[np.ndarray, "places 2"], appearance: Appearance) -> Bool[np.ndarray, " places"]:
    low, high = (share * appearance.radius_px for share in _RADII)
    return (
        (shapes.contrast > _LEAST_CONTRAST * appearance.contrast)
        & (shapes.contrast > _LEAST_OVER_NOISE * shapes.noise)
        & (shapes.radius_px > low)
        & (shapes.radius_px < high)
        & (shapes.roundness > _LEAST_ROUNDNESS)
        & (np.linalg.norm(shapes.centre_px - near, axis=1) < 1.2 * appearance.radius_px)
    )


def _first_of_each(centre_px: Float[np.ndarray, "spots 2"], *, reach_px: float) -> Bool[np.ndarray, " spots"]:
    """Drop spots that came to lie on an earlier, stronger one."""
    distance = np.linalg.norm(centre_px[:, None] - centre_px[None], axis=-1)
    earlier = np.tri(len(centre_px), k=-1, dtype=bool)
    return ~np.any((distance < reach_px) & earlier, axis=1)
