from dataclasses import replace

import numpy as np
import pytest

from sliplens.plots.margins import draw_strip
from sliplens.results.explanation import Strip, StripReadings


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
            low=np.nan_to_num(margin) * 0.5,
            high=np.ones(5),
            withheld=np.full(5, ""),
        ),
        shown=(1, 3),
        pictures=np.full((2, 8, 8, 3), 100, dtype=np.uint8),
        relevance=np.array([np.zeros((4, 4)), np.diag([-0.02, 0.01, 0, 0])], dtype=np.float32),
    )


def test_a_strip_says_what_was_read_and_what_was_true(strip):
    figure = draw_strip(strip)
    titles = [ax.get_title(loc="center") for ax in figure.axes]
    assert "1: 90 % predicted\n100 % true" in titles
    assert "2: 18 % predicted\n20 % true" in titles


def test_colours_tell_the_sign_and_nothing_is_coloured_where_nothing_speaks(strip):
    empty, mapped = (np.asarray(ax.images[0].get_array()) for ax in draw_strip(strip).axes[:2])
    assert np.ptp(empty, axis=2).max() < 1e-6  # grey all over
    lowers, raises = mapped[0, 0], mapped[2, 2]
    assert lowers[0] > lowers[2]  # orange
    assert raises[2] > raises[0]  # blue


def test_the_chart_has_units_and_marks_the_moments_with_pictures(strip):
    figure = draw_strip(strip)
    chart = next(ax for ax in figure.axes if ax.get_xlabel() == "Time (s)")
    assert chart.get_ylabel() == "Safety margin (%)"
    assert {text.get_text() for text in chart.texts} == {"1", "2"}


def test_a_withheld_moment_shows_no_margin_and_a_grey_chart(strip):
    gap = np.arange(5) == 3
    values = {name: np.where(gap, np.nan, getattr(strip.readings, name)) for name in ("prediction", "low", "high")}
    readings = replace(strip.readings, **values, withheld=np.where(gap, "strange; train it", ""))
    figure = draw_strip(replace(strip, readings=readings))
    titles = [ax.get_title(loc="center") for ax in figure.axes]
    assert "2: withheld\n20 % true" in titles
    chart = next(ax for ax in figure.axes if ax.get_xlabel() == "Time (s)")
    legend = chart.get_legend()
    assert legend is not None
    assert "withheld: strange" in {text.get_text() for text in legend.get_texts()}
