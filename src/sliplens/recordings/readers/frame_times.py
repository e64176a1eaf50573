"""Times of image files from a table."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.recordings.readers.columns import TIME_UNITS, guess_time_column, guess_time_unit, unit_of
from sliplens.recordings.readers.text_table import TextTable, open_table, require_rising, to_number

_NAME_COLUMNS = ("file", "filename", "file_name", "image", "image_name", "frame", "path", "name")


@dataclass(frozen=True, kw_only=True)
class FrameTimes:
    """Images in the order they were taken."""

    paths: tuple[Path, ...]
    time_s: Float[np.ndarray, " frames"]
    notes: tuple[str, ...]


def read_frame_times(table: Path, images: Sequence[Path]) -> FrameTimes:
    """Find the time of every image in a table with a column of file names and one of times.

    Parameters
    ----------
    table
        Text table with a header; folders before a file's name, and its ending, may be left out or differ.
    images
        Files of one folder.

    Raises
    ------
    RecordingError
        If a column or an image is missing in the table, or two images have one time.
    """
    text = open_table(table)
    name_column, time_column = _name_column(text), guess_time_column(text)
    stamps, listed = _stamps(text, name_column, time_column)
    found = []
    for image in images:
        row = stamps.get(image.name, stamps.get(image.stem))
        if row is None:
            raise RecordingError(f"{table} has no time for {image.name}; add a row for every image of the folder")
        found.append((row[0], row[1], image))
    found.sort(key=lambda row: row[0])
    time = np.array([row[0] for row in found])
    require_rising(time, [row[1] for row in found], path=table, column=time_column)
    unit = unit_of(time_column, quantity="time", path=str(table))
    how = "by its name"
    if unit is None:
        unit, how = guess_time_unit(time), "guessed from its steps"
    notes = [
        f"{table.name}: times of images are those of column {time_column!r}, in {unit} ({how}), "
        f"their names those of {name_column!r}."
    ]
    if listed > len(images):
        notes.append(f"{table.name}: {listed - len(images)} of {listed} rows name no image of the folder.")
    return FrameTimes(paths=tuple(row[2] for row in found), time_s=time * TIME_UNITS[unit], notes=tuple(notes))


def _name_column(text: TextTable) -> str:
    found = next((name for name in text.header if name.lower().replace(" ", "_") in _NAME_COLUMNS), None)
    if found is None:
        raise RecordingError(
            f"{text.path} has no column with the names of images among {', '.join(map(repr, text.header))}; "
            "call it file"
        )
    return found


def _stamps(text: TextTable, name_column: str, time_column: str) -> tuple[dict[str, tuple[float, int]], int]:
    """Time and line of every name, with and without its ending, and how many rows there are."""
    name_at, time_at = text.header.index(name_column), text.header.index(time_column)
    stamps: dict[str, tuple[float, int]] = {}
    count = 0
    for line, fields in text.rows():
        count += 1
        name = fields[name_at].replace("\\", "/").rsplit("/", maxsplit=1)[-1]
        where = f"{text.path}, line {line}, {time_column!r}"
        value = to_number(fields[time_at].replace(",", "."), shown=fields[time_at], where=where)
        if name in stamps:
            raise RecordingError(f"{text.path}, line {line} names {name!r} again; give each image one time")
        stamps[name] = value, line
    # "frame_1.5" has no ending: a full name is looked for before one without it
    for name in list(stamps):
        stamps.setdefault(Path(name).stem, stamps[name])
    return stamps, count
