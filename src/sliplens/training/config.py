"""Settings of a training, recipes, and loggers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypedDict

from lightning.pytorch.loggers import Logger, TensorBoardLogger

from sliplens.errors import InputError
from sliplens.extras import missing_packages, pick
from sliplens.models.backbones import DEFAULT_BACKBONE, HEADS
from sliplens.models.checkpoint import LARGEST_INPUT
from sliplens.training.data import get_augmentation

_LEAST, _MOST = 1e-12, 1e9
_LIMITS = {
    "image_size": (32, LARGEST_INPUT),
    "epochs": (1, _MOST),
    "batch_size": (2, _MOST),  # batch normalisation needs more than one image
    "learning_rate": (_LEAST, _MOST),
    "max_minutes": (_LEAST, _MOST),
    "untouched_share": (0, 1),
    "epoch_frames": (1, _MOST),
    "patience": (1, _MOST),
}
"""Least and largest values of settings."""


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Settings of a training; `InputError` for an impossible value."""

    recipe: str = "default"
    """Name of the recipe, for the manifest."""
    backbone: str = DEFAULT_BACKBONE
    head: str = "point"
    """Outputs of the network: `point`, `histogram` or `margin-and-ratio`."""
    image_size: int = 224
    epochs: int = 25
    batch_size: int = 64
    optimizer: Literal["adamw", "ranger21"] = "adamw"
    """AdamW with one warm-up and one cosine descent, or Ranger21 with its own schedule and defaults."""
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    """Share of each weight, times the learning rate, that AdamW takes away a step; Ranger21 keeps its own."""
    mixed_precision: bool = False
    """16-bit floats where they are safe; on a GPU alone, for a CPU is not faster with them."""
    max_minutes: float | None = None
    augmentation: str = "default"
    untouched_share: float = 0.05
    """Images of the untouched sensor, as full stick, for each labelled frame."""
    learns: Literal["all", "weights", "ratio"] = "all"
    """Parameters that change. all: weights, and the statistics of batch normalisation. weights: the weights alone.
    ratio: the rows of the last layer that predict F_t / F_n, so that margins stay to the bit; the inputs of that layer
    are computed once, without augmentation."""
    epoch_frames: int | None = None
    """Images of an epoch, drawn from all; each frame once if None."""
    patience: int | None = None
    """Epochs without gain on the validation trials after which training stops; no limit if None."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"{name} must be {low:g} to {high:g}, got {value}")
        pick(dict.fromkeys(("adamw", "ranger21")), self.optimizer, noun="optimizer")
        wrong = self.head != "margin-and-ratio" or self.optimizer != "adamw" or self.augmentation != "none"
        if self.learns == "ratio" and (wrong or self.weight_decay):
            raise InputError("to learn F_t / F_n alone, leave out --head, --optimizer, --augmentation and weight_decay")
        pick(HEADS, self.head, noun="head")
        get_augmentation(self.augmentation)


class TrainingChanges(TypedDict, total=False):
    """Options of `train`: fields of `TrainingConfig`, None for those of the recipe, and `accelerator`."""

    backbone: str | None
    head: str | None
    image_size: int | None
    epochs: int | None
    batch_size: int | None
    optimizer: Literal["adamw", "ranger21"] | None
    learning_rate: float | None
    weight_decay: float | None
    mixed_precision: bool | None
    max_minutes: float | None
    augmentation: str | None
    untouched_share: float | None
    epoch_frames: int | None
    patience: int | None
    seed: int | None
    accelerator: Literal["auto", "cpu", "gpu"]


RECIPES = {
    "default": TrainingConfig(head="histogram"),
    "thesis": TrainingConfig(
        recipe="thesis",
        batch_size=124,
        optimizer="ranger21",
        learning_rate=8e-4,
        mixed_precision=True,
        augmentation="thesis",
        untouched_share=0.0,
    ),
    "ratio": TrainingConfig(
        recipe="ratio", head="margin-and-ratio", epochs=20, weight_decay=0.0, augmentation="none", learns="ratio"
    ),
    "adapt": TrainingConfig(
        recipe="adapt",
        head="histogram",
        epochs=20,
        batch_size=32,
        learning_rate=5e-4,
        learns="weights",
        epoch_frames=640,
        patience=6,
    ),
}
"""`thesis` is that of Polak, section 4: ShuffleNetV2 x1.0 from scratch, one output, Ranger21 with its defaults, mean
squared error, 25 epochs, batches of 124, 224 x 224 pixels, a learning rate of 8e-4, mixed precision, the best
checkpoint on validation, rotation, noise and blur. `default` is ours; docs/networks.md has the reasons. `ratio` teaches
an existing network its second output, F_t / F_n, and `adapt` another sensor from few trials, both in minutes."""


def make_logger(logger: Logger | str, folder: Path) -> Logger | None:
    """Return a logger by name, or that of Lightning: `tensorboard` keeps its files in the folder, `csv` is none."""
    if not isinstance(logger, str) or logger == "csv":
        return None if isinstance(logger, str) else logger
    if logger != "tensorboard":
        raise InputError(
            f"there is no logger named {logger!r}; choose csv or tensorboard, or in Python one of Lightning"
        )
    if missing := missing_packages("tensorboard", extra="tracking"):
        raise InputError(f"--logger tensorboard needs {missing}, or leave it away: metrics.csv is always written")
    return TensorBoardLogger(folder, name="tensorboard", version="", default_hp_metric=False)
