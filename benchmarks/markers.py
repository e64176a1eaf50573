"""Markers on simulated trials: how well they are found and followed, and how fast, against two known tools.

Centres and tracks are compared with the simulator's own; the speed is that of frames of 640 x 480 pixels with 100
markers, of which every tool is given the same. scikit-image's blobs are linked by trackpy, Lucas-Kanade is OpenCV's
pyramidal one from frame to frame. Both are left out where they are not installed; the extra `dev` has them.

A track is right if it is followed in the last frame and, whenever it says it was followed, lies within a pixel of its
own marker; markers that leave the frame in between are not counted. Damage begins in mid-trial: of every ten markers
one is painted over or smeared, and the tracks of the others are counted.

Recovery is measured on drawn clips of a GelSight Mini's 7 x 9 dots that are lost for a while: a heavy object pushed in
from the border, a knock, two seconds of darkness. A marker that shows again counts as recovered if within 5 frames it
is followed under its old name, within a pixel; `visible_followed` are marker frames, `worst_clip_alive` is the least
share of the visible markers that a clip ends with.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np

from sliplens.extras import import_cv2
from sliplens.markers import MarkerStatus, Tracker, Tracks, detect_markers, track_markers
from sliplens.recordings import Recording
from sliplens.simulation import SENSORS, SimulationRecipe, plan_trials, simulate_trial

KINDS = {"chromatouch": "chromatouch", "flat-gel": "gelsight-mini"}
RIGHT_PX = 1.0
_EDGE_PX = 10.0  # a marker's disc, and what blurs it


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What one trial gave."""

    squared_px: np.ndarray
    """Squared errors of centres, by coordinate."""
    right: np.ndarray
    """By track of a marker that stays in view."""
    wrong_frames: int
    """Marker frames that were said to be followed and were not."""


def judge(tracks: Tracks, recording: Recording, counted: np.ndarray | None = None) -> Quality:
    """Compare tracks with the truth; `counted` are true markers that count, all if None."""
    truth = recording.truth
    assert truth is not None  # the trial was simulated
    kept = tracks.from_reference
    own = np.linalg.norm(tracks.rest_px[kept][:, None] - truth.marker_rest_px[None], axis=-1).argmin(axis=1)
    places, found, followed = truth.marker_px[:, own], tracks.position_px[:, kept], tracks.followed[:, kept]
    error = np.linalg.norm(found - places, axis=-1)
    size = recording.reference.shape[:2]
    far = np.array([size[1] - 1, size[0] - 1]) - _EDGE_PX
    inside = np.all((places > _EDGE_PX) & (places < far), axis=(0, 2))
    if counted is not None:
        inside &= counted[own]
    astray = followed & (error > RIGHT_PX)
    right = ~astray.any(axis=0) & followed[-1]
    chosen = followed & inside
    return Quality(
        squared_px=((found - places) ** 2)[chosen].ravel(),
        right=right[inside],
        wrong_frames=int(astray[:, inside].sum()),
    )


