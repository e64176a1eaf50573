"""ROS 2 bags with images and wrenches, written by rosbags."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_HUMBLE)
CAMERA, FORCE = "/tactile/image", "/wrench"
HEIGHT, WIDTH, FRAMES = 12, 16, 5
EPOCH_NS = 1_742_563_762_691_831_035
"""A day in 2025: seconds since 1970 in double precision would round the stamps."""

Event = tuple[str, Any, int]


def make(kind: str, **fields: Any) -> Any:
    return TYPES.types[kind](**fields)


def header(time_ns: int) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="gel")


def raw_image(pixels: np.ndarray, time_ns: int, *, encoding: str = "rgb8", padding: int = 0, **claims: Any) -> Any:
    height, width = pixels.shape[:2]
    rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, padding)))
    fields = {"height": height, "width": width, "step": rows.shape[1], "data": rows.reshape(-1)} | claims
    return make("sensor_msgs/msg/Image", header=header(time_ns), encoding=encoding, is_bigendian=0, **fields)


def compressed_image(data: bytes, time_ns: int, *, form: str = "rgb8; jpeg compressed bgr8") -> Any:
    return make(
        "sensor_msgs/msg/CompressedImage", header=header(time_ns), format=form, data=np.frombuffer(data, np.uint8)
    )


def wrench(force: Sequence[float], time_ns: int) -> Any:
    def vector(x: float, y: float, z: float) -> Any:
        return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    content = make("geometry_msgs/msg/Wrench", force=vector(*force), torque=vector(7.0, 8.0, 9.0))
    return make("geometry_msgs/msg/WrenchStamped", header=header(time_ns), wrench=content)


def encode(pixels: np.ndarray, form: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format=form)
    return buffer.getvalue()


def write_bag(
    folder: Path,
    events: Sequence[Event],
    *,
    storage: str = "MCAP",
    compression: str | None = None,
    topics: Sequence[tuple[str, str]] = (),
) -> Path:
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage])
    if compression is not None:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind in [*topics, *((topic, message.__msgtype__) for topic, message, _ in events)]:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
        for topic, message, time_ns in events:
            writer.write(connections[topic], time_ns, TYPES.serialize_cdr(message, message.__msgtype__))
    return folder


def frame_ns(index: int) -> int:
    return EPOCH_NS + 33_333_333 * index


def wrench_ns(index: int) -> int:
    return EPOCH_NS - 5_000_001 + 10_000_000 * index
