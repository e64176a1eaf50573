"""Simulated fingertips in any state of their contact: images, markers, and predictions of a network for them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array
from threadpoolctl import ThreadpoolController
from torch import Tensor

from sliplens.codec import load_result
from sliplens.errors import InputError
from sliplens.files import find_run, shipped_names
from sliplens.friction import SlipLearner
from sliplens.grip.plant import OBJECTS, Episodes, Fingers, Plant, PlantState
from sliplens.markers import Tracker
from sliplens.models import Network, make_engine
from sliplens.models.predictions import LEVEL
from sliplens.progress import add_note, open_stage, report_each
from sliplens.results.evaluation import ANSWER, MARGIN
from sliplens.simulation.filming import Film, prepare_film, see_markers
from sliplens.simulation.loading import load_at_margins, load_at_states
from sliplens.simulation.nuisances import Day, Nuisances, draw_day, draw_grasp, draw_unit
from sliplens.simulation.sensor import CHROMATOUCH, Sensor
from sliplens.simulation.trials import NOISE_PX

_TOUCH_N = 0.02  # force of the lightest touch, as in the simulator's labels


class Fingertip:
    """Fingertip on an object: a built sensor, the day's light and the touch, all drawn from a seed.

    The simulator's press and pull move the markers, at any force, friction and margin. Marks of an earlier slip in the
    skin are not simulated.
    """

    def __init__(
        self,
        *,
        seed: int,
        sensor: Sensor = CHROMATOUCH,
        nuisances: Nuisances | None = None,
        day: Day | None = None,
    ) -> None:
        nuisances = Nuisances() if nuisances is None else nuisances
        day_rng, unit_rng, grasp_rng, self._film_rng, self._rng = np.random.default_rng(seed).spawn(5)
        self.day = draw_day(nuisances, quantile=0.5, rng=day_rng) if day is None else day
        self.sensor, self.grasp = sensor, draw_grasp(nuisances, day=self.day, wet=False, rng=grasp_rng)
        self.unit = draw_unit(nuisances, markers=sensor.geometry.markers, rng=unit_rng)

    @cached_property
    def _film(self) -> Film:
        return prepare_film(
            self.sensor,
            loading=load_at_margins(np.ones(1), grasp=self.grasp),
            grasp=self.grasp,
            day=self.day,
            unit=self.unit,
            rng=self._film_rng,
        )

    @cached_property
    def reference(self) -> UInt8[np.ndarray, "height width 3"]:
        """Image T_0 of the untouched sensor."""
        return self._film.draw_reference().numpy()

    def film(
        self,
        normal_force_n: Float[np.ndarray, " frames"],
        *,
        friction: Float[np.ndarray, " frames"],
        margins: Float[np.ndarray, " frames"],
        held_s: Float[np.ndarray, " frames"] | None = None,
        pulled_back: bool = False,
    ) -> Film:
        """Prepare a film of contact states, ready to be drawn.

        `friction` is the coefficient in effect, kinetic where the object slides (margin 0); creep grows with the time
        `held_s` since the touch; with `pulled_back` the object pulls the other way.
        """
        touching = np.where(normal_force_n > _TOUCH_N, margins, np.nan)
        loading = load_at_states(normal_force_n, friction=friction, margins=touching, held_s=held_s)
        film, grasp = self._film, self._film.grasp
        if pulled_back:
            film = replace(film, grasp=replace(grasp, shear_direction_rad=grasp.shear_direction_rad + np.pi))
        return film.under(loading, rng=self._rng)

    def draw(self, state: PlantState, *, finger: int = 0) -> UInt8[np.ndarray, "height width 3"]:
        """Draw one frame of a finger of the first gripper of a plant."""
        film = self.film(
            state.force_n[:1],
            friction=state.holding_friction[:1, finger],
            margins=np.nan_to_num(state.margin[:1, finger], nan=1.0),
            held_s=state.held_s[:1],
            pulled_back=bool(state.shear_n[0, finger] < 0),
        )
        return film.draw_all()[0]


class MarkerField:
    """Markers of the two fingertips of some grippers, in any state of their contacts.

    Positions are interpolated between states of a grid in force and margin. The motion by the pull is proportional to
    the friction at a given margin (Cattaneo and Mindlin), and reverses with the pull.
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        rest, press, shear = (np.stack(values) for values in zip(*map(_marker_grid, seeds), strict=True))
        self.rest_px = rest
        # a row a state: motion by the press at each force, below it motion by the pull
        self._moved_px = np.concatenate([press.reshape(-1, _MARKERS * 2), shear.reshape(-1, _MARKERS * 2)])

    def at(
        self,
        grippers: Int[np.ndarray, " episodes"],
        normal_force_n: Float[np.ndarray, " episodes"],
        *,
        friction: Float[np.ndarray, "episodes 2"],
        margins: Float[np.ndarray, "episodes 2"],
        pulled_back: Bool[np.ndarray, "episodes 2"],
    ) -> Float[np.ndarray, "episodes 2 markers 2"]:
        """Interpolate positions in pixels (x, y); at rest where nothing presses."""
        tips = 2 * grippers[:, None] + np.arange(2)
        touches = (normal_force_n > _TOUCH_N)[:, None]
        force, part = _cell(_FORCES_N, normal_force_n[:, None])
        margin, share = _cell(_MARGINS, margins)
        pull = np.where(pulled_back, -1, 1) * friction
        first, states = 2 * len(self.rest_px) * len(_FORCES_N), list[tuple[np.ndarray, np.ndarray]]()
        for upper, by_force in ((0, 1 - part), (1, part)):
            press, weight = tips * len(_FORCES_N) + force + upper, np.broadcast_to(touches * by_force, tips.shape)
            states.append((press, weight))
            for right, by_margin in ((0, 1 - share), (1, share)):
                states.append((first + press * len(_MARGINS) + margin + right, weight * by_margin * pull))
        # a sparse product sums the weighted states without a temporary array each
        rows, weights = (np.stack(parts, axis=-1) for parts in zip(*states, strict=True))
        starts = np.arange(0, rows.size + 1, len(states))
        mix = csr_array((weights.ravel(), rows.ravel(), starts), shape=(tips.size, len(self._moved_px)))
        return self.rest_px[grippers] + (mix @ self._moved_px).reshape(*tips.shape, _MARKERS, 2)


