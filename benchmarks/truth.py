"""Do maps rank the markers as the simulator knows they count? Signed, against Shapley values and single effects.

Frames of simulated trials whose seed no preset and no study has, but on which methods were tried out: no test of these
unless `--data` names other trials. Both networks of the package unless `--network` names others. Beside the methods
stand the controls of a study, which know nothing of what the network learned. `--json` ends with one line of JSON.
"""

import argparse
import json
import os
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np

from sliplens.intervals import Difference
from sliplens.models.checkpoint import load
from sliplens.recordings import Dataset, load_dataset
from sliplens.results.study import Truth
from sliplens.simulation import simulate
from sliplens.study.checks import explain_untrained
from sliplens.study.curves import influences
from sliplens.study.explaining import explain_frames, frames_at, nearest_frame, network_inputs
from sliplens.study.material import Material, study_explainers
from sliplens.study.truth import TRUTH_PAIRS, judge_by_truth

NETWORKS = ("chromatouch-difference", "chromatouch-raw")
CHANGES: dict[str, Any] = {"dry_trials": 24, "wet_trials": 8, "days": 8, "test_days": 4, "frames_per_trial": 40}
METHODS = ("grad-cam", "integrated-gradients", "poly-cam-thesis", "poly-cam", "occlusion")


def judge(network: str, data: Dataset, args: argparse.Namespace) -> Truth:
    """Judge the maps of one network on frames of trials that are spread evenly over the test days."""
    run, infos = load(network), data.select(split="test", condition="dry")
    infos = infos[:: max(1, len(infos) // args.trials)][: args.trials]
    rows = [
        (info.trial, nearest_frame(data.load(info).safety_margin, level)) for info in infos for level in args.levels
    ]
    chosen = frames_at(run, data, rows)
    explainers = study_explainers(METHODS, budget=0.15)
    explained = explain_frames(run, chosen, methods=METHODS, explainers=explainers)
    material = Material(
        trained=run,
        explained=explained,
        inputs=network_inputs(run, explained),
        references=chosen.references.to(run.device),
        chosen=(),
        markers={},
        explainers=explainers,
    )
    maps = influences(material) | explain_untrained(material).maps
    return judge_by_truth(run, explained, data, maps=maps, fills=("reference", "blur", "grey"), pairs=args.pairs)


def told(gap: Difference | None) -> str:
    """Write a mean with its interval."""
    return "unknown" if gap is None else f"{gap.estimate:+.2f} ({gap.low:+.2f} to {gap.high:+.2f})"


def report(network: str, truth: Truth) -> dict[str, Any]:
    """Print what was found, and give it as numbers."""
    print(f"{network}: {truth.summary}\nreliability {told(truth.reliability)}")
    for name, found in sorted(
        truth.methods.items(), key=lambda one: -one[1].shapley.estimate if one[1].shapley else 0.0
    ):
        print(f"  {name:30} Shapley {told(found.shapley)}, single {told(found.network)}, margin {told(found.margin)}")
        if found.lead_over_controls is not None:
            print(f"  {'':30} lead over {found.lead_over_controls.control} {told(found.lead_over_controls.gap)}")
    for test in truth.meta:
        for counted, own in (("along", test), ("by size", test.by_size)):
            gains = f"truth {own.oracle:+.3f}, damaged {own.degraded:+.3f}, |x - b| {own.changed:+.3f}"
            print(f"  {test.fill:10} {counted:8} {gains}", flush=True)
    effects = truth.effects
    sums = {frame: own.shapley.sum() for (frame,), own in effects.groups("frame_id").items()}
    towards = np.sign([sums[frame] for frame in effects.frame_id])
    return {
        "spearman": {name: found.shapley and asdict(found.shapley) for name, found in truth.methods.items()},
        "lead_over_controls": {
            name: asdict(lead.gap) for name, found in truth.methods.items() if (lead := found.lead_over_controls)
        },
        "spearman_single": {name: found.network and asdict(found.network) for name, found in truth.methods.items()},
        "reliability": truth.reliability and asdict(truth.reliability),
        "sums": truth.sums,
        "opposing": {name: float((towards * getattr(effects, name) < 0).mean()) for name in ("network", "shapley")},
    }


def main() -> None:
    """Judge each network, on the data set that is named or on one that is simulated."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="data set; simulated if not given")
    parser.add_argument("--network", nargs="+", default=list(NETWORKS))
    parser.add_argument("--trials", type=int, default=6)
    parser.add_argument("--levels", type=float, nargs="+", default=[0.3], help="safety margins to look at")
    parser.add_argument("--pairs", type=int, default=TRUTH_PAIRS)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        simulated = None if args.data else simulate(Path(scratch) / "data", preset="thesis", seed=11, **CHANGES)
        data = simulated or load_dataset(args.data)
        found = {network: report(network, judge(network, data, args)) for network in args.network}
    if args.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
