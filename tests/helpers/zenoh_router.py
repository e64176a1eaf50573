"""Zenoh as a robot's router has it, for what is sent there and comes from there."""

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def open_router() -> Iterator[tuple[Any, str]]:
    """Session that others connect to, and its address; the test is skipped where Zenoh or rosbags are missing."""
    zenoh = pytest.importorskip("zenoh", reason="Zenoh is not installed")
    pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    config = zenoh.Config()
    for name, value in (("listen/endpoints", [address]), ("scouting/multicast/enabled", False)):
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config) as session:
        yield session, address
