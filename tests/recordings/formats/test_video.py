from pathlib import Path

import av
import numpy as np
import pytest
from own_recording import write_frames
from readers import read_video, refused

from sliplens.errors import RecordingError
from sliplens.images import write_png

SIZE = 64, 96


def brightening(count: int) -> list[np.ndarray]:
    """Frames whose brightness tells their number, even after lossy coding."""
    return [np.full((*SIZE, 3), 20 + 6 * index, dtype=np.uint8) for index in range(count)]


LOSSY = [
    ("a.mp4", "libx264", 0), ("a.mp4", "libx264", 3), ("a.mkv", "libx264", 3), ("a.ts", "libx264", 3),
    ("a.avi", "libx264", 3), ("a.avi", "mpeg4", 0), ("a.avi", "mpeg4", 2), ("a.mp4", "mpeg4", 2), ("a.avi", "mjpeg", 0),
]  # fmt: skip


def test_a_title_that_is_no_utf8_does_not_matter(tmp_path):
    frames = [np.full((*SIZE, 3), level, dtype=np.uint8) for level in (0, 255)]
    path = write_frames(tmp_path / "pull.mkv", frames, title="Gr\u00fcn")
    coded = path.read_bytes()
    assert "Gr\u00fcn".encode() in coded
    path.write_bytes(coded.replace("Gr\u00fcn".encode(), b"Gr\xff\xffn"))
    assert len(read_video(path).frame_time_s) == 2


def test_lossless_frames_come_back_as_they_were(tmp_path: Path, rng: np.random.Generator):
    frames = list(rng.integers(0, 256, (5, *SIZE, 3), dtype=np.uint8))
    capture = read_video(write_frames(tmp_path / "trial 1.mkv", frames))
    np.testing.assert_array_equal(list(capture.read_frames()), frames)
    np.testing.assert_array_equal(list(capture.read_frames()), frames)
    assert (capture.trial, capture.frame_size, capture.forces, capture.notes) == ("trial-1", SIZE, None, ())


@pytest.mark.parametrize(("name", "codec", "reordered"), LOSSY)
def test_frames_come_in_the_order_they_are_shown(tmp_path: Path, name: str, codec: str, reordered: int):
    pixels = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    path = write_frames(tmp_path / name, brightening(30), codec=codec, pixels=pixels, reordered=reordered)
    capture = read_video(path)
    shown = [frame.mean() for frame in capture.read_frames()]
    np.testing.assert_allclose(shown, 20 + 6 * np.arange(30), atol=2.5)
    np.testing.assert_allclose(capture.frame_time_s, np.arange(30) / 25, atol=1e-3)
    assert "frames are coded with loss" in capture.notes[0]


@pytest.mark.parametrize("codec", ["ffv1", "libx264"])
def test_a_variable_frame_rate_is_kept(tmp_path: Path, codec: str):
    stamps = [0, 33, 67, 500, 501, 2000, 2040, 2080]
    pixels = "bgr0" if codec == "ffv1" else "yuv420p"
    path = write_frames(tmp_path / "a.mkv", brightening(8), codec=codec, pixels=pixels, stamps_ms=stamps, reordered=0)
    capture = read_video(path)
    np.testing.assert_allclose(capture.frame_time_s, np.array(stamps) / 1000, atol=1e-9)
    assert len(list(capture.read_frames())) == 8


def test_a_stream_without_stamps_needs_a_declared_rate(tmp_path: Path):
    path = write_frames(tmp_path / "a.h264", brightening(6), codec="libx264", pixels="yuv420p")
    refused(read_video, path, r"a\.h264 has no presentation stamps; declare its rate with --frame-rate")
    capture = read_video(path, frame_rate=25.0)
    np.testing.assert_allclose([frame.mean() for frame in capture.read_frames()], 20 + 6 * np.arange(6), atol=2.5)


