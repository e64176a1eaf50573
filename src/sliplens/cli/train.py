"""`sliplens train`."""

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from sliplens.cli.console import OUT, progress_bar, unchanged, wrote
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
    recipe: Literal["default", "thesis"] = "default"
    """default: a distribution over the margin, AdamW. thesis: as the thesis trained, one output and Ranger21. The
    options below change it."""
    input: Literal["difference", "raw", "signed", "amplitude"] = "difference"
    """What the network sees: |T_n - T_0| divided by its own maximum, the frame itself, T_n - T_0, or |T_n - T_0| with
    its amplitude."""
    backbone: str | None = None
    """A TorchVision classifier, such as resnet18."""
    head: Literal["point", "histogram"] | None = None
    """What the network answers with: one number, or a distribution, which tells how sure it is."""
    image_size: int | None = None
    """Height and width of the network's input, in pixels."""
    epochs: int | None = None
    """Most passes over the training frames."""
    max_minutes: float | None = None
    """Stop after this time; the learning rate falls with it."""
    batch_size: int | None = None
    """Images a step."""
    optimizer: Literal["adamw", "ranger21"] | None = None
    """With its own schedule of the learning rate."""
    learning_rate: float | None = None
    """Peak learning rate."""
    untouched_share: float | None = None
    """Share of images that show the untouched sensor as full stick: what explanations are measured against."""
    augmentation: Literal["default", "thesis", "none"] | None = None
    """Slight rotations, noise and blur; by default shifts and colour too."""
    seed: int = 0
    """Seed of weights, order and augmentation."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Train and write the run."""
        from sliplens.datasets import get_encoding, load_frames
        from sliplens.recordings import Dataset
        from sliplens.training import TrainConfig, TrainProgress, fit, get_recipe

        names = {item.name for item in fields(TrainConfig)} - {"recipe"}
        said = {name: value for name in names if (value := getattr(self, name, None)) is not None}
        config = replace(get_recipe(self.recipe), **said)
        data = Dataset.open(self.data)
        train_trials, validation_trials = data.select(split="train"), data.select(split="validation")
        recipe = {
            "input": self.input,
            "training": config,
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
                    image_size=config.image_size,
                    untouched_share=config.untouched_share,
                    scratch=out.folder,
                    on_trial=lambda done, _: bar(done, total),
                )
                validation = load_frames(
                    data,
                    validation_trials,
                    encoding=encoding,
                    image_size=config.image_size,
                    scratch=out.folder,
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
                    trained_on=[one.sha256[:12] for one in (*train_trials, *validation_trials)],
                    on_progress=show,
                )
            write_json(
                out.folder / "result.json",
                {
                    "input": self.input,
                    "backbone": config.backbone,
                    "image_size": config.image_size,
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
