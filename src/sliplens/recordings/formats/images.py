"""Images in files: a folder as one trial, a table of stills under known forces, and the lists of the thesis."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path, PureWindowsPath

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.images import image_size, list_images, natural_key, read_image
from sliplens.recordings.capture import Capture, Forces
from sliplens.recordings.formats import tables
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.trial import ContactState, labels_of_margins, require_possible


def common_size(paths: tuple[Path, ...]) -> tuple[int, int]:
    """Return the height and width that all images share."""
    first = image_size(paths[0])
    for path in paths[1:]:
        if (size := image_size(path)) != first:
            sizes = f"{size[1]} x {size[0]} pixels but {paths[0].name} is {first[1]} x {first[0]}"
            raise RecordingError(f"{path} is {sizes}; record all frames with the same camera settings")
    return first


_NAME_COLUMNS = ("file", "filename", "file_name", "image", "image_name", "frame", "path", "name")


def find_name_column(table: tables.TextTable) -> str:
    """Find the column that holds names of images by its name."""
    if names := [name for name in table.header if name.lower().replace(" ", "_") in _NAME_COLUMNS]:
        return names[0]
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
        stamps[name] = tables.to_number(cells[time_at], table=table, line=line, column=time_column), line
    rows = len(stamps)
    # "frame_1.5" has no ending: a full name is looked up before one without it
    for name in list(stamps):
        stamps.setdefault(Path(name).stem, stamps[name])
    if absent := [image.name for image in images if not {image.name, image.stem} & stamps.keys()]:
        raise RecordingError(f"{path} has no time for {absent[0]}; add a row for every image of the folder")
    timed = sorted((*(stamps.get(image.name) or stamps[image.stem]), image) for image in images)
    stamp, lines, ordered = zip(*timed, strict=True)
    time_s, unit = tables.scale_times(np.array(stamp), lines, table=table, column=time_column)
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


_is_file = os.path.isfile  # unlike that of a path, False for a line that is too long for a name
_LEAST_FORCE_N = 1e-9  #: Forces below it are none: the sensor is untouched.
_LISTS = ("_images_L.txt", "_images_Lref.txt", "_gamma.csv")  # of the thesis: frames, reference frames, margins
_MARGIN = "safety_margin"


def find_states(path: Path) -> Path | None:
    """Find the table of stills that a path is, or the only one in a folder: a column of files, labels beside it.

    Its first row names an image that exists; a number of a frame is no file. Lists of the thesis are known by name.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    if states := [file for file in files if file.name.endswith(_LISTS[0])]:
        return states[0] if len(states) == 1 else None
    for file in files:
        with suppress(RecordingError, OSError, StopIteration):
            if file.suffix.lower() in tables.TEXT_TABLES and file.is_file():
                table = tables.open_text_table(file)
                if _MARGIN not in table.header:
                    tables.choose_force_columns(table, ReadOptions())
                _, cells = next(table.rows)
                listed = cells[table.header.index(find_name_column(table))]
                find_image(listed, str(file), folder=file.parent, root=file.parent)
                states.append(file)
    return states[0] if len(states) == 1 else None


def _join_lists(path: Path) -> tables.TextTable:
    """Join the three lists of a set of the thesis, as its programs read them (`get_data` in polycam-regression)."""
    files = [path.with_name(path.name.removesuffix(_LISTS[0]) + ending) for ending in _LISTS]
    images, references, margins = ([text.strip() for _, text in tables.text_lines(file)] for file in files)
    if len(margins) == len(images) + 1:
        del margins[0]  # a header
    if not len(images) == len(references) == len(margins):
        counts = f"{len(references)} references and {files[2].name} {len(margins)} margins"
        raise RecordingError(f"{path} has {len(images)} frames, {files[1].name} {counts}; give as many")
    rows = enumerate(map(list, zip(images, references, margins, strict=True)), start=1)
    return tables.TextTable(path=path, header=("file", "reference", _MARGIN), rows=rows, row="entry")


