"""Checks of a data set: its files against their hashes, its labels against their laws."""

from collections import Counter, deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from sliplens.errors import InputError, SliplensError
from sliplens.files import RUN_FILE, hash_file, read_json
from sliplens.progress import OnProgress, add_note, report_each, reporting
from sliplens.recordings.dataset import JOURNAL_FOLDER, Dataset, TrialInfo, load_dataset, report_flags, trial_path
from sliplens.recordings.labels.friction import LAW_SIGMAS, PRESSED_SHARE
from sliplens.recordings.store import forces_path, hash_frames, in_turn, load_recording, read_header, stream_frames
from sliplens.recordings.trial import SIGNALS, ContactState, Recording

# margins are stored in double precision; labels made in single precision may differ by this much from their forces
_ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True)
class Violation:
    """Law that a data set violates, or doubt about the labels of a trial."""

    where: str  #: The trial, or the file of the data set.
    what: str  #: Error, and the frame it is at; or the doubt.
    doubt: bool = False  #: True for a doubt: the data are whole, and the labels may be wrong.


def check_dataset(
    data: Dataset | Path | str,
    *,
    against: Dataset | Path | str | None = None,
    on_progress: OnProgress | None = None,
) -> tuple[Violation, ...]:
    """Read every trial of a data set, and list its errors, doubts, and those trials that another data set holds too.

    For each trial: its file exists, has the hash and the facts of the table, and every image can be decoded; margin,
    forces and contact states agree, and F_t / F_n stays within the friction by 3 sigma, before a slip and after it. For
    the data set: no trial is listed twice, no file is unlisted, and no recording was cut off. Doubts about labels are
    those of the import. Faults of the force sensor are notes: frames at a fault are not valid.

    Parameters
    ----------
    data
        Data set, or its folder.
    against
        Data set whose trials must be others, as those of a test. Trials are compared by frames, simulated ones by
        their seeds too. Days and sensors of both are notes.

    See Also
    --------
    recover_dataset : Recover the trials of an interrupted recording.
    label_dataset : Compute labels again.

    Examples
    --------
    >>> import sliplens as sl
    >>> data = sl.simulate(dry_trials=3, wet_trials=0, days=2, frames_per_trial=20)
    >>> sl.check_dataset(data), len(sl.check_dataset(data, against=data))
    ((), 3)
    """
    data = load_dataset(data)
    folder, violations = data.folder, []
    for trial, count in Counter(info.trial for info in data.trials).items():
        if count > 1:
            splits = sorted({info.split for info in data.trials if info.trial == trial})
            violations.append(Violation(where=trial, what=f"is listed {count} times, in split {' and '.join(splits)}"))
    listed = {trial_path(folder, info.trial) for info in data.trials}
    listed |= {forces_path(folder, info.trial) for info in data.trials if info.forces_sha256}
    unlisted = sorted({*(folder / "trials").glob("*"), *(folder / "forces").glob("*")} - listed)
    what = "is not in the table of the data set"
    violations += [Violation(where=str(path.relative_to(folder)), what=what) for path in unlisted]
    if (folder / JOURNAL_FOLDER).is_dir():
        violations.append(Violation(where=JOURNAL_FOLDER, what="still runs or was cut off; use sliplens recover"))
    # hashes and decoding release the interpreter's lock
    with reporting(on_progress):
        checked = in_turn(lambda info: tuple(_check_trial(folder, info)), data.trials)
        for info, errors in zip(report_each(data.trials), checked, strict=True):
            violations += [Violation(where=info.trial, what=error) for error in errors]
        report_flags(data)
        doubts = [(trial, doubt) for trial, sentences in data.doubts.items() for doubt in sentences]
        violations += [Violation(where=trial, what=doubt, doubt=True) for trial, doubt in doubts]
        violations += [] if against is None else _find_shared(data, load_dataset(against))
    return tuple(violations)


def _find_shared(data: Dataset, other: Dataset) -> list[Violation]:
    """List the trials that are in another data set too, and note the days and sensors of both."""
    seeds = [_read_seed(each) for each in (data, other)]
    seeds = seeds if all(seeds) else [(), ()]
    trials, circumstances = ([{}, {}] for _ in range(2))
    for place, each in enumerate((data, other)):
        for info in each.trials:
            # a simulated trial of the same seed is of the same touch, also where its frames are others
            names = [hash_frames(trial_path(each.folder, info.trial)), *([(*seeds[place], info.trial)] * any(seeds))]
            trials[place] |= dict.fromkeys(names, info.trial)
            for fact in (f"the sensor {info.sensor}", f"day {info.day} of {info.sensor}") if info.sensor else ():
                circumstances[place][*seeds[place], fact] = fact
    if both := [fact for key, fact in circumstances[0].items() if key in circumstances[1]]:
        add_note(f"{other.folder} has, too: {', '.join(both)}")
    shared = {name: trials[1][key] for key, name in trials[0].items() if key in trials[1]}
    return [Violation(where=name, what=f"is {same} of {other.folder}") for name, same in shared.items()]


