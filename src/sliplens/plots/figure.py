"""One figure for each kind of result, and one of a proposed sensor profile."""

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from textwrap import fill as wrap
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from sliplens.codec import COLUMN_KINDS, Columns, Result, table_rows
from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK, require_new_file
from sliplens.intervals import Difference
from sliplens.markers.gel import SensorProposal, propose_profile
from sliplens.plots import charts, style
from sliplens.plots.saliency import POINTS, SIGN_COLOURS
from sliplens.plots.sheets import plot_margin
from sliplens.recordings.sensor import save_profile
from sliplens.recordings.source import Frames
from sliplens.results.explanation import CLOSE, Explanation, full_points, overlay_points
from sliplens.results.faithfulness import Faithfulness, is_control
from sliplens.results.study import Study, Truth, UntrainedMaps


def plot(result: Any, ax: Axes | None = None, *, index: int | None = None) -> Figure:
    """Draw the main figure of a result.

    An evaluation shows predictions against labels; a training or a network its learning curve; an explanation the map
    over the image, with its warnings; scores of explanations their curves or gains; predictions and readings the margin
    over time; tracked markers their displacement; a study the gain of each method with its 95 % interval; a grip the
    force over the least that holds; a hold the commanded force; a proposed sensor its gel and markers; a split or a
    check how many trials or faults there are. Margins are in percent, gains in margin units.

    Parameters
    ----------
    result
        Result of a function of sliplens or a record of `sliplens.results`; or several in a list, as of `read_live`.
    ax
        Axes to draw on; a new figure if None.
    index
        Number of the image of an explanation, or of the trial of predictions and markers. If None, the image with most
        to explain, or the first trial.

    Returns
    -------
    Figure
        `.savefig(path)` saves it; a notebook shows it.

    Raises
    ------
    InputError
        If there is no picture of such a result, or it holds nothing to draw.

    See Also
    --------
    write_report : Write a page of all results.
    view : Show a trial in the Rerun viewer.

    Examples
    --------
    >>> import numpy as np
    >>> import sliplens as sl
    >>> touched = np.zeros((1, 224, 224, 3), dtype=np.uint8)
    >>> touched[:, 80:120, 90:150] = 90
    >>> figure = sl.plot(sl.explain("chromatouch-difference", touched, method="grad-cam"))
    >>> figure.axes[1].get_ylabel().splitlines()[-1]
    '(points of margin per 1 % of the image)'
    """
    # by the names of the classes: some records live on higher floors, and drawing them needs no torch
    name = next((kind.__name__ for kind in type(result).__mro__ if kind.__name__ in DRAWERS), "")
    if isinstance(result, list | tuple) and all(map(is_dataclass, result)):
        result = pa.Table.from_pylist(table_rows(result))
    elif not name and not isinstance(result, Result | Columns):
        raise InputError(
            f"there is no picture of a {type(result).__name__}; plot a result, such as that of sl.predict or sl.explain"
        )
    with style.drawing_style():
        figure = Figure(figsize=(6.4, 4.2), layout="constrained") if ax is None else ax.get_figure(root=True)
        assert figure is not None
        axes = figure.subplots() if ax is None else ax
        DRAWERS.get(name, _rows)(result, axes, index)
        if ax is None:  # room for the warnings of a map
            figure.set_figheight(4.2 + 0.15 * axes.get_xlabel().count("\n"))
    return figure


