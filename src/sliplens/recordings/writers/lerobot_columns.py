"""Features of each frame of a LeRobot data set: numbers and labels, and where it stands."""

from typing import Any

import numpy as np

from sliplens.recordings.capture import Capture
from sliplens.recordings.given import GivenLabels
from sliplens.recordings.readers.lerobot_kept import CAMERA, FORCE, FORCE_AXES, NUMBERS, REASON, STATE, TIME, VALID
from sliplens.recordings.recording import ContactState
from sliplens.recordings.writers.lerobot_files import Features

_STATES = [str(state) for state in ContactState]


def frame_features(height: int, width: int) -> Features:
    """Features of the frames, as `meta/info.json` lists them; the words of the reasons are added when all are known."""
    found: Features = {
        CAMERA: {"dtype": "image", "shape": [height, width, 3], "names": ["height", "width", "channels"]},
        TIME: {"dtype": "float64", "shape": [1], "names": ["time_s"]},
        FORCE: {"dtype": "float64", "shape": [3], "names": list(FORCE_AXES)},
        **{key: {"dtype": "float64", "shape": [1], "names": [name]} for name, key in NUMBERS.items()},
        VALID: {"dtype": "bool", "shape": [1], "names": ["valid"]},
        STATE: {"dtype": "int64", "shape": [1], "names": ["contact_state"], "info": {"values": _STATES}},
        REASON: {"dtype": "int64", "shape": [1], "names": ["invalid_reason"]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    counts = ("frame_index", "episode_index", "index", "task_index")
    return found | {name: {"dtype": "int64", "shape": [1], "names": None} for name in counts}


def frame_columns(capture: Capture, *, fps: int | float, reasons: dict[str, int]) -> dict[str, np.ndarray]:
    """Features of the frames of a trial, but for its images and its place.

    Parameters
    ----------
    capture
        The trial, with labels.
    fps
        Frames in a second of `timestamp`.
    reasons
        Numbers of the reasons why labels are not valid; those not met before are added.
    """
    labels, count = capture.labels, len(capture.frame_time_s)
    assert labels is not None
    force = np.stack([labels.tangential_force_n, np.zeros(count), labels.normal_force_n], axis=1)
    return {
        TIME: capture.frame_time_s,
        FORCE: force,
        **{key: _given(labels, name) for name, key in NUMBERS.items()},
        VALID: _given(labels, "valid"),
        STATE: np.array([_STATES.index(state) for state in labels.contact_state], dtype=np.int64),
        REASON: np.array([reasons.setdefault(reason, len(reasons)) for reason in _given(labels, "reason")], np.int64),
        "timestamp": (np.arange(count) / fps).astype(np.float32),
    }


def _given(labels: GivenLabels, name: str) -> Any:
    """Labels of a name; those that a trial lacks follow from what it has, or are not known."""
    values = getattr(labels, name)
    if values is not None:
        return values
    known = np.isfinite(labels.safety_margin)
    return {"safety_margin_sigma": np.full(len(labels), np.nan), "valid": known, "reason": [""] * len(labels)}[name]


def frame_places(frames: int, *, first: int, episode: int, task: int) -> dict[str, np.ndarray]:
    """Features that place the frames of an episode in the data set.

    Parameters
    ----------
    frames
        Of the episode.
    first
        Number of its first frame in the whole data set.
    episode, task
        Their numbers.
    """
    numbers = np.arange(frames, dtype=np.int64)
    return {
        "frame_index": numbers,
        "episode_index": np.full_like(numbers, episode),
        "index": first + numbers,
        "task_index": np.full_like(numbers, task),
    }
