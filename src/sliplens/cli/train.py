"""`sliplens train`."""

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from sliplens.cli.console import OUT, progress_bar, unchanged, wrote
from sliplens.cli.training import TrainingJob, choose_trials
from sliplens.files import output_folder, write_json

if TYPE_CHECKING:
    from lightning.pytorch.loggers import Logger

    from sliplens.training import TrainProgress
    from sliplens.training.data import FrameSet
    from sliplens.training.fit import TrainResult


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
    start_from: Path | None = None
    """Network whose weights to start from, a run or one that comes with sliplens: to teach it your own sensor, or to go
    on at another image size. Its input, backbone and head must be those asked for."""
    condition: str | None = None
    """Train and validate on the trials of one condition alone, such as dry."""
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
    """Images a step, over all devices: each takes its share."""
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
    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    """auto: a GPU if there is one."""
    devices: int = 1
    """Devices of each machine, one process each: started here, or by torchrun or SLURM."""
    num_nodes: int = 1
    """Machines that share the training; all must see the output folder."""
    logger: Literal["csv", "tensorboard", "wandb", "mlflow"] = "csv"
    """Where the numbers go besides metrics.csv. All keep them in the output folder and send nothing, unless
    WANDB_MODE=online or MLFLOW_TRACKING_URI asks for it."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Train and write the run; of several processes the first writes and speaks, the others help."""
        from sliplens.models import load_checkpoint
        from sliplens.models.checkpoint import find_run
        from sliplens.recordings import Dataset
        from sliplens.training import TrainConfig, get_recipe
        from sliplens.training.fit import require_same_kind
        from sliplens.training.hardware import Hardware, follow_folder

        hardware = Hardware(accelerator=self.accelerator, devices=self.devices, num_nodes=self.num_nodes)
        names = {item.name for item in fields(TrainConfig)} - {"recipe"}
        said = {name: value for name in names if (value := getattr(self, name, None)) is not None}
        config = replace(get_recipe(self.recipe), **said)
        hardware.share(config.batch_size)
        start = None if self.start_from is None else load_checkpoint(find_run(self.start_from))
        if start is not None:
            require_same_kind(start, config, self.input)
        data = Dataset.open(self.data)
        train_trials, validation_trials = choose_trials(data, self.condition)
        job = TrainingJob(
            input=self.input,
            config=config,
            hardware=hardware,
            start=start,
            data=data,
            train_trials=train_trials,
            validation_trials=validation_trials,
        )
        if hardware.rank() == 0:
            self._lead(job)
        elif (folder := follow_folder(self.output, overwrite=self.overwrite)) is not None:
            job.follow(folder)

    def _lead(self, job: "TrainingJob") -> None:
        from sliplens.plots.errors import draw_learning_curve
        from sliplens.training.hardware import open_logger

        told = {"input": self.input, "condition": self.condition, "data_hash": job.data.hash}
        if job.start is not None:
            told["started_from"] = job.start.manifest.weights_sha256
        recipe = {**told, "training": job.config}
        with output_folder(self.output, stage="train", config=recipe, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            with progress_bar(f"Reading trials ({self.input})") as bar:
                frames, validation = job.load(scratch=out.folder, on_trial=bar)
            told = {**asdict(job.config), **told}
            with open_logger(self.logger, out.folder, run_name=self.output.name, recipe=told) as logger:
                result = self._show_training(job, frames, validation, out.folder, logger)
            info = job.train_trials[0]
            write_json(
                out.folder / "result.json",
                {
                    "input": self.input,
                    "condition": self.condition,
                    "backbone": job.config.backbone,
                    "image_size": job.config.image_size,
                    "frame_size": [info.height, info.width],
                    "train_frames": len(frames),
                    "validation_frames": len(validation),
                    "seed": self.seed,
                    **asdict(result),
                },
            )
            draw_learning_curve(
                out.folder / "metrics.csv",
                out.folder / "curves.png",
                input_name=self.input,
                title=f"{self.output.name}, {self.input} images of {self.data.name}",
            )
        wrote(
            self.output,
            f"{result.epochs:.1f} epochs in {result.minutes:.1f} min, validation MSE {result.best_validation_mse:.4f}",
        )

    def _show_training(
        self, job: "TrainingJob", frames: "FrameSet", validation: "FrameSet", folder: Path, logger: "Logger | None"
    ) -> "TrainResult":
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=30), TaskProgressColumn(), TimeElapsedColumn())
        with Progress(*columns, TextColumn("{task.fields[status]}"), console=OUT) as progress:
            task = progress.add_task(f"Training ({self.input})", total=1.0, status="")

            def show(now: "TrainProgress") -> None:
                status = f"epoch {now.epoch + 1}, validation MSE {now.validation_mse:.4f}"
                progress.update(task, completed=now.fraction, status=status)

            result = job.fit(frames, validation, folder, logger=logger, on_progress=show)
        assert result is not None  # this is the first process
        return result
