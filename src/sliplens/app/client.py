"""A connected browser: what it is sent, and what its buttons do."""

import asyncio
import time
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import msgspec
import numpy as np
from websockets.exceptions import ConnectionClosed

from sliplens.app.access import Allowance
from sliplens.app.feed import CHART_S, Feed, Map, PageFrame
from sliplens.errors import InputError, SliplensError
from sliplens.explainers.table import EXPLAINERS, RECOMMENDED_METHOD
from sliplens.extras import pick
from sliplens.files import to_builtins
from sliplens.grip.controllers import CONTROLLERS
from sliplens.grip.source import GripSource
from sliplens.live.contract import LiveSource
from sliplens.live.health import CHECKS
from sliplens.live.reading import NO_NETWORK, TARGET, describe_reading
from sliplens.live.sources import SimulatedSource
from sliplens.recordings.trial import TrialFacts

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

_UNANSWERED = 2  # messages under way to one client: one is drawn while the next one travels
_MESSAGES_A_SECOND = 200
_KEEP_ALIVE_S = 1.0  # the page takes a longer silence for a lost connection
_RATE_S = 2.0
_LARGEST = {"press_n": 3.0, "pull_n": 2.4, "water_kg": 0.06, "grip_pull_n": 0.6}
"""Ends of the sliders."""
_STILL = "waiting for a still picture: leave the sensor untouched"
_Source = TypeVar("_Source", bound=LiveSource)


class ClientMessage(msgspec.Struct, forbid_unknown_fields=True):
    """Message of a browser: the answer to a message, or a button, key or slider with its values."""

    act: str
    """`drawn`, or a row of `_ACTS`."""
    serial: int = -1
    """Message that was drawn."""
    method: str = RECOMMENDED_METHOD
    map: bool = True
    markers: bool = True
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
        self.shows_map = self.shows_arrows = True
        self._waiting = ""
        """Work in progress for this client, in words."""
        self._notices: deque[str] = deque(maxlen=4)
        self._running: dict[str, asyncio.Task[None]] = {}
        self._changed = asyncio.Event()
        self._has_news = True
        self._serial = 0
        self._unanswered: set[int] = set()
        self._sent_until_s = -np.inf
        self._picture: PageFrame | None = None
        self._map: Map | None = None
        self._sent_arrows = True

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

    async def serve(self, connection: "ServerConnection") -> None:
        """Send news whenever the message before the last was answered, until the client is gone."""
        allowance = Allowance(_MESSAGES_A_SECOND, at_once=2 * _MESSAGES_A_SECOND)
        self.feed.clients.add(self)
        sending = asyncio.create_task(self._send(connection))
        try:
            while allowance.take():
                await self._obey(msgspec.json.decode(await connection.recv(), type=ClientMessage))
            await connection.close(1008, "too much was sent")
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
            explained = await self.feed.explain(picture, command.method)
            if self.frozen is picture:
                self.explained = explained
        finally:
            self._waiting = ""

    async def record(self, _: ClientMessage) -> None:
        """Record, or end the recording."""
        reader, loop = self.feed.reader, asyncio.get_running_loop()
        if reader.recorder is None:
            await loop.run_in_executor(None, lambda: reader.record(self._record_into, facts=self._facts))
        elif (data := await loop.run_in_executor(None, reader.stop_recording)) is None:
            self._notices.append("nothing was recorded: no frame came")
        else:
            self._notices.append(f"recorded into {data.folder}; look with `sliplens check {data.folder}`")

    async def _send(self, connection: "ServerConnection") -> None:
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
        is_new = picture is not None and (picture is not self._picture or self._sent_arrows is not self.shows_arrows)
        drawn = frozen = recording = None
        if picture is not None and is_new:
            height, width = picture.frame.size
            arrows = picture.arrows if self.shows_arrows else ()
            drawn = {"width": width, "height": height, "arrows": arrows, "jpeg": picture.jpeg}
        if self.frozen is not None:
            frozen = f"frame {self.frozen.frame.number}, {describe_reading(self.frozen.reading)}"
        if (recorder := reader.recorder) is not None:
            outlet = recorder.outlet
            recording = {"name": outlet.name, "sent": outlet.sent, "lost": outlet.lost}
        points = feed.points_since(self._sent_until_s)
        notices = [self._notices.popleft() for _ in range(len(self._notices))]
        self._serial += 1
        message = {
            "serial": self._serial,
            "now_s": now_s,  # of the points' clock
            "reading": feed.reading,
            "words": None if feed.reading is None else describe_reading(feed.reading),
            "controls": self._controls(),
            "points": points,  # readings since the message before
            "rate_hz": len(feed.points_since(now_s - _RATE_S)) / _RATE_S,
            "waiting": self._waiting or (_STILL if reader.takes_reference else ""),
            "notices": notices,
            "ended": feed.ended,
            "recording": recording,
            "troubles": (*reader.doubts, *reader.troubles),
            "frozen": frozen,
            "has_map": overlay is not None,  # this one, or the one sent before
            "picture": drawn,
            "map": None if overlay is self._map else overlay,
        }
        self._unanswered.add(self._serial)
        self._picture, self._map, self._sent_arrows = picture, overlay, self.shows_arrows
        self._sent_until_s = (points[-1]["at_s"] or 0.0) if points else self._sent_until_s
        return msgspec.json.encode(to_builtins(message))

    def _controls(self) -> object:
        """State of the simulated fingertip or gripper: what acts, whoever moved the sliders."""
        source, reading = self.feed.reader.source, self.feed.reading
        if isinstance(source, SimulatedSource) and reading is not None and self.feed.forces_n is not None:
            press_n, pull_n = self.feed.forces_n
            _, wanted_n = source.forces_n(reading.time_s)
            return {"kind": "fingertip", "press_n": press_n, "pull_n": pull_n, "wanted_n": wanted_n}
        if isinstance(source, GripSource) and self.feed.grip is not None:
            sliders = {"water_kg": source.water_kg, "pull_n": source.pull_n, "wet": source.wet}
            return {"kind": "gripper", **asdict(self.feed.grip), **sliders, "chosen": source.controller}
        return None


_ACTS: dict[str, Callable[[Client, ClientMessage], object]] = {
    "show": lambda client, message: vars(client).update(shows_map=message.map, shows_arrows=message.markers),
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
