"""`sliplens report`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.console import wrote
from sliplens.progress import number_of


@dataclass(frozen=True, kw_only=True)
class Report:
    """Draw one self-contained page from what the other commands wrote into a folder.

    The figures are written beside it too, in the folder figures: each as PDF, its numbers as CSV.
    """

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="WORKSPACE")]
    """Folder that holds the results, one subfolder a command."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Page to write; report.html in the workspace if not given."""

    def run(self) -> None:
        """Draw and write the page."""
        from sliplens.report import write_report

        written = write_report(self.workspace, self.output)
        if written.figures:
            wrote(
                written.figures[0].parent,
                f"{number_of(len(written.figures) // 2, 'figure')} as PDF, their numbers as CSV",
            )
        wrote(written.page, "open it in a browser")
