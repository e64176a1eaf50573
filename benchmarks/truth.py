"""Which explanation ranks the markers as they matter, on trials and networks that nothing was chosen by.

The truth are Shapley values of the markers over scenes drawn anew (docs/study.md). A method is recommended where its
signed rank correlation with them leads every control and every other method, both intervals off zero. With networks of
a second seed (`--second-network`) the whole is done once more on other trials of the same sensor, of four later days,
and the two answers are compared. Other networks have been chosen with other trials: `--seed` simulates those.
Each seed is a study that can be interrupted and goes on where it stopped (`--keep`).
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np

from sliplens.cli.console import Terminal
from sliplens.errors import SliplensError
from sliplens.intervals import Difference
from sliplens.recordings import load_dataset
from sliplens.report.verdict import recommend
from sliplens.results.study import Study, StudyConfig
from sliplens.simulation import simulate
from sliplens.study.run import run_study

LATER: dict[str, Any] = {"dry_trials": 32, "wet_trials": 8, "days": 8, "test_days": 4}
"""Days 5 to 8 of the preset's sensor, which has four."""


def look(networks: list[str], folder: Path, *, days: dict[str, Any], options: argparse.Namespace) -> Study:
    """Study the explanations of the networks that are named on test trials of the preset, or of other days."""
    terminal = Terminal()
    data = folder / "data"
    frames = options.frames_per_trial
    simulated = (
        load_dataset(data)
        if data.exists()
        else simulate(data, preset="thesis", frames_per_trial=frames, seed=options.seed, on_progress=terminal, **days)
    )
    return run_study(
        simulated,
        networks,
        StudyConfig(trials=options.trials, tests=("truth",)),
        out=folder / "study",
        on=options.on,
        on_progress=terminal,
    )


def interval(gap: Difference | None) -> list[float] | None:
    """Estimate, lower and upper end; None of a single trial."""
    return None if gap is None or gap.low is None or gap.high is None else [gap.estimate, gap.low, gap.high]


def judged(study: Study, name: str) -> dict[str, Any]:
    """What the truth says of one network's explanations."""
    truth, best = study.truth[name], recommend(study.truth[name])
    leads = {method: own.lead_over_controls for method, own in truth.methods.items()}
    effects = truth.effects
    sums = {frame: own.shapley.sum() for (frame,), own in effects.groups("frame_id").items()}
    towards = np.sign([sums[frame] for frame in effects.frame_id])
    return {
        "spearman": {method: interval(own.shapley) for method, own in truth.methods.items()},
        "lead_over_controls": {method: interval(lead.gap) for method, lead in leads.items() if lead is not None},
        "best": best and best.method,
        "tied": best and best.tied,
        "recommended": best.method if best is not None and best.shown else None,
        "spearman_single": {method: interval(own.network) for method, own in truth.methods.items()},
        "reliability": interval(truth.reliability),
        "sums": truth.sums,
        "opposing": {kind: float((towards * getattr(effects, kind) < 0).mean()) for kind in ("network", "shapley")},
        "frames": truth.frames,
        "left_out": study.left_out.get(name),
        "qualifying_trials": study.choice and study.choice.qualified_alone[name],
        "mean_error": study.choice and study.choice.mean_error[name],
    }


def show(name: str, found: dict[str, Any]) -> None:
    """Print one network's answers, the best method first."""
    print(f"{name}: recommended {found['recommended'] or 'none'}; {found['qualifying_trials']} trials qualify")
    known = {method: own for method, own in found["spearman"].items() if own}
    for method in sorted(known, key=lambda method: -known[method][0]):
        lead = found["lead_over_controls"].get(method)
        words = "" if lead is None else ", lead over controls {:+.2f} ({:+.2f} to {:+.2f})".format(*lead)
        print("  {:32} {:+.2f} ({:+.2f} to {:+.2f})".format(method, *known[method]) + words)


def main() -> None:
    """Print correlations, leads and verdicts by input, as text or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    own = ["thesis-difference", "thesis-raw"]
    parser.add_argument("--network", nargs="+", default=own, help="networks, one an input: folders or names")
    parser.add_argument("--second-network", nargs="+", default=[], help="networks of another seed")
    parser.add_argument("--seed", type=int, default=0, help="seed of the simulated trials")
    parser.add_argument("--trials", type=int, default=14)
    parser.add_argument("--frames-per-trial", type=int, default=80)
    parser.add_argument("--on", default="processes=2")
    parser.add_argument("--keep", type=Path, help="folder to keep data and studies in, and to go on from")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        work = options.keep or Path(scratch)
        try:
            looks = [
                look(networks, work / folder, days=days, options=options)
                for networks, folder, days in ((options.network, "1", {}), (options.second_network, "2", LATER))
                if networks
            ]
        except SliplensError as error:
            sys.exit(f"{Path(__file__).name}: {error}")
    result = {}
    for name in looks[0].truth:
        one, *others = [judged(study, name) for study in looks if name in study.truth]
        show(name, one)
        for other in others:
            show(f"{name}, second seed", other)
        again = others[0] if others else None
        same = again and again["recommended"] == one["recommended"]
        result[name] = {**one, "second_seed": again, "same_verdict_second_seed": same}
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
