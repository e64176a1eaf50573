"""Server of the page, on this machine alone or with a token: connections are bounded in bytes, time and number."""

import asyncio
import errno
import logging
import re
import secrets
import socket
import time
from contextlib import ExitStack
from functools import partial
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import parse_qs

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.protocol import State

from sliplens.app.feed import Client, Feed
from sliplens.errors import InputError
from sliplens.live.loop import LiveReader
from sliplens.recordings.trial import TrialFacts

_PORT = 8090
_PATIENCE_S = 10.0
REQUEST_S = 10.0
"""Longest time in seconds from an open connection to the end of its only request, and then to that of the answer."""
MOST_CONNECTIONS = 128
"""A browser opens a few. Far below the 1,024 files that a process may open, cameras among them."""
MOST_MESSAGE_BYTES = 2**12
_BYTES_A_SECOND, _MOST_AT_ONCE_BYTES = 2**13, 2**16
SOCKET_PATH = "/readings"
_FILES = {
    "/": ("live.html", "text/html; charset=utf-8"),
    "/live.js": ("live.js", "text/javascript; charset=utf-8"),
    "/live.css": ("live.css", "text/css; charset=utf-8"),
}
"""Files of the page by path, and their types; no other path leads to the disk."""
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[\w.-]+)(:\d+)?", re.ASCII)


class LivePage:
    """Page of a reader, for browsers; a context manager that serves it while it is entered.

    Several browsers see the same frames, and cost one inference.

    Parameters
    ----------
    reader
        Reader that is entered, and stays so for longer than the page.
    host
        Address to listen on; on any other than this machine's own, the page asks for the token that its address holds.
    port
        Port to listen on, 0 for any; 8090, or any where that is taken, if None.
    record_into
        Data set into which the page's button records, a new or an existing one.
    facts
        Who, when and what of its trials.

    Raises
    ------
    InputError
        If the port is taken.

    Examples
    --------
    >>> import sliplens as sl
    >>> from sliplens.app import LivePage
    >>> with sl.LiveReader("simulated") as reader, LivePage(reader, port=0) as page:
    ...     page.address.startswith("http://127.0.0.1:")
    True
    """

    def __init__(
        self,
        reader: LiveReader,
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        record_into: Path | str = "recorded",
        facts: TrialFacts | None = None,
    ) -> None:
        if port is not None and not 0 <= port <= 65535:
            raise InputError(f"--port must be from 0 to 65535, got {port}")
        self.reader, self.record_into, self.facts = reader, Path(record_into), facts
        self._host, self._port = host, port
        self.token = None if is_loopback(host) else secrets.token_urlsafe(24)
        """Token that a visitor must show; None where only this machine can visit."""
        self._stack = ExitStack()

    @property
    def address(self) -> str:
        """Address for a browser, with the token where it needs one; set while the page is entered."""
        port, host = self._socket.getsockname()[1], self._host
        if host in {"", "0.0.0.0", "::"}:
            host = socket.gethostname()
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{port}/" + ("" if self.token is None else f"?token={self.token}")

    def __enter__(self) -> "LivePage":
        with ExitStack() as stack:
            self._socket = stack.enter_context(_listen(self._host, self._port))
            self.feed = Feed(self.reader)
            started = Event()
            thread = Thread(target=lambda: asyncio.run(self._serve(started)), name="page", daemon=True)
            thread.start()
            while not started.wait(0.01):
                if not thread.is_alive():
                    raise InputError("the page could not be served; run without it, with --no-page")
            stack.callback(thread.join, _PATIENCE_S)
            stack.callback(self._loop.call_soon_threadsafe, self._over.set)
            stack.callback(self.feed.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    async def _serve(self, started: Event) -> None:
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        crowd: dict[BoundedConnection, None] = {}
        silent = logging.Logger("sliplens.app", logging.CRITICAL)  # failed requests are of no interest
        async with serve(
            self._talk,
            sock=self._socket,
            process_request=Gate(token=self.token, port=self._socket.getsockname()[1]),
            create_connection=partial(BoundedConnection, crowd=crowd),  # pyright: ignore[reportArgumentType]
            open_timeout=REQUEST_S,
            close_timeout=REQUEST_S,
            max_size=MOST_MESSAGE_BYTES,
            compression=None,  # of a JPEG it leaves what it was
            server_header=None,
            logger=silent,
            backlog=MOST_CONNECTIONS // 2,  # taken at once: who has sent a request is heard before it must go
        ):
            self.feed.start(self._loop)
            started.set()
            await self._over.wait()
            for connection in tuple(crowd):
                connection.transport.abort()

    async def _talk(self, connection: ServerConnection) -> None:
        await Client(self.feed, record_into=self.record_into, facts=self.facts).serve(connection)


def _listen(host: str, port: int | None) -> socket.socket:
    """Listen on a port; on any where none was named and the default one is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    reason = ""
    for wanted in (_PORT, 0) if port is None else (port,):
        try:
            return socket.create_server((host, wanted), family=family)
        except OSError as error:
            if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                raise InputError(
                    f"--host {host} is no address of this machine; name one, such as 0.0.0.0 for all"
                ) from None
            reason = error.strerror or str(error)
    raise InputError(f"port {port} of {host} cannot be listened on ({reason}); name another with --port")


class BoundedConnection(ServerConnection):
    """Connection that is cut off where it sends more bytes than a browser does, whatever they mean.

    Of more connections than `MOST_CONNECTIONS` the one that has waited longest for its request to end is cut off, or
    the newest where all are sockets of admitted browsers.
    """

    def __init__(self, *positional: Any, crowd: "dict[BoundedConnection, None]", **settings: Any) -> None:
        super().__init__(*positional, **settings)
        self._crowd, self._allowed_bytes, self._last_s = crowd, float(_MOST_AT_ONCE_BYTES), time.monotonic()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the request."""
        super().connection_made(transport)
        self._crowd[self] = None
        if len(self._crowd) > MOST_CONNECTIONS:
            oldest = next(other for other in self._crowd if other.protocol.state is State.CONNECTING)
            del self._crowd[oldest]
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the crowd."""
        self._crowd.pop(self, None)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take some bytes, of an amount that refills with time."""
        refilled = self._allowed_bytes + (time.monotonic() - self._last_s) * _BYTES_A_SECOND
        self._allowed_bytes, self._last_s = min(_MOST_AT_ONCE_BYTES, refilled) - len(data), time.monotonic()
        if self._allowed_bytes >= 0:
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
            fields = "Max-Age=86400; Path=/; HttpOnly; SameSite=Strict"
            answer.headers["Set-Cookie"] = f"{self._cookie}={self._token}; {fields}"
            return answer
        if path == SOCKET_PATH:
            return None
        if path not in _FILES:
            return _answer(404, "sliplens: there is no such page\n", host=host)
        name, kind = _FILES[path]
        return _answer(200, Path(__file__).with_name(name).read_text(encoding="utf-8"), host=host, kind=kind)

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


def is_loopback(host: str) -> bool:
    """Return True where only this machine can reach an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
