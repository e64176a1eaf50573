"""`sliplens live`."""

import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sliplens.cli.command import Device
from sliplens.cli.console import print_table, say

if TYPE_CHECKING:
    from sliplens.live import LiveReader, Reading, SourceOptions

_SOURCE = "simulated, the number of a camera, the address of a stream, or a video, bag, data set or growing folder."


def _parse_size(text: str | None) -> tuple[int, int] | None:
    from sliplens.errors import InputError

    if text is None:
        return None
    width, times, height = text.lower().partition("x")
    if not (times and width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size is {text!r}; give width and height as 640x480")
    return int(height), int(width)


@dataclass(frozen=True, kw_only=True)
class Live:
    """Read the safety margin of a running sensor, frame by frame.

    Without a source it is a simulated fingertip that grips, pulls until it slips, and lets go. Ends with its source,
    after --seconds, or with Ctrl-C.
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE", help=_SOURCE)] = "simulated"
    network: str | None = None
    """Folder of a trained network, or the name of one that comes with sliplens: chromatouch-difference for the
    simulated fingertip; none if not given."""
    reference: Path | None = None
    """Image of the untouched sensor; taken when the picture is still at first if not given."""
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
    """Where readings go: json prints a line of JSON for each. Without one, a line a second is printed."""
    engine: Literal["auto", "eager", "folded", "compiled", "onnxruntime", "openvino"] = "auto"
    """What runs the network; auto is the fastest at hand."""
    device: Device = "cpu"

    def run(self) -> None:
        """Read until the source ends."""
        from sliplens.live import LiveReader
        from sliplens.live.sinks import open_sink

        if self.list:
            self._list()
            return
        shipped = "chromatouch-difference" if self.source in {"simulated", "simulated:chromatouch"} else None
        with ExitStack() as stack:
            sinks = [open_sink(name) for name in self.sink]
            for sink in sinks:
                stack.callback(sink.close)
            reader = LiveReader(
                self.source,
                self.network or shipped,
                reference=self.reference,
                options=self._options(),
                engine=self.engine,
                device=self.device,
                smoothing_s=self.smoothing,
                seconds=self.seconds,
            )
            for sink in sinks:
                reader.subscribe(lambda reading, frame, sink=sink: sink.send(reading, frame and frame.image))
            try:
                with reader:
                    self._watch(reader)
            except KeyboardInterrupt:
                return  # the way to end it

    def _options(self) -> "SourceOptions":
        from sliplens.live import SourceOptions

        return SourceOptions(
            rate_hz=self.rate,
            speed=self.speed,
            trial=self.trial,
            size=_parse_size(self.size),
            pixel_format=self.pixel_format,
        )

    def _watch(self, reader: "LiveReader") -> None:
        told_s = -1.0
        for reading in reader.readings():
            if not self.sink and time.monotonic() - told_s >= 1:
                told_s = time.monotonic()
                say(_in_words(reading))

    def _list(self) -> None:
        from sliplens.live import SOURCES, list_cameras

        rows = [
            (str(camera.path), camera.name, mode.pixel_format, f"{mode.size[1]}x{mode.size[0]}", _rates(mode.rates_hz))
            for camera in list_cameras()
            for mode in camera.modes
        ]
        if rows:
            print_table("Cameras", ("device", "name", "format", "size", "frames/s"), rows)
        else:
            say("no camera is there that can be read")
        for kind in SOURCES.values():
            say(f"  {kind.words}")


def _rates(rates_hz: tuple[float, ...]) -> str:
    return ", ".join(f"{rate:g}" for rate in rates_hz) or "not told"


def _in_words(reading: "Reading") -> str:
    """One line for people."""
    if reading.margin is None:
        told = f"no margin: {reading.withheld}" if reading.withheld else "no network"
    else:
        told = f"margin {reading.margin:4.0%}"
        if reading.low is not None and reading.high is not None:
            told += f" ({reading.low:.0%} to {reading.high:.0%})"
    return f"{reading.time_s:8.2f} s  {told}  {reading.latency.total_ms:.0f} ms, {reading.dropped} dropped"
