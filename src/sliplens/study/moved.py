"""Proof of a map: the markers that it ranks first, moved back to the stick frame by the simulator."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from sliplens.errors import InputError
from sliplens.explainers.occlusion import marker_regions
from sliplens.models import Network
from sliplens.recordings import Recording
from sliplens.results.explanation import MovedMarkers
from sliplens.simulation.intervention import draw_with_markers_back, rebuild_trial, visible_markers
from sliplens.study.neutral import marker_sums

RANDOM_SETS = 20
_HALF = 0.5


def move_markers(
    network: Network,
    folder: Path,
    recording: Recording,
    *,
    frame: int,
    stick: int,
    relevance: Float32[np.ndarray, "size size"],
) -> tuple[MovedMarkers, UInt8[np.ndarray, "1 height width 3"]] | None:
    """Move the fewest markers that hold half of a map's supporting relevance to the stick frame, and predict again.

    `folder` is that of the data set. As many random markers are moved for comparison. The frame drawn anew is returned
    beside the record. None where the trial cannot be
    drawn anew, or the map supports the change of the prediction nowhere.
    """
    try:
        film = rebuild_trial(folder, recording).film
    except InputError:
        return None
    visible = visible_markers(film.sensor)
    size = network.manifest.image_size
    scale = size / np.array([recording.frames.shape[2], recording.frames.shape[1]])
    centres = torch.from_numpy((film.marker_px[frame][visible] + 0.5) * scale - 0.5)

    def predict(moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        back = np.zeros((len(moved), len(film.marker_rest_px)), dtype=bool)
        back[:, visible] = moved
        drawn = draw_with_markers_back(film, frame, back, to=stick).numpy()
        return drawn, network.predict(network.encode(drawn, recording.reference)).cpu().numpy().astype(np.float64)

    count = len(visible)
    _, (now, after_all) = predict(np.stack([np.zeros(count, dtype=bool), np.ones(count, dtype=bool)]))
    sums = marker_sums(relevance, marker_regions((size, size), centres).numpy(), markers=count)
    supporting = np.clip(sums * np.sign(now - after_all), 0, None)
    if supporting.sum() <= 0:
        return None
    order = np.argsort(-supporting, kind="stable")
    few = 1 + int(np.argmax(np.cumsum(supporting[order]) >= _HALF * supporting.sum()))
    rng = np.random.default_rng(0)
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
