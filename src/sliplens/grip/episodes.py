"""Episodes of a grip: many in parallel by the network's measured errors, or one after another through pixels."""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Bool

from sliplens.codec import load_result
from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK, to_builtins
from sliplens.friction import Friction, FrictionLike, SlipLearner, as_friction
from sliplens.grip.controllers import SPRINGS_BACK_S, Controller, Observation, SlipGate, make_controller
from sliplens.grip.fingertip import FingertipReading, RenderedSensor, TableSensor, load_readings
from sliplens.grip.plant import (
    EPISODE_S,
    LATENCY_S,
    LIFT_S,
    OBJECTS,
    PERIOD_S,
    Episodes,
    Plant,
    PlantState,
    Scripts,
    World,
    draw_scripts,
    least_force,
)
from sliplens.grip.records import EpisodeTable, Grip, GripSetup, GripTrace
from sliplens.live.slip import SlipBatch
from sliplens.models import Network
from sliplens.models.wrapping import open_run
from sliplens.progress import OnProgress, number_of, open_stage, report_each, reporting
from sliplens.runner import keep_record

_BATCH = 500  # episodes stepped together: few enough for a processor's caches
_STILL_FRAMES = 30  # frames of the untouched fingertips before they close, for the noise of the markers
_TICKS = round(EPISODE_S / PERIOD_S)
_HANGS_S = LIFT_S + 0.1  # time from which the least force counts: the object hangs in the hand


