"""Slip from markers: what springs back slips, what moves as a whole, or slowly, does not."""

import numpy as np
import pytest

from sliplens.friction import Friction, SlipLearner
from sliplens.grip.fingertip import Fingertip
from sliplens.live import MarkerReading, SlipDetector, SlipState
from sliplens.live.slip import SlipBatch

RATE_HZ = 60.0
REST = np.stack(np.meshgrid(np.arange(7.0), np.arange(7.0)), axis=-1).reshape(-1, 2) * 20.0
FROM_MIDDLE = REST - REST.mean(axis=0)
BELL = np.exp(-((np.linalg.norm(FROM_MIDDLE, axis=1) / 50) ** 2))[:, None]
DOWN = np.array([0.0, 1.0])
PULLED, SPRUNG = 100, 160  # frames


def play(pull_px: np.ndarray, *, rng: np.random.Generator, shift_px: np.ndarray | None = None) -> np.ndarray:
    """Markers of a sensor that is still, pressed from frame 30 to 60, and pulled by so many pixels in its middle."""
    frames = np.arange(len(pull_px))
    pressed = 0.04 * np.clip((frames - 30) / 30, 0, 1)[:, None, None] * FROM_MIDDLE * BELL
    moved = pressed + pull_px[:, None, None] * BELL * DOWN
    if shift_px is not None:
        moved = moved + shift_px[:, None, None] * DOWN
    return REST + moved + rng.normal(0, 0.05, moved.shape)


def pull(springs_back_px: float = 0.0, *, frames: float = 3.0) -> np.ndarray:
    """Pull to 4 px from frame 100 to 160, and spring back within some frames."""
    at = np.arange(240)
    back = springs_back_px * np.clip((at - SPRUNG) / frames, 0, 1)
    return 4.0 * np.clip((at - PULLED) / (SPRUNG - PULLED), 0, 1) - back


def watch(places: np.ndarray, rest: np.ndarray = REST) -> list[MarkerReading]:
    detector = SlipDetector(rest)
    return [detector.update(place, number / RATE_HZ) for number, place in enumerate(places)]


def states(readings: list[MarkerReading]) -> list[SlipState]:
    return [reading.state for reading in readings]


def test_skin_that_springs_back_slips_within_50_ms_and_says_since_when(rng: np.random.Generator):
    readings = watch(play(pull(1.0), rng=rng))
    first = states(readings).index(SlipState.SLIP)
    assert SPRUNG < first <= SPRUNG + 3
    # a frame before or after: the first part of the spring is within the noise
    assert readings[first].slipping_s == pytest.approx((first - SPRUNG) / RATE_HZ, abs=1.1 / RATE_HZ)


def test_a_grip_that_holds_is_told_as_sticking_and_never_as_slip(rng: np.random.Generator):
    said = states(watch(play(pull(), rng=rng)))
    assert SlipState.SLIP not in said
    assert set(said[PULLED:]) == {SlipState.STICKING}


def test_letting_a_pull_go_slowly_is_no_slip(rng: np.random.Generator):
    # 1 px in 0.75 s: within a window of 0.1 s it is a few standard deviations of the middle's noise
    assert SlipState.SLIP not in states(watch(play(pull(1.0, frames=45), rng=rng)))


def test_a_camera_that_moves_does_not_pass_for_a_slip(rng: np.random.Generator):
    shift = np.where(np.arange(240) >= SPRUNG, -1.0, 0.0)
    assert SlipState.SLIP not in states(watch(play(pull(), rng=rng, shift_px=shift)))


def test_after_a_slip_nobody_knows_until_the_shear_grows_again(rng: np.random.Generator):
    path = pull(1.0)
    said = states(watch(play(path, rng=rng)))
    assert said[-1] is SlipState.CANNOT_TELL
    path[200:] += np.linspace(0, 2, 40)
    assert states(watch(play(path, rng=rng)))[-1] is SlipState.STICKING


@pytest.mark.parametrize("turn_rad", [0.7, np.pi / 2])
def test_states_do_not_depend_on_how_the_camera_is_turned(turn_rad: float, rng: np.random.Generator):
    places = play(pull(1.0), rng=rng)
    turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    turned = watch(places @ turn.T, REST @ turn.T)
    # the noise is measured by the median of both coordinates, which turns with the camera
    agree = [one is other for one, other in zip(states(turned), states(watch(places)), strict=True)]
    assert np.mean(agree) > 0.98
    assert SlipState.SLIP in states(turned)


