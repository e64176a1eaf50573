"""Tables of the page: cells as text, so that the template only lays them out."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float

from sliplens.intervals import Difference, bootstrap_difference
from sliplens.plots.style import (
    CONTROL,
    conditions_in_order,
    decimals,
    input_name,
    inputs_in_order,
    method_name,
    methods_in_order,
    percent,
    short_input_name,
    signed,
    source_name,
)
from sliplens.report.thesis import ACCURACY, DELETION, MARK, NETWORK_PIXELS, SECONDS
from sliplens.report.workspace import Results
from sliplens.results.evaluation import Predictions
from sliplens.results.faithfulness import DeletionCurve, DeletionScores


def compare_errors(first: Predictions, second: Predictions, *, rng: np.random.Generator) -> Difference | None:
    """Difference in MSE of two networks, resampling trials; None unless both answered the very same frames."""
    order_a, order_b = (np.lexsort((one.frame, one.trial)) for one in (first, second))
    same = (
        len(first.trial) == len(second.trial) > 0
        and np.array_equal(first.trial[order_a], second.trial[order_b])
        and np.array_equal(first.frame[order_a], second.frame[order_b])
    )
    if not same:
        return None
    trials, trial_at = np.unique(first.trial[order_a], return_inverse=True)
    sums = np.zeros((3, len(trials)))
    np.add.at(sums[0], trial_at, _squared_error(first)[order_a])
    np.add.at(sums[1], trial_at, _squared_error(second)[order_b])
    np.add.at(sums[2], trial_at, 1.0)
    return bootstrap_difference(sums[0], sums[1], sums[2], rng=rng)


def compare_deletion(first: DeletionCurve, second: DeletionCurve, *, rng: np.random.Generator) -> Difference | None:
    """Difference in D_AUC of two deletion orders, resampling frames; None unless both hold the same frames."""
    if first.frame_ids != second.frame_ids or not first.frame_ids:
        return None
    auc = [curve.scores.mean(axis=1) for curve in (first, second)]
    return bootstrap_difference(auc[0], auc[1], np.ones(len(auc[0])), rng=rng)


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How answers stand to labels: mean absolute error, that of the best constant answer, and pairs in right order."""

    frames: int
    mae: float
    constant_mae: float
    pairs: int
    ordered_pairs: int


def agreement(labels: Float[np.ndarray, " frames"], predictions: Float[np.ndarray, " frames"]) -> Agreement:
    """Compare answers with labels, in margin units.

    The best constant answer is the median of the labels: a network that cannot beat it has read nothing. Pairs with
    equal labels have no order and are left out.
    """
    first, second = np.triu_indices(len(labels), k=1)
    rise, answer = labels[first] - labels[second], predictions[first] - predictions[second]
    return Agreement(
        frames=len(labels),
        mae=float(np.abs(predictions - labels).mean()),
        constant_mae=float(np.abs(labels - np.median(labels)).mean()),
        pairs=int(np.count_nonzero(rise)),
        ordered_pairs=int(np.count_nonzero(rise * answer > 0)),
    )


def _squared_error(predictions: Predictions) -> Float[np.ndarray, " frames"]:
    return (predictions.prediction - predictions.safety_margin) ** 2


Kind = Literal["name", "number", "best", "thesis"]
Shade = Literal[0, 1, 2, 3, 4]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Text of a cell, and what it is: a name, a number, the best number of its group, or a figure of the thesis.

    Attributes
    ----------
    shade
        How dark its ground is, from 0 (as the page) to 4, where a table is read as a map of heat.
    """

    text: str
    kind: Kind = "number"
    shade: Shade = 0


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table with its caption."""

    layout: ClassVar[str] = "table"

    caption: str
    head: tuple[Cell, ...]
    rows: tuple[tuple[Cell, ...], ...]


