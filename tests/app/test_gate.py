"""Who is let in: those who know the token, from pages of no other site."""

import asyncio

import pytest

from sliplens.app.connections import Gate

TOKEN = "a-token"


async def _inside(scope, receive, send) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def visit(
    token: str | None = TOKEN, *, kind: str = "http", path: str = "/", query: str = "", **headers: str
) -> list[dict]:
    """What the gate sends to a visitor."""
    sent: list[dict] = []

    async def send(message) -> None:
        sent.append(message)

    async def receive() -> dict:
        return {}

    pairs = [(name.encode(), value.encode()) for name, value in ({"host": "robot:8090"} | headers).items()]
    scope = {"type": kind, "path": path, "query_string": query.encode(), "headers": pairs}
    asyncio.run(Gate(_inside, token=token, port=8090)(scope, receive, send))
    return sent


def test_the_token_of_the_address_becomes_a_cookie_that_lets_in():
    [start, _] = visit(query=f"token={TOKEN}")
    headers = dict(start["headers"])
    assert (start["status"], headers[b"location"]) == (303, b"/")
    cookie = headers[b"set-cookie"].decode()
    assert "HttpOnly" in cookie
    assert "samesite=strict" in cookie.lower()
    [start, body] = visit(cookie=cookie.partition(";")[0])
    assert (start["status"], body["body"]) == (200, b"inside")


@pytest.mark.parametrize(
    "path", ["//evil.example/", "/\\evil.example/", "https://evil.example/", "/%2Fevil.example", "x"]
)
@pytest.mark.parametrize("token", [TOKEN, ""])
def test_no_path_leads_elsewhere(path: str, token: str):
    [start, _] = visit(path=path, query=f"token={token}")
    assert dict(start["headers"]).get(b"location", b"/") == b"/"


@pytest.mark.parametrize(
    "words", [{}, {"query": "token=another"}, {"cookie": "sliplens-8090=another"}, {"cookie": ";;="}]
)
def test_without_the_token_nobody_is_let_in(words: dict[str, str]):
    [start, body] = visit(**words)
    assert start["status"] == 401
    assert b"with its token" in body["body"]
    [closed] = visit(kind="websocket", **words)
    assert closed["type"] == "websocket.close"


def test_a_page_of_another_site_is_refused_whatever_it_knows():
    known = {"cookie": f"sliplens-8090={TOKEN}"}
    assert visit(origin="http://robot:8090", **known)[0]["status"] == 200
    assert visit(origin="http://evil.example", **known)[0]["status"] == 403
    assert visit(kind="websocket", origin="null", **known)[0]["type"] == "websocket.close"


def test_without_a_token_this_machine_is_called_by_its_own_name():
    assert visit(None, host="127.0.0.1:8090")[0]["status"] == 200
    assert visit(None, host="[::1]:8090")[0]["status"] == 200
    assert visit(None, host="evil.example:8090")[0]["status"] == 403


def policy(**headers: str) -> dict[str, str]:
    [start, *_] = visit(None, **({"host": "localhost:8090"} | headers))
    told = dict(start["headers"])[b"content-security-policy"].decode()
    return dict(part.strip().split(" ", 1) for part in told.split(";"))


def test_what_is_let_in_may_load_nothing_from_elsewhere():
    told = policy()
    assert told["default-src"] == "'self'"
    assert "http" not in " ".join(told.values())
    assert policy(host="a; script-src *")["script-src"].startswith("'self' 'nonce-")  # a refusal has it too


def test_scripts_within_a_page_run_with_the_nonce_of_their_answer_alone():
    first, second = policy()["script-src"], policy()["script-src"]
    assert "unsafe-inline" not in first
    assert "'nonce-" in first
    assert first != second


def test_a_page_of_another_site_may_lead_here_and_load_no_part():
    asked = {"host": "127.0.0.1:8090", "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert visit(None, **asked, **{"sec-fetch-dest": "document"})[0]["status"] == 200
    assert visit(None, **asked, **{"sec-fetch-dest": "iframe"})[0]["status"] == 403
    assert visit(None, **(asked | {"sec-fetch-mode": "no-cors", "sec-fetch-dest": "image"}))[0]["status"] == 403
    assert visit(None, **(asked | {"sec-fetch-site": "same-origin"}))[0]["status"] == 200


@pytest.mark.parametrize("host", ["", "[::1", "localhost:8090/../", "localhost@evil.example", "127.0.0.1:80:90"])
def test_a_host_that_is_none_is_refused(host: str):
    assert visit(None, host=host)[0]["status"] == 403


def test_pages_that_are_opened_too_fast_are_refused():
    gate, sent = Gate(_inside, token=None, port=8090), []
    scope = {"type": "http", "path": "/", "query_string": b"", "headers": [(b"host", b"localhost")]}

    async def send(message) -> None:
        sent.append(message.get("status"))

    async def receive() -> dict:
        return {}

    async def many() -> None:
        for _ in range(60):
            await gate(dict(scope), receive, send)

    asyncio.run(many())
    assert set(sent) == {200, 429, None}
    assert 45 < sent.count(200) < 60


@pytest.mark.parametrize("messages", [["x" * 300_000], ["x"] * 1000], ids=["long", "many"])
def test_who_sends_too_much_is_cut_off(messages: list[str]):
    taken, sent = [], []

    async def inside(scope, receive, send) -> None:
        while (message := await receive())["type"] == "websocket.receive":
            taken.append(message["text"])

    async def send(message) -> None:
        sent.append(message)

    waiting = iter(messages)

    async def receive() -> dict:
        return {"type": "websocket.receive", "text": next(waiting)}

    scope = {"type": "websocket", "path": "/", "query_string": b"", "headers": [(b"host", b"localhost")]}
    asyncio.run(Gate(inside, token=None, port=8090)(scope, receive, send))
    assert [(message["type"], message["code"]) for message in sent] == [("websocket.close", 1008)]
    assert len(taken) < len(messages)