def _cell(grid: tuple[float, ...], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell of a grid that each value lies in, and its position in it, 0 to 1."""
    place = np.interp(values, grid, np.arange(len(grid)))
    at = np.minimum(place.astype(int), len(grid) - 2)
    return at, place - at


_FORCES_N = (_TOUCH_N, 0.1, 0.3, 0.6, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
_MARGINS = (0.0, 0.03, 0.1, 0.25, 0.45, 0.7, 1.0)
_MARKERS = 40  # number of markers, those nearest to the middle: about 42 of the sensor's 82 lie within the frame


@lru_cache(maxsize=256)
def _marker_grid(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute a gripper's markers at rest, and their motion by the press and by a pull of friction 1, by state."""
    force, gamma = np.meshgrid(_FORCES_N, _MARGINS, indexing="ij")
    first = Fingertip(seed=seed)
    parts = []
    for tip in (first, Fingertip(seed=seed + 1, day=first.day)):
        loading = load_at_states(
            force.ravel(), friction=np.ones(force.size), margins=gamma.ravel(), held_s=np.ones(force.size)
        )
        _, rest, places = see_markers(tip.sensor, loading=loading, grasp=tip.grasp, day=tip.day, unit=tip.unit)
        middle = np.asarray(tip.sensor.geometry.centre_px)
        nearest = np.argsort(np.linalg.norm(rest - middle, axis=1), kind="stable")[:_MARKERS]
        moved = (places - rest)[:, nearest].reshape(*force.shape, len(nearest), 2)
        parts.append((rest[nearest], moved[:, -1], moved - moved[:, -1:]))
    rest, press, shear = (np.stack(values) for values in zip(*parts, strict=True))
    # rounded as they were stored, in the type of all else: mixed types are slow
    return rest, press.astype(np.float32).astype(np.float64), shear.astype(np.float32).astype(np.float64)


FRICTIONS = (0.1, 0.18, 0.3, 0.5, 0.8, 1.3)
"""Coefficients of friction of the table; predictions between them are interpolated in the logarithm."""
FORCES_N = (0.3, 0.7, 1.5, 2.5, 3.0, 3.25, 3.5, 3.75, 4.0)
"""Normal forces of the table, interpolated in the logarithm. The networks were trained from 0.5 to 2 N; far above,
their errors are large and change within a quarter of a newton."""
MARGINS = (0.0, 0.04, 0.12, 0.3, 0.55, 0.8, 1.0)
"""Margins of the table, interpolated linearly."""


@dataclass(frozen=True, kw_only=True)
class ReadingTable:
    """Predictions of a network for many fingertips at each friction, force and margin.

    Fingertips are the first axis: each has its own sensor and touch, and its errors stay with it as long as it holds,
    as they do in the rendered loop; noise is drawn for each frame. Fingertips 0 and 1, 2 and 3, ... are those of
    one gripper and share a day.
    """

    network: str
    """Hash of the measured weights."""
    seed: int
    """Seed of the first fingertip; the others follow."""
    margin: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], ANSWER]
    low: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], MARGIN]
    """Lower end of the 90 % interval."""
    high: Annotated[Float32[np.ndarray, "fingertips frictions forces margins"], MARGIN]
    noise: float
    """Standard deviation of predictions of the same state, in margin units."""
    ratio: dict[str, Float32[np.ndarray, "fingertips frictions forces margins"]] = field(default_factory=dict)
    """`mean` and `sigma` of the predicted F_t / F_n; empty for a network that predicts the margin alone."""
    ratio_noise: float = 0.0
    """Standard deviation of the predicted ratio of the same state."""

    def __len__(self) -> int:
        return len(self.margin)

    def read(
        self,
        fingertips: Int[np.ndarray, "*contacts"],
        normal_force_n: Float[np.ndarray, "*contacts"],
        *,
        friction: Float[np.ndarray, "*contacts"],
        margins: Float[np.ndarray, "*contacts"],
    ) -> tuple[Float[np.ndarray, "*contacts"], ...]:
        """Interpolate the margin and both ends of its interval of contacts, without noise.

        Mean and sigma of F_t / F_n follow, where the network predicts them. Forces and frictions outside the table
        count as the outermost.
        """
        steps = (np.log(FRICTIONS), np.log(FORCES_N), np.array(MARGINS))
        values = (np.log(np.maximum(friction, 1e-6)), np.log(np.maximum(normal_force_n, 1e-6)), margins)
        places = [np.interp(value, grid, np.arange(len(grid))) for value, grid in zip(values, steps, strict=True)]
        tables = [self.margin, self.low, self.high, *(self.ratio[name] for name in ("mean", "sigma") if self.ratio)]
        return tuple(map_coordinates(table, [fingertips, *places], output=np.float64, order=1) for table in tables)


