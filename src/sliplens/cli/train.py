"""`sliplens train`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sliplens.cli.command import Command, Data, Output
from sliplens.cli.console import Terminal


@dataclass(frozen=True, kw_only=True)
class Train(Command):
    """Train a network to read the safety margin from camera frames, with or without the untouched sensor.

    Interrupted, it goes on after the last whole epoch when the same command is given again.
    """

    data: Data
    output: Output
    """Folder to make: weights, manifest, learning curve."""
    recipe: str = "default"
    """default: a distribution over the margin, AdamW. thesis: as the thesis trained, one output and Ranger21.
    adapt: teaches the network of --start-from a sensor of your own, from some ten trials, in minutes. ratio: teaches it
    F_t / F_n, for where friction is told; its margins stay. sequence: teaches it to read several frames, beside one.
    The options below change it."""
    input: str | None = None
    """Input of the network, made of a frame T_n and the untouched sensor T_0. difference, unless --start-from has
    another: |T_n - T_0|, each image divided by its own maximum. raw: T_n. signed: T_n - T_0. amplitude:
    |T_n - T_0| as strong as it is. pair: T_n and T_0 side by side."""
    start_from: Path | None = None
    """Network whose weights to start from, a run or one that comes with sliplens: to teach it your own sensor, or to go
    on at another image size. It keeps its input, backbone and head."""
    condition: str | None = None
    """Train and validate on the trials of one condition alone, such as dry."""
    backbone: str | None = None
    """A TorchVision classifier, such as resnet18."""
    head: Literal["point", "histogram", "margin-and-ratio"] | None = None
    """Output of the network: one number; a distribution, which shows its uncertainty; or two, the second over
    F_t / F_n, for use with --friction."""
    image_size: int | None = None
    """Height and width of the network's input, in pixels."""
    epochs: int | None = None
    """Passes over the training frames, at most."""
    max_minutes: float | None = None
    """Stop after this time; the learning rate falls with it."""
    batch_size: int | None = None
    """Images a step, over all devices: each takes its share."""
    optimizer: Literal["adamw", "ranger21"] | None = None
    """Optimizer, each with a schedule of the learning rate of its own; the recipe's if not given."""
    learning_rate: float | None = None
    """Peak learning rate."""
    untouched_share: float | None = None
    """Images of the untouched sensor, as full stick, for each labelled frame: explanations are measured against it."""
    augmentation: str | None = None
    """Random changes of training images. noise: noise alone. thesis: slight rotations, noise and blur. default: shifts
    and colour too. all-directions: turns by any angle, mirrors and magnifies, for pulls in any direction."""
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

    def run(self) -> None:
        """Train, and draw the learning curve; of several processes the first writes and speaks, the others help."""
        from sliplens.plots.errors import draw_learning_curve
        from sliplens.training import train

        options = {name: value for name, value in vars(self).items() if name != "output"}
        run = train(out=self.output, **options, on_progress=Terminal())
        picture = self.output / "curves.png"
        if run.training is not None and not picture.is_file():
            title = f"{self.output.name}, {run.manifest.input} images of {self.data.name}"
            draw_learning_curve(run.training, picture, title=title)
