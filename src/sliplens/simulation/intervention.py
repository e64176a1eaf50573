"""Information of the markers about the safety margin, and interventions on stored simulated trials.

Observations are the displacements of the markers inside the image, each coordinate with Gaussian noise. The camera's
pose and the print's jitter move a marker and its place at rest alike: the reference frame shows them, so they are no
unknowns.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from sliplens._version import __version__
from sliplens.errors import ContactError, InputError
from sliplens.recordings import Recording
from sliplens.simulation.filming import Film
from sliplens.simulation.loading import Loading, load_at_margins, move_markers
from sliplens.simulation.nuisances import Nuisances, Range, Touch
from sliplens.simulation.plan import SimulationRecipe, TrialPlan, plan_trials, read_recipe
from sliplens.simulation.sensor import Sensor
from sliplens.simulation.trials import prepare_trial

Jacobian: TypeAlias = Float[np.ndarray, "coordinates unknowns"]

MARGIN = "margin"
"""Unknown that is estimated."""
_STEP = 1e-4  # step of the central differences: their error grows with its square, that of rounding (1e-12 px) over it


def _shift(field: str, axis: int | None = None, *, relative: bool = False) -> Callable[[Touch, float], Touch]:
    """Shift a number of the grasp, one of its pair, or its logarithm if `relative`."""

    def shift(touch: Touch, step: float) -> Touch:
        value = getattr(touch.grasp, field)
        if axis is None:
            moved = value + (value * float(np.expm1(step)) if relative else step)
        else:
            moved = tuple(part + step * (axis == at) for at, part in enumerate(value))
        return replace(touch, grasp=replace(touch.grasp, **{field: moved}))

    return shift


NUISANCES: dict[str, Callable[[Touch, float], Touch]] = {
    "log_friction": _shift("friction", relative=True),
    # force, drift, creep and stiffness all act through the contact radius: one unknown
    "log_load": _shift("normal_force_n", relative=True),
    "offset_x": _shift("contact_offset", 0),
    "offset_y": _shift("contact_offset", 1),
    "tilt_x_rad": _shift("tilt_rad", 0),
    "tilt_y_rad": _shift("tilt_rad", 1),
    "direction_rad": _shift("shear_direction_rad"),
    "shear_exponent": _shift("shear_exponent"),
    "marker_depth": lambda touch, step: replace(touch, marker_depth=touch.marker_depth + step),
}
"""Shift of a touch by each nuisance; lengths in radii of the contact's sphere, angles in radians, `log_` relative."""
UNKNOWNS = (MARGIN, *NUISANCES)
"""Names of the columns of `marker_sensitivity`."""


def visible_markers(sensor: Sensor) -> Int[np.ndarray, " markers"]:
    """Find the markers that lie inside the image at rest, at least their radius from its border."""
    points = sensor.geometry.project(sensor.geometry.marker_positions())
    border = max(sensor.look.radius_px)
    return np.flatnonzero(np.all((points >= border) & (points <= sensor.image_size_px - 1 - border), axis=-1))


def marker_sensitivity(
    margins: Float[np.ndarray, " frames"], *, sensor: Sensor, touch: Touch, displacement: str | None = None
) -> Float[np.ndarray, "frames coordinates unknowns"]:
    """Compute the shift of the visible markers with each of `UNKNOWNS`, by central differences.

    In pixels per unit of the unknown.
    """
    if not np.all((margins > 0) & (margins < 1)):
        raise ContactError("safety margins must lie inside (0, 1), where the derivative exists; leave out the ends")
    visible, step = visible_markers(sensor), _STEP * np.minimum(margins, 1 - margins)

    def positions(margins: np.ndarray, touch: Touch) -> np.ndarray:
        loading = load_at_margins(margins, grasp=touch.grasp)
        motion = move_markers(sensor, touch, loading=loading, displacement=displacement)
        # from rest: a deeper marker also lies elsewhere at rest, as the reference frame shows
        return (motion.centres_px - motion.rest_px)[:, visible].reshape(len(margins), -1)

    columns = [(positions(margins + step, touch) - positions(margins - step, touch)) / (2 * step[:, None])]
    # no marker lies above the skin
    start = replace(touch, marker_depth=max(touch.marker_depth, _STEP))
    for shift in NUISANCES.values():
        there, back = (positions(margins, shift(start, side * _STEP)) for side in (1, -1))
        columns.append((there - back) / (2 * _STEP))
    return np.stack(columns, axis=-1)


