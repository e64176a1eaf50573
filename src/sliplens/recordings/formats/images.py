"""A folder of images as one trial."""

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from sliplens.errors import ImageError, RecordingError
from sliplens.images import (
    list_images,
    open_image,
    read_image,
    require_eight_bits,
    require_image,
    telling_damage,
    upright_pixels,
    upright_size,
)
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.formats.tables import (
    UNITS,
    evenly_spaced,
    guess_time_column,
    guess_time_unit,
    open_text_table,
    place_on_clock,
    require_rising,
    require_unit,
    to_number,
    trial_name,
    unit_of,
)
from sliplens.recordings.options import ReadOptions


@contextmanager
def open_encoded(data: Any, *, where: str) -> Iterator[Image.Image]:
    """Open a PNG or JPEG in memory, recognised by its bytes, and read its header."""
    with open_image(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
        if image.mode not in {"RGB", "L"}:
            raise RecordingError(f"{where} has pixels of mode {image.mode}; record it as 8-bit RGB or grey")
        require_eight_bits(image, where=where)
        yield image


def rgb_pixels(image: Image.Image) -> Frame:
    """Return the pixels of an RGB or grey image, upright; a grey one gets three equal channels."""
    pixels = upright_pixels(image)
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)


def frame_size(path: Path) -> tuple[int, int]:
    """Read height and width of an image, in pixels, from its header."""
    require_image(path)
    with _image_errors(path), open_image(path) as image:
        pages = getattr(image, "n_frames", 1)
        if pages > 1:
            raise ImageError(f"{path} holds {pages} images; save one image a file")
        return upright_size(image)


def read_frame(path: Path, *, size: tuple[int, int]) -> Frame:
    """Read an image as a frame."""
    require_image(path)
    with _image_errors(path), open_image(path) as image:
        if image.mode != "L" or upright_size(image) != size:
            return read_image(path, size=size)  # and refuse what no frame is
        return rgb_pixels(image)


def _image_errors(path: Path) -> AbstractContextManager[None]:
    return telling_damage(f"{path} cannot be read as an image", "copy or export it again")


def common_size(paths: tuple[Path, ...]) -> tuple[int, int]:
    """Return the height and width that all images share."""
    first = frame_size(paths[0])
    for path in paths[1:]:
        size = frame_size(path)
        if size != first:
            sizes = f"{path} is {size[1]} x {size[0]} pixels but {paths[0].name} is {first[1]} x {first[0]}"
            raise RecordingError(f"{sizes}; record all frames of a trial with the same camera settings")
    return first


_NAME_COLUMNS = ("file", "filename", "file_name", "image", "image_name", "frame", "path", "name")


def read_frame_times(
    table: Path, images: Sequence[Path]
) -> tuple[tuple[Path, ...], Float[np.ndarray, " frames"], list[str]]:
    """Sort images by a table with names of files and times; return them, their times, and notes."""
    text = open_text_table(table)
    name_column = next((name for name in text.header if name.lower().replace(" ", "_") in _NAME_COLUMNS), None)
    if name_column is None:
        raise RecordingError(f"{table} has no column with the names of images among {text.names}; call it file")
    time_column = guess_time_column(text)
    name_at, time_at = text.header.index(name_column), text.header.index(time_column)
    stamps: dict[str, tuple[float, int]] = {}
    for line, fields in text.rows():
        name = fields[name_at].replace("\\", "/").rsplit("/", maxsplit=1)[-1]
        if name in stamps:
            raise RecordingError(f"{table}, line {line} names {name!r} again; give each image one time")
        stamps[name] = to_number(fields[time_at], where=f"{table}, line {line}, {time_column!r}"), line
    rows = len(stamps)
    # "frame_1.5" has no ending: a full name is looked up before one without it
    for name in list(stamps):
        stamps.setdefault(Path(name).stem, stamps[name])
    taken = []
    for image in images:
        row = stamps.get(image.name, stamps.get(image.stem))
        if row is None:
            raise RecordingError(f"{table} has no time for {image.name}; add a row for every image of the folder")
        taken.append((*row, image))
    stamp, lines, ordered = zip(*sorted(taken, key=lambda row: row[0]), strict=True)
    time = np.array(stamp)
    require_rising(time, lines, path=table, column=time_column)
    unit, how = unit_of(time_column, quantity="time", path=str(table)), "by its name"
    if unit is None:
        unit, how = guess_time_unit(time), "guessed from its steps"
    notes = [
        f"{table.name}: times of images are those of column {time_column!r}, in {unit} ({how}), "
        f"their names those of {name_column!r}.",
    ]
    if rows > len(images):
        notes.append(f"{table.name}: {rows - len(images)} of {rows} rows name no image of the folder.")
    return ordered, time * UNITS["time"][unit][0], notes


def read_image_folder(folder: Path, options: ReadOptions) -> Capture:
    """Open a folder of images, in natural order (2 before 10), and a table of forces recorded beside it."""
    times, frame_rate, name_unit = options.times, options.frame_rate, options.name_unit
    count = sum(option is not None for option in (times, frame_rate, name_unit))
    if count != 1:
        what = "more than one source of times" if count else "no times"
        raise RecordingError(f"the images of {folder} have {what}; give one of --times, --frame-rate, --name-unit")
    paths = tuple(list_images(folder))
    notes = []
    if times is not None:
        paths, time, notes = read_frame_times(times, paths)
    elif frame_rate is not None:
        time = evenly_spaced(len(paths), frame_rate=frame_rate)
        notes.append(f"{folder.name}: frames were declared to be taken {frame_rate:g} times a second.")
    else:
        unit = require_unit(str(name_unit), quantity="time")
        time = _numbers_in_names(paths) * UNITS["time"][unit][0]
        notes.append(f"{folder.name}: the last number in a file's name was declared to be its time in {unit}.")
    lossy = sum(path.suffix.lower() in {".jpg", ".jpeg"} for path in paths)
    if lossy:
        jpeg = f"{folder.name}: {lossy} of {len(paths)} frames are JPEG, which moves markers a little"
        notes.append(f"{jpeg}; record PNG or TIFF where you can.")
    size = common_size(paths)
    time, samples, more = place_on_clock(time, options, source=folder.name)
    return Capture(
        trial=trial_name(folder.resolve().name),
        source=str(folder),
        frame_time_s=time,
        frame_size=size,
        read_frames=lambda: (read_frame(path, size=size) for path in paths),
        forces=samples,
        notes=(*notes, *more),
    )


def _numbers_in_names(paths: Sequence[Path]) -> Float[np.ndarray, " frames"]:
    numbers = [re.findall(r"\d+(?:\.\d+)?", path.stem) for path in paths]
    if [] in numbers:
        path = paths[numbers.index([])]
        raise RecordingError(f"{path} has no number in its name; give its time in a table (--times) instead")
    return np.array([float(each[-1]) for each in numbers])
