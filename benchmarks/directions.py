"""Pulls in directions that a network was not trained on: how many of their margins are withheld, and what is shown.

Simulated frames in contact of days and sensors that nothing was chosen on are pulled within 75 to 105 degrees, as they
are and with frame and reference turned together or mirrored, and at 0, 180 and 270 degrees. Of each row the table has
the share of frames that the check of the direction withholds (`withheld`; `no_pull`: of those without a pull, `low`:
with a margin under 0.3), and of the frames that are not strange to the network: the share of those with a margin under
0.3 that it reads above 0.7 (`safe_before`, and `safe` of those that the check lets pass), and the share of all that are
off by more than 0.2 (`off_before`, `off`).

With --fit the weights of `sliplens.shear` are fitted on trials of other days, and printed.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from sliplens import shear
from sliplens.live.reading import OFF
from sliplens.models import load
from sliplens.models.checkpoint import STRANGE
from sliplens.simulation import make_recipe, plan_trials
from sliplens.simulation.trials import prepare_trial

TRAINED = (75.0, 105.0)
LOW, SAFE = 0.3, 0.7
ROWS: dict[str, tuple[tuple[float, float], Callable[[np.ndarray], np.ndarray]]] = {
    "75 to 105": (TRAINED, lambda images: images),
    "75 to 105, mirrored": (TRAINED, lambda images: images[..., ::-1, :]),
    "75 to 105, turned by 180": (TRAINED, lambda images: images[..., ::-1, ::-1, :]),
    **{f"{middle:g}": ((middle, middle), lambda images: images) for middle in (0.0, 180.0, 270.0)},
}
"""Directions in degrees, and what is done to frame and reference."""
RIDGE = 3e-4  # of the mean square of the features


@dataclass(frozen=True, kw_only=True)
class Pulled:
    """Frames in contact of one trial."""

    reference: np.ndarray
    frames: np.ndarray
    margins: np.ndarray
    force_n: np.ndarray
    """Tangential force (x, y) in the image."""


def draw(series: str, directions: tuple[float, float], *, trials: int, frames: int, sensor: str) -> Iterator[Pulled]:
    """Draw frames of trials that are pulled in a range of directions; two trials a day, each with a new sensor."""
    recipe = make_recipe(
        "varied", sensor=sensor, dry_trials=trials, wet_trials=max(1, trials // 8), days=trials // 2 + 2, test_days=2,
        frames_per_trial=40,
    )  # fmt: skip
    nuisances = replace(recipe.nuisances, shear_direction_deg=directions)
    for plan in plan_trials(replace(recipe, series=series, sensors=trials // 2 + 1, nuisances=nuisances)):
        loading, film = prepare_trial(plan)
        touching = np.flatnonzero(np.isfinite(loading.safety_margin))
        at = touching[((np.arange(frames) + 0.5) / frames * len(touching)).astype(int)]
        direction = film.grasp.shear_direction_rad + film.day.camera_rotation_rad
        yield Pulled(
            reference=film.draw_reference().numpy(),
            frames=np.concatenate([film.draw(slice(frame, frame + 1)).numpy() for frame in at]),
            margins=loading.safety_margin[at],
            force_n=loading.tangential_force_n[at, None] * [np.cos(direction), np.sin(direction)],
        )


def measure(network: str, *, trials: int, frames: int) -> dict[str, dict[str, float]]:
    """Shares of frames, by row of `ROWS`."""
    run, found = load(network), {}
    for name, (directions, turn) in ROWS.items():
        columns: dict[str, list[np.ndarray]] = {"margin": [], "read": [], "strange": [], "astray": []}
        for pulled in draw("direction-test", directions, trials=trials, frames=frames, sensor="chromatouch"):
            reference, images = (np.ascontiguousarray(turn(part)) for part in (pulled.reference, pulled.frames))
            estimate = run.estimate(run.encode(images, reference))
            estimator = shear.ShearEstimator(reference, "chromatouch")
            excess = np.array([estimator.estimate(image).excess(TRAINED) for image in images])
            known = np.ones(len(images)) if estimate.known is None else estimate.known
            columns["margin"].append(pulled.margins)
            columns["read"].append(np.clip(estimate.margin, 0, 1))
            columns["strange"].append(known < STRANGE)
            columns["astray"].append(excess > shear.DIRECTION_LIMIT)
        margin, read, strange, astray = (np.concatenate(parts) for parts in columns.values())
        low, off = margin < LOW, np.abs(read - margin) > OFF
        found[name] = {
            "withheld": astray.mean(), "no_pull": astray[margin > 0.99].mean(), "low": astray[low].mean(),
            "safe_before": (~strange & (read > SAFE))[low].mean(),
            "safe": (~strange & ~astray & (read > SAFE))[low].mean(),
            "off_before": (~strange & off).mean(), "off": (~strange & ~astray & off).mean(), "frames": len(margin),
        }  # fmt: skip
    return {name: {key: round(float(value), 4) for key, value in row.items()} for name, row in found.items()}


def fit(*, trials: int, frames: int) -> dict[str, object]:
    """Weights at the knots, of displacements and of their outward parts, by ridge regression to the pull.

    They are scaled so that a picture that moves as a whole by 1 pixel has a shear of 1 pixel; forces of each sensor
    count alike.
    """
    squares, products = np.zeros((2, 10, 10)), np.zeros((2, 10))
    for at, sensor in enumerate(("chromatouch", "flat-gel")):
        rows, forces = [], []
        for pulled in draw("direction-fit", (0.0, 360.0), trials=trials, frames=frames, sensor=sensor):
            estimator = shear.ShearEstimator(pulled.reference)
            for image, force_n in zip(pulled.frames, pulled.force_n, strict=True):
                rows.append(estimator.moments(estimator.measure_displacements(image)[0]))
                forces.append(force_n)
        moments, force_n = np.concatenate(rows, axis=1).T, np.concatenate(forces)
        scale = len(force_n) * np.mean(force_n**2)
        squares[at], products[at] = moments.T @ moments / scale, moments.T @ force_n / scale
    blank = np.zeros((224, 224, 3), dtype=np.uint8)
    estimator = shear.ShearEstimator(blank)
    still_px = estimator.measure_displacements(blank)[0]
    whole = [estimator.moments(still_px + np.eye(2)[axis])[:, axis] for axis in (0, 1)]
    found: dict[str, object] = {}
    for name, some in (("chromatouch", [0]), ("", [0, 1])):
        square, product = squares[some].sum(axis=0), products[some].sum(axis=0)
        weights = np.linalg.solve(square + RIDGE * np.trace(square) / 10 * np.eye(10), product)
        found[name] = (weights / (np.mean(whole, axis=0) @ weights)).round(2).tolist()
    return found


def main() -> None:
    """Print the shares as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", default="chromatouch-pair", help="name or folder of a network")
    parser.add_argument("--trials", type=int, default=40, help="dry ones, and an eighth as many wet")
    parser.add_argument("--frames", type=int, default=6, help="of each trial")
    parser.add_argument("--fit", action="store_true", help="print weights (--trials 150 --frames 5 for those in use)")
    parser.add_argument("--threads", type=int, default=2, help="of torch")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    sizes = {"trials": options.trials, "frames": options.frames}
    found = fit(**sizes) if options.fit else measure(options.network, **sizes)
    if options.json:
        print(json.dumps(found))
        return
    for name, row in found.items():
        print(f"{name:26} {row}")


if __name__ == "__main__":
    main()
