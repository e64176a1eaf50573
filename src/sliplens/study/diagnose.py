"""Where a network fails, and why: slices of its errors, the limit of one frame, and other frictions."""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from sliplens.codec import load_result, save_result
from sliplens.errors import InputError
from sliplens.explainers.explain import join_maps
from sliplens.explainers.frames import frames_at
from sliplens.extras import require_packages
from sliplens.files import output_folder
from sliplens.intervals import FEWEST_UNITS, Difference, mean_interval, paired_difference
from sliplens.models import Network
from sliplens.models.checkpoint import open_run
from sliplens.plots.style import decimals, signed, tell_ends
from sliplens.progress import (
    OnProgress,
    add_note,
    current_listener,
    number_of,
    open_stage,
    report_each,
    report_file,
    reporting,
)
from sliplens.recordings import Dataset
from sliplens.recordings.dataset import load_dataset
from sliplens.results.evaluation import Diagnosis, ErrorSlice, ErrorTable, FrictionSlope, FrictionTable, ScoredFrames
from sliplens.simulation.intervention import film_with_friction, reading_limit, reading_slope
from sliplens.study.truth import StagedFrame, stage_frames
from sliplens.training import evaluate

LEVELS = (0.8, 0.5, 0.2)
"""Margins at which frames are filmed with other frictions."""
FRICTION_FACTORS = (0.67, 0.8, 1.0, 1.25, 1.5)
"""Other frictions over a frame's own, none so far that the object would be another."""
_SLICES, _LEAST_SHARE, _LEAST_GAIN = 5, 0.1, 0.01
"""Slices at most, the share of the frames that each holds at least, and of the variance that each cut explains."""