def read_stills(path: Path, options: ReadOptions) -> list[Capture]:
    """Open the images that a table lists, in its order, each with its forces or its safety margin.

    Stills count as one a second unless a rate is declared. The forces of columns such as `shear_x_n`, `shear_y_n`,
    `normal_n` become x, y and z, those of `fn`, `ft` become z and x; margins then need `LabelSettings.mu`, and the
    first image without any force shows the untouched sensor. A column `safety_margin` has fractions, or percents where
    one is larger than 2. Each image in a column `reference` makes a trial of the frames beside it.
    """
    states = find_states(path) or path
    if states.is_dir():
        raise RecordingError(f"{path} has no table of stills, or more than one; name the table itself")
    lists = states.name.endswith(_LISTS[0])
    table = _join_lists(states) if lists else tables.open_text_table(states)
    rows, rate = list(table.rows), options.frame_rate or 1.0
    table, name_column = replace(table, rows=iter(rows)), find_name_column(table)
    pace = f"{rate:g}" if rate != 1 else "one"
    notes: tuple[str, ...] = (f"{states.name}: stills have no times; they count as {pace} a second.",)
    if _MARGIN in table.header:
        values, lines, more = tables.read_numbers(table, (_MARGIN,))
        # no margin as a fraction comes near 2, percents all do
        percent = bool((values > 2).any())
        margin, force_n = values[:, 0] / (100 if percent else 1), None
        if np.isnan(margin).all():
            raise RecordingError(f"{states} holds no safety margin; give one a line")
        require_possible(margin, name="safety_margin", where=states.name)
        notes += (f"{states.name}: margins are taken as {'percent' if percent else 'fractions'}, by their size.", *more)
    else:
        names, how = tables.choose_force_columns(table, options)
        numbers, lines, more = tables.read_numbers(table, names)
        force_n, (axes, unit) = tables.scale_forces(numbers, lines, names, options, table=table)
        if (force_n[:, 2] < 0).any():
            where, least = table.place(lines[int(np.argmax(force_n[:, 2] < 0))]), force_n[:, 2].min()
            raise RecordingError(f"{where}: the normal force is {least:.4g} N; give it positive where it presses")
        margin = np.full(len(rows), np.nan)
        columns = f"{', '.join(map(repr, names))} as {axes} ({how}), {unit}."
        notes = (f"{states.name}: forces are those of {columns}", f"{notes[0]} Margins need a friction (--mu).", *more)
    find = partial(find_image, folder=states.parent, root=options.image_root or states.parent)
    trials: dict[Path | None, dict[Path, int]] = {}
    for number, (line, cells) in enumerate(rows):
        row, where = dict(zip(table.header, cells, strict=True)), table.place(line)
        reference = find(row["reference"], where) if "reference" in row else None
        places, image = trials.setdefault(reference, {}), find(row[name_column], where)
        if image in places:
            raise RecordingError(f"{where} names {row[name_column]!r} again, as line {lines[places[image]]}; drop one")
        places[image] = number
    base = tables.trial_name(states.name.removesuffix(_LISTS[0]) if lists else states.resolve().parent.name)
    captures = []
    for number, (reference, places) in enumerate(trials.items(), start=1):
        # shuffled frames of a list come in the natural order of their names
        images = tuple(sorted(places, key=lambda image: natural_key(str(image))) if lists else places)
        at = [places[image] for image in images]
        size = common_size(images if reference is None else (reference, *images))
        time_s, labels = tables.evenly_spaced(len(images), frame_rate=rate), labels_of_margins(margin[at])
        forces, untouched = None, None
        if force_n is not None:
            forces = Forces(time_s=time_s, force_n=force_n[at], source=str(states))
            touched = np.abs(forces.force_n).max(axis=1) >= _LEAST_FORCE_N
            untouched = None if touched.all() else int(np.argmin(touched))
            labels = replace(
                labels,
                normal_force_n=forces.force_n[:, 2],
                tangential_force_n=np.hypot(forces.force_n[:, 0], forces.force_n[:, 1]),
                contact_state=tuple(ContactState.UNKNOWN if each else ContactState.NO_CONTACT for each in touched),
            )
        captures.append(
            Capture(
                trial=base if len(trials) == 1 else f"{base}-{number:0{len(str(len(trials)))}d}",
                source=str(states),
                frame_time_s=time_s,
                frame_size=size,
                read_frames=partial(map, partial(read_image, size=size), images),
                forces=forces,
                notes=notes,
                labels=labels,
                reference=None if reference is None else read_image(reference, size=size),
                reference_index=untouched,
                files=tuple(image.name for image in images),
            )
        )
    return captures
