"""Simulated trials: from a plan to a recording, from a recipe to a data set on disk, and what two sets share."""

import weakref
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

import numpy as np

from sliplens.codec import Result
from sliplens.errors import InputError
from sliplens.files import output_folder, scratch_folder
from sliplens.progress import OnProgress, number_of, open_stage, report_each, report_file, reporting
from sliplens.recordings import Dataset, GroundTruth, Recording
from sliplens.recordings.dataset import TrialInfo, load_dataset, trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import hash_frames, read_header, save_recording
from sliplens.recordings.trial import SIGNALS
from sliplens.simulation.filming import Film, batches, move_camera, prepare_film
from sliplens.simulation.loading import Loading, load_grasp
from sliplens.simulation.nuisances import draw_grasp, draw_unit
from sliplens.simulation.plan import RecipeChanges, SimulationRecipe, TrialPlan, make_recipe, plan_trials, read_recipe


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


def simulate_examples(recipe: SimulationRecipe) -> list[Recording]:
    """Simulate up to four trials that show the range of a recipe, a wet one last."""
    plans = plan_trials(recipe)
    dry = [plan for plan in plans if plan.condition == "dry"]
    wet = [plan for plan in plans if plan.condition == "wet"][:1]
    count = min(4 - len(wet), len(dry))
    chosen = [dry[index * (len(dry) - 1) // max(1, count - 1)] for index in range(count)] + wet
    return [simulate_trial(plan) for plan in report_each(chosen)]


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
    recipe = make_recipe(preset, sensor=sensor, **changes)
    with reporting(on_progress), ExitStack() as stack:
        if out is None:
            folder = stack.enter_context(scratch_folder())
            with open_stage("Simulating frames"):
                data = simulate_dataset(folder, recipe)
            weakref.finalize(data, stack.pop_all().close)
            return data
        config = {"recipe": recipe.to_json()}
        with output_folder(Path(out), stage="simulate", config=config, overwrite=overwrite) as output:
            if not output.complete:
                with open_stage("Simulating frames"):
                    simulate_dataset(output.folder, recipe)
        data = load_dataset(out)
        size = f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}"
        report_file(Path(out), size, kept=output.complete)
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


@dataclass(frozen=True, kw_only=True)
class SharedMaterial(Result):
    """Material in both of two data sets; each pair has the names in the first and in the second."""

    by_seeds: bool
    """True where both are as they were simulated, so that seeds identify days and sensors. Otherwise their names do, a
    day with its sensor: simulated trials may have been imported or labelled anew."""
    trials: tuple[tuple[str, str], ...]
    """Trials with the same frames, or drawn from the same seed: with other frames, but of one touch."""
    days: tuple[tuple[str, str], ...]
    sensors: tuple[tuple[str, str], ...]


def compare_datasets(
    first: Dataset | Path | str, second: Dataset | Path | str, *, splits: tuple[str | None, str | None] = (None, None)
) -> SharedMaterial:
    """Find the trials, days and sensors that two data sets share.

    Parameters
    ----------
    first, second
        The data sets, or their folders; one data set twice, with two splits, compares the splits.
    splits
        Split of each; all trials if None.

    Raises
    ------
    InputError
        If a folder is no data set, or has no such split.

    Examples
    --------
    >>> import sliplens as sl
    >>> from sliplens.files import scratch_folder
    >>> with scratch_folder() as folder:
    ...     data = sl.simulate(folder / "data", dry_trials=4, wet_trials=0, days=2, frames_per_trial=20)
    ...     shared = sl.compare_datasets(data, data, splits=("train", "test"))
    >>> shared.trials, shared.days, shared.sensors
    ((), (), (('chromatouch-1', 'chromatouch-1'),))
    """
    datasets = [data if isinstance(data, Dataset) else load_dataset(data) for data in (first, second)]
    trials = [data.select(split=split) for data, split in zip(datasets, splits, strict=True)]
    plans = [_plans(data, chosen) for data, chosen in zip(datasets, trials, strict=True)]
    by_seeds = all(plans)
    identities = [
        [_identify(trial, data.folder, plan.get(trial.trial) if by_seeds else None) for trial in chosen]
        for data, chosen, plan in zip(datasets, trials, plans, strict=True)
    ]

    def shared(*facts: str) -> tuple[tuple[str, str], ...]:
        pairs = []
        for fact in facts:
            ours, others = ([trial[fact] for trial in side if fact in trial] for side in identities)
            names = dict(others)
            pairs += [(name, names[key]) for key, name in ours if key in names]
        return tuple(dict.fromkeys(pairs))

    return SharedMaterial(
        by_seeds=by_seeds, trials=shared("frames", "trial"), days=shared("day"), sensors=shared("sensor")
    )


def _plans(data: Dataset, trials: Sequence[TrialInfo]) -> dict[str, TrialPlan]:
    """Return the plans of simulated trials by name; none where the recipe of any is unknown."""
    try:
        plans = {plan.trial: plan for plan in plan_trials(read_recipe(data.folder))} if data.simulated else {}
    except InputError:
        return {}
    return plans if all(trial.trial in plans for trial in trials) else {}


def _identify(trial: TrialInfo, folder: Path, plan: TrialPlan | None) -> dict[str, tuple[object, str]]:
    """Return a key and a name of a trial and of its circumstances; a sensor without a name has none."""
    keys: dict[str, tuple[object, str]] = {"frames": (hash_frames(trial_path(folder, trial.trial)), trial.trial)}
    if plan is not None:
        keys |= {"trial": (plan.seed, trial.trial), "day": (plan.day_seed, f"day {trial.day}")}
        keys["sensor"] = (plan.unit_seed, trial.sensor)
    elif trial.sensor:
        day = f"{trial.sensor}, day {trial.day}"
        keys |= {"day": (day, day), "sensor": (trial.sensor, trial.sensor)}
    return keys
