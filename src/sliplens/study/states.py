"""The chosen frames as the camera saw them, and where their markers are."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from jaxtyping import Float

from sliplens.errors import ImageError, InputError
from sliplens.images import absolute_difference
from sliplens.markers import track_markers
from sliplens.progress import OnProgress
from sliplens.recordings import Dataset, Recording
from sliplens.results.study import Choice, ChosenFrame, MarkedFrame, MarkerTable, ShownFrame, States


def show_states(choice: Choice, data: Dataset, *, on_progress: OnProgress | None = None) -> States:
    """Pictures of the shown frames, raw and difference, and the markers of every chosen frame.

    The simulator knows the markers' places; in recorded trials they are followed from the untouched sensor on. A trial
    in which they cannot be followed has none, and the result says why.
    """
    infos = {info.trial: info for info in data.trials}
    tables: list[MarkerTable] = [_NO_MARKERS]
    shown, raw, difference, untracked = [], [], [], []
    done, simulated = 0, True
    for trial, group in groupby(choice.frames, key=lambda frame: frame.trial):
        chosen = list(group)
        recording = data.load(infos[trial])
        simulated = simulated and recording.truth is not None
        try:
            tables += [
                _table(frame.id, marked) for frame, marked in zip(chosen, _markers(recording, chosen), strict=True)
            ]
        except (ImageError, InputError) as error:
            untracked.append(f"{trial}: {error}")
        for frame in chosen:
            if frame.shown:
                shown.append(
                    ShownFrame(
                        id=frame.id,
                        level=frame.level,
                        safety_margin=frame.safety_margin,
                        contact_state=str(recording.contact_state[frame.frame]).replace("_", " "),
                    )
                )
                raw.append(recording.frames[frame.frame])
                difference.append(absolute_difference(raw[-1][None], recording.reference)[0])
            done += 1
            if on_progress is not None:
                on_progress(done, len(choice.frames))
    return States(
        trial=next(frame.trial for frame in choice.frames if frame.shown),
        markers_from="simulation" if simulated else "tracking",
        shown=tuple(shown),
        untracked=tuple(untracked),
        raw=np.stack(raw),
        difference=np.stack(difference),
        table=MarkerTable.joined(tables),
    )


def _markers(recording: Recording, chosen: Sequence[ChosenFrame]) -> list[MarkedFrame]:
    rows = [frame.frame for frame in chosen]
    if recording.truth is not None:
        truth = recording.truth
        return [
            MarkedFrame(rest_px=truth.marker_rest_px.astype(np.float64), now_px=truth.marker_px[row].astype(np.float64))
            for row in rows
        ]
    tracks = track_markers(recording.frames[: max(rows) + 1], recording.reference)
    followed = np.where(tracks.followed[..., None], tracks.position_px, np.nan)
    return [MarkedFrame(rest_px=tracks.rest_px, now_px=followed[row]) for row in rows]


def _table(frame_id: str, marked: MarkedFrame) -> MarkerTable:
    count = len(marked.rest_px)
    return MarkerTable(
        frame_id=np.repeat(frame_id, count),
        marker=np.arange(count),
        rest_x_px=marked.rest_px[:, 0],
        rest_y_px=marked.rest_px[:, 1],
        x_px=marked.now_px[:, 0],
        y_px=marked.now_px[:, 1],
    )


# so that the table of a study without markers has its columns
_NO_MARKERS = _table("", MarkedFrame(rest_px=np.empty((0, 2)), now_px=np.empty((0, 2))))


def network_places(
    marked: MarkedFrame, *, frame_size: tuple[int, int], image_size: int
) -> tuple[Float[np.ndarray, "seen 2"], float]:
    """Where a network sees the markers (x, y), and how far each one's surroundings reach, in its own pixels.

    A difference image shows a marker where it was and where it is; so its place is half-way, and half of the pitch, the
    median distance between neighbours, reaches both. Markers that were not followed are left out.
    """
    middle = (marked.rest_px + marked.now_px) / 2
    middle = middle[np.isfinite(middle).all(axis=1)]
    scale = image_size / np.array([frame_size[1], frame_size[0]])
    # pixel centres lie at whole numbers, edges half a pixel before
    centres = (middle + 0.5) * scale - 0.5
    between = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(between, np.inf)
    return centres, float(np.median(between.min(axis=1))) / 2
