"""The published GelSight Mini clips of grasps that slip or hold, with their pitfalls handled."""

import csv
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
            if (folder / LABELS_FILE).is_file() and {"file", "slip_label"} <= set(
                open_text_table(folder / LABELS_FILE).header
            ):
                return True
    return False


def read_gelsight(path: Path, options: ReadOptions) -> list[Capture]:
    """Read clips: all in the data set's folder, those in the folder of a grasp, or a single one."""
    if (path / LABELS_FILE).is_file():
        clips = list_gelsight_clips(path)
    else:
        clips = [path] if path.is_file() else sorted(path.glob("*.avi"))
    if not clips:
        raise RecordingError(f"{path} holds no clip; name a clip, the folder of a grasp, or that of {LABELS_FILE}")
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
    row, whole = rows[key], read_video(path, ReadOptions())
    if len(whole) != int(row["n_frames"]):
        raise RecordingError(f"{path} has {len(whole)} frames but {table.name} says {row['n_frames']}; copy it again")
    copies = small_copies(whole.read_frames())
    stale = count_stale(copies)
    slipped = row["slip_label"].strip() == "1"
    capture = read_video(path, ReadOptions(frame_rate=frame_rate, skip_frames=stale))
    reference = least_contact(copies[stale:])
    label = "slips" if slipped else "does not slip"
    notes = (
        f"{path.name}: times are nominal; the true frame rate is unknown, roughly {FRAME_RATE_HZ:g} frames/s, and not "
        "the 25 of the file.",
        f"{path.name}: one label for the whole clip ({label}); it is not known when slip begins.",
        f"{path.name}: no reference frame was recorded; frame {reference} of the rest shows the least contact, "
        "check it before use.",
    )
    return replace(
        capture,
        trial=trial_name(f"{path.parent.name}-{path.stem}"),
        notes=capture.notes + notes,
        labels=labels_of_margins(np.full(len(capture), np.nan)),
        reference_index=reference,
        clip=Clip(slips=slipped, grasp=path.parent.name, stale_frames=stale),
        sensor="gelsight-mini",
        object=row["object"],
    )


def list_gelsight_clips(folder: Path) -> list[Path]:
    """List the clips in the data set's `labels.csv` that exist."""
    clips = [folder / name for name in _read_labels(folder / LABELS_FILE) if (folder / name).is_file()]
    if not clips:
        raise RecordingError(f"{folder} holds none of the clips that its {LABELS_FILE} lists; copy them beside it")
    return clips


def _read_labels(path: Path) -> dict[str, dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path}, the labels of the clips, cannot be read ({error}); copy it again") from None
    needed = {"file", "slip_label", "object", "n_frames"}
    if not rows or needed - set(rows[0]):
        raise RecordingError(f"{path} is no table of GelSight clips; it needs columns {', '.join(sorted(needed))}")
    return {row["file"]: row for row in rows}