def prior_sigma(nuisances: Nuisances, *, wet: bool) -> dict[str, float]:
    """Compute the standard deviation of each nuisance over trials, with the friction of a wet or a dry object.

    The draws are even, not Gaussian: their variances are matched. Variances of the logarithms of a product add up.
    """
    if wet:
        friction = np.hypot(_log_sigma(nuisances.wet_friction), _drift_sigma(nuisances.wet_friction_drift))
    else:
        friction = np.hypot(_log_sigma(nuisances.dry_friction), _log_sigma(nuisances.dry_friction_factor))
    creep = (1 + nuisances.creep[0], 1 + nuisances.creep[1])
    load = [_log_sigma(part) for part in (nuisances.normal_force_n, nuisances.modulus_factor, creep)]
    # even in direction and reach: each coordinate has half of the mean squared reach
    low, high = nuisances.contact_offset
    offset = np.sqrt((low**2 + low * high + high**2) / 6)
    tilt, direction = (float(np.radians(_sigma(part))) for part in (nuisances.tilt_deg, nuisances.shear_direction_deg))
    return {
        "log_friction": float(friction),
        "log_load": float(np.linalg.norm([*load, _drift_sigma(nuisances.normal_force_drift)])),
        "offset_x": float(offset),
        "offset_y": float(offset),
        "tilt_x_rad": tilt,
        "tilt_y_rad": tilt,
        "direction_rad": direction,
        "shear_exponent": _sigma(nuisances.shear_exponent),
        "marker_depth": _sigma(nuisances.marker_depth),
    }


def reading_gain(
    jacobian: Jacobian, unknowns: tuple[str, ...], *, noise_px: float, prior: Mapping[str, float]
) -> Float[np.ndarray, " coordinates"]:
    """Compute the gain of the best linear estimator of the margin: its change with each coordinate, per pixel.

    The margin's row of (J^T J / sigma^2 + diag(1 / prior^2))^-1 J^T / sigma^2: with infinite priors the best linear
    unbiased estimator, else the posterior mean. `jacobian` is that of a frame, with the names of its columns.
    """
    rows, scale = observations(jacobian, unknowns, noise_px, prior)
    return np.linalg.pinv(rows / scale)[0, : len(jacobian)] / (scale[0] * noise_px)


def observations(
    jacobian: Jacobian, unknowns: tuple[str, ...], noise_px: float, prior: Mapping[str, float]
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, " columns"]]:
    """Build the rows of the least squares, a prior being one more observation, and the length of each column.

    Metres, radians and shares stand in one matrix: a column over its length has no unit.
    """
    sigma = {MARGIN: np.inf, **prior}
    if not (noise_px > 0 and min(sigma.values()) > 0):
        raise ContactError("noise and priors must be positive; leave fixed unknowns out of `prior`")
    free = [index for index, name in enumerate(unknowns) if name in sigma]
    rows = np.concatenate([jacobian[:, free] / noise_px, np.diag([1 / sigma[unknowns[index]] for index in free])])
    return rows, np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)


def _sigma(limits: Range) -> float:
    return (limits[1] - limits[0]) / np.sqrt(12)


def _drift_sigma(limits: Range) -> float:
    """Standard deviation of a relative change d p, p even in [-1, 1] through a trial, of variance E[d^2] / 3."""
    low, high = limits
    return float(np.sqrt((low**2 + low * high + high**2) / 9))


def _log_sigma(limits: Range) -> float:
    """Standard deviation of the logarithm of an even draw, on a grid fine enough for four digits."""
    return float(np.std(np.log(np.linspace(*limits, 10_001))))


_ROUNDING = 1  # grey levels by which another device or library may draw the same scene differently


@dataclass(frozen=True, kw_only=True)
class FilmedTrial:
    """A simulated trial with its plan, loading and film."""

    plan: TrialPlan
    loading: Loading
    film: Film

    def touch(self, frame: int) -> Touch:
        """Return the parameters that move the markers of a frame besides its margin, without traces of earlier slips.

        Force and friction of the frame include drift and creep.
        """
        grasp, loading = self.film.grasp, self.loading
        creep = 1 + grasp.creep * (1 - np.exp(-loading.held_s[frame] / grasp.creep_time_s))
        return Touch(
            grasp=replace(
                grasp,
                normal_force_n=float(loading.normal_force_n[frame] * creep),
                friction=float(loading.friction_coefficient[frame]),
            ),
            modulus_factor=self.film.day.modulus_factor,
            marker_depth=self.film.unit.marker_depth,
        )


