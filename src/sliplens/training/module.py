"""The Lightning module and the callbacks around it."""

import math
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import Callback
from pytorch_optimizer import Ranger21
from torch import Tensor, distributed, nn
from torchmetrics import MeanSquaredError

from sliplens.errors import ModelError
from sliplens.models.backbones import BINS, Answers, last_layer, margin_loss, ratio_edges
from sliplens.progress import OnProgress
from sliplens.results.training import LearningCurve
from sliplens.training.config import TrainConfig
from sliplens.training.data import Augmentation

_NAMED_ROWS = 3
"""Frames of a batch that a message names."""


class DivergedError(ModelError):
    """A loss or an error is no longer finite; every process of a training raises it together."""


class Regressor(lightning.LightningModule):
    """A network with its loss, its augmentation and its optimizer.

    With AdamW the learning rate follows the share of the training that is done, in epochs or in minutes, so that a
    training cut short by its time limit still ends on a small step.
    """

    ratio_centres: Tensor | None

    def __init__(
        self,
        model: nn.Module,
        *,
        config: TrainConfig,
        augmentation: Augmentation | None,
        clock: "Clock",
        batch_rows: Callable[[int, int], Sequence[str]],
    ) -> None:
        super().__init__()
        self.model = model
        self.config = config
        self.augmentation = augmentation
        self.clock = clock
        self.batch_rows = batch_rows
        # sums and counts, added up over the processes: exact however the frames are shared
        self.train_mse = MeanSquaredError()
        self.validation_mse = MeanSquaredError()
        edges = ratio_edges(model)
        centres = None if edges is None else torch.from_numpy((edges[1:] + edges[:-1]) / 2).float()
        self.register_buffer("ratio_centres", centres, persistent=False)

        if config.learns == "ratio":
            # without weight decay, a row without a slope stays as it is to the bit
            for value in last_layer(model).parameters():
                value.register_hook(lambda slope: torch.cat([torch.zeros_like(slope[:BINS]), slope[BINS:]]))

    def forward(self, images: Float[Tensor, "batch *input"]) -> Float[Tensor, " batch"]:
        """Predict the safety margin."""
        return self.model(images).reshape(len(images))

    def on_train_epoch_start(self) -> None:
        """Take batch normalisation that is to stay as it is out of training."""
        if self.config.learns == "weights":
            for module in self.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):
                    module.eval()

    def training_step(self, batch: tuple[Tensor, Tensor, Tensor], batch_idx: int) -> Tensor:
        """One step; a loss that is not finite stops the training."""
        images, labels, ratios = batch
        if self.augmentation is not None:
            # seeded by the step, so that a resumed training draws what it would have drawn; and by the process
            seed = self.config.seed * 1_000_003 + self.global_step + (self.global_rank << 40)
            generator = torch.Generator(device=images.device).manual_seed(seed)
            images = self.augmentation(images, generator=generator)
        loss, margins = margin_loss(self.model, images, labels, ratios)
        finite = bool(torch.isfinite(loss))
        # all stop or none: a process that goes on alone waits for ever
        if not self.trainer.strategy.reduce_boolean_decision(finite):
            self._refuse(loss.item(), batch_idx, finite=finite)
        self.train_mse.update(margins.detach(), labels)
        self.log("train_mse", self.train_mse, on_step=False, on_epoch=True)
        if self.trainer.loggers:
            rate = self.trainer.optimizers[0].param_groups[0]["lr"]
            self.log("learning_rate", rate, on_step=True, on_epoch=False)
        return loss

    def _refuse(self, loss: float, batch_idx: int, *, finite: bool) -> None:
        """Stop, and say which frames of which process brought a loss that is not finite."""
        mine: tuple[float, Sequence[str]] = (loss, () if finite else self.batch_rows(self.current_epoch, batch_idx))
        losses = [mine] * self.trainer.world_size
        if self.trainer.world_size > 1:
            distributed.all_gather_object(losses, mine)
        value, rows = next(shared for shared in losses if shared[1])
        more = f" and {len(rows) - _NAMED_ROWS} more" if len(rows) > _NAMED_ROWS else ""
        raise DivergedError(
            f"the training loss is {value} in epoch {self.current_epoch + 1}, at step {self.global_step}, for a batch "
            f"of {', '.join(rows[:_NAMED_ROWS])}{more}; lower the learning rate, or look at these frames, and try again"
        )

    def validation_step(self, batch: tuple[Tensor, Tensor, Tensor], batch_idx: int) -> None:
        """Log the validation error, of a network with two answers that over both."""
        images, labels, ratios = batch
        margins, *histograms = Answers(self.model)(images)
        if self.ratio_centres is not None and (known := torch.isfinite(ratios)).any():
            margins = torch.cat([margins, (histograms[1] @ self.ratio_centres)[known]])
            labels = torch.cat([labels, ratios[known]])
        self.validation_mse.update(margins, labels)
        self.log("validation_mse", self.validation_mse, on_epoch=True)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Set the learning rate for the share of the training that is done; Ranger21 sets its own."""
        if self.config.optimizer != "adamw":
            return
        warm_up, done = 0.1, self.clock.fraction()
        descent = 0.5 * (1 + math.cos(math.pi * min(1.0, max(0.0, (done - warm_up) / (1 - warm_up)))))
        factor = max(done / warm_up, 0.02) if done < warm_up else max(descent, 0.005)
        for optimizer in self.trainer.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = self.config.learning_rate * factor

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """AdamW, without weight decay on biases and normalisation; or Ranger21 with its defaults."""
        if self.config.optimizer == "ranger21":
            return Ranger21(self.parameters(), num_iterations=self.clock.steps, lr=self.config.learning_rate)
        decayed = [value for value in self.parameters() if value.ndim > 1]
        others = [value for value in self.parameters() if value.ndim <= 1]
        groups = [{"params": decayed}, {"params": others, "weight_decay": 0.0}]
        return torch.optim.AdamW(groups, lr=self.config.learning_rate, weight_decay=self.config.weight_decay)


@dataclass(kw_only=True, eq=False)
class Clock(Callback):
    """Stops when the epochs or the minutes are used up, and writes a table row after each epoch.

    Its state is part of the checkpoint: a training that was interrupted goes on with the minutes that are left. With a
    time limit all processes go by the clock of the first: the learning rate follows it too.
    """

    steps: int
    max_minutes: float | None
    metrics_file: Path | None
    on_progress: OnProgress | None
    seconds_before: float = 0.0
    step: int = 0
    rows: list[list[float]] = field(default_factory=list)
    stopped_by: str = "epochs"
    _started: float = field(default_factory=time.perf_counter)
    _time_share: float = 0.0

    @property
    def seconds(self) -> float:
        """Seconds spent, interruptions left out."""
        return self.seconds_before + time.perf_counter() - self._started

    def fraction(self) -> float:
        """Share of the training that is done."""
        return min(1.0, max(self.step / self.steps, self._time_share))

    def curve(self) -> LearningCurve:
        """Learning curve so far."""
        epoch, train, validation, minutes = np.array(self.rows, dtype=np.float64).reshape(-1, 4).T
        return LearningCurve(epoch=epoch, train_mse=train, validation_mse=validation, minutes=minutes)

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps of the clock."""
        return {"seconds": self.seconds, "rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.seconds_before, self.rows = state_dict["seconds"], state_dict["rows"]

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Start the clock; from now on a request to end is an interruption."""
        self._started = time.perf_counter()
        self.step = trainer.global_step
        if threading.current_thread() is threading.main_thread():
            # Lightning 2.6 would ask the other processes from within its handler, and all would wait for ever; what was
            # there before comes back when the training is over
            signal.signal(signal.SIGTERM, signal.default_int_handler)

    def on_train_batch_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Look at the clock, which the module's learning rate follows."""
        if self.max_minutes is not None:
            self._time_share = trainer.strategy.broadcast(self.seconds) / (60 * self.max_minutes)

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop when the time is up."""
        self.step = trainer.global_step
        if self.max_minutes is not None and self.step < self.steps:
            late = self.seconds >= 60 * self.max_minutes
            # one that stopped alone would leave the others waiting
            if trainer.strategy.reduce_boolean_decision(late, all=False):
                self.stopped_by, self._time_share = "time limit", 1.0
                trainer.should_stop = True
        if self.on_progress is not None:
            self.on_progress(round(self.fraction() * self.steps), self.steps)

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the epoch's row; the validation has run by now."""
        metrics = trainer.callback_metrics
        epoch = self.step / self.steps * (trainer.max_epochs or 1)
        train, validation = metrics["train_mse"].item(), metrics["validation_mse"].item()
        if not math.isfinite(validation):
            raise DivergedError(
                f"the validation error is {validation} after epoch {trainer.current_epoch + 1}; "
                "lower the learning rate and try again"
            )
        self.rows.append([epoch, train, validation, self.seconds / 60])
        if self.metrics_file is not None:
            lines = ["epoch,train_mse,validation_mse,minutes"]
            lines += [f"{r[0]:.3f},{r[1]:.6g},{r[2]:.6g},{r[3]:.4f}" for r in self.rows]
            part = self.metrics_file.with_name(self.metrics_file.name + ".part")
            part.write_text("\n".join(lines) + "\n", encoding="utf-8")
            part.replace(self.metrics_file)
