"""Who is let in, and what anybody can send before that: bounded in bytes, time and number."""

import re
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection
from unittest.mock import Mock

import pytest

pytest.importorskip("websockets", reason="the page needs websockets (extra live)")

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from sliplens.app import LivePage, server
from sliplens.live import LiveReader

TOKEN = "a-token"
COOKIE = {"Cookie": f"sliplens-8090={TOKEN}"}
GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
POST = GET.replace(b"GET", b"POST")
UPGRADE = (
    GET.replace(b"/", b"/readings", 1) + b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OTAxMjM0NQ==\r\n"
)
CHUNKED = POST + b"Transfer-Encoding: chunked\r\n\r\n"
A_LOT = b"a" * 2**16
FAR_TOO_MUCH = 2**26
"""Bytes: several times what the buffers of a socket hold, so that a server that takes no more is noticed."""
PINGS = (b"\x89\xfd\0\0\0\0" + b"a" * 125) * 512
TEXTS = (b"\x81\xfd\0\0\0\0" + b"a" * 125) * 512


# who is let in


def visit(token: str | None = TOKEN, path: str = "/", **headers: str) -> tuple[int, Response]:
    """Status and answer for a visitor; 101 where a socket may open."""
    fields = {"Host": "robot:8090"} | {name.replace("_", "-"): value for name, value in headers.items()}
    answer = server.Gate(token=token, port=8090)(None, Request(path, Headers(fields)))
    return (101, Response(101, "", Headers())) if answer is None else (answer.status_code, answer)


def test_the_token_of_the_address_becomes_a_cookie_that_lets_in():
    status, answer = visit(path=f"/?token={TOKEN}")
    assert (status, answer.headers["Location"]) == (303, "/")
    assert {"HttpOnly", "SameSite=Strict"} <= set(answer.headers["Set-Cookie"].split("; "))
    cookie = answer.headers["Set-Cookie"].partition(";")[0]
    assert visit(Cookie=f"another=1; {cookie}")[0] == 200
    assert visit(Cookie=cookie, path="/readings")[0] == 101


@pytest.mark.parametrize("path", ["//evil.example/", "/\\evil.example/", "https://evil.example/", "/%2Fevil", "x"])
@pytest.mark.parametrize("token", [TOKEN, ""])
def test_no_path_leads_elsewhere(path: str, token: str):
    assert visit(path=f"{path}?token={token}")[1].headers.get("Location", "/") == "/"


@pytest.mark.parametrize("cookie", ["", "sliplens-8090=another", ";;=", "sliplens-8090=\xff"])
@pytest.mark.parametrize(
    "path", ["/", "/?token=another", "/?token", "/live.js", "/readings", f"/readings?token={TOKEN}"]
)
def test_without_the_token_nobody_is_let_in(cookie: str, path: str):
    assert visit(path=path, Cookie=cookie)[0] == 401


@pytest.mark.parametrize(
    ("token", "headers", "status"),
    [
        pytest.param(TOKEN, {"Origin": "http://robot:8090"} | COOKIE, 200, id="own"),
        pytest.param(TOKEN, {"Origin": "http://evil.example"} | COOKIE, 403, id="origin"),
        pytest.param(TOKEN, {"Origin": "null"} | COOKIE, 403, id="no-origin"),
        pytest.param(None, {"Host": "127.0.0.1:8090"}, 200, id="loopback"),
        pytest.param(None, {"Host": "[::1]:8090"}, 200, id="loopback-6"),
        pytest.param(None, {"Host": "evil.example:8090"}, 403, id="rebinding"),
        *(
            pytest.param(None, {"Host": host}, 403, id=f"host {host}")
            for host in ("", "[::1", "localhost:8090/../", "localhost@evil.example", "127.0.0.1:80:90")
        ),
        *(
            pytest.param(
                None, {"Sec_Fetch_Site": site, "Sec_Fetch_Mode": mode, "Sec_Fetch_Dest": what, "Host": "localhost"},
                status, id=f"{site} {what}",
            )
            for site, mode, what, status in (
                ("cross-site", "navigate", "document", 200), ("cross-site", "navigate", "iframe", 403),
                ("cross-site", "no-cors", "image", 403), ("same-origin", "no-cors", "image", 200),
            )
        ),
    ],
)  # fmt: skip
def test_a_page_of_another_site_is_refused_whatever_it_knows(token: str | None, headers: dict[str, str], status: int):
    assert visit(token, **headers)[0] == status
    assert visit(token, path="/readings", **headers)[0] == (101 if status == 200 else 403)


