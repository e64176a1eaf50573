"""Hold with a gripper by what one or two running fingertips read."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import Literal

import numpy as np

from sliplens.codec import save_result
from sliplens.errors import InputError
from sliplens.files import output_folder
from sliplens.grip.controllers import (
    STALE_S,
    Answer,
    AssumedFriction,
    Controller,
    Holder,
    MarginGrip,
    Oracle,
    make_controller,
)
from sliplens.grip.gripper import DryRun, Gripper, GripperError, GripperState, GuardedGripper, open_gripper
from sliplens.grip.plant import PERIOD_S
from sliplens.grip.source import GripSource, open_grip, usual_network
from sliplens.live.contract import LiveOptions, LiveSource, Pace
from sliplens.live.loop import LiveReader
from sliplens.live.reading import LiveFrame, Reading, describe_reading
from sliplens.models.checkpoint import Network
from sliplens.results.grip import Hold, HoldSteps

GRIPPERS = {
    "simulated": "the gripper of the source `grip`",
    "dry-run": "none: what would be sent is noted",
}
"""Names of grippers that are no address, and what they are."""

_TRIES = 30  # at the first force, for half a second: a driver may not have heard of it yet
_STUCK_S, _STUCK_M = 2.0, 1e-4
"""Time in which a gripper without any force has to close by a tenth of a millimetre; the simulated one opens for 1.5 s
first."""


@dataclass(frozen=True, kw_only=True)
class HoldStep:
    """One command to a gripper, and what it answers."""

    time_s: float
    """Since the hold began."""
    command_n: float
    """Grip force that was told."""
    force_n: float
    """Grip force that the gripper measured before; NaN where it told none."""
    margin: float
    """Safety margin read, the mean of the fingertips that read; NaN where none does."""
    low: float
    """Lower end of its interval, in margin units."""
    slip: bool
    """Whether the markers told a slip."""
    why: str
    trouble: str | None
    """What the gripper failed at; None while it takes its commands and its force follows them."""
    readings: tuple[Reading | None, ...]
    """Newest reading of each fingertip; None before the first."""

    def __str__(self) -> str:
        several = len(self.readings) > 1
        words = [
            (f"fingertip {number}: " if several else "") + str(describe_reading(reading))
            for number, reading in enumerate(self.readings, start=1)
            if reading is not None
        ]
        told = f"{self.time_s:8.2f} s  {self.command_n:5.2f} N told, {self.force_n:5.2f} N measured  {self.why}"
        return "; ".join([told, *words])


def hold_grip(
    source: LiveReader | LiveSource | Path | str | Sequence[LiveReader],
    gripper: Gripper | str,
    *,
    network: Network | Path | str | None = None,
    controller: str | Controller = "margin",
    settings: Mapping[str, float] | None = None,
    ceiling_n: float = 4.0,
    watchdog_s: float = 0.2,
    seconds: float | None = None,
    on_step: Callable[[HoldStep], None] | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
) -> Hold:
    """Hold with a gripper: 60 times a second a controller answers what the fingertips read with a grip force.

    Each reading is paired with the grip force that was measured when its frame was taken. While no margin is read, and
    when the reading stops, nothing is loosened; at the end, by Ctrl-C too, the gripper keeps the force that it was told
    last. No force passes the ceiling, and a watchdog tells the last one again when no command comes (`GuardedGripper`).

    Parameters
    ----------
    source
        Reader that was entered, or two for both fingertips of the gripper; or a source that `LiveReader` takes, or
        `grip` for a simulated gripper (`GripSource`), read by `network` until the hold ends.
    gripper
        Gripper, or an address as `open_gripper` takes it, whose connection is closed at the end; `simulated` for the
        gripper of the source `grip`; `dry-run` to note what would be sent, as if it were obeyed at once.
    network
        Network that reads a source; for `grip` and `simulated` that of the package if None.
    controller
        Row of `CONTROLLERS`, or anything with `command(observation)`.
    settings
        Constants of a row to change, in its units (newtons, seconds, shares).
    ceiling_n
        Grip force that is never passed.
    watchdog_s
        Time without a command after which the last force is told again, in seconds.
    seconds
        Time after which it ends; with the source if None.
    on_step
        Called after each command; what takes long delays the next, and what it raises ends the hold and is raised
        again once the result is kept.
    out
        Folder to keep the result in; in memory alone if None.
    overwrite
        Whether to replace a folder that is there.

    Raises
    ------
    InputError
        If there is no such source, network, controller or gripper, or they do not go together.
    GripperError
        If nobody answers at the gripper's address.

    Examples
    --------
    >>> import sliplens as sl
    >>> with sl.LiveReader("simulated", "chromatouch-pair", engine="torch") as reader:
    ...     hold = sl.hold_grip(reader, "dry-run", ceiling_n=3.0, seconds=0.2)
    >>> bool((hold.steps.command_n >= 2).all())  # lifted with 2 N, whatever is read
    True
    >>> hold.why
    'the time is over; nothing was sent'
    """
    if seconds is not None and not seconds > 0:
        raise InputError(f"seconds must be positive, got {seconds:g}")
    if settings and not isinstance(controller, str):
        raise InputError("settings change a controller that is named; give your own as it is to be")
    with ExitStack() as stack:
        address = gripper if isinstance(gripper, str) else type(gripper).__name__
        if isinstance(gripper, str) and gripper not in GRIPPERS:
            gripper = stack.enter_context(closing(open_gripper(gripper)))
        readers = _readers(source, network, stack)
        _require_fit(make_controller(controller, settings) if isinstance(controller, str) else controller, readers)
        if isinstance(gripper, str):
            gripper = DryRun() if gripper == "dry-run" else _simulated(readers[0])
        name = controller if isinstance(controller, str) else type(controller).__name__
        recipe = {"gripper": address, "controller": name, "begun_s": time.time()}  # no two holds are the same
        kept = None
        if out is not None:
            kept = output_folder(Path(out), stage="hold", config=recipe, overwrite=overwrite, resumable=False)
        output = None if kept is None else stack.enter_context(kept)
        guard = GuardedGripper(gripper, ceiling_n=ceiling_n, watchdog_s=watchdog_s)
        stack.callback(guard.stop)
        holding = _Holding(guard, readers, controller, settings, ceiling_n)
        for finger, reader in enumerate(readers):
            stack.callback(reader.subscribe(partial(holding.hear, finger)))
        ended, why, error = holding.run(seconds, on_step)
        hold = Hold(
            sources=tuple(reader.source.name for reader in readers),
            gripper=address,
            controller=name,
            settings=dict(settings or {}),
            ceiling_n=ceiling_n,
            watchdog_s=watchdog_s,
            ended=ended,
            why=f"{why}; {'nothing was sent' if address == 'dry-run' else holding.kept}",
            troubles=tuple(holding.troubles),
            steps=holding.steps(),
        )
        if output is not None:
            save_result(hold, output.folder)
    if error is not None:
        raise error
    return hold


class _Holding:
    """The loop of a hold: measure, answer, tell."""

    def __init__(
        self,
        guard: GuardedGripper,
        readers: Sequence[LiveReader],
        controller: str | Controller,
        settings: Mapping[str, float] | None,
        ceiling_n: float,
    ) -> None:
        self._guard, self._readers = guard, readers
        self._readings: list[Reading | None] = [None] * len(readers)
        self._rows: list[tuple[float, Answer, float, bool]] = []
        self.troubles: dict[str, None] = {}
        """What the gripper failed at, in the order in which it first did."""
        force_n = self._first_force()
        self._closes: tuple[float, float, float] | None = None
        """Time at which the fingers last moved without any force, and their opening then; None once they pressed."""
        self._holder = Holder(
            controller,
            settings=settings,
            ceiling_n=ceiling_n,
            command_n=min(force_n, ceiling_n) if force_n > 0 else 0.0,  # what is held already is not let go
            fingers=len(readers),
        )

    def hear(self, finger: int, reading: Reading, _: LiveFrame | None) -> None:
        """Take a reading, in the thread that reads."""
        self._readings[finger] = reading
        self._holder.hear(reading, taken_s=reading.captured_s, finger=finger)

    def run(
        self, seconds: float | None, on_step: Callable[[HoldStep], None] | None
    ) -> tuple[Literal["time", "source", "failed", "interrupted"], str, Exception | None]:
        """Hold until it ends; tells how, and what `on_step` raised."""
        begun_s = time.monotonic()
        pace, number = Pace(Event()), 0
        try:
            while pace.wait(number * PERIOD_S):
                number += 1
                ends = [reader.ended for reader in self._readers]
                if None not in ends:
                    failed = any(reader.failed for reader in self._readers)
                    return "failed" if failed else "source", ", ".join(map(str, ends)), None
                if seconds is not None and time.monotonic() - begun_s >= seconds:
                    break
                try:
                    step = self._step(begun_s)
                except GripperError as error:
                    return "failed", str(error), error
                if on_step is not None:
                    try:
                        on_step(step)
                    except Exception as error:  # whoever is told no more: what was held is kept none the less
                        return "failed", f"who is told of each step failed ({error or type(error).__name__})", error
        except KeyboardInterrupt:
            return "interrupted", "interrupted", None
        return "time", "the time is over", None

    @property
    def kept(self) -> str:
        """What the gripper goes on doing."""
        if not self._rows:
            return "the gripper was told nothing"
        return f"the gripper keeps the {self._rows[-1][1].command_n:.2f} N that it was told last"

    def steps(self) -> HoldSteps:
        """All commands so far."""
        times, answers, forces, failed = zip(*self._rows, strict=True) if self._rows else ((),) * 4
        return HoldSteps(
            time_s=np.array(times, dtype=np.float64),
            command_n=np.array([one.command_n for one in answers], dtype=np.float64),
            force_n=np.array(forces, dtype=np.float64),
            margin=np.array([one.margin for one in answers], dtype=np.float64),
            low=np.array([one.low for one in answers], dtype=np.float64),
            slip=np.array([one.slip for one in answers], dtype=bool),
            failed=np.array(failed, dtype=bool),
            why=np.array([one.why for one in answers], dtype=str),
        )

    def _step(self, begun_s: float) -> HoldStep:
        state, trouble = self._measure()
        now_s, force_n = time.monotonic(), state.force_n
        answer = self._holder.answer(now_s, force_n)
        self._require_force(state, now_s)
        try:
            self._guard.set_force(answer.command_n)
        finally:  # interrupted, it was told none the less
            trouble = self._guard.failure or trouble or answer.trouble
            if trouble is not None:
                self.troubles[trouble] = None
            self._rows.append((now_s - begun_s, answer, force_n, trouble is not None))
        return HoldStep(
            time_s=now_s - begun_s,
            command_n=answer.command_n,
            force_n=force_n,
            margin=answer.margin,
            low=answer.low,
            slip=answer.slip,
            why=answer.why,
            trouble=trouble,
            readings=tuple(
                replace(one, margin=None, low=None, high=None, withheld="the newest margin is too old")
                if one is not None and one.margin is not None and now_s - one.captured_s > STALE_S
                else one
                for one in self._readings
            ),
        )

    def _first_force(self) -> float:
        """Grip force before anything is told: who does not know it would let go of what is held."""
        trouble = None
        for _ in range(_TRIES):
            state, trouble = self._measure()
            if not math.isnan(state.force_n):
                return state.force_n
            time.sleep(PERIOD_S)
        raise GripperError(
            f"the gripper tells no force to begin with ({trouble or 'no number'}); check its connection: it was told "
            "nothing"
        )

    def _measure(self) -> tuple[GripperState, str | None]:
        """State of the gripper; NaN and what it failed at where it gives none."""
        try:
            return self._guard.read_state(), None
        except Exception as error:  # whatever a driver raises: what is held is held on
            return GripperState(force_n=math.nan, width_m=math.nan), str(error) or type(error).__name__

    def _require_force(self, state: GripperState, now_s: float) -> None:
        """Refuse a gripper that has measured no force from the start, though its fingers have stopped."""
        if math.isnan(state.width_m):
            return
        if self._holder.touched or not self._rows:
            self._closes = None
            return
        since_s, low_m, high_m = self._closes or (now_s, state.width_m, state.width_m)
        if not low_m - _STUCK_M <= state.width_m <= high_m + _STUCK_M:
            since_s = now_s
        # widths that were measured before are noise, not a motion
        self._closes = since_s, min(low_m, state.width_m), max(high_m, state.width_m)
        if now_s - since_s > _STUCK_S and self._rows[-1][1].command_n > 0:
            raise GripperError(
                f"the gripper measures {state.force_n:.2f} N and its fingers do not move, {_STUCK_S:g} s after "
                f"{self._rows[-1][1].command_n:.2f} N was commanded; without a force sensor, or with forces of the "
                "other sign, it cannot be held by the margin: check its driver"
            )


def _readers(
    source: LiveReader | LiveSource | Path | str | Sequence[LiveReader],
    network: Network | Path | str | None,
    stack: ExitStack,
) -> list[LiveReader]:
    """Readers of the fingertips; one that is made here reads until the stack is left."""
    if isinstance(source, LiveSource | Path | str):
        if isinstance(source, str):
            source = open_grip(source, LiveOptions()) or source
        return [stack.enter_context(LiveReader(source, network or usual_network(source, None)))]
    readers = [source] if isinstance(source, LiveReader) else list(source)
    if len(readers) not in {1, 2}:
        raise InputError(f"a gripper has one or two fingertips that are read, got {len(readers)}")
    if network is not None:
        raise InputError("a reader has its own network; name it where the reader is made")
    if not all(reader.entered for reader in readers):
        raise InputError("nothing is read yet; enter the reader first, with `with reader:`")
    return readers


def _require_fit(controller: Controller, readers: Sequence[LiveReader]) -> None:
    """Refuse a controller that needs what these readers do not tell."""
    if isinstance(controller, AssumedFriction):
        raise InputError("this controller needs a force sensor at the wrist; choose margin, reflex or fixed")
    for reader in readers:
        name = reader.source.name
        if isinstance(controller, Oracle):
            if not reader.source.simulated:
                raise InputError(f"this controller needs the true margin, which {name} does not tell; choose margin")
        elif isinstance(controller, MarginGrip) and reader.network is None:
            raise InputError(f"this controller needs margins, and no network reads {name}; name one with --network")


def _simulated(reader: LiveReader) -> GripSource:
    if not isinstance(reader.source, GripSource):
        raise InputError(f"`simulated` is {GRIPPERS['simulated']}; {reader.source.name} has none")
    return reader.source


__all__ = ["GRIPPERS", "HoldStep", "hold_grip"]
