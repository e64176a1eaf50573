"""Which explanation agrees with the effects of moved markers, on several networks, days and trials.

The truth is neutral: no map is made to predict how groups of markers, moved to another margin of their trial, change
the prediction (docs/study.md). Several networks of an input are pooled: intervals are over networks, then days, then
trials. A method is recommended where it leads every control and every other method for sure; `lead_over_rivals` is that
of the best method over Integrated Gradients and occlusion by marker. With networks and data of a second set
(`--second-network`, `--second-data`) the whole is done once more and the verdicts are compared.

Data are simulated with the preset `thesis` where none are named. Each network's study can be interrupted and continues
where it stopped (`--keep`).
"""

import argparse
import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np

import sliplens as sl
from sliplens.cli.console import Terminal
from sliplens.faithfulness.controls import lead_over_controls
from sliplens.intervals import Difference, mean_interval, paired_difference
from sliplens.models import Network
from sliplens.recordings import Dataset, load_dataset
from sliplens.results.faithfulness import CHANCE, is_control
from sliplens.results.study import RIVALS, NeutralScores, Study, StudyConfig
from sliplens.simulation import simulate
from sliplens.study.run import run_study

ORACLES = ("oracle", "degraded-oracle")


def test_trials(data: Dataset, *, a_day: int | None) -> Dataset:
    """Keep the first dry test trials of each day."""
    days: dict[int, list[Any]] = {}
    for info in data.select(split="test", condition="dry"):
        days.setdefault(info.day, []).append(info)
    return replace(data, trials=tuple(info for day in sorted(days) for info in days[day][:a_day]))


def each_round(networks: Sequence[Network]) -> Iterator[list[Network]]:
    """Yield networks of different inputs, until each is used once."""
    left = list(networks)
    while left:
        first = {network.manifest.input: network for network in reversed(left)}
        left = [network for network in left if network is not first[network.manifest.input]]
        yield list(first.values())


def judge_networks(
    names: Sequence[str], data: Path | None, folder: Path, *, options: argparse.Namespace
) -> list[Study]:
    """Study the explanations of all networks on the same trials, those of the preset if `data` is None."""
    terminal, frames = Terminal(), options.frames_per_trial
    if data is None:
        data = folder / "data"
        simulate(data, preset="thesis", frames_per_trial=frames, on_progress=terminal)
    trials = test_trials(load_dataset(data), a_day=options.trials_a_day)
    return [
        run_study(
            trials,
            some,
            StudyConfig(trials=options.trials or len(trials.trials), tests=("truth",)),
            out=folder / f"study-{number}",
            on=options.on,
            on_progress=terminal,
        )
        for number, some in enumerate(each_round([sl.load(name) for name in names]))
    ]


def ends(gap: Difference | None) -> list[float | None] | None:
    """Estimate, lower and upper end; these are None of a single trial."""
    return None if gap is None else [gap.estimate, gap.low, gap.high]


def pool(studies: Sequence[Study], name: str) -> dict[str, Any]:
    """Pool the judgements of all networks of an input."""
    truths = [study.truth[name] for study in studies if name in study.truth]
    rows = NeutralScores.joined([truth.neutral for truth in truths])
    network = np.repeat(np.arange(len(truths)), [len(truth.neutral) for truth in truths])
    # maps of a method are in the order of networks and frames: all methods have the same
    of_method = {str(method): np.flatnonzero(rows.method == method) for method in dict.fromkeys(rows.method.tolist())}
    valid = np.isfinite(rows.correlation[of_method[CHANCE]])
    scores = {method: rows.correlation[at][valid] for method, at in of_method.items()}
    at = of_method[CHANCE][valid]
    labels: dict[str, Any] = {"clusters": [network[at], rows.day[at], rows.trial[at]]}

    def compare(first: str, second: str) -> Difference:
        return paired_difference(scores[first], scores[second], rng=np.random.default_rng(0), **labels)

    neutral = {
        method: mean_interval(of_map, rng=np.random.default_rng(0), limits=(-1.0, 1.0), **labels)
        for method, of_map in scores.items()
    }
    controls = {
        method: np.copysign(1.0, of_map.mean()) * of_map
        for method, of_map in scores.items()
        if is_control(method) and method != CHANCE
    }
    methods = [method for method in scores if not is_control(method) and method not in ORACLES]
    best = max(methods, key=lambda method: neutral[method].estimate)
    lead = lead_over_controls(scores[best], controls, rng=np.random.default_rng(0), **labels)
    over = {method: compare(best, method) for method in methods if method != best}
    sure = lead.gap.above_zero and all(gap.above_zero for gap in over.values())
    return {
        "neutral": {method: ends(gap) for method, gap in neutral.items()},
        "over": neutral[best].over,
        "best": best,
        "recommended": best if sure else None,
        "strongest_control": lead.control,
        "lead_over_controls": ends(lead.gap),
        "lead_over_rivals": {rival: ends(over[rival]) for rival in RIVALS if rival in over},
        "lead_over_methods": {method: ends(gap) for method, gap in over.items()},
        **{
            kind: {method: [ends(getattr(truth.methods[method], kind)) for truth in truths] for method in methods}
            for kind in ("stick", "shapley")
        },
        "frames": [truth.frames for truth in truths],
        "mean_error": [study.choice and study.choice.mean_error.get(name) for study in studies],
    }


def main() -> None:
    """Print correlations, leads and verdicts by input as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = ["thesis-difference", "thesis-raw"]
    parser.add_argument("--network", nargs="+", default=default, help="networks, several an input: folders or names")
    parser.add_argument("--data", type=Path, help="data set of the networks' sensor; simulated if left out")
    parser.add_argument("--second-network", nargs="+", default=[], help="networks of the second set")
    parser.add_argument("--second-data", type=Path, help="data set of the second set")
    parser.add_argument("--trials-a-day", type=int, help="dry test trials of each day; all if left out")
    parser.add_argument("--trials", type=int, help="trials of all days, those that qualify first; all if left out")
    parser.add_argument("--frames-per-trial", type=int, default=80)
    parser.add_argument("--on", default="processes=2")
    parser.add_argument("--keep", type=Path, help="folder to keep data and studies in, and to continue from")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    sets = [(options.network, options.data, "1"), (options.second_network, options.second_data, "2")]
    with tempfile.TemporaryDirectory() as scratch:
        work = options.keep or Path(scratch)
        judged = [judge_networks(names, data, work / folder, options=options) for names, data, folder in sets if names]
    result = {}
    for name in sorted({name for study in judged[0] for name in study.truth}):
        first, *others = [pool(studies, name) for studies in judged if any(name in study.truth for study in studies)]
        second = others[0] if others else None
        same = None if second is None else second["recommended"] == first["recommended"]
        result[name] = {**first, "second_set": second, "same_verdict_second_set": same}
    print(json.dumps(result, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
