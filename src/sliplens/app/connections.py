"""Access to a page's server: whom it admits, and connections bounded in bytes, time and number."""

import asyncio
import re
import secrets
import time

import h11
import uvicorn
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from sliplens.app.server import is_loopback

REQUEST_S = 10.0
"""Longest time in seconds from an open connection, or the last answer on it, to the end of a request."""
ANSWER_S = 60.0
"""Longest time in seconds for an answer: a script of a megabyte through a slow network."""
MOST_CONNECTIONS = 128
"""A browser opens six, and two sockets. Far below the 1,024 files that a process may open, cameras among them."""
_MOST_HEADER_BYTES = 2**14
_MOST_BYTES = 2**18
"""Of a message of a browser, and of what it posts."""
_MESSAGES_A_SECOND = 200
_PAGES_A_SECOND, _PAGES_AT_ONCE = 2, 50
"""Pages that may be opened: each is kept for a minute, whether somebody looks or not."""
_DAY_S = 24 * 3600
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[\w.-]+)(:\d+)?", re.ASCII)


class _Ration:
    """Allowance that refills with time: an amount a second, up to the amount at once."""

    def __init__(self, a_second: int, *, at_once: int) -> None:
        self._a_second, self._most = a_second, at_once
        self._rest, self._last_s = float(at_once), time.monotonic()

    def take(self, amount: int = 1) -> bool:
        """Take an amount; False where less is left."""
        now_s = time.monotonic()
        self._rest = min(self._most, self._rest + (now_s - self._last_s) * self._a_second)
        self._last_s = now_s
        enough = self._rest >= amount
        self._rest -= amount if enough else 0
        return enough


