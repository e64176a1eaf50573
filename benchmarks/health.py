"""Whether health tells that a margin is off: faults at graded strength on simulated trials, and healthy frames.

Each frame in contact of unseen days and sensors is predicted as it is, and with each fault in each strength. Faults of
camera and light are there since before the touch; a turn and a zoom also in a contact that was never seen without (`in
contact`). `dropped` is a picture that falls by 28 pixels at once, `torn` one of the upper part of a frame and the lower
part of one 0.4 or 1.6 s later, `pulled` a pull towards 180 or 270 degrees, outside the network's training. In `half
stale` and `frozen` half of the picture, or all of it under fresh noise, has stood still for 0.5 or 1 s. A margin is off
where it errs by more than 0.2, or without contact. `shown_wrong_share` is the share of frames off and not withheld.

`auroc` ranks all these frames by `margin_risk`, in which all checks and the network's own spread are one number, and
`auroc_worst` by how far their worst check is from its limit. `auroc_true_fault` is the best possible: ranking by the
true fault and strength, and how often it put the margins of the other trials off. `seen_by_network` is the AUROC of
each fault against frames without one, by `Estimate.known`. `withheld_healthy` is the share of healthy frames withheld.

With --choose, on other days and sensors, the quantiles of healthy values are printed, from which the limits were
chosen, and the numbers of `margin_risk`. Choice and test share no day and no sensor.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
import torch
from scipy.optimize import minimize
from scipy.stats import mannwhitneyu

from sliplens.files import DEFAULT_NETWORK
from sliplens.live import Check, HealthMonitor, LiveFrame
from sliplens.live.health import check_direction, check_novelty, margin_risk, severity
from sliplens.live.reading import OFF
from sliplens.markers import Tracker
from sliplens.models import Network, load
from sliplens.recordings.capture import Forces
from sliplens.simulation import TrialPlan, make_recipe, plan_trials
from sliplens.simulation.filming import Film
from sliplens.simulation.loading import Loading, load_at_margins
from sliplens.simulation.trials import prepare_trial

Fault = Callable[[np.ndarray, float, np.random.Generator], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One frame, and what was said of it."""

    trial: int
    fault: str
    strength: float
    error: float
    """Of the margin, infinite without contact."""
    checks: tuple[Check, ...]
    beyond: float
    """What the network gives for an error above 0.2."""
    known: float

    @property
    def failed(self) -> tuple[str, ...]:
        """Checks that were not fine."""
        return tuple(check.name for check in self.checks if not check.ok)

    @property
    def worst(self) -> float:
        """How far the worst check is from its limit."""
        return max(map(severity, self.checks))

    @property
    def name(self) -> str:
        """Fault with its strength."""
        return f"{self.fault} {self.strength:g}".removesuffix(" 0")


def auroc(positive: np.ndarray, negative: np.ndarray) -> float | None:
    """Compute how often a positive scores above a negative, ties half; None where a class is empty."""
    pairs = len(positive) * len(negative)
    return float(mannwhitneyu(positive, negative).statistic) / pairs if pairs else None


