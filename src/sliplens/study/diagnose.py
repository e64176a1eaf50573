"""Where a network fails, and why: slices of its errors, its markers, other frictions, and kinds of explanations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from torch.nn.functional import adaptive_avg_pool2d

from sliplens.codec import keep_part, load_result, save_result
from sliplens.errors import InputError
from sliplens.explainers.attribution import frame_of
from sliplens.explainers.explain import join_maps, network_inputs
from sliplens.explainers.frames import frames_at
from sliplens.explainers.shapley import shapley_values
from sliplens.explainers.table import get_explainer
from sliplens.extras import require_packages
from sliplens.faithfulness.removal import answer_whole
from sliplens.faithfulness.scoring import prepare_passes
from sliplens.files import output_folder, remove
from sliplens.intervals import FEWEST_UNITS, Difference, mean_interval, paired_difference
from sliplens.models import Network
from sliplens.models.checkpoint import condition_each, open_run
from sliplens.plots.style import decimals, signed, tell_ends
from sliplens.progress import OnProgress, counted, note, number_of, stage, wrote
from sliplens.recordings import Dataset
from sliplens.recordings.dataset import load_dataset
from sliplens.results.evaluation import (
    Diagnosis,
    ErrorSlice,
    ErrorTable,
    ExplainedErrors,
    FrictionSlope,
    FrictionTable,
    ScoredFrames,
)
from sliplens.results.explanation import Explanation
from sliplens.simulation.intervention import film_with_friction, marker_readings, reading_limit, reading_slope
from sliplens.study.explaining import Explaining
from sliplens.study.truth import StagedFrame, find_places, rank_correlation, redrawing, reliability_of, stage_frames
from sliplens.training import evaluate

Markers = Float64[np.ndarray, " markers"]
LEVELS = (0.8, 0.5, 0.2)
"""Margins at which frames are explained."""
FRICTION_FACTORS = (0.67, 0.8, 1.0, 1.25, 1.5)
"""Other frictions over a frame's own, none so far that the object would be another."""
_SLICES, _LEAST_SHARE, _LEAST_GAIN = 5, 0.1, 0.01
"""Slices at most, the share of the frames that each holds at least, and of the variance that each cut explains."""
_KINDS, _EXAMPLES, _BLOCKS = 6, 2, 8
"""Kinds of explanations at most, examples of each, and blocks across a map that has no markers to compare."""
_DISTINCT = 0.25
"""Silhouette below which Kaufman and Rousseeuw (*Finding Groups in Data*, 1990) find no structure."""
_LOOKED = ("agreement", "reliability", "network_slipping", "reading_slipping")


