"""Results that a workspace holds, whatever its folders are called."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sliplens.codec import load_record, load_result
from sliplens.errors import InputError
from sliplens.files import RUN_FILE, Provenance, require_folder
from sliplens.grip.records import Grip
from sliplens.recordings.dataset import load_dataset
from sliplens.results.evaluation import Diagnosis, Evaluation, Simulation, Training, describe_simulation
from sliplens.results.explanation import Explanation, Strip, load_explanation
from sliplens.results.faithfulness import DeletionScores
from sliplens.results.study import CONFIG_FILE, RECORDS, TABLES, Choice, Study, StudyConfig

_OF_A_COMMAND: dict[str, type] = {
    "train": Training,
    "evaluate": Evaluation,
    "diagnose": Diagnosis,
    "grip": Grip,
    "score": DeletionScores,
    "strip": Strip,
}


_BY_SOURCE = ("explain", "score", "faithfulness")
"""Stages of which a workspace may hold two, of simulated and of real touch."""


@dataclass(frozen=True, kw_only=True)
class Results:
    """All that a workspace holds; a stage that was not run is None or an empty table."""

    workspace: Path
    runs: dict[str, Provenance]
    """By the name of the folder, last finished last."""
    simulation: Simulation | None = None
    trainings: dict[str, Training] = field(default_factory=dict)
    evaluations: dict[str, Evaluation] = field(default_factory=dict)
    """By input ("raw", "difference")."""
    diagnoses: dict[str, Diagnosis] = field(default_factory=dict)
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
        """Inputs that any stage tells of."""
        of_source = {name for name, _ in (*self.explanations, *self.scores)}
        names_used = {*self.trainings, *self.evaluations, *self.diagnoses} | of_source
        return names_used | self.study.inputs if self.study or not names_used else names_used


def load_results(workspace: Path) -> Results:
    """Load every result in the direct subfolders of a workspace.

    A folder counts when it holds `run.json`; its stage, input and source say what it is. Of two results of one kind the
    one that finished last is kept, and `Results.notes` says so.

    Raises
    ------
    InputError
        If the folder is missing or holds no result, or a file in it is malformed.
    """
    require_folder(workspace, what="the workspace")
    inside = sorted(path for path in workspace.iterdir() if path.is_dir() and not path.name.startswith("."))
    # a link that leads nowhere is no folder without a result
    folders = [path for path in inside if (path / RUN_FILE).exists() or (path / RUN_FILE).is_symlink()]
    runs = {folder: load_record(folder / RUN_FILE, Provenance, command="sliplens") for folder in folders}
    # last finished last, so that it replaces the earlier ones
    runs = dict(sorted(runs.items(), key=lambda item: item[1].finished))
    records: dict[tuple[str, str, str], Any] = {}
    folder_of: dict[tuple[str, str, str], Path] = {}
    notes = []
    for folder, run in runs.items():
        if run.stage == "control":  # large maps, which no page shows
            continue
        if run.stage == "simulate":
            result = describe_simulation(load_dataset(folder))
        elif run.stage == "explain":
            result = load_explanation(folder)
        elif kind := (RECORDS | _OF_A_COMMAND).get(run.stage):
            command = run.stage if run.stage in _OF_A_COMMAND else "study"
            result = load_result(folder, kind, command=f"sliplens {command}")
        else:
            continue
        name = getattr(result, "input", "")
        # frames of a real sensor are explained beside a study's own
        key = (run.stage, name, getattr(result, "source", "") if run.stage in _BY_SOURCE else "")
        if key in records:
            notes.append(
                f"Two folders hold a result of “{' '.join(filter(None, key))}”: {folder.name} finished last and is "
                f"shown, {folder_of[key].name} is not."
            )
        records[key], folder_of[key] = result, folder
    if not records:
        raise InputError(
            f"{workspace} holds no result to report; run `sliplens simulate` and the stages after it into this folder"
        )

    def of(stage: str) -> dict[str, Any]:
        return {name: value for (rows, name, _), value in records.items() if rows == stage}

    choice: Choice | None = of("choice").get("")
    config = workspace / CONFIG_FILE
    of_study = {stage: of(stage) for stage in TABLES}
    if choice is not None:
        for stage in _BY_SOURCE:
            of_study[stage] = {key[1]: records[key] for key in records if key[::2] == (stage, choice.source)}
    return Results(
        workspace=workspace,
        runs={folder.name: run for folder, run in runs.items()},
        simulation=of("simulate").get(""),
        trainings=of("train"),
        evaluations=of("evaluate"),
        diagnoses=of("diagnose"),
        grip=of("grip").get(""),
        explanations={key[1:]: value for key, value in records.items() if key[0] == "explain"},
        scores=_scores(records),
        strip=next(iter(of("strip").values()), None),
        study=Study(
            folder=workspace,
            config=load_record(config, StudyConfig, command="sliplens study") if config.exists() else None,
            choice=choice,
            states=of("states").get(""),
            **{table: of_study[stage] for stage, table in TABLES.items()},  # pyright: ignore[reportArgumentType]
        ),
        notes=tuple(notes),
    )


def _scores(found: dict[tuple[str, str, str], Any]) -> dict[tuple[str, str], DeletionScores]:
    """Deletion scores by input and source: of a study's stage, else of `sliplens score`."""
    parts = {key[1:]: value.deletion_scores for key, value in found.items() if key[0] == "faithfulness"}
    stages = {key[1:]: value for key, value in found.items() if key[0] == "score"}
    return {key: value for key, value in parts.items() if value is not None} | stages
