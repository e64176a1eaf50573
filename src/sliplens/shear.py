"""Direction in which a contact shears the skin, estimated from the frame and the untouched sensor alone."""

from dataclasses import dataclass
from math import atan2, degrees, hypot, inf, radians, sin

import numpy as np
from jaxtyping import Float, Float32, UInt8

from sliplens.images import shrink

FULL_CIRCLE = (0.0, 360.0)
"""Range of directions that leaves none out. The first end of a range is from 0 to 360 degrees, the second at least the
first: (345, 375) is from 345 on through 0 to 15."""
TOLERANCE_DEG = 15.0
"""Angle beyond a range that still counts as inside. Up to 30 degrees from the middle of 75 to 105 the error of
`chromatouch-pair` is that at the middle; it doubles at 60 (60 simulated trials pulled in every direction)."""
DIRECTION_LIMIT = 2.5
"""Standard deviations beyond a range from which on a pull is outside. Of simulated frames (series `direction-choose`)
with a press and no pull it leaves 1.4 % outside, of those pulled in range 0.1 %; of those pulled the other way with a
margin under 0.3, 0.3 to 0.6 and 0.6 to 0.75 it finds 99, 91 and 81 %."""

_SIDE_PX = 75  # shorter side of the reduced picture: patches of a quarter of it then hold two or three markers
_STEP, _PATCH, _WINDOW = 8, 18, 32
_WIDE = 7  # half of the box whose mean is subtracted: light and shade are wider than markers
_FLAT = 1.0  # grey levels, of a patch that shows nothing
_LEAST_CORRELATION = 0.5
_STRAY = 0.2  # patch spacings between a patch and the median of its neighbours; a wrong match is further off
_LEAST_SHARE = 0.5  # of the patches, that must be matched
_WEIGHTS: dict[str, tuple[tuple[float, ...], tuple[float, ...], float]] = {
    "chromatouch": ((-1.61, -2.49, 4.76, 3.46, 1.09), (0.19, -2.89, -3.83, -1.63, 0.75), 0.0223),
    "": ((-0.5, -0.44, -2.48, 6.96, 1.45), (0.35, 4.25, -2.75, 3.25, 1.87), 0.11),
}
"""By kind of sensor, at the knots: weights of a displacement and of its outward part, and the standard deviation of
the shear as a share of the mean outward displacement. Fitted by ridge regression to the tangential force of 150
simulated trials pulled in every direction; the deviation was measured on other days. The row without a name is of all
simulated sensors together."""
_KNOTS = np.array([0, 0.33, 0.66, 1.0, 1.4])  # distances from the centre over half of the shorter side
_NOISE_PX = 0.027  # of the reduced picture


@dataclass(frozen=True, kw_only=True)
class Shear:
    """Shear of the skin in one frame; x right, y down."""

    x_px: float
    y_px: float
    """Shear in pixels of displacement, 1 where the picture as a whole moves by 1 pixel."""
    sigma_px: float
    """Standard deviation of either part: camera noise, and a press that is off the centre or tilted. Infinite where
    the frame does not show how the skin moves."""

    @property
    def direction_deg(self) -> float:
        """Direction from 0 to 360 degrees: 0 is right, 90 down the image."""
        return degrees(atan2(self.y_px, self.x_px)) % 360

    def excess(self, range_deg: tuple[float, float]) -> float:
        """Compute how far the pull is outside a range of directions, in standard deviations.

        The distance is measured in pixels from the nearest pull whose direction is within the range or
        `TOLERANCE_DEG` beyond it, so that a small shear is never far outside.

        Examples
        --------
        >>> from sliplens.shear import Shear
        >>> upwards = Shear(x_px=0.0, y_px=-1.0, sigma_px=0.1)
        >>> upwards.excess((75.0, 105.0)), upwards.excess((0.0, 360.0))
        (10.0, 0.0)
        """
        low, high = range_deg
        turn = abs((self.direction_deg - (low + high) / 2 + 180) % 360 - 180)
        beyond_deg = turn - (high - low) / 2 - TOLERANCE_DEG
        if beyond_deg <= 0:
            return 0.0
        return hypot(self.x_px, self.y_px) * sin(radians(min(beyond_deg, 90.0))) / self.sigma_px


