"""The first page: can these maps be trusted, and why so."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sliplens.plots.style import input_name, inputs_in_order, listed
from sliplens.report import charts, plates, tables
from sliplens.report.results import Results
from sliplens.report.verdict import MethodRow, answer_trust, load_thesis, test_r2, why_no_verdict

SHOWN_R2 = 0.5
"""R2 on test trials below which a network's maps are not shown."""
OF_PACKAGE = "These are results on the simulated networks of the thesis that come with sliplens, not on this workspace."


@dataclass(frozen=True, kw_only=True)
class Opening:
    """Answer, what shows it, and what to do next."""

    answer: str
    blocks: tuple[tables.CellTable | plates.Plate, ...]
    next_step: str


def without_weak(results: Results) -> tuple[Results, tuple[str, ...]]:
    """Leave out maps of networks that predict too badly to be explained, and say so."""
    scores_of = {name: test_r2(results, name) for name in results.evaluations}
    weak = [name for name, r2 in scores_of.items() if r2 is not None and r2 < SHOWN_R2]
    if not weak:
        return results, ()
    tables_of = ("explanations", "deletion", "faithfulness", "randomisation", "map_quality", "timing", "truth")
    keep = {
        name: {key: record for key, record in getattr(results.study, name).items() if key not in weak}
        for name in tables_of
    }
    strip = None if results.strip is not None and results.strip.input in weak else results.strip
    # real frames may be explained by another network of the same input
    source = results.study.source
    maps = {key: record for key, record in results.explanations.items() if key[0] not in weak or key[1] != source}
    scores = {key: record for key, record in results.scores.items() if key in maps or key[0] not in weak}
    text = (
        f"The maps of {listed([input_name(name).lower() for name in weak])} are not shown: a network with R² under "
        f"{SHOWN_R2:g} on test trials has nothing to explain but its errors."
    )
    study = replace(results.study, **keep)
    return replace(results, strip=strip, explanations=maps, scores=scores, study=study), (text,)


def build_opening(results: Results, rows: Sequence[MethodRow]) -> Opening:
    """Build the first page from the study of a workspace, or from that of the package where it holds none."""
    strip, study = results.strip, results.study
    reasons = [why_no_verdict(results, name) for name in inputs_in_order(study.inputs)] if study else []
    if rows:
        answer = answer_trust(rows, reasons)
    elif strip is not None and not study:
        rows = load_thesis().methods
        answer = f"{answer_trust(rows, ())} {OF_PACKAGE}"
    else:
        answer = "Not known: no explanation was scored yet."
    blocks = [
        plates.plate_strip(strip) if strip else None,
        plates.plate_moved(strip, strip.moved) if strip and strip.moved else None,
        charts.plate_shift(load_thesis()) if strip and strip.source == "simulated" else None,
        tables.table_methods(rows) if rows else None,
    ]
    best = next((row.method for row in rows if row.status == "ahead"), None)
    if not study and strip:
        step = "judge the maps of your own network on your recordings: `sliplens study DATA --network RUN --quick`."
    elif best:
        step = f"look at your own frames with the method that is ahead: `sliplens explain RUN DATA --method {best}`."
    elif rows:
        step = "train on more trials until five of them are predicted within 5 points, and run the study again."
    else:
        step = "" if study else "`sliplens study DATA --network RUN --quick` judges the maps of a network."
    return Opening(answer=answer, blocks=tuple(block for block in blocks if block is not None), next_step=step)
