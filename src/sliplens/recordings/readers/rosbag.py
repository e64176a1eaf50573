"""ROS 2 bags (MCAP or sqlite3) of a tactile camera and a force-torque sensor."""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64, UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.readers.clocks import trial_name
from sliplens.recordings.readers.ros_images import COMPRESSED, RAW, image_pixels, image_size
from sliplens.recordings.readers.ros_storage import bag_messages, bag_topics
from sliplens.recordings.readers.rosbag_labels import read_trial_bag

_IMAGES = (RAW, COMPRESSED)
_WRENCHES = ("geometry_msgs/msg/WrenchStamped",)


def read_rosbag(path: Path, *, image_topic: str | None = None, wrench_topic: str | None = None) -> Capture:
    """Read a bag as one trial.

    Images are `sensor_msgs/Image` (rgb8, bgr8, mono8) or `CompressedImage` (JPEG, PNG), forces the x, y, z of
    `geometry_msgs/WrenchStamped`; torques are left out. A first pass reads stamps and sizes; pixels are decoded when
    frames are read. Frames and forces share one clock, that of the message headers; where a header has no stamp, or
    the two topics have clocks that never meet, both take the times at which the bag received them, and `notes` say so.
    Times are seconds since the first frame or force: since the epoch, double precision would round them to 0.2 us.

    A trial that `write_mcap` exported comes back as it was, with its labels; where a topic is named, like any bag.

    Parameters
    ----------
    path
        Folder with `metadata.yaml`, or an .mcap or .db3 file.
    image_topic
        By default the only topic that holds images.
    wrench_topic
        By default the only topic that holds wrenches; there are no forces where there is none.

    Raises
    ------
    InputError
        If `rosbags` is not installed.
    RecordingError
        If the path is no bag, it is damaged, a topic is missing or could be one of several, an image has another
        encoding or its size changes, or times do not rise.
    """
    topics = bag_topics(path)
    if image_topic is None and wrench_topic is None and (trial := read_trial_bag(path, topics)) is not None:
        return trial
    images = _choose(topics, image_topic, types=_IMAGES, what="images", path=path)
    wrenches = _choose(topics, wrench_topic, types=_WRENCHES, what="wrenches", path=path)
    if images is None:
        raise RecordingError(
            f"{path} has no topic with images ({' or '.join(_IMAGES)}); record the camera too "
            f"(it has {_listed(topics)})"
        )
    found = _scan(path, images=images, wrenches=wrenches)
    notes = []
    if wrenches is None:
        notes.append(f"There are no forces: the bag has no topic of {_WRENCHES[0]}.")
    elif wrench_topic is None and not found.wrenches.bag_ns:
        notes.append(f"There are no forces: {wrenches} has no message.")
        wrenches = None
    if found.size is None:
        raise RecordingError(f"{images} of {path} has no frame; leave it out or record it again")
    clock, why = _choose_clock(found)
    notes += why
    frame_ns, wrench_ns = found.frames.times(clock), found.wrenches.times(clock)
    zero = min(series[0] for series in (frame_ns, wrench_ns) if len(series))
    return Capture(
        name=trial_name(path.stem if path.is_file() else path.resolve().name),
        source=f"{images} of {path}",
        frame_time_s=_seconds(frame_ns - zero),
        frame_size=found.size,
        read_frames=lambda: _read_frames(path, images),
        forces=None
        if wrenches is None
        else Forces(
            time_s=_seconds(wrench_ns - zero),
            force_n=np.array(found.force_n, dtype=np.float64).reshape(-1, 3),
            source=f"{wrenches} of {path}",
        ),
        notes=tuple(notes),
    )


@dataclass(kw_only=True)
class _Stamps:
    """Times of the messages of a topic in nanoseconds, 16 bytes each: an hour at 1 kHz is 58 MB."""

    topic: str
    header_ns: array = field(default_factory=lambda: array("q"))
    bag_ns: array = field(default_factory=lambda: array("q"))

    def append(self, message: Any, bag_ns: int) -> None:
        stamp = message.header.stamp
        self.header_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        self.bag_ns.append(bag_ns)

    def times(self, clock: str) -> Int64[np.ndarray, " messages"]:
        return np.array(self.header_ns if clock == "header" else self.bag_ns, dtype=np.int64)


@dataclass(kw_only=True)
class _Scan:
    """What the first pass found."""

    frames: _Stamps
    wrenches: _Stamps
    force_n: array = field(default_factory=lambda: array("d"))
    size: tuple[int, int] | None = None


def _scan(path: Path, *, images: str, wrenches: str | None) -> _Scan:
    """Read stamps, sizes and forces, but no pixel."""
    found = _Scan(frames=_Stamps(topic=images), wrenches=_Stamps(topic=wrenches or "no topic"))
    for topic, bag_ns, message in bag_messages(path, {images, wrenches} - {None}):
        if topic == wrenches:
            found.wrenches.append(message, bag_ns)
            force = message.wrench.force
            found.force_n.extend((force.x, force.y, force.z))
            continue
        index = len(found.frames.bag_ns)
        size = image_size(message, where=_where(index, images, path))
        if found.size is not None and size != found.size:
            raise RecordingError(
                f"{_where(index, images, path)} is {size[0]} x {size[1]} pixels, those before it are "
                f"{found.size[0]} x {found.size[1]}; cut the bag there"
            )
        found.size = size
        found.frames.append(message, bag_ns)
    return found


def _read_frames(path: Path, images: str) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    for index, (_, _, message) in enumerate(bag_messages(path, {images})):
        yield image_pixels(message, where=_where(index, images, path))


def _choose(topics: dict[str, str], named: str | None, *, types: tuple[str, ...], what: str, path: Path) -> str | None:
    """Topic that was named, or the only one of these types."""
    fitting = {topic: kind for topic, kind in topics.items() if kind in types}
    if named is not None:
        if named not in topics:
            raise RecordingError(f"{path} has no topic {named}; it has {_listed(topics)}")
        if named not in fitting:
            raise RecordingError(
                f"{named} of {path} holds {topics[named]}, no {what}; name one of {' or '.join(types)}"
            )
        return named
    if len(fitting) > 1:
        raise RecordingError(f"{path} has {len(fitting)} topics with {what}, {_listed(fitting)}; name one of them")
    return next(iter(fitting), None)


def _choose_clock(found: _Scan) -> tuple[str, list[str]]:
    """Clock that both topics have, "header" or "bag", and a note where it is not the header's."""
    for stamps in (found.frames, found.wrenches):
        missing = stamps.header_ns.count(0)
        if missing:
            return "bag", [
                f"{missing} of {len(stamps.header_ns)} messages of {stamps.topic} have no header stamp: "
                "times are those at which the bag received the messages."
            ]
    if found.wrenches.bag_ns and not _meet("header", found) and _meet("bag", found):
        return "bag", [
            f"The header stamps of {found.frames.topic} and {found.wrenches.topic} are of different clocks: "
            "times are those at which the bag received the messages."
        ]
    return "header", []


def _meet(clock: str, found: _Scan) -> bool:
    frames, wrenches = found.frames.times(clock), found.wrenches.times(clock)
    return bool(frames[0] <= wrenches[-1] and wrenches[0] <= frames[-1])


def _seconds(time_ns: Int64[np.ndarray, " messages"]) -> Float[np.ndarray, " messages"]:
    return time_ns / 1e9


def _listed(topics: dict[str, str]) -> str:
    return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "no topic"


def _where(index: int, topic: str, path: Path) -> str:
    return f"frame {index} of {topic} in {path}"
