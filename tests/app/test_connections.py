"""What anybody can send to the server of a page, before the gate: bounded in bytes, time and number."""

import asyncio
import re
import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from threading import Thread

import pytest

uvicorn = pytest.importorskip("uvicorn", reason="the page needs NiceGUI (extra live), which brings it")

from sliplens.app import connections  # noqa: E402 (needs it)

GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
POST = GET.replace(b"GET", b"POST")
UPGRADE = (
    GET + b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OTAxMjM0NQ==\r\n"
)
CHUNKED = POST + b"Transfer-Encoding: chunked\r\n\r\n"
A_LOT = b"a" * 2**16
FAR_TOO_MUCH = 2**26
"""Bytes: several times what the buffers of a socket hold, so that a server that takes no more is noticed."""
PINGS = (b"\x89\xfd\0\0\0\0" + b"a" * 125) * 512


async def inside(scope, receive, send) -> None:
    """Answer a request once it is there whole, /never not at all; accept a socket and wait for its end."""
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
        while (await receive())["type"] != "websocket.disconnect":
            pass
        return
    if scope["path"] == "/never":
        await asyncio.Future()
    while (message := await receive())["type"] == "http.request" and message.get("more_body"):
        pass
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"6")]})
    await send({"type": "http.response.body", "body": b"inside"})


@contextmanager
def serving(token: str | None) -> Iterator[int]:
    """Serve `inside` behind the gate; gives the port."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        server = uvicorn.Server(connections.server_config(connections.Gate(inside, token=token, port=port)))
        thread = Thread(target=lambda: asyncio.run(server.serve([listening])), daemon=True)
        thread.start()
        try:
            while not server.started:
                thread.join(0.01)
            yield port
        finally:
            server.should_exit = True
            thread.join(20)


@pytest.fixture(params=[None, "a-token"], ids=["open", "token"])
def port(request: pytest.FixtureRequest) -> Iterator[int]:
    with serving(request.param) as port:
        yield port


def connect(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=30)


def is_served(port: int) -> bool:
    """Whether a client that does nothing wrong is answered."""
    with closing(HTTPConnection("127.0.0.1", port, timeout=30)) as client:
        client.request("GET", "/")
        return client.getresponse().status in {200, 401}


def is_cut_off(client: socket.socket) -> bool:
    """Wait for the end of a connection; what comes before it is passed over."""
    try:
        while client.recv(2**16):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        pass
    return True


@pytest.mark.parametrize(
    ("begin", "more"),
    [
        pytest.param(b"GET /", A_LOT, id="request line"),
        pytest.param(GET + b"X: ", A_LOT, id="header"),
        pytest.param(GET, b"X: y\r\n" * 2**13, id="headers"),
        pytest.param(UPGRADE + b"X: ", A_LOT, id="header of an upgrade"),
        pytest.param(POST + b"Content-Length: 99999999999\r\n\r\n", A_LOT, id="body"),
        pytest.param(b"POST / HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n", A_LOT, id="body of no host"),
        pytest.param(CHUNKED, b"8000\r\n" + A_LOT[:0x8000] + b"\r\n", id="chunks"),
        pytest.param(CHUNKED + b"1;", A_LOT, id="chunk extension"),
        pytest.param(CHUNKED + b"0\r\nX: ", A_LOT, id="trailer"),
        pytest.param(UPGRADE + b"\r\n", PINGS, id="pings"),
    ],
)
def test_what_has_no_end_is_cut_off(port: int, begin: bytes, more: bytes):
    with connect(port) as client:
        client.sendall(begin)
        with pytest.raises(ConnectionError):
            client.sendall(more * (FAR_TOO_MUCH // len(more)))
    assert is_served(port)


@pytest.mark.parametrize(
    "begin",
    [
        pytest.param(b"", id="nothing"),
        pytest.param(b"GET /", id="half a line"),
        pytest.param(GET, id="half a header"),
        pytest.param(UPGRADE, id="half an upgrade"),
        pytest.param(POST + b"Content-Length: 10\r\n\r\n12345", id="half a body"),
        pytest.param(GET + b"\r\n" + GET, id="half a second request"),
    ],
)
def test_what_never_comes_whole_is_cut_off(port: int, monkeypatch: pytest.MonkeyPatch, begin: bytes):
    monkeypatch.setattr(connections, "REQUEST_S", 0.2)
    with connect(port) as client:
        client.sendall(begin)
        assert is_cut_off(client)


def trickle(client: socket.socket) -> None:
    """Send a byte now and then."""
    for _ in range(1000):
        client.send(b"G")
        time.sleep(0.02)


def test_a_trickle_does_not_put_off_the_end(port: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(connections, "REQUEST_S", 0.2)
    with connect(port) as client, pytest.raises(ConnectionError):
        trickle(client)


def test_a_request_without_an_answer_ends_as_well(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(connections, "ANSWER_S", 0.2)
    with serving(None) as port, connect(port) as client:
        client.sendall(GET.replace(b"/", b"/never", 1) + b"\r\n")
        assert is_cut_off(client)


def test_of_many_that_only_wait_the_oldest_make_room(port: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 8)
    crowd = [connect(port) for _ in range(30)]
    try:
        assert is_served(port)
        assert all(map(is_cut_off, crowd[:20]))
    finally:
        for client in crowd:
            client.close()


def test_a_socket_that_was_let_in_stays_while_others_crowd(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 4)
    monkeypatch.setattr(connections, "REQUEST_S", 0.2)
    with serving(None) as port, connect(port) as client:
        client.sendall(UPGRADE + b"\r\n")
        assert client.recv(2**16).startswith(b"HTTP/1.1 101")
        for _ in range(10):
            with connect(port) as other:
                assert is_cut_off(other)
        client.sendall(PINGS[:131])
        assert re.match(rb"\x8a\x7d", client.recv(2**16))  # a pong


def test_a_whole_request_is_answered_however_it_is_cut(port: int):
    with connect(port) as client:
        for byte in POST + b"Content-Length: 4\r\nConnection: close\r\n\r\nbody":
            client.sendall(bytes([byte]))
        assert re.match(rb"HTTP/1.1 (200|401)", client.recv(2**16))
