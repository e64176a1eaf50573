"""What removal curves say: scores with intervals, comparisons, agreement between fills, alarms."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.stats import kendalltau

from sliplens.faithfulness.alarms import controls_win, rankings_disagree
from sliplens.faithfulness.controls import CONTROLS
from sliplens.faithfulness.removal import Faithfulness
from sliplens.intervals import Difference, paired_difference

RANDOMISED = "randomised"
"""The control that explains a network whose weights were drawn anew."""
EQUAL_AREAS = (0.01, 0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One way to remove parts: what is removed at once, and what takes its place."""

    fill: str
    unit: str


Found = Mapping[Setting, Mapping[str, Faithfulness]]
"""Curves by setting and method, controls included."""


def judge_curves(found: Found, *, trials: np.ndarray, seed: int) -> dict[str, Any]:
    """Scores with intervals, comparisons, and how far the fills agree; whole trials are resampled.

    Parameters
    ----------
    found
        Curves by setting and method, controls included.
    trials
        Trial of each frame.
    seed
        Of the resampling.
    """
    rng = np.random.default_rng(seed)
    scores, comparisons = [], []
    for setting, curves in found.items():
        where = {"fill": setting.fill, "unit": setting.unit}
        for name, curve in curves.items():
            none = np.zeros_like(curve.symmetric_gain)
            scores.append(
                {
                    **where,
                    "method": name,
                    "control": is_control(name),
                    "srg": _interval(paired_difference(curve.symmetric_gain, none, trials=trials, rng=rng)),
                    "gain_over_random": _interval(
                        paired_difference(curve.gain_over_random, none, trials=trials, rng=rng)
                    ),
                    "most_first": float(curve.most_first.mean()),
                    "least_first": float(curve.least_first.mean()),
                    "random": float(curve.random.mean()),
                    "at": {str(area): float(curve.at(area)[0].mean()) for area in EQUAL_AREAS if area in curve.areas},
                }
            )
        methods = [name for name in curves if not is_control(name)]
        controls = [name for name in curves if is_control(name)]
        best = max(controls, key=lambda name: float(curves[name].symmetric_gain.mean()), default=None)
        pairs = [*combinations(methods, 2), *((name, best) for name in methods if best is not None)]
        for first, second in pairs:
            gains = (curves[first].symmetric_gain, curves[second].symmetric_gain)
            gap = paired_difference(*gains, trials=trials, rng=rng)
            comparisons.append({**where, "first": first, "second": second, "measure": "srg", **_interval(gap)})
    return {"scores": scores, "comparisons": comparisons, "agreement": _agreement(found)}


def is_control(name: str) -> bool:
    """Whether a row stands for a map that knows nothing of what the network learned."""
    return name in CONTROLS or name == RANDOMISED


def _interval(gap: Difference) -> dict[str, Any]:
    return {"estimate": gap.estimate, "low": gap.low, "high": gap.high, "units": gap.units, "sure": gap.sure}


def _agreement(found: Found) -> list[dict[str, Any]]:
    told = []
    for first, second in combinations(found, 2):
        if first.unit != second.unit:
            continue
        names = [name for name in found[first] if not is_control(name)]
        ranks = [[float(found[one][name].symmetric_gain.mean()) for name in names] for one in (first, second)]
        tau = float(np.asarray(kendalltau(*ranks))[0]) if len(names) > 1 else float("nan")
        told.append(
            {"unit": first.unit, "first": first.fill, "second": second.fill, "tau": tau if np.isfinite(tau) else None}
        )
    return told


def ranking_alarms(found: Found) -> list[str]:
    """Say where a control wins, and which fills rank the methods differently."""
    by_fill: dict[str, dict[str, float]] = {}
    told = []
    for setting, curves in found.items():
        methods = {name: curve for name, curve in curves.items() if not is_control(name)}
        controls = {name: curve for name, curve in curves.items() if is_control(name)}
        where = f"under {setting.fill}, {setting.unit} by {setting.unit}"
        told += [f"{where}: {alarm}" for alarm in controls_win(methods, controls)]
        if setting.unit == "pixel":
            by_fill[setting.fill] = {name: float(curve.symmetric_gain.mean()) for name, curve in methods.items()}
    return [*rankings_disagree(by_fill), *told]
