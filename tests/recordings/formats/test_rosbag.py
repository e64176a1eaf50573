"""Bags written here with images and wrenches come back as they were; damaged and foreign ones are refused."""

import contextlib
import io
import sqlite3
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from memory import held_below
from PIL import Image
from readers import read_rosbag, refused
from there import there

from sliplens.errors import InputError, RecordingError
from sliplens.recordings.formats import open_captures
from sliplens.recordings.options import ReadOptions

pytest.importorskip("rosbags")

from ros_bags import (
    CAMERA,
    FORCE,
    FRAMES,
    HEIGHT,
    WIDTH,
    Event,
    compressed_image,
    encode,
    frame_ns,
    raw_image,
    wrench,
    wrench_ns,
    write_bag,
)


@pytest.fixture
def pixels(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.fixture
def forces(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(14, 3))


@pytest.fixture
def frames_of(pixels: np.ndarray) -> Callable[..., list[Event]]:
    """Camera events; each arrives 2 ms after its stamp."""

    def frames(**fields: Any) -> list[Event]:
        return [
            (CAMERA, raw_image(image, frame_ns(index), **fields), frame_ns(index) + 2_000_000)
            for index, image in enumerate(pixels)
        ]

    return frames


@pytest.fixture
def wrenches(forces: np.ndarray) -> list[Event]:
    return [
        (FORCE, wrench(force.tolist(), wrench_ns(index)), wrench_ns(index) + 1_000_000)
        for index, force in enumerate(forces)
    ]


@pytest.fixture
def recorded(frames_of: Callable[..., list[Event]], wrenches: list[Event]) -> list[Event]:
    return in_order(frames_of(), wrenches)


def in_order(*streams: Sequence[Event]) -> list[Event]:
    return sorted((event for stream in streams for event in stream), key=lambda event: event[2])


@pytest.mark.parametrize(
    "kind",
    [("MCAP", None), ("MCAP", "STORAGE"), ("SQLITE3", None), ("SQLITE3", "MESSAGE"), ("SQLITE3", "FILE")],
    ids=str,
)
def test_a_bag_comes_back_without_loss(tmp_path, pixels, forces, recorded, kind):
    path = write_bag(tmp_path / "trial", recorded, storage=kind[0], compression=kind[1])
    capture = read_rosbag(path)
    np.testing.assert_array_equal(list(capture.read_frames()), pixels)
    np.testing.assert_array_equal(there(capture.forces).force_n, forces)
    assert (capture.trial, capture.frame_size, capture.notes) == ("trial", (HEIGHT, WIDTH), ())


def test_frames_and_forces_count_from_the_first_of_them_without_rounding(tmp_path, recorded):
    capture = read_rosbag(write_bag(tmp_path / "trial", recorded))
    first = wrench_ns(0)
    assert there(capture.forces).time_s.tolist() == [(wrench_ns(index) - first) / 1e9 for index in range(14)]
    assert capture.frame_time_s.tolist() == [(frame_ns(index) - first) / 1e9 for index in range(FRAMES)]
    assert capture.frame_time_s[0] == 0.005000001


@pytest.mark.parametrize("suffix", [("MCAP", ".mcap"), ("SQLITE3", ".db3")])
def test_a_file_of_a_bag_is_read_like_its_folder(tmp_path, pixels, frames_of, suffix):
    folder = write_bag(tmp_path / "trial 7", frames_of(), storage=suffix[0])
    (file,) = folder.glob(f"*{suffix[1]}")
    (folder / "metadata.yaml").unlink()
    capture = read_rosbag(file)
    np.testing.assert_array_equal(list(capture.read_frames()), pixels)
    assert capture.trial == "trial-7"


@pytest.mark.parametrize(
    ("encoding", "padding", "recode"),
    [
        ("rgb8", 5, lambda rgb: rgb),
        ("bgr8", 0, lambda rgb: rgb[..., ::-1]),
        ("8UC3", 0, lambda rgb: rgb[..., ::-1]),
        ("rgba8", 0, lambda rgb: np.dstack([rgb, rgb[..., :1]])),
        ("bgra8", 0, lambda rgb: np.dstack([rgb[..., ::-1], rgb[..., :1]])),
        ("mono8", 0, lambda rgb: rgb[..., :1]),
    ],
)
def test_colours_in_another_order_are_exact_and_padding_is_left_out(tmp_path, pixels, encoding, padding, recode):
    events = [
        (CAMERA, raw_image(recode(rgb), frame_ns(i), encoding=encoding, padding=padding), i)
        for i, rgb in enumerate(pixels)
    ]
    expected = np.repeat(pixels[..., :1], 3, axis=-1) if encoding == "mono8" else pixels
    np.testing.assert_array_equal(list(read_rosbag(write_bag(tmp_path / "bag", events)).read_frames()), expected)


@pytest.mark.parametrize("encoding", ["yuyv", "uyvy", "bayer_rggb8", "bayer_grbg8"])
def test_an_even_colour_survives_what_cameras_send(tmp_path, encoding):
    rgb = np.array([200, 120, 60])
    red, green, blue = rgb.tolist()
    if encoding.startswith("bayer"):
        at = {"r": red, "g": green, "b": blue}
        cell = np.array([at[colour] for colour in encoding[6:10]]).reshape(2, 2)
        sent = np.tile(cell, (HEIGHT // 2, WIDTH // 2))[..., None]
    else:  # ITU-R BT.601, levels of 16 to 235
        luma = 16 + (65.481 * red + 128.553 * green + 24.966 * blue) / 255
        u = 128 + (-37.797 * red - 74.203 * green + 112 * blue) / 255
        v = 128 + (112 * red - 93.786 * green - 18.214 * blue) / 255
        pair = [[luma, u], [luma, v]]
        sent = np.tile(np.array(pair if encoding == "yuyv" else [part[::-1] for part in pair]), (HEIGHT, WIDTH // 2, 1))
        sent = sent.reshape(HEIGHT, WIDTH, 2).round()
    event = (CAMERA, raw_image(sent.astype(np.uint8), frame_ns(0), encoding=encoding), 0)
    (frame,) = read_rosbag(write_bag(tmp_path / "bag", [event])).read_frames()
    np.testing.assert_allclose(
        frame[4:-4, 4:-4].reshape(-1, 3), np.broadcast_to(rgb, (frame[4:-4, 4:-4].size // 3, 3)), atol=3
    )


def test_forces_without_a_stamp_take_the_times_of_their_arrival(tmp_path, frames_of):
    def unstamped(force: Sequence[float], time_ns: int) -> Any:
        return wrench(force, time_ns).wrench

    events = [*frames_of(), *(("/force", unstamped((0.0, 0.0, float(i)), 0), frame_ns(i)) for i in range(4))]
    capture = read_rosbag(write_bag(tmp_path / "bag", sorted(events, key=lambda event: event[2])))
    np.testing.assert_array_equal(there(capture.forces).force_n[:, 2], np.arange(4.0))
    assert "have no header stamp" in capture.notes[0]


def test_compressed_images_are_what_pillow_makes_of_their_bytes(tmp_path, pixels):
    for form in ("PNG", "JPEG"):
        data = [encode(image, form) for image in pixels]
        events = [(CAMERA, compressed_image(one, frame_ns(i)), i) for i, one in enumerate(data)]
        frames = list(read_rosbag(write_bag(tmp_path / form, events)).read_frames())
        np.testing.assert_array_equal(frames, [np.array(Image.open(io.BytesIO(one))) for one in data])
        if form == "PNG":  # lossless: what was recorded
            np.testing.assert_array_equal(frames, pixels)


@pytest.mark.parametrize(
    ("shape", "claims", "message"),
    [
        ((HEIGHT, WIDTH, 2), {"encoding": "16UC1"}, "has encoding '16UC1'; record it as rgb8, bgr8, mono8"),
        ((HEIGHT, WIDTH, 2), {"encoding": "yuyv", "width": WIDTH - 1}, "claims"),
        ((HEIGHT, WIDTH, 3), {"height": 200_000, "width": 170_000, "step": 510_000}, "but holds 576 bytes"),  # 100 GB
        ((HEIGHT, WIDTH, 3), {"height": 2**32 - 1, "width": 1, "step": 2**32 - 1}, "but holds"),  # over 64 bits
        ((HEIGHT, WIDTH, 3), {"height": HEIGHT + 1}, "but holds"),
        ((HEIGHT, WIDTH, 3), {"height": 0}, "claims 0 rows"),
        ((HEIGHT, WIDTH, 3), {"width": 0}, "claims"),
        ((HEIGHT, WIDTH, 3), {"step": 0}, "rows of 0 bytes"),
        ((HEIGHT, WIDTH, 3), {"width": WIDTH + 1}, "claims"),
    ],
)
def test_a_frame_that_is_no_8_bit_image_or_contradicts_itself_is_refused(tmp_path, rng, shape, claims, message):
    pixels = rng.integers(0, 256, shape, dtype=np.uint8)
    path = write_bag(tmp_path / "trial", [(CAMERA, raw_image(pixels, frame_ns(0), **claims), 0)])
    with held_below(64e6):
        refused(read_rosbag, path, f"frame 0 of .* {message}")


def test_another_kind_of_compressed_image_is_refused(tmp_path, pixels, monkeypatch):
    png = encode(pixels[0], "PNG")
    events = {
        "of format '16UC1; compressedDepth png', cannot be read as an image": compressed_image(
            b"\0" * 12 + png, frame_ns(0), form="16UC1; compressedDepth png"
        ),
        "has the colours RGBA": compressed_image(encode(np.zeros((4, 4, 4), np.uint8), "PNG"), frame_ns(0)),
        "cannot be read as an image .*decompression bomb": compressed_image(png, frame_ns(0)),
    }
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 50)
    for number, (message, image) in enumerate(events.items()):
        refused(read_rosbag, write_bag(tmp_path / f"{number}", [(CAMERA, image, 0)]), message)


def test_frames_of_changing_size_are_refused(tmp_path, pixels, frames_of):
    small = (CAMERA, raw_image(pixels[0, :-2], frame_ns(FRAMES)), frame_ns(FRAMES) + 2_000_000)
    path = write_bag(tmp_path / "trial", [*frames_of(), small])
    refused(read_rosbag, path, r"frame 5 of .* is of another size than those before it; cut")


def test_a_compressed_frame_that_is_cut_short_is_refused_when_it_is_read(tmp_path, rng):
    noise = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    whole, cut = encode(noise, "PNG"), encode(noise, "PNG")[:4000]
    events = [(CAMERA, compressed_image(data, frame_ns(i)), i) for i, data in enumerate((whole, cut))]
    frames = read_rosbag(write_bag(tmp_path / "trial", events)).read_frames()
    np.testing.assert_array_equal(next(frames), noise)
    with pytest.raises(InputError, match=r"frame 1 of .* cannot be read as an image"):
        next(frames)


def test_without_header_stamps_both_topics_take_the_time_of_the_bag(tmp_path, pixels, wrenches):
    frames = [(CAMERA, raw_image(image, 0), frame_ns(i) + 2_000_000) for i, image in enumerate(pixels)]
    capture = read_rosbag(write_bag(tmp_path / "trial", in_order(frames, wrenches)))
    first = wrench_ns(0) + 1_000_000
    assert capture.frame_time_s.tolist() == [(frame_ns(i) + 2_000_000 - first) / 1e9 for i in range(FRAMES)]
    assert there(capture.forces).time_s[0] == 0
    assert capture.notes == (
        f"5 of 5 messages of {CAMERA} have no header stamp: times are those at which the bag received the messages.",
    )


def test_clocks_that_never_meet_are_replaced_by_the_time_of_the_bag(tmp_path, pixels, wrenches):
    since_boot = [(CAMERA, raw_image(im, 10**9 * (i + 1)), frame_ns(i) + 2_000_000) for i, im in enumerate(pixels)]
    capture = read_rosbag(write_bag(tmp_path / "trial", in_order(since_boot, wrenches)))
    assert capture.frame_time_s[0] == 0.006000001
    assert f"header stamps of {CAMERA} and {FORCE} are of different clocks" in capture.notes[0]


def test_a_bag_without_wrenches_has_no_forces(tmp_path, frames_of):
    capture = read_rosbag(write_bag(tmp_path / "a", frames_of()))
    assert capture.forces is None
    assert capture.notes == ("There are no forces: the bag has no message of geometry_msgs/msg/WrenchStamped.",)
    silent = write_bag(tmp_path / "b", frames_of(), topics=[(FORCE, "geometry_msgs/msg/WrenchStamped")])
    assert "There are no forces: /wrench has no message" in read_rosbag(silent).notes[0]
    refused(read_rosbag, silent, r"/wrench of .* has no force sample; record the force sensor too", wrench_topic=FORCE)


def test_of_several_topics_one_must_be_named(tmp_path, pixels, frames_of, wrenches):
    shown = [(raw_image(255 - image, frame_ns(i)), frame_ns(i)) for i, image in enumerate(pixels)]
    scenes = [(name, *frame) for frame in shown for name in ("/a", "/b")]
    path = write_bag(tmp_path / "trial", in_order(scenes, wrenches))
    refused(read_rosbag, path, "has 2 image topics among /a, /b; name one with --image-topic")
    refused(read_rosbag, path, r"has no image topic /wrench", image_topic=FORCE)
    frames = read_rosbag(path, image_topic="/b", wrench_topic=FORCE).read_frames()
    np.testing.assert_array_equal(list(frames), 255 - pixels)
    left = [("/left", message, time_ns) for _, message, time_ns in wrenches]
    path = write_bag(tmp_path / "two", in_order(frames_of(), left, wrenches))
    refused(read_rosbag, path, "has 2 wrench topics among /left, /wrench; name one with")


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_an_empty_bag_is_refused(tmp_path, storage):
    with pytest.raises(RecordingError, match=r"has no topic with images; record the camera too \(it has no topic\)"):
        read_rosbag(write_bag(tmp_path / "nothing", [], storage=storage))
    silent = write_bag(tmp_path / "silent", [], storage=storage, topics=[(CAMERA, "sensor_msgs/msg/Image")])
    refused(read_rosbag, silent, r"/tactile/image of .* has no frame; leave it out or record it again")


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_a_bag_that_is_cut_off_is_refused(tmp_path, recorded, storage):
    path = write_bag(tmp_path / "trial", recorded, storage=storage)
    (file,) = [*path.glob("*.mcap"), *path.glob("*.db3")]
    whole = file.read_bytes()
    for length in (0, 1, 8, 100, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:length])
        refused(read_rosbag, path, r"is not a readable ROS 2 bag|is cut off; copy it again")


def test_a_bag_with_any_byte_changed_raises_no_foreign_error(tmp_path, rng, recorded):
    for storage in ("MCAP", "SQLITE3"):
        path = write_bag(tmp_path / storage, recorded, storage=storage)
        for file in path.iterdir():
            whole = file.read_bytes()
            for at in rng.integers(0, len(whole), 25):
                damaged = bytearray(whole)
                damaged[at] ^= 1 << rng.integers(8)
                file.write_bytes(damaged)
                with contextlib.suppress(InputError):
                    list(read_rosbag(path).read_frames())
            file.write_bytes(whole)


def test_a_path_that_is_no_bag_is_refused(tmp_path, frames_of):
    bag = write_bag(tmp_path / "bag", frames_of())
    (bag / "metadata.yaml").unlink()
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    refused(read_rosbag, bag, r"has no metadata\.yaml; write it with `ros2 bag reindex`, or name bag\.mcap")
    refused(read_rosbag, tmp_path, r"has no metadata\.yaml; .* or name the folder of a bag")
    with pytest.raises(RecordingError, match="is a ROS 1 bag; convert it with `rosbags-convert"):
        open_captures(tmp_path / "old.bag", options=ReadOptions())


def test_files_of_something_else_are_refused(tmp_path, frames_of):
    with contextlib.closing(sqlite3.connect(tmp_path / "phone.db3")) as database, database:
        database.execute("CREATE TABLE contacts (name TEXT)")
    (tmp_path / "video.mcap").write_bytes(b"\0\0\0\x18ftypmp42" * 20)
    for name in ("phone.db3", "video.mcap"):
        refused(read_rosbag, tmp_path / name, f"{name} is not a readable ROS 2 bag")
    bag = write_bag(tmp_path / "bag", frames_of())
    for text in ("", "- a list", "rosbag2_bagfile_information: {version: 99}", "a: [", "a: !!python/object:os.x {}"):
        (bag / "metadata.yaml").write_text(text)
        refused(read_rosbag, bag, "bag is not a readable ROS 2 bag")


def test_the_memory_of_reading_does_not_grow_with_the_length_of_a_bag(tmp_path, rng):
    pixels = rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    path = write_bag(tmp_path / "long", [(CAMERA, raw_image(pixels, frame_ns(i)), frame_ns(i)) for i in range(300)])
    with held_below(9e6):  # 17 MB of pixels, a chunk of 1 MiB a few times over
        assert sum(1 for _ in read_rosbag(path).read_frames()) == 300


def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    refused(read_rosbag, tmp_path / "a.mcap", r'pip install "sliplens\[ros\]"')
