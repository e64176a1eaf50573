"""`sliplens study` and `sliplens diagnose`."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sliplens.cli.command import Command, Data, Device, NetworkPath, Output, RetryFailed
from sliplens.cli.console import say
from sliplens.cli.report import Report
from sliplens.cli.simulate import Simulate
from sliplens.errors import InputError
from sliplens.extras import require_device
from sliplens.files import DEFAULT_NETWORK

_PRESET_FRAMES = 80
"""Frames of each simulated trial; the thesis has about 800, which takes ten times as long and says the same."""


@dataclass(frozen=True, kw_only=True)
class Study(Command):
    """Find out which explanation of a network can be believed: the experiment of the thesis, and the controls it lacks.

    Picks trials that the networks read well, explains frames from full stick to full slip, scores the explanations by
    removal under several fills against controls, by randomisation and, where the data are simulated, by the truth; then
    draws the report. Interrupted, it goes on where it stopped when the same command is given again.
    """

    data: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DATA]")] = None
    """Data set with labels; leave out with --preset."""
    output: Output
    """Folder to make, one subfolder a stage; the page is report.html in it."""
    network: tuple[str, ...] | None = None
    """Networks to explain, folders or names of those that come with sliplens, one an input. If not given,
    chromatouch-pair, or with --preset thesis-difference and thesis-raw."""
    preset: Literal["thesis"] | None = None
    """Simulate the data set first: the days and trials of the thesis, 80 frames each, some 1.5 GB; and explain networks
    that were trained on its training trials with the recipe of the thesis."""
    method: tuple[str, ...] | None = None
    """Explainers to compare; those that end in -thesis are as the thesis ran them. If not given, the three of the
    thesis, the same three against the untouched sensor, occlusion, and Shapley values of markers."""
    split: str = "test"
    """Trials to choose from."""
    condition: str = "dry"
    """Condition of those trials."""
    trials: int = 14
    """How many trials to look at."""
    tolerance: float = 0.03
    """Largest error of an answer in them, as a share of the margin; where too few qualify, the next best are taken."""
    budget: float = 0.15
    """Share of the channels that Poly-CAM measures at first, more where its map asks for it; 1 for all."""
    random_orders: int = 10
    """Random orders that every method has to beat."""
    device: Device = "cpu"
    on: Annotated[str | None, tyro.conf.arg(metavar="serial|processes[=N]|ray[=ADDRESS]")] = None
    """Where maps are made and judged. If not given, in two processes where the networks run on a processor."""
    retry_failed: RetryFailed = False
    seed: int = 0
    """Seed of the random orders, of new weights and of noise."""

    def run(self) -> None:
        """Run every stage that is not there yet, and draw the report."""
        from sliplens.results.study import STUDY_METHODS, StudyConfig
        from sliplens.study.choice import study_explainers
        from sliplens.study.run import load_networks, run_study

        if (self.data is None) == (self.preset is None):
            raise InputError("name a data set, or --preset thesis to simulate one")
        require_device(self.device)
        default = ("thesis-difference", "thesis-raw") if self.preset else (DEFAULT_NETWORK,)
        # mistakes are reported before a data set is simulated
        networks = load_networks(self.network or default, device=self.device)
        methods = self.method or STUDY_METHODS
        study_explainers(methods, budget=self.budget)
        options = {field.name: vars(self)[field.name] for field in fields(StudyConfig) if field.name in vars(self)}
        self.call(
            run_study,
            data=self.data or self._simulate(),
            networks=tuple(networks.values()),
            config=StudyConfig(methods=methods, **options),
            out=self.output,
            on=self.on or ("serial" if self.device != "cpu" else "processes=2"),
        )
        Report(workspace=self.output).run()

    def _simulate(self) -> Path:
        folder = self.output / "data"
        assert self.preset is not None  # one of the two is given
        Simulate(output=folder, preset=self.preset, frames_per_trial=_PRESET_FRAMES, overwrite=self.overwrite).run()
        return folder


@dataclass(frozen=True, kw_only=True)
class Diagnose(Command):
    """Find out where a network fails, and why.

    Half of the trials tell in which slices the error is large: condition, friction, force, place of contact, day. The
    other half tests them. In simulation what the network makes of each marker is compared with the best linear
    reading, and the same press and pull is filmed anew with other frictions. Ends in sentences, and a page.
    """

    model: NetworkPath
    data: Data
    output: Output
    """Workspace: a subfolder for the evaluation and one for the diagnosis; the page is report.html in it."""
    split: str = "test"
    """Which trials of the data set."""
    trials: int = 8
    """Trials of each condition that are explained, three frames each."""
    pairs: int = 120
    """Pairs of random sets of markers from which the Shapley values of each of these frames are estimated."""
    device: Device = "cpu"
    seed: int = 0
    """Seed of the halves and of the random sets."""

    def run(self) -> None:
        """Diagnose, say what was found and draw the page."""
        from sliplens.models.checkpoint import load
        from sliplens.study.diagnose import diagnose

        diagnosis = self.call(diagnose, run=load(self.model, device=self.device), out=self.output)
        for sentence in filter(None, (*diagnosis.sentences, diagnosis.left_out)):
            say(f"- {sentence}")
        Report(workspace=self.output).run()