class Gate:
    """Access control and rate limits of the page: ASGI middleware around everything.

    Without a token it admits requests to this machine's own names: a page of another site that resolves a name of its
    own to this machine is refused. With one it admits whoever shows it, once in the address and from then on in a
    cookie. A page of another site can neither open a socket, send anything nor load a part of this one. A client that
    sends long messages, or many, is cut off.
    """

    def __init__(self, app: ASGIApp, *, token: str | None, port: int) -> None:
        self.app, self._token, self._cookie = app, token, f"sliplens-{port}"
        self._pages = _Ration(_PAGES_A_SECOND, at_once=_PAGES_AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, send to the page without the token in its address, or refuse."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        visit, is_http = HTTPConnection(scope), scope["type"] == "http"
        scope["nonce"] = nonce = secrets.token_urlsafe(16)
        send = _guarded(send, visit.headers.get("host", ""), nonce)
        answer: ASGIApp
        if (why := self._refusal(visit.headers)) is not None:
            answer = _refusal_of(scope, 403, why)
        elif self._token is None or self._shows(visit.cookies.get(self._cookie, "")):
            answer, receive = self.app, _rationed(receive, send)
            if is_http and scope["path"] == "/" and not self._pages.take():
                answer = _refusal_of(scope, 429, "too many pages are opened at once; wait some seconds")
        elif is_http and self._shows(visit.query_params.get("token", "")):
            # whatever the path was: of //elsewhere/ a browser makes another host
            answer = RedirectResponse("/", 303)
            answer.set_cookie(self._cookie, self._token or "", max_age=_DAY_S, httponly=True, samesite="strict")
        else:
            answer = _refusal_of(scope, 401, "open the whole address that sliplens printed, with its token")
        await answer(scope, receive, send)

    def _refusal(self, headers: Headers) -> str | None:
        host = headers.get("host", "")
        if (parts := _HOST.fullmatch(host)) is None:
            return "the request names no host; open the address that sliplens printed"
        if self._token is None and not is_loopback(parts[1].strip("[]").lower()):
            return f"this page is for this machine alone, and not at {host}; start it with --host to open it to others"
        origin = headers.get("origin")
        if origin is not None and origin.partition("://")[2] != host:
            return "a page of another site may not use this one"
        # browsers tell who asks: what others may do is to lead a person here
        leads = headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document"
        if headers.get("sec-fetch-site", "none") not in {"none", "same-origin"} and not leads:
            return "a page of another site may not load parts of this one"
        return None

    def _shows(self, token: str) -> bool:
        return self._token is not None and secrets.compare_digest(token.encode(), self._token.encode())


def _refusal_of(scope: Scope, status: int, why: str) -> ASGIApp:
    if scope["type"] == "websocket":
        return WebSocketClose(1008, why[:120])
    return PlainTextResponse(f"sliplens: {why}\n", status)


def _rationed(receive: Receive, send: Send) -> Receive:
    """Limit length and rate of messages; the page takes a client beyond them for disconnected."""
    ration, bytes_left = _Ration(_MESSAGES_A_SECOND, at_once=2 * _MESSAGES_A_SECOND), _MOST_BYTES

    async def received() -> Message:
        nonlocal bytes_left
        message = await receive()
        if message["type"] == "http.request":
            bytes_left -= len(message.get("body", b""))
            return message if bytes_left >= 0 else {"type": "http.disconnect"}
        if message["type"] == "websocket.receive":
            size = len(message.get("bytes") or b"") + len(message.get("text") or "")
            if size > _MOST_BYTES or not ration.take():
                await send({"type": "websocket.close", "code": 1008, "reason": "too much was sent"})
                return {"type": "websocket.disconnect", "code": 1008}
        return message

    return received


def _guarded(send: Send, host: str, nonce: str) -> Send:
    """Add the headers by which a page loads nothing from elsewhere and is not shown within another one."""
    sockets = f" ws://{host} wss://{host}" if _HOST.fullmatch(host) else ""  # Safari does not take them for 'self'
    policy = (
        f"default-src 'self'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "  # Vue makes templates in the browser
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; object-src 'none'; "
        f"connect-src 'self'{sockets}; frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
    )

    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.append("content-security-policy", policy)
            headers.append("cross-origin-resource-policy", "same-origin")
            headers.append("referrer-policy", "no-referrer")
            headers.append("x-content-type-options", "nosniff")
        await send(message)

    return sent


class HttpConnection(H11Protocol):
    """HTTP connection that is cut off when a request, or its answer, takes too long.

    h11 bounds request line, headers and trailers; the gate bounds the body of a request that it lets in. Of more
    connections than `MOST_CONNECTIONS` the one that has waited longest for a request is cut off.
    """

    waiting_since_s: float | None = None
    """Time since which a request is awaited, on the loop's clock; None while one is answered."""
    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Wait for the first request."""
        super().connection_made(transport)
        self._set_deadline()
        if len(self.connections) > MOST_CONNECTIONS:
            others = (other for other in self.connections if isinstance(other, HttpConnection))
            waiting = {other: other.waiting_since_s for other in others if other.waiting_since_s}
            min(waiting, key=lambda other: waiting[other]).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take a part of a request."""
        super().data_received(data)
        if (self.waiting_since_s is not None) != self._waits:
            self._set_deadline()

    def on_response_complete(self) -> None:
        """Wait for the next request; what was answered before it was there whole is not read on."""
        unread = self.conn.their_state is h11.SEND_BODY
        super().on_response_complete()
        if unread:
            self.transport.close()
        self._set_deadline()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the deadline."""
        super().connection_lost(exc)
        self._end_deadline()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand on to a socket, whose request is there whole."""
        super().handle_websocket_upgrade(event)
        self._end_deadline()

    @property
    def _waits(self) -> bool:
        return self.conn.their_state in {h11.IDLE, h11.SEND_BODY}

    def _set_deadline(self) -> None:
        self._end_deadline()
        if self.transport.get_protocol() is self:  # else it has become a socket
            self.waiting_since_s = self.loop.time() if self._waits else None
            self._deadline = self.loop.call_later(REQUEST_S if self._waits else ANSWER_S, self.transport.abort)

    def _end_deadline(self) -> None:
        self.waiting_since_s = None
        if self._deadline is not None:
            self._deadline.cancel()


class SocketConnection(WebSocketsSansIOProtocol):
    """Websocket that is cut off where it sends more bytes than a page does, whatever they mean."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to count."""
        super().connection_made(transport)
        self._bytes = _Ration(_MOST_BYTES, at_once=4 * _MOST_BYTES)

    def data_received(self, data: bytes) -> None:
        """Take some bytes."""
        if self._bytes.take(len(data)):
            super().data_received(data)
        else:
            self.transport.abort()

    def keepalive_timeout(self) -> None:
        """Cut off a peer that answers no ping, which may not read what is left to send either."""
        super().keepalive_timeout()
        self.transport.abort()


def server_config(app: ASGIApp) -> uvicorn.Config:
    """Make the settings of a server all of whose connections are bounded."""
    return uvicorn.Config(
        app,
        log_level="error",
        access_log=False,
        loop="asyncio",
        lifespan="off",
        backlog=MOST_CONNECTIONS // 2,  # taken at once: who has sent a request is heard before others make it go
        http=HttpConnection,
        h11_max_incomplete_event_size=_MOST_HEADER_BYTES,
        ws=SocketConnection,
        ws_max_size=_MOST_BYTES,
        ws_per_message_deflate=False,  # of a JPEG it leaves what it was
        timeout_graceful_shutdown=1,
    )
