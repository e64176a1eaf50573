"""Made-up workspaces, as they are and to damage."""

import shutil
from pathlib import Path

import pytest
from made_up import write_workspace

from sliplens.report import Written, write_report

from .study_results import Made, write_study


@pytest.fixture(scope="session")
def pristine_workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_workspace(tmp_path_factory.mktemp("pristine") / "runs")


@pytest.fixture
def workspace(pristine_workspace: Path, tmp_path: Path) -> Path:
    """A copy of one's own, to damage."""
    return shutil.copytree(pristine_workspace, tmp_path / "runs")


@pytest.fixture(scope="session")
def pristine_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_study(tmp_path_factory.mktemp("pristine") / "study")


@pytest.fixture(scope="session")
def study_report(pristine_study: Path, tmp_path_factory: pytest.TempPathFactory) -> Written:
    """The report of a whole study, drawn once: it takes a while."""
    return write_report(pristine_study, tmp_path_factory.mktemp("report") / "report.html")


@pytest.fixture(scope="session")
def pristine_half_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_study(tmp_path_factory.mktemp("pristine") / "study", Made(inputs=("raw",)))


@pytest.fixture
def study(pristine_half_study: Path, tmp_path: Path) -> Path:
    """A study of raw images, a copy of one's own, to damage."""
    return shutil.copytree(pristine_half_study, tmp_path / "study")
