"""A small study, up to where its scores begin."""

from pathlib import Path

import numpy as np
import pytest

from sliplens.files import output_folder
from sliplens.models import TrainedModel, load_checkpoint
from sliplens.recordings import Dataset
from sliplens.study import explain_frames, load_explained
from sliplens.study.choice import Choice, choose_frames
from sliplens.study.explaining import frames_at
from sliplens.study.material import Material, gather, study_explainers
from sliplens.study.states import MarkedFrame

METHODS = ("grad-cam", "integrated-gradients")


@pytest.fixture(scope="session")
def network(difference_run: Path) -> TrainedModel:
    return load_checkpoint(difference_run)


@pytest.fixture(scope="session")
def choice(network: TrainedModel, fine_dataset: Dataset) -> Choice:
    return choose_frames({"difference": network}, fine_dataset, trials=2, tolerance=1.0)


@pytest.fixture(scope="session")
def material(
    network: TrainedModel, fine_dataset: Dataset, choice: Choice, tmp_path_factory: pytest.TempPathFactory
) -> Material:
    """Six scored frames of two trials, their maps, and a grid of markers that does not move."""
    explainers = study_explainers(METHODS)
    rows: dict[str, list[int]] = {}
    for pick in choice.frames:
        rows.setdefault(pick.trial, []).append(pick.frame)
    target = tmp_path_factory.mktemp("study") / "explain"
    with output_folder(target, stage="explain", config={"weights_sha256": network.manifest.weights_sha256}) as out:
        chosen = frames_at(network, fine_dataset, rows)
        explain_frames(network, chosen, out.folder, methods=METHODS, explainers=explainers)
    x, y = np.meshgrid(np.arange(6, 48, 9.0), np.arange(6, 48, 9.0))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    return gather(
        network,
        load_explained(target),
        fine_dataset,
        tuple(pick for pick in choice.frames if pick.scored),
        markers={pick.id: MarkedFrame(rest_px=grid, now_px=grid) for pick in choice.frames},
        explainers=explainers,
    )
