"""Load the results that a workspace holds, whatever its folders are called."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sliplens.errors import InputError
from sliplens.files import RUN_FILE, read_json, require_folder
from sliplens.report.study.readers import STUDY_READERS, gather_study
from sliplens.report.workspace import Results
from sliplens.results.explanation import Explained, ExplainedFrame, MethodNotes
from sliplens.results.faithfulness import DeletionScores, MethodScore
from sliplens.results.fields import Fields
from sliplens.results.files import (
    read_deletion,
    read_learning_curve,
    read_pictures,
    read_predictions,
    read_saliency,
)
from sliplens.results.records import BinScore, ConditionScores, Evaluation, Run, Simulation, SplitCount, Training

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
    # last finished last, so that it replaces the earlier ones
    runs = sorted((_read_run(folder) for folder in folders), key=lambda run: run.finished)
    found: dict[tuple[str, str, str], Any] = {}
    notes = []
    for run in runs:
        if run.stage not in READERS:
            continue
        result = READERS[run.stage](run, _read_result(run))
        key = (run.stage, getattr(result, "input", ""), getattr(result, "source", ""))
        if key in found:
            kind = " ".join(part for part in key if part)
            notes.append(
                f"Two folders hold a result of “{kind}”: {run.folder.name} finished last and is shown, "
                f"{found[key].run.folder.name} is not."
            )
        found[key] = result
    if not found:
        raise InputError(
            f"{workspace} holds no result to report; run `sliplens simulate` and the stages after it into this folder"
        )
    return Results(
        workspace=workspace,
        runs=tuple(runs),
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


def _read_run(folder: Path) -> Run:
    fields = _read_object(folder / RUN_FILE, command="sliplens")
    # the config, the versions and the machine are shown as they are, so any object will do
    loose = {name: fields.values.get(name) for name in ("config", "versions", "machine")}
    objects = {name: value if isinstance(value, dict) else {} for name, value in loose.items()}
    return Run(
        folder=folder,
        stage=fields.text("stage"),
        config=objects["config"],
        config_hash=fields.text("config_hash", default="unknown"),
        versions={str(name): str(value) for name, value in objects["versions"].items()},
        machine=objects["machine"],
        finished=fields.text("finished", default="unknown"),
    )


def _read_result(run: Run) -> Fields:
    command = "study" if run.stage in STUDY_READERS else run.stage
    return _read_object(run.folder / RESULT_FILE, command=f"sliplens {command}")


def _read_simulation(run: Run, fields: Fields) -> Simulation:
    splits = fields.inner("by_split", optional=True)
    return Simulation(
        run=run,
        trials=fields.optional_integer("trials"),
        frames=fields.optional_integer("frames"),
        by_split={
            name: SplitCount(trials=split.integer("trials"), frames=split.integer("frames"))
            for name, split in splits.items()
        },
        conditions=fields.texts("conditions"),
    )


def _read_training(run: Run, fields: Fields) -> Training:
    curve = read_learning_curve(run.folder / "metrics.csv", command=fields.command)
    return Training(
        run=run,
        input=fields.text("input"),
        backbone=fields.text("backbone", default="unknown"),
        image_size=fields.integer("image_size"),
        frame_size=fields.integers("frame_size"),
        train_frames=fields.optional_integer("train_frames"),
        validation_frames=fields.optional_integer("validation_frames"),
        epochs=fields.optional_number("epochs"),
        minutes=fields.optional_number("minutes"),
        seed=fields.optional_integer("seed"),
        best_validation_mse=fields.optional_number("best_validation_mse"),
        parameters=fields.optional_integer("parameters"),
        stopped_by=fields.text("stopped_by", default="unknown"),
        **curve,
    )


def _read_evaluation(run: Run, fields: Fields) -> Evaluation:
    conditions = fields.inner("conditions")
    if not conditions:
        raise InputError(f"{fields.where} names no condition; evaluate some test trials with `{fields.command}`")
    return Evaluation(
        run=run,
        input=fields.text("input"),
        conditions={name: _read_condition(inner) for name, inner in conditions.items()},
        predictions=read_predictions(run.folder / "predictions.parquet", command=fields.command),
    )


def _read_condition(fields: Fields) -> ConditionScores:
    return ConditionScores(
        frames=fields.integer("frames"),
        trials=fields.integer("trials"),
        mse=fields.number("mse"),
        r2=fields.optional_number("r2"),
        mae=fields.number("mae"),
        bins=tuple(
            BinScore(
                low=row.number("low"),
                high=row.number("high"),
                frames=row.integer("frames"),
                mse=row.optional_number("mse"),
            )
            for row in fields.rows("bins")
        ),
    )


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


READERS: dict[str, Callable[[Run, Fields], Any]] = {
    "simulate": _read_simulation,
    "train": _read_training,
    "evaluate": _read_evaluation,
    "explain": _read_explained,
    "score": _read_scored,
    **STUDY_READERS,
}
