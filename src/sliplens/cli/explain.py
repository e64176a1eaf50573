"""`sliplens explain` and `sliplens score`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sliplens.cli.command import Command, Device, NetworkPath, On, Output, RetryFailed, require_path
from sliplens.cli.console import print_table, say
from sliplens.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Explain(Command):
    """Show which parts of a frame made the network answer as it did, rather than as for the untouched sensor.

    Explains frames of a data set along the safety margin, or a folder of images (`--frames`). The folder holds the maps
    without loss (arrays.npz), an overlay of each (overlays/METHOD/FRAME.png) and up to twelve frames side by side
    (panel.png).
    """

    model: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")] = None
    """Folder of a trained network, or the name of one that comes with sliplens."""
    data: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DATA]")] = None
    """Data set to take frames from; leave out with --frames."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Folder to make: maps, inputs, table, pictures."""
    frames: Path | None = None
    """Folder of 8-bit RGB images: camera frames together with --reference, or difference images for a network on
    differences, such as chromatouch-difference."""
    reference: Path | None = None
    """Image of the untouched sensor, for camera frames in --frames."""
    sensor: Path | None = None
    """Profile of the sensor for --frames: a file that `sliplens sensor new` made, or a name such as digit."""
    labels_in_names: bool = False
    """Read the safety margin in percent from names such as image_433_20.png."""
    method: tuple[str, ...] | None = None
    """Explainers to run; --list-methods tells which there are. If not given, the recommended one: Shapley values of the
    markers, or of tiles where none are found."""
    list_methods: bool = False
    """Print the table of explainers and do nothing else."""
    budget: float | None = None
    """Share of the channels that poly-cam measures at first; below 1 it is faster. It goes on where the map is not
    expected to be like the exact one, and tells how far it is. If not given, 1 for one image and 0.15 for several."""
    colours: Literal["signed", "jet"] = "signed"
    """Colours of the pictures. signed: blue raises the answer and orange lowers it, on one scale for all frames. jet:
    what supports the answer, each picture on its own scale, as in the thesis's figures."""
    split: str = "test"
    """Trials of the data set to take frames from."""
    condition: str = "dry"
    """Condition of those trials."""
    trials: int = 1
    """How many trials."""
    levels: tuple[float, ...] = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
    """Safety margins at which frames are taken."""
    device: Device = "cpu"
    on: On = "serial"
    retry_failed: RetryFailed = False

    def check(self) -> None:
        """Refuse what is wrong at first sight."""
        if self.list_methods:
            return
        if self.model is None or self.output is None:
            raise InputError("name the network and the folder to make: sliplens explain RUN DATA -o FOLDER")
        if (self.data is None) == (self.frames is None):
            raise InputError("name either a data set or --frames FOLDER, to say which frames to explain")
        if self.frames is not None:
            require_path(self.frames, what="the folder of frames")
        super().check()

    def run(self) -> None:
        """Explain and write the maps."""
        if self.list_methods:
            _print_methods()
            return
        if self.model is None or self.output is None:
            raise InputError("name the network and the folder to make: sliplens explain RUN DATA -o FOLDER")
        if self.data is not None and self.frames is None:
            from sliplens.recordings import load_dataset

            source = load_dataset(self.data)
        elif self.frames is not None and self.data is None:
            source = self.frames
        else:
            raise InputError("name either a data set or --frames FOLDER, to say which frames to explain")
        from sliplens.explainers.frames import FrameSelection
        from sliplens.study.explaining import explain

        select = FrameSelection(
            split=self.split, condition=self.condition, trials=self.trials, levels=tuple(self.levels)
        )
        self.call(explain, run=self.model, source=source, select=select, out=self.output)


def _print_methods() -> None:
    from sliplens.explainers.table import EXPLAINERS

    print_table("Explainers", ("method", "name"), [(name, row.title) for name, row in EXPLAINERS.items()])


@dataclass(frozen=True, kw_only=True)
class Score(Command):
    """Score explanations: remove what they call influential first, and last, against random orders and controls.

    The score is the symmetric gain in margin units: 0 is no better than chance, and a method that does not beat the
    controls, which use nothing the network learned, shows nothing. The deletion score of the thesis (D_AUC, grey fill,
    lower is more faithful) stands beside it.
    """

    model: NetworkPath
    explanations: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="EXPLANATIONS")]
    """Folder that `sliplens explain` made."""
    output: Output
    """Folder to make: curves and scores."""
    fill: str = "reference"
    """Content of removed pixels: reference (the untouched sensor), grey, black, white, background, blur or
    noisy-linear."""
    unit: Literal["pixel", "tile"] = "pixel"
    """What is removed at once: pixels, or tiles of a fourteenth of the image."""
    random_orders: int = 20
    """Number of random orders."""
    steps: int = 28
    """Steps of the deletion score until every pixel is removed; 224 as in the thesis, 0 to leave it out."""
    device: Device = "cpu"
    on: On = "serial"
    retry_failed: RetryFailed = False
    seed: int = 0
    """Seed of the random orders."""

    def run(self) -> None:
        """Score and write the curves."""
        from sliplens.study.scoring import score

        faithfulness = self.call(score, run=self.model, frames=self.explanations, out=self.output)
        rows = []
        for found in faithfulness.scores:
            gap, lead = found.srg, found.lead_over_controls
            ends = "" if gap.low is None or gap.high is None else f"{gap.low:+.3f} to {gap.high:+.3f}"
            lead_words = "" if lead is None else f"{lead.gap.estimate:+.3f}"
            rows.append((found.method, f"{gap.estimate:+.3f}", ends, lead_words))
        where = f"{faithfulness.input} images ({faithfulness.source})"
        print_table(
            f"symmetric gain, {where}, fill {self.fill}: higher is more faithful",
            ("method", "gain", "95 % interval", "less the best control"),
            rows,
        )
        if faithfulness.deletion is not None:
            print_table(
                f"deletion score of the thesis, {where}, fill grey: lower is more faithful",
                ("method", "D_AUC", "+-", "last step", "frames"),
                [
                    (name, f"{method.mean:.3f}", f"{method.sd:.3f}", f"{method.last_step_mean:.3f}", str(method.frames))
                    for name, method in faithfulness.deletion.methods.items()
                ],
            )
        alarms = faithfulness.alarms + (() if faithfulness.deletion is None else faithfulness.deletion.alarms)
        for alarm in dict.fromkeys(alarms):
            say(f"  alarm: {alarm}")