def table_accuracy(results: Results) -> Table:
    """Tabulate MSE, R2 and MAE by condition and input (thesis, Table 1)."""
    rows = []
    for condition in conditions_in_order(name for one in results.evaluations.values() for name in one.conditions):
        scores = {
            name: results.evaluations[name].conditions[condition]
            for name in inputs_in_order(results.evaluations)
            if condition in results.evaluations[name].conditions
        }
        lowest = min(score.mse for score in scores.values())
        for name, score in scores.items():
            thesis = ACCURACY.get((name, condition), (None, None))
            kind: Kind = "best" if score.mse == lowest and len(scores) > 1 else "number"
            rows.append(
                (
                    Cell(text=condition.capitalize(), kind="name"),
                    Cell(text=input_name(name), kind="name"),
                    Cell(text=decimals(score.mse, 4), kind=kind),
                    Cell(text=decimals(thesis[0], 4), kind="thesis"),
                    Cell(text=decimals(score.r2, 3)),
                    Cell(text=decimals(thesis[1], 2), kind="thesis"),
                    Cell(text=decimals(100 * score.mae, 1)),
                    Cell(text=f"{score.frames} / {score.trials}"),
                )
            )
    return Table(
        caption="How well each network reads the safety margin on test trials. MSE in squared margin units (Γ from 0 "
        "to 1), MAE in percentage points of Γ; the lower MSE of each condition is bold. Grey columns: the "
        f"{MARK}.",
        head=table_head(
            "Objects", "Input", "MSE", "MSE, thesis", "R²", "R², thesis", "MAE (points)", "Frames / trials"
        ),
        rows=tuple(rows),
    )


def table_deletion(scores: dict[str, DeletionScores], *, rng: np.random.Generator) -> Table:
    """Tabulate the deletion score by input and method, with the random control (thesis, Table 2)."""
    rows = []
    for name in inputs_in_order(scores):
        scored = scores[name]
        lowest = min((score.mean for method, score in scored.methods.items() if method != CONTROL), default=None)
        for method in methods_in_order(scored.methods):
            score = scored.methods[method]
            thesis = DELETION.get((name, method))
            rows.append(
                (
                    Cell(text=input_name(name), kind="name"),
                    Cell(text=method_name(method), kind="name"),
                    Cell(text=tell_spread(score.mean, score.sd), kind="best" if score.mean == lowest else "number"),
                    Cell(text=_gap(against_control(scored, method, rng=rng))),
                    Cell(text=decimals(score.last_step_mean, 3)),
                    Cell(text=tell_spread(*thesis) if thesis else decimals(None, 3), kind="thesis"),
                    Cell(text=str(score.frames)),
                )
            )
    sources = " and ".join(sorted({source_name(scored.source) for scored in scores.values()}))
    return Table(
        caption=f"Deletion score D on {sources}, averaged over all steps, mean ± standard deviation over frames; "
        "lower = more faithful, and the lowest of each input is bold. “Against random”: mean difference from the "
        "random control with a 95 % interval (frames resampled); below zero = better than chance. “Last step”: D once "
        f"every pixel is filled, which no map has a part in. Grey column: the {MARK}.",
        head=table_head("Input", "Method", "Score D", "Against random", "Last step", "Score D, thesis", "Frames"),
        rows=tuple(rows),
    )


def against_control(scored: DeletionScores, method: str, *, rng: np.random.Generator) -> Difference | None:
    """Difference of a method's D_AUC from the random control's; None for the control itself or without one."""
    if method == CONTROL or not {method, CONTROL} <= set(scored.curves):
        return None
    return compare_deletion(scored.curves[method], scored.curves[CONTROL], rng=rng)