def damage(recording: Recording, *, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Frames of which, from the middle on, a tenth of the markers is painted over or smeared; and which are whole."""
    cv2 = import_cv2()
    truth = recording.truth
    assert truth is not None  # the trial was simulated
    frames, count = recording.frames.copy(), len(truth.marker_rest_px)
    hurt = rng.permutation(count)[: max(1, count // 10)]
    for number in range(len(frames) // 2, len(frames)):
        frame = frames[number]
        for index, marker in enumerate(hurt):
            x, y = truth.marker_px[number, marker]
            rows, columns = (slice(max(0, int(at) - 11), max(0, int(at) + 12)) for at in (y, x))
            patch = frame[rows, columns]
            if patch.size == 0:
                continue
            if index % 2:
                # drawn out sideways, as a wet dot under a thumb
                frame[rows, columns] = cv2.blur(patch, (17, 3))
            else:
                edge = np.concatenate([patch[0], patch[-1], patch[:, 0], patch[:, -1]])
                frame[rows, columns] = np.median(edge, axis=0).astype(np.uint8)
    return frames, ~np.isin(np.arange(count), hurt)


def measure_quality(*, trials: int, frames: int, seed: int) -> dict[str, float]:
    """Errors and right tracks over trials of both sensors, whole and damaged."""
    told: dict[str, float] = {}
    pooled: dict[str, list[Quality]] = {"whole": [], "damaged": []}
    for name, kind in KINDS.items():
        recipe = SimulationRecipe(
            dry_trials=max(3, trials),
            wet_trials=1,
            frames_per_trial=frames,
            release=True,
            sensor=SENSORS[name],
            seed=seed,
        )
        own: dict[str, list[Quality]] = {"whole": [], "damaged": []}
        for plan in plan_trials(recipe)[:trials]:
            recording = simulate_trial(plan)
            own["whole"].append(judge(track_markers(recording.frames, recording.reference, kind), recording))
            hurt, whole = damage(recording, rng=np.random.default_rng(plan.seed))
            own["damaged"].append(judge(track_markers(hurt, recording.reference, kind), recording, whole))
        told |= {f"{name}_{key}": value for key, value in _sum_up(own).items()}
        for state, some in own.items():
            pooled[state] += some
    return {**_sum_up(pooled), **told}


def _sum_up(found: dict[str, list[Quality]]) -> dict[str, float]:
    squared = np.concatenate([one.squared_px for one in found["whole"]])
    whole, hurt = (np.concatenate([one.right for one in found[state]]) for state in ("whole", "damaged"))
    return {
        "centre_rms_px": float(np.sqrt(squared.mean())),
        "centre_rms_2d_px": float(np.sqrt(2 * squared.mean())),
        "tracks": len(whole),
        "tracks_right": float(whole.mean()),
        "tracks_damaged": len(hurt),
        "tracks_right_damaged": float(hurt.mean()),
        "wrong_marker_frames": sum(one.wrong_frames for some in found.values() for one in some),
    }


_PITCH_PX, _GEL = 34.0, (240, 320)
_SOON = 5  # frames


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """One frame to be drawn."""

    places_px: np.ndarray
    shown: np.ndarray
    light: float = 1.0
    object_px: tuple[float, float, float] | None = None
    """Centre and radius of what hides the gel."""


def press_from_border(rest: np.ndarray, *, reach_px: float, radius_px: float, frames: int) -> Iterator[Drawn]:
    """Push an object in from the left within some frames, hold it, draw it back: it hides dots and moves the others."""
    way = np.linspace(0, 1, frames)
    for depth in np.concatenate([np.zeros(3), way, np.ones(10), way[::-1], np.zeros(8)]):
        x, y = reach_px * depth - radius_px, 110.0
        apart = rest - (x, y)
        distance = np.linalg.norm(apart, axis=1, keepdims=True)
        push = 0.5 * _PITCH_PX * depth * np.exp(-np.maximum(distance - radius_px, 0) / 60)
        places = rest + apart / distance * push
        shown = np.linalg.norm(places - (x, y), axis=1) > radius_px + 4
        yield Drawn(places_px=places, shown=shown, object_px=(x, y, radius_px))


def knock(rest: np.ndarray, *, pitches: float) -> Iterator[Drawn]:
    """Throw the whole pattern aside; it swings back, and is too blurred to be seen while it is fast."""
    before = 0.0
    for share in (0, 0, 0, 0.5, 1, 0.7, 0.2, -0.3, -0.5, -0.3, 0, 0.2, 0.1, 0.05, *[0] * 8):
        shown = np.full(len(rest), abs(share - before) * pitches < 0.35)
        before = share
        yield Drawn(places_px=rest + pitches * share * _PITCH_PX * np.array([1.0, 0.3]), shown=shown)


def darken(rest: np.ndarray, *, pitches: float) -> Iterator[Drawn]:
    """Put the lamps out for two seconds; meanwhile the skin is pressed apart in its middle, and drawn aside."""
    apart = rest - (160, 120)
    distance = np.linalg.norm(apart, axis=1, keepdims=True)
    dented = apart / np.maximum(distance, 1) * 0.35 * np.exp(-(((distance - 50) / 35) ** 2))
    moved = rest + _PITCH_PX * (dented + np.array([pitches, -0.4 * pitches]))
    for number in range(75):
        dark = 3 <= number < 63
        places = rest if number < 3 else moved
        yield Drawn(places_px=places, shown=np.full(len(rest), not dark), light=0.02 if dark else 1.0)


CLIPS = {
    "border_half": partial(press_from_border, reach_px=170, radius_px=200, frames=4),
    "border_two_thirds": partial(press_from_border, reach_px=215, radius_px=250, frames=12),
    "border_deep": partial(press_from_border, reach_px=130, radius_px=200, frames=3),
    "knock": partial(knock, pitches=1.4),
    "hard_knock": partial(knock, pitches=2.2),
    "darkness": partial(darken, pitches=0.0),
    "darkness_drawn": partial(darken, pitches=0.3),
}


def draw_gel(drawn: Drawn, *, rng: np.random.Generator) -> np.ndarray:
    """Dark dots on a lit gel."""
    rows, columns = np.mgrid[: _GEL[0], : _GEL[1]]
    share = np.zeros(_GEL)
    for x, y in drawn.places_px[drawn.shown]:
        near = np.s_[max(0, int(y) - 12) : max(0, int(y) + 13), max(0, int(x) - 12) : max(0, int(x) + 13)]
        if share[near].size:
            distance = np.clip((np.hypot(columns[near] - x, rows[near] - y) - 5) / 0.8, -40, 40)
            share[near] = np.maximum(share[near], 1 / (1 + np.exp(distance)))
    image = np.array([180.0, 170, 160]) - share[..., None] * np.array([140.0, 135, 130])
    if drawn.object_px is not None:
        x, y, radius = drawn.object_px
        inside = np.hypot(columns - x, rows - y) < radius
        image[inside] = np.array([70.0, 75, 80]) + 30 * np.sin(columns[inside] / 5)[:, None]
    noisy = drawn.light * image + rng.normal(0, 2, image.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def measure_recovery(*, jitter_px: float, seed: int) -> dict[str, float]:
    """Follow the dots of drawn clips that are lost for a while; `jitter_px` are the irregularities of the print."""
    back, seen, ends, wrong = [], [], {}, 0
    for name, clip in CLIPS.items():
        rng = np.random.default_rng(seed)
        across, down = np.meshgrid(np.arange(-2, 12) * _PITCH_PX + 4, np.arange(-2, 10) * _PITCH_PX + 8)
        rest = np.stack([across.ravel(), down.ravel()], axis=-1)
        rest = rest + rng.normal(0, jitter_px, rest.shape)
        drawn = list(clip(rest))
        reference = draw_gel(Drawn(places_px=rest, shown=np.ones(len(rest), dtype=bool)), rng=rng)
        tracks = track_markers([draw_gel(one, rng=rng) for one in drawn], reference, "gelsight-mini")
        kept = tracks.from_reference
        own = np.linalg.norm(tracks.rest_px[kept][:, None] - rest[None], axis=-1).argmin(axis=1)
        places = np.stack([one.places_px[own] for one in drawn])
        inside = np.all((places > _EDGE_PX) & (places < np.array(_GEL[::-1]) - 1 - _EDGE_PX), axis=-1)
        visible = np.stack([one.shown[own] for one in drawn]) & inside
        right = tracks.followed[:, kept] & (np.linalg.norm(tracks.position_px[:, kept] - places, axis=-1) < RIGHT_PX)
        wrong += int((tracks.followed[:, kept] & ~right & visible).sum())
        shows = visible[1:] & ~visible[:-1]
        back += [
            right[at + 1 : at + 1 + _SOON, marker].any()
            for at, marker in np.argwhere(shows)
            if visible[at + 1 : at + 1 + _SOON, marker].all() and at + _SOON < len(drawn)
        ]
        seen.append(right[visible].mean())
        ends[name] = float(right[-1][visible[-1]].mean())
    return {
        "recovered": float(np.mean(back)),
        "shown_again": len(back),
        "visible_followed": float(np.mean(seen)),
        "worst_clip_visible_followed": float(min(seen)),
        "worst_clip_alive": min(ends.values()),
        "recovery_wrong_marker_frames": wrong,
    }


def draw_sequence(*, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Frames of 640 x 480 pixels with 100 markers that are pressed apart and drawn down."""
    across, down = np.meshgrid(np.arange(10) * 60.0 + 50, np.arange(10) * 44.0 + 42)
    places = np.stack([across.ravel(), down.ravel()], axis=-1) + rng.normal(0, 0.5, (100, 2))
    rows, columns = np.mgrid[:480, :640]
    found = []
    for number in range(frames):
        share = number / max(1, frames - 1)
        moved = places + share * (0.02 * (places - (320, 240)) + np.array([1.0, 6.0]))
        image = np.full((480, 640), 180.0)
        for x, y in moved:
            near = np.s_[max(0, int(y) - 14) : int(y) + 15, max(0, int(x) - 14) : int(x) + 15]
            distance = np.hypot(columns[near] - x, rows[near] - y)
            image[near] -= 140 / (1 + np.exp((distance - 7) / 0.8))
        colour = image[..., None] + rng.normal(0, 2.3, (480, 640, 3))
        found.append(np.clip(np.round(colour), 0, 255).astype(np.uint8))
    return np.stack(found)


def track_ours(frames: np.ndarray) -> int:
    """Find and follow with sliplens; gives how many markers were followed at the end."""
    tracker = Tracker(frames[0], "gelsight-mini")
    status = [tracker.update(frame).status for frame in frames]
    return int((status[-1] == MarkerStatus.FOLLOWED).sum())


def track_blobs(frames: np.ndarray) -> int:
    """Find scikit-image's differences of Gaussians and link them with trackpy."""
    import pandas as pd  # noqa: PLC0415 (trackpy's tables)  # pyright: ignore[reportMissingImports]
    import trackpy  # noqa: PLC0415 (only compared with)  # pyright: ignore[reportMissingImports]
    from skimage.feature import blob_dog  # noqa: PLC0415 (only compared with)  # pyright: ignore[reportMissingImports]

    trackpy.quiet()
    rows = []
    for number, frame in enumerate(frames):
        dark = 1 - frame.mean(axis=-1) / 255
        blobs = blob_dog(dark, min_sigma=4, max_sigma=7, threshold=0.1)
        rows += [{"frame": number, "y": y, "x": x} for y, x, _ in blobs]
    linked = trackpy.link(pd.DataFrame(rows), search_range=15)
    lengths = np.unique(linked["particle"].to_numpy(), return_counts=True)[1]
    return int((lengths == len(frames)).sum())


def track_flow(frames: np.ndarray) -> int:
    """Follow the first frame's centres with OpenCV's pyramidal Lucas-Kanade, forwards and backwards."""
    cv2 = import_cv2()
    start = detect_markers(frames[0], "gelsight-mini").centre_px.astype(np.float32)[:, None]
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    points, good = start, np.ones(len(start), dtype=bool)
    for before, after in pairwise(grey):
        moved, there, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, winSize=(21, 21), maxLevel=3)
        back, _, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, None, winSize=(21, 21), maxLevel=3)
        good &= (there.ravel() == 1) & (np.abs(back - points).max(axis=(1, 2)) < 1)
        points = moved
    return int(good.sum())


