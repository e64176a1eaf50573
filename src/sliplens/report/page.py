"""The report: one page that needs nothing but itself."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from sliplens.errors import InputError
from sliplens.files import Provenance
from sliplens.plots.layout import Picture, draw_picture, written_whole
from sliplens.plots.saliency import plot_colour_bar
from sliplens.plots.style import input_name, method_name, source_name
from sliplens.report.believing import judge_study, tell_interval
from sliplens.report.plates import FOLDER, Plate, write_plates
from sliplens.report.results import READERS, RECORDS, load_results
from sliplens.report.sections import Section, build_sections
from sliplens.report.study.sections import build_study_page
from sliplens.report.verdict import Statement, judge
from sliplens.report.workspace import Results

_TEMPLATE = "report.html.j2"


@dataclass(frozen=True, kw_only=True)
class Page:
    """All that the template lays out, and the figures that are written beside it."""

    name: str
    finished: str
    statements: tuple[Statement, ...]
    sections: tuple[Section, ...]
    plates: tuple[Plate, ...]
    study: bool
    colour_bar: Picture
    warnings: tuple[str, ...]
    runs: dict[str, Provenance]
    recipes: tuple[str, ...]
    versions: tuple[tuple[str, str], ...]
    machine: tuple[tuple[str, str], ...]


@dataclass(frozen=True, kw_only=True)
class Written:
    """The page, and the files of a study's figures; these are none for other workspaces."""

    page: Path
    figures: tuple[Path, ...]


def build_report(workspace: Path, output: Path) -> Written:
    """Write the report of a workspace as one self-contained HTML file, and a study's figures beside it.

    Each figure is written as `figures/NAME.pdf`, and its numbers as `figures/NAME.csv`; other files there are left as
    they are.

    Parameters
    ----------
    workspace
        Folder with one subfolder a stage, as the sliplens commands write them. A stage that was not run is named as
        missing on the page.
    output
        HTML file to write; it appears when complete.

    Returns
    -------
    Written
        The files written.

    Raises
    ------
    InputError
        If the workspace holds no result or a malformed one, or the file cannot be written.
    """
    if output.is_dir():
        raise InputError(f"{output} is a folder; name the HTML file to write, such as {output / 'report.html'}")
    page = build_page(load_results(workspace))
    text = render_page(page)
    # the figures first: a page that is there has all that it names
    figures = write_plates(page.plates, output.parent / FOLDER)
    with written_whole(output) as part:
        part.write_text(text, encoding="utf-8")
    return Written(page=output, figures=figures)


def render_page(page: Page) -> str:
    """Lay a page out as HTML; every text is escaped."""
    environment = Environment(
        loader=PackageLoader("sliplens.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(_TEMPLATE).render(page=page, interval=tell_interval)


def build_page(results: Results) -> Page:
    """Draw and judge the results of a workspace."""
    # one stream, seeded: the same results give the same intervals
    rng = np.random.default_rng(0)
    newest = list(results.runs.values())[-1]
    if results.study:
        drawn = build_study_page(results, rng=rng)
        sections, plates, statements = drawn.sections, drawn.plates, judge_study(results, rng=rng)
    else:
        sections, plates, statements = build_sections(results, rng=rng), (), judge(results, rng=rng)
    return Page(
        name=results.workspace.resolve().name,
        finished=newest.finished[:16].replace("T", " at "),
        statements=statements,
        sections=sections,
        plates=plates,
        study=bool(results.study),
        colour_bar=draw_picture(
            lambda ax: plot_colour_bar(ax=ax),
            alt="Colours of the saliency maps, from dark (least important) to light yellow (most important)",
            size_in=(4.4, 0.75),
        ),
        warnings=tuple(_warnings(results)),
        runs=results.runs,
        recipes=tuple(json.dumps(run.config, indent=2, ensure_ascii=False) for run in results.runs.values()),
        versions=tuple(newest.versions.items()),
        machine=tuple((str(name), str(value)) for name, value in vars(newest.machine).items()),
    )


def _warnings(results: Results) -> list[str]:
    told = list(results.notes)
    for (name, source), scored in results.scores.items():
        told += [f"Scores, {input_name(name).lower()}, {source_name(source)}: {alarm}" for alarm in scored.alarms]
    for (name, source), explained in results.explanations.items():
        where = f"{input_name(name).lower()}, {source_name(source)}"
        told += [
            f"{method_name(method)}, {where}: {warning}"
            for method, cost in explained.methods.items()
            for warning in cost.warnings
        ]
    versions = {
        tuple(sorted(run.versions.items()))
        for run in results.runs.values()
        if run.stage in READERS.keys() | RECORDS.keys() | {"simulate"}
    }
    if len(versions) > 1:
        told.append("The stages were run with different versions of the libraries; see the versions of each run.json.")
    return told
