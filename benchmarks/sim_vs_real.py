"""How far the simulated ChromaTouch is from the real one, on the published difference images.

The trial of the images is simulated with the fitted defaults of `Grasp` and compared frame by frame.
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from sliplens.images import absolute_difference, read_image, write_png
from sliplens.simulation.filming import prepare_film
from sliplens.simulation.loading import load_at_margins
from sliplens.simulation.motion import move_markers
from sliplens.simulation.noise import Noise
from sliplens.simulation.nuisances import Day, Grasp, nominal_unit
from sliplens.simulation.sensor import CHROMATOUCH

IMAGES = {51: np.nan, 80: 1.0, 357: 0.6, 433: 0.2, 547: 0.0}
"""Number and safety margin of the published images; the first is before contact."""

_BLUR_PX = 3


def read_real(folder: Path) -> np.ndarray:
    """Read the five real difference images, (frames, height, width, 3)."""
    return np.stack(
        [
            read_image(
                folder / "difference" / f"image_{number}.tiff_{100 if np.isnan(margin) else round(margin * 100)}.png"
            )
            for number, margin in IMAGES.items()
        ]
    )


def simulate(seed: int = 0) -> np.ndarray:
    """Difference images of the same trial, simulated."""
    grasp = Grasp()
    film = prepare_film(
        CHROMATOUCH,
        loading=load_at_margins(np.array(list(IMAGES.values())), grasp=grasp),
        grasp=grasp,
        day=Day(),
        unit=nominal_unit(CHROMATOUCH.geometry.markers),
        rng=np.random.default_rng(seed),
        noise=Noise(),
    )
    return absolute_difference(film.draw(slice(0, len(IMAGES))).numpy(), film.draw_reference().numpy())


def blurred(images: np.ndarray) -> np.ndarray:
    """Grey images under a Gaussian blur, the colours averaged."""
    steps = np.arange(-9, 10)
    kernel = np.exp(-(steps**2) / (2 * _BLUR_PX**2))
    kernel /= kernel.sum()
    grey = images.mean(axis=-1)
    for axis in (1, 2):
        grey = np.apply_along_axis(lambda line: np.convolve(line, kernel, mode="same"), axis, grey)
    return grey


def top_over_bottom(images: np.ndarray) -> np.ndarray:
    """Mean of the upper half over that of the lower half."""
    half = images.shape[1] // 2
    return images[:, :half].mean(axis=(1, 2, 3)) / images[:, half:].mean(axis=(1, 2, 3))


def marker_errors(real: np.ndarray) -> np.ndarray:
    """Simulated less measured displacement in pixels, (frames, markers, 2).

    Each real marker is located by fitting two blurred discs, at rest and displaced, to its crescents in green.
    """
    sensor, grasp = CHROMATOUCH, Grasp()
    loading = load_at_margins(np.array(list(IMAGES.values()))[1:], grasp=grasp)
    moved = move_markers(sensor, loading=loading, grasp=grasp)
    rest = moved.rest_px
    # two radii and the motion fit inside
    kept = np.all((rest > 20) & (rest < 204), axis=-1) & (
        np.linalg.norm(rest - sensor.geometry.centre_px, axis=-1) < 110
    )
    radius = sensor.marker_radius_px[1] * sensor.geometry.marker_scale()
    errors = []
    for image, centres, scale in zip(real[1:], moved.centres_px, moved.scale, strict=True):
        for index in np.flatnonzero(kept):
            expected = centres[index] - rest[index]
            measured = _measure(image[..., 1], rest[index], expected, radius[index], scale[index])
            errors.append(expected - measured)
    return np.array(errors).reshape(len(moved.scale), -1, 2)


def _measure(green: np.ndarray, rest: np.ndarray, expected: np.ndarray, radius: float, scale: float) -> np.ndarray:
    column, row = np.meshgrid(np.arange(green.shape[1]), np.arange(green.shape[0]))
    near = np.hypot(column - rest[0], row - rest[1]) < 17
    x, y, target = column[near], row[near], green[near].astype(float)

    def residual(guess: np.ndarray) -> np.ndarray:
        rest_x, rest_y, dx, dy, growth, old, new = guess
        signal = old * _disc(x - rest_x, y - rest_y, radius) - new * _disc(
            x - rest_x - dx, y - rest_y - dy, radius * growth
        )
        # the noise keeps the fold of |.| off zero
        return (np.hypot(signal, 6) - target) / 15

    x0, y0 = rest
    # a marker that is not seen twice leaves the fit free to wander
    limits = ([x0 - 2, y0 - 2, -14, -14, 0.8, 100, 80], [x0 + 2, y0 + 2, 14, 14, 1.35, 240, 240])
    fits = [
        least_squares(
            residual, [x0, y0, *(expected * start), scale, 165, 150], bounds=limits, loss="soft_l1", max_nfev=40
        )
        for start in (0.7, 1.1)
    ]
    return min(fits, key=lambda fit: fit.cost).x[2:4]


def _disc(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    return 1 / (1 + np.exp(np.clip(np.hypot(x, y) - radius, -40, 40)))


def lobe_colours(images: np.ndarray) -> np.ndarray:
    """Mean colour of the brightest twentieth of the pixels, (frames, 3)."""
    colours = []
    for image in images:
        grey = image.mean(axis=-1)
        colours.append(image[grey >= np.quantile(grey, 0.95)].mean(axis=0))
    return np.array(colours)


def compare(real: np.ndarray, simulated: np.ndarray) -> dict[str, float]:
    """Numbers that say how far the simulated images are from the real ones; the worst frame counts."""
    contact = slice(1, None)
    soft_real, soft_simulated = blurred(real[contact]), blurred(simulated[contact])
    return {
        "correlation": float(
            min(np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in zip(soft_real, soft_simulated, strict=True))
        ),
        "mean_intensity_error": float(
            np.max(np.abs(simulated.mean(axis=(1, 2, 3)) / real.mean(axis=(1, 2, 3)) - 1)[contact])
        ),
        "top_bottom_error": float(np.max(np.abs(top_over_bottom(simulated) - top_over_bottom(real))[contact])),
        "marker_rms_px": float(np.sqrt(np.mean(marker_errors(real) ** 2))),
        "colour_error_levels": float(np.max(np.abs(lobe_colours(simulated) - lobe_colours(real))[contact])),
    }


def picture(real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """Real above simulated, the frame without contact brightened eight times."""
    rows = []
    for images in (real, simulated):
        lifted = np.clip(images[0].astype(int) * 8, 0, 255).astype(np.uint8)
        rows.append(np.concatenate([lifted, *images[1:]], axis=1))
    return np.concatenate(rows, axis=0).repeat(2, axis=0).repeat(2, axis=1)


def main() -> None:
    """Compare, print, and draw if asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    parser.add_argument("--out", type=Path, help="PNG to write: real above simulated")
    arguments = parser.parse_args()
    folder = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "chromatouch"
    real, simulated = read_real(folder), simulate()
    numbers = compare(real, simulated)
    print("margin        real  simulated   top/bottom real  simulated")
    for index, margin in enumerate(IMAGES.values()):
        print(
            f"{margin:6.2f}  {real[index].mean():10.2f} {simulated[index].mean():10.2f} "
            f"{top_over_bottom(real)[index]:16.2f} {top_over_bottom(simulated)[index]:10.2f}"
        )
    for name, value in numbers.items():
        print(f"{name:24s} {value:.3f}")
    if arguments.out is not None:
        write_png(arguments.out, picture(real, simulated))
    if arguments.json:
        print(json.dumps(numbers))


if __name__ == "__main__":
    main()
