"""Is the regression score better than the thesis's? Removal curves and the simulator's truth, frame by frame.

Maps of `PolyCam(score="regression")`, with a budget (an engine, and an approximation of a likeness that is asked for),
against `PolyCam(score="thesis")`: its finest map, which the thesis displayed, and its sixth, which it scored. Controls
know nothing of answers: the same layers with all weights 1, and |x - reference|. Random orders are shared by the maps
of a frame. Differences are paired, and intervals are those over days and trials. `--json` ends with one line of JSON.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np
import torch
from torch import Tensor

from sliplens.errors import SliplensError
from sliplens.explainers.attribution import combine
from sliplens.explainers.cam import capture, find_layers, find_published_layers
from sliplens.explainers.contract import frozen
from sliplens.explainers.occlusion import marker_regions, markers_in_recording
from sliplens.explainers.poly_cam import PolyCam
from sliplens.faithfulness.controls import relevance_mass, relevance_rank
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import Units, score_maps, tile_units
from sliplens.files import machine, versions
from sliplens.intervals import paired_difference
from sliplens.models import Network
from sliplens.models.checkpoint import load
from sliplens.models.engines import prepare
from sliplens.plots.style import tell_ends
from sliplens.recordings import Dataset, Recording, load_dataset
from sliplens.recordings.trial import SLIPS
from sliplens.simulation import SimulationRecipe, simulate_dataset

NETWORKS = ("chromatouch-difference", "thesis-raw")
RECIPE = SimulationRecipe(dry_trials=24, wet_trials=0, days=12, frames_per_trial=40, seed=11)
FILLS = ("reference", "grey", "blur", "noisy-linear")
UNITS = {"pixel": lambda shape: tile_units(shape, size=1), "tile": lambda shape: tile_units(shape, size=16)}
LEVELS = (0.7, 0.4, 0.2, 0.0)
OURS = "regression"
FULL_BUDGET_PASSES = 10_000  # more than any frame takes: one engine for maps and removals


@dataclass(frozen=True, kw_only=True)
class Case:
    """One frame as a network sees it, with the simulator's truth."""

    trial: str
    day: int
    margin: float
    image: Tensor
    reference: Tensor
    regions: dict[str, np.ndarray]
    """Where the truth lies, at the network's size."""


