"""How well the safety margin can be read from marker displacements at all: from one frame, from two, from a sequence.

Three answers, for both ways to move the markers and without any image:

- the Cramer-Rao bound with the simulator's priors, for each margin;
- what a perceptron reaches on the noisy displacements of fresh trials: so much a frame tells at least;
- what an exact posterior mean reaches that is told everything but margin and friction: no reader of one frame does
  better.

Views named `path` do not know how fast the pull is; the others see frames at known times, and in the simulator every
pull takes about as long as any other.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import nn

from sliplens.simulation import CHROMATOUCH, PRESETS, TrialPlan, plan_trials
from sliplens.simulation.geometry import Dome
from sliplens.simulation.intervention import (
    MARGIN,
    Sensitivity,
    least_sigma,
    marker_sensitivity,
    prior_sigma,
    visible_markers,
)
from sliplens.simulation.loading import TRIAL_S, load_at_margins, load_grasp
from sliplens.simulation.motion import move_markers
from sliplens.simulation.nuisances import Grasp, Nuisances, Touch, draw_day, draw_grasp, draw_unit

MODELS = ("calibrated", "half-space")
FRAMES = 50
"""Of a trial: 6.25 a second, enough for a pull of 6 s."""
STEP_S = TRIAL_S / FRAMES
MARGINS = np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98])
DOME = cast("Dome", CHROMATOUCH.geometry)
LEAN = replace(CHROMATOUCH, geometry=replace(DOME, ring_counts=DOME.ring_counts[:5], ring_scale=DOME.ring_scale[:5]))
"""Without the outermost ring, which the camera does not see."""
SEEN = visible_markers(LEAN)
THESIS = replace(PRESETS["thesis"], nuisances=Nuisances())
FRICTIONS = np.linspace(0.12, 1.34, 100)
"""All that can occur in contact, dry or wet."""
MIXTURES = {"mixed": 1, "mixed 4:1": 4, "mixed 16:1": 16}
"""Dry frames for each wet one: who weighs dry frames more reads them better, at the cost of the wet."""
VIEWS = {
    "1": "one frame",
    "2": "and one 0.5 s earlier",
    "8": "8 frames, the last 2.2 s",
    "all": "12 frames since touch, and the time since",
    "path 2": "and the last frame before the pull",
    "path 12": "12 frames at even steps of the shear",
}


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One simulated trial, reduced to what the markers show and to the truth."""

    plan: TrialPlan
    grasp: Grasp
    marker_depth: float
    shift_px: Float[np.ndarray, "frames coordinates"]
    """Displacement of the visible markers."""
    margin: Float[np.ndarray, " frames"]
    load_n: Float[np.ndarray, " frames"]
    """Normal force, with what creep adds to the contact."""
    touched: int
    """The first frame in contact."""
    held: int
    """The last frame before the pull, which the markers themselves show."""
    slipped: int
    """The first frame in full slip."""


def run_trial(plan: TrialPlan, model: str) -> Trial:
    """Load a trial and move its markers as `prepare_trial` does, but prepare nothing to be drawn."""
    ranges, sensor = plan.recipe.nuisances, plan.recipe.sensor
    grasp_rng, load_rng, _ = np.random.default_rng(plan.seed).spawn(3)
    grasp = draw_grasp(ranges, day=plan.day_draw, wet=plan.condition == "wet", rng=grasp_rng)
    loading = load_grasp(grasp, frames=FRAMES, rng=load_rng)
    unit = draw_unit(ranges, markers=sensor.geometry.markers, rng=np.random.default_rng(plan.unit_seed))
    touch = Touch(grasp=grasp, modulus_factor=plan.day_draw.modulus_factor, marker_depth=unit.marker_depth)
    motion = move_markers(LEAN, touch, loading=loading, displacement=model)
    touching = np.flatnonzero(~np.isnan(loading.safety_margin))
    return Trial(
        plan=plan,
        grasp=grasp,
        marker_depth=unit.marker_depth,
        shift_px=(motion.centres_px - motion.rest_px)[:, SEEN].reshape(FRAMES, -1),
        margin=loading.safety_margin,
        load_n=loading.normal_force_n * (1 + grasp.creep * (1 - np.exp(-loading.held_s / grasp.creep_time_s))),
        touched=int(touching[0]),
        held=int(np.flatnonzero(loading.safety_margin == 1)[-1]),
        slipped=int(np.flatnonzero(loading.safety_margin == 0)[0]),
    )


