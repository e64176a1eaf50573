"""Real GelSight Mini clips of grasps that slip or hold: whether their dots are followed, and whether a slip is told.

Every clip is followed from the frame with least contact. Two classifiers say of a whole clip whether it slips (a label
a grasp is all there is): a logistic one of how the dots move, and a small convolutional network on difference images.
Both look at windows of the same number of frames, each against its own first frame, and at the mean over a clip's
windows, in which their number cannot be seen. Beside them stands what the number of frames alone gives away.

The clips of full length were recorded apart from the shorter ones, of which three in four slip. So clips weigh, in
training, as if as many slipped as held in either part: knowing which part a clip is of tells nothing.

Objects are left out one at a time (for the network in folds); 95 % intervals are over objects. `grasps` joins both
fingers, as do the figures at the top.
"""

import argparse
import json
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from scipy.stats import spearmanr
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from torch import Tensor, nn

from sliplens.errors import SliplensError
from sliplens.extras import import_cv2
from sliplens.markers import MarkerStatus, track_markers
from sliplens.markers.estimators import affine_parts
from sliplens.recordings.capture import Capture
from sliplens.recordings.formats.tables import open_text_table
from sliplens.recordings.formats.video import read_video
from sliplens.recordings.options import ReadOptions

FRAMES, STRIDE = 24, 12
SMALL = (48, 64)
"""Height and width of the pictures that the network sees."""
_CONTACT_PX = 1.0
_RIDGE = 1.0
_DRAWS = 2000
_STILL = 0.003  # pitches, of motion that is noise
_SHOWN = Console(stderr=True)  # what is printed is the result alone
_EVERY = 3  # frames from one of the network's windows to the next
_FOLDS, _EPOCHS, _BATCH, _SEEN = 6, 40, 8, 8


@dataclass(frozen=True, kw_only=True)
class Clip:
    """What was followed in one clip."""

    grasp: str
    grasped: str
    slipped: bool
    rest_px: np.ndarray
    """(markers, 2)"""
    position_px: np.ndarray
    """(frames, markers, 2), NaN where a marker was not followed."""
    status: np.ndarray
    """(frames, markers)"""
    picture: np.ndarray
    """(frames, rows, columns), grey and small, 8 bits."""

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.status)

    @property
    def pitch_px(self) -> float:
        """Median distance of the nearest marker."""
        distance = np.linalg.norm(self.rest_px[:, None] - self.rest_px[None], axis=-1)
        np.fill_diagonal(distance, np.inf)
        return float(np.median(distance.min(axis=1)))


@dataclass(frozen=True, kw_only=True)
class RecordedClip:
    """A clip without the dark and frozen frames at its start."""

    path: Path
    grasped: str
    slipped: bool
    stale: int
    capture: Capture
    reference: int
    """Frame with the least relief, for no untouched one was recorded."""


_HEAD = 13  # frames at the start that may be stale
_HORIZON = 500  # frames that the head is compared with; a longer video is read no further
_BLOCKS = 24, 32
_LEAST_LEAP = 1.5  # grey levels, mean over the image: several times what noise and coding change
_FROZEN = 0.75  # grey levels: no more than noise and coding change
_WAKES = 1.015  # a camera that adapts its exposure when it is started grows brighter by more


def small_copies(frames: Iterable[np.ndarray]) -> np.ndarray:
    """Reduce frames to the means of blocks, enough to tell scenes apart and small enough to keep."""
    copies = []
    for frame in islice(frames, _HORIZON):
        rows, columns = (min(most, size) for most, size in zip(_BLOCKS, frame.shape[:2], strict=True))
        height, width = frame.shape[0] // rows, frame.shape[1] // columns
        blocks = frame[: rows * height, : columns * width].reshape(rows, height, columns, width, 3)
        copies.append(blocks.mean(axis=(1, 3)).astype(np.float32))
    return np.stack(copies) if copies else np.empty((0, *_BLOCKS, 3), dtype=np.float32)


