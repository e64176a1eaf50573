"""Load the results that a workspace holds, whatever its folders are called."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sliplens.codec import load_record, load_result
from sliplens.errors import InputError
from sliplens.files import RUN_FILE, Provenance, read_json, require_folder
from sliplens.recordings.dataset import load_dataset
from sliplens.report.study.readers import STUDY_READERS, gather_study
from sliplens.report.workspace import Results
from sliplens.results.evaluation import Evaluation
from sliplens.results.explanation import Explained, ExplainedFrame, MethodNotes
from sliplens.results.faithfulness import DeletionScores, MethodScore
from sliplens.results.fields import Fields
from sliplens.results.files import (
    read_deletion,
    read_pictures,
    read_saliency,
)
from sliplens.results.records import Run
from sliplens.results.simulation import describe_simulation
from sliplens.results.training import Training

RESULT_FILE = "result.json"


def load_results(workspace: Path) -> Results:
    """Load every result in the direct subfolders of a workspace.

    A folder counts when it holds `run.json`; its stage, input and source say what it is. Of two results of one kind the
    one that finished last is kept, and `Results.notes` says so.

    Parameters
    ----------
    workspace
        Folder with one subfolder a stage.

    Raises
    ------
    InputError
        If the folder is missing or holds no result, or a file in it is malformed.
    """
    require_folder(workspace, what="the workspace")
    folders = sorted(path.parent for path in workspace.glob(f"*/{RUN_FILE}") if not path.parent.name.startswith("."))
    runs = {folder: load_record(folder / RUN_FILE, Provenance, command="sliplens") for folder in folders}
    # last finished last, so that it replaces the earlier ones
    runs = dict(sorted(runs.items(), key=lambda item: item[1].finished))
    found: dict[tuple[str, str, str], Any] = {}
    folder_of: dict[tuple[str, str, str], Path] = {}
    notes = []
    for folder, run in runs.items():
        if run.stage == "simulate":
            result = describe_simulation(load_dataset(folder))
        elif run.stage in RECORDS:
            result = load_result(folder, RECORDS[run.stage], command=f"sliplens {run.stage}")
        elif run.stage in READERS:
            own = Run(folder=folder, stage=run.stage)
            result = READERS[run.stage](own, _read_result(own))
        else:
            continue
        key = (run.stage, getattr(result, "input", ""), getattr(result, "source", ""))
        if key in found:
            kind = " ".join(part for part in key if part)
            notes.append(
                f"Two folders hold a result of “{kind}”: {folder.name} finished last and is shown, "
                f"{folder_of[key].name} is not."
            )
        found[key], folder_of[key] = result, folder
    if not found:
        raise InputError(
            f"{workspace} holds no result to report; run `sliplens simulate` and the stages after it into this folder"
        )
    return Results(
        workspace=workspace,
        runs={folder.name: run for folder, run in runs.items()},
        simulation=found.get(("simulate", "", "")),
        trainings={key[1]: value for key, value in found.items() if key[0] == "train"},
        evaluations={key[1]: value for key, value in found.items() if key[0] == "evaluate"},
        explanations={key[1:]: value for key, value in found.items() if key[0] == "explain"},
        scores={key[1:]: value for key, value in found.items() if key[0] == "score"},
        study=gather_study(found),
        notes=tuple(notes),
    )


def _read_object(path: Path, *, command: str) -> Fields:
    value = read_json(path)
    if not isinstance(value, dict):
        raise InputError(f"{path} holds no JSON object; make the folder again with `{command}`")
    return Fields(values=value, where=str(path), command=command)


def _read_result(run: Run) -> Fields:
    command = "study" if run.stage in STUDY_READERS else run.stage
    return _read_object(run.folder / RESULT_FILE, command=f"sliplens {command}")


def _read_explained(run: Run, fields: Fields) -> Explained:
    size = fields.integer("image_size")
    frames = tuple(
        ExplainedFrame(
            id=row.text("id"),
            condition=row.text("condition", default="unknown"),
            safety_margin=row.optional_number("safety_margin"),
            prediction=row.number("prediction"),
            reference_prediction=row.optional_number("reference_prediction"),
        )
        for row in fields.rows("frames")
    )
    if not frames:
        raise InputError(f"{fields.where} names no frame; explain some with `{fields.command}`")
    methods = fields.inner("methods")
    return Explained(
        run=run,
        input=fields.text("input"),
        source=fields.text("source"),
        image_size=size,
        frames=frames,
        methods={
            name: MethodNotes(
                seconds_per_frame=inner.optional_number("seconds_per_frame"), warnings=inner.texts("warnings")
            )
            for name, inner in methods.items()
        },
        pictures=read_pictures(run.folder / "frames", frames, size=size, command=fields.command),
        saliency=read_saliency(
            run.folder / "maps.npz", tuple(methods), (len(frames), size, size), command=fields.command
        ),
    )


def _read_scored(run: Run, fields: Fields) -> DeletionScores:
    return DeletionScores(
        run=run,
        input=fields.text("input"),
        source=fields.text("source"),
        fill=fields.text("fill"),
        methods={
            name: MethodScore(
                mean=inner.number("mean"),
                sd=inner.number("sd"),
                last_step_mean=inner.optional_number("last_step_mean"),
                frames=inner.integer("frames"),
            )
            for name, inner in fields.inner("methods").items()
        },
        alarms=fields.texts("alarms"),
        curves=read_deletion(run.folder / "deletion.parquet", command=fields.command),
    )


RECORDS: dict[str, type] = {"train": Training, "evaluate": Evaluation}
"""Record of each stage."""
READERS: dict[str, Callable[[Run, Fields], Any]] = {"explain": _read_explained, "score": _read_scored, **STUDY_READERS}
