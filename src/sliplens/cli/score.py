"""`sliplens score`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.command import Command, Device, Network, On, Output, RetryFailed
from sliplens.cli.console import print_table, say


@dataclass(frozen=True, kw_only=True)
class Score(Command):
    """Score explanations by deletion: remove the most salient pixels first and watch the answer.

    D = (1 - |y_base - y_mask|)^2 at each step, averaged over the steps (thesis, eq. 2): lower is more faithful. A
    random order is scored beside every method; one that does not beat it has shown nothing.
    """

    model: Network
    explanations: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="EXPLANATIONS")]
    """Folder that `sliplens explain` made."""
    output: Output
    """Folder to make: curves and table."""
    fill: str = "grey"
    """What removed pixels become: grey, black, white, background, blur or noisy-linear."""
    steps: int | None = None
    """Steps until every pixel is gone; the image's height if not given."""
    device: Device = "cpu"
    on: On = "serial"
    retry_failed: RetryFailed = False
    seed: int = 0
    """Seed of the random order."""

    def run(self) -> None:
        """Score and write the curves."""
        from sliplens.study.workspace import score_explained

        scores = self.call(score_explained, run=self.model, out=self.output)
        print_table(
            f"deletion score, {scores.input} images ({scores.source}), fill {self.fill}: lower is more faithful",
            ("method", "D_AUC", "+-", "last step", "frames"),
            [
                (name, f"{method.mean:.3f}", f"{method.sd:.3f}", f"{method.last_step_mean:.3f}", str(method.frames))
                for name, method in scores.methods.items()
            ],
        )
        for alarm in scores.alarms:
            say(f"  alarm: {alarm}")
