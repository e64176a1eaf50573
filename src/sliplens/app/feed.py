"""Feed of the page, made once for all connected browsers: what each is sent, and what its buttons do."""

import asyncio
import gc
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from threading import Event, Lock, Thread
from typing import TypeAlias, TypeVar

import msgspec
import numpy as np
from PIL import Image
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from sliplens.errors import InputError, SliplensError
from sliplens.explainers.explain import choose_explainers, explain_frames
from sliplens.explainers.frames import frames_from_arrays
from sliplens.explainers.table import EXPLAINERS, RECOMMENDED_METHOD
from sliplens.extras import pick
from sliplens.files import to_builtins
from sliplens.grip.controllers import CONTROLLERS
from sliplens.grip.source import GripSource
from sliplens.images import encode_image
from sliplens.live.contract import LiveSource
from sliplens.live.health import CHECKS
from sliplens.live.loop import LiveReader
from sliplens.live.reading import NO_NETWORK, TARGET, LiveFrame, Reading, SlipState, describe_reading
from sliplens.live.sources import SimulatedSource
from sliplens.models.checkpoint import Network
from sliplens.recordings.capture import Frame
from sliplens.recordings.trial import TrialFacts
from sliplens.results.explanation import CLOSE, full_colour

CHART_S = 30.0
"""Time that the chart of the page spans, in seconds."""
LIVE_METHOD = "grad-cam"
"""Explainer of the running picture, one of the fastest; any other explains a frozen one."""
_PICTURES_HZ, _MAPS_HZ = 30.0, 2.0
_LONGEST_PX = 800
_QUALITY = 85
_START_SHEAR, _STICK_SHARE, _LEAST_STICK = 0.0025, 0.97, 0.9
"""Frames before the pull: largest shear in heights of the frame, least share of the contact's largest margin, and
least margin at all."""
_PATIENCE_S = 10.0  # with a thread that is to end
_UNANSWERED = 2  # messages under way to one client: one is drawn while the next one travels
_KEEP_ALIVE_S = 1.0  # the page takes a longer silence for a lost connection
_RATE_S = 2.0
_LARGEST = {"press_n": 3.0, "pull_n": 2.4, "water_kg": 0.06, "grip_pull_n": 0.6}  # ends of the sliders
_STILL = "waiting for a still picture: leave the sensor untouched"
_Source = TypeVar("_Source", bound=LiveSource)


Point: TypeAlias = dict[str, float | None]
"""A reading on the chart: `at_s` as `time.monotonic` counts, margins, shear in pixels, forces of a simulated gripper in
newtons; None where there is none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PageFrame:
    """Frame as the page shows it, with its reading."""

    reading: Reading
    frame: LiveFrame
    start: LiveFrame | None = None
    """Last frame of the same contact before the pull, where that is known."""
    reference: Frame | None = None
    """The sensor untouched, with which the frame was compared."""
    markers_px: tuple[np.ndarray, np.ndarray] | None = None
    """Places of the markers at rest and in the frame."""

    @cached_property
    def jpeg(self) -> bytes:
        """Frame, smaller where it is large."""
        thumbnail = Image.fromarray(self.frame.image)
        thumbnail.thumbnail((_LONGEST_PX, _LONGEST_PX), reducing_gap=1.0)
        return encode_image(np.asarray(thumbnail), jpeg_quality=_QUALITY)

    @cached_property
    def arrows(self) -> list[list[float]]:
        """Markers that are seen: x and y at rest, then now, in pixels."""
        ways = np.empty((0, 4)) if self.markers_px is None else np.column_stack(self.markers_px).round(1)
        return ways[np.isfinite(ways[:, 2])].tolist()


class Map(msgspec.Struct, frozen=True, kw_only=True):
    """Relevance of a frame's pixels; margins and relevance in margin units."""

    number: int
    """Frame that is explained."""
    method: str
    baseline: int | None
    """Frame with which it is compared, the last before the pull; None for the untouched sensor."""
    baseline_prediction: float
    shape: tuple[int, ...]
    """Number of rows and columns."""
    full: float
    """Relevance of a cell of 127."""
    alike: bool
    """True where both margins are the same but for the network's error, so that there is nothing to explain."""
    warnings: tuple[str, ...]
    cells: bytes
    """Signed bytes, row by row."""