def enclosing_range(
    directions_deg: Float[np.ndarray, " directions"], *, margin_deg: float = 0.0
) -> tuple[float, float]:
    """Find the smallest range that holds all of some directions, and widen it at both ends.

    It is `FULL_CIRCLE` where less than twice `TOLERANCE_DEG` would be left out.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.shear import enclosing_range
    >>> enclosing_range(np.array([350.0, 20.0, 5.0]), margin_deg=5.0)
    (345.0, 385.0)
    """
    ordered = np.sort(directions_deg % 360)
    gaps = np.diff(ordered, append=ordered[0] + 360)
    widest = int(gaps.argmax())
    if gaps[widest] - 2 * margin_deg <= 2 * TOLERANCE_DEG:
        return FULL_CIRCLE
    low = float(ordered[(widest + 1) % len(ordered)] - margin_deg) % 360
    return low, low + max(0.0, float(360 - gaps[widest] + 2 * margin_deg))


def range_words(range_deg: tuple[float, float]) -> str:
    """Format a range of directions for people, such as "75 to 105 degrees"."""
    low, high = range_deg
    return f"{low % 360:.0f} to {high if high <= 360 else high - 360:.0f} degrees"


class ShearEstimator:
    """Estimates the shear of frames of one sensor against its untouched image.

    The displacement of patches of the picture is measured by normalised cross-correlation. The shear is a weighted sum
    over the patches that cancels a press, off the centre or tilted. The weights depend on the distance from the centre
    of the picture alone, so that all directions are equal.

    Parameters
    ----------
    reference
        The sensor untouched.
    kind
        Kind of sensor whose weights to use, such as chromatouch; those of all simulated sensors together where there
        are none of its own.

    References
    ----------
    Lewis, *Fast Normalized Cross-Correlation*, Vision Interface 1995.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.shear import ShearEstimator
    >>> untouched = np.random.default_rng(0).integers(0, 256, (75, 75, 3), dtype=np.uint8)
    >>> moved = np.roll(untouched, 2, axis=0)  # down
    >>> round(ShearEstimator(untouched).estimate(moved).direction_deg)
    90
    """

    def __init__(self, reference: UInt8[np.ndarray, "height width 3"], kind: str = "") -> None:
        self._factor = max(1, round(min(reference.shape[:2]) / _SIDE_PX))
        plane = self._plane(reference)
        rows, columns = (np.arange(_PATCH // 2, side - _PATCH // 2 + 1, _STEP) for side in plane.shape)
        self._grid = len(rows), len(columns)
        down, right = (places.ravel() for places in np.meshgrid(rows, columns, indexing="ij"))
        window = np.hanning(_PATCH + 2)[1:-1].astype(np.float32)
        weight = np.outer(window, window)
        patches = _cut(plane, down - _PATCH // 2, right - _PATCH // 2, _PATCH)
        patches = (patches - (patches * weight).sum((1, 2), keepdims=True) / weight.sum()) * weight
        self._energy = np.sqrt((patches**2).sum((1, 2)))
        self._flat = self._energy < _FLAT * np.sqrt((weight**2).sum())
        self._patches, self._weight = (np.conj(_transform(part)) for part in (patches * weight, weight**2))
        self._corners = down - _WINDOW // 2 + _WINDOW, right - _WINDOW // 2 + _WINDOW  # of the padded picture
        middle = (np.array(plane.shape[::-1]) - 1) / 2
        away = np.stack([right, down], axis=1) - 0.5 - middle
        distance = np.linalg.norm(away, axis=1) / (min(plane.shape) / 2)
        self._outward = away / np.maximum(np.linalg.norm(away, axis=1), 1e-6)[:, None]
        near = np.stack([np.interp(distance, _KNOTS, row) for row in np.eye(len(_KNOTS))], axis=1)
        self._near = near / max(1, len(near))
        *weights, self._press_share = _WEIGHTS.get(kind, _WEIGHTS[""])
        self._weights = np.concatenate(weights)

    def estimate(self, frame: UInt8[np.ndarray, "_ _ 3"]) -> Shear:
        """Estimate the shear of a frame of the reference's size."""
        moved_px, share = self._measure_displacements(frame)
        if share < _LEAST_SHARE:
            return Shear(x_px=0.0, y_px=0.0, sigma_px=inf)
        outward_px = (moved_px * self._outward).sum(axis=1, keepdims=True)
        # mean displacement of the patches near each knot, then of its outward part
        moments = np.concatenate([self._near.T @ moved_px, self._near.T @ (outward_px * self._outward)])
        x_px, y_px = (self._weights @ moments).tolist()
        sigma_px = hypot(_NOISE_PX * self._factor, self._press_share * float(outward_px.mean()))
        return Shear(x_px=x_px, y_px=y_px, sigma_px=sigma_px)

    def _plane(self, image: UInt8[np.ndarray, "_ _ 3"]) -> Float32[np.ndarray, "rows columns"]:
        """Reduce the green channel and remove structures wider than a marker."""
        plane = shrink(image, self._factor)[..., 1].astype(np.float32)
        side = 2 * _WIDE + 1
        sums = np.pad(np.pad(plane, _WIDE, mode="edge").cumsum(0, dtype=np.float64).cumsum(1), ((1, 0), (1, 0)))
        box = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
        return plane - (box / side**2).astype(np.float32)

    def _measure_displacements(self, frame: UInt8[np.ndarray, "_ _ 3"]) -> tuple[Float[np.ndarray, "patches 2"], float]:
        """Measure the displacement (x, y) of each patch in pixels, and the share of the patches that were matched."""
        windows = _cut(np.pad(self._plane(frame), _WINDOW), *self._corners, _WINDOW)
        places = _WINDOW - _PATCH + 1
        product, energy = (
            np.asarray(np.fft.irfft2(_transform(part) * other, s=(_WINDOW, _WINDOW)))[:, :places, :places]
            for part, other in ((windows, self._patches), (windows**2, self._weight))
        )
        scale = np.sqrt(np.maximum(energy, 1e-3)) * np.maximum(self._energy, 1e-3)[:, None, None]
        match = (product / scale).reshape(len(windows), places**2)
        rows = np.arange(len(match))
        best = match.argmax(axis=1)
        row, column = np.divmod(best, places)
        matched = ~self._flat & (match[rows, best] >= _LEAST_CORRELATION)
        matched &= (np.minimum(row, column) > 0) & (np.maximum(row, column) < places - 1)
        inside = np.where(matched, best, places + 1)
        moved = [
            at - (_WINDOW - _PATCH) // 2 + _parabola(*(match[rows, inside + step * side] for side in (-1, 0, 1)))
            for at, step in ((column, 1), (row, places))
        ]
        field = np.where(matched[:, None], np.stack(moved, axis=1), np.nan).reshape(*self._grid, 2)
        share = float(matched.mean()) if len(matched) else 0.0
        return self._factor * _fill(field).reshape(-1, 2), share


def _transform(patches: Float32[np.ndarray, "*patches side side"]) -> np.ndarray:
    return np.asarray(np.fft.rfft2(patches, s=(_WINDOW, _WINDOW)))


def _cut(plane: Float32[np.ndarray, "height width"], row: np.ndarray, column: np.ndarray, side: int) -> np.ndarray:
    """Cut squares out of a plane, by their upper left corners."""
    if not len(row):
        return np.zeros((0, side, side), dtype=np.float32)
    return np.lib.stride_tricks.sliding_window_view(plane, (side, side))[row, column]


def _parabola(before: np.ndarray, at: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Find the top of the parabola through three values around the largest, from -0.5 to 0.5."""
    bend = np.minimum(before + after - 2 * at, -1e-9)
    return np.clip((before - after) / (2 * bend), -0.5, 0.5)


def _fill(moved: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 2"]:
    """Replace unknown values (NaN) and outliers by the median of their neighbours; 0 where there is none."""
    rows, columns = moved.shape[:2]
    for _ in range(2):
        padded = np.pad(moved, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        around = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
        ordered = np.sort(np.stack(around), axis=0)  # NaN comes last
        count = np.isfinite(ordered).sum(axis=0, keepdims=True)
        low, high = (np.take_along_axis(ordered, np.maximum(at, 0), axis=0)[0] for at in ((count - 1) // 2, count // 2))
        median = (low + high) / 2
        with np.errstate(invalid="ignore"):
            stray = ~(np.linalg.norm(moved - median, axis=-1) <= _STRAY * _STEP) & np.isfinite(median[..., 0])
        moved = np.where(stray[..., None], median, moved)
    return np.nan_to_num(moved)
