"""From what was recorded to a labelled trial on disk, one frame at a time."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, is_dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.capture import GIVEN_SIGNALS, Capture, Forces, GivenLabels, save_forces
from sliplens.recordings.labels import (
    Labels,
    LabelSettings,
    Reason,
    choose_reference,
    label_trial,
    measure_motion,
)
from sliplens.recordings.store import OBJECT, encode_frames, require_labelling, write_trial


@dataclass(frozen=True, kw_only=True)
class About:
    """What a trial is."""

    sensor: str
    day: int
    condition: str
    """dry or wet, or any other word for the state of the surface."""
    object: str = ""
    """What was held; empty where it is not told."""


_NO_CHOICE = dict.fromkeys(("index", "method", "contact_energy", "drift"))
"""What is told of a reference frame."""
_RESTS_ON = (
    "axes",
    "friction",
    "friction_change",
    "slip_s",
    "lag",
    "contact_threshold_n",
    "window_s",
    "gap_s",
    "force_range_n",
)
"""What is told of labels that were found; None of labels that came with the frames."""


def import_trial(
    capture: Capture,
    path: Path,
    *,
    about: About,
    settings: LabelSettings,
    rng: np.random.Generator,
    forces_path: Path | None = None,
    reference_index: int | None = None,
    reference_method: str = "least contact energy",
    on_frames: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Write a recording as a trial of a data set, with the labels that came with it, or found; whole or not at all.

    The frames are read several times, never all at once: to see the image move, to find the untouched sensor, and to
    write them.

    Parameters
    ----------
    capture
        What a reader found; it must have labels or forces.
    path
        Parquet file to write.
    about
        What the trial is.
    settings
        What is known of axes, friction and lag, where labels are to be found.
    rng
        Source of the bootstraps.
    forces_path
        Where to keep the samples of the force sensor, from which labels can be made anew; not kept if None.
    reference_index, reference_method
        The untouched frame by hand, or how to choose it where the source does not tell it.
    on_frames
        Called with the frames written and the frames in all.

    Returns
    -------
    dict
        What the labels rest on, as `read_labelling` gives it back.

    Raises
    ------
    RecordingError
        If there are neither labels nor forces, nothing touches, the trial never slips and no friction is given, or no
        frame is untouched and none is named.
    """
    if capture.labels is None and capture.forces is None:
        raise RecordingError(
            f"{capture.source} has no forces, and without them there is no label; give the table of the force sensor"
        )
    try:
        if capture.labels is not None:
            made = _given(capture, capture.labels, index=reference_index)
        else:
            assert capture.forces is not None
            made = _found(capture, capture.forces, settings, rng, index=reference_index, method=reference_method)
    except RecordingError as error:
        raise RecordingError(f"{capture.source}: {error}") from None
    description = {
        **{name: str(getattr(about, name)) for name in ("sensor", "day", "condition")},
        "trial": capture.name,
        "labelling": json.dumps(made.labelling, allow_nan=False),
    }
    if about.object:
        description[OBJECT] = about.object
    # before the trial, whose file tells that all of it is there
    if forces_path is not None and capture.forces is not None:
        save_forces(capture.forces, forces_path)
    count = len(capture.frame_time_s)
    images = _counted(encode_frames(_exactly(capture, count)), count, on_frames)
    write_trial(path, images, {"time_s": capture.frame_time_s, **made.columns}, description, reference=made.reference)
    return made.labelling


@dataclass(frozen=True, kw_only=True)
class _Made:
    """What is written besides frames and times."""

    columns: dict[str, Any]
    labelling: dict[str, Any]
    reference: UInt8[np.ndarray, "height width 3"]


