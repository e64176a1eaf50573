"""Delay, misses and false alarms of slip detection from markers, on simulated grips with a known onset.

Each trial is pressed, held and pulled until it slips; its frames are drawn at 60 a second, their markers tracked, and
given to `SlipDetector` as by a running sensor. The onset is the first frame without margin. A slip within half a second
of it is detected, later it is missed; one before it is a false alarm. Thresholds were chosen on seeds below 100. With
--positions the true marker positions with 0.1 px of noise replace drawing and tracking, in a hundredth of the time.
With --clips, real GelSight Mini clips of lifts, of which only slip or not is known.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gelsight import list_clips, read_clip
from sliplens.errors import SliplensError
from sliplens.live import SlipDetector, SlipState
from sliplens.markers import Tracker
from sliplens.simulation import make_recipe, plan_trials
from sliplens.simulation.plan import TrialPlan
from sliplens.simulation.trials import NOISE_PX, prepare_trial

FRAMES = 480
"""Of a trial of 8 s: 60 a second."""
LATEST_S = 0.5
FIRST_SEED = 200


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was told of one trial."""

    delay_s: float | None
    """From the onset to the first slip told; None where none was told within half a second."""
    false_alarms: int
    before_s: float
    """Time before the onset."""


def plan_grips(sensor: str, *, wet: bool, trials: int, seed: int) -> list[TrialPlan]:
    """Trials of as many days, of one condition."""
    recipe = make_recipe(
        "small", sensor=sensor, seed=seed, days=trials + 1, dry_trials=trials + 1, wet_trials=0, frames_per_trial=FRAMES
    )
    dry = plan_trials(recipe)[:trials]
    return [replace(plan, condition="wet", seed=plan.seed + 1) for plan in dry] if wet else list(dry)


def places(plan: TrialPlan, *, drawn: bool) -> tuple[np.ndarray, Iterator[np.ndarray], np.ndarray, np.ndarray]:
    """Markers at rest, their places frame by frame, times and margins."""
    loading, film = prepare_trial(plan)
    if drawn:
        tracker = Tracker(film.draw_reference().numpy())
        rest = tracker.rest.centre_px
        frames = (film.draw(slice(at, at + 1)).numpy()[0] for at in range(len(film)))
        moved = (tracker.update(frame).position_px[: len(rest)] for frame in frames)
        return rest, moved, loading.time_s, loading.safety_margin
    seen = np.all((film.marker_rest_px > 8) & (film.marker_rest_px < film.sensor.image_size_px - 9), axis=1)
    noise = np.random.default_rng(plan.seed).normal(0, NOISE_PX, (len(film), int(seen.sum()), 2))
    moved = iter(film.marker_px[:, seen] + noise)
    return film.marker_rest_px[seen], moved, loading.time_s, loading.safety_margin


def run_trial(plan: TrialPlan, *, drawn: bool) -> Outcome:
    """Follow one trial until half a second after its slip."""
    rest, positions, time_s, margin = places(plan, drawn=drawn)
    detector, onset = SlipDetector(rest), int(np.argmax(margin == 0))
    delay_s, alarms, slipped = None, 0, False
    for at, position in enumerate(positions):
        if time_s[at] > time_s[onset] + LATEST_S:
            break
        slips = detector.update(position, float(time_s[at])).state is SlipState.SLIP
        if at < onset:
            alarms += slips and not slipped
        elif slips and delay_s is None:
            delay_s = float(time_s[at] - time_s[onset])
        slipped = slips
    return Outcome(delay_s=delay_s, false_alarms=alarms, before_s=float(time_s[onset]))


def summarise(outcomes: list[Outcome]) -> dict[str, float | int | None]:
    """Delays, misses and false alarms of some trials."""
    delays = [1e3 * outcome.delay_s for outcome in outcomes if outcome.delay_s is not None]
    p50, p95 = np.quantile(delays, [0.5, 0.95]).tolist() if delays else (None, None)
    alarms, minutes = sum(one.false_alarms for one in outcomes), sum(one.before_s for one in outcomes) / 60
    return {
        "trials": len(outcomes),
        "delay_ms_p50": p50,
        "delay_ms_p95": p95,
        "missed": 1 - len(delays) / len(outcomes),
        "false_alarms": alarms,
        "false_alarms_per_min": alarms / minutes,
    }


def run_clips(folder: Path) -> dict[str, float | int]:
    """Share of the real clips in which a slip was told, of those that slip and of those that hold."""
    told: dict[bool, list[bool]] = {True: [], False: []}
    failed = 0
    for path, row in list_clips(folder).items():
        try:
            clip = read_clip(path, row)
            frames = list(clip.capture.read_frames())
            tracker = Tracker(frames[clip.reference], "gelsight-mini")
            detector = SlipDetector(tracker.rest.centre_px)
            rate_hz = clip.capture.frame_rate_hz
            states = [
                detector.update(tracker.update(frame).position_px, at / rate_hz).state
                for at, frame in enumerate(frames)
            ]
        except SliplensError:
            failed += 1
            continue
        told[clip.slipped].append(SlipState.SLIP in states)
    return {
        "slip_clips": len(told[True]), "detected_in_slip_clips": float(np.mean(told[True] or [np.nan])),
        "holding_clips": len(told[False]), "detected_in_holding_clips": float(np.mean(told[False] or [np.nan])),
        "failed": failed,
    }  # fmt: skip


def main() -> None:
    """Print delays, misses and false alarms as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=4, help="of each sensor, dry and wet")
    parser.add_argument("--positions", action="store_true", help="true places with noise; nothing is drawn")
    parser.add_argument("--clips", type=Path, help="folder of GelSight Mini clips with slip/ and noslip/")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    outcomes = {
        f"{sensor} {'wet' if wet else 'dry'}": [
            run_trial(plan, drawn=not options.positions)
            for plan in plan_grips(sensor, wet=wet, trials=options.trials, seed=FIRST_SEED)
        ]
        for sensor in ("flat-gel", "chromatouch")
        for wet in (False, True)
    }
    found: dict[str, object] = dict(summarise([one for some in outcomes.values() for one in some]))
    found |= {"drawn": not options.positions, "by_case": {name: summarise(some) for name, some in outcomes.items()}}
    if options.clips is not None:
        found["clips"] = run_clips(options.clips)
    print(json.dumps(found, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
