"""The machine that a training runs on, and which of its processes this one is."""

import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.fabric.plugins.environments.lsf import LSFEnvironment
from lightning.fabric.plugins.environments.mpi import MPIEnvironment
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger

from sliplens.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Hardware:
    """Devices and nodes that share a training; they change how long it takes and are no part of its recipe.

    Each device has a process of its own (distributed data parallel). Lightning starts those of one machine itself;
    torchrun and SLURM start all. The first process writes, the others only train.

    Raises
    ------
    InputError
        If a number is not positive.
    """

    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    devices: int = 1
    """A node."""
    num_nodes: int = 1

    def __post_init__(self) -> None:
        """Refuse numbers on which nothing can run."""
        for name in ("devices", "num_nodes"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def processes(self) -> int:
        """How many there are over all nodes."""
        return self.devices * self.num_nodes

    def rank(self) -> int:
        """Number of this process among all, from 0: what Lightning will find, told before it is asked.

        Raises
        ------
        InputError
            If torchrun or a cluster started another number of processes.
        """
        environment = _environment()
        if isinstance(environment, LightningEnvironment):
            return environment.node_rank() * self.devices + environment.local_rank()
        started = environment.world_size()
        if started != self.processes:
            raise InputError(
                f"{started} processes were started, but --devices times --num-nodes is {self.processes}; "
                "make them the same"
            )
        return environment.global_rank()

    def share(self, batch_size: int) -> int:
        """Images of a batch that one process takes.

        Raises
        ------
        InputError
            If the batch does not divide, or a share is too small for batch normalisation.
        """
        share, rest = divmod(batch_size, self.processes)
        if rest:
            raise InputError(
                f"batch_size {batch_size} does not divide among {self.processes} processes; "
                f"choose {max(2, share) * self.processes}"
            )
        if share < 2:
            raise InputError(
                f"batch_size {batch_size} leaves one image to each of {self.processes} processes, and batch "
                f"normalisation needs more; choose {2 * self.processes} or more"
            )
        return share


def _environment() -> ClusterEnvironment:
    # those that Lightning asks, in its order
    for kind in (TorchElasticEnvironment, SLURMEnvironment, LSFEnvironment, MPIEnvironment):
        if kind.detect():
            try:
                return kind()
            except RuntimeError as error:
                reason = str(error).rstrip(".")
                raise InputError(f"cannot tell the processes of this cluster apart ({reason})") from None
    return LightningEnvironment()


def follow_folder(target: Path, *, overwrite: bool = False) -> Path | None:
    """Folder that the first process makes through `output_folder`, for the others, which only read there.

    Parameters
    ----------
    target, overwrite
        As the first process gives them.

    Returns
    -------
    Path or None
        None where the target exists: then the first process has nothing to do, or refuses.
    """
    # the target appears when a training is over, which no process leaves before the others: all see the same here
    if target.exists() and not overwrite:
        return None
    return target.with_name(f".{target.name}.partial")


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
def open_logger(name: str, folder: Path, *, run_name: str, recipe: Mapping[str, Any]) -> Iterator[Logger | None]:
    """Open a logger that keeps its files in the run's folder, and close it so that the folder can take its name.

    TensorBoard and MLflow write there, MLflow elsewhere if `MLFLOW_TRACKING_URI` says so. Weights & Biases too writes
    there alone, for `wandb sync` to send, unless `WANDB_MODE` says `online`: nothing leaves the machine unasked.

    Parameters
    ----------
    name
        `csv` for none besides `metrics.csv`, or one of `LOGGERS`.
    folder
        Of the run.
    run_name
        What the logger calls the run.
    recipe
        Kept as hyperparameters.

    Raises
    ------
    InputError
        If there is no such logger, its package is not installed, or it does not start.
    """
    if name == "csv":
        yield None
        return
    if name not in LOGGERS:
        raise InputError(f"there is no logger named {name!r}; choose one of csv, {', '.join(LOGGERS)}")
    packages, make = LOGGERS[name]
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise InputError(
            f'--logger {name} needs {name}, which is not installed; install with `pip install "sliplens[tracking]"`, '
            "or leave --logger away, for metrics.csv is always written"
        )
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
