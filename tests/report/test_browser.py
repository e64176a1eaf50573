"""The page of a study in a real browser."""

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from sliplens.report import Written

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: the page is not opened in a browser"
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PHONE, DESK = {"width": 320, "height": 640}, {"width": 1280, "height": 900}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A Chromium of this machine's: playwright's own would have to be fetched from outside the package index."""
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip("no Chromium on this machine: install the system's package chromium")
    with playwright.sync_playwright() as driver:
        # a container's root has no sandbox; the page is our own
        opened = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture(scope="module", params=[PHONE, DESK], ids=["phone", "desk"])
def opened(request: pytest.FixtureRequest, browser: Any, study_report: Written) -> Iterator[tuple[Any, list, list]]:
    """The page, what the console said, and what was asked for beside it."""
    page = browser.new_page(viewport=request.param)
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text) if message.type in {"error", "warning"} else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda one: asked.append(one.url))
    page.goto(study_report.page.as_uri(), wait_until="load")
    yield page, said, asked
    page.close()


def test_the_console_is_silent(opened):
    _, said, _ = opened

    assert said == []


def test_nothing_is_asked_of_the_network(opened, study_report):
    _, _, asked = opened

    assert [url for url in asked if not url.startswith("data:")] == [study_report.page.as_uri()]


def test_every_picture_is_shown(opened, study_report):
    page, _, _ = opened

    widths = page.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(widths) == len(study_report.figures) // 2
    assert min(widths) > 0


def test_the_page_does_not_scroll_sideways(opened):
    page, _, _ = opened

    # with every detail open: what is folded away must fit too
    page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    wide = page.viewport_size["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= wide
    # what is wider scrolls inside a box that the keyboard reaches
    boxes = page.evaluate("""[...document.querySelectorAll('.scroll')].map(box => box.tabIndex)""")
    assert set(boxes) == {0}


def test_words_are_legible(opened):
    page, _, _ = opened

    sizes = page.evaluate(
        "[...document.querySelectorAll('p, td, th, dd, li, figcaption')]"
        ".map(one => parseFloat(getComputedStyle(one).fontSize))"
    )
    assert min(sizes) >= 11
