"""Detection of the markers of a frame: place, size and contrast."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from sliplens.errors import ImageError
from sliplens.extras import import_cv2, pick
from sliplens.images import require_rgb

Contrast: TypeAlias = Literal["dark", "light", "colour"]


@dataclass(frozen=True, kw_only=True)
class MarkerKind:
    """Look of a sensor's markers against their background."""

    contrasts: tuple[Contrast, ...]
    """Possible contrasts; where there are several, the frame decides."""
    radius_px: tuple[float, float] = (2.0, 40.0)
    """Smallest and largest radius, in pixels."""
    channels: tuple[float, float, float] | None = None
    """Weights of red, green and blue for measuring centres; estimated from the markers if None."""


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """Look of a sensor's markers in a frame."""

    weights: Float32[np.ndarray, "3"]
    """Weights of red, green and blue; their sum is high on a marker, whatever its colour, and in grey levels."""
    radius_px: float
    """Median over the markers."""
    contrast: float
    """Median over the markers, in weighted grey levels."""


KINDS = {
    # red speckles most, and the lamps' glare is blue: green measures best
    "chromatouch": MarkerKind(contrasts=("dark",), channels=(0.2, 0.8, 0.0)),
    "gelsight-mini": MarkerKind(contrasts=("dark",), channels=(1.0, 1.0, 1.0)),
    "tactip": MarkerKind(contrasts=("light",), channels=(1.0, 1.0, 1.0)),
    "auto": MarkerKind(contrasts=("dark", "light", "colour")),
}
"""Presets by name: the magenta dots of the ChromaTouch, the black ones of a GelSight Mini, the white pins of a TacTip;
`auto` looks for whatever is round and stands out alike in many places."""


FEWEST = 4
"""Fewest markers of a pattern: fewer may be dirt."""
_BRIGHT, _DARK, _EXPOSED = 250, 5, 0.5
_GREY = np.array([1, 1, 1], dtype=np.float32) / 3


def find_appearance(frame: UInt8[np.ndarray, "height width 3"], kind: MarkerKind) -> Appearance:
    """Estimate colour, size and contrast of a frame's markers: round spots of one size over Otsu's threshold."""
    for what, pixels in (("saturated", frame.min(axis=-1) >= _BRIGHT), ("black", frame.max(axis=-1) <= _DARK)):
        if np.mean(pixels) > _EXPOSED:
            raise ImageError(
                f"{100 * np.mean(pixels):.0f} % of the frame is {what}, so that markers do not show; correct the "
                "exposure or choose another frame"
            )
    tries = [look for contrast in kind.contrasts if (look := _find_spots(frame, kind, contrast))]
    if not tries:
        raise ImageError(
            f"fewer than {FEWEST} markers are visible in a frame of {frame.shape[0]} x {frame.shape[1]} pixels; choose "
            "another kind of markers, or use a frame that shows them"
        )
    return max(tries, key=lambda look: look[0])[1]


