"""From recorded forces to labels in one go."""

from dataclasses import replace

import numpy as np
import pytest
from there import there

from sliplens.errors import RecordingError
from sliplens.recordings.labelling import FrictionEstimate, Lag

from .conftest import SLIP_S, STATIC, Trial

TARE = (0.7, -0.4, 0.2)


def test_labels_come_back_through_noise_tare_lag_and_a_wrong_sign(trial: Trial, rng: np.random.Generator):
    forces = trial.forces(noise_n=0.02, rng=rng, tare_n=TARE, order=(2, 0, 1), sign=-1)
    motion = trial.motion + rng.normal(0, 0.01, len(trial.motion))
    labels = replace(trial, frame_time_s=trial.frame_time_s + 0.04, motion=motion).label(forces, apply_lag=True)
    assert (labels.basis.axes.normal, labels.basis.axes.sign) == ("y", -1)
    error = (labels.safety_margin - trial.truth)[labels.valid]
    # 0.02 N over 17 samples, on the 0.9 N that friction holds, is 0.005; the light touch at the start has more
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert labels.basis.friction.mu == pytest.approx(STATIC, rel=0.02)
    assert labels.basis.slip_s == pytest.approx(SLIP_S, abs=0.01)


def test_the_lag_is_reported_and_not_applied_unless_asked(trial: Trial):
    late = replace(trial, frame_time_s=trial.frame_time_s + 0.04)
    labels = late.label(trial.forces())
    assert there(labels.basis.lag).lag_s == pytest.approx(0.04, abs=0.005)
    np.testing.assert_array_equal(labels.force_time_s, late.frame_time_s)


def test_what_is_declared_is_used(trial_without_slip: Trial):
    settings = {"normal_axis": "x", "normal_sign": 1, "tare": (0.0,) * 3, "mu": STATIC, "lag_ms": 10.0}
    labels = trial_without_slip.label(trial_without_slip.forces(), **settings)
    basis = labels.basis
    assert (basis.lag, basis.lag_applied) == (Lag(lag_s=0.01, sigma_s=0.0), True)
    assert basis.friction == FrictionEstimate(mu=STATIC, low=STATIC, high=STATIC)


@pytest.mark.parametrize("mu", [None, STATIC])
def test_without_a_tangential_force_there_is_no_margin(trial: Trial, mu: float | None):
    pressed = replace(trial, contact_n=trial.contact_n * np.array([1, 0, 0]))
    with pytest.raises(RecordingError, match=r"sensor has no tangential force .* name the columns of all axes"):
        trial.label(pressed.forces(tare_n=TARE), mu=mu)


def test_few_frames_are_labelled_without_a_lag(trial: Trial, rng: np.random.Generator):
    few = replace(trial, frame_time_s=trial.frame_time_s[::4], motion=trial.motion[::4])
    labels = few.label(trial.forces(noise_n=0.02, rng=rng))
    assert "too few to estimate a lag" in there(labels.basis.lag).doubt
    # windows are four times as long as at the full rate, so kinks err by four times as much
    np.testing.assert_allclose(labels.safety_margin[labels.valid], few.truth[labels.valid], atol=0.05)