def count_stale(copies: np.ndarray) -> int:
    """Count the frames at the start of `small_copies` that belong to another scene.

    A camera that was just started hands out dark frames, then frozen frames of an earlier moment from its buffers, the
    last of them unlike every frame that follows. Of an object that slides all frames leap, or none does. (Where the
    camera ran already, an object that is pressed all at once within the first 13 frames and never released looks like
    a frozen start; do not count there.)
    """
    head = min(_HEAD, len(copies) // 3)  # enough frames must follow to compare with
    if not head:
        return 0
    flat = copies.reshape(len(copies), -1)
    leap = np.array([np.abs(flat[at + 1 :] - flat[at]).mean(axis=1).min() for at in range(head)])
    brightness = flat[: head + 1].mean(axis=1)
    wakes = bool(np.any(brightness[1:] > _WAKES * brightness[:-1]))
    frozen = np.append(False, leap[:-1] < np.minimum(leap[1:] / 4, _FROZEN))
    # where all frames move, none of them leaps
    stale = (leap > max(_LEAST_LEAP, 4 * float(np.median(leap)))) & (frozen | wakes)
    return int(np.flatnonzero(stale)[-1]) + 1 if stale.any() else 0


def list_clips(folder: Path) -> dict[Path, dict[str, str]]:
    """List the clips in `labels.csv` that exist, with their rows: their names repeat in every folder."""
    table = open_text_table(folder / "labels.csv")
    rows = [dict(zip(table.header, cells, strict=True)) for _, cells in table.rows]
    return {folder / row["file"]: row for row in rows if (folder / row["file"]).is_file()}


def read_clip(path: Path, row: dict[str, str]) -> RecordedClip:
    """Open a clip at 8 frames a second: its file says 25, its author that 10 to 13 s of video are 37 s of motion."""
    copies = small_copies(read_video(path, ReadOptions()).read_frames())
    stale = count_stale(copies)
    colour = copies[stale:, ..., [0, 2]] - copies[stale:, ..., [1]]
    padded = np.pad(colour, ((0, 0), (2, 2), (2, 2), (0, 0)), mode="edge")
    smooth = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2)).mean(axis=(-2, -1))
    return RecordedClip(
        path=path,
        grasped=row["object"],
        slipped=row["slip_label"] == "1",
        stale=stale,
        capture=read_video(path, ReadOptions(frame_rate=8.0, skip_frames=stale)),
        reference=int(np.argmin(np.abs(colour - smooth).mean(axis=(1, 2, 3)))),
    )


def follow(recorded: RecordedClip) -> Clip:
    """Follow the dots of a clip from its frame with least contact."""
    path, frames = recorded.path, list(recorded.capture.read_frames())
    tracks = track_markers(frames, frames[recorded.reference], "gelsight-mini")
    return Clip(
        grasp="/".join(path.parts[-3:-1]),
        grasped=recorded.grasped,
        slipped=recorded.slipped,
        rest_px=tracks.rest_px,
        position_px=np.where(tracks.followed[..., None], tracks.position_px, np.nan),
        status=tracks.status,
        picture=np.stack([shrink(frame) for frame in frames]),
    )


def shrink(frame: np.ndarray) -> np.ndarray:
    """Grey and small."""
    cv2 = import_cv2()
    return cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), SMALL[::-1], interpolation=cv2.INTER_AREA)


def follow_all(folder: Path, keep: Path | None) -> tuple[list[Clip], list[str]]:
    """Follow every clip, or read what was followed before from `keep`; gives the clips, and what failed."""
    clips, failed = [], []
    for path, row in track(list_clips(folder).items(), console=_SHOWN, description="Following dots"):
        saved = None if keep is None else keep / ("__".join(path.parts[-3:]) + ".npz")
        if saved is not None and saved.is_file():
            with np.load(saved) as data:
                clips.append(Clip(**{name: value if value.ndim else value.item() for name, value in data.items()}))
            continue
        try:
            clip = follow(read_clip(path, row))
        except SliplensError as error:
            failed.append(f"{path.parent.name}/{path.name}: {error}")
            continue
        clips.append(clip)
        if saved is not None:
            saved.parent.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(saved, **{name: getattr(clip, name) for name in Clip.__dataclass_fields__})
    return clips, failed


