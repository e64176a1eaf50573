"""Comparisons that the report makes: errors, deletion scores, gains, and their intervals over days and trials.

Beside them stand figures of the thesis: real touch of a real sensor, so other data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, Tables 1 and 2; Table 2 with
the third digit of the recorded scores, the seconds on an RTX 3060 Ti and without device synchronisation.
"""

from collections.abc import Collection, Iterable
from dataclasses import replace
from functools import partial

import numpy as np

from sliplens.intervals import Difference, mean_interval, paired_difference
from sliplens.plots import style
from sliplens.progress import number_of
from sliplens.results.evaluation import ScoredFrames
from sliplens.results.faithfulness import CHANCE, DeletionCurve, DeletionScores, Faithfulness, MethodGap, RemovalCurve
from sliplens.results.study import Choice, MarkerEffects, Truth

CITATION = (
    "Max Polak, Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning, Master's thesis, "
    "Delft University of Technology"
)
MARK = "thesis (real touch, other data)"
NETWORK_PIXELS = 224

AS_RUN = "-thesis"
"""Ends the names of the methods that are run as the thesis ran them."""


def thesis_row(method: str, among: Collection[str]) -> str | None:
    """Name the method of the thesis that one of ours stands beside; None if there is none.

    Its methods stand beside ours run as in the thesis, and beside our own only where those were not among those run.
    """
    return None if method + AS_RUN in among else method.removesuffix(AS_RUN)


ACCURACY: dict[tuple[str, str], tuple[float, float]] = {
    ("raw", "dry"): (1.87e-2, 0.85),
    ("raw", "wet"): (5.07e-2, 0.57),
    ("difference", "dry"): (1.44e-2, 0.89),
    ("difference", "wet"): (4.02e-2, 0.66),
}
"""MSE in squared margin units and R2, by input and condition."""

DELETION: dict[tuple[str, str], tuple[float, float]] = {
    ("difference", "grad-cam"): (0.325, 0.106),
    ("difference", "integrated-gradients"): (0.272, 0.158),
    ("difference", "poly-cam"): (0.200, 0.146),
    ("raw", "grad-cam"): (0.539, 0.101),
    ("raw", "integrated-gradients"): (0.677, 0.118),
    ("raw", "poly-cam"): (0.512, 0.203),
}
"""Mean and standard deviation of D_AUC, by input and method."""

SECONDS: dict[str, float] = {"grad-cam": 0.029, "integrated-gradients": 0.27, "poly-cam": 4.9}
"""Seconds an image, by method."""


def compare_errors(first: ScoredFrames, second: ScoredFrames, *, rng: np.random.Generator) -> Difference | None:
    """Difference in MSE of two networks, over days and trials; None unless both answered the very same frames."""
    record, other = (rows.where(np.lexsort((rows.frame, rows.trial))) for rows in (first, second))
    if not len(record.trial) or any(
        not np.array_equal(getattr(record, key), getattr(other, key)) for key in ("trial", "frame")
    ):
        return None
    errors = [(rows.prediction - rows.safety_margin) ** 2 for rows in (record, other)]
    return paired_difference(errors[0], errors[1], clusters=[record.day, record.trial], rng=rng)


def compare_deletion(first: DeletionCurve, second: DeletionCurve, *, rng: np.random.Generator) -> Difference | None:
    """Difference in D_AUC of two deletion orders, over the frames that both hold; None without any."""
    ids, here, there = np.intersect1d(first.frame_ids, second.frame_ids, return_indices=True)
    if not len(ids):
        return None
    auc = [curve.scores.mean(axis=1)[rows] for curve, rows in ((first, here), (second, there))]
    return paired_difference(auc[0], auc[1], clusters=first.clusters[:, here], rng=rng)


def against_control(scored: DeletionScores, method: str, *, rng: np.random.Generator) -> Difference | None:
    """Difference of a method's D_AUC from the random control's; None for the control itself or without one."""
    if method == CHANCE or not {method, CHANCE} <= set(scored.curves):
        return None
    return compare_deletion(scored.curves[method], scored.curves[CHANCE], rng=rng)


def compare_gain(*pairs: tuple[RemovalCurve, RemovalCurve], rng: np.random.Generator) -> Difference | None:
    """Symmetric relevance gain of the first less that of the second, over the frames all have; None without any.

    Of several pairs, such as those of several methods, the gains of each frame are averaged first.
    """
    shared = sorted(set.intersection(*(set(curve.frame_ids) for pair in pairs for curve in pair)))
    if not shared:
        return None
    first, second = (
        np.mean([curve.symmetric_gain[np.searchsorted(curve.frame_ids, shared)] for curve in curves], axis=0)
        for curves in zip(*pairs, strict=True)
    )
    assert pairs[0][0].clusters is not None  # of a saved table
    clusters = pairs[0][0].clusters[:, np.searchsorted(pairs[0][0].frame_ids, shared)]
    return paired_difference(first, second, clusters=clusters, rng=rng)


