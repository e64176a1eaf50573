"""A gripper that runs: simulated, seen through one fingertip, and held by what is read of its frames."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock

import numpy as np

from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK
from sliplens.grip.controllers import Holder
from sliplens.grip.fingertip import Fingertip
from sliplens.grip.gripper import GripperError, GripperState
from sliplens.grip.plant import PERIOD_S, GripperModel, Plant, PlantState, World, least_force, pick_object
from sliplens.grip.scripts import LIFT_S, hand_motion
from sliplens.live.contract import LiveOptions, LiveSource, Pace
from sliplens.live.reading import LiveFrame, Reading
from sliplens.recordings.capture import Forces
from sliplens.recordings.sensor import SensorProfile

OPEN_S = 1.5
"""Time that the fingers stay open before they close, so that the sensor is seen untouched, and after a drop."""
_CEILING_N = 2.8
"""Force that the gripper never passes: beyond, the network of the package sees frames that it does not know, its margin
is withheld, and a grip that is never loosened blindly would stay there."""
_MEMORY = 120
_POURS_KG_S, _PULLS_N_S = 0.03, 2.0
"""How fast a person pours and pulls."""
_FAINTEST_N = 0.02
_WIDTHS_M = (0.09, 0.07)
"""Opening of the fingers, and what is between them when they touch (assumed)."""


@dataclass(frozen=True, kw_only=True)
class Held:
    """What the gripper did when a frame was taken."""

    force_n: float
    """Grip force of each finger."""
    least_force_n: float
    """Least grip force that holds."""
    slip_m: float
    """Way that the object has slid."""
    phase: str
    """open, closing, lifting, holding, dropped or crushed."""
    controller: str
    why: str
    """What the controller answered last, and to what."""


class GripSource(LiveSource):
    """Simulated gripper that lifts an object and holds it; water can be poured in, and it can be pulled at and wetted.

    Its frames are those of one fingertip. Who reads them says what was read (`hear`, as `LiveReader` does), and the
    controller answers that: the loop is closed through pixels, by the network at hand, with its true latency and what
    its health withholds. A gripper that hears nothing goes to its safe force. What has fallen is gripped anew. Told
    forces from outside (`set_force`), it is a `Gripper` without a controller of its own.

    Parameters
    ----------
    object
        Row of `OBJECTS`.
    controller
        Row of `CONTROLLERS`.
    friction
        Coefficient of friction of the dry object.
    rate_hz
        Frames a second.
    seed
        Of the fingertip, its day and its touch.

    Examples
    --------
    >>> from sliplens.grip import GripSource
    >>> with GripSource("cup", rate_hz=200.0) as source:
    ...     source.act(water_kg=0.05, wet=True)
    ...     frame = next(source.frames())
    >>> frame.size, source.held(frame.number).phase
    ((224, 224), 'open')
    """

    simulated = True

    def __init__(
        self,
        object: str = "cup",
        controller: str = "margin",
        *,
        friction: float = 0.7,
        rate_hz: float = 30.0,
        seed: int = 0,
    ) -> None:
        if not 0 < friction < np.inf:
            raise InputError(f"a coefficient of friction is a positive number, got {friction:g}")
        self._object, self._friction, self._tip = pick_object(object), friction, Fingertip(seed=seed)
        self.name, self.rate_hz, self.reference = f"a simulated gripper ({object})", rate_hz, self._tip.reference
        self.size = self.reference.shape[0], self.reference.shape[1]
        self._lock, self._closed = Lock(), Event()
        self.water_kg, self.pull_n, self.wet = 0.0, 0.0, False
        self.controller = controller
        """Row of `CONTROLLERS` that grips."""
        self._outside_n: float | None = None
        self._told: dict[int, tuple[PlantState, Held]] = {}
        self._begin(0.0)

    def _begin(self, time_s: float) -> None:
        """Open the fingers, and close them anew after a moment."""
        self._plant = Plant(self._object, model=GripperModel(ceiling_n=_CEILING_N))
        self._grips_s = time_s + OPEN_S
        self._told.clear()
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
        for name, value in (("water_kg", water_kg), ("pull_n", pull_n)):
            if value is not None and not 0 <= value < np.inf:
                raise InputError(f"{name} must be 0 or more, got {value:g}")
        with self._lock:
            self.water_kg = self.water_kg if water_kg is None else water_kg
            self.pull_n = self.pull_n if pull_n is None else pull_n
            self.wet = self.wet if wet is None else wet
            if controller is not None and controller != self.controller:
                self._holder.choose(controller)
                self.controller = controller

    def grip_again(self) -> None:
        """Put the object down, and grip it anew."""
        with self._lock:
            self._ended_s = -np.inf

    def hear(self, reading: Reading) -> None:
        """Take what was read of a frame."""
        with self._lock:
            known = self._told.get(reading.number)
            if known is not None:
                self._holder.hear(reading, taken_s=known[0].time_s)

    def set_force(self, force_n: float) -> None:
        """Press with so many newtons from now on: who tells forces is the controller."""
        with self._lock:
            self._outside_n, self._why = force_n, "presses as it is told from outside"

    def set_width(self, width_m: float) -> None:
        """Refused: it opens by itself."""
        raise GripperError(f"the simulated gripper cannot be opened to {width_m:g} m; tell it forces")

    def read_state(self) -> GripperState:
        """Grip force, and a width that is assumed."""
        with self._lock:
            force_n = float(self._plant.state.force_n[0])
        return GripperState(force_n=force_n, width_m=_WIDTHS_M[force_n > 0])

    def held(self, number: int) -> Held | None:
        """What the gripper did at a frame; None where that was long ago."""
        known = self._told.get(number)
        return None if known is None else known[1]

    def frames(self) -> Iterator[LiveFrame]:
        """Frames of the first fingertip, as the gripper goes on."""
        pace, number, rate_hz = Pace(self._closed), 0, self.rate_hz or 30.0
        while pace.wait(number / rate_hz):
            captured_s, time_s = time.monotonic(), number / rate_hz
            with self._lock:
                state = self._advance(time_s)
                self._told[number] = state, self._describe(state, time_s)
                self._told.pop(number - _MEMORY, None)
            force_n, margin = float(state.force_n[0]), float(state.margin[0, 0])
            image = self._tip.draw(
                force_n,
                friction=float(state.holding_friction[0, 0]),
                margin=float(np.nan_to_num(margin, nan=1.0)),
                held_s=float(state.held_s[0]),
                pulled_back=bool(state.shear_n[0, 0] < 0),
            )
            yield LiveFrame(
                image=image,
                number=number,
                time_s=time_s,
                captured_s=captured_s,
                decode_ms=1e3 * (time.monotonic() - captured_s),
                forces=Forces(
                    time_s=np.array([time_s]),
                    force_n=np.array([[float(state.shear_n[0, 0]), 0.0, force_n]]),
                    source="the simulated gripper",
                ),
                safety_margin=margin if force_n > _FAINTEST_N and np.isfinite(margin) else None,
            )
            number += 1

    def close(self) -> None:
        """Stop at the next frame."""
        self._closed.set()

    def _advance(self, time_s: float) -> PlantState:
        """Go on until a time; what has ended begins anew after a moment."""
        plant = self._plant
        if self._ended_s is None and (plant.state.dropped[0] or plant.state.crushed[0]):
            self._ended_s = time_s
        if self._ended_s is not None and time_s - self._ended_s >= OPEN_S:
            self._begin(time_s)
            plant = self._plant
        while self._grips_s + plant.state.time_s + PERIOD_S <= time_s:
            self._poured_kg = _towards(self._poured_kg, self.water_kg, _POURS_KG_S * PERIOD_S)
            self._pulled_n = _towards(self._pulled_n, self.pull_n, _PULLS_N_S * PERIOD_S)
            world = self._world()
            plant.step(np.array([self._answer(plant.state)]), world)
        return plant.state

    def _world(self) -> World:
        height, speed, _ = hand_motion(self._plant.state.time_s)
        one = np.ones(1)
        return World(
            mass_kg=(self._object.mass_kg[0] + self._poured_kg) * one,
            friction=np.full((1, 2), self._friction * (0.5 if self.wet else 1.0)),
            kinetic_ratio=0.8 * one,
            pull_n=self._pulled_n * one,
            hand_m=height * one,
            hand_speed_m_s=speed * one,
        )

    def _answer(self, now: PlantState) -> float:
        """Grip force that the controller tells, in newtons."""
        if self._outside_n is not None:
            return self._outside_n
        answer = self._holder.answer(now.time_s, float(now.force_n[0]), load_n=float(now.load_n[0]))
        self._why = answer.why
        return answer.command_n

    def _describe(self, state: PlantState, time_s: float) -> Held:
        world = self._world()
        least = least_force(world, hand_acceleration_m_s2=hand_motion(state.time_s)[2])
        lifting = state.time_s < LIFT_S + 1.5
        phase = "closing" if state.time_s < LIFT_S else "lifting" if lifting else "holding"
        if time_s < self._grips_s:
            phase = "open"
        elif state.dropped[0] or state.crushed[0]:
            phase = "dropped" if state.dropped[0] else "crushed"
        return Held(
            force_n=float(state.force_n[0]),
            least_force_n=float(least[0]) if state.time_s > LIFT_S else 0.0,
            slip_m=float(state.slipped_m[0]),
            phase=phase,
            controller=self.controller if self._outside_n is None else "outside",
            why=self._why,
        )


def _towards(value: float, wanted: float, step: float) -> float:
    return value + min(max(wanted - value, -step), step)


def open_grip(name: str, options: LiveOptions) -> GripSource | None:
    """Gripper of a name such as `grip` or `grip:egg`; None where it is that of another source."""
    kind, _, held = name.partition(":")
    if kind != "grip":
        return None
    options.require_only("rate_hz", what="the simulated gripper")
    return GripSource(held or "cup", rate_hz=options.rate_hz or 30.0)


def usual_network(source: LiveSource | Path | str, profile: SensorProfile | None) -> str | None:
    """Network for a source where none is named: the profile's, else the package's for the sensor it was trained on."""
    if profile is not None:
        return profile.network
    own = isinstance(source, GripSource) or source in {"simulated", "simulated:chromatouch"}
    return DEFAULT_NETWORK if own else None


__all__ = ["GripSource", "Held", "open_grip", "usual_network"]
