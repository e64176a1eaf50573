"""A stored simulated trial made anew, so that markers can be put back while all else, the noise too, stays."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from sliplens._version import __version__
from sliplens.errors import ContactError, InputError
from sliplens.files import RUN_FILE, read_json
from sliplens.recordings import Recording
from sliplens.simulation.filming import Film, batches
from sliplens.simulation.information import (
    MARGIN,
    Sensitivity,
    marker_sensitivity,
    prior_sigma,
    reading_gain,
    visible_markers,
)
from sliplens.simulation.loading import Loading
from sliplens.simulation.nuisances import Nuisances, Pulls, Touch
from sliplens.simulation.plan import FrameTotals, SimulationRecipe, TrialPlan, plan_trials
from sliplens.simulation.sensor import SENSORS
from sliplens.simulation.trials import prepare_trial

_ROUNDING = 1
"""Grey levels by which the same scene may differ where another device or library drew it."""


@dataclass(frozen=True, kw_only=True)
class FilmedTrial:
    """A simulated trial with all that drew it."""

    plan: TrialPlan
    loading: Loading
    film: Film

    def touch(self, frame: int) -> Touch:
        """All that moves the markers of a frame, apart from its margin; what an earlier slip or pull left is not told.

        Drift and creep are in the force and the friction that hold in this frame.
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


@dataclass(frozen=True, kw_only=True)
class Outlines:
    """Circles that the markers of a frame fill, in camera pixels, and those that they filled at rest."""

    rest_px: Float[np.ndarray, "markers 2"]
    rest_radius_px: Float[np.ndarray, " markers"]
    """Radius in the widest channel."""
    now_px: Float[np.ndarray, "markers 2"]
    now_radius_px: Float[np.ndarray, " markers"]


def read_recipe(folder: Path) -> SimulationRecipe:
    """Read the recipe of a data set from its `run.json`."""
    path = folder / RUN_FILE
    try:
        stored = read_json(path)["config"]["recipe"]
        totals, pulls = stored["frame_totals"], stored.get("pulls")
        records: dict[str, Any] = {
            "sensor": SENSORS[stored["sensor"]["name"]],
            "nuisances": Nuisances(**_tuples(stored["nuisances"])),
            "frame_totals": None if totals is None else FrameTotals(**totals),
            "pulls": None if pulls is None else Pulls(**_tuples(pulls)),
        }
        return SimulationRecipe(**(_tuples(stored) | records))
    except (InputError, KeyError, TypeError, AttributeError, ValueError, ArithmeticError):
        raise InputError(
            f"{path} does not tell the recipe of the simulated trials; give the recipe, or a data set that "
            "sliplens simulate made"
        ) from None


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def rebuild_trial(folder: Path, recording: Recording, *, recipe: SimulationRecipe | None = None) -> FilmedTrial:
    """Make a stored simulated trial ready to be drawn anew, the same bytes as before.

    `recipe`: what simulated it; read from the folder if None.
    """
    name, truth = recording.trial, recording.truth
    if truth is None:
        raise InputError(f"trial {name} has no simulated truth and cannot be drawn anew; choose a simulated data set")
    recipe = read_recipe(folder) if recipe is None else recipe
    plans = {plan.trial: plan for plan in plan_trials(recipe)}
    if recipe.hash != truth.recipe or name not in plans:
        raise InputError(
            f"trial {name} of {folder} was simulated by another recipe, or by another version of sliplens than this "
            f"{__version__}; simulate the data set again"
        )
    loading, film = prepare_trial(plans[name])
    # the untouched sensor shows light, seat and print; the last frame all that came after
    last = len(film) - 1
    drawn = torch.stack([film.draw_reference(), film.draw(slice(last, last + 1))[0]]).numpy().astype(np.int16)
    if np.abs(drawn - [recording.reference, recording.frames[last]]).max() > _ROUNDING:
        raise InputError(
            f"trial {name} of {folder} is drawn otherwise than it is stored: its frames were changed, or other "
            "versions of numpy and torch made it; simulate the data set again"
        )
    return FilmedTrial(plan=plans[name], loading=loading, film=film)


def film_with_friction(trial: FilmedTrial, friction: Float[np.ndarray, " frames"]) -> FilmedTrial:
    """Film a trial anew as if the object had another friction in each frame: same forces, light, sensor and noise.

    Margins are NaN where that cannot be told (`loading.with_friction`): those frames mean nothing.
    """
    loading, film = prepare_trial(trial.plan, friction=friction)
    return FilmedTrial(plan=trial.plan, loading=loading, film=film)


