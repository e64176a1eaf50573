"""Trials as MCAP files of ROS 2 messages, which Foxglove, Rerun and ROS play with images, forces and labels."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from jaxtyping import Float, Int64

from sliplens._version import __version__
from sliplens.errors import InputError, RecordingError
from sliplens.extras import require_packages
from sliplens.files import require_folder
from sliplens.images import encode_png
from sliplens.progress import OnProgress
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.dataset import Dataset, TrialInfo
from sliplens.recordings.formats.stored import ExportedTrial, encode_batches, exported_labels, read_stored_trial
from sliplens.recordings.trial import LABEL_SIGNALS

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


TRIAL, REFERENCE, IMAGE = "/tactile/trial", "/tactile/reference", "/tactile/image"
LABELS, MARGIN = "/tactile/labels", "/tactile/safety_margin"
WRENCH, WRENCH_TIMES = "/tactile/wrench", "/tactile/wrench_times"
TOPICS = {
    TRIAL: "std_msgs/msg/String",
    REFERENCE: "sensor_msgs/msg/CompressedImage",
    IMAGE: "sensor_msgs/msg/CompressedImage",
    LABELS: "sliplens_msgs/msg/SafetyMargin",
    MARGIN: "std_msgs/msg/Float64",
    WRENCH: "geometry_msgs/msg/WrenchStamped",
    WRENCH_TIMES: "sliplens_msgs/msg/SampleTimes",
}
"""Types of the messages; wrenches and their times are there where forces are known."""

NUMBERS = ("time_s", *LABEL_SIGNALS, "safety_margin_sigma")
"""The numbers of a frame, named as in its message."""
_DEFINITIONS = {
    "sliplens_msgs/msg/SafetyMargin": """
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
""",
    "sliplens_msgs/msg/SampleTimes": """
std_msgs/Header header
float64[] time_s
""",
}


def trial_types() -> "Typestore":
    """Messages of ROS 2 and ours: from these definitions, never from a file's, for `rosbags` turns them into code."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 (an extra)

    types = get_typestore(Stores.LATEST)
    for kind, definition in _DEFINITIONS.items():
        types.register(get_types_from_msg(definition, kind))
    return types


_FRAME_ID = "tactile"
_LAST_S = 2**31  # a stamp of ROS counts seconds in 32 bits
_BLOCK = 1000  # times of wrenches in a message


def write_mcap(
    data: Dataset, folder: Path, *, trials: Sequence[TrialInfo] | None = None, on_progress: OnProgress | None = None
) -> None:
    """Write trials as `TRIAL.mcap`, without loss: `read_rosbag` gives each back as it is in the data set.

    Frames are PNG: on simulated frames those are 22 % smaller than raw images under the Zstandard of MCAP. Wrenches are
    the samples of the force sensor where the data set keeps them, else the forces of the frames.

    Stamps are the times of the trial to the nanosecond. ROS takes a stamp of 0 for none and cannot write one before:
    where a trial begins before 1 s, stamps are later by the whole seconds that let it begin within [1 s, 2 s), which
    `stamp_offset_s` of `/tactile/trial` tells. Exact times stand in `/tactile/labels` and `/tactile/wrench_times`.
    """
    require_folder(folder, what="the folder to write to")
    if any(folder.iterdir()):
        raise InputError(f"{folder} is not empty; name a new folder")
    chosen = data.trials if trials is None else tuple(trials)
    written, total = 0, sum(info.frames for info in chosen)
    for info in chosen:
        with (folder / f"{info.trial}.mcap").open("wb") as stream:
            bag = _Bag(stream)
            for _ in _write_trial(bag, read_stored_trial(data, info)):
                written += 1
                if on_progress is not None:
                    on_progress(written, total)
            bag.writer.finish()


class _Bag:
    """An MCAP file that takes messages by topic and field."""

    def __init__(self, stream: BinaryIO) -> None:
        require_packages("mcap", "rosbags", extra="ros", purpose="an MCAP file")
        from mcap.writer import Writer  # noqa: PLC0415 (an extra)

        self.types = trial_types()
        # chunks under Zstandard, with indexes and checksums
        self.writer = Writer(stream)
        self.writer.start(profile="ros2", library=f"sliplens {__version__}")
        self.schemas: dict[str, int] = {}
        self.channels: dict[str, int] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        """A message, or part of one."""
        return self.types.types[kind](**fields)

    def header(self, stamp_ns: int) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=_FRAME_ID)

    def write(self, topic: str, stamp_ns: int, **fields: Any) -> None:
        """Write a message; it was recorded when it was stamped."""
        kind = TOPICS[topic]
        if topic not in self.channels:
            self.channels[topic] = self.writer.register_channel(topic, "cdr", self._schema(kind))
        data = self.types.serialize_cdr(self.make(kind, **fields), kind)
        self.writer.add_message(self.channels[topic], log_time=stamp_ns, data=bytes(data), publish_time=stamp_ns)

    def _schema(self, kind: str) -> int:
        if kind not in self.schemas:
            definition, _ = self.types.generate_msgdef(kind, ros_version=2)
            self.schemas[kind] = self.writer.register_schema(kind, "ros2msg", definition.encode())
        return self.schemas[kind]


