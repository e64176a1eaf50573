"""Labels under faults of the force sensor and events that resemble them, in simulated trials.

14 kinds of faults at three strengths, and 10 of events and settings (`contact_events.py`). Each trial is filmed once,
recorded with noise, offset, lag, turned axes and a wrong sign, and labelled without a fault and with each. Of the valid
labels: how many are off by more than 3 sigma, or have no truth; of the frames valid without a fault and far from faulty
samples: how many still are. Trials alternate between 500 and 100 samples a second, and between held to the end and
released. Shares have standard errors over trials.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from contact_events import (
    EVENTS,
    FORCE_HZ,
    LONGEST_LAG_S,
    Case,
    Seen,
    film_trial,
    near_events,
    spoil,
    tilt,
)
from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces
from sliplens.recordings.labels.margin import LARGEST_SIGMA, FoundLabels, label_trial
from sliplens.recordings.options import LabelSettings
from sliplens.simulation import SimulationRecipe, plan_trials
from sliplens.simulation.loading import TRIAL_S

_SLOWER = 5  # a second rate of samples, as a part of the first
_SIGMAS = 3.0
NOISE_N = 0.02
"""Standard deviation of a force sample."""
_NEAR_S = 0.06  # frames as near to a faulty sample may lose their label: a frame's time and some samples

Samples = Float[np.ndarray, "samples 3"]
Fault = Callable[[Samples, np.ndarray, int, np.random.Generator], Bool[np.ndarray, " samples"]]
"""Spoils forces in place between two samples, at one of three strengths, and tells which samples it changed."""

_PEAK_N = (0.5, 5.0, 70.0)
_LENGTH_S = (0.1, 0.4, 1.2)


def _span(time_s: np.ndarray, begin_s: float, length_s: float) -> Bool[np.ndarray, " samples"]:
    return (time_s >= begin_s) & (time_s < begin_s + length_s)


def _anywhere(time_s: np.ndarray, rng: np.random.Generator, *, length_s: float = 0.0) -> float:
    """A moment between the touch and the slip of most trials."""
    return float(rng.uniform(0.07, 0.88 - length_s / TRIAL_S) * TRIAL_S + time_s[0])


def _add(force: Samples, where: np.ndarray, size_n: float, rng: np.random.Generator) -> np.ndarray:
    force[where, int(rng.integers(3))] += size_n * rng.choice((-1, 1))
    return where


def spike(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
    """One sample of one axis."""
    where = np.arange(len(time_s)) == np.searchsorted(time_s, _anywhere(time_s, rng))
    return _add(force, where, _PEAK_N[strength], rng)


def spikes(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
    """Several samples, anywhere in the trial."""
    where = np.zeros(len(time_s), dtype=bool)
    for at in rng.choice(len(time_s), (3, 10, 30)[strength], replace=False).tolist():
        where |= _add(force, np.arange(len(time_s)) == at, float(rng.choice(_PEAK_N)), rng)
    return where


def pull(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
    """A tenth of a second of another force."""
    return _add(force, _span(time_s, _anywhere(time_s, rng), 0.1), _PEAK_N[strength], rng)


def step(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
    """An offset from a moment on."""
    return _add(force, time_s >= _anywhere(time_s, rng), _PEAK_N[strength], rng)


def drift(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
    """An offset that grows evenly from the first sample to the last."""
    size_n = (0.3, 1.0, 3.0)[strength] * rng.choice((-1, 1))
    force[:, int(rng.integers(3))] += size_n * (time_s - time_s[0]) / np.ptp(time_s)
    return np.zeros(len(time_s), dtype=bool)


def clipping(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
    """The axis that moves most, cut off below its largest departure."""
    del rng  # where it clips is told by the trial
    rest = np.median(force[time_s < time_s[0] + 0.1], axis=0)
    axis = int(np.argmax(np.quantile(np.abs(force - rest), 0.9, axis=0)))
    away = force[:, axis] - rest[axis]
    most = (0.9, 0.7, 0.5)[strength] * np.quantile(np.abs(away), 0.98)
    where = np.abs(away) > most
    force[where, axis] = rest[axis] + np.sign(away[where]) * most
    return where


def stuck_sample(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
    """A sample that is repeated for some 10, 20 or 50 ms, at ten moments."""
    count = np.searchsorted(time_s - time_s[0], (0.01, 0.02, 0.05)[strength])
    where = np.zeros(len(time_s), dtype=bool)
    for _ in range(10):
        at = int(np.searchsorted(time_s, _anywhere(time_s, rng)))
        force[at : at + count] = force[at]
        where[at : at + count] = True
    return where


def stuck(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
    """A sample that is repeated for long."""
    where = _span(time_s, _anywhere(time_s, rng, length_s=_LENGTH_S[strength]), _LENGTH_S[strength])
    force[where] = force[int(np.argmax(where))]
    return where


def _changed(change: Callable[[Samples], Samples]) -> Fault:
    def fault(force: Samples, time_s: np.ndarray, strength: int, rng: np.random.Generator) -> np.ndarray:
        length_s = _LENGTH_S[strength]
        where = _span(time_s, _anywhere(time_s, rng, length_s=length_s), length_s)
        force[where] = change(force[where])
        return where

    return fault


FAULTS: dict[str, Fault] = {
    "spike": spike,
    "several spikes": spikes,
    "pull of 100 ms": pull,
    "step": step,
    "drift": drift,
    "clipping": clipping,
    "drop-out, no number": _changed(lambda force: np.full_like(force, np.nan)),
    "drop-out, zero": _changed(np.zeros_like),
    "stuck sample": stuck_sample,
    "stuck span": stuck,
    "sign flip": _changed(lambda force: -force),
    "swapped axes": _changed(lambda force: force[:, [1, 0, 2]]),
    "scaled": _changed(lambda force: 2 * force),
    "time gap": _changed(lambda force: np.full_like(force, np.inf)),
}
"""A time gap is cut out where the samples are infinite."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Labels of one trial with one fault."""

    trial: str
    fault: str
    strength: int
    valid: int
    off: int
    """Of the valid, more than 3 sigma from the truth, or without one."""
    loose: int
    """Of the valid, those whose sigma is above the bound."""
    clean: int
    """Frames that are valid without the fault and that no faulty sample comes near."""
    kept: int
    refusal: str = ""


