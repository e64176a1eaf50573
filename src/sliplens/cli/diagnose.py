"""`sliplens diagnose`."""

from dataclasses import dataclass

from sliplens.cli.command import Command, Data, Device, Network, Output
from sliplens.cli.console import say
from sliplens.cli.report import Report


@dataclass(frozen=True, kw_only=True)
class Diagnose(Command):
    """Find out where a network fails, and why.

    Half of the trials tell in which slices the error is large: condition, friction, force, place of contact, day. The
    other half tests them. In simulation what the network makes of each marker is compared with the best linear
    reading, and the same press and pull is filmed anew with other frictions. Ends in sentences, and a page.
    """

    model: Network
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
