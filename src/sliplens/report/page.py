"""The report: one page that needs nothing but itself, and its figures beside it."""

import json
import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from sliplens.errors import InputError
from sliplens.plots.style import written_whole
from sliplens.report.alarms import count_alarms
from sliplens.report.comparisons import CITATION, tell_interval
from sliplens.report.pictures import plate_strip
from sliplens.report.plates import FOLDER, Plate, write_plates
from sliplens.report.results import Results, load_results
from sliplens.report.sections import Section, build_sections
from sliplens.report.verdict import Verdict, cautions, judge
from sliplens.results.study import Study

PAGE = "report.html"


@dataclass(frozen=True, kw_only=True)
class Written:
    """Files of a report: the page, and each of its figures as PDF and its numbers as CSV."""

    page: Path
    figures: tuple[Path, ...]


def write_report(
    workspace: str | Path | Study, out: str | Path | None = None, *, waiting_for: Sequence[str] = ()
) -> Written:
    """Write the report of a workspace as one self-contained HTML file, and its figures beside it.

    Each figure is written as `figures/NAME.pdf`, and its numbers as `figures/NAME.csv`; other files there are left as
    they are.

    Parameters
    ----------
    workspace
        Folder with one subfolder a stage, as the sliplens commands write them, or a study. A stage of a study
        that was not run is named as missing on the page.
    out
        HTML file to write; it appears when complete. `report.html` in the workspace if not given.
    waiting_for
        What is still being made, in words; the page says so, and loads itself anew every few seconds.

    Returns
    -------
    Written
        The files written.

    Raises
    ------
    InputError
        If the workspace holds no result or a malformed one, or the file cannot be written.
    """
    folder = Path(workspace) if isinstance(workspace, str | Path) else workspace.folder
    page = folder / PAGE if out is None else Path(out)
    if page.is_dir():
        raise InputError(f"{page} is a folder; name the HTML file to write, such as {page / PAGE}")
    results = load_results(folder)
    # one stream, seeded: the same results give the same intervals
    rng = np.random.default_rng(0)
    sections = build_sections(results, rng=rng)
    claims = [block for section in sections for block in section.blocks if isinstance(block, Verdict)]
    verdict = judge(results, claims=claims, rng=rng)
    opening = None if results.strip is None else plate_strip(results.strip)
    text = _render(results, verdict, sections, opening=opening, waiting_for=waiting_for)
    plates = [] if opening is None else [opening]
    plates += [block for section in sections for block in section.blocks if isinstance(block, Plate)]
    # the figures first: a page that is there has all that it names
    figures = write_plates(plates, page.parent / FOLDER)
    with written_whole(page) as part:
        part.write_text(text, encoding="utf-8")
    return Written(page=page, figures=figures)


def _render(
    results: Results,
    verdict: tuple[Verdict, ...],
    sections: tuple[Section, ...],
    *,
    opening: Plate | None,
    waiting_for: Sequence[str],
) -> str:
    """Lay a report out as HTML."""
    runs = list(results.runs.values())
    versions = {tuple(sorted(run.versions.items())) for run in runs}
    mixed = "The stages were run with different versions of the libraries; see the versions of each run.json."
    return render_page(
        "report.html.j2",
        name=results.workspace.resolve().name,
        finished=runs[-1].finished[:16].replace("T", " at "),
        thesis=CITATION,
        waiting_for=waiting_for,
        opening=opening,
        verdict=verdict,
        cautions=cautions(results),
        alarms=[*results.notes, *([mixed] if len(versions) > 1 else []), *count_alarms(results)],
        sections=sections,
        study=bool(results.study),
        runs=results.runs,
        recipes=[json.dumps(run.config, indent=2, ensure_ascii=False) for run in runs],
        facts={**runs[-1].versions, **vars(runs[-1].machine)},
        interval=tell_interval,
    )


def render_page(template: str, *, script: str = "", **values: Any) -> str:
    """Fill a template of a page: every text is escaped, and only the style and script of the package work on it."""
    loader = PackageLoader("sliplens.report")
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    folder = files("sliplens.report") / "templates"
    inline = {"style": "report.css"} | ({"script": script} if script else {})
    texts = {kind: (folder / name).read_text(encoding="utf-8") for kind, name in inline.items()}
    pages.filters["code"] = set_code
    allowed = [f"{kind}-src 'sha256-{_sha256(text)}'" for kind, text in texts.items()]
    policy = "; ".join(["default-src 'none'", "img-src data:", *allowed, "base-uri 'none'", "form-action 'none'"])
    return pages.get_template(template).render(policy=policy, **texts, **values)


def set_code(text: str) -> Markup:
    """Escape a text, and set what stands between backticks as code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _sha256(text: str) -> str:
    return b64encode(sha256(text.encode()).digest()).decode()
