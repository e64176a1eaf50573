"""The page in a real browser, and who may see it."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection
from importlib.metadata import version
from pathlib import Path

import pytest
from hostile_names import FILE_NAME, assert_inert, watch

import sliplens as sl
from sliplens.app import LivePage
from sliplens.app.server import is_loopback
from sliplens.live.reading import Reading, describe_reading
from sliplens.recordings.check import check_dataset

pytest.importorskip("nicegui", reason="the page needs NiceGUI (extra live)")
MARGIN = "parseInt(document.querySelector('.sl-number').textContent)"
CAPTION = "document.querySelector('.sl-caption').textContent"


@dataclass(frozen=True, kw_only=True)
class Served:
    """A page of another process."""

    address: str
    second: str
    """What a second page of that process is answered."""
    taken: str
    """What a page at the same port is answered."""
    record_into: Path


@contextmanager
def served(what: str, into: Path) -> Iterator[Served]:
    """Serve the page of a simulated fingertip or gripper."""
    command = [sys.executable, str(Path(__file__).with_name("served_page.py")), str(into), what]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield Served(**json.loads(process.stdout.readline()), record_into=into)
            assert process.stdin is not None
            process.stdin.close()
            assert process.wait(timeout=60) == 0
        finally:
            process.kill()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Page of a simulated fingertip that nobody presses yet."""
    with served("fingertip", tmp_path_factory.mktemp("page") / FILE_NAME) as page:
        yield page


@pytest.fixture(scope="module")
def seen(browser, page: Served):
    """The page in a window as narrow as a small phone's, with what it asked for and complained of."""
    context = browser.new_context(viewport={"width": 320, "height": 640})
    context.set_default_timeout(30_000)
    window = context.new_page()
    watch(window)
    window.asked, window.said = [], []
    window.on("request", lambda request: window.asked.append(request.url))
    window.on("websocket", lambda socket: window.asked.append(socket.url))
    window.on("console", lambda message: window.said.append(message.text) if message.type == "error" else None)
    window.on("pageerror", lambda error: window.said.append(str(error)))
    window.goto(page.address)
    window.wait_for_function(f"{MARGIN} >= 0")
    yield window
    context.close()


def slide(window, name: str, key: str, until: str) -> None:
    """Move a slider by a key, step by step, until something is so."""
    window.get_by_role("slider", name=name).locator("[tabindex]").first.focus()  # the part that takes the focus
    for _ in range(40):
        window.keyboard.press(key)
        window.wait_for_timeout(100)
        if window.evaluate(until):
            return
    window.wait_for_function(until)


def test_more_pull_means_less_margin_and_more_press_means_more(seen):
    slide(seen, "Press", "PageDown", f"{MARGIN} > 80")  # takes the fingertip in hand; whatever the step, it is pressed
    slide(seen, "Pull", "PageUp", f"{MARGIN} < 20")
    slide(seen, "Pull", "PageDown", f"{MARGIN} > 80")


def test_the_page_has_the_words_of_the_terminal(seen):
    texts = "['.sl-number', '.sl-band', '.sl-words'].map((name) => document.querySelector(name).textContent)"
    number, band, words = seen.evaluate(texts)  # of one message: nothing is drawn in between
    margin, low, high = (int(text) / 100 for text in re.findall(r"\d+", number + band.partition(":")[2]))
    reading = Reading(number=0, time_s=0.0, captured_s=0.0, margin=margin, low=low, high=high)
    assert words.endswith(describe_reading(reading).advice)


def test_the_picture_is_frozen_and_explained_while_the_margin_runs_on(seen):
    slide(seen, "Pull", "PageUp", f"{MARGIN} < 60")
    seen.locator("body").click(position={"x": 2, "y": 2})
    seen.keyboard.press("e")
    # 400 passes of the network, on cores that other tests keep busy
    explained = f"/frozen: frame (\\d+).* Shapley values of markers of frame \\1\\b/.test({CAPTION})"
    seen.wait_for_function(explained, timeout=120_000)
    frozen = seen.evaluate(CAPTION)
    assert "not the recommended map" not in frozen
    slide(seen, "Pull", "PageDown", f"{MARGIN} > 80")
    assert seen.evaluate(CAPTION) == frozen
    seen.locator("body").click(position={"x": 2, "y": 2})
    seen.keyboard.press("f")
    seen.wait_for_function(f"!{CAPTION}.includes('frozen')")
    seen.wait_for_function(
        f"{CAPTION}.includes('not the recommended map: Explain (E) shows Shapley values of markers')"
    )


