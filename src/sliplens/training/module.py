"""The Lightning module and the callbacks around it."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import Callback
from pytorch_optimizer import Ranger21
from torch import Tensor, nn
from torch.nn import functional

from sliplens.datasets import Augmentation
from sliplens.errors import ModelError
from sliplens.models.heads import margin_loss
from sliplens.training.config import TrainConfig


@dataclass(frozen=True, kw_only=True)
class TrainProgress:
    """Where a training stands; `fraction` is the share of the epochs or of the time, whichever is further."""

    fraction: float
    epoch: int
    train_mse: float
    validation_mse: float


class Regressor(lightning.LightningModule):
    """A network with its loss, its augmentation and its optimizer.

    With AdamW the learning rate follows the share of the training that is done, in epochs or in minutes, so that a
    training cut short by its time limit still ends on a small step.
    """

    def __init__(
        self,
        model: nn.Module,
        *,
        config: TrainConfig,
        augmentation: Augmentation | None,
        steps: int,
        fraction_done: Callable[[], float],
    ) -> None:
        super().__init__()
        self.model = model
        self.config = config
        self.augmentation = augmentation
        self.steps = steps
        self.fraction_done = fraction_done

    def forward(self, images: Float[Tensor, "batch 3 size size"]) -> Float[Tensor, " batch"]:
        """Predict the safety margin."""
        return self.model(images).reshape(len(images))

    def training_step(self, batch: tuple[Tensor, Tensor], batch_idx: int) -> Tensor:
        """One step; a loss that is not finite stops the training."""
        images, labels = batch
        if self.augmentation is not None:
            # seeded by the step, so that a resumed training draws what it would have drawn
            generator = torch.Generator(device=images.device).manual_seed(
                self.config.seed * 1_000_003 + self.global_step
            )
            images = self.augmentation(images, generator=generator)
        loss, margins = margin_loss(self.model, images, labels)
        if not torch.isfinite(loss):
            raise ModelError(
                f"the training loss is {loss.item()} at step {self.global_step}; lower the learning rate and try again"
            )
        self.log(
            "train_mse",
            functional.mse_loss(margins.detach(), labels),
            on_step=False,
            on_epoch=True,
            batch_size=len(images),
        )
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], batch_idx: int) -> None:
        """Log the validation error."""
        images, labels = batch
        loss = functional.mse_loss(self(images), labels)
        self.log("validation_mse", loss, on_epoch=True, batch_size=len(images))

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Set the learning rate for the share of the training that is done; Ranger21 sets its own."""
        if self.config.optimizer != "adamw":
            return
        warm_up, done = 0.1, self.fraction_done()
        descent = 0.5 * (1 + math.cos(math.pi * min(1.0, max(0.0, (done - warm_up) / (1 - warm_up)))))
        factor = max(done / warm_up, 0.02) if done < warm_up else max(descent, 0.005)
        for optimizer in self.trainer.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = self.config.learning_rate * factor

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """AdamW, without weight decay on biases and normalisation; or Ranger21 with its defaults."""
        if self.config.optimizer == "ranger21":
            return Ranger21(self.parameters(), num_iterations=self.steps, lr=self.config.learning_rate)
        decayed = [value for value in self.parameters() if value.ndim > 1]
        others = [value for value in self.parameters() if value.ndim <= 1]
        groups = [
            {"params": decayed, "weight_decay": self.config.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ]
        return torch.optim.AdamW(groups, lr=self.config.learning_rate)


class Clock(Callback):
    """Stops when the epochs or the minutes are used up, and writes a table row after each epoch.

    Its state is part of the checkpoint: a training that was interrupted goes on with the minutes that are left.
    """

    def __init__(
        self,
        *,
        steps: int,
        max_minutes: float | None,
        metrics_file: Path,
        on_progress: Callable[[TrainProgress], None] | None,
    ) -> None:
        self.steps = steps
        self.max_seconds = None if max_minutes is None else 60 * max_minutes
        self.metrics_file = metrics_file
        self.on_progress = on_progress
        self.seconds_before = 0.0
        self.step = 0
        self.rows: list[list[float]] = []
        self.stopped_by = "epochs"
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds spent, interruptions left out."""
        return self.seconds_before + time.perf_counter() - self._started

    def fraction(self) -> float:
        """Share of the training that is done."""
        by_steps = self.step / self.steps
        by_time = 0.0 if self.max_seconds is None else self.seconds / self.max_seconds
        return min(1.0, max(by_steps, by_time))

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps of the clock."""
        return {"seconds": self.seconds, "rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.seconds_before, self.rows = state_dict["seconds"], state_dict["rows"]

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Start the clock."""
        self._started = time.perf_counter()
        self.step = trainer.global_step

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Stop when the time is up."""
        self.step = trainer.global_step
        if self.max_seconds is not None and self.seconds >= self.max_seconds and self.step < self.steps:
            self.stopped_by = "time limit"
            trainer.should_stop = True
        self._report(trainer)

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the epoch's row; the validation has run by now."""
        metrics = trainer.callback_metrics
        epoch = self.step / self.steps * (trainer.max_epochs or 1)
        row = [epoch, metrics["train_mse"].item(), metrics["validation_mse"].item(), self.seconds / 60]
        self.rows.append(row)
        lines = ["epoch,train_mse,validation_mse,minutes"]
        lines += [f"{r[0]:.3f},{r[1]:.6g},{r[2]:.6g},{r[3]:.4f}" for r in self.rows]
        self.metrics_file.write_text("\n".join(lines) + "\n", encoding="utf-8")
        self._report(trainer)

    def _report(self, trainer: lightning.Trainer) -> None:
        if self.on_progress is not None:
            last = self.rows[-1] if self.rows else [0.0, math.nan, math.nan, 0.0]
            self.on_progress(
                TrainProgress(
                    fraction=self.fraction(), epoch=trainer.current_epoch, train_mse=last[1], validation_mse=last[2]
                )
            )
