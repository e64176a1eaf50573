"""`sliplens import`."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sliplens.cli.console import OUT, print_table, progress_bar, say, unchanged, wrote
from sliplens.errors import InputError, RecordingError
from sliplens.provenance import output_folder, write_json

_AUDITED_FRAMES = 800

if TYPE_CHECKING:
    from sliplens.recordings.capture import Capture
    from sliplens.recordings.labels import LabelSettings


@dataclass(frozen=True, kw_only=True)
class Import:
    """Import recordings of your own sensor and label every frame with its safety margin.

    Reads ROS 2 bags (no ROS needed), LeRobot v3 data sets, videos and folders of images beside a table of forces. Tare,
    axes, sign, lag and friction are found from the trial itself unless you give them, and shown. A trial must touch,
    and slip at its end; for one that never slips give --mu.
    """

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Recordings: one trial each, or all episodes of a LeRobot data set."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """Folder to make: a data set for `sliplens train`."""
    sensor: str
    """Name of the sensor; a network is trained for one."""
    condition: str = "dry"
    """State of the surface, such as dry or wet."""
    day: int = 1
    """Day of the recording, counted from 1."""
    validation_trials: int = 0
    """So many of the last trials, before those that test, validate the training."""
    test_trials: int = 0
    """So many of the last trials test; all others train. Trials are never split."""
    format: str | None = None
    """rosbag, lerobot, images or video; recognised if not given."""
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
    mu: float | None = None
    """Static coefficient of friction, if you know it; estimated at the onset of slip otherwise."""
    friction_change: float = 0.0
    """Relative standard deviation by which friction may change from touch to slip; on wet objects some 0.1 to 0.2. It
    widens the uncertainty."""
    apply_lag: bool = False
    """Shift the forces by the lag that was found between camera and force sensor; it is always shown."""
    normal_axis: Literal["x", "y", "z"] | None = None
    """Axis of the force sensor that presses; found if not given."""
    normal_sign: Literal[1, -1] | None = None
    """1 if pressing is positive as recorded, -1 if negative; found if not given."""
    contact_threshold: float | None = None
    """Least normal force of a contact, in newtons; chosen from the noise if not given."""
    force_range: float | None = None
    """What each axis of the force sensor can measure, in newtons; frames beyond are not valid."""
    reference: Literal["least contact energy", "first still"] = "least contact energy"
    """How to choose the untouched frame among those before the contact."""
    reference_frame: int | None = None
    """Number of the untouched frame, by hand."""
    audit: bool = True
    """Draw a page for each trial, in `audit/` of the folder, from which to judge its labels."""
    seed: int = 0
    """Seed of the bootstraps behind the uncertainties."""
    overwrite: bool = False
    """Replace the folder if it exists."""

    def run(self) -> None:
        """Read, label, write, and show what was found."""
        captures = self._open()
        splits = self._deal(len(captures))
        settings = self._settings()
        config = {
            **{name: value for name, value in vars(self).items() if name not in {"output", "overwrite", "sources"}},
            "sources": [_fingerprint(path) for path in self.sources],
            "forces": None if self.forces is None else _fingerprint(self.forces),
        }
        with output_folder(self.output, stage="import", config=config, overwrite=self.overwrite) as out:
            if out.complete:
                unchanged(self.output)
                return
            found = self._import(out.folder, captures, splits, settings)
            write_json(out.folder / "result.json", {"trials": [_told(name, told) for name, told in found.items()]})
        header = ("trial", "frames", "valid", "mu", "lag, ms", "reference")
        print_table("Imported", header, [_row(name, told) for name, told in found.items()])
        for note in dict.fromkeys(note for told in found.values() for note in (*told["notes"], *told["axes"]["notes"])):
            say(f"  note: {note}")
        for name, told in found.items():
            lost = {reason: count for reason, count in told["frames_by_reason"].items() if reason != "valid"}
            why = ", ".join(f"{count} {reason}" for reason, count in lost.items()) or "none"
            say(f"  {name}: frames without a valid label: {why}")
        frames = sum(len(capture.frame_time_s) for capture in captures)
        wrote(self.output, f"{len(captures)} trials, {frames:,} frames")
        if self.audit:
            wrote(self.output / "audit", "a page a trial: look at them before you train")

    def _open(self) -> "list[Capture]":
        from sliplens.recordings.readers import ReadOptions, open_captures

        options = ReadOptions(
            forces=self.forces,
            frame_rate=self.frame_rate,
            start_s=self.start_s,
            time_column=self.time_column,
            force_columns=self.force_columns,
            time_unit=self.time_unit,
            force_unit=self.force_unit,
            image_topic=self.image_topic,
            wrench_topic=self.wrench_topic,
            camera_key=self.camera_key,
            force_key=self.force_key,
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

    def _deal(self, count: int) -> list[str]:
        if self.validation_trials < 0 or self.test_trials < 0:
            raise InputError("numbers of trials are not negative; give 0 or more")
        training = count - self.validation_trials - self.test_trials
        if training < 0:
            raise InputError(
                f"{self.validation_trials} trials to validate and {self.test_trials} to test are more than the {count} "
                "there are; give fewer"
            )
        return ["train"] * training + ["validation"] * self.validation_trials + ["test"] * self.test_trials

    def _settings(self) -> "LabelSettings":
        from sliplens.recordings.labels import LabelSettings, given_friction

        return LabelSettings(
            normal=self.normal_axis,
            sign=self.normal_sign,
            friction=None if self.mu is None else given_friction(self.mu),
            friction_change=self.friction_change,
            apply_lag=self.apply_lag,
            contact_threshold_n=self.contact_threshold,
            force_range_n=self.force_range,
        )

    def _import(
        self, folder: Path, captures: "list[Capture]", splits: list[str], settings: "LabelSettings"
    ) -> dict[str, dict[str, Any]]:
        """Write the trials that are not there yet; give what the labels of each rest on."""
        import numpy as np

        from sliplens.recordings.dataset import trial_info, trial_path, write_dataset_table
        from sliplens.recordings.headers import read_labelling
        from sliplens.recordings.importing import About, import_trial

        about = About(sensor=self.sensor, day=self.day, condition=self.condition)
        found, table, done = {}, [], 0
        total = sum(len(capture.frame_time_s) for capture in captures)
        with progress_bar("Importing frames") as bar:
            for number, (capture, split) in enumerate(zip(captures, splits, strict=True)):
                path = trial_path(folder, capture.name)
                # a trial is there whole or not at all, and the folder is of this very import
                if not path.is_file():
                    import_trial(
                        capture,
                        path,
                        about=about,
                        settings=settings,
                        rng=np.random.default_rng((self.seed, number)),
                        reference_index=self.reference_frame,
                        reference_method=self.reference,
                        on_frames=lambda written, _, before=done: bar(before + written, total),
                    )
                done += len(capture.frame_time_s)
                bar(done, total)
                found[capture.name] = read_labelling(path) or {}
                table.append(trial_info(path, split=split))
                if self.audit:
                    _draw_audit(path, folder / "audit" / f"{capture.name}.png", found[capture.name])
        if not table:
            raise RecordingError("there is no trial to import; name a recording")
        write_dataset_table(folder, table)
        return found


def _draw_audit(trial: Path, picture: Path, labelling: dict[str, Any]) -> None:
    from sliplens.recordings.store import load_recording
    from sliplens.report.audit import write_audit

    # a page shows no more than this of a long trial, and memory stays small
    frames = sum(labelling["frames_by_reason"].values())
    write_audit(load_recording(trial, every=max(1, frames // _AUDITED_FRAMES)), labelling, picture)


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


def _row(name: str, told: dict[str, Any]) -> tuple[str, ...]:
    friction, lag, reference = told["friction"], told["lag"], told["reference"]
    told_lag = "-"
    if lag is not None:
        told_lag = "not told" if lag["doubt"] else f"{1e3 * lag['lag_s']:+.1f} +- {1e3 * lag['sigma_s']:.1f}"
        told_lag += " (applied)" if told["lag_applied"] else ""
    drift = "not told" if reference["drift"] is None else f"{reference['drift']:.1f}"
    return (
        name,
        str(sum(told["frames_by_reason"].values())),
        str(told["frames_by_reason"].get("valid", 0)),
        f"{friction['mu']:.3f} [{friction['low']:.3f}, {friction['high']:.3f}] {friction['found']}",
        told_lag,
        f"frame {reference['index']}, drift {drift}",
    )


def _told(name: str, told: dict[str, Any]) -> dict[str, Any]:
    return {
        "trial": name,
        "source": told["source"],
        "frames_by_reason": told["frames_by_reason"],
        "friction": told["friction"]["mu"],
        "reference_frame": told["reference"]["index"],
    }
