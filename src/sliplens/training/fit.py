"""Fit a network to a data set."""

import io
import logging
import os
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import Logger
from torch import nn
from torch.utils.data import DataLoader

from sliplens.errors import InputError, ModelError
from sliplens.files import versions
from sliplens.models import Manifest, TrainedModel, build_model, save_checkpoint
from sliplens.models.backbones import HistogramRegressor, histogram_targets
from sliplens.models.calibration import LEVELS, Calibration, conformal_offset, fit_temperature, quantiles
from sliplens.training.config import TrainConfig
from sliplens.training.data import EpochShuffle, FrameSet, get_augmentation, make_loaders
from sliplens.training.hardware import Hardware
from sliplens.training.module import Clock, DivergedError, Regressor, TrainProgress


class WholeCheckpoints(TorchCheckpointIO):
    """Writes each checkpoint beside the one it replaces, so that a crash or a full disk leaves the old one.

    Lightning's own way goes through the system's temporary folder, and is whole only where that is on the same disk.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint.

        Raises
        ------
        InputError
            If it cannot be written.
        """
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


@torch.no_grad()
def calibrate(model: nn.Module, validation: FrameSet, *, batch_size: int) -> Calibration:
    """Fit the temperature of a distribution, which is set in the model, and the offsets of its intervals.

    Parameters
    ----------
    model
        Trained.
    validation
        Labelled frames of trials that did not train it.
    batch_size
        Images at a time.
    """
    was_training, device = model.training, next(model.parameters()).device
    model.eval()
    network = model.backbone if isinstance(model, HistogramRegressor) else model
    answers = []
    for start in range(0, len(validation), batch_size):
        rows = range(start, min(start + batch_size, len(validation)))
        answers.append(network(validation.__getitems__(rows)[0].to(device)).float().cpu())
    model.train(was_training)
    outputs, labels = torch.cat(answers), validation.safety_margin
    margins = labels.double().numpy()
    if not isinstance(model, HistogramRegressor):
        told = outputs.reshape(-1).double().numpy()
        offsets = {str(level): conformal_offset(told, told, margins, level=level) for level in LEVELS}
        mse = float(np.mean((told - margins) ** 2))
        return Calibration(temperature=1.0, offsets=offsets, frames=len(margins), mse=mse)
    edges = model.edges.cpu()
    temperature = fit_temperature(outputs, histogram_targets(labels, edges))
    model.temperature.fill_(temperature)
    probabilities = torch.softmax(outputs / temperature, dim=-1).double().numpy()
    offsets = {}
    for level in LEVELS:
        low, high = (
            quantiles(probabilities, edges.double().numpy(), share) for share in ((1 - level) / 2, (1 + level) / 2)
        )
        offsets[str(level)] = conformal_offset(np.asarray(low), np.asarray(high), margins, level=level)
    told = probabilities @ model.centres.double().cpu().numpy()
    mse = float(np.mean((told - margins) ** 2))
    return Calibration(temperature=temperature, offsets=offsets, frames=len(margins), mse=mse)


_LAST = "last.ckpt"


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """What a training came to."""

    epochs: float
    minutes: float
    stopped_by: str
    best_validation_mse: float
    parameters: int
    processes: int
    """That shared it."""


