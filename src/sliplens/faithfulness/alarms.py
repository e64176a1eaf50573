"""Alarms: where a score of faithfulness does not measure the explanation."""

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from jaxtyping import Float
from scipy.stats import kendalltau

from sliplens.faithfulness.removal import Faithfulness

FILL_DECIDES = 0.05
"""An image of nothing but fill that is answered this near to the whole image, in margin units."""
_TIED_TO_LAST = 0.8
_SATURATED = 0.01
_SAME_ORDER = 0.5
_FEWEST = 3


def fill_decides(whole: Float[np.ndarray, " images"], filled: Float[np.ndarray, " images"], *, fill: str) -> list[str]:
    """Say in how many images the fill alone is answered like the whole image: there no map can move the answer."""
    near = int(np.sum(np.abs(whole - filled) < FILL_DECIDES))
    sentence = (
        f"the fill decides in {near} of {len(whole)} frames: an image of nothing but {fill} is answered within "
        f"{FILL_DECIDES:.0%} of the whole frame"
    )
    return [sentence] if near else []


def follows_last_step(
    score: Float[np.ndarray, " images"], last: Float[np.ndarray, " images"], *, name: str
) -> list[str]:
    """Say whether a score follows its own last step, where all is filled and no map has a part."""
    if len(score) < _FEWEST or np.std(score) == 0 or np.std(last) == 0:
        return []
    tied = float(np.corrcoef(score, last)[0, 1])
    if tied < _TIED_TO_LAST:
        return []
    return [f"{name} correlates with its last step by {tied:.2f}: it measures the fill rather than the map"]


def saturated(answers: Float[np.ndarray, " images"]) -> list[str]:
    """Say how many answers lie at an end of [0, 1] or outside: they move one way only."""
    ends = int(np.sum((answers < _SATURATED) | (answers > 1 - _SATURATED)))
    return [f"{ends} of {len(answers)} answers lie at an end of the margin: they can move one way only"] if ends else []


def flat_maps(maps: Mapping[str, Float[np.ndarray, "images height width"]]) -> list[str]:
    """Say which methods gave maps that are constant, or hold NaN: they rank nothing."""
    alarms = []
    for method, values in maps.items():
        bad = int(np.sum(~np.isfinite(values).all(axis=(1, 2))))
        flat = int(np.sum(values.max(axis=(1, 2)) == values.min(axis=(1, 2))))
        alarms += [f"{method}: {bad} of {len(values)} maps hold NaN or infinity"] if bad else []
        alarms += [f"{method}: {flat} of {len(values)} maps are constant and rank nothing"] if flat else []
    return alarms


def rankings_disagree(scores: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Say which fills rank the methods differently, by Kendall's tau; scores by fill, then by method.

    References
    ----------
    Kendall, *A new measure of rank correlation* (1938).
    """
    alarms = []
    for first, second in combinations(scores, 2):
        methods = sorted(set(scores[first]) & set(scores[second]))
        if len(methods) < _FEWEST:
            continue
        ranked = ([scores[fill][method] for method in methods] for fill in (first, second))
        tau = float(np.asarray(kendalltau(*ranked))[0])
        if not tau >= _SAME_ORDER:
            alarms.append(
                f"{first} and {second} rank the methods differently (Kendall's tau {tau:.2f}): which is best depends "
                "on what removed pixels become"
            )
    return alarms


def controls_win(scores: Mapping[str, Faithfulness], controls: Mapping[str, Faithfulness]) -> list[str]:
    """Say which methods gain no more than a map that knows nothing of the network, or than random orders."""
    alarms = []
    best = max(controls, key=lambda name: float(controls[name].symmetric_gain.mean()), default=None)
    for method, score in scores.items():
        gain = float(score.symmetric_gain.mean())
        if gain <= 0:
            alarms.append(f"{method} does not beat a random order: its symmetric gain is {gain:.3f}")
        elif best is not None and gain <= (control := float(controls[best].symmetric_gain.mean())):
            alarms.append(f"{method} gains {gain:.3f}, no more than the control {best} ({control:.3f})")
    return alarms
