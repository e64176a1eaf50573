"""The chosen frames as the camera saw them, and where their markers are."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from sliplens.errors import ImageError, InputError
from sliplens.files import write_json
from sliplens.images import absolute_difference, write_png
from sliplens.markers import track_markers
from sliplens.recordings import Dataset, Recording
from sliplens.study.choice import Choice, Pick
from sliplens.study.explaining import RESULT_FILE

MARKERS_FILE = "markers.parquet"


@dataclass(frozen=True, kw_only=True)
class MarkedFrame:
    """Where the markers of a frame are, in camera pixels; NaN for one that was not followed."""

    rest_px: Float[np.ndarray, "markers 2"]
    now_px: Float[np.ndarray, "markers 2"]


def save_states(
    choice: Choice, data: Dataset, folder: Path, *, on_frame: Callable[[int, int], None] | None = None
) -> None:
    """Write pictures of the shown frames, raw and difference, and the markers of every chosen frame.

    The simulator knows the markers' places; in recorded trials they are followed from the untouched sensor on. A trial
    in which they cannot be followed has none, and the result says why.

    Parameters
    ----------
    choice
        What the study looks at.
    data
        The data set it was chosen from.
    folder
        Gets `frames/*.png`, `markers.parquet` and `result.json`; must exist.
    on_frame
        Called with the number of frames done and the number of all.
    """
    (folder / "frames").mkdir(exist_ok=True)
    infos = {info.trial: info for info in data.trials}
    tables: list[pa.Table] = []
    shown, untracked, done, known = [], [], 0, True
    size = (0, 0)
    for trial, group in groupby(choice.frames, key=lambda pick: pick.trial):
        picks = list(group)
        recording = data.load(infos[trial])
        size = recording.reference.shape[:2]
        known = known and recording.truth is not None
        try:
            tables += [_table(pick.id, one) for pick, one in zip(picks, _markers(recording, picks), strict=True)]
        except (ImageError, InputError) as error:
            untracked.append(f"{trial}: {error}")
        for pick in picks:
            if pick.shown:
                _draw(recording, pick, folder)
                shown.append(
                    {
                        "id": pick.id,
                        "level": pick.level,
                        "safety_margin": pick.safety_margin,
                        "contact_state": str(recording.contact_state[pick.frame]),
                    }
                )
            done += 1
            if on_frame is not None:
                on_frame(done, len(choice.frames))
    pq.write_table(pa.concat_tables(tables) if tables else _NO_MARKER.empty_table(), folder / MARKERS_FILE)
    write_json(
        folder / RESULT_FILE,
        {
            "trial": next(pick.trial for pick in choice.frames if pick.shown),
            "markers_from": "simulation" if known else "tracking",
            "frame_size": size,
            "frames": shown,
            "untracked": untracked,
        },
    )


def _draw(recording: Recording, pick: Pick, folder: Path) -> None:
    frame = recording.frames[pick.frame]
    write_png(folder / "frames" / f"{pick.id}.raw.png", frame)
    difference = absolute_difference(frame[None], recording.reference)[0]
    write_png(folder / "frames" / f"{pick.id}.difference.png", difference)


def _markers(recording: Recording, picks: Sequence[Pick]) -> list[MarkedFrame]:
    rows = [pick.frame for pick in picks]
    if recording.truth is not None:
        truth = recording.truth
        return [
            MarkedFrame(rest_px=truth.marker_rest_px.astype(np.float64), now_px=truth.marker_px[row].astype(np.float64))
            for row in rows
        ]
    tracks = track_markers(recording.frames[: max(rows) + 1], recording.reference)
    followed = np.where(tracks.followed[..., None], tracks.position_px, np.nan)
    return [MarkedFrame(rest_px=tracks.rest_px, now_px=followed[row]) for row in rows]


_NO_MARKER = pa.schema(
    [
        ("frame_id", pa.string()),
        ("marker", pa.int64()),
        *((name, pa.float64()) for name in ("rest_x_px", "rest_y_px", "x_px", "y_px")),
    ]
)


def _table(name: str, found: MarkedFrame) -> pa.Table:
    count = len(found.rest_px)
    return pa.table(
        {
            "frame_id": [name] * count,
            "marker": np.arange(count),
            "rest_x_px": found.rest_px[:, 0],
            "rest_y_px": found.rest_px[:, 1],
            "x_px": found.now_px[:, 0],
            "y_px": found.now_px[:, 1],
        },
        schema=_NO_MARKER,
    )


def load_markers(folder: Path) -> dict[str, MarkedFrame]:
    """Read the markers of each frame that has some.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    try:
        table = pq.ParquetFile(folder / MARKERS_FILE).read().to_pydict()
    except (OSError, pa.ArrowException, KeyError) as error:
        raise InputError(f"{folder / MARKERS_FILE} cannot be read ({error}); make the study again") from None
    names = np.array(table["frame_id"], dtype=str)
    found = {}
    for name in dict.fromkeys(names.tolist()):
        rows = names == name
        rest, now = (
            np.stack([np.array(table[column], dtype=np.float64)[rows] for column in columns], axis=1)
            for columns in (("rest_x_px", "rest_y_px"), ("x_px", "y_px"))
        )
        found[name] = MarkedFrame(rest_px=rest, now_px=now)
    return found


def network_places(
    found: MarkedFrame, *, frame_size: tuple[int, int], image_size: int
) -> tuple[Float[np.ndarray, "seen 2"], float]:
    """Where a network sees the markers, and how far each one's surroundings reach, in its own pixels.

    A difference image shows a marker where it was and where it is; so its place is half-way, and half of the pitch
    reaches both.

    Parameters
    ----------
    found
        Markers in camera pixels; those not followed are left out.
    frame_size
        Height and width of the camera's frames.
    image_size
        Side of the network's input.

    Returns
    -------
    centres, reach
        x and y, and half of the median distance between neighbours.
    """
    middle = (found.rest_px + found.now_px) / 2
    middle = middle[np.isfinite(middle).all(axis=1)]
    scale = image_size / np.array([frame_size[1], frame_size[0]])
    # pixel centres lie at whole numbers, edges half a pixel before
    centres = (middle + 0.5) * scale - 0.5
    between = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(between, np.inf)
    return centres, float(np.median(between.min(axis=1))) / 2
