"""How well labels come back from simulated trials seen through noise, offset, lag, turned axes and a wrong sign.

A trial is simulated at the rate of its force sensor, and only every so-manieth frame is drawn: forces and frames then
come from one loading, not from forces interpolated between frames. Each trial is filmed once and labelled several
times, every time with another noise, offset, lag, direction of the pull, order of the axes and sign. Views of one trial
share its drift and friction, so the error of a coverage is counted over trials; several seeds make it small.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces
from sliplens.recordings.labels import FoundLabels, LabelSettings, estimate_lag, label_trial, measure_motion, soften
from sliplens.simulation import SimulationRecipe, TrialPlan, plan_trials
from sliplens.simulation.filming import Film
from sliplens.simulation.loading import TRIAL_S, Loading
from sliplens.simulation.trials import prepare_trial

FORCE_HZ = 500
SAMPLES_A_FRAME = 18
"""27.8 frames a second."""
LONGEST_LAG_S = 0.06
LARGEST_OFFSET_N = 1.0
_CONDITIONS = (("dry", False), ("wet", True))


@dataclass(frozen=True, kw_only=True)
class Seen:
    """A simulated trial, before anything spoils it."""

    plan: TrialPlan
    loading: Loading
    """At the force sensor's rate."""
    frames: np.ndarray
    """Which samples have a frame."""
    motion: Float[np.ndarray, " frames"]


@dataclass(frozen=True, kw_only=True)
class Score:
    """How far the labels of one trial are from the truth."""

    trial: str
    """With its seed, so that trials of several seeds stay apart."""
    wet: bool
    mu_error: float
    """Relative, signed."""
    mu_covered: bool
    lag_error_s: float
    lag_covered: bool
    lag_doubtful: bool
    axes_right: bool
    margin_error: Float[np.ndarray, " valid"]
    margin_covered: np.ndarray
    falsely_valid: int
    """Frames with a valid label that truly have no contact, or come after the slip."""


