from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sliplens.errors import RecordingError
from sliplens.recordings.labelling import FrictionEstimate
from sliplens.recordings.labels.axes import ContactForces, apply_axes
from sliplens.recordings.labels.friction import ImageMotion, estimate_friction, fit_break

from .conftest import SLIP_S, STATIC, Trial


def estimate(forces: ContactForces, rng: np.random.Generator, **options: Any) -> FrictionEstimate:
    return estimate_friction(forces, contact_threshold_n=0.05, rng=rng, **options)


def test_the_interval_covers(trial: Trial):
    hits = []
    for number in range(60):
        rng = np.random.default_rng(number)
        contact = trial.contact(noise_n=0.02, rng=rng)
        # 100 draws know the ends of an interval to a tenth of its width, which hardly changes how often it covers
        friction = estimate(contact, rng, draws=100)
        hits.append(friction.low <= STATIC <= friction.high)
    # 68 % of 60 is known to 6 %: three standard deviations
    assert 0.5 <= np.mean(hits) <= 0.86


def test_friction_has_no_unit(trial: Trial):
    contact = trial.contact(noise_n=0.02, rng=np.random.default_rng(3))
    doubled = apply_axes(
        replace(contact.recorded, force_n=2 * contact.recorded.force_n),
        replace(contact.axes, noise_n=tuple(2 * noise for noise in contact.axes.noise_n)),
    )
    one, two = (estimate(each, np.random.default_rng(4)) for each in (contact, doubled))
    assert (two.mu, two.low, two.onset_s) == pytest.approx((one.mu, one.low, one.onset_s), rel=1e-9)


def test_an_uncertain_tare_widens_the_interval(trial: Trial):
    contact = trial.contact(noise_n=0.02, rng=np.random.default_rng(3))
    loose = apply_axes(contact.recorded, replace(contact.axes, tare_sigma_n=(0.03, 0.03, 0.03)))
    sure, unsure = (estimate(each, np.random.default_rng(4)) for each in (contact, loose))
    # 0.03 N of 1.5 N, along the pull and, times mu, across it: 0.023, known from 300 draws to 4 %
    assert unsure.sigma == pytest.approx(np.hypot(sure.sigma, 0.02 * np.hypot(1, STATIC)), rel=0.2)


def pulled(trial: Trial, share: np.ndarray) -> ContactForces:
    """Another share of the pull, the normal force as it was."""
    return replace(trial, contact_n=trial.contact_n * np.stack((np.ones_like(share), share, share), axis=1)).contact()


def test_a_knock_that_the_image_does_not_see_is_no_slip(trial: Trial, rng: np.random.Generator):
    # a jolt at the force sensor that nothing at the fingertip feels
    forces = pulled(trial, np.where(np.abs(trial.time_s - 3.8) < 0.05, 0.8, 1.0))
    motion = trial.motion + rng.normal(0, 0.005, len(trial.motion))
    seen = ImageMotion(time_s=trial.frame_time_s, motion=motion)
    # the ratio exceeds the height that it fell from: that was no slip
    assert estimate(forces, rng).onset_s == pytest.approx(SLIP_S, abs=0.01)
    friction = estimate(forces, rng, image=seen)
    assert friction.onset_s == pytest.approx(SLIP_S, abs=0.01)
    assert friction.method == "break of F_t / F_n, seen in the image"


def test_letting_go_is_no_slip(trial: Trial, trial_without_slip: Trial):
    slipped, held = (
        replace(one, contact_n=one.contact_n * np.clip((5.3 - one.time_s) / 0.3, 0, 1)[:, None])
        for one in (trial, trial_without_slip)
    )
    # the fingertip springs back, and the slip itself is not seen
    motion = np.where(np.abs(trial.frame_time_s - 5.2) < 0.15, 3.0, 0.7) + np.random.default_rng(0).normal(
        0, 0.05, len(trial.motion)
    )
    seen = ImageMotion(time_s=trial.frame_time_s, motion=motion)
    for number in range(8):
        rng = np.random.default_rng(number)
        friction = estimate(slipped.contact(noise_n=0.05, rng=rng), rng, image=seen, draws=20)
        assert friction.onset_s == pytest.approx(SLIP_S, abs=0.05)
        with pytest.raises(RecordingError, match="never slips"):
            estimate(held.contact(noise_n=0.05, rng=rng), rng, image=seen, draws=20)


def test_samples_too_few_to_fit_a_fall_tell_the_break_between_two_of_them(rng: np.random.Generator):
    # six samples a second, the last two after the slip
    time = np.arange(0, 2, 1 / 6)
    values = np.where(time < 1.6, 0.1 + 0.2 * time, 0.3)
    found = fit_break(time, values, about_s=1.6, rng=rng, draws=400)
    last, following = time[time < 1.6][-1], time[time > 1.6][0]
    assert last < found.time_s < following
    # the line is known, and where on it the contact slips is not
    assert found.level == pytest.approx(0.1 + 0.2 * found.time_s)
    assert (found.levels.min(), found.levels.max()) == pytest.approx(
        (0.1 + 0.2 * last, 0.1 + 0.2 * following), abs=1e-3
    )


