import re
from dataclasses import replace

import numpy as np
import pytest

from sliplens.errors import RecordingError
from sliplens.images import soften
from sliplens.recordings.capture import Forces
from sliplens.recordings.labelling import Lag
from sliplens.recordings.labels.lag import doubt_agreement, estimate_lag, measure_motion

from .conftest import FORCE_HZ, FRAME_HZ, SLIP_S, Trial


def seed() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.parametrize("lag_s", [-0.1, -0.033, 0.0, 0.007, 0.2])
def test_lag_comes_back_within_five_milliseconds(trial: Trial, rng: np.random.Generator, lag_s: float):
    forces = trial.forces(noise_n=0.02, rng=rng, tare_n=(1.0, 2.0, -1.0))
    motion = trial.motion + rng.normal(0, 0.01, len(trial.motion))
    lag = estimate_lag(trial.frame_time_s + lag_s, motion, forces, rng=rng)
    assert lag.lag_s == pytest.approx(lag_s, abs=0.005)
    assert lag.doubt == ""
    assert lag.correlation is not None
    assert lag.correlation > 0.9


def test_lag_knows_neither_tare_nor_sign_nor_order_of_the_axes(trial: Trial):
    right = estimate_lag(trial.frame_time_s, trial.motion, trial.forces(), rng=seed())
    turned = trial.forces(tare_n=(3.0, -1.0, 0.5), order=(2, 0, 1), sign=-1)
    other = estimate_lag(trial.frame_time_s, trial.motion, turned, rng=seed())
    assert other.lag_s == pytest.approx(right.lag_s, abs=1e-9)
    assert other.sigma_s == pytest.approx(right.sigma_s, abs=1e-9)


def test_frames_need_not_be_evenly_spaced(trial: Trial, rng: np.random.Generator):
    kept = np.sort(rng.choice(len(trial.frame_time_s), size=120, replace=False))
    time = trial.frame_time_s[kept]
    at = np.stack([np.interp(time, trial.time_s, column) for column in trial.contact_n.T], axis=1)
    motion = np.append(0, np.linalg.norm(np.diff(at, axis=0), axis=1))
    assert estimate_lag(time + 0.03, motion, trial.forces(), rng=rng).lag_s == pytest.approx(0.03, abs=0.005)


def test_the_uncertainty_covers(trial: Trial):
    hits = []
    for number in range(40):
        rng = np.random.default_rng(number)
        forces = trial.forces(noise_n=0.02, rng=rng)
        motion = trial.motion + rng.normal(0, 0.03, len(trial.motion))
        # 50 draws know a deviation to a tenth, which hardly changes how often it covers
        lag = estimate_lag(trial.frame_time_s + 0.02, motion, forces, rng=rng, draws=50)
        hits.append(abs(lag.lag_s - 0.02) <= lag.sigma_s)
    # 68 % of 40 is known to 7 %: two standard deviations, and the bootstrap's own few per cent
    assert 0.5 <= np.mean(hits) <= 0.9


def pressed(press_s: float, release_s: float | None) -> tuple[np.ndarray, np.ndarray, Forces]:
    """Frame times, image motion and forces of a soft ball pressed, held, and let go if `release_s` is given.

    Of Hertz's contact the depth is as the force to the power 2/3: the image leads in the press and trails in the
    release, by more the longer they take.
    """

    def load(time_s: np.ndarray) -> np.ndarray:
        risen = np.clip((time_s - 1.0) / press_s, 0, 1)
        fallen = 0 * time_s if release_s is None else np.clip((time_s - 4.0) / release_s, 0, 1)
        return (3 - 2 * risen) * risen**2 * (1 - (3 - 2 * fallen) * fallen**2)

    time = np.arange(0, 6, 1 / FORCE_HZ)
    frame_time = np.arange(0.01, 5.99, 1 / FRAME_HZ)
    motion = np.abs(np.diff(load(frame_time) ** (2 / 3), prepend=0))
    force = 1.5 * load(time)[:, None] * np.array([0.6, 0.0, -0.8])
    return frame_time, motion, Forces(time_s=time, force_n=force, source="sensor")


