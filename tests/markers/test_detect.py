from functools import partial

import numpy as np
import pytest
from dots import draw_dots, make_grid
from scipy.ndimage import gaussian_filter

from sliplens.errors import ImageError, InputError
from sliplens.markers import detect_markers

KIND = {"chromatouch": "chromatouch", "flat-gel": "gelsight-mini"}


def nearest(found, places):
    return np.linalg.norm(found[:, None] - places[None], axis=-1).argmin(axis=0)


@pytest.mark.parametrize(
    ("kind", "colours"),
    [
        ("gelsight-mini", {"background": (150, 140, 160), "marker": (30, 30, 30)}),
        ("tactip", {"background": (20, 20, 20), "marker": (230, 230, 230)}),
        ("chromatouch", {"background": (212, 208, 128), "marker": (83, 42, 53)}),
        ("auto", {"background": (150, 140, 160), "marker": (30, 30, 30)}),
        ("auto", {"background": (20, 20, 20), "marker": (230, 230, 230)}),
        # as bright as what surrounds it: only its colour tells it
        ("auto", {"background": (120, 120, 120), "marker": (180, 60, 120)}),
    ],
)
def test_every_contrast_is_found_and_measured(kind, colours, rng):
    places = make_grid(jitter=0.5, rng=rng)
    found = detect_markers(draw_dots(places, **colours, noise=3.0, rng=rng), kind)
    assert len(found) == len(places)
    error = found.centre_px[nearest(found.centre_px, places)] - places
    assert np.sqrt(np.mean(error**2)) < 0.06
    np.testing.assert_allclose(found.radius_px, 5.0, rtol=0.06)


@pytest.mark.parametrize("name", ["chromatouch", "flat-gel"])
def test_simulated_centres_are_within_the_goal_and_none_is_missed_or_invented(name, trials):
    trial = trials[name]
    appearance = detect_markers(trial.reference, KIND[name]).appearance
    errors = []
    for frame, places in zip(trial.frames[::4], trial.truth.marker_px[::4], strict=True):
        found = detect_markers(frame, appearance=appearance)
        distance = np.linalg.norm(found.centre_px[:, None] - places[None], axis=-1)
        inside = ((places > 9) & (places < 214)).all(axis=1)
        assert np.all(distance.min(axis=0)[inside] < 2)
        assert np.all(distance.min(axis=1)[found.whole] < 2)
        errors.append((found.centre_px[distance.argmin(axis=0)] - places)[inside])
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.15


def test_a_frame_without_markers_is_answered_with_none_once_their_look_is_known():
    appearance = detect_markers(draw_dots(make_grid()), "gelsight-mini").appearance
    assert len(detect_markers(draw_dots(np.zeros((0, 2))), appearance=appearance)) == 0


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        (np.full((80, 90, 3), 255, dtype=np.uint8), "saturated"),
        (np.zeros((80, 90, 3), dtype=np.uint8), "black"),
        (np.full((80, 90, 3), 120, dtype=np.uint8), "fewer than 4 markers"),
    ],
)
def test_frames_without_markers_are_refused_in_one_sentence(frame, told):
    with pytest.raises(ImageError, match=told):
        detect_markers(frame, "auto")


def noise(rng: np.random.Generator, *, blur_px: float) -> np.ndarray:
    levels = rng.normal(size=(224, 224, 3))
    levels = gaussian_filter(levels, (blur_px, blur_px, 0))
    return np.clip(120 + 30 * levels / levels.std(), 0, 255).astype(np.uint8)


def discs_of_many_sizes(rng: np.random.Generator) -> np.ndarray:
    rows, columns = np.mgrid[:300, :300]
    image = np.full((300, 300, 3), 180, dtype=np.uint8)
    for x, y, radius in zip(*rng.integers(0, 300, (2, 40)), rng.uniform(3, 16, 40), strict=True):
        image[np.hypot(columns - x, rows - y) < radius] = 60
    return image


def a_scene(rng: np.random.Generator) -> np.ndarray:
    """Grey levels whose spectrum falls as that of photographs does, with the inverse of the frequency."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    frequency[0, 0] = 1
    levels = np.fft.ifft2(np.fft.fft2(rng.normal(size=(256, 256))) / frequency).real
    return np.repeat(np.clip(120 + 45 * levels / levels.std(), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


PICTURES = {
    "noise": partial(noise, blur_px=0),
    "grain": partial(noise, blur_px=1),
    "fabric": partial(noise, blur_px=2),
    "clouds": partial(noise, blur_px=4),
    "discs": discs_of_many_sizes,
    "scene": a_scene,
}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_without_dots_has_no_markers(name: str, seed: int):
    with pytest.raises(ImageError, match="markers"):
        detect_markers(PICTURES[name](np.random.default_rng(seed)), "auto")


def test_dots_that_lie_anywhere_are_markers_if_they_are_alike(rng):
    grid = rng.permutation(49)[:20]  # of a fine grid, so that none touches another
    places = np.stack([20 + 26.0 * (grid % 7), 20 + 26.0 * (grid // 7)], axis=-1) + rng.uniform(-6, 6, (20, 2))
    assert len(detect_markers(draw_dots(places, size=(200, 200)), "auto")) == 20


def test_an_unknown_kind_is_refused():
    with pytest.raises(InputError, match="choose one of chromatouch, gelsight-mini, tactip, auto"):
        detect_markers(draw_dots(make_grid()), "digit")