_MEASURED = 32  # fingertips by which the errors of a network without a table are measured


def _measure_readings(run: Network) -> ReadingTable:
    """Measure the predictions of a calibrated network for fingertips at every friction, force and margin of the table.

    It takes some 2 s a fingertip on one core. The noise is that of 12 states of each fingertip, drawn twice.
    """
    mu, force, gamma = np.meshgrid(FRICTIONS, FORCES_N, MARGINS, indexing="ij")
    # a fully stuck contact does not show the friction: one value is enough
    drawn = (gamma < 1) | (mu == FRICTIONS[0])
    count = int(drawn.sum())
    again = np.random.default_rng(0).choice(count, 12, replace=False)
    engine = make_engine("auto", run, frames=_MEASURED * count)
    tables, repeats, tip = list[np.ndarray](), list[np.ndarray](), None
    for number in report_each(range(_MEASURED)):
        tip = Fingertip(seed=number, day=tip.day if tip is not None and number % 2 else None)
        frames = []
        for rows in (np.arange(count), again):
            force_n, friction, margins = (values[drawn][rows] for values in (force, mu, gamma))
            film = tip.film(force_n, friction=friction, margins=margins, held_s=np.ones(len(rows)))
            frames.append(film.draw_all())
        estimate = run.estimate(run.encode(np.concatenate(frames), tip.reference), engine=engine)
        ends = estimate.interval(LEVEL)
        assert ends is not None  # it is calibrated
        ratio = [] if estimate.ratio is None else [estimate.ratio.mean, estimate.ratio.sigma]
        values = np.stack([estimate.margin, *ends, *ratio])
        table = np.empty((len(values), *mu.shape), dtype=np.float32)
        table[:, drawn] = values[:, :count]
        table[:, 1:, :, -1] = table[:, :1, :, -1]
        tables.append(table)
        repeats.append(values[:, count:] - values[:, again])
    margin, low, high, *ratios = np.stack(tables, axis=1)
    noise = np.std(np.concatenate(repeats, axis=1), axis=1) / np.sqrt(2)
    return ReadingTable(
        network=run.manifest.weights_sha256,
        seed=0,
        margin=margin,
        low=low,
        high=high,
        noise=float(noise[0]),
        ratio=dict(zip(("mean", "sigma"), ratios, strict=False)),
        ratio_noise=float(noise[3:4].sum()),
    )