def plan_many(days: int, *, trials: int) -> list[TrialPlan]:
    """Lay out fresh days of the thesis preset, dry and wet trials on each, with its sensor."""
    recipe = replace(THESIS, days=days + 4, dry_trials=trials * (days + 4), wet_trials=0, frame_totals=None)
    # the preset's own days are kept aside: they test
    dry = [plan for plan in plan_trials(recipe) if plan.day > 4]
    return dry + [replace(plan, condition="wet", seed=plan.seed + 1) for plan in dry]


@dataclass(frozen=True, kw_only=True)
class Bank:
    """Trials in the basis of their displacements, whose directions of little motion are left out."""

    trials: Sequence[Trial]
    parts: Float[np.ndarray, "trials frames parts"]
    unit: Float[np.ndarray, " trials"]


def make_bank(trials: Sequence[Trial], basis: Float[np.ndarray, "coordinates parts"]) -> Bank:
    """Put trials in a basis."""
    return Bank(
        trials=trials,
        parts=np.stack([(trial.shift_px @ basis).astype(np.float32) for trial in trials]),
        unit=np.array([float(trial.plan.unit) for trial in trials]),
    )


def find_basis(trials: Sequence[Trial], *, noise_px: float) -> Float[np.ndarray, "coordinates parts"]:
    """Orthonormal directions in which displacements vary by a fifth of the noise or more."""
    shifts = np.concatenate([trial.shift_px[::5] for trial in trials])
    values, vectors = np.linalg.eigh(shifts.T @ shifts / len(shifts))
    return vectors[:, values > (noise_px / 5) ** 2][:, ::-1]


def view_frames(trial: Trial, now: int, view: str) -> Float[np.ndarray, " frames"]:
    """Choose the frames of a view, the present one last; fractions lie between two frames."""
    match view:
        case "1":
            return np.array([now], dtype=float)
        case "2":
            return np.array([max(now - 3, 0), now], dtype=float)
        case "8":
            return np.maximum(now - 2.0 * np.arange(7, -1, -1), 0)
        case "all":
            return trial.touched + (now - trial.touched) * np.linspace(0, 1, 12)
    held = min(trial.held, now)
    if view == "path 2":
        return np.array([held, now], dtype=float)
    mean = trial.shift_px[held : now + 1].reshape(now + 1 - held, -1, 2).mean(axis=1)
    path = np.maximum.accumulate(np.linalg.norm(mean - mean[0], axis=1)) + 1e-9 * np.arange(len(mean))
    chosen = held + np.interp(np.linspace(0, path[-1], 12), path, np.arange(len(path)))
    chosen[-1] = now
    return chosen


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Noiseless inputs of a view, labels, and where they come from."""

    inputs: torch.Tensor
    """(samples, frames, parts)."""
    known: torch.Tensor
    """(samples, 2): which sensor, and the time since touch where the view has it."""
    margin: torch.Tensor
    wet: Bool[np.ndarray, " samples"]
    pull: Bool[np.ndarray, " samples"]
    """Between full stick and the first full slip."""
    day: Int[np.ndarray, " samples"]


def look(bank: Bank, view: str) -> Samples:
    """See every labelled frame of a bank through a view."""
    rows, frames, margins, waited, pulled = [], [], [], [], []
    for row, trial in enumerate(bank.trials):
        for now in np.flatnonzero(~np.isnan(trial.margin)):
            rows.append(row)
            frames.append(view_frames(trial, int(now), view))
            margins.append(trial.margin[now])
            pulled.append(trial.held < now < trial.slipped)
            waited.append((now - trial.touched) * STEP_S if view == "all" else 0.0)
    row, place = np.array(rows), np.stack(frames)
    below = np.minimum(place.astype(int), FRAMES - 2)
    share = (place - below).astype(np.float32)[..., None]
    inputs = (1 - share) * bank.parts[row[:, None], below] + share * bank.parts[row[:, None], below + 1]
    return Samples(
        inputs=torch.tensor(inputs, dtype=torch.float32),
        known=torch.tensor(np.stack([bank.unit[row], waited], axis=1), dtype=torch.float32),
        margin=torch.tensor(np.array(margins), dtype=torch.float32),
        wet=np.array([trial.plan.condition == "wet" for trial in bank.trials])[row],
        pull=np.array(pulled),
        day=np.array([trial.plan.day for trial in bank.trials])[row],
    )


def train(
    samples: Samples, chosen: Int[np.ndarray, " chosen"], *, noise_px: float, steps: int, seed: int
) -> nn.Sequential:
    """Train a perceptron to the mean of the margin given a view; every step draws its noise anew."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.from_numpy(chosen)
    first = torch.cat([_noisy(samples, rows, noise_px, generator), samples.known[rows]], dim=1)
    middle, spread = first.mean(dim=0), first.std(dim=0).clamp_min(1e-3)
    width = first.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = [layer for before, after in ((width, 128), (128, 128), (128, 128)) for layer in _dense(before, after)]
        network = nn.Sequential(_Scale(middle, spread), *layers, nn.Linear(128, 1), nn.Flatten(0))
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=3e-3, total_steps=steps)
    for _ in range(steps):
        batch = rows[torch.randint(len(rows), (512,), generator=generator)]
        inputs = torch.cat([_noisy(samples, batch, noise_px, generator), samples.known[batch]], dim=1)
        loss = nn.functional.mse_loss(network(inputs), samples.margin[batch])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network


