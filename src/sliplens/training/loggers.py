"""Experiment loggers, kept on this machine unless asked otherwise."""

import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger

from sliplens.errors import InputError
from sliplens.extras import missing_packages

PROJECT = "sliplens"
"""Of the runs in Weights & Biases, and experiment of those in MLflow."""


def _tensorboard(folder: Path, _: str) -> Logger:
    return TensorBoardLogger(folder, name="tensorboard", version="", default_hp_metric=False)


def _wandb(folder: Path, run_name: str) -> Logger:
    # whoever is logged in for something else has not asked to send this
    offline = "WANDB_MODE" not in os.environ
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
    os.environ.setdefault("WANDB_SILENT", "true")
    from wandb import Settings  # noqa: PLC0415 (an extra)  # pyright: ignore[reportMissingImports]

    settings = Settings(console="off", disable_git=True, x_disable_stats=True, x_disable_meta=True)
    return WandbLogger(name=run_name, save_dir=folder, project=PROJECT, offline=offline, settings=settings)


def _mlflow(folder: Path, run_name: str) -> Logger:
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
    logging.getLogger("lightning.pytorch.loggers.mlflow").setLevel(logging.ERROR)  # "Experiment not found. Creating it"
    address = os.environ.get("MLFLOW_TRACKING_URI")
    if not address:
        (folder / "mlflow").mkdir(exist_ok=True)
        address = f"sqlite:///{folder.resolve() / 'mlflow' / 'mlflow.db'}"
    return MLFlowLogger(experiment_name=PROJECT, run_name=run_name, tracking_uri=address)


LOGGERS: dict[str, tuple[tuple[str, ...], Callable[[Path, str], Logger]]] = {
    "tensorboard": (("tensorboard",), _tensorboard),
    "wandb": (("wandb",), _wandb),
    # mlflow-skinny, which lacks the latter, keeps no runs on this machine
    "mlflow": (("mlflow", "sqlalchemy"), _mlflow),
}
"""The packages that each needs, and how it is made."""


@contextmanager
def open_logger(
    name: str, folder: Path, *, run_name: str, recipe: Mapping[str, str | float | None]
) -> Iterator[Logger | None]:
    """Open a logger that keeps its files in the run's folder, and close it so that the folder can take its name.

    TensorBoard and MLflow write there, MLflow elsewhere if `MLFLOW_TRACKING_URI` says so. Weights & Biases too writes
    there alone, for `wandb sync` to send, unless `WANDB_MODE` says `online`: nothing leaves the machine unasked. `csv`
    opens none, for `metrics.csv` is always written.
    """
    if name == "csv":
        yield None
        return
    if name not in LOGGERS:
        raise InputError(f"there is no logger named {name!r}; choose one of csv, {', '.join(LOGGERS)}")
    packages, make = LOGGERS[name]
    if missing := missing_packages(*packages, extra="tracking"):
        raise InputError(f"--logger {name} needs {missing}, or leave --logger away, for metrics.csv is always written")
    try:
        logger = make(folder, run_name)
        logger.log_hyperparams(dict(recipe))
    except Exception as error:  # these libraries have trees of errors of their own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(f"--logger {name} does not start ({reason}); mend that, or leave --logger away") from None
    try:
        yield logger
    finally:
        if name == "wandb":
            logger.experiment.finish()  # pyright: ignore[reportAttributeAccessIssue]
