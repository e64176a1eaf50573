"""The report: one page that needs nothing but itself."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from sliplens.errors import InputError
from sliplens.report.drawing import Picture, draw_picture
from sliplens.report.overlay import plot_colour_bar
from sliplens.report.records import Results, Run
from sliplens.report.results import load_results
from sliplens.report.sections import Section, build_sections
from sliplens.report.style import input_name, method_name, source_name
from sliplens.report.verdict import Statement, judge

_TEMPLATE = "report.html.j2"
_STAGES = ("simulate", "train", "evaluate", "explain", "score")


@dataclass(frozen=True, kw_only=True)
class Page:
    """All that the template lays out."""

    name: str
    finished: str
    statements: tuple[Statement, ...]
    sections: tuple[Section, ...]
    colour_bar: Picture
    warnings: tuple[str, ...]
    runs: tuple[Run, ...]
    recipes: tuple[str, ...]
    versions: tuple[tuple[str, str], ...]
    machine: tuple[tuple[str, str], ...]


def build_report(workspace: Path, output: Path) -> Path:
    """Write the report of a workspace as one self-contained HTML file.

    Parameters
    ----------
    workspace
        Folder with one subfolder a stage, as the sliplens commands write them. A stage that was not run is named as
        missing on the page.
    output
        HTML file to write; it appears when complete.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If the workspace holds no result or a malformed one, or the file cannot be written.
    """
    if output.is_dir():
        raise InputError(f"{output} is a folder; name the HTML file to write, such as {output / 'report.html'}")
    text = render_page(build_page(load_results(workspace)))
    part = output.with_name(f".{output.name}.part")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(output)
    except OSError as error:
        raise InputError(f"cannot write {output} ({error.strerror}); choose another file") from None
    return output


def render_page(page: Page) -> str:
    """Lay a page out as HTML; every text is escaped."""
    environment = Environment(
        loader=PackageLoader("sliplens.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(_TEMPLATE).render(page=page)


def build_page(results: Results) -> Page:
    """Draw and judge the results of a workspace."""
    # one stream, seeded: the same results give the same intervals
    rng = np.random.default_rng(0)
    newest = results.runs[-1]
    return Page(
        name=results.workspace.resolve().name,
        finished=newest.finished[:16].replace("T", " at "),
        statements=judge(results, rng=rng),
        sections=build_sections(results, rng=rng),
        colour_bar=draw_picture(
            lambda ax: plot_colour_bar(ax=ax),
            alt="Colours of the saliency maps, from dark (least important) to light yellow (most important)",
            size_in=(4.4, 0.75),
        ),
        warnings=tuple(_warnings(results)),
        runs=results.runs,
        recipes=tuple(json.dumps(run.config, indent=2, ensure_ascii=False) for run in results.runs),
        versions=tuple(newest.versions.items()),
        machine=tuple((str(name), str(value)) for name, value in newest.machine.items()),
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
    versions = {tuple(sorted(run.versions.items())) for run in results.runs if run.stage in _STAGES}
    if len(versions) > 1:
        told.append("The stages were run with different versions of the libraries; see the versions of each run.json.")
    return told
