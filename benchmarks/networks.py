"""How well a network reads the margin where friction is told, and where it is not, on one untouched test.

The trials are of days, sensors, frictions and seeds of their own (a series of its own is drawn into every seed, and the
seeds are checked against those of the trainings and of the selection): 40 days, three dry trials each (friction 0.5 to
1.2 by day) and three wet ones (0.15 to 0.7, drifting). Variants are compared with `--selection`, on other days; the
test is for the one that was chosen.

What is told: nothing; the static friction of each trial, exactly; a number that is wrong by up to 10 %, as a range of
10 % either way; or what one earlier slip of the same object has taught. For that the object is grasped once before, at
a place, force and stretch of its own; the network reads F_t / F_n in five frames of the last 0.2 s before the slip,
whose time is the true one. The friction of both grasps lies within a tenth of the object's: so the dry trials of a
day are drawn, and the spread is the very one that `Friction.from_slips` expects. Wet trials are drawn each with a
friction of its own, and are given an earlier grasp as if they were of one such object. `--grasp-spread` has the earlier
grasp differ by more, with the usual spread expected (`one_slip_unlike`) and with the true one (`one_slip_unlike_told`).

`several`, of a network that was taught to: all frames of a trial are read in order. Its pulls are varied (0.8 to 8 s,
with rests, jerks and lettings back), so that no sequence reads the clock, and `one_of_several` has the same frames one
by one. `several_gain` is what the first is ahead of the second, resampled together; of fast pulls, which last less than
3 s from the first tug to the slip, and of slow ones too.

`--known` asks instead how far the network knows frames of its own kind of sensor and of others, on days of their own.

Intervals hold 95 % over days.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from adapt import SENSORS
from sliplens.errors import SliplensError
from sliplens.friction import GRASP_SPREAD, Friction
from sliplens.models import Estimate, Run
from sliplens.models.checkpoint import Ratio, load
from sliplens.simulation import PRESETS, SimulationRecipe
from sliplens.simulation.filming import Film
from sliplens.simulation.loading import Loading
from sliplens.simulation.plan import PULLS, TrialPlan, plan_trials
from sliplens.simulation.trials import prepare_trial
from sliplens.training.metrics import auroc

DAYS, TRIALS, FRAMES, DRAWN = 40, 3, 40, 10
"""Days; trials of a day and condition; frames of a trial, and how many of them with contact are drawn."""
BEFORE_SLIP, RATE_HZ, TRIAL_S = 5, 30, 8
WITHIN = 0.1
FAST_S = 3.0
"""A pull that lasts less is fast: about half of the varied ones."""
KNOWN_DAYS = 10
RESAMPLES = 2000


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Frames of some trials as the network was given them, and the truth."""

    inputs: torch.Tensor
    margin: Float[np.ndarray, " frames"]
    ratio: Float[np.ndarray, " frames"]
    pulled: np.ndarray
    """Whether the contact was pulled: frames before are read at once, by anyone."""


def fresh_days(series: str, days: int) -> SimulationRecipe:
    """Days to test on, in a series of their own: series share no day, sensor or trial."""
    return replace(
        PRESETS["varied"],
        series=series,
        frames_per_trial=FRAMES,
        days=days + 1,  # the first trains, as a recipe wants it, and is not used
        test_days=days,
        dry_trials=TRIALS * (days + 1),
        wet_trials=TRIALS * days,
        nuisances=PRESETS["thesis"].nuisances,
    )


def test_recipe(*, selection: bool) -> SimulationRecipe:
    """Days of the selection, or of the test."""
    return fresh_days("networks, selection" if selection else "networks, test", DAYS)


def require_disjoint(plans: list[TrialPlan]) -> None:
    """Check that no day, sensor or trial is among those of any training or of the other set."""
    seeds = {seed for plan in plans for seed in (plan.seed, plan.unit_seed, plan.day_seed)}
    varied = PRESETS["varied"]
    trained = [
        varied,
        replace(varied, seed=1, dry_trials=3060, days=1020),
        replace(varied, seed=2, dry_trials=1230, days=410),
        replace(varied, seed=3, dry_trials=1230, days=410, frames_per_trial=20),
        replace(
            varied,
            seed=4,
            dry_trials=1020,
            days=340,
            test_days=10,
            wet_trials=30,
            frames_per_trial=60,
            pulls=PULLS["varied"],
        ),
        replace(varied, seed=5, dry_trials=5100, days=1700, test_days=10, wet_trials=10),
        PRESETS["thesis"],
        PRESETS["small"],
    ]
    for recipe in [*trained, test_recipe(selection=True), test_recipe(selection=False)]:
        theirs = plan_trials(recipe)
        if theirs[0].recipe_hash == plans[0].recipe_hash:
            continue
        shared = seeds & {seed for plan in theirs for seed in (plan.seed, plan.unit_seed, plan.day_seed)}
        if shared:
            raise SystemExit(
                f"networks.py: {len(shared)} seeds of the test are also those of {recipe.series or 'varied'}"
            )


