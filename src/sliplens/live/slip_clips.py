"""Evaluation of slip detection on labelled clips, beside trivial baselines."""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Shaped

from sliplens.errors import ImageError, InputError
from sliplens.live.reading import SlipState
from sliplens.live.slip import SlipDetector
from sliplens.markers import Tracker
from sliplens.progress import OnProgress, add_note, report_progress, reporting
from sliplens.recordings.formats.tables import open_text_table
from sliplens.recordings.source import open_source

_LABELS = ("slips", "slip", "slip_label", "label")
_YES, _NO = {"1", "true", "yes", "slip", "slips"}, {"0", "false", "no", "hold", "holds"}
_DRAWS = 2000


@dataclass(frozen=True, kw_only=True)
class SlipScore:
    """Balanced accuracy of a method: mean of the shares of slipping and of holding clips that it classifies rightly."""

    method: str
    balanced_accuracy: float
    low: float
    high: float
    """Ends of the 95 % interval, from drawing objects again, as shares."""


@dataclass(frozen=True, kw_only=True)
class ClipReading:
    """Slip of one clip: its label, and the detector's states."""

    clip: str
    object: str
    slips: bool
    detected: bool
    """True where a frame up to the decision was read as slip."""
    fall: float
    """Largest fall of the mean shear so far, as a share; 0 where no shear was seen."""
    displacement_px: float
    """Largest mean displacement of the markers, in pixels."""
    frames: int


@dataclass(frozen=True, kw_only=True)
class SlipEvaluation:
    """Scores of the detector and of baselines on labelled clips, and the reading of each clip."""

    scores: tuple[SlipScore, ...]
    clips: tuple[ClipReading, ...]


def evaluate_slip(
    table: Path | str,
    *,
    after: int | None = None,
    markers: str = "auto",
    frame_rate_hz: float = 30.0,
    on_progress: OnProgress | None = None,
) -> SlipEvaluation:
    """Evaluate slip detection on clips with labels.

    Each clip is read from its first frame, or its `start_frame`, as a grasp that is pressed already: no untouched frame
    is needed. Baselines that need a threshold get it from the clips of all other objects.

    Parameters
    ----------
    table
        Text table with a row for each clip: `file` (relative to the table), `slips` (1 or 0; `slip_label` and `label`
        do too), and where known `object`, `start_frame` (where the lift begins) and `width` of the gripper.
    after
        Frames after the start at which a clip is classified, from those before alone; its end if None.
    markers
        Row of `KINDS`.
    frame_rate_hz
        Frames a second of clips without times.

    Returns
    -------
    SlipEvaluation
        Balanced accuracy of the detector, of the fall of the mean shear, frame count, largest displacement and width.

    Raises
    ------
    InputError
        If the table lacks a column or has an unknown label, or all clips have one label.

    Examples
    --------
    >>> import sliplens as sl
    >>> scores = sl.evaluate_slip("lifts.csv", after=10).scores  # doctest: +SKIP
    """
    path = Path(table)
    text = open_text_table(path)
    rows = [dict(zip(text.header, cells, strict=True)) for _, cells in text.rows]
    label = next((name for name in _LABELS if name in text.header), None)
    if label is None or "file" not in text.header:
        raise InputError(f"{path} needs the columns file and slips; it has {', '.join(text.header)}")
    for number, row in enumerate(rows, 1):
        if row[label].strip().lower() not in _YES | _NO:
            raise InputError(f"{path}, row {number}: the label is {row[label]!r}; write 1 for slip or 0")
    slips = np.array([row[label].strip().lower() in _YES for row in rows])
    if slips.all() or not slips.any():
        raise InputError(f"the clips of {path} are all labelled alike; add clips that slip and clips that hold")
    clips = []
    with reporting(on_progress):
        for number, row in enumerate(rows):
            report_progress(number, len(rows))
            start = int(_number(row.get("start_frame") or "0", "start_frame", where=f"{path}, row {number + 1}"))
            clips.append(
                _read_clip(
                    path.parent / row["file"],
                    row.get("object") or row["file"],
                    slips=bool(slips[number]),
                    frames=slice(start, None if after is None else start + after + 1),
                    markers=markers,
                    frame_rate_hz=frame_rate_hz,
                )
            )
        report_progress(len(rows), len(rows))
    objects = np.array([clip.object for clip in clips])
    values = {
        "fall of the mean shear": [clip.fall for clip in clips],
        "largest displacement": [clip.displacement_px for clip in clips],
        "frame count": [clip.frames for clip in clips],
    }
    if "width" in text.header:
        values["gripper width"] = [
            _number(row["width"], "width", where=f"{path}, row {number}") for number, row in enumerate(rows, 1)
        ]
    detected = {"detector": np.array([clip.detected for clip in clips])}
    fitted = {name: leave_out(np.array(of, dtype=float), slips, objects) for name, of in values.items()}
    scores = (_score(name, guess, slips, objects) for name, guess in (detected | fitted).items())
    return SlipEvaluation(scores=tuple(scores), clips=tuple(clips))


