"""The loop of a grip: images are read, a controller answers, the gripper acts, and the object moves or holds."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8
from threadpoolctl import ThreadpoolController
from torch import Tensor

from sliplens.errors import InputError
from sliplens.friction import SlipLearner
from sliplens.grip.controllers import SPRINGS_BACK_S, Controller, Observation, SlipGate
from sliplens.grip.fingertip import Fingertip, MarkerField
from sliplens.grip.plant import PERIOD_S, Episodes, Fingers, Plant, PlantState, World
from sliplens.grip.readings import ReadingTable
from sliplens.live.slip import SlipBatch
from sliplens.markers import Tracker
from sliplens.models import Engine, Network, make_engine
from sliplens.models.predictions import LEVEL
from sliplens.simulation.intervention import NOISE_PX

Markers: TypeAlias = Float[np.ndarray, "_ _ 2"]
"""Places of a fingertip's markers, in pixels (x, y), by episode and marker."""


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What two fingertips read of one moment; NaN where nothing is read."""

    margin: Float[np.ndarray, "episodes 2"]
    low: Float[np.ndarray, "episodes 2"]
    high: Float[np.ndarray, "episodes 2"]
    markers_px: tuple[Markers, Markers] | None = None
    """Places (x, y) of the markers of both fingertips; None where nothing follows them."""
    frames: UInt8[np.ndarray, "2 height width 3"] | None = None
    """What the cameras saw, where anything was filmed."""


@runtime_checkable
class Eyes(Protocol):
    """What looks at the fingertips: images and a network, or a table of what the network said of such images."""

    def still(self, frames: int) -> Sequence[tuple[Markers, Markers]]:
        """Markers of both fingertips in frames of the untouched sensors, the places at rest first; none if unseen."""
        ...

    def look(self, state: PlantState, slipping_s: Episodes) -> Sight:
        """Read both fingertips of every episode.

        `slipping_s`: how many seconds ago a slip began that the markers have just confirmed; NaN where none.
        """
        ...


class TableEyes:
    """Readings looked up in what was measured of the network, with its noise.

    Where friction is known, the margin is that of the closed form, 1 - ratio / mu, expected over what is known of mu.

    `fingertips`: which pair of the table's fingertips each episode holds with. `error_scale` makes the network worse on
    purpose, or better: its errors, and the reach of its interval, times so much. `learners`: what is known of the
    friction in each episode, in all or in none, and what learns from its slips; `InputError` where the network tells no
    F_t / F_n.
    """

    def __init__(
        self,
        table: ReadingTable,
        *,
        fingertips: Float[np.ndarray, " episodes"],
        rng: np.random.Generator,
        error_scale: float = 1.0,
        learners: Sequence[SlipLearner] | None = None,
    ) -> None:
        pair = fingertips.astype(np.int64) % (len(table) // 2)
        pairs, self._gripper = np.unique(pair, return_inverse=True)
        self._field = MarkerField((table.seed + 2 * pairs).tolist())
        self._table, self._tips = table, 2 * pair[:, None] + np.arange(2)
        self._rng, self._scale = rng, error_scale
        self._learners, known = learners, [one.friction is not None for one in learners or ()]
        if learners is not None and not table.ratio:
            raise InputError("friction was told, but these readings are of the margin alone; measure a ratio network")
        if any(known) and not all(known):
            raise InputError("of some episodes the friction is known and of some it is not; run them apart")

    def still(self, frames: int) -> Sequence[tuple[Markers, Markers]]:
        """Markers of the untouched fingertips, the places at rest first."""
        rest = self._field.rest_px[self._gripper]
        return [(rest[:, 0], rest[:, 1]), *(self._follow(rest) for _ in range(frames))]

    def _follow(self, places_px: Float[np.ndarray, "episodes 2 markers 2"]) -> tuple[Markers, Markers]:
        """Places as markers are followed to them, of each finger."""
        followed = self._rng.standard_normal(places_px.shape)
        followed *= NOISE_PX
        followed += places_px
        return followed[:, 0], followed[:, 1]

    def look(self, state: PlantState, slipping_s: Episodes) -> Sight:
        """Read both fingertips of every episode."""
        true = state.margin
        pressing = np.isfinite(true)
        known = np.where(pressing, true, 1.0)
        force = np.broadcast_to(state.force_n[:, None], known.shape)
        friction, table = state.holding_friction, self._table
        margin, low, high, *ratio = table.read(self._tips, force, friction=friction, margins=known)
        noise = self._rng.standard_normal(known.shape)
        told = None
        if self._learners is not None:
            sliding = np.where(state.sliding, state.kinetic_ratio[:, None], 1 - known)
            held = np.where(pressing, state.friction * sliding, 0.0)
            pulled = held + self._scale * (ratio[0] - held + table.ratio_noise * noise)
            self._learn(pulled, self._scale * ratio[1], state.time_s, slipping_s)
            told = _told_margin(pulled, self._scale * ratio[1], self._learners)
        if told is None:
            change = (self._scale - 1) * (margin - known) + table.noise * self._scale * noise
            reach = [(self._scale - 1) * (end - margin) for end in (low, high)]
            told = margin + change, low + change + reach[0], high + change + reach[1]
        margin, low, high = told
        places = self._field.at(
            self._gripper, state.force_n, friction=friction, margins=known, pulled_back=state.shear_n < 0
        )
        return Sight(
            margin=np.where(pressing, margin, 1.0),
            low=np.where(pressing, np.clip(low, 0, 1), 1.0),
            high=np.where(pressing, np.clip(high, 0, 1), 1.0),
            markers_px=self._follow(places),
        )

    def _learn(self, ratio: Fingers, sigma: Fingers, time_s: float, slipping_s: Episodes) -> None:
        """Have each episode learn from what both fingers read of F_t / F_n, and from its slip."""
        for learner, since_s, read, doubt in zip(
            self._learners or (),
            slipping_s.tolist(),
            ratio.mean(axis=1).tolist(),
            sigma.mean(axis=1).tolist(),
            strict=True,
        ):
            learner.update(time_s, slipping_s=None if math.isnan(since_s) else since_s)
            learner.note(read, sigma=doubt, time_s=time_s)


def _told_margin(ratio: Fingers, sigma: Fingers, learners: Sequence[SlipLearner]) -> tuple[Fingers, ...] | None:
    """Margin and the ends of its 90 % interval from F_t / F_n and the friction; None where nothing is known of that."""
    nodes = [learner.friction.nodes for learner in learners if learner.friction is not None]
    if not nodes:
        return None
    most = max(len(values) for values, _ in nodes)
    values, weights = (np.stack([np.pad(one[row], (0, most - len(one[row]))) for one in nodes]) for row in (0, 1))
    values, weights = np.where(values > 0, values, 1.0)[:, None], weights[:, None]
    margins = np.clip(1 - ratio[..., None] / values, 0, 1)
    margin = (weights * margins).sum(axis=-1)
    variance = (weights * ((margins - margin[..., None]) ** 2 + (sigma[..., None] / values) ** 2)).sum(axis=-1)
    reach = _REACH_90 * np.sqrt(variance)
    return margin, margin - reach, margin + reach


_REACH_90 = 1.645
"""Standard deviations to either side that hold 90 % of a Gaussian."""


class RenderedEyes:
    """Two fingertips filmed and read by a network, markers followed: the loop closed through pixels, one episode.

    While the network reads one finger's frame, its markers are followed and the other finger's frame is drawn: each of
    the two by one thread, for threads that share their many short steps wait for each other.

    `learner`: what is known of the friction, and what learns from slips. `sequence`: read each finger's frames in
    order, as `predict` does; where the friction is known, each by itself.
    """

    def __init__(
        self,
        run: Network,
        *,
        seed: int,
        engine: str | Engine = "auto",
        frames: int = 4000,
        learner: SlipLearner | None = None,
        sequence: bool = False,
    ) -> None:
        first = Fingertip(seed=seed)
        self.fingertips = (first, Fingertip(seed=seed + 1, day=first.day))
        self._run, self._threads = run, ThreadpoolController()
        if isinstance(engine, str):
            with self._threads.limit(limits=1):
                engine = make_engine(engine, run, frames=frames, batch_size=1)
        self._engine = engine
        self._trackers = [Tracker(tip.reference) for tip in self.fingertips]
        self._learner = learner
        if learner is not None:
            run.require_ratio()
        in_order = sequence and (learner is None or learner.friction is None)
        self._followers = [run.follow() for _ in self.fingertips] if in_order else []

    @property
    def references(self) -> UInt8[np.ndarray, "2 height width 3"]:
        """The two untouched sensors, T_0."""
        return np.stack([tip.reference for tip in self.fingertips])

    def still(self, frames: int) -> Sequence[tuple[Markers, Markers]]:
        """Markers followed in frames of the untouched fingertips, the places at rest first."""
        followed = [[tracker.rest.centre_px[None] for tracker in self._trackers]]
        for _ in range(frames):
            films = [tip.draw(0.0, friction=1.0, margin=1.0) for tip in self.fingertips]
            followed.append([_places(*both) for both in zip(self._trackers, films, strict=True)])
        return [(first, second) for first, second in followed]

    def look(self, state: PlantState, slipping_s: Episodes) -> Sight:
        """Film both fingertips and read them."""
        frames: list[np.ndarray] = []
        markers_px: list[Markers] = []

        def inputs() -> Iterator[Tensor]:
            for finger, (tip, tracker) in enumerate(zip(self.fingertips, self._trackers, strict=True)):
                with self._threads.limit(limits=1):
                    frame = tip.draw(
                        float(state.force_n[0]),
                        friction=float(state.holding_friction[0, finger]),
                        margin=float(np.nan_to_num(state.margin[0, finger], nan=1.0)),
                        held_s=float(state.held_s[0]),
                        pulled_back=bool(state.shear_n[0, finger] < 0),
                    )
                    encoded = self._run.encode(frame[None], tip.reference)
                yield encoded
                with self._threads.limit(limits=1):
                    markers_px.append(_places(tracker, frame))
                frames.append(frame)

        known, learner = None, self._learner
        if learner is not None:
            since_s = float(slipping_s[0])
            learner.update(state.time_s, slipping_s=None if math.isnan(since_s) else since_s)
            known = learner.friction
        estimate = self._engine.estimate(self._run, inputs(), friction=known)
        if learner is not None and estimate.ratio is not None:
            learner.note(
                float(estimate.ratio.mean.mean()), sigma=float(estimate.ratio.sigma.mean()), time_s=state.time_s
            )
        fingers, touches = [estimate], np.isfinite(state.margin[0])
        if self._followers:
            fingers = [
                follower.update(estimate.at(np.array([row])), np.array([state.time_s]), touches[[row]])
                for row, follower in enumerate(self._followers)
            ]
        margin = np.concatenate([one.margin for one in fingers])
        ends = [one.interval(LEVEL) or (one.margin, one.margin) for one in fingers]
        low, high = (np.concatenate(end) for end in zip(*ends, strict=True))
        return Sight(
            margin=margin[None],
            low=low[None],
            high=high[None],
            markers_px=(markers_px[0], markers_px[1]),
            frames=np.stack(frames),
        )


def _places(tracker: Tracker, frame: UInt8[np.ndarray, "height width 3"]) -> Markers:
    """Places of a tracker's markers in its next frame."""
    return tracker.update(frame).position_px[None, : len(tracker.rest)]


