"""Comparisons that the report makes: errors, deletion scores, gains, and their intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from sliplens.intervals import Difference, bootstrap_difference, paired_difference
from sliplens.plots.style import CONTROL, FILL_NAMES, UNIT_NAMES, in_order, signed
from sliplens.results.evaluation import Predictions
from sliplens.results.faithfulness import DeletionCurve, DeletionScores, RemovalCurve, RemovalScores
from sliplens.results.study import MarkerEffects


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
    errors = (_squared_error(first)[order_a], _squared_error(second)[order_b], np.ones(len(trial_at)))
    sums = (np.bincount(trial_at, weights=one, minlength=len(trials)) for one in errors)
    return bootstrap_difference(*sums, rng=rng)


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


def against_control(scored: DeletionScores, method: str, *, rng: np.random.Generator) -> Difference | None:
    """Difference of a method's D_AUC from the random control's; None for the control itself or without one."""
    if method == CONTROL or not {method, CONTROL} <= set(scored.curves):
        return None
    return compare_deletion(scored.curves[method], scored.curves[CONTROL], rng=rng)


def compare_gain(first: RemovalCurve, second: RemovalCurve, *, rng: np.random.Generator) -> Difference | None:
    """Symmetric relevance gain of the first less that of the second, over the frames both have; None without any."""
    _, here, there = np.intersect1d(first.frame_ids, second.frame_ids, return_indices=True)
    if len(here) == 0:
        return None
    return paired_difference(first.srg[here], second.srg[there], trials=first.trials[here], rng=rng)


def compare_mean_gain(
    firsts: Sequence[RemovalCurve], seconds: Sequence[RemovalCurve], *, rng: np.random.Generator
) -> Difference | None:
    """Compare as `compare_gain` does, the gain of each frame averaged over several methods first, in the same order."""
    shared = sorted(set.intersection(*(set(curve.frame_ids) for curve in (*firsts, *seconds))))
    if not shared:
        return None
    means = [
        np.mean([curve.srg[np.searchsorted(curve.frame_ids, shared)] for curve in curves], axis=0)
        for curves in (firsts, seconds)
    ]
    trials = firsts[0].trials[np.searchsorted(firsts[0].frame_ids, shared)]
    return paired_difference(means[0], means[1], trials=trials, rng=rng)


def reversed_gap(gap: Difference) -> Difference:
    """Difference of the second less the first."""
    return Difference(estimate=-gap.estimate, low=-gap.high, high=-gap.low, units=gap.units)


def gain_over_chance(curve: RemovalCurve, *, rng: np.random.Generator) -> Difference:
    """Symmetric relevance gain with its interval: a map that tells nothing has 0."""
    return paired_difference(curve.srg, np.zeros(len(curve.frame_ids)), trials=curve.trials, rng=rng)


def compare_thesis_score(
    first: DeletionCurve, second: DeletionCurve, trials: dict[str, str], *, rng: np.random.Generator
) -> Difference | None:
    """Deletion score of the first less that of the second, over the frames whose trial is known; None without any."""
    ids, here, there = np.intersect1d(first.frame_ids, second.frame_ids, return_indices=True)
    known = np.array([name in trials for name in ids], dtype=bool)
    if not known.any():
        return None
    means = [one.scores.mean(axis=1)[rows[known]] for one, rows in ((first, here), (second, there))]
    names = np.array([trials[name] for name in ids[known]])
    return paired_difference(means[0], means[1], trials=names, rng=rng)


def share_of_strongest(effects: MarkerEffects, *, count: int, rng: np.random.Generator) -> Difference | None:
    """Share of a network's effects, in size, that its strongest markers hold; trials are resampled.

    None where no marker has any effect.
    """
    ids, first, member = np.unique(effects.frame_id, return_index=True, return_inverse=True)
    shares, kept = [], []
    for frame in range(len(ids)):
        sizes = np.sort(np.abs(effects.network[member == frame]))[::-1]
        if sizes.sum() > 0:
            shares.append(sizes[:count].sum() / sizes.sum())
            kept.append(effects.trial[first[frame]])
    if not shares:
        return None
    return paired_difference(np.array(shares), np.zeros(len(shares)), trials=np.array(kept), rng=rng)


def settings(faithful: RemovalScores) -> list[tuple[str, str]]:
    """Fills and units that were scored, in the order they are read."""
    found = {(fill, unit) for fill, unit, _ in faithful.curves}
    fills = in_order({fill for fill, _ in found}, FILL_NAMES)
    units = in_order({unit for _, unit in found}, UNIT_NAMES)
    return [(fill, unit) for unit in units for fill in fills if (fill, unit) in found]


def controls(faithful: RemovalScores) -> set[str]:
    """Names of the maps that know nothing of the network."""
    return {score.method for score in faithful.scores if score.control}


def best_control(faithful: RemovalScores, fill: str, unit: str) -> str | None:
    """Name the control with the highest gain under a fill and unit."""
    known = [name for name in sorted(controls(faithful)) if (fill, unit, name) in faithful.curves]
    return max(known, key=lambda name: float(faithful.curves[fill, unit, name].srg.mean()), default=None)


def mean_at(curve: RemovalCurve, area: float) -> tuple[float, float]:
    """Mean change where a share of the image is gone: most influential first, and in random order."""
    places: Float64[np.ndarray, " areas"] = curve.areas
    most, chance = (float(np.interp(area, places, values.mean(axis=0))) for values in (curve.most_first, curve.random))
    return most, chance


def tell_interval(gap: Difference, *, digits: int = 3, scale: float = 1.0) -> str:
    """Write an estimate with its 95 % interval."""
    values: Float[np.ndarray, 3] = scale * np.array([gap.estimate, gap.low, gap.high])
    return f"{signed(values[0], digits)} ({signed(values[1], digits)} to {signed(values[2], digits)})"


def tell_bounds(gap: Difference, *, digits: int = 3) -> str:
    """Write the ends of a 95 % interval."""
    return f"{signed(gap.low, digits)} to {signed(gap.high, digits)}"
