"""Out to a real gripper: one protocol, a line protocol over serial or TCP, and a guard that nothing gets past.

A guard stands between whatever controls and the gripper. It cuts every force at a ceiling, and when commands stop
coming it holds: the last force is told again, and nothing is opened. A dry run notes what would be sent and sends
nothing.
"""

import math
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedIOBase, RawIOBase
from pathlib import Path
from types import TracebackType
from typing import Protocol, runtime_checkable

from sliplens.errors import InputError, SliplensError

_ANSWER_BYTES = 200
"""Longer lines are no answers."""


class GripperError(SliplensError):
    """A gripper that does not answer, or answers something else than its protocol has."""


@dataclass(frozen=True, kw_only=True)
class GripperState:
    """What a gripper tells of itself."""

    force_n: float
    """Grip force measured, in newtons."""
    width_m: float
    """Opening between the fingers."""


@runtime_checkable
class Gripper(Protocol):
    """A parallel gripper that takes a force or a width."""

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons."""
        ...

    def set_width(self, width_m: float) -> None:
        """Open to so many metres."""
        ...

    def read_state(self) -> GripperState:
        """Measured force and width."""
        ...

    def close(self) -> None:
        """Let go of the connection, not of the object."""
        ...


class LineGripper:
    """A gripper spoken to in lines of ASCII, over a serial port or TCP.

    `F 1.250` sets the force in newtons, `W 0.0400` the width in metres, `S` asks; each is answered by one line,
    `OK force_n width_m` or `ERR reason`. A late, broken or foreign answer is a `GripperError`.

    Parameters
    ----------
    stream
        Anything that reads and writes bytes line by line; see `open_gripper`.
    """

    def __init__(self, stream: BufferedIOBase | RawIOBase, *, close: Callable[[], None] | None = None) -> None:
        self._stream, self._close = stream, close or stream.close

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons."""
        self._ask(f"F {force_n:.3f}")

    def set_width(self, width_m: float) -> None:
        """Open to so many metres."""
        self._ask(f"W {width_m:.4f}")

    def read_state(self) -> GripperState:
        """Measured force and width."""
        return self._ask("S")

    def close(self) -> None:
        """Let go of the connection."""
        self._close()

    def _ask(self, line: str) -> GripperState:
        try:
            self._stream.write(f"{line}\n".encode("ascii"))
            self._stream.flush()
            answer = self._stream.readline(_ANSWER_BYTES)
        except (OSError, ValueError) as error:
            raise GripperError(f"the gripper cannot be reached ({error}); check its cable and power") from None
        words = answer.decode("ascii", errors="replace").split()
        if not answer.endswith(b"\n"):
            raise GripperError(f"the gripper did not answer {line!r} in time; check its cable and power")
        if words[:1] == ["ERR"]:
            raise GripperError(f"the gripper refused {line!r}: {' '.join(words[1:]) or 'no reason told'}")
        try:
            said, force, width = words
            state = GripperState(force_n=float(force), width_m=float(width))
        except ValueError:
            said = ""
            state = GripperState(force_n=math.nan, width_m=math.nan)
        if said != "OK" or not (math.isfinite(state.force_n) and math.isfinite(state.width_m)):
            told = answer.decode("ascii", errors="replace").strip()
            raise GripperError(
                f"the gripper answered {told!r} to {line!r}, not `OK force_n width_m`; check its protocol"
            )
        return state


def open_gripper(address: str, *, timeout_s: float = 0.1) -> LineGripper:
    """Open a gripper that speaks the line protocol.

    Parameters
    ----------
    address
        `tcp://host:port`, or a serial device such as `/dev/ttyUSB0`, whose speed was set before (`stty`).
    timeout_s
        Time, in seconds, within which an answer has to come.

    Raises
    ------
    InputError
        If the address is none.
    GripperError
        If nobody is there.
    """
    if address.startswith("tcp://"):
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        if not host or not port.isdigit():
            raise InputError(f"{address} is no address of a gripper; write tcp://HOST:PORT")
        try:
            connection = socket.create_connection((host.strip("[]"), int(port)), timeout=timeout_s)
        except (OSError, OverflowError) as error:
            raise GripperError(f"no gripper answers at {address} ({error}); check its power and the port") from None
        stream = connection.makefile("rwb")

        def close() -> None:
            with suppress(OSError):  # what was not sent to a gripper that is gone
                stream.close()
            connection.close()

        return LineGripper(stream, close=close)
    return _open_serial(Path(address), timeout_s)