def _read_seed(data: Dataset) -> tuple[object, ...]:
    """Return what the draws of a simulated data set follow from; nothing for others, or where its recipe is unknown."""
    with suppress(InputError, KeyError, TypeError):
        recipe = read_json(data.folder / RUN_FILE)["config"]["recipe"] if data.simulated else {}
        return recipe["seed"], recipe["series"]
    return ()


def _check_trial(folder: Path, info: TrialInfo) -> Iterator[str]:
    path = trial_path(folder, info.trial)
    if not path.is_file():
        yield "has no file"
        return
    if hash_file(path) != info.sha256:
        yield "has a file that is not the one the table was made for (its hash differs)"
    samples = forces_path(folder, info.trial)
    if info.forces_sha256 and (not samples.is_file() or hash_file(samples) != info.forces_sha256):
        yield "has samples of forces that are missing or changed since the table was made"
    try:
        header = read_header(path)
        recording = load_recording(path, pixels=header.truth is not None)
        if header.truth is None:
            deque(stream_frames(path), maxlen=0)  # each can be decoded; one at a time, however many there are
    except SliplensError as error:
        yield f"cannot be read: {error}"
        return
    for name, value in vars(info).items():
        if hasattr(header, name) and value != getattr(header, name):
            yield f"has {name} {getattr(header, name)}, the table says {value}"
    yield from _check_laws(recording)


def _check_laws(recording: Recording) -> Iterator[str]:
    margin, normal, labelled = recording.safety_margin, recording.normal_force_n, recording.labelled
    present = np.isfinite(margin)
    states = np.array([str(state) for state in recording.contact_state])
    slips, capacity = states == ContactState.FULL_SLIP, recording.friction_coefficient * normal
    pressing = present & (capacity > 0)
    expected = np.clip(1 - recording.tangential_force_n / np.where(pressing, capacity, 1), 0, 1)
    # after a slip the margin stays 0, also where the pull is let go
    let_go = slips & (recording.tangential_force_n == 0)
    # of a trial whose margins alone are known there are no forces; a force sensor's noise is negative at times, and its
    # samples may be missing, where there is no label
    measured = labelled & np.isfinite(normal).any()
    laws = {f"{name} is not a number": measured & ~np.isfinite(getattr(recording, name)) for name in SIGNALS[1:4]} | {
        "the time is not a number": ~np.isfinite(recording.time_s),
        "the normal force is negative; flip its sign on import": labelled & (normal < 0),
        "only one of margin and stick ratio has a label": np.isfinite(recording.stick_ratio) != present,
        "the safety margin is not 1 - F_t / (mu F_n)": pressing & ~let_go & (np.abs(margin - expected) > _ROUNDING),
        "a frame without contact has a safety margin": (states == ContactState.NO_CONTACT) & present,
        "full slip has a margin above 0": slips & present & (margin > 0),
    }
    for law, wrong in (laws | _check_friction(recording, slips=slips)).items():
        if wrong.any():
            count = f" ({int(wrong.sum())} frames)" if wrong.sum() > 1 else ""
            yield f"frame {int(np.argmax(wrong))}: {law}{count}"


def _check_friction(
    recording: Recording, *, slips: Bool[np.ndarray, " frames"]
) -> dict[str, Bool[np.ndarray, " frames"]]:
    """Find the frames whose F_t / F_n exceeds the static friction by more than 3 sigma, before a slip and after it."""
    normal, coefficient = recording.normal_force_n, recording.friction_coefficient
    pressed = normal > PRESSED_SHARE * np.nanmax(normal, initial=0.0)
    ratio = np.where(pressed, recording.tangential_force_n / np.where(pressed, normal, 1), np.nan)
    sigma = np.zeros(len(normal)) if recording.safety_margin_sigma is None else recording.safety_margin_sigma
    basis = recording.labelling.basis if recording.labelling else None
    # of the margin, and so of the ratio as a share of the friction: at the slip, where all of it is used, no less
    sigma = np.maximum(np.nan_to_num(sigma), basis.friction.sigma / basis.friction.mu if basis else 0.0)
    # the last frame before a slip has the friction that holds until then
    last = np.maximum.accumulate(np.where(recording.labelled & ~slips, np.arange(len(normal)), -1))
    most = (coefficient * (1 + LAW_SIGMAS * sigma))[last] + _ROUNDING
    beyond = (last >= 0) & (ratio > most)
    # exact labels may have a friction that changes from frame to frame: until the slip it may have grown
    estimated = recording.safety_margin_sigma is not None
    after = beyond & slips & np.isfinite(recording.safety_margin) & estimated
    laws = {}
    for wrong, when in ((beyond & ~slips & recording.labelled, "before a slip"), (after, "after a slip")):
        at = int(np.argmax(wrong))
        allowed = f"the friction {coefficient[last[at]]:.2f} and 3 sigma allow {most[at]:.2f}"
        laws[f"F_t / F_n is {ratio[at]:.2f} {when}, and {allowed}; label the trial again"] = wrong
    return laws