class NoEyes:
    """No fingertips at all: for controllers that read nothing."""

    def still(self, frames: int) -> Sequence[tuple[Markers, Markers]]:
        """No markers."""
        return []

    def look(self, state: PlantState, slipping_s: Episodes) -> Sight:
        """Read nothing."""
        nothing = np.full((len(slipping_s), 2), np.nan)
        return Sight(margin=nothing, low=nothing, high=nothing)


class _SlipWatch:
    """Slip of both fingers of each episode, by the detector and the gate of a real hold."""

    def __init__(self, eyes: Eyes) -> None:
        rest, *still = eyes.still(_STILL_FRAMES) or [()]
        self._fingers = [(SlipBatch(places), SlipGate()) for places in rest]
        for number, frame in enumerate(still):
            for (batch, _), places in zip(self._fingers, frame, strict=True):
                batch.update(places, (number - len(still)) * PERIOD_S)
        self._forces: deque[Episodes] = deque(maxlen=round(SPRINGS_BACK_S / PERIOD_S) + 1)

    def update(self, sight: Sight, state: PlantState) -> tuple[Bool[np.ndarray, " episodes"], Episodes]:
        """Whether a slip begins at a finger, and how many seconds ago one began that is confirmed now; NaN for none."""
        self._forces.append(state.force_n)
        begins, slipped_s = np.zeros(len(state.force_n), dtype=bool), np.full(len(state.force_n), np.nan)
        for (batch, gate), places in zip(self._fingers, sight.markers_px or (), strict=True):
            states = batch.update(places, state.time_s)
            begins |= gate.update(
                states.slip, since_touch_s=state.held_s, force_n=state.force_n, earlier_n=self._forces[0]
            )
            slipped_s = np.fmax(slipped_s, states.slipped_s)
        return begins, slipped_s


