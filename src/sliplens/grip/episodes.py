"""Episodes of a grip: many in parallel by the network's measured errors, or one after another through pixels."""

import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from sliplens.codec import keep_part, load_result, save_result
from sliplens.errors import InputError
from sliplens.extras import pick
from sliplens.files import DEFAULT_NETWORK, output_folder, remove, to_builtins
from sliplens.friction import Friction, FrictionLike, SlipLearner, as_friction
from sliplens.grip.controllers import Controller, make_controller
from sliplens.grip.fingertip import ReadingTable, load_readings, measure_readings, require_calibration
from sliplens.grip.loop import GripLoop, RenderedSensor, TableSensor, Tick
from sliplens.grip.plant import (
    EPISODE_S,
    LIFT_S,
    OBJECTS,
    PERIOD_S,
    Episodes,
    Plant,
    Scripts,
    draw_scripts,
    hand_motion,
    least_force,
)
from sliplens.grip.records import EpisodeTable, Grip, GripSetup, GripTrace
from sliplens.mechanics import stick_ratio
from sliplens.models import Network
from sliplens.models.wrapping import open_run
from sliplens.plots.clip import write_clip
from sliplens.progress import OnProgress, add_note, number_of, open_stage, report_each, report_file, reporting
from sliplens.recordings import Recording
from sliplens.recordings.dataset import trial_info, trial_path, write_dataset_table
from sliplens.recordings.store import save_recording
from sliplens.recordings.trial import ContactState, contact_states

_BATCH = 500  # episodes stepped together: few enough for a processor's caches
_MEASURED = 32  # fingertips by which the errors of a network without a table are measured
_TICKS = round(EPISODE_S / PERIOD_S)
_LIFTED_S = LIFT_S + 0.1  # time from which the least force counts: the object hangs in the hand


@dataclass(frozen=True, kw_only=True)
class EpisodeOptions:
    """How episodes are run, and the predictions that they use."""

    rendered: bool = False
    """Close the loop through pixels."""
    readings: ReadingTable | None = None
    """Measured errors of the network; None loads those of a network that comes with sliplens, and measures those of
    any other first (minutes)."""
    friction: FrictionLike | Literal["each"] | None = None
    """Friction that predictions use, as in `predict`, for a network that predicts F_t / F_n; `each` uses that of each
    episode as it begins. Slips narrow a range down."""
    latency_s: float = 0.02
    """Time from an image to the command by it."""

    def __post_init__(self) -> None:
        if self.latency_s < 0:
            raise InputError("the latency must not be negative; give 0 or more")


def run_episodes(
    object: str = "cup",
    controller: str | Controller = "margin",
    *,
    condition: str = "dry",
    episodes: int = 1,
    network: str | Path | Network = DEFAULT_NETWORK,
    options: EpisodeOptions | None = None,
    seed: int = 0,
    script: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Grip:
    """Grip, lift and hold a simulated object, again and again.

    Each episode lasts 6 s: the fingers close, lift from 0.5 s on, and hold while something happens. Rendered, both
    fingertips are drawn, predicted by the network and their markers followed, 60 times a second; otherwise predictions
    are looked up in the network's measured errors on such images, dozens of episodes a second.

    Parameters
    ----------
    object
        Row of `OBJECTS`.
    controller
        Row of `CONTROLLERS`, or an object with `command(observation)`, of which each batch of episodes gets a copy.
    condition
        Row of `CONDITIONS`, from which the episodes are drawn.
    episodes, seed
        Number of episodes, and the seed they are drawn from: the same seed gives every controller the same episodes.
    network
        Network, its folder, or the name of one that comes with sliplens; it needs a calibration.
    options
        Rendering, errors, friction and latency.
    script
        Columns of `Scripts` to set rather than to draw, such as `{"mass_kg": 0.06, "patch_factor": 0.5}`.
    settings
        Constants of the controller to change, such as `{"target": 0.3}`.
    out
        Folder to write: the record, and of rendered episodes a data set with both fingertips and a clip of the first.
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

    Examples
    --------
    >>> import sliplens as sl
    >>> grip = sl.run_episodes("cup", "fixed", settings={"force_n": 3.0}, script={"mass_kg": 0.05, "friction": 0.6})
    >>> bool(grip.episodes.dropped[0]), grip.episodes.mean_force_n.round(1)
    (False, array([3.]))
    """
    options, gripped = options or EpisodeOptions(), pick(OBJECTS, object, noun="object")
    if isinstance(controller, str):
        make_controller(controller, settings)  # refused before anything is measured
    elif settings:
        raise InputError("settings are for the controllers of the table; set those of your own where you make it")
    scripts = draw_scripts(gripped, condition, episodes=episodes, seed=seed, script=script)
    network = open_run(network)
    require_calibration(network)
    friction, words = None, None
    if options.friction is not None:
        network.require_ratio()
        each = options.friction == "each"
        friction = [Friction(mu) if each else as_friction(options.friction) for mu in scripts.friction.tolist()]
        words = "that of each episode as it begins" if each else str(friction[0])
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
        latency_s=options.latency_s,
        rendered=options.rendered,
        seed=seed,
    )
    with reporting(on_progress):
        if not options.rendered and options.readings is None:
            readings = load_readings(network)
            if readings is None:
                add_note("The network's errors on grips were not measured before: this takes minutes.")
                with open_stage("Measuring readings"):
                    readings = measure_readings(network, fingertips=_MEASURED)
            options = replace(options, readings=readings)
        job = _Job(
            setup=setup, scripts=scripts, controller=controller, network=network, friction=friction, options=options
        )
        if out is None:
            return job.run(None)
        table = options.readings
        config = to_builtins(setup) | {
            "episodes": episodes,
            "script": dict(script or {}),
            "readings": None if table is None else (table.network, table.seed, len(table)),
        }
        with output_folder(Path(out), stage="grip", config=config, overwrite=overwrite) as output:
            if output.complete:
                grip = load_result(output.folder, Grip, command="sliplens grip")
            else:
                grip = job.run(output.folder)
        summary = f"{number_of(len(grip.episodes), 'episode')}, {100 * grip.drop_rate:.1f} % dropped"
        report_file(Path(out), summary, kept=output.complete)
    return grip