def test_skipped_frames_keep_the_times_of_the_rest(tmp_path: Path):
    path = write_frames(tmp_path / "a.mkv", brightening(6))
    capture = read_video(path, skip_frames=2)
    np.testing.assert_array_equal(list(capture.read_frames()), brightening(6)[2:])
    np.testing.assert_allclose(capture.frame_time_s, np.arange(2, 6) / 25, atol=1e-3)
    assert capture.notes == ("a.mkv: the first 2 of 6 frames were left out.",)
    for count in (6, -1):
        refused(read_video, path, rf"{count} of 6 frames of .*a\.mkv cannot be skipped", skip_frames=count)


def test_forces_lie_beside_the_video(tmp_path: Path):
    path = write_frames(tmp_path / "a.mkv", brightening(6))
    table = tmp_path / "forces.csv"
    table.write_text("t_s,fx,fy,fz\n10,1,2,3\n10.1,4,5,6\n")
    capture = read_video(path, forces=table, start_s=10.0, skip_frames=1)
    assert capture.forces is not None
    np.testing.assert_array_equal(capture.forces.force_n, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(capture.frame_time_s, 10 + np.arange(1, 6) / 25, atol=1e-3)
    assert "a.mkv: the first frame was declared to be taken at 10 s of the force clock." in capture.notes
    refused(read_video, path, r"have no moment in common; give --start-s", forces=table)
    table.write_text("t_s,fx,fy,fz\n0,1,2,3\n0.1,4,5,6\n")
    assert "taken to count from the same zero" in read_video(path, forces=table).notes[-1]


@pytest.mark.parametrize(
    ("name", "codec"), [("a.avi", "mpeg4"), ("a.mkv", "mpeg4"), ("a.mkv", "ffv1"), ("a.mp4", "libx264")]
)
@pytest.mark.parametrize("reordered", [0, 2])
def test_a_video_that_was_cut_off_keeps_its_whole_frames(
    tmp_path: Path, rng: np.random.Generator, name: str, codec: str, reordered: int
):
    noise, pixels = list(rng.integers(0, 256, (20, *SIZE, 3), dtype=np.uint8)), "bgr0" if codec == "ffv1" else "yuv420p"
    path = write_frames(tmp_path / name, noise, codec=codec, pixels=pixels, reordered=reordered)
    whole = [*read_video(path).read_frames()]
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    capture = read_video(path)
    assert 3 <= len(capture) < 20
    # of reordered frames the last may lack one before it
    shown = np.rint(25 * capture.frame_time_s).astype(int)
    np.testing.assert_array_equal([*capture.read_frames()], [whole[at] for at in shown])
    assert np.diff(shown).sum() <= len(shown) + reordered
    assert f"{len(capture)} frames before the cut were kept" in " ".join(capture.notes)


@pytest.mark.parametrize("kept", [1, 2, 19])
def test_not_one_frame_is_missing_at_the_end_without_a_word(tmp_path: Path, rng: np.random.Generator, kept: int):
    noise = list(rng.integers(0, 256, (20, *SIZE, 3), dtype=np.uint8))
    path = write_frames(tmp_path / "a.mkv", noise)
    with av.open(str(path)) as container:
        starts = [packet.pos for packet in container.demux(video=0) if packet.pos is not None]
    path.write_bytes(path.read_bytes()[: starts[kept]])
    capture = read_video(path)
    np.testing.assert_array_equal([*capture.read_frames()], noise[:kept])
    assert f"{kept} frame{'s' * (kept > 1)} before the cut were kept" in capture.notes[0]


def test_damage_within_a_video_is_found_at_the_frame(tmp_path: Path, rng: np.random.Generator):
    noise = list(rng.integers(0, 256, (30, *SIZE, 3), dtype=np.uint8))
    path = write_frames(tmp_path / "a.avi", noise, codec="mpeg4", pixels="yuv420p")
    data = bytearray(path.read_bytes())
    middle = data.index(b"00dc", len(data) // 2) + 200  # within the data of a frame
    data[middle : middle + 300] = rng.bytes(300)
    path.write_bytes(data)
    capture = read_video(path, frame_rate=25.0)
    with pytest.raises(RecordingError, match=r"frame \d+ of .*a\.avi cannot be decoded"):
        list(capture.read_frames())


def test_a_file_that_is_no_video_is_refused(tmp_path: Path, rng: np.random.Generator):
    cases = {
        "notes.txt": b"FFmpeg would play this text as a video\n" * 50,
        "list.m3u8": b"#EXTM3U\n#EXTINF:1,\nother.mkv\n",
        "noise.mp4": rng.bytes(4000),
        "empty.avi": b"",
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
    write_png(tmp_path / "frame.png", brightening(1)[0])
    for name in cases:
        refused(read_video, tmp_path / name, rf"{name} cannot be read as a video \(.*\); copy or export it again")
    refused(read_video, tmp_path / "frame.png", r"frame\.png is an image and no video; name the folder that it lies in")
    refused(read_video, tmp_path / "nothing.mp4", r"nothing\.mp4 does not exist; name a video, or copy it")
    refused(read_video, tmp_path, "is no file; name a video")


def test_an_absurd_frame_size_is_refused(tmp_path: Path):
    path = write_frames(tmp_path / "a.avi", brightening(2))
    data = path.read_bytes()
    header = data.index(b"strf") + 12  # width and height in the header of the stream
    size = np.array([60_000, 60_000], dtype="<i4").tobytes()
    path.write_bytes(data[:header] + size + data[header + 8 :])
    refused(read_video, path, r"a\.avi claims frames of \d+ x \d+ pixels; the file is damaged")


CORNERED = np.zeros((48, 64, 3), dtype=np.uint8)  # no turn and no mirror image leaves it as it is
CORNERED[:24, :32] = 250
CORNERED[:24, 32:] = 120
TURNS = [(degrees, mirrored) for degrees in (0, 90, 180, 270) for mirrored in (False, True)]


def write_turned(path: Path, degrees: float, *, mirrored: bool = False) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
        if not hasattr(stream, "set_display_rotation"):
            pytest.skip("this PyAV writes no display matrix")
        stream.set_display_rotation(degrees, hflip=mirrored)
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(CORNERED, format="rgb24")))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv"])
@pytest.mark.parametrize(("degrees", "mirrored"), TURNS)
def test_a_display_matrix_is_applied(tmp_path: Path, degrees: int, mirrored: bool, suffix: str):
    # PyAV turns counterclockwise, then mirrors
    upright = np.rot90(CORNERED, degrees // 90)
    upright = upright[:, ::-1] if mirrored else upright
    capture = read_video(write_turned(tmp_path / f"a.{suffix}", degrees, mirrored=mirrored))
    frames = list(capture.read_frames())
    assert capture.frame_size == upright.shape[:2]
    assert len(frames) == 3
    for frame in frames:
        assert frame.shape == upright.shape
        # coding rings at the edges of the blocks; another turn would differ by 60 and more
        assert np.abs(frame.astype(float) - upright).mean() < 8


def test_a_turn_that_is_no_right_angle_is_refused(tmp_path: Path):
    refused(read_video, write_turned(tmp_path / "a.mp4", 30), "turned by .* degrees.*export it upright")


@pytest.mark.parametrize("pixels", ["gray10le", "gray12le", "gbrp10le", "gbrp12le", "gray16le", "rgb48le"])
def test_a_video_of_10_or_12_bits_keeps_its_brightness_and_one_of_16_is_refused(tmp_path: Path, pixels: str):
    path = write_frames(tmp_path / "a.mkv", brightening(3), pixels=pixels)
    if pixels in {"gray16le", "rgb48le"}:
        refused(read_video, path, "16 bits a channel.*export it with 8")
        return
    capture = read_video(path)
    for frame, wanted in zip(capture.read_frames(), brightening(3), strict=True):
        assert np.abs(frame.astype(int) - wanted).max() <= 2  # rounding to 10 bits and back
