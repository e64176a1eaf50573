"""The page in a real browser."""

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path

import pytest
from hostile_names import FILE_NAME, assert_inert, watch
from scripted import plain_reader

from sliplens.app import LivePage
from sliplens.errors import InputError
from sliplens.grip.source import GripSource
from sliplens.live import LiveSource, SimulatedSource, SlipDetector
from sliplens.live.reading import Reading, describe_reading
from sliplens.recordings.check import check_dataset

pytest.importorskip("websockets", reason="the page needs websockets (extra live)")
MARGIN = "parseInt(document.querySelector('#number').textContent)"
CAPTION = "document.querySelector('#caption').textContent"


@contextmanager
def served(source: LiveSource, network: str | None, into: Path, *, markers: bool = False) -> Iterator[LivePage]:
    """Serve the page of a source."""
    # a busy machine drops frames, and health and markers would withhold margins for that
    reader = plain_reader(source, network, slip=SlipDetector if markers else None)
    with reader, LivePage(reader, port=0, record_into=into) as page:
        yield page


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LivePage]:
    """Page of a simulated fingertip that nobody presses yet."""
    source = SimulatedSource(rate_hz=10.0)
    source.load(normal_force_n=0.0, tangential_force_n=0.0)
    with served(source, "chromatouch-difference", tmp_path_factory.mktemp("page") / FILE_NAME) as page:
        yield page


def open_page(browser, page: LivePage, *, width: int = 320, height: int = 640):
    """Open the page, in a window as narrow as a small phone's, with what it asked for and complained of."""
    context = browser.new_context(viewport={"width": width, "height": height})
    context.set_default_timeout(30_000)
    window = context.new_page()
    watch(window)
    window.asked, window.said = [], []
    window.on("request", lambda request: window.asked.append(request.url))
    window.on("websocket", lambda socket: window.asked.append(socket.url))
    window.on("console", lambda message: window.said.append(message.text) if message.type == "error" else None)
    window.on("pageerror", lambda error: window.said.append(str(error)))
    window.goto(page.address)
    return window


@pytest.fixture(scope="module")
def seen(browser, page: LivePage):
    window = open_page(browser, page)
    wait_until(window, f"{MARGIN} >= 0")
    yield window
    window.context.close()


def wait_until(window, condition: str, *, within_s: float = 240.0) -> None:
    """Wait until something is so; Playwright's own way runs text as code, which the page forbids."""
    end_s = time.monotonic() + within_s
    while not window.evaluate(condition):
        assert time.monotonic() < end_s, condition
        window.wait_for_timeout(50)


def slide(window, name: str, key: str, until: str) -> None:
    """Move a slider by a key, step by step, until something is so."""
    window.get_by_role("slider", name=name).focus()
    for _ in range(40):
        window.keyboard.press(key)
        window.wait_for_timeout(100)
        if window.evaluate(until):
            return
    wait_until(window, until)


def test_more_pull_means_less_margin_and_more_press_means_more(seen):
    slide(seen, "Press", "PageUp", f"{MARGIN} > 80")
    slide(seen, "Pull", "PageUp", f"{MARGIN} < 20")
    slide(seen, "Pull", "PageDown", f"{MARGIN} > 80")


def test_sliders_show_the_forces_that_act(seen, page: LivePage):
    source = page.reader.source
    assert isinstance(source, SimulatedSource)
    shown = "[...document.querySelectorAll('#fingertip [type=range]')].map(({ value }) => Number(value))"
    pressed, _ = seen.evaluate(shown)
    seen.evaluate("document.querySelector('[name=pull_n]').focus()")
    seen.keyboard.press("End")
    # friction holds 0.775 of what presses; a slider has 60 steps
    wait_until(seen, f"{shown}[1] < 2.3 && Math.abs({shown}[1] - {0.775 * pressed}) < 0.05")
    assert source.forces_n(0.0)[1] == 2.4
    source.load(normal_force_n=1.0, tangential_force_n=0.2)  # by another hand
    wait_until(seen, f"Math.abs({shown}[0] - 1) < 0.05 && Math.abs({shown}[1] - 0.2) < 0.05")


def test_the_page_has_the_words_of_the_terminal(seen):
    texts = "['#number', '#band', '#words'].map((name) => document.querySelector(name).textContent)"
    number, band, words = seen.evaluate(texts)  # of one message: nothing is drawn in between
    margin, low, high = (int(text) / 100 for text in re.findall(r"\d+", number + band.partition(":")[2]))
    reading = Reading(number=0, time_s=0.0, captured_s=0.0, margin=margin, low=low, high=high)
    assert words.endswith(describe_reading(reading).advice)