def refused(refusal: RecordingError, clean: int, *, trial: str, fault: str, strength: int) -> Outcome:
    """Return the outcome of a trial without labels."""
    return Outcome(
        trial=trial, fault=fault, strength=strength, valid=0, off=0, loose=0, clean=clean, kept=0, refusal=str(refusal)
    )


def measure_trial(seen: Seen, *, rate: int, rng: np.random.Generator) -> list[Outcome]:
    """Label a trial without a fault and with each, the same but for it."""
    forces, _, _ = spoil(seen, noise_n=NOISE_N, rng=rng)
    forces = replace(forces, time_s=forces.time_s[::rate], force_n=forces.force_n[::rate])
    time_s = seen.loading.time_s[seen.frames] + rng.uniform(-LONGEST_LAG_S, LONGEST_LAG_S)
    truth, seed = seen.loading.safety_margin[seen.frames], int(rng.integers(2**32))
    name = f"seed{seen.plan.recipe.seed}-{seen.plan.trial}"

    def label(one: Forces) -> FoundLabels:
        settings = LabelSettings(friction_change=0.0 if seen.plan.condition == "dry" else 0.1)
        return label_trial(time_s, seen.motion, one, settings=settings, rng=np.random.default_rng(seed))

    try:
        fine = label(forces)
    except RecordingError as refusal:
        print(f"{name} without a fault: {refusal}", file=sys.stderr)
        return []
    outcomes = [
        _compare(fine, fine.valid, truth, np.zeros(len(truth), dtype=bool), trial=name, fault="none", strength=0)
    ]
    for fault, spoiled in FAULTS.items():
        for strength in range(3):
            force = forces.force_n.copy()
            wrong = spoiled(force, forces.time_s, strength, rng)
            there = ~np.isinf(force).any(axis=1)
            gaps = np.flatnonzero(wrong)
            times = forces.time_s[gaps]
            near = np.zeros(len(truth), dtype=bool)
            if len(times):
                after = np.minimum(np.searchsorted(times, time_s), len(times) - 1)
                apart = np.minimum(np.abs(times[after] - time_s), np.abs(times[np.maximum(after - 1, 0)] - time_s))
                near = apart <= _NEAR_S + LONGEST_LAG_S
            facts = {"trial": name, "fault": fault, "strength": strength}
            try:
                found = label(replace(forces, time_s=forces.time_s[there], force_n=force[there]))
            except RecordingError as refusal:
                clean = int(np.sum(fine.valid & ~near))
                outcomes.append(refused(refusal, clean, **facts))
                continue
            outcomes.append(_compare(found, fine.valid, truth, near, **facts))
    for event, change in EVENTS.items():
        for strength in range(3):
            facts = {"trial": name, "fault": event, "strength": strength}
            outcomes.append(_measure_event(change(seen, strength, rng), fine, rate=rate, rng=rng, facts=facts))
    return outcomes


