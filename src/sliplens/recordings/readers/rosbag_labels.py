"""Trials that `write_mcap` exported, read back with all that was known of them."""

import sys
from array import array
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.given import GIVEN_SIGNALS, GivenLabels
from sliplens.recordings.readers.ros_images import image_pixels, image_size
from sliplens.recordings.readers.ros_storage import open_bag
from sliplens.recordings.recording import ContactState, require_unit_interval
from sliplens.recordings.trial_messages import (
    FORMAT,
    IMAGE,
    LABELS,
    NUMBERS,
    REFERENCE,
    TOPICS,
    TRIAL,
    WRENCH,
    WRENCH_TIMES,
    TrialText,
    trial_types,
)

_STATES = {str(state): state for state in ContactState}


def read_trial_bag(path: Path, topics: dict[str, str]) -> Capture | None:
    """Read a bag that `write_mcap` wrote; None where it is another one.

    Frames, times, labels, reference frame and forces are those of the data set it came from, bit by bit.

    Parameters
    ----------
    path
        Folder with `metadata.yaml`, or an .mcap or .db3 file.
    topics
        Topics of the bag and the types of their messages.

    Raises
    ------
    RecordingError
        If it is one of ours, but damaged, cut, or changed.
    """
    if topics.get(TRIAL) != TOPICS[TRIAL]:
        return None
    text = next((message.data for _, message in _messages(path, {TRIAL})), "")
    # either is enough: the other may be what is damaged
    if FORMAT not in text and topics.get(LABELS) != TOPICS[LABELS]:
        return None
    about = TrialText.parse(text, where=f"{TRIAL} of {path}")
    needed = {REFERENCE, IMAGE, LABELS} | ({WRENCH, WRENCH_TIMES} if about.force_samples else set())
    missing = [topic for topic in sorted(needed) if topics.get(topic) != TOPICS[topic]]
    if missing:
        raise RecordingError(
            f"{path} lacks {', '.join(f'{topic} ({TOPICS[topic]})' for topic in missing)}; export the trial again"
        )
    found = _scan(path, needed)
    _require_whole(found, about, path)
    assert found.size is not None
    labels = _labels(found, about)
    for name in ("safety_margin", "stick_ratio"):
        require_unit_interval(getattr(labels, name), name=name, trial=f"{about.trial} of {path}")
    return Capture(
        name=about.trial,
        source=f"{about.trial} of {path}",
        frame_time_s=found.column("time_s"),
        frame_size=found.size,
        read_frames=lambda: _read_frames(path),
        forces=None
        if not about.force_samples
        else Forces(
            time_s=np.array(found.force_time_s, dtype=np.float64),
            force_n=np.array(found.force_n, dtype=np.float64).reshape(-1, 3),
            source=about.force_source,
        ),
        labels=labels,
        reference=found.reference,
        told=about.told,
    )


@dataclass(kw_only=True)
class _Scan:
    """What a bag holds besides pixels."""

    size: tuple[int, int] | None = None
    reference: UInt8[np.ndarray, "height width 3"] | None = None
    references: int = 0
    image_ns: array = field(default_factory=lambda: array("q"))
    label_ns: array = field(default_factory=lambda: array("q"))
    numbers: array = field(default_factory=lambda: array("d"))
    valid: list[bool] = field(default_factory=list)
    states: list[ContactState] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    force_n: array = field(default_factory=lambda: array("d"))
    force_time_s: array = field(default_factory=lambda: array("d"))

    def column(self, name: str) -> Float[np.ndarray, " frames"]:
        """One of `NUMBERS`."""
        return np.array(self.numbers, dtype=np.float64).reshape(-1, len(NUMBERS))[:, NUMBERS.index(name)].copy()


def _scan(path: Path, topics: Collection[str]) -> _Scan:
    found = _Scan()
    for topic, message in _messages(path, topics):
        if topic == IMAGE:
            where = _where(len(found.image_ns), path)
            found.image_ns.append(_stamp_ns(message))
            size = image_size(message, where=where)
            if found.size not in {None, size}:
                raise RecordingError(f"{where} has another size than those before it; export the trial again")
            found.size = size
        elif topic == LABELS:
            _add_label(found, message, where=f"label {len(found.label_ns)} of {LABELS} in {path}")
        elif topic == WRENCH:
            force = message.wrench.force
            found.force_n.extend((force.x, force.y, force.z))
        elif topic == WRENCH_TIMES:
            found.force_time_s.extend(message.time_s.tolist())
        else:
            found.references += 1
            found.reference = image_pixels(message, where=f"{REFERENCE} of {path}")
    return found


def _add_label(found: _Scan, message: Any, *, where: str) -> None:
    if message.contact_state not in _STATES:
        raise RecordingError(
            f"{where} has the contact state {message.contact_state[:40]!r}, none of {', '.join(_STATES)}; "
            "export the trial again"
        )
    found.label_ns.append(_stamp_ns(message))
    found.numbers.extend(getattr(message, name) for name in NUMBERS)
    found.states.append(_STATES[message.contact_state])
    found.valid.append(bool(message.valid))
    found.reasons.append(sys.intern(message.invalid_reason))  # few, and often


def _require_whole(found: _Scan, about: TrialText, path: Path) -> None:
    """Check that all that was promised is there, and that labels belong to their frames."""
    counts = {
        "reference frames": (found.references, 1),
        "frames": (len(found.image_ns), about.frames),
        "labels": (len(found.label_ns), about.frames),
        "wrenches": (len(found.force_n) // 3, about.force_samples),
        "times of wrenches": (len(found.force_time_s), about.force_samples),
    }
    for name, (count, promised) in counts.items():
        if count != promised:
            raise RecordingError(f"{path} has {count} {name}, {TRIAL} promises {promised}; export the trial again")
    if found.image_ns != found.label_ns:
        at = next(i for i, (one, other) in enumerate(zip(found.image_ns, found.label_ns, strict=True)) if one != other)
        raise RecordingError(f"label {at} of {path} has another stamp than its frame; export the trial again")
    if not np.isfinite(found.column("time_s")).all():
        raise RecordingError(f"{LABELS} of {path} has a time that is not a number; export the trial again")


def _labels(found: _Scan, about: TrialText) -> GivenLabels:
    optional = {
        "safety_margin_sigma": found.column("safety_margin_sigma"),
        "valid": np.array(found.valid, dtype=bool),
        "reason": tuple(found.reasons),
    }
    return GivenLabels(
        **{name: found.column(name) for name in GIVEN_SIGNALS},
        contact_state=tuple(found.states),
        **{name: values for name, values in optional.items() if name in about.optional},
        labelling=about.labelling,
    )


def _read_frames(path: Path) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    for index, (_, message) in enumerate(_messages(path, {IMAGE})):
        yield image_pixels(message, where=_where(index, path))


def _messages(path: Path, topics: Collection[str]) -> Iterator[tuple[str, Any]]:
    """Topic and content of each message of some of our topics, in the order of recording."""
    with open_bag(path) as bag:
        types = trial_types()
        # a second channel of the same topic could hold anything
        wanted = [one for one in bag.connections if one.topic in topics and one.msgtype == TOPICS[one.topic]]
        if not wanted:  # to rosbags none means all
            return
        for connection, _, data in bag.messages(wanted):
            yield connection.topic, types.deserialize_cdr(memoryview(data), connection.msgtype)


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def _where(index: int, path: Path) -> str:
    return f"frame {index} of {IMAGE} in {path}"
