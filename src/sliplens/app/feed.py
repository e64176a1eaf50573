"""Feed of the page: readings, pictures and maps, each made once for all connected browsers."""

import asyncio
import gc
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from threading import Event, Thread
from typing import TYPE_CHECKING, TypeAlias

import msgspec
import numpy as np
from PIL import Image

from sliplens.errors import SliplensError
from sliplens.explainers.explain import choose_explainers, explain_frames
from sliplens.explainers.frames import frames_from_arrays
from sliplens.explainers.table import RECOMMENDED_METHOD
from sliplens.grip.source import GripSource, GripStatus
from sliplens.images import encode_jpeg
from sliplens.live.loop import LiveReader
from sliplens.live.reading import LiveFrame, Reading, SlipState
from sliplens.models.checkpoint import Network
from sliplens.recordings.capture import Frame
from sliplens.results.explanation import CLOSE, full_colour

if TYPE_CHECKING:
    from sliplens.app.client import Client

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


Point: TypeAlias = dict[str, float | None]
"""A reading on the chart: `at_s` as `time.monotonic` counts, margins, shear in pixels, forces of a simulated gripper in
newtons; None where there is none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PageFrame:
    """Frame as the page shows it, with its reading."""

    reading: Reading
    frame: LiveFrame
    start: LiveFrame | None
    """Last frame of the same contact before the pull, where that is known."""
    reference: Frame | None
    """The sensor untouched, with which the frame was compared."""
    jpeg: bytes
    arrows: tuple[tuple[float, float, float, float], ...]
    """Markers: x and y at rest, then now, in pixels of the frame."""


class Map(msgspec.Struct, frozen=True, kw_only=True):
    """Relevance of a frame's pixels; margins and relevance in margin units."""

    number: int
    """Frame that is explained."""
    method: str
    baseline: int | None
    """Frame with which it is compared, the last before the pull; None for the untouched sensor."""
    prediction: float
    baseline_prediction: float
    rows: int
    columns: int
    full: float
    """Relevance of a cell of 127."""
    alike: bool
    """True where both margins are the same but for the network's error, so that there is nothing to explain."""
    warnings: tuple[str, ...]
    cells: bytes
    """Signed bytes, row by row."""


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
        self.reading: Reading | None = None
        """Newest reading."""
        self.grip: GripStatus | None = None
        """State of a simulated gripper at that reading."""
        self.forces_n: tuple[float, float] | None = None
        """Normal and tangential force of the newest frame that brings them."""
        self.picture: PageFrame | None = None
        """Newest picture."""
        self.map: Map | None = None
        """Newest map of the running picture."""
        self.ended: str | None = None
        """Why no more readings come; None while they may."""
        self._points: list[Point] = []
        self._newest: tuple[Reading, LiveFrame, LiveFrame | None] | None = None
        """Newest reading with its frame, and the last frame of the same contact before the pull."""
        self._start: LiveFrame | None = None
        self._largest = 0.0
        self._closed = Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="page-map")
        # explainers hook into the network: a copy, not the one that predicts
        network = reader.network
        self._network: Network | None = None if network is None else replace(network, model=deepcopy(network.model))
        self._thread = Thread(target=self._run, name="page-draw", daemon=True)

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        """Begin; clients are served in this loop, which runs in the thread that calls."""
        self._loop = loop
        self._end_subscription = self.reader.subscribe(self._take)
        self._thread.start()
        if self._network is not None:
            self._mapping = loop.create_task(self._make_maps())

    def close(self) -> None:
        """Make nothing more; the reader goes on."""
        self._closed.set()
        self._end_subscription()
        self._pool.shutdown(wait=False, cancel_futures=True)
        if self._thread.is_alive():  # one that is in OpenCV as the interpreter ends aborts the process
            self._thread.join(_PATIENCE_S)

    def points_since(self, at_s: float) -> tuple[Point, ...]:
        """Return the points of the chart after a time, as `time.monotonic` counts."""
        return tuple(point for point in self._points if (point["at_s"] or 0.0) > at_s)

    async def explain(self, picture: PageFrame, method: str) -> Map:
        """Explain a picture by any method; one explanation runs at a time.

        Raises
        ------
        SliplensError
            If it cannot be explained.
        """
        return await asyncio.get_running_loop().run_in_executor(self._pool, self._explain, picture, method)

    def _take(self, reading: Reading, frame: LiveFrame | None) -> None:
        """Note a reading, in the thread that reads: nothing is drawn here."""
        now_s, source = time.monotonic(), self.reader.source
        self.grip = grip = source.status(reading.number) if isinstance(source, GripSource) else None
        if frame is not None and frame.forces is not None:
            x_n, y_n, normal_n = frame.forces.force_n[-1].tolist()
            self.forces_n = normal_n, float(np.hypot(x_n, y_n))
        point = {name: getattr(reading, name) for name in ("margin", "low", "high", "true_margin")}
        point |= {name: getattr(grip, name, None) for name in ("force_n", "least_force_n")}
        point |= {"at_s": now_s, "shear_px": getattr(reading.markers, "shear_px", None)}
        # another list, for threads that walk through this one
        self._points = [*self.points_since(now_s - CHART_S), point]
        self.reading = reading
        if frame is not None:
            self._note_start(reading, frame)
        self._newest = None if frame is None else (reading, frame, self._start)

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

    def _draw(self, reading: Reading, frame: LiveFrame, start: LiveFrame | None) -> PageFrame:
        thumbnail, markers_px = Image.fromarray(frame.image), self.reader.markers_px
        thumbnail.thumbnail((_LONGEST_PX, _LONGEST_PX), reducing_gap=1.0)
        ways = [] if markers_px is None else np.column_stack(markers_px).round(1).tolist()
        return PageFrame(
            reading=reading,
            frame=frame,
            start=start,
            reference=self.reader.reference,
            jpeg=encode_jpeg(np.asarray(thumbnail), _QUALITY),
            arrows=tuple((x, y, to_x, to_y) for x, y, to_x, to_y in ways if np.isfinite(to_x)),
        )

    async def _make_maps(self) -> None:
        """Explain the newest picture at a few hertz, while a client shows maps."""
        explained = None
        while not self._closed.is_set():
            await asyncio.sleep(1 / _MAPS_HZ)
            picture = self.picture
            is_wanted = any(client.shows_map and client.ready for client in self.clients)
            if self.ended is not None or not is_wanted or picture is None or picture is explained:
                continue
            explained, self.map = picture, None if picture.reading.margin is None else self.map
            if picture.reading.margin is not None:  # without a margin there is nothing to explain
                try:
                    is_first, self.map = self.map is None, await self.explain(picture, LIVE_METHOD)
                except (SliplensError, RuntimeError):
                    self.map = None
                else:
                    if is_first:  # what explainers import: to search it for garbage takes as long as some frames
                        gc.freeze()
            for client in self.clients:
                client.wake()

    def _explain(self, picture: PageFrame, method: str) -> Map:
        assert self._network is not None
        frame, start, reference = picture.frame, picture.start, picture.reference
        baseline = "untouched" if start is None else start.image
        chosen = frames_from_arrays(self._network, frame.image[None], reference, baseline=baseline)
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
            prediction=explained.prediction,
            baseline_prediction=explained.reference_prediction,
            rows=relevance.shape[0],
            columns=relevance.shape[1],
            full=full,
            alike=alike,
            warnings=(*warnings, *(text.partition("): ")[2] for text in explanation.methods[method].warnings)),
            cells=cells.tobytes(),
        )