def test_a_fast_release_does_not_outweigh_the_press_it_undoes():
    alone, alike, faster, fast = (
        estimate_lag(*pressed(0.6, release_s), rng=seed(), draws=20).lag_s for release_s in (None, 0.6, 0.45, 0.3)
    )
    # the press alone leads
    assert alone < -0.01
    # as slow a release is its mirror image in time, which leaves no lag: to a sample
    assert alike == pytest.approx(0, abs=0.002)
    # weights that balance the two do so to the first order of lead and trail; unbalanced, these are 13 and 19 ms
    assert faster == pytest.approx(0, abs=0.004)
    assert fast == pytest.approx(0, abs=0.004)


def test_of_too_few_frames_no_lag_is_told(trial: Trial, rng: np.random.Generator):
    lag = estimate_lag(trial.frame_time_s[:48], trial.motion[:48], trial.forces(), rng=rng)
    assert lag == Lag(lag_s=0.0, sigma_s=0.0, doubt="48 frames are too few to estimate a lag from, 49 are needed")
    assert not estimate_lag(trial.frame_time_s[:49], trial.motion[:49], trial.forces(), rng=rng).doubt.startswith("49")


def test_a_camera_that_runs_on_long_after_the_forces_ended_still_tells_the_lag(trial: Trial, rng: np.random.Generator):
    more = trial.frame_time_s[-1] + np.arange(1, 600) / FRAME_HZ
    time_s, motion = np.append(trial.frame_time_s, more), np.append(trial.motion, np.zeros(len(more)))
    lag = estimate_lag(time_s + 0.03, motion, trial.forces(), rng=rng)
    assert not lag.doubt
    assert lag.lag_s == pytest.approx(0.03, abs=0.005)


def test_clocks_of_another_zero_are_refused(trial: Trial, rng: np.random.Generator):
    forces = replace(trial.forces(), time_s=trial.time_s + 1e9)
    with pytest.raises(RecordingError, match=r"no lag up to 0.25 s lets the forces of sensor cover the frames; bring"):
        estimate_lag(trial.frame_time_s, trial.motion, forces, rng=rng)


SPEEDS, LATE_S = (25 / 30, 0.8, 1.25, 0.9, 1.1), (0.1, -0.1, 0.3, -0.5, 1.5, -1.5)


@pytest.mark.parametrize(("speed", "late_s"), [*((speed, 0) for speed in SPEEDS), *((1, late_s) for late_s in LATE_S)])
def test_labels_by_another_clock_are_doubted_and_none_is_valid(trial: Trial, speed: float, late_s: float):
    forces = trial.forces(noise_n=0.02, rng=seed(), tare_n=(1.0, 2.0, -1.0))
    wrong = replace(trial, frame_time_s=trial.frame_time_s * speed + late_s, motion=frames_of(trial))
    labels = wrong.label(forces)
    assert any("--frame-rate" in doubt and "--apply-lag" in doubt for doubt in labels.basis.doubts)
    assert not labels.valid.any()
    # a clock that differs by a known or an estimated lag only is right once that is applied
    if speed == 1 and abs(late_s) < 0.2:
        for settings in ({"lag_ms": 1000 * late_s}, {"apply_lag": True}):
            mended = wrong.label(forces, **settings)
            assert mended.basis.doubts == ()
            error = np.abs(mended.safety_margin - trial.truth)[mended.valid]
            assert np.all(error < 4 * mended.safety_margin_sigma[mended.valid])


def test_frames_that_end_before_the_slip_of_the_forces_say_so(trial: Trial):
    forces, before = trial.forces(noise_n=0.02, rng=seed()), trial.frame_time_s < SLIP_S - 0.2
    early = replace(trial, frame_time_s=trial.frame_time_s[before], motion=frames_of(trial)[before])
    labels = early.label(forces)
    (doubt,) = labels.basis.doubts
    assert re.match(r"the forces slip at 4\.5\d s, and the frames are from 0\.01 to 4\.\d+ s; if ", doubt)
    # a camera that stopped earlier has right labels
    assert labels.valid.any()


def frames_of(trial: Trial, *, until_s: float = np.inf) -> np.ndarray:
    """Motion of an image with a camera's noise, which rests from a moment on."""
    rng = np.random.default_rng(3)
    return np.where(trial.frame_time_s < until_s, trial.motion, trial.motion[1]) + rng.normal(
        0, 0.01, len(trial.motion)
    )


