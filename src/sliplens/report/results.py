"""Results that a workspace holds, whatever its folders are called."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sliplens.codec import load_record, load_result
from sliplens.errors import InputError
from sliplens.files import RUN_FILE, Provenance, require_folder
from sliplens.results.evaluation import Evaluation, Training
from sliplens.results.explanation import Explanation, Strip
from sliplens.results.study import CONFIG_FILE, RECORDS, TABLES, TESTS, Study, StudyConfig

_KINDS = RECORDS | {"train": Training, "evaluate": Evaluation}
"""Record of each stage."""
_COMMANDS = ("train", "evaluate", "explain", "score")
"""Stages that a command of their name makes; a study makes the others."""
_BY_SOURCE = ("explain", "score", "faithfulness")
"""Stages of which a workspace may hold two results of an input: of simulated and of real touch."""


@dataclass(frozen=True, kw_only=True)
class Results(Study):
    """Everything that a workspace holds; a stage that was not run is None or an empty table."""

    runs: dict[str, Provenance] = field(default_factory=dict)
    """By the name of the folder, last finished last."""
    trainings: dict[str, Training] = field(default_factory=dict)
    real: dict[str, Explanation] = field(default_factory=dict)
    """Explanations of frames of a real sensor, where the others are of simulated frames."""
    strip: Strip | None = None
    """One trial from stick to slip."""
    notes: tuple[str, ...] = ()
    """Sentences on how the results were chosen."""


def load_results(workspace: Path) -> Results:
    """Load every result in the direct subfolders of a workspace.

    A folder counts when it holds `run.json`; its stage, input and source say what it is. Of two results of one kind the
    one that finished last is loaded, and `Results.notes` says so.

    Raises
    ------
    InputError
        If the folder is missing or holds no result, or a file in it is malformed.
    """
    require_folder(workspace, what="the workspace")
    files = [path / RUN_FILE for path in sorted(workspace.iterdir()) if path.is_dir() and path.name[0] != "."]
    # a link that leads nowhere is refused, not passed over
    runs = [
        (path.parent, load_record(path, Provenance, command="sliplens"))
        for path in files
        if path.exists() or path.is_symlink()
    ]
    runs.sort(key=lambda item: item[1].finished)
    if not any(run.stage in {*_KINDS, "simulate"} for _, run in runs):
        raise InputError(
            f"{workspace} holds no result to report; run `sliplens simulate` and the stages after it into this folder"
        )
    records: dict[tuple[str, str, str], Any] = {}
    folders: dict[tuple[str, str, str], str] = {}
    notes = []
    for folder, run in runs:
        if run.stage not in _KINDS or run.stage == "control":  # large maps, which no page shows
            continue
        command = run.stage if run.stage in _COMMANDS else "study"
        record = load_result(folder, _KINDS[run.stage], command=f"sliplens {command}")
        source = record.source if run.stage in _BY_SOURCE else ""
        key = (run.stage, getattr(record, "input", ""), source)
        if key in records:
            notes.append(
                f"Two folders hold a result of “{' '.join(filter(None, key))}”: {folder.name} finished last and is "
                f"shown, {folders[key]} is not."
            )
        records[key], folders[key] = record, folder.name

    def of(stage: str, source: str = "") -> Any:
        return {
            name: record for (each, name, origin), record in records.items() if each == stage and origin in ("", source)
        }

    choice, config = of("choice").get(""), workspace / CONFIG_FILE
    tested = (record.source for (stage, *_), record in records.items() if stage in TESTS)
    source = choice.source if choice else next(tested, "simulated")
    tables = {table: of(stage, source) for stage, table in TABLES.items()}
    # `sliplens score` writes the deletion score with the removal, a study writes it as a step
    deletion = {name: scores for name, record in tables["faithfulness"].items() if (scores := record.deletion_scores)}
    return Results(
        folder=workspace,
        config=load_record(config, StudyConfig, command="sliplens study") if config.exists() else None,
        choice=choice,
        states=of("states").get(""),
        **tables | {"deletion": deletion | tables["deletion"]},
        runs={folder.name: run for folder, run in runs},
        trainings=of("train"),
        real=of("explain", "real") if source != "real" else {},
        strip=next(iter(of("strip").values()), None),
        notes=tuple(notes),
    )
