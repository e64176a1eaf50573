import re
from dataclasses import replace

import numpy as np
import pytest
from there import there

from sliplens.errors import RecordingError
from sliplens.recordings import ContactState
from sliplens.recordings.labelling import FrictionEstimate, Lag, Reason
from sliplens.recordings.labels.axes import apply_axes
from sliplens.recordings.labels.friction import estimate_friction
from sliplens.recordings.labels.margin import FoundLabels, label_frames
from sliplens.recordings.options import LabelSettings

from .conftest import PULL_S, SLIP_S, STATIC, TOUCH_S, Trial, ratio

TARE = (0.7, -0.4, 0.2)
FRICTION = FrictionEstimate(mu=STATIC, low=STATIC, high=STATIC, onset_s=SLIP_S)
LAG = Lag(lag_s=0.04, sigma_s=0.003, correlation=0.9)
APPLIED = LabelSettings(apply_lag=True)


def reasons(labels: FoundLabels) -> set[Reason]:
    return set(labels.reason)


def test_the_margin_is_one_less_the_used_friction(trial: Trial):
    labels, truth = label_frames(trial.frame_time_s, trial.contact(), friction=FRICTION), trial.truth
    # windows lie evenly about their frames, so that only those over a kink of the pull err: by its slope times an
    # eighth of the window of 33 ms
    np.testing.assert_allclose(labels.safety_margin[labels.valid], truth[labels.valid], atol=0.0015)
    np.testing.assert_allclose(labels.stick_ratio, labels.safety_margin ** (2 / 3))


def test_states_follow_the_grasp(trial: Trial):
    labels = label_frames(trial.frame_time_s, trial.contact(), friction=FRICTION)
    states = np.array(labels.contact_state)
    time = trial.frame_time_s
    assert set(states[time < TOUCH_S]) == {ContactState.NO_CONTACT}
    assert set(states[(time > TOUCH_S + 0.1) & (time < PULL_S - 0.1)]) == {ContactState.CONTACT}
    assert set(states[(time > PULL_S + 0.1) & (time < SLIP_S)]) == {ContactState.INCIPIENT_SLIP}
    assert set(states[time >= SLIP_S]) == {ContactState.FULL_SLIP}


def test_after_gross_slip_the_margin_is_0_until_the_contact_is_loaded_anew(trial: Trial):
    # let go after the slip, and pressed anew; then a dip too short to be a release
    time = trial.time_s
    again = trial.contact_n.copy()
    again[(time > 4.8) & (time < 5.1)] = 0
    again[time >= 5.1, 1:] = 0
    short = trial.contact_n.copy()
    short[(time > 4.8) & (time < 4.88)] = 0
    released, dipped = (
        label_frames(trial.frame_time_s, replace(trial, contact_n=force).contact(), friction=FRICTION)
        for force in (again, short)
    )
    after = trial.frame_time_s >= SLIP_S
    # a frame over the new touch is of both
    pressed, anew = after & (released.normal_force_n > 1), trial.frame_time_s > 5.12
    pressed &= trial.frame_time_s < 5.08
    assert np.all(released.safety_margin[pressed] == 0)
    assert np.all(released.safety_margin[anew] == 1)
    assert released.valid[anew].all()
    assert not released.valid[after & (trial.frame_time_s < 5.08)].any()
    gone = (trial.frame_time_s > 4.85) & (trial.frame_time_s < 5.05)
    assert np.all(np.isnan(released.safety_margin[gone]))
    assert not dipped.valid[after].any()
    assert np.all(dipped.safety_margin[after & (dipped.normal_force_n > 1)] == 0)


@pytest.mark.parametrize(("mu", "slip_s"), [(0.3, None), (1.2, 5.2), (1.0, None)])
def test_no_valid_label_follows_a_friction_that_contradicts_the_forces(
    trial: Trial, rng: np.random.Generator, mu: float, slip_s: float | None
):
    labels = trial.label(trial.forces(noise_n=0.02, rng=rng), mu=mu, slip_s=slip_s)
    error = np.abs(labels.safety_margin - np.where(trial.frame_time_s < SLIP_S, trial.truth, 0))
    assert np.all((error <= 3 * labels.safety_margin_sigma)[labels.valid])
    assert labels.basis.flags
    assert Reason.CONTRADICTED in reasons(labels)


