"""Lightning's trainer: what it lacks for a training that goes on where it stopped, in plain sentences."""

import io
import logging
import os
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.fabric.utilities.exceptions import MisconfigurationException
from torch.utils.data import DataLoader

from sliplens.errors import InputError, ModelError
from sliplens.training.config import TrainConfig
from sliplens.training.module import DivergedError, Regressor


def make_trainer(
    config: TrainConfig,
    *,
    accelerator: Literal["auto", "cpu", "gpu"] = "auto",
    devices: int = 1,
    num_nodes: int = 1,
) -> lightning.Trainer:
    """Trainer of this process, which knows its number among all (`global_rank`); nothing runs yet.

    `accelerator`, `devices` and `num_nodes` are Lightning's own: devices of each node, a process each. `InputError` if
    this machine has not the devices, or torchrun or a cluster started another number of processes.
    """
    half = config.mixed_precision and accelerator != "cpu" and torch.cuda.is_available()
    shared = devices * num_nodes > 1 or TorchElasticEnvironment.detect()
    try:
        with quiet_lightning():
            trainer = lightning.Trainer(
                accelerator=accelerator,
                devices=devices,
                num_nodes=num_nodes,
                strategy="ddp" if shared else "auto",
                plugins=[WholeCheckpoints()],
                max_epochs=config.epochs,
                logger=False,
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
                num_sanity_val_steps=0,
                # ours share the frames as the loss and the validation error need it
                use_distributed_sampler=False,
                # Ranger21 clips by itself, adaptively
                gradient_clip_val=1.0 if config.optimizer == "adamw" else None,
                precision="16-mixed" if half else "32-true",
            )
        environment = getattr(trainer.strategy, "cluster_environment", None)
        if environment is not None:
            environment.validate_settings(num_devices=devices, num_nodes=num_nodes)
    except (MisconfigurationException, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"this machine cannot train on {devices} x {accelerator} ({reason}); "
            "change --devices, --num-nodes or --accelerator"
        ) from None
    return trainer


def share_of_batch(batch_size: int, processes: int) -> int:
    """Images of a batch that one process takes."""
    share, rest = divmod(batch_size, processes)
    if rest:
        raise InputError(
            f"batch_size {batch_size} does not divide among {processes} processes; choose {max(2, share) * processes}"
        )
    if share < 2:
        raise InputError(
            f"batch_size {batch_size} leaves one image to each of {processes} processes, and batch normalisation needs "
            f"more; choose {2 * processes} or more"
        )
    return share


class WholeCheckpoints(TorchCheckpointIO):
    """Writes each checkpoint beside the one it replaces, so that a crash or a full disk leaves the old one.

    Lightning's own way goes through the system's temporary folder, and is whole only where that is on the same disk.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint."""
        if storage_options is not None:
            raise TypeError("this way of saving takes no storage_options")
        target = Path(path)
        part = target.with_name(target.name + ".part")
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with part.open("wb") as stream:
                stream.write(buffer.getbuffer())
                stream.flush()
                os.fsync(stream.fileno())  # the new name must not come before the bytes
            part.replace(target)
        except OSError as error:
            with suppress(OSError):
                part.unlink()
            raise InputError(
                f"cannot save the checkpoint {target} ({error.strerror}); make room and give the same command again, "
                "it goes on after the last whole epoch"
            ) from None


def run_trainer(
    trainer: lightning.Trainer, module: Regressor, loaders: tuple[DataLoader, DataLoader], last: Path
) -> None:
    """Train, going on from a checkpoint where there is one."""
    on_interrupt = signal.getsignal(signal.SIGINT)
    with quiet_lightning():
        try:
            if trainer.global_rank > 0:
                # returns when the first process has come so far: by then it has decided whether to go on or begin anew
                trainer.strategy.setup_environment()
            trainer.fit(module, *loaders, ckpt_path=str(last) if last.is_file() else None, weights_only=True)
        except DivergedError:
            raise
        except SystemExit:
            # Lightning exits and goes deaf to Ctrl-C; what happens next is the caller's to decide
            signal.signal(signal.SIGINT, on_interrupt)
            _end_others(trainer)
            raise KeyboardInterrupt from None
        except torch.OutOfMemoryError:
            _end_others(trainer)
            raise ModelError("the memory of the GPU is full; lower --batch-size or --image-size") from None
        except RuntimeError as error:
            _end_others(trainer)
            lost = ("gloo", "connection closed", "connection reset", "broken pipe")
            known = isinstance(error, torch.distributed.DistError) or any(word in str(error).lower() for word in lost)
            if trainer.world_size > 1 and known:
                raise ModelError(
                    "another process of this training was lost; give the same command again, it goes on after the last "
                    "whole epoch"
                ) from None
            raise
        except BaseException:
            _end_others(trainer)
            raise


def _end_others(trainer: lightning.Trainer) -> None:
    """End the processes that Lightning started here: they would wait for this one, and write nothing."""
    launcher = trainer.strategy.launcher
    if launcher is not None:
        launcher.kill(getattr(signal, "SIGKILL", signal.SIGTERM))  # the gentler one does not reach a process that waits


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Keep Lightning's notes on hardware, loggers and its own deprecations from the user's terminal."""
    names = ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.rank_zero", "lightning.fabric")
    loggers = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in loggers:
        logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            for message in _EXPECTED:
                warnings.filterwarnings("ignore", message=message)
            yield
    finally:
        for logger, level in loggers.items():
            logger.setLevel(level)


_EXPECTED = (
    ".*does not have many workers.*",  # the frames lie in memory: worker processes would only copy them
    ".*Checkpoint directory.*exists and is not empty.*",  # resuming means to go on in such a folder
    ".*LeafSpec.*",  # Lightning 2.6 calls what torch 2.13 deprecates
    ".*Grad strides do not match bucket view strides.*",  # channels last, which is worth more than this costs
    ".*GPU available but not used.*",  # who asks for --accelerator cpu has a reason
)
