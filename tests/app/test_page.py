"""The page in a real browser, and who may see it."""

import json
import os
import shutil
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

import sliplens as sl
from sliplens.app import LivePage
from sliplens.app.feed import Viewer
from sliplens.app.server import is_loopback
from sliplens.errors import InputError
from sliplens.live import SimulatedSource
from sliplens.recordings.check import check_dataset

pytest.importorskip("nicegui", reason="the page needs NiceGUI (extra live)")
pytestmark = pytest.mark.skipif(
    "PYTEST_XDIST_WORKER" in os.environ, reason="the page's server wants a process of its own: pytest tests/app"
)
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
MARGIN = "parseInt(document.querySelector('.sl-number').textContent)"


@pytest.fixture(scope="module")
def source() -> SimulatedSource:
    return SimulatedSource(rate_hz=10.0)


@pytest.fixture(scope="module")
def page(source: SimulatedSource, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LivePage]:
    """Page of a simulated fingertip that nobody presses yet."""
    source.load(normal_force_n=0.0, tangential_force_n=0.0)
    into = tmp_path_factory.mktemp("page") / "recorded"
    with (
        # a busy machine drops frames, and health and markers would withhold margins for that
        sl.LiveReader(source, "chromatouch-difference", engine="eager", health=None, slip=None) as reader,
        LivePage(reader, port=0, record_into=into) as page,
    ):
        yield page


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="a browser is led by Playwright")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium on this machine")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def seen(browser, page: LivePage):
    """The page in a window as narrow as a small phone's, with what it asked for and complained of."""
    context = browser.new_context(viewport={"width": 320, "height": 640})
    context.set_default_timeout(30_000)
    window = context.new_page()
    window.asked, window.said = [], []
    window.on("request", lambda request: window.asked.append(request.url))
    window.on("websocket", lambda socket: window.asked.append(socket.url))
    window.on("console", lambda message: window.said.append(message.text) if message.type == "error" else None)
    window.on("pageerror", lambda error: window.said.append(str(error)))
    window.goto(page.address)
    window.wait_for_function(f"{MARGIN} >= 0")
    yield window
    context.close()


def test_more_pull_means_less_margin_and_more_press_means_more(seen):
    # the part of a slider that takes the focus
    press, pull = (seen.get_by_role("slider", name=name).locator("[tabindex]").first for name in ("Press", "Pull"))
    press.focus()
    seen.keyboard.press("PageDown")  # takes the fingertip in hand; whatever the step, it is pressed still
    seen.wait_for_function(f"{MARGIN} > 80")
    pull.focus()
    # to the end and back, with steps to spare: a busy machine answers a key with the value of the one before
    for key, reached in (("PageUp", "< 20"), ("PageDown", "> 80")):
        for _ in range(15):
            seen.keyboard.press(key)
            seen.wait_for_timeout(60)
        seen.wait_for_function(f"{MARGIN} {reached}")


def test_the_picture_is_frozen_and_explained_while_the_margin_runs_on(seen, page: LivePage, source: SimulatedSource):
    source.load(normal_force_n=1.5, tangential_force_n=0.7)
    seen.wait_for_function(f"{MARGIN} < 70")
    seen.locator("body").click(position={"x": 2, "y": 2})
    seen.keyboard.press("e")
    caption = "document.querySelector('.sl-caption').textContent"
    seen.wait_for_function(f"/frozen: frame (\\d+).* of frame \\1\\b/.test({caption})")
    [viewer] = page.feed.viewers
    assert viewer.frozen is not None
    assert next(page.reader.readings()).number > viewer.frozen.reading.number
    seen.keyboard.press("f")
    seen.wait_for_function(f"!{caption}.includes('frozen')")
    assert viewer.frozen is None


def test_what_is_recorded_is_a_data_set_that_passes(seen, page: LivePage):
    seen.get_by_role("button", name="Record").click()
    seen.wait_for_function(
        "parseInt(document.querySelector('.sl-recording').textContent.match(/(\\d+) frames/)?.[1]) >= 4"
    )
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


def get(address: str, **headers: str) -> tuple[int, str]:
    """Status and text of an address, redirects followed."""
    request = urllib.request.Request(
        address, headers={name.replace("_", "-"): value for name, value in headers.items()}
    )
    try:
        with urllib.request.build_opener(urllib.request.HTTPCookieProcessor()).open(request, timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_a_page_of_another_site_is_refused(page: LivePage):
    assert get(page.address, Host="evil.example")[0] == 403
    assert get(page.address, Origin="http://evil.example")[0] == 403
    assert get(page.address)[0] == 200


def test_a_viewer_that_never_answers_is_sent_two_messages(page: LivePage):
    client = pytest.importorskip("websockets.sync.client")
    page.feed.expected["test"] = viewer = Viewer(page.feed)
    try:
        address = page.address.replace("http", "ws") + "frames/test"
        with client.connect(address, open_timeout=60) as socket:
            serials = []
            for _ in range(2):
                message = socket.recv(timeout=60)
                length = int.from_bytes(message[:4], "little")
                serials.append(json.loads(message[4 : 4 + length])["serial"])
            with pytest.raises(TimeoutError):
                socket.recv(timeout=0.3)
            assert serials == [1, 2]
            assert not viewer.ready
            socket.send(json.dumps({"serial": 1, "drawn": False}))
            assert socket.recv(timeout=60)
        with pytest.raises(Exception, match=r"403|rejected"), client.connect(address, origin="http://evil.example"):
            pass
    finally:
        page.feed.expected.pop("test", None)


def test_one_page_at_a_time(page: LivePage):
    with pytest.raises(InputError, match="close that one first"), LivePage(page.reader, port=0):
        pass


def test_a_port_that_is_taken_is_told(page: LivePage):
    port = int(page.address.rstrip("/").rpartition(":")[2])
    with pytest.raises(InputError, match="name another with --port"), LivePage(page.reader, port=port):
        pass


@pytest.mark.parametrize(
    ("host", "own"), [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("robot", False)]
)
def test_others_need_a_token(page: LivePage, host: str, own: bool):
    assert is_loopback(host) is own
    assert (LivePage(page.reader, host=host).token is None) is own
