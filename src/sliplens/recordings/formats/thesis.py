"""The lists of the thesis: paths of frames, paths of their reference frames, and their safety margins."""

import os
import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path, PureWindowsPath

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError
from sliplens.images import natural_key
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.formats.images import common_size, read_frame
from sliplens.recordings.formats.tables import evenly_spaced, guessed_encodings, text_lines, trial_name
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.trial import labels_of_margins, require_possible

FRAMES, REFERENCES, MARGINS = "_images_L.txt", "_images_Lref.txt", "_gamma.csv"
"""Endings of the names of the three lists."""
_FRAME_RATE_HZ = 30.0


def is_thesis_list(path: Path) -> bool:
    """Return True for a path named like a list of the thesis, or a folder that holds one."""
    return path.name.endswith(FRAMES) or (path.is_dir() and next(path.glob(f"*{FRAMES}"), None) is not None)


def read_thesis(path: Path, options: ReadOptions) -> list[Capture]:
    """Read the lists of a set: `SET_images_L.txt`, `SET_images_Lref.txt` and `SET_gamma.csv`, in one folder.

    The thesis's programs (`get_data` in github.com/MaxPolak97/polycam-regression) read a path a line, and a margin a
    line as a fraction, without a header. The lists themselves are not public, so more is accepted: a header, several
    columns (that called gamma, else the last), percent, backslashes, empty lines and comments.
    """
    frame_rate = options.frame_rate
    rate = _FRAME_RATE_HZ if frame_rate is None else frame_rate
    how = "assumed" if frame_rate is None else "declared"
    times = f"The lists give no times: {rate:g} frames/s were {how}; how fast the margin falls rests on it."
    frames_list = _find_frames_list(path)
    stem = frames_list.name.removesuffix(FRAMES)
    lists = [frames_list, *(frames_list.with_name(stem + ending) for ending in (REFERENCES, MARGINS))]
    frames, references = (read_lines(file) for file in lists[:2])
    margins, notes = _read_margins(lists[2], unit=options.margin_unit)
    if not len(frames) == len(references) == len(margins):
        raise RecordingError(
            f"{frames_list} has {len(frames)} frames, {lists[1].name} {len(references)} references and {lists[2].name} "
            f"{len(margins)} margins; give one of each a line"
        )
    root = options.image_root or frames_list.parent
    listed: dict[Path, str] = {}

    def find(text: str, where: str) -> Path:
        path = _find_image(text, where=where, folder=frames_list.parent, root=root)
        before = listed.setdefault(path, text)
        if before != text:
            raise RecordingError(
                f"{where}: {text!r} and {before!r} both lead to {path}; give with --image-root a folder in which "
                "they differ"
            )
        return path

    trials: dict[Path, list[tuple[Path, float]]] = {}
    for (number, frame), (at, reference), margin in zip(frames, references, margins.tolist(), strict=True):
        untouched = find(reference, f"{lists[1]}, line {at}")
        image = find(frame, f"{frames_list}, line {number}")
        trials.setdefault(untouched, []).append((image, margin))
    base, digits = trial_name(stem or "thesis"), len(str(len(trials)))
    notes = (*guessed_encodings(*lists), *notes, times)
    captures = []
    for number, (reference, rows) in enumerate(trials.items(), start=1):
        name = base if len(trials) == 1 else f"{base}-{number:0{digits}d}"
        ordered = sorted(rows, key=lambda row: natural_key(str(row[0])))
        moved = () if ordered == rows else (f"{name}: frames were put into the natural order of their names.",)
        paths = tuple(path for path, _ in ordered)
        if len(set(paths)) < len(paths):
            twice = next(path for path in paths if paths.count(path) > 1)
            raise RecordingError(f"{frames_list} lists {twice} twice with one reference; list every frame once")
        size = common_size((reference, *paths))
        captures.append(
            Capture(
                trial=name,
                source=f"{name} of {frames_list}",
                frame_time_s=evenly_spaced(len(paths), frame_rate=rate),
                frame_size=size,
                read_frames=partial(_read_frames, paths, size),
                notes=(*notes, *moved),
                labels=labels_of_margins(np.array([margin for _, margin in ordered])),
                reference=read_frame(reference, size=size),
            )
        )
    return captures


