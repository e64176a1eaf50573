"""Trials, frames, markers and methods of a study."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from sliplens.errors import ImageError, InputError, RecordingError
from sliplens.explainers.contract import Explainer
from sliplens.explainers.frames import MARGIN_LEVELS as LEVELS
from sliplens.explainers.frames import nearest_frame
from sliplens.explainers.occlusion import RegionMethod, marker_regions, tile_regions, to_network_px
from sliplens.explainers.table import get_explainer
from sliplens.faithfulness.removal import Units
from sliplens.intervals import FEWEST_UNITS
from sliplens.markers import track_markers
from sliplens.models import Manifest, Network
from sliplens.progress import number_of, report_each
from sliplens.recordings import Dataset, TrialInfo
from sliplens.results import study as records
from sliplens.results.explanation import CLOSE, Explanation
from sliplens.results.study import Choice, ChosenFrame, MarkerTable, StudyConfig

SCORED_LEVELS = (0.4, 0.2, 0.0)
"""Margins at which the thesis scores: near slip, where there is much to explain."""
_REACH = 0.05
"""How far the frame nearest to a level may lie from it, in margin units."""


def sample_trials(data: Dataset, *, split: str, condition: str) -> tuple[TrialInfo, ...]:
    """Trials of a split and condition; those of the split `test` where a data set has none to train on."""
    has_split = any(info.split == split and info.condition == condition for info in data.trials)
    return data.select(split="test" if split == "train" and not has_split else split, condition=condition)


def choose_frames(networks: Mapping[str, Network], data: Dataset, config: StudyConfig) -> Choice:
    """Choose trials in which every network predicts the frames along the margin within a tolerance, in margin units.

    Where more trials qualify than are wanted, the first in the data set's order are taken; where fewer do, those within
    `CLOSE_TO_LABELS` are taken too, the best first. Where even these are fewer than five, five are taken, from which no
    verdict follows. Each trial has a frame nearest to each of `LEVELS` to look at; those nearest to `SCORED_LEVELS` are
    scored.

    Polak, section 4: 14 training trials predicted within 3 %, 84 frames to look at, 42 to score.
    """
    trials, tolerance, condition = config.trials, config.tolerance, config.condition
    if trials < 1:
        raise InputError(f"a study of {trials} trials is impossible; ask for 1 or more")
    if not 0 <= tolerance <= 1:
        raise InputError(f"the tolerance is {tolerance:g}; give a share of the margin between 0 and 1")
    infos = sample_trials(data, split=config.split, condition=condition)
    candidates = [
        candidate
        for info in report_each(infos)
        if (candidate := _measure_trial(info, networks, data, tolerance=tolerance)) is not None
    ]
    if not candidates:
        raise RecordingError(
            f"none of the {number_of(len(infos), f'{condition} trial')} of split {infos[0].split!r} has a labelled "
            f"frame within {_REACH:.0%} of each of {', '.join(f'{level:.0%}' for level in LEVELS)}; choose another "
            "split or condition, or trials with more frames from full stick to full slip"
        )
    # sorting is stable: those that qualify keep the data set's order, so that none is picked for its looks
    ranked = sorted(candidates, key=lambda each: 0.0 if each[0].qualified else each[0].worst)
    close = sum(trial.worst <= max(tolerance, records.CLOSE_TO_LABELS) for trial, _, _ in ranked)
    taken = ranked[: min(trials, max(close, FEWEST_UNITS))]
    best = min((trial for trial, _, _ in taken), key=lambda trial: trial.worst).trial
    scored = [level in SCORED_LEVELS for level in LEVELS]
    return Choice(
        trials_wanted=trials,
        tolerance=tolerance,
        considered=len(candidates),
        qualified=sum(trial.qualified for trial, _, _ in candidates),
        mean_error={name: float(np.mean([errors[name][scored] for _, _, errors in taken])) for name in networks},
        source=data.source,
        split=infos[0].split,
        condition=condition,
        trials=tuple(trial for trial, _, _ in taken),
        frames=tuple(replace(frame, pictured=frame.trial == best) for _, frames, _ in taken for frame in frames),
    )


def _measure_trial(
    info: TrialInfo, networks: Mapping[str, Network], data: Dataset, *, tolerance: float
) -> tuple[records.ChosenTrial, tuple[ChosenFrame, ...], dict[str, Float[np.ndarray, " levels"]]] | None:
    """Measure the errors of each network at the frames nearest to the levels; None where no frame is near one."""
    recording = data.load(info, truth=False)
    margin = np.where(recording.labelled, recording.safety_margin, np.nan)
    if not np.isfinite(margin).any():
        return None
    rows = [nearest_frame(margin, level) for level in LEVELS]
    near = all(abs(margin[row] - level) <= _REACH for row, level in zip(rows, LEVELS, strict=True))
    if not near or len(set(rows)) < len(rows):
        return None
    errors = {}
    for name, trained in networks.items():
        answers = trained.predict(trained.encode(recording.frames[rows], recording.reference)).numpy()
        errors[name] = np.abs(answers - margin[rows])
    worst = {name: float(values.max()) for name, values in errors.items()}
    frames = tuple(
        ChosenFrame(
            id=f"{info.trial}-f{row:04d}",
            trial=info.trial,
            day=info.day,
            frame=row,
            level=level,
            safety_margin=label,
            scored=level in SCORED_LEVELS,
            pictured=False,
        )
        for level, row, label in zip(LEVELS, rows, margin[rows].tolist(), strict=True)
    )
    trial = records.ChosenTrial(trial=info.trial, qualified=max(worst.values()) <= tolerance, worst_error=worst)
    return trial, frames, errors


def show_states(choice: Choice, data: Dataset) -> records.States:
    """Return the markers of every chosen frame.

    The simulator knows the markers' places; in recorded trials they are followed from the untouched sensor on. A trial
    in which they cannot be followed has none, and the result says why.
    """
    untracked, ids, rests, places = [], [], [np.empty((0, 2))], [np.empty((0, 2))]
    for trial, group in report_each(
        [(trial, list(rows)) for trial, rows in groupby(choice.frames, lambda at: at.trial)]
    ):
        recording, rows = data.load(data.find(trial)), [frame.frame for frame in group]
        if recording.truth is not None:
            rest, now = recording.truth.marker_rest_px, recording.truth.marker_px
        else:
            try:
                tracks = track_markers(recording.frames[: max(rows) + 1], recording.reference)
            except (ImageError, InputError) as error:
                untracked.append(f"{trial}: {error}")
                continue
            rest, now = tracks.rest_px, np.where(tracks.followed[..., None], tracks.position_px, np.nan)
        ids += [frame.id for frame in group for _ in rest]
        rests += [rest.astype(np.float64)] * len(rows)
        places += [now[row].astype(np.float64) for row in rows]
    (rest_x, rest_y), (x, y) = np.concatenate(rests).T, np.concatenate(places).T
    marker = np.concatenate([np.arange(len(rest)) for rest in rests])
    names = np.array(ids, dtype=str)
    table = MarkerTable(frame_id=names, marker=marker, rest_x_px=rest_x, rest_y_px=rest_y, x_px=x, y_px=y)
    return records.States(untracked=tuple(untracked), table=table)


def network_places(markers: MarkerTable, manifest: Manifest) -> tuple[Float[np.ndarray, "seen 2"], float]:
    """Where a network sees the markers (x, y), and how far each one's surroundings reach, in its own pixels.

    A difference image shows a marker where it was and where it is; so its place is half-way, and half of the pitch, the
    median distance between neighbours, reaches both. Markers that were not followed are left out.
    """
    middle = np.stack([markers.rest_x_px + markers.x_px, markers.rest_y_px + markers.y_px], axis=1) / 2
    middle = middle[np.isfinite(middle).all(axis=1)]
    centres = to_network_px(middle, manifest.frame_size, image_size=manifest.image_size).numpy()
    between = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(between, np.inf)
    return centres, float(np.median(between.min(axis=1))) / 2


def marker_sums(
    relevance: Float[np.ndarray, "size size"], regions: Int[np.ndarray, "size size"], *, markers: int
) -> Float64[np.ndarray, " markers"]:
    """Sum a map over the region of each marker (`marker_regions`)."""
    return np.bincount(regions.ravel(), relevance.astype(np.float64).ravel(), minlength=markers + 1)[:markers]


def study_explainers(methods: Sequence[str], *, budget: float = records.STUDY_BUDGET) -> dict[str, Explainer]:
    """Explainers of a study: rows of `EXPLAINERS`, Poly-CAM with a share of the channels measured at first."""
    rows: dict[str, Explainer] = {
        "poly-cam": get_explainer("poly-cam", budget=budget),
        # compared with what was published; its weights are nearly all 1, so that this costs little
        "poly-cam-thesis": get_explainer("poly-cam-thesis", budget=budget, likeness=(0.999, 0.97)),
    }
    return {name: rows.get(name) or get_explainer(name) for name in methods}


def without_markers(explainers: Mapping[str, Explainer]) -> dict[str, Explainer]:
    """Replace explainers of markers, where these are unknown, by explainers of tiles."""
    by_tile = {name.removesuffix("-marker"): explainer for name, explainer in explainers.items()}
    return {name: get_explainer(name) if isinstance(row, RegionMethod) else row for name, row in by_tile.items()}


def removal_units(
    trained: Network, explained: Explanation, markers: Mapping[str, MarkerTable]
) -> dict[str, list[Units]]:
    """Units of removal of each frame: pixels, tiles, and markers where they are known in every frame."""
    shape = (explained.image_size, explained.image_size)
    sides = {"pixel": 1, "tile": max(1, round(16 * shape[0] / 224))}  # 16 pixels of 224
    units = {name: [tile_regions(shape, tile_px=side).numpy()] * len(explained.frames) for name, side in sides.items()}
    if all(frame.id in markers for frame in explained.frames):
        discs = [network_places(markers[frame.id], trained.manifest) for frame in explained.frames]
        units["marker"] = [
            marker_regions(shape, torch.from_numpy(centres), radius_px=reach).numpy() for centres, reach in discs
        ]
    return units


def worth_scoring(chosen: Iterable[ChosenFrame], explained: Explanation) -> tuple[ChosenFrame, ...]:
    """Select the frames to score in which the answer changed by `CLOSE` or more.

    The sign of a smaller change, along which maps are ranked, is chance. If a network tells no frame from the
    baseline, all are scored.
    """
    changes = {frame.id: abs(frame.prediction - frame.reference_prediction) for frame in explained.frames}
    scored = tuple(frame for frame in chosen if frame.scored)
    return tuple(frame for frame in scored if changes[frame.id] >= CLOSE) or scored


def trial_seed(seed: int, number: int) -> int:
    """Seed of a trial of a study by its number there, of which none has a thousand: that of no other study."""
    return 1000 * seed + number


def marker_places(
    trained: Network, frames: Sequence[str], markers: Mapping[str, MarkerTable]
) -> list[Float[Tensor, "_markers 2"]]:
    """Where the markers of each frame are, in the network's pixels; those that were not followed are left out."""
    now, manifest = [np.stack([markers[frame].x_px, markers[frame].y_px], axis=1) for frame in frames], trained.manifest
    valid = [places[np.isfinite(places).all(axis=1)] for places in now]
    return [to_network_px(places, manifest.frame_size, image_size=manifest.image_size) for places in valid]
