"""Plates that are charts: errors, deletion curves, and a grip."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

from sliplens.grip.plant import LATENCY_S
from sliplens.grip.records import Grip
from sliplens.plots import errors, style
from sliplens.plots.margins import plot_grip
from sliplens.progress import number_of
from sliplens.report.plates import Plate, rows_of
from sliplens.report.results import Results
from sliplens.report.verdict import ThesisRecord
from sliplens.results.faithfulness import DeletionScores

_FEW = 4  # charts in a row


def _make_charts(count: int, *, each: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """Make a figure of some charts, at most `_FEW` in a row."""
    wide = min(count, _FEW)
    high = -(-count // wide)
    with style.drawing_style():
        figure = Figure(figsize=(each[0] * wide, each[1] * high), layout="constrained")
        axes = list(figure.subplots(high, wide, squeeze=False).ravel())
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, axes[:count]


def plate_bins(results: Results) -> Plate:
    """Draw the MSE by bins of the margin, a chart a condition (thesis, Fig. 7)."""
    bins = {
        condition: {
            name: results.evaluations[name].conditions[condition].bins
            for name in style.inputs_in_order(results.evaluations)
            if condition in results.evaluations[name].conditions
        }
        for condition in _conditions(results)
    }
    rows = [
        (condition, name, score.low, score.high, score.frames, score.mse)
        for condition, by_input in bins.items()
        for name, scores in by_input.items()
        for score in scores
    ]
    # one scale for all conditions, or the eye compares bars that do not compare
    top = 1.15 * max((row[5] for row in rows if row[5] is not None), default=1.0)
    figure, axes = _make_charts(len(bins), each=(4.4, 3.2))
    with style.drawing_style():
        for ax, (condition, by_input) in zip(axes, bins.items(), strict=True):
            errors.plot_bins(by_input, ax=ax).set(ylim=(0, top))
            ax.set_title(f"{condition.capitalize()} objects", parse_math=False)
    return Plate(
        name="fig-07-mse-by-bin",
        figure=figure,
        alt=f"Bars of the mean squared error in bins of the safety margin: {style.listed(list(bins))}",
        caption="Mean squared error by bins of the true safety margin. A bin without bars holds no test frame.",
        columns=("condition", "input", "low", "high", "frames", "mse"),
        rows=rows,
    )


def plate_shift(record: ThesisRecord) -> Plate:
    """Draw R2 of the shipped networks against a shift of the camera."""
    figure, (ax,) = _make_charts(1, each=(5.6, 3.2))
    shifts = [point.shift_px for point in record.shift]
    rows = [(name, point.shift_px, *point.r2[name]) for name in record.shift[0].r2 for point in record.shift]
    with style.drawing_style():
        for name in record.shift[0].r2:
            values, low, high = np.array([point.r2[name] for point in record.shift]).T
            ax.plot(shifts, values, "o-", color=style.INPUT_COLOURS[name], label=style.short_input_name(name))
            ax.fill_between(shifts, low, high, color=style.INPUT_COLOURS[name], alpha=0.15, linewidth=0)
        ax.axhline(0, color=style.BLACK, linewidth=0.8)
        ax.set(
            xlabel="Camera shift (px)", ylabel="R² on dry test trials", ylim=(min(-0.1, *(row[3] for row in rows)), 1)
        )
        ax.legend()
    first, last = record.shift[0], record.shift[-1]
    text = "; ".join(
        f"{style.input_name(name).lower()} {first.r2[name][0]:.2f} unmoved, {last.r2[name][0]:.2f} at the end"
        for name in first.r2
    )
    return Plate(
        name="camera-shift",
        figure=figure,
        alt=f"R² against the shift of the camera: {text}",
        caption="What a moved camera does to each network: R² on test trials, all frames and the reference frame "
        f"shifted alike; bands are 95 % intervals over trials ({record.shift_frames}). {text[:1].upper()}{text[1:]}.",
        columns=("input", "shift_px", "r2", "low", "high"),
        rows=rows,
    )


def plate_predictions(results: Results) -> Plate:
    """Draw the prediction against the label, a chart an input and condition."""
    chosen = [
        (name, condition, results.evaluations[name])
        for condition in _conditions(results)
        for name in style.inputs_in_order(results.evaluations)
        if condition in results.evaluations[name].conditions
    ]
    every = 100 * np.concatenate([evaluation.predictions.prediction for evaluation in results.evaluations.values()])
    figure, axes = _make_charts(len(chosen), each=(3.4, 3.1))
    columns = ("trial", "condition", "frame", "safety_margin", "prediction")
    rows = []
    with style.drawing_style():
        for ax, (name, condition, evaluation) in zip(axes, chosen, strict=True):
            frames = evaluation.predictions.where(evaluation.predictions.condition == condition)
            r2 = style.decimals(evaluation.conditions[condition].r2, 2)
            errors.plot_predictions(frames, colour=style.INPUT_COLOURS.get(name, style.PURPLE), ax=ax)
            # one scale for all, so that the scatter compares
            ax.set(ylim=(min(0.0, every.min()) - 5, max(100.0, every.max()) + 5))
            ax.set_title(f"{style.short_input_name(name)}, {condition} (R² {r2})", parse_math=False)
            rows += [(name, *values) for values in rows_of(*(getattr(frames, column) for column in columns))]
    charts = style.listed([f"{style.input_name(name)}, {condition}" for name, condition, _ in chosen])
    return Plate(
        name="predictions",
        figure=figure,
        alt=f"Predicted against true safety margin: {charts}",
        caption=f"Predicted against true safety margin on {len(every)} frames of test trials. A perfect network would "
        "put every dot on the dashed line.",
        columns=("input", *columns),
        rows=rows,
    )


def plate_deletion(scores: Mapping[str, DeletionScores]) -> Plate:
    """Draw the mean deletion score while pixels go, a chart an input, all of one source (thesis, Fig. 9)."""
    figure, axes = _make_charts(len(scores), each=(4.6, 3.5))
    rows = []
    with style.drawing_style():
        for ax, (name, scored) in zip(axes, scores.items(), strict=True):
            errors.plot_faithfulness(scored.curves, ax=ax).set_title(style.input_name(name))
            for method in style.methods_in_order(scored.curves):
                curve = scored.curves[method]
                low, high = np.quantile(curve.scores, [0.25, 0.75], axis=0)
                values = rows_of(curve.pixels_removed, curve.scores.mean(axis=0), low, high)
                rows += [(name, method, *row) for row in values]
    source, fill = (
        " or ".join(sorted({getattr(score, key) for score in scores.values()})) for key in ("source", "fill")
    )
    return Plate(
        name="fig-09-faithfulness",
        figure=figure,
        alt=f"Deletion score D against pixels removed: {style.listed([style.input_name(name) for name in scores])}",
        caption=f"Deletion score D of the thesis on {style.source_name(source)} while pixels become {fill}, most "
        "salient first; the line is the mean over frames, the band holds the middle half of them. A curve that falls "
        "early names pixels the network relies on; at the right end every pixel is filled.",
        columns=("input", "method", "pixels_removed", "mean", "quartile_low", "quartile_high"),
        rows=rows,
    )


def plate_trace(grip: Grip) -> Plate:
    """Draw force, margin and slip of the first episode."""
    figure, axes = _make_charts(3, each=(3.9, 3.0))
    with style.drawing_style():
        plot_grip(grip.trace.to_arrow(), axes=axes)
    columns = ("time_s", "force_n", "least_force_n", "true_margin", "margin", "low", "high", "slip_m")
    first, setup = grip.episodes.where(np.arange(1)), grip.setup
    count, fell = len(grip.episodes), int(grip.episodes.dropped.sum())
    fate = "fell" if first.dropped[0] else "was held"
    low, high = (style.percent(end) for end in binomtest(fell, count).proportion_ci(method="wilson"))
    excess = style.percent(float(first.force_excess[0]))
    source = "those of drawn frames" if setup.rendered else "looked up in the network's measured errors"
    friction = "" if setup.friction is None else f" Predictions used the coefficient of friction {setup.friction}."
    return Plate(
        name="grip-episode",
        figure=figure,
        alt=f"Force, margin and slip over time: the object {fate}",
        caption=f"A {setup.object}, {setup.condition}, held by the controller {setup.controller}: it {fate}, with a "
        f"mean force of {float(first.mean_force_n[0]):.2f} N, {excess} over the least that holds. Predictions were "
        f"{source}, with a latency of {1e3 * LATENCY_S:.0f} ms and the actuator's lag. The predicted "
        f"margin is the mean of both fingers, the true one that of the finger with less.{friction} Of "
        f"{number_of(count, 'episode')} {fell} fell ({low} to {high}, 95 % interval), with a median force of "
        f"{style.percent(float(np.median(grip.episodes.force_excess)))} over the least that holds.",
        columns=columns,
        rows=rows_of(*(getattr(grip.trace, column) for column in columns)),
    )


def _conditions(results: Results) -> list[str]:
    return style.conditions_in_order(
        name for evaluation in results.evaluations.values() for name in evaluation.conditions
    )
