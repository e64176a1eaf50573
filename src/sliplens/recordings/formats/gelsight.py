"""The published GelSight Mini clips of grasps that slip or hold, with their pitfalls handled."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Capture
from sliplens.recordings.formats.tables import open_text_table, trial_name
from sliplens.recordings.formats.video import count_stale, least_contact, read_video, small_copies
from sliplens.recordings.labelling import Clip
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.trial import labels_of_margins

LABELS_FILE = "labels.csv"
FRAME_RATE_HZ = 8.0  #: Rough rate: the files say 25, their author that 10 to 13 s of video are 37 s of motion.


def is_gelsight(path: Path) -> bool:
    """Return True for a clip of the data set, the folder of a grasp, or the data set, by the header of `labels.csv`."""
    for folder in (path, *path.absolute().parents[1:3]):
        with suppress(RecordingError):
            if {"file", "slip_label"} <= set(open_text_table(folder / LABELS_FILE).header):
                return True
    return False


def read_gelsight(path: Path, options: ReadOptions) -> list[Capture]:
    """Read clips: all in the data set's folder, those in the folder of a grasp, or a single one."""
    if (path / LABELS_FILE).is_file():
        clips = list_gelsight_clips(path)
    else:
        clips = [path] if path.is_file() else sorted(path.glob("*.avi"))
    if not clips:
        raise RecordingError(f"{path} holds no clip; name one, or its folder, or copy those that {LABELS_FILE} lists")
    rate = FRAME_RATE_HZ if options.frame_rate is None else options.frame_rate
    return [read_gelsight_clip(clip, frame_rate=rate) for clip in clips]


def read_gelsight_clip(path: Path, *, labels: Path | None = None, frame_rate: float = FRAME_RATE_HZ) -> Capture:
    """Open a clip of the data set behind *Incipient Slip Detection* (A. Parag), as laid out in its `labels.csv`."""
    table = path.absolute().parent.parent.parent / LABELS_FILE if labels is None else labels
    rows = _read_labels(table)
    # the names of clips repeat in every folder: the last three parts tell them apart
    key = "/".join(path.absolute().parts[-3:])
    if key not in rows:
        raise RecordingError(f"{table} does not list {key}; name a clip of the data set it belongs to")
    row, copies = rows[key], small_copies(read_video(path, ReadOptions()).read_frames())
    stale, slipped = count_stale(copies), row["slip_label"] == "1"
    capture = read_video(path, ReadOptions(frame_rate=frame_rate, skip_frames=stale))
    reference = least_contact(copies[stale:])
    notes = (
        f"times are nominal; the true frame rate is unknown, roughly {FRAME_RATE_HZ:g} frames/s, not that of the file.",
        f"one label for the whole clip ({'slips' if slipped else 'does not slip'}); the beginning of slip is unknown.",
        f"no reference frame was recorded; frame {reference} shows the least contact, check it before use.",
    )
    return replace(
        capture,
        trial=trial_name(f"{path.parent.name}-{path.stem}"),
        notes=(*capture.notes, *(f"{path.name}: {note}" for note in notes)),
        labels=labels_of_margins(np.full(len(capture), np.nan)),
        reference_index=reference,
        clip=Clip(slips=slipped, grasp=path.parent.name, stale_frames=stale),
        sensor="gelsight-mini",
        object=row["object"],
    )


def list_gelsight_clips(folder: Path) -> list[Path]:
    """List the clips in the data set's `labels.csv` that exist."""
    return [folder / name for name in _read_labels(folder / LABELS_FILE) if (folder / name).is_file()]


def _read_labels(path: Path) -> dict[str, dict[str, str]]:
    table = open_text_table(path)
    if needed := {"file", "slip_label", "object"} - set(table.header):
        raise RecordingError(f"{path} is no table of GelSight clips; it lacks {', '.join(sorted(needed))}")
    rows = (dict(zip(table.header, cells, strict=True)) for _, cells in table.rows)
    return {row["file"]: row for row in rows}
