"""Episodes of a grip: many in parallel by the network's measured errors, or one after another through pixels."""

import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, UInt8

from sliplens.codec import keep_part, load_result, save_result
from sliplens.errors import InputError
from sliplens.explainers.table import explain, get_explainer
from sliplens.files import DEFAULT_NETWORK, output_folder, remove, to_builtins
from sliplens.friction import Friction, FrictionLike, SlipLearner, as_friction
from sliplens.grip.controllers import Controller, make_controller
from sliplens.grip.loop import GripLoop, RenderedEyes, TableEyes, Tick
from sliplens.grip.plant import PERIOD_S, Episodes, HeldObject, Plant, least_force, pick_object
from sliplens.grip.readings import ReadingTable, load_readings, measure_readings, require_calibration
from sliplens.grip.scripts import EPISODE_S, LIFT_S, Scripts, draw_scripts, hand_motion, next_grasp
from sliplens.mechanics import stick_ratio
from sliplens.models import Network
from sliplens.models.checkpoint import open_run
from sliplens.plots.clip import write_clip
from sliplens.progress import OnProgress, note, number_of, stage, wrote
from sliplens.recordings import Recording
from sliplens.recordings.dataset import trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import save_recording
from sliplens.recordings.trial import ContactState, contact_states
from sliplens.results.grip import EpisodeTable, Grip, GripSetup, GripTrace

_BATCH = 500
"""Episodes stepped together: few enough for a processor's caches."""
_MEASURED = 32
"""Fingertips that a network without a table of readings is measured with."""
_TICKS = round(EPISODE_S / PERIOD_S)
_LIFTED_S = LIFT_S + 0.1
"""From here on the least force is asked for: the object hangs in the hand."""
MOMENTS_S = (0.4, 1.4, 2.8, 5.0)
"""Times, in seconds, at which a rendered episode is explained."""


@dataclass(frozen=True, kw_only=True)
class _Batch:
    """Episodes that were run together."""

    episodes: EpisodeTable
    trace: GripTrace
    pictures: UInt8[np.ndarray, "moments height width 3"]
    maps: Float32[np.ndarray, "moments side side"]