def _read_frames(paths: Sequence[Path], size: tuple[int, int]) -> Iterator[Frame]:
    return (read_frame(path, size=size) for path in paths)


def _find_frames_list(path: Path) -> Path:
    if path.is_dir():
        lists = sorted(path.glob(f"*{FRAMES}"))
        if len(lists) != 1:
            names = ", ".join(file.name for file in lists) or "none"
            raise RecordingError(f"{path} must hold one list *{FRAMES}, it holds {names}; name the list itself")
        return lists[0]
    if not path.name.endswith(FRAMES):
        raise RecordingError(f"{path} is not a list of the thesis; name the file that ends in {FRAMES}")
    return path


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Read the lines of a list that are neither empty nor comments, with their numbers from 1."""
    if not path.exists():
        raise RecordingError(f"{path} does not exist; the lists of a set must lie in one folder")
    lines = [(number, line.strip()) for number, line in text_lines(path)]
    lines = [(number, line) for number, line in lines if not line.startswith("#")]
    if not lines:
        raise RecordingError(f"{path} is empty; list one entry a line")
    return lines


def _find_image(listed: str, *, where: str, folder: Path, root: Path) -> Path:
    """Find the file of a list: at its path, else under the root by the last parts of its path, the most first.

    Relative paths start at the folder and may not lead out of the root.
    """
    foreign = PureWindowsPath(listed.strip("\"'"))  # reads slashes and backslashes
    native = Path(listed.strip("\"'"))
    if native.is_absolute() and _is_file(native):
        return native
    parts = foreign.parts
    if foreign.anchor:
        parts = parts[1:]
    else:
        inside = Path(os.path.normpath(folder.absolute().joinpath(*parts)))
        if inside.is_relative_to(os.path.normpath(root.absolute())):
            if _is_file(inside):
                return inside
        elif ".." in parts:
            raise RecordingError(f"{where}: {listed!r} leads out of {root}; give the folder of all with --image-root")
    parts = tuple(part for part in parts if part != "..")
    moved = (root.joinpath(*parts[dropped:]) for dropped in range(len(parts)))
    if image := next(filter(_is_file, moved), None):
        return image
    raise RecordingError(
        f"{where}: {listed[:200]!r} is not there, nor under {root}; give the folder of the images with --image-root"
    )


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a line that is too long for a name
        return False


def _read_margins(path: Path, *, unit: str | None) -> tuple[Float[np.ndarray, " frames"], tuple[str, ...]]:
    if unit not in {None, "fraction", "percent"}:
        raise RecordingError(f"{unit!r} is no unit of a safety margin; use fraction or percent")
    lines = read_lines(path)
    rows = [re.split(r"[;,\t]", line) for _, line in lines]
    column = -1
    if not all(map(_is_margin, rows[0])):  # a header
        heads = [head.strip().strip('"').lower() for head in rows[0]]
        column = next((at for at, head in enumerate(heads) if "gamma" in head), -1)
        lines, rows = lines[1:], rows[1:]
    if not rows:
        raise RecordingError(f"{path} has a header but no margin; give one a line")
    values, percent = [], unit == "percent"
    for (number, line), row in zip(lines, rows, strict=True):
        text = row[column].strip().strip('"')
        if not _is_margin(text):
            raise RecordingError(f"{path}, line {number} is {line[:40]!r}, not a safety margin; mend the line")
        percent |= text.endswith("%")
        values.append(float(text.removesuffix("%") or "nan"))
    margins = np.array(values)
    if np.isnan(margins).all():
        raise RecordingError(f"{path} holds no safety margin; give one a line")
    how = "declared" if unit is not None else "by their size"
    if unit is None:
        percent |= bool(np.nanmax(margins) > 2)  # no margin of a fraction comes near it, percents all do
    margins = margins / 100 if percent else margins
    require_possible(margins, name="safety_margin", where=path.name)
    return margins, (f"{path.name}: safety margins were read as {'percent' if percent else 'fractions'} ({how}).",)


def _is_margin(text: str) -> bool:
    try:
        float(text.strip().strip('"').removesuffix("%") or "nan")
    except ValueError:
        return False
    return True
