"""`sliplens simulate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.console import progress_bar, unchanged, wrote
from sliplens.provenance import output_folder, write_json


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Simulate trials of a ChromaTouch-like dome, with known safety margin.

    Each trial presses the dome on a flat object, holds, and pulls until it slips. The last day is the test set, dry and
    wet; the days before are dry and make the training set and, a quarter of all but the first, the validation set. A
    trial is never split. The thesis has four days.
    """

    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder to make."""
    dry_trials: int = 96
    """Trials on the dry object, dealt to all days."""
    wet_trials: int = 8
    """Trials on the wet object, all on the last day."""
    frames_per_trial: int = 48
    """Frames of each trial; the thesis has about 800."""
    days: int = 12
    """Days, each with its own friction, stiffness, light and camera; the last one tests."""
    seed: int = 0
    """Seed: the same seed gives the same bytes."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Simulate and write the data set."""
        from sliplens.simulation import SimulationRecipe, simulate_dataset

        recipe = SimulationRecipe(
            dry_trials=self.dry_trials,
            wet_trials=self.wet_trials,
            frames_per_trial=self.frames_per_trial,
            days=self.days,
            seed=self.seed,
        )
        with output_folder(self.output, stage="simulate", config={"recipe": recipe}, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            with progress_bar("Simulating trials") as bar:
                data = simulate_dataset(out.folder, recipe, on_trial=bar)
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
        wrote(self.output, f"{len(data.trials)} trials, {frames:,} frames")
