"""Trials, days and sensors that two data sets share, which make a test of one on the other too easy."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sliplens.codec import Result
from sliplens.errors import InputError
from sliplens.recordings import Dataset
from sliplens.recordings.dataset import TrialInfo, load_dataset, trial_path
from sliplens.recordings.store import hash_frames
from sliplens.simulation.intervention import read_recipe
from sliplens.simulation.plan import TrialPlan, plan_trials


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
