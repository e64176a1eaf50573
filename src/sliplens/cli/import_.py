"""`sliplens import`."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sliplens.cli.command import Command, On, Output, RetryFailed
from sliplens.cli.console import Terminal, print_table, say, wrote
from sliplens.progress import fold_equal, number_of
from sliplens.recordings.options import LabelSettings, ReadOptions

_MOST_ROWS = 24
"""Trials of which each has a line."""

if TYPE_CHECKING:
    from sliplens.recordings import Dataset
    from sliplens.recordings.labelling import Labelling


@dataclass(frozen=True, kw_only=True)
class Import(Command):
    """Import recordings of your own sensor and label every frame with its safety margin.

    Reads ROS 2 bags (no ROS needed), LeRobot v3 data sets, videos and folders of images beside a table of forces. Tare,
    axes, sign, lag and friction are found from the trial itself unless you give them, and shown. A trial must touch,
    and slip at its end; for one that never slips give --mu. What brings its own labels keeps them: data sets of
    sliplens, the lists of the thesis.
    """

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Recordings: one trial each, or all episodes of a LeRobot data set; a folder of them, paired with tables of forces
    by name; or a manifest (CSV: trial, video, forces, sensor, day, object, condition, mu, reference)."""
    output: Output
    """Folder to make: a data set for `sliplens train`."""
    reference: Path | None = None
    """Image of the untouched sensor; a frame before the contact, by --reference-method, if neither it nor
    --reference-frame is given."""
    sensor: str | None = None
    """Name of the sensor, or its profile: a file that `sliplens sensor new` made, or chromatouch, digit, gelsight-mini
    or tactip. A network is trained for one sensor. Needed unless the source tells it."""
    condition: str | None = None
    """State of the surface, such as dry or wet; as the source tells, else dry."""
    day: int | None = None
    """Day of the recording, counted from 1; as the source tells, else 1."""
    object: str | None = None
    """What was held; as the source tells, else nothing."""
    validation_trials: int | None = None
    """How many trials validate the training: the last before those that test."""
    test_trials: int | None = None
    """How many trials test, the last ones; all others train. Trials are never split."""
    splits: Path | None = None
    """Deal by trial, object or day; or a table with the columns trial and split (CSV). In place of the two counts."""
    add: bool = False
    """Add to the data set in the output folder; trials that are there already stay as they are."""
    format: str | None = None
    """rosbag, lerobot, sliplens, thesis, gelsight, images or video; recognised if not given."""
    reading: Annotated[ReadOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ReadOptions)
    labelling: Annotated[LabelSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=LabelSettings)
    audit: bool = True
    """Draw a page for each trial, in `audit/` of the folder, from which to judge its labels."""
    on: On = "serial"
    retry_failed: RetryFailed = False

    def run(self) -> None:
        """Read, label, write, and show what was found."""
        from sliplens.recordings.importing import import_recordings

        terminal = Terminal()
        data = self.call(import_recordings, out=self.output, on_progress=terminal)
        if self.audit:
            draw_audits(data, data.folder / "audit", terminal)
        show_labelling("Imported", data)
        show_trials(data)
        if data.left_out:
            print_table("Left out", ("trial", "why"), [(one.trial, one.why) for one in data.left_out])
            raise SystemExit(1)


def draw_audits(data: "Dataset", folder: Path, terminal: Terminal) -> None:
    """Draw the pages that are not there yet."""
    from sliplens.plots.audit import write_audits

    if write_audits(data, folder, on_progress=terminal):
        wrote(folder, "a page a trial: look at them before you train")


def show_trials(data: "Dataset") -> None:
    """Write the page of all trials."""
    from sliplens.report.trials import write_trials_page

    wrote(write_trials_page(data), "all trials at a glance: margins, friction, flags")


def show_labelling(title: str, data: "Dataset") -> None:
    """Show what the labels of each trial rest on, what was assumed, and which frames have none."""
    rows, notes, lost = [], [], {}
    for info in data.trials:
        labels = data.read_labels(info)
        counts = labels.count()
        kept = labels.labelling
        rows.append((info.trial, f"{counts.get('valid', 0)} of {info.frames}", *_basis(kept, counts)))
        if kept is not None:
            notes += kept.notes
        lost[info.trial] = Counter({reason: count for reason, count in counts.items() if reason != "valid"})
    print_table(title, ("trial", "valid", "mu", "lag, ms", "reference"), rows[:_MOST_ROWS])
    if len(rows) > _MOST_ROWS:
        say(f"  and {number_of(len(rows) - _MOST_ROWS, 'more trial')}, which the page of all trials shows")
        lost = {f"all {len(rows)} trials": sum(lost.values(), Counter())}
    for line in fold_equal(dict.fromkeys(notes)):
        say(f"  note: {line}")
    for what, counts in lost.items():
        why = ", ".join(f"{count:,} {reason}" for reason, count in counts.items())
        say(f"  {what}: frames without a valid label: {why or 'none'}")


def _basis(labelling: "Labelling | None", counts: dict[str, int]) -> Sequence[str]:
    """Friction, lag and reference, for people."""
    friction, lag, reference = "came with it" if counts.get("valid") else "-", "-", "its own"
    if labelling is not None and labelling.basis is not None:
        basis = labelling.basis
        mu, low, high = basis.friction.mu, basis.friction.low, basis.friction.high
        friction = f"{mu:.3f} given" if low == high else f"{mu:.3f} [{low:.3f}, {high:.3f}]"
        if basis.lag is not None:
            sure = f"{1e3 * basis.lag.lag_s:+.1f} +- {1e3 * basis.lag.sigma_s:.1f}"
            lag = ("unknown" if basis.lag.doubt else sure) + (" (applied)" if basis.lag_applied else "")
    if labelling is not None and labelling.reference.index is not None:
        reference = f"frame {labelling.reference.index}"
    return friction, lag, reference