def draw_in_contact(loading: Loading, *, rng: np.random.Generator) -> Int[np.ndarray, " frames"]:
    """A few of the frames with contact, in their order."""
    contact = np.flatnonzero(np.isfinite(loading.safety_margin))
    return np.sort(rng.choice(contact, min(DRAWN, len(contact)), replace=False))


def film_frames(
    film: Film, at: Int[np.ndarray, " frames"]
) -> tuple[UInt8[np.ndarray, "frames height width 3"], UInt8[np.ndarray, "height width 3"]]:
    """Frames of a trial by their numbers, and the sensor untouched."""
    frames = np.concatenate([film.draw(slice(one, one + 1)).numpy() for one in at.tolist()])
    return frames, film.draw_reference().numpy()


def draw(run: Run, plan: TrialPlan, *, rng: np.random.Generator, before_slip: int = 0) -> Seen:
    """Draw and encode a few frames of a trial: at random among those with contact, or the last before it slips."""
    loading, film = prepare_trial(plan)
    if before_slip:
        slip = int(np.argmax(loading.safety_margin == 0))
        at = np.arange(slip - before_slip, slip)
    else:
        at = draw_in_contact(loading, rng=rng)
    frames, reference = film_frames(film, at)
    return Seen(
        inputs=run.encode(frames, reference),
        margin=loading.safety_margin[at],
        ratio=loading.tangential_force_n[at] / loading.normal_force_n[at],
        pulled=loading.safety_margin[at] < 1,
    )


def friction_of(plan: TrialPlan) -> float:
    """Static friction of a trial, at its middle."""
    loading, _ = prepare_trial(plan)
    return float(np.median(loading.static_friction))


def earlier_grasp(
    plan: TrialPlan, friction: float, *, rng: np.random.Generator, spread: float | None = None
) -> TrialPlan:
    """An earlier grasp of the same object on the same day, filmed at 30 Hz.

    Its friction lies within a tenth of the object's, or evenly around it with another standard deviation, a share.
    """
    nuisances, day = plan.recipe.nuisances, plan.day_draw
    reach = 0.0 if spread is None else 3**0.5 * spread
    factor = rng.uniform(*(nuisances.dry_friction_factor if spread is None else (1 - reach, 1 + reach)))
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


