"""The report: one page that needs nothing but itself, and figures of the thesis beside it."""

import json
import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib.resources import files
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from sliplens.codec import Result
from sliplens.errors import InputError
from sliplens.plots.style import written_whole
from sliplens.report import sections
from sliplens.report.plates import FOLDER, Plate, write_plates
from sliplens.report.verdict import CITATION, cautions, judge_results, judge_study, without_weak
from sliplens.results.study import Study, load_results

PAGE = "report.html"
_VERDICT = "Networks compared with one another and on real touch, with 95 % intervals over days and trials."


@dataclass(frozen=True, kw_only=True)
class Written(Result):
    """Files of a report: the page, and each figure of the thesis as PDF and its numbers as CSV."""

    page: Path
    figures: tuple[Path, ...]


def write_report(
    workspace: str | Path | Study, out: str | Path | None = None, *, waiting_for: Sequence[str] = ()
) -> Written:
    """Write the report of a workspace as one self-contained HTML file, and figures of the thesis beside it.

    Each is written as `figures/NAME.pdf`, and its numbers as `figures/NAME.csv`; other files there stay.

    Parameters
    ----------
    workspace
        Folder with one subfolder a stage, as the sliplens commands write them, or a study. A stage of a study
        that was not run is named as missing on the page.
    out
        HTML file to write; it appears when complete. `report.html` in the workspace if not given.
    waiting_for
        What is still being made, in words; the page says so, and reloads every few seconds.

    Returns
    -------
    Written
        The files written.

    Raises
    ------
    InputError
        If the workspace holds no result or a malformed one, or the file cannot be written.

    See Also
    --------
    run_study : Run the study of a data set.
    plot : Draw a single figure.

    Examples
    --------
    >>> import sliplens as sl
    >>> sl.write_report("runs/mine").page  # doctest: +SKIP
    PosixPath('runs/mine/report.html')
    """
    folder = Path(workspace) if isinstance(workspace, str | Path) else workspace.folder
    page = folder / PAGE if out is None else Path(out)
    if page.is_dir():
        raise InputError(f"{page} is a folder; name the HTML file to write, such as {page / PAGE}")
    results = load_results(folder)
    rng = np.random.default_rng(0)  # seeded: the same results give the same intervals
    results, weak = without_weak(results)
    built = sections.build_sections(results)
    opening = sections.build_opening(results, judge_study(results))
    blocks = [*opening.blocks, *(block for section in built for block in section.blocks)]
    runs = list(results.runs.values())
    loader = PackageLoader("sliplens.report")
    # every text is escaped, and only the style of the package works on the page
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    # what stands between backticks is code
    pages.filters["code"] = lambda words: Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(words))))
    css = (files("sliplens.report") / "templates" / "report.css").read_text(encoding="utf-8")
    code = b64encode(sha256(css.encode()).digest()).decode()
    allowed = "img-src data:", f"style-src 'sha256-{code}'", "base-uri 'none'", "form-action 'none'"
    text = pages.get_template("report.html.j2").render(
        policy="; ".join(["default-src 'none'", *allowed]),
        style=css,
        name=results.folder.resolve().name,
        finished=runs[-1].finished[:16].replace("T", " at "),
        thesis=CITATION,
        waiting_for=waiting_for,
        opening=opening,
        verdict=[
            *([sections.table_accuracy(results)] if results.evaluations else []),
            *([sections.table_claims(_VERDICT, claims)] if (claims := [*judge_results(results, rng=rng)]) else []),
        ],
        cautions=[*weak, *cautions(results)],
        alarms=sections.list_alarms(results),
        sections=[section for section in built if section.blocks],
        missing=sections.missing_sections(results, built),
        study=results.begun,
        runs=results.runs,
        recipes=[json.dumps(run.config, indent=2, ensure_ascii=False) for run in runs],
        facts={**runs[-1].versions, **runs[-1].machine},
    )
    # the figures first: a page that is there has all that it names
    figures = write_plates([block for block in blocks if isinstance(block, Plate)], page.parent / FOLDER)
    with written_whole(page) as part:
        part.write_text(text, encoding="utf-8")
    return Written(page=page, figures=figures)
