"""Connections of a page's server, bounded in bytes, time and number before anybody is let in."""

import asyncio
from typing import TYPE_CHECKING

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from sliplens.app.server import MOST_BYTES, Ration

if TYPE_CHECKING:
    from starlette.types import ASGIApp

REQUEST_S = 10.0
"""Longest time in seconds from an open connection, or the last answer on it, to the end of a request."""
ANSWER_S = 60.0
"""Longest time in seconds for an answer: a script of a megabyte through a slow network."""
MOST_CONNECTIONS = 128
"""A browser opens six, and two sockets. Far below the 1,024 files that a process may open, cameras among them."""
MOST_HEADER_BYTES = 2**14
"""Request line and headers, as nginx and h11 have it."""


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
        self._bytes = Ration(MOST_BYTES, at_once=4 * MOST_BYTES)

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


def server_config(app: "ASGIApp") -> uvicorn.Config:
    """Settings of a server all of whose connections are bounded."""
    return uvicorn.Config(
        app,
        log_level="error",
        access_log=False,
        loop="asyncio",
        lifespan="off",
        backlog=MOST_CONNECTIONS // 2,  # taken at once: who has sent a request is heard before others make it go
        http=HttpConnection,
        h11_max_incomplete_event_size=MOST_HEADER_BYTES,
        ws=SocketConnection,
        ws_max_size=MOST_BYTES,
        ws_per_message_deflate=False,  # of a JPEG it leaves what it was
        timeout_graceful_shutdown=1,
    )
