"""`sliplens label`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.command import Command, Data, On, RetryFailed
from sliplens.cli.console import Terminal, wrote
from sliplens.cli.import_ import draw_audits, show_labelling, show_trials
from sliplens.errors import InputError
from sliplens.recordings.options import LabelSettings


@dataclass(frozen=True, kw_only=True)
class Label(Command):
    """Label the trials of a data set again, from the frames and the force samples that it stores.

    For another friction, axis or threshold than on import, to correct labels by hand, or to see how well the labels of
    a simulated data set come back from its frames and forces alone. Splits stay. Without --output the data set itself
    gets the new labels, once all of them are made.
    """

    data: Data
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Folder to make with the new labels; the data set itself if not given."""
    labelling: Annotated[LabelSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=LabelSettings)
    corrections: Annotated[Path | None, tyro.conf.arg(metavar="TABLE.csv")] = None
    """Table of corrections by hand, a row a trial, in place of those of the last table; --draft writes one."""
    draft: Annotated[Path | None, tyro.conf.arg(metavar="TABLE.csv")] = None
    """Change no label: write a table of the present labels, to be edited and given to --corrections."""
    audit: bool = True
    """Draw a page for each trial, in `audit/` of the folder, from which to judge its labels."""
    audit_only: bool = False
    """Change no label: draw the audit pages of the labels that are there, into `audit/` of the output folder."""
    on: On = "serial"
    retry_failed: RetryFailed = False

    def check(self) -> None:
        """Refuse options that exclude each other."""
        super().check()
        if self.draft is not None and (self.output is not None or self.corrections is not None or self.audit_only):
            raise InputError("--draft changes no label; leave --output, --corrections and --audit-only out")
        if self.audit_only and self.corrections is not None:
            raise InputError("--audit-only changes no label; leave --audit-only or --corrections out")

    def run(self) -> None:
        """Label again, write, and show the result."""
        from sliplens.recordings.corrections import draft_corrections
        from sliplens.recordings.dataset import load_dataset
        from sliplens.recordings.relabelling import label_dataset

        terminal, data, out = Terminal(), load_dataset(self.data), self.output or self.data
        if self.draft is not None:
            draft_corrections(data, self.draft)
            wrote(self.draft, f"edit it, then: sliplens label {self.data} --corrections {self.draft}")
            return
        if self.audit_only:
            draw_audits(data, out / "audit", terminal)
            return
        labelled = self.call(label_dataset, data=data, out=out, on_progress=terminal)
        if self.audit:
            draw_audits(labelled, out / "audit", terminal)
        show_labelling("Labelled", labelled)
        show_trials(labelled)
