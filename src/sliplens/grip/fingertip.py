"""A simulated fingertip that is filmed as it is loaded, frame after frame."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, UInt8

from sliplens.simulation.filming import Film, batches, prepare_film
from sliplens.simulation.loading import load_at_margins, load_at_states
from sliplens.simulation.nuisances import Day, Nuisances, draw_day, draw_grasp, draw_unit
from sliplens.simulation.sensor import CHROMATOUCH, Sensor

_TOUCH_N = 0.02
"""Lighter touches are none: the simulator's labels have no contact there either."""
_INNER = 19
"""Markers that surely touch: the apex and two rings of the dome."""


class Fingertip:
    """Fingertip on an object: a built sensor, the day's light and the way it touches, all drawn from a seed.

    What moves the markers is the simulator's own press and pull, at whatever force, friction and margin it is shown.
    What an earlier slip left in the skin is not shown.

    Parameters
    ----------
    seed
        Seed of the sensor, the day, the touch and the noise.
    nuisances
        Ranges they are drawn from; friction and force are given later, frame by frame.
    day
        Day to share with another fingertip of the same gripper; drawn if None.
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
        day_rng, unit_rng, grasp_rng, film_rng, self._rng = np.random.default_rng(seed).spawn(5)
        day = draw_day(nuisances, quantile=0.5, rng=day_rng) if day is None else day
        grasp = draw_grasp(nuisances, day=day, wet=False, rng=grasp_rng)
        self._film = prepare_film(
            sensor,
            loading=load_at_margins(np.ones(1), grasp=grasp),
            grasp=grasp,
            day=day,
            unit=draw_unit(nuisances, markers=sensor.geometry.markers, rng=unit_rng),
            rng=film_rng,
            noise=sensor.noise,
        )
        self.day = day

    @cached_property
    def reference(self) -> UInt8[np.ndarray, "height width 3"]:
        """The untouched sensor, T_0."""
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
        """Film of contact states, ready to be drawn.

        `friction` is the coefficient that holds, kinetic where the object slides (margin 0); `held_s` the time since
        the touch, which creep grows with; `pulled_back`: the object pulls the other way.
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
        """Draw one frame, as `film` takes its state; forces in newtons, margin from 0 to 1."""
        force, mu, gamma, held = (np.array([value]) for value in (normal_force_n, friction, margin, held_s))
        film = self.film(force, friction=mu, margins=gamma, held_s=held, pulled_back=pulled_back)
        return film.draw(slice(0, 1))[0].numpy()


def draw_film(film: Film) -> UInt8[np.ndarray, "frames height width 3"]:
    """Draw every frame of a film."""
    return torch.cat([film.draw(part) for part in batches(len(film), device="cpu")]).numpy()


def mean_shear(
    rest_px: Float[np.ndarray, "markers 2"], now_px: Float[np.ndarray, "*frames markers 2"]
) -> Float[np.ndarray, "*frames"]:
    """Mean displacement of the 19 innermost markers down the image, in pixels: the way of the pull.

    Markers that are not seen (NaN) are left out; without any it is NaN.
    """
    away = np.linalg.norm(rest_px - np.median(rest_px, axis=0), axis=1)
    moved = (now_px - rest_px)[..., np.argsort(away, kind="stable")[:_INNER], 1]
    seen = np.isfinite(moved)
    return np.asarray(np.where(seen, moved, 0).sum(axis=-1) / np.where(seen.any(axis=-1), seen.sum(axis=-1), np.nan))
