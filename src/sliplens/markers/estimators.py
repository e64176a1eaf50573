"""Estimators of the safety margin from the marker field: one interface, one row a paper."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import InputError
from sliplens.extras import pick
from sliplens.markers.tracks import Tracks

_FEWEST = 6
_PRESSED_SHARE = 0.9  # of the trial's largest spread, at which the press is complete, creep aside
_PULL_PX = 0.2  # of the inner markers' mean motion: several times its noise
INNER_SHARE = 1 / 3  # of the markers: what surely touches


@dataclass(frozen=True, kw_only=True)
class FieldTrial:
    """Displacements of one trial, of at least 6 markers; pixel coordinates are (x, y)."""

    rest_px: Float[np.ndarray, "_ 2"]
    displacement_px: Float[np.ndarray, "_ _ 2"]
    """Displacement from T_0, by frame and marker; NaN where a marker was not followed."""
    hold: int
    """Last frame before the pull, from which the motion of a slip is measured."""

    def __post_init__(self) -> None:
        if len(self.rest_px) < _FEWEST:
            raise InputError(f"{len(self.rest_px)} markers are too few to detect slip, at least {_FEWEST} are needed")
        if self.displacement_px.shape[1:] != self.rest_px.shape:
            raise InputError(
                f"{len(self.rest_px)} markers at rest but displacements of {self.displacement_px.shape[1]}; give both "
                "for the same markers"
            )
        if not 0 <= self.hold < len(self.displacement_px):
            raise InputError(f"frame {self.hold} of the hold is not one of {len(self.displacement_px)}")

    def __len__(self) -> int:
        return len(self.displacement_px)

    @property
    def increment_px(self) -> Float[np.ndarray, "frames markers 2"]:
        """Displacement since the hold; 0 before."""
        moved = self.displacement_px - self.displacement_px[self.hold]
        moved[: self.hold] = np.where(np.isnan(moved[: self.hold]), np.nan, 0.0)
        return moved

    @property
    def spread(self) -> Float[np.ndarray, " frames"]:
        """Divergence of the field since T_0, in pixels per pixel: how much the skin is stretched."""
        return affine_parts(self.rest_px, self.displacement_px)[:, 2]

    @property
    def inner(self) -> Bool[np.ndarray, " markers"]:
        """Third of the markers nearest to the fixed point of the press."""
        return _rank(self.rest_px, self.displacement_px[self.hold]) < INNER_SHARE

    @property
    def contact(self) -> Bool[np.ndarray, " markers"]:
        """Two thirds of the markers nearest to that point: those inside and the edge of the contact."""
        return _rank(self.rest_px, self.displacement_px[self.hold]) < 2 * INNER_SHARE


def _rank(
    rest_px: Float[np.ndarray, "markers 2"], pressed_px: Float[np.ndarray, "markers 2"]
) -> Float[np.ndarray, " markers"]:
    """Rank markers by their distance from the fixed point of the press."""
    parts = affine_parts(rest_px, pressed_px[None])
    return rank_from_centre(rest_px[None], mean_px=parts[:, :2], divergence=parts[:, 2])[0]


def rank_from_centre(
    rest_px: Float[np.ndarray, "fields markers 2"],
    *,
    mean_px: Float[np.ndarray, "fields 2"],
    divergence: Float[np.ndarray, " fields"],
) -> Float[np.ndarray, "fields markers"]:
    """Rank markers, 0 to 1, by their distance from where pressing moved nothing: the centre of the contact.

    Mean and divergence are those of the affine fit (`affine_parts`); without a divergence the middle of the markers is
    the centre.
    """
    middle = rest_px.mean(axis=1)
    reach = np.abs(rest_px - middle[:, None]).max(axis=(1, 2))[:, None] / 2
    spreads = np.abs(np.nan_to_num(divergence)) >= 1e-3
    shift = 2 * mean_px / np.where(spreads, divergence, 1)[:, None]
    centre = middle - np.where(spreads[:, None], np.clip(shift, -reach, reach), 0)
    distance = np.linalg.norm(rest_px - centre[:, None], axis=2)
    return np.argsort(np.argsort(distance, axis=1, kind="stable"), axis=1, kind="stable") / distance.shape[1]


def affine_parts(
    rest_px: Float[np.ndarray, "markers 2"], displacement_px: Float[np.ndarray, "frames markers 2"]
) -> Float[np.ndarray, "frames 6"]:
    """Compute the least-squares parts of a field: mean x and y, divergence, curl, and the two parts of pure shear.

    It is the Helmholtz-Hodge decomposition of an affine field about the middle of the markers. Means are in pixels, the
    rest in pixels per pixel; NaN where fewer than 3 markers are followed.

    References
    ----------
    Zhang, Kan, Yang, Tse and Wang, *Effective Estimation of Contact Force and Torque for Vision-based Tactile Sensor
    with Helmholtz-Hodge Decomposition*, 2019.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.markers.estimators import affine_parts
    >>> rest_px = np.array([[0.0, 0], [10, 0], [0, 10], [10, 10]])
    >>> moved_px = np.array([3.0, 0]) + 0.05 * (rest_px - 5)  # 3 px to the right, and 5 % larger both ways
    >>> affine_parts(rest_px, moved_px[None]).round(3)[0, :4]  # mean x and y, divergence, curl
    array([3. , 0. , 0.1, 0. ])
    """
    offset = rest_px - rest_px.mean(axis=0)
    terms = np.concatenate([np.ones((len(offset), 1)), offset], axis=1)
    followed = np.all(np.isfinite(displacement_px), axis=-1)
    weighted = terms[None] * followed[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ terms + 1e-9 * np.eye(3)
    fit = np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ np.where(followed[..., None], displacement_px, 0))
    (mean_x, mean_y), (xx, yx), (xy, yy) = (fit[:, row].T for row in range(3))
    parts = np.stack([mean_x, mean_y, xx + yy, yx - xy, xx - yy, xy + yx], axis=1)
    return np.where(followed.sum(axis=1)[:, None] >= 3, parts, np.nan)


def find_hold(rest_px: Float[np.ndarray, "markers 2"], displacement_px: Float[np.ndarray, "frames markers 2"]) -> int:
    """Find the last frame before the pull of a whole trial.

    The sensor is pressed then, and the inner markers have not yet moved by 0.2 px on average. Pressing ends where the
    divergence first reaches nine tenths of its largest; without a press the first frame is the hold.
    """
    spread = np.nan_to_num(affine_parts(rest_px, displacement_px)[:, 2], nan=-np.inf)
    if spread.max() <= 0:
        return 0
    first = int(np.argmax(spread >= _PRESSED_SHARE * spread.max()))
    inner = _rank(rest_px, displacement_px[first]) < INNER_SHARE
    moved = affine_parts(rest_px[inner], displacement_px[first:, inner] - displacement_px[first, inner])[:, :2]
    pulled = np.flatnonzero(np.linalg.norm(moved, axis=1) > _PULL_PX)
    return max(first + int(pulled[0]) - 1, first) if len(pulled) else first


def field_trial(tracks: Tracks, *, hold: int | None = None) -> FieldTrial:
    """Select the displacements of a tracked trial; its hold is found by `find_hold` if None."""
    rest, displacement = tracks.rest_px, tracks.displacement_px
    hold = find_hold(rest, displacement) if hold is None else hold
    return FieldTrial(rest_px=rest, displacement_px=displacement, hold=hold)


_BINS, _BIN_PX = 48, 0.25
_STILL_PX = 0.05  # added to motions in a denominator: half the noise of a marker


def mean_shear(trial: FieldTrial, *, inner: bool = False, relative: bool = False) -> Float[np.ndarray, "frames 1"]:
    """Compute the mean motion of all markers since the hold, or of the inner ones, in pixels.

    `relative`: over the divergence, of which at least a tenth of the trial's largest counts.
    """
    moved = trial.increment_px[:, trial.inner] if inner else trial.increment_px
    shear = np.linalg.norm(_mean(moved), axis=-1)[:, None]
    if not relative:
        return shear
    spread = trial.spread
    return shear / np.maximum(spread, 0.1 * np.fmax(np.nanmax(spread), 1e-6))[:, None]


def rigid_residual(trial: FieldTrial) -> Float[np.ndarray, "frames 2"]:
    """Compute the largest and rms distance of the contact's markers from a rigid motion t + w x r, in pixels.

    Dong, Ma, Donlon and Rodriguez, *Maintaining Grasps within Slipping Bounds by Monitoring Incipient Slip*, ICRA 2019.
    """
    # the paper uses the largest alone; a bad marker moves the root mean square less
    distance = _from_rigid(trial, trial.contact)
    tracked = np.isfinite(distance).any(axis=1)
    largest, rms = np.full(len(trial), np.nan), np.full(len(trial), np.nan)
    largest[tracked] = np.nanmax(distance[tracked], axis=1)
    rms[tracked] = np.sqrt(np.nanmean(distance[tracked] ** 2, axis=1))
    return np.stack([largest, rms], axis=1)


def stick_area(trial: FieldTrial, *, tolerance_px: float) -> Float[np.ndarray, "frames 1"]:
    """Share of the contact's markers that move with the rigid motion of its middle.

    Sui et al., *Incipient Slip Detection Method for Soft Objects with Vision-Based Tactile Sensor*, Measurement 2022.
    """
    distance = _from_rigid(trial, trial.inner)
    tracked = np.isfinite(distance) & trial.contact
    count = tracked.sum(axis=1)
    share = ((distance < tolerance_px) & tracked).sum(axis=1) / np.maximum(count, 1)
    return np.where(count > 0, share, np.nan)[:, None]


def displacement_entropy(trial: FieldTrial) -> Float[np.ndarray, "frames 2"]:
    """Compute the entropy H = -sum p ln p of the histogram of motions since the hold, and its change by frame.

    Yuan, Li, Srinivasan and Adelson, *Measurement of Shear and Slip with a GelSight Tactile Sensor*, ICRA 2015; for the
    rate Hu et al., *Learning to Detect Slip through Tactile Estimation of the Contact Force Field and its Entropy*,
    arXiv:2303.00935.
    """
    # the last bin is open: a width chosen from the trial's largest motion would depend on later frames
    bins = np.minimum(np.linalg.norm(trial.increment_px, axis=-1) / _BIN_PX, _BINS - 1)
    entropy = np.full(len(trial), np.nan)
    for frame, row in enumerate(bins):
        binned = row[np.isfinite(row)].astype(int)
        if len(binned):
            share = np.bincount(binned, minlength=_BINS) / len(binned)
            entropy[frame] = -np.sum(share[share > 0] * np.log(share[share > 0]))
    return np.stack([entropy, np.diff(entropy, prepend=entropy[:1])], axis=1)


def edge_over_centre(trial: FieldTrial) -> Float[np.ndarray, "frames 2"]:
    """Compute the motion of the contact's edge over that of its middle since the hold, and the latter in pixels.

    Khamis, Albero, Salerno, Idil, Loizou and Redmond, *PapillArray: An incipient slip sensor for dexterous robotic or
    prosthetic manipulation*, Sensors and Actuators A 2018.
    """
    moved = trial.increment_px
    way = _mean(moved)
    way = way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), _STILL_PX)
    along = (moved * way[:, None]).sum(axis=-1)
    middle, edge = (_mean(along[:, zone, None])[:, 0] for zone in (trial.inner, trial.contact & ~trial.inner))
    return np.stack([(edge + _STILL_PX) / (np.maximum(middle, 0) + _STILL_PX), middle], axis=1)


def helmholtz_hodge(trial: FieldTrial) -> Float[np.ndarray, "frames 8"]:
    """Compute divergence and curl since T_0, the parts and the middle of the motion since the hold, and a ratio."""
    whole, since = (affine_parts(trial.rest_px, field) for field in (trial.displacement_px, trial.increment_px))
    scale = float(np.linalg.norm(trial.rest_px - trial.rest_px.mean(axis=0), axis=1).max())
    shift = np.linalg.norm(since[:, :2], axis=1)
    deviator = np.hypot(since[:, 4], since[:, 5])
    shapes = np.stack([whole[:, 2], whole[:, 3], since[:, 2], since[:, 3], deviator], axis=1) * scale
    ratio = shift / np.maximum(shapes[:, 0], 1.0)
    return np.concatenate([shapes, shift[:, None], mean_shear(trial, inner=True), ratio[:, None]], axis=1)


def _from_rigid(trial: FieldTrial, fitted: Bool[np.ndarray, " markers"]) -> Float[np.ndarray, "frames markers"]:
    """Compute the distance of each motion since the hold from the best-fitting small rigid motion of some markers."""
    moved, place = trial.increment_px, trial.rest_px + trial.displacement_px[trial.hold]
    tracked = np.all(np.isfinite(moved), axis=-1) & np.all(np.isfinite(place), axis=-1)
    used = tracked & fitted
    count = np.maximum(used.sum(axis=1), 1)[:, None]
    place = np.where(np.isfinite(place), place, 0)
    middle = (used[..., None] * place).sum(axis=1) / count
    shift = np.where(used[..., None], moved, 0).sum(axis=1) / count
    arm = place[None] - middle[:, None]
    rest = np.where(tracked[..., None], moved, 0) - shift[:, None]
    turn = (used * (arm[..., 0] * rest[..., 1] - arm[..., 1] * rest[..., 0])).sum(axis=1)
    turn = turn / np.maximum((used * (arm**2).sum(axis=-1)).sum(axis=1), 1e-9)
    residual = rest - turn[:, None, None] * np.stack([-arm[..., 1], arm[..., 0]], axis=-1)
    distance = np.linalg.norm(residual, axis=-1)
    return np.where(tracked & (used.sum(axis=1) >= 2)[:, None], distance, np.nan)


def _mean(values: Float[np.ndarray, "frames markers axes"]) -> Float[np.ndarray, "frames axes"]:
    """Compute the mean over the followed markers; NaN without any."""
    tracked = np.all(np.isfinite(values), axis=-1)
    count = tracked.sum(axis=1)[:, None]
    total = np.where(tracked[..., None], values, 0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


_RIDGE = 1e-3
_HERTZ = 1.5  # exponent of the sphere, physics of Cattaneo and Mindlin
_TOLERANCES_PX = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5)

Margins: TypeAlias = Float[np.ndarray, " frames"]
Trials: TypeAlias = Sequence[FieldTrial]
Reader: TypeAlias = Callable[[FieldTrial], Margins]
"""Estimates the margin of each frame."""


def _bounded(margin: Margins, mean: float) -> Margins:
    return np.clip(np.where(np.isfinite(margin), margin, mean), 0, 1)


def _usable(labels: Margins, features: Float[np.ndarray, "frames features"]) -> Bool[np.ndarray, " frames"]:
    """Select labelled frames with finite features."""
    usable = np.isfinite(labels) & np.all(np.isfinite(features), axis=1)
    if not usable.any():
        raise InputError("no labelled frame of the training trials has a field; follow more markers")
    return usable


def _learn_features(features: Callable[[FieldTrial], np.ndarray], trials: Trials, labels: Margins) -> Reader:
    """Learn a ridge regression of the margin on features of the field, their squares and products."""
    values, mean = np.concatenate([features(trial) for trial in trials]), np.nanmean(labels)
    usable = _usable(labels, values)
    middle, scale = values[usable].mean(axis=0), values[usable].std(axis=0) + 1e-9
    rows, columns = np.triu_indices(values.shape[1])

    def terms(values: np.ndarray) -> np.ndarray:
        # features far outside the training frames are clipped to their border
        unit = np.clip((values - middle) / scale, -5, 5)
        return np.concatenate([np.ones((len(unit), 1)), unit, unit[:, rows] * unit[:, columns]], axis=1)

    rows_used = terms(values[usable])
    normal = rows_used.T @ rows_used / len(rows_used) + _RIDGE * np.eye(rows_used.shape[1])
    weights = np.linalg.solve(normal, rows_used.T @ (labels[usable] - mean) / len(rows_used))
    return lambda trial: mean + terms(features(trial)) @ weights


def _learn_stick_area(trials: Trials, labels: Margins) -> Reader:
    """Learn a quadratic in Sui's share of sticking markers, its tolerance chosen on the training trials."""
    # the relation depends on the contact's shape: for a sphere the area ratio is Gamma^(2/3)
    mean = float(np.nanmean(labels))
    readers = [
        _learn_features(partial(stick_area, tolerance_px=tolerance), trials, labels) for tolerance in _TOLERANCES_PX
    ]
    answers = [_bounded(np.concatenate([read(trial) for trial in trials]), mean) for read in readers]
    return readers[int(np.argmin([np.nanmean((answer - labels) ** 2) for answer in answers]))]


