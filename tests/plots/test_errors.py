from pathlib import Path

import numpy as np
import pytest
from made_up import made_up_evaluation, write_workspace
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from sliplens.plots.errors import (
    draw_evaluation,
    plot_bins,
    plot_faithfulness,
    plot_learning_curves,
    plot_predictions,
)
from sliplens.plots.style import ORANGE
from sliplens.report import Results, load_results
from sliplens.results.evaluation import Evaluation, ScoredFrames


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
        "predictions": lambda: plot_predictions(evaluations["raw"].predictions, colour=ORANGE, ax=ax),
        "learning": lambda: plot_learning_curves(results.trainings, ax=ax),
        "faithfulness": lambda: plot_faithfulness(scored.curves, ax=ax),
    }[name]()


@pytest.mark.parametrize(
    ("name", "labels", "entries"),
    [
        ("bins", ("Safety margin Γ (%)", "MSE (Γ as a fraction, squared)"), ["Raw", "Difference"]),
        ("predictions", ("True Γ (%)", "Predicted Γ (%)"), ["perfect", "one frame"]),
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


def evaluation(*, sure: bool = True) -> Evaluation:
    """Two dry trials that are read well, and a wet one that is read too high."""
    rng = np.random.default_rng(0)
    time = np.arange(60) / 8
    labels = np.clip(1.1 - time / 6.5, 0, 1)
    bias = np.repeat([0.0, 0.03, 0.2], 60)
    condition = np.repeat(["dry", "dry", "wet"], 60)
    answers = np.tile(labels, 3) + bias + rng.normal(0, 0.04, 180)
    sigma = np.where(condition == "wet", 0.12, 0.05) * rng.uniform(0.7, 1.3, 180) if sure else np.full(180, np.nan)
    predictions = ScoredFrames(
        trial=np.repeat(["a", "b", "c_$1"], 60),
        condition=condition,
        day=np.zeros(180, dtype=np.int64),
        frame=np.tile(np.arange(60), 3),
        time_s=np.tile(time, 3),
        safety_margin=np.tile(labels, 3),
        prediction=answers,
        sigma=sigma,
        low_90=np.clip(answers - 1.6 * sigma, 0, 1),
        high_90=np.clip(answers + 1.6 * sigma, 0, 1),
        withheld=np.full(180, ""),
    )
    return made_up_evaluation(predictions, sure=sure)


@pytest.mark.parametrize("sure", [True, False])
def test_the_picture_of_an_evaluation_is_drawn_with_and_without_uncertainty(tmp_path: Path, sure: bool):
    draw_evaluation(evaluation(sure=sure), tmp_path / "page.png", title="train-difference, test trials")
    with Image.open(tmp_path / "page.png") as image:
        pixels = np.array(image.convert("L"))
    # 12 inches at 150 dots, and something is drawn in every third of it
    assert pixels.shape[1] == 1800
    assert all(part.std() > 10 for part in np.array_split(pixels, 3, axis=1))