def test_what_is_recorded_is_a_data_set_that_passes(seen, page: Served):
    seen.get_by_role("button", name="Record").click()
    seen.wait_for_function(
        "parseInt(document.querySelector('.sl-recording').textContent.match(/(\\d+) frames/)?.[1]) >= 4"
    )
    seen.get_by_role("button", name="Stop recording").click()
    seen.get_by_text("recorded into").wait_for()
    assert check_dataset(page.record_into) == ()


def test_a_narrow_window_needs_no_scrolling_sideways(seen):
    assert seen.evaluate("document.documentElement.scrollWidth") <= 320


def test_nothing_is_asked_of_anyone_else_and_nothing_complained_of(seen, page: Served):
    own = page.address.removeprefix("http://")
    elsewhere = [url for url in seen.asked if own not in url and not url.startswith(("data:", "blob:"))]
    assert seen.asked
    assert not elsewhere
    assert not seen.said


def test_hostile_names_do_nothing_on_the_page(seen):
    assert_inert(seen)  # the folder of the recording


@pytest.mark.parametrize(
    "path",
    [
        "etc/passwd",
        "../../../../etc/passwd",
        "images/..%2F..%2F..%2Fetc%2Fpasswd/0",
        "frames/..%2F..%2Fetc%2Fpasswd",
        "_nicegui/{version}/static/..%2F..%2F..%2F..%2F..%2F..%2F..%2F..%2Fetc%2Fpasswd",
        "_nicegui/{version}/static/%2Fetc%2Fpasswd",
        "_nicegui/{version}/components/..%2F..%2F..%2Fetc%2Fpasswd",
        "_nicegui/{version}/resources/x/..%2F..%2F..%2F..%2Fetc%2Fpasswd",
        "_nicegui/{version}/esm/x/..%2F..%2F..%2F..%2Fetc%2Fpasswd",
    ],
)
def test_no_path_of_a_request_reaches_the_disk(page: Served, path: str):
    connection = HTTPConnection(page.address.removeprefix("http://").rstrip("/"), timeout=60)
    connection.request("GET", "/" + path.format(version=version("nicegui")))  # as it stands: urllib would shorten it
    answer = connection.getresponse()
    assert answer.status in {400, 403, 404}
    assert b"root:" not in answer.read()
    connection.close()


def test_one_page_at_a_time_and_a_port_that_is_taken(page: Served):
    assert "close that one first" in page.second
    assert "name another with --port" in page.taken


@pytest.mark.parametrize(
    ("host", "own"), [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("robot", False)]
)
def test_others_need_a_token(host: str, own: bool):
    assert is_loopback(host) is own
    assert (LivePage(sl.LiveReader("simulated"), host=host).token is None) is own


def test_a_gripper_answers_water_a_wet_skin_and_another_controller(browser, tmp_path: Path):
    told = "document.querySelector('.sl-grip').textContent"
    least = f"parseFloat({told}.match(/([\\d.]+) N would hold/)?.[1] ?? 0)"
    with served("gripper", tmp_path / "recorded") as page:
        context = browser.new_context(viewport={"width": 320, "height": 640})
        context.set_default_timeout(60_000)
        window = context.new_page()
        window.goto(page.address)
        window.wait_for_function(f"{least} > 0 && {told}.includes('margin: no margin: ')")
        light = window.evaluate(least)
        slide(window, "Pour water", "PageUp", f"{least} > {2 * light}")
        window.get_by_label("held by").click()
        window.get_by_role("option", name="oracle", exact=True).click()  # which lets nothing fall
        window.wait_for_function(f"{told}.includes('oracle: ')")
        heavy = window.evaluate(least)
        window.get_by_role("switch", name="Wet").click()
        window.wait_for_function(f"{least} > {1.8 * heavy}")  # half the friction
        assert window.evaluate("document.documentElement.scrollWidth") <= 320
        window.get_by_role("button", name="Grip again").click()
        window.wait_for_function(f"{told}.includes('open') || {told}.includes('closing')")
        context.close()