def test_a_frame_is_valid_exactly_where_it_has_no_reason_not_to_be(trial: Trial):
    labels = label_frames(trial.frame_time_s, trial.contact(), friction=FRICTION)
    assert [reason == Reason.NONE for reason in labels.reason] == labels.valid.tolist()
    assert reasons(labels) == {Reason.NONE, Reason.NO_CONTACT, Reason.AFTER_GROSS_SLIP}
    assert sum(labels.count().values()) == len(labels.valid)
    assert labels.count()["valid"] == labels.valid.sum()
    assert np.all(np.isnan(labels.safety_margin_sigma[~labels.valid]))


def test_a_margin_that_tells_full_stick_hardly_from_slip_is_not_valid(trial: Trial):
    # a friction known to a third: 1 - Gamma is then known to a third, which passes 0.2 at 0.6
    friction = replace(FRICTION, low=STATIC * 2 / 3, high=STATIC * 4 / 3)
    labels = label_frames(trial.frame_time_s, trial.contact(), friction=friction)
    used = ratio(trial.frame_time_s) / STATIC
    unsure = np.array([reason == Reason.TOO_UNCERTAIN for reason in labels.reason])
    before = trial.frame_time_s < SLIP_S
    assert np.all(unsure[before & (used > 0.62)])
    assert not unsure[used < 0.58].any()
    assert labels.safety_margin_sigma[labels.valid].max() <= 0.2


def test_frames_without_samples_have_no_label(trial: Trial):
    forces = trial.forces()
    kept = (forces.time_s < 3.0) | (forces.time_s > 3.2)
    kept &= forces.time_s < 5.3
    thinned = replace(forces, time_s=forces.time_s[kept], force_n=forces.force_n[kept])
    labels = label_frames(trial.frame_time_s, apply_axes(thinned, trial.contact().axes), friction=FRICTION)
    time = trial.frame_time_s
    missing = np.array([reason == Reason.MISSING_SAMPLES for reason in labels.reason])
    np.testing.assert_array_equal(missing, ((time > 2.998) & (time < 3.202)) | (time > 5.298))
    assert np.all(np.isnan(labels.safety_margin[missing]))
    assert np.all(np.isnan(labels.normal_force_n[missing]))


def test_a_lag_is_applied_only_when_asked_and_counts_as_an_error_otherwise(trial: Trial):
    plain = label_frames(trial.frame_time_s, trial.contact(), friction=FRICTION)
    known = label_frames(trial.frame_time_s, trial.contact(), friction=FRICTION, lag=LAG)
    applied = label_frames(trial.frame_time_s + 0.04, trial.contact(), friction=FRICTION, lag=LAG, settings=APPLIED)
    np.testing.assert_array_equal(known.safety_margin, plain.safety_margin)
    np.testing.assert_allclose(applied.safety_margin, plain.safety_margin, atol=1e-9)
    np.testing.assert_allclose(applied.force_time_s, trial.frame_time_s, atol=1e-12)
    assert (known.basis.lag_applied, applied.basis.lag_applied) == (False, True)
    doubtful = replace(LAG, doubt="several lags fit alike")
    with pytest.raises(RecordingError, match="the lag cannot be applied: several lags fit alike; give the lag by hand"):
        label_frames(trial.frame_time_s, trial.contact(), friction=FRICTION, lag=doubtful, settings=APPLIED)
    pulled = (trial.frame_time_s > PULL_S + 0.2) & (trial.frame_time_s < SLIP_S - 0.2)
    # one that is not applied is an error of its size; without noise nothing else is left: 1 in 3 s
    expected = np.hypot(LAG.lag_s, LAG.sigma_s) / (SLIP_S - PULL_S)
    np.testing.assert_allclose(known.safety_margin_sigma[pulled], expected, rtol=1e-6)


