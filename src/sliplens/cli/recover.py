"""`sliplens recover`."""

from dataclasses import dataclass

from sliplens.cli.command import Data
from sliplens.cli.console import Terminal, say
from sliplens.progress import number_of


@dataclass(frozen=True, kw_only=True)
class Recover:
    """Make trials of recordings that were cut off, up to the last whole frame.

    For a data set into which `sliplens live --record` wrote when its process or machine went down.
    """

    data: Data

    def run(self) -> None:
        """Recover the recordings and say what the data set holds."""
        from sliplens.recordings.dataset import recover_dataset

        data = recover_dataset(self.data, on_progress=Terminal())
        say(f"{self.data} holds {number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}")