class _Scale(nn.Module):
    def __init__(self, middle: torch.Tensor, spread: torch.Tensor) -> None:
        super().__init__()
        self.middle, self.spread = middle, spread

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return (inputs - self.middle) / self.spread


def _dense(before: int, after: int) -> Iterator[nn.Module]:
    yield nn.Linear(before, after)
    yield nn.GELU()


def _noisy(samples: Samples, rows: torch.Tensor, noise_px: float, generator: torch.Generator) -> torch.Tensor:
    clean = samples.inputs[rows]
    return (clean + noise_px * torch.randn(clean.shape, generator=generator)).flatten(1)


def read(
    network: nn.Sequential, samples: Samples, rows: torch.Tensor, *, noise_px: float
) -> Float[np.ndarray, " samples"]:
    """Margins that a network reads of some samples."""
    inputs = torch.cat([_noisy(samples, rows, noise_px, torch.Generator().manual_seed(1)), samples.known[rows]], dim=1)
    with torch.no_grad():
        return network(inputs).clamp(0, 1).double().numpy()


@lru_cache
def friction_density(condition: str) -> Float[np.ndarray, " frictions"]:
    """How often a frame has which friction of the grid, from many draws: dry, wet, or so many dry for one wet."""
    if condition in MIXTURES:
        parts = MIXTURES[condition]
        return (parts * friction_density("dry") + friction_density("wet")) / (parts + 1)
    ranges, rng, count = THESIS.nuisances, np.random.default_rng(0), 400_000
    if condition == "wet":
        drift = rng.uniform(*ranges.wet_friction_drift, count) * rng.uniform(-1, 1, count)
        draws = rng.uniform(*ranges.wet_friction, count) * (1 + drift)
    else:
        draws = rng.uniform(*ranges.dry_friction, count) * rng.uniform(*ranges.dry_friction_factor, count)
    half = (FRICTIONS[1] - FRICTIONS[0]) / 2
    return np.histogram(draws, len(FRICTIONS), (FRICTIONS[0] - half, FRICTIONS[-1] + half))[0] / count