def load_readings(run: Network) -> ReadingTable:
    """Load the table that comes with a network of the package; other networks are measured (minutes)."""
    for name in shipped_names():
        folder = find_run(Path(name)) / "readings"
        if folder.is_dir():
            table = load_result(folder, ReadingTable, command="make weights")
            if table.network == run.manifest.weights_sha256:
                return table
    add_note("The network's errors on grips were not measured before: this takes minutes.")
    with open_stage("Measuring readings"):
        return _measure_readings(run)


Markers: TypeAlias = Float[np.ndarray, "_ _ 2"]
"""Positions of a fingertip's markers, in pixels (x, y), by episode and marker."""


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
        parts = (margin, np.clip(low, 0, 1), np.clip(high, 0, 1))
        margin, low, high = (np.where(pressing, values, 1.0) for values in parts)
        return FingertipReading(margin=margin, low=low, high=high, markers_px=self._follow(places))


def _margin_of_ratio(ratio: Fingers, sigma: Fingers, learners: Sequence[SlipLearner]) -> tuple[Fingers, ...]:
    """Compute the margin and its 90 % interval from F_t / F_n and the friction of each episode."""
    nodes = [learner.friction.nodes for learner in learners if learner.friction is not None]
    most = max(len(values) for values, _ in nodes)
    values, weights = (np.stack([np.pad(pair[row], (0, most - len(pair[row]))) for pair in nodes]) for row in (0, 1))
    values, weights = np.where(values > 0, values, 1.0)[:, None], weights[:, None]
    margins = np.clip(1 - ratio[..., None] / values, 0, 1)
    margin = (weights * margins).sum(axis=-1)
    variance = (weights * ((margins - margin[..., None]) ** 2 + (sigma[..., None] / values) ** 2)).sum(axis=-1)
    reach = 1.645 * np.sqrt(variance)  # 90 % of a Gaussian
    return margin, margin - reach, margin + reach


class RenderedSensor:
    """Predictions of a network for drawn images of two fingertips, with their markers followed; for one episode."""

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
        untouched = Plant(OBJECTS["cup"]).state
        first, second = (
            [tracker.rest.centre_px[None]]
            + [tracker.update(tip.draw(untouched)).position_px[None] for _ in range(frames)]
            for tip, tracker in zip(self.fingertips, self._trackers, strict=True)
        )
        return list(zip(first, second, strict=True))

    def measure(self, state: PlantState, slipping_s: Episodes) -> FingertipReading:
        """Draw both fingertips, predict their margins and follow their markers."""
        inputs, markers_px = list[Tensor](), list[Markers]()
        with self._threads.limit(limits=1):  # threads that share many short steps wait for each other
            for finger, (tip, tracker) in enumerate(zip(self.fingertips, self._trackers, strict=True)):
                frame = tip.draw(state, finger=finger)
                inputs.append(self._network.encode(frame[None], tip.reference))
                markers_px.append(tracker.update(frame).position_px[None])
        friction, learner = None, self._learner
        if learner is not None:
            learner.update(state.time_s, slipping_s=None if np.isnan(slipping_s[0]) else float(slipping_s[0]))
            friction = learner.friction
        estimate = self._network.estimate(inputs, friction=friction, engine=self._engine)
        if learner is not None and (ratio := estimate.ratio) is not None:
            learner.note(float(ratio.mean.mean()), sigma=float(ratio.sigma.mean()), time_s=state.time_s)
        low, high = estimate.interval(LEVEL) or (estimate.margin, estimate.margin)
        return FingertipReading(margin=estimate.margin[None], low=low[None], high=high[None], markers_px=markers_px)
