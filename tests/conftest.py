"""Fixtures that several tests share."""

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def reference_folder() -> Path:
    """Folder of real recordings; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference"))
    if not folder.is_dir():
        pytest.skip(f"the real recordings are not at {folder}; set SLIPLENS_REFERENCE to their folder")
    return folder


@pytest.fixture(scope="session")
def chromatouch_folder(reference_folder: Path) -> Path:
    """The real ChromaTouch images, maps and recorded answers."""
    folder = reference_folder / "chromatouch"
    if not folder.is_dir():
        pytest.skip(f"the real ChromaTouch data are not at {folder}")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)
