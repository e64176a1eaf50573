import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplens.markers.estimators import INNER_SHARE, affine_parts, find_hold, rank_in_field, stick_share

PLACES = np.stack(np.meshgrid(np.arange(6) * 20.0, np.arange(6) * 20.0), axis=-1).reshape(-1, 2)
MIDDLE = PLACES.mean(axis=0)
PRESS = 0.025 * (PLACES - MIDDLE)


@given(parts=st.lists(st.floats(-0.1, 0.1), min_size=4, max_size=4))
def test_affine_parts_are_the_derivatives_of_an_affine_field(parts):
    matrix = np.array(parts).reshape(2, 2)
    found = affine_parts(PLACES, (PLACES - MIDDLE)[None] @ matrix.T + np.array([3.0, -2.0]))[0]
    (xx, xy), (yx, yy) = matrix
    np.testing.assert_allclose(found, [3, -2, xx + yy, yx - xy, xx - yy, xy + yx], atol=1e-6)


@given(turn=st.floats(-0.02, 0.02), x=st.floats(-3, 3), y=st.floats(-3, 3))
def test_an_object_that_moves_as_one_sticks_everywhere(turn, x, y):
    arm = (PLACES + PRESS) - (PLACES + PRESS).mean(axis=0)
    rigid = np.array([x, y]) + turn * np.stack([-arm[:, 1], arm[:, 0]], axis=-1)
    assert stick_share(PLACES, PRESS, rigid, tolerance_px=0.01) == 1


def test_markers_that_stay_behind_or_are_lost_leave_the_sticking_share():
    rank = rank_in_field(PLACES, PRESS)
    moved = np.where((rank < INNER_SHARE)[:, None], [2.0, 0.0], 0.0)
    inner, contact = (rank < INNER_SHARE).sum(), (rank < 2 * INNER_SHARE).sum()
    assert stick_share(PLACES, PRESS, moved, tolerance_px=0.1) == pytest.approx(inner / contact)
    moved[rank >= INNER_SHARE] = np.nan
    assert stick_share(PLACES, PRESS, moved, tolerance_px=0.1) == 1
    assert np.isnan(stick_share(PLACES, PRESS, np.full_like(moved, np.nan), tolerance_px=0.1))


def test_the_hold_is_the_last_frame_before_the_pull():
    pressed = np.clip(np.arange(30) / 10, 0, 1)[:, None, None] * PRESS
    pull = np.clip(np.arange(30) - 19, 0, None)[:, None, None] * [0.5, 0.0]
    assert find_hold(PLACES, pressed + pull) == 19
    assert find_hold(PLACES, pressed * 0) == 0
