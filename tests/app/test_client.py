"""What one client is sent, and when."""

import asyncio
import json
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest
from scripted import frame_of, plain_reader
from there import there

pytest.importorskip("websockets", reason="the page needs websockets (extra live)")

from websockets.exceptions import ConnectionClosedOK

import sliplens as sl
from sliplens.app.feed import Client, Feed, PageFrame
from sliplens.live import MarkerReading, SimulatedSource, SlipState
from sliplens.live.reading import Reading
from sliplens.recordings.sensor import SensorProfile

READING = Reading(number=0, time_s=0.0, captured_s=0.0)


class Wire:
    """Socket of a browser whose answers the test gives."""

    def __init__(self) -> None:
        self.sent: asyncio.Queue[dict] = asyncio.Queue()
        self.answers: asyncio.Queue[dict | None] = asyncio.Queue()

    async def send(self, message: bytes) -> None:
        if "settings" not in (told := json.loads(message)):
            await self.sent.put(told)

    async def recv(self) -> str:
        answer = await self.answers.get()
        if answer is None:
            raise ConnectionClosedOK(None, None)
        return json.dumps(answer)

    async def next(self) -> dict:
        return await asyncio.wait_for(self.sent.get(), 30.0)

    async def draw(self, message: dict) -> None:
        await self.answers.put({"act": "drawn", "serial": message["serial"]})


frame = partial(frame_of, np.zeros((224, 224, 3), np.uint8))


def picture(number: int) -> PageFrame:
    return PageFrame(reading=replace(READING, number=number), frame=frame(number))


def with_client(act, **reader) -> None:
    """Let a client be served while something is done."""

    async def run() -> None:
        # nothing happens in it by itself: it was not started
        feed, wire = Feed(sl.LiveReader("simulated", **reader)), Wire()
        client = Client(feed)
        served = asyncio.create_task(client.serve(cast("Any", wire)))
        await act(feed, wire, client)
        await wire.answers.put(None)
        await served
        assert not feed.clients

    asyncio.run(run())


def test_an_answer_alone_is_not_answered():
    async def act(_: Feed, wire: Wire, client: Client) -> None:
        first = await wire.next()
        await wire.draw(first)
        while first["serial"] in client._unanswered:
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.05)
        assert wire.sent.empty()
        client.wake()
        assert (await wire.next())["serial"] == first["serial"] + 1

    with_client(act)


def test_a_slow_client_sees_the_picture_move():
    async def act(feed: Feed, wire: Wire, client: Client) -> None:
        owed = []
        for number in range(1, 6):
            # as the drawing thread does with each reading
            if client.wants_picture:
                feed.picture = picture(number)
            client.wake()
            if number > 2:  # it answers after the next reading has come, never before
                await wire.draw(owed.pop(0))
            owed.append(await wire.next())
        assert all(message["picture"] for message in owed)  # pictures that are new
        assert there(feed.picture).frame.number >= 4

    with_client(act)


def test_a_picture_that_nobody_fetches_is_not_drawn_again():
    async def act(feed: Feed, wire: Wire, client: Client) -> None:
        await wire.next()
        client.wake()
        await wire.next()  # two that stay without an answer
        assert client.wants_picture is (feed.picture is None)
        feed.picture = picture(1)
        assert not client.ready
        assert not client.wants_picture

    with_client(act)


@pytest.mark.parametrize(
    "message",
    [{}, {"act": 1}, {"act": "load", "press_n": "1"}, {"act": "load", "more": 1}, {"act": "hold", "wet": 3}],
)
def test_who_sends_something_else_is_cut_off(message: dict):
    async def act(feed: Feed, wire: Wire, _: Client) -> None:
        await wire.answers.put(message)
        while feed.clients or not wire.answers.empty():
            await asyncio.sleep(0.001)

    with_client(act)


def test_a_slider_moves_no_further_than_its_end_and_a_mistake_is_told():
    async def act(feed: Feed, wire: Wire, _: Client) -> None:
        source = cast("SimulatedSource", feed.reader.source)
        await wire.answers.put({"act": "load", "press_n": 1e9, "pull_n": 1e9})
        await wire.answers.put({"act": "load", "press_n": -1})
        while not (notices := (await wire.next())["notices"]):
            await wire.draw({"serial": 1})
        assert source.forces_n(0.0) == (3.0, 2.4)
        assert "cannot be pressed by -1 N" in notices[0]

    with_client(act)


def test_its_threads_have_ended_when_it_is_closed():
    async def run() -> list[str]:
        source = SimulatedSource(rate_hz=200.0)
        source.load(normal_force_n=4.0, tangential_force_n=1.0)
        with plain_reader(source, "chromatouch-difference") as reader:
            feed = Feed(reader)
            feed.clients.add(Mock(wants_picture=True, shows_map=True, ready=True))
            before = set(threading.enumerate())
            feed.start(asyncio.get_running_loop())
            while feed.picture is None:
                await asyncio.sleep(0.01)
            begun = set(threading.enumerate()) - before
            feed.close()
            assert begun
            return [thread.name for thread in begun if thread.is_alive() and thread.daemon]

    assert asyncio.run(run()) == []


def test_a_client_is_told_what_the_network_was_not_made_for(difference_run: Path):
    async def act(_: Feed, wire: Wire, __: Client) -> None:
        [doubt] = (await wire.next())["troubles"]
        assert "the frames are of another" in doubt

    with_client(act, network=difference_run, sensor=SensorProfile(name="another"))


def test_the_start_of_a_grip_is_its_last_frame_without_shear_at_its_largest_margin():
    feed = Feed(sl.LiveReader("simulated"))
    # margin, shear in pixels of 224 (None: nothing touches), and the frame with which a map is compared
    course = [
        (None, None, None), (0.7, 0.1, None), (0.95, 0.1, 2), (1.0, 0.2, 3), (0.98, 0.3, 4), (0.9, 0.4, 4),
        (0.99, 0.9, 4), (0.99, 0.1, 4), (None, None, None), (0.95, 2.0, None), (0.95, 0.1, None),
    ]  # fmt: skip
    for number, (margin, shear_px, start) in enumerate(course):
        markers = MarkerReading(state=SlipState.STICKING, contact=shear_px is not None, shear_px=shear_px)
        feed._take(replace(READING, number=number, margin=margin, markers=markers), frame(number))
        before = there(feed._newest).start
        assert (before and before.number) == start
