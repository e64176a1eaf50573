"""A data set to export."""

import pytest
from exportable import save_exportable

from sliplens.recordings import Dataset


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Trials with all that an export must hold."""
    return save_exportable(tmp_path_factory.mktemp("exportable"))
