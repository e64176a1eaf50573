"""Trials as MCAP files of ROS 2 messages, which Foxglove, Rerun and ROS play with images, forces and labels."""

import math
from collections.abc import Sequence
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sliplens._version import __version__
from sliplens.errors import RecordingError
from sliplens.extras import require_packages
from sliplens.images import encode_png
from sliplens.progress import report_each, report_progress
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import Dataset, TrialInfo
from sliplens.recordings.formats.stored import fill_labels, read_stored_trial
from sliplens.recordings.store import in_turn
from sliplens.recordings.trial import LABEL_SIGNALS

if TYPE_CHECKING:
    from mcap.writer import Writer
    from rosbags.typesys.store import Typestore

REFERENCE, IMAGE, WRENCH = "/tactile/reference", "/tactile/image", "/tactile/wrench"
LABELS, MARGIN = "/tactile/labels", "/tactile/safety_margin"
TOPICS = {
    REFERENCE: "sensor_msgs/msg/CompressedImage",
    IMAGE: "sensor_msgs/msg/CompressedImage",
    LABELS: "sliplens_msgs/msg/SafetyMargin",
    MARGIN: "std_msgs/msg/Float64",
    WRENCH: "geometry_msgs/msg/WrenchStamped",
}
"""Types of the messages; wrenches are there where forces are known."""
_LABELS = """
std_msgs/Header header
float64 time_s
float64 normal_force_n
float64 tangential_force_n
float64 friction_coefficient
float64 safety_margin
float64 safety_margin_sigma
float64 stick_ratio
bool valid
string contact_state
string invalid_reason
"""
_LAST_S = 2**31  # a stamp of ROS counts seconds in 32 bits


def trial_types() -> "Typestore":
    """Return the types of ROS 2 and ours, never those that a file defines: `rosbags` turns definitions into code."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 (an extra)

    types = get_typestore(Stores.LATEST)
    types.register(get_types_from_msg(_LABELS, TOPICS[LABELS]))
    return types


def write_mcap(data: Dataset, trials: Sequence[TrialInfo], folder: Path) -> None:
    """Write trials into an empty folder; see `export_mcap`."""
    require_packages("mcap", "rosbags", extra="ros", purpose="an MCAP file")
    from mcap.writer import Writer  # noqa: PLC0415 (an extra)

    for info in report_each(trials, sizes=[info.frames for info in trials]):
        with (folder / f"{info.trial}.mcap").open("wb") as stream:
            writer = Writer(stream)  # chunks under Zstandard, with indexes and checksums
            writer.start(profile="ros2", library=f"sliplens {__version__}")
            _write_trial(_Bag(writer), read_stored_trial(data, info))
            writer.finish()


class _Bag:
    """MCAP file that takes messages by topic and fields."""

    def __init__(self, writer: "Writer") -> None:
        self.writer, self._types = writer, trial_types()
        self._channels: dict[str, int] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        """Make a message, or part of one."""
        return self._types.types[kind](**fields)

    def write(self, topic: str, stamp_ns: int, **fields: Any) -> None:
        """Write a message that was recorded when it was stamped; all but a bare number have a header."""
        kind = TOPICS[topic]
        if topic != MARGIN:
            stamp = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
            fields["header"] = self.make("std_msgs/msg/Header", stamp=stamp, frame_id="tactile")
        if topic not in self._channels:
            definition, _ = self._types.generate_msgdef(kind, ros_version=2)
            schema = self.writer.register_schema(kind, "ros2msg", definition.encode())
            self._channels[topic] = self.writer.register_channel(topic, "cdr", schema)
        data = bytes(self._types.serialize_cdr(self.make(kind, **fields), kind))
        self.writer.add_message(self._channels[topic], log_time=stamp_ns, data=data, publish_time=stamp_ns)


def _write_trial(bag: _Bag, capture: Capture) -> None:
    """Write the messages of a trial in the order of time."""
    assert capture.labels is not None
    assert capture.reference is not None
    forces, labels = capture.forces, fill_labels(capture.labels)
    series = [capture.frame_time_s, *([forces.time_s] if forces else [])]
    first_s, last_s = min(times[0].item() for times in series), max(times[-1].item() for times in series)
    offset_s = 0 if first_s >= 1 else 1 - math.floor(first_s)  # to ROS a stamp of zero is none
    if last_s + offset_s >= _LAST_S:
        raise RecordingError(f"trial {capture.trial} goes to {last_s:.6g} s, beyond ROS; import it with other times")
    bag.writer.add_metadata("sliplens", {"trial": capture.trial, "stamp_offset_s": str(offset_s)})
    rows = {name: getattr(labels, name).tolist() for name in (*LABEL_SIGNALS, "safety_margin_sigma", "valid")}
    rows |= {"time_s": capture.frame_time_s.tolist(), "invalid_reason": labels.reason or ()}
    rows["contact_state"] = [str(state) for state in labels.contact_state]

    def write_image(topic: str, stamp_ns: int, png: bytes) -> None:
        bag.write(topic, stamp_ns, format="png", data=np.frombuffer(png, dtype=np.uint8))

    def vector(xyz: Sequence[float]) -> object:
        return bag.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", xyz, strict=True)))

    write_image(REFERENCE, _stamps_ns([first_s], offset_s)[0], encode_png(capture.reference))
    wrenches = zip(_stamps_ns(forces.time_s, offset_s), forces.force_n.tolist(), strict=True) if forces else ()
    pngs = in_turn(encode_png, capture.read_frames())
    frames = zip(_stamps_ns(capture.frame_time_s, offset_s), enumerate(pngs), strict=True)
    for stamp_ns, content in merge(wrenches, frames, key=itemgetter(0)):
        if isinstance(content, list):
            force, torque = vector(content), vector((0.0, 0.0, 0.0))
            bag.write(WRENCH, stamp_ns, wrench=bag.make("geometry_msgs/msg/Wrench", force=force, torque=torque))
            continue
        index, png = content
        write_image(IMAGE, stamp_ns, png)
        bag.write(LABELS, stamp_ns, **{name: values[index] for name, values in rows.items()})
        bag.write(MARGIN, stamp_ns, data=rows["safety_margin"][index])
        report_progress(index + 1, len(capture))


def _stamps_ns(time_s: Sequence[float] | Float[np.ndarray, " samples"], offset_s: int) -> list[int]:
    """Round to nanoseconds; whole seconds apart, since doubles of times since 1970 are 256 ns apart."""
    whole = np.floor(time_s)
    return ((whole.astype(np.int64) + offset_s) * 10**9 + np.rint((time_s - whole) * 1e9).astype(np.int64)).tolist()
