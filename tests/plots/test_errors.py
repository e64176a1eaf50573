from collections.abc import Callable

import numpy as np
import pytest
from made_up import write_workspace
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sliplens.plots import charts
from sliplens.report import Results, load_results

CHARTS: dict[str, Callable[[Results, Axes], Axes]] = {
    "bins": lambda results, ax: charts.plot_bins(
        {name: each.conditions["dry"].bins for name, each in results.evaluations.items()}, ax=ax
    ),
    "predictions": lambda results, ax: charts.plot_predictions(results.evaluations["raw"].predictions, ax=ax),
    "learning": lambda results, ax: charts.plot_learning_curves(results.trainings, ax=ax),
    "faithfulness": lambda results, ax: charts.plot_faithfulness(results.deletion["difference"].curves, ax=ax),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Results:
    return load_results(write_workspace(tmp_path_factory.mktemp("workspace") / "runs"))


@pytest.fixture
def ax() -> Axes:
    return Figure().subplots()


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
    assert CHARTS[name](results, ax) is ax
    assert (ax.get_xlabel(), ax.get_ylabel()) == labels
    assert [text.get_text().partition(":")[0] for text in ax.get_legend().get_texts()] == entries


def test_bars_have_the_height_of_their_bins(results, ax):
    CHARTS["bins"](results, ax)
    bins = [results.evaluations[name].conditions["dry"].bins for name in ("raw", "difference")]
    assert [[bar.get_height() for bar in group] for group in ax.containers] == [
        [row.mse for row in rows] for rows in bins
    ]
    assert [text.get_text() for text in ax.get_xticklabels()] == [str(edge) for edge in range(0, 101, 10)]


def test_faithfulness_curve_is_the_mean_over_frames(results, ax):
    CHARTS["faithfulness"](results, ax)
    curve = results.deletion["difference"].curves["grad-cam"]
    np.testing.assert_allclose(ax.lines[0].get_ydata(), curve.scores.mean(axis=0))
    assert np.asarray(ax.lines[0].get_xdata())[-1] == pytest.approx(100)
    assert len(ax.collections) == 4


def test_predictions_outside_the_range_are_shown(results, ax):
    CHARTS["predictions"](results, ax)
    predictions = 100 * results.evaluations["raw"].predictions.prediction
    low, high = ax.get_ylim()
    assert low < predictions.min() < predictions.max() < high
