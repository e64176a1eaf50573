from dataclasses import replace

import numpy as np
import pytest
from drawn import pulled_trial
from there import there

from sliplens.plots.sheets import brightening, choose_margins
from sliplens.recordings import ContactState
from sliplens.results.explanation import MARGIN_LEVELS

NO_CONTACT, CONTACT, INCIPIENT_SLIP, FULL_SLIP, _ = ContactState


@pytest.mark.parametrize("pull", [11, 41, 700])
def test_chosen_frames_are_the_nearest_to_the_margins(pull):
    trial = pulled_trial(pull=pull)
    for nominal, index in zip(MARGIN_LEVELS, choose_margins(trial), strict=True):
        nearest = np.nanmin(np.abs(trial.safety_margin - nominal))
        # frames within half a percentage point are told apart by their force alone
        assert abs(trial.safety_margin[there(index)] - nominal) <= nearest + 0.005


def test_full_stick_is_shown_where_the_sensor_is_pressed_hardest():
    trial = pulled_trial()

    first, pressed = there(choose_margins(trial)[0]), [state == CONTACT for state in trial.contact_state]
    assert pressed[first]
    assert trial.normal_force_n[first] == trial.normal_force_n[pressed].max()


def test_frames_of_a_later_stick_are_left_alone():
    trial = pulled_trial()
    # after sliding the contact sticks again at exactly 40 %, and is pressed harder than ever
    margin, force = trial.safety_margin.copy(), trial.normal_force_n.copy()
    margin[-1], force[-1] = 0.4, 9.0
    again = replace(
        trial, safety_margin=margin, normal_force_n=force, contact_state=(*trial.contact_state[:-1], INCIPIENT_SLIP)
    )

    assert choose_margins(again)[:-1] == choose_margins(trial)[:-1]


@pytest.mark.parametrize(("lowest", "missing"), [(0.52, 3), (0.5, 3), (0.49, 2), (0.12, 1), (0.05, 0)])
def test_margin_is_missing_where_no_frame_is_within_ten_points(lowest, missing):
    found = choose_margins(pulled_trial(lowest=lowest))

    assert [index is None for index in found] == [False] * (6 - missing) + [True] * missing


@pytest.mark.parametrize(("level", "factor"), [(51, 5.0), (255, 1.0), (0, 255.0), (250, 1.0)])
def test_brightening_makes_the_brightest_pixels_white(level, factor):
    difference = np.full((1, 8, 8, 3), level, dtype=np.uint8)

    assert brightening([difference[:, :4], difference // 2]) == factor