def film_trial(plan: TrialPlan) -> Seen:
    """Simulate a trial and measure the motion of its frames."""
    loading, film = prepare_trial(plan)
    frames = np.arange(SAMPLES_A_FRAME // 2, plan.frames, SAMPLES_A_FRAME)
    return Seen(
        plan=plan, loading=loading, frames=frames, motion=measure_motion(map(soften, draw_frames(film, frames)))
    )


def draw_frames(film: Film, frames: np.ndarray) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Draw frames, one at a time."""
    for index in frames:
        yield film.draw(slice(int(index), int(index) + 1))[0].numpy()


def spoil(seen: Seen, *, noise_n: float, rng: np.random.Generator) -> tuple[Forces, int, int]:
    """Forces as a sensor mounted anyhow would record them, the column that presses, and its sign."""
    loading, direction, sign = seen.loading, rng.uniform(-np.pi, np.pi), int(rng.choice((-1, 1)))
    contact = np.stack(
        (
            sign * loading.normal_force_n,
            np.cos(direction) * loading.tangential_force_n,
            np.sin(direction) * loading.tangential_force_n,
        ),
        axis=1,
    )
    order = rng.permutation(3)
    force = contact[:, order] + rng.uniform(-LARGEST_OFFSET_N, LARGEST_OFFSET_N, 3)
    force += rng.normal(0, noise_n, force.shape)
    return Forces(time_s=loading.time_s, force_n=force, source=seen.plan.trial), int(np.argmin(order)), sign


def score_trial(seen: Seen, *, noise_n: float, know_drift: bool, rng: np.random.Generator) -> Score | None:
    """Spoil a trial, label it, and compare with the truth; None where it is refused a label.

    The lag is applied unless the estimate itself doubts it.
    """
    forces, normal, sign = spoil(seen, noise_n=noise_n, rng=rng)
    lag_s = rng.uniform(-LONGEST_LAG_S, LONGEST_LAG_S)
    wet = seen.plan.condition == "wet"
    time_s = seen.loading.time_s[seen.frames] + lag_s
    lag = estimate_lag(time_s, seen.motion, forces, rng=rng)
    settings = LabelSettings(
        apply_lag=not lag.doubt, friction_change=_friction_change(seen.plan) if wet and know_drift else 0.0
    )
    try:
        labels = label_trial(time_s, seen.motion, forces, settings=settings, rng=rng, lag=lag)
    except RecordingError as refusal:
        print(f"{seen.plan.trial}: {refusal}")
        return None
    return _compare(
        labels, seen, lag_s=lag_s, axes_right=(labels.basis.axes.normal_index, labels.basis.axes.sign) == (normal, sign)
    )


def _friction_change(plan: TrialPlan) -> float:
    """Standard deviation of the change of a wet trial's friction from touch to slip, by the recipe's range."""
    low, high = plan.recipe.nuisances.wet_friction_drift
    # the drift is counted from the middle of the trial, and drawn evenly
    return 2 * (high - low) / np.sqrt(12)


def _compare(labels: FoundLabels, seen: Seen, *, lag_s: float, axes_right: bool) -> Score:
    loading, valid = seen.loading, labels.valid
    slip = int(np.argmax(loading.safety_margin == 0))
    mu, truth = float(loading.static_friction[slip]), loading.safety_margin[seen.frames]
    error, lag = (labels.safety_margin - truth)[valid], labels.basis.lag
    assert lag is not None
    known = np.isfinite(error)
    return Score(
        trial=f"seed{seen.plan.recipe.seed}-{seen.plan.trial}",
        wet=seen.plan.condition == "wet",
        mu_error=labels.basis.friction.mu / mu - 1,
        mu_covered=labels.basis.friction.low <= mu <= labels.basis.friction.high,
        lag_error_s=lag.lag_s - lag_s,
        lag_covered=abs(lag.lag_s - lag_s) <= lag.sigma_s,
        lag_doubtful=bool(lag.doubt),
        axes_right=axes_right,
        margin_error=error[known],
        margin_covered=(np.abs(error) <= labels.safety_margin_sigma[valid])[known],
        falsely_valid=int(np.sum(valid & (np.isnan(truth) | (seen.frames > slip)))),
    )


def summarise(scores: list[Score]) -> dict[str, float]:
    """One number for each claim; a trial counts alike however many valid frames it has, as they err together."""
    errors = np.concatenate([score.margin_error for score in scores])
    rms = [np.sqrt(np.mean(score.margin_error**2)) for score in scores]
    kinds = {"coverage_68": scores}
    kinds |= {f"coverage_68_{name}": [score for score in scores if score.wet == wet] for name, wet in _CONDITIONS}
    coverage: dict[str, float] = {}
    for name, some in kinds.items():
        if some:
            shares = _coverage_of_trials(some)
            coverage[name] = float(shares.mean())
            if len(shares) > 1:
                coverage[f"{name}_error"] = float(shares.std(ddof=1) / np.sqrt(len(shares)))
    return {
        "trials": len({score.trial for score in scores}),
        "mu_error": float(np.median([abs(score.mu_error) for score in scores])),
        "mu_error_worst": float(np.max([abs(score.mu_error) for score in scores])),
        "mu_coverage_68": float(np.mean([score.mu_covered for score in scores])),
        "lag_error_ms": 1e3 * float(np.median([abs(score.lag_error_s) for score in scores])),
        "lag_error_ms_p90": 1e3 * float(np.quantile([abs(score.lag_error_s) for score in scores], 0.9)),
        "lag_coverage_68": float(np.mean([score.lag_covered for score in scores])),
        "lag_doubtful": int(np.sum([score.lag_doubtful for score in scores])),
        "gamma_rms": float(np.sqrt(np.mean(errors**2))),
        "gamma_rms_worst": float(np.max(rms)),
        **coverage,
        "axes_right": float(np.mean([score.axes_right for score in scores])),
        "falsely_valid_frames": int(np.sum([score.falsely_valid for score in scores])),
    }


def _coverage_of_trials(scores: list[Score]) -> Float[np.ndarray, " trials"]:
    """Share of the valid frames whose band holds the truth, the mean of a trial's views."""
    views: dict[str, list[float]] = {}
    for score in scores:
        views.setdefault(score.trial, []).append(float(score.margin_covered.mean()))
    return np.array([np.mean(view) for view in views.values()])


def measure_seed(
    seed: int, *, dry: int, wet: int, draws: int, noise_n: float, know_drift: bool, release: bool
) -> list[Score | None]:
    """Score the trials of one seed, each seen `draws` times."""
    recipe = SimulationRecipe(
        dry_trials=dry, wet_trials=wet, frames_per_trial=round(TRIAL_S * FORCE_HZ), release=release, seed=seed
    )
    rng = np.random.default_rng(seed)
    scores: list[Score | None] = []
    for plan in plan_trials(recipe):
        seen = film_trial(plan)
        scores += [score_trial(seen, noise_n=noise_n, know_drift=know_drift, rng=rng) for _ in range(draws)]
    return scores


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dry", type=int, default=14, help="dry trials, over four days")
    parser.add_argument("--wet", type=int, default=6, help="wet trials")
    parser.add_argument("--draws", type=int, default=4, help="times each trial is spoilt and labelled")
    parser.add_argument("--noise", type=float, default=0.02, help="standard deviation of a force sample, in newtons")
    parser.add_argument("--seed", type=int, default=0, help="of the trials and of what spoils them")
    parser.add_argument("--seeds", type=int, default=1, help="pool so many seeds, from --seed on")
    parser.add_argument("--release", action="store_true", help="let go of the object at the end of each trial")
    parser.add_argument("--unknown-drift", action="store_true", help="do not tell the labels that wet friction drifts")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    scores = [
        score
        for seed in range(arguments.seed, arguments.seed + arguments.seeds)
        for score in measure_seed(
            seed,
            dry=arguments.dry,
            wet=arguments.wet,
            draws=arguments.draws,
            noise_n=arguments.noise,
            know_drift=not arguments.unknown_drift,
            release=arguments.release,
        )
    ]
    kept = [score for score in scores if score is not None]
    numbers = {"labelled": len(kept), "refused": len(scores) - len(kept), **summarise(kept)}
    for name, value in numbers.items():
        print(f"{name:22s} {value:.4g}")
    if arguments.json:
        print(json.dumps(numbers))


if __name__ == "__main__":
    main()
