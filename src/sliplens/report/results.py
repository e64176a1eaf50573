"""Load the results that a workspace holds, whatever its folders are called."""

from pathlib import Path
from typing import Any

from sliplens.codec import load_record, load_result
from sliplens.errors import InputError
from sliplens.files import RUN_FILE, Provenance, require_folder
from sliplens.recordings.dataset import load_dataset
from sliplens.report.workspace import Results
from sliplens.results.evaluation import Evaluation
from sliplens.results.explanation import Explained, load_explained
from sliplens.results.faithfulness import DeletionScores, Remedies, RemovalScores
from sliplens.results.simulation import Simulation, describe_simulation
from sliplens.results.strip import Strip
from sliplens.results.study import Choice, MapQuality, Randomisation, States, Study, Timing, Truth
from sliplens.results.training import Training

_OF_A_STUDY: dict[str, type] = {
    "choice": Choice,
    "states": States,
    "remedies": Remedies,
    "faithfulness": RemovalScores,
    "randomisation": Randomisation,
    "map-quality": MapQuality,
    "timing": Timing,
    "truth": Truth,
}
RECORDS: dict[str, type] = {
    "simulate": Simulation,
    "train": Training,
    "evaluate": Evaluation,
    "explain": Explained,
    "score": DeletionScores,
    "strip": Strip,
    **_OF_A_STUDY,
}
"""Record of each stage."""


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
        elif run.stage == "explain":
            result = load_explained(folder)
        elif run.stage in RECORDS:
            command = f"sliplens {'study' if run.stage in _OF_A_STUDY else run.stage}"
            result = load_result(folder, RECORDS[run.stage], command=command)
        else:
            continue
        name = getattr(result, "input", "")
        key = (run.stage, name, getattr(result, "source", "") if name else "")
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
        strip=next((value for key, value in found.items() if key[0] == "strip"), None),
        study=_gather_study(workspace, found),
        notes=tuple(notes),
    )


def _gather_study(workspace: Path, found: dict[tuple[str, str, str], Any]) -> Study:
    by_input = {
        field: {name: value for (own, name, _), value in found.items() if own == stage}
        for stage, field in (
            ("evaluate", "evaluations"),
            ("explain", "explanations"),
            ("score", "deletion"),
            ("remedies", "remedies"),
            ("faithfulness", "faithfulness"),
            ("randomisation", "randomisation"),
            ("map-quality", "map_quality"),
            ("timing", "timing"),
            ("truth", "truth"),
        )
    }
    choice, states = (found.get((stage, "", "")) for stage in ("choice", "states"))
    return Study(folder=workspace, choice=choice, states=states, **by_input)  # pyright: ignore[reportArgumentType]