def find_cases(trained: Network, data: Dataset, *, options: argparse.Namespace) -> Iterator[Case]:
    """Frames at the wanted margins, of trials spread over the data set; every other trial has every other margin."""
    infos = [info for info in data.trials if info.split == "test"] or list(data.trials)
    step = max(1, len(infos) // options.trials)
    for number, info in enumerate(infos[options.offset :: step][: options.trials]):
        recording = data.load(info)
        margin = np.where(recording.labelled, recording.safety_margin, np.nan)
        levels = LEVELS if options.all_levels else LEVELS[number % 2 :: 2]
        for level in levels:
            row = int(np.nanargmin(np.abs(margin - level)))
            yield Case(
                trial=info.trial,
                day=info.day,
                margin=float(margin[row]),
                image=trained.encode(recording.frames[[row]], recording.reference)[0],
                reference=trained.encoding.empty(recording.reference, image_size=trained.manifest.image_size),
                regions=true_regions(recording, row, size=trained.manifest.image_size),
            )


def true_regions(recording: Recording, row: int, *, size: int) -> dict[str, np.ndarray]:
    """Pixels of markers, and of the skin that slips, where there are any."""
    assert recording.truth is not None  # simulated
    places = markers_in_recording(recording, row, image_size=size)
    markers = (marker_regions((size, size), places) < len(places)).numpy()
    seen = torch.from_numpy(recording.truth.contact_map[row] == SLIPS)
    slips = torch.nn.functional.interpolate(seen[None, None].float(), size=(size, size))[0, 0].bool().numpy()
    return {name: region for name, region in (("markers", markers), ("slip", slips)) if region.any()}


def make_maps(trained: Network, case: Case, *, options: argparse.Namespace) -> dict[str, Tensor]:
    """Maps of one frame by name, larger where a pixel supports the change more."""
    model, image, reference = trained.model, case.image[None], case.reference
    added = (case.image - reference).abs().mean(dim=0)
    ours = PolyCam(budget=options.budget, levels=True)(model, image, reference=reference)
    with frozen(model), torch.no_grad():
        alone, published = (
            unit_weights(model, image, [layer.name for layer in find(model, image)])
            for find in (find_layers, find_published_layers)
        )
    if options.whole_thesis:
        published = [level.saliency[0] for level in PolyCam(score="thesis", levels=True)(model, image).levels]
    (told,) = ours.approximations or (None,)
    if told is not None:
        print(f"  {told.measured} of {told.channels} channels, expected r {told.pearson_r:.4f}", flush=True)
    return {
        OURS: ours.saliency[0],
        "regression, activity only": ours.levels[0].saliency[0],
        "regression x |x - reference|": ours.levels[0].saliency[0] * added,
        "thesis, finest": published[0],
        "thesis, level 5": published[5],
        "same layers, weights 1": alone[0] * added,
        "|x - reference|": added,
    }


def unit_weights(model: torch.nn.Module, image: Tensor, names: list[str]) -> list[Tensor]:
    """Levels of Poly-CAM whose channels all have the weight 1."""
    with capture(model, names) as outputs:
        model(image)
    activations = [outputs[name][0] for name in names]
    ones = [torch.ones(len(activation)) for activation in activations]
    return combine(activations, ones, size=(image.shape[-2], image.shape[-1]))


def judge(trained: Network, case: Case, *, options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Scores of one frame by map; keys of a score are its name, its fill or region, and its unit."""
    maps = {name: one.float().numpy() for name, one in make_maps(trained, case, options=options).items()}
    scores: dict[str, dict[str, float]] = {name: {} for name in maps}
    both = torch.stack([case.image, case.reference])
    with frozen(trained.model), torch.no_grad():
        answers = trained.predict(both)
        ready = prepare(trained.model, both, answers, passes=FULL_BUDGET_PASSES)
        for fill in options.fills:
            for unit in options.units:
                units: Units = UNITS[unit]((both.shape[-2], both.shape[-1]))
                found = score_maps(
                    ready,
                    both[:1],
                    {name: one[None] for name, one in maps.items()},
                    [units],
                    fill=get_fill(fill),
                    rng=np.random.default_rng(options.seed),
                    references=both[1:],
                    towards=(answers[:1] - answers[1:]).sign().double().numpy(),
                    random_orders=options.orders,
                )
                for name, one in found.items():
                    scores[name][f"symmetric_gain/{fill}/{unit}"] = float(one.symmetric_gain[0])
                    scores[name][f"gain_over_random/{fill}/{unit}"] = float(one.gain_over_random[0])
    for name, one in maps.items():
        for region, truth in case.regions.items():
            scores[name][f"mass/{region}"] = relevance_mass(one, truth)
            scores[name][f"rank/{region}"] = relevance_rank(one, truth)
            scores[name][f"chance/{region}"] = float(truth.mean())
    return scores


def summarise(cases: Sequence[tuple[Case, dict[str, dict[str, float]]]], *, seed: int) -> dict[str, object]:
    """Mean of each map, and the paired differences of ours from the others, by score."""
    names = list(cases[0][1])
    keys = sorted({key for _, scores in cases for key in scores[OURS]})
    table: dict[str, object] = {}
    for key in keys:
        known = [
            (case, scores) for case, scores in cases if all(np.isfinite(scores[n].get(key, np.nan)) for n in names)
        ]
        if not known:
            continue
        clusters = [np.array([case.day for case, _ in known]), np.array([case.trial for case, _ in known])]
        values = {name: np.array([scores[name][key] for _, scores in known]) for name in names}
        table[key] = {
            "frames": len(known),
            "means": {name: float(one.mean()) for name, one in values.items()},
            "ours_less": {
                name: paired_difference(values[OURS], one, clusters=clusters, rng=np.random.default_rng(seed))
                for name, one in values.items()
                if name != OURS
            },
        }
    return table


def show(table: dict[str, object]) -> None:
    """Print means, and differences with their intervals; a star where that is not chance."""
    for key, row in table.items():
        assert isinstance(row, dict)
        print(f"{key} ({row['frames']} frames): ours {row['means'][OURS]:.3f}")
        for name, gap in row["ours_less"].items():
            print(
                f"    {row['means'][name]:7.3f} {name:28} ours less it {gap.estimate:+.3f} "
                f"({tell_ends(gap, '{:+.3f}'.format)}){'*' if gap.sure else ' '}"
            )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, nargs="+", default=[Path(name) for name in NETWORKS], help="networks")
    parser.add_argument("--data", type=Path, help="simulated data set; a small one is made if not given")
    parser.add_argument("--trials", type=int, default=12, help="spread over the test trials of the data set")
    parser.add_argument("--offset", type=int, default=0, help="first trial; other offsets keep frames aside")
    parser.add_argument("--all-levels", action="store_true", help="all four margins of each trial, not every other")
    parser.add_argument("--fills", nargs="+", default=FILLS)
    parser.add_argument("--units", nargs="+", choices=UNITS, default=list(UNITS))
    parser.add_argument("--orders", type=int, default=20, help="random ones; they cancel in differences of maps")
    parser.add_argument("--budget", type=float, default=0.25)
    parser.add_argument(
        "--unit-thesis",
        dest="whole_thesis",
        action="store_false",
        help="take 1 for the thesis's weights, which they are above 17 %% to the last digit, instead of 2,416 passes",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    options = parser.parse_args(arguments)
    found = {}
    with tempfile.TemporaryDirectory() as scratch:
        try:
            data = load_dataset(options.data) if options.data else simulate_dataset(Path(scratch) / "data", RECIPE)
            for run in options.run:
                trained, cases = load(run), []
                for case in find_cases(trained, data, options=options):
                    print(f"{run} {case.trial} at {case.margin:.2f}", flush=True)
                    cases.append((case, judge(trained, case, options=options)))
                found[str(run)] = summarise(cases, seed=options.seed)
                print(f"{run}: {len(cases)} frames of {len({case.trial for case, _ in cases})} trials")
                show(found[str(run)])
        except SliplensError as error:
            sys.exit(f"{Path(__file__).name}: {error}")
    if options.json:
        asked = {key: str(value) for key, value in vars(options).items()}
        told = {"networks": found, "asked": asked, "machine": vars(machine()), "versions": versions()}
        print(json.dumps(told, default=asdict))


if __name__ == "__main__":
    main()
