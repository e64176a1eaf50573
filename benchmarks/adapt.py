"""How many trials of a new sensor a network needs: adapted from another network, and trained from scratch.

Three sensors new to every network of the package: a dome with other rings of markers, the flat gel, and the ChromaTouch
dome behind another lens. Of each one piece is built; dry trials of some days are recorded, a fifth is held out. The
test is ten other days of the same piece, dry and wet. The recipe was chosen on other days, pieces and trials. From
scratch means the recipe `default` with as many images. Results are kept in `--cache` by the hash of their settings.
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import sliplens as sl
from sliplens.files import hash_json, output_folder, write_json
from sliplens.models import Network
from sliplens.recordings import Dataset, TrialInfo
from sliplens.simulation import CHROMATOUCH, FLAT_GEL, SimulationRecipe, simulate_dataset
from sliplens.simulation.sensor import Glare, Sensor
from sliplens.training import RECIPES, evaluate_frames
from sliplens.training.data import FrameSet, load_frames

DOME = replace(
    CHROMATOUCH,
    name="other-dome",
    geometry=replace(
        CHROMATOUCH.geometry, ring_spacing_deg=10.4, ring_counts=(1, 8, 14, 21, 26, 30), ring_scale=(1.0,) * 6
    ),
    look=replace(CHROMATOUCH.look, radius_px=(4.6, 5.0, 4.8), contrast=(60.0, 90.0, 150.0)),
    background=(150.0, 190.0, 205.0),
)
LENS = replace(
    CHROMATOUCH,
    name="other-lens",
    geometry=replace(CHROMATOUCH.geometry, camera_offset=0.1, focal_px_per_rad=140.0, centre_px=(108.0, 117.0)),
    glare=Glare(
        centre_px=(112.0, 112.0), radius_px=118.0, lamps=4, bearing_deg=30.0, width_px=22.0, colour=(160.0, 120.0, 40.0)
    ),
    vignette=0.4,
)
SENSORS: dict[str, Sensor] = {"dome": DOME, "flat gel": FLAT_GEL, "lens": LENS}
STARTS = ("adapted", "scratch")
DAYS, TEST_DAYS, FRAMES = 10, 10, 40
"""Days on which the owner records, days of the test, frames of a trial."""
TEST_TRIALS = 3
"""Trials of a test day and condition."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What one training is given; with the data set it is all that shapes the result."""

    sensor: str
    start: str
    trials: int
    seed: int
    image_size: int | None
    changes: dict[str, Any]


