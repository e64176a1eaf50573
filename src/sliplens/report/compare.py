"""What the numbers carry: paired differences with their uncertainty, order, and constant answers."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sliplens.intervals import Difference, bootstrap_difference
from sliplens.report.records import DeletionCurve, Predictions


def compare_errors(first: Predictions, second: Predictions, *, rng: np.random.Generator) -> Difference | None:
    """Difference in MSE of two networks, resampling trials; None unless both answered the very same frames."""
    order_a, order_b = (np.lexsort((one.frame, one.trial)) for one in (first, second))
    same = (
        len(first.trial) == len(second.trial) > 0
        and np.array_equal(first.trial[order_a], second.trial[order_b])
        and np.array_equal(first.frame[order_a], second.frame[order_b])
    )
    if not same:
        return None
    trials, trial_at = np.unique(first.trial[order_a], return_inverse=True)
    sums = np.zeros((3, len(trials)))
    np.add.at(sums[0], trial_at, _squared_error(first)[order_a])
    np.add.at(sums[1], trial_at, _squared_error(second)[order_b])
    np.add.at(sums[2], trial_at, 1.0)
    return bootstrap_difference(sums[0], sums[1], sums[2], rng=rng)


def compare_deletion(first: DeletionCurve, second: DeletionCurve, *, rng: np.random.Generator) -> Difference | None:
    """Difference in D_AUC of two deletion orders, resampling frames; None unless both hold the same frames."""
    if first.frame_ids != second.frame_ids or not first.frame_ids:
        return None
    auc = [curve.scores.mean(axis=1) for curve in (first, second)]
    return bootstrap_difference(auc[0], auc[1], np.ones(len(auc[0])), rng=rng)


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How answers stand to labels: mean absolute error, that of the best constant answer, and pairs in right order."""

    frames: int
    mae: float
    constant_mae: float
    pairs: int
    ordered_pairs: int


def agreement(labels: Float[np.ndarray, " frames"], predictions: Float[np.ndarray, " frames"]) -> Agreement:
    """Compare answers with labels, in margin units.

    The best constant answer is the median of the labels: a network that cannot beat it has read nothing. Pairs with
    equal labels have no order and are left out.
    """
    first, second = np.triu_indices(len(labels), k=1)
    rise, answer = labels[first] - labels[second], predictions[first] - predictions[second]
    return Agreement(
        frames=len(labels),
        mae=float(np.abs(predictions - labels).mean()),
        constant_mae=float(np.abs(labels - np.median(labels)).mean()),
        pairs=int(np.count_nonzero(rise)),
        ordered_pairs=int(np.count_nonzero(rise * answer > 0)),
    )


def _squared_error(predictions: Predictions) -> Float[np.ndarray, " frames"]:
    return (predictions.prediction - predictions.safety_margin) ** 2
