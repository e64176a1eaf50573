"""`sliplens simulate`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sliplens.cli.console import print_table, progress_bar, unchanged, wrote
from sliplens.errors import InputError
from sliplens.extras import require_device
from sliplens.files import output_folder, write_json

if TYPE_CHECKING:
    from sliplens.simulation import SimulationRecipe, TrialPlan

_CLIP_FRAMES_PER_S = 30
_PREVIEWED = 4


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Simulate trials of a fingertip, with known safety margin, stick zone and marker motion.

    Each trial presses the fingertip on an object, holds, pulls until it slips, and slides on. The last day is the test
    set, dry and wet; the days before are dry and make the training set and, a quarter of all but the first, the
    validation set. A trial is never split. Look before you simulate: `sliplens simulate --preview sheet.png`.
    """

    output: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[OUT]")] = None
    """Folder to make. Not needed for --preview and --video alone."""
    preset: Literal["small", "thesis", "varied"] = "small"
    """small: 104 short trials on 12 days, for a laptop. thesis: the days, splits and 160,757 frames of the thesis, some
    14 GB. varied: 2,520 short trials on 820 days, 200 sensors and objects from slippery to rough, for a network that is
    to meet others. The options below change it."""
    sensor: Literal["chromatouch", "flat-gel"] = "chromatouch"
    """chromatouch: a dome with a fisheye inside, fitted to real images. flat-gel: a flat gel with dots, lit from three
    sides, like a GelSight; not fitted to one device."""
    displacement: Literal["calibrated", "half-space"] | None = None
    """How markers move. calibrated: as in real ChromaTouch images, its stick zone nominal. half-space: exact contact
    mechanics. The sensor's own if not given."""
    dry_trials: int | None = None
    """Trials on the dry object, dealt to all days."""
    wet_trials: int | None = None
    """Trials on the wet object, all on the days that test."""
    frames_per_trial: int | None = None
    """Frames of each trial; the thesis has about 800."""
    days: int | None = None
    """Days, each with its own friction, stiffness, light and camera; the last one tests."""
    test_days: int | None = None
    """How many of the last days test."""
    dry_friction: tuple[float, float] | None = None
    """Least and largest coefficient of friction of the dry object; a wider range makes a network rely on it less."""
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
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Draw what was asked for; simulate and write the data set."""
        from sliplens.simulation import plan_trials

        if self.output is None and self.preview is None and self.video is None:
            raise InputError("nothing to do; name a folder to make, or a picture with --preview")
        self._require_pictures()
        require_device(self.device)
        recipe = self._recipe()
        plans = plan_trials(recipe)
        if self.preview is not None:
            self._draw_preview(self.preview, recipe, _spread(plans))
        if self.video is not None:
            self._draw_video(self.video, plans)
        if self.output is not None:
            self._write(self.output, recipe)

    def _recipe(self) -> "SimulationRecipe":
        from sliplens.simulation import PRESETS, SENSORS

        preset = PRESETS[self.preset]
        counts = {
            "dry_trials": self.dry_trials,
            "wet_trials": self.wet_trials,
            "days": self.days,
            "test_days": self.test_days,
        }
        changes: dict[str, Any] = {name: value for name, value in counts.items() if value is not None}
        if "days" in changes and "dry_trials" not in changes and isinstance(preset.dry_trials, tuple):
            changes["dry_trials"] = sum(preset.dry_trials)
        if self.frames_per_trial is not None:
            changes["frames_per_trial"] = self.frames_per_trial
        if self.dry_friction is not None:
            changes["nuisances"] = replace(preset.nuisances, dry_friction=self.dry_friction)
        if changes.keys() - {"nuisances"}:
            # the totals are those of the preset as it stands
            changes["frame_totals"] = None
        return replace(
            preset,
            sensor=SENSORS[self.sensor],
            displacement=self.displacement,
            release=self.release,
            seed=self.seed,
            **changes,
        )

    def _require_pictures(self) -> None:
        """Refuse a wrong suffix before anything is simulated."""
        if self.preview is not None:
            from sliplens.plots.layout import require_picture_path

            require_picture_path(self.preview, example="sheet.png")
        if self.video is not None:
            from sliplens.plots.clip import require_clip_path

            require_clip_path(self.video)

    def _draw_preview(self, path: Path, recipe: "SimulationRecipe", plans: "list[TrialPlan]") -> None:
        from sliplens.plots.contact_sheet import write_contact_sheet
        from sliplens.simulation import simulate_trial

        recordings = []
        with progress_bar("Simulating trials for the preview") as bar:
            for done, plan in enumerate(plans, start=1):
                recordings.append(simulate_trial(plan, device=self.device))
                bar(done, len(plans))
        title = f"Simulated {recipe.sensor.name}, {recipe.resolved_displacement} displacement, seed {recipe.seed}"
        write_contact_sheet(recordings, path, title=title)
        wrote(path, f"{len(recordings)} of the trials that this recipe makes")

    def _draw_video(self, path: Path, plans: "tuple[TrialPlan, ...]") -> None:
        from sliplens.plots.clip import write_clip
        from sliplens.simulation import simulate_trial
        from sliplens.simulation.loading import TRIAL_S

        # sampled anew, for the eye: a data set may have few frames a second
        plan = replace(plans[0], frames=round(TRIAL_S * _CLIP_FRAMES_PER_S))
        with progress_bar("Simulating the trial") as bar:
            recording = simulate_trial(plan, device=self.device, on_frames=bar)
        with progress_bar("Writing the clip") as bar:
            write_clip(recording, path, on_frames=bar)
        wrote(path, f"trial {plan.trial} at {_CLIP_FRAMES_PER_S} frames/s; to watch, not to train on: video is lossy")

    def _write(self, output: Path, recipe: "SimulationRecipe") -> None:
        from sliplens.simulation import simulate_dataset

        config = {"recipe": recipe, "device": self.device}
        with output_folder(output, stage="simulate", config=config, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(output)
                return
            with progress_bar("Simulating frames") as bar:
                data = simulate_dataset(out.folder, recipe, device=self.device, on_frames=bar)
            splits: dict[str, dict[str, int]] = {}
            for trial in data.trials:
                split = splits.setdefault(trial.split, {"trials": 0, "frames": 0})
                split["trials"] += 1
                split["frames"] += trial.frames
            frames = sum(trial.frames for trial in data.trials)
            write_json(
                out.folder / "result.json",
                {
                    "trials": len(data.trials),
                    "frames": frames,
                    "by_split": splits,
                    "conditions": sorted({trial.condition for trial in data.trials}),
                },
            )
        rows = [(name, str(split["trials"]), f"{split['frames']:,}") for name, split in splits.items()]
        print_table("Simulated", ("split", "trials", "frames"), rows)
        wrote(output, f"{len(data.trials)} trials, {frames:,} frames")


def _spread(plans: "tuple[TrialPlan, ...]") -> "list[TrialPlan]":
    """A few trials that show the range: the wet ones last."""
    dry = [plan for plan in plans if plan.condition == "dry"]
    wet = [plan for plan in plans if plan.condition == "wet"][:1]
    count = min(_PREVIEWED - len(wet), len(dry))
    return [dry[index * (len(dry) - 1) // max(1, count - 1)] for index in range(count)] + wet
