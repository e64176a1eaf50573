import importlib.util
import json
from dataclasses import asdict
from pathlib import Path

import pytest
from there import there

from sliplens.errors import InputError
from sliplens.training import TrainingConfig
from sliplens.training.config import LOGGERS, open_logger

RECIPE = {**asdict(TrainingConfig()), "input": "difference", "condition": None}


def needs(name: str) -> None:
    for package in LOGGERS[name][0]:
        pytest.importorskip(package, reason=f"{package} is not installed")


def test_wandb_stays_on_this_machine_unless_told_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    needs("wandb")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    with open_logger("wandb", tmp_path, run_name="run", recipe=RECIPE) as logger:
        there(logger).log_metrics({"validation_mse": 0.25}, step=1)
    folders = [path.name for path in (tmp_path / "wandb").iterdir() if path.is_dir()]
    assert len([name for name in folders if name.startswith("offline-run-")]) == 1
    assert not [name for name in folders if name.startswith("run-")]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # mlflow calls what SQLAlchemy deprecates
def test_mlflow_keeps_its_runs_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    needs("mlflow")
    from mlflow.tracking import MlflowClient  # noqa: PLC0415 (an extra)  # pyright: ignore[reportMissingImports]

    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    with open_logger("mlflow", tmp_path, run_name="run", recipe=RECIPE) as logger:
        assert logger is not None
        logger.log_metrics({"validation_mse": 0.25}, step=1)
        logger.finalize("success")
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow' / 'mlflow.db'}")
    experiment = there(client.get_experiment_by_name("sliplens"))
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.data.metrics == {"validation_mse": 0.25}
    assert run.data.params["learning_rate"] == json.dumps(RECIPE["learning_rate"])


@pytest.mark.parametrize("name", list(LOGGERS))
def test_a_package_that_is_missing_is_named_with_its_cure(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    find = importlib.util.find_spec
    gone = LOGGERS[name][0]
    monkeypatch.setattr("sliplens.extras.find_spec", lambda package: None if package in gone else find(package))
    with (
        pytest.raises(InputError, match=rf'--logger {name} needs {name}.*`pip install "sliplens\[tracking\]"`'),
        open_logger(name, tmp_path, run_name="run", recipe=RECIPE),
    ):
        pass
