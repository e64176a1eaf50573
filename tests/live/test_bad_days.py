"""Sources that misbehave: one clear sentence, and the loop goes on where it can."""

import errno
import io
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from threading import Event, Thread
from types import SimpleNamespace

import av
import numpy as np
import pytest
from PIL import Image

import sliplens as sl
from sliplens.errors import InputError, SourceError
from sliplens.images import write_png
from sliplens.live import FolderSource, LiveOptions, StreamSource, list_cameras, loop, open_live, sources
from sliplens.live.contract import LiveSource
from sliplens.live.reading import LiveFrame, Reading
from sliplens.live.sources import FrameDecoder

plain_reader = partial(sl.LiveReader, health=None, slip=None)
"""What is captured and read, without judging it."""
IMAGE = np.tile(np.arange(48, dtype=np.uint8)[:, None, None], (1, 48, 3))
Act = Callable[["Wicked"], LiveFrame | None]


def frame(number: int, *, time_s: float | None = None, image: np.ndarray = IMAGE) -> Act:
    """Give a frame once the one before was read."""

    def act(source: "Wicked") -> LiveFrame:
        assert source.read.wait(timeout=10)
        source.read.clear()
        time_now_s = 0.01 * number if time_s is None else time_s
        return LiveFrame(image=image, number=number, time_s=time_now_s, captured_s=time.monotonic())

    return act


def lost(source: "Wicked") -> None:
    raise SourceError(f"{source.name} was unplugged; plug it in again")


def lost_once_read(source: "Wicked") -> None:
    assert source.read.wait(timeout=10)
    lost(source)


def hang(source: "Wicked") -> None:
    source.hung.wait(timeout=10)


class Wicked(LiveSource):
    """Does what a script says, line after line, also after it was opened again."""

    name, cure = "the fake", "give it a push"
    sizes: tuple[tuple[int, int], ...] = ((48, 48),)
    """Sizes of its frames, by how often it was opened."""

    def __init__(self, *script: Act, reconnects: bool = True, refuses: int = 0) -> None:
        self.script, self.reconnects, self.refuses = list(script), reconnects, refuses
        self.read, self.hung, self.opened = Event(), Event(), 0
        self.read.set()

    def __enter__(self) -> "Wicked":
        self.opened += 1
        self.size = self.sizes[min(self.opened, len(self.sizes)) - 1]
        if 1 < self.opened <= 1 + self.refuses:
            raise SourceError(f"{self.name} is not there; plug it in")
        return self

    def frames(self) -> Iterator[LiveFrame]:
        while self.script:
            given = self.script.pop(0)(self)
            if given is not None:
                yield given


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "_RETRY_S", 0.01)
    monkeypatch.setattr(loop, "_PATIENCE_S", 0.2)


def readings_of(source: Wicked, *, stall_s: float = 5.0) -> list[Reading]:
    heard: list[Reading] = []

    def next_one(reading: Reading, _: LiveFrame | None) -> None:
        heard.append(reading)
        source.read.set()

    reader = plain_reader(source, reference=IMAGE, stall_s=stall_s)
    reader.subscribe(next_one)
    with reader:
        list(reader.readings())
    return heard


def test_a_source_that_is_lost_is_opened_again_until_it_is_back():
    source = Wicked(frame(0), lost, frame(0, time_s=7.0), frame(1, time_s=7.01), refuses=2)
    readings = readings_of(source)
    assert source.opened == 4
    assert [reading.number for reading in readings] == [0, 0, 1]
    assert readings[-1].withheld is None


def test_while_a_source_is_away_readings_say_so():
    def back(source: Wicked) -> LiveFrame | None:
        source.read.clear()  # only once somebody was told that it was away
        return frame(4)(source)

    readings = readings_of(Wicked(frame(3), lost_once_read, back), stall_s=0.05)
    sentences = [reading.withheld for reading in readings if reading.number == 3]
    assert sentences[0] is None
    assert "the fake was unplugged; plug it in again" in sentences
    assert readings[-1].number == 4


def test_a_source_that_hangs_is_told_and_left():
    source = Wicked(frame(0), hang, frame(1))
    reader = plain_reader(source, reference=IMAGE, stall_s=0.05)
    with reader:
        stale = next(reading for reading in reader.readings() if reading.withheld)
        begun = time.monotonic()
    assert time.monotonic() - begun < 5  # it would hang for 10 s
    assert stale.withheld == "the fake has given no frame for 0.05 s; give it a push"
    assert stale.margin is None
    source.hung.set()