def _learn_eccentricity(trials: Trials, labels: Margins) -> Reader:
    """Learn from Ikeda's eccentricity e = delta_t / a: motion of the contact's middle over its indentation.

    Gamma = (1 - delta_t / delta_full)^1.5 for a sphere, with delta_full = mu (2 - nu) delta / (2 (1 - nu)): full slip
    begins when the tangential displacement of the stuck middle reaches a multiple of the indentation delta. delta_t is
    the mean motion of the inner markers since the hold, delta is in proportion to the divergence since T_0, and the
    factor between them, which holds the friction, is fitted on the training trials.

    Ikeda, Kurita, Ueda, Matsumoto and Ogasawara, *Grip Force Control for an Elastic Finger using Vision-based Incipient
    Slip Feedback*, IROS 2004; Obinata et al., *Vision Based Tactile Sensor Using Transparent Elastic Fingertip for
    Dexterous Handling*, 2007. Johnson, *Contact Mechanics* (1985), section 7.2.
    """
    eccentricity = partial(mean_shear, inner=True, relative=True)
    ratio = np.concatenate([eccentricity(trial) for trial in trials])[:, 0]
    usable = _usable(labels, ratio[:, None])
    tries = np.geomspace(1e-2, 1e2, 400) * max(float(np.median(ratio[usable])), 1e-3)
    errors = [np.mean((_hertz(ratio[usable], full) - labels[usable]) ** 2) for full in tries]
    return lambda trial: _hertz(eccentricity(trial)[:, 0], tries[int(np.argmin(errors))])


