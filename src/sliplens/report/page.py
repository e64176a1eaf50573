"""Pages that need nothing but themselves: the report with its figures beside it, and the trials of a data set."""

import json
import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from PIL import Image

from sliplens.codec import Result
from sliplens.errors import InputError
from sliplens.plots.style import UNKNOWN, decimals, percent, written_whole
from sliplens.progress import number_of
from sliplens.recordings.capture import Frame
from sliplens.recordings.dataset import Dataset, TrialInfo, load_dataset, trial_path
from sliplens.recordings.store import load_recording, read_frames
from sliplens.report.plates import FOLDER, Plate, write_plates
from sliplens.report.results import load_results
from sliplens.report.sections import (
    build_opening,
    build_sections,
    list_alarms,
    missing_sections,
    table_accuracy,
    table_claims,
)
from sliplens.report.verdict import CITATION, cautions, judge_results, judge_study, without_weak
from sliplens.results.study import Study

PAGE = "report.html"
VERDICT = "Networks compared with one another and on real touch, with 95 % intervals over days and trials."


@dataclass(frozen=True, kw_only=True)
class Written(Result):
    """Files of a report: the page, and each figure of the thesis as PDF and its numbers as CSV."""

    page: Path
    figures: tuple[Path, ...]


def write_report(
    workspace: str | Path | Study, out: str | Path | None = None, *, waiting_for: Sequence[str] = ()
) -> Written:
    """Write the report of a workspace as one self-contained HTML file, and figures of the thesis beside it.

    Each of these is written as `figures/NAME.pdf`, and its numbers as `figures/NAME.csv`; other files there are left as
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
    sections = build_sections(results)
    rows = judge_study(results)
    opening = build_opening(results, rows)
    blocks = [*opening.blocks, *(block for section in sections for block in section.blocks)]
    runs = list(results.runs.values())
    text = render_page(
        "report.html.j2",
        name=results.folder.resolve().name,
        finished=runs[-1].finished[:16].replace("T", " at "),
        thesis=CITATION,
        waiting_for=waiting_for,
        answer=opening.answer,
        opening=opening.blocks,
        next_step=opening.next_step,
        verdict=[
            *([table_accuracy(results)] if results.evaluations else []),
            *([table_claims(VERDICT, claims)] if (claims := judge_results(results, rng=rng)) else []),
        ],
        cautions=[*weak, *cautions(results)],
        alarms=list_alarms(results),
        sections=[section for section in sections if section.blocks],
        missing=missing_sections(results, sections),
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


def render_page(template: str, *, script: str = "", **values: Any) -> str:
    """Fill a template of a page: every text is escaped, and only the style and script of the package work on it."""
    loader = PackageLoader("sliplens.report")
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    # what stands between backticks is code
    pages.filters["code"] = lambda words: Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(words))))
    inline = {"style": "report.css"} | ({"script": script} if script else {})
    folder = files("sliplens.report") / "templates"
    texts = {kind: (folder / name).read_text(encoding="utf-8") for kind, name in inline.items()}
    hashes = {kind: b64encode(sha256(text.encode()).digest()).decode() for kind, text in texts.items()}
    allowed = [f"{kind}-src 'sha256-{code}'" for kind, code in hashes.items()]
    policy = "; ".join(["default-src 'none'", "img-src data:", *allowed, "base-uri 'none'", "form-action 'none'"])
    return pages.get_template(template).render(policy=policy, **texts, **values)


TRIALS_PAGE = "trials.html"
_THUMBNAIL_PX = 72


@dataclass(frozen=True, kw_only=True)
class _Row:
    """A trial on the page: texts, and the numbers that it is sorted by (NaN sorts last)."""

    info: TrialInfo
    pictures: tuple[str, ...]
    """The untouched sensor, and the frame of the least margin, as data addresses."""
    valid: int
    margin: str
    least: float
    friction: str
    mu: float
    flags: tuple[str, ...]
    lost: str


def write_trials_page(data: Dataset | Path | str, out: Path | str | None = None) -> Path:
    """Write the summary of a data set's trials as one self-contained HTML page; gives its path.

    Each trial has a row: the untouched sensor and the frame of the least margin, the range of the margin,
    friction with its interval, the share of frames with a valid label, and what puts the labels in doubt. Columns are
    sorted by a click on their heads; recordings that were left out are listed with the reason.

    Parameters
    ----------
    data
        Data set, or its folder.
    out
        HTML file to write; `trials.html` in the data set if None.

    Raises
    ------
    InputError
        If the data set is missing or damaged.
    """
    data = data if isinstance(data, Dataset) else load_dataset(data)
    page = data.folder / TRIALS_PAGE if out is None else Path(out)
    text = render_page(
        "trials.html.j2",
        script="trials.js",
        name=data.folder.resolve().name,
        rows=[_row(data, info) for info in data.trials],
        objects=any(info.object for info in data.trials),
        left_out=data.left_out,
        counts=f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}",
    )
    with written_whole(page) as part:
        part.write_text(text, encoding="utf-8")
    return page


def _row(data: Dataset, info: TrialInfo) -> _Row:
    path = trial_path(data.folder, info.trial)
    trial = load_recording(path, pixels=False)
    margin = np.where(trial.labelled, trial.safety_margin, np.nan)
    labelled = bool(np.isfinite(margin).any())
    least, most = (float(np.nanmin(margin)), float(np.nanmax(margin))) if labelled else (np.nan, np.nan)
    frame = int(np.nanargmin(margin)) if labelled else len(margin) // 2
    basis, counts = trial.labelling.basis if trial.labelling else None, trial.count()
    estimates = trial.friction_coefficient[np.isfinite(trial.friction_coefficient)]
    mu = basis.friction.mu if basis else float(np.median(estimates)) if len(estimates) else np.nan
    friction = decimals(mu, 2) if np.isfinite(mu) else UNKNOWN
    if basis:
        low, high = (decimals(end, 2) for end in (basis.friction.low, basis.friction.high))
        friction += " given" if basis.friction.low == basis.friction.high else f" [{low}, {high}]"
    return _Row(
        info=info,
        pictures=(_thumbnail(trial.reference), _thumbnail(read_frames(path, [frame])[0])),
        valid=counts.get("valid", 0),
        margin=f"{percent(least)} to {percent(most)}" if labelled else UNKNOWN,
        least=least,
        friction=friction,
        mu=mu,
        flags=basis.flags if basis else (),
        lost=", ".join(f"{count} {reason}" for reason, count in counts.items() if reason != "valid"),
    )


def _thumbnail(frame: Frame) -> str:
    image = Image.fromarray(frame)
    image.thumbnail((2 * _THUMBNAIL_PX, 2 * _THUMBNAIL_PX))  # twice as fine, for dense screens
    stream = BytesIO()
    image.save(stream, format="JPEG", quality=80)
    return f"data:image/jpeg;base64,{b64encode(stream.getvalue()).decode()}"
