"""A small study, up to where its scores begin."""

from pathlib import Path

import numpy as np
import pytest

from sliplens.explainers.explain import explain_frames
from sliplens.explainers.frames import frames_at
from sliplens.models import Network, load
from sliplens.recordings import Dataset
from sliplens.results.study import Choice, MarkerTable, StudyConfig
from sliplens.study.choice import Material, choose_frames, gather, study_explainers

METHODS = ("grad-cam", "integrated-gradients")


def marker_table(rest: np.ndarray, now: np.ndarray) -> MarkerTable:
    """Markers of a frame from x and y at rest and now."""
    places = dict(zip(("rest_x_px", "rest_y_px", "x_px", "y_px"), (*rest.T, *now.T), strict=True))
    return MarkerTable(frame_id=np.full(len(rest), "f"), marker=np.arange(len(rest)), **places)


@pytest.fixture(scope="session")
def network(difference_run: Path) -> Network:
    return load(difference_run)


@pytest.fixture(scope="session")
def choice(network: Network, fine_dataset: Dataset) -> Choice:
    return choose_frames({"difference": network}, fine_dataset, StudyConfig(trials=2, tolerance=1.0))


@pytest.fixture(scope="session")
def material(network: Network, fine_dataset: Dataset, choice: Choice) -> Material:
    """Six scored frames of two trials, their maps, and a grid of markers that does not move."""
    explainers = study_explainers(METHODS)
    chosen = frames_at(network, fine_dataset, [(frame.trial, frame.frame) for frame in choice.frames])
    grid = np.stack(np.meshgrid(np.arange(6, 48, 9.0), np.arange(6, 48, 9.0)), axis=-1).reshape(-1, 2)
    return gather(
        network,
        explain_frames(network, chosen, explainers),
        tuple(frame for frame in choice.frames if frame.scored),
        markers={frame.id: marker_table(grid, grid) for frame in choice.frames},
        explainers=explainers,
    )
