"""Estimators of the safety margin from the marker field: one interface, one row a paper."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import final

import numpy as np
from jaxtyping import Float

from sliplens.errors import InputError
from sliplens.markers.estimators.features import (
    displacement_entropy,
    edge_over_centre,
    helmholtz_hodge,
    mean_shear,
    rigid_residual,
    shear_over_divergence,
    stick_area,
)
from sliplens.markers.estimators.trial import FieldTrial

_RIDGE = 1e-3
_HERTZ = 1.5  # exponent of the sphere, physics of Cattaneo and Mindlin
_TOLERANCES_PX = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5)

Margins = Float[np.ndarray, " frames"]


class MarginEstimator(ABC):
    """Reads the safety margin of every frame of a trial, after it was fitted on others."""

    def fit(self, trials: Sequence[FieldTrial], margins: Sequence[Float[np.ndarray, " _"]]) -> "MarginEstimator":
        """Fit on training trials; gives itself.

        Parameters
        ----------
        trials
            Fields of the trials.
        margins
            Safety margin of each frame of each trial, in [0, 1]; NaN where there is no label.

        Raises
        ------
        InputError
            If no frame is labelled, or a trial has another number of frames than margins.
        """
        if len(trials) != len(margins) or any(len(one) != len(own) for one, own in zip(trials, margins, strict=False)):
            raise InputError("trials and margins do not match; give a margin for every frame of every trial")
        labels = np.concatenate([*margins, np.zeros(0)])
        if not np.isfinite(labels).any():
            raise InputError("no frame of the training trials has a label; give trials with safety margins")
        self._mean = float(np.nanmean(labels))
        self._fit(trials, labels)
        return self

    def estimate(self, trial: FieldTrial) -> Margins:
        """Safety margin of each frame, in [0, 1]; the training mean where the field tells nothing.

        Raises
        ------
        InputError
            If the estimator was not fitted.
        """
        if not hasattr(self, "_mean"):
            raise InputError("the estimator was not fitted; call fit with training trials first")
        value = self._estimate(trial)
        return np.clip(np.where(np.isfinite(value), value, self._mean), 0, 1)

    @abstractmethod
    def _fit(self, trials: Sequence[FieldTrial], labels: Float[np.ndarray, " all_frames"]) -> None: ...

    @abstractmethod
    def _estimate(self, trial: FieldTrial) -> Margins: ...


@final
class Constant(MarginEstimator):
    """The mean margin of the training frames: what a reader without any touch would say."""

    def _fit(self, trials: Sequence[FieldTrial], labels: Float[np.ndarray, " all_frames"]) -> None:
        """Nothing but the mean is needed."""

    def _estimate(self, trial: FieldTrial) -> Margins:
        return np.full(len(trial), self._mean)


@final
class FeatureRegression(MarginEstimator):
    """Ridge regression of the margin on a few numbers of the field, their squares and products.

    Parameters
    ----------
    features
        Gives (frames, features) of a trial.
    """

    def __init__(self, features: Callable[[FieldTrial], np.ndarray]) -> None:
        self._features = features

    def _fit(self, trials: Sequence[FieldTrial], labels: Float[np.ndarray, " all_frames"]) -> None:
        values = np.concatenate([self._features(trial) for trial in trials])
        usable = np.isfinite(labels) & np.all(np.isfinite(values), axis=1)
        if not usable.any():
            raise InputError("no labelled frame of the training trials has a field; follow more markers")
        self._middle, self._scale = values[usable].mean(axis=0), values[usable].std(axis=0) + 1e-9
        terms = self._terms(values[usable])
        normal = terms.T @ terms / len(terms) + _RIDGE * np.eye(terms.shape[1])
        self._weights = np.linalg.solve(normal, terms.T @ (labels[usable] - self._mean) / len(terms))

    def _estimate(self, trial: FieldTrial) -> Margins:
        return self._mean + self._terms(self._features(trial)) @ self._weights

    def _terms(self, values: np.ndarray) -> np.ndarray:
        # what lies far outside the training frames is taken for their border
        unit = np.clip((values - self._middle) / self._scale, -5, 5)
        rows, columns = np.triu_indices(unit.shape[1])
        return np.concatenate([np.ones((len(unit), 1)), unit, unit[:, rows] * unit[:, columns]], axis=1)


@final
class StickArea(MarginEstimator):
    """Sui's share of markers that stick, its tolerance chosen on the training trials.

    References
    ----------
    See `stick_area`; the margin is a quadratic in the share, for the relation depends on the contact's shape: for a
    sphere the area ratio is Gamma^(2/3).
    """

    def _fit(self, trials: Sequence[FieldTrial], labels: Float[np.ndarray, " all_frames"]) -> None:
        tries = []
        margins = np.split(labels, np.cumsum([len(trial) for trial in trials])[:-1])
        for tolerance in _TOLERANCES_PX:
            one = FeatureRegression(partial(stick_area, tolerance_px=tolerance)).fit(trials, margins)
            answer = np.concatenate([one.estimate(trial) for trial in trials])
            tries.append((float(np.nanmean((answer - labels) ** 2)), one))
        self._best = min(tries, key=lambda pair: pair[0])[1]

    def _estimate(self, trial: FieldTrial) -> Margins:
        return self._best.estimate(trial)


@final
class Eccentricity(MarginEstimator):
    """Ikeda's eccentricity e = delta_t / a: how far the contact's middle has moved, for how far it is pressed.

    Gamma = (1 - delta_t / delta_full)^1.5 for a sphere, with delta_full = mu (2 - nu) delta / (2 (1 - nu)): full slip
    begins when the tangential displacement of the stuck middle reaches a multiple of the indentation delta, which for a
    sphere is a^2 over its radius, a being the contact's. Both are read in pixels: delta_t is the mean motion of the
    inner markers since the hold, delta is taken in proportion to the divergence since T_0, and the factor between them,
    which holds the friction, is fitted on the training trials.

    References
    ----------
    Ikeda, Kurita, Ueda, Matsumoto and Ogasawara, *Grip Force Control for an Elastic Finger using Vision-based Incipient
    Slip Feedback*, IROS 2004; Obinata et al., *Vision Based Tactile Sensor Using Transparent Elastic Fingertip for
    Dexterous Handling*, 2007. Johnson, *Contact Mechanics* (1985), section 7.2.
    """

    def _fit(self, trials: Sequence[FieldTrial], labels: Float[np.ndarray, " all_frames"]) -> None:
        ratio = np.concatenate([self._ratio(trial) for trial in trials])
        usable = np.isfinite(labels) & np.isfinite(ratio)
        if not usable.any():
            raise InputError("no labelled frame of the training trials has a field; follow more markers")
        tries = np.geomspace(1e-2, 1e2, 400) * max(float(np.median(ratio[usable])), 1e-3)
        errors = [np.mean((self._margin(ratio[usable], full) - labels[usable]) ** 2) for full in tries]
        self._full = float(tries[int(np.argmin(errors))])

    def _estimate(self, trial: FieldTrial) -> Margins:
        return self._margin(self._ratio(trial), self._full)

    @staticmethod
    def _ratio(trial: FieldTrial) -> Margins:
        moved = trial.increment_px[:, trial.inner]
        known = np.all(np.isfinite(moved), axis=-1)
        count = known.sum(axis=1)
        mean = np.where(known[..., None], moved, 0).sum(axis=1) / np.maximum(count, 1)[:, None]
        pressed = np.maximum(trial.spread, 0.1 * max(float(np.nanmax(trial.spread)), 1e-6))
        return np.where(count > 0, np.linalg.norm(mean, axis=1) / pressed, np.nan)

    @staticmethod
    def _margin(ratio: np.ndarray, full: float) -> np.ndarray:
        return np.clip(1 - ratio / full, 0, 1) ** _HERTZ


ESTIMATORS: dict[str, Callable[[], MarginEstimator]] = {
    "constant": Constant,
    "mean-shear": partial(FeatureRegression, mean_shear),
    "shear-over-divergence": partial(FeatureRegression, shear_over_divergence),
    "ikeda-eccentricity": Eccentricity,
    "sui-stick-area": StickArea,
    "dong-rigid-residual": partial(FeatureRegression, rigid_residual),
    "yuan-entropy": partial(FeatureRegression, displacement_entropy),
    "khamis-edge-centre": partial(FeatureRegression, edge_over_centre),
    "helmholtz-hodge": partial(FeatureRegression, helmholtz_hodge),
}
"""Estimators by name, unfitted: the first three are trivial, the others named for their papers."""


def get_estimator(name: str) -> MarginEstimator:
    """Unfitted estimator of a name.

    Raises
    ------
    InputError
        If there is none.
    """
    if name not in ESTIMATORS:
        raise InputError(f"estimator {name!r} is not known; choose {', '.join(ESTIMATORS)}")
    return ESTIMATORS[name]()