@pytest.mark.parametrize("within_s", [0.05, 0.1, 0.2, 0.4, 1.0])
def test_a_pull_that_is_let_go_is_no_slip(trial: Trial, within_s: float, rng: np.random.Generator):
    share = np.interp(trial.time_s, (2.5, 2.5 + within_s, 2.8 + within_s, 3.1 + within_s), (1, 0, 0, 1))
    friction = estimate(pulled(trial, share), rng)
    assert friction.onset_s == pytest.approx(SLIP_S, abs=0.01)
    assert friction.mu == pytest.approx(STATIC, rel=0.01)
    with pytest.raises(RecordingError, match="never slips"):
        estimate(pulled(trial, np.minimum.accumulate(share)), rng)


@pytest.mark.parametrize("seen", [0.0, 0.1, 1.0])
def test_the_slip_is_where_the_ratio_falls_however_the_image_moves(trial: Trial, rng: np.random.Generator, seen: float):
    after = trial.frame_time_s > SLIP_S - 0.05
    motion = np.where(after, 0.7 + seen * (trial.motion - 0.7), trial.motion)
    # stirred where a sliding contact jerks, by a fall to less than half of what the slip falls by
    motion[np.abs(trial.frame_time_s - 5.2) < 0.04] += 2
    jerk = 1 - 0.1 * np.clip(np.minimum((trial.time_s - 5.18) / 0.02, (5.3 - trial.time_s) / 0.1), 0, 1)
    image = ImageMotion(time_s=trial.frame_time_s, motion=motion + rng.normal(0, 0.005, len(motion)))
    friction = estimate(pulled(trial, jerk), rng, image=image)
    assert friction.onset_s == pytest.approx(SLIP_S, abs=0.01)
    assert friction.mu == pytest.approx(STATIC, rel=0.01)


@pytest.mark.parametrize("mu", [None, STATIC])
@pytest.mark.parametrize("slip_s", [None, SLIP_S])
def test_friction_and_slip_are_independent_facts(
    trial: Trial, rng: np.random.Generator, mu: float | None, slip_s: float | None
):
    friction = estimate(trial.contact(noise_n=0.02, rng=rng), rng, mu=mu, slip_s=slip_s)
    assert friction.onset_s == pytest.approx(SLIP_S, abs=0.01)
    assert friction.mu == pytest.approx(STATIC, rel=0.012)
    assert friction.notes == ()
    assert (friction.method == "given by hand") == (mu is not None)


@pytest.mark.parametrize(
    ("given", "numbers"),
    [
        ((0.4, None), ("0.60", "0.40")),
        ((0.8, None), ("0.60", "0.80")),
        ((None, 5.0), ("0.60", "4.50 s", "5.00 s")),
        ((None, 3.0), ("0.60", "0.30", "3.00 s")),
        ((None, 4.3), ("0.60", "4.50 s", "4.30 s")),
        # by the line that is fitted before the slip, 0.02 above the kinetic friction
        ((STATIC, 5.0), ("0.50", "0.60", "5.00 s")),
    ],
)
def test_a_friction_that_contradicts_the_forces_is_off_by_as_much_and_says_so(
    trial: Trial, rng: np.random.Generator, given: tuple[float | None, float | None], numbers: tuple[str, ...]
):
    mu, slip_s = given
    friction = estimate(trial.contact(noise_n=0.02, rng=rng), rng, mu=mu, slip_s=slip_s)
    assert any(all(number in note for number in numbers) for note in friction.notes)
    # the ratio at the slip is known to some 0.005
    shown = STATIC if mu != STATIC else 0.5
    assert friction.sigma >= abs(friction.mu - shown) - 0.01


def test_without_a_slip_no_ratio_exceeds_a_given_friction(trial_without_slip: Trial, rng: np.random.Generator):
    contact = trial_without_slip.contact(noise_n=0.02, rng=rng)
    (note,) = estimate(contact, rng, mu=0.4).notes
    assert "nothing slips" in note
    assert estimate(contact, rng, mu=STATIC) == FrictionEstimate(mu=STATIC, low=STATIC, high=STATIC)


def test_each_contact_slips_by_itself(trial: Trial, rng: np.random.Generator):
    twice = np.concatenate([trial.contact_n, trial.contact_n])
    time = np.concatenate([trial.time_s, trial.time_s + trial.time_s[-1] + trial.time_s[1]])
    both = replace(trial, time_s=time, contact_n=twice).contact(noise_n=0.02, rng=rng)
    friction = estimate(both, rng)
    assert friction.onset_s == pytest.approx(SLIP_S, abs=0.01)
    assert friction.later_onsets_s == (pytest.approx(SLIP_S + 5.5, abs=0.01),)
    assert friction.notes == ()