@pytest.mark.parametrize("host", ["localhost:8090", "a; script-src *"])  # a refusal has it too
def test_a_page_may_load_nothing_from_elsewhere_and_no_script_within_it_runs(host: str):
    policy = visit(None, Host=host)[1].headers["Content-Security-Policy"]
    parts = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert (parts["default-src"], parts["script-src"], parts["frame-ancestors"]) == ("'none'", "'self'", "'none'")
    assert "http" not in policy
    assert "unsafe" not in policy


@pytest.mark.parametrize(
    ("host", "own"), [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("robot", False)]
)
def test_others_need_a_token(host: str, own: bool):
    assert server.is_loopback(host) is own
    assert (LivePage(Mock(spec=LiveReader), host=host).token is None) is own


# what anybody can send


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut short how long a request may take; to be asked for before the port."""
    monkeypatch.setattr(server, "REQUEST_S", 0.2)


@pytest.fixture(params=[None, TOKEN], ids=["open", "token"])
def port(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Port of a page behind the gate, whose sockets take what comes, and say nothing."""

    async def talk(_: LivePage, connection) -> None:
        async for _ in connection:
            pass

    monkeypatch.setattr(LivePage, "_talk", talk)
    monkeypatch.setattr(server, "Feed", Mock())
    page = LivePage(Mock(spec=LiveReader), port=0)
    page.token = request.param
    with page:
        yield page._socket.getsockname()[1]


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
        pytest.param(GET + b"\r\n", A_LOT, id="after the request"),
        pytest.param(UPGRADE + b"\r\n", PINGS, id="pings"),
        pytest.param(UPGRADE + b"\r\n", TEXTS, id="texts"),
        pytest.param(UPGRADE + b"\r\n\x81\xff\0\0\0\0\xff\xff\xff\xff\0\0\0\0", A_LOT, id="a text without end"),
    ],
)
def test_what_has_no_end_is_cut_off(port: int, begin: bytes, more: bytes):
    with connect(port) as client, pytest.raises(ConnectionError):
        client.sendall(begin + more * (FAR_TOO_MUCH // len(more)))
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
        pytest.param(GET + b"\r\n", id="an answer that is not taken leave of"),
    ],
)
def test_what_never_ends_is_cut_off(impatient: None, port: int, begin: bytes):
    with connect(port) as client:
        client.sendall(begin)
        assert is_cut_off(client)


def trickle(client: socket.socket) -> None:
    """Send a byte now and then."""
    for _ in range(1000):
        client.send(b"G")
        time.sleep(0.02)


def test_a_trickle_does_not_put_off_the_end(impatient: None, port: int):
    with connect(port) as client, pytest.raises(ConnectionError):
        trickle(client)


def test_of_many_that_only_wait_the_oldest_make_room(port: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 8)
    crowd = [connect(port) for _ in range(30)]
    try:
        assert is_served(port)
        assert all(map(is_cut_off, crowd[:20]))
    finally:
        for client in crowd:
            client.close()


@pytest.mark.parametrize("port", [None], indirect=True)
def test_a_socket_that_was_let_in_stays_while_others_crowd(port: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 2)
    clients = [connect(port) for _ in range(2)]
    for client in clients:
        client.sendall(UPGRADE + b"\r\n")
        assert client.recv(2**16).startswith(b"HTTP/1.1 101")
    for _ in range(10):
        with connect(port) as other:
            assert is_cut_off(other)
    for client in clients:
        client.sendall(PINGS[:131])
        assert re.match(rb"\x8a\x7d", client.recv(2**16))  # a pong
        client.close()


def test_a_whole_request_is_answered_however_it_is_cut(port: int):
    with connect(port) as client:
        for byte in GET + b"\r\n":
            client.sendall(bytes([byte]))
        assert re.match(rb"HTTP/1.1 (200|401)", client.recv(2**16))