def posterior_errors(
    trial: Trial, now: int, *, model: str, basis: np.ndarray, noise_px: float, rng: np.random.Generator
) -> dict[tuple[str, str], float]:
    """Squared errors of posterior means from one frame of the pull, summed on a grid of margin and friction.

    `told` knows every nuisance but the friction: the variance of its exact posterior. `untold` knows their variances:
    it takes them as Gaussian and the markers as linear in them round the truth. Each with the friction of the trial's
    own condition as prior, and with mixtures of both.
    """
    used, exponent = np.linspace(0, 1, 33), trial.grasp.shear_exponent
    nodes = np.linspace(FRICTIONS[0], FRICTIONS[-1], 9)
    grasp = replace(trial.grasp, normal_force_n=float(trial.load_n[now]))
    margins = np.tile((1 - used) ** (1 / exponent), len(nodes))
    loading = replace(load_at_margins(margins, grasp=grasp), friction_coefficient=np.repeat(nodes, len(used)))
    touch = Touch(grasp=grasp, modulus_factor=trial.plan.day_draw.modulus_factor, marker_depth=trial.marker_depth)
    motion = move_markers(LEAN, touch, loading=loading, displacement=model)
    shift = (motion.centres_px - motion.rest_px)[:, SEEN].reshape(len(margins), -1) @ basis
    # the markers go evenly with friction and with 1 - Gamma^p: straight lines between the nodes will do
    fine = np.linspace(0, 1, 601)
    over, along = (
        np.stack([np.interp(to, at, unit) for unit in np.eye(len(at))], axis=1)
        for to, at in ((FRICTIONS, nodes), (fine, used))
    )
    guess = np.matmul(along, np.tensordot(over, shift.reshape(len(nodes), len(used), -1), axes=1))
    margin = (1 - fine) ** (1 / exponent)
    seen = trial.shift_px[now] @ basis + rng.normal(0, noise_px, basis.shape[1])
    off, spread = _marginal(trial, grasp, margin=trial.margin[now : now + 1], model=model, basis=basis)
    root = np.linalg.cholesky(noise_px**2 * np.eye(len(seen)) + spread @ spread.T)
    errors = {}
    for reader, residual in (
        ("told", (seen - guess) / noise_px),
        ("untold", (seen - guess - off) @ np.linalg.inv(root).T),
    ):
        misfit = np.sum(residual**2, axis=-1)
        likelihood = np.exp((misfit.min() - misfit) / 2) * np.abs(np.gradient(margin))
        for prior in (trial.plan.condition, *MIXTURES):
            weight = friction_density(prior)[:, None] * likelihood
            mean = np.sum(weight * margin) / weight.sum()
            error = (mean - trial.margin[now]) ** 2
            if reader == "told" and prior == trial.plan.condition:
                # the same on average over noise and trials, and steadier; with another prior it is not
                error = np.sum(weight * (margin - mean) ** 2) / weight.sum()
            errors[reader, prior] = float(error)
    return errors


def _marginal(
    trial: Trial, grasp: Grasp, *, margin: Float[np.ndarray, "1"], model: str, basis: np.ndarray
) -> tuple[Float[np.ndarray, " parts"], Float[np.ndarray, "parts nuisances"]]:
    """Where the nuisances' prior puts the markers on average, seen from the truth, and how it spreads them."""
    ranges = THESIS.nuisances
    touch = Touch(grasp=grasp, modulus_factor=trial.plan.day_draw.modulus_factor, marker_depth=trial.marker_depth)
    slope = marker_sensitivity(margin, sensor=LEAN, touch=touch, displacement=model)
    # friction is on the grid, and the depth of the preset's two sensors can be learnt
    known = ("log_friction", "marker_depth")
    sigma = {name: value for name, value in prior_sigma(ranges, wet=False).items() if name not in known}
    spread = basis.T @ slope.jacobian[0][:, [slope.unknowns.index(name) for name in sigma]] * list(sigma.values())
    centre = {
        "offset_x": -grasp.contact_offset[0],
        "offset_y": -grasp.contact_offset[1],
        "tilt_x_rad": -grasp.tilt_rad[0],
        "tilt_y_rad": -grasp.tilt_rad[1],
        "direction_rad": np.pi / 2 - grasp.shear_direction_rad,
        "shear_exponent": np.mean(ranges.shear_exponent) - grasp.shear_exponent,
    }
    return spread @ np.array([centre.get(name, 0.0) / value for name, value in sigma.items()]), spread


