"""Neutral judge on additive games, whose answers are known."""

import numpy as np
import pytest

from sliplens.study.choice import marker_sums
from sliplens.study.truth import correlate_groups, draw_groups, neutral_frame

MARKERS = 40


def test_an_additive_game_agrees_with_its_own_values_and_not_with_chance(rng):
    values, groups = rng.normal(size=MARKERS), draw_groups(MARKERS, rng=rng)
    assert all(len(set(members)) == 5 for members in groups.tolist())
    effects = 0.1 * values[groups].sum(axis=1)
    assert correlate_groups(values, groups, effects) == pytest.approx(1)
    assert correlate_groups(-values, groups, effects) == pytest.approx(-1)
    # the standard deviation of one is about 0.2
    chance = [correlate_groups(rng.normal(size=MARKERS), groups, effects) for _ in range(400)]
    assert np.mean(chance) == pytest.approx(0, abs=0.05)


def test_effects_that_do_not_vary_judge_nothing_and_maps_that_do_not_vary_score_zero(rng):
    values, groups = rng.normal(size=MARKERS), draw_groups(MARKERS, rng=rng)
    assert np.isnan(correlate_groups(values, groups, np.zeros(len(groups))))
    assert correlate_groups(np.zeros(MARKERS), groups, rng.normal(size=len(groups))) == 0


def test_markers_move_to_a_frame_before_the_first_slip():
    margins = np.array([np.nan, 1.0, 0.84, 0.5, 0.31, 0.0, 0.85, 0.3, 0.0])
    assert neutral_frame(margins, 4) == 2
    assert neutral_frame(margins, 7) == 2
    assert neutral_frame(margins, 1) == 4  # too near to .85 itself
    assert neutral_frame(margins, 2) == 4


def test_relevance_is_summed_by_marker():
    regions = np.array([[0, 0, 2], [1, 2, 1], [2, 2, 2]])
    relevance = np.array([[1.0, 2.0, 8.0], [4.0, 8.0, -1.0], [8.0, 8.0, 8.0]])
    sums = marker_sums(relevance, regions, markers=2)
    np.testing.assert_array_equal(sums, [3.0, 3.0])
