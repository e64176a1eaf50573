"""Server of the page: on this machine alone, or with a token."""

import asyncio
import errno
import re
import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import parse_qs

from sliplens.errors import InputError
from sliplens.extras import require_packages
from sliplens.recordings.trial import TrialFacts

if TYPE_CHECKING:
    from fastapi import FastAPI
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from sliplens.app.feed import Feed
    from sliplens.live.loop import LiveReader

_PORT = 8090
_PATIENCE_S = 10.0
_DAY_S = 24 * 3600
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[\w.-]+)(:\d+)?", re.ASCII)
MOST_BYTES = 2**18
"""Of a message of a browser, and of what it posts."""
_MESSAGES_A_SECOND = 200
"""Of a browser: it answers pictures, and tells where sliders are."""
_PAGES_A_SECOND, _PAGES_AT_ONCE = 2, 50
"""Pages that may be opened: each is kept for a minute, whether somebody looks or not."""
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

    def build(self) -> None:
        """Build the page of one client, where NiceGUI asks for it."""
        from sliplens.app.page import build_live  # noqa: PLC0415 (torch comes with it)

        build_live(self)


@cache
def _application() -> "FastAPI":
    """Make the one application of NiceGUI in this process; it shows the page that is entered."""
    import nicegui  # noqa: PLC0415 (the extra)
    from fastapi import FastAPI  # noqa: PLC0415 (comes with it)
    from starlette.middleware.gzip import GZipMiddleware  # noqa: PLC0415
    from starlette.websockets import WebSocket  # noqa: PLC0415

    _sign_scripts()
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

    @app.websocket("/frames/{name}")
    async def frames(socket: WebSocket, name: str) -> None:
        client = app.state.page.feed.expected.get(name)
        await (socket.close(code=1008) if client is None else client.serve(socket))

    @nicegui.ui.page("/", title="sliplens", dark=None)
    def index() -> None:
        app.state.page.build()

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


class Ration:
    """Allowance that refills with time: an amount a second, up to the amount at once."""

    def __init__(self, a_second: int, *, at_once: int) -> None:
        self._a_second, self._most = a_second, at_once
        self._rest, self._last_s = float(at_once), time.monotonic()

    def take(self, amount: int = 1) -> bool:
        """Take an amount; False where less is left."""
        now_s = time.monotonic()
        self._rest = min(self._most, self._rest + (now_s - self._last_s) * self._a_second)
        self._last_s = now_s
        if self._rest < amount:
            return False
        self._rest -= amount
        return True


class Gate:
    """Access control and rate limits of the page: ASGI middleware around everything.

    Without a token it admits requests to this machine's own names: a page of another site that resolves a name of its
    own to this machine is refused. With one it admits whoever shows it, once in the address and from then on in a
    cookie. A page of another site can neither open a socket, send anything nor load a part of this one. A client that
    sends long messages, or many, is cut off.
    """

    def __init__(self, app: "ASGIApp", *, token: str | None, port: int) -> None:
        self.app, self._token, self._cookie = app, token, f"sliplens-{port}"
        self._pages = Ration(_PAGES_A_SECOND, at_once=_PAGES_AT_ONCE)

    async def __call__(self, scope: "Scope", receive: "Receive", send: "Send") -> None:
        """Pass on, send to the page without the token in its address, or refuse."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        scope["nonce"] = nonce = secrets.token_urlsafe(16)
        send = _guarded(send, headers.get("host", ""), nonce)
        if (why := self._refusal(headers)) is not None:
            await _refuse(scope, send, 403, why)
        elif self._token is None or self._shows(_cookie(headers.get("cookie", ""), self._cookie)):
            if scope["type"] == "http" and scope["path"] == "/" and not self._pages.take():
                await _refuse(scope, send, 429, "too many pages are opened at once; wait some seconds")
            else:
                await self.app(scope, _rationed(receive, send), send)
        elif scope["type"] == "http" and self._shows(_token_of(scope)):
            cookie = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict; Max-Age={_DAY_S}"
            # whatever the path was: of //elsewhere/ a browser makes another host
            await _answer(send, 303, [("location", "/"), ("set-cookie", cookie)], "")
        else:
            await _refuse(scope, send, 401, "open the whole address that sliplens printed, with its token")

    def _refusal(self, headers: dict[str, str]) -> str | None:
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


def _cookie(header: str, name: str) -> str:
    try:
        cookie = SimpleCookie(header).get(name)
    except CookieError:
        return ""
    return "" if cookie is None else cookie.value


def _token_of(scope: "Scope") -> str:
    return parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]


def _rationed(receive: "Receive", send: "Send") -> "Receive":
    """Limit length and rate of messages; the page takes a client beyond them for disconnected."""
    ration, bytes_left = Ration(_MESSAGES_A_SECOND, at_once=2 * _MESSAGES_A_SECOND), MOST_BYTES

    async def received() -> "Message":
        nonlocal bytes_left
        message = await receive()
        if message["type"] == "http.request":
            bytes_left -= len(message.get("body", b""))
            return message if bytes_left >= 0 else {"type": "http.disconnect"}
        if message["type"] == "websocket.receive":
            size = len(message.get("bytes") or b"") + len(message.get("text") or "")
            if size > MOST_BYTES or not ration.take():
                await send({"type": "websocket.close", "code": 1008, "reason": "too much was sent"})
                return {"type": "websocket.disconnect", "code": 1008}
        return message

    return received


def _guarded(send: "Send", host: str, nonce: str) -> "Send":
    """Add the headers by which a page loads nothing from elsewhere and is not shown within another one.

    Inline scripts run where they carry the nonce: NiceGUI's own (`_sign_scripts`).
    """
    sockets = f" ws://{host} wss://{host}" if _HOST.fullmatch(host) else ""  # Safari does not take them for 'self'
    policy = (
        f"default-src 'self'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "  # Vue makes templates in the browser
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; object-src 'none'; "
        f"connect-src 'self'{sockets}; frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
    )

    async def sent(message: "Message") -> None:
        if message["type"] == "http.response.start":
            more = {
                "content-security-policy": policy,
                "cross-origin-resource-policy": "same-origin",
                "referrer-policy": "no-referrer",
                "x-content-type-options": "nosniff",
            }
            added = [(name.encode(), value.encode("latin-1")) for name, value in more.items()]
            message = {**message, "headers": [*message.get("headers", []), *added]}
        await send(message)

    return sent


async def _refuse(scope: "Scope", send: "Send", status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": why[:120]})
    else:
        await _answer(send, status, [("content-type", "text/plain; charset=utf-8")], f"sliplens: {why}\n")


async def _answer(send: "Send", status: int, headers: list[tuple[str, str]], text: str) -> None:
    encoded = [(name.encode(), value.encode("latin-1")) for name, value in headers]
    await send({"type": "http.response.start", "status": status, "headers": encoded})
    await send({"type": "http.response.body", "body": text.encode()})