def margin_bound(
    sensitivity: Sensitivity, *, noise_px: float, prior: Mapping[str, float]
) -> Float[np.ndarray, " frames"]:
    """Bound on the standard deviation of the safety margin that is read from one frame, for each frame.

    The square root of the margin's entry in (J^T J / sigma^2 + diag(1 / prior^2))^-1: without priors the bound of
    Cramer and Rao, with priors on the nuisances the hybrid one, with one on the margin too that of Van Trees here.

    `noise_px`: standard deviation of each coordinate, in pixels; `prior`: standard deviation of each unknown before the
    frame is seen; infinite where nothing is known. A nuisance that is left out is known; a margin that is left out is
    not.

    Kay, *Fundamentals of Statistical Signal Processing* I (1993), section 3.7; Van Trees, *Detection, Estimation, and
    Modulation Theory* I (1968), section 2.4; Gill and Levit, *Bernoulli* 1 (1995) 59.
    """
    known = {"noise_px": noise_px, "prior": prior}
    return np.array([least_sigma(jacobian, sensitivity.unknowns, **known) for jacobian in sensitivity.jacobian])


def sequence_bound(
    sensitivity: Sensitivity, *, noise_px: float, prior: Mapping[str, float], pull_known: bool = False
) -> float:
    """Bound on the standard deviation of the last frame's margin, read from all frames together.

    They are of one trial, and share every nuisance.

    `sensitivity`: from `marker_sensitivity`; the last frame is the one asked for; `pull_known`: whether it is known by
    how much the margin fell between the frames, from a clock and a steady pull; else every frame's margin is an unknown
    of its own.
    """
    (frames, coordinates, unknowns), names = sensitivity.jacobian.shape, sensitivity.unknowns
    if pull_known:
        return least_sigma(sensitivity.jacobian.reshape(-1, unknowns), names, noise_px=noise_px, prior=prior)
    own = np.zeros((frames, coordinates, frames))
    own[np.arange(frames), :, np.arange(frames)] = sensitivity.jacobian[..., 0]
    # the last frame's margin first
    stacked = np.concatenate([own[..., ::-1], sensitivity.jacobian[..., 1:]], axis=-1)
    earlier = tuple(f"earlier {index}" for index in range(1, frames))
    unbounded = {**prior, **dict.fromkeys(earlier, np.inf)}
    rows, every = stacked.reshape(frames * coordinates, -1), (MARGIN, *earlier, *names[1:])
    return least_sigma(rows, every, noise_px=noise_px, prior=unbounded)


def bound_tables(touches: int, *, seed: int) -> list[dict[str, object]]:
    """Cramer-Rao bounds for each margin: the median over touches drawn as the simulator draws them."""
    ranges, rows = THESIS.nuisances, []
    for model in MODELS:
        for friction in ("known", "dry", "wet", "unknown"):
            wet, rng = friction == "wet", np.random.default_rng(seed)
            prior = prior_sigma(ranges, wet=wet)
            prior["log_friction"] = np.inf if friction == "unknown" else prior["log_friction"]
            if friction == "known":
                del prior["log_friction"]
            seen = [
                marker_sensitivity(MARGINS, sensor=LEAN, touch=_draw_touch(rng, wet=wet), displacement=model)
                for _ in range(touches)
            ]
            for noise_px in (0.05, 0.1, 0.2):
                bounds = [margin_bound(one, noise_px=noise_px, prior=prior) for one in seen]
                row = {"model": model, "friction": friction, "noise_px": noise_px}
                rows.append({**row, "margin": MARGINS.tolist(), "sigma": np.median(bounds, axis=0).tolist()})
    return rows