def _hertz(ratio: Margins, full: float) -> Margins:
    return np.clip(1 - ratio / full, 0, 1) ** _HERTZ


ESTIMATORS: dict[str, Callable[[Trials, Margins], Reader]] = {
    "constant": lambda _, labels: lambda trial: np.full(len(trial), np.nanmean(labels)),
    "mean-shear": partial(_learn_features, mean_shear),
    "shear-over-divergence": partial(_learn_features, partial(mean_shear, relative=True)),
    "ikeda-eccentricity": _learn_eccentricity,
    "sui-stick-area": _learn_stick_area,
    "dong-rigid-residual": partial(_learn_features, rigid_residual),
    "yuan-entropy": partial(_learn_features, displacement_entropy),
    "khamis-edge-centre": partial(_learn_features, edge_over_centre),
    "helmholtz-hodge": partial(_learn_features, helmholtz_hodge),
}
"""Fits of each estimator to trials and their margins: the first three trivial, the others named after papers. All need
the hold of the whole trial."""


def fit_estimator(name: str, trials: Trials, margins: Sequence[Float[np.ndarray, " _"]]) -> Reader:
    """Fit an estimator, a row of `ESTIMATORS`, on trials and the margin of each of their frames, in [0, 1] or NaN.

    The function that is returned estimates the margin of each frame of a trial, in [0, 1]: the mean of the training
    trials where the field has no information.
    """
    learn = pick(ESTIMATORS, name, noun="estimator")
    if len(trials) != len(margins) or any(map(lambda trial, labels: len(trial) != len(labels), trials, margins)):
        raise InputError("trials and margins do not match; give a margin for every frame of every trial")
    labels = np.concatenate([*margins, np.zeros(0)])
    if not np.isfinite(labels).any():
        raise InputError("no frame of the training trials has a label; give trials with safety margins")
    read, mean = learn(trials, labels), float(np.nanmean(labels))
    return lambda trial: _bounded(read(trial), mean)