def alive_at_end(clip: Clip) -> float:
    """Share of the dots in view that are followed in the last frame of contact."""
    moved = np.linalg.norm(clip.position_px - clip.rest_px, axis=-1)
    far = np.array([np.quantile(row[np.isfinite(row)], 0.9) if np.isfinite(row).any() else np.inf for row in moved])
    touched = np.flatnonzero(far > _CONTACT_PX)
    last = int(touched[-1]) if len(touched) else len(far) - 1
    followed, seen = clip.status[last] == MarkerStatus.FOLLOWED, clip.status[last] != MarkerStatus.OUTSIDE
    return float(followed.sum() / max(1, seen.sum()))


def window_starts(frames: int) -> np.ndarray:
    """Where the windows of a clip begin: all of it is seen, every frame about twice."""
    count = 1 + int(np.ceil(max(0, frames - FRAMES) / STRIDE))
    return np.linspace(0, max(0, frames - FRAMES), count).round().astype(int)


def motion_features(clip: Clip, places: np.ndarray | None = None) -> np.ndarray:
    """Mean over windows of the numbers of `window_features`; not the largest, which grows with a clip's length.

    `places` are other frames than the clip's own, such as a part of it.
    """
    places = clip.position_px if places is None else places
    return np.mean([window_features(clip, places[at : at + FRAMES]) for at in window_starts(len(places))], axis=0)


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


def lag_features(clip: Clip, places: np.ndarray | None = None) -> np.ndarray:
    """How the dots move within 1, 4 and 12 frames, in pitches.

    Quantiles of the motion of their mean, of what moves against it, and of the divergence; and both of the latter over
    the former where that is fast.
    """
    moved = ((clip.position_px if places is None else places) - clip.rest_px) / clip.pitch_px
    parts = affine_parts(clip.rest_px / clip.pitch_px, moved)
    at, known = np.arange(len(parts)), np.isfinite(parts[:, 0])
    mean_x, mean_y, spread = (np.interp(at, at[known], parts[known, column]) for column in range(3))
    mean, values = np.stack([mean_x, mean_y], axis=1), []
    for lag in (1, 4, 12):
        step = moved[lag:] - moved[:-lag]
        apart = ((step - np.nanmean(step, axis=1, keepdims=True)) ** 2).sum(axis=2)
        together = np.linalg.norm(mean[lag:] - mean[:-lag], axis=1)
        rest = np.nan_to_num(np.sqrt(np.nanmean(apart, axis=1)))
        spreads = np.abs(spread[lag:] - spread[:-lag])
        fast = together > np.quantile(together, 0.9)
        values += [np.quantile(motion, share) for share in (0.5, 0.9, 0.99) for motion in (together, rest, spreads)]
        values += [(motion[fast].mean() + _STILL) / (together[fast].mean() + _STILL) for motion in (rest, spreads)]
    return np.log(np.array(values) + _STILL)


def _known_mean(values: np.ndarray) -> np.ndarray:
    known = np.all(np.isfinite(values), axis=-1)
    return np.where(known[..., None], values, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]


def _quantiles(rows: np.ndarray, share: float) -> np.ndarray:
    return np.array([np.quantile(row[np.isfinite(row)], share) if np.isfinite(row).any() else 0.0 for row in rows])