_STILL_FRAMES = 30
"""Frames of the untouched fingertips before they close, from which the noise of the markers is learnt."""


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One turn of the loop."""

    world: World
    """What acted on the objects during the step."""
    state: PlantState
    """After the step."""
    command_n: Float[np.ndarray, " episodes"]
    sight: Sight
    """What was read before the step; `seen` is what the controller knew of it, later."""
    seen: Observation


class GripLoop:
    """Plant, eyes and controller in a loop of 60 Hz; a command answers what was seen `latency_s` before.

    Parameters
    ----------
    plant
        What is stepped.
    eyes
        `TableEyes`, or `RenderedEyes` for a single episode.
    controller
        Anything with `command(observation)`.
    latency_s
        From an image to the command that answers it, rounded up to whole images; the actuator's lag comes on top.

    Examples
    --------
    Squeeze a cup that stands on the table with the force that a controller asks for:

    >>> import numpy as np
    >>> from sliplens.grip import CONTROLLERS, GripLoop, NoEyes, Plant, draw_scripts, pick_object
    >>> scripts = draw_scripts("cup", "dry", episodes=1, seed=0)
    >>> loop = GripLoop(Plant(pick_object("cup")), NoEyes(), CONTROLLERS["fixed"](force_n=2.0))
    >>> for _ in range(30):
    ...     tick = loop.tick(scripts.world(loop.plant.state.time_s))
    >>> tick.state.force_n.round(1)
    array([2.])
    """

    def __init__(self, plant: Plant, eyes: Eyes, controller: Controller, *, latency_s: float = 0.02) -> None:
        self.plant, self.eyes, self.controller = plant, eyes, controller
        self._delay = math.ceil(latency_s / PERIOD_S - 1e-9)
        self._past: list[tuple[PlantState, Sight, Bool[np.ndarray, " episodes"]]] = []
        self._watch = _SlipWatch(eyes)
        self._command = np.zeros(len(plant.state.force_n))
        self._slipping_s = np.full(len(plant.state.force_n), np.nan)

    def tick(self, world: World, *, dark: Bool[np.ndarray, "episodes 2"] | None = None) -> Tick:
        """Look, command, step; `dark` fingers read nothing."""
        now, sight = self.plant.state, self.eyes.look(self.plant.state, self._slipping_s)
        if dark is not None and dark.any():
            blind = {name: np.where(dark, np.nan, getattr(sight, name)) for name in ("margin", "low", "high")}
            if sight.markers_px is not None:
                hidden = zip(dark.T[..., None, None], sight.markers_px, strict=True)
                first, second = (np.where(unseen, np.nan, places) for unseen, places in hidden)
                blind["markers_px"] = first, second
            sight = replace(sight, **blind)
        slip, slipped_s = self._watch.update(sight, now)
        self._slipping_s = slipped_s + PERIOD_S  # when it is looked at next
        self._past = [*self._past[-self._delay :], (now, sight, slip)] if self._delay else [(now, sight, slip)]
        then, read, slip = self._past[0]
        seen = Observation(
            time_s=now.time_s,
            force_n=then.force_n,
            command_n=self._command,
            load_n=then.load_n,
            margin=read.margin,
            low=read.low,
            slip=slip,
            true_margin=np.nan_to_num(then.margin, nan=1.0),
        )
        self._command = np.asarray(self.controller.command(seen), dtype=np.float64)
        state = self.plant.step(self._command, world)
        return Tick(world=world, state=state, command_n=self._command, sight=sight, seen=seen)
