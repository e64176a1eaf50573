from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sliplens.errors import RecordingError
from sliplens.recordings.labels.axes import apply_axes, infer_axes, magnitude, mean_force, noise_sigma
from sliplens.recordings.options import LabelSettings

from .conftest import NORMAL_N, SLIP_S, TOUCH_S, Trial

TARE = (0.7, -0.4, 0.2)


@pytest.mark.parametrize("order", list(permutations(range(3))))
@pytest.mark.parametrize("sign", [1, -1])
def test_axis_and_sign_come_back_however_the_sensor_is_mounted(
    trial: Trial, rng: np.random.Generator, order: tuple[int, int, int], sign: int
):
    axes = infer_axes(trial.forces(noise_n=0.02, rng=rng, tare_n=TARE, order=order, sign=sign))
    assert (axes.normal, axes.sign) == ("xyz"[order.index(0)], sign)
    assert axes.notes == ()


def test_tare_and_noise_come_back(trial: Trial, rng: np.random.Generator):
    axes = infer_axes(trial.forces(noise_n=0.02, rng=rng, tare_n=TARE))
    assert np.all(np.abs(np.subtract(axes.tare_n, TARE)) < 4 * np.array(axes.tare_sigma_n))
    # 0.6 s less the guard hold some 225 samples: 0.02 / 15; ten stretches know it to a quarter
    np.testing.assert_allclose(axes.tare_sigma_n, 0.02 / 15, rtol=0.6)
    np.testing.assert_allclose(axes.noise_n, 0.02, rtol=0.1)
    assert axes.still_until_s is not None
    assert axes.still_until_s < TOUCH_S


def test_noise_with_a_memory_makes_the_tare_less_certain(trial: Trial, rng: np.random.Generator):
    white = rng.normal(0, 0.02, (len(trial.time_s) + 24, 3))
    # means over 25 samples, as of a sensor that filters: the same spread sample by sample, a 25th as many of them
    slow = np.lib.stride_tricks.sliding_window_view(white, 25, axis=0).mean(axis=-1) * 5
    quick, filtered = (infer_axes(trial.record(trial.contact_n + noise)) for noise in (white[:-24], slow))
    assert np.all(filtered.tare_sigma_n > 1.5 * np.array(quick.tare_sigma_n))


def test_a_recording_that_begins_in_the_press_has_no_still_samples(trial: Trial, rng: np.random.Generator):
    later = trial.time_s > TOUCH_S + 0.02
    begins = replace(trial, time_s=trial.time_s[later], contact_n=trial.contact_n[later])
    axes = infer_axes(begins.forces(noise_n=0.02, rng=rng))
    assert "no still samples before contact" in axes.notes[0]
    np.testing.assert_array_equal(axes.tare_n, 0)


def turned(degrees: float, *, about: tuple[float, float, float]) -> np.ndarray:
    """Rotation about an axis."""
    return Rotation.from_rotvec(degrees * np.array(about) / np.linalg.norm(about), degrees=True).as_matrix()


@pytest.mark.parametrize("degrees", [2, 5, 20, 50])
@pytest.mark.parametrize("about", [(0, 1, 0), (0, 1, -3), (1, 2, 3)])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_tilted_sensor_gives_the_forces_of_a_straight_one(
    trial: Trial, rng: np.random.Generator, degrees: float, about: tuple[float, float, float], sign: int
):
    straight = trial.forces(noise_n=0.02, rng=rng, sign=sign)
    tilted = trial.record(straight.force_n @ turned(degrees, about=about).T + TARE)
    axes = infer_axes(tilted)
    contact = apply_axes(tilted, axes)
    # the direction is known to 0.02 N / (1.5 N sqrt(60)), those of 250 samples of a press that weigh as much as a full
    # one: 2e-3; 3 sigma of it and 4 of a mean over 25 samples
    smooth = [np.convolve(one, np.ones(25) / 25, "same") for one in (contact.normal_n, *contact.tangential_n.T)]
    normal, pull = smooth[0], np.hypot(*smooth[1:])
    inside = (trial.time_s > TOUCH_S + 0.6) & (trial.time_s < SLIP_S - 0.1)
    np.testing.assert_allclose(normal[inside], trial.contact_n[inside, 0], atol=0.03)
    np.testing.assert_allclose(pull[inside], np.linalg.norm(trial.contact_n[inside, 1:], axis=1), atol=0.03)
    assert axes.tilt_deg == pytest.approx(
        np.rad2deg(np.arccos(np.abs(turned(degrees, about=about)[:, 0]).max())), abs=0.4
    )
    assert any("degrees off the axis" in note for note in axes.notes) == (axes.tilt_deg > 3)


