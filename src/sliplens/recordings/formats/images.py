"""A folder of images as one trial."""

import re
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.images import image_size, list_images, read_image
from sliplens.recordings.capture import Capture
from sliplens.recordings.formats.tables import (
    UNITS,
    evenly_spaced,
    guess_time_column,
    open_text_table,
    place_on_clock,
    require_unit,
    scale_times,
    to_number,
    trial_name,
)
from sliplens.recordings.options import ReadOptions


def common_size(paths: tuple[Path, ...]) -> tuple[int, int]:
    """Return the height and width that all images share."""
    first = image_size(paths[0])
    for path in paths[1:]:
        if (size := image_size(path)) != first:
            sizes = f"{path} is {size[1]} x {size[0]} pixels but {paths[0].name} is {first[1]} x {first[0]}"
            raise RecordingError(f"{sizes}; record all frames of a trial with the same camera settings")
    return first


_NAME_COLUMNS = ("file", "filename", "file_name", "image", "image_name", "frame", "path", "name")


def guess_name_column(header: Sequence[str]) -> str | None:
    """Find the column that holds names of images by its name; None if there is none."""
    return next((name for name in header if name.lower().replace(" ", "_") in _NAME_COLUMNS), None)


def read_frame_times(
    path: Path, images: Sequence[Path]
) -> tuple[tuple[Path, ...], Float[np.ndarray, " frames"], list[str]]:
    """Sort images by a table with names of files and times; return them, their times, and notes."""
    table = open_text_table(path)
    name_column = guess_name_column(table.header)
    if name_column is None:
        columns = ", ".join(map(repr, table.header))
        raise RecordingError(f"{path} has no column with the names of images among {columns}; call it file")
    time_column = guess_time_column(table.header, path=path)
    name_at, time_at = table.header.index(name_column), table.header.index(time_column)
    stamps: dict[str, tuple[float, int]] = {}
    for line, cells in table.rows:
        name = PureWindowsPath(cells[name_at]).name  # divides at slashes and backslashes
        if name in stamps:
            raise RecordingError(f"{path}, line {line} names {name!r} again; give each image one time")
        stamps[name] = to_number(cells[time_at], path=path, line=line, column=time_column), line
    rows = len(stamps)
    # "frame_1.5" has no ending: a full name is looked up before one without it
    for name in list(stamps):
        stamps.setdefault(Path(name).stem, stamps[name])
    if absent := [image.name for image in images if not {image.name, image.stem} & stamps.keys()]:
        raise RecordingError(f"{path} has no time for {absent[0]}; add a row for every image of the folder")
    timed = sorted((*(stamps.get(image.name) or stamps[image.stem]), image) for image in images)
    stamp, lines, ordered = zip(*timed, strict=True)
    time_s, unit = scale_times(np.array(stamp), lines, path=path, column=time_column)
    times = f"{path.name}: times of images are those of column {time_column!r}, in {unit}"
    notes = [f"{times}, their names those of {name_column!r}."]
    if rows > len(images):
        notes.append(f"{path.name}: {rows - len(images)} of {rows} rows name no image of the folder.")
    return ordered, time_s, notes


def read_image_folder(folder: Path, options: ReadOptions) -> Capture:
    """Open a folder of images, in natural order (2 before 10), and a table of forces recorded beside it."""
    times, frame_rate, name_unit = options.times, options.frame_rate, options.name_unit
    if sum(option is not None for option in (times, frame_rate, name_unit)) > 1:
        cure = "give one of --times, --frame-rate, --name-unit"
        raise RecordingError(f"the images of {folder} have more than one source of times; {cure}")
    paths = tuple(list_images(folder))
    notes, time = [], np.full(len(paths), np.nan)
    if times is not None:
        paths, time, notes = read_frame_times(times, paths)
    elif frame_rate is not None:
        time = evenly_spaced(len(paths), frame_rate=frame_rate)
        notes.append(f"{folder.name}: frames were declared to be taken {frame_rate:g} times a second.")
    elif name_unit is not None:
        unit = require_unit(name_unit, quantity="time")
        numbers = [re.findall(r"\d+(?:\.\d+)?", path.stem) for path in paths]
        if [] in numbers:
            path = paths[numbers.index([])]
            raise RecordingError(f"{path} has no number in its name; give its time in a table (--times) instead")
        time = np.array([float(each[-1]) for each in numbers]) * UNITS["time"][unit][0]
        notes.append(f"{folder.name}: the last number in a file's name was declared to be its time in {unit}.")
    elif options.forces is not None:
        raise RecordingError(f"the images of {folder} have no times; give one of --times, --frame-rate, --name-unit")
    lossy = sum(path.suffix.lower() in {".jpg", ".jpeg"} for path in paths)
    if lossy:
        jpeg = f"{lossy} of {len(paths)} frames are JPEG, which moves markers; record PNG or TIFF where you can."
        notes.append(f"{folder.name}: {jpeg}")
    size = common_size(paths)
    time, samples, more = place_on_clock(time, options, source=folder.name)
    return Capture(
        trial=trial_name(folder.resolve().name),
        source=str(folder),
        frame_time_s=time,
        frame_size=size,
        read_frames=lambda: (read_image(path, size=size) for path in paths),
        forces=samples,
        notes=(*notes, *more),
        files=tuple(path.name for path in paths),
    )
