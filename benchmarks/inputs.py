"""Which input or backbone reads the margin best from the same images: networks of several seeds, on new sensors too.

Each network is trained by the same command but for its input or backbone and its seed:

    sliplens simulate DATA --preset varied --dry-trials 1230 --days 410 --frames-per-trial 20 --seed 2
    sliplens train DATA -o RUNS/pair-0 --input pair --image-size 112 --epochs 5 --seed 0

The sets are fresh days of pieces of the ChromaTouch's kind, and the three sensors of `adapt.py`, which no network was
shown: a dome with other markers, the flat gel, another lens. Their seeds share nothing with any training. R2 of each
kind is a mean over its networks; differences to the first kind are those of networks with the same seed, with
intervals that hold 95 % over networks, then days. The set `selection` has other days
of the ChromaTouch's kind, on which variants are compared.

`time_over_first` is the median time of one image on one core, over that of the first kind, measured in turns.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from adapt import SENSORS
from networks import SETS, draw_in_contact, film_frames, fresh_days, r2, require_disjoint
from sliplens.errors import SliplensError
from sliplens.models import Network
from sliplens.models.checkpoint import load
from sliplens.simulation import SimulationRecipe
from sliplens.simulation.plan import plan_trials
from sliplens.simulation.trials import prepare_trial

DAYS = 20
RESAMPLES = 2000
TURNS = 50


@dataclass(frozen=True, kw_only=True)
class Read:
    """What every network answers to the frames of a set, and the truth."""

    margin: Float[np.ndarray, " frames"]
    day: Int[np.ndarray, " frames"]
    wet: np.ndarray
    answers: dict[str, Float[np.ndarray, " frames"]]


def recipes() -> dict[str, SimulationRecipe]:
    """The sets: days, sensors and trials of a series of their own."""
    varied = fresh_days("inputs, test", DAYS)
    others = {name: replace(varied, sensor=sensor) for name, sensor in SENSORS.items()}
    return {"chromatouch": varied, **others, "selection": fresh_days(*SETS["selection"])}


def read(runs: dict[str, Network], recipe: SimulationRecipe, *, trials: int | None) -> Read:
    """Draw a few frames of each trial, and have every network read them."""
    rng = np.random.default_rng(0)
    plans = [plan for plan in plan_trials(recipe) if plan.split == "test"]
    require_disjoint(plans)
    plans = plans[:: max(1, len(plans) // trials)] if trials else plans
    margin, day, wet = [], [], []
    answers: dict[str, list[np.ndarray]] = {name: [] for name in runs}
    for plan in plans:
        loading, film = prepare_trial(plan)
        at = draw_in_contact(loading, rng=rng)
        frames, reference = film_frames(film, at)
        for name, run in runs.items():
            answers[name].append(run.estimate(run.encode(frames, reference)).margin)
        margin.append(loading.safety_margin[at])
        day.append(np.full(len(at), plan.day))
        wet.append(np.full(len(at), plan.condition == "wet"))
    return Read(
        margin=np.concatenate(margin),
        day=np.concatenate(day),
        wet=np.concatenate(wet),
        answers={name: np.concatenate(one) for name, one in answers.items()},
    )


def by_kind(runs: dict[str, Network]) -> dict[str, dict[int, str]]:
    """Names of the networks, by input and backbone, and seed.

    Raises
    ------
    SystemExit
        If kinds were not trained with the same seeds, on the same images and as long.
    """
    found: dict[str, dict[int, str]] = {}
    for name, run in runs.items():
        if run.training is None:
            raise SystemExit(f"inputs.py: nothing tells how {name} was trained")
        kind = f"{run.manifest.input}, {run.manifest.backbone}"
        found.setdefault(kind, {})[run.training.seed] = name
    first = next(iter(found.values()))
    if any(one.keys() != first.keys() for one in found.values()):
        raise SystemExit("inputs.py: name networks of the same seeds for each input or backbone")
    costs = {(one.image_size, one.epochs, one.train_frames) for run in runs.values() if (one := run.training)}
    if len(costs) > 1 or len({run.manifest.data_hash for run in runs.values()}) > 1:
        raise SystemExit("inputs.py: the networks saw other data, sizes of image or numbers of epochs")
    return found


def time_over_first(runs: Sequence[Network]) -> list[float]:
    """Median time of one image, over that of the first network; the networks take turns on one core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    images = [torch.rand(1, run.encoding.colours, run.manifest.image_size, run.manifest.image_size) for run in runs]
    seconds = np.zeros((TURNS, len(runs)))
    with torch.inference_mode():
        for turn in range(-3, TURNS):  # the first few are not counted
            for at, (run, image) in enumerate(zip(runs, images, strict=True)):
                start = perf_counter()
                run.model(image)
                seconds[turn, at] = perf_counter() - start
    torch.set_num_threads(threads)
    medians = np.median(seconds, axis=0)
    return (medians / medians[0]).tolist()


