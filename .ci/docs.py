"""Build the documentation anew into docs/_build, run its gallery, and try every page: links, pictures, a browser.

`python .ci/docs.py --kept` tries what was built before. The pages are opened in a Chromium of this machine's, where
there is one: no error, no request to outside, nothing to scroll sideways at 360 px, text that stands out.
"""

import argparse
import re
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree as ET

DOCS = Path(__file__).parents[1] / "docs"
SITE = DOCS / "_build"
NARROWEST_PX = 360
SLOWEST_S = 30.0
READ = ("index.html", "guide.html", "explainers.html", "api/calls.html", "gallery/index.html")
"""Pages on which the contrast of the text is measured, each as all of its kind."""
LOADED = {"img": "src", "script": "src", "link": "href", "source": "src", "video": "src", "iframe": "src"}

# WCAG 2.1, 1.4.3: 4.5 for text, 3 where it is large; what lies behind is the nearest box that is not transparent
FAINT = """() => {
  const parse = colour => {
    const [r, g, b, a = 1] = colour.match(/[\\d.]+/g).map(Number);
    return {rgb: [r, g, b], a};
  };
  const luminance = rgb => rgb.map(v => v / 255).map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = element => {
    for (let at = element; at; at = at.parentElement) {
      const colour = parse(getComputedStyle(at).backgroundColor);
      if (colour.a > 0.5) return colour.rgb;
    }
    return [255, 255, 255];
  };
  const found = new Set(), walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement, text = walker.currentNode.textContent.trim();
    if (!text || !element.checkVisibility({visibilityProperty: true, opacityProperty: true})) continue;
    const style = getComputedStyle(element), size = parseFloat(style.fontSize);
    const least = size >= 24 || (size >= 18.6 && style.fontWeight >= 700) ? 3 : 4.5;
    const [high, low] = [parse(style.color).rgb, behind(element)].map(luminance).sort((a, b) => b - a);
    const ratio = (high + 0.05) / (low + 0.05);
    if (ratio < least) found.add(`"${text.slice(0, 30)}" stands out ${ratio.toFixed(1)} times`);
  }
  return [...found];
}"""


@dataclass
class Page(HTMLParser):
    """Places on a page, and where it leads or what it loads."""

    anchors: set[str] = field(default_factory=set)
    links: set[str] = field(default_factory=set)
    loaded: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what a tag names and where it leads."""
        told = {name: value for name, value in attrs if value}
        self.anchors |= {told[name] for name in ("id", "name") if name in told}
        if tag == "a" and "href" in told:
            self.links.add(told["href"])
        if (address := told.get(LOADED.get(tag, ""))) and told.get("rel") not in (
            "canonical",
            "next",
            "prev",
            "author",
        ):
            self.loaded.add(address)


def read_pages(site: Path) -> dict[Path, Page]:
    """Every page of a built site; below `_static` there are templates of the theme's."""
    pages = {}
    for path in sorted(site.rglob("*.html")):
        if "_static" not in path.relative_to(site).parts:
            pages[path] = page = Page()
            page.feed(path.read_text(encoding="utf-8"))
    return pages


def find_faults(site: Path) -> list[str]:
    """Links that lead to no page or place of the site, and what is loaded from outside of it."""
    site = site.resolve()  # as the targets of links are
    pages, faults = read_pages(site), []
    for path, page in pages.items():
        for address in sorted(page.links | page.loaded):
            url = urlsplit(address)
            if url.scheme or url.netloc:
                if address in page.loaded and url.scheme != "data":
                    faults.append(f"{path.relative_to(site)} loads {address}")
                continue
            at, place = unquote(url.path), unquote(url.fragment)
            target = path if not at else site / at.lstrip("/") if at.startswith("/") else (path.parent / at).resolve()
            if target.is_dir():
                target /= "index.html"
            if not target.is_file():
                faults.append(f"{path.relative_to(site)} leads to {address}, which is not there")
            elif place and target in pages and place not in pages[target].anchors:
                faults.append(f"{path.relative_to(site)} leads to {address}, where no such place is")
    return faults


