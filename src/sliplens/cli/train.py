"""`sliplens train`."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from sliplens.cli.console import OUT, progress_bar, unchanged, wrote
from sliplens.errors import InputError
from sliplens.provenance import output_folder, write_json


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a network to read the safety margin from raw frames or from difference images.

    Interrupted, it goes on after the last whole epoch when the same command is given again.
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Data set, as `sliplens simulate` makes it."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """Folder to make: weights, manifest, learning curve."""
    input: Literal["difference", "raw"] = "difference"
    """What the network sees: |T_n - T_0|, or the frame itself."""
    backbone: str = "shufflenet_v2_x1_0"
    """A TorchVision classifier; its last layer becomes one output."""
    image_size: int = 224
    """Height and width of the network's input, in pixels."""
    epochs: int = 25
    """Most passes over the training frames."""
    max_minutes: float | None = None
    """Stop after this time; the learning rate falls with it."""
    batch_size: int = 64
    """Images a step."""
    learning_rate: float = 2e-3
    """Peak learning rate."""
    untouched_share: float = 0.05
    """Share of images that show the untouched sensor as full stick: what explanations are measured against."""
    augment: bool = True
    """Slight rotations, noise and blur."""
    seed: int = 0
    """Seed of weights, order and augmentation."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Train and write the run."""
        from sliplens.datasets import get_encoding, load_frames
        from sliplens.recordings import Dataset
        from sliplens.training import TrainConfig, TrainProgress, fit

        config = TrainConfig(
            backbone=self.backbone,
            image_size=self.image_size,
            epochs=self.epochs,
            batch_size=self.batch_size,
            learning_rate=self.learning_rate,
            max_minutes=self.max_minutes,
            augment=self.augment,
            seed=self.seed,
        )
        data = Dataset.open(self.data)
        train_trials, validation_trials = data.select(split="train"), data.select(split="validation")
        if not 0 <= self.untouched_share <= 1:
            raise InputError(f"--untouched-share must lie in [0, 1], got {self.untouched_share:g}")
        recipe = {
            "input": self.input,
            "training": config,
            "untouched_share": self.untouched_share,
            "data_hash": data.hash,
        }
        with output_folder(self.output, stage="train", config=recipe, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            encoding = get_encoding(self.input)
            with progress_bar(f"Reading trials ({self.input})") as bar:
                total = len(train_trials) + len(validation_trials)
                frames = load_frames(
                    data,
                    train_trials,
                    encoding=encoding,
                    image_size=self.image_size,
                    untouched_share=self.untouched_share,
                    on_trial=lambda done, _: bar(done, total),
                )
                validation = load_frames(
                    data,
                    validation_trials,
                    encoding=encoding,
                    image_size=self.image_size,
                    on_trial=lambda done, _: bar(len(train_trials) + done, total),
                )
            columns = (
                TextColumn("{task.description}"),
                BarColumn(bar_width=30),
                TaskProgressColumn(),
                TimeElapsedColumn(),
            )
            with Progress(*columns, TextColumn("{task.fields[status]}"), console=OUT) as progress:
                task = progress.add_task(f"Training ({self.input})", total=1.0, status="")

                def show(now: TrainProgress) -> None:
                    status = f"epoch {now.epoch + 1}, validation MSE {now.validation_mse:.4f}"
                    progress.update(task, completed=now.fraction, status=status)

                info = train_trials[0]
                result = fit(
                    config,
                    frames,
                    validation,
                    out.folder,
                    frame_size=(info.height, info.width),
                    sensor=info.sensor,
                    data_hash=data.hash,
                    on_progress=show,
                )
            write_json(
                out.folder / "result.json",
                {
                    "input": self.input,
                    "backbone": self.backbone,
                    "image_size": self.image_size,
                    "frame_size": [info.height, info.width],
                    "train_frames": len(frames),
                    "validation_frames": len(validation),
                    "seed": self.seed,
                    **asdict(result),
                },
            )
        wrote(
            self.output,
            f"{result.epochs:.1f} epochs in {result.minutes:.1f} min, validation MSE {result.best_validation_mse:.4f}",
        )