def _find_spots(
    frame: UInt8[np.ndarray, "height width 3"], kind: MarkerKind, contrast: Contrast
) -> tuple[float, Appearance] | None:
    """Find round spots that stand out in one way; return their look, and how like markers they are."""
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
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    round_ones = _round(stats, kind, (height, width))
    if round_ones.sum() < FEWEST:
        return None
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    # the median is weighed by area: specks are many, and small
    order = np.sort(area[round_ones])
    typical = order[np.searchsorted(np.cumsum(order), order.sum() / 2)]
    chosen = np.flatnonzero(round_ones & (np.abs(np.log(area / typical)) < np.log(2.5)))
    if len(chosen) < FEWEST:
        return None
    spread = float(np.std(np.log(area[chosen])))
    share = float(area[chosen].sum() / area[1:].sum())
    inside, outside = np.isin(labels, chosen), labels == 0
    outstanding = float(np.median(over[inside]) / (np.median(over[outside]) + 1))
    radius_px = float(np.sqrt(np.median(area[chosen]) / np.pi))
    if kind.channels is not None and contrast != "colour":
        weights = np.array(kind.channels) / (sum(kind.channels) if contrast == "light" else -sum(kind.channels))
    else:
        reach = 2 * round(radius_px) + 1
        near = cv2.dilate(inside.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
        colour = np.median(frame[inside], axis=0) - np.median(frame[near & outside], axis=0)
        # shadows change the brightness alone, so it does not count
        colour = colour - colour.mean() if contrast == "colour" else colour
        # a step from background to marker keeps its size in grey levels; spots that differ in nothing have no colour
        weights = colour / max(np.abs(colour).sum(), 1e-6)
    signal = pixels @ weights.astype(np.float32)
    level = float(np.median(signal[inside]) - np.median(signal[outside]))
    # spots end where they pass the threshold, markers where half of their contrast is left: measured when refined
    look = Appearance(weights=weights.astype(np.float32), radius_px=radius_px, contrast=max(level, 1.0))
    return np.sqrt(len(chosen)) * share * outstanding / (0.1 + spread), look


def _round(stats: np.ndarray, kind: MarkerKind, size: tuple[int, int]) -> Bool[np.ndarray, " components"]:
    """Select components that are round, of a possible size and inside the frame."""
    x, y, width, height, area = stats[:, :5].astype(float).T
    radius, fill = np.sqrt(area / np.pi), area / (width * height)
    low, high = kind.radius_px
    inside = (x > 0) & (y > 0) & (x + width < size[1]) & (y + height < size[0])
    shape = (np.maximum(width, height) < 1.7 * np.minimum(width, height)) & (fill > 0.55) & (fill < 0.95)
    return inside & shape & (radius >= low) & (radius <= min(high, min(size) / 8)) & (np.arange(len(stats)) > 0)


_INNER, _OUTER = 1.55, 2.1  # radii of the ring in which the background is seen
_CORE = 0.5  # radii, of what is surely marker
_REACH = 1.6  # radii, beyond which nothing belongs to the marker
_LOW, _HIGH = 0.25, 0.75  # of the contrast: below is background, above marker, however it speckles
_ROUNDS = 3  # of moving the window onto the measured centre
_FOLLOWED_ROUNDS = 1  # of the same from a place known to a third of a radius: the marker lies within the reach
_SLOPE_SHARE = 0.5  # of the contrast that the background may change by across a radius


@dataclass(frozen=True, kw_only=True)
class Markers:
    """Markers of one frame; pixel coordinates are (x, y), pixel centres at whole numbers."""

    centre_px: Float[np.ndarray, "spots 2"]
    radius_px: Float[np.ndarray, " spots"]
    """Radius of the disc of the same area."""
    contrast: Float[np.ndarray, " spots"]
    """Contrast with the background around it, in weighted grey levels."""
    roundness: Float[np.ndarray, " spots"]
    """Shorter over longer axis, 1 for a disc."""
    noise: Float[np.ndarray, " spots"]
    """Standard deviation of the background around it, in weighted grey levels."""
    whole: Bool[np.ndarray, " spots"]
    """False where the edge of the frame cuts a marker, so that its centre is unknown."""
    appearance: Appearance
    """Common look of the markers."""

    def __len__(self) -> int:
        return len(self.centre_px)

    def only(self, chosen: Bool[np.ndarray, " spots"]) -> "Markers":
        """Return some of the markers."""
        arrays = {name: values for name, values in vars(self).items() if name != "appearance"}
        return replace(self, **{name: values[chosen] for name, values in arrays.items()})


class _Window(NamedTuple):
    """Common part of windows of one size; pixels in one row."""

    half: int
    ring: Bool[np.ndarray, " pixels"]
    means: Float32[np.ndarray, "pixels 4"]  # over the ring (level, slope along x, slope along y) and over the core
    plane: Float32[np.ndarray, "3 pixels"]  # 1, x and y
    moments: Float32[np.ndarray, "pixels 6"]  # 1, x, y, x^2, y^2 and xy


@lru_cache(maxsize=32)
def _window(radius_px: float) -> _Window:
    half = int(np.ceil(_OUTER * radius_px))
    y, x = (axis.ravel().astype(np.float32) for axis in np.mgrid[-half : half + 1, -half : half + 1])
    distance = np.hypot(x, y)
    ring, core = (distance > _INNER * radius_px) & (distance < _OUTER * radius_px), distance <= _CORE * radius_px
    means = [ring / ring.sum(), ring * x / (x[ring] @ x[ring]), ring * y / (y[ring] @ y[ring]), core / core.sum()]
    ones = np.ones_like(x)
    moments = np.stack([ones, x, y, x * x, y * y, x * y], axis=1)
    return _Window(half, ring, np.stack(means, axis=1).astype(np.float32), np.stack([ones, x, y]), moments)


def measure_spots(
    signal: Float32[np.ndarray, "height width"],
    near_px: Float[np.ndarray, "spots 2"],
    appearance: Appearance,
    *,
    rounds: int = _ROUNDS,
) -> Markers:
    """Measure the spots near places, known to a third of a radius, in a signal that is high on markers.

    The background is a plane, fitted in a ring around each spot. A pixel counts as marker from a quarter (not at all)
    to three quarters (wholly) of the contrast: speckle inside a marker does not move its centre, but its edge does, by
    fractions of a pixel.
    """
    radius_px = appearance.radius_px
    window = _window(round(max(radius_px, 1.5), 1))
    height, width = signal.shape
    whole = np.clip(np.round(near_px), 0, (width - 1, height - 1)).astype(np.int64)
    steps = np.arange(2 * window.half + 1)
    rows, columns = whole[:, 1, None] + steps, whole[:, 0, None] + steps
    padded = np.pad(signal, window.half, mode="edge")
    patches = padded[rows[:, :, None], columns[:, None, :]].reshape(len(whole), steps.size**2)
    level, slope_x, slope_y, core = (patches @ window.means).T
    contrast = core - level
    limit = _SLOPE_SHARE * np.abs(contrast) / radius_px
    slopes = np.stack([level, np.clip(slope_x, -limit, limit), np.clip(slope_y, -limit, limit)], axis=1)
    patches -= slopes @ window.plane
    noise = patches[:, window.ring].std(axis=1)
    patches *= (1 / ((_HIGH - _LOW) * np.where(contrast > 1e-3, contrast, 1e-3)))[:, None]
    patches -= np.float32(_LOW / (_HIGH - _LOW))
    share = np.clip(patches, 0, 1, out=patches)
    offset = (near_px - whole).astype(np.float32)
    moments = np.ones((len(whole), 6), dtype=np.float32)
    for _ in range(rounds):
        x, y = window.plane[1] - offset[:, :1], window.plane[2] - offset[:, 1:]
        near = np.sqrt(x * x + y * y)
        part = share * np.clip(np.subtract(_REACH * radius_px + 0.5, near, out=near), 0, 1, out=near)
        moments = part @ window.moments
        moments[:, 1:] /= np.maximum(moments[:, :1], 1e-6)
        offset = moments[:, 1:3]
    mass, mean_x, mean_y, mean_xx, mean_yy, mean_xy = moments.T
    spread_x, spread_y = mean_xx - mean_x**2, mean_yy - mean_y**2
    middle, half = (spread_x + spread_y) / 2, np.hypot((spread_x - spread_y) / 2, mean_xy - mean_x * mean_y)
    centre, radius = whole + offset.astype(np.float64), np.sqrt(mass / np.pi).astype(np.float64)
    # a pixel beyond the disc: its blurred edge counts too
    edge = radius[:, None] + 1
    return Markers(
        centre_px=centre,
        radius_px=radius,
        contrast=contrast.astype(np.float64),
        roundness=np.sqrt(np.clip((middle - half) / np.maximum(middle + half, 1e-9), 0, 1)).astype(np.float64),
        noise=noise.astype(np.float64),
        whole=np.all((centre >= edge) & (centre <= np.array([width - 1, height - 1]) - edge), axis=1),
        appearance=appearance,
    )


_SMALL_RADIUS = 3.0  # pixels: spots are searched in frames reduced to it, and measured in the frame itself
_LEAST_RESPONSE = 0.15  # of that of the markers
_LEAST_CONTRAST = 0.3  # of that of the markers
_LEAST_OVER_NOISE = 4.0
_RADII = (0.55, 1.6)  # of that of the markers
_LEAST_ROUNDNESS = 0.4


def detect_markers(
    frame: UInt8[np.ndarray, "height width 3"],
    kind: str | MarkerKind = "auto",
    *,
    appearance: Appearance | None = None,
) -> Markers:
    """Detect the markers of a frame, and measure them to a fraction of a pixel.

    Places are maxima of a difference of blurs at the markers' size; centre and radius are centroid and area of the
    pixels above half of the contrast with the local background (`measure_spots`).

    Parameters
    ----------
    kind
        Row of `KINDS`, or another `MarkerKind`.
    appearance
        Appearance of the same sensor's markers in an earlier frame, in place of `kind`: saves time, and applies the
        same criteria through a recording. A frame without markers is then no error.
    """
    require_rgb(frame, what="levels of the frame")
    if appearance is not None:
        return _detect(frame, appearance)
    first = find_appearance(frame, pick(KINDS, kind, noun="kind of markers") if isinstance(kind, str) else kind)
    # the first estimate of the size depends on where the threshold cuts the edge: measure, correct, measure again
    for _ in range(2):
        markers = _detect(frame, first)
        sound = markers.whole & (markers.roundness > 0.7)
        if sound.sum() < FEWEST:
            raise ImageError(
                f"only {int(sound.sum())} markers are whole, at least {FEWEST} are needed; choose another kind, or "
                "use a frame that shows the markers"
            )
        radius, contrast = (float(np.median(values[sound])) for values in (markers.radius_px, markers.contrast))
        first = replace(first, radius_px=radius, contrast=contrast)
    markers = _detect(frame, first)
    if not _make_pattern(markers.only(markers.whole)):
        raise ImageError(
            f"the frame shows {int(markers.whole.sum())} spots that are neither round and alike nor in a pattern: no "
            "markers; use a frame that shows the markers of a sensor"
        )
    return markers


# Chosen on pictures without markers (noise blurred by 1 to 8 px, fractal noise, blobs, discs of many sizes; seeds 1000
# to 2011): roundness below 0.89, radii that differ by 0.08 and more where spots are round, and a ratio of neighbours
# below 0.68 where there are 7 or more. Simulated sensors have 0.97, 0.03 and 0.94, the irregular, blurred dots of
# FingerVision 0.75, 0.16 and 0.75.
_ROUND, _ALIKE = 0.9, 0.06
_FEWEST_NEIGHBOURS, _LEAST_RATIO = 9, 0.7


def _make_pattern(markers: Markers) -> bool:
    """Return whether spots are round and of one size, or have their third neighbour hardly farther than the first."""
    if len(markers) < FEWEST:
        return False
    radius = np.log(markers.radius_px)
    if np.median(markers.roundness) >= _ROUND and np.median(np.abs(radius - np.median(radius))) <= _ALIKE:
        return True
    if len(markers) < _FEWEST_NEIGHBOURS:
        return False
    apart = np.linalg.norm(markers.centre_px[:, None] - markers.centre_px, axis=-1)
    first, third = np.sort(apart, axis=1)[:, [1, 3]].T
    return bool(np.median(first / third) >= _LEAST_RATIO)


def measure_markers(
    frame: UInt8[np.ndarray, "height width 3"], appearance: Appearance, near_px: Float[np.ndarray, "markers 2"]
) -> tuple[Markers, Int[np.ndarray, " markers"]]:
    """Measure markers in windows around predicted places; returns them, and which of them each place has, or -1.

    A window is moved once, onto a centre that is more than a third of a radius from its place.
    """
    signal, radius = frame.astype(np.float32) @ appearance.weights, appearance.radius_px
    markers = measure_spots(signal, near_px, appearance, rounds=_FOLLOWED_ROUNDS)
    moved = np.linalg.norm(markers.centre_px - near_px, axis=1) > radius / 3
    if moved.any():
        again = measure_spots(signal, markers.centre_px[moved], appearance, rounds=_FOLLOWED_ROUNDS)
        for name, values in vars(again).items():
            if name != "appearance":
                vars(markers)[name][moved] = values
    keep = _look_alike(markers, near_px)
    return markers.only(keep), np.where(keep, np.cumsum(keep) - 1, -1)


def _detect(frame: UInt8[np.ndarray, "height width 3"], appearance: Appearance) -> Markers:
    signal = frame.astype(np.float32) @ appearance.weights
    near = _find_places(signal, appearance)
    markers = measure_spots(signal, near, appearance)
    return markers.only(_look_alike(markers, near))


def _look_alike(spots: Markers, near: Float[np.ndarray, "spots 2"]) -> Bool[np.ndarray, " spots"]:
    """Select the spots that look like markers, each once."""
    look, centre = spots.appearance, spots.centre_px
    low, high = (share * look.radius_px for share in _RADII)
    keep = (
        (spots.contrast > _LEAST_CONTRAST * look.contrast)
        & (spots.contrast > _LEAST_OVER_NOISE * spots.noise)
        & (spots.radius_px > low)
        & (spots.radius_px < high)
        & (spots.roundness > _LEAST_ROUNDNESS)
        & (np.linalg.norm(centre - near, axis=1) < 1.2 * look.radius_px)
    )
    # spots that came to lie on an earlier, stronger one are the same
    apart = np.linalg.norm(centre[keep][:, None] - centre[keep][None], axis=-1)
    keep[keep] = ~np.any((apart < look.radius_px) & np.tri(len(apart), k=-1, dtype=bool), axis=1)
    return keep


def _find_places(signal: Float32[np.ndarray, "height width"], appearance: Appearance) -> Float[np.ndarray, "places 2"]:
    """Find maxima of a difference of blurs at the markers' size, to a pixel of the reduced frame, strongest first."""
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
    # a disc of full contrast gives about 0.65 of it: 1 - exp(-r^2 / 2 (0.6 r)^2), less the mean of the box
    rows, columns = np.nonzero((response == highest) & (response > _LEAST_RESPONSE * appearance.contrast))
    order = np.argsort(-response[rows, columns], kind="stable")
    # pixel centres are whole numbers in both frames
    return (np.stack([columns, rows], axis=1)[order] + 0.5) * factor - 0.5
