"""Alarms: each is raised where it must be, and not where it must not."""

from pathlib import Path

import numpy as np
import pytest

from sliplens.faithfulness.scoring import fill_decides, flat_maps, follows_last_step, ranking_alarms, saturated
from sliplens.results.study import Setting


def test_a_fill_that_is_answered_like_the_image_decides():
    told = fill_decides(np.array([0.5, 0.5, 0.9]), np.array([0.52, 0.6, 0.91]), fill="grey")
    assert told == ["the fill decides in 2 of 3 frames: an image of nothing but grey is answered within 5% of the "
                    "whole frame"]  # fmt: skip
    assert fill_decides(np.array([0.5]), np.array([0.1]), fill="grey") == []


def test_a_score_that_follows_its_last_step_measures_the_fill(rng: np.random.Generator):
    last = rng.uniform(size=40)
    assert (
        "correlates with its last step by 0.9" in follows_last_step(last + 0.1 * rng.normal(size=40), last, name="D")[0]
    )
    assert follows_last_step(rng.uniform(size=400), rng.uniform(size=400), name="D") == []
    assert follows_last_step(np.ones(5), np.arange(5.0), name="D") == []


@pytest.mark.real
@pytest.mark.parametrize(("method", "tied"), [("gradcam", 0.87), ("ig", 0.98), ("pcampm", 0.99)])
def test_the_recorded_scores_of_the_thesis_raise_it(chromatouch_folder: Path, method: str, tied: float):
    suffix = "-4" if method == "pcampm" else ""
    path = chromatouch_folder / "scores" / "grey" / f"del_details_{method}-diff-shufflenetv2{suffix}.csv"
    recorded = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(1, 225))
    (told,) = follows_last_step(recorded.mean(axis=1), recorded[:, -1], name="D_AUC")
    assert f"D_AUC correlates with its last step by {tied:.2f}" in told


def test_answers_at_an_end_move_one_way_only():
    assert saturated(np.array([0.0, 0.5, 1.0, 1.2])) == [
        "3 of 4 answers lie at an end of the margin: they can move one way only"
    ]
    assert saturated(np.array([0.2, 0.8])) == []


def test_maps_that_rank_nothing_are_told():
    maps = {"good": np.random.default_rng(0).uniform(size=(2, 4, 4)), "flat": np.zeros((2, 4, 4))}
    assert flat_maps(maps) == ["flat: 2 of 2 maps are constant and rank nothing"]


GREY, BLUR, BLACK = (Setting(fill=fill, unit="pixel") for fill in ("grey", "blur", "black"))


def test_fills_that_rank_the_methods_otherwise_are_told():
    one = {"a": 0.1, "b": 0.2, "c": 0.3}
    told = ranking_alarms({GREY: one, BLUR: {"a": 0.3, "b": 0.2, "c": 0.1}, BLACK: {"a": 1.0, "b": 2.0, "c": 3.0}})
    assert len(told) == 2  # blur against each of the others
    assert "grey and blur rank the methods differently (Kendall's tau -1.00)" in told[0]
    assert ranking_alarms({GREY: {"a": 1.0, "b": 2.0}, BLUR: {"a": 2.0, "b": 1.0}}) == []  # two are too few


def test_a_control_that_wins_is_told():
    control = "poly-cam-new-weights"
    assert f"no more than the control {control}" in ranking_alarms({GREY: {"poly-cam": 0.2, control: 0.3}})[0]
    assert ranking_alarms({GREY: {"poly-cam": 0.4, control: 0.3}}) == []