def twice(trial: Trial, motion: np.ndarray, *, loads: int) -> tuple[np.ndarray, np.ndarray, Forces]:
    """Two contacts one after the other, let go between them, of which the forces tell some."""
    span_s = trial.time_s[-1] + 0.5
    held = trial.contact_n * np.clip((5.3 - trial.time_s) / 0.2, 0, 1)[:, None]
    force = np.concatenate((held, held if loads == 2 else 0 * held))
    force = force + np.random.default_rng(4).normal(0, 0.02, force.shape)
    time = np.concatenate((trial.time_s, trial.time_s + span_s))
    frame_time = np.concatenate((trial.frame_time_s, trial.frame_time_s + span_s))
    return frame_time, motion, Forces(time_s=time, force_n=force, source="sensor")


def doubts(time_s: np.ndarray, motion: np.ndarray, forces: Forces) -> tuple[str, ...]:
    lag = estimate_lag(time_s, motion, forces, rng=seed())
    return doubt_agreement(time_s, motion, forces, lag)


@pytest.mark.parametrize("noise_n", [0.002, 0.02])
def test_an_image_that_moves_as_the_force_changes_is_in_no_doubt(trial: Trial, noise_n: float):
    forces = trial.forces(noise_n=noise_n, rng=np.random.default_rng(2), tare_n=(1.0, 2.0, -1.0))
    assert doubts(trial.frame_time_s, frames_of(trial), forces) == ()
    motion = frames_of(trial)
    assert doubts(*twice(trial, np.append(motion, motion), loads=2)) == ()


@pytest.mark.parametrize("case", ["image rests", "image repeats", "forces rest", "forces of another trial"])
def test_a_contact_in_which_one_moves_and_the_other_does_not_is_told_with_the_correlation(trial: Trial, case: str):
    motion, forces = frames_of(trial), trial.forces(noise_n=0.02, rng=np.random.default_rng(2))
    noise = np.random.default_rng(2).normal(0, 0.02, forces.force_n.shape)
    motion = {"image rests": frames_of(trial, until_s=0.0), "image repeats": 0 * motion}.get(case, motion)
    # another trial presses and slips at other moments
    others = {"forces rest": noise, "forces of another trial": forces.force_n[::-1].copy()}
    (doubt,) = doubts(trial.frame_time_s, motion, replace(forces, force_n=others.get(case, forces.force_n)))
    assert re.search(r"do not move together from .* \(correlation -?0\.[012]\d, 0\.3 is needed\)", doubt)


@pytest.mark.parametrize("without", ["image", "force"])
def test_a_second_contact_that_one_of_both_misses_is_told(trial: Trial, without: str):
    first, rests = frames_of(trial), frames_of(trial, until_s=0.0)
    if without == "image":
        (doubt,) = doubts(*twice(trial, np.append(first, rests), loads=2))
        assert doubt.startswith("image and force do not move together from 6.")
    else:
        (doubt,) = doubts(*twice(trial, np.append(first, first), loads=1))
        assert re.match(r"the image moves as in a contact from 6\.\d+ to 1\d\.\d+ s, and the forces rest", doubt)


@pytest.mark.parametrize("size", [(224, 224), (480, 640), (61, 83), (20, 16)])
def test_blocks_are_means(rng: np.random.Generator, size: tuple[int, int]):
    frame = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    soft = soften(frame)
    side = max(1, min(size) // 28)
    assert soft.shape == (size[0] // side, size[1] // side, 3)
    last = soft.shape[0] - 1, soft.shape[1] - 1
    for row, column in ((0, 0), last):
        block = frame[row * side : (row + 1) * side, column * side : (column + 1) * side]
        np.testing.assert_allclose(soft[row, column], block.mean(axis=(0, 1)), rtol=1e-5)


def test_a_still_image_does_not_move_and_a_brighter_one_moves_by_its_levels(rng: np.random.Generator):
    frame = rng.integers(0, 200, (64, 64, 3), dtype=np.uint8)
    np.testing.assert_allclose(measure_motion(map(soften, [frame, frame, frame + 7])), [0, 0, 7], rtol=1e-4)