def open_pages(site: Path, pages: list[Path]) -> list[str] | None:
    """Errors, requests to outside, sideways scrolling and faint text as a browser finds them; None without one."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chromium-browser"))), None)
    if chromium is None:
        return None
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 (a site is built without a browser too)

    faults: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for scheme in ("light", "dark"):
            context = browser.new_context(viewport={"width": NARROWEST_PX, "height": 800}, color_scheme=scheme)
            tab = context.new_page()
            told: list[str] = []
            tab.on("console", lambda said, told=told: told.append(said.text) if said.type == "error" else None)
            tab.on("pageerror", lambda error, told=told: told.append(str(error)))
            tab.on("request", lambda asked, told=told: asked.url[:4] == "http" and told.append(f"asks for {asked.url}"))
            for path in pages:
                name = path.relative_to(site).as_posix()
                if scheme == "dark" and name not in READ:
                    continue
                told.clear()
                tab.goto(path.as_uri())
                wide = tab.evaluate("document.documentElement.scrollWidth")
                if wide > NARROWEST_PX:
                    told.append(f"is {wide} px wide on a screen of {NARROWEST_PX} px")
                if name in READ:
                    told += [f"{scheme}: {words}" for words in tab.evaluate(FAINT)]
                faults += [f"{name}: {words}" for words in told]
        browser.close()
    return faults


def build() -> tuple[float, int]:
    """Make the site from nothing; how long it took, in seconds, and how many warnings there were."""
    for folder in (SITE, DOCS / "gallery"):
        shutil.rmtree(folder, ignore_errors=True)
    begun = time.perf_counter()
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(SITE)]
    made = subprocess.run(command, check=False, stderr=subprocess.PIPE, text=True)
    print(made.stderr, end="", file=sys.stderr)
    return time.perf_counter() - begun, max(len(re.findall("WARNING|ERROR", made.stderr)), made.returncode)


def main() -> None:
    """Build, try, count; exit with 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kept", action="store_true", help="try what was built before")
    kept = parser.parse_args().kept
    seconds, warnings = (0.0, 0) if kept else build()
    sys.path.append(str(DOCS.parent / "benchmarks"))
    from house import measure  # noqa: PLC0415 (a script beside the package)

    counts = measure()
    pages = [path for path in sorted(SITE.rglob("*.html")) if not {"_modules", "_static"} & set(path.parts)]
    gallery = [path for path in pages if path.parent.name == "gallery" and path.name.startswith("plot_")]
    if not (SITE / "gallery.xml").is_file():
        sys.exit("no site was built")
    cases = ET.parse(SITE / "gallery.xml").iter("testcase")
    ran = {case.attrib["classname"]: float(case.attrib["time"]) for case in cases}
    faults = find_faults(SITE)
    faults += [f"{path.name} has no picture" for path in gallery if "sphx_glr_plot_" not in path.read_text("utf-8")]
    faults += [f"{path.name} was not executed" for path in gallery if path.stem not in ran and not kept]
    for name in [name for name, took in ran.items() if took > SLOWEST_S]:
        print(f"slow: {name} takes {ran[name]:.0f} s of {SLOWEST_S:.0f}")
    # the page of what is not found names its files from the root of a served site
    seen = open_pages(SITE, [path for path in pages if path.name != "404.html"])
    for fault in faults + (seen or []):
        print(fault)
    print(
        f"{seconds:.0f} s: {len(pages)} pages, {counts.doc_words:,} words, {counts.words_per_sentence} a sentence, "
        f"{len(gallery)} of the gallery, {len(ran)} examples executed in "
        f"{sum(ran.values()):.0f} s (at most {max(ran.values(), default=0):.0f} s), {warnings} warnings, "
        f"{len(faults)} faults"
        + (", not opened in a browser" if seen is None else f", {len(seen)} faults in a browser")
    )
    if warnings or faults or seen:
        sys.exit(1)


if __name__ == "__main__":
    main()
