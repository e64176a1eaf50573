"""Faults of the force sensor are marked, what is sound is not, and labels are those of the sound samples."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces
from sliplens.recordings.labelling import Reason
from sliplens.recordings.labels.axes import infer_axes
from sliplens.recordings.labels.faults import screen_forces

from .conftest import PULL_S, SLIP_S, STATIC, Trial

TARE = (0.7, -0.4, 0.2)
NOISE_N = 0.02
AT_S = 3.0
Spoil = Callable[[np.ndarray, np.ndarray], None]


def spoilt(trial: Trial, spoil: Spoil = lambda _time, _force: None, *, every: int = 1) -> Forces:
    """Forces through noise and an offset, changed in place between samples."""
    forces = trial.forces(noise_n=NOISE_N, rng=np.random.default_rng(5), tare_n=TARE)
    time, force = forces.time_s[::every], forces.force_n[::every].copy()
    spoil(time, force)
    return replace(forces, time_s=time, force_n=force)


def put(length_s: float, change: Callable[[np.ndarray], object]) -> Spoil:
    def spoil(time: np.ndarray, force: np.ndarray) -> None:
        span = (time >= AT_S - 1e-9) & (time < AT_S + length_s - 1e-9)
        force[span] = change(force[span])

    return spoil


SPANS = {
    "a sample of 70 N": (put(0.002, lambda part: np.add(part, (70, 0, 0))), 0.002, Reason.SPIKE),
    "a small spike": (put(0.004, lambda part: np.subtract(part, (0, 0.5, 0))), 0.004, Reason.SPIKE),
    "100 ms of 70 N pull": (put(0.1, lambda part: np.subtract(part, (70, 0, 0))), 0.1, Reason.STEP),
    "a soft pull": (put(0.2, lambda part: np.add(part, (0, 0, 0.4))), 0.2, Reason.STEP),
    "no numbers": (put(0.3, lambda part: np.nan * part), 0.3, Reason.DROP_OUT),
    "no force": (put(0.002, lambda part: 1e56 + 0 * part), 0.002, Reason.DROP_OUT),
    "zeros": (put(0.3, lambda part: 0 * part), 0.3, Reason.DROP_OUT),
    "one value": (put(0.5, lambda part: part[0]), 0.5, Reason.STUCK),
    "signs": (put(0.3, lambda part: -part), 0.3, Reason.STEP),
    "scales": (put(0.3, lambda part: 3 * part), 0.3, Reason.STEP),
    "axes": (put(0.3, lambda part: part[:, [2, 0, 1]]), 0.3, Reason.STEP),
}


@pytest.mark.parametrize("fault", SPANS)
def test_a_fault_is_marked_from_its_first_sample_to_its_last(trial: Trial, fault: str):
    spoil, length_s, kind = SPANS[fault]
    screened = screen_forces(spoilt(trial, spoil))
    found = [one for one in screened.faults if one.kind is not Reason.MISSING_SAMPLES]
    assert {one.kind for one in found} == {kind}
    # a line through noise places a small jump to some samples
    assert found[0].start_s == pytest.approx(AT_S, abs=0.006)
    assert found[-1].end_s == pytest.approx(AT_S + length_s, abs=0.008)
    assert len(screened.forces.time_s) == np.sum(screened.codes == 0)


@pytest.mark.parametrize("fault", SPANS)
@pytest.mark.parametrize("every", [1, 5])
def test_labels_are_those_of_the_sound_samples(trial: Trial, fault: str, every: int):
    spoil, length_s, _ = SPANS[fault]
    labels, time = trial.label(spoilt(trial, spoil, every=every)), trial.frame_time_s
    assert labels.basis.friction.mu == pytest.approx(STATIC, rel=0.03)
    error = np.abs(labels.safety_margin - trial.truth)[labels.valid]
    assert np.all(error < 4 * labels.safety_margin_sigma[labels.valid] + 0.01)
    # frames at the fault say so, the others of the pull keep their labels
    inside = (time > AT_S) & (time < AT_S + length_s)
    apart = (time > PULL_S) & (time < SLIP_S - 0.1) & ((time < AT_S - 0.08) | (time > AT_S + length_s + 0.08))
    assert not labels.valid[inside].any()
    assert {labels.reason[at] for at in np.flatnonzero(inside)} <= {*SPANS[fault][2:], Reason.MISSING_SAMPLES}
    assert labels.valid[apart].all()
    assert labels.basis.flags


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("axes", ["along an axis", "between axes"])
def test_a_fall_of_the_pull_at_constant_normal_force_is_a_slip(trial: Trial, axes: str, seen: bool, every: int):
    # in conftest the force falls within 30 ms; here from one sample to the next
    slipped = replace(trial, contact_n=sudden_slip(trial))
    if axes == "along an axis":
        pull = np.linalg.norm(slipped.contact_n[:, 1:], axis=1)
        slipped = replace(slipped, contact_n=np.stack((slipped.contact_n[:, 0], pull, 0 * pull), axis=1))
    at_slip = np.abs(trial.frame_time_s - SLIP_S) < 0.1
    slipped = replace(slipped, motion=trial.motion if seen else np.where(at_slip, 0.7, trial.motion))
    labels = slipped.label(spoilt(slipped, every=every))
    assert labels.basis.faults == ()
    # of 100 samples a second the slip lies anywhere in a hundredth
    assert labels.basis.slip_s == pytest.approx(SLIP_S, abs=0.012)
    assert labels.basis.friction.mu == pytest.approx(STATIC, rel=0.03)
    # an image that rests there is flagged; of 100 samples a second so small a fall is no jump that wants a witness
    flagged = any("the image rests, which was taken for a slip" in flag for flag in labels.basis.flags)
    assert flagged == (every == 1 and not seen)


def sudden_slip(trial: Trial) -> np.ndarray:
    """Forces that fall from static to kinetic friction from one sample to the next."""
    return np.where((trial.time_s >= SLIP_S)[:, None], trial.contact_n[-1], trial.contact_n)


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("length_s", [0.002, 0.02, 0.05, 0.1])
@pytest.mark.parametrize("slips", [True, False])
@pytest.mark.parametrize("shape", ["even", "soft"])
def test_a_fall_of_both_forces_is_a_release(trial: Trial, every: int, length_s: float, slips: bool, shape: str):
    begin_s = SLIP_S + 0.4 if slips else 4.0
    left = np.clip(1 - (trial.time_s - begin_s) / length_s, 0, 1)
    left = left if shape == "even" else left**2 * (3 - 2 * left)
    forces = spoilt(replace(trial, contact_n=trial.contact_n * left[:, None]), every=every)
    # no image is asked
    screened = screen_forces(forces)
    assert screened.faults == ()
    assert screened.doubts == ()
    # the zero is where it was, so no drift is read from the end
    np.testing.assert_array_equal(infer_axes(screened.forces, moved_s=screened.moved_s).drift_n_s, 0)


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("what", ["pull", "both"])
def test_a_fall_that_returns_is_a_fault(trial: Trial, what: str, share: float):
    # as a slip or a release, but back at once
    kept = (trial.time_s < AT_S) | (trial.time_s >= AT_S + 0.2)
    scale = np.where(kept, 1.0, share)[:, None] * np.ones(3)
    if what == "pull":
        scale[:, 0] = 1
    faulty = replace(trial, contact_n=trial.contact_n * scale)
    faults = screen_forces(spoilt(faulty)).faults
    assert {fault.kind for fault in faults} == {Reason.STEP}
    assert faults[0].start_s == pytest.approx(AT_S, abs=0.006)
    assert faults[-1].end_s == pytest.approx(AT_S + 0.2, abs=0.008)


def test_a_step_that_may_be_a_slip_names_the_option_that_says_so(trial: Trial):
    # both axes jump, and the normal force, too: no slip as far as the forces tell
    jumped = sudden_slip(trial)
    jumped[trial.time_s >= SLIP_S, 0] += 0.4
    rests = replace(trial, contact_n=jumped, motion=np.where(trial.frame_time_s > SLIP_S - 0.1, 0.74, trial.motion))
    forces = spoilt(rests)
    with pytest.raises(RecordingError, match=r"if the contact slips at 4\.50 s, give --slip-s 4\.50") as refusal:
        rests.label(forces)
    slip_s = float(str(refusal.value).rsplit("--slip-s ", 1)[1].rstrip(")"))
    labels = rests.label(forces, slip_s=slip_s)
    assert labels.basis.faults == ()
    assert labels.basis.friction.mu == pytest.approx(STATIC, rel=0.03)


def test_a_fall_that_the_contact_makes_up_for_before_it_slips_is_a_step(trial: Trial):
    # from 0.63 N of pull to 0.33 N at constant normal force, as a slip would; and 0.60 N when it slips
    knocked = trial.contact_n - 0.3 * (trial.time_s >= 3.6)[:, None] * np.array([0, 0.6, -0.8])
    labels = trial.label(spoilt(replace(trial, contact_n=knocked)))
    assert [(fault.kind, round(fault.start_s, 1)) for fault in labels.basis.faults] == [(Reason.STEP, 3.6)]
    assert labels.basis.friction.mu == pytest.approx(STATIC, rel=0.03)


def test_after_a_step_nothing_is_valid_and_what_is_before_stays(trial: Trial):
    labels = trial.label(spoilt(trial, put(99, lambda part: np.add(part, (0, 3, 0)))))
    time = trial.frame_time_s
    assert not labels.valid[time > AT_S].any()
    assert labels.valid[(time > PULL_S) & (time < AT_S - 0.05)].all()
    # friction from the forces after it, moved back
    assert labels.basis.friction.mu == pytest.approx(STATIC, rel=0.03)


def test_clipped_tops_are_not_taken_for_forces(trial: Trial):
    def clip(_time: np.ndarray, force: np.ndarray) -> None:
        force[:, 0] = np.minimum(force[:, 0], TARE[0] + 1.2)

    screened = screen_forces(spoilt(trial, clip))
    assert {one.kind for one in screened.faults} == {Reason.CLIPPED}
    # pressed to 1.2 N of 1.5 after four fifths of half a second
    assert screened.faults[0].start_s == pytest.approx(1.0, abs=0.03)
    with pytest.raises(RecordingError, match=r"\(left out were: clipped force "):
        trial.label(spoilt(trial, clip))


def test_coarse_and_repeated_readings_are_no_fault(trial: Trial):
    def coarse(_time: np.ndarray, force: np.ndarray) -> None:
        force[:] = np.round(force / 0.05) * 0.05

    def repeated(_time: np.ndarray, force: np.ndarray) -> None:
        force[:] = np.repeat(force[::5], 5, axis=0)[: len(force)]

    for spoil in (coarse, repeated):
        assert screen_forces(spoilt(trial, spoil)).faults == ()


@pytest.mark.parametrize(("rate_n_s", "released", "share"), [(0.12, False, 0.9), (-0.3, False, 0.5), (-0.3, True, 0.9)])
def test_an_even_drift_is_subtracted_and_its_uncertainty_counts(
    trial: Trial, rate_n_s: float, released: bool, share: float
):
    def drift(time: np.ndarray, force: np.ndarray) -> None:
        force[:, 1] += rate_n_s * time

    pressed = trial.time_s < (5.2 if released else np.inf)
    drifting = replace(trial, contact_n=trial.contact_n * pressed[:, None])
    labels = drifting.label(spoilt(drifting, drift))
    # before the touch 225 samples within 0.45 s know it to 0.02 N / 15 / 0.13 s = 0.01 N/s, an untouched end to 0.001
    assert labels.basis.axes.drift_n_s[1] == pytest.approx(rate_n_s, abs=0.003 if released else 0.035)
    assert labels.basis.axes.drift_n_s[::2] == (0, 0)
    assert any("drifts by" in flag for flag in labels.basis.flags)
    used = labels.valid & (trial.frame_time_s > PULL_S)
    error = np.abs(labels.safety_margin - trial.truth)[used]
    assert np.all(error < 3 * labels.safety_margin_sigma[used])
    # a drift that stayed would be off by 0.5 or 1.3
    assert error.max() < (0.06 if released else 0.2)
    assert labels.valid[(trial.frame_time_s > PULL_S) & (trial.frame_time_s < SLIP_S - 0.1)].mean() > share


@pytest.mark.parametrize("begin_s", [SLIP_S - 0.02, SLIP_S - 0.3])
@pytest.mark.parametrize("length_s", [0.1, 0.4, 0.7])
@pytest.mark.parametrize("every", [1, 5])
def test_a_slip_that_missing_samples_hide_lies_anywhere_among_them(
    trial: Trial, begin_s: float, length_s: float, every: int
):
    begin_s = max(begin_s, SLIP_S - length_s / 2)
    forces = spoilt(trial, every=every)
    kept = (forces.time_s < begin_s) | (forces.time_s > begin_s + length_s)
    labels = trial.label(replace(forces, time_s=forces.time_s[kept], force_n=forces.force_n[kept]))
    friction = labels.basis.friction
    # the ratio rises by 0.2 a second; without an untouched end the zero may drift, of 100 samples a second by 0.05 N
    half = STATIC / (SLIP_S - PULL_S) * length_s / 2
    assert abs(friction.mu - STATIC) < half + 0.02
    assert friction.sigma < half + 0.04
    before = (trial.frame_time_s > PULL_S) & (trial.frame_time_s < begin_s - 0.05)
    assert labels.valid[before].all()
    error = np.abs(labels.safety_margin - trial.truth)[before]
    assert np.all(error < 3 * labels.safety_margin_sigma[before])


def test_a_friction_that_no_fingertip_has_is_refused_or_flagged(trial: Trial):
    strong = replace(trial, contact_n=trial.contact_n * np.array([1, 20, 20]))
    forces = strong.forces(noise_n=NOISE_N, rng=np.random.default_rng(0), tare_n=TARE)
    with pytest.raises(RecordingError, match=r"comes out as 12.., and that of a fingertip lies between 0.05 and 4"):
        trial.label(forces, normal_axis="x", normal_sign=1)
    flags = trial.label(forces, normal_axis="x", normal_sign=1, mu=9.0).basis.flags
    assert any(flag.startswith("a friction of 9 was given") for flag in flags)


def test_a_normal_force_that_mostly_pulls_is_flagged(trial: Trial):
    forces = trial.forces(noise_n=NOISE_N, rng=np.random.default_rng(0), tare_n=TARE, sign=-1)
    forces.force_n[trial.time_s > 5.4, 0] += 3.0
    labels = trial.label(forces, normal_axis="x", normal_sign=1, mu=STATIC)
    assert any("the normal force is negative in" in flag for flag in labels.basis.flags)


@pytest.mark.parametrize("speed", [0.5, 4])
def test_frames_by_a_clock_of_another_speed_than_the_forces_are_flagged(trial: Trial, speed: float):
    forces = trial.forces(noise_n=NOISE_N, rng=np.random.default_rng(0), tare_n=TARE)
    labels = replace(trial, frame_time_s=trial.frame_time_s / speed).label(forces)
    (flag,) = [flag for flag in labels.basis.flags if flag.startswith("the frames last")]
    assert f"the frames last {np.ptp(trial.frame_time_s) / speed:.2f} s and the forces 5.50 s" in flag
    assert "--frame-rate" in flag
