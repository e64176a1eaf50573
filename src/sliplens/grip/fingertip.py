"""Simulated fingertips in any state of their contact: images, and positions of the markers."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import csr_array

from sliplens.grip.plant import PlantState
from sliplens.simulation.filming import Film, batches, prepare_film, see_markers
from sliplens.simulation.loading import load_at_margins, load_at_states
from sliplens.simulation.nuisances import Day, Nuisances, draw_day, draw_grasp, draw_unit
from sliplens.simulation.sensor import CHROMATOUCH, Sensor

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
        self._sensor, self._grasp = sensor, draw_grasp(nuisances, day=self.day, wet=False, rng=grasp_rng)
        self._unit = draw_unit(nuisances, markers=sensor.geometry.markers, rng=unit_rng)

    @cached_property
    def _film(self) -> Film:
        return prepare_film(
            self._sensor,
            loading=load_at_margins(np.ones(1), grasp=self._grasp),
            grasp=self._grasp,
            day=self.day,
            unit=self._unit,
            rng=self._film_rng,
            noise=self._sensor.noise,
        )

    def markers(
        self,
        normal_force_n: Float[np.ndarray, " frames"],
        *,
        friction: Float[np.ndarray, " frames"],
        margins: Float[np.ndarray, " frames"],
        held_s: Float[np.ndarray, " frames"] | None = None,
    ) -> tuple[Float[np.ndarray, "markers 2"], Float[np.ndarray, "frames markers 2"]]:
        """Return the markers in pixels (x, y), at rest and in contact states as in `film`."""
        loading = load_at_states(normal_force_n, friction=friction, margins=margins, held_s=held_s)
        return see_markers(self._sensor, loading=loading, grasp=self._grasp, day=self.day, unit=self._unit)[1:]

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

    def draw(
        self, normal_force_n: float, *, friction: float, margin: float, held_s: float = 0.0, pulled_back: bool = False
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Draw one frame of a state as in `film`; force in newtons, margin from 0 to 1."""
        force, mu, gamma, time_s = (np.array([value]) for value in (normal_force_n, friction, margin, held_s))
        film = self.film(force, friction=mu, margins=gamma, held_s=time_s, pulled_back=pulled_back)
        return film.draw(slice(0, 1))[0].numpy()

    def draw_state(self, state: PlantState, *, finger: int = 0) -> UInt8[np.ndarray, "height width 3"]:
        """Draw one frame of a finger of the first gripper of a plant."""
        return self.draw(
            float(state.force_n[0]),
            friction=float(state.holding_friction[0, finger]),
            margin=float(np.nan_to_num(state.margin[0, finger], nan=1.0)),
            held_s=float(state.held_s[0]),
            pulled_back=bool(state.shear_n[0, finger] < 0),
        )


def draw_film(film: Film) -> UInt8[np.ndarray, "frames height width 3"]:
    """Draw every frame of a film."""
    return torch.cat([film.draw(part) for part in batches(len(film), device="cpu")]).numpy()


class MarkerField:
    """Markers of the two fingertips of some grippers, in any state of their contacts.

    Positions are interpolated between states of a grid in force and margin. The motion by the pull is proportional to
    the friction at a given margin (Cattaneo and Mindlin), and reverses with the pull.
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        rest, press, shear = (np.stack(values) for values in zip(*map(_marker_grid, seeds), strict=True))
        self.rest_px = rest
        self._size = shear[..., 0, 0].size
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
        force, part = (values[:, None] for values in place_in_grid(np.asarray(_FORCES_N), normal_force_n))
        margin, share = place_in_grid(np.asarray(_MARGINS), margins)
        pull = np.where(pulled_back, -1, 1) * friction
        rows, weights = list[np.ndarray](), list[np.ndarray]()
        for upper, by_force in ((0, 1 - part), (1, part)):
            press = tips * len(_FORCES_N) + force + upper
            rows.append(press)
            weights.append(np.broadcast_to(touches * by_force, tips.shape))
            for right, by_margin in ((0, 1 - share), (1, share)):
                rows.append(len(self._moved_px) - self._size + press * len(_MARGINS) + margin + right)
                weights.append(touches * by_force * by_margin * pull)
        # a sparse product, which sums the weighted states without a temporary array each
        columns, values = (np.stack(parts, axis=-1) for parts in (rows, weights))
        starts = np.arange(0, columns.size + 1, len(rows))
        mix = csr_array((values.ravel(), columns.ravel(), starts), shape=(tips.size, len(self._moved_px)))
        return self.rest_px[grippers] + (mix @ self._moved_px).reshape(*tips.shape, _MARKERS, 2)


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
        rest, places = tip.markers(
            force.ravel(), friction=np.ones(force.size), margins=gamma.ravel(), held_s=np.ones(force.size)
        )
        middle = np.asarray(tip._sensor.geometry.centre_px)
        nearest = np.argsort(np.linalg.norm(rest - middle, axis=1), kind="stable")[:_MARKERS]
        moved = (places - rest)[:, nearest].reshape(*force.shape, len(nearest), 2)
        parts.append((rest[nearest], moved[:, -1], moved - moved[:, -1:]))
    rest, press, shear = (np.stack(values) for values in zip(*parts, strict=True))
    # rounded as they were stored, in the type of all else: mixed types are slow
    return rest, press.astype(np.float32).astype(np.float64), shear.astype(np.float32).astype(np.float64)


def place_in_grid(grid: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell of a grid that each value lies in, and its position in it, 0 to 1."""
    at = np.clip(np.searchsorted(grid, values, side="right") - 1, 0, len(grid) - 2)
    return at, np.clip((values - grid[at]) / (grid[at + 1] - grid[at]), 0, 1)
