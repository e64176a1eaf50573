"""Images in files: a folder as one trial, and stills under known forces, listed in a table, a row an image."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path, PureWindowsPath

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.images import image_size, list_images, read_image
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.formats import tables
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.trial import ContactState, labels_of_margins


def common_size(paths: tuple[Path, ...]) -> tuple[int, int]:
    """Return the height and width that all images share."""
    first = image_size(paths[0])
    for path in paths[1:]:
        if (size := image_size(path)) != first:
            sizes = f"{path} is {size[1]} x {size[0]} pixels but {paths[0].name} is {first[1]} x {first[0]}"
            raise RecordingError(f"{sizes}; record all frames of a trial with the same camera settings")
    return first


_NAME_COLUMNS = ("file", "filename", "file_name", "image", "image_name", "frame", "path", "name")


def find_name_column(table: tables.TextTable) -> str:
    """Find the column that holds names of images by its name."""
    for name in table.header:
        if name.lower().replace(" ", "_") in _NAME_COLUMNS:
            return name
    columns = ", ".join(map(repr, table.header))
    raise RecordingError(f"{table.path} has no column with the names of images among {columns}; call it file")


def read_frame_times(
    path: Path, images: Sequence[Path]
) -> tuple[tuple[Path, ...], Float[np.ndarray, " frames"], list[str]]:
    """Sort images by a table with names of files and times; return them, their times, and notes."""
    table = tables.open_text_table(path)
    name_column = find_name_column(table)
    time_column = tables.guess_time_column(table.header, path=path)
    name_at, time_at = table.header.index(name_column), table.header.index(time_column)
    stamps: dict[str, tuple[float, int]] = {}
    for line, cells in table.rows:
        name = PureWindowsPath(cells[name_at]).name  # divides at slashes and backslashes
        if name in stamps:
            raise RecordingError(f"{path}, line {line} names {name!r} again; give each image one time")
        stamps[name] = tables.to_number(cells[time_at], path=path, line=line, column=time_column), line
    rows = len(stamps)
    # "frame_1.5" has no ending: a full name is looked up before one without it
    for name in list(stamps):
        stamps.setdefault(Path(name).stem, stamps[name])
    if absent := [image.name for image in images if not {image.name, image.stem} & stamps.keys()]:
        raise RecordingError(f"{path} has no time for {absent[0]}; add a row for every image of the folder")
    timed = sorted((*(stamps.get(image.name) or stamps[image.stem]), image) for image in images)
    stamp, lines, ordered = zip(*timed, strict=True)
    time_s, unit = tables.scale_times(np.array(stamp), lines, path=path, column=time_column)
    times = f"{path.name}: times of images are those of column {time_column!r}, in {unit}"
    notes = [f"{times}, their names those of {name_column!r}."]
    if rows > len(images):
        notes.append(f"{path.name}: {rows - len(images)} of {rows} rows name no image of the folder.")
    return ordered, time_s, notes


def read_image_folder(folder: Path, options: ReadOptions) -> Capture:
    """Open a folder of images, in natural order (2 before 10), and a table of forces recorded beside it."""
    times, frame_rate = options.times, options.frame_rate
    if times is not None and frame_rate is not None:
        raise RecordingError(f"the images of {folder} have two sources of times; give --times or --frame-rate")
    paths = tuple(list_images(folder))
    notes, time = [], np.full(len(paths), np.nan)
    if times is not None:
        paths, time, notes = read_frame_times(times, paths)
    elif frame_rate is not None:
        time = tables.evenly_spaced(len(paths), frame_rate=frame_rate)
        notes.append(f"{folder.name}: frames were declared to be taken {frame_rate:g} times a second.")
    elif options.forces is not None:
        raise RecordingError(f"the images of {folder} have no times; give --times or --frame-rate")
    lossy = sum(path.suffix.lower() in {".jpg", ".jpeg"} for path in paths)
    if lossy:
        jpeg = f"{lossy} of {len(paths)} frames are JPEG, which moves markers; record PNG or TIFF where you can."
        notes.append(f"{folder.name}: {jpeg}")
    size = common_size(paths)
    time, samples, more = tables.place_on_clock(time, options, source=folder.name)
    return Capture(
        trial=tables.trial_name(folder.resolve().name),
        source=str(folder),
        frame_time_s=time,
        frame_size=size,
        read_frames=lambda: (read_image(path, size=size) for path in paths),
        forces=samples,
        notes=(*notes, *more),
        files=tuple(path.name for path in paths),
    )


def find_image(listed: str, where: str, *, folder: Path, root: Path) -> Path:
    """Find the file of a list at its path, which must stay in the root, or under the root by its last parts."""
    if Path(listed).is_absolute() and _is_file(Path(listed)):
        return Path(listed)
    foreign = PureWindowsPath(listed)  # reads slashes and backslashes
    parts = foreign.parts[1:] if foreign.anchor else foreign.parts
    inside = Path(os.path.normpath(folder.absolute().joinpath(*parts)))
    within = inside.is_relative_to(os.path.normpath(root.absolute()))
    if ".." in parts and not within:
        raise RecordingError(f"{where}: {listed!r} leads out of {root}; give the folder of all with --image-root")
    if within and _is_file(inside):
        return inside
    parts = tuple(part for part in parts if part != "..")
    moved = (root.joinpath(*parts[dropped:]) for dropped in range(len(parts)))
    if image := next(filter(_is_file, moved), None):
        return image
    raise RecordingError(f"{where}: {listed[:200]!r} is not there, nor under {root}; name its folder with --image-root")


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a line that is too long for a name
        return False


_SUFFIXES = frozenset({".csv", ".tsv", ".txt"})
_LEAST_FORCE_N = 1e-9  #: Forces below it are none: the sensor is untouched.


def find_states(path: Path) -> Path | None:
    """Find the table of stills that a path is, or the only one in a folder: a column of files, forces beside it.

    Its first row names an image that exists; a number of a frame is no file.
    """
    states = []
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        with suppress(RecordingError, OSError, StopIteration):
            if file.suffix.lower() in _SUFFIXES and file.is_file():
                table = tables.open_text_table(file)
                tables.choose_force_columns(table, ReadOptions())
                _, cells = next(table.rows)
                listed = cells[table.header.index(find_name_column(table))]
                find_image(listed, str(file), folder=file.parent, root=file.parent)
                states.append(file)
    return states[0] if len(states) == 1 else None


def read_stills(path: Path, options: ReadOptions) -> Capture:
    """Open the images that a table lists, in its order, each with its forces.

    Stills have no times: they count as one a second. The margin is unknown unless `LabelSettings.mu` gives the
    friction. The forces of columns such as `shear_x_n`, `shear_y_n`, `normal_n` become x, y and z, those of `fn`, `ft`
    become z and x; the first image without any force shows the untouched sensor.
    """
    states = path if path.is_file() else find_states(path)
    if states is None:
        raise RecordingError(f"{path} has no table of stills, or more than one; name the table itself")
    table = tables.open_text_table(states)
    name_column = find_name_column(table)
    names, how = tables.choose_force_columns(table, options)
    rows = list(table.rows)
    numbers, lines, notes = tables.read_numbers(replace(table, rows=iter(rows)), names)
    force_n, (axes, unit) = tables.scale_forces(numbers, lines, names, options, path=states)
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
        trial=tables.trial_name(states.resolve().parent.name),
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
