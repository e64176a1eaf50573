"""What one client is sent, and when."""

import asyncio
import json
import threading
from pathlib import Path
from typing import Any, cast

import numpy as np
from starlette.websockets import WebSocketDisconnect

import sliplens as sl
from sliplens.app.feed import Client, Feed, PageFrame
from sliplens.live import SimulatedSource
from sliplens.live.reading import LiveFrame, Reading
from sliplens.recordings.sensor import SensorProfile


class Wire:
    """Socket of a browser whose answers the test gives."""

    def __init__(self) -> None:
        self.sent: asyncio.Queue[dict] = asyncio.Queue()
        self.answers: asyncio.Queue[dict | None] = asyncio.Queue()

    async def accept(self) -> None: ...

    async def close(self) -> None: ...

    async def send_bytes(self, message: bytes) -> None:
        length = int.from_bytes(message[:4], "little")
        await self.sent.put(json.loads(message[4 : 4 + length]))

    async def receive_text(self) -> str:
        answer = await self.answers.get()
        if answer is None:
            raise WebSocketDisconnect
        return json.dumps(answer)

    async def next(self, *, within_s: float = 30.0) -> dict:
        return await asyncio.wait_for(self.sent.get(), within_s)


def picture(number: int) -> PageFrame:
    frame = LiveFrame(image=np.zeros((4, 4, 3), np.uint8), number=number, time_s=0.0, captured_s=0.0)
    return PageFrame(
        reading=Reading(number=number, time_s=0.0, captured_s=0.0),
        frame=frame,
        reference=None,
        jpeg=bytes([number]),
        arrows=(),
    )


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

    asyncio.run(run())


def test_an_answer_alone_is_not_answered():
    async def act(_: Feed, wire: Wire, client: Client) -> None:
        first = await wire.next()
        await wire.answers.put({"serial": first["serial"]})
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
                await wire.answers.put({"serial": owed.pop(0)["serial"]})
            owed.append(await wire.next())
        drawn = [message["picture_bytes"] for message in owed]
        assert all(drawn)  # pictures that are new
        assert feed.picture is not None
        assert feed.picture.frame.number >= 4

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


def test_a_client_that_comes_back_before_its_old_connection_is_given_up_goes_on():
    async def act(feed: Feed, old: Wire, client: Client) -> None:
        await old.next()
        new = Wire()
        served = asyncio.create_task(client.serve(cast("Any", new)))
        await new.next()
        await old.answers.put(None)  # the old one is told to be gone only now
        await asyncio.sleep(0.01)
        assert feed.clients == {client}
        for _ in range(2):
            client.wake()
            await new.answers.put({"serial": (await new.next())["serial"]})
        assert old.sent.empty()
        await new.answers.put(None)
        await served
        assert not feed.clients

    with_client(act)


def test_its_threads_have_ended_when_it_is_closed():
    class Looks:
        wants_picture = shows_map = ready = True
        takes_s = 0.0

        def wake(self) -> None: ...

    async def run() -> list[str]:
        source = SimulatedSource(rate_hz=200.0)
        source.load(normal_force_n=4.0, tangential_force_n=1.0)
        with sl.LiveReader(source, "chromatouch-difference", engine="torch", health=None, slip=None) as reader:
            feed = Feed(reader)
            feed.clients.add(cast("Any", Looks()))
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
        assert "reads frames of another" in doubt

    with_client(act, network=difference_run, sensor=SensorProfile(name="another"))
