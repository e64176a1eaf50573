"""Interventions on stored simulated trials: markers are moved and the scene is drawn again."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int

from sliplens._version import __version__
from sliplens.errors import InputError
from sliplens.recordings import Recording
from sliplens.simulation.filming import Film
from sliplens.simulation.loading import Loading
from sliplens.simulation.plan import SimulationRecipe, TrialPlan, plan_trials, read_recipe
from sliplens.simulation.sensor import Sensor
from sliplens.simulation.trials import prepare_trial


def visible_markers(sensor: Sensor) -> Int[np.ndarray, " markers"]:
    """Find the markers that lie inside the image at rest, at least their radius from its border."""
    points = sensor.geometry.project(sensor.geometry.marker_positions())
    border = max(sensor.look.radius_px)
    return np.flatnonzero(np.all((points >= border) & (points <= sensor.image_size_px - 1 - border), axis=-1))


_ROUNDING = 1  # grey levels by which another device or library may draw the same scene differently


@dataclass(frozen=True, kw_only=True)
class FilmedTrial:
    """A simulated trial with its plan, loading and film."""

    plan: TrialPlan
    loading: Loading
    film: Film


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
