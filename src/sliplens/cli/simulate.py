"""`sliplens simulate`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sliplens.cli.command import Command
from sliplens.cli.console import Terminal, print_table
from sliplens.errors import InputError
from sliplens.progress import open_stage, report_file, reporting

if TYPE_CHECKING:
    from sliplens.simulation import SimulationRecipe

_CLIP_FRAMES_PER_S = 30.0


@dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Simulate trials of a fingertip, with known safety margin, stick zone and marker motion.

    Each trial presses the fingertip on an object, holds, pulls until it slips, and slides on. The last day is the test
    set, dry and wet; the days before are dry and make the training set and, a quarter of all but the first, the
    validation set. A trial is never split. Look before you simulate: `sliplens simulate --preview sheet.png`.
    """

    output: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[OUT]")] = None
    """Folder to make. Not needed for --preview and --video alone."""
    preset: str = "small"
    """small: 104 short trials on 12 days, for a laptop. thesis: the days, splits and 160,757 frames of the thesis, some
    14 GB. varied: 2,520 short trials on 820 days, 200 sensors and objects from slippery to rough, for a network that
    meets others. The options below change it."""
    sensor: str = "chromatouch"
    """chromatouch: a dome with a fisheye inside, fitted to real images. flat-gel: a flat gel with dots, lit from three
    sides, like a GelSight; not fitted to one device."""
    displacement: Literal["calibrated", "half-space"] | None = None
    """How markers move. calibrated: as in real ChromaTouch images, its stick zone nominal. half-space: exact contact
    mechanics. That of the sensor if not given."""
    dry_trials: int | None = None
    """Trials on the dry object, dealt to all days."""
    wet_trials: int | None = None
    """Trials on the wet object, all on the days that test."""
    frames_per_trial: int | None = None
    """Frames of each trial; the thesis has about 800."""
    days: int | None = None
    """Days, each with its own friction, stiffness, light and camera; the last one tests."""
    test_days: int | None = None
    """Number of the last days that test."""
    dry_friction: tuple[float, float] | None = None
    """Least and largest coefficient of friction of the dry object; a wider range makes a network rely on it less."""
    pulls: Literal["steady", "varied"] | None = None
    """How objects are pulled. steady: in about 5.8 s, the margin falling evenly. varied: in 0.8 to 8 s, with rests,
    jerks and lettings back. That of the preset if not given."""
    release: bool = False
    """Let go of the object at the end of each trial."""
    seed: int = 0
    """Seed: the same seed gives the same bytes."""
    device: str = "cpu"
    """Where to draw the frames: cpu, cuda or cuda:1. A GPU's pixels may differ by one grey level."""
    preview: Path | None = None
    """Picture to write: a contact sheet of four trials (PNG, PDF or SVG)."""
    video: Path | None = None
    """Clip to write: one trial with its forces and margin beside it (MP4)."""

    def run(self) -> None:
        """Draw the pictures; simulate and write the data set."""
        from sliplens.extras import require_device
        from sliplens.results import describe_simulation
        from sliplens.simulation import make_recipe, simulate

        if self.output is None and self.preview is None and self.video is None:
            raise InputError("nothing to do; name a folder to make, or a picture with --preview")
        self._require_pictures()
        require_device(self.device)
        recipe, terminal = self.call(make_recipe), Terminal()
        with reporting(terminal):
            if self.preview is not None:
                self._draw_preview(self.preview, recipe)
            if self.video is not None:
                self._draw_video(self.video, recipe)
        if self.output is not None:
            data = self.call(simulate, out=self.output, on_progress=terminal)
            splits = describe_simulation(data).by_split.items()
            rows = [(name, str(row.trials), f"{row.frames:,}") for name, row in splits]
            print_table("Simulated", ("split", "trials", "frames"), rows)

    def _require_pictures(self) -> None:
        """Refuse a wrong suffix before anything is simulated."""
        if self.preview is not None:
            from sliplens.plots.style import require_picture_path

            require_picture_path(self.preview, example="sheet.png")
        if self.video is not None:
            from sliplens.plots.clip import require_clip_path

            require_clip_path(self.video)

    def _draw_preview(self, path: Path, recipe: "SimulationRecipe") -> None:
        from sliplens.plots.contact_sheet import write_contact_sheet
        from sliplens.simulation import simulate_examples

        with open_stage("Simulating trials for the preview"):
            recordings = simulate_examples(recipe, device=self.device)
        title = f"Simulated {recipe.sensor.name}, {recipe.resolved_displacement} displacement, seed {recipe.seed}"
        write_contact_sheet(recordings, path, title=title)
        report_file(path, f"{len(recordings)} of the trials that this recipe makes")

    def _draw_video(self, path: Path, recipe: "SimulationRecipe") -> None:
        from sliplens.plots.clip import write_clip
        from sliplens.simulation import plan_trials, simulate_trial
        from sliplens.simulation.loading import TRIAL_S

        # sampled at the clip's rate: a data set may have few frames a second
        plan = replace(plan_trials(recipe)[0], frames=round(TRIAL_S * _CLIP_FRAMES_PER_S))
        with open_stage("Simulating the trial"):
            recording = simulate_trial(plan, device=self.device)
        with open_stage("Writing the clip"):
            write_clip(recording, path, frames_per_s=_CLIP_FRAMES_PER_S)
        rate = f"{_CLIP_FRAMES_PER_S:g} frames/s"
        report_file(path, f"trial {plan.trial} at {rate}; to watch, not to train on: video is lossy")
