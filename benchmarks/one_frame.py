"""What the markers of one frame tell of the margin, on the very days on which the networks are tested.

A perceptron is given where the visible markers went, with noise in each coordinate, and no image: it finds each marker
and mistakes none. What it reaches can be reached; what it misses another reader may still find. It is taught on trials
of their own, drawn as those of `chromatouch-pair` are, friction from 0.15 to 1.2 (`perceptron`), or as those of the
test, with more objects of middling friction (`as_tested`). A network reads the same frames: `lead_over` is what it
is ahead of a perceptron in R2, the days resampled together. Names end with the noise, in pixels.

Days, sensors and trials of a set are those of `networks.py`, and ten frames of each trial are drawn anew. What the
perceptron is given and its steps were chosen on the days of selection. Intervals hold 95 % over days.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from limit import SEEN, Samples, read, train
from networks import SETS, draw_in_contact, film_frames, fresh_days, lead, plans_of_set, r2_over_days, require_disjoint
from sliplens.errors import SliplensError
from sliplens.models import Network
from sliplens.models.checkpoint import load
from sliplens.simulation import PRESETS
from sliplens.simulation.nuisances import Nuisances
from sliplens.simulation.plan import TrialPlan, plan_trials
from sliplens.simulation.trials import prepare_trial

DAYS, STEPS = 1700, 3000
"""Days of training, of three trials each; steps, of 512 frames each."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """A few frames with contact of some trials: their markers, and what a network reads of them."""

    shift_px: Float[np.ndarray, "frames coordinates"]
    """Displacement of the visible markers."""
    margin: Float[np.ndarray, " frames"]
    wet: np.ndarray
    day: np.ndarray
    answer: Float[np.ndarray, " frames"] | None
    """Margins of the network; None where there is none to ask."""

    def samples(self, basis: Float[np.ndarray, "coordinates parts"]) -> Samples:
        """What a perceptron is given."""
        return Samples(
            inputs=torch.tensor(self.shift_px @ basis, dtype=torch.float32)[:, None],
            known=torch.empty(len(self.margin), 0),
            margin=torch.tensor(self.margin, dtype=torch.float32),
            wet=self.wet,
            pull=self.margin < 1,
            day=self.day,
        )


def training_plans(days: int) -> dict[str, tuple[TrialPlan, ...]]:
    """Trials to learn from, in series of their own."""
    as_network = replace(
        PRESETS["varied"],
        series="one frame",
        dry_trials=3 * days,
        days=days,
        test_days=1,
        wet_trials=1,
        nuisances=Nuisances(dry_friction=(0.15, 1.2)),
    )
    plans = {"perceptron": plan_trials(as_network), "as_tested": plan_trials(fresh_days("one frame, mixed", days // 2))}
    for some in plans.values():
        require_disjoint(some)
    return plans


def see(plans: Sequence[TrialPlan], *, seed: int, network: Network | None = None) -> Seen:
    """Draw a few frames with contact of each trial."""
    rng = np.random.default_rng(seed)
    shift, margin, wet, day, answer = [], [], [], [], []
    for plan in plans:
        loading, film = prepare_trial(plan)
        at = draw_in_contact(loading, rng=rng)
        shift.append((film.marker_px[at] - film.marker_rest_px)[:, SEEN].reshape(len(at), -1))
        margin.append(loading.safety_margin[at])
        wet.append(np.full(len(at), plan.condition == "wet"))
        day.append(np.full(len(at), plan.day))
        if network is not None:
            answer.append(network.estimate(network.encode(*film_frames(film, at))).margin)
    columns = [np.concatenate(some) for some in (shift, margin, wet, day)]
    return Seen(
        **dict(zip(("shift_px", "margin", "wet", "day"), columns, strict=True)),
        answer=np.concatenate(answer) if network is not None else None,
    )


def find_basis(seen: Seen, *, noise_px: float) -> Float[np.ndarray, "coordinates parts"]:
    """Orthonormal directions in which displacements vary by a fifth of the noise or more."""
    values, vectors = np.linalg.eigh(seen.shift_px.T @ seen.shift_px / len(seen.shift_px))
    return vectors[:, values > (noise_px / 5) ** 2]


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """R2 of the network and of each perceptron, and what the network is ahead of it, dry and wet."""
    test = see(plans_of_set(options.set, trials=options.trials), seed=1, network=load(options.run))
    assert test.answer is not None
    found: dict[str, Any] = {"set": options.set, "frames": len(test.margin)}
    answers = {"network": test.answer}
    for name, plans in training_plans(options.days).items():
        taught = see(plans, seed=0)
        found[f"{name}_taught_on"] = len(taught.margin)
        for noise_px in options.noise:
            basis = find_basis(taught, noise_px=noise_px)
            every, rows = np.arange(len(taught.margin)), torch.arange(len(test.margin))
            reader = train(taught.samples(basis), every, noise_px=noise_px, steps=options.steps, seed=options.seed)
            answers[f"{name}_{noise_px:g}"] = read(reader, test.samples(basis), rows, noise_px=noise_px)
    for condition, rows in (("dry", ~test.wet), ("wet", test.wet)):
        for name, answer in answers.items():
            found |= r2_over_days(f"{name}_r2_{condition}", test.margin[rows], answer[rows], test.day[rows])
            if name != "network":
                pair = test.answer, answer
                found |= lead(f"lead_over_{name}_{condition}", test.margin, pair, test.day, rows)
    return found


def main() -> None:
    """Print what was measured, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=Path("chromatouch-pair"), help="a trained network")
    parser.add_argument("--set", choices=SETS, default="test", help="days of `networks.py`")
    parser.add_argument(
        "--noise", type=float, nargs="+", default=[0.05, 0.1, 0.2], help="standard deviation of a coordinate, in px"
    )
    parser.add_argument("--days", type=int, default=DAYS, help="days of training")
    parser.add_argument("--steps", type=int, default=STEPS, help="of training")
    parser.add_argument("--trials", type=int, help="about so many trials of the set, for a quick look")
    parser.add_argument("--seed", type=int, default=0, help="of the perceptron")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        found = measure(options)
    except SliplensError as error:
        sys.exit(f"{Path(__file__).name}: {error}")
    if options.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        print(f"{name:32}", f"{value:.3f}" if isinstance(value, float) else value)


if __name__ == "__main__":
    main()
