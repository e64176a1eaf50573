"""Simulated grip in a loop: fingertips are measured, a controller commands, the gripper acts, the object moves."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from threadpoolctl import ThreadpoolController
from torch import Tensor

from sliplens.errors import InputError
from sliplens.friction import SlipLearner
from sliplens.grip.controllers import SPRINGS_BACK_S, Controller, Observation, SlipGate
from sliplens.grip.fingertip import Fingertip, MarkerField, ReadingTable
from sliplens.grip.plant import LATENCY_S, PERIOD_S, Episodes, Fingers, Plant, PlantState, World
from sliplens.live.slip import SlipBatch
from sliplens.markers import Tracker
from sliplens.models import Network, make_engine
from sliplens.models.predictions import LEVEL
from sliplens.simulation.intervention import NOISE_PX

Markers: TypeAlias = Float[np.ndarray, "_ _ 2"]
"""Positions of a fingertip's markers, in pixels (x, y), by episode and marker."""
_STILL_FRAMES = 30  # frames of the untouched fingertips before they close, for the noise of the markers
_GAUSSIAN_90 = 1.645  # standard deviations to either side that hold 90 % of a Gaussian


@dataclass(frozen=True, kw_only=True)
class FingertipReading:
    """Margins and markers of both fingertips at one moment; NaN without a margin."""

    margin: Float[np.ndarray, "episodes 2"]
    low: Float[np.ndarray, "episodes 2"]
    high: Float[np.ndarray, "episodes 2"]
    markers_px: Sequence[Markers] = ()
    """Positions (x, y) of the markers of both fingertips; empty without markers."""


