"""Evaluation of slip detection on labelled clips, beside trivial baselines."""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Shaped

from sliplens.codec import Columns, Result
from sliplens.errors import ImageError, InputError
from sliplens.live.reading import SlipState
from sliplens.live.slip import SlipDetector
from sliplens.markers import track_markers
from sliplens.progress import add_note, report_each
from sliplens.recordings.formats.tables import open_text_table, to_number
from sliplens.recordings.source import open_source

Flags: TypeAlias = Bool[np.ndarray, " clips"]
Groups: TypeAlias = Shaped[np.ndarray, " clips"]
_LABELS = ("slips", "slip", "slip_label", "label")
_DRAWS = 2000


@dataclass(frozen=True, kw_only=True)
class SlipScores(Columns):
    """Balanced accuracy of methods: mean of the shares of slipping and of holding clips that are classified rightly."""

    method: Shaped[np.ndarray, " methods"]
    balanced_accuracy: Float[np.ndarray, " methods"]
    low: Float[np.ndarray, " methods"]
    high: Float[np.ndarray, " methods"]
    """Ends of the 95 % interval, from drawing objects again, as shares."""


@dataclass(frozen=True, kw_only=True)
class SlipEvaluation(Result):
    """Scores of the detector and of baselines on labelled clips, and what the markers show in each clip."""

    scores: SlipScores
    detected: Flags
    """True for clips in which a frame up to the decision was classified as slip."""
    fall: Float[np.ndarray, " clips"]
    """Largest fall of the mean shear, as a share; 0 where no shear was seen."""
    displacement_px: Float[np.ndarray, " clips"]
    """Largest mean displacement of the markers, in pixels."""


def evaluate_slip(table: Path | str, *, after: int | None = None, markers: str = "auto") -> SlipEvaluation:
    """Evaluate slip detection on clips with labels.

    Each clip counts from its first frame, or its `start_frame`, as a grasp that is pressed already: no untouched frame
    is needed. Baselines that need a threshold get it from the clips of all other objects.

    Parameters
    ----------
    table
        Text table with a row for each clip: `file` (relative to the table), `slips` (1 or 0; `slip_label` and `label`
        do too), and where known `object`, `start_frame` (where the lift begins) and `width` of the gripper.
    after
        Frames after the start at which a clip is classified, from those before alone; its end if None.
    markers
        Kind of markers (docs/markers.md).

    Raises
    ------
    InputError
        If the table lacks a column or has an unknown value, or all clips have one label.

    See Also
    --------
    read_live : Detect slips on a running sensor.
    track : Measure the motion of the markers.

    Examples
    --------
    >>> import sliplens as sl
    >>> sl.evaluate_slip("lifts.csv", after=10).scores.method[:2].tolist()  # doctest: +SKIP
    ['detector', 'fall of the mean shear']
    """
    text = open_text_table(path := Path(table))
    label = next((name for name in _LABELS if name in text.header), "slips")
    if not {label, "file"} <= set(text.header):
        raise InputError(f"{table} needs the columns file and slips; it has {', '.join(text.header)}")
    lines = [(line, dict(zip(text.header, cells, strict=True))) for line, cells in text.rows]
    numbers = {
        name: np.array([to_number(row[name], table=text, line=line, column=name) for line, row in lines])
        for name in (label, "start_frame", "width")
        if name in text.header
    }
    slips, start = numbers[label] > 0, numbers.get("start_frame", np.zeros(len(lines))).astype(int)
    if slips.all() or not slips.any():
        raise InputError(f"the clips of {table} are all labelled alike; add clips that slip and clips that hold")
    if start.min() < 0:
        raise InputError(f"start_frame of {table} is {start.min()}; count the frames from 0")
    objects = np.array([row.get("object") or row["file"] for _, row in lines])
    clips = np.empty((len(lines), 4))
    for number, (_, row) in enumerate(report_each(lines)):
        chosen = slice(start[number], None if after is None else start[number] + after + 1)
        clips[number] = _read_clip(path.parent / row["file"], chosen, markers)
    detected, fall, displacement_px, frames = clips.T
    values = {"fall of the mean shear": fall, "largest displacement": displacement_px, "frame count": frames}
    if "width" in numbers:
        values["gripper width"] = numbers["width"]
    guesses = {"detector": detected > 0}
    guesses |= {name: threshold_left_out(value, slips, objects) for name, value in values.items()}
    accuracy, low, high = np.array([score_guesses(guess, slips, objects) for guess in guesses.values()]).T
    scores = SlipScores(method=np.array(list(guesses)), balanced_accuracy=accuracy, low=low, high=high)
    return SlipEvaluation(scores=scores, detected=guesses["detector"], fall=fall, displacement_px=displacement_px)


def _read_clip(path: Path, chosen: slice, markers: str) -> tuple[bool, float, float, int]:
    """Return whether a slip was detected, the largest fall and displacement, and the number of frames."""
    capture = open_source(path)[0]
    frames = list(islice(capture.read_frames(), chosen.start, chosen.stop))
    if not frames:
        raise InputError(f"{path} has {len(capture)} frames, too few for a start_frame of {chosen.start}")
    try:
        tracks = track_markers(frames, frames[0], markers)
    except ImageError as error:
        add_note(f"{path.name} counts as not slipping: {error}")
        return False, 0.0, 0.0, len(capture)
    detector, rate_hz = SlipDetector(tracks.rest_px), capture.frame_rate_hz
    readings = [detector.update(place_px, number / rate_hz) for number, place_px in enumerate(tracks.position_px)]
    moved = np.ma.masked_invalid(tracks.displacement_px).mean(axis=1).filled(0)
    detected, fall = SlipState.SLIP in [reading.state for reading in readings], max(it.fall or 0.0 for it in readings)
    return detected, fall, float(np.linalg.norm(moved, axis=1).max()), len(capture)


def threshold_left_out(values: Float[np.ndarray, " clips"], labels: Flags, groups: Groups) -> Flags:
    """Classify clips by a threshold on a value, chosen with its sign on the clips of all other groups."""
    guess = np.zeros(len(values), dtype=bool)
    for group in np.unique(groups):
        rest = groups != group
        levels = np.unique(values[rest])
        limits = np.concatenate([[-np.inf], (levels[1:] + levels[:-1]) / 2])
        above = np.array([_balanced(values[rest] > limit, labels[rest]) for limit in limits])
        best = int(np.abs(above - 0.5).argmax())
        guess[~rest] = (values[~rest] > limits[best]) == (above[best] >= 0.5)
    return guess


def score_guesses(guess: Flags, labels: Flags, groups: Groups) -> tuple[float, float, float]:
    """Compute the balanced accuracy of a method, and the ends of its interval over groups."""
    rng, rows = np.random.default_rng(0), [np.flatnonzero(groups == name) for name in np.unique(groups)]
    drawn = [np.concatenate([rows[at] for at in rng.integers(0, len(rows), len(rows))]) for _ in range(_DRAWS)]
    draws = [_balanced(guess[some], labels[some]) for some in drawn if 0 < labels[some].mean() < 1]
    low, high = np.quantile(draws or [0.0, 1.0], [0.025, 0.975]).tolist()
    return _balanced(guess, labels), low, high


def _balanced(guess: Flags, labels: Flags) -> float:
    """Compute the mean of the shares of both labels that are guessed rightly; 0.5 where one of them is missing."""
    both = labels.any() and not labels.all()
    return float((guess[labels].mean() + (~guess[~labels]).mean()) / 2) if both else 0.5
