"""Stills under known forces: a table with a column of files, a row an image."""

from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from sliplens.errors import RecordingError
from sliplens.images import read_image
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.formats.images import common_size, guess_name_column
from sliplens.recordings.formats.tables import (
    choose_force_columns,
    open_text_table,
    read_numbers,
    scale_forces,
    trial_name,
)
from sliplens.recordings.formats.thesis import find_image
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.trial import ContactState, labels_of_margins

_SUFFIXES = frozenset({".csv", ".tsv", ".txt"})
_LEAST_FORCE_N = 1e-9  #: Forces below it are none: the sensor is untouched.


def find_states(path: Path) -> Path | None:
    """Find the table of stills that a path is, or the only one in a folder: a column of files, forces beside it.

    Its first row names an image that exists; a number of a frame is no file.
    """
    tables = []
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        with suppress(RecordingError, OSError):
            if file.suffix.lower() in _SUFFIXES and file.is_file():
                table = open_text_table(file)
                column, row = guess_name_column(table.header), next(table.rows, None)
                if column is not None and row is not None:
                    choose_force_columns(table, ReadOptions())
                    listed = row[1][table.header.index(column)]
                    find_image(listed, str(file), folder=file.parent, root=file.parent)
                    tables.append(file)
    return tables[0] if len(tables) == 1 else None


def read_stills(path: Path, options: ReadOptions) -> Capture:
    """Open the images that a table lists, in its order, each with its forces.

    Stills have no times: they count as one a second. The margin is unknown unless `LabelSettings.mu` gives the
    friction. The forces of columns such as `shear_x_n`, `shear_y_n`, `normal_n` become x, y and z, those of `fn`, `ft`
    become z and x; the first image without any force shows the untouched sensor.
    """
    states = path if path.is_file() else find_states(path)
    if states is None:
        raise RecordingError(f"{path} has no table of stills, or more than one; name the table itself")
    table = open_text_table(states)
    name_column = guess_name_column(table.header)
    if name_column is None:
        raise RecordingError(f"{states} has no column with the names of images; call it file")
    names, how = choose_force_columns(table, options)
    rows = list(table.rows)
    numbers, lines, notes = read_numbers(replace(table, rows=iter(rows)), names)
    force_n, (axes, unit) = scale_forces(numbers, lines, names, options, path=states)
    root = options.image_root or states.parent
    place, lines_of = table.header.index(name_column), dict[Path, int]()
    for line, cells in rows:
        image = find_image(cells[place], f"{states}, line {line}", folder=states.parent, root=root)
        if image in lines_of:
            again = f"{states}, line {line} names {cells[place]!r} again, as line {lines_of[image]}"
            raise RecordingError(f"{again}; drop one")
        lines_of[image] = line
    images = tuple(lines_of)
    size = common_size(images)
    time_s = np.arange(float(len(images)))
    normal_n, tangential_n = force_n[:, 2], np.hypot(force_n[:, 0], force_n[:, 1])
    if (normal_n < 0).any():
        where = f"{states}, line {lines[int(np.argmax(normal_n < 0))]}"
        raise RecordingError(f"{where}: the normal force is {normal_n.min():.4g} N; give it positive where it presses")
    untouched = np.flatnonzero(np.abs(force_n).max(axis=1) < _LEAST_FORCE_N)
    labels = labels_of_margins(np.full(len(images), np.nan))
    unknown = (ContactState.NO_CONTACT if at in untouched else ContactState.UNKNOWN for at in range(len(images)))
    return Capture(
        trial=trial_name(states.resolve().parent.name),
        source=str(states),
        frame_time_s=time_s,
        frame_size=size,
        read_frames=partial(map, partial(read_image, size=size), images),
        forces=Forces(time_s=time_s, force_n=force_n, source=str(states)),
        notes=(
            f"{states.name}: forces are those of {', '.join(map(repr, names))} as {axes} ({how}), {unit}.",
            f"{states.name}: stills have no times; they count as one a second. Margins need a friction (--mu).",
            *notes,
        ),
        labels=replace(
            labels,
            normal_force_n=normal_n,
            tangential_force_n=tangential_n,
            contact_state=tuple(unknown),
        ),
        reference_index=int(untouched[0]) if len(untouched) else None,
        files=tuple(image.name for image in images),
    )
