"""Sources that misbehave: one clear sentence, and the loop goes on where it can."""

import errno
import io
import os
import socket
import time
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from pathlib import Path
from threading import Event, Thread

import av
import av.logging
import numpy as np
import pytest
from scripted import Scripted, frame_of, plain_reader

from sliplens.errors import InputError, SourceError
from sliplens.images import encode_image
from sliplens.live import CameraSource, LiveOptions, list_cameras, loop, open_live, sources
from sliplens.live.reading import LiveFrame, Reading

IMAGE = np.tile(np.arange(48, dtype=np.uint8)[:, None, None], (1, 48, 3))
frame = partial(frame_of, IMAGE)


def lost(source: Scripted) -> None:
    raise SourceError(f"{source.name} was unplugged; plug it in again")


def lost_once_read(source: Scripted) -> None:
    source.wait()
    lost(source)


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "_RETRY_S", 0.01)
    monkeypatch.setattr(loop, "_PATIENCE_S", 0.2)


def readings_of(*script: LiveFrame | Callable[[Scripted], None], **settings: float) -> list[Reading]:
    return Scripted(*script).all_readings(None, reference=IMAGE, **settings)


def test_a_source_that_is_lost_is_opened_again_until_it_is_back():
    source = Scripted(frame(0), lost, frame(0, time_s=7.0), frame(1, time_s=7.01), refuses=2)
    readings = source.all_readings(None, reference=IMAGE)
    assert source.opened == 4
    assert [reading.number for reading in readings] == [0, 0, 1]
    assert readings[-1].withheld is None


def test_while_a_source_is_away_readings_say_so():
    def told(source: Scripted) -> None:
        source.read.clear()  # only once somebody was told that it was away

    readings = readings_of(frame(3), lost_once_read, told, frame(4), stall_s=0.05)
    sentences = [reading.withheld for reading in readings if reading.number == 3]
    assert sentences[0] is None
    assert "the fake was unplugged; plug it in again" in sentences
    assert readings[-1].number == 4


def test_a_source_that_hangs_is_told_and_left():
    hung = Event()
    reader = plain_reader(Scripted(frame(0), lambda _: hung.wait(10), frame(1)), reference=IMAGE, stall_s=0.05)
    with reader:
        stale = next(reading for reading in reader.readings() if reading.withheld)
        begun = time.monotonic()
    assert time.monotonic() - begun < 5  # it would hang for 10 s
    assert stale.withheld == "the fake has given no frame for 0.05 s; give it a push"
    assert stale.margin is None
    hung.set()


def test_frames_of_another_size_have_no_margin_until_they_are_as_before():
    readings = readings_of(frame(0), frame_of(np.zeros((24, 48, 3), dtype=np.uint8), 1), frame(2))
    assert [bool(reading.withheld) for reading in readings] == [False, True, False]
    assert "now 24 x 48 pixels, they were 48 x 48; set the camera as it was" in str(readings[1].withheld)


def test_a_reader_reads_once_and_only_while_it_is_entered():
    reader = plain_reader(Scripted(frame(0)), reference=IMAGE)
    with pytest.raises(InputError, match="enter the reader first"):
        next(reader.readings())
    with reader:
        list(reader.readings())
    with pytest.raises(InputError, match="a reader reads once"):
        reader.__enter__()


@pytest.mark.parametrize("jump_s", [-3.0, 0.0, 60.0, np.nan])
def test_a_clock_that_jumps_withholds_one_frame(jump_s: float):
    times = [5.0, 5.01, 5.01 + jump_s, 5.02 + jump_s]
    readings = readings_of(*(frame(number, time_s=time_s) for number, time_s in enumerate(times)))
    # a clock that tells nothing withholds all
    assert [bool(reading.withheld) for reading in readings] == [False, False, True, bool(np.isnan(jump_s))]
    assert "the clock of the fake jumped by" in str(readings[2].withheld)


# a network stream