class Feed:
    """Readings, pictures and maps of a reader that is entered, for any number of clients.

    Everything is made once, in threads of its own, and only while a client waits for it: a client that does not answer
    is sent no more, and delays no other.
    """

    def __init__(self, reader: LiveReader) -> None:
        self.reader = reader
        self.clients: set[Client] = set()
        """Connected clients."""
        self.reading: Reading | None = None
        """Newest reading."""
        self.controls: Mapping[str, float | str] | None = None
        """State of the simulated fingertip or gripper: what acts, whoever moved the sliders."""
        self.picture: PageFrame | None = None
        """Newest picture."""
        self.map: Map | None = None
        """Newest map of the running picture."""
        self.ended: str | None = None
        """Why no more readings come; None while they may."""
        self._points: list[Point] = []
        self._newest: PageFrame | None = None  # newest frame; a picture once it is drawn
        self._start: LiveFrame | None = None
        self._largest = 0.0
        self._closed = Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._explaining = Lock()
        # explainers hook into the network: a copy, not the one that predicts
        network = reader.network
        self._network: Network | None = None if network is None else replace(network, model=deepcopy(network.model))
        jobs = [self._run] if network is None else [self._run, self._make_maps]
        self._threads = [Thread(target=job, name="page", daemon=True) for job in jobs]

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        """Begin; clients are served in this loop, which runs in the thread that calls."""
        self._loop = loop
        self._end_subscription = self.reader.subscribe(self._take)
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Make nothing more; the reader goes on."""
        self._closed.set()
        self._end_subscription()
        for thread in self._threads:
            if thread.is_alive():  # one that is in OpenCV as the interpreter ends aborts the process
                thread.join(_PATIENCE_S)

    def points_since(self, at_s: float) -> tuple[Point, ...]:
        """Return the points of the chart after a time, as `time.monotonic` counts."""
        return tuple(point for point in self._points if (point["at_s"] or 0.0) > at_s)

    def _take(self, reading: Reading, frame: LiveFrame | None) -> None:
        """Note a reading, in the thread that reads: nothing is drawn here."""
        now_s, source = time.monotonic(), self.reader.source
        grip = source.status(reading.number) if isinstance(source, GripSource) else None
        if grip is not None and isinstance(source, GripSource):
            sliders = {"water_kg": source.water_kg, "pull_n": source.pull_n, "wet": source.wet}
            self.controls = {"kind": "gripper", **asdict(grip), **sliders, "chosen": source.controller}
        elif isinstance(source, SimulatedSource) and frame is not None and frame.forces is not None:
            x_n, y_n, press_n = frame.forces.force_n[-1].tolist()
            forces = {"press_n": press_n, "pull_n": float(np.hypot(x_n, y_n))}
            self.controls = {"kind": "fingertip", **forces, "wanted_n": source.forces_n(reading.time_s)[1]}
        point = {name: getattr(reading, name) for name in ("margin", "low", "high", "true_margin")}
        point |= {name: getattr(grip, name, None) for name in ("force_n", "least_force_n")}
        point |= {"at_s": now_s, "shear_px": getattr(reading.markers, "shear_px", None)}
        # another list, for threads that walk through this one
        self._points = [*self.points_since(now_s - CHART_S), point]
        self.reading, self._newest = reading, None
        if frame is not None:
            self._note_start(reading, frame)
            sensor = {"reference": self.reader.reference, "markers_px": self.reader.markers_px}
            self._newest = PageFrame(reading=reading, frame=frame, start=self._start, **sensor)

    def _note_start(self, reading: Reading, frame: LiveFrame) -> None:
        """Keep the last frame of the contact before the pull: its markers show no shear, its margin is the largest."""
        markers, margin = reading.markers, reading.margin
        if markers is None or not markers.contact or markers.shear_px is None:
            self._start, self._largest = None, 0.0
        elif markers.shear_px > _START_SHEAR * frame.size[0] or reading.slip is SlipState.SLIP:
            self._largest = np.inf  # the pull has begun
        elif margin is not None and margin >= max(_STICK_SHARE * self._largest, _LEAST_STICK):
            self._start, self._largest = frame, max(margin, self._largest)

    def _run(self) -> None:
        """Draw the newest reading, until there are no more."""
        drawn_s = -np.inf
        try:
            for _ in self.reader.readings():
                if self._closed.is_set():
                    return
                if time.monotonic() - drawn_s < 0.7 / _PICTURES_HZ:  # frames that come as fast are never early
                    continue
                drawn_s, newest = time.monotonic(), self._newest
                if newest is not None and any(client.wants_picture for client in tuple(self.clients)):
                    _ = newest.jpeg, newest.arrows  # made in this thread
                    self.picture = newest
                self._wake()
            self.ended = f"{self.reader.source.name} has ended"
        except Exception as error:  # whatever it was: the page must not show the last margin as a new one
            self.ended = str(error) or type(error).__name__
        if self.reading is not None:
            self.reading = replace(self.reading, margin=None, low=None, high=None, slip=None, withheld=self.ended)
        self._wake()

    def _wake(self) -> None:
        assert self._loop is not None
        with suppress(RuntimeError):  # the server has gone
            self._loop.call_soon_threadsafe(lambda: [client.wake() for client in tuple(self.clients)])

    def _make_maps(self) -> None:
        """Explain the newest picture at a few hertz, while a client shows maps."""
        explained = None
        while not self._closed.wait(1 / _MAPS_HZ) and self.ended is None:
            picture, is_first = self.picture, self.map is None
            is_wanted = any(client.shows_map and client.ready for client in tuple(self.clients))
            if picture is None or picture is explained or not is_wanted:
                continue
            explained = picture
            try:  # without a margin there is nothing to explain
                self.map = None if picture.reading.margin is None else self.explain(picture, LIVE_METHOD)
            except (SliplensError, RuntimeError):
                self.map = None
            # what explainers import: to search it for garbage takes as long as some frames
            if is_first and self.map is not None:
                gc.freeze()
            self._wake()

    def explain(self, picture: PageFrame, method: str) -> Map:
        """Explain a picture by any method; one explanation runs at a time."""
        assert self._network is not None
        frame, start = picture.frame, picture.start
        baseline = "untouched" if start is None else start.image
        with self._explaining:
            chosen = frames_from_arrays(self._network, frame.image[None], picture.reference, baseline=baseline)
            methods = None if method == RECOMMENDED_METHOD else method
            explainers, warnings = choose_explainers(self._network, chosen, methods)
            explanation = explain_frames(self._network, chosen, explainers)
        method, relevance = explanation.method, explanation.relevance[explanation.method][0]
        [explained] = explanation.frames
        full = full_colour(relevance)
        # where both margins are the same but for the network's error, the strongest of nothing is not shown in colour
        alike = abs(explained.prediction - explained.reference_prediction) < CLOSE
        cells = np.round(127 * (not alike) * np.clip(relevance / full, -1, 1)).astype(np.int8)
        return Map(
            number=frame.number,
            method=method,  # tiles where no markers are found
            baseline=None if start is None else start.number,
            baseline_prediction=explained.reference_prediction,
            shape=relevance.shape,
            full=full,
            alike=alike,
            warnings=(*warnings, *(text.partition("): ")[2] for text in explanation.methods[method].warnings)),
            cells=cells.tobytes(),
        )


class ClientMessage(msgspec.Struct, forbid_unknown_fields=True):
    """Message of a browser: the answer to a message, or a button, key or slider with its values."""

    act: str
    """`drawn`, or a row of `_ACTS`."""
    serial: int = -1
    """Message that was drawn."""
    method: str = RECOMMENDED_METHOD
    map: bool = True
    press_n: float = 0.0
    pull_n: float = 0.0
    water_kg: float = 0.0
    wet: bool = False
    controller: str | None = None


class Client:
    """A connected browser: its last message, frozen picture and settings."""

    def __init__(self, feed: Feed, *, record_into: Path = Path("recorded"), facts: TrialFacts | None = None) -> None:
        self.feed, self._record_into, self._facts = feed, record_into, facts
        self.frozen: PageFrame | None = None
        """Picture that stays until the client lets it run; number and chart go on."""
        self.explained: Map | None = None
        """Map of the frozen picture."""
        self.shows_map = True
        self._waiting = ""  # work in progress for this client, in words
        self._notices: deque[str] = deque(maxlen=4)
        self._running: dict[str, asyncio.Task[None]] = {}
        self._changed = asyncio.Event()
        self._has_news = True
        self._serial = 0
        self._unanswered: set[int] = set()
        self._sent_until_s = -np.inf
        self._picture: PageFrame | None = None
        self._map: Map | None = None

    def wake(self) -> None:
        """Send the news as soon as this client has answered; called in the thread of the server."""
        self._has_news = True
        self._changed.set()

    @property
    def ready(self) -> bool:
        """True where it has answered the message before the last."""
        return len(self._unanswered) < _UNANSWERED

    @property
    def wants_picture(self) -> bool:
        """True where a newer picture would be sent; one that waits for a slow client is not drawn again."""
        return self.ready or self._picture is self.feed.picture

    async def serve(self, connection: ServerConnection) -> None:
        """Send news whenever the message before the last was answered, until the client is gone."""
        self.feed.clients.add(self)
        sending = asyncio.create_task(self._send(connection))
        try:
            while True:
                await self._obey(msgspec.json.decode(await connection.recv(), type=ClientMessage))
        except (ConnectionClosed, msgspec.MsgspecError):
            pass  # it has gone, or is of another kind
        finally:
            sending.cancel()
            self.feed.clients.discard(self)
            await asyncio.gather(sending, return_exceptions=True)

    async def _obey(self, command: ClientMessage) -> None:
        """Take an answer, or do what a button asks for; what takes long is not begun twice at once."""
        if command.act == "drawn":
            self._unanswered.discard(command.serial)
            self._changed.set()
        elif command.act not in self._running:
            self._running[command.act] = task = asyncio.create_task(self._act(command))
            task.add_done_callback(lambda _: self._running.pop(command.act))
            if command.act not in _LONG:
                await task

    async def _act(self, command: ClientMessage) -> None:
        try:
            done = pick(_ACTS, command.act, noun="button")(self, command)
            if isinstance(done, Awaitable):
                await done
        except (SliplensError, OSError) as error:
            self._notices.append(str(error))
        self.wake()

    def source(self, kind: type[_Source]) -> _Source:
        """Return the source whose sliders are moved."""
        source = self.feed.reader.source
        if not isinstance(source, kind):
            raise InputError(f"{source.name} has no such controls")
        return source

    def begin_object(self) -> None:
        """Forget the friction of the object, and show what its slips taught."""
        learnt = self.feed.reader.learnt
        self.feed.reader.new_object()
        last = "" if learnt is None else f"; the last one's friction was {learnt}"
        self._notices.append(f"nothing is known of the friction of the new object{last}")

    def freeze(self) -> None:
        """Stop at the picture on the screen, or let it run again."""
        self.frozen = (self._picture or self.feed.picture) if self.frozen is None else None
        self.explained = None

    async def explain(self, command: ClientMessage) -> None:
        """Freeze the picture and explain it."""
        if self.feed.reader.network is None:
            raise InputError(NO_NETWORK)
        self.frozen = picture = self.frozen or self._picture or self.feed.picture
        if picture is None:
            return
        self._waiting = f"explaining frame {picture.frame.number}"
        self.wake()
        try:
            explained = await asyncio.to_thread(self.feed.explain, picture, command.method)
            if self.frozen is picture:
                self.explained = explained
        finally:
            self._waiting = ""

    async def record(self, _: ClientMessage) -> None:
        """Record, or end the recording."""
        reader = self.feed.reader
        if reader.recorder is None:
            await asyncio.to_thread(reader.record, self._record_into, facts=self._facts)
        elif (data := await asyncio.to_thread(reader.stop_recording)) is None:
            self._notices.append("nothing was recorded: no frame came")
        else:
            self._notices.append(f"recorded into {data.folder}; look with `sliplens check {data.folder}`")

    async def _send(self, connection: ServerConnection) -> None:
        settings = {
            "chart_s": CHART_S,
            "target": TARGET,
            "methods": {name: row.title for name, row in EXPLAINERS.items()},
            "recommended": RECOMMENDED_METHOD,
            "units": {name: kind.unit for name, kind in CHECKS.items()},
            "network": self.feed.reader.network is not None,
            "largest": _LARGEST,
            "controllers": list(CONTROLLERS),
            "record_into": str(self._record_into),
        }
        await connection.send(msgspec.json.encode({"settings": settings}))
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(_KEEP_ALIVE_S):  # `wait_for` of Python 3.11 may miss that it is cancelled
                    await self._changed.wait()
            is_idle = not self._changed.is_set()
            self._changed.clear()
            if self.ready and (self._has_news or is_idle):
                self._has_news = False
                await connection.send(self._message())

    def _message(self) -> bytes:
        """Make a message as JSON, with the JPEG and the cells of the map in base 64."""
        feed, reader, now_s = self.feed, self.feed.reader, time.monotonic()
        picture = self.frozen or feed.picture
        has_margin = feed.reading is not None and feed.reading.margin is not None
        overlay = self.explained if self.frozen is not None else feed.map if has_margin else None
        overlay = overlay if self.shows_map else None
        drawn = frozen = None
        if picture is not None and picture is not self._picture:
            height, width = picture.frame.size
            drawn = {"width": width, "height": height, "arrows": picture.arrows, "jpeg": picture.jpeg}
        if self.frozen is not None:
            frozen = f"frame {self.frozen.frame.number}, {describe_reading(self.frozen.reading)}"
        points = feed.points_since(self._sent_until_s)
        notices = [self._notices.popleft() for _ in range(len(self._notices))]
        self._serial += 1
        message = {
            "serial": self._serial,
            "now_s": now_s,  # of the points' clock
            "reading": feed.reading,
            "words": None if feed.reading is None else describe_reading(feed.reading),
            "controls": feed.controls,
            "points": points,  # readings since the message before
            "rate_hz": len(feed.points_since(now_s - _RATE_S)) / _RATE_S,
            "waiting": self._waiting or (_STILL if reader.taker else ""),
            "notices": notices,
            "ended": feed.ended,
            "recording": reader.recorder and str(reader.recorder),
            "troubles": (*reader.doubts, *reader.troubles),
            "frozen": frozen,
            "has_map": overlay is not None,  # this one, or the one sent before
            "picture": drawn,
            "map": None if overlay is self._map else overlay,
        }
        self._unanswered.add(self._serial)
        self._picture, self._map = picture, overlay
        self._sent_until_s = (points[-1]["at_s"] or 0.0) if points else self._sent_until_s
        return msgspec.json.encode(to_builtins(message))


_ACTS: dict[str, Callable[[Client, ClientMessage], object]] = {
    "show": lambda client, message: setattr(client, "shows_map", message.map),
    "reference": lambda client, _: client.feed.reader.take_reference(),
    "object": lambda client, _: client.begin_object(),
    "freeze": lambda client, _: client.freeze(),
    "load": lambda client, message: client.source(SimulatedSource).load(
        normal_force_n=min(message.press_n, _LARGEST["press_n"]),
        tangential_force_n=min(message.pull_n, _LARGEST["pull_n"]),
    ),
    "let_go": lambda client, _: client.source(SimulatedSource).let_go(),
    "pour": lambda client, message: client.source(GripSource).act(
        water_kg=min(message.water_kg, _LARGEST["water_kg"]), pull_n=min(message.pull_n, _LARGEST["grip_pull_n"])
    ),
    "hold": lambda client, message: client.source(GripSource).act(wet=message.wet, controller=message.controller),
    "again": lambda client, _: client.source(GripSource).grip_again(),
    "explain": Client.explain,
    "record": Client.record,
}
"""Functions of the page's buttons, keys and sliders."""
_LONG = {"explain", "record"}