def _open_serial(path: Path, timeout_s: float) -> LineGripper:
    """Open a serial device; reading ends after the timeout, so that a silent gripper is noticed."""
    if not path.exists():
        raise InputError(f"there is no serial device {path}; name one, or tcp://HOST:PORT")
    try:
        import termios  # noqa: PLC0415 (not on every system)
    except ImportError:
        raise InputError("serial devices are opened on Linux and macOS alone; use tcp://HOST:PORT") from None
    try:
        stream = path.open("r+b", buffering=0)
        settings = termios.tcgetattr(stream.fileno())
        settings[3] &= ~(termios.ICANON | termios.ECHO)
        settings[6][termios.VMIN], settings[6][termios.VTIME] = 0, max(1, round(10 * timeout_s))
        termios.tcsetattr(stream.fileno(), termios.TCSANOW, settings)
    except (OSError, termios.error) as error:
        raise GripperError(f"{path} cannot be opened as a serial device ({error}); check who uses it") from None
    return LineGripper(stream)


class DryRun:
    """A gripper that is told everything and does nothing: what would have been sent is kept in `sent`."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self._force_n, self._width_m = 0.0, 0.0

    def set_force(self, force_n: float) -> None:
        """Note a force in newtons."""
        self.sent.append(f"F {force_n:.3f}")
        self._force_n = force_n

    def set_width(self, width_m: float) -> None:
        """Note a width in metres."""
        self.sent.append(f"W {width_m:.4f}")
        self._width_m = width_m

    def read_state(self) -> GripperState:
        """Force and width that were told last."""
        return GripperState(force_n=self._force_n, width_m=self._width_m)

    def close(self) -> None:
        """Do nothing."""


class GuardedGripper:
    """A gripper behind a guard: a ceiling that no force passes, and a watchdog that holds.

    When no command comes for `watchdog_s`, or the gripper failed to take one, the guard holds: it tells the last force
    again and again until commands return, and never opens. A force that is no number holds, too; a width is refused
    while holding, for opening drops what is held.

    Parameters
    ----------
    gripper
        What is guarded.
    ceiling_n
        Grip force, in newtons, that is never passed.
    watchdog_s
        Time without a command, in seconds, after which it holds.
    """

    def __init__(self, gripper: Gripper, *, ceiling_n: float = 4.0, watchdog_s: float = 0.2) -> None:
        for name, value in (("ceiling", ceiling_n), ("watchdog", watchdog_s)):
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"the {name} of a guarded gripper must be positive and finite, got {value:g}")
        self._gripper, self._ceiling, self._limit = gripper, ceiling_n, watchdog_s
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._force: float | None = None
        self._heard = time.monotonic()
        self.failure: str | None = None
        """What the gripper last failed at; None while it takes its commands."""
        self._holding = False
        self._watch = threading.Thread(target=self._guard, name="sliplens gripper watchdog", daemon=True)
        self._watch.start()

    @property
    def holding(self) -> bool:
        """Whether the guard holds, for commands stay away or the gripper fails."""
        return self._holding

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons, at most the ceiling, at least none; what is no number holds."""
        with self._lock:
            self._heard = time.monotonic()
            if not math.isnan(force_n):
                self._force = min(max(force_n, 0.0), self._ceiling)
            self._tell()
            self._holding = self.failure is not None

    def set_width(self, width_m: float) -> None:
        """Open to so many metres; refused while holding."""
        with self._lock:
            if self._holding:
                raise GripperError("the guard holds the object and opens nothing; send a force first")
            self._heard, self._force = time.monotonic(), None
            self._gripper.set_width(width_m)

    def read_state(self) -> GripperState:
        """Measured force and width."""
        with self._lock:
            return self._gripper.read_state()

    def close(self) -> None:
        """Stop guarding and let go of the connection; the gripper keeps the last force it was told."""
        self._stop.set()
        self._watch.join()
        self._gripper.close()

    def __enter__(self) -> "GuardedGripper":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _tell(self) -> None:
        if self._force is None:
            return
        try:
            self._gripper.set_force(self._force)
            self.failure = None
        except (SliplensError, OSError) as error:
            self.failure = str(error)

    def _guard(self) -> None:
        while not self._stop.wait(self._limit / 4):
            with self._lock:
                late = time.monotonic() - self._heard > self._limit
                if late or self.failure is not None:
                    self._holding = True
                    self._tell()


__all__ = ["DryRun", "Gripper", "GripperError", "GripperState", "GuardedGripper", "LineGripper", "open_gripper"]