def test_a_tilt_off_a_declared_axis_is_flagged_and_not_turned(trial: Trial):
    tilted = trial.contact_n @ turned(20, about=(0, 1, 0)).T
    axes = infer_axes(trial.record(tilted), LabelSettings(normal_axis="x", normal_sign=1))
    assert axes.direction is None
    assert "points 20 degrees off the axis x that was declared" in axes.notes[0]


@pytest.mark.parametrize("pull_s", [0.0, 0.2])
def test_a_press_that_is_pulled_from_the_touch_on_is_no_tilt(trial: Trial, rng: np.random.Generator, pull_s: float):
    normal = trial.contact_n[:, 0]
    pull = 0.5 * np.clip((trial.time_s - TOUCH_S - pull_s) / 2.0, 0, 1) * normal
    force = np.stack((normal, pull, 0 * pull), axis=1) + rng.normal(0, 0.02, (len(normal), 3))
    axes = infer_axes(trial.record(force))
    assert (axes.normal, axes.direction) == ("x", None)


def test_moved_samples_give_no_drift(trial: Trial, rng: np.random.Generator):
    force = trial.contact_n * (trial.time_s < 5)[:, None] + rng.normal(0, 0.02, (len(trial.time_s), 3))
    force[trial.time_s > 4.0] += 0.2
    forces = trial.record(force)
    # 0.2 N in the 5 s from the middle of the untouched samples to the end
    np.testing.assert_allclose(infer_axes(forces).drift_n_s, 0.2 / 5.3, rtol=0.15)
    np.testing.assert_array_equal(infer_axes(forces, moved_s=4.0).drift_n_s, 0)


def test_a_sensor_that_is_never_touched_is_refused(trial: Trial, rng: np.random.Generator):
    forces = trial.record(rng.normal(0.5, 0.02, (len(trial.time_s), 3)))
    with pytest.raises(RecordingError, match=r"sensor never departs from its noise.*; give --normal-axis"):
        infer_axes(forces)
    assert infer_axes(forces, LabelSettings(normal_axis="z", normal_sign=1)).still_until_s is None


@pytest.mark.parametrize("force_n", [0.1, NORMAL_N])
def test_magnitude_is_not_lengthened_by_noise(rng: np.random.Generator, force_n: float):
    noisy = np.array([0.6, 0.8]) * force_n + rng.normal(0, 0.02, (40_000, 2))
    # the mean of 40000 is known to 1e-4; the plain length is too long by sigma^2 / 2 F, 2e-3 of the smaller force
    assert magnitude(noisy, sigma_n=0.02).mean() == pytest.approx(force_n, abs=4e-4)
    assert magnitude(noisy, sigma_n=0.02).mean() <= np.linalg.norm(noisy, axis=1).mean()


@given(seed=st.integers(0, 2**32 - 1), window=st.floats(0.001, 0.5))
def test_mean_of_a_line_is_its_middle_however_samples_lie(seed: int, window: float):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.001, 0.05, 60))
    at = rng.uniform(time[0], time[-1], 10)
    np.testing.assert_allclose(mean_force(time, 3 - 2 * time, at, window_s=window), 3 - 2 * at, atol=1e-9)


def test_mean_is_that_of_a_finely_sampled_line(rng: np.random.Generator):
    time, values = np.sort(rng.uniform(0, 1, 30)), rng.normal(0, 1, 30)
    fine = np.linspace(0.4, 0.6, 200_001)
    # the trapezoidal rule on steps of 1 us: what is left is of the order of a kink's step
    slow = np.trapezoid(np.interp(fine, time, values), fine) / 0.2
    assert mean_force(time, values, np.array([0.5]), window_s=0.2)[0] == pytest.approx(slow, abs=1e-5)


def test_no_window_reaches_over_a_break():
    time = np.arange(0, 1, 0.001)
    step = np.where(time < 0.5, 1.0, 0.0)
    at = np.array([0.45, 0.49, 0.498, 0.502, 0.51, 0.55])
    # 0.4995 is the middle of the one interval in which the line through the samples falls
    means = mean_force(time, step, at, window_s=0.1, until_s=0.4995)
    np.testing.assert_allclose(means, [1, 1, 1, 0, 0, 0], atol=0.15)
    assert np.all(np.diff(mean_force(time, step, at, window_s=0.1)) < 0)


def test_noise_is_told_from_a_slope_and_a_jump(rng: np.random.Generator):
    values = rng.normal(0, 0.02, (4000, 2)) + np.linspace(0, 5, 4000)[:, None]
    values[2000:] += 3
    # the median of 4000 second differences is known to 2 %; 5 standard deviations of that
    np.testing.assert_allclose(noise_sigma(values), 0.02, rtol=0.1)