def rebuild_trial(folder: Path, recording: Recording, *, recipe: SimulationRecipe | None = None) -> FilmedTrial:
    """Prepare a stored simulated trial to be drawn again with the same bytes; its recipe is read if None."""
    name, truth = recording.trial, recording.truth
    if truth is None:
        raise InputError(f"trial {name} has no simulated truth and cannot be drawn again; choose a simulated data set")
    recipe = read_recipe(folder) if recipe is None else recipe
    plans = {plan.trial: plan for plan in plan_trials(recipe)}
    if recipe.hash != truth.recipe or name not in plans:
        raise InputError(
            f"trial {name} of {folder} was simulated by another recipe, or by another version of sliplens than this "
            f"{__version__}; simulate the data set again"
        )
    loading, film = prepare_trial(plans[name])
    # the untouched sensor shows light, camera and print; the last frame depends on all the rest
    last = len(film) - 1
    drawn = torch.stack([film.draw_reference(), film.draw(slice(last, last + 1))[0]]).numpy().astype(np.int16)
    if np.abs(drawn - [recording.reference, recording.frames[last]]).max() > _ROUNDING:
        raise InputError(
            f"trial {name} of {folder} is drawn differently from its stored frames: they were changed, or other "
            "versions of numpy and torch made them; simulate the data set again"
        )
    return FilmedTrial(plan=plans[name], loading=loading, film=film)


def put_markers_back(
    film: Film, frame: int, back: Bool[np.ndarray, "variants markers"], *, to: int | None = None
) -> Film:
    """Film one moment several times, each time with other markers put back; all else stays, the noise too.

    A marker put back has its place, size and pressure of the frame `to`, of the untouched sensor if None. Focus and
    paleness, which the touch gives to all markers, stay.
    """
    count, motion = len(back), film.motion
    source, there = (film.untouched(), 0) if to is None else (film, to)

    def where_back(path: np.ndarray, paths: np.ndarray) -> np.ndarray:
        chosen = back[..., None] if path.ndim == 3 else back
        return np.where(chosen, paths[there], path[frame][None])

    moved = {
        name: where_back(getattr(motion, name), getattr(source.motion, name))
        for name in ("centres_px", "scale", "pressure")
    }
    same = {
        name: getattr(motion, name)[np.full(count, frame)]
        for name in ("touch", "indentation_m", "contact_radius_m", "stick_radius_m")
    }
    picks = np.append(0, np.full(count, frame + 1))  # the untouched sensor's come first
    return replace(
        film,
        motion=replace(motion, **moved, **same),
        marker_px=where_back(film.marker_px, source.marker_px),
        blur_px=film.blur_px[picks],
        noise_picks=film.noise_picks[picks],
    )


NOISE_PX = 0.1
"""Standard deviation of each coordinate of a tracked marker in images of this noise (docs/limit.md)."""
_NEAREST_END = 0.02  # distance from 0 and 1 within which the gain of this margin is used: the ends have no derivative


def marker_readings(
    trial: FilmedTrial, frame: int
) -> tuple[Int[np.ndarray, " markers"], Float[np.ndarray, " markers"]]:
    """Compute the contribution of each marker inside the image to the best linear estimate of a frame's margin.

    Gives numbers of the markers, and the estimate less the estimate with that marker put back, in margin units.
    """
    recipe, margin = trial.plan.recipe, float(trial.loading.safety_margin[frame])
    if np.isnan(margin):
        raise ContactError(
            f"frame {frame} of {trial.plan.trial} has no contact, and so no margin; choose another frame"
        )
    [jacobian] = marker_sensitivity(
        np.array([np.clip(margin, _NEAREST_END, 1 - _NEAREST_END)]),
        sensor=recipe.sensor,
        touch=trial.touch(frame),
        displacement=recipe.displacement,
    )
    prior = prior_sigma(recipe.nuisances, wet=trial.plan.condition == "wet")
    gain = reading_gain(jacobian, UNKNOWNS, noise_px=NOISE_PX, prior=prior)
    motion, visible = trial.film.motion, visible_markers(recipe.sensor)
    moved = (motion.centres_px[frame] - motion.rest_px)[visible]
    return visible, (gain.reshape(-1, 2) * moved).sum(axis=1)