def gap_from(compared: MethodGap, method: str) -> Difference:
    """Difference of a method, one of the two that were compared, less the other."""
    gap = compared.gap
    if compared.first == method:
        return gap
    low, high = (None if end is None else -end for end in (gap.high, gap.low))
    return replace(gap, estimate=-gap.estimate, low=low, high=high)


def share_of_strongest(effects: MarkerEffects, *, count: int, rng: np.random.Generator) -> Difference | None:
    """Share of a network's effects, in size, that its strongest markers hold; over days and trials.

    None where no marker has any effect.
    """
    shares, clusters = [], []
    for frame in effects.groups("frame_id").values():
        sizes = np.sort(np.abs(frame.network))[::-1]
        if sizes.sum() > 0:
            shares.append(sizes[:count].sum() / sizes.sum())
            clusters.append((str(frame.day[0]), frame.trial[0]))
    if not shares:
        return None
    return mean_interval(np.array(shares), clusters=np.array(clusters).T, rng=rng, limits=(0.0, 1.0))


def settings(faithful: Faithfulness) -> list[tuple[str, str]]:
    """Fills and units that were scored, in the order they are read."""
    records = {(fill, unit) for fill, unit, _ in faithful.curves}
    fills = style.in_order({fill for fill, _ in records}, style.FILL_NAMES)
    units = style.in_order({unit for _, unit in records}, style.UNIT_NAMES)
    return [(fill, unit) for unit in units for fill in fills if (fill, unit) in records]


def voting_settings(faithful: Faithfulness, *truths: Truth | None) -> list[tuple[str, str]]:
    """One setting of each fill, or a fill tried with several units would vote as often: that by pixels where it is.

    Fills under which a map made from one of the truths does not win for sure have no vote.
    """
    units = {fill: (fill, unit) for fill, unit in reversed(settings(faithful))}
    unfit = {fill for truth in truths for fill in unfit_fills(truth)}
    return [setting for setting in settings(faithful) if units[setting[0]] == setting and setting[0] not in unfit]


def unfit_fills(truth: Truth | None) -> list[str]:
    """Fills under which a map made from the truth does not win for sure: they cannot judge a map."""
    return [] if truth is None else [test.fill for test in truth.meta if not test.holds]


def removal_by_setting(faithful: Faithfulness) -> list[tuple[str, dict[str, RemovalCurve]]]:
    """Name of each fill and unit, and its curves by method, in the order they are read."""
    return [
        (style.fill_name(*setting), {key[2]: curve for key, curve in faithful.curves.items() if key[:2] == setting})
        for setting in settings(faithful)
    ]


def tell_sample(choice: Choice, name: str = "") -> str:
    """Write how wrong the explained answers are, and how many trials are read well enough; of one network, if named."""
    names = [name] if name in choice.mean_error else style.inputs_in_order(choice.mean_error)[::-1]
    several = len(names) > 1
    errors = [
        f"{100 * choice.mean_error[name]:.0f} points" + (f" ({style.input_name(name).lower()})" if several else "")
        for name in names
    ]
    alone = [f"{choice.qualified_alone[name]} with {style.input_name(name).lower()}" for name in names]
    text = f", {style.listed(alone)} alone" if len(choice.inputs) > 1 else ""
    return (
        f"The sample explains answers that are off by {style.listed(errors)} on average; {choice.qualified} of "
        f"{number_of(choice.considered, 'trial')} qualified at ±{100 * choice.tolerance:g} points{text}."
    )


def tell_over(gaps: Iterable[Difference | None]) -> str:
    """Write what intervals of a table were taken over: "14 trials, one day, one network"."""
    return next((gap.over for gap in gaps if gap is not None), "trials")


def tell_interval(gap: Difference, *, digits: int = 3) -> str:
    """Write an estimate with its 95 % interval."""
    return f"{style.signed(gap.estimate, digits)} ({tell_bounds(gap, digits=digits)})"


def tell_bounds(gap: Difference, *, digits: int = 3) -> str:
    """Write the ends of a 95 % interval, or that there is none."""
    return style.tell_ends(gap, partial(style.signed, digits=digits))
