"""What estimators read: the displacements of a trial, and when the pull began."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import InputError
from sliplens.markers.tracks import Tracks

_FEWEST = 6
_PRESSED_SHARE = 0.9  # of the trial's own largest spread: from here on the press is done, creep aside
_PULL_PX = 0.2  # of the inner markers' mean motion: several times its noise
_INNER_SHARE = 1 / 3  # of the markers: what surely touches


@dataclass(frozen=True, kw_only=True)
class FieldTrial:
    """Displacements of one trial; pixel coordinates are (x, y).

    Raises
    ------
    InputError
        If there are fewer than 6 markers, sizes disagree, or the frame of the hold is not one of the trial.
    """

    rest_px: Float[np.ndarray, "_ 2"]
    displacement_px: Float[np.ndarray, "_ _ 2"]
    """From T_0, by frame and marker; NaN where a marker was not followed."""
    hold: int
    """Last frame before the pull: slip is told by what moves from there, not from T_0."""

    def __post_init__(self) -> None:
        """Check what every estimator needs."""
        if len(self.rest_px) < _FEWEST:
            raise InputError(f"{len(self.rest_px)} markers are too few to tell slip, at least {_FEWEST} are needed")
        if self.displacement_px.shape[1:] != self.rest_px.shape:
            raise InputError(
                f"{len(self.rest_px)} markers at rest but displacements of {self.displacement_px.shape[1]}; give both "
                "for the same markers"
            )
        if not 0 <= self.hold < len(self.displacement_px):
            raise InputError(f"frame {self.hold} of the hold is not one of {len(self.displacement_px)}")

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.displacement_px)

    @property
    def increment_px(self) -> Float[np.ndarray, "frames markers 2"]:
        """Displacement since the end of normal loading; what came before it counts as none."""
        moved = self.displacement_px - self.displacement_px[self.hold]
        moved[: self.hold] = np.where(np.isnan(moved[: self.hold]), np.nan, 0.0)
        return moved

    @property
    def spread(self) -> Float[np.ndarray, " frames"]:
        """Divergence of the field since T_0, in pixels per pixel: how far the skin is pressed apart."""
        return affine_parts(self.rest_px, self.displacement_px)[:, 2]

    @property
    def inner(self) -> Bool[np.ndarray, " markers"]:
        """The third of the markers nearest to where pressing moved nothing: what touches for sure."""
        return self._by_distance(0.0, _INNER_SHARE)

    @property
    def outer(self) -> Bool[np.ndarray, " markers"]:
        """The next third: the edge of the contact."""
        return self._by_distance(_INNER_SHARE, 2 * _INNER_SHARE)

    def _by_distance(self, low: float, high: float) -> Bool[np.ndarray, " markers"]:
        return _ring(self.rest_px, self.displacement_px[self.hold], low, high)


def _ring(
    rest_px: Float[np.ndarray, "markers 2"], pressed_px: Float[np.ndarray, "markers 2"], low: float, high: float
) -> Bool[np.ndarray, " markers"]:
    """Markers between two shares of all, ranked by their distance from where pressing moved nothing."""
    distance = np.linalg.norm(rest_px - pressed_centre(rest_px, pressed_px), axis=1)
    rank = np.argsort(np.argsort(distance, kind="stable"), kind="stable") / len(distance)
    return (rank >= low) & (rank < high)


def affine_parts(
    rest_px: Float[np.ndarray, "markers 2"], displacement_px: Float[np.ndarray, "frames markers 2"]
) -> Float[np.ndarray, "frames 6"]:
    """Least-squares parts of a field: mean x and y, divergence, curl, and the two parts of pure shear.

    The Helmholtz-Hodge decomposition of an affine field: its source-free, its curl-free and its harmonic part (a shift
    and a deviator), about the middle of the markers. Means are in pixels, the rest in pixels per pixel; NaN where fewer
    than 3 markers are known.

    References
    ----------
    Zhang, Kan, Yang, Tse and Wang, *Effective Estimation of Contact Force and Torque for Vision-based Tactile Sensor
    with Helmholtz-Hodge Decomposition*, 2019.
    """
    offset = rest_px - rest_px.mean(axis=0)
    terms = np.concatenate([np.ones((len(offset), 1)), offset], axis=1)
    known = np.all(np.isfinite(displacement_px), axis=-1)
    weighted = terms[None] * known[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ terms + 1e-9 * np.eye(3)
    fit = np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ np.where(known[..., None], displacement_px, 0))
    (mean_x, mean_y), (xx, yx), (xy, yy) = (fit[:, row].T for row in range(3))
    parts = np.stack([mean_x, mean_y, xx + yy, yx - xy, xx - yy, xy + yx], axis=1)
    return np.where(known.sum(axis=1)[:, None] >= 3, parts, np.nan)


def pressed_centre(
    rest_px: Float[np.ndarray, "markers 2"], displacement_px: Float[np.ndarray, "markers 2"]
) -> Float[np.ndarray, "2"]:
    """Where pressing moved nothing sideways, by the affine fit; the middle of the markers where it says nothing."""
    middle = rest_px.mean(axis=0)
    mean_x, mean_y, divergence, *_ = affine_parts(rest_px, displacement_px[None])[0]
    if not np.isfinite(divergence) or abs(divergence) < 1e-3:
        return middle
    reach = np.abs(rest_px - middle).max() / 2
    return middle - np.clip(2 * np.array([mean_x, mean_y]) / divergence, -reach, reach)


def find_hold(rest_px: Float[np.ndarray, "markers 2"], displacement_px: Float[np.ndarray, "frames markers 2"]) -> int:
    """Find the last frame before the pull: pressed, and the inner markers not yet moved by 0.2 px on average.

    Pressing ends where the divergence first comes to nine tenths of the trial's largest; a trial without any has its
    first frame for its hold. It looks at the whole trial: a live reader is told by the hand when it begins to pull.
    """
    parts = affine_parts(rest_px, displacement_px)
    spread = np.nan_to_num(parts[:, 2], nan=-np.inf)
    if not np.isfinite(spread).any() or spread.max() <= 0:
        return 0
    settled = int(np.argmax(spread >= _PRESSED_SHARE * spread.max()))
    inner = _ring(rest_px, displacement_px[settled], 0.0, _INNER_SHARE)
    moved = affine_parts(rest_px[inner], displacement_px[settled:, inner] - displacement_px[settled, inner])[:, :2]
    later = np.flatnonzero(np.nan_to_num(np.linalg.norm(moved, axis=1), nan=0.0) > _PULL_PX)
    return settled + max(int(later[0]) - 1, 0) if len(later) else settled


def field_trial(tracks: Tracks, *, hold: int | None = None) -> FieldTrial:
    """Displacements of a tracked trial, its hold found by `find_hold` if it is not given.

    Raises
    ------
    InputError
        If fewer than 6 markers of the reference frame were tracked, or the frame is not one of the trial.
    """
    kept = tracks.from_reference
    rest, displacement = tracks.rest_px[kept], tracks.displacement_px[:, kept]
    return FieldTrial(
        rest_px=rest, displacement_px=displacement, hold=find_hold(rest, displacement) if hold is None else hold
    )
