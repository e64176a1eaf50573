"""Feed of the page: readings, pictures and maps, each made once for all connected browsers."""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import takewhile
from threading import Event, Lock, Thread

import msgspec
import numpy as np
import torch
from PIL import Image
from starlette.websockets import WebSocket, WebSocketDisconnect

from sliplens.errors import SliplensError
from sliplens.explainers.attribution import CLOSE
from sliplens.explainers.explain import choose_explainers, explain_frames
from sliplens.explainers.frames import frames_from_arrays
from sliplens.explainers.occlusion import marker_regions, to_network_px
from sliplens.explainers.table import RECOMMENDED_METHOD
from sliplens.files import to_builtins
from sliplens.grip.source import GripSource, GripStatus
from sliplens.images import encode_jpeg
from sliplens.live.loop import LiveReader
from sliplens.live.mailbox import OutputState
from sliplens.live.reading import LiveFrame, Reading, ReadingWords, describe_reading
from sliplens.models.checkpoint import Network
from sliplens.plots.saliency import full_colour
from sliplens.recordings.capture import Frame

CHART_S = 30.0
"""Time that the chart of the page spans, in seconds."""
LIVE_METHOD = "grad-cam"
"""Explainer of the running picture, one of the fastest; any other explains a frozen one."""
_PICTURES_HZ, _LEAST_HZ, _MAPS_HZ = 30.0, 5.0, 2.0
_LONGEST_PX = 800
_QUALITY = 85
_UNANSWERED = 2  # messages under way to one client: one is drawn while the next one travels
_KEEP_ALIVE_S = 1.0  # the page takes a longer silence for a lost connection
_RATE_S = 2.0
_PATIENCE_S = 10.0  # with a thread that is to end


@dataclass(frozen=True, kw_only=True)
class Point:
    """A reading on the chart: margins from 0 to 1, forces in newtons, None where there is none."""

    at_s: float
    """Time of the reading, as `time.monotonic` counts."""
    margin: float | None
    low: float | None
    high: float | None
    true_margin: float | None
    force_n: float | None
    """Grip force, of a simulated gripper alone."""
    least_force_n: float | None
    """Least grip force that holds, of the same."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PageFrame:
    """Frame as the page shows it."""

    reading: Reading
    frame: LiveFrame
    reference: Frame | None
    """The sensor untouched, with which the frame was compared."""
    jpeg: bytes
    arrows: tuple[tuple[float, float, float, float], ...]
    """Markers: x and y at rest, then now, in pixels of the frame."""


@dataclass(frozen=True, kw_only=True)
class MapFacts:
    """Header of a map; margins and relevance in margin units."""

    number: int
    """Frame that is explained."""
    method: str
    prediction: float
    reference_prediction: float
    """Margin of the untouched sensor."""
    rows: int
    columns: int
    full: float
    """Relevance of a cell of 127; cells are signed bytes, row by row."""
    alike: bool
    """True where both margins are the same but for the network's error, so that there is nothing to explain."""
    markers: tuple[tuple[float, float, float], ...]
    """x and y of each marker in pixels of the frame, and the relevance of the pixels nearest to it."""
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Map:
    """Relevance of a frame's pixels."""

    facts: MapFacts
    cells: bytes


@dataclass(frozen=True, kw_only=True)
class PictureFacts:
    """Size of the frame that a JPEG shows, and the arrows over it."""

    width: int
    height: int
    arrows: tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True, kw_only=True)
