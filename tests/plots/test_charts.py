"""Charts: what the table withholds is grey and drawn nowhere; axes, units and series."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from made_up import write_workspace
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sliplens.plots import charts
from sliplens.plots.charts import draw_strip, plot_margins
from sliplens.results.explanation import Strip, StripReadings
from sliplens.results.study import Study, load_results

TIME_S = np.arange(6) / 10


def rows(*reasons: str | None) -> pa.Table:
    margin = [None if reason else 0.6 for reason in reasons]
    ends = {"low_90": [m and m - 0.2 for m in margin], "high_90": [m and m + 0.2 for m in margin]}
    times = {"frame": range(len(reasons)), "time_s": TIME_S[: len(reasons)]}
    columns = {"trial": ["t"] * len(reasons), **times, "prediction": margin, **ends, "withheld": list(reasons)}
    kinds = {"prediction": pa.float64(), "low_90": pa.float64(), "high_90": pa.float64(), "withheld": pa.string()}
    return pa.table({name: pa.array(values, kinds.get(name)) for name, values in columns.items()})


def drawn(*reasons: str | None) -> tuple[Axes, list[tuple[float, float]], list[str]]:
    """The chart, its grey spans from left to right, and the words of its legend."""
    ax = plot_margins(rows(*reasons), ax=Figure().subplots())
    spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in ax.patches if isinstance(patch, Rectangle)]
    legend = ax.get_legend()
    return ax, spans, [] if legend is None else [text.get_text() for text in legend.get_texts()]


def test_withheld_frames_are_grey_up_to_half_way_to_their_neighbours():
    _, spans, words = drawn(None, "a; cure", "a; cure", None, "b; cure", None)
    assert np.array(spans) == pytest.approx(np.array([(0.05, 0.25), (0.35, 0.45)]))
    assert {"withheld: a", "withheld: b"} < set(words)


def test_where_all_is_withheld_neither_margin_nor_interval_is_drawn():
    ax, [(left, right)], words = drawn("a; cure", "a; cure")
    assert (left, right) == pytest.approx((0, 0.1))
    assert words == ["withheld: a"]
    assert not any(isinstance(drawing, FillBetweenPolyCollection) for drawing in ax.collections)


def test_the_interval_has_a_gap_where_it_is_withheld():
    ax, _, _ = drawn(None, None, "a; cure", None, None)
    [band] = [drawing for drawing in ax.collections if isinstance(drawing, FillBetweenPolyCollection)]
    assert all(TIME_S[2] not in np.asarray(path.vertices)[:, 0] for path in band.get_paths())
    assert np.isnan(np.asarray(ax.lines[0].get_ydata())[2])


@pytest.fixture
def strip() -> Strip:
    time_s = np.arange(5) / 10
    margin = np.array([np.nan, 1.0, 0.6, 0.2, 0.0])
    return Strip(
        trial="t",
        condition="dry",
        source="simulated",
        input="difference",
        method="poly-cam",
        readings=StripReadings(
            time_s=time_s,
            contact_state=np.array(["no contact", "contact", "incipient slip", "incipient slip", "full slip"]),
            safety_margin=margin,
            prediction=np.nan_to_num(margin, nan=1.0) * 0.9,
            low_90=np.nan_to_num(margin) * 0.5,
            high_90=np.ones(5),
            withheld=np.full(5, ""),
        ),
        shown=(1, 3),
        pictures=np.full((2, 8, 8, 3), 100, dtype=np.uint8),
        relevance=np.array([np.zeros((4, 4)), np.diag([-0.02, 0.01, 0, 0])], dtype=np.float32),
    )


def test_a_strip_says_what_was_read_and_what_was_true(strip):
    figure = draw_strip(strip)
    titles = [ax.get_title(loc="center") for ax in figure.axes]
    assert "1: predicted 90\xa0%\ntrue 100\xa0%" in titles
    assert "2: predicted 18\xa0%\ntrue 20\xa0%" in titles


def test_colours_tell_the_sign_and_nothing_is_coloured_where_nothing_speaks(strip):
    empty, mapped = (np.asarray(ax.images[0].get_array()) for ax in draw_strip(strip).axes[:2])
    assert np.ptp(empty, axis=2).max() < 1e-6  # grey all over
    lowers, raises = mapped[0, 0], mapped[2, 2]
    assert lowers[0] > lowers[2]  # orange
    assert raises[2] > raises[0]  # blue


def test_the_chart_has_units_and_marks_the_moments_with_pictures(strip):
    figure = draw_strip(strip)
    chart = next(ax for ax in figure.axes if ax.get_xlabel() == "Time (s)")
    assert chart.get_ylabel() == "Safety margin Γ (%)"
    assert {text.get_text() for text in chart.texts} == {"1", "2"}


def test_a_withheld_moment_shows_no_margin_and_a_grey_chart(strip):
    gap = np.arange(5) == 3
    names = ("prediction", "low_90", "high_90")
    values = {name: np.where(gap, np.nan, getattr(strip.readings, name)) for name in names}
    readings = replace(strip.readings, **values, withheld=np.where(gap, "strange; train it", ""))
    figure = draw_strip(replace(strip, readings=readings))
    titles = [ax.get_title(loc="center") for ax in figure.axes]
    assert "2: withheld\ntrue 20\xa0%" in titles
    chart = next(ax for ax in figure.axes if ax.get_xlabel() == "Time (s)")
    legend = chart.get_legend()
    assert legend is not None
    assert "withheld: strange" in {text.get_text() for text in legend.get_texts()}


CHARTS: dict[str, Callable[[Study, Axes], Axes]] = {
    "bins": lambda results, ax: charts.plot_bins(
        {name: each.conditions["dry"].bins for name, each in results.evaluations.items()}, ax=ax
    ),
    "predictions": lambda results, ax: charts.plot_predictions(results.evaluations["raw"].predictions, ax=ax),
    "learning": lambda results, ax: charts.plot_learning_curves(results.trainings, ax=ax),
    "faithfulness": lambda results, ax: charts.plot_faithfulness(results.deletion["difference"].curves, ax=ax),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Study:
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
