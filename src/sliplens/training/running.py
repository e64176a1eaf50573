"""Lightning's trainer, set up for a recipe and a machine, and what may go wrong while it runs."""

import logging
import signal
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger
from torch.utils.data import DataLoader

from sliplens.errors import InputError, ModelError
from sliplens.training.config import TrainConfig
from sliplens.training.hardware import Hardware
from sliplens.training.module import DivergedError, Regressor
from sliplens.training.saving import WholeCheckpoints


def make_trainer(
    config: TrainConfig,
    *,
    hardware: Hardware,
    callbacks: Sequence[Callback],
    folder: Path,
    logger: Logger | None,
    steps_per_epoch: int,
) -> lightning.Trainer:
    """Trainer of one process; nothing runs yet.

    Parameters
    ----------
    folder
        For what Lightning writes of its own accord.

    Raises
    ------
    InputError
        If this machine has not the devices.
    """
    on_gpu = hardware.accelerator != "cpu" and torch.cuda.is_available()
    try:
        with quiet_lightning():
            return lightning.Trainer(
                accelerator=hardware.accelerator,
                devices=hardware.devices,
                num_nodes=hardware.num_nodes,
                strategy="ddp" if hardware.processes > 1 else "auto",
                max_epochs=config.epochs,
                callbacks=list(callbacks),
                plugins=[WholeCheckpoints()],
                logger=logger or False,
                log_every_n_steps=min(50, steps_per_epoch),
                default_root_dir=folder,
                enable_progress_bar=False,
                enable_model_summary=False,
                num_sanity_val_steps=0,
                # ours share the frames as the loss and the validation error need it
                use_distributed_sampler=False,
                # Ranger21 clips by itself, adaptively
                gradient_clip_val=1.0 if config.optimizer == "adamw" else None,
                precision="16-mixed" if config.mixed_precision and on_gpu else "32-true",
            )
    except MisconfigurationException as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"this machine cannot train on {hardware.devices} x {hardware.accelerator} ({reason}); "
            "lower --devices or choose another --accelerator"
        ) from None


def run_trainer(
    trainer: lightning.Trainer, module: Regressor, loaders: tuple[DataLoader, DataLoader], last: Path
) -> None:
    """Train, going on from a checkpoint where there is one.

    Raises
    ------
    KeyboardInterrupt
        If interrupted or told to end; Lightning would exit.
    DivergedError
        If a loss is not finite, in every process.
    ModelError
        If the memory of a GPU is full, or another process was lost.
    """
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
            if trainer.world_size > 1 and _is_lost_connection(error):
                raise ModelError(
                    "another process of this training was lost; give the same command again, it goes on after the last "
                    "whole epoch"
                ) from None
            raise
        except BaseException:
            _end_others(trainer)
            raise


def _is_lost_connection(error: RuntimeError) -> bool:
    words = str(error).lower()
    return isinstance(error, torch.distributed.DistError) or any(
        word in words for word in ("gloo", "connection closed", "connection reset", "broken pipe")
    )


def _end_others(trainer: lightning.Trainer) -> None:
    """End the processes that Lightning started here: they would wait for this one, and write nothing."""
    launcher = trainer.strategy.launcher
    if launcher is not None:
        launcher.kill(getattr(signal, "SIGKILL", signal.SIGTERM))  # the gentler one does not reach a process that waits


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Keep Lightning's notes on hardware, loggers and its own deprecations from the user's terminal."""
    names = ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.rank_zero", "lightning.fabric")
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            for message, category in _EXPECTED:
                warnings.filterwarnings("ignore", message=message, category=category)
            yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


_EXPECTED: tuple[tuple[str, Any], ...] = (
    # the frames lie in memory: worker processes would only copy them
    (".*does not have many workers.*", Warning),
    # going on in a folder that holds a checkpoint is what resuming means
    (".*Checkpoint directory.*exists and is not empty.*", Warning),
    # Lightning 2.6 calls what torch 2.13 deprecates
    (".*LeafSpec.*", FutureWarning),
    # channels last, which is worth more than this costs
    (".*Grad strides do not match bucket view strides.*", UserWarning),
    # who asks for --accelerator cpu has a reason
    (".*GPU available but not used.*", Warning),
)
