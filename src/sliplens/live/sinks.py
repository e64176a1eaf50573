"""Where readings go: one row a kind of sink."""

import sys
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import msgspec

from sliplens.errors import InputError
from sliplens.extras import Table
from sliplens.files import to_builtins
from sliplens.live.reading import Reading
from sliplens.recordings.capture import Frame


@runtime_checkable
class Sink(Protocol):
    """Takes readings, one after another."""

    def send(self, reading: Reading, image: Frame | None, /) -> None:
        """Send a reading, and the frame that it was made from where there is one."""
        ...

    def close(self) -> None:
        """Send what waits, and end."""
        ...


def encode_reading(reading: Reading) -> bytes:
    """One line of JSON; what is not known is null."""
    return msgspec.json.encode(to_builtins(reading))


class JsonLines:
    """One line of JSON a reading on standard output."""

    def send(self, reading: Reading, _: Frame | None, /) -> None:
        """Print a line, at once."""
        sys.stdout.buffer.write(encode_reading(reading) + b"\n")
        sys.stdout.buffer.flush()

    def close(self) -> None:
        """Nothing waits."""


def _open_json(address: str) -> Sink:
    if address:
        raise InputError(f"--sink json prints on standard output and takes no address, got {address}; leave it out")
    return JsonLines()


SINKS = Table[Callable[[str], Sink]]("sink", "sliplens.sinks", {"json": _open_json})
"""Sinks by kind, each opened with an address; an installed package adds its own by the entry point `sliplens.sinks`."""


def open_sink(name: str) -> Sink:
    """Open a sink by the name of its row, and its address after a colon where it has one.

    Raises
    ------
    InputError
        If there is no such sink, or it cannot be opened.
    """
    kind, _, address = name.partition(":")
    return SINKS.pick(kind)(address)


__all__ = ["SINKS", "JsonLines", "Sink", "encode_reading", "open_sink"]
