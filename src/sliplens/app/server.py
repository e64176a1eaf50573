"""Server of the page: on this machine alone, or with a token."""

import asyncio
import errno
import secrets
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from ipaddress import ip_address
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, TypeVar

from sliplens.errors import InputError
from sliplens.extras import require_packages
from sliplens.recordings.trial import TrialFacts

if TYPE_CHECKING:
    from fastapi import FastAPI
    from starlette.types import ASGIApp

    from sliplens.app.feed import Feed
    from sliplens.live.loop import LiveReader

_PORT = 8090
_PATIENCE_S = 10.0
_ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 16 16"><path d="M2 12a6 6 0 1 1 12 0" fill="none" '
    'stroke="#009E73" stroke-width="3"/><path d="M8 12 5 6" stroke="#D55E00" stroke-width="2"/></svg>'
)


_Page = TypeVar("_Page", bound="LivePage")


class LivePage:
    """Page of a reader, for browsers; a context manager that serves it while it is entered.

    Several browsers see the same frames, and cost one inference. One page at a time runs in a process.

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
        require_packages("nicegui", extra="live", purpose="the page")
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
        # explainers, and with them torch
        from sliplens.app.connections import Gate  # noqa: PLC0415
        from sliplens.app.feed import Feed  # noqa: PLC0415
        from sliplens.app.page import Hand  # noqa: PLC0415

        with ExitStack() as stack:
            self._socket = stack.enter_context(_listen(self._host, self._port))
            self.feed, self.hand = Feed(self.reader), Hand()
            stack.callback(self.feed.close)
            app = _application()
            if getattr(app.state, "page", None) is not None:
                raise InputError("a page is being shown by this process already; close that one first")
            app.state.page = self
            stack.callback(setattr, app.state, "page", None)
            gate = Gate(app, token=self.token, port=self._socket.getsockname()[1])
            stack.enter_context(_serving(gate, self._socket, self.feed))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


@cache
def _application() -> "FastAPI":
    """Make the one application of NiceGUI in this process; it shows the page that is entered."""
    import nicegui  # noqa: PLC0415 (the extra)
    from fastapi import FastAPI  # noqa: PLC0415 (comes with it)
    from starlette.middleware.gzip import GZipMiddleware  # noqa: PLC0415
    from starlette.websockets import WebSocket  # noqa: PLC0415

    from sliplens.app.page import build_live  # noqa: PLC0415 (torch comes with it)

    _sign_scripts()
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

    @app.websocket("/frames/{name}")
    async def frames(socket: WebSocket, name: str) -> None:
        client = app.state.page.feed.expected.get(name)
        await (socket.close(code=1008) if client is None else client.serve(socket))

    @nicegui.ui.page("/", title="sliplens", dark=None)
    def index() -> None:
        build_live(app.state.page)

    nicegui.ui.run_with(
        app,
        title="sliplens",
        favicon=_ICON,
        dark=None,
        tailwind=False,
        binding_refresh_interval=0.25,
        show_welcome_message=False,
        # the usual level takes ten times as long, of the cores that read
        gzip_middleware_factory=partial(GZipMiddleware, compresslevel=1),
    )
    return app


def _sign_scripts() -> None:
    """Give NiceGUI's own scripts the nonce of the answer, in its template, before any value is in it."""
    from jinja2 import ChoiceLoader, DictLoader  # noqa: PLC0415 (with the page alone)
    from nicegui.client import templates  # noqa: PLC0415 (the extra)

    loader = templates.env.loader
    assert loader is not None
    text, *_ = loader.get_source(templates.env, "index.html")
    signed = text.replace("<script", "<script nonce=\"{{ request.scope['nonce'] }}\"")
    templates.env.loader = ChoiceLoader([DictLoader({"index.html": signed}), loader])


@contextmanager
def _serving(app: "ASGIApp", listening: socket.socket, feed: "Feed") -> Iterator[None]:
    """Serve in a thread that has started when this is entered and ended when it is left."""
    import nicegui  # noqa: PLC0415 (the extra)
    import uvicorn  # noqa: PLC0415 (comes with it)

    from sliplens.app.connections import server_config  # noqa: PLC0415 (needs it)

    server = uvicorn.Server(server_config(app))

    async def serve() -> None:
        feed.start(asyncio.get_running_loop())
        # not by the lifespan that `ui.run_with` makes: it walks over all objects of the process, and a tuple that
        # another thread is just making then fails with a SystemError
        async with nicegui.app.router.lifespan_context(nicegui.app):
            await server.serve([listening])

    thread = Thread(target=lambda: asyncio.run(serve()), daemon=True)
    thread.start()
    try:
        while not server.started:
            thread.join(0.01)
            if not thread.is_alive():
                raise InputError("the page could not be served; run without it, with --no-page")
        yield
    finally:
        server.should_exit = True
        thread.join(_PATIENCE_S)


def is_loopback(host: str) -> bool:
    """Return True where only this machine can reach an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


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
