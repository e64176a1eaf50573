"""Who is let in: those who know the token, from pages of no other site."""

import asyncio

import pytest

from sliplens.app.server import Gate

TOKEN = "a-token"


async def _inside(scope, receive, send) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def visit(token: str | None = TOKEN, *, kind: str = "http", query: str = "", **headers: str) -> list[dict]:
    """What the gate sends to a visitor."""
    sent: list[dict] = []

    async def send(message) -> None:
        sent.append(message)

    async def receive() -> dict:
        return {}

    pairs = [(name.encode(), value.encode()) for name, value in ({"host": "robot:8090"} | headers).items()]
    scope = {"type": kind, "path": "/", "query_string": query.encode(), "headers": pairs}
    asyncio.run(Gate(_inside, token=token, port=8090)(scope, receive, send))
    return sent


def test_the_token_of_the_address_becomes_a_cookie_that_lets_in():
    [start, _] = visit(query=f"token={TOKEN}")
    headers = dict(start["headers"])
    assert (start["status"], headers[b"location"]) == (303, b"/")
    cookie = headers[b"set-cookie"].decode()
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    [start, body] = visit(cookie=cookie.partition(";")[0])
    assert (start["status"], body["body"]) == (200, b"inside")


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


def test_what_is_let_in_may_load_nothing_from_elsewhere():
    [start, _] = visit(None, host="localhost:8090")
    policy = dict(start["headers"])[b"content-security-policy"].decode()
    assert "default-src 'self'" in policy
    assert "http:" not in policy