def test_frames_of_another_size_have_no_margin_until_they_are_as_before():
    other = np.zeros((24, 48, 3), dtype=np.uint8)
    readings = readings_of(Wicked(frame(0), frame(1, image=other), frame(2)))
    assert [bool(reading.withheld) for reading in readings] == [False, True, False]
    assert "now 24 x 48 pixels, they were 48 x 48; set the camera as it was" in str(readings[1].withheld)


def test_a_reader_reads_once_and_only_while_it_is_entered():
    reader = plain_reader(Wicked(frame(0)), reference=IMAGE)
    with pytest.raises(InputError, match="enter the reader first"):
        next(reader.readings())
    with reader:
        list(reader.readings())
    with pytest.raises(InputError, match="a reader reads once"):
        reader.__enter__()


@pytest.mark.parametrize("jump_s", [-3.0, 0.0, 60.0, np.nan])
def test_a_clock_that_jumps_withholds_one_frame(jump_s: float):
    times = [5.0, 5.01, 5.01 + jump_s, 5.02 + jump_s]
    readings = readings_of(Wicked(*(frame(number, time_s=time_s) for number, time_s in enumerate(times))))
    # a clock that tells nothing withholds all
    assert [bool(reading.withheld) for reading in readings] == [False, False, True, bool(np.isnan(jump_s))]
    assert "the clock of the fake jumped by" in str(readings[2].withheld)


# a growing folder


def test_a_folder_gives_its_newest_image_and_those_to_come(tmp_path: Path):
    for number in (1, 2, 10):
        write_png(tmp_path / f"{number}.png", np.full((8, 6, 3), number, dtype=np.uint8))
    with open_live(tmp_path) as source:
        assert (source.name, source.size) == (f"the folder {tmp_path}", (8, 6))
        frames = source.frames()
        assert next(frames).image[0, 0, 0] == 10
        write_png(tmp_path / "11.png", np.full((8, 6, 3), 11, dtype=np.uint8))
        grown = next(frames)
        assert (grown.number, grown.image[0, 0, 0]) == (1, 11)
        source.close()
        assert list(frames) == []


def test_an_image_that_is_half_written_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sources, "_WRITTEN_S", 60.0)  # however late the rest comes
    write_png(tmp_path / "1.png", IMAGE)
    whole = (tmp_path / "1.png").read_bytes()
    with FolderSource(tmp_path) as source:
        frames = source.frames()
        next(frames)
        (tmp_path / "2.png").write_bytes(whole[:200])
        end = Thread(target=lambda: (time.sleep(0.1), (tmp_path / "2.png").write_bytes(whole)))
        end.start()
        np.testing.assert_array_equal(next(frames).image, IMAGE)
        end.join()


def test_an_image_that_stays_damaged_is_missing_in_the_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sources, "_WRITTEN_S", 0.05)
    write_png(tmp_path / "1.png", IMAGE)
    with FolderSource(tmp_path) as source:
        frames = source.frames()
        next(frames)
        (tmp_path / "2.png").write_bytes(b"no image")
        write_png(tmp_path / "3.png", IMAGE)
        assert next(frames).number == 2


def test_a_folder_that_is_removed_is_told(tmp_path: Path):
    folder = tmp_path / "frames"
    folder.mkdir()
    write_png(folder / "1.png", IMAGE)
    with FolderSource(folder) as source:
        frames = source.frames()
        next(frames)
        (folder / "1.png").unlink()
        folder.rmdir()
        with pytest.raises(SourceError, match=r"cannot be read .*; make it again, and begin anew"):
            next(frames)


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
        assert isinstance(source, StreamSource)
        with source, pytest.raises(SourceError, match="has ended; start the camera again"):
            images.extend(source.frames())
        server.join()
    assert source.size == (48, 64)
    assert [given.number for given in images] == list(range(len(images)))
    # what comes while the stream is looked at first is not kept; coded with loss
    assert len(images) >= 10
    np.testing.assert_allclose([given.image.mean() for given in images], 4 * np.arange(60)[-len(images) :], atol=4)


def test_a_stream_that_is_not_there_is_told(unused_port: int):
    with pytest.raises(SourceError, match=r"the stream tcp://127.0.0.1:\d+ cannot be read .*check its address"):
        StreamSource(f"tcp://127.0.0.1:{unused_port}").__enter__()


def test_a_stream_leads_to_no_file_of_this_machine(tmp_path: Path):
    (tmp_path / "list.m3u8").write_text("#EXTM3U\n")
    with pytest.raises(SourceError):
        StreamSource(f"file://{tmp_path}/list.m3u8").__enter__()