def test_what_touches_and_how_far_it_shears_is_told(rng: np.random.Generator):
    readings = watch(play(pull(), rng=rng))
    assert {reading.contact for reading in readings[26:30]} == {False}
    assert all(reading.contact for reading in readings[60:])
    # the third in the middle moves by the mean of the bell over it, of the 4 px at its top
    inner = np.argsort(np.linalg.norm(FROM_MIDDLE, axis=1))[: len(REST) // 3]
    assert readings[-1].shear_px == pytest.approx(4 * BELL[inner].mean(), rel=0.1)
    assert readings[-1].stick_share is not None
    assert readings[80].stick_share is not None
    # pulled, the edge of the contact stays behind its middle
    assert readings[-1].stick_share < 0.9 < readings[80].stick_share


def test_markers_that_are_not_seen_leave_the_answer_open(rng: np.random.Generator):
    places = play(pull(), rng=rng)
    places[150, 5:] = np.nan
    places[170, ::3] = np.nan
    said = states(watch(places))
    assert (said[150], said[170]) == (SlipState.CANNOT_TELL, SlipState.STICKING)


def test_a_gripper_that_tightens_and_loosens_does_not_pass_for_a_slip_and_a_slip_is_told(rng: np.random.Generator):
    tip = Fingertip(seed=int(rng.integers(100)))
    grip = np.interp(
        np.arange(400), [20, 40, 70, 100, 130, 133, 160, 200, 203, 240], [0, 2, 2, 1, 1.1, 2, 1.2, 1.3, 2.2, 1]
    )
    pulled = np.interp(np.arange(400), [45, 60], [0, 0.6])
    friction = np.where(np.arange(400) < 300, 0.7, 0.25)  # of a sudden it slides
    margins = 1 - np.minimum(1, pulled / np.maximum(friction * grip, 1e-9))
    film = tip.film(grip, friction=friction, margins=margins)
    detector = SlipDetector(film.marker_rest_px)
    places = film.marker_px + rng.normal(0, 0.05, film.marker_px.shape)
    said = [detector.update(place, number / 30).state for number, place in enumerate(places)]
    assert SlipState.SLIP not in said[:300]
    assert set(said[60:300]) == {SlipState.STICKING}
    assert SlipState.SLIP in said[300:304]


def test_contacts_of_a_batch_are_read_as_each_alone(rng: np.random.Generator):
    """Other contacts change nothing, though they begin, slip, end and lose markers at other times."""
    played = []
    for number in range(5):
        places = np.roll(play(pull(0.4 * number), rng=rng), -5 * number, axis=0)
        places[120 + number : 140, : 9 * number] = np.nan
        played.append(places)
    batch = SlipBatch(np.stack([REST] * 5))
    states = [
        batch.update(np.stack(places), number / RATE_HZ) for number, places in enumerate(zip(*played, strict=True))
    ]
    for contact, places in enumerate(played):
        for number, reading in enumerate(watch(places)):
            together = states[number]
            assert bool(together.slip[contact]) is (reading.state is SlipState.SLIP)
            assert bool(together.contact[contact]) is bool(reading.contact)
            if reading.shear_px is not None:
                assert together.shear_px[contact] == pytest.approx(reading.shear_px)


@pytest.mark.parametrize("rate_hz", [8, 15, 60])
def test_a_grasp_that_begins_pressed_slips_where_its_shear_falls_at_any_frame_rate(rate_hz, rng: np.random.Generator):
    """No untouched frame and no still phase: the first frame is pressed, and the pull begins at once."""
    frames = np.arange(PULLED, 240, 60 // rate_hz)
    holds, slips = (play(pull(back), rng=rng)[frames] for back in (0.0, 1.0))
    assert {SlipState.STICKING} < set(states(watch(holds, holds[0]))) <= {SlipState.STICKING, SlipState.CANNOT_TELL}
    said = states(watch(slips, slips[0]))
    assert SlipState.SLIP not in [state for state, frame in zip(said, frames, strict=True) if frame <= SPRUNG]
    assert said[-1] is SlipState.SLIP
    # 4 standard deviations of the mean of 49 markers, about 0.03 of the shear, count as noise
    assert watch(slips, slips[0])[-1].fall == pytest.approx(1 - 3 / pull(1.0)[frames].max(), abs=0.05)


@pytest.mark.parametrize("frames", [2.0, 9.0])  # as fast as skin springs back, and by hand
@pytest.mark.parametrize("share", [0.5, 0.75, 1.0])
def test_a_pull_that_is_let_go_is_no_confirmed_slip_and_teaches_no_friction(share, frames, rng: np.random.Generator):
    taught = {}
    for name, fall in (("slip", 0.2), ("let go", share)):
        learner = SlipLearner(Friction.between(0.2, 1.0), same_object=True)
        for number, reading in enumerate(
            watch(play(pull(4.0 * fall, frames=2.0 if name == "slip" else frames), rng=rng))
        ):
            learner.update(number / RATE_HZ, slipping_s=reading.slipped_s)
            ratio = 0.5 * np.clip((number - PULLED) / (SPRUNG - PULLED), 0, 1)
            learner.note(float(ratio), sigma=0.03, time_s=number / RATE_HZ)
        taught[name] = learner.learnt
    assert taught["let go"] is None
    assert taught["slip"] is not None
    assert taught["slip"].mean == pytest.approx(0.5, abs=0.06)  # two standard deviations of what was read
