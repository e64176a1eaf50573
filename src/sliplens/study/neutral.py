"""Markers moved to another margin of their trial: a neutral judge of maps, and the proof of one."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int, Int64, UInt8

from sliplens.errors import InputError
from sliplens.explainers.occlusion import marker_regions
from sliplens.models import Network
from sliplens.recordings import Recording
from sliplens.results.explanation import MovedMarkers
from sliplens.simulation.trials import put_markers_back, rebuild_trial, visible_markers

GROUPS, GROUP_MARKERS = 24, 5
"""Groups of a frame, and markers of a group."""
MOVED_TO, MOVED_FAR, HIGH = 0.85, 0.3, 0.8
"""Margin to which markers are moved; margin for frames above the third one, which lie too near to the first."""


def neutral_frame(margins: Float[np.ndarray, " frames"], frame: int) -> int:
    """Find the frame of a trial to whose places the markers of a frame are moved; it lies before the first slip."""
    slips = np.flatnonzero(margins <= 0)
    before = margins[: slips[0]] if len(slips) and np.isfinite(margins[: slips[0]]).any() else margins
    wanted = MOVED_FAR if margins[frame] > HIGH else MOVED_TO
    return int(np.nanargmin(np.abs(before - wanted)))


def draw_groups(markers: int, *, rng: np.random.Generator) -> Int64[np.ndarray, "groups members"]:
    """Draw random groups of a frame's markers."""
    size = min(GROUP_MARKERS, markers)
    return np.stack([rng.choice(markers, size, replace=False) for _ in range(GROUPS)])


def marker_sums(
    relevance: Float[np.ndarray, "size size"], regions: Int[np.ndarray, "size size"], *, markers: int
) -> Float64[np.ndarray, " markers"]:
    """Sum a map over the region of each marker (`marker_regions`)."""
    return np.bincount(regions.ravel(), relevance.astype(np.float64).ravel(), minlength=markers + 1)[:markers]


def correlate_groups(
    values: Float[np.ndarray, " markers"],
    groups: Int[np.ndarray, "groups members"],
    effects: Float[np.ndarray, " groups"],
) -> float:
    """Pearson's correlation of the sums of marker values over groups with the effects of these.

    NaN where the effects do not vary, so that nothing can be judged; 0 where the sums do not.
    """
    sums = values[groups].sum(axis=1)
    if len(effects) < 2 or np.ptp(effects) == 0:
        return float("nan")
    return 0.0 if np.ptp(sums) == 0 else float(np.corrcoef(sums, effects)[0, 1])


RANDOM_SETS = 20
"""Sets of random markers that are moved beside those of a map."""


def prove_map(
    network: Network,
    folder: Path,
    recording: Recording,
    *,
    frame: int,
    stick: int,
    relevance: Float32[np.ndarray, "size size"],
    rng: np.random.Generator,
) -> tuple[MovedMarkers, UInt8[np.ndarray, "1 height width 3"]] | None:
    """Move the fewest markers that hold half of a map's supporting relevance to the stick frame, and predict again.

    `folder` is that of the data set. As many random markers are moved for comparison. The new drawing is returned with
    the record; None where the trial cannot be drawn again, or the map nowhere supports the change of the prediction.
    """
    try:
        film = rebuild_trial(folder, recording)
    except InputError:
        return None
    visible = visible_markers(film.sensor)
    size = network.manifest.image_size
    scale = size / np.array([recording.frames.shape[2], recording.frames.shape[1]])
    centres = torch.from_numpy((film.marker_px[frame][visible] + 0.5) * scale - 0.5)

    def predict(moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        back = np.zeros((len(moved), len(film.marker_rest_px)), dtype=bool)
        back[:, visible] = moved
        drawn = put_markers_back(film, frame, back, to=stick).draw_all()
        return drawn, network.predict(network.encode(drawn, recording.reference)).cpu().numpy().astype(np.float64)

    count = len(visible)
    _, (now, after_all) = predict(np.stack([np.zeros(count, dtype=bool), np.ones(count, dtype=bool)]))
    sums = marker_sums(relevance, marker_regions((size, size), centres).numpy(), markers=count)
    supporting = np.clip(sums * np.sign(now - after_all), 0, None)
    if supporting.sum() <= 0:
        return None
    order = np.argsort(-supporting, kind="stable")
    few = 1 + int(np.argmax(np.cumsum(supporting[order]) >= 0.5 * supporting.sum()))
    sets = np.stack([order[:few], *(rng.choice(count, few, replace=False) for _ in range(RANDOM_SETS))])
    moved = np.zeros((len(sets), count), dtype=bool)
    np.put_along_axis(moved, sets, values=True, axis=1)
    drawn, after = predict(moved)
    chosen = visible[order[:few]]
    record = MovedMarkers(
        frame=frame,
        prediction=float(now),
        change=float(now - after[0]),
        change_all=float(now - after_all),
        change_random=float(np.mean(now - after[1:])),
        random_sets=RANDOM_SETS,
        markers=count,
        from_px=tuple((float(x), float(y)) for x, y in film.marker_px[frame][chosen]),
        to_px=tuple((float(x), float(y)) for x, y in film.marker_px[stick][chosen]),
    )
    return record, drawn[:1]
