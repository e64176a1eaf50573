"""Real GelSight Mini clips of grasps that slip or hold: whether their dots are followed, and their motion tells a slip.

Every clip is followed from the frame with least contact. A classifier of the whole clip (a label a grasp is all there
is) sees motion alone: from each clip the same number of windows of the same number of frames, spread evenly, each
reduced to numbers of how its dots move against the window's first frame, in pitches. Clip length, frame count,
brightness and the number of dots are not among them; what they alone would tell stands beside it, for they do tell.

Objects are left out one at a time; intervals are of 95 %, from drawing objects again. Balanced accuracy and F1 (of
slip) are of clips; `grasps` joins both fingers. Whatever lies in folders laid out alike, with a table of the same
columns, can be measured with --clips and --labels.
"""

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from rich.progress import track as progress

from sliplens.errors import SliplensError
from sliplens.markers import MarkerStatus, track_markers
from sliplens.markers.estimators import affine_parts
from sliplens.recordings.readers.gelsight import list_gelsight_clips, read_gelsight_clip

WINDOWS, FRAMES = 8, 24
_STILL_RUN = 10
_CONTACT_PX = 1.0
_RIDGE = 1.0
_DRAWS = 2000


@dataclass(frozen=True, kw_only=True)
class Clip:
    """What was followed in one clip."""

    name: str
    grasp: str
    grasped: str
    slipped: bool
    rest_px: np.ndarray
    """(markers, 2)"""
    position_px: np.ndarray
    """(frames, markers, 2), NaN where a marker was not followed."""
    status: np.ndarray
    """(frames, markers)"""

    @property
    def pitch_px(self) -> float:
        """Median distance of the nearest marker."""
        distance = np.linalg.norm(self.rest_px[:, None] - self.rest_px[None], axis=-1)
        np.fill_diagonal(distance, np.inf)
        return float(np.median(distance.min(axis=1)))


def follow(path: Path, labels: Path | None) -> Clip:
    """Follow the dots of a clip from its frame with least contact."""
    clip = read_gelsight_clip(path, labels=labels)
    frames = list(clip.capture.read_frames())
    tracks = track_markers(frames, frames[clip.reference_index], "gelsight-mini")
    known = tracks.from_reference
    return Clip(
        name="/".join(path.parts[-3:]),
        grasp="/".join(path.parts[-3:-1]),
        grasped=clip.grasped,
        slipped=clip.slipped,
        rest_px=tracks.rest_px[known],
        position_px=np.where(tracks.followed[:, known, None], tracks.position_px[:, known], np.nan),
        status=tracks.status[:, known],
    )


def follow_all(folder: Path, labels: Path | None, keep: Path | None) -> tuple[list[Clip], list[str]]:
    """Follow every clip, or read what was followed before from `keep`; gives the clips, and what failed."""
    clips, failed = [], []
    with tempfile.TemporaryDirectory() as scratch:
        if labels is not None:
            # the list of clips is read from beside them
            shutil.copy(labels, Path(scratch) / "labels.csv")
            for part in ("slip", "noslip"):
                (Path(scratch) / part).symlink_to((folder / part).absolute())
        paths = list_gelsight_clips(folder if labels is None else Path(scratch))
        for path in progress(paths, description="Following dots"):
            saved = None if keep is None else keep / ("__".join(path.parts[-3:]) + ".npz")
            if saved is not None and saved.is_file():
                clips.append(read_kept(saved))
                continue
            try:
                clip = follow(path, labels)
            except SliplensError as error:
                failed.append(f"{path.parent.name}/{path.name}: {error}")
                continue
            clips.append(clip)
            if saved is not None:
                saved.parent.mkdir(parents=True, exist_ok=True)
                np.savez_compressed(saved, **{name: getattr(clip, name) for name in Clip.__dataclass_fields__})
    return clips, failed