# cameras, as the kernel would show them


def jpeg(image: np.ndarray, **options: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", **options)
    return buffer.getvalue()


def smooth(height: int, width: int) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows, columns, 255 - rows], axis=-1).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("wanted", [(96, 128), (48, 64), (24, 32)])
def test_a_jpeg_is_decoded_as_pillow_does_it_and_scaled_down(wanted: tuple[int, int]):
    image = smooth(96, 128)
    data = jpeg(image, quality=95)
    decoded = FrameDecoder("MJPG", size=(96, 128), wanted=wanted).decode(data)
    assert decoded is not None
    step = 96 // wanted[0]
    blocks = image.reshape(wanted[0], step, wanted[1], step, 3).mean(axis=(1, 3))
    # two ways to interpolate colour, and JPEG's own loss: some grey levels
    assert np.abs(decoded - blocks).mean() < 3


@pytest.mark.parametrize("data", [b"", b"garbage" * 50, jpeg(smooth(48, 64))[:300]])
def test_garbage_is_no_frame(data: bytes):
    decoder = FrameDecoder("MJPG", size=(48, 64))
    assert decoder.decode(data) is None
    assert decoder.decode(jpeg(smooth(48, 64))) is not None


def test_padded_rows_of_a_camera_are_left_out():
    image = smooth(4, 6)
    padded = np.zeros((4, 20), dtype=np.uint8)
    padded[:, :18] = image.reshape(4, 18)
    decoded = FrameDecoder("RGB3", size=(4, 6)).decode(padded.tobytes(), row_bytes=20)
    np.testing.assert_array_equal(decoded, image)


MONOTONIC, ERROR = 0x2000, 0x40


class FakeDriver:
    """What linuxpy asks of the kernel, with two modes, frames that are sent by hand, and errors on demand."""

    def __init__(self) -> None:
        self.sent: list[SimpleNamespace | OSError] = []
        self.refuses: OSError | None = None
        self.chosen: tuple[int, int, str] = (480, 640, "MJPG")
        self.opened = 0

    def send(self, data: bytes, *, number: int, stamp_s: float, flags: int = MONOTONIC) -> None:
        from linuxpy.video.device import BufferFlag  # noqa: PLC0415 (an extra)

        self.sent.append(SimpleNamespace(data=data, frame_nb=number, timestamp=stamp_s, flags=BufferFlag(flags)))

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from linuxpy.video import device  # noqa: PLC0415 (an extra)

        driver = self

        def fourcc(name: str) -> SimpleNamespace:
            return SimpleNamespace(human_str=lambda: name)

        class Device:
            def __init__(self, _: Path) -> None:
                kinds = [("YUYV", 480, 640, 30), ("MJPG", 480, 640, 60), ("MJPG", 96, 128, 60), ("MJPG", 480, 640, 30)]
                modes = [
                    SimpleNamespace(pixel_format=fourcc(name), height=height, width=width, max_fps=rate)
                    for name, height, width, rate in kinds
                ]
                takes = device.Capability.VIDEO_CAPTURE
                self.info = SimpleNamespace(frame_types=modes, device_capabilities=takes, card="A camera")

            def __enter__(self) -> "Device":
                if driver.refuses is not None:
                    raise driver.refuses
                driver.opened += 1
                self.ends = os.pipe()
                os.write(self.ends[1], b"always ready")
                return self

            def __exit__(self, *_: object) -> None:
                for end in self.ends:
                    os.close(end)

            def fileno(self) -> int:
                return self.ends[0]

        class VideoCapture(nullcontext):
            def __init__(self, opened: Device, size: int) -> None:
                super().__init__(opened)
                assert size > 2
                self.buffer, self.set_fps, self.get_fps = self, lambda _: None, lambda: 60.0

            def set_format(self, width: int, height: int, pixel_format: str) -> None:
                driver.chosen = (height, width, pixel_format)

            def get_format(self) -> SimpleNamespace:
                height, width, name = driver.chosen
                return SimpleNamespace(height=height, width=width, pixel_format=fourcc(name), bytes_per_line=0)

            def raw_read(self) -> SimpleNamespace:
                if not driver.sent:
                    raise BlockingIOError
                sent = driver.sent.pop(0)
                if isinstance(sent, OSError):
                    raise sent
                return sent

        monkeypatch.setattr(device, "Device", Device)
        monkeypatch.setattr(device, "VideoCapture", VideoCapture)


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> FakeDriver:
    pytest.importorskip("linuxpy")
    fake = FakeDriver()
    fake.install(monkeypatch)
    return fake


