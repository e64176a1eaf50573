"""The calibrated motion of the markers fitted anew, leaving out one real frame at a time."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from realism.markers import fit_crescents, read_table, rms
from realism.scene import MARGINS, PUBLISHED, SEEN, read_real
from sliplens.simulation.loading import load_at_margins
from sliplens.simulation.motion import DISPLACEMENTS, Displacement, move_markers
from sliplens.simulation.nuisances import Grasp, Touch
from sliplens.simulation.sensor import CHROMATOUCH

_KNOBS = ("layer", "local_friction", "clamp_exponent", "skin_shear", "normal_force_n", "shear_direction_rad",
          "shear_exponent")  # fmt: skip


def leave_one_out(folder: Path) -> dict[str, dict[str, Any]]:
    """What each frame in contact says when the motion was fitted to the others alone, by its margin in percent.

    Fitted are the four numbers of the calibrated displacement, and of the grasp its force, direction, exponent and
    contact offset, to the markers that the freer fit finds. Told are the error in px on the frame that was left out,
    the error on it when it is fitted too, and the numbers.
    """
    table = read_table(folder)
    labels = [index - 1 for index in SEEN]
    kept = table.reliable[labels]
    guess = _defaults()
    rest_px, start = _motion(guess)
    nearest = np.argmin(np.linalg.norm(table.rest_px[:, None] - rest_px, axis=-1), axis=1)
    measured = fit_crescents(read_real(folder)[1:], table.rest_px, start[:, nearest])

    def errors(factors: np.ndarray) -> np.ndarray:
        return _motion(guess * factors)[1][:, nearest] - measured

    def fit(frames: np.ndarray) -> np.ndarray:
        used = kept & frames[:, None]
        return least_squares(lambda factors: errors(factors)[used].ravel(), np.ones(len(guess)), max_nfev=30).x

    every = np.ones(len(SEEN), dtype=bool)
    whole, told = errors(fit(every)), {}
    for index, margin in enumerate(list(PUBLISHED.values())[1:]):
        factors = fit(np.arange(len(SEEN)) != index)
        told[f"{100 * margin:.0f} %"] = {
            "left_out_px": rms(errors(factors)[index][kept[index]]),
            "fitted_px": rms(whole[index][kept[index]]),
            "knobs": dict(zip((*_KNOBS, "offset_x", "offset_y"), (guess * factors).round(4).tolist(), strict=True)),
        }
    return told


def _defaults() -> np.ndarray:
    known = vars(DISPLACEMENTS["calibrated"]) | vars(Grasp())
    return np.array([*(known[name] for name in _KNOBS), *Grasp().contact_offset])


def _motion(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Markers at rest, and their displacement in the frames in contact, in px."""
    knobs = dict(zip(_KNOBS, values[:-2].tolist(), strict=True))
    model = Displacement(**{name: knobs.pop(name) for name in _KNOBS[:4]})
    grasp = replace(Grasp(), contact_offset=(float(values[-2]), float(values[-1])), **knobs)
    with _calibrated(model):
        motion = move_markers(
            CHROMATOUCH, Touch(grasp=grasp, marker_depth=0.0), loading=load_at_margins(MARGINS, grasp=grasp)
        )
    return motion.rest_px, motion.centres_px[SEEN] - motion.rest_px


@contextmanager
def _calibrated(model: Displacement) -> Iterator[None]:
    before = DISPLACEMENTS["calibrated"]
    DISPLACEMENTS["calibrated"] = model
    try:
        yield
    finally:
        DISPLACEMENTS["calibrated"] = before
