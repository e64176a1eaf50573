"""`sliplens live`."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sliplens.cli.command import Device, Friction, InOrder, SameObject
from sliplens.cli.console import print_table, say

if TYPE_CHECKING:
    from sliplens.live import LiveReader
    from sliplens.live.loop import ReaderSettings
    from sliplens.recordings import TrialFacts

_SOURCE = "simulated, grip, number of a camera, address of a stream, or a video, bag, data set or growing folder."


@dataclass(frozen=True, kw_only=True)
class Live:
    """Read the safety margin of a running sensor, frame by frame.

    Without a source it is a simulated fingertip to press and pull in a browser; its page is at the address that is
    printed. Ends with Ctrl-C or after --seconds; with --no-page or --sink also when the source ends.
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[SOURCE]", help=_SOURCE)] = "simulated"
    network: str | None = None
    """Folder or name of a trained network. If not given, that of the profile; chromatouch-pair for what is
    simulated, else none."""
    reference: Path | None = None
    """Image of the untouched sensor; taken when the picture is still at first if not given."""
    friction: Friction = None
    same_object: SameObject = False
    sequence: InOrder = False
    list: bool = False
    """List the cameras with their formats, sizes and rates, and what else can be read, and end."""
    rate: float | None = None
    """Frames a second."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WIDTHxHEIGHT")] = None
    """Size of the frames of a camera or stream; larger ones are scaled down."""
    pixel_format: str | None = None
    """Format of a camera, such as MJPG or YUYV."""
    speed: float | None = None
    """How many times faster than it was recorded something is replayed."""
    trial: str | None = None
    """Trial of a data set or bag; the first if not given."""
    seconds: float | None = None
    """Time after which it ends."""
    smoothing: float = 0.0
    """Time constant in seconds of a low-pass on margin and interval, which delays them by so much; 0 for none."""
    sink: tuple[str, ...] = ()
    """Where readings go: json (lines on standard output), udp:HOST:PORT, mcap:FILE, foxglove:HOST:PORT, rerun:FILE,
    zenoh:KEY (to ROS 2). Without one, a line a second is printed."""
    page: bool = True
    """Show it in browsers, with buttons to freeze, explain and record."""
    host: str = "127.0.0.1"
    """Where the page listens; 0.0.0.0 for all machines, which need the token of the address that is printed."""
    port: int | None = None
    """Port of the page; 8090 if not given."""
    record: Path | None = None
    """Data set to record every frame into, from the start on; the page's button records into `recorded` without it."""
    forces: Path | None = None
    """File or named pipe into which another program writes force samples (time_s,fx,fy,fz), to be recorded too."""
    sensor: str = ""
    """Profile of the sensor, a file or a name such as digit; or its name alone, for the recording."""
    object: str = ""
    """Name of what is held, for the recording."""
    condition: str = "dry"
    """dry or wet, for the recording."""
    day: int = 1
    """Day of the recording."""
    engine: Literal["auto", "torch", "openvino"] = "auto"
    """Engine of the network; auto is the fastest at hand."""
    device: Device = "cpu"

    def run(self) -> None:
        """Read until the source ends."""
        from sliplens.grip.source import open_grip, usual_network
        from sliplens.live import LiveReader
        from sliplens.live.contract import LiveOptions, parse_size
        from sliplens.recordings import TrialFacts
        from sliplens.recordings.sensor import is_profile, load_profile

        if self.list:
            self._list()
            return
        options = LiveOptions(
            rate_hz=self.rate,
            size=parse_size(self.size),
            speed=self.speed,
            trial=self.trial,
            pixel_format=self.pixel_format,
        )
        profile = load_profile(self.sensor) if is_profile(self.sensor) else None
        grip = open_grip(self.source, options)
        source = self.source if grip is None else grip
        settings: ReaderSettings = {
            "reference": self.reference,
            "options": options if grip is None else None,
            "sensor": profile,
            "friction": self.friction,
            "same_object": self.same_object,
            "sequence": self.sequence,
            "engine": self.engine,
            "device": self.device,
            "smoothing_s": self.smoothing,
            "seconds": self.seconds,
            "forces": self.forces,
        }
        facts = TrialFacts(trial="live", sensor=self.sensor, object=self.object, condition=self.condition, day=self.day)
        with ExitStack() as stack:
            network = self.network or usual_network(source, profile)
            reader = stack.enter_context(closing(LiveReader(source, network, **settings)))
            reader.send_to(*self.sink)
            if self.record is not None:
                reader.record(self.record, facts=facts)
            stack.callback(lambda: [say(str(state), aside=True) for state in reader.outputs])
            stack.callback(lambda: reader.lesson and say(reader.lesson, aside=True))
            with suppress(KeyboardInterrupt), reader, self._serve_page(reader, facts):  # Ctrl-C ends it
                self._print(reader)

    @contextmanager
    def _serve_page(self, reader: "LiveReader", facts: "TrialFacts") -> Iterator[None]:
        """Serve the page; without --seconds or --sink it stays when the source has ended."""
        if not self.page:
            yield
            return
        from sliplens.app import LivePage

        into = self.record or Path("recorded")
        with LivePage(reader, host=self.host, port=self.port, record_into=into, facts=facts) as page:
            say(f"open {page.address}", aside=True)
            yield
            if self.seconds is None and not self.sink:
                say(f"{reader.source.name} has ended; the page stays until Ctrl-C", aside=True)
                Event().wait()

    def _print(self, reader: "LiveReader") -> None:
        """Print a reading and new troubles every second."""
        printed_s, printed = -1.0, set[str]()
        for reading in reader.readings():
            if time.monotonic() - printed_s >= 1:
                printed_s = time.monotonic()
                for error in () if self.page else (sender.error for sender in reader.senders if sender.error):
                    raise error
                for words in {*reader.doubts, *reader.troubles} - printed:
                    printed.add(words)
                    say(words, aside=True)
                if not self.sink:
                    say(str(reading))

    def _list(self) -> None:
        from sliplens.live import SOURCES, list_cameras

        rows = [(str(camera.path), camera.name, *mode.in_words()) for camera in list_cameras() for mode in camera.modes]
        columns = ("device", "name", "format", "size", "frames/s")
        print_table("Cameras", columns, rows) if rows else say("no camera is there that can be read")
        for words in ("simulated gripper that holds (grip, or grip:egg)", *(kind.words for kind in SOURCES.values())):
            say(f"  {words}")
