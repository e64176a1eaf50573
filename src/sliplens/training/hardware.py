"""The machine that a training runs on, and which of its processes this one is."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.fabric.plugins.environments.lsf import LSFEnvironment
from lightning.fabric.plugins.environments.mpi import MPIEnvironment
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment

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
