"""The page of a data set: every trial with its pictures, margins, friction and flags."""

from base64 import b64encode
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from sliplens.plots.style import UNKNOWN, decimals, percent
from sliplens.progress import number_of
from sliplens.recordings.capture import Frame
from sliplens.recordings.dataset import Dataset, TrialInfo, load_dataset, trial_path
from sliplens.recordings.store import load_recording, read_frames
from sliplens.recordings.trial import Recording
from sliplens.report.page import render_page, write_page

PAGE = "trials.html"
_THUMBNAIL_PX = 72
_CURVE = 160, 44  # of the picture's own units
_POINTS = 80


@dataclass(frozen=True, kw_only=True)
class _Row:
    """A trial on the page: texts, and the numbers that it is sorted by (NaN sorts last)."""

    info: TrialInfo
    pictures: tuple[str, ...]
    """The untouched sensor, and the frame of the least margin, as data addresses."""
    curves: tuple[str, ...]
    """Points of the margins' runs, as SVG takes them."""
    valid: int
    margin: str
    least: float
    friction: str
    mu: float
    flags: tuple[str, ...]
    lost: str


def write_trials_page(data: Dataset | Path | str, out: Path | str | None = None) -> Path:
    """Write the summary of a data set's trials as one self-contained HTML page; gives its path.

    Each trial has a row: the untouched sensor and the frame of the least margin, the margin against time, its range,
    friction with its interval, the share of frames with a valid label, and what puts the labels in doubt. Columns are
    sorted by a click on their heads; recordings that were left out are listed with the reason.

    Parameters
    ----------
    data
        Data set, or its folder.
    out
        HTML file to write; `trials.html` in the data set if None.

    Raises
    ------
    InputError
        If the data set is missing or damaged.
    """
    data = data if isinstance(data, Dataset) else load_dataset(data)
    page = data.folder / PAGE if out is None else Path(out)
    text = render_page(
        "trials.html.j2",
        script="trials.js",
        name=data.folder.resolve().name,
        rows=[_row(data, info) for info in data.trials],
        objects=any(info.object for info in data.trials),
        left_out=data.left_out,
        counts=f"{number_of(len(data.trials), 'trial')}, {number_of(data.frames, 'frame')}",
        curve=_CURVE,
    )
    write_page(page, text)
    return page


def _row(data: Dataset, info: TrialInfo) -> _Row:
    path = trial_path(data.folder, info.trial)
    trial = load_recording(path, pixels=False)
    margin = np.where(trial.labelled, trial.safety_margin, np.nan)
    labelled = bool(np.isfinite(margin).any())
    least, most = (float(np.nanmin(margin)), float(np.nanmax(margin))) if labelled else (np.nan, np.nan)
    frame = int(np.nanargmin(margin)) if labelled else len(margin) // 2
    basis, counts = trial.labelling.basis if trial.labelling else None, trial.count()
    estimates = trial.friction_coefficient[np.isfinite(trial.friction_coefficient)]
    mu = basis.friction.mu if basis else float(np.median(estimates)) if len(estimates) else np.nan
    friction = decimals(mu, 2) if np.isfinite(mu) else UNKNOWN
    if basis:
        low, high = (decimals(end, 2) for end in (basis.friction.low, basis.friction.high))
        friction += " given" if basis.friction.low == basis.friction.high else f" [{low}, {high}]"
    return _Row(
        info=info,
        pictures=(_thumbnail(trial.reference), _thumbnail(read_frames(path, [frame])[0])),
        curves=_curves(trial, margin),
        valid=counts.get("valid", 0),
        margin=f"{percent(least)} to {percent(most)}" if labelled else UNKNOWN,
        least=least,
        friction=friction,
        mu=mu,
        flags=basis.flags if basis else (),
        lost=", ".join(f"{count} {reason}" for reason, count in counts.items() if reason != "valid"),
    )


def _curves(trial: Recording, margin: Float[np.ndarray, " frames"]) -> tuple[str, ...]:
    """The margin against time in pieces, as points of an SVG line: broken where no label is valid."""
    width, height = _CURVE
    span = max(float(trial.time_s[-1] - trial.time_s[0]), 1e-9)
    step = max(1, len(margin) // _POINTS)
    pieces: list[list[str]] = [[]]
    for time_s, value in zip(trial.time_s[::step].tolist(), margin[::step].tolist(), strict=True):
        if np.isnan(value):
            pieces.append([])
        else:
            pieces[-1].append(f"{width * (time_s - trial.time_s[0]) / span:.1f},{height * (1 - value):.1f}")
    # a point alone is drawn as a short stroke
    return tuple(" ".join(points if len(points) > 1 else points * 2) for points in pieces if points)


def _thumbnail(frame: Frame) -> str:
    image = Image.fromarray(frame)
    image.thumbnail((2 * _THUMBNAIL_PX, 2 * _THUMBNAIL_PX))  # twice as fine, for dense screens
    stream = BytesIO()
    image.save(stream, format="JPEG", quality=80)
    return f"data:image/jpeg;base64,{b64encode(stream.getvalue()).decode()}"