def _found(
    capture: Capture,
    forces: Forces,
    settings: LabelSettings,
    rng: np.random.Generator,
    *,
    index: int | None,
    method: str,
) -> _Made:
    motion = measure_motion(_exactly(capture, len(capture.frame_time_s)))
    labels = label_trial(capture.frame_time_s, motion, forces, settings=settings, rng=rng)
    index = capture.reference_index if index is None else index
    if capture.reference is not None and index is None:
        image, told = capture.reference, {**_NO_CHOICE, "method": "recorded apart from the frames"}
    else:
        untouched = np.array([reason is Reason.NO_CONTACT for reason in labels.reason])
        chosen = choose_reference(capture.read_frames, untouched, index=index, method=method)
        image, told = chosen.image, {name: getattr(chosen, name) for name in _NO_CHOICE}
    columns = {
        **{name: getattr(labels, name) for name in GIVEN_SIGNALS},
        "contact_state": [str(state) for state in labels.contact_state],
        "safety_margin_sigma": labels.safety_margin_sigma,
        "valid": labels.valid,
        "invalid_reason": [str(reason) for reason in labels.reason],
        "force_time_s": labels.force_time_s,
    }
    return _Made(columns=columns, labelling=_told(capture, labels, told, settings), reference=image)


def _given(capture: Capture, labels: GivenLabels, *, index: int | None) -> _Made:
    index = capture.reference_index if index is None else index
    told: dict[str, Any] = {**_NO_CHOICE, "method": "came with the recording"}
    if index is not None:
        if not 0 <= index < len(labels):
            raise RecordingError(f"the reference is frame {index} of {len(labels)}; name one from 0 on that is there")
        image = next(islice(capture.read_frames(), index, None))
        told |= {"index": index, "method": "named"}
    elif capture.reference is not None:
        image = capture.reference
    else:
        raise RecordingError("no frame is known to be untouched; name one with --reference-frame")
    columns: dict[str, Any] = {name: getattr(labels, name) for name in GIVEN_SIGNALS}
    columns["contact_state"] = [str(state) for state in labels.contact_state]
    for name, column in (("safety_margin_sigma",) * 2, ("valid",) * 2, ("reason", "invalid_reason")):
        values = getattr(labels, name)
        if values is not None:
            columns[column] = list(values) if name == "reason" else values
    labelling = labels.labelling
    if labelling is not None:
        require_labelling(labelling, where="what came with the frames")
    else:
        labelling = {
            **dict.fromkeys(_RESTS_ON),
            "source": capture.source,
            "frames_by_reason": labels.count(),
            "forces": capture.forces.source if capture.forces else None,
            "notes": list(capture.notes),
            "lag_applied": False,
            "reference": told,
            "clip": labels.clip,
        }
    return _Made(columns=columns, labelling=labelling, reference=image)


def _exactly(capture: Capture, count: int) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Frames of a capture, which must be as many as it promised and of one size."""
    read = 0
    for frame in capture.read_frames():
        if frame.shape[:2] != capture.frame_size:
            raise RecordingError(
                f"frame {read} of {capture.source} is {frame.shape[0]} x {frame.shape[1]} pixels, not "
                f"{capture.frame_size[0]} x {capture.frame_size[1]} as its first; cut the recording there"
            )
        read += 1
        yield frame
    if read != count:
        raise RecordingError(f"{capture.source} promised {count} frames but gave {read}; copy or export it again")


def _counted(
    chunks: Iterator[list[bytes]], count: int, on_frames: Callable[[int, int], None] | None
) -> Iterator[list[bytes]]:
    done = 0
    for chunk in chunks:
        done += len(chunk)
        yield chunk
        del chunk  # before the next is made
        if on_frames is not None:
            on_frames(done, count)


def _told(capture: Capture, labels: Labels, reference: dict[str, Any], settings: LabelSettings) -> dict[str, Any]:
    """All that the labels rest on, as JSON can hold it."""
    told = {
        "source": capture.source,
        "frames_by_reason": labels.count(),
        "forces": capture.forces.source if capture.forces else None,
        "notes": capture.notes,
        "axes": labels.axes,
        "friction": labels.friction,
        "friction_change": settings.friction_change,
        "slip_s": labels.slip_s,
        "lag": labels.lag,
        "lag_applied": labels.lag_applied,
        "contact_threshold_n": labels.contact_threshold_n,
        "window_s": labels.window_s,
        "gap_s": labels.gap_s,
        "force_range_n": labels.force_range_n,
        "reference": reference,
        "clip": None,
    }
    return _plain(told)


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
