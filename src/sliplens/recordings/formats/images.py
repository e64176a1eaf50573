"""A folder of images as one trial."""

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PureWindowsPath
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
    open_text_table,
    place_on_clock,
    require_unit,
    scale_times,
    to_number,
    trial_name,
)
from sliplens.recordings.options import ReadOptions


@contextmanager
def open_encoded(data: Any, *, where: str) -> Iterator[Image.Image]:
    """Open a PNG or JPEG in memory, recognised by its bytes; damage of its header or pixels is a `RecordingError`."""
    damage = telling_damage(f"{where} cannot be read as PNG or JPEG", "copy or record it again", kind=RecordingError)
    with damage, open_image(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
        if image.mode not in {"RGB", "L"}:
            raise RecordingError(f"{where} has pixels of mode {image.mode}; record it as 8-bit RGB or grey")
        require_eight_bits(image, where=where)
        yield image


def decode_image(data: Any, *, where: str) -> Frame:
    """Decode a PNG or JPEG in memory, upright; grey is repeated in all three channels."""
    with open_encoded(data, where=where) as image:
        return _rgb_pixels(image)


def _rgb_pixels(image: Image.Image) -> Frame:
    pixels = upright_pixels(image)
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)


@contextmanager
def _open_file(path: Path) -> Iterator[Image.Image]:
    require_image(path)
    with telling_damage(f"{path} cannot be read as an image", "copy or export it again"), open_image(path) as image:
        yield image


def frame_size(path: Path) -> tuple[int, int]:
    """Read height and width of an image, in pixels, from its header."""
    with _open_file(path) as image:
        pages = getattr(image, "n_frames", 1)
        if pages > 1:
            raise ImageError(f"{path} holds {pages} images; save one image a file")
        return upright_size(image)


def read_frame(path: Path, *, size: tuple[int, int]) -> Frame:
    """Read an image as a frame."""
    with _open_file(path) as image:
        if image.mode == "L" and upright_size(image) == size:
            return _rgb_pixels(image)
    return read_image(path, size=size)


def common_size(paths: tuple[Path, ...]) -> tuple[int, int]:
    """Return the height and width that all images share."""
    first = frame_size(paths[0])
    for path in paths[1:]:
        if (size := frame_size(path)) != first:
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
        numbers = [re.findall(r"\d+(?:\.\d+)?", path.stem) for path in paths]
        if [] in numbers:
            path = paths[numbers.index([])]
            raise RecordingError(f"{path} has no number in its name; give its time in a table (--times) instead")
        time = np.array([float(each[-1]) for each in numbers]) * UNITS["time"][unit][0]
        notes.append(f"{folder.name}: the last number in a file's name was declared to be its time in {unit}.")
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
        read_frames=lambda: (read_frame(path, size=size) for path in paths),
        forces=samples,
        notes=(*notes, *more),
    )