def run_episodes(
    object: str = "cup",
    controller: str | Controller = "margin",
    *,
    condition: str = "dry",
    episodes: int = 1,
    network: str | Path | Network = DEFAULT_NETWORK,
    rendered: bool = False,
    friction: FrictionLike | Literal["each"] | None = None,
    seed: int = 0,
    settings: Mapping[str, float] | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Grip:
    """Grip, lift and hold a simulated object, again and again.

    Each episode lasts 6 s: the fingers close, lift from 0.5 s on, and hold while something happens. Rendered, both
    fingertips are drawn, predicted by the network and their markers followed, 60 times a second; otherwise predictions
    come from a table of the network's errors on such images, dozens of episodes a second. Those of a network that
    does not come with sliplens are measured first (minutes).

    Parameters
    ----------
    object
        `cup`, `egg` or `berries`.
    controller
        Name of a controller (docs/grip.md), or an object with `command(observation)`, of which each batch of episodes
        gets a copy.
    condition
        Name of a condition (docs/grip.md), from which the episodes are drawn.
    episodes, seed
        Number of episodes, and the seed they are drawn from: the same seed gives every controller the same episodes.
    network
        Network, its folder, or the name of one that comes with sliplens; it needs a calibration.
    rendered
        If True, close the loop through pixels.
    friction
        Friction that predictions use, as in `predict`, for a network that predicts F_t / F_n; `each` uses that of each
        episode as it begins. Slips narrow a range down.
    settings
        Constants of the controller to change, such as `{"target": 0.2}`.
    out
        Folder to write the record to.
    overwrite
        If True, replace a folder that exists.
    on_progress
        Called with the number of episodes that are done, and of all.

    Returns
    -------
    Grip
        A row an episode, and the first episode tick by tick.

    Raises
    ------
    InputError
        If there is no such object, controller, condition or network, or they do not go together.

    See Also
    --------
    hold_grip : Control a gripper.
    plot : Plot the grip force over time.

    Examples
    --------
    >>> import sliplens as sl
    >>> grip = sl.run_episodes("cup", "fixed", settings={"force_n": 3.0})
    >>> bool(grip.episodes.dropped[0]), grip.episodes.mean_force_n.round(1)
    (False, array([3.]))
    """
    make_controller(controller, settings)  # refused before anything is measured
    scripts = draw_scripts(object, condition, episodes=episodes, seed=seed)
    network = open_run(network)
    if network.manifest.calibration is None:
        raise InputError("the network was never calibrated and has no interval to grip by; train it with validation")
    frictions, words = list[Friction](), None
    if friction is not None:
        network.require_ratio()
        frictions = [Friction(mu) if friction == "each" else as_friction(friction) for mu in scripts.friction.tolist()]
        words = "that of each episode as it begins" if friction == "each" else str(frictions[0])
    constants = dict(settings or {})
    if not isinstance(controller, str) and is_dataclass(controller):
        values = {item.name: getattr(controller, item.name) for item in fields(controller) if item.init}
        constants = {name: float(value) for name, value in values.items() if isinstance(value, int | float)}
    setup = GripSetup(
        object=object,
        condition=condition,
        controller=controller if isinstance(controller, str) else type(controller).__name__,
        settings=constants,
        network=network.manifest.weights_sha256[:12],
        friction=words,
        rendered=rendered,
        seed=seed,
    )
    law = partial(make_controller, controller, settings)
    run = partial(_run, setup, scripts, law=law, network=network, frictions=frictions)
    with reporting(on_progress):
        if out is None:
            return run()
        config, what = to_builtins(setup) | {"episodes": episodes}, number_of(episodes, "episode")
        keep_record(Path(out), lambda _: run(), stage="grip", config=config, what=what, overwrite=overwrite)
    return load_result(Path(out), Grip, command="sliplens grip")


def _run(
    setup: GripSetup, scripts: Scripts, *, law: partial[Controller], network: Network, frictions: list[Friction]
) -> Grip:
    """Run episodes in batches, by the measured errors of the network or through pixels."""
    begin, size, count = time.perf_counter(), 1 if setup.rendered else _BATCH, len(scripts)
    table = None if setup.rendered else load_readings(network)
    ticks, done = list[Tick](), list[EpisodeTable]()
    chunks = [np.arange(first, min(first + size, count)) for first in range(0, count, size)]
    with open_stage("Gripping"):
        for number, rows in enumerate(report_each(chunks, sizes=list(map(len, chunks)))):
            batch, priors = scripts.where(rows), [frictions[row] for row in rows if frictions]
            learners, seed = list(map(SlipLearner, priors)), np.random.SeedSequence((setup.seed, number))
            if table is None:
                first, frames = int(seed.generate_state(1)[0]), 2 * _TICKS * count
                sensor = RenderedSensor(network, seed=first, frames=frames, learner=next(iter(learners), None))
            else:
                rng = np.random.default_rng(seed)
                sensor = TableSensor(table, fingertips=batch.fingertips, rng=rng, learners=learners)
            controller = deepcopy(law(friction_known=bool(priors)))
            loop = GripLoop(Plant(OBJECTS[setup.object], episodes=len(rows)), sensor, controller)
            rows_done = run_scripts(loop, batch, condition=setup.condition, on_tick=None if number else ticks.append)
            if priors:
                rows_done = replace(rows_done, known_friction=np.array([mu.mean for mu in priors]))
            done.append(rows_done)
    seconds = time.perf_counter() - begin
    return Grip(setup=setup, seconds=seconds, episodes=EpisodeTable.joined(done), trace=_trace(ticks))


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One turn of the loop."""

    world: World
    """Loads on the objects during the step."""
    state: PlantState
    """State after the step."""
    command_n: Episodes
    reading: FingertipReading
    """Measurement before the step; the controller gets an earlier one."""
    slip: Bool[np.ndarray, " episodes"]
    """True where the controller receives slip events."""
    least_n: Episodes
    """Least force that holds in the step; 0 before the object hangs in the hand."""


Sensor: TypeAlias = TableSensor | RenderedSensor


class GripLoop:
    """Plant, fingertip sensor and controller in a loop of 60 Hz."""

    def __init__(
        self, plant: Plant, sensor: Sensor | None, controller: Controller, *, latency_s: float = LATENCY_S
    ) -> None:
        self.plant, self.sensor, self.controller = plant, sensor, controller
        delay = math.ceil(latency_s / PERIOD_S - 1e-9)
        self._past: deque[tuple[PlantState, FingertipReading, Bool[np.ndarray, " episodes"]]] = deque(maxlen=delay + 1)
        self._fingers: list[tuple[SlipBatch, SlipGate]] = []  # detector and gate of each finger, as in a real hold
        self._forces: deque[Episodes] = deque(maxlen=round(SPRINGS_BACK_S / PERIOD_S) + 1)
        if sensor is not None:
            rest, *still = sensor.still_markers(_STILL_FRAMES)
            self._fingers = [(SlipBatch(places), SlipGate()) for places in rest]
            for number, frame in enumerate(still):
                for (batch, _), places in zip(self._fingers, frame, strict=True):
                    batch.update(places, (number - len(still)) * PERIOD_S)
        self._command_n = np.zeros(len(plant.state.force_n))
        self._slipping_s = np.full(len(plant.state.force_n), np.nan)

    def tick(self, world: World, *, dark: Bool[np.ndarray, "episodes 2"] | None = None) -> Tick:
        """Measure, command and step; `dark` fingers have no margin and no markers."""
        now, count = self.plant.state, len(self._command_n)
        nothing, slip, slipped_s = np.full((count, 2), np.nan), np.zeros(count, dtype=bool), np.full(count, np.nan)
        reading = FingertipReading(margin=nothing, low=nothing, high=nothing)
        if self.sensor is not None:
            reading = self.sensor.measure(now, self._slipping_s)
            markers = reading.markers_px
            if dark is not None:
                visible = {name: np.where(dark, np.nan, getattr(reading, name)) for name in ("margin", "low", "high")}
                markers = [
                    np.where(hidden[:, None, None], np.nan, at) for hidden, at in zip(dark.T, markers, strict=True)
                ]
                reading = replace(reading, markers_px=markers, **visible)
            self._forces.append(now.force_n)
            for (batch, gate), places in zip(self._fingers, markers, strict=True):
                states = batch.update(places, now.time_s)
                slip |= gate.update(
                    states.slip, since_touch_s=now.held_s, force_n=now.force_n, earlier_n=self._forces[0]
                )
                slipped_s = np.fmax(slipped_s, states.slipped_s)
            self._slipping_s = slipped_s + PERIOD_S  # at the next measurement
        self._past.append((now, reading, slip))
        then, earlier, slip = self._past[0]
        observation = Observation(
            time_s=now.time_s,
            force_n=then.force_n,
            command_n=self._command_n,
            load_n=then.load_n,
            margin=earlier.margin,
            low=earlier.low,
            slip=slip,
            true_margin=np.nan_to_num(then.margin, nan=1.0),
        )
        self._command_n = np.asarray(self.controller.command(observation), dtype=np.float64)
        state = self.plant.step(self._command_n, world)
        least_n = least_force(world, time_s=now.time_s) * (now.time_s >= _HANGS_S - 1e-9)
        return Tick(world=world, state=state, command_n=self._command_n, reading=reading, slip=slip, least_n=least_n)


def run_scripts(
    loop: GripLoop, scripts: Scripts, *, condition: str = "", on_tick: Callable[[Tick], None] | None = None
) -> EpisodeTable:
    """Run episodes to their end in a given loop."""
    count = len(scripts)
    force, least, lasted, under = np.zeros((4, count))
    friction = np.full(count, np.inf)
    for _ in range(_TICKS):
        time_s, holds = loop.plant.state.time_s, ~loop.plant.state.dropped
        dark = np.stack([time_s >= scripts.lamp_at_s, np.zeros(count, dtype=bool)], axis=1)
        tick = loop.tick(scripts.world(time_s), dark=dark)
        if on_tick is not None:
            on_tick(tick)
        world = tick.world
        if time_s >= _HANGS_S:
            on = holds * PERIOD_S
            force += on * tick.state.force_n
            least += on * tick.least_n
            lasted += on
            # the object slips when both fingers do: the margin of both frictions together
            whole = 1 - np.abs(tick.state.load_n) / np.maximum(tick.state.force_n * world.friction.sum(axis=1), 1e-9)
            under += on * (whole < 0.2)
        friction = np.minimum(friction, world.friction.mean(axis=1))
    state = loop.plant.state
    return EpisodeTable(
        condition=np.full(count, condition),
        known_friction=np.full(count, np.nan), mass_kg=scripts.mass_kg + scripts.water_kg, friction=friction,
        dropped=state.dropped, crushed=state.crushed, slip_m=state.slipped_m,
        mean_force_n=force / lasted, least_force_n=least / lasted,
        force_excess=force / least - 1, under_20_s=under,
    )  # fmt: skip


def _trace(ticks: list[Tick]) -> GripTrace:
    """Trace the first episode; empty without ticks."""
    rows = []
    for tick in ticks:
        state, valid = tick.state, np.isfinite(tick.reading.margin[0])
        predicted = [getattr(tick.reading, name)[0] for name in ("margin", "low", "high")]
        rows.append((
            state.time_s, tick.command_n[0], state.force_n[0], tick.least_n[0], state.load_n[0],
            np.nan_to_num(state.margin[0], nan=1.0).min(),
            *(values[valid].mean() if valid.any() else np.nan for values in predicted),
            state.slipped_m[0], tick.slip[0],
        ))  # fmt: skip
    *columns, slip = np.array(rows, dtype=float).reshape(-1, len(fields(GripTrace))).T
    names = [item.name for item in fields(GripTrace)]
    return GripTrace(**dict(zip(names, columns, strict=False)), slip_seen=slip > 0)
