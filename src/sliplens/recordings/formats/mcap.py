"""Trials as MCAP files of ROS 2 messages, which Foxglove, Rerun and ROS play with images, forces and labels."""

import math
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from jaxtyping import Float, Int64

from sliplens._version import __version__
from sliplens.errors import RecordingError
from sliplens.extras import require_packages
from sliplens.files import scratch_folder
from sliplens.images import encode_png
from sliplens.progress import report_each, report_progress
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import DATASET_FILE, Dataset, TrialInfo, load_dataset, trial_path
from sliplens.recordings.formats.stored import encode_batches, fill_labels, read_stored_trial, save_without_images
from sliplens.recordings.store import forces_path
from sliplens.recordings.trial import LABEL_SIGNALS

if TYPE_CHECKING:
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
_TRIAL_FILE, _FORCES_FILE = "trial.parquet", "forces.parquet"
_ATTACHMENTS = frozenset({DATASET_FILE, _TRIAL_FILE, _FORCES_FILE})
_LAST_S = 2**31  # a stamp of ROS counts seconds in 32 bits


def trial_types() -> "Typestore":
    """Return the types of ROS 2 and ours, never those that a file defines: `rosbags` turns definitions into code."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 (an extra)

    types = get_typestore(Stores.LATEST)
    types.register(get_types_from_msg(_LABELS, TOPICS[LABELS]))
    return types


def write_mcap(data: Dataset, trials: Sequence[TrialInfo], folder: Path) -> None:
    """Write trials into an empty folder; see `export_mcap`."""
    for info in report_each(trials, sizes=[info.frames for info in trials]):
        with (
            (folder / f"{info.trial}.mcap").open("wb") as stream,
            closing(_Bag(stream)) as bag,
            scratch_folder() as copy,
        ):
            _write_trial(bag, read_stored_trial(data, info))
            save_without_images(data, [info], copy)
            bag.attach(copy / DATASET_FILE, DATASET_FILE)
            bag.attach(trial_path(copy, info.trial), _TRIAL_FILE)
            if info.forces_sha256:
                bag.attach(forces_path(copy, info.trial), _FORCES_FILE)


def extract_attachments(bag: Path, folder: Path) -> bool:
    """Copy the trial without images that `write_mcap` attached into a folder; return False if there is none."""
    from mcap.reader import SeekingReader  # noqa: PLC0415 (an extra)

    with bag.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True, record_size_limit=bag.stat().st_size)
        summary = reader.get_summary()
        if summary is None or DATASET_FILE not in {index.name for index in summary.attachment_indexes}:
            return False
        data = {item.name: item.data for item in reader.iter_attachments() if item.name in _ATTACHMENTS}
    (folder / DATASET_FILE).write_bytes(data[DATASET_FILE])
    trial = load_dataset(folder).trials[0].trial
    for name, path in ((_TRIAL_FILE, trial_path(folder, trial)), (_FORCES_FILE, forces_path(folder, trial))):
        if name in data:
            path.parent.mkdir()
            path.write_bytes(data[name])
    return True


class _Bag:
    """MCAP file that takes messages by topic and fields."""

    def __init__(self, stream: BinaryIO) -> None:
        require_packages("mcap", "rosbags", extra="ros", purpose="an MCAP file")
        from mcap.writer import Writer  # noqa: PLC0415 (an extra)

        self.types = trial_types()
        # chunks under Zstandard, with indexes and checksums
        self.writer = Writer(stream)
        self.writer.start(profile="ros2", library=f"sliplens {__version__}")
        self.channels: dict[str, int] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        """Make a message, or part of one."""
        return self.types.types[kind](**fields)

    def write(self, topic: str, stamp_ns: int, **fields: Any) -> None:
        """Write a message that was recorded when it was stamped; all but a bare number have a header."""
        kind = TOPICS[topic]
        if kind != "std_msgs/msg/Float64":
            stamp = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
            fields["header"] = self.make("std_msgs/msg/Header", stamp=stamp, frame_id="tactile")
        if topic not in self.channels:
            definition, _ = self.types.generate_msgdef(kind, ros_version=2)
            schema = self.writer.register_schema(kind, "ros2msg", definition.encode())
            self.channels[topic] = self.writer.register_channel(topic, "cdr", schema)
        data = self.types.serialize_cdr(self.make(kind, **fields), kind)
        self.writer.add_message(self.channels[topic], log_time=stamp_ns, data=bytes(data), publish_time=stamp_ns)

    def write_image(self, topic: str, stamp_ns: int, png: bytes) -> None:
        """Write an image."""
        self.write(topic, stamp_ns, format="png", data=np.frombuffer(png, dtype=np.uint8))

    def attach(self, path: Path, name: str) -> None:
        """Attach a file."""
        self.writer.add_attachment(0, 0, name, "application/octet-stream", path.read_bytes())

    def close(self) -> None:
        """Write the index."""
        self.writer.finish()


def _write_trial(bag: _Bag, capture: Capture) -> None:
    """Write the messages of a trial in the order of time."""
    assert capture.labels is not None
    assert capture.reference is not None
    forces, offset_s = capture.forces, _stamp_offset_s(capture)
    bag.writer.add_metadata("sliplens", {"trial": capture.trial, "stamp_offset_s": str(offset_s)})
    frame_ns = _stamps_ns(capture.frame_time_s, offset_s)
    force_ns = _stamps_ns(forces.time_s, offset_s) if forces else np.zeros(0, dtype=np.int64)
    wrenches = iter(zip(force_ns.tolist(), forces.force_n.tolist() if forces else (), strict=True))
    labels = fill_labels(capture.labels)
    rows = {name: getattr(labels, name).tolist() for name in (*LABEL_SIGNALS, "safety_margin_sigma", "valid")}
    rows |= {"time_s": capture.frame_time_s.tolist(), "invalid_reason": labels.reason or ()}
    rows["contact_state"] = [str(state) for state in labels.contact_state]
    first_ns = min(series[0].item() for series in (frame_ns, force_ns) if len(series))
    bag.write_image(REFERENCE, first_ns, encode_png(capture.reference))
    pngs = (png for _, batch in encode_batches(capture.read_frames()) for png in batch)
    written = 0
    for index, (stamp_ns, png) in enumerate(zip(frame_ns.tolist(), pngs, strict=True)):
        until = int(np.searchsorted(force_ns, stamp_ns, side="right"))
        _write_wrenches(bag, wrenches, until - written)
        written = until
        bag.write_image(IMAGE, stamp_ns, png)
        bag.write(LABELS, stamp_ns, **{name: values[index] for name, values in rows.items()})
        bag.write(MARGIN, stamp_ns, data=rows["safety_margin"][index])
        report_progress(index + 1, len(capture))
    _write_wrenches(bag, wrenches, len(force_ns) - written)


def _write_wrenches(bag: _Bag, wrenches: Iterable[tuple[int, list[float]]], count: int) -> None:
    zero = bag.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    for _, (stamp_ns, (x, y, z)) in zip(range(count), wrenches, strict=False):
        force = bag.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        bag.write(WRENCH, stamp_ns, wrench=bag.make("geometry_msgs/msg/Wrench", force=force, torque=zero))


def _stamp_offset_s(capture: Capture) -> int:
    """Return the whole seconds by which stamps are later than the times of the trial."""
    series = [capture.frame_time_s, *([capture.forces.time_s] if capture.forces else [])]
    first, last = min(times[0].item() for times in series), max(times[-1].item() for times in series)
    offset_s = 0 if first >= 1 else 1 - math.floor(first)
    if last + offset_s >= _LAST_S:
        raise RecordingError(f"trial {capture.trial} goes to {last:.6g} s, beyond ROS; import it with times in seconds")
    return offset_s


def _stamps_ns(time_s: Float[np.ndarray, " samples"], offset_s: int) -> Int64[np.ndarray, " samples"]:
    """Round to nanoseconds; whole seconds apart, since doubles of times since 1970 are 256 ns apart."""
    whole = np.floor(time_s)
    return (whole.astype(np.int64) + offset_s) * 10**9 + np.rint((time_s - whole) * 1e9).astype(np.int64)