def _number(text: str, column: str, *, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not 0 <= value < np.inf:
        raise InputError(f"{where}: {column} is {text!r}; write a number of 0 or more")
    return value


def _read_clip(
    path: Path, object: str, *, slips: bool, frames: slice, markers: str, frame_rate_hz: float
) -> ClipReading:
    capture = open_source(path)[0]
    time_s = np.arange(len(capture)) / frame_rate_hz if capture.time_s is None else capture.time_s
    detected, fall, largest_px = False, 0.0, 0.0
    try:
        images = islice(capture.read_frames(), frames.start, frames.stop)
        first = next(images, None)
        if first is None:
            raise InputError(f"{path} has {len(capture)} frames, fewer than its start_frame {frames.start}")
        tracker = Tracker(first, markers)
        detector = SlipDetector(tracker.rest.centre_px)
        for number, image in enumerate([first, *images], frames.start):
            tracked = tracker.update(image)
            reading = detector.update(tracked.position_px, float(time_s[number]))
            seen = np.isfinite(tracked.motion_px[:, 0])
            if seen.any():
                largest_px = max(largest_px, float(np.linalg.norm(tracked.motion_px[seen].mean(axis=0))))
            detected |= reading.state is SlipState.SLIP
            fall = max(fall, reading.fall or 0.0)
    except ImageError as error:
        add_note(f"{path.name} counts as not slipping: {error}")
    return ClipReading(
        clip=path.name,
        object=object,
        slips=slips,
        detected=detected,
        fall=fall,
        displacement_px=largest_px,
        frames=len(capture),
    )


def leave_out(
    values: Float[np.ndarray, " clips"], labels: Bool[np.ndarray, " clips"], groups: Shaped[np.ndarray, " clips"]
) -> Bool[np.ndarray, " clips"]:
    """Classify clips by a threshold on a value, chosen with its sign on the clips of all other groups."""
    guess = np.zeros(len(values), dtype=bool)
    for group in np.unique(groups):
        rest = groups != group
        levels = np.unique(values[rest])
        limits = np.concatenate([[-np.inf], (levels[1:] + levels[:-1]) / 2, [np.inf]])
        above = np.array([balanced_accuracy(values[rest] > limit, labels[rest]) for limit in limits])
        at = int(np.abs(above - 0.5).argmax())
        guess[~rest] = (values[~rest] > limits[at]) == (above[at] >= 0.5)
    return guess


def balanced_accuracy(guess: Bool[np.ndarray, " clips"], labels: Bool[np.ndarray, " clips"]) -> float:
    """Compute the mean of the shares of both labels that are guessed rightly; 0.5 where one of them is missing."""
    if labels.all() or not labels.any():
        return 0.5
    return float((guess[labels].mean() + (~guess[~labels]).mean()) / 2)


def _score(
    method: str,
    guess: Bool[np.ndarray, " clips"],
    labels: Bool[np.ndarray, " clips"],
    groups: Shaped[np.ndarray, " clips"],
) -> SlipScore:
    rng, names = np.random.default_rng(0), np.unique(groups)
    rows = [np.flatnonzero(groups == name) for name in names]
    draws = []
    for _ in range(_DRAWS):
        drawn = np.concatenate([rows[at] for at in rng.integers(0, len(rows), len(rows))])
        if 0 < labels[drawn].mean() < 1:
            draws.append(balanced_accuracy(guess[drawn], labels[drawn]))
    low, high = np.quantile(draws or [0.0, 1.0], [0.025, 0.975]).tolist()
    return SlipScore(method=method, balanced_accuracy=balanced_accuracy(guess, labels), low=low, high=high)


__all__ = ["ClipReading", "SlipEvaluation", "SlipScore", "balanced_accuracy", "evaluate_slip", "leave_out"]
