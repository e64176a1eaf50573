"""`sliplens label`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.command import Command, Data
from sliplens.cli.console import Terminal
from sliplens.cli.import_ import draw_audits, show_labelling, show_trials
from sliplens.recordings.options import LabelSettings


@dataclass(frozen=True, kw_only=True)
class Label(Command):
    """Label the trials of a data set anew, from the frames and the force samples that it keeps.

    For another friction, axis or threshold than on import, or to see how well the labels of a simulated data set come
    back when only its frames and forces are known. Splits stay. Without --output the data set itself gets the new
    labels, once all of them are there.
    """

    data: Data
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Folder to make with the new labels; the data set itself if not given."""
    labelling: Annotated[LabelSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=LabelSettings)
    audit: bool = True
    """Draw a page for each trial, in `audit/` of the folder, from which to judge its labels."""
    audit_only: bool = False
    """Change no label: draw the audit pages of the labels that are there, into `audit/` of the output folder."""

    def run(self) -> None:
        """Label anew, write, and show what was found."""
        from sliplens.recordings.dataset import load_dataset
        from sliplens.recordings.importing import label_dataset

        terminal, data, out = Terminal(), load_dataset(self.data), self.output or self.data
        if self.audit_only:
            draw_audits(data, out / "audit", terminal)
            return
        labelled = self.call(label_dataset, data=data, out=out, on_progress=terminal)
        if self.audit:
            draw_audits(labelled, out / "audit", terminal)
        show_labelling("Labelled", labelled)
        show_trials(labelled)