def measure_speed(frames: np.ndarray, *, repeats: int) -> dict[str, float | None]:
    """Frames a second of each tool, by the clock and by processor time, the best of some runs taken in turn."""
    tools: dict[str, Callable[[np.ndarray], int]] = {"": track_ours, "_lk": track_flow, "_trackpy": track_blobs}
    wall: dict[str, float] = {}
    busy: dict[str, float] = {}
    told: dict[str, float | None] = {}
    for _ in range(repeats):
        for name, tool in tools.items():
            # blobs take so long that a few frames tell
            some = frames[:6] if name == "_trackpy" else frames
            begun, spent = time.perf_counter(), time.process_time()
            try:
                told[f"followed{name}"] = tool(some)
            except ImportError:
                told[f"followed{name}"] = None
                continue
            wall[name] = max(wall.get(name, 0), len(some) / (time.perf_counter() - begun))
            busy[name] = max(busy.get(name, 0), len(some) / (time.process_time() - spent))
    told |= {f"frames_per_s{name}": wall.get(name) for name in tools}
    return told | {f"frames_per_processor_s{name}": busy.get(name) for name in tools}


def main() -> None:
    """Print errors, right tracks and speeds, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=4, help="of each sensor")
    parser.add_argument("--frames", type=int, default=60, help="of each trial")
    parser.add_argument("--speed-frames", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2, help="of OpenCV")
    parser.add_argument("--jitter", type=float, default=0.6, help="of the dots of the clips that are lost, px")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    import_cv2().setNumThreads(options.threads)
    sequence = draw_sequence(frames=options.speed_frames, rng=np.random.default_rng(options.seed))
    found = {
        **measure_speed(sequence, repeats=options.repeats),
        **measure_quality(trials=options.trials, frames=options.frames, seed=options.seed),
        **measure_recovery(jitter_px=options.jitter, seed=options.seed),
    }
    if options.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        print(f"{name:32} {'not installed' if value is None else f'{value:.4g}'}")


if __name__ == "__main__":
    main()
