"""Motion of the camera: it is measured apart from what a contact moves, with markers and without."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from sliplens.markers import Tracker
from sliplens.markers.camera import CAMERA_LIMIT_PX, BorderMotion, CameraMotion, CameraWatch, marker_camera_motion
from sliplens.recordings import Recording

Measure = Callable[[np.ndarray, np.ndarray], CameraMotion | None]


def warp(image: np.ndarray, *, degrees: float = 0.0, zoom: float = 1.0, shift: float = 0.0) -> np.ndarray:
    """Move a picture; clockwise turns are positive, as OpenCV's are not."""
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -degrees, zoom)
    matrix[0, 2] += shift
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)


def by_markers(reference: np.ndarray, frame: np.ndarray) -> CameraMotion | None:
    return marker_camera_motion(Tracker(reference).update(frame))


def by_border(reference: np.ndarray, frame: np.ndarray) -> CameraMotion | None:
    return BorderMotion(reference[..., 1].astype(np.float32)).measure(frame[..., 1].astype(np.float32))


def untouched(trial: Recording) -> np.ndarray:
    return trial.frames[np.isnan(trial.safety_margin)][0]


def touching(trial: Recording) -> np.ndarray:
    return trial.frames[np.isfinite(trial.safety_margin)][::4]


MOVES = [
    {"degrees": 1.0},
    {"degrees": -3.0},
    {"zoom": 1.02},
    {"zoom": 0.97},
    {"shift": 4.0},
    {"degrees": 1.0, "zoom": 0.98},
]


@pytest.mark.parametrize("measure", [by_markers, by_border])
@pytest.mark.parametrize("move", MOVES, ids=str)
def test_the_similarity_of_a_moved_camera_is_measured(
    trials: dict[str, Recording], measure: Measure, move: dict[str, float]
):
    trial = trials["chromatouch"]
    motion = measure(trial.reference, warp(untouched(trial), **move))
    assert motion is not None
    # noise of a tenth of a pixel in some 25 places; linear in the turn, whose square is 0.003 at 3 degrees
    assert motion.turn_deg == pytest.approx(move.get("degrees", 0.0), abs=0.1)
    assert motion.zoom == pytest.approx(move.get("zoom", 1.0) - 1, abs=0.003)
    assert motion.shift_px == pytest.approx(move.get("shift", 0.0), abs=0.1)
    # a border whose parts do not quite agree, as where a zoom was interpolated, may show a contact
    assert motion.excess_px > CAMERA_LIMIT_PX or (measure is by_border and not motion.free and "zoom" in move)


@pytest.mark.parametrize("measure", [by_markers, by_border])
def test_a_fixed_camera_has_not_moved_in_any_contact(trials: dict[str, Recording], measure: Measure):
    trial = trials["chromatouch"]
    for frame in (untouched(trial), *touching(trial)):
        motion = measure(trial.reference, frame)
        assert motion is not None
        assert motion.excess_px < CAMERA_LIMIT_PX


@pytest.mark.parametrize(
    ("measure", "move"),
    [
        *((by_markers, move) for move in ({"degrees": 1.2}, {"degrees": -3.0}, {"zoom": 1.025}, {"shift": 6.0})),
        (by_border, {"degrees": 1.2}),
        (by_border, {"degrees": -3.0}),
    ],
    ids=lambda value: str(getattr(value, "__name__", value)),
)
def test_a_camera_that_moves_in_a_contact_is_seen(
    trials: dict[str, Recording], measure: Measure, move: dict[str, float]
):
    trial = trials["chromatouch"]
    for frame in touching(trial):
        motion = measure(trial.reference, warp(frame, **move))
        assert motion is not None
        assert motion.excess_px > CAMERA_LIMIT_PX


def test_what_a_contact_hides_holds_from_before_it(trials: dict[str, Recording]):
    trial = trials["chromatouch"]
    watch, moved = CameraWatch(trial.reference), {"shift": 4.0}
    seen = [watch.update(warp(frame, **moved)) for frame in (untouched(trial), *touching(trial))]
    assert all(motion is not None and motion.excess_px > CAMERA_LIMIT_PX for motion in seen)
    back = watch.update(untouched(trial))
    assert back is not None
    assert back.excess_px < CAMERA_LIMIT_PX


def test_a_border_without_texture_shows_no_motion(rng: np.random.Generator):
    plain = np.clip(128 + rng.normal(0, 2, (224, 224, 3)), 0, 255).astype(np.uint8)
    plain[90:130, 90:130] = 20
    assert CameraWatch(plain).update(warp(plain, degrees=3.0)) is None
