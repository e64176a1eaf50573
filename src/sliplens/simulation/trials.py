"""Simulated trials: from a plan to a recording, from a recipe to a data set, and scenes drawn again."""

import weakref
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np
import torch
from jaxtyping import Bool, Int

from sliplens._version import __version__
from sliplens.errors import InputError
from sliplens.extras import require_keywords
from sliplens.files import output_folder, scratch_folder
from sliplens.progress import OnProgress, number_of, open_stage, report_each, report_file, reporting
from sliplens.recordings import Dataset, GroundTruth, Recording
from sliplens.recordings.dataset import load_dataset, trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import read_header, save_recording
from sliplens.recordings.trial import SIGNALS
from sliplens.simulation.filming import Film, batches, move_camera, prepare_film
from sliplens.simulation.loading import Loading, load_grasp
from sliplens.simulation.nuisances import draw_grasp, draw_unit
from sliplens.simulation.plan import RecipeChanges, SimulationRecipe, TrialPlan, make_recipe, plan_trials, read_recipe
from sliplens.simulation.sensor import Sensor


def prepare_trial(plan: TrialPlan, *, change: Callable[[Loading], Loading] | None = None) -> tuple[Loading, Film]:
    """Load a trial, change its loading if a function for that is given, and make it ready to be drawn."""
    recipe, sensor = plan.recipe, plan.recipe.sensor
    grasp_rng, load_rng, rng = np.random.default_rng(plan.seed).spawn(3)
    grasp = draw_grasp(recipe.nuisances, day=plan.day_draw, wet=plan.condition == "wet", rng=grasp_rng)
    loading = load_grasp(
        grasp, frames=plan.frames, rng=load_rng, release=recipe.release, varied=recipe.pulls == "varied"
    )
    if change is not None:
        loading = change(loading)
    film = prepare_film(
        sensor,
        loading=loading,
        grasp=grasp,
        day=plan.day_draw,
        unit=draw_unit(recipe.nuisances, markers=sensor.geometry.markers, rng=np.random.default_rng(plan.unit_seed)),
        rng=rng,
        displacement=recipe.displacement,
    )
    return loading, move_camera(film, recipe.nuisances, rng=rng)


def simulate_trial(plan: TrialPlan) -> Recording:
    """Simulate one trial."""
    loading, film = prepare_trial(plan)
    reference = film.draw_reference().numpy()
    frames = np.empty((plan.frames, *reference.shape), dtype=np.uint8)
    contact_map = np.empty(frames.shape[:3], dtype=np.uint8)
    parts = batches(plan.frames)
    for part in report_each(parts, sizes=[part.stop - part.start for part in parts]):
        frames[part] = film.draw(part).numpy()
        contact_map[part] = film.contact_map(part)
    return Recording(
        trial=plan.trial,
        sensor=f"{plan.recipe.sensor.name}-{plan.unit + 1}",
        day=plan.day,
        condition=plan.condition,
        reference=reference,
        frames=frames,
        **{name: getattr(loading, name) for name in (*SIGNALS, "contact_state")},
        truth=GroundTruth(
            recipe=plan.recipe.hash,
            displacement=plan.recipe.resolved_displacement,
            marker_rest_px=film.marker_rest_px.astype(np.float32),
            marker_px=film.marker_px.astype(np.float32),
            static_friction=loading.static_friction,
            contact_radius_m=film.motion.contact_radius_m,
            stick_radius_m=film.motion.stick_radius_m,
            contact_map=contact_map,
        ),
    )


def simulate(
    out: Path | str | None = None,
    *,
    preset: str = "small",
    sensor: str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    **changes: Unpack[RecipeChanges],
) -> Dataset:
    """Simulate a data set of labelled trials.

    docs/simulation.md has the mechanics. An interrupted call with the same `out` continues after the last whole trial.

    Parameters
    ----------
    out
        Folder to write; None writes a temporary one that lives as long as the returned data set.
    preset, sensor, changes
        As in `make_recipe`: `preset="small"` is made for a laptop, `"thesis"` has the days and frames of the thesis;
        `pulls="varied"` makes every pull different; `dry_trials`, `wet_trials`, `days`, `frames_per_trial` or `seed`
        change it.

    Raises
    ------
    InputError
        If the recipe cannot be followed, or the folder holds something else.

    See Also
    --------
    import_recordings : Import recordings of a sensor.
    run_episodes : Simulate grips under control.

    Examples
    --------
    >>> import sliplens as sl
    >>> data = sl.simulate(dry_trials=3, wet_trials=0, days=2, frames_per_trial=20)
    >>> len(data.trials), data.trials[0].split
    (3, 'train')
    """
    require_keywords(simulate, changes)
    recipe = make_recipe(preset, sensor=sensor, **changes)
    with reporting(on_progress), ExitStack() as stack:
        target = stack.enter_context(scratch_folder()) / "data" if out is None else Path(out)
        config = {"recipe": recipe.to_json()}
        with output_folder(target, stage="simulate", config=config, overwrite=overwrite) as output:
            if not output.complete:
                with open_stage("Simulating frames"):
                    simulate_dataset(output.folder, recipe)
        data = load_dataset(target)
        if out is not None:
            size = f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}"
            report_file(target, size, kept=output.complete)
        weakref.finalize(data, stack.pop_all().close)
        return data


