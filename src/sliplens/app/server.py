"""Server of the page: on this machine alone, or with a token."""

import asyncio
import errno
import logging
import secrets
import socket
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, TypeVar

from sliplens.errors import InputError
from sliplens.extras import require_packages
from sliplens.recordings.trial import TrialFacts

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

    from sliplens.live.loop import LiveReader

_PORT = 8090
_PATIENCE_S = 10.0
_Page = TypeVar("_Page", bound="LivePage")


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
        If the packages of the extra `live` are missing, or the port is taken.

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
        reader: "LiveReader",
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        record_into: Path | str = "recorded",
        facts: TrialFacts | None = None,
    ) -> None:
        require_packages("websockets", extra="live", purpose="the page")
        from sliplens.app.access import is_loopback  # noqa: PLC0415 (needs it)

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

    def __enter__(self: _Page) -> _Page:
        from sliplens.app.feed import Feed  # noqa: PLC0415 (explainers, and with them torch)

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
        from websockets.asyncio.server import serve  # noqa: PLC0415 (an extra)

        from sliplens.app import access  # noqa: PLC0415 (needs it)

        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        crowd: dict[access.BoundedConnection, None] = {}
        silent = logging.Logger("sliplens.app", logging.CRITICAL)  # of failed requests nobody wants to read
        async with serve(
            self._talk,
            sock=self._socket,
            process_request=access.Gate(token=self.token, port=self._socket.getsockname()[1]),
            create_connection=partial(access.BoundedConnection, crowd=crowd),  # pyright: ignore[reportArgumentType]
            open_timeout=access.REQUEST_S,
            close_timeout=access.REQUEST_S,
            max_size=access.MOST_MESSAGE_BYTES,
            compression=None,  # of a JPEG it leaves what it was
            server_header=None,
            logger=silent,
            backlog=access.MOST_CONNECTIONS // 2,  # taken at once: who has sent a request is heard before it must go
        ):
            self.feed.start(self._loop)
            started.set()
            await self._over.wait()
            for connection in tuple(crowd):
                connection.transport.abort()

    async def _talk(self, connection: "ServerConnection") -> None:
        from sliplens.app.client import Client  # noqa: PLC0415 (explainers, and with them torch)

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
