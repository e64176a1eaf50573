"""Results that a workspace holds, whatever its folders are called."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from sliplens.codec import load_record, load_result
from sliplens.errors import InputError
from sliplens.files import RUN_FILE, Provenance, require_folder
from sliplens.grip.records import Grip
from sliplens.results.evaluation import Evaluation, Training
from sliplens.results.explanation import Explanation, Strip
from sliplens.results.faithfulness import DeletionScores, Faithfulness
from sliplens.results.study import (
    CONFIG_FILE,
    RECORDS,
    Choice,
    MapQuality,
    Randomisation,
    States,
    Study,
    StudyConfig,
    Timing,
    Truth,
)

Record = TypeVar("Record")
_COMMANDS: dict[str, type] = {
    "train": Training,
    "evaluate": Evaluation,
    "explain": Explanation,
    "score": DeletionScores,
    "grip": Grip,
}
"""Record of each command by its stage; other stages are steps of a study."""
_BY_SOURCE = ("explain", "score", "faithfulness")
"""Stages of which a workspace may hold two results of an input: of simulated and of real touch."""


@dataclass(frozen=True, kw_only=True)
class Results:
    """All that a workspace holds; a stage that was not run is None or an empty table."""

    workspace: Path
    runs: dict[str, Provenance]
    """By the name of the folder, last finished last."""
    trainings: dict[str, Training] = field(default_factory=dict)
    evaluations: dict[str, Evaluation] = field(default_factory=dict)
    """By input ("raw", "difference")."""
    explanations: dict[tuple[str, str], Explanation] = field(default_factory=dict)
    scores: dict[tuple[str, str], DeletionScores] = field(default_factory=dict)
    """By input and source ("simulated", "real")."""
    grip: Grip | None = None
    """An object held with the margin in the loop."""
    strip: Strip | None = None
    """One trial from stick to slip."""
    study: Study = field(default_factory=Study)
    """Records of a study; false where none was run."""
    notes: tuple[str, ...] = ()
    """Sentences on how the results were chosen."""

    @property
    def inputs(self) -> set[str]:
        """Inputs of all results."""
        names = {*self.trainings, *self.evaluations}
        names |= {name for name, _ in (*self.explanations, *self.scores)}
        return names | self.study.inputs if self.study or not names else names


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
    if not any(run.stage in RECORDS | _COMMANDS or run.stage == "simulate" for _, run in runs):
        raise InputError(
            f"{workspace} holds no result to report; run `sliplens simulate` and the stages after it into this folder"
        )
    records: dict[tuple[str, str, str], object] = {}
    folders: dict[tuple[str, str, str], str] = {}
    notes = []
    for folder, run in runs:
        kind = (RECORDS | _COMMANDS).get(run.stage)
        if kind is None or run.stage == "control":  # large maps, which no page shows
            continue
        command = run.stage if run.stage in _COMMANDS else "study"
        result = load_result(folder, kind, command=f"sliplens {command}")
        source = getattr(result, "source", "") if run.stage in _BY_SOURCE else ""
        key = (run.stage, getattr(result, "input", ""), source)
        if key in records:
            notes.append(
                f"Two folders hold a result of “{' '.join(filter(None, key))}”: {folder.name} finished last and is "
                f"shown, {folders[key]} is not."
            )
        records[key], folders[key] = result, folder.name

    def of_kind(kind: type[Record]) -> dict[tuple[str, str], Record]:
        return {key[1:]: record for key, record in records.items() if isinstance(record, kind)}

    def by_input(kind: type[Record], source: str = "") -> dict[str, Record]:
        return {name: record for (name, origin), record in of_kind(kind).items() if source in ("", origin)}

    choice = of_kind(Choice).get(("", ""))
    source, config = choice.source if choice else "", workspace / CONFIG_FILE
    # `sliplens score` writes the deletion score with the removal, a study writes it as a step
    deletion = {key: scores for key, record in of_kind(Faithfulness).items() if (scores := record.deletion_scores)}
    return Results(
        workspace=workspace,
        runs={folder.name: run for folder, run in runs},
        trainings=by_input(Training),
        evaluations=by_input(Evaluation),
        grip=of_kind(Grip).get(("", "")),
        explanations=of_kind(Explanation),
        scores=deletion | of_kind(DeletionScores),
        strip=next(iter(of_kind(Strip).values()), None),
        study=Study(
            folder=workspace,
            config=load_record(config, StudyConfig, command="sliplens study") if config.exists() else None,
            choice=choice,
            states=of_kind(States).get(("", "")),
            evaluations=by_input(Evaluation),
            explanations=by_input(Explanation, source),
            deletion=by_input(DeletionScores, source),
            faithfulness=by_input(Faithfulness, source),
            randomisation=by_input(Randomisation),
            map_quality=by_input(MapQuality),
            timing=by_input(Timing),
            truth=by_input(Truth),
        ),
        notes=tuple(notes),
    )
