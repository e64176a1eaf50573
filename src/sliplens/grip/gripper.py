"""Drivers of real grippers, by lines over serial or TCP or topics of ROS 2, and a guard in front of them."""

import math
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from io import FileIO
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from sliplens.errors import InputError, SliplensError
from sliplens.extras import pick
from sliplens.live.sinks import ZENOH_ADDRESS, ZenohRos, parse_zenoh

_ANSWER_BYTES = 200  # longest answer; longer lines are none
_SILENCE_S = 2.0  # time after which a serial gripper sends no more late answers


class GripperError(SliplensError):
    """A gripper does not answer, or not by its protocol."""


@dataclass(frozen=True, kw_only=True)
class GripperState:
    """Measured force and width of a gripper."""

    force_n: float
    """Grip force, in newtons."""
    width_m: float
    """Opening between the fingers."""


@runtime_checkable
class Gripper(Protocol):
    """A parallel gripper that takes a force; opening it is left to the robot's own program."""

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons."""
        ...

    def read_state(self) -> GripperState:
        """Measure force and width."""
        ...

    def close(self) -> None:
        """Close the connection; the grip stays."""
        ...


class LineGripper:
    """A gripper with a protocol of ASCII lines, over a serial port or TCP.

    `F 1.250` sets the force in newtons, `S` asks; the answer to each is one line, `OK force_n width_m` or `ERR reason`.
    A late, broken or foreign answer is a `GripperError`, and so is a connection that breaks. An answer that is late
    cannot be matched to its line: the connection is then closed, and the next line opens it again.

    Parameters
    ----------
    connect
        Opens the socket, or file of a serial device, that carries the lines; see `open_gripper`.
    timeout_s
        Longest time until an answer, in seconds.
    silence_s
        Time, in seconds, after which a late answer does not come any more on a new connection; 0 where the answer ends
        with the old connection, as in TCP.
    """

    def __init__(
        self, connect: Callable[[], socket.socket | FileIO], *, timeout_s: float = 0.1, silence_s: float = 0.0
    ) -> None:
        self._connect, self.timeout_s, self._silence_s = connect, timeout_s, silence_s
        self._wire: socket.socket | FileIO | None = connect()
        self._silent_until_s = -math.inf

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons."""
        self.ask(f"F {force_n:.3f}")

    def read_state(self) -> GripperState:
        """Measure force and width."""
        return self.ask("S")

    def close(self) -> None:
        """Close the connection."""
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    def ask(self, line: str) -> GripperState:
        """Send a line, and return its answer."""
        if self._wire is None:
            if (wait_s := self._silent_until_s - time.monotonic()) > 0:
                raise GripperError(f"the gripper answered late; it is left alone for {wait_s:.1f} s")
            self._wire = self._connect()
        try:
            answer = self._exchange(self._wire.fileno(), line)
        except (OSError, ValueError) as error:
            self.close()
            fault = f"cannot be reached ({error})"
            if isinstance(error, TimeoutError):
                self._silent_until_s = time.monotonic() + self._silence_s
                fault = f"did not answer {line!r} in time" + (f", it sent {str(error)!r}" if str(error) else "")
            raise GripperError(f"the gripper {fault}; check its cable and power") from None
        if answer[0] == "ERR":
            raise GripperError(f"the gripper refused {line!r}: {' '.join(answer[1:]) or 'no reason given'}")
        try:
            force_n, width_m = map(float, answer[1:])
        except ValueError:
            force_n, width_m = math.nan, math.nan
        if not (math.isfinite(force_n) and math.isfinite(width_m)):
            raise GripperError(
                f"the gripper answered {' '.join(answer)!r} to {line!r}, not `OK force_n width_m`; check its protocol"
            )
        return GripperState(force_n=force_n, width_m=width_m)

    def _exchange(self, wire: int, line: str) -> list[str]:
        """Send a line, and return the words of its answer; what came before it and other lines are dropped."""
        ends_s, text = time.monotonic() + self.timeout_s, ""
        while time.monotonic() < ends_s and select.select([wire], [], [], 0.0)[0]:
            self._read(wire)
        os.write(wire, f"{line}\n".encode("ascii"))
        while True:
            *lines, rest = text.split("\n")
            for words in map(str.split, lines):
                if words[:1] in (["OK"], ["ERR"]):
                    return words
            ready, _, _ = select.select([wire], [], [], max(0.0, ends_s - time.monotonic()))
            if len(rest) >= _ANSWER_BYTES or not ready:
                raise TimeoutError(text.strip())
            text += self._read(wire).decode("ascii", errors="replace")

    def _read(self, wire: int) -> bytes:
        if not (read := os.read(wire, _ANSWER_BYTES)):
            raise OSError("it has hung up")
        return read