def put_markers_back(film: Film, frame: int, back: Bool[np.ndarray, "variants markers"]) -> Film:
    """Film of one moment, in each of its frames with other markers put back; all else stays, the noise too.

    A marker that is put back lies where it lay untouched, as large as it was and pressed by nothing. The focus and the
    paleness that the touch gives to all markers stay: they are of the gel, not of the marker.
    """
    count, motion = len(back), film.motion
    at, taken = np.full(count, frame), np.full(count, frame + 1)  # the untouched sensor's picks come first

    def where_back(rest: np.ndarray | float, now: np.ndarray) -> np.ndarray:
        chosen = back[..., None] if now.ndim == 2 else back
        return np.where(chosen, rest, now[None])

    return replace(
        film,
        motion=replace(
            motion,
            centres_px=where_back(motion.rest_px, motion.centres_px[frame]),
            scale=where_back(1.0, motion.scale[frame]),
            pressure=where_back(0.0, motion.pressure[frame]),
            touch=motion.touch[at],
            indentation_m=motion.indentation_m[at],
            contact_radius_m=motion.contact_radius_m[at],
            stick_radius_m=motion.stick_radius_m[at],
        ),
        marker_px=where_back(film.marker_rest_px, film.marker_px[frame]),
        blur_px=film.blur_px[np.append(0, taken)],
        noise_picks=film.noise_picks[np.append(0, taken)],
    )


def draw_with_markers_back(
    film: Film, frame: int, back: Bool[np.ndarray, "variants markers"], *, device: str | torch.device = "cpu"
) -> UInt8[Tensor, "variants height width 3"]:
    """Draw a frame with markers put back (`put_markers_back`), once for each choice of them.

    With none put back it is the frame as it is stored.
    """
    changed = put_markers_back(film, frame, back)
    return torch.cat([changed.draw(part, device=device) for part in batches(len(back), device=device)])


def marker_outlines(film: Film, frame: int) -> Outlines:
    """Circles that the markers of a frame fill, and those that they filled at rest."""
    return Outlines(
        rest_px=film.marker_rest_px,
        rest_radius_px=film.untouched().look(slice(0, 1)).radius_px[0].max(axis=-1),
        now_px=film.marker_px[frame],
        now_radius_px=film.look(slice(frame, frame + 1)).radius_px[0].max(axis=-1),
    )


NOISE_PX = 0.1
"""Standard deviation of each coordinate of a marker that is followed in images of this noise (docs/limit.md)."""
_NEAREST_END = 0.02
"""Margins nearer to 0 or 1 are read with the gain of this one, or of one less this: the ends have no derivative."""


def marker_readings(
    trial: FilmedTrial, frame: int, *, noise_px: float = NOISE_PX
) -> tuple[Int[np.ndarray, " markers"], Float[np.ndarray, " markers"]]:
    """Part of each marker that lies wholly in the image in the best reading of a frame's margin.

    Gives numbers of the markers, and the reading as it is less the reading with that marker put back, in margin units.
    """
    gain, _ = _best_reading(trial, frame, noise_px)
    motion, seen = trial.film.motion, visible_markers(trial.plan.recipe.sensor)
    moved = (motion.centres_px[frame] - motion.rest_px)[seen]
    return seen, (gain.reshape(-1, 2) * moved).sum(axis=1)


def reading_slope(trial: FilmedTrial, frame: int, *, noise_px: float = NOISE_PX) -> float:
    """Rise of the best reading over that of the margin, where friction alone changes and the forces stay.

    It is told from the same markers whether the margin or the friction differs, and how far the reader expects each:
    below 1 the best reader, too, ascribes a part of what it sees to the friction. With friction mu and the same forces
    d log(mu) = d Gamma / (1 - Gamma).
    """
    gain, sensitivity = _best_reading(trial, frame, noise_px)
    moved = dict(zip(sensitivity.unknowns, sensitivity.jacobian[0].T, strict=True))
    used = max(1 - float(trial.loading.safety_margin[frame]), _NEAREST_END)
    return float(gain @ (moved[MARGIN] + moved["log_friction"] / used))


def _best_reading(trial: FilmedTrial, frame: int, noise_px: float) -> tuple[np.ndarray, Sensitivity]:
    """Gain of the best linear reading of a frame, and what it rests on."""
    recipe, margin = trial.plan.recipe, float(trial.loading.safety_margin[frame])
    if np.isnan(margin):
        raise ContactError(
            f"frame {frame} of {trial.plan.trial} has no contact, and so no margin; choose another frame"
        )
    sensitivity = marker_sensitivity(
        np.array([np.clip(margin, _NEAREST_END, 1 - _NEAREST_END)]),
        sensor=recipe.sensor,
        touch=trial.touch(frame),
        displacement=recipe.resolved_displacement,
    )
    prior = prior_sigma(recipe.nuisances, wet=trial.plan.condition == "wet")
    gain = reading_gain(sensitivity.jacobian[0], sensitivity.unknowns, noise_px=noise_px, prior=prior)
    return gain, sensitivity
