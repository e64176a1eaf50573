"""Motion of the camera: it is measured apart from what a contact moves, with markers and without."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from there import there

from sliplens.images import picture_change, soften
from sliplens.live import SimulatedSource
from sliplens.markers import Tracker
from sliplens.markers.camera import CAMERA_LIMIT_PX, BorderMotion, CameraMotion, CameraWatch, marker_camera_motion
from sliplens.recordings import Recording

Measure = Callable[[np.ndarray, np.ndarray], CameraMotion]
Pressed = tuple[np.ndarray, np.ndarray, list[np.ndarray]]


def warp(image: np.ndarray, *, degrees: float = 0.0, zoom: float = 1.0, shift: float = 0.0) -> np.ndarray:
    """Move a picture; clockwise turns are positive, as OpenCV's are not."""
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -degrees, zoom)
    matrix[0, 2] += shift
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)


def by_markers(reference: np.ndarray, frame: np.ndarray) -> CameraMotion:
    return there(marker_camera_motion(Tracker(reference).update(frame)))


def by_border(reference: np.ndarray, frame: np.ndarray) -> CameraMotion:
    return there(BorderMotion(reference[..., 1].astype(np.float32)).measure(frame[..., 1].astype(np.float32)))


def untouched(trial: Recording) -> np.ndarray:
    return trial.frames[np.isnan(trial.safety_margin)][0]


def touching(trial: Recording) -> np.ndarray:
    return trial.frames[np.isfinite(trial.safety_margin)][::4]


MOVES = [{"degrees": 1.0}, {"degrees": -3.0}, {"zoom": 1.02}, {"zoom": 0.97}, {"shift": 4.0}]
MOVES += [{"degrees": 1.0, "zoom": 0.98}]


@pytest.mark.parametrize("measure", [by_markers, by_border])
@pytest.mark.parametrize("move", MOVES, ids=str)
def test_the_similarity_of_a_moved_camera_is_measured(
    trials: dict[str, Recording], measure: Measure, move: dict[str, float]
):
    trial = trials["chromatouch"]
    motion = measure(trial.reference, warp(untouched(trial), **move))
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
        assert measure(trial.reference, frame).excess_px < CAMERA_LIMIT_PX


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
        assert measure(trial.reference, warp(frame, **move)).excess_px > CAMERA_LIMIT_PX


@pytest.fixture(scope="module", params=["chromatouch", "flat-gel"])
def pressed(request: pytest.FixtureRequest) -> Pressed:
    """Reference, an untouched frame, and frames of a wet contact up to full slip."""
    loads_n = [(0.0, 0.0), (0.3, 0.0), (0.8, 0.0), (1.5, 0.0), (2.5, 0.6), (2.5, 1.2), (3.0, 1.5)]
    frames, source = [], SimulatedSource(request.param, friction=0.5, rate_hz=1000.0, seed=1)
    with source:
        stream = source.frames()
        for normal_n, pull_n in loads_n:
            source.load(normal_force_n=normal_n, tangential_force_n=pull_n)
            next(stream)
            frames.append(next(stream).image)
    return there(source.reference), frames[0], frames[1:]


def border_excesses(pressed: Pressed, *, before: dict[str, float], during: dict[str, float]) -> list[float]:
    """Excess of an untouched frame, then of the contact, where a camera moves before the contact or in it."""
    reference, untouched, contact = pressed
    watch = CameraWatch(reference)
    frames = [warp(untouched, **before), *(warp(frame, **before, **during) for frame in contact)]
    motions = [watch.update(frame, touches=picture_change(soften(frame), soften(reference)) >= 7) for frame in frames]
    return [np.nan if motion is None else motion.excess_px for motion in motions]


def test_without_markers_a_healthy_wet_contact_raises_no_alarm(pressed: Pressed):
    assert max(border_excesses(pressed, before={}, during={})) < CAMERA_LIMIT_PX


@pytest.mark.parametrize("move", [{"shift": 4.0}, {"zoom": 1.03}], ids=str)
def test_without_markers_a_shift_before_the_contact_holds_until_its_end(pressed: Pressed, move: dict[str, float]):
    assert min(border_excesses(pressed, before=move, during={})) > CAMERA_LIMIT_PX
    reference, untouched, _ = pressed
    watch = CameraWatch(reference)
    watch.update(warp(untouched, **move), touches=True)
    assert there(watch.update(untouched, touches=False)).excess_px < CAMERA_LIMIT_PX


def test_a_border_without_texture_shows_no_motion(rng: np.random.Generator):
    plain = np.clip(128 + rng.normal(0, 2, (224, 224, 3)), 0, 255).astype(np.uint8)
    plain[90:130, 90:130] = 20
    assert CameraWatch(plain).update(warp(plain, degrees=3.0), touches=True) is None