def balanced_weights(labels: np.ndarray, full: np.ndarray) -> np.ndarray:
    """Weights by which as many clips slip as hold, among those of full length and among the shorter ones."""
    weights = np.zeros(len(labels))
    for part in (full, ~full):
        for label in (labels, ~labels):
            rows = part & label
            weights[rows] = part.sum() / (2 * max(1, rows.sum()))
    return weights


def fit_logistic(values: np.ndarray, labels: np.ndarray, weight: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Ridge logistic regression; returns the function that gives the probability of a slip."""
    scale = StandardScaler().fit(values)
    fitted = LogisticRegression(C=1 / _RIDGE, tol=1e-8, max_iter=1000)
    fitted.fit(scale.transform(values), labels, sample_weight=weight)
    return lambda others: fitted.predict_proba(np.clip(scale.transform(others), -6, 6))[:, 1]


@dataclass(frozen=True, kw_only=True)
class Cases:
    """Labels of all clips, and what they may be grouped by."""

    slipped: np.ndarray
    grasped: np.ndarray
    frames: np.ndarray

    @property
    def full(self) -> np.ndarray:
        """Clips of full length."""
        return self.frames == self.frames.max()

    def only(self, rows: np.ndarray) -> "Cases":
        """Some of them."""
        return Cases(slipped=self.slipped[rows], grasped=self.grasped[rows], frames=self.frames[rows])


def leave_one_out(values: np.ndarray, cases: Cases) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """For each object, what was fitted on all clips of the others."""
    fitted = {}
    for name in np.unique(cases.grasped):
        rest = cases.grasped != name
        fitted[str(name)] = fit_logistic(
            values[rest], cases.slipped[rest], balanced_weights(cases.slipped[rest], cases.full[rest])
        )
    return fitted


def ask(fitted: dict[str, Callable[[np.ndarray], np.ndarray]], values: np.ndarray, cases: Cases) -> np.ndarray:
    """Probability of a slip of each clip, by what never saw its object."""
    return np.array([fitted[str(name)](row[None])[0] for name, row in zip(cases.grasped, values, strict=True)])


class WindowNetwork(nn.Module):
    """Three convolutions on each window, their mean over a clip's windows, and a linear answer; 14,000 weights."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in ((3, 16), (16, 32), (32, 32)):
            layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.BatchNorm2d(after), nn.ReLU()]
        self.see = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten())
        self.answer = nn.Sequential(nn.Dropout(0.3), nn.Linear(32, 1))

    def forward(self, windows: Tensor) -> Tensor:
        """Logit of a slip of each clip, from (clips, windows, 3, rows, columns)."""
        clips, count = windows.shape[:2]
        return self.answer(self.see(windows.flatten(0, 1)).reshape(clips, count, -1).mean(dim=1))[:, 0]


def difference_windows(clip: Clip) -> Tensor:
    """What the network sees of a clip: (windows, 3, rows, columns), in units of 24 grey levels, the dots' contrast.

    Last frame of the window less its first; mean absolute difference from frame to frame, threefold; largest absolute
    difference from the first.
    """
    picture = clip.picture.astype(np.float32) / 24
    found = []
    for at in range(0, max(1, len(picture) - FRAMES + 1), _EVERY):
        window = picture[at : at + FRAMES]
        moved = window - window[0]
        found.append([moved[-1], 3 * np.abs(np.diff(window, axis=0)).mean(axis=0), np.abs(moved).max(axis=0)])
    return torch.from_numpy(np.array(found).astype(np.float16))


def fold_objects(cases: Cases) -> Iterator[np.ndarray]:
    """Clips of each fold: objects dealt out in turn by the share of their clips that slip, so that folds are alike."""
    names = np.unique(cases.grasped)
    share = [cases.slipped[cases.grasped == name].mean() for name in names]
    count = [np.sum(cases.grasped == name) for name in names]
    order = np.lexsort((names, count, share))
    for fold in range(_FOLDS):
        yield np.isin(cases.grasped, names[order[fold::_FOLDS]])


