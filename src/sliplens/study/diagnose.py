"""Where a network fails: slices of its errors, tested on trials that they were not found on."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from sliplens.codec import load_result, save_result
from sliplens.extras import require_packages
from sliplens.files import output_folder
from sliplens.intervals import FEWEST_UNITS, Difference, mean_interval, paired_difference
from sliplens.models import Network
from sliplens.models.wrapping import open_run
from sliplens.plots.style import decimals, listed, signed, tell_ends
from sliplens.progress import OnProgress, current_listener, number_of, open_stage, report_each, report_file, reporting
from sliplens.recordings import Dataset
from sliplens.recordings.dataset import load_dataset
from sliplens.results.evaluation import Diagnosis, ErrorSlice, ErrorTable, ScoredFrames
from sliplens.training import evaluate

_SLICES, _LEAST_SHARE, _LEAST_GAIN = 5, 0.1, 0.01
"""Slices at most, the share of the frames that each holds at least, and of the variance that each cut explains."""


def diagnose(
    run: Network | Path | str,
    data: Dataset | Path | str,
    out: Path | str | None = None,
    *,
    split: str = "test",
    seed: int = 0,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Diagnosis:
    """Find out where a network fails.

    A tree finds slices of large error (condition, friction, force, place of contact, day, sensor) on half of the
    trials; the other half tests them.

    Parameters
    ----------
    run
        Network, its folder, or the name of one that comes with sliplens.
    data, split
        Data set with labels or its folder, and which of its trials.
    out
        Workspace, with a subfolder for the evaluation and one for the diagnosis; nothing is kept if None.

    Raises
    ------
    InputError
        If scikit-learn is missing, or the network or the data set cannot be found.
    RecordingError
        If no frame has a label.

    Examples
    --------
    >>> import sliplens as sl
    >>> diagnosis = sl.diagnose("chromatouch-pair", "runs/mine/data", "runs/mine")  # doctest: +SKIP
    >>> [part.name for part in diagnosis.slices if part.holds]  # doctest: +SKIP
    ['normal force above 0.493 N, friction up to 0.242']
    """
    require_packages("sklearn", extra="diagnose", purpose="finding where a network fails")
    run, data = open_run(run), data if isinstance(data, Dataset) else load_dataset(data)
    name, folder = run.manifest.input, None if out is None else Path(out)
    scores = folder and folder / f"evaluate-{name}"
    with reporting(on_progress):
        evaluation = evaluate(run, data, scores, split=split, overwrite=overwrite, on_progress=current_listener())
        compute = partial(_diagnose, name, data, evaluation.predictions, seed=seed)
        if folder is None:
            return compute()
        config = {"weights_sha256": run.manifest.weights_sha256, "data_hash": data.hash, "input": name, "split": split}
        target = folder / f"diagnose-{name}"
        with output_folder(target, stage="diagnose", config=config | {"seed": seed}, overwrite=overwrite) as output:
            if not output.complete:
                save_result(compute(), output.folder)
        report_file(target, "where the network fails", kept=output.complete)
    return load_result(target, Diagnosis, command="sliplens diagnose")


def _diagnose(name: str, data: Dataset, answers: ScoredFrames, *, seed: int) -> Diagnosis:
    with open_stage("Reading what may explain the errors"):
        errors = tabulate_errors(data, answers)
    slices, errors = find_slices(errors, seed=seed)
    sentences = say_errors(errors, np.random.default_rng(seed)), say_slices(slices)
    return Diagnosis(input=name, source=data.source, sentences=sentences, slices=slices, errors=errors)


def tabulate_errors(data: Dataset, answers: ScoredFrames) -> ErrorTable:
    """Put beside each answer what may have made it wrong."""
    pieces = []
    for (trial,), rows in report_each(answers.groups("trial").items()):
        info, (x, y) = data.find(trial), [np.full(len(rows), np.nan)] * 2
        recording = data.load(info)
        if recording.truth is not None:
            touching = (recording.truth.contact_map[rows.frame] > 0).astype(np.float64)
            pixels = np.maximum(touching.sum(axis=(1, 2)), 1)
            along = [touching.sum(axis=axis) for axis in (1, 2)]
            x, y = (counts @ (np.arange(counts.shape[1]) + 0.5) / counts.shape[1] / pixels for counts in along)
        pieces.append(
            ErrorTable(
                **vars(rows),
                sensor=np.repeat(info.sensor, len(rows)),
                friction=recording.friction_coefficient[rows.frame].astype(np.float64),
                normal_force_n=recording.normal_force_n[rows.frame].astype(np.float64),
                contact_x=x,
                contact_y=y,
                slice=np.full(len(rows), -1),
            )
        )
    return ErrorTable.joined(pieces)


_Name = Callable[[float, float], str]
"""Function that names the values of a feature above the first number and up to the second."""


def _name_kind(kind: str, others: str, low: float, _: float) -> str:
    return kind if low > 0 else others


def _name_range(words: str, low: float, high: float) -> str:
    ends = f"above {low:.3g}" if np.isinf(high) else f"{low:.3g} to {high:.3g}"
    return words.format(f"up to {high:.3g}" if np.isinf(low) else ends)


def _features(errors: ErrorTable) -> list[tuple[Float64[np.ndarray, " frames"], _Name]]:
    """Features that the tree may cut by: known of all frames, and varying."""
    features: list[tuple[np.ndarray, _Name]] = []
    for name, words in (("condition", "{} objects"), ("day", "day {}"), ("sensor", "sensor {}")):
        values = getattr(errors, name).astype(str)
        first, *more = np.unique(values).tolist()
        for kind in more if len(more) == 1 else [first, *more]:
            others = words.format(first) if len(more) == 1 else f"not {words.format(kind)}"
            features.append(((values == kind).astype(float), partial(_name_kind, words.format(kind), others)))
    numbers = {
        "friction {}": errors.friction,
        "normal force {} N": errors.normal_force_n,
        "contact {} % from the left": 100 * errors.contact_x,
        "contact {} % from the top": 100 * errors.contact_y,
    }
    features += [(values, partial(_name_range, words)) for words, values in numbers.items()]
    return [(values, name) for values, name in features if np.isfinite(values).all() and np.ptp(values) > 0]


def hold_out(errors: ErrorTable, *, seed: int) -> Bool[np.ndarray, " frames"]:
    """Frames of every second trial of each condition, drawn."""
    rng, trials = np.random.default_rng(seed), []
    for rows in errors.groups("condition").values():
        trials += rng.permutation(np.unique(rows.trial))[1::2].tolist()
    return np.isin(errors.trial, trials)


def find_slices(errors: ErrorTable, *, seed: int) -> tuple[tuple[ErrorSlice, ...], ErrorTable]:
    """Find slices in which the error is large, and test each on held-out trials, the largest error first.

    They are the leaves of a regression tree (Breiman et al., 1984) of the error and its size, fitted on the trials that
    are not held out; their intervals hold together, however many there are. Gives them, and the table with each
    frame's.
    """
    from sklearn.tree import DecisionTreeRegressor  # noqa: PLC0415 (an extra)

    rng, compared, features = np.random.default_rng(seed), hold_out(errors, seed=seed), _features(errors)
    columns = np.column_stack([np.zeros(len(errors)), *(values for values, _ in features)])
    # both: where it errs either way alike, or not at all, the mean error alone tells nothing
    wanted = np.stack([np.abs(errors.error), errors.error], axis=1)[~compared]
    least, rules = wanted.var(axis=0).mean(), {"max_leaf_nodes": _SLICES, "min_samples_leaf": _LEAST_SHARE}
    grown = DecisionTreeRegressor(**rules, min_impurity_decrease=_LEAST_GAIN * least, random_state=seed)
    tree = grown.fit(columns[~compared], wanted).tree_
    leaves, tested, records = grown.apply(columns), errors.where(compared), []
    bounds: dict[int, dict[int, tuple[float, float]]] = {0: {}}
    for node in range(tree.node_count):  # a parent comes before its children
        at, cut, ranges = int(tree.feature[node]), float(tree.threshold[node]), bounds[node]
        low, high = ranges.get(at, (-np.inf, np.inf))
        if at >= 0:
            bounds[int(tree.children_left[node])] = {**ranges, at: (low, cut)}
            bounds[int(tree.children_right[node])] = {**ranges, at: (cut, high)}
        elif (inside := leaves[compared] == node).any():
            name = ", ".join(features[column - 1][1](*ends) for column, ends in ranges.items()) or "all frames"
            there, excess = tested.where(inside), excess_error(tested, inside, rng, comparisons=int(tree.n_leaves))
            error, bias, trials = float(np.abs(there.error).mean()), float(there.error.mean()), len(set(there.trial))
            record = ErrorSlice(name=name, frames=len(there), trials=trials, error=error, bias=bias, excess=excess)
            records.append((node, record))
    records.sort(key=lambda pair: -pair[1].error)
    place = {node: at for at, (node, _) in enumerate(records)}
    slices = np.array([place.get(leaf, -1) for leaf in leaves.tolist()], dtype=np.int64)
    return tuple(record for _, record in records), replace(errors, slice=slices)


def excess_error(
    table: ErrorTable, inside: Bool[np.ndarray, " frames"], rng: np.random.Generator, *, comparisons: int = 1
) -> Difference:
    """Mean size of the error inside a group less that outside, with a 95 % interval; 0 where all are of one group.

    Of several `comparisons` all intervals hold together (`paired_difference`).
    A trial may lie in both: each frame counts with its influence on the difference, whose mean is the difference.
    """
    share, sizes, clusters = float(inside.mean()), np.abs(table.error), [table.day.astype(str), table.trial]
    if share in {0, 1}:
        return mean_interval(0 * sizes, clusters=clusters, rng=rng)
    there, elsewhere = sizes[inside].mean(), sizes[~inside].mean()
    influence = np.where(inside, (sizes - there) / share, (elsewhere - sizes) / (1 - share))
    gaps = there - elsewhere + influence
    return paired_difference(gaps, np.zeros(len(gaps)), clusters=clusters, rng=rng, comparisons=comparisons)


def _tell_points(gap: Difference) -> str:
    ends = tell_ends(gap, lambda end: decimals(100 * end, 1), title="95 % interval ")
    return f"{signed(100 * gap.estimate, 1)} ({ends}; {gap.over})"


def say_errors(errors: ErrorTable, rng: np.random.Generator) -> str:
    """Say how large the error is in each condition, and whether it is larger on wet objects."""
    groups = {condition: rows for (condition,), rows in errors.groups("condition").items()}
    each = [f"{100 * np.abs(group.error).mean():.1f} on {name} objects" for name, group in groups.items()]
    text = f"In {number_of(len(errors), 'frame')} the answer is off by {listed(each)} percentage points on average."
    if {"dry", "wet"} - set(groups):
        return text
    both = ErrorTable.joined([groups["wet"], groups["dry"]])
    gap = excess_error(both, both.condition == "wet", rng)
    return f"{text} Wet less dry: {_tell_points(gap)}{'' if gap.sure else ', which may be chance'}."


def say_slices(slices: Sequence[ErrorSlice]) -> str:
    """Say where the error is larger on trials that the tree has not seen."""
    if not any(part.trials >= FEWEST_UNITS for part in slices):
        return f"Where the error is larger is not known: no slice has the {FEWEST_UNITS} held-out trials to test it on."
    texts = [
        f"{part.name}: off by {100 * part.error:.1f} in {number_of(part.trials, 'trial')}, less elsewhere "
        f"{_tell_points(part.excess)}"
        for part in slices
        if part.holds
    ]
    if not texts:
        return "No slice found on half of the trials has a larger error on the other half beyond chance."
    return f"On held-out trials the error is larger than elsewhere where {'; where '.join(texts)}."
