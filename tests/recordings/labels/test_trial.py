"""From recorded forces to labels in one go."""

from dataclasses import replace

import numpy as np
import pytest
from there import there

from sliplens.errors import RecordingError
from sliplens.recordings.labels import Found, FrictionEstimate, LabelSettings, Lag, label_trial

from .conftest import SLIP_S, STATIC, Trial, ratio

TARE = (0.7, -0.4, 0.2)


def test_labels_come_back_through_noise_tare_lag_and_a_wrong_sign(trial: Trial, rng: np.random.Generator):
    forces = trial.forces(noise_n=0.02, rng=rng, tare_n=TARE, order=(2, 0, 1), sign=-1)
    motion = trial.motion + rng.normal(0, 0.01, len(trial.motion))
    labels = label_trial(trial.frame_time_s + 0.04, motion, forces, settings=LabelSettings(apply_lag=True), rng=rng)
    assert (labels.basis.axes.normal, labels.basis.axes.sign) == ("y", -1)
    truth = 1 - ratio(trial.frame_time_s) / STATIC
    error = (labels.safety_margin - truth)[labels.valid]
    # 0.02 N over 17 samples, on the 0.9 N that friction holds, is 0.005; the light touch at the start has more
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert labels.basis.friction.mu == pytest.approx(STATIC, rel=0.02)
    assert labels.basis.slip_s == pytest.approx(SLIP_S, abs=0.01)


def test_the_lag_is_reported_and_not_applied_unless_asked(trial: Trial, rng: np.random.Generator):
    time = trial.frame_time_s + 0.04
    labels = label_trial(time, trial.motion, trial.forces(), settings=LabelSettings(), rng=rng)
    assert there(labels.basis.lag).lag_s == pytest.approx(0.04, abs=0.005)
    np.testing.assert_array_equal(labels.force_time_s, time)


def test_what_is_declared_is_used(trial_without_slip: Trial, rng: np.random.Generator):
    settings = LabelSettings(
        normal_axis="x", normal_sign=1, tare=(0.0, 0.0, 0.0), mu=STATIC, lag_ms=10.0, contact_threshold=0.3
    )
    trial = trial_without_slip
    labels = label_trial(trial.frame_time_s, trial.motion, trial.forces(), settings=settings, rng=rng)
    basis = labels.basis
    assert (basis.axes.tare_found, basis.lag, basis.lag_applied) == (Found.DECLARED, Lag(lag_s=0.01, sigma_s=0.0), True)
    assert (basis.friction, basis.contact_threshold_n) == (FrictionEstimate(mu=STATIC, low=STATIC, high=STATIC), 0.3)
    assert labels.normal_force_n[labels.valid].min() >= 0.3


@pytest.mark.parametrize("mu", [None, STATIC])
def test_without_a_tangential_force_there_is_no_margin(trial: Trial, rng: np.random.Generator, mu: float | None):
    pressed = replace(trial, contact_n=trial.contact_n * np.array([1, 0, 0]))
    forces = pressed.forces(tare_n=TARE)
    with pytest.raises(RecordingError, match=r"sensor has no tangential force .* name the columns of all axes"):
        label_trial(trial.frame_time_s, trial.motion, forces, settings=LabelSettings(mu=mu), rng=rng)


def test_few_frames_are_labelled_without_a_lag(trial: Trial, rng: np.random.Generator):
    few = slice(None, None, 4)
    time, motion = trial.frame_time_s[few], trial.motion[few]
    labels = label_trial(time, motion, trial.forces(noise_n=0.02, rng=rng), settings=LabelSettings(), rng=rng)
    assert "too few to estimate a lag" in there(labels.basis.lag).doubt
    truth = 1 - ratio(time) / STATIC
    # windows are four times as long as at the full rate, so kinks err by four times as much
    np.testing.assert_allclose(labels.safety_margin[labels.valid], truth[labels.valid], atol=0.05)
