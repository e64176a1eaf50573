"""What `sliplens import` and `sliplens label` share: options, the trials one by one, and what was found."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sliplens.cli.console import print_table, progress_bar, say
from sliplens.errors import RecordingError

if TYPE_CHECKING:
    from sliplens.recordings.capture import Capture
    from sliplens.recordings.importing import About
    from sliplens.recordings.labels import LabelSettings


@dataclass(frozen=True, kw_only=True)
class LabelOptions:
    """How labels are found from forces."""

    mu: float | None = None
    """Static coefficient of friction, if you know it; estimated at the onset of slip otherwise."""
    friction_change: float = 0.0
    """Relative standard deviation by which friction may change from touch to slip; on wet objects some 0.1 to 0.2. It
    widens the uncertainty."""
    tare: tuple[float, float, float] | None = None
    """What the force sensor reads untouched (x y z), in newtons; found if not given."""
    lag_ms: float | None = None
    """By how much the camera's clock is late, if you know it; it is then applied."""
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
    """How to choose the untouched frame among those before the contact, where the source does not tell it."""
    reference_frame: int | None = None
    """Number of the untouched frame, by hand."""
    audit: bool = True
    """Draw a page for each trial, in `audit/` of the folder, from which to judge its labels."""
    seed: int = 0
    """Seed of the bootstraps behind the uncertainties."""

    def settings(self) -> "LabelSettings":
        """Settings as the library takes them."""
        from sliplens.recordings.labels import LabelSettings, given_friction, given_lag

        return LabelSettings(
            normal=self.normal_axis,
            sign=self.normal_sign,
            tare_n=self.tare,
            lag=None if self.lag_ms is None else given_lag(self.lag_ms / 1e3),
            friction=None if self.mu is None else given_friction(self.mu),
            friction_change=self.friction_change,
            apply_lag=self.apply_lag or self.lag_ms is not None,
            contact_threshold_n=self.contact_threshold,
            force_range_n=self.force_range,
        )


def write_trials(
    folder: Path,
    captures: "Sequence[Capture]",
    abouts: "Sequence[About]",
    splits: Sequence[str],
    options: LabelOptions,
    *,
    title: str = "Importing frames",
) -> dict[str, dict[str, Any]]:
    """Write the trials of a data set that are not there yet; give what the labels of each rest on."""
    import numpy as np

    from sliplens.recordings.capture import forces_path
    from sliplens.recordings.dataset import trial_info, trial_path, write_dataset_table
    from sliplens.recordings.importing import import_trial
    from sliplens.recordings.store import read_labelling

    found, table, done = {}, [], 0
    settings = options.settings()
    total = sum(len(capture.frame_time_s) for capture in captures)
    with progress_bar(title) as bar:
        for number, (capture, about, split) in enumerate(zip(captures, abouts, splits, strict=True)):
            path = trial_path(folder, capture.name)
            # a trial is there whole or not at all, and the folder is of this very command
            if not path.is_file():
                import_trial(
                    capture,
                    path,
                    about=about,
                    settings=settings,
                    rng=np.random.default_rng((options.seed, number)),
                    forces_path=forces_path(folder, capture.name),
                    reference_index=options.reference_frame,
                    reference_method=options.reference,
                    on_frames=lambda written, _, before=done: bar(before + written, total),
                )
            done += len(capture.frame_time_s)
            bar(done, total)
            found[capture.name] = read_labelling(path) or {}
            table.append(trial_info(path, split=split))
            if options.audit:
                draw_audit_page(path, folder / "audit" / f"{capture.name}.png", found[capture.name])
    if not table:
        raise RecordingError("there is no trial to import; name a recording")
    write_dataset_table(folder, table, simulated=all(capture.told.simulated for capture in captures))
    return found


def draw_audit_page(trial: Path, picture: Path, labelling: dict[str, Any]) -> None:
    """Draw the page of a trial from which to judge its labels."""
    from sliplens.plots.audit import write_audit
    from sliplens.recordings.store import load_recording, read_frames

    # all numbers, but only the pixels that the page shows: memory stays small however long the trial
    write_audit(load_recording(trial, pixels=False), labelling, picture, read_frames=partial(read_frames, trial))


def show_found(title: str, found: dict[str, dict[str, Any]]) -> None:
    """Show what the labels of each trial rest on, and what was assumed."""
    header = ("trial", "frames", "valid", "mu", "lag, ms", "reference")
    print_table(title, header, [_row(name, told) for name, told in found.items()])
    notes = [note for told in found.values() for note in (*told["notes"], *(told["axes"] or {}).get("notes", ()))]
    for note in dict.fromkeys(notes):
        say(f"  note: {note}")
    for name, told in found.items():
        lost = {reason: count for reason, count in told["frames_by_reason"].items() if reason != "valid"}
        why = ", ".join(f"{count} {reason}" for reason, count in lost.items()) or "none"
        say(f"  {name}: frames without a valid label: {why}")


def summary(found: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """What `result.json` tells of each trial."""
    return [
        {
            "trial": name,
            "source": told["source"],
            "frames_by_reason": told["frames_by_reason"],
            "friction": (told["friction"] or {}).get("mu"),
            "reference_frame": told["reference"]["index"],
        }
        for name, told in found.items()
    ]


def _row(name: str, told: dict[str, Any]) -> tuple[str, ...]:
    friction, lag, reference = told["friction"], told["lag"], told["reference"]
    told_friction = "came with it" if told["frames_by_reason"].get("valid") else "-"
    if friction is not None:
        told_friction = f"{friction['mu']:.3f} [{friction['low']:.3f}, {friction['high']:.3f}] {friction['found']}"
    told_lag = "-"
    if lag is not None:
        told_lag = "not told" if lag["doubt"] else f"{1e3 * lag['lag_s']:+.1f} +- {1e3 * lag['sigma_s']:.1f}"
        told_lag += " (applied)" if told["lag_applied"] else ""
    drift = "not told" if reference["drift"] is None else f"{reference['drift']:.1f}"
    told_reference = "its own" if reference["index"] is None else f"frame {reference['index']}, drift {drift}"
    return (
        name,
        str(sum(told["frames_by_reason"].values())),
        str(told["frames_by_reason"].get("valid", 0)),
        told_friction,
        told_lag,
        told_reference,
    )