class Update:
    """Header of a message to a client; the JPEG and the cells of the map follow where they are new."""

    serial: int
    now_s: float
    """Time of the message, as `time.monotonic` counts."""
    reading: Reading | None
    words: ReadingWords | None
    grip: GripStatus | None
    points: tuple[Point, ...]
    """Readings since the message before."""
    rate_hz: float
    """Readings a second, over the last two."""
    drawn_ms: float | None
    """Time from the capture of a frame until this client had drawn it, in milliseconds."""
    viewers: int
    waiting: str
    """Work in progress, in words; empty for none."""
    ended: str | None
    """Why no more readings come; None while they may."""
    recording: OutputState | None
    sinks: tuple[OutputState, ...]
    troubles: tuple[str, ...]
    """Doubts about the network, and outputs that failed, with the cure."""
    frozen: str | None
    """Frame and reading of the picture in words, where it is frozen."""
    has_map: bool
    """True where a map lies over the picture: this one, or the one sent before."""
    picture: PictureFacts | None
    picture_bytes: int
    map: MapFacts | None
    map_bytes: int


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Answer of a client to a message."""

    serial: int
    drawn: bool = True
    """False where it was passed over in a hidden window."""


class Feed:
    """Readings, pictures and maps of a reader, for any number of clients.

    Everything is made once, in threads of its own, and only while a client waits for it: a client that does not answer
    is sent no more, and delays no other.

    Parameters
    ----------
    reader
        Reader that is entered.
    """

    def __init__(self, reader: LiveReader) -> None:
        self.reader = reader
        self.clients: set[Client] = set()
        """Connected clients."""
        self.expected: dict[str, Client] = {}
        """Clients that may connect, by the name in their socket's address."""
        self.reading: Reading | None = None
        """Newest reading."""
        self.grip: GripStatus | None = None
        """State of a simulated gripper at that reading."""
        self.picture: PageFrame | None = None
        """Newest picture."""
        self.map: Map | None = None
        """Newest map of the running picture."""
        self.ended: str | None = None
        """Why no more readings come; None while they may."""
        self._points: deque[Point] = deque()
        self._lock = Lock()
        self._newest: tuple[Reading, LiveFrame] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closed = Event()
        self._end_subscription: Callable[[], None] = lambda: None
        self._before: Frame | None = None
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="explain")
        # explainers hook into the network: a copy, not the one that predicts
        network = reader.network
        self._network: Network | None = None if network is None else replace(network, model=deepcopy(network.model))
        self._thread = Thread(target=self._run, daemon=True)
        self._mapper = Thread(target=self._make_maps, daemon=True)

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        """Begin; clients are served in this loop."""
        self._loop = loop
        self._end_subscription = self.reader.subscribe(self._take)
        self._thread.start()
        if self._network is not None:
            self._mapper.start()

    def close(self) -> None:
        """Make nothing more; the reader goes on."""
        self._closed.set()
        self._end_subscription()
        self._pool.shutdown(wait=False, cancel_futures=True)
        for thread in (self._thread, self._mapper):
            if thread.is_alive():  # one that is in OpenCV as the interpreter ends aborts the process
                thread.join(_PATIENCE_S)

    @property
    def waiting(self) -> str:
        """Instruction while a new reference is taken, else empty."""
        if self._before is not None and self._before is self.reader.reference:
            return "waiting for a still picture: leave the sensor untouched"
        self._before = None
        return ""

    def points_since(self, at_s: float) -> tuple[Point, ...]:
        """Return the points of the chart after a time, as `time.monotonic` counts."""
        with self._lock:  # the newest first: the thread that reads waits for this lock
            newest = tuple(takewhile(lambda point: point.at_s > at_s, reversed(self._points)))
        return newest[::-1]

    def take_reference(self) -> None:
        """Have the reader take a new reference, and show that until it has."""
        self._before = self.reader.reference
        self.reader.take_reference()

    async def explain(self, picture: PageFrame, method: str) -> Map:
        """Explain a picture by any method; one explanation runs at a time.

        Raises
        ------
        SliplensError
            If it cannot be explained.
        """
        return await asyncio.get_running_loop().run_in_executor(self._pool, self._explain, picture, method)

    def _take(self, reading: Reading, frame: LiveFrame | None) -> None:
        now_s, source = time.monotonic(), self.reader.source
        self.grip = grip = source.status(reading.number) if isinstance(source, GripSource) else None
        point = Point(
            at_s=now_s, margin=reading.margin, low=reading.low, high=reading.high, true_margin=reading.true_margin,
            force_n=None if grip is None else grip.force_n,
            least_force_n=None if grip is None else grip.least_force_n,
        )  # fmt: skip
        with self._lock:
            self._points.append(point)
            while self._points[0].at_s < now_s - CHART_S:
                self._points.popleft()
        self.reading = reading
        self._newest = None if frame is None else (reading, frame)

    def _run(self) -> None:
        """Draw the newest reading, until there are no more."""
        drawn_s = -np.inf
        try:
            for _ in self.reader.readings():
                if self._closed.is_set():
                    return
                # twice what the fastest client takes to draw one, on cores that may be ours
                takes_s = min((client.takes_s for client in tuple(self.clients)), default=0.0)
                # frames that come as fast as pictures are drawn are never early
                if time.monotonic() - drawn_s < max(0.7 / _PICTURES_HZ, min(2 * takes_s, 1 / _LEAST_HZ)):
                    continue
                drawn_s = time.monotonic()
                newest = self._newest
                if newest is not None and any(client.wants_picture for client in tuple(self.clients)):
                    self.picture = self._draw(*newest)
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

    def _draw(self, reading: Reading, frame: LiveFrame) -> PageFrame:
        thumbnail, markers_px = Image.fromarray(frame.image), self.reader.markers_px
        thumbnail.thumbnail((_LONGEST_PX, _LONGEST_PX), reducing_gap=1.0)
        ways = [] if markers_px is None else np.column_stack(markers_px).round(1).tolist()
        return PageFrame(
            reading=reading,
            frame=frame,
            reference=self.reader.reference,
            jpeg=encode_jpeg(np.asarray(thumbnail), _QUALITY),
            arrows=tuple((x, y, to_x, to_y) for x, y, to_x, to_y in ways if np.isfinite(to_x)),
        )

    def _make_maps(self) -> None:
        """Explain the newest picture at a few hertz, while a client shows maps."""
        explained = None
        while not self._closed.wait(1 / _MAPS_HZ):
            picture = self.picture
            is_wanted = any(client.shows_map and client.ready for client in tuple(self.clients))
            if self.ended is not None or not is_wanted or picture is None or picture is explained:
                continue
            explained = picture
            try:
                if picture.reading.margin is None:
                    self.map = None  # without a margin there is nothing to explain
                else:
                    self.map = self._pool.submit(self._explain, picture, LIVE_METHOD).result()
            except (SliplensError, RuntimeError, CancelledError):
                self.map = None
            self._wake()

    def _explain(self, picture: PageFrame, method: str) -> Map:
        assert self._network is not None
        chosen = frames_from_arrays(self._network, picture.frame.image[None], picture.reference)
        methods = None if method == RECOMMENDED_METHOD else method
        explainers, warnings = choose_explainers(self._network, chosen, methods)
        explanation = explain_frames(self._network, chosen, explainers)
        method, relevance = explanation.method, explanation.relevance[explanation.method][0]
        [frame] = explanation.frames
        full = full_colour(relevance)
        # where both margins are the same but for the network's error, the strongest of nothing is not shown in colour
        alike = abs(frame.prediction - frame.reference_prediction) < CLOSE
        facts = MapFacts(
            number=picture.frame.number,
            method=method,  # tiles where no markers are found
            prediction=frame.prediction,
            reference_prediction=frame.reference_prediction,
            rows=relevance.shape[0],
            columns=relevance.shape[1],
            full=full,
            alike=alike,
            markers=() if alike else _sum_by_marker(relevance, picture),
            warnings=(*warnings, *(text.partition("): ")[2] for text in explanation.methods[method].warnings)),
        )
        cells = np.round(127 * (not alike) * np.clip(relevance / full, -1, 1)).astype(np.int8)
        return Map(facts=facts, cells=cells.tobytes())


