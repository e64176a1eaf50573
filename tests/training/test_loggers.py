from pathlib import Path

import pytest

from sliplens.errors import InputError
from sliplens.training.config import make_logger


def test_a_package_that_is_missing_is_named_with_its_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sliplens.extras.find_spec", lambda _: None)
    with pytest.raises(
        InputError, match=r"--logger tensorboard needs tensorboard.*`pip install .sliplens\[tracking\].`"
    ):
        make_logger("tensorboard", tmp_path)


def test_an_unknown_logger_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no logger named 'wandb'; choose csv or tensorboard, or in Python one of"):
        make_logger("wandb", tmp_path)
