"""How well a network reads the margin where friction is told, and where it is not, on one untouched test.

The trials are of days, sensors, frictions and seeds of their own (a series of its own is drawn into every seed, and the
seeds are checked against those of the trainings and of the selection): 40 days, three dry trials each (friction 0.5 to
1.2 by day) and three wet ones (0.15 to 0.7, drifting). Variants are compared with `--selection`, on other days; the
test is for the one that was chosen.

What is told: nothing; the static friction of each trial, exactly; a number that is wrong by up to 10 %, as a range of
10 % either way; or what one earlier slip of the same object has taught. For that the object is grasped once before, at
a place, force and stretch of its own, with a friction that differs as those of the trials of a day do; the network
reads F_t / F_n in five frames of the last 0.2 s before the slip, whose time is taken as known.

`several`, of a network that was taught to: all frames of a trial are read in order. Its pulls are varied (0.8 to 8 s,
with rests, jerks and lettings back), so that no sequence reads the clock, and `one_of_several` has the same frames one
by one. Intervals hold 95 % over days.
"""

import argparse
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from sliplens.errors import SliplensError
from sliplens.friction import Friction
from sliplens.models import Estimate, Run
from sliplens.models.checkpoint import load
from sliplens.simulation import PRESETS, SimulationRecipe
from sliplens.simulation.filming import Film
from sliplens.simulation.loading import Loading
from sliplens.simulation.plan import PULLS, TrialPlan, plan_trials
from sliplens.simulation.trials import prepare_trial

DAYS, TRIALS, FRAMES, DRAWN = 40, 3, 40, 10
"""Days; trials of a day and condition; frames of a trial, and how many of them with contact are drawn."""
BEFORE_SLIP, RATE_HZ, TRIAL_S = 5, 30, 8
WITHIN = 0.1
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


def earlier_grasp(plan: TrialPlan, friction: float, *, rng: np.random.Generator) -> TrialPlan:
    """An earlier grasp of the same object on the same day, filmed at 30 Hz; its friction differs by up to a tenth."""
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


def with_interval(
    truth: np.ndarray, answer: np.ndarray, days: np.ndarray, *, rng: np.random.Generator
) -> tuple[float, float, float]:
    """R2, and the ends that hold 95 % of it over resampled days."""
    rows = [np.flatnonzero(days == day) for day in np.unique(days)]
    drawn = []
    for _ in range(RESAMPLES):
        some = np.concatenate([rows[at] for at in rng.integers(len(rows), size=len(rows))])
        drawn.append(r2(truth[some], answer[some]))
    return r2(truth, answer), float(np.quantile(drawn, 0.025)), float(np.quantile(drawn, 0.975))


