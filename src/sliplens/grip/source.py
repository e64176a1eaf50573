"""Simulated gripper as a live source: drawn through one fingertip, and held by the predictions for its frames."""

from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Unpack

import numpy as np

from sliplens.errors import InputError
from sliplens.extras import pick
from sliplens.files import DEFAULT_NETWORK
from sliplens.grip.controllers import Holder
from sliplens.grip.fingertip import Fingertip
from sliplens.grip.gripper import GripperState
from sliplens.grip.plant import LIFT_S, LIFTED_S, OBJECTS, PERIOD_S, Plant, World, least_force
from sliplens.live.contract import DrawnSource, LiveOptions
from sliplens.live.loop import LiveReader, ReaderSettings
from sliplens.live.reading import Reading
from sliplens.models.checkpoint import Network
from sliplens.recordings.capture import Frame

OPEN_S = 1.5
"""Time for which the fingers stay open at first, to show the untouched sensor, and after a drop."""
_CEILING_N = 2.8
"""Largest force of the gripper: beyond it, frames are unknown to the network of the package, its margins withheld, and
a grip that is never loosened blindly would stay there."""
_MEMORY = 120
_POURS_KG_S, _PULLS_N_S = 0.03, 2.0  # rates at which a person pours and pulls
_FRICTION, _FAINTEST_N = 0.7, 0.02
_WIDTHS_M = (0.09, 0.07)  # opening of the fingers without and with an object between them (assumed)


@dataclass(frozen=True, kw_only=True)
class GripStatus:
    """State of the gripper at a frame."""

    force_n: float
    """Grip force of each finger."""
    least_force_n: float
    """Least grip force that holds."""
    slip_m: float
    """Distance that the object has slid."""
    phase: str
    """open, closing, lifting, holding, dropped or crushed."""
    controller: str
    why: str
    """Last action of the controller, and its reason."""


