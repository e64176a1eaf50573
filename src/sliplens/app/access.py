"""Access to the page: whom the server admits, and connections bounded in bytes, time and number."""

import re
import secrets
import time
from asyncio import BaseTransport
from functools import cache
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.protocol import State

REQUEST_S = 10.0
"""Longest time in seconds from an open connection to the end of its only request, and then to that of the answer."""
MOST_CONNECTIONS = 128
"""A browser opens a few. Far below the 1,024 files that a process may open, cameras among them."""
MOST_MESSAGE_BYTES = 2**12
_MOST_HEADER_BYTES = 2**14
_BYTES_A_SECOND = 2**16
SOCKET_PATH = "/readings"
_FILES = {
    "/": ("live.html", "text/html; charset=utf-8"),
    "/live.js": ("live.js", "text/javascript; charset=utf-8"),
    "/live.css": ("live.css", "text/css; charset=utf-8"),
}
"""Files of the page by path, and their types; no other path leads to the disk."""
_DAY_S = 24 * 3600
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[\w.-]+)(:\d+)?", re.ASCII)


class Allowance:
    """Amount that refills with time: some a second, up to the most at once."""

    def __init__(self, a_second: int, *, at_once: int) -> None:
        self._a_second, self._most = a_second, at_once
        self._rest, self._last_s = float(at_once), time.monotonic()

    def take(self, amount: int = 1) -> bool:
        """Take an amount; False where less is there."""
        now_s = time.monotonic()
        self._rest = min(self._most, self._rest + (now_s - self._last_s) * self._a_second)
        self._last_s = now_s
        enough = self._rest >= amount
        self._rest -= amount if enough else 0
        return enough


class BoundedConnection(ServerConnection):
    """Connection that is cut off where it sends more bytes than a browser does, whatever they mean.

    Of more connections than `MOST_CONNECTIONS` the one that has waited longest for its request to end is cut off, or
    the newest where all are sockets of admitted browsers.
    """

    def __init__(self, *positional: Any, crowd: "dict[BoundedConnection, None]", **settings: Any) -> None:
        super().__init__(*positional, **settings)
        self._crowd, self._received = crowd, 0
        self._bytes = Allowance(_BYTES_A_SECOND, at_once=4 * _BYTES_A_SECOND)

    def connection_made(self, transport: BaseTransport) -> None:
        """Wait for the request."""
        super().connection_made(transport)
        self._crowd[self] = None
        if len(self._crowd) > MOST_CONNECTIONS:
            waiting = (other for other in self._crowd if other.protocol.state is State.CONNECTING)
            oldest = next(waiting)
            del self._crowd[oldest]
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the crowd."""
        self._crowd.pop(self, None)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take some bytes."""
        self._received += len(data)
        is_open = self.protocol.state is not State.CONNECTING
        if self._bytes.take(len(data)) if is_open else self._received <= _MOST_HEADER_BYTES:
            super().data_received(data)
        else:
            self.transport.abort()


class Gate:
    """Answers requests: a refusal, a file of the page, or None for a socket that may open.

    Without a token it admits requests to this machine's own names: a page of another site that resolves a name of its
    own to this machine is refused. With one it admits whoever shows it, once in the address and from then on in a
    cookie. A page of another site can neither open a socket, send anything nor load a part of this one.
    """

    def __init__(self, *, token: str | None, port: int) -> None:
        self._token, self._cookie = token, f"sliplens-{port}"

    def __call__(self, _connection: ServerConnection | None, request: Request, /) -> Response | None:
        """Answer a request; None to go on as a socket."""
        host, (path, _, query) = _header(request, "Host"), request.path.partition("?")
        if (why := self._refusal(request)) is not None:
            return _answer(403, f"sliplens: {why}\n", host=host)
        cookies = [part.strip().partition("=") for part in _header(request, "Cookie").split(";")]
        admitted = any(name == self._cookie and self._shows(token) for name, _, token in cookies)
        if not (self._token is None or admitted):
            if path == SOCKET_PATH or not self._shows(*parse_qs(query).get("token", [])[:1]):
                return _answer(401, "sliplens: open the whole address that was printed, with its token\n", host=host)
            # whatever the path was: of //elsewhere/ a browser makes another host
            answer = _answer(303, "", host=host)
            answer.headers["Location"] = "/"
            fields = f"Max-Age={_DAY_S}; Path=/; HttpOnly; SameSite=Strict"
            answer.headers["Set-Cookie"] = f"{self._cookie}={self._token}; {fields}"
            return answer
        if path == SOCKET_PATH:
            return None
        if path not in _FILES:
            return _answer(404, "sliplens: there is no such page\n", host=host)
        name, kind = _FILES[path]
        return _answer(200, _read_file(name), host=host, kind=kind)

    def _refusal(self, request: Request) -> str | None:
        host = _header(request, "Host")
        if request.method != "GET":
            return "the page is only looked at"
        if (parts := _HOST.fullmatch(host)) is None:
            return "the request names no host; open the address that sliplens printed"
        if self._token is None and not is_loopback(parts[1].strip("[]").lower()):
            return f"this page is for this machine alone, and not at {host}; start it with --host to open it to others"
        if "Origin" in request.headers and _header(request, "Origin").partition("://")[2] != host:
            return "a page of another site may not use this one"
        # browsers tell who asks: what others may do is to lead a person here
        mode, target = _header(request, "Sec-Fetch-Mode"), _header(request, "Sec-Fetch-Dest")
        is_foreign = _header(request, "Sec-Fetch-Site") not in {"", "none", "same-origin"}
        if is_foreign and (mode, target) != ("navigate", "document"):
            return "a page of another site may not load parts of this one"
        return None

    def _shows(self, token: str = "") -> bool:
        return self._token is not None and secrets.compare_digest(token.encode(), self._token.encode())


def _header(request: Request, name: str) -> str:
    """Join the values of a header; one that may stand once only is then no valid value."""
    return ", ".join(request.headers.get_all(name))


def _answer(status: int, body: str, *, host: str, kind: str = "text/plain; charset=utf-8") -> Response:
    """Make an answer whose page loads nothing from elsewhere and is not shown within another one."""
    sockets = f" ws://{host} wss://{host}" if _HOST.fullmatch(host) else ""  # Safari does not take them for 'self'
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        f"connect-src 'self'{sockets}; frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
    )
    headers = Headers({
        "Connection": "close",
        "Content-Length": str(len(body.encode())),
        "Content-Type": kind,
        "Cache-Control": "no-cache",
        "Content-Security-Policy": policy,
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
    })  # fmt: skip
    return Response(status, HTTPStatus(status).phrase, headers, body.encode())


@cache
def _read_file(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def is_loopback(host: str) -> bool:
    """Return True where only this machine can reach an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
