import numpy as np
import pytest
from made_up import write_workspace
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.plots.charts import (
    plot_bins,
    plot_faithfulness,
    plot_learning_curves,
    plot_predictions,
)
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
    evaluations, scored = results.evaluations, results.deletion["difference"]
    return {
        "bins": lambda: plot_bins({key: one.conditions["dry"].bins for key, one in evaluations.items()}, ax=ax),
        "predictions": lambda: plot_predictions(evaluations["raw"].predictions, ax=ax),
        "learning": lambda: plot_learning_curves(results.trainings, ax=ax),
        "faithfulness": lambda: plot_faithfulness(scored.curves, ax=ax),
    }[name]()


@pytest.mark.parametrize(
    ("name", "labels", "entries"),
    [
        ("bins", ("Safety margin Γ (%)", "MSE (Γ as a fraction, squared)"), ["Raw", "Difference"]),
        ("predictions", ("True Γ (%)", "Predicted Γ (%)"), ["perfect", "dry", "wet"]),
        (
            "learning",
            ("Epoch (passes over the training frames)", "MSE (Γ as a fraction, squared)"),
            ["Raw, training", "Raw, validation", "kept", "Difference, training", "Difference, validation", "kept"],
        ),
        (
            "faithfulness",
            ("Pixels removed (%)", "Deletion score D (no unit)"),
            ["Grad-CAM", "Integrated Gradients", "Poly-CAM", "Random order (control)"],
        ),
    ],
)
def test_figure_names_its_axes_units_and_series(results, ax, name, labels, entries):
    assert draw(name, results, ax) is ax

    assert (ax.get_xlabel(), ax.get_ylabel()) == labels
    assert [entry.partition(":")[0] for entry in legend(ax)] == entries


def test_bars_have_the_height_of_their_bins(results, ax):
    draw("bins", results, ax)

    heights = [[bar.get_height() for bar in group] for group in ax.containers]
    assert heights == [
        [row.mse for row in results.evaluations[key].conditions["dry"].bins] for key in ("raw", "difference")
    ]
    assert [text.get_text() for text in ax.get_xticklabels()] == [str(edge) for edge in range(0, 101, 10)]


def test_faithfulness_curve_is_the_mean_over_frames(results, ax):
    draw("faithfulness", results, ax)

    curve = results.deletion["difference"].curves["grad-cam"]
    np.testing.assert_allclose(ax.lines[0].get_ydata(), curve.scores.mean(axis=0))
    assert np.asarray(ax.lines[0].get_xdata())[-1] == pytest.approx(100)
    assert len(ax.collections) == 4


def test_predictions_outside_the_range_are_shown(results, ax):
    draw("predictions", results, ax)
    predictions = 100 * results.evaluations["raw"].predictions.prediction
    low, high = ax.get_ylim()
    assert low < predictions.min()
    assert high > predictions.max()