@dataclass(frozen=True, kw_only=True)
class _Job:
    """Episodes to run, with everything that they need."""

    setup: GripSetup
    scripts: Scripts
    controller: str | Controller
    network: Network
    friction: list[Friction] | None
    options: EpisodeOptions

    def run(self, folder: Path | None) -> Grip:
        """Run every batch that is not in the folder yet, and write the record."""
        begin, size, total = time.perf_counter(), 1 if self.setup.rendered else _BATCH, len(self.scripts)
        done: list[Grip] = []
        chunks = [np.arange(first, min(first + size, total)) for first in range(0, total, size)]
        with open_stage("Gripping"):
            for number, rows in enumerate(report_each(chunks, sizes=list(map(len, chunks)))):
                part = None if folder is None else folder / "parts" / str(number)
                done.append(keep_part(part, Grip, partial(self.run_batch, number, rows, folder)))
        episodes = EpisodeTable.joined([batch.episodes for batch in done])
        grip = replace(done[0], seconds=time.perf_counter() - begin, episodes=episodes)
        if folder is not None:
            if self.setup.rendered:
                paths = sorted((folder / "data").glob("trials/*.parquet"))
                write_dataset_table(folder / "data", [trial_info(path, split="test") for path in paths], simulated=True)
                add_note("The clip is for the eye only: lossy video moves markers; measure in the data set.")
            save_result(grip, folder)
            remove(folder / "parts")
        return grip

    def run_batch(self, number: int, rows: Int[np.ndarray, " episodes"], folder: Path | None) -> Grip:
        """Run some episodes; save images of a rendered one in the folder."""
        setup, options, scripts = self.setup, self.options, self.scripts.where(rows)
        learners = [SlipLearner(self.friction[row]) for row in rows] if self.friction else []
        seed = np.random.SeedSequence((setup.seed, number))
        if setup.rendered:
            sensor = RenderedSensor(
                self.network,
                seed=int(seed.generate_state(1)[0]),
                frames=2 * _TICKS * len(self.scripts),
                learner=learners[0] if learners else None,
            )
        else:
            assert options.readings is not None
            sensor = TableSensor(
                options.readings,
                fingertips=scripts.fingertips,
                rng=np.random.default_rng(seed),
                learners=learners,
            )
        if isinstance(self.controller, str):
            controller = make_controller(self.controller, setup.settings, friction_known=bool(learners))
        else:
            controller = deepcopy(self.controller)
        loop = GripLoop(Plant(OBJECTS[setup.object], episodes=len(rows)), sensor, controller, latency_s=setup.latency_s)
        ticks, traced = list[Tick](), setup.rendered or number == 0
        table = run_scripts(loop, scripts, condition=setup.condition, on_tick=ticks.append if traced else None)
        if self.friction:
            table = replace(table, known_friction=np.array([self.friction[row].mean for row in rows]))
        if folder is not None and isinstance(sensor, RenderedSensor):
            _save_trials(folder, sensor, ticks, condition=setup.condition, number=number)
        return Grip(setup=setup, seconds=0.0, episodes=table, trace=_trace(ticks))


