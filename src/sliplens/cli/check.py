"""`sliplens check`."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.command import Data
from sliplens.cli.console import Terminal, print_table, say
from sliplens.errors import RecordingError
from sliplens.progress import number_of

if TYPE_CHECKING:
    from sliplens.recordings import Dataset

_OTHER = "Another data set, or a network: tell what DATA shares with it instead."


@dataclass(frozen=True, kw_only=True)
class Check:
    """Check a data set: every hash, every image, and the laws of its labels; or what it shares with another.

    Exit code 0 when all is well, 2 when something is not; then every finding is listed.
    """

    data: Data
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DATA|RUN]", help=_OTHER)] = None
    split: str | None = None
    """Trials of DATA to compare; all if not given."""
    other_split: str | None = None
    """Trials of the other data set to compare; all if not given."""

    def run(self) -> None:
        """Check and say what is wrong, and where, or what is shared."""
        from sliplens.recordings.check import check_dataset
        from sliplens.recordings.dataset import DATASET_FILE, load_dataset, trial_path
        from sliplens.recordings.store import read_header

        data = load_dataset(self.data)
        if self.other is not None:
            (self._compare if (self.other / DATASET_FILE).is_file() else self._ask)(data, self.other)
            return
        findings = check_dataset(data, on_progress=Terminal())
        if findings:
            print_table("Found", ("where", "what"), [(one.where, one.what) for one in findings])
            raise RecordingError(
                f"{self.data} has {number_of(len(findings), 'thing')} wrong, listed above; "
                "mend or make these trials again"
            )
        held = f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}"
        labellings = (read_header(trial_path(data.folder, info.trial)).labelling for info in data.trials)
        bases = [labelling.basis for labelling in labellings if labelling and labelling.basis]
        # frames at a fault of the force sensor are not valid, and the others are in no doubt for it
        doubtful = sum(bool(basis.axes.notes or basis.friction.notes or basis.doubts) for basis in bases)
        if doubtful:
            about = f"the notes above put labels of {number_of(doubtful, 'trial')} in doubt"
            say(f"{self.data} is whole: {held}, every hash and law holds, but {about}")
            return
        say(f"{self.data} is sound: {held}, every hash and law holds")

    def _compare(self, data: "Dataset", other: Path) -> None:
        from sliplens.simulation.sharing import compare_datasets

        shared = compare_datasets(data, other, splits=(self.split, self.other_split))
        pairs = {"trial": shared.trials, "day": shared.days, "sensor": shared.sensors}
        for noun, found in pairs.items():
            if found:
                print_table(f"Shared {noun}s", (str(self.data), str(other)), list(found))
        counts = ", ".join(number_of(len(found), noun) for noun, found in pairs.items())
        told = "seeds and frames" if shared.by_seeds else "names and frames"
        say(f"{self.data} and {other} share {counts} (told by their {told})")

    def _ask(self, data: "Dataset", network: Path) -> None:
        from sliplens.models.checkpoint import load
        from sliplens.training.evaluation import find_training_trials

        trials = data.select(split=self.split)
        known = Counter(trial.split for trial in find_training_trials(trials, load(network)))
        for split, count in Counter(trial.split for trial in trials).items():
            say(f"{network} was trained on {known[split]} of the {count} {split} trials of {self.data}")