def measure(
    run: Run, *, selection: bool, trials: int | None = None, grasp_spread: float | None = None
) -> dict[str, Any]:
    """R2 of the margin by what is told, dry and wet, with intervals; what the 90 % intervals hold; what is `known`."""
    rng, aside = np.random.default_rng(20 + selection), np.random.default_rng(22)
    plans = [plan for plan in plan_trials(test_recipe(selection=selection)) if plan.split == "test"]
    require_disjoint(plans)
    plans = plans[:: max(1, len(plans) // trials)] if trials else plans
    told: dict[str, list[Estimate]] = {}
    truth, ratios, days, wet, pulled = [], [], [], [], []
    for plan in plans:
        seen, friction = draw(run, plan, rng=rng), friction_of(plan)
        untold = run.estimate(seen.inputs)
        slip = draw(run, earlier_grasp(plan, friction, rng=rng), rng=rng, before_slip=BEFORE_SLIP)
        slipped = run.estimate(slip.inputs).ratio
        wrong = friction * rng.uniform(1 - WITHIN, 1 + WITHIN)
        told.setdefault("one_frame", []).append(untold)
        known: dict[str, Friction] = {}
        if slipped is not None:
            known = {
                "told": Friction(friction),
                "told_within_10": Friction.between((1 - WITHIN) * wrong, (1 + WITHIN) * wrong),
                "one_slip": learn(slipped),
            }
        if slipped is not None and grasp_spread is not None:
            unlike = earlier_grasp(plan, friction, rng=aside, spread=grasp_spread)
            slipped = run.estimate(draw(run, unlike, rng=aside, before_slip=BEFORE_SLIP).inputs).ratio
            assert slipped is not None
            known |= {"one_slip_unlike": learn(slipped), "one_slip_unlike_told": learn(slipped, spread=grasp_spread)}
        for name, one in known.items():
            traction = run.require_ratio()
            estimate = untold.told(one, trained_friction=np.array(traction.friction), calibration=traction.told)
            told.setdefault(name, []).append(estimate)
        truth.append(seen.margin)
        ratios.append(seen.ratio)
        pulled.append(seen.pulled)
        days.append(np.full(len(seen.margin), plan.day))
        wet.append(np.full(len(seen.margin), plan.condition == "wet"))
    margin, ratio, day, is_wet, is_pulled = map(np.concatenate, (truth, ratios, days, wet, pulled))
    seen_ratios = [one.ratio for one in told["one_frame"] if one.ratio is not None]
    is_known = [one.known for one in told["one_frame"] if one.known is not None]
    found: dict[str, Any] = {
        "trials": len(plans),
        "frames": len(margin),
        "set": "selection" if selection else "test",
        "weights_sha256": run.manifest.weights_sha256,
    }
    for condition, rows in (("dry", ~is_wet), ("wet", is_wet)):
        if seen_ratios:
            found[f"ratio_r2_{condition}"] = r2(ratio[rows], np.concatenate([one.mean for one in seen_ratios])[rows])
            found[f"ratio_in_90_{condition}"] = held(ratio, [one.interval(0.9) for one in seen_ratios], rows)
        if is_known:
            found[f"known_below_5_{condition}"] = float(np.mean(np.concatenate(is_known)[rows] < 0.05))
        for name, estimates in told.items():
            answer = np.concatenate([one.margin for one in estimates])
            key = f"{name}_r2_{condition}"
            found |= r2_over_days(key, margin[rows], answer[rows], day[rows])
            some = rows & is_pulled
            found[f"{key}_pull_alone"] = r2(margin[some], answer[some])
            found[f"{name}_in_90_{condition}"] = held(margin, [one.interval(0.9) for one in estimates], rows)
    return found


def learn(slipped: Ratio, spread: float = GRASP_SPREAD) -> Friction:
    """Friction from the readings before one slip, as of a grasp that differs by so much."""
    return Friction.from_slips([float(slipped.mean.mean())], sigma=float(slipped.sigma.mean()), grasp_spread=spread)


def held(truth: np.ndarray, ends: Sequence[tuple[np.ndarray, np.ndarray] | None], rows: np.ndarray) -> float:
    """Share of some rows whose truth lies in its interval."""
    low, high = (np.concatenate([end[at] for end in ends if end is not None]) for at in (0, 1))
    return float(np.mean(((truth >= low) & (truth <= high))[rows]))


@dataclass(frozen=True, kw_only=True)
class Followed:
    """Frames of one trial, from touch to end: the truth, what is read of each by itself, and of all in order."""

    day: int
    wet: bool
    pull_s: float
    """From the first tug to the slip."""
    margin: Float[np.ndarray, " frames"]
    one: Float[np.ndarray, " frames"]
    several: Float[np.ndarray, " frames"]
    in_90: np.ndarray


def follow(run: Run, plan: TrialPlan) -> Followed:
    """Read all frames of a trial with contact."""
    loading, film = prepare_trial(plan)
    contact = np.flatnonzero(np.isfinite(loading.safety_margin))
    frames = film.draw(slice(int(contact[0]), int(contact[-1]) + 1)).numpy()
    one = run.to_estimate(*run.answers(run.encode(frames, film.draw_reference().numpy()).split(8)))
    time_s, margin = loading.time_s[contact], loading.safety_margin[contact]
    several = run.follow().update(one, time_s, np.ones(len(margin), dtype=bool))
    low, high = several.interval(0.9) or (margin, margin)
    return Followed(
        day=plan.day,
        wet=plan.condition == "wet",
        pull_s=float(time_s[np.argmax(margin == 0)] - time_s[np.argmax(margin < 1)]),
        margin=margin,
        one=one.margin,
        several=several.margin,
        in_90=(margin >= low) & (margin <= high),
    )


def measure_sequences(run: Run, *, selection: bool, trials: int | None = None) -> dict[str, Any]:
    """R2 of the margin from one frame, and where all frames of a trial are read in order, with intervals."""
    recipe = test_recipe(selection=selection)
    require_disjoint([plan for plan in plan_trials(recipe) if plan.split == "test"])
    plans = [plan for plan in plan_trials(replace(recipe, pulls=PULLS["varied"])) if plan.split == "test"]
    plans = plans[:: max(1, len(plans) // trials)] if trials else plans
    return summarise_sequences([follow(run, plan) for plan in plans])


def summarise_sequences(read: Sequence[Followed]) -> dict[str, Any]:
    """R2 and errors of one frame and of several, dry and wet, and what several gain, in all and by the pull's speed."""
    found: dict[str, Any] = {"sequence_frames": sum(len(one.margin) for one in read)}
    for condition, wet in (("dry", False), ("wet", True)):
        some = [one for one in read if one.wet == wet]
        margin, one, several, in_90 = (
            np.concatenate([getattr(each, name) for each in some]) for name in ("margin", "one", "several", "in_90")
        )
        slipped = np.concatenate([np.cumsum(each.margin == 0) > 0 for each in some])
        day = np.concatenate([np.full(len(each.margin), each.day) for each in some])
        fast = np.concatenate([np.full(len(each.margin), each.pull_s < FAST_S) for each in some])
        for name, answer in (("one_of_several", one), ("several", several)):
            key = f"{name}_r2_{condition}"
            found |= r2_over_days(key, margin, answer, day)
            pulled = (margin < 1) & ~slipped
            found[f"{key}_before_slip"] = r2(margin[pulled], answer[pulled])
            for when, rows in (("before", ~slipped), ("after", slipped)):
                found[f"{name}_rmse_{condition}_{when}_slip"] = float(np.sqrt(np.mean((answer - margin)[rows] ** 2)))
        found[f"several_in_90_{condition}"] = float(in_90.mean())
        found[f"fast_trials_{condition}"] = sum(each.pull_s < FAST_S for each in some)
        for speed, rows in (("", np.ones(len(day), dtype=bool)), ("_fast", fast), ("_slow", ~fast)):
            if rows.any():
                before, after, truth = one[rows], several[rows], margin[rows]
                found |= over_days(
                    f"several_gain_{condition}{speed}",
                    day[rows],
                    lambda at, b=before, a=after, t=truth: r2(t[at], a[at]) - r2(t[at], b[at]),
                )
    return found


def measure_known(run: Run, *, trials: int | None = None) -> dict[str, Any]:
    """How well `known` tells frames of other sensors from those of the network's kind, and how often it is low."""
    if run.novelty is None:
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
            found[f"known_auroc_{name.replace(' ', '_')}"] = auroc(-known, -usual)
        for share in (1, 5):
            found[f"known_below_{share}_{name.replace(' ', '_')}"] = float(np.mean(known < share / 100))
    return found


def main() -> None:
    """Print what was measured, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("chromatouch-pair"), help="a trained network")
    parser.add_argument("--selection", action="store_true", help="the days on which variants are compared")
    parser.add_argument("--trials", type=int, help="about so many trials, for a quick look")
    parser.add_argument("--sequences", action="store_true", help="only what several frames tell")
    parser.add_argument("--known", action="store_true", help="only how far it knows its own kind of sensor, and others")
    parser.add_argument(
        "--grasp-spread", type=float, help="also: an earlier grasp whose friction differs by this share"
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.grasp_spread is not None and not 0 < options.grasp_spread < 0.5:
        parser.error("--grasp-spread is a share between 0 and 0.5")
    try:
        run = load(options.run)
    except SliplensError as error:
        sys.exit(f"{Path(__file__).name}: {error}")
    chosen = {"selection": options.selection, "trials": options.trials}
    if options.known:
        found = measure_known(run, trials=options.trials)
    else:
        found = {} if options.sequences else measure(run, **chosen, grasp_spread=options.grasp_spread)
    if run.sequence is not None and not options.known:
        found |= measure_sequences(run, **chosen)
    if options.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        print(f"{name:32}", f"{value:.3f}" if isinstance(value, float) else value)


if __name__ == "__main__":
    main()
