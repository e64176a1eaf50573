"""Frames that a recorder repeated: noticed whatever the coding, and a working camera is never accused of them."""

from pathlib import Path

import numpy as np
import pytest
from own_recording import write_frames
from readers import read_video

from sliplens.images import soften
from sliplens.recordings import Recording
from sliplens.recordings.labels.lag import describe_repeats, measure_motion

CODECS = {
    "libx264": ("yuv420p", "mp4"),
    "mpeg4": ("yuv420p", "mp4"),
    "mjpeg": ("yuvj420p", "avi"),
    "ffv1": ("bgr0", "mkv"),
}


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("camera_hz", [30, 24, 15, 10])
def test_a_camera_slower_than_its_file_is_noticed(
    trials: dict[str, Recording], tmp_path: Path, camera_hz: int, codec: str
):
    frames = trials["chromatouch"].frames
    shown = np.arange(len(frames) * 30 // camera_hz) * camera_hz // 30
    pixels, suffix = CODECS[codec]
    path = write_frames(tmp_path / f"a.{suffix}", frames[shown], codec=codec, pixels=pixels, rate=30)
    capture = read_video(path)
    assert capture.time_s is not None
    note = describe_repeats(measure_motion(map(soften, capture.read_frames())), capture.time_s)
    assert (note is not None) == (camera_hz < 30)


def test_a_scene_that_rests_is_no_repeat():
    moves = np.r_[np.ones(20), np.full(15, 0.01), np.ones(20), np.full(30, 0.01)]
    assert describe_repeats(moves, np.arange(len(moves)) / 30) is None


def test_key_frames_of_lossy_video_are_no_repeats():
    moves = np.tile([0.7, 0.2, 0.1, 0.09, 0.07, 0.05, 0.04, 0.03, 0.02, 0.03, 0.01, 0.03], 8)
    assert describe_repeats(moves, np.arange(len(moves)) / 30) is None
