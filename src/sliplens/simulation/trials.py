"""Simulated trials: from a plan to a recording, to a data set on disk, or to frames drawn when asked for."""

import weakref
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sliplens.errors import InputError
from sliplens.extras import require_device
from sliplens.files import output_folder, scratch_folder
from sliplens.progress import OnProgress, counted, number_of, stage, wrote
from sliplens.recordings import Dataset, GroundTruth, Recording
from sliplens.recordings.dataset import load_dataset, trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import read_header, save_recording
from sliplens.recordings.trial import SIGNALS
from sliplens.simulation.filming import Film, batches, move_camera, prepare_film
from sliplens.simulation.loading import Loading, load_grasp
from sliplens.simulation.nuisances import draw_grasp, draw_unit
from sliplens.simulation.plan import SimulationRecipe, TrialPlan, make_recipe, plan_trials


def prepare_trial(plan: TrialPlan, *, change: Callable[[Loading], Loading] | None = None) -> tuple[Loading, Film]:
    """Load a trial, change its loading if asked, and make it ready to be drawn."""
    recipe, unit_rng = plan.recipe, np.random.default_rng(plan.unit_seed)
    grasp_rng, load_rng, rng = np.random.default_rng(plan.seed).spawn(3)
    day, sensor = plan.day_draw, recipe.sensor
    grasp = draw_grasp(recipe.nuisances, day=day, wet=plan.condition == "wet", rng=grasp_rng)
    loading = load_grasp(grasp, frames=plan.frames, rng=load_rng, release=recipe.release, pulls=recipe.pulls)
    if change is not None:
        loading = change(loading)
    unit = draw_unit(recipe.nuisances, markers=sensor.geometry.markers, rng=unit_rng)
    displacement = recipe.resolved_displacement
    film = prepare_film(
        sensor, loading=loading, grasp=grasp, day=day, unit=unit, rng=rng, noise=sensor.noise, displacement=displacement
    )
    return loading, move_camera(film, recipe.nuisances, rng=rng)


def simulate_trial(
    plan: TrialPlan, *, device: str | torch.device = "cpu", on_progress: OnProgress | None = None
) -> Recording:
    """Simulate one trial."""
    loading, film = prepare_trial(plan)
    reference = film.draw_reference(device=device).cpu().numpy()
    frames = np.empty((plan.frames, *reference.shape), dtype=np.uint8)
    contact_map = np.empty(frames.shape[:3], dtype=np.uint8)
    for part in batches(plan.frames, device=device):
        frames[part] = film.draw(part, device=device).cpu().numpy()
        contact_map[part] = film.contact_map(part)
        if on_progress is not None:
            on_progress(part.stop, plan.frames)
    return Recording(
        trial=plan.trial,
        sensor=f"{plan.recipe.sensor.name}-{plan.unit + 1}",
        day=plan.day,
        condition=plan.condition,
        reference=reference,
        frames=frames,
        **{name: getattr(loading, name) for name in (*SIGNALS, "contact_state")},
        truth=GroundTruth(
            recipe=plan.recipe_hash,
            displacement=plan.recipe.resolved_displacement,
            marker_rest_px=film.marker_rest_px.astype(np.float32),
            marker_px=film.marker_px.astype(np.float32),
            static_friction=loading.static_friction,
            contact_radius_m=film.motion.contact_radius_m,
            stick_radius_m=film.motion.stick_radius_m,
            contact_map=contact_map,
        ),
    )


def simulate_examples(
    recipe: SimulationRecipe, *, device: str | torch.device = "cpu", on_progress: OnProgress | None = None
) -> list[Recording]:
    """Simulate four trials at most that show the range of a recipe, a wet one last."""
    plans = plan_trials(recipe)
    dry = [plan for plan in plans if plan.condition == "dry"]
    wet = [plan for plan in plans if plan.condition == "wet"][:1]
    shown = min(4 - len(wet), len(dry))
    chosen = [dry[index * (len(dry) - 1) // max(1, shown - 1)] for index in range(shown)] + wet
    return [simulate_trial(plan, device=device) for plan in counted(chosen, on_progress)]


def simulate(
    out: Path | str | None = None,
    *,
    preset: str = "small",
    sensor: str | None = None,
    device: str = "cpu",
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **changes: Any,
) -> Dataset:
    """Simulate a data set of labelled trials.

    Interrupted, it goes on after the last whole trial when it is called again with the same `out`.

    Parameters
    ----------
    out
        Folder to write; a temporary one that lives as long as what is returned if None.
    preset, sensor, changes
        As `make_recipe` takes them: `preset="small"` is made for a laptop, `"thesis"` has the days and frames of the
        thesis; `pulls="varied"` makes no pull like another; `dry_trials`, `wet_trials`, `days`, `frames_per_trial` or
        `seed` change it.
    device
        Where to draw the frames: cpu, cuda or cuda:1. A GPU's pixels may differ by one grey level.

    Raises
    ------
    InputError
        If the recipe cannot be followed, the device is not there, or the folder holds something else.
    """
    require_device(device)
    recipe = make_recipe(preset, sensor=sensor, **changes)
    if out is None:
        with ExitStack() as stack, stage(on_progress, "Simulating frames") as count:
            folder = stack.enter_context(scratch_folder())
            data = simulate_dataset(folder, recipe, device=device, on_progress=count)
            weakref.finalize(data, stack.pop_all().close)
        return data
    out, config = Path(out), {"recipe": recipe.told, "device": device}
    with output_folder(out, stage="simulate", config=config, overwrite=overwrite) as output:
        if not output.complete:
            with stage(on_progress, "Simulating frames") as count:
                simulate_dataset(output.folder, recipe, device=device, on_progress=count)
    data = load_dataset(out)
    written = f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}"
    wrote(on_progress, out, written, kept=output.complete)
    return data


def simulate_dataset(
    folder: Path, recipe: SimulationRecipe, *, device: str | torch.device = "cpu", on_progress: OnProgress | None = None
) -> Dataset:
    """Simulate `trials/*.parquet` and, last, `dataset.json` into a folder; trials that are already there are kept.

    Raises
    ------
    InputError
        If a trial that is there was made by another recipe.
    """
    plans = plan_trials(recipe)
    total = sum(plan.frames for plan in plans)
    table, done = [], 0

    def report(drawn: int, _: int) -> None:
        if on_progress is not None:
            on_progress(done + drawn, total)

    for plan in plans:
        path = trial_path(folder, plan.trial)
        if path.is_file():
            truth = read_header(path).truth
            if truth is None or truth.recipe != plan.recipe_hash:
                raise InputError(f"{path} was made by another recipe; choose another folder")
        else:
            save_recording(simulate_trial(plan, device=device, on_progress=report), path)
        table.append(trial_info(path, split=plan.split))
        done += plan.frames
        report(0, 0)
    write_dataset_table(folder, table, simulated=True)
    return load_dataset(folder)
