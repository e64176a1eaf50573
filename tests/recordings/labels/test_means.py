import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplens.recordings.labels.axes import mean_force, noise_sigma


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
