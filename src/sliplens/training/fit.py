"""Fit a network to a data set."""

import logging
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader, Sampler

from sliplens.datasets import FrameSet, get_augmentation
from sliplens.errors import InputError
from sliplens.models import Manifest, build_model, save_checkpoint
from sliplens.provenance import versions
from sliplens.training.calibrate import calibrate
from sliplens.training.config import TrainConfig
from sliplens.training.module import Clock, Regressor, TrainProgress

_LAST = "last.ckpt"


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """What a training came to."""

    epochs: float
    minutes: float
    stopped_by: str
    best_validation_mse: float
    parameters: int


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
    on_progress: Callable[[TrainProgress], None] | None = None,
) -> TrainResult:
    """Train a network and save the weights that were best on the validation frames.

    Parameters
    ----------
    config
        The recipe.
    train, validation
        Encoded frames, of trials that do not overlap.
    folder
        Gets `model.safetensors`, `manifest.json` and `metrics.csv`. While training runs it also holds checkpoints, from
        which a call with the same folder goes on.
    frame_size, sensor, data_hash, trained_on
        Kept in the manifest: height and width of the sensor's frames, its name, the data set's hash, and those of the
        trials.
    on_progress
        Called after every step.

    Raises
    ------
    InputError
        If the training set is smaller than one batch, or a trial is in both sets.
    ModelError
        If the loss is no longer finite, or the backbone is unknown.
    """
    if len(train) < config.batch_size:
        raise InputError(f"{len(train)} training frames do not fill a batch of {config.batch_size}; lower batch_size")
    shared = set(train.trial) & set(validation.trial)
    if shared:
        raise InputError(f"trial {min(shared)} is in both training and validation; split by trial")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)  # the initial weights; forked, so that the caller's random state is untouched
        # channels last: depthwise convolutions run up to half as fast again on a CPU
        model = build_model(config.backbone, head=config.head).to(memory_format=torch.channels_last)
    loaders = _loaders(config, train, validation)
    clock = Clock(
        steps=config.epochs * len(loaders[0]),
        max_minutes=config.max_minutes,
        metrics_file=folder / "metrics.csv",
        on_progress=on_progress,
    )
    module = Regressor(
        model,
        config=config,
        augmentation=get_augmentation(config.augmentation, neutral=train.encoding.neutral),
        steps=clock.steps,
        fraction_done=clock.fraction,
    )
    checkpoints = folder / "checkpoints"
    best = ModelCheckpoint(dirpath=checkpoints, filename="best", monitor="validation_mse", save_last=True)
    with torch.random.fork_rng(devices=[]):
        _run(config, module, [clock, best], loaders, checkpoints / _LAST)
    # our own file of tensors and plain numbers, read back without unpickling anything else
    state = torch.load(best.best_model_path, weights_only=True)["state_dict"]
    module.load_state_dict(state)
    assert best.best_model_score is not None  # set whenever a best path is
    best_mse = float(best.best_model_score)
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
            trained_on=tuple(trained_on),
            metrics={"validation_mse": best_mse},
            calibration=asdict(calibration),
            versions=versions(),
        ),
    )
    shutil.rmtree(checkpoints)
    return TrainResult(
        epochs=clock.rows[-1][0],
        minutes=clock.seconds / 60,
        stopped_by=clock.stopped_by,
        best_validation_mse=best_mse,
        parameters=sum(value.numel() for value in model.parameters()),
    )


def _loaders(config: TrainConfig, train: FrameSet, validation: FrameSet) -> tuple[DataLoader, DataLoader]:
    common: dict[str, Any] = {"batch_size": config.batch_size, "collate_fn": _as_is}
    # a last small batch would make batch normalisation noisy
    shuffled = DataLoader(train, sampler=EpochShuffle(len(train), seed=config.seed), drop_last=True, **common)
    return shuffled, DataLoader(validation, **common)


class EpochShuffle(Sampler[int]):
    """A random order for each epoch that depends on the seed and the epoch alone, so that resuming repeats it."""

    def __init__(self, count: int, *, seed: int) -> None:
        self.count = count
        self.seed = seed
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Count the frames."""
        return self.count

    def __iter__(self) -> Iterator[int]:
        """Yield every index once."""
        return iter(np.random.default_rng((self.seed, self.epoch)).permutation(self.count).tolist())


def _as_is(batch: Any) -> Any:
    return batch  # FrameSet.__getitems__ has made the batch already


def _run(
    config: TrainConfig,
    module: Regressor,
    callbacks: list[Any],
    loaders: tuple[DataLoader, DataLoader],
    last: Path,
) -> None:
    with _quiet_lightning():
        trainer = lightning.Trainer(
            accelerator="auto",
            devices=1,
            max_epochs=config.epochs,
            callbacks=callbacks,
            logger=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            num_sanity_val_steps=0,
            # Ranger21 clips by itself, adaptively
            gradient_clip_val=1.0 if config.optimizer == "adamw" else None,
            precision="16-mixed" if config.mixed_precision and torch.cuda.is_available() else "32-true",
        )
        on_interrupt = signal.getsignal(signal.SIGINT)
        try:
            trainer.fit(module, *loaders, ckpt_path=str(last) if last.is_file() else None, weights_only=True)
        except SystemExit:
            # Lightning exits and goes deaf to Ctrl-C; what happens next is the caller's to decide
            signal.signal(signal.SIGINT, on_interrupt)
            raise KeyboardInterrupt from None


@contextmanager
def _quiet_lightning() -> Iterator[None]:
    """Keep Lightning's notes on hardware, loggers and its own deprecations from the user's terminal."""
    logger = logging.getLogger("lightning.pytorch.utilities.rank_zero")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            # the frames lie in memory: worker processes would only copy them
            warnings.filterwarnings("ignore", message=".*does not have many workers.*")
            # going on in a folder that holds a checkpoint is what resuming means
            warnings.filterwarnings("ignore", message=".*Checkpoint directory.*exists and is not empty.*")
            # Lightning 2.6 calls what torch 2.13 deprecates
            warnings.filterwarnings("ignore", message=".*LeafSpec.*", category=FutureWarning)
            yield
    finally:
        logger.setLevel(level)