def _sum_by_marker(values: np.ndarray, picture: PageFrame) -> tuple[tuple[float, float, float], ...]:
    """Sum the relevance around each marker."""
    if len(picture.arrows) < 2:
        return ()
    places = np.array(picture.arrows)[:, 2:]
    relevance = torch.from_numpy(values).double()
    centres = to_network_px(places, picture.frame.size, image_size=len(relevance))
    regions = marker_regions((relevance.shape[0], relevance.shape[1]), centres)
    sums = torch.bincount(regions.flatten(), weights=relevance.flatten(), minlength=len(places) + 1)
    return tuple((*place, value) for place, value in zip(places.tolist(), sums[: len(places)].tolist(), strict=True))


class Client:
    """A connected browser: its last message, frozen picture and settings."""

    def __init__(self, feed: Feed) -> None:
        self.feed = feed
        self.frozen: PageFrame | None = None
        """Picture that stays until `thaw`; number and chart go on."""
        self.explained: Map | None = None
        """Map of the frozen picture."""
        self.waiting = ""
        """Work in progress for this client, in words."""
        self.shows_map = self.shows_arrows = True
        self.takes_s = 0.0
        """Time from sending a message to its answer, over the last few, in seconds."""
        self._changed = asyncio.Event()
        self._sending: asyncio.Task[None] | None = None
        self._has_news = True
        self._serial = 0
        self._unanswered: dict[int, tuple[float, float]] = {}
        self._reset()

    def _reset(self) -> None:
        self._sent_until_s, self._drawn_ms = -np.inf, None
        self._picture: PageFrame | None = None
        self._map: Map | None = None
        self._unanswered.clear()

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

    def freeze(self) -> PageFrame | None:
        """Stop at the picture on the screen; None before the first."""
        self.frozen = self.frozen or self._picture or self.feed.picture
        self.wake()
        return self.frozen

    def thaw(self) -> None:
        """Let the picture run again."""
        self.frozen = self.explained = None
        self.wake()

    async def serve(self, socket: WebSocket) -> None:
        """Send news whenever the message before the last was answered, until the client is gone."""
        await socket.accept()
        if self._sending is not None:
            self._sending.cancel()  # to a connection that is lost without notice
        self._reset()
        self.feed.clients.add(self)
        self._sending = sending = asyncio.create_task(self._send(socket))
        try:
            while True:
                answer = msgspec.json.decode(await socket.receive_text(), type=Answer)
                captured_s, sent_s = self._unanswered.pop(answer.serial, (np.nan, np.nan))
                if answer.drawn and np.isfinite(captured_s):
                    now_s = time.monotonic()
                    self._drawn_ms = 1e3 * (now_s - captured_s)
                    self.takes_s += 0.2 * (now_s - sent_s - self.takes_s)
                self._changed.set()
        except (WebSocketDisconnect, RuntimeError, msgspec.MsgspecError, KeyError):
            pass  # it has gone, which starlette calls a RuntimeError where sending saw it first, or is of another kind
        finally:
            sending.cancel()
            if self._sending is sending:
                self._sending = None
                self.feed.clients.discard(self)
            await asyncio.gather(sending, return_exceptions=True)
            with suppress(RuntimeError, WebSocketDisconnect, OSError):
                await socket.close()

    async def _send(self, socket: WebSocket) -> None:
        self.wake()
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(_KEEP_ALIVE_S):  # `wait_for` of Python 3.11 may miss that it is cancelled
                    await self._changed.wait()
            is_idle = not self._changed.is_set()
            self._changed.clear()
            if self.ready and (self._has_news or is_idle):
                self._has_news = False
                await socket.send_bytes(self._message())

    def _message(self) -> bytes:
        """Make a message: length of the header in 4 bytes, the header as JSON, the JPEG and the cells of the map."""
        feed, reader = self.feed, self.feed.reader
        picture = self.frozen or feed.picture
        overlay = self.explained if self.frozen is not None else feed.map
        overlay = overlay if self.shows_map else None
        jpeg = picture.jpeg if picture is not None and picture is not self._picture else b""
        cells = overlay.cells if overlay is not None and overlay is not self._map else b""
        facts = frozen = None
        if picture is not None and jpeg:
            height, width = picture.frame.size
            facts = PictureFacts(width=width, height=height, arrows=picture.arrows if self.shows_arrows else ())
        if self.frozen is not None:
            frozen = f"frame {self.frozen.frame.number}, {describe_reading(self.frozen.reading)}"
        points = feed.points_since(self._sent_until_s)
        self._serial += 1
        update = Update(
            serial=self._serial,
            now_s=time.monotonic(),
            reading=feed.reading,
            words=None if feed.reading is None else describe_reading(feed.reading),
            grip=feed.grip,
            points=points,
            rate_hz=len(feed.points_since(time.monotonic() - _RATE_S)) / _RATE_S,
            drawn_ms=self._drawn_ms,
            viewers=len(feed.clients),
            waiting=self.waiting or feed.waiting,
            ended=feed.ended,
            recording=None if (recorder := reader.recorder) is None else recorder.state,
            sinks=tuple(sender.state for sender in reader.senders),
            troubles=(*reader.doubts, *reader.troubles),
            frozen=frozen,
            has_map=overlay is not None,
            picture=facts,
            picture_bytes=len(jpeg),
            map=overlay.facts if overlay is not None and cells else None,
            map_bytes=len(cells),
        )
        # a picture that was drawn before says nothing of how long drawing takes
        captured_s = picture.frame.captured_s if jpeg and picture is not None else np.nan
        self._unanswered[self._serial] = captured_s, update.now_s
        self._picture, self._map = picture, overlay
        self._sent_until_s = points[-1].at_s if points else self._sent_until_s
        header = msgspec.json.encode(to_builtins(update))
        return b"".join([len(header).to_bytes(4, "little"), header, jpeg, cells])
