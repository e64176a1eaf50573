"""What the model-based estimators of slip read from the field, one function a paper: a few numbers for every frame."""

import numpy as np
from jaxtyping import Bool, Float

from sliplens.markers.estimators.trial import FieldTrial, affine_parts

_BINS, _BIN_PX = 48, 0.25
_STILL_PX = 0.05
"""Added where a motion is divided by: half the noise of a marker."""


def mean_shear(trial: FieldTrial) -> Float[np.ndarray, "frames 1"]:
    """Mean motion of all markers since the hold, in pixels: the trivial reading of a pull."""
    return np.linalg.norm(_mean(trial.increment_px), axis=-1)[:, None]


def shear_over_divergence(trial: FieldTrial) -> Float[np.ndarray, "frames 1"]:
    """Mean motion over divergence, in pixels: a pull for a press, as a ratio of forces is."""
    spread = np.maximum(trial.spread, 0.1 * max(float(np.nanmax(trial.spread)), 1e-6))
    return mean_shear(trial) / spread[:, None]


def rigid_residual(trial: FieldTrial) -> Float[np.ndarray, "frames 2"]:
    """Largest, and root mean square, distance of the contact's markers from a rigid motion t + w x r, in pixels.

    Where the contact sticks, it moves as the object does; where it slips, it is left behind. The paper calls it slip
    when the largest distance passes a threshold; here the margin is fitted to it, and to the root mean square, which
    one bad marker moves less.

    References
    ----------
    Dong, Ma, Donlon and Rodriguez, *Maintaining Grasps within Slipping Bounds by Monitoring Incipient Slip*, ICRA 2019.
    """
    distance = _from_rigid(trial, trial.inner | trial.outer)
    known = np.isfinite(distance).any(axis=1)
    largest, rms = np.full(len(trial), np.nan), np.full(len(trial), np.nan)
    largest[known] = np.nanmax(distance[known], axis=1)
    rms[known] = np.sqrt(np.nanmean(distance[known] ** 2, axis=1))
    return np.stack([largest, rms], axis=1)


def stick_area(trial: FieldTrial, *, tolerance_px: float) -> Float[np.ndarray, "frames 1"]:
    """Share of the contact's markers that move with the rigid motion of its middle, within a tolerance in pixels.

    References
    ----------
    Sui et al., *Incipient Slip Detection Method for Soft Objects with Vision-Based Tactile Sensor*, Measurement 2022:
    the ratio of the areas of stick and contact tells how near slip is.
    """
    distance = _from_rigid(trial, trial.inner)
    contact = trial.inner | trial.outer
    known = np.isfinite(distance) & contact
    count = known.sum(axis=1)
    share = ((distance < tolerance_px) & known).sum(axis=1) / np.maximum(count, 1)
    return np.where(count > 0, share, np.nan)[:, None]


def displacement_entropy(trial: FieldTrial) -> Float[np.ndarray, "frames 2"]:
    """Entropy H = -sum p ln p of the histogram of motions since the hold, and its change to the next frame.

    Bins of a quarter pixel, the last one open: a width taken from the trial's own largest motion would tell of frames
    that are still to come.

    References
    ----------
    Yuan, Li, Srinivasan and Adelson, *Measurement of Shear and Slip with a GelSight Tactile Sensor*, ICRA 2015; for the
    rate Hu et al., *Learning to Detect Slip through Tactile Estimation of the Contact Force Field and its Entropy*,
    arXiv:2303.00935.
    """
    length = np.linalg.norm(trial.increment_px, axis=-1)
    bins = np.minimum(length / _BIN_PX, _BINS - 1)
    entropy = np.full(len(trial), np.nan)
    for frame, row in enumerate(bins):
        known = row[np.isfinite(row)].astype(int)
        if len(known):
            share = np.bincount(known, minlength=_BINS) / len(known)
            entropy[frame] = -np.sum(share[share > 0] * np.log(share[share > 0]))
    return np.stack([entropy, np.diff(entropy, prepend=entropy[:1])], axis=1)