def read_kept(path: Path) -> Clip:
    """Read what was followed before."""
    with np.load(path) as data:
        return Clip(
            name=str(data["name"]),
            grasp=str(data["grasp"]),
            grasped=str(data["grasped"]),
            slipped=bool(data["slipped"]),
            rest_px=data["rest_px"],
            position_px=data["position_px"],
            status=data["status"],
        )


def alive_at_end(clip: Clip) -> tuple[float, float]:
    """Share of dots followed in the last frame of contact: of those then in view, and of all."""
    moved = np.linalg.norm(clip.position_px - clip.rest_px, axis=-1)
    far = np.array([np.quantile(row[np.isfinite(row)], 0.9) if np.isfinite(row).any() else np.inf for row in moved])
    touched = np.flatnonzero(far > _CONTACT_PX)
    last = int(touched[-1]) if len(touched) else len(far) - 1
    followed, seen = clip.status[last] == MarkerStatus.FOLLOWED, clip.status[last] != MarkerStatus.OUTSIDE
    return float(followed.sum() / max(1, seen.sum())), float(followed.mean())


def rest_jitter(clip: Clip) -> float:
    """Root mean square, over coordinates, of how dots leave their mean place over the stillest ten frames, in pixels.

    Every other dot chooses the frames and the rest are measured: chosen by themselves, they would flatter themselves.
    Lossy video repeats what stands still, so that this tells the camera's noise too small: it is a lower bound.
    """
    runs = len(clip.position_px) - _STILL_RUN + 1
    chooser, measured = clip.position_px[:, ::2], clip.position_px[:, 1::2]
    spread = [_spread(chooser[at : at + _STILL_RUN]) for at in range(max(runs, 1))]
    at = int(np.nanargmin(spread))
    return _spread(measured[at : at + _STILL_RUN])


def _spread(places: np.ndarray) -> float:
    whole = np.all(np.isfinite(places), axis=(0, 2))
    if not whole.any():
        return np.nan
    kept = places[:, whole]
    return float(np.sqrt(np.mean((kept - kept.mean(axis=0)) ** 2) * len(kept) / max(1, len(kept) - 1)))


def motion_features(clip: Clip) -> np.ndarray:
    """Mean, largest and spread over equally many windows of the numbers of `window_features`."""
    starts = np.linspace(0, max(0, len(clip.position_px) - FRAMES), WINDOWS).round().astype(int)
    found = np.array([window_features(clip, clip.position_px[at : at + FRAMES]) for at in starts])
    return np.concatenate([found.mean(axis=0), found.max(axis=0), found.std(axis=0)])


def window_features(clip: Clip, places: np.ndarray) -> np.ndarray:
    """How the dots of a window move, in pitches: speed, way, slip against their mean, and the shape of the field."""
    pitch = clip.pitch_px
    places = places / pitch
    step = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    moved = places - places[0]
    length = np.linalg.norm(moved, axis=-1)
    mean = _known_mean(moved)
    net = np.linalg.norm(mean[-1] - mean[0])
    way = np.linalg.norm(np.diff(mean, axis=0), axis=-1).sum()
    parts = affine_parts(clip.rest_px / pitch, moved)
    residual = length - np.linalg.norm(mean, axis=-1)[:, None]
    strongest = _quantiles(length, 0.9)
    from_rest = _quantiles(np.linalg.norm(places - clip.rest_px / pitch, axis=-1), 0.9)
    fast = _quantiles(step, 0.9)
    values = [
        np.nanmean(fast),
        np.nanmax(fast),
        np.nanmean(_quantiles(step, 0.5)),
        np.nanmax(strongest),
        strongest[-1],
        net,
        way,
        net / (way + 0.02),
        np.nanmax(np.abs(_quantiles(residual, 0.9))),
        np.nanmean(from_rest),
        from_rest[-1] - from_rest[0],
        np.nanmax(from_rest) - np.nanmin(from_rest),
        *np.nanmax(np.abs(parts[:, 2:]), axis=0),
        *np.nanstd(parts[:, 2:], axis=0),
    ]
    return np.log1p(np.abs(np.nan_to_num(values))) * np.sign(np.nan_to_num(values))