def run_scripts(
    loop: GripLoop,
    scripts: Scripts,
    *,
    condition: str | Sequence[str] = "",
    on_tick: Callable[[Tick], None] | None = None,
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
        needed, world = _least_force(tick), tick.world
        if time_s >= _LIFTED_S:
            on = holds * PERIOD_S
            force += on * tick.state.force_n
            least += on * needed
            lasted += on
            # the object slips when both fingers do: the margin of both frictions together
            whole = 1 - np.abs(tick.state.load_n) / np.maximum(tick.state.force_n * world.friction.sum(axis=1), 1e-9)
            under += on * (whole < 0.2)
        friction = np.minimum(friction, world.friction.mean(axis=1))
    state = loop.plant.state
    return EpisodeTable(
        condition=np.broadcast_to(np.asarray(condition, dtype=str), count).copy(),
        known_friction=np.full(count, np.nan), mass_kg=scripts.mass_kg + scripts.water_kg, friction=friction,
        dropped=state.dropped, crushed=state.crushed, slip_m=state.slipped_m,
        mean_force_n=force / lasted, least_force_n=least / lasted,
        force_excess=force / least - 1, under_20_s=under,
    )  # fmt: skip


def _least_force(tick: Tick) -> Episodes:
    """Compute the least force that holds in a step; 0 before the object hangs in the hand."""
    begun_s = tick.state.time_s - PERIOD_S
    least = least_force(tick.world, hand_acceleration_m_s2=hand_motion(begun_s)[2])
    return least if begun_s >= _LIFTED_S - 1e-9 else 0 * least


def _trace(ticks: list[Tick]) -> GripTrace:
    """Trace the first episode; empty without ticks."""

    def column(value: Callable[[Tick], float | np.floating]) -> Float[np.ndarray, " ticks"]:
        return np.array([float(value(tick)) for tick in ticks])

    def mean(margins: Float[np.ndarray, "episodes 2"]) -> float:
        valid = margins[0][np.isfinite(margins[0])]
        return float(valid.mean()) if len(valid) else np.nan

    return GripTrace(
        time_s=column(lambda tick: tick.state.time_s),
        command_n=column(lambda tick: tick.command_n[0]),
        force_n=column(lambda tick: tick.state.force_n[0]),
        least_force_n=column(lambda tick: _least_force(tick)[0]),
        load_n=column(lambda tick: tick.state.load_n[0]),
        true_margin=column(lambda tick: np.nan_to_num(tick.state.margin[0], nan=1.0).min()),
        margin=column(lambda tick: mean(tick.reading.margin)),
        low=column(lambda tick: mean(tick.reading.low)),
        high=column(lambda tick: mean(tick.reading.high)),
        slip_m=column(lambda tick: tick.state.slipped_m[0]),
        slip_seen=np.array([tick.observation.slip[0] for tick in ticks], dtype=bool),
    )


def _save_trials(folder: Path, sensor: RenderedSensor, ticks: list[Tick], *, condition: str, number: int) -> None:
    """Save the images of both fingertips of a rendered episode, with the plant's forces and margins as labels."""
    # an image shows the state before the step of its tick
    states = [tick.state for tick in ticks[:-1]]
    frames = np.stack([tick.reading.frames for tick in ticks[1:] if tick.reading.frames is not None])
    for finger in range(2):
        margin = np.array([state.margin[0, finger] for state in states])
        recording = Recording(
            trial=f"episode-{number + 1:04d}-finger-{finger + 1}",
            sensor=f"simulated-{finger + 1}",
            condition="wet" if condition == "wet" else "dry",
            object=condition,
            reference=sensor.fingertips[finger].reference,
            frames=frames[:, finger],
            time_s=np.array([state.time_s for state in states]),
            normal_force_n=np.array([state.force_n[0] for state in states]),
            tangential_force_n=np.array([abs(state.shear_n[0, finger]) for state in states]),
            friction_coefficient=np.array([state.holding_friction[0, finger] for state in states]),
            safety_margin=margin,
            stick_ratio=stick_ratio(margin),
            contact_state=contact_states(margin, without=ContactState.NO_CONTACT),
        )
        path = trial_path(folder / "data", recording.trial)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_recording(recording, path)
        if number == 0 and finger == 0:
            write_clip(recording, folder / "clip.mp4")
