import re
from dataclasses import replace

import numpy as np
import pytest
from drawn import misplaced, pulled_trial
from matplotlib.figure import Figure
from matplotlib.text import Text
from there import there

from sliplens.errors import InputError
from sliplens.plots.sheets import (
    brightening,
    choose_margins,
    choose_untouched,
    draw_contact_sheet,
)
from sliplens.plots.style import save_page
from sliplens.recordings import ContactState
from sliplens.results.explanation import MARGIN_LEVELS

NO_CONTACT, CONTACT, INCIPIENT_SLIP, FULL_SLIP, _ = ContactState


def texts(figure: Figure) -> list[str]:
    return [found.get_text().replace("\N{NO-BREAK SPACE}", " ") for found in figure.findobj(Text)]


@pytest.mark.parametrize("pull", [11, 41, 700])
def test_chosen_frames_are_the_nearest_to_the_margins(pull):
    trial = pulled_trial(pull=pull)

    for nominal, index in zip(MARGIN_LEVELS, choose_margins(trial), strict=True):
        nearest = np.nanmin(np.abs(trial.safety_margin - nominal))
        # frames within half a percentage point are told apart by their force alone
        assert abs(trial.safety_margin[there(index)] - nominal) <= nearest + 0.005


def test_full_stick_is_shown_where_the_sensor_is_pressed_hardest():
    trial = pulled_trial()

    first = there(choose_margins(trial)[0])

    assert trial.contact_state[first] == CONTACT
    assert (
        trial.normal_force_n[first] == trial.normal_force_n[[state == CONTACT for state in trial.contact_state]].max()
    )


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


def test_sheet_names_each_margin_and_each_that_is_missing():
    found = texts(draw_contact_sheet([pulled_trial(lowest=0.52, pull=25)], title="A title"))

    assert [text for text in found if re.match(r"\d\.\d s", text)] == [
        "0.1 s, no contact", "0.3 s, contact", "0.8 s, incipient slip", "1.2 s, incipient slip"
    ]  # fmt: skip
    assert found.count("no frame") == 3
    assert {"A title", *(f"Γ {level} %" for level in range(0, 101, 20))} < set(found)


def test_frames_are_shown_as_they_are_over_their_differences_times_one_factor():
    trials = [pulled_trial(bright=60), pulled_trial(bright=20, pull=21)]
    figure = draw_contact_sheet(trials)

    [factor] = {float(text.split()[-1]) for text in texts(figure) if text.startswith("difference")}
    assert factor > 2
    rows = iter([ax.images[0].get_array() for ax in figure.axes])
    for trial in trials:
        chosen = [choose_untouched(trial), *choose_margins(trial)]
        cameras, differences = ([np.asarray(next(rows)) for _ in chosen] for _ in range(2))
        for camera, difference, index in zip(cameras, differences, chosen, strict=True):
            np.testing.assert_array_equal(camera, trial.frames[index])
            signed = trial.frames[index].astype(float) - trial.reference
            # halves may be rounded either way
            assert np.abs(difference - np.minimum(255, factor * np.abs(signed))).max() <= 0.51


@pytest.mark.parametrize(("level", "factor"), [(51, 5.0), (255, 1.0), (0, 255.0), (250, 1.0)])
def test_brightening_makes_the_brightest_pixels_white(level, factor):
    difference = np.full((1, 8, 8, 3), level, dtype=np.uint8)

    assert brightening([difference[:, :4], difference // 2]) == factor


def test_no_text_lies_over_another_or_beyond_the_edge():
    long = replace(pulled_trial(size=(16, 60)), trial="a_trial_as_$long$ as a sentence that goes on and on and on")
    slow = pulled_trial(size=(40, 30))
    slow = replace(slow, time_s=400 * slow.time_s)
    assert misplaced(draw_contact_sheet([long, slow], title="All")) == ([], [])


def test_no_trial_is_no_sheet():
    with pytest.raises(InputError, match="needs a trial; give at least one"):
        draw_contact_sheet([])


def test_one_frame_and_no_label_can_be_drawn(tmp_path):
    trial = pulled_trial()
    signals = ("time_s", "normal_force_n", "tangential_force_n", "friction_coefficient", "safety_margin", "stick_ratio")
    one = replace(
        trial,
        frames=trial.frames[:1],
        contact_state=trial.contact_state[:1],
        **{name: getattr(trial, name)[:1] for name in signals},
    )

    save_page(draw_contact_sheet([one]), tmp_path / "new" / "preview.svg")

    assert [path.name for path in (tmp_path / "new").iterdir()] == ["preview.svg"]
    assert sum(text == "no frame" for text in texts(draw_contact_sheet([one]))) == len(MARGIN_LEVELS)