def _write_trial(bag: _Bag, capture: Capture) -> Iterator[None]:
    """Write all of a trial in the order of time; stops after every frame."""
    labels, forces = capture.labels, capture.forces
    assert labels is not None
    assert capture.reference is not None
    offset_s = _stamp_offset_s(capture)
    frame_ns = _stamps_ns(capture.frame_time_s, offset_s)
    force_ns = _stamps_ns(forces.time_s, offset_s) if forces else np.zeros(0, dtype=np.int64)
    start_ns = min(series[0].item() for series in (frame_ns, force_ns) if len(series))
    about = ExportedTrial.of(capture)
    bag.write(TRIAL, start_ns, data=about.dump(stamp_offset_s=offset_s, sliplens_version=__version__))
    bag.write(REFERENCE, start_ns, **_image(bag, encode_png(capture.reference), start_ns))
    label = {"time_s": capture.frame_time_s, **exported_labels(labels)}
    label["invalid_reason"] = label.pop("reason")
    fields = {name: values.tolist() for name, values in label.items()}
    sampled = 0
    pngs = (png for _, batch in encode_batches(capture.read_frames()) for png in batch)
    for index, png in enumerate(pngs):
        stamp_ns = frame_ns[index].item()
        if forces is not None:
            until = int(np.searchsorted(force_ns, stamp_ns, side="right"))
            _write_forces(bag, forces, force_ns, sampled, until)
            sampled = until
        bag.write(IMAGE, stamp_ns, **_image(bag, png, stamp_ns))
        label = {name: values[index] for name, values in fields.items()}
        bag.write(LABELS, stamp_ns, header=bag.header(stamp_ns), **label)
        bag.write(MARGIN, stamp_ns, data=label["safety_margin"])
        yield
    if forces is not None:
        _write_forces(bag, forces, force_ns, sampled, len(force_ns))


def _write_forces(bag: _Bag, forces: Forces, stamps_ns: Int64[np.ndarray, " samples"], start: int, stop: int) -> None:
    for index in range(start, stop):
        stamp_ns = stamps_ns[index].item()
        if index % _BLOCK == 0:
            times = forces.time_s[index : index + _BLOCK]
            bag.write(WRENCH_TIMES, stamp_ns, header=bag.header(stamp_ns), time_s=times)
        force, torque = (
            bag.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
            for x, y, z in (forces.force_n[index].tolist(), (0.0, 0.0, 0.0))
        )
        wrench = bag.make("geometry_msgs/msg/Wrench", force=force, torque=torque)
        bag.write(WRENCH, stamp_ns, header=bag.header(stamp_ns), wrench=wrench)


def _image(bag: _Bag, png: bytes, stamp_ns: int) -> dict[str, Any]:
    return {"header": bag.header(stamp_ns), "format": "png", "data": np.frombuffer(png, dtype=np.uint8)}


def _stamp_offset_s(capture: Capture) -> int:
    """Whole seconds by which stamps are later than the times of the trial."""
    series = [capture.frame_time_s, *([capture.forces.time_s] if capture.forces else [])]
    first, last = min(times[0].item() for times in series), max(times[-1].item() for times in series)
    offset_s = 0 if first >= 1 else 1 - math.floor(first)
    if last + offset_s >= _LAST_S:
        raise RecordingError(
            f"trial {capture.trial} goes from {first:.6g} s to {last:.6g} s, and stamps of ROS end at {_LAST_S} s; "
            "import it with times in seconds"
        )
    return offset_s


def _stamps_ns(time_s: Float[np.ndarray, " samples"], offset_s: int) -> Int64[np.ndarray, " samples"]:
    """Nearest nanoseconds; whole seconds apart, for of a time since 1970 the product would be rounded to 256 ns."""
    whole = np.floor(time_s)
    return (whole.astype(np.int64) + offset_s) * 10**9 + np.rint((time_s - whole) * 1e9).astype(np.int64)