def recipe_of(sensor: Sensor, *, most: int, seed: int) -> SimulationRecipe:
    """Trials of one piece of a sensor: enough to record, and the test."""
    return SimulationRecipe(
        dry_trials=(-(-most // DAYS),) * DAYS + (TEST_TRIALS,) * TEST_DAYS,
        wet_trials=TEST_TRIALS * TEST_DAYS,
        frames_per_trial=FRAMES,
        days=DAYS + TEST_DAYS,
        test_days=TEST_DAYS,
        sensor=sensor,
        sensors=1,
        seed=seed,
        series="adapt, test",
    )


def recorded(data: Dataset, trials: int) -> Dataset:
    """The first trials that the owner records, a fifth of them held out."""
    mine = [trial for trial in data.trials if trial.split != "test"]
    mine.sort(key=lambda trial: (trial.trial.split("-")[-1], trial.day))
    held = max(1, round(0.2 * trials))
    learnt = max(1, trials - held)
    split: dict[str, list[TrialInfo]] = {"train": mine[:learnt], "validation": mine[learnt : learnt + held]}
    return replace(data, trials=tuple(replace(one, split=name) for name, some in split.items() for one in some))


def train(plan: Plan, data: Dataset, start: Network) -> Network:
    """The network that the owner gets."""
    recipe = RECIPES["adapt"]
    changes: dict[str, Any] = {"seed": plan.seed, "image_size": plan.image_size} | plan.changes
    if plan.start == "scratch":
        as_many = {"epoch_frames": recipe.epoch_frames, "epochs": recipe.epochs, "batch_size": recipe.batch_size}
        return sl.train(recorded(data, plan.trials), **as_many | changes)
    return sl.train(recorded(data, plan.trials), recipe="adapt", start_from=start, **changes)


def r2(run: Network, frames: FrameSet) -> dict[str, float]:
    """R2 of the margin, dry and wet."""
    return {name: float(one.r2 or 0) for name, one in evaluate_frames(run, frames).conditions.items()}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """R2 by sensor, start and number of trials, mean over seeds with each seed beside it."""
    network = sl.load(options.start_from)
    found: dict[str, dict[str, dict[str, list[dict[str, float]]]]] = {}
    sensors: list[str] = options.sensors
    for name, seed in product(sensors, range(options.seeds)):
        recipe = recipe_of(SENSORS[name], most=max(options.trials), seed=seed)
        folder = options.cache / f"data-{recipe.hash}"
        with output_folder(folder, stage="adapt", config={"recipe": recipe.to_json()}, overwrite=False) as output:
            if not output.complete:
                print(f"simulating {name}, seed {seed}", file=sys.stderr)
                simulate_dataset(output.folder, recipe)
        data = sl.load_dataset(folder)
        test: dict[tuple[int, str], FrameSet] = {}
        for trials, start in product(options.trials, options.starts):
            if not trials and start == "scratch":
                continue
            plan = Plan(
                sensor=name, start=start, trials=trials, seed=seed, image_size=options.image_size,
                changes=json.loads(options.changes),
            )  # fmt: skip
            shaped = {
                "plan": asdict(plan),
                "recipe": recipe.hash,
                "start": network.manifest.weights_sha256,
                "training": RECIPES["adapt" if start == "adapted" else "default"],
                "as_many": RECIPES["adapt"],
            }
            part = options.cache / f"{hash_json(shaped)}.json"
            if not part.is_file():
                print(f"{name}, {start}, {trials} trials, seed {seed}", file=sys.stderr)
                run = train(plan, data, network) if trials else network
                size = run.manifest.image_size
                seen = size, run.encoding.name
                test[seen] = test.get(seen) or load_frames(
                    data, data.select(split="test"), encoding=run.encoding, image_size=size
                )
                write_json(part, r2(run, test[seen]))
            row = found.setdefault(name, {}).setdefault(start, {})
            row.setdefault(str(trials), []).append(json.loads(part.read_text()))
    means = {
        name: {
            start: {
                trials: {key: float(np.mean([one[key] for one in seeds])) for key in seeds[0]}
                for trials, seeds in row.items()
            }
            for start, row in rows.items()
        }
        for name, rows in found.items()
    }
    result: dict[str, Any] = {"r2_by_trials": means, "by_seed": found, "seeds": options.seeds}
    if "adapted" in options.starts and 10 in options.trials:
        most = str(max(options.trials))
        for name, rows in found.items():
            few, many = (np.array([[seed["dry"], seed["wet"]] for seed in rows["adapted"][at]]) for at in ("10", most))
            shares = few.mean(axis=0) / many.mean(axis=0)
            result.setdefault("share_at_10", {})[name] = dict(zip(("dry", "wet"), shares.tolist(), strict=True))
            by_seed = dict(zip(("dry", "wet"), (few / many).T.tolist(), strict=True))
            result.setdefault("share_at_10_by_seed", {})[name] = by_seed
    return result


def main() -> None:
    """Print what was measured as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--start-from", default="chromatouch-difference", help="network to adapt")
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS), choices=SENSORS)
    parser.add_argument("--trials", nargs="+", type=int, default=[0, 2, 3, 10, 30, 100])
    parser.add_argument("--starts", nargs="+", default=list(STARTS), choices=STARTS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--image-size", type=int, help="that of the network if not given")
    parser.add_argument("--changes", default="{}", help="fields of the recipes that are to differ, as JSON")
    parser.add_argument("--cache", type=Path, default=Path("runs/adapt"))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    found = measure(options)
    print(json.dumps(found, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
