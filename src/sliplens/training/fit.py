"""Fit a network to a data set."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import Logger

from sliplens.datasets import FrameSet, get_augmentation
from sliplens.errors import InputError, ModelError
from sliplens.models import Manifest, TrainedModel, build_model, save_checkpoint
from sliplens.provenance import versions
from sliplens.training.calibrate import calibrate
from sliplens.training.config import TrainConfig
from sliplens.training.hardware import Hardware
from sliplens.training.module import Clock, DivergedError, Regressor, TrainProgress
from sliplens.training.running import make_trainer, run_trainer
from sliplens.training.samplers import EpochShuffle, make_loaders

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
                calibration=asdict(calibration),
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
