"""Tracked markers of a trial, and the displacement field between them."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, UInt8

from sliplens.errors import InputError


class MarkerStatus(IntEnum):
    """State of a marker in a frame; only followed markers have a displacement."""

    UNSEEN = 0
    """A marker that appears later."""
    FOLLOWED = 1
    """Detected, and identified with a marker of the reference frame."""
    MISSING = 2
    """Should be in view but was not detected."""
    BROKEN = 3
    """Detected, but changed in size or shape, or astray from its neighbours: its centre is unreliable."""
    OUTSIDE = 4
    """Cut by the edge of the frame, or beyond it."""
    LOST = 5
    """The pattern jumped so far that markers cannot be identified."""
    NEW = 6
    """Detected, but not in the reference frame: it has a place and no displacement."""


@dataclass(frozen=True, kw_only=True)
class TrackedFrame:
    """Markers of one frame, in the order of the reference frame, new ones after them."""

    position_px: Float[np.ndarray, "markers 2"]
    """x, y; NaN where a marker was not detected whole."""
    motion_px: Float[np.ndarray, "markers 2"]
    """Displacement from the place at rest; NaN of new markers too."""
    size: tuple[int, int]
    """Height and width of the picture, in pixels."""
    radius_px: Float[np.ndarray, " markers"]
    deviation_px: Float[np.ndarray, " markers"]
    """Distance of a marker's displacement from that of the skin around it; NaN where either is unknown."""
    status: UInt8[np.ndarray, " markers"]
    """`MarkerStatus` of each."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Markers of a trial; pixel coordinates are (x, y), pixel centres at whole numbers."""

    rest_px: Float[np.ndarray, "markers 2"]
    """Places in the reference frame T_0; NaN for markers that it does not show."""
    rest_radius_px: Float[np.ndarray, " markers"]
    position_px: Float[np.ndarray, "frames markers 2"]
    """NaN where a marker was not detected whole."""
    radius_px: Float[np.ndarray, "frames markers"]
    deviation_px: Float[np.ndarray, "frames markers"]
    status: UInt8[np.ndarray, "frames markers"]

    def __len__(self) -> int:
        return len(self.status)

    @property
    def followed(self) -> Bool[np.ndarray, "frames markers"]:
        """Markers that have a displacement, frame by frame."""
        return self.status == MarkerStatus.FOLLOWED

    @property
    def displacement_px(self) -> Float[np.ndarray, "frames markers 2"]:
        """T_n less T_0, x and y; NaN where a marker was not followed."""
        return np.where(self.followed[..., None], self.position_px - self.rest_px, np.nan)

    @property
    def from_reference(self) -> Bool[np.ndarray, " markers"]:
        """Markers that the reference frame shows."""
        return np.all(np.isfinite(self.rest_px), axis=1)


_STACKED = ("position_px", "radius_px", "deviation_px", "status")


def stack_tracks(
    frames: list[TrackedFrame],
    *,
    rest_px: Float[np.ndarray, "markers 2"],
    rest_radius_px: Float[np.ndarray, " markers"],
) -> Tracks:
    """Join the frames of a trial; markers that appear later are unseen before."""
    count = max(len(frame.status) for frame in frames)

    def padded(values: np.ndarray) -> np.ndarray:
        missing = [(0, count - len(values)), *((0, 0) for _ in values.shape[1:])]
        return np.pad(values, missing, constant_values=np.nan if values.dtype.kind == "f" else MarkerStatus.UNSEEN)

    joined = {name: np.stack([padded(getattr(frame, name)) for frame in frames]) for name in _STACKED}
    return Tracks(rest_px=padded(rest_px), rest_radius_px=padded(rest_radius_px), **joined)


_FEWEST = 3
_RIDGE = 1e-9


