"""`sliplens train`."""

import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from sliplens.cli.console import OUT, progress_bar, unchanged, wrote
from sliplens.errors import RecordingError
from sliplens.provenance import output_folder, write_json

if TYPE_CHECKING:
    from lightning.pytorch.loggers import Logger

    from sliplens.datasets import FrameSet
    from sliplens.recordings import Dataset, TrialInfo
    from sliplens.training import TrainConfig, TrainProgress
    from sliplens.training.fit import TrainResult
    from sliplens.training.hardware import Hardware


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
        from sliplens.recordings import Dataset
        from sliplens.training import TrainConfig, get_recipe
        from sliplens.training.hardware import Hardware, follow_folder

        hardware = Hardware(accelerator=self.accelerator, devices=self.devices, num_nodes=self.num_nodes)
        names = {item.name for item in fields(TrainConfig)} - {"recipe"}
        said = {name: value for name in names if (value := getattr(self, name, None)) is not None}
        config = replace(get_recipe(self.recipe), **said)
        hardware.share(config.batch_size)
        data = Dataset.open(self.data)
        train_trials, validation_trials = _choose_trials(data, self.condition)
        job = _Job(
            command=self,
            config=config,
            hardware=hardware,
            data=data,
            train_trials=train_trials,
            validation_trials=validation_trials,
        )
        if hardware.rank() == 0:
            self._lead(job)
        elif (folder := follow_folder(self.output, overwrite=self.overwrite)) is not None:
            job.follow(folder)

    def _lead(self, job: "_Job") -> None:
        from sliplens.cli.curves import draw_learning_curve
        from sliplens.training.loggers import open_logger

        told = {"input": self.input, "condition": self.condition, "data_hash": job.data.hash}
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
        self, job: "_Job", frames: "FrameSet", validation: "FrameSet", folder: Path, logger: "Logger | None"
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


@dataclass(frozen=True, kw_only=True)
class _Job:
    """What every process of a training does alike."""

    command: Train
    config: "TrainConfig"
    hardware: "Hardware"
    data: "Dataset"
    train_trials: tuple["TrialInfo", ...]
    validation_trials: tuple["TrialInfo", ...]

    def load(
        self, *, scratch: Path, on_trial: Callable[[int, int], None] | None = None
    ) -> tuple["FrameSet", "FrameSet"]:
        """Frames to train and to validate on."""
        from sliplens.datasets import get_encoding, load_frames

        plan = ((self.train_trials, self.config.untouched_share), (self.validation_trials, 0.0))
        total, loaded = sum(len(trials) for trials, _ in plan), []
        for trials, share in plan:
            before = sum(len(trials) for trials, _ in plan[: len(loaded)])
            loaded.append(
                load_frames(
                    self.data,
                    trials,
                    encoding=get_encoding(self.command.input),
                    image_size=self.config.image_size,
                    untouched_share=share,
                    scratch=scratch,
                    on_trial=None if on_trial is None else partial(_count_on, on_trial, before, total),
                )
            )
        return loaded[0], loaded[1]

    def fit(
        self,
        frames: "FrameSet",
        validation: "FrameSet",
        folder: Path,
        *,
        logger: "Logger | None" = None,
        on_progress: "Callable[[TrainProgress], None] | None" = None,
    ) -> "TrainResult | None":
        from sliplens.training import fit

        info = self.train_trials[0]
        return fit(
            self.config,
            frames,
            validation,
            folder,
            frame_size=(info.height, info.width),
            sensor=info.sensor,
            data_hash=self.data.hash,
            trained_on=[one.sha256[:12] for one in (*self.train_trials, *self.validation_trials)],
            hardware=self.hardware,
            logger=logger,
            on_progress=on_progress,
        )

    def follow(self, folder: Path) -> None:
        """Help the first process, in silence."""
        # the output folder is the first one's to write, and on a cluster this disk is nearer
        frames, validation = self.load(scratch=Path(tempfile.gettempdir()))
        with suppress(KeyboardInterrupt):  # the first says what there is to say
            self.fit(frames, validation, folder)


def _count_on(on_trial: Callable[[int, int], None], before: int, total: int, done: int, _: int) -> None:
    on_trial(before + done, total)


def _choose_trials(data: "Dataset", condition: str | None) -> tuple[tuple["TrialInfo", ...], tuple["TrialInfo", ...]]:
    try:
        train, validation = (data.select(split=split, condition=condition) for split in ("train", "validation"))
    except RecordingError as error:
        cure = "divide it" if condition is None else "name another --condition, or divide it"
        raise RecordingError(f"{error}; {cure} with `sliplens split`") from None
    sizes = sorted({(info.height, info.width) for info in (*train, *validation)})
    if len(sizes) > 1:
        shown = " and ".join(f"{height} x {width}" for height, width in sizes)
        raise RecordingError(f"{data.folder} mixes frames of {shown} pixels; train on one sensor at a time")
    return train, validation