def diagnose(
    run: Network | Path | str,
    data: Dataset | Path | str,
    out: Path | str | None = None,
    *,
    split: str = "test",
    trials: int = 8,
    seed: int = 0,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Diagnosis:
    """Find out where a network fails, and why.

    A tree finds slices of large error (condition, friction, force, place of contact, day, sensor) on half of the
    trials; the other half tests them. In simulation the error is compared with the limit of one frame, and the same
    press and pull is filmed anew with other frictions.

    Parameters
    ----------
    run
        Network, its folder, or the name of one that comes with sliplens.
    data, split
        Data set with labels or its folder, and which of its trials.
    out
        Workspace, with a subfolder for the evaluation and one for the diagnosis; nothing is kept if None.
    trials
        Trials of each condition of which three frames are filmed anew.

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
    if trials < 1:
        raise InputError(f"--trials must be at least 1, got {trials}")
    run, data = open_run(run), data if isinstance(data, Dataset) else load_dataset(data)
    name, folder = run.manifest.input, None if out is None else Path(out)
    scores = folder and folder / f"evaluate-{name}"
    with reporting(on_progress):
        evaluation = evaluate(run, data, scores, split=split, overwrite=overwrite, on_progress=current_listener())
        compute = partial(_diagnose, run, data, evaluation.predictions, trials=trials, seed=seed)
        if folder is None:
            return compute()
        config = {"weights_sha256": run.manifest.weights_sha256, "data_hash": data.hash, "input": name, "split": split}
        target = folder / f"diagnose-{name}"
        with output_folder(target, stage="diagnose", config=config | compute.keywords, overwrite=overwrite) as output:
            if not output.complete:
                save_result(compute(), output.folder)
        report_file(target, "where the network fails, and why", kept=output.complete)
    return load_result(target, Diagnosis, command="sliplens diagnose")


def _diagnose(run: Network, data: Dataset, answers: ScoredFrames, *, trials: int, seed: int) -> Diagnosis:
    rng, left_out = np.random.default_rng(seed), ""
    with open_stage("Reading what may explain the errors"):
        errors = tabulate_errors(data, answers)
    slices, errors = find_slices(errors, seed=seed)
    rows = _spread_rows(errors, trials)
    some = errors.where(rows)
    chosen = frames_at(run, data, list(zip(some.trial.tolist(), some.frame.tolist(), strict=True)))
    explained = join_maps(run, chosen, {})
    try:
        frames = stage_frames(run, explained, data)
    except InputError as error:
        left_out = f"The limit of one frame, and what other frictions would change, are left out: {error}."
        add_note(left_out)
        frictions = tabulate_frictions([])
    else:
        errors.limit[rows] = [reading_limit(frame.scene, frame.number) for frame in frames]
        with open_stage("Filming with other frictions"):
            frictions = refilm(run, frames, some.condition.tolist())
    slopes = friction_slopes(frictions, rng)
    return Diagnosis(
        input=run.manifest.input,
        source=data.source,
        sentences=(
            say_errors(errors, rng), say_slices(slices), *say_limits(errors, rng), *map(say_slope, slopes)
        ),
        left_out=left_out,
        slices=slices,
        slopes=slopes,
        errors=errors,
        frictions=frictions,
    )  # fmt: skip


def tabulate_errors(data: Dataset, answers: ScoredFrames) -> ErrorTable:
    """Put beside each answer what may have made it wrong."""
    pieces = []
    for (trial,), rows in report_each(answers.groups("trial").items()):
        info, places = data.find(trial), [np.full(len(rows), np.nan)] * 2
        recording = data.load(info)
        if recording.truth is not None:
            touching = (recording.truth.contact_map[rows.frame] > 0).astype(np.float64)
            pixels = np.maximum(touching.sum(axis=(1, 2)), 1)
            along = [touching.sum(axis=axis) for axis in (1, 2)]
            places = [record @ (np.arange(record.shape[1]) + 0.5) / record.shape[1] / pixels for record in along]
        pieces.append(
            ErrorTable(
                **vars(rows),
                sensor=np.repeat(info.sensor, len(rows)),
                friction=recording.friction_coefficient[rows.frame].astype(np.float64),
                normal_force_n=recording.normal_force_n[rows.frame].astype(np.float64),
                contact_x=places[0],
                contact_y=places[1],
                slice=np.full(len(rows), -1),
                limit=np.full(len(rows), np.nan),
            )
        )
    return ErrorTable.joined(pieces)


_Say = Callable[[float, float], str]
"""Words for values of a feature above the first number and up to the second."""


def _features(errors: ErrorTable) -> list[tuple[Float64[np.ndarray, " frames"], _Say]]:
    """Features that the tree may cut by: known of all frames, and varying."""

    def say_kind(kind: str, others: str, low: float, _: float) -> str:
        return kind if low > 0 else others

    def say_range(words: str, low: float, high: float) -> str:
        ends = f"above {low:.3g}" if np.isinf(high) else f"{low:.3g} to {high:.3g}"
        return words.format(f"up to {high:.3g}" if np.isinf(low) else ends)

    features: list[tuple[np.ndarray, _Say]] = []
    for name, words in (("condition", "{} objects"), ("day", "day {}"), ("sensor", "sensor {}")):
        values = getattr(errors, name).astype(str)
        first, *more = np.unique(values).tolist()
        for kind in more if len(more) == 1 else [first, *more]:
            others = words.format(first) if len(more) == 1 else f"not {words.format(kind)}"
            features.append(((values == kind).astype(float), partial(say_kind, words.format(kind), others)))
    numbers = {
        "friction {}": errors.friction,
        "normal force {} N": errors.normal_force_n,
        "contact {} % from the left": 100 * errors.contact_x,
        "contact {} % from the top": 100 * errors.contact_y,
    }
    features += [(values, partial(say_range, words)) for words, values in numbers.items()]
    return [(values, say) for values, say in features if np.isfinite(values).all() and np.ptp(values) > 0]


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


def _mean(
    values: Float[np.ndarray, " rows"], table: ErrorTable | FrictionTable, rng: np.random.Generator
) -> Difference:
    """Mean over rows of a table with a 95 % interval over days and trials."""
    return mean_interval(values, clusters=[table.day.astype(str), table.trial], rng=rng)


def excess_error(
    table: ErrorTable, inside: Bool[np.ndarray, " frames"], rng: np.random.Generator, *, comparisons: int = 1
) -> Difference:
    """Mean size of the error inside a group less that outside, with a 95 % interval; 0 where all are of one group.

    Of several `comparisons` all intervals hold together (`paired_difference`).
    A trial may lie in both: each frame counts with its influence on the difference, whose mean is the difference.
    """
    share, sizes = float(inside.mean()), np.abs(table.error)
    if share in {0, 1}:
        return _mean(0 * sizes, table, rng)
    clusters = [table.day.astype(str), table.trial]
    there, elsewhere = sizes[inside].mean(), sizes[~inside].mean()
    influence = np.where(inside, (sizes - there) / share, (elsewhere - sizes) / (1 - share))
    gaps = there - elsewhere + influence
    return paired_difference(gaps, np.zeros(len(gaps)), clusters=clusters, rng=rng, comparisons=comparisons)


def _spread_rows(errors: ErrorTable, trials: int) -> Int64[np.ndarray, " rows"]:
    """Rows of frames along the margin of so many trials of each condition, spread evenly over them."""
    rows = []
    for (condition,) in errors.groups("condition"):
        names = list(dict.fromkeys(errors.trial[errors.condition == condition].tolist()))
        count = min(trials, len(names))
        for trial in (names[at * len(names) // count] for at in range(count)):
            frames = np.flatnonzero(errors.trial == trial)
            rows += sorted({int(frames[np.abs(errors.safety_margin[frames] - level).argmin()]) for level in LEVELS})
    return np.array(rows)


def refilm(run: Network, frames: Sequence[StagedFrame], conditions: Sequence[str]) -> FrictionTable:
    """Film frames anew with other frictions, and predict them."""
    rows, films, last = [], [], None
    for frame, condition in report_each(list(zip(frames, conditions, strict=True))):
        at, scene = frame.number, frame.scene
        if scene is not last:  # frames of a trial stand together
            values, last = scene.loading.friction_coefficient, scene
            films = [film_with_friction(scene, factor * values) for factor in FRICTION_FACTORS]
        valid = [film for film in films if np.isfinite(film.loading.safety_margin[at])]
        drawn = np.concatenate([film.film.draw(slice(at, at + 1)).numpy() for film in valid])
        inputs = run.encode(drawn, frame.reference).to(run.device)
        for film, answer in zip(valid, run.predict(inputs).tolist(), strict=True):
            truth = (film.loading.friction_coefficient[at], film.loading.safety_margin[at])
            rows.append((frame.id, frame.trial, condition, frame.day, *truth, answer, reading_slope(film, at)))
    return tabulate_frictions(rows)


def tabulate_frictions(rows: Sequence[tuple[Any, ...]]) -> FrictionTable:
    """Table of rows, or of none."""
    columns = dict(zip((field.name for field in fields(FrictionTable)), zip(*rows, strict=True), strict=False))
    kinds = {"frame_id": str, "trial": str, "condition": str, "day": np.int64}
    names_used = {field.name: kinds.get(field.name, np.float64) for field in fields(FrictionTable)}
    return FrictionTable(**{name: np.array(columns.get(name, ()), dtype=kind) for name, kind in names_used.items()})


def friction_slopes(frictions: FrictionTable, rng: np.random.Generator) -> tuple[FrictionSlope, ...]:
    """How far answer and best reading follow the margin as friction alone changes, by condition.

    The network's is the least-squares slope over a frame's frictions, the best reading's the mean of its own over the
    same range of margins.
    """
    slopes = []
    for (condition,), table in frictions.groups("condition").items():
        frames = [rows.where(np.argsort(rows.safety_margin)) for rows in table.groups("frame_id").values()]
        frames = [frame for frame in frames if np.ptp(frame.safety_margin) > 0]
        if frames:
            network = np.array([np.polyfit(frame.safety_margin, frame.prediction, 1)[0] for frame in frames])
            areas = [np.trapezoid(frame.reading_slope, frame.safety_margin) for frame in frames]
            reading = np.array(areas) / [np.ptp(frame.safety_margin) for frame in frames]
            firsts = FrictionTable.joined([frame.where(np.array([0])) for frame in frames])
            mean, best, gap = (_mean(values, firsts, rng) for values in (network, reading, network - reading))
            slopes.append(FrictionSlope(condition=condition, network=mean, reading=best, gap=gap))
    return tuple(slopes)


def _gap(gap: Difference, *, points: bool = False) -> str:
    scale, digits = (100, 1) if points else (1, 2)
    ends = tell_ends(gap, lambda end: decimals(scale * end, digits), title="95 % interval ")
    return f"{signed(scale * gap.estimate, digits)} ({ends}; {gap.over})"


def _frames(table: ErrorTable) -> str:
    trials = len(np.unique(table.trial))
    return f"{number_of(len(table), 'frame')} of {'one trial' if trials == 1 else f'{trials} trials'}"


def _off(table: ErrorTable) -> str:
    return f"off by {100 * np.abs(table.error).mean():.1f}"


def say_errors(errors: ErrorTable, rng: np.random.Generator) -> str:
    """Say how large the error is, in each condition, and whether it is larger on wet objects."""
    groups = {condition: rows for (condition,), rows in errors.groups("condition").items()}
    each = [
        f"{_off(group)} on {name} objects ({signed(100 * group.error.mean(), 1)} mean)"
        for name, group in groups.items()
    ]
    text = f"Over {_frames(errors)} the answer is {_off(errors)} percentage points on average: {', '.join(each)}."
    if {"dry", "wet"} - set(groups):
        return text
    both = ErrorTable.joined([groups["wet"], groups["dry"]])
    text += f" Wet less dry: {_say_excess(both, rng)}."
    ends = [np.array([rows.friction.min(), rows.friction.max()]) for rows in (groups["wet"], groups["dry"])]
    low, high = max(first for first, _ in ends), min(last for _, last in ends)
    alike = both.where((both.friction >= low) & (both.friction <= high))  # nowhere, where friction is not known
    fewest = min(len(np.unique(alike.trial[alike.condition == name])) for name in ("dry", "wet"))
    if fewest < FEWEST_UNITS:
        return text
    return (
        f"{text} Among objects of the same friction, {low:.2f} to {high:.2f} ({_frames(alike)}), wet less dry: "
        f"{_say_excess(alike, rng)}."
    )


def _say_excess(both: ErrorTable, rng: np.random.Generator) -> str:
    gap = excess_error(both, both.condition == "wet", rng)
    return f"{_gap(gap, points=True)}{'' if gap.sure else ', which may be chance'}"


def say_slices(slices: Sequence[ErrorSlice]) -> str:
    """Say where the error is larger on trials that the tree has not seen."""
    tested = [part for part in slices if part.trials >= FEWEST_UNITS]
    if not tested:
        return f"Where the error is larger is not known: no slice has the {FEWEST_UNITS} held-out trials to test it on."
    compared = [record for record in tested if record.holds]
    texts = [
        f"{record.name}: off by {100 * record.error:.1f} ({signed(100 * record.bias, 1)} mean) in "
        f"{number_of(record.frames, 'frame')} of {number_of(record.trials, 'trial')}, against elsewhere "
        f"{_gap(record.excess, points=True)}"
        for record in compared or tested[:1]
    ]
    if not compared:
        return (
            "No slice found on half of the trials has a larger error on the other half beyond chance, all slices taken "
            f"together. The largest is {texts[0]}."
        )
    return f"On held-out trials the error is larger than elsewhere where {'; where '.join(texts)}."


def say_limits(errors: ErrorTable, rng: np.random.Generator) -> list[str]:
    """Say how much of the error no unbiased reader of one frame could spare."""
    texts = []
    for (condition,), rows in errors.where(np.isfinite(errors.limit)).groups("condition").items():
        if len(np.unique(rows.trial)) < FEWEST_UNITS:
            continue
        squared, least = rows.error**2, rows.limit**2
        gap = _mean(squared - least, rows, rng)
        verdict = "above" if gap.above_zero else "below" if gap.below_zero else "not told from"
        reached, bound = (100 * np.sqrt(values.mean()) for values in (squared, least))
        texts.append(
            f"On {condition} objects the root mean squared error in {_frames(rows)} is {reached:.1f} points. It is "
            f"{verdict} the {bound:.1f} points that no unbiased reader of the markers of one frame comes below, who is "
            f"told how far the friction of {condition} objects ranges and no more (over {gap.over})."
        )
    return texts


def say_slope(slope: FrictionSlope) -> str:
    """Say whether the answer follows the margin where friction alone changes, and whether the markers let it."""
    verdict = "more than" if slope.gap.above_zero else "less than" if slope.gap.below_zero else "not told from"
    return (
        f"With the forces kept and friction alone changed, the answer on {slope.condition} objects follows the margin "
        f"with a slope of {_gap(slope.network)}, {verdict} that of the best reading of the markers, "
        f"{decimals(slope.reading.estimate, 2)}: difference {_gap(slope.gap)}."
    )
