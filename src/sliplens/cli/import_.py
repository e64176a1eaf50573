"""`sliplens import`."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sliplens.cli.console import OUT, say, unchanged, wrote
from sliplens.cli.labelling import LabelOptions, show_found, summary, write_trials
from sliplens.errors import InputError
from sliplens.files import output_folder, write_json

if TYPE_CHECKING:
    from sliplens.recordings.capture import Capture
    from sliplens.recordings.importing import About
    from sliplens.recordings.splits import SplitPlan


@dataclass(frozen=True, kw_only=True)
class Import:
    """Import recordings of your own sensor and label every frame with its safety margin.

    Reads ROS 2 bags (no ROS needed), LeRobot v3 data sets, videos and folders of images beside a table of forces. Tare,
    axes, sign, lag and friction are found from the trial itself unless you give them, and shown. A trial must touch,
    and slip at its end; for one that never slips give --mu. What brings its own labels keeps them: data sets of
    sliplens, the lists of the thesis.
    """

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Recordings: one trial each, or all episodes of a LeRobot data set."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """Folder to make: a data set for `sliplens train`."""
    sensor: str | None = None
    """Name of the sensor; a network is trained for one. Needed unless the source tells it."""
    condition: str | None = None
    """State of the surface, such as dry or wet; as the source tells, else dry."""
    day: int | None = None
    """Day of the recording, counted from 1; as the source tells, else 1."""
    object: str | None = None
    """What was held; as the source tells, else nothing."""
    validation_trials: int | None = None
    """So many of the last trials, before those that test, validate the training."""
    test_trials: int | None = None
    """So many of the last trials test; all others train. Trials are never split."""
    splits: Path | None = None
    """File of rules that deal the trials to splits (TOML; see docs/splits.md), in place of the two numbers above."""
    format: str | None = None
    """rosbag, lerobot, sliplens, thesis, gelsight, images or video; recognised if not given."""
    forces: Path | None = None
    """Table of forces beside a video or folder of images (CSV)."""
    time_column: str | None = None
    """Column of the table with the times; guessed if not given."""
    force_columns: tuple[str, ...] | None = None
    """Columns with the forces, three (x y z) or two (tangential and normal); guessed if not given."""
    time_unit: str | None = None
    """s, ms, us or ns; guessed if not given."""
    force_unit: str | None = None
    """N, mN, gf or kgf; guessed if not given."""
    frame_rate: float | None = None
    """Frames a second, where a video's stamps are missing or wrong."""
    times: Path | None = None
    """Table with the name and the time of every image of a folder (CSV)."""
    name_unit: str | None = None
    """Unit (s, ms, us, ns) of the last number in the names of images, which is then their time."""
    skip_frames: int | None = None
    """So many frames at the start of a video are left out."""
    skip_stale: bool = False
    """Leave out the dark or frozen frames that a camera hands out when it was just started."""
    start_s: float | None = None
    """When the first frame was taken, on the clock of the forces."""
    image_topic: str | None = None
    """Topic of the images; the only one if not given."""
    wrench_topic: str | None = None
    """Topic of the forces; the only one if not given."""
    camera_key: str | None = None
    """Feature of a LeRobot data set with the images."""
    force_key: str | None = None
    """Feature of a LeRobot data set with the forces."""
    image_root: Path | None = None
    """Folder under which the images that a list names lie now."""
    margin_unit: Literal["fraction", "percent"] | None = None
    """Unit of a list's safety margins; told by their size if not given."""
    labels: Annotated[LabelOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=LabelOptions)
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Read, label, write, and show what was found."""
        from sliplens.recordings.splits import TrialFacts, assign_splits, write_split_record

        captures = self._open()
        abouts = [self._about(capture) for capture in captures]
        plan = self._plan()
        facts = [
            TrialFacts(
                trial=one.name, sensor=about.sensor, day=about.day, condition=about.condition, object=about.object
            )
            for one, about in zip(captures, abouts, strict=True)
        ]
        dealt = None if plan is None else assign_splits(plan, facts)
        splits = self._deal(captures) if dealt is None else dealt.splits
        own = {"output", "overwrite", "sources", "labels", "forces", "times"}
        config = {
            **{name: value for name, value in vars(self).items() if name not in own},
            **vars(self.labels),
            "sources": [_fingerprint(path) for path in self.sources],
            **{
                name: None if path is None else _fingerprint(path)
                for name, path in (("forces", self.forces), ("times", self.times))
            },
            "splits": None if plan is None else [rule.as_table() for rule in plan.rules],
        }
        with output_folder(self.output, stage="import", config=config, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            found = write_trials(out.folder, captures, abouts, splits, self.labels)
            write_json(out.folder / "result.json", {"trials": summary(found)})
            if plan is not None and dealt is not None:
                write_split_record(out.folder, plan, facts, dealt)
        show_found("Imported", found)
        for note in dealt.notes if dealt else ():
            say(f"  note: {note}")
        frames = sum(len(capture.frame_time_s) for capture in captures)
        wrote(self.output, f"{len(captures)} trials, {frames:,} frames")
        if self.labels.audit:
            wrote(self.output / "audit", "a page a trial: look at them before you train")

    def _open(self) -> "list[Capture]":
        from sliplens.recordings.formats import ReadOptions, open_captures

        options = ReadOptions(
            forces=self.forces,
            frame_rate=self.frame_rate,
            times=self.times,
            name_unit=self.name_unit,
            skip_frames=self.skip_frames,
            skip_stale=self.skip_stale or None,
            start_s=self.start_s,
            time_column=self.time_column,
            force_columns=self.force_columns,
            time_unit=self.time_unit,
            force_unit=self.force_unit,
            image_topic=self.image_topic,
            wrench_topic=self.wrench_topic,
            camera_key=self.camera_key,
            force_key=self.force_key,
            image_root=self.image_root,
            margin_unit=self.margin_unit,
        )
        if self.forces is not None and len(self.sources) > 1:
            raise InputError("one table of forces goes with one recording; import the trials one by one")
        with OUT.status("Opening the recordings"):
            captures = [
                one for path in self.sources for one in open_captures(path, format=self.format, options=options)
            ]
        twice = [name for name, count in Counter(one.name for one in captures).items() if count > 1]
        if twice:
            raise InputError(f"several recordings are named {', '.join(twice)}; rename their files")
        return captures

    def _about(self, capture: "Capture") -> "About":
        """What a trial is: as said on the command line, else as its source tells."""
        from sliplens.recordings.importing import About

        told = capture.told
        sensor = self.sensor or told.sensor
        if not sensor:
            raise InputError(f"{capture.source} does not tell its sensor, and a network is of one; add --sensor")
        return About(
            sensor=sensor,
            day=self.day if self.day is not None else told.day if told.day is not None else 1,
            condition=self.condition or told.condition or "dry",
            object=self.object or told.object or "",
        )

    def _plan(self) -> "SplitPlan | None":
        from sliplens.recordings.splits import read_splits

        if self.splits is None:
            return None
        if self.validation_trials is not None or self.test_trials is not None:
            raise InputError("splits come from a file or from numbers of trials, not from both; leave one out")
        return read_splits(self.splits)

    def _deal(self, captures: "list[Capture]") -> list[str]:
        count = len(captures)
        if self.validation_trials is None and self.test_trials is None:
            return [capture.told.split or "train" for capture in captures]
        validation, test = self.validation_trials or 0, self.test_trials or 0
        if validation < 0 or test < 0:
            raise InputError("numbers of trials are not negative; give 0 or more")
        training = count - validation - test
        if training < 0:
            raise InputError(
                f"{validation} trials to validate and {test} to test are more than the {count} there are; give fewer"
            )
        return ["train"] * training + ["validation"] * validation + ["test"] * test


def _fingerprint(path: Path) -> list[object]:
    """What tells a file that changed from one that did not, without reading all of it."""
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path")
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    stats = [file.stat() for file in files]
    return [
        str(path.resolve()),
        sum(stat.st_size for stat in stats),
        max((stat.st_mtime_ns for stat in stats), default=0),
    ]
