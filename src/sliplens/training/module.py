"""Lightning module and trainer of a training, which resumes where it was interrupted."""

import logging
import math
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import EarlyStopping, Timer
from pytorch_optimizer import Ranger21
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader

from sliplens.errors import InputError, ModelError
from sliplens.files import whole_file
from sliplens.models.backbones import BINS, Answers, bin_centres, last_layer, margin_loss
from sliplens.progress import report_progress
from sliplens.training.config import TrainingConfig
from sliplens.training.data import Augmentation


class Regressor(lightning.LightningModule):
    """Network with its loss, its augmentation, its optimizer and its learning curve, which is written after each epoch.

    With AdamW the learning rate follows the share of the training that is done, in epochs or in minutes, so that a
    training cut short by its time limit still ends on a small step.
    """

    def __init__(
        self,
        model: nn.Module,
        *,
        config: TrainingConfig,
        augmentation: Augmentation | None,
        steps: int,
        metrics_file: Path,
    ) -> None:
        super().__init__()
        self.model, self.config, self.augmentation = model, config, augmentation
        self.steps, self.rows, self.metrics_file = steps, list[list[float]](), metrics_file
        limit = None if config.max_minutes is None else timedelta(minutes=config.max_minutes)
        self.timer = Timer(limit, verbose=False)
        """Clock, which also stops the training at its time limit; a resumed training has the time that is left."""
        if config.learns == "ratio":
            # without weight decay, a row without a slope stays as it is to the bit
            for value in last_layer(model).parameters():
                value.register_hook(lambda slope: torch.cat([torch.zeros_like(slope[:BINS]), slope[BINS:]]))

    def fraction(self) -> float:
        """Share of the training that is done, in steps or in minutes, whichever is larger."""
        limit, minutes = self.config.max_minutes, self.timer.time_elapsed("train") / 60
        return min(1.0, max(self.global_step / self.steps, minutes / limit if limit else 0.0))

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        """Keep the learning curve in a checkpoint."""
        checkpoint["rows"] = self.rows

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        """Restore the learning curve of a checkpoint."""
        self.rows = checkpoint["rows"]

    def on_train_start(self) -> None:
        """Take a request to end for an interruption from now on."""
        if threading.current_thread() is threading.main_thread():
            # what was there before comes back when the training is over
            signal.signal(signal.SIGTERM, signal.default_int_handler)

    def on_train_epoch_start(self) -> None:
        """Keep the statistics of batch normalisation where the configuration says so."""
        if self.config.learns == "weights":
            for module in self.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):
                    module.eval()

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Set the learning rate for the share of the training that is done; Ranger21 sets its own."""
        if self.config.optimizer != "adamw":
            return
        warm_up, done = 0.1, self.fraction()
        descent = 0.5 * (1 + math.cos(math.pi * min(1.0, max(0.0, (done - warm_up) / (1 - warm_up)))))
        factor = max(done / warm_up, 0.02) if done < warm_up else max(descent, 0.005)
        for optimizer in self.trainer.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = self.config.learning_rate * factor

    def training_step(self, batch: tuple[Tensor, Tensor, Tensor], batch_idx: int) -> Tensor:
        """One step; a loss that is not finite stops the training."""
        images, labels, ratios = batch
        if self.augmentation is not None:
            # seeded by the step, so that a resumed training draws what it would have drawn
            seed = self.config.seed * 1_000_003 + self.global_step
            generator = torch.Generator(device=images.device).manual_seed(seed)
            images = self.augmentation(images, generator=generator)
        loss, margins = margin_loss(self.model, images, labels, ratios)
        if not torch.isfinite(loss):
            raise ModelError(
                f"the training loss is {loss.item()} in epoch {self.current_epoch + 1}, at step {self.global_step}; "
                "lower the learning rate and try again"
            )
        error = functional.mse_loss(margins.detach(), labels)
        self.log("train_mse", error, on_step=False, on_epoch=True, batch_size=len(labels))
        if self.trainer.loggers:
            rate = self.trainer.optimizers[0].param_groups[0]["lr"]
            self.log("learning_rate", rate, on_step=True, on_epoch=False)
        return loss

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Report the step."""
        report_progress(round(self.fraction() * self.steps), self.steps)

    def validation_step(self, batch: tuple[Tensor, Tensor, Tensor], batch_idx: int) -> None:
        """Log the validation error; of a network with two outputs, over both."""
        images, labels, ratios = batch
        margins, *histograms = Answers(self.model)(images)
        if len(histograms) > 1 and (finite := torch.isfinite(ratios)).any():
            centres = bin_centres(self.model.get_buffer("ratio_edges"))
            margins = torch.cat([margins, (histograms[1] @ centres)[finite]])
            labels = torch.cat([labels, ratios[finite]])
        self.log("validation_mse", functional.mse_loss(margins, labels), on_epoch=True, batch_size=len(labels))

    def on_train_epoch_end(self) -> None:
        """Add the epoch's row to the learning curve and write all of it as CSV; the validation has run by now."""
        metrics, epoch = self.trainer.callback_metrics, self.global_step / self.steps * self.config.epochs
        errors = [metrics[name].item() for name in ("train_mse", "validation_mse")]
        if not math.isfinite(errors[1]):
            raise ModelError(
                f"the validation error is {errors[1]} after epoch {len(self.rows) + 1}; lower the learning rate and "
                "try again"
            )
        self.rows.append([epoch, *errors, self.timer.time_elapsed("train") / 60])
        with whole_file(self.metrics_file) as part:
            header, formats = "epoch,train_mse,validation_mse,minutes", ("%.3f", "%.6g", "%.6g", "%.4f")
            np.savetxt(part, self.rows, fmt=formats, delimiter=",", header=header, comments="")

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """AdamW, without weight decay on biases and normalisation; or Ranger21 with its defaults."""
        if self.config.optimizer == "ranger21":
            return Ranger21(self.parameters(), num_iterations=self.steps, lr=self.config.learning_rate)
        decayed = [value for value in self.parameters() if value.ndim > 1]
        others = [value for value in self.parameters() if value.ndim <= 1]
        groups = [{"params": decayed}, {"params": others, "weight_decay": 0.0}]
        return torch.optim.AdamW(groups, lr=self.config.learning_rate, weight_decay=self.config.weight_decay)


