"""What two data sets share: the trials, days and sensors that would make a test of one on the other too easy."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sliplens.errors import InputError
from sliplens.recordings import Dataset
from sliplens.recordings.dataset import TrialInfo, load_dataset, trial_path
from sliplens.recordings.store import hash_frames
from sliplens.simulation.intervention import read_recipe
from sliplens.simulation.plan import TrialPlan, plan_trials


@dataclass(frozen=True, kw_only=True)
class SharedMaterial:
    """What two data sets have in common; each pair names a thing in the first and in the second."""

    by_seeds: bool
    """Both are as they were simulated, so that seeds tell; otherwise the names of sensors, and of days with their
    sensor, do, as of simulated trials that were imported or labelled anew."""
    trials: tuple[tuple[str, str], ...]
    """Trials that show the same frames, or are drawn from the same seed: with other frames, but of one touch."""
    days: tuple[tuple[str, str], ...]
    sensors: tuple[tuple[str, str], ...]


def compare_datasets(
    first: Dataset | Path | str, second: Dataset | Path | str, *, splits: tuple[str | None, str | None] = (None, None)
) -> SharedMaterial:
    """Tell which trials, days and sensors two data sets share.

    Parameters
    ----------
    first, second
        The data sets, or their folders; one data set twice, with two splits, tells what these share.
    splits
        Which trials of each; all if None.

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
    sets = [one if isinstance(one, Dataset) else load_dataset(one) for one in (first, second)]
    chosen = [one.select(split=split) for one, split in zip(sets, splits, strict=True)]
    plans = [_plans(one, trials) for one, trials in zip(sets, chosen, strict=True)]
    by_seeds = all(plans)
    keys = [
        [_keys(trial, trial_path(one.folder, trial.trial), known if by_seeds else {}) for trial in trials]
        for one, trials, known in zip(sets, chosen, plans, strict=True)
    ]

    def share(*names: str) -> tuple[tuple[str, str], ...]:
        pairs = [_pairs(*((one[name] for one in side if name in one) for side in keys)) for name in names]
        return tuple(dict.fromkeys(pair for one in pairs for pair in one))

    return SharedMaterial(by_seeds=by_seeds, trials=share("shown", "trial"), days=share("day"), sensors=share("sensor"))


def _plans(data: Dataset, trials: Sequence[TrialInfo]) -> dict[str, TrialPlan]:
    """Plans of simulated trials by name; none where the recipe of any is not known."""
    try:
        plans = {plan.trial: plan for plan in plan_trials(read_recipe(data.folder))} if data.simulated else {}
    except InputError:
        return {}
    return plans if all(trial.trial in plans for trial in trials) else {}


def _keys(trial: TrialInfo, path: Path, plans: dict[str, TrialPlan]) -> dict[str, tuple[object, str]]:
    """What identifies a trial and its circumstances, each with its name; a sensor that is not told is no sensor."""
    found: dict[str, tuple[object, str]] = {"shown": (hash_frames(path), trial.trial)}
    if trial.trial in plans:
        plan = plans[trial.trial]
        found |= {"trial": (plan.seed, trial.trial), "day": (plan.day_seed, f"day {trial.day}")}
        found["sensor"] = (plan.unit_seed, trial.sensor)
    elif trial.sensor:
        day = f"{trial.sensor}, day {trial.day}"
        found |= {"day": (day, day), "sensor": (trial.sensor, trial.sensor)}
    return found


def _pairs(first: Iterable[tuple[object, str]], second: Iterable[tuple[object, str]]) -> list[tuple[str, str]]:
    others = dict(second)
    return [(name, others[key]) for key, name in first if key in others]
