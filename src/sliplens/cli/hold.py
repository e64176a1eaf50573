"""`sliplens hold`."""

import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import tyro

from sliplens.cli.command import Command, Device, Friction, InOrder, SameObject
from sliplens.cli.console import say, wrote
from sliplens.cli.grip import constant
from sliplens.errors import InputError, SliplensError
from sliplens.files import to_builtins
from sliplens.progress import number_of

if TYPE_CHECKING:
    from sliplens.grip.hold import HoldStep
    from sliplens.live import LiveReader

_SOURCES = "One source or two, a fingertip each: grip (simulated), number of a camera, address of a stream, or a video."


@dataclass(frozen=True, kw_only=True)
class Hold(Command):
    """Hold with a real gripper: its force follows the margins of its fingertips, and is never loosened blindly.

    Ends with Ctrl-C, after --seconds or with the source; the gripper keeps the last commanded force.
    """

    sources: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE [SOURCE]", help=_SOURCES)]
    gripper: str | None = None
    """tcp://HOST:PORT or /dev/ttyUSB0 (lines of ASCII), zenoh:KEY (ROS 2), or simulated (that of the source grip)."""
    dry_run: bool = False
    """Send nothing: show the commands, as if the gripper obeyed at once."""
    controller: str = "margin"
    """margin, proportional, reflex or fixed, or one of an installed package."""
    set: tuple[str, ...] = ()
    """Constants of the controller to change, such as --set target=0.4 least_n=1."""
    ceiling: float = 4.0
    """Largest grip force, in newtons."""
    watchdog: float = 0.2
    """Time without a command after which the last force is repeated, in seconds."""
    messages: str = "gripper-command"
    """Messages of a gripper of ROS 2: gripper-command, numbers or controllers."""
    joint: str | None = None
    """Joint of a gripper of ROS 2 that measures width and force; the first if not given."""
    network: str | None = None
    """Folder or name of a trained network. If not given, that of the profile; chromatouch-pair for what is
    simulated, else none."""
    reference: tuple[Path, ...] = ()
    """Image of each untouched sensor; taken when the picture is still at first if not given."""
    friction: Friction = None
    same_object: SameObject = False
    sequence: InOrder = False
    sensor: str | None = None
    """Profile of the sensors, a file or a name such as digit."""
    seconds: float | None = None
    """Time after which it ends."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Folder to save commands, measurements and margins in; its steps.parquet has a row a command."""
    json: bool = False
    """Print a line of JSON a command, with the readings; else a line a second."""
    engine: Literal["auto", "torch", "openvino"] = "auto"
    """Engine that runs the network; auto is the fastest that is installed."""
    device: Device = "cpu"

    def run(self) -> None:
        """Hold until it ends."""
        from sliplens.grip.controllers import make_controller
        from sliplens.grip.gripper import open_gripper
        from sliplens.grip.hold import GRIPPERS, hold_grip

        gripper = "dry-run" if self.dry_run else self.gripper
        if gripper is None:
            raise InputError("no gripper is named; name one with --gripper, or see the commands with --dry-run")
        settings = dict(map(constant, self.set))
        make_controller(self.controller, settings)  # refused before a network is made ready
        with ExitStack() as stack:
            if gripper not in GRIPPERS:
                opened = open_gripper(gripper, messages=self.messages, joint=self.joint)
                gripper = stack.enter_context(closing(opened))
            readers = [stack.enter_context(reader) for reader in self._readers()]
            hold = self.call(
                hold_grip,
                source=readers,
                gripper=gripper,
                network=None,
                settings=settings,
                ceiling_n=self.ceiling,
                watchdog_s=self.watchdog,
                out=self.output,
                on_step=_Steps(readers, json=self.json),
            )
        say(hold.why, aside=True)
        for source, reader in zip(self.sources, readers, strict=True):
            if reader.lesson is not None:
                say(f"{source}: {reader.lesson}" if len(readers) > 1 else reader.lesson, aside=True)
        if self.output is not None:
            wrote(self.output, number_of(len(hold.steps), "command"))
        if hold.ended == "failed":
            raise SliplensError(hold.why)

    def _readers(self) -> "list[LiveReader]":
        from sliplens.grip.source import open_grip, usual_network
        from sliplens.live import LiveReader
        from sliplens.live.contract import LiveOptions
        from sliplens.models import load
        from sliplens.recordings.sensor import load_profile

        if self.reference and len(self.reference) != len(self.sources):
            raise InputError(f"--reference takes an image a source, {len(self.sources)}, got {len(self.reference)}")
        common = {name: getattr(self, name) for name in ("friction", "same_object", "sequence", "engine")}
        profile = common["sensor"] = None if self.sensor is None else load_profile(self.sensor)
        sources = [open_grip(source, LiveOptions()) or source for source in self.sources]
        names = [self.network or usual_network(source, profile) for source in sources]
        networks = {name: load(name, device=self.device) for name in dict.fromkeys(names) if name is not None}
        references = self.reference or [None] * len(sources)
        return [
            LiveReader(source, None if name is None else networks[name], reference=reference, **common)
            for source, name, reference in zip(sources, names, references, strict=True)
        ]


class _Steps:
    """Prints each command as a line of JSON, or one a second, and each trouble and doubt once."""

    def __init__(self, readers: "Sequence[LiveReader]", *, json: bool) -> None:
        self._readers, self._json, self._printed_s, self._printed = readers, json, -1.0, set[str]()

    def __call__(self, step: "HoldStep") -> None:
        for words in (step.trouble, *(doubt for reader in self._readers for doubt in reader.doubts)):
            if words is not None and words not in self._printed:
                self._printed.add(words)
                say(words, aside=True)
        if self._json:
            print(msgspec.json.encode(to_builtins(step)).decode(), flush=True)
        elif time.monotonic() - self._printed_s >= 1:
            self._printed_s = time.monotonic()
            say(str(step))
