"""`sliplens status`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.console import say
from sliplens.files import RUN_FILE

if TYPE_CHECKING:
    from sliplens.runner import Status as Progress

_SHOWN = 20
"""Number of failed parts that are listed."""


@dataclass(frozen=True, kw_only=True)
class Status:
    """Show how far a command is that works on many trials: what is done, how fast, when it ends, what failed.

    Reads the parts that are there, so that it can be asked from another terminal or machine while the command runs.
    """

    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """File or folder that the command was told to write."""

    def run(self) -> None:
        """Read the parts and show them."""
        from sliplens.runner import read_status

        works = read_status(self.output)
        if not works:
            whole = self.output.is_file() or (self.output / RUN_FILE).is_file()
            say(f"{self.output} is complete" if whole else f"nothing in {self.output} is worked on in parts now")
        for work in works:
            _show(work)


def _show(work: "Progress") -> None:
    frames = f"{work.frames_done:,} of {work.frames:,} frames"
    say(f"{work.title}, --on {work.on}: {work.done:,} of {work.parts:,} parts, {frames}")
    if work.frames_per_s is not None:
        say(f"  {work.frames_per_s:.3g} a second" + (f", done at {work.ends}" if work.ends else ""))
    if not work.running:
        say("  not running; give the same command again to continue")
    for failure in work.failed[:_SHOWN]:
        times = "once" if len(failure.errors) == 1 else f"{len(failure.errors)} times"
        say(f"  failed, {times}: {failure.name}: {failure.errors[-1]}")
