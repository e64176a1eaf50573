"""Hold with a gripper by the margins of one or two running fingertips."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from threading import Event

import numpy as np

from sliplens.codec import save_result
from sliplens.errors import InputError
from sliplens.files import output_folder
from sliplens.grip.controllers import (
    AssumedFriction,
    Controller,
    Holder,
    HoldStep,
    MarginLaw,
    Oracle,
    make_controller,
)
from sliplens.grip.gripper import DryRun, Gripper, GripperError, GripperState, GuardedGripper, open_gripper
from sliplens.grip.plant import PERIOD_S
from sliplens.grip.records import Ending, Hold, HoldSteps
from sliplens.grip.source import GripSource
from sliplens.live.contract import Pace
from sliplens.live.loop import LiveReader
from sliplens.live.reading import LiveFrame, Reading

_STUCK_S, _STUCK_M = 2.0, 1e-4
"""Time in which a gripper without any force has to close by a tenth of a millimetre; the simulated one opens for 1.5 s
first."""


def hold_grip(
    readers: LiveReader | Sequence[LiveReader],
    gripper: Gripper | str,
    *,
    controller: str | Controller = "margin",
    settings: Mapping[str, float] | None = None,
    ceiling_n: float = 4.0,
    seconds: float | None = None,
    on_step: Callable[[HoldStep], None] | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
) -> Hold:
    """Hold with a gripper: 60 times a second a controller sets the grip force by the fingertips' margins.

    Each reading is paired with the grip force at the time of its frame. Without a margin, and when the readings stop,
    the grip is never loosened; at the end, by Ctrl-C too, the gripper keeps the last commanded force. No force exceeds
    the ceiling, and a watchdog repeats the last command when no other comes (`GuardedGripper`).

    Parameters
    ----------
    readers
        Entered reader of a fingertip, or two of both fingertips of the gripper.
    gripper
        Gripper, or an address as in `open_gripper`, whose connection is closed at the end; `simulated` for the gripper
        of the source `grip`; `dry-run` to record commands as if the gripper obeyed at once.
    controller
        Name of a controller (docs/grip.md), or an object with `command(observation)`.
    settings
        Constants of a row to change, in its units (newtons, seconds, shares).
    ceiling_n
        Largest grip force.
    seconds
        Duration; with the source if None.
    on_step
        Called after each command; a slow call delays the next command, and an exception ends the hold and is raised
        again once the result is saved.
    out
        Folder to save the result in; none if None.
    overwrite
        If True, replace a folder that exists.

    Raises
    ------
    InputError
        If there is no such controller or gripper, or they do not go together.
    GripperError
        If no gripper answers at the address.

    See Also
    --------
    run_episodes : Simulate grips first.
    LiveReader : Reader of a running fingertip.

    Examples
    --------
    >>> import sliplens as sl
    >>> with sl.LiveReader("simulated", "chromatouch-pair", engine="torch") as reader:
    ...     hold = sl.hold_grip(reader, "dry-run", ceiling_n=3.0, seconds=0.2)
    >>> bool((hold.steps.command_n >= 2).all())  # lifted with 2 N, whatever the margin
    True
    >>> hold.why
    'the time is over; nothing was sent'
    """
    if seconds is not None and not seconds > 0:
        raise InputError(f"seconds must be positive, got {seconds:g}")
    readers = [readers] if isinstance(readers, LiveReader) else list(readers)
    _require_fit(make_controller(controller, settings), readers)
    with ExitStack() as stack:
        address = gripper if isinstance(gripper, str) else type(gripper).__name__
        if gripper == "simulated":
            if not isinstance(simulated := readers[0].source, GripSource):
                raise InputError(f"`simulated` is the gripper of the source `grip`; {simulated.name} has none")
            gripper = simulated
        elif gripper == "dry-run":
            gripper = DryRun()
        elif isinstance(gripper, str):
            gripper = stack.enter_context(closing(open_gripper(gripper)))
        name = controller if isinstance(controller, str) else type(controller).__name__
        recipe = {"gripper": address, "controller": name, "begun_s": time.time()}  # no two holds are the same
        output = None
        if out is not None:
            folder = output_folder(Path(out), stage="hold", config=recipe, overwrite=overwrite, resumable=False)
            output = stack.enter_context(folder)
        guard = GuardedGripper(gripper, ceiling_n=ceiling_n)
        stack.callback(guard.stop)
        loop = HoldLoop(guard, readers, controller, settings)
        for finger, reader in enumerate(readers):
            stack.callback(reader.subscribe(partial(loop.update_reading, finger)))
        ended, why = loop.run(seconds, on_step or (lambda _: None))
        last = "the gripper got no command"
        if loop.steps:
            last = f"the gripper keeps the last command of {loop.steps[-1].command_n:.2f} N"
        names = ("time_s", "command_n", "force_n", "margin", "low")
        numbers = {name: np.array([getattr(step, name) for step in loop.steps], dtype=float) for name in names}
        hold = Hold(
            sources=tuple(reader.source.name for reader in readers),
            gripper=address,
            controller=name,
            settings=dict(settings or {}),
            ceiling_n=ceiling_n,
            ended=ended,
            why=f"{why}; {'nothing was sent' if address == 'dry-run' else last}",
            troubles=tuple(loop.troubles),
            steps=HoldSteps(
                **numbers,
                slip=np.array([step.slip for step in loop.steps], dtype=bool),
                failed=np.array([step.trouble is not None for step in loop.steps], dtype=bool),
                why=np.array([step.why for step in loop.steps], dtype=str),
            ),
        )
        if output is not None:
            save_result(hold, output.folder)
    if loop.error is not None:
        raise loop.error
    return hold


class HoldLoop:
    """Loop of a hold: measure, decide, command."""

    def __init__(
        self,
        guard: GuardedGripper,
        readers: Sequence[LiveReader],
        controller: str | Controller,
        settings: Mapping[str, float] | None = None,
    ) -> None:
        self._guard, self._readers, trouble = guard, readers, None
        self.steps: list[HoldStep] = []
        self.troubles: dict[str, None] = {}
        """Faults of the gripper, in the order in which they first came."""
        for _ in range(30):  # half a second: a driver may start late
            state, trouble = self._measure()
            if not math.isnan(state.force_n):
                break
            time.sleep(PERIOD_S)
        else:
            raise GripperError(
                f"the gripper measures no force to begin with ({trouble or 'not a number'}), and got no command; check "
                "its connection"
            )
        self._closing: tuple[float, float, float] | None = None
        """Time of the last motion of the fingers without any force, and the range of their opening since; None once
        they pressed."""
        self._holder = Holder(
            controller,
            settings=settings,
            ceiling_n=guard.ceiling_n,
            command_n=min(max(state.force_n, 0.0), guard.ceiling_n),  # what is held already stays held
            fingers=len(readers),
        )

    def update_reading(self, finger: int, reading: Reading, _: LiveFrame | None) -> None:
        """Take a reading, in the thread of its reader."""
        self._holder.update_reading(reading, taken_s=reading.captured_s, finger=finger)

    def run(self, seconds: float | None, on_step: Callable[[HoldStep], object]) -> tuple[Ending, str]:
        """Hold until the end; returns its kind and reason. What a gripper or callback raises is in `error`."""
        begun_s, pace = time.monotonic(), Pace(Event())
        self.error: Exception | None = None
        try:
            for number in count():
                pace.wait(number * PERIOD_S)
                ends = [reader.ended for reader in self._readers]
                if None not in ends:
                    failed = any(reader.error is not None for reader in self._readers)
                    return "failed" if failed else "source", ", ".join(map(str, ends))
                if seconds is not None and time.monotonic() - begun_s >= seconds:
                    break
                on_step(self.step(begun_s))
        except KeyboardInterrupt:
            return "interrupted", "interrupted"
        except Exception as error:  # whatever a callback raises: the result is saved first
            self.error = error
            return "failed", str(error) if isinstance(error, GripperError) else f"{type(error).__name__} ({error})"
        return "time", "the time is over"

    def step(self, begun_s: float) -> HoldStep:
        """Measure the force, and command the next one."""
        state, trouble = self._measure()
        now_s = time.monotonic()
        decision = self._holder.grip_force(now_s, state.force_n)
        self._require_force(state, now_s)
        try:
            self._guard.set_force(decision.command_n)
        finally:  # an interrupted command was sent, too
            trouble = self._guard.failure or trouble or decision.trouble
            if trouble is not None:
                self.troubles[trouble] = None
            step = replace(decision, time_s=now_s - begun_s, trouble=trouble)
            self.steps.append(replace(step, readings=()))
        return step

    def _measure(self) -> tuple[GripperState, str | None]:
        """Return the state of the gripper, NaN where it gives none, and its fault."""
        try:
            return self._guard.read_state(), None
        except Exception as error:  # whatever a driver raises: the hold goes on
            return GripperState(force_n=math.nan, width_m=math.nan), str(error) or type(error).__name__

    def _require_force(self, state: GripperState, now_s: float) -> None:
        """Refuse a gripper that measures no force from the start although its fingers have stopped."""
        if math.isnan(state.width_m):
            return
        if self._holder.touched_s is not None or not self.steps:
            self._closing = None
            return
        since_s, low_m, high_m = self._closing or (now_s, state.width_m, state.width_m)
        if not low_m - _STUCK_M <= state.width_m <= high_m + _STUCK_M:
            since_s = now_s
        # a width that was measured before is noise, not motion
        self._closing = since_s, min(low_m, state.width_m), max(high_m, state.width_m)
        command_n = self.steps[-1].command_n
        if now_s - since_s > _STUCK_S and command_n > 0:
            raise GripperError(
                f"the gripper measures {state.force_n:.2f} N and its fingers do not move, {_STUCK_S:g} s after "
                f"{command_n:.2f} N was commanded; without a force sensor, or with forces of the other sign, it cannot "
                "be held by the margin: check its driver"
            )


def _require_fit(controller: Controller, readers: Sequence[LiveReader]) -> None:
    """Refuse readers that cannot hold together, and a controller that needs more than they provide."""
    if len(readers) not in {1, 2}:
        raise InputError(f"a gripper has one or two readers, got {len(readers)}")
    if isinstance(controller, AssumedFriction):
        raise InputError("this controller needs a force sensor at the wrist; choose margin, reflex or fixed")
    for reader in readers:
        reader.require_entered()
        name = reader.source.name
        if isinstance(controller, Oracle):
            if not reader.source.simulated:
                raise InputError(f"this controller needs the true margin, which {name} does not have; choose margin")
        elif isinstance(controller, MarginLaw) and reader.network is None:
            raise InputError(f"this controller needs margins, and {name} has no network; name one with --network")