def fit(
    config: TrainConfig,
    train: FrameSet,
    validation: FrameSet,
    folder: Path,
    *,
    frame_size: tuple[int, int],
    sensor: str,
    data_hash: str,
    trained_on: Sequence[str] = (),
    start: TrainedModel | None = None,
    hardware: Hardware | None = None,
    logger: Logger | None = None,
    on_progress: Callable[[TrainProgress], None] | None = None,
) -> TrainResult | None:
    """Train a network and save the weights that were best on the validation frames.

    With several processes, each calls this with the same frames and takes its share of every batch; the first writes.
    Batch normalisation sees the share alone, so the weights differ from those of one process.

    Parameters
    ----------
    config
        The recipe.
    train, validation
        Encoded frames, of trials that do not overlap.
    folder
        Gets `model.safetensors`, `manifest.json` and `metrics.csv`. While training runs it also holds checkpoints, from
        which a call with the same folder goes on. All processes must see it.
    frame_size, sensor, data_hash, trained_on
        Kept in the manifest: height and width of the sensor's frames, its name, the data set's hash, and those of the
        trials.
    start
        Network whose weights it starts from, instead of random ones: to go on at another image size, or to teach a
        network a sensor that is like the one it knows. It is left as it is.
    hardware
        One device, a GPU if there is one, unless told otherwise.
    logger
        Gets the errors and the learning rate too.
    on_progress
        Called after every step, in the first process.

    Returns
    -------
    TrainResult or None
        None in all processes but the first.

    Raises
    ------
    InputError
        If the training set is smaller than one batch, a trial is in both sets, the batch does not divide among the
        processes, the machine has not the devices, or a checkpoint cannot be saved.
    ModelError
        If the network to start from has another input, backbone or head, the backbone is unknown, or the loss is no
        longer finite. The best network so far is saved before.
    """
    hardware = hardware or Hardware()
    share = _check(config, train, validation, hardware)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)  # the initial weights; forked, so that the caller's random state is untouched
        # channels last: depthwise convolutions run up to half as fast again on a CPU
        model = build_model(config.backbone, head=config.head).to(memory_format=torch.channels_last)
    if start is not None:
        require_same_kind(start, config, train.encoding.name)
        model.load_state_dict(start.model.state_dict())
    first = hardware.rank() == 0
    per_epoch = len(train) // config.batch_size
    clock = Clock(
        steps=config.epochs * per_epoch,
        max_minutes=config.max_minutes,
        metrics_file=folder / "metrics.csv" if first else None,
        on_progress=on_progress if first else None,
    )

    def batch_rows(epoch: int, batch: int) -> list[str]:
        order = EpochShuffle(len(train), seed=config.seed).order(epoch)[hardware.rank() :: hardware.processes]
        return [_name(train, row) for row in order[batch * share : (batch + 1) * share]]

    module = Regressor(
        model,
        config=config,
        augmentation=get_augmentation(config.augmentation, neutral=train.encoding.neutral),
        steps=clock.steps,
        fraction_done=clock.fraction,
        batch_rows=batch_rows,
    )
    checkpoints = folder / "checkpoints"
    best = ModelCheckpoint(dirpath=checkpoints, filename="best", monitor="validation_mse", save_last=True)
    trainer = make_trainer(
        config,
        hardware=hardware,
        callbacks=[clock, best],
        folder=checkpoints,
        logger=logger if first else None,
        steps_per_epoch=per_epoch,
    )
    loaders = make_loaders(
        train,
        validation,
        seed=config.seed,
        batch_size=share,
        rank=hardware.rank(),
        processes=hardware.processes,
    )

    def save_best() -> float:
        # our own file of tensors and plain numbers, read back without unpickling anything else
        kept = torch.load(best.best_model_path, map_location="cpu", weights_only=True)
        module.load_state_dict(kept["state_dict"])
        # as the file itself has it: after a crash between two files the callback may remember an older one
        best_mse = float(kept["callbacks"][best.state_key]["current_score"])
        calibration = calibrate(module.model, validation, batch_size=config.batch_size)
        save_checkpoint(
            folder,
            module.model,
            Manifest(
                backbone=config.backbone,
                head=config.head,
                recipe=config.recipe,
                input=train.encoding.name,
                image_size=config.image_size,
                frame_size=frame_size,
                sensor=sensor,
                data_hash=data_hash,
                trained_on=(*trained_on, *(start.manifest.trained_on if start else ())),
                started_from=start.manifest.weights_sha256 if start else "",
                metrics={"validation_mse": calibration.mse},
                calibration=calibration,
                versions=versions(),
            ),
        )
        return best_mse

    try:
        with torch.random.fork_rng(devices=[]):
            run_trainer(trainer, module, loaders, checkpoints / _LAST)
    except DivergedError as error:
        if not first:
            return None
        if not best.best_model_path:
            raise
        raise ModelError(
            f"{error} (the best network so far, of validation MSE {save_best():.4g}, is in {folder})"
        ) from None
    if not first:
        return None
    best_mse = save_best()
    shutil.rmtree(checkpoints)
    return TrainResult(
        epochs=clock.rows[-1][0],
        minutes=clock.seconds / 60,
        stopped_by=clock.stopped_by,
        best_validation_mse=best_mse,
        parameters=sum(value.numel() for value in model.parameters()),
        processes=hardware.processes,
    )


def _check(config: TrainConfig, train: FrameSet, validation: FrameSet, hardware: Hardware) -> int:
    """Refuse frames that this recipe or this hardware cannot take; return the share of a batch of one process."""
    share = hardware.share(config.batch_size)
    if len(train) < config.batch_size:
        raise InputError(f"{len(train)} training frames do not fill a batch of {config.batch_size}; lower batch_size")
    if len(validation) < hardware.processes:
        raise InputError(
            f"{len(validation)} validation frames are too few for {hardware.processes} processes; lower --devices"
        )
    shared = set(train.trial) & set(validation.trial)
    if shared:
        raise InputError(f"trial {min(shared)} is in both training and validation; split by trial")
    return share


def require_same_kind(start: TrainedModel, config: TrainConfig, encoding: str) -> None:
    """Refuse to start from a network whose weights would mean something else.

    Raises
    ------
    ModelError
        If its input, backbone or head is another.
    """
    kept = start.manifest
    asked = {"input": encoding, "backbone": config.backbone, "head": config.head}
    for name, value in asked.items():
        if getattr(kept, name) != value:
            raise ModelError(
                f"the network to start from has the {name} {getattr(kept, name)}, and {value} is to be trained; "
                f"train {getattr(kept, name)}, or start from another network"
            )


def _name(frames: FrameSet, row: int) -> str:
    frame = frames.frame[row]
    return f"the reference frame of {frames.trial[row]}" if frame < 0 else f"frame {frame} of {frames.trial[row]}"
