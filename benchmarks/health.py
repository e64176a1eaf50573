"""Whether health tells that a margin is off: eight faults at graded strength on simulated trials, and healthy frames.

Each frame in contact of unseen days and sensors is read as it is, and with each fault in each strength; faults of
camera and light are there since before the touch. A margin is off
where it errs by more than 0.2; without contact there is none, so any answer counts as off. `auroc` ranks all these
frames by how far their worst check is from its limit; `withheld_healthy` is the share of the frames without a fault
whose margin is withheld. With --choose the quantiles of healthy values on validation trials are printed, from which
the limits were chosen; with --fit a folder's network gets its novelty from such trials. Choice, fit and test share no
day and no sensor.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sliplens.codec import load_record, save_record
from sliplens.live import HealthMonitor, LiveFrame
from sliplens.live.health import severity
from sliplens.markers import Tracker
from sliplens.models import Run, load
from sliplens.models.checkpoint import MANIFEST_FILE, Manifest
from sliplens.models.novelty import fit_novelty
from sliplens.simulation import TrialPlan, make_recipe, plan_trials
from sliplens.simulation.filming import Film
from sliplens.simulation.trials import prepare_trial

OFF = 0.2
Fault = Callable[[np.ndarray, float, np.random.Generator], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One frame, and what was said of it."""

    fault: str
    strength: float
    error: float
    """Of the margin, infinite without contact."""
    severity: float
    failed: tuple[str, ...]
    """Checks that were not fine."""


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


FAULTS: dict[str, tuple[Fault, tuple[float, ...]]] = {
    "defocus": (defocus, (0.7, 1.5, 3.0)),
    "camera moved": (move_camera, (1.0, 3.0, 6.0)),
    "exposure": (lambda image, factor, _: image * factor, (0.5, 0.8, 1.25, 1.7)),
    "lamp out": (lose_lamp, (0.2, 0.4, 0.7)),
}


def plan_some(series: str, trials: int, *, sensor: str | None = None) -> list[TrialPlan]:
    """One trial of each of as many days, each with a sensor of its own; series share no day and no sensor."""
    recipe = replace(
        make_recipe("varied", sensor=sensor, days=trials + 2, dry_trials=trials + 2, wet_trials=0, test_days=1),
        series=series,
        sensors=trials + 2,
    )
    return list(plan_trials(recipe))[:trials]


def touching(margins: np.ndarray, count: int) -> np.ndarray:
    """Some frames in contact, evenly spread."""
    frames = np.flatnonzero(np.isfinite(margins))
    return frames[np.linspace(0, len(frames) - 1, count).round().astype(int)]


def draw(film: Film, frame: int) -> np.ndarray:
    """One frame."""
    return film.draw(slice(frame, frame + 1)).numpy()[0]


def hide_markers(film: Film, share: float, rng: np.random.Generator) -> Film:
    """Film in which some markers have lost their dye."""
    contrast = film.unit.contrast_factor.copy()
    contrast[rng.random(len(contrast)) < share] = 0.0
    return replace(film, unit=replace(film.unit, contrast_factor=contrast))


class Judge:
    """Reads frames of one trial, and asks for their health."""

    def __init__(self, run: Run, reference: np.ndarray) -> None:
        self._run, self._reference = run, reference

    def say(
        self,
        image: np.ndarray,
        margin: float,
        *,
        fault: str = "none",
        strength: float = 0.0,
        held_s: float = 0.0,
        before: np.ndarray | None = None,
    ) -> tuple[Case, dict[str, float]]:
        """Read one frame; `held_s`: time for which it has been the same; `before`: the untouched sensor as it was seen
        last.
        """
        pixels = np.clip(np.round(image), 0, 255).astype(np.uint8)
        monitor, tracker = HealthMonitor(self._reference, self._run), Tracker(self._reference)
        checks = ()
        if before is not None:
            first = np.clip(np.round(before), 0, 255).astype(np.uint8)
            monitor.check(LiveFrame(image=first, number=0, time_s=-1.0, captured_s=0.0))
        for time_s in (0.0, held_s) if held_s else (0.0,):
            checks = monitor.check(
                LiveFrame(image=pixels, number=0, time_s=time_s, captured_s=0.0), tracker.update(pixels)
            )
        said = float(np.clip(self._run.predict(self._run.encode(pixels[None], self._reference))[0], 0, 1))
        error = abs(said - margin) if np.isfinite(margin) else np.inf
        failed = tuple(check.name for check in checks if not check.ok)
        case = Case(fault=fault, strength=strength, error=error, severity=severity(checks), failed=failed)
        return case, {check.name: check.value for check in checks}


