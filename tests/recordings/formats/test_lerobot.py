"""Data sets written here in the layout of LeRobot v3.0 come back as they were; others are refused."""

import contextlib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot_data import (
    CAMERA,
    FORCE,
    FPS,
    HEIGHT,
    LENGTHS,
    LOSSLESS,
    SCENE,
    WIDTH,
    write_dataset,
    write_episodes,
    write_info,
)
from own_recording import write_frames
from readers import read_lerobot, refused

from sliplens.errors import InputError, RecordingError


def split(values: np.ndarray) -> list[np.ndarray]:
    return np.split(values, np.cumsum(LENGTHS)[:-1])


@pytest.fixture
def frames(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (sum(LENGTHS), HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.fixture
def wrenches(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(sum(LENGTHS), 6)).astype(np.float32)


@pytest.fixture
def dataset(tmp_path: Path, frames: np.ndarray, wrenches: np.ndarray) -> Path:
    return write_dataset(tmp_path / "press v3", frames, wrenches)


def test_episodes_come_back_without_loss(dataset, frames, wrenches):
    captures = read_lerobot(dataset)
    assert [capture.trial for capture in captures] == [f"press-v3-{index:06d}" for index in range(3)]
    for capture, shown, felt in zip(captures, split(frames), split(wrenches), strict=True):
        np.testing.assert_array_equal(list(capture.read_frames()), shown)
        assert capture.frame_size == (HEIGHT, WIDTH)
        assert capture.forces is not None
        np.testing.assert_array_equal(capture.forces.force_n, felt[:, :3])
        np.testing.assert_array_equal(capture.forces.time_s, capture.frame_time_s)
        # stored in single precision
        np.testing.assert_allclose(capture.frame_time_s, np.arange(len(shown)) / FPS, atol=1e-7)


@pytest.mark.parametrize("key_frame", [2, 3, 4, 5])
def test_a_key_frame_shown_after_the_episode_begins_loses_no_frame(tmp_path, frames, wrenches, key_frame):
    params = f"bframes=3:b-adapt=0:open-gop=1:scenecut=0:keyint={key_frame}:min-keyint=1"
    coding = {**LOSSLESS, "options": {"qp": "0", "x264-params": params}}
    folder = write_dataset(tmp_path / "a", frames, wrenches, coding=coding)
    for capture, shown in zip(read_lerobot(folder), split(frames), strict=True):
        np.testing.assert_array_equal(list(capture.read_frames()), shown)


def test_a_camera_is_found_by_its_name_or_named(dataset, frames):
    capture = read_lerobot(dataset, camera_key=SCENE)[0]
    np.testing.assert_array_equal(list(capture.read_frames()), 255 - split(frames)[0])
    refused(
        read_lerobot, dataset, rf"has no camera wrist among .*{CAMERA}.*{SCENE}.*; name one with", camera_key="wrist"
    )
    write_info(dataset, lambda info: info["features"].pop(CAMERA))
    assert SCENE in read_lerobot(dataset)[0].source  # there is no other
    write_info(dataset, lambda info: info["features"].update(gelsight=info["features"][CAMERA]))
    refused(read_lerobot, dataset, "has 2 cameras among .*gelsight.*; name one with --camera-key")
    write_info(dataset, lambda info: [info["features"].pop(key) for key in (CAMERA, SCENE)])
    refused(read_lerobot, dataset, "press v3 has no camera")


def test_a_force_is_found_by_its_name_or_named(dataset):
    write_info(dataset, lambda info: info["features"].update(ft=info["features"][FORCE]))
    refused(read_lerobot, dataset, "has 2 forces among .*; name one with --force-key")
    assert read_lerobot(dataset, force_key=FORCE)[0].forces is not None
    for name in ("load", "observation.state"):
        refused(read_lerobot, dataset, rf"has no force {name} among", force_key=name)
    write_info(dataset, lambda info: info["features"].pop(FORCE))
    capture = read_lerobot(dataset)[0]
    assert capture.forces is None
    assert capture.notes[0] == f"There are no forces: no feature of {dataset} is named like one."


@pytest.mark.parametrize(
    "names",
    [["tx", "ty", "tz", "fx", "fy", "fz"], {"motors": ["torque_x", "torque_y", "torque_z", "fx", "fy", "fz"]}],
    ids=["list", "groups"],
)
def test_torques_are_not_taken_for_forces(dataset, names):
    write_info(dataset, lambda info: info["features"][FORCE].update(names=names))
    refused(read_lerobot, dataset, r"observation\.wrench of .* begins with t.*; forces must come first")


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "meta").mkdir()
    info = tmp_path / "meta" / "info.json"
    refused(read_lerobot, tmp_path, r"info\.json does not exist; name the folder of a LeRobot data set")
    for text, message in {
        "{": "is not valid JSON",
        "[" * 100_000: "is not valid JSON",
        "[]": "is not .*got `array`",
        '{"codebase_version": "v2.1"}': "is not .*codebase_version.*; convert an older one with",
        '{"codebase_version": "v3.0", "fps": 0}': r"is not .*`float` > 0.* at `\$.fps`\); .* copy",
        '{"codebase_version": "v3.0", "fps": "30"}': r"is not .*Expected `float`, got `str`",
        '{"codebase_version": "v3.0", "fps": 30, "features": {"a": 1}}': "is not .*, got `int`.*features",
    }.items():
        info.write_text(text)
        refused(read_lerobot, tmp_path, rf"info\.json {message}")


@pytest.mark.parametrize("camera", ["../secret", "/etc/videos", "a\0b", "..", "..\\secret"])
def test_a_camera_that_leads_out_of_the_data_set_is_refused(dataset, camera):
    write_info(dataset, lambda info: info["features"].update({camera: info["features"][CAMERA]}))
    refused(read_lerobot, dataset, "cannot name a folder; copy one you trust", camera_key=camera)


def test_a_play_list_dressed_as_a_video_is_not_followed(dataset, tmp_path, frames):
    write_frames(tmp_path / "secret.mp4", frames, rate=FPS, **LOSSLESS)
    video = dataset / "videos" / CAMERA / "chunk-000" / "file-000.mp4"
    lists = (f"ffconcat version 1.0\nfile '{tmp_path}/secret.mp4'\n", f"#EXTM3U\n#EXTINF:1,\n{tmp_path}/secret.mp4\n")
    for text in lists:
        video.write_text(text)
        refused(read_lerobot, dataset, r"file-000\.mp4 cannot be read as a video")


def test_a_missing_or_damaged_video_is_refused(dataset):
    video = dataset / "videos" / CAMERA / "chunk-000" / "file-000.mp4"
    video.write_bytes(b"no video")
    refused(read_lerobot, dataset, r"file-000\.mp4 cannot be read as a video \(.*\); copy or")
    video.unlink()
    refused(read_lerobot, dataset, r"file-000\.mp4 does not exist; name a video, or copy it")


def test_a_video_that_ends_too_early_is_refused_when_it_is_read(dataset, frames):
    write_frames(dataset / "videos" / CAMERA / "chunk-000" / "file-000.mp4", frames[:10], rate=FPS, **LOSSLESS)
    first, second, _ = read_lerobot(dataset)
    assert len(list(first.read_frames())) == 7
    shown = second.read_frames()
    assert sum(1 for _ in zip(range(3), shown, strict=False)) == 3
    with pytest.raises(RecordingError, match=r"file-000\.mp4 has no frame at 0\.333 s; it is cut off, copy"):
        next(shown)


def test_tables_that_contradict_the_metadata_are_refused(dataset):
    starts = np.cumsum([0, *LENGTHS])
    from_timestamp = f"videos/{CAMERA}/from_timestamp"
    for name, values, message in (
        ("length", [7, 4, 6], r"has 5 frames of episode 1 .*, its metadata say 4, .*; leave the episode out"),
        ("episode_index", [0, 1, 1], "has 0 frames of episode 1"),
        (from_timestamp, [0.0, None, 0.0], r"has gaps in the column 'videos/.*/from_timestamp'; copy the data set"),
        (from_timestamp, [0.0, np.inf, 0.0], "from inf s on in the video"),
        ("episode_index", ["0", "1", "2"], r"holds string as .episode_index. where whole numbers belong"),
        ("data/file_index", ["0", "0", "1"], r"holds string as .data/file_index. where whole numbers belong"),
    ):
        write_episodes(dataset, starts, **{name: values})
        refused(read_lerobot, dataset, message)
    write_episodes(dataset, starts)
    write_info(dataset, lambda info: info["features"][FORCE].update(shape=[3]))
    refused(read_lerobot, dataset, "does not hold 3 numbers a frame")


def test_missing_and_damaged_tables_are_refused(dataset):
    data = dataset / "data" / "chunk-000" / "file-001.parquet"
    pq.write_table(pq.read_table(data).drop_columns([FORCE]), data)
    refused(read_lerobot, dataset, rf"file-001\.parquet lacks the column '{FORCE}'")
    data.write_bytes(data.read_bytes()[:-9])
    refused(read_lerobot, dataset, r"file-001\.parquet is not a readable Parquet file")
    data.unlink()
    refused(read_lerobot, dataset, r"file-001\.parquet does not exist")
    (dataset / "meta" / "episodes" / "chunk-000" / "file-000.parquet").unlink()
    refused(read_lerobot, dataset, "episodes lists no episode")


def test_a_data_set_with_any_byte_changed_raises_no_foreign_error(dataset, rng):
    for file in [path for path in dataset.rglob("*") if path.is_file() and SCENE not in path.parts]:
        whole = file.read_bytes()
        for at in rng.integers(0, len(whole), 10):
            damaged = bytearray(whole)
            damaged[at] ^= 255
            file.write_bytes(damaged)
            with contextlib.suppress(InputError):
                for capture in read_lerobot(dataset):
                    list(capture.read_frames())
        file.write_bytes(whole)