def simulate_dataset(folder: Path, recipe: SimulationRecipe) -> Dataset:
    """Simulate `trials/*.parquet` and, last, `dataset.json` into a folder; existing trials are kept."""
    plans, table = plan_trials(recipe), []
    for plan in report_each(plans, sizes=[plan.frames for plan in plans]):
        path = trial_path(folder, plan.trial)
        if not path.is_file():
            save_recording(simulate_trial(plan), path)
        elif (truth := read_header(path).truth) is None or truth.recipe != plan.recipe.hash:
            raise InputError(f"{path} was made by another recipe; choose another folder")
        table.append(trial_info(path, split=plan.split))
    write_dataset_table(folder, table, simulated=True)
    return load_dataset(folder)


def visible_markers(sensor: Sensor) -> Int[np.ndarray, " markers"]:
    """Find the markers that lie inside the image at rest, at least their radius from its border."""
    points = sensor.geometry.project(sensor.geometry.marker_positions())
    border = max(sensor.look.radius_px)
    return np.flatnonzero(np.all((points >= border) & (points <= sensor.image_size_px - 1 - border), axis=-1))


def rebuild_trial(folder: Path, recording: Recording) -> Film:
    """Prepare a trial of a simulated data set to be drawn again with the same bytes."""
    name, truth = recording.trial, recording.truth
    if truth is None:
        raise InputError(f"trial {name} has no simulated truth and cannot be drawn again; choose a simulated data set")
    recipe = read_recipe(folder)
    plans = {plan.trial: plan for plan in plan_trials(recipe)}
    if recipe.hash != truth.recipe or name not in plans:
        made = f"was simulated by another recipe, or by another version of sliplens than this {__version__}"
        raise InputError(f"trial {name} of {folder} {made}; simulate the data set again")
    _, film = prepare_trial(plans[name])
    # the untouched sensor shows light, camera and print; the last frame depends on all the rest
    last = len(film) - 1
    drawn = torch.stack([film.draw_reference(), film.draw(slice(last, last + 1))[0]]).numpy().astype(np.int16)
    # another device or library may draw the same scene with other grey levels, by one at most
    if np.abs(drawn - [recording.reference, recording.frames[last]]).max() > 1:
        cause = "they were changed, or other versions of numpy and torch made them"
        differs = f"trial {name} of {folder} is drawn differently from its stored frames: {cause}"
        raise InputError(f"{differs}; simulate the data set again")
    return film


def put_markers_back(
    film: Film, frame: int, back: Bool[np.ndarray, "variants markers"], *, to: int | None = None
) -> Film:
    """Film one moment several times, each time with other markers put back; all else stays, the noise too.

    A marker put back has its place, size and pressure of the frame `to`, of the untouched sensor if None. Focus and
    paleness, which the touch gives to all markers, stay.
    """
    count, motion = len(back), film.motion
    source, there = (film.untouched(), 0) if to is None else (film, to)

    def where_back(path: np.ndarray, paths: np.ndarray) -> np.ndarray:
        return np.where(back[..., None] if path.ndim == 3 else back, paths[there], path[frame])

    moved = {
        name: where_back(getattr(motion, name), getattr(source.motion, name))
        for name in ("centres_px", "scale", "pressure")
    }
    same = {
        name: getattr(motion, name)[np.full(count, frame)]
        for name in ("touch", "indentation_m", "contact_radius_m", "stick_radius_m")
    }
    picks = np.append(0, np.full(count, frame + 1))  # the untouched sensor's come first
    return replace(
        film,
        motion=replace(motion, **moved, **same),
        marker_px=where_back(film.marker_px, source.marker_px),
        blur_px=film.blur_px[picks],
        noise_picks=film.noise_picks[picks],
    )


NOISE_PX = 0.1
"""Standard deviation of each coordinate of a tracked marker in images of this noise (docs/limit.md)."""
