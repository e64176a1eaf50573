import re
from dataclasses import replace

import numpy as np
import pytest
from drawn import misplaced, pictures, pulled_trial
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from there import there

from sliplens.errors import InputError
from sliplens.plots.contact_sheet import (
    brightening,
    choose_margins,
    choose_untouched,
    draw_contact_sheet,
    write_contact_sheet,
)
from sliplens.recordings import ContactState, GroundTruth, Recording
from sliplens.results.explanation import MARGIN_LEVELS

NO_CONTACT, CONTACT, INCIPIENT_SLIP, FULL_SLIP, _ = ContactState


def with_truth(trial: Recording, *, displacement: str = "half-space") -> Recording:
    """A contact of rows 6 to 17 and columns 8 to 19, its inner 4 x 4 pixels sticking before full slip."""
    count = len(trial)
    contact = np.zeros(trial.frames.shape[:3], dtype=np.uint8)
    contact[4:, 6:18, 8:20] = 1
    contact[4:-3, 10:14, 12:16] = 2
    rest = np.zeros((2, 2), dtype=np.float32)
    truth = GroundTruth(
        recipe="none",
        displacement=displacement,
        marker_rest_px=rest,
        marker_px=np.repeat(rest[None], count, axis=0),
        static_friction=np.ones(count),
        contact_radius_m=np.ones(count),
        stick_radius_m=np.zeros(count),
        contact_map=contact,
    )
    return replace(trial, truth=truth)


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

    assert [text for text in found if re.match(r"Γ \d", text)] == [
        "Γ 100 %\n0.3 s, contact", "Γ 80 %\n0.8 s, incipient slip", "Γ 60 %\n1.2 s, incipient slip"
    ]  # fmt: skip
    assert [text for text in found if "no frame" in text] == [f"no frame\nnear {left} %" for left in (40, 20, 0)]
    assert {"A title", "day1-dry-001\ndry, day 1, test-sensor\n34 frames in 1.3 s"} < set(found)


def test_frames_are_shown_as_they_are_over_their_differences_times_one_factor():
    trials = [pulled_trial(bright=60), pulled_trial(bright=20, pull=21)]
    figure = draw_contact_sheet(trials)

    [factor] = {float(text.split()[-1]) for text in texts(figure) if text.startswith("difference")}
    rows = [(trial, index) for trial in trials for index in (choose_untouched(trial), *choose_margins(trial))]
    assert factor > 2
    for camera, ax, (trial, index) in zip(*pictures(figure), rows, strict=True):
        np.testing.assert_array_equal(camera.images[0].get_array(), trial.frames[index])
        signed = trial.frames[index].astype(float) - trial.reference
        # halves may be rounded either way
        assert np.abs(np.asarray(ax.images[0].get_array()) - np.minimum(255, factor * np.abs(signed))).max() <= 0.51


@pytest.mark.parametrize(("level", "factor"), [(51, 5.0), (255, 1.0), (0, 255.0), (250, 1.0)])
def test_brightening_makes_the_brightest_pixels_white(level, factor):
    difference = np.full((1, 8, 8, 3), level, dtype=np.uint8)

    assert brightening([difference[:, :4], difference // 2]) == factor


def test_marks_stand_where_the_frames_were_taken():
    trial = pulled_trial(lowest=0.5, pull=26)
    charts = [ax for ax in draw_contact_sheet([trial]).axes if ax.get_ylabel() in {"Force (N)", "Γ (%)"}]

    taken = [index for index in (choose_untouched(trial), *choose_margins(trial)) if index is not None]
    assert [ax.get_ylabel() for ax in charts] == ["Force (N)", "Γ (%)"]
    for ax in charts:
        drawn = [np.asarray(line.get_xdata()) for line in ax.lines]
        marks = [x[0] for x in drawn if len(x) == 2]
        np.testing.assert_array_equal(marks, trial.time_s[taken])


def test_outlines_run_along_the_edges_of_contact_and_stick_zone():
    above, _ = pictures(draw_contact_sheet([with_truth(pulled_trial())]))

    def spans(ax: Axes) -> set[tuple[float, ...]]:
        corners = [np.concatenate([path.vertices for path in one.get_paths()]) for one in ax.collections]
        return {(*found.min(axis=0), *found.max(axis=0)) for found in corners}

    # half way between the last pixel inside and the first one outside, as (x, y)
    contact, stick = (7.5, 5.5, 19.5, 17.5), (11.5, 9.5, 15.5, 13.5)
    assert [spans(ax) for ax in above] == [set(), *[{contact, stick}] * 5, {contact}]


def test_legend_names_outlines_where_there_are_any():
    names = ["outline of the contact", "outline of its stick zone (nominal)"]
    for trial, first in ((pulled_trial(), []), (with_truth(pulled_trial(), displacement="calibrated"), names)):
        (legend,) = draw_contact_sheet([trial]).legends

        found = [text.get_text() for text in legend.get_texts()]
        assert found == [*first, "frame shown", "no contact", "contact", "incipient slip", "full slip"]


def test_no_text_lies_over_another_or_beyond_the_edge():
    long = replace(pulled_trial(size=(16, 60)), trial="a_trial_as_$long$ as a sentence that goes on and on and on")
    slow = pulled_trial(size=(40, 30))
    slow = replace(slow, time_s=400 * slow.time_s)
    truth = with_truth(pulled_trial(lowest=0.5, pull=26), displacement="calibrated")
    assert misplaced(draw_contact_sheet([long, slow, truth], title="All")) == ([], [])


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

    write_contact_sheet([one], tmp_path / "new" / "preview.svg")

    assert [path.name for path in (tmp_path / "new").iterdir()] == ["preview.svg"]
    assert sum("no frame" in text for text in texts(draw_contact_sheet([one]))) == len(MARGIN_LEVELS)