def run_episodes(
    object: str = "cup",
    controller: str | Controller = "margin",
    *,
    condition: str = "dry",
    episodes: int = 1,
    network: str | Path | Network = DEFAULT_NETWORK,
    rendered: bool = False,
    readings: ReadingTable | None = None,
    error_scale: float = 1.0,
    friction: FrictionLike | Literal["each"] | None = None,
    grasps: int = 1,
    same_object: bool = False,
    sequence: bool = False,
    latency_s: float = 0.02,
    seed: int = 0,
    script: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
    method: str | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Grip:
    """Grip, lift and hold an object, again and again, and tell what became of it.

    Each episode lasts 6 s: the fingers close, lift from 0.5 s on, and hold while something happens. Rendered, both
    fingertips are filmed, read by the network and their markers followed, 60 times a second; otherwise readings are
    looked up in what was measured of the network on such images, dozens of episodes a second.

    Parameters
    ----------
    object
        Row of `OBJECTS`.
    controller
        Row of `CONTROLLERS`, or anything with `command(observation)`, of which each batch of episodes, and each of
        their grasps, gets a copy: it may remember.
    condition
        Row of `CONDITIONS`, from which the episodes are drawn.
    episodes, seed
        How many, and the seed they are drawn from: the same seed gives every controller the same episodes.
    network
        Network, its folder, or the name of one that comes with sliplens; it needs a calibration.
    rendered
        Close the loop through pixels.
    readings
        Errors of the network; those that come with it if None, and measured first (minutes) where there are none.
    error_scale
        Ratio by which the network's errors are made worse, or better; only where they are looked up.
    friction
        What is told of the coefficient of friction, as `predict` takes it, for a network that tells F_t / F_n; `each`
        tells each episode its own, as its first grasp begins. Slips that the markers tell narrow a range down.
    grasps
        How many times each object is gripped, one grasp after another, each with other fingertips and a friction within
        some percent of the object's (`GRASP_SPREAD`). The table has a row a grasp, first those of all first ones.
    same_object
        Whether what a slip taught counts in the grasps that follow, as `LiveReader` takes it, for a network that tells
        F_t / F_n.
    sequence
        Whether frames are read in order, as `predict` takes it; only through pixels. Where the friction is known, each
        is read by itself.
    latency_s
        From an image to the command that answers it, in seconds.
    script
        Columns of `Scripts` to set rather than to draw, such as `{"mass_kg": 0.06, "patch_factor": 0.5}`.
    settings
        Constants of the controller to change, such as `{"target": 0.3}`.
    method
        Explainer whose maps are drawn at four moments of the first rendered episode; none if None.
    out
        Folder to write: the record, and of rendered episodes a data set with both fingertips and a clip of the first.

    Raises
    ------
    InputError
        If something named is not there or cannot be.

    Examples
    --------
    >>> import sliplens as sl
    >>> grip = sl.run_episodes("cup", "fixed", settings={"force_n": 3.0}, script={"mass_kg": 0.05, "friction": 0.6})
    >>> bool(grip.episodes.dropped[0]), grip.episodes.mean_force_n.round(1)
    (False, array([3.]))
    """
    if error_scale < 0 or latency_s < 0:
        raise InputError("latency and error scale must not be negative; give 0 or more")
    if grasps < (fewest := 1 + same_object):
        taught = " by --same-object, which teaches the grasps that follow" * same_object
        raise InputError(
            f"{number_of(grasps, 'grasp')} of an object cannot be run{taught}; add --grasps {fewest} or more"
        )
    if sequence and not rendered:
        raise InputError("readings that are looked up have no order; add --rendered, or leave out --sequence")
    held = pick_object(object)
    if isinstance(controller, str):
        make_controller(controller, settings)  # mistakes are told before anything is measured
    elif settings:
        raise InputError("settings are for the controllers of the table; set those of your own where you make it")
    if method is not None:
        get_explainer(method)
    own = isinstance(friction, str) and friction == "each"
    told = None if friction is None else "each" if own else as_friction(friction)
    scripts = draw_scripts(held, condition, episodes=episodes, seed=seed, script=script)
    run = open_run(network)
    require_calibration(run)
    if told is not None or same_object:
        run.require_ratio(learns=told is None)
    if sequence:
        run.follow(friction=told)
    if not rendered and readings is None:
        readings = _readings_of(run, on_progress)
    setup = GripSetup(
        object=object,
        condition=condition,
        controller=controller if isinstance(controller, str) else type(controller).__name__,
        settings=dict(settings or _constants(controller)),
        network=run.manifest.weights_sha256[:12],
        friction=None if told is None else "that of each episode as it begins" if isinstance(told, str) else str(told),
        grasps=grasps,
        same_object=same_object,
        sequence=sequence,
        latency_s=latency_s,
        rendered=rendered,
        seed=seed,
    )
    job = _Job(
        setup=setup, held=held, scripts=scripts, controller=controller, run=run, readings=readings, friction=told,
        error_scale=error_scale, method=method,
    )  # fmt: skip
    if out is None:
        return job.all(None, on_progress)
    config = to_builtins(setup) | {
        "episodes": episodes,
        "error_scale": error_scale,
        "method": method,
        "script": dict(script or {}),
        "readings": None if readings is None else (readings.network, readings.seed, len(readings)),
    }
    with output_folder(Path(out), stage="grip", config=config, overwrite=overwrite) as output:
        if output.complete:
            grip = load_result(output.folder, Grip, command="sliplens grip")
        else:
            grip = job.all(output.folder, on_progress)
    counted = f"{number_of(len(grip.episodes), 'episode')}, {100 * grip.drop_rate:.1f} % dropped"
    wrote(on_progress, Path(out), counted, kept=output.complete)
    return grip


def _constants(controller: str | Controller) -> dict[str, float]:
    """Constants of a controller that is none of the table, as far as it is a dataclass and tells them."""
    if isinstance(controller, str) or not is_dataclass(controller):
        return {}
    named = {field.name: getattr(controller, field.name) for field in fields(controller) if field.init}
    return {name: float(value) for name, value in named.items() if isinstance(value, int | float)}


def _readings_of(run: Network, on_progress: OnProgress | None) -> ReadingTable:
    """Readings that come with a network; measured where there are none."""
    readings = load_readings(run)
    if readings is None:
        note(on_progress, "The network's errors on grips were not measured before: this takes minutes.")
        with stage(on_progress, "Measuring readings") as count:
            readings = measure_readings(run, fingertips=_MEASURED, on_progress=count)
    return readings


@dataclass(frozen=True, kw_only=True)
class _Job:
    """All that the episodes need."""

    setup: GripSetup
    held: HeldObject
    scripts: Scripts
    controller: str | Controller
    run: Network
    readings: ReadingTable | None
    friction: Friction | Literal["each"] | None
    error_scale: float
    method: str | None

    def all(self, folder: Path | None, on_progress: OnProgress | None) -> Grip:
        """Run every batch that is not in the folder yet, and write what they add up to."""
        begin, size, total = time.perf_counter(), 1 if self.setup.rendered else _BATCH, len(self.scripts)
        done: list[_Batch] = []
        with stage(on_progress, "Gripping") as count:
            for number, first in enumerate(range(0, total, size)):
                part = None if folder is None else folder / "parts" / str(number)
                chosen = self.scripts.where(np.arange(first, min(first + size, total)))
                done.append(keep_part(part, _Batch, partial(self.batch, number, chosen, folder)))
                count(first + len(chosen), total)
        episodes = EpisodeTable.joined([one.episodes for one in done])
        grip = Grip(
            setup=self.setup,
            seconds=time.perf_counter() - begin,
            episodes=episodes.where(np.argsort(episodes.grasp, kind="stable")),
            trace=done[0].trace,
            moments_s=MOMENTS_S[: len(done[0].maps)],
            pictures=done[0].pictures,
            maps=done[0].maps,
        )
        if folder is not None:
            _finish(folder, grip, on_progress)
        return grip

    def batch(self, number: int, scripts: Scripts, folder: Path | None) -> _Batch:
        """Run some episodes, and further grasps of the same objects; what the cameras saw of the first is saved."""
        learners, tables, ticks = self._learners(scripts), list[EpisodeTable](), list[Tick]()
        pictures, maps = np.zeros((0, 1, 1, 3), dtype=np.uint8), np.zeros((0, 1, 1), dtype=np.float32)
        for grasp in range(self.setup.grasps):
            seed = np.random.SeedSequence((self.setup.seed, number, *((grasp,) if grasp else ())))
            held = next_grasp(scripts, rng=np.random.default_rng(seed.spawn(1)[0])) if grasp else scripts
            told = np.array([one.friction.mean if one.friction else np.nan for one in learners] or [np.nan] * len(held))
            parts: list[tuple[np.ndarray, EpisodeTable]] = []
            for known in (True, False):
                rows = np.flatnonzero(np.isfinite(told) == known)
                if not len(rows):
                    continue
                eyes = self._eyes(held.where(rows), [learners[row] for row in rows] if learners else None, seed)
                keep = not grasp and (self.setup.rendered or number == 0)
                table = self._run(held.where(rows), eyes, known=known, on_tick=ticks.append if keep else None)
                parts.append((rows, replace(table, grasp=table.grasp + grasp, known_friction=told[rows])))
                if isinstance(eyes, RenderedEyes) and not grasp:
                    frames = np.stack([tick.sight.frames for tick in ticks if tick.sight.frames is not None])
                    if folder is not None:
                        _save_trials(folder, eyes, ticks, frames, condition=self.setup.condition, number=number)
                    if self.method is not None and number == 0:
                        pictures = np.ascontiguousarray(frames[[round(at / PERIOD_S) for at in MOMENTS_S], 0])
                        why = explain(self.run, pictures, reference=eyes.references[0], method=self.method)
                        maps = why.relevance.cpu().numpy()
            order = np.argsort(np.concatenate([rows for rows, _ in parts]))
            tables.append(EpisodeTable.joined([table for _, table in parts]).where(order))
            for learner in learners:
                learner.release()
        return _Batch(episodes=EpisodeTable.joined(tables), trace=_trace(ticks), pictures=pictures, maps=maps)

    def _learners(self, scripts: Scripts) -> list[SlipLearner]:
        """What is known of the friction in each episode, and learns; none where nothing is told or kept."""
        if self.friction is None and not self.setup.same_object:
            return []
        told = [Friction(one) if isinstance(self.friction, str) else self.friction for one in scripts.friction.tolist()]
        return [SlipLearner(one, same_object=self.setup.same_object) for one in told]

    def _run(
        self, scripts: Scripts, eyes: RenderedEyes | TableEyes, *, known: bool, on_tick: Callable[[Tick], None] | None
    ) -> EpisodeTable:
        setup, chosen = self.setup, self.controller
        # one of the caller's own is copied: what it remembers is of the grasp before
        own = not isinstance(chosen, str)
        chosen = deepcopy(chosen) if own else make_controller(chosen, setup.settings, told=known)
        loop = GripLoop(Plant(self.held, episodes=len(scripts)), eyes, chosen, latency_s=setup.latency_s)
        return run_scripts(loop, scripts, condition=setup.condition, on_tick=on_tick)

    def _eyes(
        self, scripts: Scripts, learners: list[SlipLearner] | None, seed: np.random.SeedSequence
    ) -> RenderedEyes | TableEyes:
        if self.setup.rendered:
            return RenderedEyes(
                self.run,
                seed=int(seed.generate_state(1)[0]),
                frames=2 * _TICKS * len(self.scripts) * self.setup.grasps,
                learner=None if learners is None else learners[0],
                sequence=self.setup.sequence,
            )
        assert self.readings is not None
        return TableEyes(
            self.readings,
            fingertips=scripts.fingertips,
            rng=np.random.default_rng(seed),
            error_scale=self.error_scale,
            learners=learners,
        )


def run_scripts(
    loop: GripLoop,
    scripts: Scripts,
    *,
    condition: str | Sequence[str] = "",
    on_tick: Callable[[Tick], None] | None = None,
) -> EpisodeTable:
    """Run episodes to their end in a loop of your own, and tell what became of each.

    Parameters
    ----------
    loop
        Plant, eyes and controller for as many episodes as there are scripts.
    scripts
        What happens in each.
    condition
        Name to note for all of them, or one for each.
    on_tick
        Called with each turn of the loop.
    """
    count = len(scripts)
    force, least, lasted, under = np.zeros((4, count))
    peak, peak_least, friction = np.zeros(count), np.zeros(count), np.full(count, np.inf)
    for _ in range(_TICKS):
        time_s, holds = loop.plant.state.time_s, ~loop.plant.state.dropped
        dark = np.stack([time_s >= scripts.lamp_at_s, np.zeros(count, dtype=bool)], axis=1)
        tick = loop.tick(scripts.world(time_s), dark=dark)
        if on_tick is not None:
            on_tick(tick)
        needed, world = _needed(tick), tick.world
        if time_s >= _LIFTED_S:
            on = holds * PERIOD_S
            force += on * tick.state.force_n
            least += on * needed
            lasted += on
            # the object slips when both fingers do: what counts is what is left of both frictions together
            whole = 1 - np.abs(tick.state.load_n) / np.maximum(tick.state.force_n * world.friction.sum(axis=1), 1e-9)
            under += on * (whole < 0.2)
            peak = np.maximum(peak, np.where(holds, tick.state.force_n, 0))
            peak_least = np.maximum(peak_least, np.where(holds, needed, 0))
        friction = np.minimum(friction, world.friction.mean(axis=1))
    state = loop.plant.state
    names = np.broadcast_to(np.asarray(condition, dtype=str), count).copy()
    return EpisodeTable(
        condition=names, grasp=np.ones(count, dtype=np.int64), known_friction=np.full(count, np.nan),
        mass_kg=scripts.mass_kg + scripts.water_kg, friction=friction,
        dropped=state.dropped, crushed=state.crushed, slip_m=state.slipped_m,
        mean_force_n=force / lasted, peak_force_n=peak, least_force_n=least / lasted, peak_least_force_n=peak_least,
        force_excess=force / least - 1, peak_excess=peak / peak_least - 1, under_20_s=under,
    )  # fmt: skip


def _needed(tick: Tick) -> Episodes:
    """Least force that held in a step; none before the object hangs in the hand."""
    begun_s = tick.state.time_s - PERIOD_S
    least = least_force(tick.world, hand_acceleration_m_s2=hand_motion(begun_s)[2])
    return least if begun_s >= _LIFTED_S - 1e-9 else 0 * least


def _trace(ticks: list[Tick]) -> GripTrace:
    """Trace of the first episode; empty where no tick was kept."""

    def mean(values: Float[np.ndarray, "episodes 2"]) -> float:
        own = values[0][np.isfinite(values[0])]
        return float(own.mean()) if len(own) else float("nan")

    states = [tick.state for tick in ticks]
    return GripTrace(
        time_s=np.array([one.time_s for one in states]),
        command_n=np.array([float(tick.command_n[0]) for tick in ticks]),
        force_n=np.array([float(one.force_n[0]) for one in states]),
        least_force_n=np.array([float(_needed(tick)[0]) for tick in ticks]),
        load_n=np.array([float(one.load_n[0]) for one in states]),
        true_margin=np.array([float(np.nan_to_num(one.margin[0], nan=1.0).min()) for one in states]),
        margin=np.array([mean(tick.sight.margin) for tick in ticks]),
        low=np.array([mean(tick.sight.low) for tick in ticks]),
        high=np.array([mean(tick.sight.high) for tick in ticks]),
        slip_m=np.array([float(one.slipped_m[0]) for one in states]),
        slip_seen=np.array([bool(tick.seen.slip[0]) for tick in ticks], dtype=bool),
    )


def _save_trials(
    folder: Path,
    eyes: RenderedEyes,
    ticks: list[Tick],
    frames: UInt8[np.ndarray, "ticks 2 height width 3"],
    *,
    condition: str,
    number: int,
) -> None:
    """Save what both fingertips of a rendered episode saw, with the plant's forces and margins as labels."""
    # an image shows the state before the step of its tick
    states = [tick.state for tick in ticks[:-1]]
    force = np.array([float(one.force_n[0]) for one in states])
    for finger in range(2):
        shear = np.array([abs(float(one.shear_n[0, finger])) for one in states])
        margin = np.array([float(one.margin[0, finger]) for one in states])
        recording = Recording(
            trial=f"episode-{number + 1:04d}-finger-{finger + 1}",
            sensor=f"simulated-{finger + 1}",
            condition="wet" if condition == "wet" else "dry",
            object=condition,
            reference=eyes.references[finger],
            frames=frames[1:, finger],
            time_s=np.array([one.time_s for one in states]),
            normal_force_n=force,
            tangential_force_n=shear,
            friction_coefficient=np.array([float(one.holding_friction[0, finger]) for one in states]),
            safety_margin=margin,
            stick_ratio=stick_ratio(margin),
            contact_state=contact_states(margin, without=ContactState.NO_CONTACT),
        )
        path = trial_path(folder / "data", recording.trial)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_recording(recording, path)
        if number == 0 and finger == 0:
            write_clip(recording, folder / "clip.mp4")


def _finish(folder: Path, grip: Grip, on_progress: OnProgress | None) -> None:
    """Write the record, and the table of the data set where there is one."""
    if grip.setup.rendered:
        paths = sorted((folder / "data").glob("trials/*.parquet"))
        write_dataset_table(folder / "data", [trial_info(path, split="test") for path in paths], simulated=True)
        note(on_progress, "The clip is for the eye only: lossy video moves markers; measure in the data set.")
    save_result(grip, folder)
    remove(folder / "parts")


__all__ = ["MOMENTS_S", "run_episodes", "run_scripts"]
