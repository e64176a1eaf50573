"""Accuracy of a network where friction is known and where it is not, on a held-out test.

The test has 120 days of sensors, frictions and seeds of their own, three dry trials each (friction 0.5 to 1.2 by day)
and three wet ones (0.15 to 0.7, drifting); seeds are checked against those of trainings and other sets. Variants are
compared with `--set selection`, on 40 other days. Intervals hold 95 % over days.

Friction is unknown; exact; wrong by up to 10 %, as a range of 10 % either way; or learnt from one earlier slip: the
network predicts F_t / F_n in five frames of the last 0.2 s before the slip of an earlier grasp of the object, whose
friction lies within a tenth of the object's.

`--against` names another network, and prints the lead over it.
`--directions` draws the same trials pulled to 0 (right), 90, 180 and 270 degrees, each within 15 degrees, and prints
R2 of each. `--known` measures instead how well the network recognises frames of its own kind of sensor, on days of
their own.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.stats import mannwhitneyu

from adapt import SENSORS
from sliplens.friction import Friction
from sliplens.models import Estimate, Network
from sliplens.models.checkpoint import Ratio, load
from sliplens.simulation import PRESETS, SimulationRecipe
from sliplens.simulation.loading import Loading
from sliplens.simulation.nuisances import Nuisances
from sliplens.simulation.plan import TrialPlan, plan_trials
from sliplens.simulation.trials import prepare_trial

TRIALS, FRAMES, DRAWN = 3, 40, 10
"""Trials of a day and condition; frames of a trial, and how many of them with contact are drawn."""
SETS = {
    "test": ("networks, second test", 120),
    "selection": ("networks, selection", 40),
}
"""Series of their own, and days."""
FIRST_TEST = ("networks, test", 40)
"""Test of earlier networks, which no set may share."""
DRAWS = {"test": 23, "selection": 21}
"""Seeds of which frames are drawn, and of earlier grasps."""
BEFORE_SLIP, RATE_HZ, TRIAL_S = 5, 30, 8
WITHIN = 0.1
DIRECTIONS_DEG = (0, 90, 180, 270)
KNOWN_DAYS = 10
RESAMPLES = 2000


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Frames of some trials as the network was given them, and the truth."""

    inputs: torch.Tensor
    margin: Float[np.ndarray, " frames"]
    ratio: Float[np.ndarray, " frames"]


def fresh_days(series: str, days: int) -> SimulationRecipe:
    """Return days to test on, in a series of their own: series share no day, sensor or trial."""
    return replace(
        PRESETS["varied"],
        series=series,
        frames_per_trial=FRAMES,
        days=days + 1,  # the first trains, as a recipe wants it, and is not used
        test_days=days,
        dry_trials=TRIALS * (days + 1),
        wet_trials=TRIALS * days,
        nuisances=Nuisances(shear_direction_deg=(75.0, 105.0)),
    )