def measure(run: Run, *, selection: bool, trials: int | None = None) -> dict[str, Any]:
    """R2 of the margin by what is told, dry and wet, with intervals, and coverage of the 90 % intervals."""
    rng = np.random.default_rng(20 + selection)
    plans = [plan for plan in plan_trials(test_recipe(selection=selection)) if plan.split == "test"]
    require_disjoint(plans)
    plans = plans[:: max(1, len(plans) // trials)] if trials else plans
    told: dict[str, list[Estimate]] = {}
    truth, ratios, read, days, wet, pulled = [], [], [], [], [], []
    for plan in plans:
        seen, friction = draw(run, plan, rng=rng), friction_of(plan)
        answers = run.answers(seen.inputs.split(64))
        slip = draw(run, earlier_grasp(plan, friction, rng=rng), rng=rng, before_slip=BEFORE_SLIP)
        slipped = run.estimate(slip.inputs).ratio
        wrong = friction * rng.uniform(1 - WITHIN, 1 + WITHIN)
        known: dict[str, Friction | None] = {"one_frame": None}
        if slipped is not None:
            known |= {
                "told": Friction(friction),
                "told_within_10": Friction.between((1 - WITHIN) * wrong, (1 + WITHIN) * wrong),
                "one_slip": Friction.from_slips([float(slipped.mean.mean())], sigma=float(slipped.sigma.mean())),
            }
        for name, one in known.items():
            told.setdefault(name, []).append(run.to_estimate(*answers, friction=one))
        ratio = told["one_frame"][-1].ratio
        read.append(np.full(len(seen.margin), np.nan) if ratio is None else ratio.mean)
        truth.append(seen.margin)
        ratios.append(seen.ratio)
        pulled.append(seen.pulled)
        days.append(np.full(len(seen.margin), plan.day))
        wet.append(np.full(len(seen.margin), plan.condition == "wet"))
    margin, ratio, reading, day, is_wet, is_pulled = map(np.concatenate, (truth, ratios, read, days, wet, pulled))
    found: dict[str, Any] = {
        "trials": len(plans),
        "frames": len(margin),
        "set": "selection" if selection else "test",
        "weights_sha256": run.manifest.weights_sha256,
    }
    for condition, rows in (("dry", ~is_wet), ("wet", is_wet)):
        if np.isfinite(reading).all():
            found[f"ratio_r2_{condition}"] = r2(ratio[rows], reading[rows])
        for name, estimates in told.items():
            answer = np.concatenate([one.margin for one in estimates])
            key = f"{name}_r2_{condition}"
            found[key], found[f"{key}_low"], found[f"{key}_high"] = with_interval(
                margin[rows], answer[rows], day[rows], rng=np.random.default_rng(0)
            )
            some = rows & is_pulled
            found[f"{key}_pull_alone"] = r2(margin[some], answer[some])
            ends = [one.interval(0.9) for one in estimates]
            low, high = (np.concatenate([end[at] for end in ends if end is not None]) for at in (0, 1))
            inside = (margin >= low) & (margin <= high)
            found[f"{name}_in_90_{condition}"] = float(inside[rows].mean())
    return found


def measure_sequences(run: Run, *, selection: bool, trials: int | None = None) -> dict[str, Any]:
    """R2 of the margin from one frame, and where all frames of a trial are read in order, with intervals."""
    recipe = test_recipe(selection=selection)
    require_disjoint([plan for plan in plan_trials(recipe) if plan.split == "test"])
    plans = [plan for plan in plan_trials(replace(recipe, pulls=PULLS["varied"])) if plan.split == "test"]
    plans = plans[:: max(1, len(plans) // trials)] if trials else plans
    parts: list[np.ndarray] = []
    for plan in plans:
        loading, film = prepare_trial(plan)
        contact = np.flatnonzero(np.isfinite(loading.safety_margin))
        frames = film.draw(slice(int(contact[0]), int(contact[-1]) + 1)).numpy()
        one = run.to_estimate(*run.answers(run.encode(frames, film.draw_reference().numpy()).split(8)))
        several = run.follow().update(one, loading.time_s[contact], np.ones(len(contact), dtype=bool))
        margin = loading.safety_margin[contact]
        low, high = several.interval(0.9) or (margin, margin)
        facts = (np.full(len(margin), fact) for fact in (plan.day, plan.condition == "wet"))
        slipped = np.cumsum(margin == 0) > 0
        parts.append(
            np.stack([margin, one.margin, several.margin, slipped, (margin >= low) & (margin <= high), *facts])
        )
    margin, one, several, slipped, held, day, wet = np.concatenate(parts, axis=1)
    found: dict[str, Any] = {"sequence_frames": len(margin)}
    for condition, rows in (("dry", wet == 0), ("wet", wet == 1)):
        for name, answer in (("one_of_several", one), ("several", several)):
            key = f"{name}_r2_{condition}"
            found[key], found[f"{key}_low"], found[f"{key}_high"] = with_interval(
                margin[rows], answer[rows], day[rows], rng=np.random.default_rng(0)
            )
            pulled = rows & (margin < 1) & (slipped == 0)
            found[f"{key}_before_slip"] = r2(margin[pulled], answer[pulled])
            for when, some in (("before", rows & (slipped == 0)), ("after", rows & (slipped == 1))):
                found[f"{name}_rmse_{condition}_{when}_slip"] = float(np.sqrt(np.mean((answer - margin)[some] ** 2)))
        found[f"several_in_90_{condition}"] = float(held[rows].mean())
    return found


def main() -> None:
    """Print what was measured, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("chromatouch-difference"), help="a trained network")
    parser.add_argument("--selection", action="store_true", help="the days on which variants are compared")
    parser.add_argument("--trials", type=int, help="about so many trials, for a quick look")
    parser.add_argument("--sequences", action="store_true", help="only what several frames tell")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        run = load(options.run)
    except SliplensError as error:
        sys.exit(f"{Path(__file__).name}: {error}")
    chosen = {"selection": options.selection, "trials": options.trials}
    found = {} if options.sequences else measure(run, **chosen)
    if run.sequence is not None:
        found |= measure_sequences(run, **chosen)
    if options.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        print(f"{name:32}", f"{value:.3f}" if isinstance(value, float) else value)


if __name__ == "__main__":
    main()