class RosCommand(NamedTuple):
    """Message by which a gripper of ROS 2 takes a force."""

    topic: str
    """Topic, below the key of the gripper."""
    kind: str
    """Type of the message."""
    fields: Callable[[float], tuple[object, ...]]
    """Returns the fields of the message, in order, for a force in newtons."""


_GRIPPER_COMMAND = "control_msgs/msg/GripperCommand"
ROS_MESSAGES = {
    # closed as far as the effort brings it; some drivers take an effort of 0 for no limit
    "gripper-command": RosCommand("command", _GRIPPER_COMMAND, lambda n: (0.0, max(n, 0.01))),
    # forward controllers of ros2_control take a number a joint
    "controllers": RosCommand(
        "effort_controller/commands",
        "std_msgs/msg/Float64MultiArray",
        lambda n: (SimpleNamespace(dim=[], data_offset=0), np.array([n])),
    ),
}
"""Messages of grippers of ROS 2 by name."""
_STATE_TOPIC, _STATE_KIND = "joint_states", "sensor_msgs/msg/JointState"


class RosGripper:
    """A gripper of ROS 2, by topics over Zenoh; its state is `sensor_msgs/msg/JointState` on `joint_states`.

    The joint's position is the width in metres and its effort the force in newtons. Topics confirm nothing: a gripper
    without a valid state for `timeout_s` is a `GripperError` after each command, though the command was sent. Topics
    are below a key such as `gripper`, which ROS names `/gripper/command`. Parameters are those of `open_gripper`.
    """

    def __init__(
        self,
        key: str,
        address: str = ZENOH_ADDRESS,
        *,
        messages: str = "gripper-command",
        joint: str | None = None,
        timeout_s: float = 0.1,
    ) -> None:
        self._command, key = pick(ROS_MESSAGES, messages, noun="kind of gripper messages"), key.strip("/")
        self._ros = ZenohRos(address, purpose="a gripper of ROS 2")
        self._topic, self._joint, self.timeout_s = f"{key}/{_STATE_TOPIC}", joint, timeout_s
        self._message, self._message_s, self._new = b"", -math.inf, threading.Condition()
        try:
            # a type that ROS itself does not bring
            self._ros.define(_GRIPPER_COMMAND, "float64 position\nfloat64 max_effort")
            self._publish = self._ros.publisher(f"{key}/{self._command.topic}", self._command.kind)
            self._ros.subscribe(self._topic, _STATE_KIND, self._receive)
            self._await_state(3.0)
        except Exception as error:  # whatever Zenoh or a package's messages raise
            self.close()
            if isinstance(error, SliplensError):
                raise
            raise InputError(
                f"no gripper can be commanded at {key!r} ({error}); check the key and the kind of messages"
            ) from None

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons, and check that the gripper still sends its state."""
        try:
            self._publish(self._command.fields(force_n), time.time_ns())
        except OSError as error:
            raise GripperError(f"the gripper cannot be reached ({error}); check its bridge") from None
        self.read_state()

    def read_state(self) -> GripperState:
        """Return force and width from the newest state."""
        message = self._await_state(self.timeout_s)
        try:
            state = self._ros.decode(message, _STATE_KIND)
            at = 0 if self._joint is None else list(state.name).index(self._joint)
            force_n, width_m = float(state.effort[at]), float(state.position[at])
        except Exception as error:  # whatever a decoder does at foreign bytes
            raise GripperError(
                f"/{self._topic} has no force and width of {self._joint or 'a joint'} "
                f"({str(error) or type(error).__name__}); it has to be {_STATE_KIND} with position and effort"
            ) from None
        if not (math.isfinite(force_n) and math.isfinite(width_m)):
            raise GripperError(f"/{self._topic} has {force_n:g} N and {width_m:g} m; check the gripper's sensors")
        return GripperState(force_n=force_n, width_m=width_m)

    def close(self) -> None:
        """Close the connection."""
        self._ros.close()

    def _receive(self, message: bytes) -> None:
        with self._new:
            self._message, self._message_s = message, time.monotonic()
            self._new.notify_all()

    def _await_state(self, wait_s: float) -> bytes:
        with self._new:
            if not self._new.wait_for(lambda: time.monotonic() - self._message_s <= self.timeout_s, wait_s):
                raise GripperError(
                    f"the gripper sends no state on /{self._topic}; check its power, its driver and its bridge"
                )
            return self._message


def open_gripper(
    address: str, *, timeout_s: float = 0.1, messages: str = "gripper-command", joint: str | None = None
) -> LineGripper | RosGripper:
    """Open a gripper that speaks the line protocol (on Linux and macOS), or one of ROS 2.

    Parameters
    ----------
    address
        `tcp://host:port`, or a serial device such as `/dev/ttyUSB0`, whose speed was set before (`stty`); for ROS 2
        `zenoh:KEY`, or `zenoh:KEY@tcp/HOST:PORT`, by `zenoh-bridge-ros2dds` or `rmw_zenohd`.
    timeout_s
        Longest time until an answer, and largest age of a state of ROS 2, in seconds.
    messages
        Messages that a gripper of ROS 2 takes, a row of `ROS_MESSAGES`.
    joint
        Joint of the gripper among those in its state; the first if None.
    """
    if address.startswith("zenoh:"):
        key, where = parse_zenoh(address.removeprefix("zenoh:"), purpose="zenoh")
        return RosGripper(key, where, messages=messages, joint=joint, timeout_s=timeout_s)
    if not address.startswith("tcp://"):
        return LineGripper(partial(_open_serial, Path(address)), timeout_s=timeout_s, silence_s=_SILENCE_S)
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    if not host or not port.isdigit():
        raise InputError(f"{address} is no address of a gripper; write tcp://HOST:PORT")

    def connect() -> socket.socket:
        try:
            return socket.create_connection((host.strip("[]"), int(port)), timeout=timeout_s)
        except (OSError, OverflowError) as error:
            raise GripperError(f"no gripper answers at {address} ({error}); check its power and the port") from None

    return LineGripper(connect, timeout_s=timeout_s)


def _open_serial(path: Path) -> FileIO:
    """Open a serial device that passes bytes on unchanged."""
    if not path.exists():
        raise InputError(f"there is no serial device {path}; name one, or tcp://HOST:PORT, or zenoh:KEY for ROS 2")
    try:
        import termios  # noqa: PLC0415 (not on every system)
        import tty  # noqa: PLC0415 (not on every system)
    except ImportError:
        raise InputError("serial devices are opened on Linux and macOS alone; use tcp://HOST:PORT") from None
    try:
        stream = path.open("r+b", buffering=0)
        tty.setraw(stream.fileno())
        termios.tcflush(stream.fileno(), termios.TCIFLUSH)
    except (OSError, termios.error) as error:
        raise GripperError(f"{path} cannot be opened as a serial device ({error}); check who uses it") from None
    return stream


class DryRun:
    """A gripper that does nothing and records all forces, in newtons, in `sent`."""

    def __init__(self) -> None:
        self.sent: list[float] = []

    def set_force(self, force_n: float) -> None:
        """Record a force in newtons."""
        self.sent.append(force_n)

    def read_state(self) -> GripperState:
        """Return the last force, with a width of 0."""
        return GripperState(force_n=self.sent[-1] if self.sent else 0.0, width_m=0.0)

    def close(self) -> None:
        """Do nothing."""


class GuardedGripper(AbstractContextManager["GuardedGripper"]):
    """A gripper behind a guard: a ceiling that no force exceeds, and a watchdog that holds.

    When no command comes for `watchdog_s`, or the gripper fails at one in whatever way, the guard repeats the last
    force until commands return. A force of NaN holds, too.
    """

    def __init__(self, gripper: Gripper, *, ceiling_n: float = 4.0, watchdog_s: float = 0.2) -> None:
        for name, value in (("ceiling", ceiling_n), ("watchdog", watchdog_s)):
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"the {name} of a guarded gripper must be positive and finite, got {value:g}")
        self._gripper, self.ceiling_n, self._limit = gripper, ceiling_n, watchdog_s
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._force: float | None = None
        self._command_s = time.monotonic()
        self.failure: str | None = None
        """Last fault of the gripper; None while it takes its commands."""
        self._watch = threading.Thread(target=self._guard, name="sliplens gripper watchdog", daemon=True)
        self._watch.start()

    @property
    def holding(self) -> bool:
        """True while commands stay away or the gripper fails."""
        late = time.monotonic() - self._command_s > self._limit
        return self._force is not None and (late or self.failure is not None)

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons, between 0 and the ceiling; NaN holds."""
        with self._lock:
            self._command_s = time.monotonic()
            if not math.isnan(force_n):
                self._force = min(max(force_n, 0.0), self.ceiling_n)
            self._send()

    def read_state(self) -> GripperState:
        """Measure force and width."""
        with self._lock:
            return self._gripper.read_state()

    def stop(self) -> None:
        """Stop guarding; the gripper keeps the last force."""
        self._stop.set()
        self._watch.join()

    def close(self) -> None:
        """Stop guarding, and close the connection."""
        self.stop()
        self._gripper.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _send(self) -> None:
        try:
            if self._force is not None:
                self._gripper.set_force(self._force)
            self.failure = None
        except Exception as error:  # whatever it was: without the watchdog nothing holds
            self.failure = str(error) or type(error).__name__

    def _guard(self) -> None:
        while not self._stop.wait(self._limit / 4):
            with self._lock:
                if self.holding:
                    self._send()