def test_the_noise_is_not_counted_again_as_an_effect_of_the_lag(trial: Trial, rng: np.random.Generator):
    contact = trial.contact(noise_n=0.03, rng=rng)
    sure = label_frames(trial.frame_time_s, contact, friction=FRICTION)
    lag = replace(LAG, lag_s=0.0, sigma_s=0.01)
    unsure = label_frames(trial.frame_time_s, contact, friction=FRICTION, lag=lag, settings=APPLIED)
    pulled = (trial.frame_time_s > PULL_S + 0.2) & (trial.frame_time_s < SLIP_S - 0.2)
    more = np.mean((unsure.safety_margin_sigma**2 - sure.safety_margin_sigma**2)[pulled])
    # the margin falls by 1 in 3 s; over a chord of 0.2 s the noise adds half a per cent of its variance, and may double
    noise = 0.01 * np.mean(sure.safety_margin_sigma[pulled] ** 2)
    assert more == pytest.approx((0.01 / (SLIP_S - PULL_S)) ** 2, abs=float(noise))


def test_friction_moves_the_margin_by_its_share(trial: Trial):
    friction = FrictionEstimate(mu=STATIC, low=0.95 * STATIC, high=1.05 * STATIC, onset_s=SLIP_S)
    labels = label_frames(trial.frame_time_s, trial.contact(), friction=friction)
    valid = labels.valid
    np.testing.assert_allclose(labels.safety_margin_sigma[valid], 0.05 * (1 - labels.safety_margin[valid]), atol=1e-6)


def test_the_band_of_the_margin_covers(trial: Trial):
    truth, shares = trial.truth, []
    for number in range(20):
        rng = np.random.default_rng(number)
        contact = trial.contact(noise_n=0.03, rng=rng)
        friction = estimate_friction(contact, contact_threshold_n=0.1, rng=rng, draws=50)
        labels = label_frames(trial.frame_time_s, contact, friction=friction)
        used = labels.valid & (truth < 0.9)  # at 1 the margin cannot err upwards
        shares.append(np.mean(np.abs(labels.safety_margin - truth)[used] <= labels.safety_margin_sigma[used]))
    assert 0.6 <= np.mean(shares) <= 0.76


def test_without_an_onset_slip_begins_outside_the_friction_cone(trial: Trial):
    labels = label_frames(trial.frame_time_s, trial.contact(), friction=FrictionEstimate(mu=0.4, low=0.4, high=0.4))
    # the ratio reaches 0.4 after two thirds of the pull; the next frame is outside
    assert labels.basis.slip_s == pytest.approx(PULL_S + 2 / 3 * (SLIP_S - PULL_S), abs=0.04)
    assert not labels.valid[trial.frame_time_s > labels.basis.slip_s].any()


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


@pytest.mark.parametrize("factor", [1000, 1 / 1000])
def test_forces_in_another_unit_than_named_are_doubted(trial: Trial, rng: np.random.Generator, factor: float):
    forces = trial.forces(noise_n=0.02, rng=rng, tare_n=TARE)
    right, wrong = (trial.label(trial.record(scale * forces.force_n)) for scale in (1, factor))
    (doubt,) = wrong.basis.doubts
    assert "--force-unit" in doubt
    assert float(there(re.search(r"normal force is (\S+) N", doubt))[1]) == pytest.approx(1.5 * factor, rel=0.1)
    assert right.basis.doubts == ()
    # a margin has no unit
    np.testing.assert_allclose(wrong.safety_margin[wrong.valid], right.safety_margin[right.valid], atol=1e-6)


def test_few_frames_are_labelled_without_a_lag(trial: Trial, rng: np.random.Generator):
    few = replace(trial, frame_time_s=trial.frame_time_s[::4], motion=trial.motion[::4])
    labels = few.label(trial.forces(noise_n=0.02, rng=rng))
    assert "too few to estimate a lag" in there(labels.basis.lag).doubt
    # windows are four times as long as at the full rate, so kinks err by four times as much
    np.testing.assert_allclose(labels.safety_margin[labels.valid], few.truth[labels.valid], atol=0.05)
