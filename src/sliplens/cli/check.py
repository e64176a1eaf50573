"""`sliplens check`."""

from dataclasses import dataclass

from sliplens.cli.command import Data
from sliplens.cli.console import Terminal, print_table, say
from sliplens.errors import RecordingError


@dataclass(frozen=True, kw_only=True)
class Check:
    """Check a data set: every hash, every image, and the laws of its labels.

    Exit code 0 when all is well, 2 when something is not; then every finding is listed.
    """

    data: Data

    def run(self) -> None:
        """Check and say what is wrong, and where."""
        from sliplens.recordings.check import check_dataset
        from sliplens.recordings.dataset import load_dataset

        data = load_dataset(self.data)
        findings = check_dataset(data, on_progress=Terminal())
        if findings:
            print_table("Found", ("where", "what"), [(one.where, one.what) for one in findings])
            raise RecordingError(
                f"{self.data} has {len(findings)} thing{'s' if len(findings) > 1 else ''} wrong, listed above; "
                "mend or make these trials again"
            )
        say(f"{self.data} is sound: {len(data.trials)} trials, {data.frames:,} frames, every hash and law holds")
