"""From what was recorded to a labelled trial on disk, one frame at a time."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Capture
from sliplens.recordings.labels import (
    Labels,
    LabelSettings,
    Reason,
    Reference,
    choose_reference,
    label_trial,
    measure_motion,
)
from sliplens.recordings.store import encode_frames, write_trial


@dataclass(frozen=True, kw_only=True)
class About:
    """What a trial is."""

    sensor: str
    day: int
    condition: str
    """dry or wet, or any other word for the state of the surface."""


@dataclass(frozen=True, kw_only=True)
class ImportedTrial:
    """A trial that was written, and what its labels rest on."""

    labels: Labels
    reference: Reference
    notes: tuple[str, ...]


def import_trial(
    capture: Capture,
    path: Path,
    *,
    about: About,
    settings: LabelSettings,
    rng: np.random.Generator,
    reference_index: int | None = None,
    reference_method: str = "least contact energy",
    on_frames: Callable[[int, int], None] | None = None,
) -> ImportedTrial:
    """Label a recording and write it as a trial of a data set; whole or not at all.

    The frames are read several times, never all at once: to see the image move, to find the untouched sensor, and to
    write them.

    Parameters
    ----------
    capture
        What a reader found; it must have forces.
    path
        Parquet file to write.
    about
        What the trial is.
    settings
        What is known of axes, friction and lag.
    rng
        Source of the bootstraps.
    reference_index, reference_method
        The untouched frame by hand, or how to choose it.
    on_frames
        Called with the frames written and the frames in all.

    Raises
    ------
    RecordingError
        If there are no forces, nothing touches, the trial never slips and no friction is given, or no frame is
        untouched and none is named.
    """
    if capture.forces is None:
        raise RecordingError(
            f"{capture.source} has no forces, and without them there is no label; give the table of the force sensor"
        )
    count = len(capture.frame_time_s)
    motion = measure_motion(_exactly(capture, count))
    try:
        labels = label_trial(capture.frame_time_s, motion, capture.forces, settings=settings, rng=rng)
        untouched = np.array([reason is Reason.NO_CONTACT for reason in labels.reason])
        reference = choose_reference(capture.read_frames, untouched, index=reference_index, method=reference_method)
    except RecordingError as error:
        raise RecordingError(f"{capture.source}: {error}") from None
    columns = {
        "time_s": labels.time_s,
        "normal_force_n": labels.normal_force_n,
        "tangential_force_n": labels.tangential_force_n,
        "friction_coefficient": labels.friction_coefficient,
        "safety_margin": labels.safety_margin,
        "stick_ratio": labels.stick_ratio,
        "contact_state": [str(state) for state in labels.contact_state],
        "safety_margin_sigma": labels.safety_margin_sigma,
        "valid": labels.valid,
        "invalid_reason": [str(reason) for reason in labels.reason],
        "force_time_s": labels.force_time_s,
    }
    description = {
        "trial": capture.name,
        "sensor": about.sensor,
        "day": str(about.day),
        "condition": about.condition,
        "labelling": json.dumps(_told(capture, labels, reference, settings), allow_nan=False),
    }
    write_trial(
        path, _counted(encode_frames(_exactly(capture, count)), count, on_frames), columns, description,
        reference=reference.image,
    )  # fmt: skip
    return ImportedTrial(labels=labels, reference=reference, notes=capture.notes + labels.axes.notes)


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
        yield chunk
        done += len(chunk)
        if on_frames is not None:
            on_frames(done, count)


def _told(capture: Capture, labels: Labels, reference: Reference, settings: LabelSettings) -> dict[str, Any]:
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
        "reference": {
            "index": reference.index,
            "method": reference.method,
            "contact_energy": reference.contact_energy,
            "drift": reference.drift,
        },
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