def _draw_touch(rng: np.random.Generator, *, wet: bool) -> Touch:
    ranges = THESIS.nuisances
    day = draw_day(ranges, quantile=rng.uniform(), rng=rng)
    grasp = draw_grasp(ranges, day=day, wet=wet, rng=rng)
    return Touch(grasp=grasp, modulus_factor=day.modulus_factor, marker_depth=rng.uniform(*ranges.marker_depth))


def sequence_tables(touches: int, *, noise_px: float, seed: int) -> list[dict[str, object]]:
    """Cramer-Rao bounds of sequences of a dry trial, with and without knowing how fast the margin falls."""
    rows = []
    prior = prior_sigma(THESIS.nuisances, wet=False)
    for model in MODELS:
        for now in (0.2, 0.5, 0.8):
            # evenly from just before the pull
            paths = {1: [now], 2: [0.99, now], 8: np.linspace(0.99, now, 8)}
            for count, path in paths.items():
                rng = np.random.default_rng(seed)
                some = [
                    marker_sensitivity(
                        np.array(path), sensor=LEAN, touch=_draw_touch(rng, wet=False), displacement=model
                    )
                    for _ in range(touches)
                ]
                for clock in (False, True) if count > 1 else (False,):
                    sigma = [sequence_bound(one, noise_px=noise_px, prior=prior, pull_known=clock) for one in some]
                    row = {"model": model, "margin": now, "frames": count, "pull_known": clock}
                    rows.append({**row, "sigma": float(np.median(sigma))})
    return rows


def early_figures() -> list[dict[str, object]]:
    """Bounds without priors in the settings that come closest to the project's first figures."""
    stiff = replace(LEAN, youngs_modulus_pa=105_000.0)
    settings = (
        ("half-space", stiff, Grasp(contact_offset=(0.0, 0.0)), (0.016, 0.048, 0.18)),
        ("calibrated", LEAN, Grasp(normal_force_n=0.7, contact_offset=(0.05, 0.03)), (0.12, 0.38, 1.5)),
    )
    rows = []
    for model, sensor, grasp, first in settings:
        touch = Touch(grasp=grasp, marker_depth=0.0)
        seen = marker_sensitivity(np.array([0.2, 0.5, 0.8]), sensor=sensor, touch=touch, displacement=model)
        known, unknown = (
            margin_bound(seen, noise_px=0.1, prior=prior).tolist() for prior in ({}, {"log_friction": np.inf})
        )
        rows.append({"model": model, "known": known, "unknown": unknown, "first": first})
    return rows


def score(errors: np.ndarray, *, margin: np.ndarray, pull: np.ndarray) -> dict[str, object]:
    """MSE, R2, R2 if frames outside the pull were read without error, and rms error in ten bins of the margin."""
    bins = np.minimum(margin * 10, 9).astype(int)
    return {
        "mse": float(errors.mean()),
        "r2": float(1 - errors.mean() / margin.var()),
        "r2_pull": float(1 - (errors * pull).mean() / margin.var()),
        "rms_by_margin": [
            float(np.sqrt(errors[bins == index].mean())) if np.any(bins == index) else None for index in range(10)
        ],
    }


