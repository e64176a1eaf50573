"""Recipes: all that shapes a network besides its data."""

from dataclasses import dataclass
from math import isfinite
from typing import Literal

from sliplens.errors import InputError
from sliplens.extras import Table
from sliplens.models.backbones import DEFAULT_BACKBONE, head_outputs
from sliplens.models.checkpoint import LARGEST_INPUT
from sliplens.training.data import get_augmentation


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training recipe; `InputError` for a number that cannot train a network, `ModelError` for an unknown head."""

    recipe: str = "default"
    """Its name, kept in the manifest."""
    backbone: str = DEFAULT_BACKBONE
    head: str = "point"
    """What the network answers with; see `sliplens.models.backbones`."""
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
    """What changes. all: weights, and the statistics of batch normalisation. weights: these statistics stay, for few
    trials tell them badly. ratio: the rows of the last layer that answer with F_t / F_n, so that margins stay to the
    bit; what that layer sees is computed once, without augmentation."""
    epoch_frames: int | None = None
    """Images of an epoch, drawn from all: few trials come again, of long ones some; each frame once if None."""
    patience: int | None = None
    """Epochs without gain on the validation trials after which it stops; none if None."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("image_size", "epochs", "batch_size", "learning_rate", "epoch_frames", "patience"):
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value > 0):
                raise InputError(f"{name} must be positive, got {value}")
        if not 32 <= self.image_size <= LARGEST_INPUT:
            raise InputError(f"image_size must be 32 to {LARGEST_INPUT} pixels, got {self.image_size}")
        if self.batch_size < 2:
            raise InputError("batch_size must be at least 2, since batch normalisation needs more than one image")
        if self.max_minutes is not None and not self.max_minutes > 0:
            raise InputError(f"max_minutes must be positive, got {self.max_minutes}")
        if not 0 <= self.untouched_share <= 1:
            raise InputError(f"untouched_share must lie in [0, 1], got {self.untouched_share:g}")
        if self.optimizer not in {"adamw", "ranger21"}:
            raise InputError(f"there is no optimizer named {self.optimizer!r}; choose adamw or ranger21")
        wrong = self.head != "margin-and-ratio" or self.optimizer != "adamw" or self.augmentation != "none"
        if self.learns == "ratio" and (wrong or self.weight_decay):
            raise InputError(
                "a network whose margins stay learns F_t / F_n alone, by AdamW without weight decay and augmentation; "
                "leave out --head, --optimizer and --augmentation"
            )
        head_outputs(self.head)
        get_augmentation(self.augmentation)


_RECIPES = {
    "default": TrainConfig(head="histogram"),
    "thesis": TrainConfig(
        recipe="thesis",
        batch_size=124,
        optimizer="ranger21",
        learning_rate=8e-4,
        mixed_precision=True,
        augmentation="thesis",
        untouched_share=0.0,
    ),
    "ratio": TrainConfig(
        recipe="ratio", head="margin-and-ratio", epochs=20, weight_decay=0.0, augmentation="none", learns="ratio"
    ),
    "adapt": TrainConfig(
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
RECIPES = Table("recipe", "sliplens.recipes", _RECIPES)
"""`thesis` is that of Polak, section 4: ShuffleNetV2 x1.0 from scratch, one output, Ranger21 with its defaults, mean
squared error, 25 epochs, batches of 124, 224 x 224 pixels, a learning rate of 8e-4, mixed precision, the best
checkpoint on validation, rotation, noise and blur. `default` is ours; docs/networks.md tells why. `ratio` teaches a
network that is there its second answer, F_t / F_n, and `adapt` a sensor of your own from few trials, both in
minutes."""


def get_recipe(name: str) -> TrainConfig:
    """Look up a recipe by name; `InputError` lists those there are."""
    return RECIPES.pick(name)
