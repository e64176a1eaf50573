from itertools import pairwise

import matplotlib as mpl
import numpy as np
import pytest
from made_up import write_workspace
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from sliplens.plots.errors import (
    plot_bins,
    plot_faithfulness,
    plot_learning_curves,
    plot_margin_over_time,
    plot_predictions,
)
from sliplens.plots.style import BLUE, GREEN, INPUT_COLOURS, ORANGE
from sliplens.report import Results, load_results


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Results:
    return load_results(write_workspace(tmp_path_factory.mktemp("workspace") / "runs"))


@pytest.fixture
def ax() -> Axes:
    return Figure().subplots()


def legend(ax: Axes) -> list[str]:
    found = ax.get_legend()
    return [] if found is None else [text.get_text() for text in found.get_texts()]


def draw(name: str, results: Results, ax: Axes) -> Axes:
    evaluations, scored = results.evaluations, results.scores["difference", "simulated"]
    trial = {key: one.predictions.where(one.predictions.trial == "day4-dry-000") for key, one in evaluations.items()}
    return {
        "bins": lambda: plot_bins({key: one.conditions["dry"].bins for key, one in evaluations.items()}, ax=ax),
        "predictions": lambda: plot_predictions(evaluations["raw"].predictions, colour=ORANGE, ax=ax),
        "learning": lambda: plot_learning_curves(results.trainings, ax=ax),
        "faithfulness": lambda: plot_faithfulness(scored.curves, pixels=24 * 24, ax=ax),
        "time": lambda: plot_margin_over_time(trial, ax=ax),
    }[name]()


@pytest.mark.parametrize(
    ("name", "labels", "entries"),
    [
        ("bins", ("Safety margin Γ (%)", "MSE (Γ as a fraction, squared)"), ["Raw", "Difference"]),
        ("predictions", ("True Γ (%)", "Predicted Γ (%)"), ["perfect", "one frame"]),
        (
            "learning",
            ("Epoch (passes over the training frames)", "MSE (Γ as a fraction, squared)"),
            ["Raw, training", "Raw, validation", "Difference, training", "Difference, validation"],
        ),
        (
            "faithfulness",
            ("Pixels removed (%)", "Deletion score D (no unit)"),
            ["Grad-CAM", "Integrated Gradients", "Poly-CAM", "Random order (control)"],
        ),
        ("time", ("Time (s)", "Safety margin Γ (%)"), ["true", "Raw", "Difference"]),
    ],
)
def test_figure_names_its_axes_units_and_series(results, ax, name, labels, entries):
    assert draw(name, results, ax) is ax

    assert (ax.get_xlabel(), ax.get_ylabel()) == labels
    assert legend(ax) == entries


def test_bars_have_the_height_of_their_bins(results, ax):
    draw("bins", results, ax)

    heights = [[bar.get_height() for bar in group] for group in ax.containers]
    assert heights == [
        [row.mse for row in results.evaluations[key].conditions["dry"].bins] for key in ("raw", "difference")
    ]
    assert [text.get_text() for text in ax.get_xticklabels()] == [str(edge) for edge in range(0, 101, 10)]


def test_bars_of_two_inputs_do_not_overlap(results, ax):
    draw("bins", results, ax)

    bars = sorted((bar.get_x(), bar.get_x() + bar.get_width()) for group in ax.containers for bar in group)
    assert all(end <= start + 1e-9 for (_, end), (start, _) in pairwise(bars))


def test_an_input_keeps_its_colour_in_every_figure(results):
    assert INPUT_COLOURS == {"raw": ORANGE, "difference": BLUE, "pair": GREEN}
    bars = draw("bins", results, Figure().subplots())
    learning = draw("learning", results, Figure().subplots())
    time = draw("time", results, Figure().subplots())

    assert [to_hex(group[0].get_facecolor()).upper() for group in bars.containers] == [ORANGE, BLUE]
    assert [line.get_color() for line in learning.lines] == [ORANGE, ORANGE, BLUE, BLUE]
    assert [line.get_color() for line in time.lines][1:3] == [ORANGE, BLUE]


def test_faithfulness_curve_is_the_mean_over_frames(results, ax):
    draw("faithfulness", results, ax)

    curve = results.scores["difference", "simulated"].curves["grad-cam"]
    np.testing.assert_allclose(ax.lines[0].get_ydata(), curve.scores.mean(axis=0))
    assert np.asarray(ax.lines[0].get_xdata())[-1] == pytest.approx(100)
    assert len(ax.collections) == 4


def test_answers_outside_the_range_are_shown(results, ax):
    draw("predictions", results, ax)

    answers = 100 * results.evaluations["raw"].predictions.prediction
    low, high = ax.get_ylim()
    assert low < answers.min()
    assert high > answers.max()


def test_drawing_leaves_matplotlibs_settings_alone(results, ax):
    before = dict(mpl.rcParams)

    draw("bins", results, ax)

    assert dict(mpl.rcParams) == before