def reach(model: str, arguments: argparse.Namespace) -> tuple[list[dict[str, object]], list[dict[str, object]]]:
    """What perceptrons reach through every view, and the posterior means beside the single frame."""
    noise_px, seed = arguments.noise, arguments.seed
    fresh = [run_trial(plan, model) for plan in plan_many(arguments.days, trials=arguments.trials)]
    thesis = [run_trial(plan, model) for plan in plan_trials(THESIS)]
    # whole days test: a day has its friction and stiffness in common
    last = 4 + round(0.8 * arguments.days)
    basis = find_basis([trial for trial in fresh if trial.plan.day <= last], noise_px=noise_px)
    banks = [make_bank(trials, basis) for trials in (fresh, thesis)]
    reached = []
    for view in VIEWS:
        many, few = (look(bank, view) for bank in banks)
        dry, wet = (np.flatnonzero((many.day <= last) & (many.wet == kind)) for kind in (False, True))
        training = {
            "mixed": (many, np.concatenate([dry, wet])),
            # drawn at random: what stands there four times is drawn four times as often
            "mixed 4:1": (many, np.concatenate([dry] * 4 + [wet])),
            "dry": (many, dry),
            "thesis days": (few, np.flatnonzero(few.day < 4)),
        }
        tests = {"fresh days": (many, many.day > last), "thesis day 4": (few, few.day == 4)}
        for name, (samples, chosen) in training.items():
            steps = arguments.steps // (4 if samples is few else 1)
            network = train(samples, chosen, noise_px=noise_px, steps=steps, seed=seed)
            for test, (others, kept) in tests.items():
                for condition in ("dry", "wet"):
                    rows = np.flatnonzero(kept & (others.wet == (condition == "wet")))
                    margin = others.margin.double().numpy()[rows]
                    errors = (read(network, others, torch.from_numpy(rows), noise_px=noise_px) - margin) ** 2
                    row = {"model": model, "frames": view, "training": name, "test": test, "condition": condition}
                    reached.append({**row, **score(errors, margin=margin, pull=others.pull[rows])})
                    print(*row.values(), f"MSE {reached[-1]['mse']:.4f} R2 {reached[-1]['r2']:.3f}", flush=True)
    rng, posterior = np.random.default_rng(seed), []
    for condition in ("dry", "wet"):
        some = [trial for trial in fresh if trial.plan.day > last and trial.plan.condition == condition]
        labels = np.concatenate([trial.margin[~np.isnan(trial.margin)] for trial in some])
        # frames outside the pull are given away: those are read without error
        share = sum(trial.slipped - trial.held - 1 for trial in some) / len(labels)
        picked = [some[index] for index in rng.choice(len(some), min(arguments.posteriors, len(some)), replace=False)]
        found = [
            posterior_errors(
                trial,
                int(rng.integers(trial.held + 1, trial.slipped)),
                model=model,
                basis=basis,
                noise_px=noise_px,
                rng=rng,
            )
            for trial in picked
        ]
        for reader, prior in found[0]:
            errors = share * np.array([one[reader, prior] for one in found])
            r2, error = 1 - errors.mean() / labels.var(), errors.std() / np.sqrt(len(errors)) / labels.var()
            row = {"model": model, "condition": condition, "reader": reader, "prior": prior}
            posterior.append({**row, "mse": float(errors.mean()), "r2": float(r2), "r2_error": float(error)})
            print(*row.values(), f"R2 {r2:.3f} +- {error:.3f}", flush=True)
    return reached, posterior


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--days", type=int, default=400, help="fresh days to draw; a fifth tests")
    parser.add_argument("--trials", type=int, default=4, help="dry trials a day, and as many wet ones")
    parser.add_argument("--steps", type=int, default=700, help="of training, of 512 frames each")
    parser.add_argument("--touches", type=int, default=40, help="touches over which bounds are summarised")
    parser.add_argument("--posteriors", type=int, default=120, help="frames whose posterior is summed")
    parser.add_argument("--noise", type=float, default=0.1, help="standard deviation of a marker's coordinate, in px")
    parser.add_argument("--seed", type=int, default=0, help="of touches, noise and training")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    numbers: dict[str, list[dict[str, object]]] = {
        "bound": bound_tables(arguments.touches, seed=arguments.seed),
        "sequence": sequence_tables(arguments.touches, noise_px=arguments.noise, seed=arguments.seed),
        "early": early_figures(),
        "bayes_r2": [],
        "posterior": [],
    }
    for row in numbers["bound"] + numbers["sequence"] + numbers["early"]:
        print(json.dumps(row))
    for model in MODELS:
        reached, posterior = reach(model, arguments)
        numbers["bayes_r2"] += reached
        numbers["posterior"] += posterior
    if arguments.json:
        print(json.dumps(numbers))


if __name__ == "__main__":
    main()