def plans_of_set(name: str, *, trials: int | None) -> list[TrialPlan]:
    """Trials of a set, or about so many of them."""
    plans = [plan for plan in plan_trials(fresh_days(*SETS[name])) if plan.split == "test"]
    require_disjoint(plans)
    if trials:  # of both conditions, which stand in groups of a day
        plans = sorted(plans, key=lambda plan: plan.condition)[:: max(1, len(plans) // trials)]
    return plans


def require_disjoint(plans: Sequence[TrialPlan]) -> None:
    """Check that no day, sensor or trial is among those of any training or of the other set."""
    seeds = {seed for plan in plans for seed in (plan.seed, plan.unit_seed, plan.day_seed)}
    varied = PRESETS["varied"]
    trained = [
        varied,
        replace(varied, seed=1, dry_trials=3060, days=1020),
        replace(varied, seed=2, dry_trials=1230, days=410),
        replace(varied, seed=3, dry_trials=1230, days=410, frames_per_trial=20),
        *(replace(varied, seed=seed, dry_trials=5100, days=1700, test_days=10, wet_trials=10) for seed in (5, 6)),
        *(replace(varied, seed=seed, dry_trials=3600, days=1200, test_days=10, wet_trials=10) for seed in (11, 15)),
        PRESETS["thesis"],
        PRESETS["small"],
    ]
    for recipe in [*trained, *(fresh_days(*one) for one in (*SETS.values(), FIRST_TEST))]:
        if recipe.series and recipe.series == plans[0].recipe.series:
            continue
        theirs = plan_trials(recipe)
        shared = seeds & {seed for plan in theirs for seed in (plan.seed, plan.unit_seed, plan.day_seed)}
        if shared:
            raise SystemExit(
                f"networks.py: {len(shared)} seeds of the test are also those of {recipe.series or 'varied'}"
            )


def draw_in_contact(loading: Loading, *, rng: np.random.Generator) -> Int[np.ndarray, " frames"]:
    """A few of the frames with contact, in their order."""
    contact = np.flatnonzero(np.isfinite(loading.safety_margin))
    return np.sort(rng.choice(contact, min(DRAWN, len(contact)), replace=False))


def draw(run: Network, plan: TrialPlan, *, rng: np.random.Generator, before_slip: int = 0) -> Seen:
    """Draw and encode a few frames of a trial: at random among those with contact, or the last before it slips."""
    loading, film = prepare_trial(plan)
    if before_slip:
        slip = int(np.argmax(loading.safety_margin == 0))
        at = np.arange(slip - before_slip, slip)
    else:
        at = draw_in_contact(loading, rng=rng)
    frames = np.concatenate([film.draw(slice(one, one + 1)).numpy() for one in at.tolist()])
    return Seen(
        inputs=run.encode(frames, film.draw_reference().numpy()),
        margin=loading.safety_margin[at],
        ratio=loading.tangential_force_n[at] / loading.normal_force_n[at],
    )


def measure_directions(run: Network, name: str, *, trials: int | None = None) -> dict[str, Any]:
    """R2 of the margin by the direction of the pull, dry and wet."""
    found: dict[str, Any] = {}
    for degrees in DIRECTIONS_DEG:
        rng, seen, plans = np.random.default_rng(DRAWS[name]), [], plans_of_set(name, trials=trials)
        for plan in plans:
            pull = replace(plan.recipe.nuisances, shear_direction_deg=(degrees - 15.0, degrees + 15.0))
            seen.append(draw(run, replace(plan, recipe=replace(plan.recipe, nuisances=pull)), rng=rng))
        margin = np.concatenate([one.margin for one in seen])
        predicted = np.concatenate([run.estimate(one.inputs).margin for one in seen])
        days, wet = (
            np.concatenate([np.full(len(one.margin), value) for one, value in zip(seen, values, strict=True)])
            for values in ([plan.day for plan in plans], [plan.condition == "wet" for plan in plans])
        )
        for condition, rows in (("dry", ~wet), ("wet", wet)):
            found |= r2_over_days(f"pull_{degrees}_r2_{condition}", margin[rows], predicted[rows], days[rows])
    return found


def friction_of(plan: TrialPlan) -> float:
    """Static friction of a trial, at its middle."""
    loading, _ = prepare_trial(plan)
    return float(np.median(loading.static_friction))


def earlier_grasp(plan: TrialPlan, friction: float, *, rng: np.random.Generator) -> TrialPlan:
    """An earlier grasp of the same object on the same day, at 30 Hz; its friction within a tenth of the object's."""
    nuisances, day = plan.recipe.nuisances, plan.day_draw
    factor = rng.uniform(*nuisances.dry_friction_factor)
    if plan.condition == "wet":
        # the object's friction is not drawn, only that of its trials: this one is off by a factor as well
        value = friction / rng.uniform(*nuisances.dry_friction_factor) * factor
        nuisances = replace(nuisances, wet_friction=(value, value))
    else:
        nuisances = replace(nuisances, dry_friction_factor=(factor, factor))
    seed = int(rng.integers(1 << 62))
    recipe = replace(plan.recipe, nuisances=nuisances, frames_per_trial=RATE_HZ * TRIAL_S)
    return replace(plan, recipe=recipe, frames=RATE_HZ * TRIAL_S, seed=seed, day_draw=day)


def r2(truth: Float[np.ndarray, " _"], answer: Float[np.ndarray, " _"]) -> float:
    """Share of the variance that is explained."""
    return float(1 - np.sum((answer - truth) ** 2) / np.sum((truth - truth.mean()) ** 2))


def over_days(name: str, days: np.ndarray, figure: Callable[[np.ndarray], float]) -> dict[str, float]:
    """What is figured of all rows, and the ends that hold 95 % of it over resampled days."""
    rng = np.random.default_rng(0)
    rows = [np.flatnonzero(days == day) for day in np.unique(days)]
    drawn = [
        figure(np.concatenate([rows[at] for at in rng.integers(len(rows), size=len(rows))])) for _ in range(RESAMPLES)
    ]
    low, high = np.quantile(drawn, (0.025, 0.975)).tolist()
    return {name: figure(np.arange(len(days))), f"{name}_low": low, f"{name}_high": high}


def r2_over_days(name: str, truth: np.ndarray, answer: np.ndarray, days: np.ndarray) -> dict[str, float]:
    """R2 with its interval."""
    return over_days(name, days, lambda some: r2(truth[some], answer[some]))


@dataclass(frozen=True, kw_only=True)
class Read:
    """Predictions of a network for frames of a set, trial by trial, by the friction given to it; true values."""

    estimates: dict[str, list[Estimate]]
    margin: Float[np.ndarray, " frames"]
    ratio: Float[np.ndarray, " frames"]
    day: Int[np.ndarray, " frames"]
    wet: Bool[np.ndarray, " frames"]

    def answers(self, name: str) -> Float[np.ndarray, " frames"]:
        """Margins under this knowledge of the friction."""
        return np.concatenate([one.margin for one in self.estimates[name]])


def read_frames(run: Network, name: str, *, trials: int | None = None) -> Read:
    """Predict a few frames of each trial of a set, with more or less knowledge of its friction."""
    rng = np.random.default_rng(DRAWS[name])
    estimates: dict[str, list[Estimate]] = {}
    truth, ratios, days, wet = [], [], [], []
    for plan in plans_of_set(name, trials=trials):
        seen, friction = draw(run, plan, rng=rng), friction_of(plan)
        one_frame = run.estimate(seen.inputs)
        slip = draw(run, earlier_grasp(plan, friction, rng=rng), rng=rng, before_slip=BEFORE_SLIP)
        slipped = run.estimate(slip.inputs).ratio
        wrong = friction * rng.uniform(1 - WITHIN, 1 + WITHIN)
        estimates.setdefault("one_frame", []).append(one_frame)
        known: dict[str, Friction] = {}
        if slipped is not None:
            known = {
                "known_friction": Friction(friction),
                "friction_within_10": Friction.between((1 - WITHIN) * wrong, (1 + WITHIN) * wrong),
                "one_slip": learn(slipped),
            }
        for what, one in known.items():
            estimates.setdefault(what, []).append(one_frame.with_friction(one, run.require_ratio()))
        truth.append(seen.margin)
        ratios.append(seen.ratio)
        days.append(np.full(len(seen.margin), plan.day))
        wet.append(np.full(len(seen.margin), plan.condition == "wet"))
    margin, ratio, day, is_wet = map(np.concatenate, (truth, ratios, days, wet))
    return Read(estimates=estimates, margin=margin, ratio=ratio, day=day, wet=is_wet)


def summarise(read: Read) -> dict[str, Any]:
    """R2 of the margin by knowledge of the friction, dry and wet; coverage of the 90 % intervals; `known`."""
    one_frame = read.estimates["one_frame"]
    ratios = [one.ratio for one in one_frame if one.ratio is not None]
    is_known = [one.known for one in one_frame if one.known is not None]
    found: dict[str, Any] = {"trials": len(one_frame), "frames": len(read.margin)}
    for condition, rows in (("dry", ~read.wet), ("wet", read.wet)):
        if ratios:
            found[f"ratio_r2_{condition}"] = r2(read.ratio[rows], np.concatenate([one.mean for one in ratios])[rows])
            intervals = [(one.mean - 1.645 * one.sigma, one.mean + 1.645 * one.sigma) for one in ratios]
            found[f"ratio_in_90_{condition}"] = held(read.ratio, intervals, rows)
        if is_known:
            found[f"known_below_5_{condition}"] = float(np.mean(np.concatenate(is_known)[rows] < 0.05))
        for name, estimates in read.estimates.items():
            answer, key = read.answers(name), f"{name}_r2_{condition}"
            found |= r2_over_days(key, read.margin[rows], answer[rows], read.day[rows])
            found[f"{name}_in_90_{condition}"] = held(read.margin, [one.interval(0.9) for one in estimates], rows)
    return found


def lead(
    name: str, truth: np.ndarray, answers: tuple[np.ndarray, np.ndarray], days: np.ndarray, rows: np.ndarray
) -> dict[str, float]:
    """How far the first answers are ahead of the second in R2 on some rows, both on the same resampled days."""
    margin, first, second = truth[rows], answers[0][rows], answers[1][rows]
    return over_days(name, days[rows], lambda some: r2(margin[some], first[some]) - r2(margin[some], second[some]))


def leads(read: Read, other: Read) -> dict[str, float]:
    """Lead in R2 of one network over another on the same frames, by knowledge of the friction."""
    found: dict[str, float] = {}
    for name in read.estimates.keys() & other.estimates.keys():
        for condition, rows in (("dry", ~read.wet), ("wet", read.wet)):
            answers = read.answers(name), other.answers(name)
            found |= lead(f"{name}_lead_{condition}", read.margin, answers, read.day, rows)
    return dict(sorted(found.items()))


def learn(slipped: Ratio) -> Friction:
    """Friction from the readings before one slip."""
    return Friction.from_slips([float(slipped.mean.mean())], sigma=float(slipped.sigma.mean()))


def held(truth: np.ndarray, ends: Sequence[tuple[np.ndarray, np.ndarray] | None], rows: np.ndarray) -> float:
    """Share of some rows whose truth lies in its interval."""
    low, high = (np.concatenate([end[at] for end in ends if end is not None]) for at in (0, 1))
    return float(np.mean(((truth >= low) & (truth <= high))[rows]))


def measure_known(run: Network, *, trials: int | None = None) -> dict[str, Any]:
    """How well `known` tells frames of other sensors from those of the network's kind, and how often it is low."""
    if run.manifest.novelty is None:
        raise SystemExit("networks.py: this network does not tell how far it knows a frame")
    recipe, found, usual = fresh_days("networks, known", KNOWN_DAYS), {}, np.zeros(0)
    for name, sensor in {"own kind": recipe.sensor, **SENSORS}.items():
        rng = np.random.default_rng(0)
        plans = [plan for plan in plan_trials(replace(recipe, sensor=sensor)) if plan.split == "test"]
        require_disjoint(plans)
        plans = plans[:: max(1, len(plans) // trials)] if trials else plans
        read = [run.estimate(draw(run, plan, rng=rng).inputs).known for plan in plans]
        known = np.concatenate([one for one in read if one is not None])
        if name == "own kind":
            usual = known
        else:
            above = float(mannwhitneyu(-known, -usual).statistic)
            found[f"known_auroc_{name.replace(' ', '_')}"] = above / (len(known) * len(usual))
        for share in (1, 5):
            found[f"known_below_{share}_{name.replace(' ', '_')}"] = float(np.mean(known < share / 100))
    return found


def main() -> None:
    """Print what was measured as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("chromatouch-pair"), help="a trained network")
    parser.add_argument("--against", type=Path, help="another network; told is what the first is ahead of it")
    parser.add_argument("--set", choices=SETS, default="test", help="the test, or days on which variants are compared")
    parser.add_argument("--trials", type=int, help="about so many trials, for a quick look")
    parser.add_argument("--directions", action="store_true", help="only R2 by the direction of the pull")
    parser.add_argument("--known", action="store_true", help="only how far it knows its own kind of sensor, and others")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    run, other = load(options.run), options.against and load(options.against)
    found: dict[str, Any] = {"weights_sha256": run.manifest.weights_sha256}
    chosen = {"name": options.set, "trials": options.trials}
    found |= measure_known(run, trials=options.trials) if options.known else {"set": options.set}
    if options.directions:
        found |= measure_directions(run, **chosen)
    elif not options.known:
        read = read_frames(run, **chosen)
        found |= summarise(read)
        if other is not None:
            found |= leads(read, read_frames(other, **chosen))
    print(json.dumps(found, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