def resampled(seeds: list[int], days: Int[np.ndarray, " _"]) -> Iterator[tuple[list[int], Int[np.ndarray, " _"]]]:
    """Seeds of networks, and rows of days, drawn with replacement."""
    rng = np.random.default_rng(0)
    rows = [np.flatnonzero(days == day) for day in np.unique(days)]
    for _ in range(RESAMPLES):
        some = np.concatenate([rows[at] for at in rng.integers(len(rows), size=len(rows))])
        yield [seeds[at] for at in rng.integers(len(seeds), size=len(seeds))], some


def compare(found: dict[str, dict[int, str]], seen: Read, *, wet: bool) -> dict[str, Any]:
    """R2 of each kind by seed, and what each is ahead of the first."""
    rows = seen.wet == wet
    margin, day = seen.margin[rows], seen.day[rows]
    answers = {name: answer[rows] for name, answer in seen.answers.items()}
    told: dict[str, Any] = {"frames": int(rows.sum())}
    for name, networks in found.items():
        told[name] = [r2(margin, answers[network]) for _, network in sorted(networks.items())]
    first, *others = found
    for name in others:
        drawn = [
            float(np.mean([
                r2(margin[some], answers[found[name][seed]][some]) - r2(margin[some], answers[found[first][seed]][some])
                for seed in seeds
            ]))
            for seeds, some in resampled(sorted(found[first]), day)
        ]  # fmt: skip
        told[f"{name}_minus_{first}"] = {
            "mean": float(np.mean(told[name]) - np.mean(told[first])),
            "low": float(np.quantile(drawn, 0.025)),
            "high": float(np.quantile(drawn, 0.975)),
        }
    return told


def main() -> None:
    """Print what was measured, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="trained networks; the kind of the first is compared with")
    parser.add_argument("--sets", nargs="+", default=["chromatouch", *SENSORS], choices=list(recipes()))
    parser.add_argument("--trials", type=int, help="about so many trials of each set, for a quick look")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        runs = {str(path): load(path) for path in options.runs}
    except SliplensError as error:
        sys.exit(f"{Path(__file__).name}: {error}")
    found, told = by_kind(runs), {}
    for name in options.sets:
        seen = read(runs, recipes()[name], trials=options.trials)
        told[name] = {"wet" if wet else "dry": compare(found, seen, wet=wet) for wet in (False, True)}
    times = time_over_first([runs[next(iter(names.values()))] for names in found.values()])
    if options.json:
        print(json.dumps({**told, "time_over_first": dict(zip(found, times, strict=True))}))
        return
    for name, time in zip(found, times, strict=True):
        print(f"{name:40} {time:.2f} of the time of the first")
    for name, condition in product(told, ("dry", "wet")):
        for one, value in told[name][condition].items():
            words = " ".join(f"{number:.3f}" for number in value) if isinstance(value, list) else value
            if isinstance(value, dict):
                words = "{mean:+.3f} ({low:+.3f} to {high:+.3f})".format(**value)
            print(f"{name:12} {condition} {one:24} {words}")


if __name__ == "__main__":
    main()