def test_the_picture_is_frozen_and_explained_while_the_margin_runs_on(seen):
    slide(seen, "Pull", "PageUp", f"{MARGIN} < 60")
    seen.keyboard.press("e")
    # 400 passes of the network, on cores that other tests keep busy; nobody follows the markers, so none knows a start
    explained = f"/frozen: frame (\\d+).* as untouched: Shapley values of markers of frame \\1\\b/.test({CAPTION})"
    wait_until(seen, explained, within_s=120)
    frozen = seen.evaluate(CAPTION)
    assert "not the recommended map" not in frozen
    slide(seen, "Pull", "PageDown", f"{MARGIN} > 80")
    assert seen.evaluate(CAPTION) == frozen
    seen.keyboard.press("f")
    wait_until(seen, f"!{CAPTION}.includes('frozen')")
    wait_until(seen, f"{CAPTION}.includes('not the recommended map: Explain (E) shows Shapley values of markers')")


def test_what_is_recorded_is_a_data_set_that_passes(seen, page: LivePage):
    seen.get_by_role("button", name="Record").click()
    wait_until(seen, "parseInt(document.querySelector('#recording').textContent.match(/(\\d+) recorded/)?.[1]) >= 4")
    seen.get_by_role("button", name="Stop recording").click()
    seen.get_by_text("recorded into").wait_for()
    assert check_dataset(page.record_into) == ()


def test_a_narrow_window_needs_no_scrolling_sideways(seen):
    assert seen.evaluate("document.documentElement.scrollWidth") <= 320


def test_nothing_is_asked_of_anyone_else_and_nothing_complained_of(seen, page: LivePage):
    own = page.address.removeprefix("http://")
    elsewhere = [url for url in seen.asked if own not in url and not url.startswith(("data:", "blob:"))]
    assert seen.asked
    assert not elsewhere
    assert not seen.said


def test_hostile_names_do_nothing_on_the_page(seen):
    assert_inert(seen)  # the folder of the recording


@pytest.mark.parametrize(
    "path", ["etc/passwd", "../../../../etc/passwd", "live.js/..%2F..%2Fetc%2Fpasswd", "%2Fetc%2Fpasswd"]
)
def test_no_path_of_a_request_reaches_the_disk(page: LivePage, path: str):
    connection = HTTPConnection(page.address.removeprefix("http://").rstrip("/"), timeout=60)
    connection.request("GET", "/" + path)  # as it stands: urllib would shorten it
    answer = connection.getresponse()
    assert answer.status in {400, 403, 404}
    assert b"root:" not in answer.read()
    connection.close()


def test_a_port_that_is_taken_is_told_and_any_other_serves_a_second_page(page: LivePage):
    port = int(page.address.rstrip("/").rpartition(":")[2])
    with pytest.raises(InputError, match="name another with --port"):
        LivePage(page.reader, port=port).__enter__()
    with LivePage(page.reader, port=0) as second:
        assert second.address != page.address


def test_without_a_network_the_markers_fill_a_page_whose_buttons_need_no_scrolling(browser, tmp_path: Path):
    with served(SimulatedSource(rate_hz=10.0), None, tmp_path / "recorded", markers=True) as page:
        window = open_page(browser, page, width=1280, height=800)
        wait_until(window, "document.querySelector('#words').textContent.includes('sheared by')")
        bottoms = "[...document.querySelectorAll('button')].map((button) => button.getBoundingClientRect().bottom)"
        assert 0 < max(window.evaluate(bottoms)) < 800
        picture = window.evaluate(
            "JSON.parse(JSON.stringify(document.querySelector('#picture').getBoundingClientRect()))"
        )
        assert picture["width"] * picture["height"] > 0.4 * 1280 * 800
        assert picture["bottom"] <= 800
        assert not window.said
        window.context.close()


def test_a_gripper_answers_water_a_wet_skin_and_another_controller(browser, tmp_path: Path):
    told = "document.querySelector('#status').textContent"
    least = f"parseFloat({told}.match(/([\\d.]+) N would hold/)?.[1] ?? 0)"
    # the controllers say what they do without a margin, too
    with served(GripSource(rate_hz=10.0), None, tmp_path / "recorded") as page:
        window = open_page(browser, page)
        wait_until(window, f"{least} > 0 && {told}.includes('margin: no margin: ')")
        light = window.evaluate(least)
        slide(window, "Pour water", "PageUp", f"{least} > {2 * light}")
        window.get_by_label("held by").select_option("oracle")  # which lets nothing fall
        wait_until(window, f"{told}.includes('oracle: ')")
        heavy = window.evaluate(least)
        window.get_by_role("switch", name="Wet").click()
        wait_until(window, f"{least} > {1.8 * heavy}")  # half the friction
        assert window.evaluate("document.documentElement.scrollWidth") <= 320
        window.get_by_role("button", name="Grip again").click()
        wait_until(window, f"{told}.includes('open') || {told}.includes('closing')")
        assert not window.said
        window.context.close()