def judge_trial(run: Run, plan: TrialPlan, *, frames: int, other: TrialPlan, healthy: bool) -> Iterator[tuple]:
    """All cases of one trial; those without a fault alone if `healthy`."""
    rng = np.random.default_rng(plan.seed)
    loading, film = prepare_trial(plan)
    judge, margins = Judge(run, film.draw_reference().numpy()), loading.safety_margin
    # the reference's own noise would be shared
    untouched = draw(film, 0)
    chosen = touching(margins, frames)
    for at in chosen:
        image, margin = draw(film, at), float(margins[at])
        yield judge.say(image, margin)
        if healthy:
            continue
        for fault, (make, strengths) in FAULTS.items():
            for strength in strengths:
                seed = int(rng.integers(2**32))
                there, free = (make(one, strength, np.random.default_rng(seed)) for one in (image, untouched))
                yield judge.say(there, margin, fault=fault, strength=strength, before=free)
        for share in (0.1, 0.2, 0.4):
            hidden = draw(hide_markers(film, share, rng), at)
            yield judge.say(hidden, margin, fault="markers hidden", strength=share)
    if healthy:
        return
    for later in (1, 2):  # the picture stays that of an earlier frame, for longer and longer
        for old, now in zip(chosen[:-later], chosen[later:], strict=True):
            held_s = float(loading.time_s[now] - loading.time_s[old])
            yield judge.say(draw(film, old), float(margins[now]), fault="stale", strength=float(later), held_s=held_s)
    for at in np.flatnonzero(~np.isfinite(margins))[:2]:
        yield judge.say(draw(film, at), np.nan, fault="no contact")
    loading, film = prepare_trial(other)
    judge = Judge(run, film.draw_reference().numpy())
    for at in touching(loading.safety_margin, frames):
        yield judge.say(draw(film, at), float(loading.safety_margin[at]), fault="another sensor")


def auroc(scores: np.ndarray, positive: np.ndarray) -> float:
    """Chance that what is off ranks above what is not, ties counted half."""
    above = scores[positive][:, None] - scores[~positive][None]
    return float(np.mean((above > 0) + 0.5 * (above == 0)))


def summarise(cases: list[Case]) -> dict[str, object]:
    """Ranking, withheld frames, by fault and strength, and the error of what is told as more is withheld."""
    scores, off = np.array([case.severity for case in cases]), np.array([case.error > OFF for case in cases])
    by_fault: dict[str, list[Case]] = defaultdict(list)
    for case in cases:
        by_fault[f"{case.fault} {case.strength:g}".removesuffix(" 0")].append(case)
    touched = np.array([np.isfinite(case.error) for case in cases])
    errors, order = np.array([case.error for case in cases]), np.argsort(scores)
    order = order[touched[order]]
    shares = (0.0, 0.2, 0.4, 0.6, 0.8)
    healthy = by_fault["none"]
    return {
        "auroc": auroc(scores, off),
        "withheld_healthy": float(np.mean([bool(case.failed) for case in healthy])),
        "healthy_off": float(np.mean([case.error > OFF for case in healthy])),
        "off_told": float(np.mean([bool(case.failed) for case, wrong in zip(cases, off, strict=True) if wrong])),
        "mean_error_by_share_withheld": {
            f"{share:g}": float(errors[order[: round(len(order) * (1 - share))]].mean()) for share in shares
        },
        "by_fault": {
            name: {
                "frames": len(some),
                "off": float(np.mean([case.error > OFF for case in some])),
                "withheld": float(np.mean([bool(case.failed) for case in some])),
                "by": sorted({name for case in some for name in case.failed}),
            }
            for name, some in by_fault.items()
        },
        "frames": len(cases),
    }


def fit(folder: Path, *, trials: int) -> None:
    """Fit the novelty of a network on simulated trials of half the days, its limit on those of the others."""
    run = load(folder)
    inputs = []
    for plan in plan_some("health-fit", trials):
        loading, film = prepare_trial(plan)
        images = np.stack([draw(film, at) for at in touching(loading.safety_margin, 8)])
        inputs.append(run.encode(images, film.draw_reference().numpy()))
    half = len(inputs) // 2
    manifest = load_record(folder / MANIFEST_FILE, Manifest, command="sliplens train")
    save_record(replace(manifest, novelty=fit_novelty(run.model, inputs[:half], inputs[half:])), folder / MANIFEST_FILE)


def main() -> None:
    """Print what health told, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", default="chromatouch-difference", help="name or folder of a network")
    parser.add_argument("--trials", type=int, default=8, help="one a day")
    parser.add_argument("--frames", type=int, default=5, help="of each trial")
    parser.add_argument("--choose", action="store_true", help="print quantiles of healthy values, on other trials")
    parser.add_argument("--fit", type=Path, help="folder of a network that gets its novelty")
    parser.add_argument("--threads", type=int, default=2, help="of torch")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.fit is not None:
        fit(options.fit, trials=options.trials)
        return
    run = load(options.network)
    series = "health-choose" if options.choose else "health-test"
    plans = plan_some(series, options.trials)
    others = plan_some(series, options.trials, sensor="flat-gel")
    said = [
        one
        for plan, other in zip(plans, others, strict=True)
        for one in judge_trial(run, plan, frames=options.frames, other=other, healthy=options.choose)
    ]
    if options.choose:
        names = said[0][1]
        shown = (0.5, 0.9, 0.99, 0.997, 1.0)
        found: dict[str, object] = {
            name: np.quantile([values[name] for _, values in said], shown).round(4).tolist() for name in names
        }
    else:
        found = summarise([case for case, _ in said])
    if options.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        print(f"{name:30} {value}")


if __name__ == "__main__":
    main()
