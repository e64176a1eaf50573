"""`sliplens label`."""

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Annotated

import tyro

from sliplens.cli.command import Command, Data, On, RetryFailed
from sliplens.cli.console import Terminal, say
from sliplens.cli.import_ import draw_audits, show_labelling, show_trials
from sliplens.errors import InputError
from sliplens.recordings.options import LabelSettings


@dataclass(frozen=True, kw_only=True)
class Label(Command):
    """Label the trials of a data set anew, from the frames and the force samples that it keeps.

    For another friction, axis or threshold than on import, or to see how well the labels of a simulated data set come
    back when only its frames and forces are known. Splits stay. Without --output the data set itself gets the new
    labels, once all of them are there. Repairs by hand (--page) are followed.
    """

    data: Data
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Folder to make with the new labels; the data set itself if not given."""
    labelling: Annotated[LabelSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=LabelSettings)
    audit: bool = True
    """Draw a page for each trial, in `audit/` of the folder, from which to judge its labels."""
    audit_only: bool = False
    """Change no label: draw the audit pages of the labels that are there, into `audit/` of the output folder."""
    page: bool = False
    """Change no label: show the trials in a browser on this machine, to set reference, contact, slip, tare, sign and
    bad spans by hand. Each edit is kept beside the data set; ends with Ctrl-C."""
    undo: Annotated[str | None, tyro.conf.arg(metavar="TRIAL")] = None
    """Change no label: take back the last edit by hand of this trial."""
    by: str | None = None
    """Who edits on the page, or takes an edit back; who is logged in if not given."""
    on: On = "serial"
    retry_failed: RetryFailed = False

    def check(self) -> None:
        """Refuse what does not go together."""
        super().check()
        if (self.page or self.undo is not None) and (self.output is not None or self.audit_only):
            raise InputError("edits are kept beside the data set itself; leave --output and --audit-only out")
        if self.page and self.undo is not None:
            raise InputError("the page has an undo of its own; leave --page or --undo out")
        if self.by is not None and not self.page and self.undo is None:
            raise InputError("--by says who edits; add --page, or leave it out")

    def run(self) -> None:
        """Label anew, write, and show what was found."""
        from sliplens.recordings.dataset import load_dataset
        from sliplens.recordings.importing import label_dataset

        if self.page:
            self._repair()
            return
        if self.undo is not None:
            self._take_back(self.undo)
            return
        terminal, data, out = Terminal(), load_dataset(self.data), self.output or self.data
        if self.audit_only:
            draw_audits(data, out / "audit", terminal)
            return
        labelled = self.call(label_dataset, data=data, out=out, on_progress=terminal)
        if self.audit:
            draw_audits(labelled, out / "audit", terminal)
        show_labelling("Labelled", labelled)
        show_trials(labelled)

    def _take_back(self, trial: str) -> None:
        from sliplens.recordings.dataset import load_dataset
        from sliplens.recordings.edits import undo_edit

        edit = undo_edit(load_dataset(self.data), trial, by=self.by)
        value = ", ".join(f"{number:g}" for number in edit.numbers) or "as found"
        say(f"took back what {edit.by} set on {edit.at[:10]}: {edit.kind} {value}, of {trial}")

    def _repair(self) -> None:
        """Show the page until it is ended."""
        from sliplens.app import LabelPage

        with suppress(KeyboardInterrupt), LabelPage(self.data, labelling=self.labelling, by=self.by) as page:
            say(f"open {page.address}")
            Event().wait()
        say(f"`sliplens label {self.data}` makes the labels follow the edits")
