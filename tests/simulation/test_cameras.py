"""The camera is built into a sensor: the days of one sensor share it, and other sensors have other cameras."""

import numpy as np
import pytest

from sliplens.simulation import make_recipe, plan_trials
from sliplens.simulation.filming import move_camera
from sliplens.simulation.nuisances import CameraSetup, Day, Nuisances, mount_camera
from sliplens.simulation.trials import prepare_trial


def test_the_days_of_a_thesis_sensor_see_the_same_camera_within_the_change_of_a_day():
    plans = plan_trials(make_recipe("thesis", days=8))
    days = {plan.day: plan.day_draw for plan in plans}
    shifts = np.array([day.camera_shift_px for day in days.values()])
    turns = np.degrees([day.camera_rotation_rad for day in days.values()])
    # each day is drawn within +-.15 px and +-.15 degrees
    assert np.all(np.ptp(shifts, axis=0) <= 0.3)
    assert np.ptp(turns) <= 0.3
    assert np.ptp([day.gain for day in days.values()]) <= 0.04 * 1.1


def test_mounting_adds_seats_and_multiplies_light():
    day = Day(gain=1.1, gradient=0.02, gradient_direction_rad=0.0, camera_shift_px=(0.1, -0.1), glare=0.5)
    camera = CameraSetup(gain=0.9, gradient=0.2, gradient_direction_rad=np.pi, camera_shift_px=(1.0, 2.0), glare=0.8)
    mounted = mount_camera(day, camera)
    assert mounted.gain == pytest.approx(0.99)
    assert mounted.glare == pytest.approx(0.4)
    assert mounted.gradient == pytest.approx(0.18)
    assert mounted.camera_shift_px == pytest.approx((1.1, 1.9))
    assert mount_camera(day, CameraSetup()) == day


def test_a_moved_camera_turns_and_magnifies_markers_about_the_middle():
    _, film = prepare_trial(plan_trials(make_recipe("small"))[0])
    turned = move_camera(
        film, Nuisances(frame_turn_deg=(1.0, 1.0), frame_zoom=(1.02, 1.02)), rng=np.random.default_rng(0)
    )
    before, after = (one.marker_px - np.asarray(film.sensor.geometry.centre_px) for one in (film, turned))
    expected = 1.02 * np.exp(1j * np.radians(1.0)) * (before[..., 0] + 1j * before[..., 1])
    np.testing.assert_allclose(after[..., 0] + 1j * after[..., 1], expected)
    np.testing.assert_array_equal(turned.marker_rest_px, film.marker_rest_px)