def diagnose(
    run: Network | Path | str,
    data: Dataset | Path | str,
    out: Path | str | None = None,
    *,
    split: str = "test",
    trials: int = 8,
    pairs: int = 120,
    seed: int = 0,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Diagnosis:
    """Find out where a network fails, and why.

    Half of the trials tell in which slices (condition, friction, force, place of contact, day, sensor) the error is
    large; the other half tests them. Frames are explained, and the explanations sorted into kinds. In simulation those
    are Shapley values of the markers over redrawn scenes, beside those of the best reading, and the same press and pull
    is filmed anew with other frictions.

    Parameters
    ----------
    run
        Network, its folder, or the name of one that comes with sliplens.
    out
        Workspace, with a subfolder for the evaluation and one for the diagnosis; nothing is kept if None.
    trials, pairs
        Trials of each condition of which three frames are explained, and pairs of coalitions of markers that are asked
        for each, at least twice the markers.

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
    >>> [one.name for one in diagnosis.slices if one.holds]  # doctest: +SKIP
    ['normal force above 0.493 N, friction up to 0.242']
    """
    require_packages("sklearn", extra="diagnose", purpose="finding where a network fails")
    if trials < 1:
        raise InputError(f"--trials must be at least 1, got {trials}")
    run = open_run(run)
    data = data if isinstance(data, Dataset) else load_dataset(data)
    name, weights = run.manifest.input, run.manifest.weights_sha256
    record = None if out is None else Path(out) / f"evaluate-{name}"
    answers = evaluate(run, data, record, split=split, overwrite=overwrite, on_progress=on_progress).predictions
    make = partial(_diagnose, run, data, answers, on_progress, trials=trials, pairs=pairs, seed=seed)
    if out is None:
        return make(None)
    config = {"weights_sha256": weights, "data_hash": data.hash, "input": name, "split": split, **make.keywords}
    target = Path(out) / f"diagnose-{name}"
    with output_folder(target, stage="diagnose", config=config, overwrite=overwrite) as output:
        if not output.complete:
            save_result(make(parts := output.folder / "parts"), output.folder)
            remove(parts)
    wrote(on_progress, target, "where the network fails, and why", kept=output.complete)
    return load_result(target, Diagnosis, command="sliplens diagnose")


def _diagnose(
    run: Network,
    data: Dataset,
    answers: ScoredFrames,
    on_progress: OnProgress | None,
    parts: Path | None,
    *,
    trials: int,
    pairs: int,
    seed: int,
) -> Diagnosis:
    rng = np.random.default_rng(seed)
    with stage(on_progress, "Reading what may explain the errors") as count:
        errors = tabulate_errors(data, answers, on_progress=count)
    slices, errors = find_slices(errors, seed=seed)
    values = errors.where(_spread_rows(errors, trials))
    chosen = frames_at(run, data, list(zip(values.trial.tolist(), values.frame.tolist(), strict=True)))
    explained, left_out = join_maps(run, chosen, {}), ""
    try:
        frames = stage_frames(run, explained, data)
    except InputError as error:
        left_out = f"What the markers do, and what other frictions would change, is left out: {error}."
        note(on_progress, left_out)
        with stage(on_progress, "Explaining frames") as count:
            ig, method = "integrated-gradients", "Integrated Gradients"
            work = Explaining(
                trained=run, chosen=replace(chosen, find_markers=None), explainers={ig: get_explainer(ig)}
            )
            maps = work.make(parts, on_progress=count).relevance[ig]
        rows = adaptive_avg_pool2d(torch.from_numpy(maps)[:, None], _BLOCKS).flatten(1).double().numpy()
        measured = dict.fromkeys((*_LOOKED, "limit"), np.full(len(values), np.nan))
        frictions, pictures, drawn = as_frictions([]), explained.pictures[:0], ""
    else:
        with stage(on_progress, "Asking for each marker's part") as count:
            records = find_contributions(run, explained, frames, pairs=pairs, seed=seed, parts=parts, on_progress=count)
        size, rows = run.manifest.image_size, np.stack([record.values for record in records])
        maps = np.stack(
            [find_places(frame, image_size=size).paint(row) for frame, row in zip(frames, rows, strict=True)]
        )
        measured = {name: np.array([getattr(record, name) for record in records]) for name in _LOOKED}
        measured["limit"] = np.array([reading_limit(frame.scene, frame.number) for frame in frames])
        method = "Shapley values of the markers"
        with stage(on_progress, "Filming with other frictions") as count:
            frictions, pictures, drawn = refilm(run, frames, values.condition.tolist(), on_progress=count)
    kinds, examples, silhouette = cluster_explanations(rows, np.abs(values.error), seed=seed)
    place = np.full(len(values), -1)
    place[examples] = np.arange(len(examples))
    text = tell_friction(run, network_inputs(run, explained), values.friction)
    table = ExplainedErrors(**vars(values), **measured, told=text, cluster=kinds, example=place)
    slopes, valid = friction_slopes(frictions, rng), (say_errors(errors, rng), say_slices(slices))
    valid += (*say_limits(table, rng), *say_told(table, rng), *map(say_slope, slopes))
    sentences = (*valid, *say_looked(table, slices, rng), say_kinds(table, silhouette))
    return Diagnosis(
        input=run.manifest.input, source=data.source, sentences=sentences, left_out=left_out, slices=slices,
        slopes=slopes, method=method, errors=errors, explained=table, frictions=frictions,
        pictures=explained.pictures[examples], maps=maps[examples].astype(np.float32), shown_frame=drawn,
        other_frictions=pictures,
    )  # fmt: skip


def tabulate_errors(data: Dataset, answers: ScoredFrames, *, on_progress: OnProgress | None = None) -> ErrorTable:
    """Put beside each answer what may have made it wrong."""
    pieces = []
    for (trial,), rows in counted(answers.groups("trial").items(), on_progress):
        info, places = data.find(trial), [np.full(len(rows), np.nan)] * 2
        recording = data.load(info)
        if recording.truth is not None:
            touching = (recording.truth.contact_map[rows.frame] > 0).astype(np.float64)
            pixels = np.maximum(touching.sum(axis=(1, 2)), 1)
            along = [touching.sum(axis=axis) for axis in (1, 2)]
            places = [record @ (np.arange(record.shape[1]) + 0.5) / record.shape[1] / pixels for record in along]
        table = ErrorTable(
            **vars(rows),
            sensor=np.repeat(info.sensor, len(rows)),
            friction=recording.friction_coefficient[rows.frame].astype(np.float64),
            normal_force_n=recording.normal_force_n[rows.frame].astype(np.float64),
            contact_x=places[0],
            contact_y=places[1],
            slice=np.full(len(rows), -1),
        )
        pieces.append(table)
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
    numbers = {"friction {}": errors.friction, "normal force {} N": errors.normal_force_n}
    numbers |= {
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
            rows = ErrorSlice(name=name, frames=len(there), trials=trials, error=error, bias=bias, excess=excess)
            records.append((node, rows))
    records.sort(key=lambda pair: -pair[1].error)
    place = {node: at for at, (node, _) in enumerate(records)}
    slices = np.array([place.get(leaf, -1) for leaf in leaves.tolist()], dtype=np.int64)
    return tuple(record for _, record in records), replace(errors, slice=slices)


def _mean(
    values: Float[np.ndarray, " rows"],
    table: ErrorTable | FrictionTable,
    rng: np.random.Generator,
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> Difference:
    """Mean over rows of a table with a 95 % interval over days and trials."""
    return mean_interval(values, clusters=[table.day.astype(str), table.trial], rng=rng, limits=limits)


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


@dataclass(frozen=True, kw_only=True)
class MarkerContributions:
    """Contributions of a frame's markers in margin units, and what an `ExplainedErrors` says of them."""

    values: Markers
    agreement: float
    reliability: float
    network_slipping: float
    reading_slipping: float


def hold_against(
    values: Markers, errors: Markers, reading: Markers, state: Int64[np.ndarray, " markers"]
) -> MarkerContributions:
    """Hold contributions of markers that slip (1), stick (2) or touch nothing (0) against those to the best reading."""
    sizes, least = (np.abs(values), np.abs(reading)), np.finfo(float).tiny
    network, best = (float(size[state == 1].sum() / max(size[state > 0].sum(), least)) for size in sizes)
    return MarkerContributions(
        values=values, agreement=rank_correlation(values, reading), reliability=reliability_of(values, errors),
        network_slipping=network, reading_slipping=best,
    )  # fmt: skip


def find_contributions(
    run: Network,
    explained: Explanation,
    frames: Sequence[StagedFrame],
    *,
    pairs: int,
    seed: int,
    parts: Path | None = None,
    on_progress: OnProgress | None = None,
) -> list[MarkerContributions]:
    """Shapley values of the markers over redrawn scenes: a marker that takes no part lies where it rested.

    The best reading is linear in the markers: what each adds to it is its Shapley value.
    """
    redraw, markers = redrawing(run, frames), len(frames[0].markers)
    pairs = max(pairs, 2 * markers)
    predict = prepare_passes(run, network_inputs(run, explained), 2 * pairs * len(frames))

    def find(index: int) -> MarkerContributions:
        def worth(members: Bool[np.ndarray, "coalitions markers"]) -> Float64[np.ndarray, " coalitions"]:
            some = np.array_split(~members, -(-len(members) // 64))
            return np.concatenate([answer_whole(predict, redraw(index, back)) for back in some])

        # a run that goes on asks the same
        shares = shapley_values(worth, markers, pairs=pairs, rng=np.random.default_rng((seed, index)))
        reading = marker_readings(frames[index].scene, frames[index].number)[1]
        state = find_places(frames[index], image_size=run.manifest.image_size).state
        return hold_against(shares.values, shares.standard_errors, reading, state)

    indices = counted(range(len(frames)), on_progress)
    return [keep_part(parts and parts / f"{at:05d}", MarkerContributions, partial(find, at)) for at in indices]


def tell_friction(
    run: Network, inputs: Float[torch.Tensor, "frames colours size size"], friction: Float64[np.ndarray, " frames"]
) -> Float64[np.ndarray, " frames"]:
    """Answers where each frame's friction is told; NaN of a network that cannot be told, or where one is not known."""
    traction = run.manifest.traction
    if traction is None or not np.isfinite(friction).all():
        return np.full(len(friction), np.nan)
    untold = run.estimate_batches(inputs.split(64))
    conditioned = condition_each(
        untold, friction, trained_friction=np.array(traction.friction), calibration=traction.told
    )
    return conditioned.margin.astype(np.float64)


def refilm(
    run: Network, frames: Sequence[StagedFrame], conditions: Sequence[str], *, on_progress: OnProgress | None = None
) -> tuple[FrictionTable, UInt8[np.ndarray, "shown size size 3"], str]:
    """Film frames anew with other frictions, and ask the network; gives the table, pictures of one frame, and its name.

    That frame is of the last condition, in the middle of the margin.
    """
    rows, pictures, films, last = [], {}, [], None
    for frame, condition in counted(list(zip(frames, conditions, strict=True)), on_progress):
        at, scene = frame.number, frame.scene
        if scene is not last:  # frames of a trial stand together
            values, last = scene.loading.friction_coefficient, scene
            films = [film_with_friction(scene, factor * values) for factor in FRICTION_FACTORS]
        valid = [film for film in films if np.isfinite(film.loading.safety_margin[at])]
        drawn = np.concatenate([film.film.draw(slice(at, at + 1)).numpy() for film in valid])
        inputs = run.encode(drawn, frame.reference).to(run.device)
        pictures[frame.id] = (255 * frame_of(inputs)).round().byte().permute(0, 2, 3, 1).cpu().numpy()
        for film, answer in zip(valid, run.predict(inputs).tolist(), strict=True):
            truth = (film.loading.friction_coefficient[at], film.loading.safety_margin[at])
            rows.append((frame.id, frame.trial, condition, frame.day, *truth, answer, reading_slope(film, at)))
    of_last = [frame for frame, condition in zip(frames, conditions, strict=True) if condition == conditions[-1]]
    chosen = min(of_last, key=lambda frame: abs(frame.safety_margin - 0.5)).id
    return as_frictions(rows), pictures[chosen], chosen


def as_frictions(rows: Sequence[tuple[Any, ...]]) -> FrictionTable:
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


def cluster_explanations(
    rows: Float[np.ndarray, "frames parts"], sizes: Float64[np.ndarray, " frames"], *, seed: int
) -> tuple[Int64[np.ndarray, " frames"], list[int], float | None]:
    """Sort explanations, each divided by the sum of its sizes, into as many kinds as have the largest silhouette.

    Gives each one's kind, that of the largest mean of `sizes` (errors) first; the rows nearest to the middle of each
    kind; and the silhouette (Rousseeuw, 1987), None where too few differ to have kinds.
    """
    from sklearn.cluster import KMeans  # noqa: PLC0415 (an extra)
    from sklearn.metrics import silhouette_score  # noqa: PLC0415

    rows = rows / np.maximum(np.abs(rows).sum(axis=1, keepdims=True), np.finfo(float).tiny)
    best, highest = np.zeros(len(rows), dtype=np.int64), None
    for count in range(2, min(_KINDS, len(np.unique(rows, axis=0)) - 1) + 1):
        labels = KMeans(count, n_init=10, random_state=seed).fit_predict(rows)  # pyright: ignore[reportArgumentType]
        silhouette = float(silhouette_score(rows, labels))
        # a frame alone is no kind
        if np.bincount(labels).min() >= _EXAMPLES and (highest is None or silhouette > highest):
            best, highest = labels, silhouette
    order = sorted(np.unique(best).tolist(), key=lambda label: -sizes[best == label].mean())
    kinds, examples = np.array([order.index(label) for label in best.tolist()], dtype=np.int64), []
    for kind in range(len(order)):
        frames = np.flatnonzero(kinds == kind)
        away = np.linalg.norm(rows[frames] - rows[frames].mean(axis=0), axis=1)
        examples += frames[np.argsort(away, kind="stable")[:_EXAMPLES]].tolist()
    return kinds, examples, highest


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


def say_limits(table: ExplainedErrors, rng: np.random.Generator) -> list[str]:
    """Say how much of the error is in the picture already: what no unbiased reader of one frame does better than."""
    texts = []
    for condition, rows in _enough(table, table.limit).items():
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


def say_told(table: ExplainedErrors, rng: np.random.Generator) -> list[str]:
    """Say what is left of the error where the network is told the friction that holds."""
    texts = []
    for condition, rows in _enough(table, table.told).items():
        text = replace(rows, prediction=rows.told)
        gain = _mean(np.abs(text.error) - np.abs(rows.error), rows, rng)
        texts.append(f"{_off(text)} points on {condition} objects, untold {_off(rows)}: {_gap(gain, points=True)}")
    return [f"Told the friction that holds, the same network is {'; '.join(texts)}."] if texts else []


def _enough(table: ExplainedErrors, known: Float64[np.ndarray, " frames"]) -> dict[str, ExplainedErrors]:
    """Frames of each condition, where a value is known and trials are enough to say something."""
    groups = {name: rows for (name,), rows in table.where(np.isfinite(known)).groups("condition").items()}
    return {name: group for name, group in groups.items() if len(np.unique(group.trial)) >= FEWEST_UNITS}


def say_looked(table: ExplainedErrors, slices: Sequence[ErrorSlice], rng: np.random.Generator) -> list[str]:
    """Say how far the markers' parts are those of the best reading, in each condition and where the error is larger."""
    groups = {f"on {name} objects": table.condition == name for (name,) in table.groups("condition")}
    groups["in the slices of larger error"] = np.isin(table.slice, [at for at, part in enumerate(slices) if part.holds])
    valid = {name: table.where(rows & np.isfinite(table.agreement)) for name, rows in groups.items()}
    return [
        f"In {_frames(rows)} {name} the markers' parts in the answer rank as in the best reading, to a signed rank "
        f"correlation (Spearman's) of {_gap(_mean(rows.agreement, rows, rng, (-1.0, 1.0)))}; of the parts in contact, "
        f"{100 * rows.network_slipping.mean():.0f} % of the answer's and {100 * rows.reading_slipping.mean():.0f} % of "
        "the best reading's are of slipping markers: "
        f"{_gap(_mean(rows.network_slipping - rows.reading_slipping, rows, rng), points=True)}." + _say_sampling(rows)
        for name, rows in valid.items()
        if len(np.unique(rows.trial)) >= FEWEST_UNITS
    ]


def _say_sampling(table: ExplainedErrors) -> str:
    reliability = float(table.reliability.mean())
    text = f" Another estimate of the answer's from as many scenes would correlate with this one by {reliability:.2f}."
    return text if np.isfinite(reliability) else ""


def say_slope(slope: FrictionSlope) -> str:
    """Say whether the answer follows the margin where friction alone changes, and whether the markers let it."""
    verdict = "more than" if slope.gap.above_zero else "less than" if slope.gap.below_zero else "not told from"
    return (
        f"With the forces kept and friction alone changed, the answer on {slope.condition} objects follows the margin "
        f"with a slope of {_gap(slope.network)}, {verdict} that of the best reading of the markers, "
        f"{decimals(slope.reading.estimate, 2)}: difference {_gap(slope.gap)}."
    )


def say_kinds(table: ExplainedErrors, silhouette: float | None) -> str:
    """Say how many kinds of explanations there are, whether they are distinct, and which has the largest error."""
    if silhouette is None:
        return "The explanations are too few to be sorted into kinds."
    kinds = [table.where(table.cluster == kind) for kind in np.unique(table.cluster)]
    distinct = "distinct" if silhouette >= _DISTINCT else "hardly distinct: they shade into one another"
    first, last = (f"({_frames(rows)}) is {_off(rows)} percentage points" for rows in (kinds[0], kinds[-1]))
    return (
        f"Explanations fall into {len(kinds)} kinds (silhouette {decimals(silhouette, 2)}, {distinct}). That of the "
        f"largest error {first}, that of the smallest {last}."
    )