@dataclass(frozen=True, kw_only=True)
class DisplacementField:
    """Displacement of the skin from T_0 to T_n, at its places at rest.

    Pixel coordinates are (x, y), y down; gradients are pixels of displacement per pixel.
    """

    x_px: Float[np.ndarray, " columns"]
    y_px: Float[np.ndarray, " rows"]
    displacement_px: Float[np.ndarray, "rows columns 2"]
    """x and y; extrapolated from the nearest markers where `confidence` is low."""
    gradient: Float[np.ndarray, "rows columns 2 2"]
    """[..., i, j]: change of displacement i along coordinate j."""
    confidence: Float[np.ndarray, "rows columns"]
    """1 / (1 + v), v the variance of the value over that of a single marker, times the weight of the markers near (at
    most 1): 0.5 is as good as a marker, 0 is a guess."""

    @property
    def divergence(self) -> Float[np.ndarray, "rows columns"]:
        """Growth of area, du_x/dx + du_y/dy: positive where the skin is pressed apart."""
        return self.gradient[..., 0, 0] + self.gradient[..., 1, 1]

    @property
    def curl(self) -> Float[np.ndarray, "rows columns"]:
        """Twice the rotation, du_y/dx - du_x/dy: positive where the skin turns from x to y, clockwise as seen."""
        return self.gradient[..., 1, 0] - self.gradient[..., 0, 1]

    @property
    def shear(self) -> Float[np.ndarray, "rows columns"]:
        """Magnitude of the change of shape, sqrt((u_xx - u_yy)^2 + (u_xy + u_yx)^2), in any axes."""
        return np.hypot(
            self.gradient[..., 0, 0] - self.gradient[..., 1, 1], self.gradient[..., 0, 1] + self.gradient[..., 1, 0]
        )


def interpolate_field(
    rest_px: Float[np.ndarray, "markers 2"],
    displacement_px: Float[np.ndarray, "markers 2"],
    *,
    size: tuple[int, int],
    step_px: float = 8.0,
    reach_px: float | None = None,
) -> DisplacementField:
    """Interpolate displacements between markers: at each point the best-fitting plane.

    Moving least squares with Gaussian weights: exact where the skin deforms evenly.

    Parameters
    ----------
    displacement_px
        x, y of each marker's displacement; NaN where it is unknown.
    size
        Height and width of the frame, in pixels.
    reach_px
        Standard deviation of the weights; if None, three quarters of the median distance to the third nearest marker.

    References
    ----------
    Lancaster and Salkauskas, Surfaces generated by moving least squares methods (1981).

    Examples
    --------
    Skin that is stretched by 1 % both ways has a divergence of 0.02 everywhere:

    >>> import numpy as np
    >>> from sliplens.markers import interpolate_field
    >>> rest_px = np.array([[x, y] for x in (8.0, 24, 40) for y in (8.0, 24, 40)])
    >>> field = interpolate_field(rest_px, 0.01 * (rest_px - 24), size=(48, 48))
    >>> bool(np.allclose(field.divergence, 0.02)), bool(np.allclose(field.shear, 0))
    (True, True)
    """
    followed = np.all(np.isfinite(displacement_px), axis=1) & np.all(np.isfinite(rest_px), axis=1)
    if followed.sum() < _FEWEST:
        raise InputError(
            f"{int(followed.sum())} markers have a displacement, at least {_FEWEST} are needed for a field; "
            "choose a frame in which more are followed"
        )
    if step_px <= 0 or (reach_px is not None and reach_px <= 0):
        raise InputError(f"the grid's step and reach must be positive, got {step_px} and {reach_px} px")
    place, value = rest_px[followed], displacement_px[followed]
    if reach_px is None:
        near = np.sort(np.linalg.norm(place[:, None] - place[None], axis=-1), axis=1)[:, 1 : _FEWEST + 1]
        reach_px = 0.75 * float(np.median(near[:, -1]))
    x = np.arange(step_px / 2, size[1], step_px) - 0.5
    y = np.arange(step_px / 2, size[0], step_px) - 0.5
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    offset = (place[None] - points[:, None]) / reach_px
    squared = (offset**2).sum(axis=-1)
    support = np.exp(-squared / 2).sum(axis=1)
    # the nearest marker weighs 1: far from all, weights would vanish, and their ratios with them
    weight = np.exp(-(squared - squared.min(axis=1, keepdims=True)) / 2)
    terms = np.concatenate([np.ones((*weight.shape, 1)), offset], axis=-1)
    weighted = terms * weight[..., None]
    # slopes without data are zero
    normal = np.swapaxes(weighted, 1, 2) @ terms + np.diag([0.0, _RIDGE, _RIDGE])
    inverse = np.linalg.inv(normal)
    influence = inverse @ np.swapaxes(weighted, 1, 2)
    fit = influence @ value
    variance = (influence[:, 0] ** 2).sum(axis=1)
    shape = (len(y), len(x))
    return DisplacementField(
        x_px=x,
        y_px=y,
        displacement_px=fit[:, 0].reshape(*shape, 2),
        gradient=(np.swapaxes(fit[:, 1:], 1, 2) / reach_px).reshape(*shape, 2, 2),
        confidence=(np.minimum(support, 1) / (1 + variance)).reshape(shape),
    )
