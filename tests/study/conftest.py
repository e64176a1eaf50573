"""A small study, up to where its scores begin."""

from pathlib import Path

import numpy as np
import pytest

from sliplens.explainers.contract import Explainer
from sliplens.explainers.explain import explain_frames
from sliplens.explainers.frames import frames_at
from sliplens.models import Network, load
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation
from sliplens.results.study import Choice, MarkerTable, StudyConfig
from sliplens.study.choice import choose_frames, study_explainers


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
def explainers() -> dict[str, Explainer]:
    return study_explainers(("grad-cam", "integrated-gradients"))


@pytest.fixture(scope="session")
def explained(network: Network, fine_dataset: Dataset, choice: Choice, explainers: dict[str, Explainer]) -> Explanation:
    """Maps of six scored frames of two trials."""
    places = [(frame.trial, frame.frame) for frame in choice.frames if frame.scored]
    return explain_frames(network, frames_at(network, fine_dataset, places), explainers)


@pytest.fixture(scope="session")
def markers(choice: Choice) -> dict[str, MarkerTable]:
    """A grid of markers that does not move."""
    grid = np.stack(np.meshgrid(np.arange(6, 48, 9.0), np.arange(6, 48, 9.0)), axis=-1).reshape(-1, 2)
    return {frame.id: marker_table(grid, grid) for frame in choice.frames}