def test_a_camera_keeps_the_stamps_and_numbers_of_the_kernel(driver: FakeDriver):
    now_s = time.monotonic()
    data = jpeg(smooth(480, 640))
    driver.send(data, number=4, stamp_s=now_s - 0.02)
    driver.send(b"torn", number=5, stamp_s=now_s)
    driver.send(data, number=6, stamp_s=now_s, flags=MONOTONIC | ERROR)
    driver.send(data, number=7, stamp_s=now_s + 0.02)
    with open_live("0") as source:
        assert (source.size, source.rate_hz) == ((480, 640), 60.0)
        frames = source.frames()
        first, second = next(frames), next(frames)
    assert (first.number, second.number) == (4, 7)
    assert (first.time_s, first.captured_s) == (now_s - 0.02, now_s - 0.02)


@pytest.mark.parametrize(
    ("options", "chosen", "size"),
    [
        (LiveOptions(), (480, 640, "MJPG"), (480, 640)),
        (LiveOptions(size=(96, 128)), (96, 128, "MJPG"), (96, 128)),
        (LiveOptions(size=(240, 320)), (480, 640, "MJPG"), (240, 320)),  # decoded scaled down
        (LiveOptions(fit_size=(240, 320)), (480, 640, "MJPG"), (240, 320)),
        (LiveOptions(fit_size=(224, 224)), (480, 640, "MJPG"), (480, 640)),  # of another shape: the network says so
        (LiveOptions(pixel_format="YUYV", size=(480, 640)), (480, 640, "YUYV"), (480, 640)),
    ],
)
def test_the_mode_of_a_camera_suits_the_wishes(
    driver: FakeDriver, options: LiveOptions, chosen: tuple[int, int, str], size: tuple[int, int]
):
    with open_live("/dev/video0", options=options) as source:
        assert source.size == size
    assert driver.chosen == chosen


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (LiveOptions(size=(100, 100)), "has no mode that gives 100x100 .*128x96, 640x480"),
        (LiveOptions(size=(480, 640), rate_hz=200.0), "or a lower --rate"),
        (LiveOptions(pixel_format="H264"), "has no format H264; choose MJPG, YUYV with --pixel-format"),
    ],
)
def test_a_mode_that_a_camera_has_not_is_told(driver: FakeDriver, options: LiveOptions, words: str):
    with pytest.raises(SourceError, match=words):
        open_live("0", options=options).__enter__()
    assert driver.opened == 1


def test_a_camera_that_is_unplugged_is_read_again_when_it_is_back(driver: FakeDriver):
    data, begun_s = jpeg(IMAGE), time.monotonic()
    driver.chosen = (48, 48, "MJPG")
    driver.send(data, number=8, stamp_s=begun_s)
    driver.sent.append(OSError(errno.ENODEV, "No such device"))
    numbers = []
    with plain_reader("0", reference=IMAGE, seconds=10.0) as reader:
        for reading in reader.readings():
            numbers.append(reading.number)
            if len(numbers) == 2:
                break
            driver.send(data, number=0, stamp_s=begun_s + 0.5)
    assert numbers == [8, 0]
    assert driver.opened == 2


def test_a_camera_that_sends_garbage_alone_says_so(driver: FakeDriver):
    for number in range(40):
        driver.send(b"garbage", number=number, stamp_s=float(number))
    with open_live("0") as source, pytest.raises(SourceError, match="sends frames that cannot be decoded"):
        list(source.frames())


def test_a_camera_that_is_silent_says_so(driver: FakeDriver, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sliplens.live.sources._STALL_S", 0.05)
    with open_live("0") as source, pytest.raises(SourceError, match=r"has given no frame for 0\.05 s"):
        list(source.frames())
    assert driver.opened == 1


def test_cameras_are_listed_with_their_modes(driver: FakeDriver, tmp_path: Path):
    for name in ("video10", "video2", "null"):
        (tmp_path / name).touch()
    cameras = list_cameras(tmp_path)
    assert [camera.path.name for camera in cameras] == ["video2", "video10"]
    told = [(mode.pixel_format, mode.size, mode.rates_hz) for mode in cameras[0].modes]
    assert told == [("MJPG", (96, 128), (60.0,)), ("MJPG", (480, 640), (60.0, 30.0)), ("YUYV", (480, 640), (30.0,))]
    driver.refuses = OSError(errno.EBUSY, "Device or resource busy")
    assert list_cameras(tmp_path)[0].name == "cannot be opened (Device or resource busy)"


@pytest.fixture
def unused_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