def network_answers(clips: list[Clip], cases: Cases, *, seed: int) -> np.ndarray:
    """Probability of a slip of each clip, by a network trained on the other folds."""
    windows = [difference_windows(clip) for clip in clips]
    labels = torch.from_numpy(cases.slipped.astype(np.float32))
    answers = np.full(len(clips), np.nan)
    for held in track(list(fold_objects(cases)), console=_SHOWN, description="Training networks"):
        rows = np.flatnonzero(~held)
        weights = torch.zeros(len(clips))
        weights[rows] = torch.from_numpy(balanced_weights(cases.slipped[rows], cases.full[rows])).float()
        network = train_network(windows, labels, weights, rows, seed=seed).eval()
        for row in np.flatnonzero(held):
            answers[row] = _say_slip(network, windows[row])
    return answers


def _say_slip(network: WindowNetwork, windows: Tensor) -> float:
    """Answer to a clip by as many of its windows whatever its length, evenly spread."""
    spread = np.linspace(0, len(windows) - 1, 2 * _SEEN).round().astype(int)
    with torch.no_grad():
        return float(torch.sigmoid(network(windows[spread].float()[None]))[0])


def train_network(
    windows: list[Tensor], labels: Tensor, weights: Tensor, rows: np.ndarray, *, seed: int
) -> WindowNetwork:
    """Train on some clips; of each, eight windows at random an epoch, mirrored at random, stronger or weaker."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = WindowNetwork()
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-2)
    steps = _EPOCHS * (-(-len(rows) // _BATCH))
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=steps)
    for _ in range(_EPOCHS):
        order = rng.permutation(rows)
        for at in range(0, len(order), _BATCH):
            some = order[at : at + _BATCH]
            seen = torch.stack([windows[row][rng.integers(0, len(windows[row]), _SEEN)] for row in some]).float()
            seen = seen.flip([axis for axis in (3, 4) if rng.random() < 0.5])
            seen = seen * torch.from_numpy(np.exp(rng.normal(0, 0.4, (len(some), 1, 1, 1, 1)))).float()
            error = nn.functional.binary_cross_entropy_with_logits(
                network(seen), labels[some], weight=weights[some], reduction="mean"
            )
            optimiser.zero_grad()
            error.backward()
            optimiser.step()
            schedule.step()
    return network


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
    }


def _scores(said: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
    hit, held = said[labels].mean(), (~said[~labels]).mean()
    return float((hit + held) / 2), float(2 * (said & labels).sum() / max(1, said.sum() + labels.sum()))


def measure_classifiers(clips: list[Clip], *, seeds: int) -> dict[str, object]:
    """Scores of the two classifiers, of trivial readings of motion, and of what must not be used."""
    cases = Cases(
        slipped=np.array([clip.slipped for clip in clips]),
        grasped=np.array([clip.grasped for clip in clips]),
        frames=np.array([len(clip) for clip in clips]),
    )
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # frames in which all dots are lost
        both = np.array([np.concatenate([motion_features(clip), lag_features(clip)]) for clip in clips])
    motion = both[:, : motion_features(clips[0]).size]
    inputs = {
        "motion_and_lags": both,
        "motion": motion,
        "leak_frame_count": np.log(cases.frames)[:, None],
    }
    answers = {name: ask(leave_one_out(values, cases), values, cases) for name, values in inputs.items()}
    told: dict[str, object] = {"always_slip": score(np.ones(len(clips)), cases.slipped, cases.grasped)}
    told |= {name: _score_all(chance, cases) for name, chance in answers.items()}
    told["grasps"] = _score_grasps(clips, answers["motion_and_lags"])
    told["grasps_by_frame_count"] = _score_grasps(clips, answers["leak_frame_count"])
    told["count_alone"] = count_alone(cases.frames, cases.slipped, cases.grasped)
    networks = [network_answers(clips, cases, seed=seed) for seed in range(seeds)]
    if networks:
        told["small_network"] = _score_all(np.mean(networks, axis=0), cases)
    return told


def count_alone(frames: np.ndarray, slipped: np.ndarray, grasped: np.ndarray) -> dict[str, object]:
    """Accuracy of a threshold on the number of frames, clips of all lengths mixed, as the authors of the clips train.

    Over 500 draws: a fifth of the clips, or the clips of ten objects, are left out of choosing the threshold.
    """
    rng, scores = np.random.default_rng(0), dict[str, list[float]]()
    for _ in range(500):
        parts = {
            "clips": rng.permutation(len(frames)) < len(frames) // 5,
            "objects": np.isin(grasped, rng.permutation(np.unique(grasped))[:10]),
        }
        for name, test in parts.items():
            cuts = np.unique(frames)
            right = [np.mean((frames[~test] < cut) == slipped[~test]) for cut in cuts]
            cut = cuts[int(np.argmax(right))]
            scores.setdefault(name, []).append(float(np.mean((frames[test] < cut) == slipped[test])))
    return {
        name: {"accuracy": float(np.mean(each)), "accuracy_95": np.percentile(each, [2.5, 97.5]).tolist()}
        for name, each in scores.items()
    }


def _score_all(chance: np.ndarray, cases: Cases) -> dict[str, object]:
    """Scores over all clips and over those of one length, and how far the answers go with the length in each class."""
    full = cases.only(cases.full)
    return {
        **score(chance, cases.slipped, cases.grasped),
        "among_full_length": {
            "clips": len(full.frames),
            "slip": int(full.slipped.sum()),
            **score(chance[cases.full], full.slipped, full.grasped),
        },
        "rank_correlation_with_length": {
            kind: float(np.asarray(spearmanr(chance[rows], cases.frames[rows]))[0])
            for kind, rows in (("slip", cases.slipped), ("no_slip", ~cases.slipped))
        },
    }


def _score_grasps(clips: list[Clip], chance: np.ndarray) -> dict[str, object]:
    names = np.array([clip.grasp for clip in clips])
    firsts = [int(np.flatnonzero(names == name)[0]) for name in np.unique(names)]
    joined = np.array([chance[names == names[at]].mean() for at in firsts])
    labels, groups = np.array([clips[at].slipped for at in firsts]), np.array([clips[at].grasped for at in firsts])
    return {"grasps": len(firsts), **score(joined, labels, groups)}


def main() -> None:
    """Print what was followed and what its motion tells as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference")) / "gelsight_mini_slip"
    parser.add_argument("--clips", type=Path, default=default, help="folder with slip/ and noslip/")
    parser.add_argument("--keep", type=Path, help="folder to keep what was followed in, and to read it from")
    parser.add_argument("--seeds", type=int, default=2, help="networks a fold, their answers averaged; 0 for none")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if not options.clips.is_dir():
        parser.error(f"{options.clips} does not exist; name the folder of the clips with --clips")
    clips, failed = follow_all(options.clips, options.keep)
    torch.set_num_threads(2)
    alive = np.array([alive_at_end(clip) for clip in clips])
    found = {
        "clips": len(clips),
        "failed": failed,
        "objects": len({clip.grasped for clip in clips}),
        "frames": sum(len(clip) for clip in clips),
        "tracks_alive": float(alive.mean()),
        "worst_clip_alive": float(alive.min()),
        **measure_classifiers(clips, seeds=options.seeds),
    }
    grasps, by_count = found["grasps"], found["grasps_by_frame_count"]
    assert isinstance(grasps, dict)  # as made above
    assert isinstance(by_count, dict)
    found |= {name: grasps[name] for name in ("balanced_accuracy", "balanced_accuracy_95", "f1", "f1_95")}
    found |= {"low": grasps["balanced_accuracy_95"][0], "frame_count_alone": by_count["balanced_accuracy"]}
    print(json.dumps(found, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
