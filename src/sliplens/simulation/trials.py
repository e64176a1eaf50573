"""Simulated trials: from a plan to a recording, and from a recipe to a data set on disk."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from sliplens.errors import InputError
from sliplens.recordings import Dataset, Recording
from sliplens.recordings.dataset import load_recording, save_recording, trial_info, trial_path, write_dataset_table
from sliplens.simulation.filming import film
from sliplens.simulation.loading import load_grasp
from sliplens.simulation.nuisances import draw_grasp, draw_unit
from sliplens.simulation.plan import SimulationRecipe, TrialPlan, plan_trials
from sliplens.simulation.rendering import Noise
from sliplens.simulation.sensor import CHROMATOUCH, Sensor


def simulate_trial(
    plan: TrialPlan,
    *,
    sensor: Sensor = CHROMATOUCH,
    device: str | torch.device = "cpu",
    on_frames: Callable[[int, int], None] | None = None,
) -> Recording:
    """Simulate one trial.

    Parameters
    ----------
    plan
        The trial, as `plan_trials` laid it out.
    sensor
        The fingertip.
    device
        Where to draw the frames.
    on_frames
        Called with the frames done and the frames in all, after each batch.
    """
    grasp_rng, load_rng, film_rng = np.random.default_rng(plan.seed).spawn(3)
    grasp = draw_grasp(plan.nuisances, day=plan.day_draw, wet=plan.condition == "wet", rng=grasp_rng)
    loading = load_grasp(grasp, frames=plan.frames, rng=load_rng)
    markers = sum(sensor.ring_counts)
    reference, frames = film(
        sensor,
        loading=loading,
        grasp=grasp,
        day=plan.day_draw,
        unit=draw_unit(plan.nuisances, markers=markers, rng=np.random.default_rng(plan.unit_seed)),
        rng=film_rng,
        noise=Noise(),
        device=device,
        on_frames=on_frames,
    )
    return Recording(
        trial=plan.trial,
        sensor=f"{sensor.name}-{plan.unit + 1}",
        day=plan.day,
        condition=plan.condition,
        reference=reference,
        frames=frames,
        time_s=loading.time_s,
        normal_force_n=loading.normal_force_n,
        tangential_force_n=loading.tangential_force_n,
        friction_coefficient=loading.friction_coefficient,
        safety_margin=loading.safety_margin,
        stick_ratio=loading.stick_ratio,
        contact_state=loading.contact_state,
    )


def simulate_dataset(
    folder: Path, recipe: SimulationRecipe, *, on_trial: Callable[[int, int], None] | None = None
) -> Dataset:
    """Simulate a data set into a folder; trials that are already there are kept.

    Parameters
    ----------
    folder
        Where to write `trials/*.parquet` and, last, `dataset.json`. It must hold trials of the same recipe, if any.
    recipe
        What to simulate.
    on_trial
        Called with the trials done and the trials in all, after each.

    Raises
    ------
    InputError
        If a trial that is there has another number of frames than the recipe asks for.
    """
    plans = plan_trials(recipe)
    table = []
    for index, plan in enumerate(plans):
        path = trial_path(folder, plan.trial)
        if path.is_file():
            recording = load_recording(path)
            if len(recording) != plan.frames:
                raise InputError(
                    f"{path} has {len(recording)} frames but the recipe asks for {plan.frames}; choose another folder"
                )
        else:
            recording = simulate_trial(plan)
            save_recording(recording, path)
        table.append(trial_info(recording, split=plan.split, path=path))
        if on_trial is not None:
            on_trial(index + 1, len(plans))
    write_dataset_table(folder, table, simulated=True)
    return Dataset.open(folder)
