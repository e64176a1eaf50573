"""What the benchmark of the GelSight clips measures, on clips whose motion is known."""

import numpy as np
import pytest

pytest.importorskip("cv2", reason="markers are found with OpenCV, of the extra `markers`")

from gelsight import (
    FRAMES,
    NOISE_LEVELS,
    STRIDE,
    Cases,
    Clip,
    balanced_weights,
    difference_windows,
    find_still,
    fold_objects,
    measure_jitter,
    motion_features,
    network_answers,
)

REST = np.stack(np.meshgrid(np.arange(6) * 30.0, np.arange(5) * 30.0), axis=-1).reshape(-1, 2)


def make_clip(moved, *, picture=None, key_change=None, slipped=True, grasped="cup") -> Clip:
    """Dots at rest, moved by (frames, markers, 2)."""
    count = len(moved)
    return Clip(
        name="clip",
        grasp=grasped,
        grasped=grasped,
        slipped=slipped,
        rest_px=REST,
        position_px=REST + moved,
        status=np.ones((count, len(REST)), dtype=np.uint8),
        picture=np.zeros((count, 12, 16), np.uint8) if picture is None else picture,
        key_change=np.full(count, np.nan) if key_change is None else key_change,
        file_bytes=1,
    )


def shaking(count, rng):
    """Motion that repeats itself with every stride of the windows, different from dot to dot."""
    period = rng.normal(0, 2, (STRIDE, len(REST), 2))
    return period[np.arange(count) % STRIDE]


@pytest.mark.parametrize("strides", [2, 5, 40])
def test_motion_that_goes_on_as_it_is_looks_alike_however_long_the_clip(strides, rng):
    moved = shaking(FRAMES + 40 * STRIDE, rng)
    whole = motion_features(make_clip(moved))
    cut = motion_features(make_clip(moved[: FRAMES + strides * STRIDE]))
    np.testing.assert_allclose(cut, whole, atol=1e-9)
    assert np.abs(whole).max() > 0.1


def test_a_clip_in_which_nothing_moves_has_no_motion():
    np.testing.assert_allclose(motion_features(make_clip(np.zeros((60, len(REST), 2)))), 0, atol=1e-6)


def test_the_network_sees_of_a_clip_that_is_cut_what_it_saw_before(rng):
    picture = rng.integers(0, 255, (80, 12, 16), dtype=np.uint8)
    moved = np.zeros((80, len(REST), 2))
    whole = difference_windows(make_clip(moved, picture=picture))
    cut = difference_windows(make_clip(moved[:50], picture=picture[:50]))
    np.testing.assert_array_equal(cut.numpy(), whole[: len(cut)].numpy())
    # whatever stands still is not seen at all
    still = difference_windows(make_clip(moved, picture=np.repeat(picture[:1], 80, axis=0)))
    assert not still.any()


def test_jitter_is_the_noise_of_key_frames_in_which_the_picture_is_still(rng):
    change = np.full(600, np.nan)
    change[12::12] = 0.9 * NOISE_LEVELS
    change[240:300:12] = 3 * NOISE_LEVELS  # something moves
    # between key frames, what stands still is copied: it must not count
    moved = np.repeat(rng.normal(0, 0.08, (50, len(REST), 2)), 12, axis=0)
    moved[230:288] += np.linspace(0, 9, 58)[:, None, None]
    moved[288:] += 9
    clip = make_clip(moved, key_change=change)
    runs = find_still(clip)
    assert [run.tolist() for run in runs] == [list(range(12, 240, 12)), list(range(288, 600, 12))]
    told = measure_jitter([clip])
    # about 40 key frames of 60 numbers: the spread of a standard deviation is 1.4 %
    assert told["jitter_px"] == pytest.approx(0.08, rel=0.06)
    assert told["jitter_key_frames"] == sum(map(len, runs))


def test_weights_make_slips_as_many_as_holds_in_either_part(rng):
    labels, full = rng.random(50) < 0.7, rng.random(50) < 0.4
    weights = balanced_weights(labels, full)
    for part in (full, ~full):
        assert weights[part & labels].sum() == pytest.approx(weights[part & ~labels].sum())
        assert weights[part].sum() == pytest.approx(part.sum())


def test_every_clip_is_held_back_once_and_with_all_of_its_object(rng):
    names = np.array([f"object-{at}" for at in range(15)])
    grasped = rng.permutation(np.repeat(names, 3))
    cases = Cases(slipped=rng.random(45) < 0.6, grasped=grasped, frames=rng.integers(50, 450, 45))
    folds = list(fold_objects(cases))
    np.testing.assert_array_equal(np.sum(folds, axis=0), 1)
    assert all(len({bool(one) for one in fold[grasped == name]}) == 1 for fold in folds for name in names)


def test_a_network_tells_clips_that_move_from_clips_that_do_not(rng):
    clips = []
    for index in range(24):
        picture = np.full((40, 12, 16), 100.0)
        picture += rng.normal(0, 20, picture.shape) if index % 2 else rng.normal(0, 2, picture.shape)
        clips.append(
            make_clip(
                np.zeros((40, len(REST), 2)),
                picture=np.clip(picture, 0, 255).astype(np.uint8),
                slipped=bool(index % 2),
                grasped=f"object-{index // 2}",
            )
        )
    cases = Cases(
        slipped=np.array([clip.slipped for clip in clips]),
        grasped=np.array([clip.grasped for clip in clips]),
        frames=np.array([len(clip) for clip in clips]),
    )
    for chance in network_answers(clips, cases, epochs=6, seed=0):
        np.testing.assert_array_equal(chance > 0.5, cases.slipped)