class GripSource(DrawnSource):
    """Simulated gripper that lifts an object and holds it while water is poured in, it is pulled or wetted.

    Its frames are those of one fingertip. The controller acts on their readings, which `LiveReader` passes on: the loop
    is closed through pixels. A dropped object is gripped again. With forces from outside (`set_force`), it is a
    `Gripper` without a controller.

    Examples
    --------
    >>> from sliplens.grip.source import GripSource
    >>> with GripSource("cup", rate_hz=200.0) as source:
    ...     source.act(water_kg=0.05, wet=True)
    ...     frame = next(source.frames())
    >>> frame.size, source.status(frame.number).phase
    ((224, 224), 'open')
    """

    def __init__(self, object: str = "cup", controller: str = "margin", *, rate_hz: float = 30.0) -> None:
        self._object, self._tip = pick(OBJECTS, object, noun="object"), Fingertip(seed=0)
        self.name, self.rate_hz, self.reference = f"a simulated gripper ({object})", rate_hz, self._tip.reference
        self.size = self.reference.shape[0], self.reference.shape[1]
        self._lock = Lock()
        self.water_kg, self.pull_n, self.wet = 0.0, 0.0, False
        self.controller = controller
        """Row of `CONTROLLERS` in use."""
        self._outside_n: float | None = None
        self._frames: dict[int, tuple[float, GripStatus]] = {}
        """Time of the grip, and the status, at each of the last frames."""
        self._begin(0.0)

    def _begin(self, time_s: float) -> None:
        """Open the fingers, to close them again after `OPEN_S`."""
        self._plant = Plant(self._object, ceiling_n=_CEILING_N)
        self._grips_s = time_s + OPEN_S
        self._frames.clear()
        self._ended_s: float | None = None
        self._poured_kg = self._pulled_n = 0.0
        self._holder, self._why = Holder(self.controller, ceiling_n=_CEILING_N), ""

    def act(
        self,
        *,
        water_kg: float | None = None,
        pull_n: float | None = None,
        wet: bool | None = None,
        controller: str | None = None,
    ) -> None:
        """Pour water in, pull down, wet (which halves the friction) or choose a controller, from the next frame on."""
        changes = {"water_kg": water_kg, "pull_n": pull_n, "wet": wet, "controller": controller}
        changes = {name: value for name, value in changes.items() if value is not None}
        for name in changes.keys() & {"water_kg", "pull_n"}:
            if not 0 <= changes[name] < np.inf:
                raise InputError(f"{name} must be 0 or more, got {changes[name]:g}")
        with self._lock:
            if controller is not None and controller != self.controller:
                self._holder.choose(controller)
            vars(self).update(changes)

    def grip_again(self) -> None:
        """Put the object down, and grip it again."""
        with self._lock:
            self._ended_s = -np.inf

    def update_reading(self, reading: Reading) -> None:
        """Take the reading of a frame."""
        with self._lock:
            if reading.number in self._frames:
                self._holder.update_reading(reading, taken_s=self._frames[reading.number][0])

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons from now on, in place of the controller's force."""
        with self._lock:
            self._outside_n, self._why = force_n, "follows commands from outside"

    def read_state(self) -> GripperState:
        """Return the grip force, and an assumed width."""
        force_n = float(self._plant.state.force_n[0])
        return GripperState(force_n=force_n, width_m=_WIDTHS_M[force_n > 0])

    def status(self, number: int) -> GripStatus | None:
        """Return the state of the gripper at a frame; None for a frame long ago."""
        return self._frames[number][1] if number in self._frames else None

    def draw(self, number: int, time_s: float, /) -> tuple[Frame, tuple[float, float], float | None]:
        """Draw a frame of the fingertip while the gripper goes on."""
        with self._lock:
            self._advance(time_s)
            state = self._plant.state
            self._frames[number] = state.time_s, self._describe(time_s)
            self._frames.pop(number - _MEMORY, None)
        force_n, shear_n, margin = float(state.force_n[0]), float(state.shear_n[0, 0]), float(state.margin[0, 0])
        is_pressed = force_n > _FAINTEST_N and np.isfinite(margin)
        return self._tip.draw(state), (force_n, shear_n), margin if is_pressed else None

    def _advance(self, time_s: float) -> None:
        """Step until a time; begin again some time after a drop."""
        state = self._plant.state
        if self._ended_s is None and (state.dropped[0] or state.crushed[0]):
            self._ended_s = time_s
        if self._ended_s is not None and time_s - self._ended_s >= OPEN_S:
            self._begin(time_s)
        while self._grips_s + self._plant.state.time_s + PERIOD_S <= time_s:
            pour, pull = _POURS_KG_S * PERIOD_S, _PULLS_N_S * PERIOD_S
            self._poured_kg += float(np.clip(self.water_kg - self._poured_kg, -pour, pour))
            self._pulled_n += float(np.clip(self.pull_n - self._pulled_n, -pull, pull))
            command_n, state = self._outside_n, self._plant.state
            if command_n is None:
                command = self._holder.grip_force(state.time_s, float(state.force_n[0]), load_n=float(state.load_n[0]))
                command_n, self._why = command.command_n, command.why
            self._plant.step(np.array([command_n]), self._world())

    def _world(self) -> World:
        return World(
            mass_kg=np.array([self._object.mass_kg[0] + self._poured_kg]),
            friction=np.full((1, 2), _FRICTION * (0.5 if self.wet else 1.0)),
            kinetic_ratio=np.array([0.8]),
            pull_n=np.array([self._pulled_n]),
        )

    def _describe(self, time_s: float) -> GripStatus:
        state = self._plant.state
        phases = {
            "open": time_s < self._grips_s,
            "dropped": state.dropped[0],
            "crushed": state.crushed[0],
            "closing": state.time_s < LIFT_S,
            "lifting": state.time_s < LIFTED_S,
            "holding": True,
        }
        return GripStatus(
            force_n=float(state.force_n[0]),
            least_force_n=float(least_force(self._world(), time_s=state.time_s)[0]) if state.time_s > LIFT_S else 0.0,
            slip_m=float(state.slipped_m[0]),
            phase=next(phase for phase, holds in phases.items() if holds),
            controller=self.controller if self._outside_n is None else "outside",
            why=self._why,
        )


def open_reader(
    source: str = "simulated", network: Network | Path | str | None = None, **settings: Unpack[ReaderSettings]
) -> LiveReader:
    """Create a reader of a source by its name, such as `grip` or `grip:egg` for the simulated gripper.

    Simulated sources of the sensor that the network of the package was trained on have that network by default.
    """
    kind, _, gripped = source.partition(":")
    if settings.get("sensor") is None and (kind == "grip" or source in {"simulated", "simulated:chromatouch"}):
        network = network or DEFAULT_NETWORK
    if kind != "grip":
        return LiveReader(source, network, **settings)
    options = settings.pop("options", None) or LiveOptions()
    options.require_only("rate_hz", what="the simulated gripper")
    return LiveReader(GripSource(gripped or "cup", rate_hz=options.rate_hz or 30.0), network, **settings)