def _known_mean(values: np.ndarray) -> np.ndarray:
    known = np.all(np.isfinite(values), axis=-1)
    return np.where(known[..., None], values, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]


def _quantiles(rows: np.ndarray, share: float) -> np.ndarray:
    return np.array([np.quantile(row[np.isfinite(row)], share) if np.isfinite(row).any() else 0.0 for row in rows])


def fit_logistic(values: np.ndarray, labels: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Ridge logistic regression, both classes weighing alike; gives the probability of a slip."""
    middle, scale = values.mean(axis=0), values.std(axis=0) + 1e-9
    terms = np.concatenate([np.ones((len(values), 1)), (values - middle) / scale], axis=1)
    weight = np.where(labels, 0.5 / max(labels.mean(), 1e-9), 0.5 / max(1 - labels.mean(), 1e-9))
    ridge = np.eye(terms.shape[1]) * _RIDGE
    ridge[0, 0] = 1e-6
    at = np.zeros(terms.shape[1])
    for _ in range(50):
        chance = 1 / (1 + np.exp(-np.clip(terms @ at, -30, 30)))
        slope = terms.T @ (weight * (chance - labels)) + ridge @ at
        bend = (terms * (weight * chance * (1 - chance) + 1e-9)[:, None]).T @ terms + ridge
        move = np.linalg.solve(bend, slope)
        at -= move
        if np.abs(move).max() < 1e-8:
            break

    def answer(others: np.ndarray) -> np.ndarray:
        unit = np.clip((others - middle) / scale, -6, 6)
        return 1 / (1 + np.exp(-np.clip(at[0] + unit @ at[1:], -30, 30)))

    return answer


def leave_one_out(values: np.ndarray, labels: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Probability of a slip of each clip, from all clips of other objects."""
    chance = np.full(len(labels), np.nan)
    for group in np.unique(groups):
        here = groups == group
        chance[here] = fit_logistic(values[~here], labels[~here])(values[here])
    return chance


def score(chance: np.ndarray, labels: np.ndarray, groups: np.ndarray) -> dict[str, object]:
    """Balanced accuracy and F1 with their intervals."""
    rng = np.random.default_rng(0)
    names = np.unique(groups)
    draws = []
    for _ in range(_DRAWS):
        rows = np.concatenate([np.flatnonzero(groups == name) for name in rng.choice(names, len(names))])
        if 0 < labels[rows].mean() < 1:
            draws.append(_scores(chance[rows] > 0.5, labels[rows]))
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    balanced, f1 = _scores(chance > 0.5, labels)
    return {
        "balanced_accuracy": balanced,
        "balanced_accuracy_95": [float(low[0]), float(high[0])],
        "f1": f1,
        "f1_95": [float(low[1]), float(high[1])],
        "accuracy": float(np.mean((chance > 0.5) == labels)),
    }


def _scores(said: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
    hit, held = said[labels].mean(), (~said[~labels]).mean()
    return float((hit + held) / 2), float(2 * (said & labels).sum() / max(1, said.sum() + labels.sum()))


def measure_classifiers(clips: list[Clip]) -> dict[str, object]:
    """Scores of motion features, of trivial readings of motion, and of what must not be used."""
    labels, groups = np.array([clip.slipped for clip in clips]), np.array([clip.grasped for clip in clips])
    motion = np.array([motion_features(clip) for clip in clips])
    count = motion.shape[1] // 3
    length = np.array([len(clip.status) for clip in clips], dtype=float)[:, None]
    inputs = {
        "motion": motion,
        "largest_step_alone": motion[:, [count + 1]],
        "largest_displacement_alone": motion[:, [count + 3]],
        "leak_frame_count": np.log(length),
        "leak_marker_count": np.array([[float(len(clip.rest_px))] for clip in clips]),
    }
    told: dict[str, object] = {"always_slip": score(np.ones(len(labels)), labels, groups)}
    for name, values in inputs.items():
        chance = leave_one_out(values, labels, groups)
        told[name] = score(chance, labels, groups)
        if name == "motion":
            told["grasps"] = _score_grasps(clips, chance)
            # within a class, what tells the length would still tell it
            told["motion_rank_correlation_with_length"] = {
                kind: _rank_correlation(chance[rows], length[rows, 0])
                for kind, rows in (("slip", labels), ("no_slip", ~labels))
            }
    long = length[:, 0] >= np.median(length[~labels])
    if 0 < labels[long].mean() < 1:
        chance = leave_one_out(motion[long], labels[long], groups[long])
        told["motion_on_clips_of_full_length"] = {
            "clips": int(long.sum()),
            "slip": int(labels[long].sum()),
            **score(chance, labels[long], groups[long]),
        }
    return told


def _score_grasps(clips: list[Clip], chance: np.ndarray) -> dict[str, object]:
    names = np.array([clip.grasp for clip in clips])
    firsts = [int(np.flatnonzero(names == name)[0]) for name in np.unique(names)]
    joined = np.array([chance[names == names[at]].mean() for at in firsts])
    labels, groups = np.array([clips[at].slipped for at in firsts]), np.array([clips[at].grasped for at in firsts])
    return {"grasps": len(firsts), **score(joined, labels, groups)}


def _rank_correlation(first: np.ndarray, second: np.ndarray) -> float | None:
    ranks = [_mean_ranks(values) for values in (first, second)]
    if min(values.std() for values in ranks) == 0:
        return None
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def _mean_ranks(values: np.ndarray) -> np.ndarray:
    """Ranks in which equal values share theirs: many clips have one length."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return (ends - (counts - 1) / 2)[inverse]


def main() -> None:
    """Print what was followed and what its motion tells, as a table or as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "gelsight_mini_slip"
    parser.add_argument("--clips", type=Path, default=default, help="folder with slip/ and noslip/")
    parser.add_argument("--labels", type=Path, help="table of the clips; labels.csv of their folder if not given")
    parser.add_argument("--keep", type=Path, help="folder to keep what was followed in, and to read it from")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if not options.clips.is_dir():
        parser.error(f"{options.clips} does not exist; name the folder of the clips with --clips")
    clips, failed = follow_all(options.clips, options.labels, options.keep)
    alive, jitter = np.array([alive_at_end(clip) for clip in clips]), np.array([rest_jitter(clip) for clip in clips])
    status = np.concatenate([clip.status.ravel() for clip in clips])
    found = {
        "clips": len(clips),
        "failed": failed,
        "objects": len({clip.grasped for clip in clips}),
        "frames": sum(len(clip.status) for clip in clips),
        "tracks_alive": float(alive[:, 0].mean()),
        "tracks_alive_worst_clip": float(alive[:, 0].min()),
        "clips_with_95_percent_alive": float(np.mean(alive[:, 0] >= 0.95)),
        "tracks_alive_of_all": float(alive[:, 1].mean()),
        "followed_in_view": float(np.mean(status[status != MarkerStatus.OUTSIDE] == MarkerStatus.FOLLOWED)),
        "jitter_px": float(np.sqrt(np.nanmean(jitter**2))),
        "jitter_px_worst_clip": float(np.nanmax(jitter)),
        **measure_classifiers(clips),
        "small_network": None,
    }
    motion = found["motion"]
    assert isinstance(motion, dict)  # as made above
    found |= {name: motion[name] for name in ("balanced_accuracy", "balanced_accuracy_95", "f1", "f1_95")}
    if options.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        print(f"{name:36} {value}")


if __name__ == "__main__":
    main()