def edge_over_centre(trial: FieldTrial) -> Float[np.ndarray, "frames 2"]:
    """Motion of the contact's edge over that of its middle since the hold, and the motion of the middle in pixels.

    Slip begins at the edge: it falls behind the middle.

    References
    ----------
    Khamis, Albero, Salerno, Idil, Loizou and Redmond, *PapillArray: An incipient slip sensor for dexterous robotic or
    prosthetic manipulation*, Sensors and Actuators A 2018.
    """
    moved = trial.increment_px
    way = _mean(moved)
    way = way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), _STILL_PX)
    along = (moved * way[:, None]).sum(axis=-1)
    middle, edge = (_mean(along[:, zone, None])[:, 0] for zone in (trial.inner, trial.outer))
    return np.stack([(edge + _STILL_PX) / (np.maximum(middle, 0) + _STILL_PX), middle], axis=1)


def helmholtz_hodge(trial: FieldTrial) -> Float[np.ndarray, "frames 8"]:
    """Parts of the field since T_0 and since the hold: divergence, curl, shift and deviators, by least squares.

    Divergence and curl since T_0; length of the mean motion since the hold, and divergence, curl and deviator of that
    motion, all, and its mean over the inner markers alone.

    References
    ----------
    Zhang, Kan, Yang, Tse and Wang, 2019 (see `affine_parts`).
    """
    whole, since = (affine_parts(trial.rest_px, field) for field in (trial.displacement_px, trial.increment_px))
    inner = np.linalg.norm(_mean(trial.increment_px[:, trial.inner]), axis=-1)
    scale = float(np.linalg.norm(trial.rest_px - trial.rest_px.mean(axis=0), axis=1).max())
    shift = np.linalg.norm(since[:, :2], axis=1)
    deviator = np.hypot(since[:, 4], since[:, 5])
    shapes = np.stack([whole[:, 2], whole[:, 3], since[:, 2], since[:, 3], deviator], axis=1) * scale
    ratio = shift / np.maximum(shapes[:, 0], 1.0)
    return np.concatenate([shapes, shift[:, None], inner[:, None], ratio[:, None]], axis=1)


def _from_rigid(trial: FieldTrial, fitted: Bool[np.ndarray, " markers"]) -> Float[np.ndarray, "frames markers"]:
    """Distance of each motion since the hold from the small rigid motion that fits some markers best."""
    moved, place = trial.increment_px, trial.rest_px + trial.displacement_px[trial.hold]
    known = np.all(np.isfinite(moved), axis=-1) & np.all(np.isfinite(place), axis=-1)
    used = known & fitted
    count = np.maximum(used.sum(axis=1), 1)[:, None]
    place = np.where(np.isfinite(place), place, 0)
    middle = (used[..., None] * place).sum(axis=1) / count
    shift = np.where(used[..., None], moved, 0).sum(axis=1) / count
    arm = place[None] - middle[:, None]
    rest = np.where(known[..., None], moved, 0) - shift[:, None]
    turn = (used * (arm[..., 0] * rest[..., 1] - arm[..., 1] * rest[..., 0])).sum(axis=1)
    turn = turn / np.maximum((used * (arm**2).sum(axis=-1)).sum(axis=1), 1e-9)
    left = rest - turn[:, None, None] * np.stack([-arm[..., 1], arm[..., 0]], axis=-1)
    distance = np.linalg.norm(left, axis=-1)
    return np.where(known & (used.sum(axis=1) >= 2)[:, None], distance, np.nan)


def _mean(values: Float[np.ndarray, "frames markers axes"]) -> Float[np.ndarray, "frames axes"]:
    """Mean over the markers that are known; NaN where none is."""
    known = np.all(np.isfinite(values), axis=-1)
    count = known.sum(axis=1)[:, None]
    total = np.where(known[..., None], values, 0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