def table_timing(results: Results) -> Table:
    """Tabulate the seconds a frame of each method, one column for each input and origin of the frames."""
    keys = sorted(results.explanations, key=lambda key: (key[1] == "real", key[0] != "raw", key))
    explained = {key: results.explanations[key] for key in keys}
    sides = sorted({one.image_size for one in explained.values()})
    rows = [
        (
            Cell(text=method_name(method), kind="name"),
            *(
                Cell(text=decimals(one.methods[method].seconds_per_frame if method in one.methods else None, 3))
                for one in explained.values()
            ),
            Cell(text=decimals(SECONDS.get(method), 3), kind="thesis"),
        )
        for method in methods_in_order(name for one in explained.values() for name in one.methods)
    ]
    return Table(
        caption=f"Seconds to explain one frame, images of {' and '.join(map(str, sides))} px. The thesis timed images "
        f"of {NETWORK_PIXELS} px on an RTX 3060 Ti and did not wait for the GPU to finish, so its seconds show the "
        "order of magnitude only.",
        head=table_head("Method", *(f"{short_input_name(name)}, {source}" for name, source in keys), "Thesis"),
        rows=tuple(rows),
    )


def table_real(results: Results) -> Table:
    """Tabulate label and answers of each real frame."""
    explained = {name: one for (name, source), one in results.explanations.items() if source == "real"}
    names = inputs_in_order(explained)
    found = {name: {frame.id: frame for frame in explained[name].frames} for name in names}
    frames = {frame.id: frame for name in names for frame in explained[name].frames}
    rows = []
    for frame in sorted(frames.values(), key=lambda one: (-(one.safety_margin or 0), one.id)):
        answers = [found[name].get(frame.id) for name in names]
        rows.append(
            (
                Cell(text=frame.id, kind="name"),
                Cell(text=frame.condition.capitalize(), kind="name"),
                Cell(text=percent(frame.safety_margin)),
                *(Cell(text=percent(None if answer is None else answer.prediction)) for answer in answers),
            )
        )
    return Table(
        caption=f"{len(rows)} real frames: the recorded safety margin, and what each network reads.",
        head=table_head("Frame", "Objects", "True Γ", *(f"Read from {input_name(name).lower()}" for name in names)),
        rows=tuple(rows),
    )


def table_training(results: Results) -> Table:
    """Tabulate how each network was trained."""
    trainings = {name: results.trainings[name] for name in inputs_in_order(results.trainings)}
    facts = {
        "Backbone": lambda one: one.backbone,
        "Image side (camera)": lambda one: f"{one.image_size} px ({' x '.join(map(str, one.frame_size)) or 'unknown'})",
        "Frames: training / validation": lambda one: f"{_whole(one.train_frames)} / {_whole(one.validation_frames)}",
        "Epochs": lambda one: decimals(one.epochs, 1),
        "Minutes": lambda one: decimals(one.minutes, 1),
        "Stopped by": lambda one: one.stopped_by,
        "Best validation MSE": lambda one: decimals(one.best_validation_mse, 4),
        "Parameters": lambda one: _whole(one.parameters),
        "Seed": lambda one: _whole(one.seed),
    }
    return Table(
        caption="How the networks were trained.",
        head=table_head("", *(input_name(name) for name in trainings)),
        rows=tuple(
            (Cell(text=fact, kind="name"), *(Cell(text=tell(one)) for one in trainings.values()))
            for fact, tell in facts.items()
        ),
    )


def table_head(*texts: str) -> tuple[Cell, ...]:
    """Head of a table; what names the thesis is marked as its own."""
    return tuple(Cell(text=text, kind="thesis" if "thesis" in text.lower() else "name") for text in texts)


def tell_spread(mean: float, sd: float) -> str:
    """Write a mean with its standard deviation."""
    return f"{mean:.3f} ± {sd:.3f}"


def _gap(difference: Difference | None) -> str:
    if difference is None:
        return decimals(None, 3)
    return f"{signed(difference.estimate, 3)} ({signed(difference.low, 3)} to {signed(difference.high, 3)})"


def _whole(value: int | None) -> str:
    return decimals(None, 0) if value is None else f"{value:,}".replace(",", " ")