def defocus(image: np.ndarray, sigma_px: float, rng: np.random.Generator) -> np.ndarray:
    """Blur, then put the camera's noise back."""
    reach = int(3 * sigma_px) + 1
    kernel = np.exp(-((np.arange(-reach, reach + 1) / sigma_px) ** 2) / 2)
    kernel /= kernel.sum()
    soft = np.pad(image.astype(float), ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    for axis in (0, 1):
        soft = np.apply_along_axis(lambda line: np.convolve(line, kernel, mode="valid"), axis, soft)
    return soft + rng.normal(0, 2.2, soft.shape)


def move_camera(image: np.ndarray, shift_px: float, rng: np.random.Generator) -> np.ndarray:
    """Shift by so many pixels in some direction."""
    bearing = rng.uniform(-np.pi, np.pi)
    down, along = (round(shift_px * part) for part in (np.sin(bearing), np.cos(bearing)))
    rows, columns = (np.arange(side) for side in image.shape[:2])
    return image[np.ix_(np.clip(rows - down, 0, len(rows) - 1), np.clip(columns - along, 0, len(columns) - 1))]


def lose_lamp(image: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Darken one side by a share, the other not at all."""
    bearing = rng.uniform(-np.pi, np.pi)
    rows, columns = np.meshgrid(*(np.linspace(-0.5, 0.5, side) for side in image.shape[:2]), indexing="ij")
    ramp = 0.5 + (np.cos(bearing) * columns + np.sin(bearing) * rows) / (abs(np.cos(bearing)) + abs(np.sin(bearing)))
    return image * (1 - share * ramp[..., None])


def turn_camera(image: np.ndarray, degrees: float, rng: np.random.Generator) -> np.ndarray:
    """Turn by so many degrees one way or the other, about the middle."""
    return _warp(image, degrees=degrees * rng.choice([-1, 1]))


def zoom_camera(image: np.ndarray, factor: float, _: np.random.Generator) -> np.ndarray:
    """Enlarge about the middle."""
    return _warp(image, factor=factor)


def _warp(image: np.ndarray, *, degrees: float = 0.0, factor: float = 1.0) -> np.ndarray:
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, factor)
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)


def drop_picture(image: np.ndarray, pixels: float, _: np.random.Generator) -> np.ndarray:
    """Let the picture fall; its first row fills what comes above."""
    return image[np.maximum(np.arange(len(image)) - round(pixels), 0)]


TURNS = (0.3, 1.0, 3.0)
ZOOMS = (0.97, 0.98, 1.02, 1.03)
FAULTS: dict[str, tuple[Fault, tuple[float, ...]]] = {
    "defocus": (defocus, (0.7, 1.5, 3.0)),
    "camera moved": (move_camera, (1.0, 3.0, 6.0)),
    "exposure": (lambda image, factor, _: image * factor, (0.5, 0.8, 1.25, 1.7)),
    "lamp out": (lose_lamp, (0.2, 0.4, 0.7)),
    "turned": (turn_camera, TURNS),
    "zoomed": (zoom_camera, ZOOMS),
}
"""Faults that are there since before the touch."""
SUDDEN: dict[str, tuple[Fault, tuple[float, ...]]] = {
    "turned in contact": (turn_camera, TURNS),
    "zoomed in contact": (zoom_camera, ZOOMS),
    "dropped": (drop_picture, (28.0,)),
}
"""Faults of one frame, before which nothing was seen."""


def plan_some(
    series: str, trials: int, *, sensor: str | None = None, pull_deg: tuple[float, float] | None = None
) -> list[TrialPlan]:
    """One trial of each of as many days, each with a sensor of its own; series share no day and no sensor.

    `pull_deg`: directions of the pull; those of the recipe if None.
    """
    recipe = make_recipe("varied", sensor=sensor, days=trials + 2, dry_trials=trials + 2, wet_trials=0, test_days=1)
    directions = pull_deg or recipe.nuisances.shear_direction_deg
    nuisances = replace(recipe.nuisances, shear_direction_deg=directions)
    recipe = replace(recipe, nuisances=nuisances, series=series, sensors=trials + 2)
    return list(plan_trials(recipe))[:trials]


def touching(margins: np.ndarray, count: int) -> np.ndarray:
    """Some frames in contact, evenly spread: the middles of as many parts."""
    frames = np.flatnonzero(np.isfinite(margins))
    return frames[((np.arange(count) + 0.5) / count * len(frames)).astype(int)]


def draw(film: Film, frame: int) -> np.ndarray:
    """One frame."""
    return film.draw(slice(frame, frame + 1)).numpy()[0]


def hide_markers(film: Film, share: float, rng: np.random.Generator) -> Film:
    """Film in which some markers have lost their dye."""
    contrast = film.unit.contrast_factor.copy()
    contrast[rng.random(len(contrast)) < share] = 0.0
    return replace(film, unit=replace(film.unit, contrast_factor=contrast))


@dataclass(frozen=True, kw_only=True)
class Shot:
    """Frame that was seen before the one that is judged."""

    image: np.ndarray
    time_s: float
    force_n: np.ndarray | None = None
    """x, y, z; None without a force sensor."""

    def frame(self) -> LiveFrame:
        """Give it as a camera does."""
        forces = None
        if self.force_n is not None:
            forces = Forces(time_s=np.array([self.time_s]), force_n=self.force_n[None], source="simulated")
        pixels = np.clip(np.round(self.image), 0, 255).astype(np.uint8)
        return LiveFrame(image=pixels, number=0, time_s=self.time_s, captured_s=0.0, forces=forces)


class Judge:
    """Reads frames of one trial, and checks their health."""

    def __init__(self, run: Network, reference: np.ndarray, *, trial: int) -> None:
        self._run, self._reference, self._trial = run, reference, trial
        self._shear = run.shear_estimator(reference)

    def say(
        self,
        image: np.ndarray,
        margin: float,
        *,
        fault: str = "none",
        strength: float = 0.0,
        before: Sequence[Shot] = (),
        force_n: np.ndarray | None = None,
    ) -> Case:
        """Read one frame at the time 0; `before`: what was seen until then."""
        monitor, tracker = HealthMonitor(self._reference), Tracker(self._reference)
        checks, frame = (), Shot(image=image, time_s=0.0, force_n=force_n).frame()
        for seen in (*(shot.frame() for shot in before), frame):
            checks = monitor.check(seen, tracker.update(seen.image))
        if self._shear is not None and all(check.ok for check in checks):
            checks = (*checks, check_direction(self._run, self._shear.estimate(frame.image)))
        estimate = self._run.estimate(self._run.encode(frame.image[None], self._reference))
        novelty = check_novelty(estimate)
        error = abs(float(np.clip(estimate.margin[0], 0, 1)) - margin) if np.isfinite(margin) else np.inf
        return Case(
            trial=self._trial, fault=fault, strength=strength, error=error,
            checks=checks if novelty is None else (*checks, novelty),
            beyond=float(estimate.beyond(OFF)[0]), known=1.0 if estimate.known is None else float(estimate.known[0]),
        )  # fmt: skip


RATE_HZ = 10.0
FROZEN_S = (0.5, 1.0)
"""Time for which a picture stays as it was."""


def film_pull(
    film: Film, loading: Loading, *, old: int, now: int, rng: np.random.Generator
) -> tuple[list[Shot], float]:
    """Film the load from one frame to another, a quarter of its first part twice; gives the margin at the end too."""
    steps = np.linspace(0, 1, 1 + round(RATE_HZ * max(FROZEN_S)))
    steps = np.concatenate([np.zeros(3), steps])
    margins, normal_n = (
        values[old] + (values[now] - values[old]) * steps for values in (loading.safety_margin, loading.normal_force_n)
    )
    shots, friction = [], film.grasp.friction
    for at, (margin, normal) in enumerate(zip(margins.tolist(), normal_n.tolist(), strict=True)):
        grasp = replace(film.grasp, normal_force_n=normal)
        image = draw(film.under(load_at_margins(np.array([margin]), grasp=grasp), rng=rng), 0)
        force_n = np.array([(1 - margin) * friction * normal, 0.0, normal])
        shots.append(Shot(image=image, time_s=(at + 1 - len(steps)) / RATE_HZ, force_n=force_n))
    return shots, float(margins[-1])


def stop_half(shots: list[Shot], since: int, _: np.random.Generator) -> list[Shot]:
    """Leave the lower half as it was at one frame."""
    stale = shots[since].image
    half = len(stale) // 2
    return [
        replace(shot, image=np.concatenate([shot.image[:half], stale[half:]])) if at > since else shot
        for at, shot in enumerate(shots)
    ]


def stop_all(shots: list[Shot], since: int, rng: np.random.Generator) -> list[Shot]:
    """Leave all as it was at one frame, under fresh noise."""
    stale = shots[since].image
    return [
        replace(shot, image=stale + rng.normal(0, 2.2, stale.shape)) if at > since else shot
        for at, shot in enumerate(shots)
    ]


STOPPED: dict[str, Callable[[list[Shot], int, np.random.Generator], list[Shot]]] = {
    "half stale": stop_half,
    "frozen": stop_all,
}


def judge_stopped(
    judge: Judge, loading: Loading, film: Film, *, chosen: np.ndarray, rng: np.random.Generator
) -> Iterator[Case]:
    """Cases of pictures that stay as they were, whole or in part, and of the same sequences without the fault."""
    margins = loading.safety_margin
    for later in (1, 2):  # the picture stays that of an earlier frame, for longer and longer
        for old, now in zip(chosen[:-later], chosen[later:], strict=True):
            image, held_s = draw(film, old), float(loading.time_s[now] - loading.time_s[old])
            before = [Shot(image=image, time_s=-held_s)]
            yield judge.say(image, float(margins[now]), fault="stale", strength=float(later), before=before)
    for old, now in pairwise(chosen):
        shots, margin = film_pull(film, loading, old=old, now=now, rng=rng)
        *before, last = shots
        yield judge.say(last.image, margin, before=before, force_n=last.force_n)
        for fault, stop in STOPPED.items():
            for held_s in FROZEN_S:
                *before, last = stop(shots, len(shots) - 1 - round(RATE_HZ * held_s), rng)
                yield judge.say(last.image, margin, fault=fault, strength=held_s, before=before, force_n=last.force_n)


def judge_trial(run: Network, plan: TrialPlan, *, trial: int, frames: int, other: TrialPlan) -> Iterator[Case]:
    """All cases of one trial."""
    rng = np.random.default_rng(plan.seed)
    loading, film = prepare_trial(plan)
    judge, margins = Judge(run, film.draw_reference().numpy(), trial=trial), loading.safety_margin
    # the reference's own noise would be shared
    untouched = draw(film, 0)
    chosen = touching(margins, frames)
    for at in chosen:
        image, margin = draw(film, at), float(margins[at])
        yield judge.say(image, margin)
        for faults, seen in ((FAULTS, True), (SUDDEN, False)):
            for fault, (make, strengths) in faults.items():
                for strength in strengths:
                    seed = int(rng.integers(2**32))
                    there, free = (make(one, strength, np.random.default_rng(seed)) for one in (image, untouched))
                    before = [Shot(image=free, time_s=-1.0)] if seen else []
                    yield judge.say(there, margin, fault=fault, strength=strength, before=before)
        for share in (0.1, 0.2, 0.4):
            hidden = draw(hide_markers(film, share, rng), at)
            yield judge.say(hidden, margin, fault="markers hidden", strength=share)
        for later in (1, 4):
            row = int(rng.uniform(0.25, 0.75) * len(image))
            upper = draw(film, max(0, at - later))
            torn, before = np.concatenate([upper[:row], image[row:]]), [Shot(image=upper, time_s=-0.03)]
            yield judge.say(torn, margin, fault="torn", strength=float(later), before=before)
        for degrees in (180.0, 270.0):
            turned = replace(film, grasp=replace(film.grasp, shear_direction_rad=np.radians(degrees)))
            grasp = replace(film.grasp, normal_force_n=float(loading.normal_force_n[at]))
            pulled = draw(turned.under(load_at_margins(np.array([margin]), grasp=grasp), rng=rng), 0)
            yield judge.say(pulled, margin, fault="pulled", strength=degrees)
    yield from judge_stopped(judge, loading, film, chosen=chosen, rng=rng)
    for at in np.flatnonzero(~np.isfinite(margins))[:2]:
        yield judge.say(draw(film, at), np.nan, fault="no contact")
    loading, film = prepare_trial(other)
    judge = Judge(run, film.draw_reference().numpy(), trial=trial)
    for at in touching(loading.safety_margin, frames):
        yield judge.say(draw(film, at), float(loading.safety_margin[at]), fault="another sensor")


def off_elsewhere(cases: list[Case], off: np.ndarray) -> np.ndarray:
    """How often each case's fault and strength put the margins of the other trials off."""
    names, trials = np.array([case.name for case in cases]), np.array([case.trial for case in cases])
    shares = np.zeros(len(cases))
    for name in set(names):
        for trial in set(trials):
            others = off[(names == name) & (trials != trial)]
            shares[(names == name) & (trials == trial)] = others.mean() if len(others) else off.mean()
    return shares


def count_withheld(cases: list[Case]) -> dict[str, object]:
    """Shares of frames that are off, withheld, and off without being withheld."""
    off, withheld = (np.array(values) for values in zip(*((c.error > OFF, bool(c.failed)) for c in cases), strict=True))
    return {
        "frames": len(cases),
        "off": float(off.mean()),
        "withheld": float(withheld.mean()),
        "shown_wrong_share": float((off & ~withheld).mean()),
        "by": sorted({name for case in cases for name in case.failed}),
    }


def summarise(cases: list[Case]) -> dict[str, object]:
    """Ranking and withheld frames, by fault."""
    off = np.array([case.error > OFF for case in cases])
    risk = np.array([margin_risk(case.checks, case.beyond) for case in cases])
    worst, known = np.array([case.worst for case in cases]), np.array([case.known for case in cases])
    told = off_elsewhere(cases, off)
    by_fault = defaultdict[str, list[Case]](list)
    for case in cases:
        by_fault[case.fault].append(case)
    kinds = np.array([case.fault for case in cases])
    healthy, faults = kinds == "none", sorted(set(kinds) - {"none"})
    return {
        "auroc": auroc(risk[off], risk[~off]),
        "auroc_worst": auroc(worst[off], worst[~off]),
        "auroc_true_fault": auroc(told[off], told[~off]),
        "seen_by_network": {name: auroc(-known[kinds == name], -known[healthy]) for name in faults}
        | {"all": auroc(-known[~healthy], -known[healthy])},
        "withheld_healthy": float(np.mean([bool(case.failed) for case in by_fault["none"]])),
        "errors_withheld": float(np.mean([bool(case.failed) for case, wrong in zip(cases, off, strict=True) if wrong])),
        "by_fault": {name: count_withheld(some) for name, some in by_fault.items()},
        "frames": len(cases),
    }  # fmt: skip


def choose(cases: list[Case]) -> dict[str, object]:
    """Quantiles of healthy values, and the numbers of `margin_risk` that make what happened most likely."""
    healthy = [{check.name: check.value for check in case.checks} for case in cases if case.fault == "none"]
    found: dict[str, object] = {
        name: np.quantile([values[name] for values in healthy if name in values], (0.5, 0.9, 0.99, 0.997, 1.0))
        .round(4)
        .tolist()
        for name in dict.fromkeys(name for values in healthy for name in values)
    }
    names = [name for name in found if name not in {"late", "drops"}]
    off = np.array([case.error > OFF for case in cases])

    def unpack(numbers: np.ndarray) -> tuple[dict[str, tuple[float, float]], tuple[float, float]]:
        most, growth = 1 / (1 + np.exp(-numbers[: len(names)])), np.exp(numbers[len(names) : -2])
        harm = {name: (float(a), float(b)) for name, a, b in zip(names, most, growth, strict=True)}
        return harm, (float(numbers[-2]), float(np.exp(numbers[-1])))

    def loss(numbers: np.ndarray) -> float:
        harm, spread = unpack(numbers)
        risk = np.array([margin_risk(case.checks, case.beyond, harm=harm, spread=spread) for case in cases])
        risk = np.clip(risk, 1e-4, 1 - 1e-4)
        # a little towards nothing known: some checks hardly ever failed
        return -float(np.mean(np.where(off, np.log(risk), np.log(1 - risk)))) + 1e-3 * float(np.mean(numbers**2))

    begin = np.concatenate([np.zeros(len(names)), np.full(len(names), -1.0), np.zeros(2)])
    harm, spread = unpack(minimize(loss, begin, method="L-BFGS-B").x)
    found["harm"] = {name: (round(a, 2), round(b, 2)) for name, (a, b) in harm.items()}
    found["spread"] = [round(value, 2) for value in spread]
    return found


def main() -> None:
    """Print what health told as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", default=DEFAULT_NETWORK, help="name or folder of a network")
    parser.add_argument("--trials", type=int, default=8, help="one a day")
    parser.add_argument("--frames", type=int, default=5, help="of each trial")
    parser.add_argument("--choose", action="store_true", help="print what limits and risk are chosen from")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(2)
    run = load(options.network)
    series = "health-choose" if options.choose else "health-test"
    pull_deg = run.manifest.pull_direction_deg
    plans = plan_some(series, options.trials, pull_deg=pull_deg)
    others = plan_some(series, options.trials, sensor="flat-gel", pull_deg=pull_deg)
    cases = [
        case
        for trial, (plan, other) in enumerate(zip(plans, others, strict=True))
        for case in judge_trial(run, plan, trial=trial, frames=options.frames, other=other)
    ]
    found = choose(cases) if options.choose else summarise(cases)
    print(json.dumps(found, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
