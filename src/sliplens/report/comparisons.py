"""Comparisons that the report makes, their intervals over days and trials, and figures of the thesis.

The thesis's figures are of real touch on another sensor, so other data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, Tables 1 and 2; Table 2 with
the third digit of the recorded scores, the seconds on an RTX 3060 Ti and without device synchronisation.
"""

from collections.abc import Collection, Iterable
from functools import partial

import numpy as np

from sliplens.intervals import Difference, paired_difference
from sliplens.plots import style
from sliplens.progress import number_of
from sliplens.results.evaluation import ScoredFrames
from sliplens.results.faithfulness import Faithfulness
from sliplens.results.study import Choice, Truth

CITATION = (
    "Max Polak, Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning, Master's thesis, "
    "Delft University of Technology"
)
MARK = "thesis (real touch, other data)"
NETWORK_PIXELS = 224

AS_RUN = "-thesis"
"""Ends the names of the methods that are run as the thesis ran them."""

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


def thesis_row(method: str, among: Collection[str]) -> str:
    """Name the thesis's method that a method stands beside; empty if there is none.

    The thesis's numbers stand beside the methods run as in the thesis, and beside ours only where those were not run.
    """
    return "" if method + AS_RUN in among else method.removesuffix(AS_RUN)


def compare_errors(first: ScoredFrames, second: ScoredFrames, *, rng: np.random.Generator) -> Difference | None:
    """Difference in MSE of two networks, over days and trials; None unless both predicted the same frames."""
    first, second = (rows.where(np.lexsort((rows.frame, rows.trial))) for rows in (first, second))
    same = [np.array_equal(getattr(first, key), getattr(second, key)) for key in ("trial", "frame")]
    if not len(first.trial) or not all(same):
        return None
    errors = [(rows.prediction - rows.safety_margin) ** 2 for rows in (first, second)]
    return paired_difference(errors[0], errors[1], clusters=[first.day, first.trial], rng=rng)


def settings(faithful: Faithfulness) -> list[tuple[str, str]]:
    """Fills and units that were scored, in the order they are read."""
    scored = {(fill, unit) for fill, unit, _ in faithful.curves}
    fills = style.in_order({fill for fill, _ in scored}, style.FILL_NAMES)
    units = style.in_order({unit for _, unit in scored}, style.UNIT_NAMES)
    return [(fill, unit) for unit in units for fill in fills if (fill, unit) in scored]


def voting_settings(faithful: Faithfulness, *truths: Truth | None) -> list[tuple[str, str]]:
    """One setting of each fill, by pixels where it is: a fill tried with several units would vote as often.

    Fills under which a map made from one of the truths does not win for sure cannot judge a map and have no vote.
    """
    scored = settings(faithful)
    units = {fill: (fill, unit) for fill, unit in reversed(scored)}
    unfit = {test.fill for truth in truths if truth is not None for test in truth.meta if not test.holds}
    return [setting for setting in scored if units[setting[0]] == setting and setting[0] not in unfit]


def write_sample(choice: Choice) -> str:
    """Write how wrong the explained predictions are, and how many trials qualify."""
    names = style.inputs_in_order(choice.mean_error)[::-1]
    errors = [f"{100 * choice.mean_error[name]:.0f} points ({style.input_name(name).lower()})" for name in names]
    return (
        f"The sample explains predictions that are off by {style.listed(errors)} on average; {choice.qualified} of "
        f"{number_of(choice.considered, 'trial')} qualified at ±{100 * choice.tolerance:g} points."
    )


def write_units(gaps: Iterable[Difference | None]) -> str:
    """Write what the intervals of a table were taken over: "14 trials, one day, one network"."""
    return next((gap.over for gap in gaps if gap is not None), "trials")


def write_ends(gap: Difference | None, *, digits: int = 3) -> str:
    """Write the ends of a 95 % interval with signs; nothing where there is no estimate."""
    return "" if gap is None else style.tell_ends(gap, partial(style.signed, digits=digits))


def write_gap(gap: Difference | None, *, digits: int = 3) -> str:
    """Write an estimate with its 95 % interval, or a dash."""
    return style.UNKNOWN if gap is None else f"{style.signed(gap.estimate, digits)} ({write_ends(gap, digits=digits)})"