def _explanation(explanation: Explanation, ax: Axes, index: int | None) -> None:
    changes = [frame.prediction - frame.reference_prediction for frame in explanation.frames]
    row = _of(len(changes), int(np.argmax(np.abs(changes))) if index is None else index)
    frame, method, baseline = explanation.frames[row], explanation.method, explanation.baseline_words(row)
    scale, of_margin = explanation.scale, explanation.unit == "margin"
    unit = POINTS if of_margin else f"{explanation.unit_words} per 1 % of the image"
    relevance = explanation.relevance[method][row, None]
    full = full_points(relevance, scale=scale) / (1 if of_margin else 100)
    ax.imshow(overlay_points([explanation.pictures[row]], relevance, scale=scale)[0])
    ax.set(xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    bar = ax.figure.colorbar(ScalarMappable(Normalize(-full, full), SIGN_COLOURS), ax=ax, shrink=0.9)
    bar.set_label(f"orange lowers the prediction, blue raises it\n({unit})", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    predicted = "withheld" if frame.withheld else style.amount(frame.prediction, explanation.unit)
    compared, close = style.amount(frame.reference_prediction, explanation.unit), CLOSE * explanation.scale
    why = f"{frame.id}: why {predicted} rather than {compared}, that of {baseline}"
    if abs(changes[row]) <= close:
        near = style.amount(close, explanation.unit)
        why = f"{frame.id}: nothing to explain, for {predicted} is within {near} of that of {baseline}"
    ax.set_title(f"{style.method_name(method)}\n{wrap(why, 46)}", fontsize=9, parse_math=False)
    warnings = {text: _FRAMES_OF.match(text) for text in explanation.methods[method].warnings}
    more = "\N{HORIZONTAL ELLIPSIS}"
    texts = [text for text, match in warnings.items() if match is None or {frame.id, more} & {*match[1].split(", ")}]
    ax.set_xlabel(wrap("; ".join(texts), 62), fontsize=7.5, loc="left", color=style.VERMILLION)


_FRAMES_OF = re.compile(r"\d+ of \d+ frames? \((.*?)\): ")
"""Beginning of a warning of some frames, with their names."""


def _faithfulness(faithfulness: Faithfulness, ax: Axes, _: int | None) -> None:
    if not faithfulness.scores:
        raise InputError("these scores hold no method; score some explanations first")
    fill, unit = faithfulness.scores[0].fill, faithfulness.scores[0].unit
    gains = {score.method: score.srg for score in faithfulness.scores if (score.fill, score.unit) == (fill, unit)}
    methods = [name for name in gains if not is_control(name)]
    if len(methods) == 1:
        charts.plot_removal(faithfulness.curves[fill, unit, methods[0]], colour=style.BLUE, ax=ax)
        ax.set(xlabel="Removed (% of the image)", ylabel=f"Evidence lost ({faithfulness.unit_words})", xlim=(0, 100))
        ax.set_title(f"{style.method_name(methods[0])} ({style.fill_name(fill, unit)})")
        ax.legend()
        return
    _plot_methods(gains, ax)
    ax.set(xlabel=f"Symmetric gain, {style.fill_name(fill, unit)} ({faithfulness.unit_words}, 95 % interval)")
    ax.set_title(style.input_name(faithfulness.input))


def _truth(truth: Truth, ax: Axes, _: int | None) -> None:
    scores = {name: method.neutral for name, method in truth.methods.items() if method.neutral is not None}
    _plot_methods(scores, ax)
    ax.set(xlabel="Correlation with the effects of moved groups of markers (95 % interval)")
    ax.set_title(style.input_name(truth.input))


def _untrained(record: UntrainedMaps, ax: Axes, index: int | None) -> None:
    name, maps = next(iter(record.maps.items()))
    ax.figure.colorbar(ax.imshow(maps[index or 0], cmap="gray"), ax=ax, label="relevance in the output's unit")
    ax.set_title(style.method_name(name))


def _rows(result: Any, ax: Axes, _: int | None) -> None:
    """Draw the first number of each row of a table: a bar a row where they are few, else a line.

    Rows of texts alone are counted; those of readings are drawn over time.
    """
    table = result if isinstance(result, pa.Table) else result.to_arrow()
    if "captured_s" in table.column_names:
        names = {"margin": "prediction", "low": "low_90", "high": "high_90", "true_margin": "safety_margin"}
        charts.plot_margins(table.rename_columns([names.get(name, name) for name in table.column_names]), ax=ax)
        return
    kinds = dict(zip(table.column_names, table.schema.types, strict=True))
    numbers = [name for name, kind in kinds.items() if COLUMN_KINDS["numbers"](kind)]
    texts = [table[each].to_pylist() for each, kind in kinds.items() if COLUMN_KINDS["texts"](kind)]
    least = 1 if numbers or table is result else 2  # one row of texts is no table
    if len(table) < least or not (numbers or texts):
        raise InputError("there is nothing to draw: this result holds no number, or is empty")
    if numbers:
        name = next((name for name in numbers if name == "frames" or pa.types.is_floating(kinds[name])), numbers[0])
        values, words = charts.column(table, name), name.replace("_", " ")
        labels = [f"{number}  {style.method_name(text)}" for number, text in enumerate(texts[0])] if texts else []
    else:
        counts = Counter(min(texts, key=lambda column: (len({*column}), len("".join(map(str, column))))))
        labels, values, words = [*counts], np.array([*counts.values()]), "number of rows"
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    if len(values) > _MOST_BARS or not labels:
        ax.plot(values, color=style.BLUE)
        ax.set(xlabel="Row", ylabel=words)
        return
    ax.barh(labels, values, color=style.BLUE, height=0.6)
    ax.invert_yaxis()
    ax.set(xlabel=words)


def _plot_methods(values: Mapping[str, Difference], ax: Axes) -> None:
    """Draw the value of each method with its interval, the first on top, controls in grey."""
    names = style.methods_in_order(values)
    for place, name in enumerate(names):
        value, colour = values[name], style.GREY if is_control(name) else style.BLUE
        if value.low is not None and value.high is not None:
            ax.plot([value.low, value.high], [place, place], color=colour)
        ax.plot([value.estimate], [place], color=colour, marker="o")
    ax.axvline(0, color=style.BLACK, linewidth=0.8, linestyle=":")
    ax.set_yticks(range(len(names)), [style.method_name(name) for name in names])
    ax.invert_yaxis()


def _study(study: Study, ax: Axes, index: int | None) -> None:
    if not study.faithfulness:
        raise InputError("this study holds no scores; run `sliplens study` on")
    _faithfulness(study.faithfulness[sorted(study.faithfulness)[0]], ax, index)


def _tracking(tracking: Any, ax: Axes, index: int | None) -> None:
    rows = _rows_of_trial(tracking.to_arrow(), index)
    frame, right, down = (charts.column(rows, name) for name in ("frame", "dx_px", "dy_px"))
    frames, length = np.unique(frame), np.hypot(right, down)
    lengths = [length[(frame == number) & np.isfinite(length)] for number in frames]
    for values, name, colour in (
        ([np.median(moved) if len(moved) else np.nan for moved in lengths], "median marker", style.BLUE),
        ([moved.max() if len(moved) else np.nan for moved in lengths], "marker that moved most", style.VERMILLION),
    ):
        ax.plot(frames, values, color=colour, label=name)
    ax.set(xlabel="Frame", ylabel="Displacement (px)")
    ax.set_title(rows["trial"][0].as_py(), parse_math=False)
    ax.legend()


def _rows_of_trial(table: pa.Table, index: int | None) -> pa.Table:
    names = table["trial"].unique().to_pylist()
    if not names:
        raise InputError("there is no frame to draw; predict at least one")
    return table.filter(pc.field("trial") == names[_of(len(names), index or 0)])


def _of(count: int, index: int) -> int:
    if not -count <= index < count:
        raise InputError(f"there is no number {index} among {count}; count from 0")
    return index


def _network(network: Any, ax: Axes, _: int | None) -> None:
    if network.training is None:
        raise InputError("this network has no record of its training; plot what sl.predict or sl.explain makes of it")
    charts.plot_learning_curves({network.training.input: network.training}, ax=ax)


def _proposal(proposal: SensorProposal, ax: Axes, _: int | None) -> None:
    """Draw the camera's frame with gel, crop and markers."""
    frame, markers = proposal.picture, proposal.markers_px
    ax.imshow(frame)
    crop = proposal.profile.crop_px or (0, 0, frame.shape[1], frame.shape[0])
    for (x, y, *size), colour, words in ((proposal.gel_px, style.BLUE, "gel"), (crop, style.VERMILLION, "crop_px")):
        box = {"fill": False, "color": colour, "linewidth": 1.6, "label": words}
        ax.add_patch(Rectangle((x - 0.5, y - 0.5), *size, **box))
    if len(markers):
        words = f"{len(markers)} markers ({proposal.profile.markers})"
        ax.plot(*markers.T, "o", mfc="none", mec="white", ms=9, label=words)
    ax.set(title="camera", xlabel="x in pixels", ylabel="y in pixels")
    below = {"bbox_to_anchor": (0.5, -0.16), "facecolor": "0.7"}  # rings are white
    ax.legend(loc="upper center", ncols=3, frameon=True, **below)
    ax.grid(visible=False)


_MOST_BARS = 40
DRAWERS: dict[str, Callable[[Any, Axes, int | None], object]] = {
    "Evaluation": lambda result, ax, _: charts.plot_predictions(result.predictions, ax=ax),
    "Training": lambda result, ax, _: charts.plot_learning_curves({result.input: result}, ax=ax),
    "Network": _network,
    "Explanation": _explanation,
    "UntrainedMaps": _untrained,
    "DeletionScores": lambda of, ax, _: charts.plot_faithfulness(of.curves, ax=ax).set_title(f"{of.input} images"),
    "Faithfulness": _faithfulness,
    "Study": _study,
    "Truth": _truth,
    "Predictions": lambda result, ax, index: charts.plot_margins(
        _rows_of_trial(result.to_arrow(), index), ax=ax, unit=result.unit
    ),
    "ScoredFrames": lambda result, ax, index: charts.plot_margins(_rows_of_trial(result.to_arrow(), index), ax=ax),
    "Tracking": _tracking,
    "Grip": lambda of, ax, _: charts.plot_grip_force(of.trace.to_arrow(), ax=ax).set_title(of.setup.controller),
    "Hold": lambda result, ax, _: charts.plot_grip_force(result.steps.to_arrow(), ax=ax).set_title(result.controller),
    "Recording": lambda result, ax, _: plot_margin(result, ax=ax).set_title(result.trial, parse_math=False),
    "Strip": lambda result, ax, _: charts.plot_readings(result, ax=ax),
    "SensorProposal": _proposal,
}
"""Functions that draw a record, by the name of its class."""


def write_proposal(proposal: SensorProposal, path: Path) -> None:
    """Save the camera's frame with gel, crop and markers beside the frame that the profile makes of it, as PNG."""
    profile, frame = proposal.profile, proposal.picture
    with style.drawing_style(), style.written_whole(path) as part:
        figure = Figure(figsize=(9.6, 4.6), layout="constrained")
        camera, made = figure.subplots(1, 2, width_ratios=(frame.shape[1] / frame.shape[0], 1.0))
        _proposal(proposal, camera, None)
        made.imshow(profile.apply(frame))
        apart = f" (markers {proposal.spacing_px:.1f} apart)" if np.isfinite(proposal.spacing_px) else ""
        made.set(title=f"{profile.name}, after the profile", xlabel=f"x in pixels{apart}", ylabel="y in pixels")
        made.grid(visible=False)
        figure.savefig(part, dpi=120, format="png")


def make_profile(
    source: Path | str | Frames,
    out: Path | str,
    *,
    name: str | None = None,
    network: str = DEFAULT_NETWORK,
    keep_size: bool = False,
    overwrite: bool = False,
) -> SensorProposal:
    """Make the profile of a sensor from a recording, and draw a picture of it beside the file.

    Detects the gel's rectangle and the markers. Check the picture, and correct the file where it is wrong.

    Parameters
    ----------
    source
        Video, bag, folder of images or frames that begin with the sensor untouched.
    out
        Profile to write (TOML); the picture stands beside it as PNG.
    name
        Name of the sensor; that of the file if None.
    network
        Network for the frames, which are scaled to the size it was trained on.
    keep_size
        If True, keep the camera's resolution, to train a network of its own; the profile then names no network.
    overwrite
        Replace an existing file.

    Raises
    ------
    InputError
        If the source cannot be read, its frames show no gel, or the file exists.

    See Also
    --------
    import_recordings : Import recordings with a profile.
    read_live : Read a camera with a profile.

    Examples
    --------
    >>> import sliplens as sl
    >>> sl.make_profile("tip.mp4", "tip.toml").profile.name  # doctest: +SKIP
    'tip'
    """
    from sliplens.models.checkpoint import read_manifest  # noqa: PLC0415 (torch takes seconds)

    path = Path(out)
    require_new_file(path, suffix=".toml", overwrite=overwrite)
    height, width = (0, 0) if keep_size else read_manifest(network).frame_size
    size_px = None if keep_size else (width, height)
    proposal = propose_profile(source, name=name or path.stem, network=None if keep_size else network, size_px=size_px)
    save_profile(proposal.profile, path, notes=proposal.notes)
    write_proposal(proposal, path.with_suffix(".png"))
    return proposal