class TableSensor:
    """Predictions looked up in the measured errors of a network, with noise.

    Where the friction is known, the margin is the expected value of 1 - ratio / mu over the distribution of mu.
    """

    def __init__(
        self,
        table: ReadingTable,
        *,
        fingertips: Float[np.ndarray, " episodes"],
        rng: np.random.Generator,
        error_scale: float = 1.0,
        learners: Sequence[SlipLearner] = (),
    ) -> None:
        pair = fingertips.astype(np.int64) % (len(table) // 2)
        pairs, self._gripper = np.unique(pair, return_inverse=True)
        self._field = MarkerField((table.seed + 2 * pairs).tolist())
        self._table, self._tips = table, 2 * pair[:, None] + np.arange(2)
        self._rng, self._scale, self._learners = rng, error_scale, learners
        if learners and not table.ratio:
            raise InputError("friction needs F_t / F_n, but this table has margins alone; measure a ratio network")

    def still_markers(self, frames: int) -> Sequence[tuple[Markers, Markers]]:
        """Return the markers of both untouched fingertips: at rest, then as followed in some frames."""
        rest = self._field.rest_px[self._gripper]
        return [(rest[:, 0], rest[:, 1]), *(self._follow(rest) for _ in range(frames))]

    def _follow(self, places_px: Float[np.ndarray, "episodes 2 markers 2"]) -> tuple[Markers, Markers]:
        """Add the noise of a tracker to the markers of each finger."""
        followed = self._rng.standard_normal(places_px.shape)
        followed *= NOISE_PX
        followed += places_px
        return followed[:, 0], followed[:, 1]

    def measure(self, state: PlantState, slipping_s: Episodes) -> FingertipReading:
        """Measure both fingertips of every episode."""
        pressing = np.isfinite(state.margin)
        true = np.where(pressing, state.margin, 1.0)
        force = np.broadcast_to(state.force_n[:, None], true.shape)
        friction, table, scale = state.holding_friction, self._table, self._scale
        margin, low, high, *ratio = table.read(self._tips, force, friction=friction, margins=true)
        noise = self._rng.standard_normal(true.shape)
        if self._learners:
            traction = np.where(state.sliding, state.kinetic_ratio[:, None], 1 - true)
            traction = np.where(pressing, state.friction * traction, 0.0)
            measured = traction + scale * (ratio[0] - traction + table.ratio_noise * noise)
            for learner, since_s, mean, sigma in zip(
                self._learners, slipping_s, measured.mean(axis=1), scale * ratio[1].mean(axis=1), strict=True
            ):
                learner.update(state.time_s, slipping_s=None if np.isnan(since_s) else float(since_s))
                learner.note(float(mean), sigma=float(sigma), time_s=state.time_s)
            margin, low, high = _margin_of_ratio(measured, scale * ratio[1], self._learners)
        else:
            change = (scale - 1) * (margin - true) + table.noise * scale * noise
            low, high = (end + change + (scale - 1) * (end - margin) for end in (low, high))
            margin = margin + change
        places = self._field.at(
            self._gripper, state.force_n, friction=friction, margins=true, pulled_back=state.shear_n < 0
        )
        return FingertipReading(
            margin=np.where(pressing, margin, 1.0),
            low=np.where(pressing, np.clip(low, 0, 1), 1.0),
            high=np.where(pressing, np.clip(high, 0, 1), 1.0),
            markers_px=self._follow(places),
        )


def _margin_of_ratio(ratio: Fingers, sigma: Fingers, learners: Sequence[SlipLearner]) -> tuple[Fingers, ...]:
    """Compute the margin and its 90 % interval from F_t / F_n and the friction of each episode."""
    nodes = [learner.friction.nodes for learner in learners if learner.friction is not None]
    most = max(len(values) for values, _ in nodes)
    values, weights = (np.stack([np.pad(pair[row], (0, most - len(pair[row]))) for pair in nodes]) for row in (0, 1))
    values, weights = np.where(values > 0, values, 1.0)[:, None], weights[:, None]
    margins = np.clip(1 - ratio[..., None] / values, 0, 1)
    margin = (weights * margins).sum(axis=-1)
    variance = (weights * ((margins - margin[..., None]) ** 2 + (sigma[..., None] / values) ** 2)).sum(axis=-1)
    reach = _GAUSSIAN_90 * np.sqrt(variance)
    return margin, margin - reach, margin + reach


class RenderedSensor:
    """Predictions of a network for drawn images of two fingertips, with their markers followed; for one episode.

    While the network predicts one finger's frame, the other finger's markers are followed and frame is drawn, by one
    thread each: threads that share many short steps wait for each other.
    """

    def __init__(
        self,
        network: Network,
        *,
        seed: int,
        engine: str = "auto",
        frames: int = 4000,
        learner: SlipLearner | None = None,
    ) -> None:
        first = Fingertip(seed=seed)
        self.fingertips = (first, Fingertip(seed=seed + 1, day=first.day))
        self._network, self._threads, self._learner = network, ThreadpoolController(), learner
        with self._threads.limit(limits=1):
            self._engine = make_engine(engine, network, frames=frames, batch_size=1)
        self._trackers = [Tracker(tip.reference) for tip in self.fingertips]

    def still_markers(self, frames: int) -> Sequence[tuple[Markers, Markers]]:
        """Return the markers of both untouched fingertips: at rest, then as followed in some frames."""
        first, second = (
            [tracker.rest.centre_px[None]]
            + [tracker.update(tip.draw(0.0, friction=1.0, margin=1.0)).position_px[None] for _ in range(frames)]
            for tip, tracker in zip(self.fingertips, self._trackers, strict=True)
        )
        return list(zip(first, second, strict=True))

    def measure(self, state: PlantState, slipping_s: Episodes) -> FingertipReading:
        """Draw both fingertips, predict their margins and follow their markers."""
        markers_px: list[Markers] = []

        def inputs() -> Iterator[Tensor]:
            for finger, (tip, tracker) in enumerate(zip(self.fingertips, self._trackers, strict=True)):
                with self._threads.limit(limits=1):
                    frame = tip.draw_state(state, finger=finger)
                    encoded = self._network.encode(frame[None], tip.reference)
                yield encoded
                with self._threads.limit(limits=1):
                    markers_px.append(tracker.update(frame).position_px[None])

        friction, learner = None, self._learner
        if learner is not None:
            learner.update(state.time_s, slipping_s=None if np.isnan(slipping_s[0]) else float(slipping_s[0]))
            friction = learner.friction
        estimate = self._network.estimate(inputs(), friction=friction, engine=self._engine)
        if learner is not None and (ratio := estimate.ratio) is not None:
            learner.note(float(ratio.mean.mean()), sigma=float(ratio.sigma.mean()), time_s=state.time_s)
        low, high = estimate.interval(LEVEL) or (estimate.margin, estimate.margin)
        return FingertipReading(margin=estimate.margin[None], low=low[None], high=high[None], markers_px=markers_px)


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
    """True where the controller is told of a slip."""


class GripLoop:
    """Plant, fingertip sensor and controller in a loop of 60 Hz."""

    def __init__(
        self,
        plant: Plant,
        sensor: TableSensor | RenderedSensor | None,
        controller: Controller,
        *,
        latency_s: float = LATENCY_S,
    ) -> None:
        self.plant, self.sensor, self.controller = plant, sensor, controller
        delay = math.ceil(latency_s / PERIOD_S - 1e-9)
        self._past: deque[tuple[PlantState, FingertipReading, Bool[np.ndarray, " episodes"]]] = deque(maxlen=delay + 1)
        self._fingers: list[tuple[SlipBatch, SlipGate]] = []
        """Detector and gate of each finger, as in a real hold."""
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
        return Tick(world=world, state=state, command_n=self._command_n, reading=reading, slip=slip)
