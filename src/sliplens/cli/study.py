"""`sliplens study`."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sliplens.cli.evaluate import Evaluate
from sliplens.cli.report import Report
from sliplens.cli.screen import Screen, Terminal
from sliplens.cli.simulate import Simulate
from sliplens.cli.together import run_together
from sliplens.errors import InputError
from sliplens.extras import require_device

if TYPE_CHECKING:
    from sliplens.cli.study_stages import Stages
    from sliplens.models import TrainedModel

_PRESET_FRAMES = 80
"""Frames of each simulated trial; the thesis has about 800, which takes ten times as long and says the same."""
_NONE = "none"


@dataclass(frozen=True, kw_only=True)
class Study:
    """Find out which explanation of a network can be believed: the experiment of the thesis, and the controls it lacks.

    Picks trials that the networks read well, explains frames from full stick to full slip, scores the explanations by
    removal under several fills against controls, by randomisation and, where the data are simulated, by the truth; then
    draws the report. Interrupted, it goes on where it stopped when the same command is given again.
    """

    data: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DATA]")] = None
    """Data set with labels; leave out with --preset."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """Folder to make, one subfolder a stage; the page is report.html in it."""
    difference: str = "chromatouch-difference"
    """Network on difference images: a folder, or a name of one that comes with sliplens; none to leave it out."""
    raw: str = "chromatouch-raw"
    """The same on raw images."""
    preset: Literal["thesis"] | None = None
    """Simulate the data set first: the days and trials of the thesis, 80 frames each, some 1.5 GB. The networks of the
    package never saw its trials, so the training trials are chosen from, as in the thesis."""
    method: tuple[str, ...] | None = None
    """Explainers to compare; poly-cam-thesis is Poly-CAM as the thesis ran it. If not given, the thesis's three,
    Poly-CAM for a regressor, and occlusion."""
    split: str | None = None
    """Trials to choose from; test if not given, train with --preset."""
    condition: str = "dry"
    """Condition of those trials."""
    trials: int = 14
    """How many trials to look at."""
    tolerance: float = 0.03
    """Largest error of an answer in them, as a share of the margin; where too few qualify, the next best are taken."""
    budget: float = 0.15
    """Share of the channels that Poly-CAM measures at first, more where its map asks for it; 1 for all."""
    random_orders: int = 20
    """Random orders that every method has to beat."""
    device: str = "cpu"
    """Where the networks run: cpu, cuda or cuda:1."""
    jobs: int | None = None
    """Networks to judge at the same time, each by a process with its share of the cores; one after the other with 1. If
    not given, both at once where they run on a processor."""
    seed: int = 0
    """Seed of the random orders, of new weights and of noise."""
    overwrite: bool = False
    """Make every stage again."""

    def run(self) -> None:
        """Run every stage that is not there yet, and draw the report."""
        from sliplens.study.material import STUDY_METHODS, study_explainers

        if (self.data is None) == (self.preset is None):
            raise InputError("name a data set, or --preset thesis to simulate one")
        if self.jobs is not None and self.jobs < 1:
            raise InputError(f"--jobs must be at least 1, got {self.jobs}")
        if self.random_orders < 1:
            raise InputError(f"--random-orders must be at least 1, got {self.random_orders}")
        require_device(self.device)
        study_explainers(self.method or STUDY_METHODS, budget=self.budget)  # a mistake is told before all else
        networks = self._load_networks()
        folder = self.data or self._simulate()
        for name, model in self._named().items():
            Evaluate(
                model=model,
                data=folder,
                output=self.output / f"evaluate-{name}",
                device=self.device,
                overwrite=self.overwrite,
            ).run()
        stages = self.stages(folder, networks)
        stages.choose(
            split=self.split or ("train" if self.preset else "test"),
            condition=self.condition,
            trials=self.trials,
            tolerance=self.tolerance,
        )
        threads = self._threads(len(networks))
        if threads is None:
            for name in networks:
                stages.judge(name)
        else:
            run_together(partial(_judge, self, folder), list(networks), threads=threads)
        for name in networks:
            stages.time(name)
        Report(workspace=self.output).run()

    def stages(self, folder: Path, networks: "Mapping[str, TrainedModel]", screen: Screen | None = None) -> "Stages":
        """The stages of this study on a data set, with some of its networks."""
        from sliplens.cli.study_stages import Stages
        from sliplens.recordings import Dataset
        from sliplens.study.material import STUDY_METHODS, method_options, study_explainers

        explainers = study_explainers(self.method or STUDY_METHODS, budget=self.budget)
        return Stages(
            output=self.output,
            data=Dataset.open(folder),
            networks=networks,
            explainers=explainers,
            settings={"methods": method_options(explainers), "seed": self.seed},
            random_orders=self.random_orders,
            seed=self.seed,
            overwrite=self.overwrite,
            screen=screen or Terminal(),
        )

    def load_network(self, name: str) -> "TrainedModel":
        """One of the networks, by its input.

        Raises
        ------
        InputError
            If it was trained on another input.
        """
        from sliplens.models.checkpoint import load

        trained = load(self._named()[name], device=self.device)
        if trained.manifest.input != name:
            raise InputError(
                f"--{name} names a network on {trained.manifest.input} images; give one that was trained on {name}"
            )
        return trained

    def _threads(self, networks: int) -> int | None:
        """Threads of each network's process, or None to judge them one after the other in this one."""
        import torch

        jobs = self.jobs if self.jobs is not None else (networks if self.device == "cpu" else 1)
        cores = torch.get_num_threads()
        return None if min(jobs, networks, cores) < 2 else cores // networks

    def _simulate(self) -> Path:
        folder = self.output / "data"
        assert self.preset is not None  # one of the two is given
        Simulate(output=folder, preset=self.preset, frames_per_trial=_PRESET_FRAMES, overwrite=self.overwrite).run()
        return folder

    def _named(self) -> dict[str, Path]:
        return {
            name: Path(given) for name, given in (("difference", self.difference), ("raw", self.raw)) if given != _NONE
        }

    def _load_networks(self) -> "dict[str, TrainedModel]":
        networks = {name: self.load_network(name) for name in self._named()}
        if not networks:
            raise InputError("a study needs a network; leave out --difference none or --raw none")
        return networks


def _judge(study: Study, folder: Path, name: str, screen: Screen) -> None:
    study.stages(folder, {name: study.load_network(name)}, screen).judge(name)