def encode_stream(frames: int) -> bytes:
    """Frames that brighten, as MPEG-TS."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mpegts") as out:
        stream = out.add_stream("mpeg2video", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(frames):
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 4 * number, dtype=np.uint8), format="rgb24")
            out.mux(stream.encode(picture))
        out.mux(stream.encode(None))
    return buffer.getvalue()


def test_a_stream_is_read_and_its_end_is_told():
    images: list[LiveFrame] = []
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve() -> None:
            connection, _ = listening.accept()
            with connection:
                connection.sendall(encode_stream(60))

        server = Thread(target=serve)
        server.start()
        source = open_live(f"tcp://127.0.0.1:{listening.getsockname()[1]}")
        assert isinstance(source, CameraSource)
        with source, pytest.raises(SourceError, match="has ended; start the camera again"):
            images.extend(source.frames())
        server.join()
    assert source.size == (48, 64)
    assert [given.number for given in images] == list(range(len(images)))
    # what comes while the stream is looked at first is not kept; coded with loss
    assert len(images) >= 10
    np.testing.assert_allclose([given.image.mean() for given in images], 4 * np.arange(60)[-len(images) :], atol=4)


def test_a_stream_that_is_not_there_is_told():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(SourceError, match=r"the stream tcp://127.0.0.1:\d+ cannot be read .*check its address"):
        open_live(f"tcp://127.0.0.1:{port}").__enter__()


def test_a_stream_leads_to_no_file_of_this_machine(tmp_path: Path):
    (tmp_path / "list.m3u8").write_text("#EXTM3U\n")
    with pytest.raises(SourceError):
        CameraSource(f"file://{tmp_path}/list.m3u8", LiveOptions()).__enter__()


# cameras: FFmpeg opens a film in place of the device


class FakeCamera:
    """Camera of 64 x 48 pixels whose packets, in MJPEG, are a film: times in seconds, and bytes."""

    whole = encode_image(np.tile(np.arange(64, dtype=np.uint8)[:, None], (48, 1, 3)), jpeg_quality=95)

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.packets, self.formats, self.fails = [(0.0, self.whole)], {"mjpeg"}, list[OSError | None]()
        self.asked: list[dict[str, str]] = []
        self.open = av.open
        monkeypatch.setattr(sources.av, "open", self.play)

    def play(self, path: str, *, format: str, options: dict[str, str]) -> object:
        assert (path, format) == ("/dev/video0", "v4l2")
        self.asked.append(options)
        if self.fails and (failure := self.fails.pop(0)) is not None:
            raise failure
        if options.get("input_format", "yuyv422") not in self.formats:
            raise OSError(errno.EINVAL, "Invalid argument")
        film = io.BytesIO()
        with self.open(film, "w", format="matroska") as out:
            stream = out.add_stream("mjpeg", rate=50)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
            for time_s, data in self.packets:
                packet = av.Packet(data)
                packet.stream, packet.time_base = stream, Fraction(1, 1000)
                packet.pts = packet.dts = round(1000 * time_s)
                out.mux(packet)
        film.seek(0)
        return self.open(film, format="matroska")


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> FakeCamera:
    return FakeCamera(monkeypatch)


def test_a_camera_keeps_the_stamps_of_the_kernel_and_counts_what_is_lost(camera: FakeCamera):
    now_s = round(time.monotonic(), 3)
    camera.packets = [(now_s, camera.whole), (now_s + 0.02, b"torn"), (now_s + 0.06, camera.whole)]
    frames: list[LiveFrame] = []
    with open_live("0") as source, pytest.raises(SourceError, match="has ended"):
        frames.extend(source.frames())
    # the second was torn, and the third never came
    assert [frame.number for frame in frames] == [0, 3]
    assert [frame.time_s for frame in frames] == pytest.approx([now_s, now_s + 0.06])
    assert [frame.captured_s for frame in frames] == pytest.approx([now_s, now_s + 0.06])


@pytest.mark.parametrize("mjpg", [True, False])
@pytest.mark.parametrize(
    ("options", "asked", "size"),
    [
        (LiveOptions(), {}, (48, 64)),
        (LiveOptions(size=(24, 32), rate_hz=50.0), {"video_size": "32x24", "framerate": "50"}, (24, 32)),  # scaled down
        (LiveOptions(fit_size=(24, 32)), {"video_size": "32x24"}, (24, 32)),
        (LiveOptions(fit_size=(224, 224)), {"video_size": "224x224"}, (48, 64)),  # of another shape
    ],
)
def test_a_camera_is_asked_for_what_the_options_say(
    camera: FakeCamera, options: LiveOptions, asked: dict[str, str], size: tuple[int, int], mjpg: bool
):
    camera.formats = {"mjpeg", "yuyv422"} if mjpg else {"yuyv422"}
    with open_live("/dev/video0", options=options) as source:
        assert source.size == size
        assert next(iter(source.frames())).image.shape == (*size, 3)
    assert camera.asked == [{"input_format": "mjpeg"} | asked, *([] if mjpg else [asked])]


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EBUSY, "close that one"),
        (errno.EACCES, "group video"),
        (errno.EIO, "plug it in again"),
        (None, "gives 64x48 and not 100x100; choose a --size of the same shape and no larger"),
    ],
)
def test_a_camera_that_cannot_be_opened_says_why(camera: FakeCamera, number: int | None, words: str):
    camera.fails.extend([] if number is None else [OSError(number, os.strerror(number))] * 2)
    with pytest.raises(SourceError, match=words):
        open_live("0", options=LiveOptions(size=(100, 100))).__enter__()


def test_a_camera_that_is_unplugged_is_read_again_when_it_is_back(camera: FakeCamera):
    camera.fails = [None, *([OSError(errno.ENODEV, "No such device")] * 20)]
    withheld: list[str | None] = []
    reader = plain_reader("0", reference=np.zeros((48, 64, 3), np.uint8), stall_s=0.05)
    reader.subscribe(lambda reading, _: withheld.append(reading.withheld))
    with reader:
        while len(camera.asked) < 24:  # opened again
            time.sleep(0.01)
    assert withheld[0] is None
    assert "the camera /dev/video0 was unplugged; plug it in again" in withheld


def test_cameras_are_listed_by_name(tmp_path: Path):
    for number in (10, 2):
        (tmp_path / f"video{number}").mkdir()
        (tmp_path / f"video{number}" / "name").write_text(f"tip {number}\n")
    assert list(list_cameras(tmp_path).items()) == [("/dev/video2", "tip 2"), ("/dev/video10", "tip 10")]