def _measure_event(
    case: Case, fine: FoundLabels, *, rate: int, rng: np.random.Generator, facts: dict[str, Any]
) -> Outcome:
    """Label a trial to which something happened."""
    seen = case.seen
    forces, normal, _ = spoil(seen, noise_n=NOISE_N, rng=rng)
    if case.tilt_deg:
        forces = replace(forces, force_n=tilt(forces.force_n, normal, case.tilt_deg, rng))
    forces = replace(forces, time_s=forces.time_s[::rate], force_n=forces.force_n[::rate])
    frame_s, count = seen.loading.time_s[seen.frames], len(seen.frames)
    near, truth = near_events(case, frame_s, within_s=_NEAR_S + LONGEST_LAG_S), seen.loading.safety_margin[seen.frames]
    change = 0.0 if seen.plan.condition == "dry" else 0.1
    settings = LabelSettings(friction_change=change, mu=case.mu, slip_s=case.slip_s)
    lag_s = rng.uniform(-LONGEST_LAG_S, LONGEST_LAG_S)
    before = fine.valid[:count] & np.isfinite(truth) & (truth > 0)
    try:
        found = label_trial(frame_s + lag_s, seen.motion, forces, settings=settings, rng=rng)
    except RecordingError as refusal:
        return refused(refusal, int(np.sum(before & ~near)), **facts)
    return _compare(found, before, truth, near, **facts)


def _compare(
    found: FoundLabels,
    before: Bool[np.ndarray, " frames"],
    truth: Float[np.ndarray, " frames"],
    near: Bool[np.ndarray, " frames"],
    *,
    trial: str,
    fault: str,
    strength: int,
) -> Outcome:
    valid, sigma = found.valid, found.safety_margin_sigma
    wrong = ~(np.abs(found.safety_margin - truth) <= _SIGMAS * sigma)
    clean = before & ~near
    return Outcome(
        trial=trial,
        fault=fault,
        strength=strength,
        valid=int(valid.sum()),
        off=int(np.sum(valid & wrong)),
        loose=int(np.sum(valid & (sigma > LARGEST_SIGMA))),
        clean=int(clean.sum()),
        kept=int(np.sum(clean & valid)),
    )


def summarise(outcomes: list[Outcome]) -> dict[str, float]:
    """Shares over all faults."""
    faulty = [one for one in outcomes if one.fault != "none"]
    false, kept = (_share(faulty, *pair) for pair in (("off", "valid"), ("kept", "clean")))
    return {
        "trials": len({one.trial for one in outcomes}),
        "false_valid_share": false[0],
        "false_valid_share_error": false[1],
        "valid_kept_share": kept[0],
        "valid_kept_share_error": kept[1],
        "valid_above_largest_sigma": sum(one.loose for one in outcomes),
        "refused_share": float(np.mean([bool(one.refusal) for one in faulty])),
    }


def summarise_faults(outcomes: list[Outcome]) -> dict[str, dict[str, Any]]:
    """Shares by fault."""
    shares = {}
    for fault in dict.fromkeys(one.fault for one in outcomes):
        some = [one for one in outcomes if one.fault == fault]
        by_strength = [[one for one in some if one.strength == at] for at in sorted({one.strength for one in some})]
        shares[fault] = {
            "false_valid_share": _share(some, "off", "valid")[0],
            "valid_kept_share": _share(some, "kept", "clean")[0],
            "refused_share": float(np.mean([bool(one.refusal) for one in some])),
            "false_valid_by_strength": [_share(those, "off", "valid")[0] for those in by_strength],
        }
    return shares


def _share(outcomes: list[Outcome], part: str, whole: str) -> tuple[float, float]:
    """Share of frames, and its standard error over trials (jackknife)."""
    parts, wholes = Counter[str](), Counter[str]()
    for one in outcomes:
        parts[one.trial] += getattr(one, part)
        wholes[one.trial] += getattr(one, whole)
    names, total = list(wholes), max(wholes.total(), 1)
    without = [(parts.total() - parts[name]) / max(wholes.total() - wholes[name], 1) for name in names]
    error = np.sqrt((len(names) - 1) * np.var(without)) if len(names) > 1 else float("nan")
    return parts.total() / total, float(error)


def measure_seed(seed: int, *, dry: int, wet: int) -> list[Outcome]:
    """Measure the trials of a seed."""
    rng, outcomes = np.random.default_rng(seed), []
    for release in (False, True):
        recipe = SimulationRecipe(
            dry_trials=dry, wet_trials=wet, frames_per_trial=round(TRIAL_S * FORCE_HZ), release=release, seed=seed
        )
        for number, plan in enumerate(plan_trials(recipe)):
            seen, rate = film_trial(plan), (1, _SLOWER)[number % 2]
            some = measure_trial(seen, rate=rate, rng=rng)
            outcomes += [replace(one, trial=f"{one.trial}-{'released' if release else 'held'}") for one in some]
    return outcomes


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dry", type=int, default=4, help="dry trials, over four days, held and let go")
    parser.add_argument("--wet", type=int, default=1, help="wet trials, held and let go")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds to pool")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    outcomes = [outcome for seed in seeds for outcome in measure_seed(seed, dry=arguments.dry, wet=arguments.wet)]
    numbers = {**summarise(outcomes), "by_fault": summarise_faults(outcomes)}
    print(json.dumps(numbers, indent=None if arguments.json else 2))


if __name__ == "__main__":
    main()