class Patience(EarlyStopping):
    """Early stopping whose end survives a resumption: Lightning restores the count, not that training had ended."""

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Stop at once if the checkpoint had waited long enough."""
        if self.wait_count >= self.patience:
            trainer.should_stop = True


def make_trainer(config: TrainingConfig, *, accelerator: Literal["auto", "cpu", "gpu"] = "auto") -> lightning.Trainer:
    """Make the trainer of one device."""
    half = config.mixed_precision and accelerator != "cpu" and torch.cuda.is_available()
    try:
        with quiet_lightning():
            return lightning.Trainer(
                accelerator=accelerator,
                devices=1,
                plugins=[WholeCheckpoints()],
                max_epochs=config.epochs,
                logger=False,
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
                num_sanity_val_steps=0,
                # Ranger21 clips by itself, adaptively
                gradient_clip_val=1.0 if config.optimizer == "adamw" else None,
                precision="16-mixed" if half else "32-true",
            )
    except (MisconfigurationException, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(f"this machine cannot train on {accelerator} ({reason}); change --accelerator") from None


class WholeCheckpoints(TorchCheckpointIO):
    """Write each checkpoint beside the one it replaces, so that a crash or a full disk leaves the old one.

    Lightning's own way goes through the system's temporary folder, and is whole only where that is on the same disk.
    """

    def save_checkpoint(self, checkpoint: dict, path: str | Path, storage_options: object = None) -> None:
        """Write a checkpoint."""
        try:
            torch.save(checkpoint, content := BytesIO())  # into a file it raises no OSError where the disk is full
            with whole_file(Path(path)) as part:
                part.write_bytes(content.getbuffer())
        except OSError as error:
            raise InputError(
                f"cannot save the checkpoint {path} ({error.strerror}); make room and give the same command again, "
                "it goes on after the last whole epoch"
            ) from None


def run_trainer(
    trainer: lightning.Trainer, module: Regressor, loaders: tuple[DataLoader, DataLoader], last: Path
) -> None:
    """Train, resuming from a checkpoint if there is one."""
    on_interrupt = signal.getsignal(signal.SIGINT)
    with quiet_lightning():
        try:
            trainer.fit(module, *loaders, ckpt_path=str(last) if last.is_file() else None, weights_only=True)
        except SystemExit:
            # Lightning exits and goes deaf to Ctrl-C; what happens next is the caller's to decide
            signal.signal(signal.SIGINT, on_interrupt)
            raise KeyboardInterrupt from None
        except torch.OutOfMemoryError:
            raise ModelError("the memory of the GPU is full; lower --batch-size or --image-size") from None


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
    ".*GPU available but not used.*",  # who asks for --accelerator cpu has a reason
)
