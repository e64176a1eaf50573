"""Sensor profiles: what frames go through, and the files that say so."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from there import there

from sliplens.errors import ImageError, InputError
from sliplens.recordings.options import LabelSettings
from sliplens.recordings.sensor import SensorProfile, load_profile, save_profile, shipped_profiles
from sliplens.recordings.source import open_source

FRAME = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
TIP = SensorProfile(name="tip", camera_size_px=(64, 48), crop_px=(8, 0, 48, 48), resize_px=(24, 24))


@given(turns=st.lists(st.sampled_from([0, 90, 180, 270]), max_size=5))
def test_quarter_turns_add_up(turns):
    turned = FRAME
    for turn in turns:
        turned = SensorProfile(name="tip", rotate_deg=turn).apply(turned)
    whole = SensorProfile(name="tip", rotate_deg=sum(turns) % 360)  # pyright: ignore[reportArgumentType]
    np.testing.assert_array_equal(turned, whole.apply(FRAME))


@pytest.mark.parametrize("flip", ["horizontal", "vertical", "both"])
def test_a_flip_done_twice_is_undone(flip):
    profile = SensorProfile(name="tip", flip=flip)
    assert not np.array_equal(profile.apply(FRAME), FRAME)
    np.testing.assert_array_equal(profile.apply(profile.apply(FRAME)), FRAME)


@pytest.mark.parametrize("colours", ["bgr", "gbr", "brg"])
def test_channels_are_found_where_they_arrive(colours):
    sent = FRAME[..., ["rgb".index(channel) for channel in colours]]
    np.testing.assert_array_equal(SensorProfile(name="tip", colours=colours).apply(sent), FRAME)


def test_what_is_cropped_and_resized_keeps_its_place_and_its_mean():
    small = TIP.apply(FRAME)
    assert small.shape[:2] == TIP.output_size((48, 64)) == (24, 24)
    constant = np.full((48, 64, 3), 77, dtype=np.uint8)
    assert np.all(TIP.apply(constant) == 77)
    np.testing.assert_array_equal(replace(TIP, resize_px=None).apply(FRAME), FRAME[:, 8:56])


def test_another_camera_and_a_stretch_are_refused():
    with pytest.raises(ImageError, match="sliplens sensor new"):
        TIP.apply(FRAME[:, :48])
    with pytest.raises(ImageError, match="stretches"):
        SensorProfile(name="tip", resize_px=(24, 24)).output_size((48, 64))


def test_a_profile_comes_back_from_its_text(tmp_path: Path):
    profile = replace(
        TIP, rotate_deg=90, flip="both", colours="bgr", markers="tactip",
        reference_frame=3, frame_rate_hz=30.0, normal_axis="z", normal_sign=-1, network='a "b" ü',
    )  # fmt: skip
    path = tmp_path / "tip.toml"
    save_profile(profile, path, notes=("a note",))
    assert load_profile(path) == profile
    assert load_profile(str(path)) == profile


def test_every_shipped_profile_can_be_read():
    assert {"chromatouch", "digit", "fingervision", "gelsight-mini", "tactip"} <= set(shipped_profiles())
    for name in shipped_profiles():
        profile = load_profile(name)
        assert profile.name == name.removesuffix("-camera")
        width, height = profile.camera_size_px or (224, 224)
        assert min(profile.output_size((height, width))) > 0


def test_what_the_makers_software_hands_on_is_not_cropped_or_turned_twice():
    frame = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    np.testing.assert_array_equal(load_profile("gelsight-mini").apply(frame), frame)
    # the maker's software leaves a seventh out at each border; DIGIT's driver transposes, then turns upside down
    assert load_profile("gelsight-mini-camera").crop_px == (469, 352, 3280 - 2 * 469, 2464 - 2 * 352)
    np.testing.assert_array_equal(load_profile("digit").apply(frame), frame.transpose(1, 0, 2)[::-1])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name = 'tip'\ncorp_px = [0, 0, 1, 1]", "corp_px"),
        ("name = 'tip'\ncrop_px = [0, 0, 90, 90]\ncamera_size_px = [64, 48]", "not inside"),
        ("name = 'tip'\ncrop_px = [0, 0, 9, 9]", "camera_size_px"),
        ("name = 'tip'\nrotate_deg = 45", "rotate_deg"),
        ("name = '../tip'", "letters"),
        ("name = ", "TOML"),
        ("colours = 'rgb'", "name"),
    ],
)
def test_a_profile_that_cannot_be_is_refused_with_its_place(tmp_path: Path, text, words):
    path = tmp_path / "tip.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        load_profile(path)
    assert "tip.toml" in str(caught.value)


def test_a_source_is_read_through_its_profile_and_what_is_said_of_the_reference_counts_more():
    frames = np.stack([FRAME, FRAME[::-1], FRAME[:, ::-1]])
    profile = replace(TIP, reference_frame=2)
    (capture,) = open_source(frames, sensor=profile)
    assert (capture.sensor, capture.frame_size) == ("tip", (24, 24))
    np.testing.assert_array_equal(next(capture.read_frames()), TIP.apply(FRAME))
    np.testing.assert_array_equal(there(capture.read_reference)(), TIP.apply(frames[2]))
    assert there(capture.reference_choice).method == "named by the profile tip"
    (capture,) = open_source(frames, sensor=profile, reference=FRAME)
    np.testing.assert_array_equal(there(capture.read_reference)(), TIP.apply(FRAME))
    with pytest.raises(InputError, match="--reference-frame"):
        open_source(frames[:2], sensor=profile)


def test_what_a_user_says_of_forces_counts_more_than_the_profile():
    profile = replace(TIP, normal_axis="y", normal_sign=-1)
    settings = profile.settings(LabelSettings(normal_axis="x"))
    assert (settings.normal_axis, settings.normal_sign) == ("x", -1)
