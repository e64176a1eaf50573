"""The lists of the thesis: paths of frames, paths of their reference frames, and their safety margins."""

from functools import partial
from pathlib import Path

import numpy as np

from sliplens.errors import RecordingError
from sliplens.images import natural_key, read_image
from sliplens.recordings.capture import Capture
from sliplens.recordings.formats.images import common_size, find_image
from sliplens.recordings.formats.tables import evenly_spaced, text_lines, trial_name
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.trial import labels_of_margins, require_possible

FRAMES, REFERENCES, MARGINS = "_images_L.txt", "_images_Lref.txt", "_gamma.csv"
_FRAME_RATE_HZ = 30.0


def is_thesis_list(path: Path) -> bool:
    """Return True for a path named like a list of the thesis, or a folder that holds one."""
    return path.name.endswith(FRAMES) or (path.is_dir() and next(path.glob(f"*{FRAMES}"), None) is not None)


def read_thesis(path: Path, options: ReadOptions) -> list[Capture]:
    """Read the lists of a set: `SET_images_L.txt`, `SET_images_Lref.txt` and `SET_gamma.csv`, in one folder.

    As the thesis's programs do (`get_data` in github.com/MaxPolak97/polycam-regression), it reads a path a line and a
    margin a line; besides, margins in percent, a header of the margins, and paths of another computer. Each reference
    frame makes a trial.
    """
    rate = _FRAME_RATE_HZ if options.frame_rate is None else options.frame_rate
    how = "assumed" if options.frame_rate is None else "declared"
    times = f"The lists give no times: {rate:g} frames/s were {how}; how fast the margin falls rests on it."
    lists = sorted(path.glob(f"*{FRAMES}")) if path.is_dir() else [path] * path.name.endswith(FRAMES)
    if len(lists) != 1:
        names = ", ".join(file.name for file in lists) or "no list"
        raise RecordingError(f"{path} has {names} of the thesis; name the file that ends in {FRAMES}")
    frames_list = lists[0]
    stem = frames_list.name.removesuffix(FRAMES)
    references_list, margins_list = (frames_list.with_name(stem + ending) for ending in (REFERENCES, MARGINS))
    frames, references = _read_lines(frames_list), _read_lines(references_list)
    margins, note = _read_margins(margins_list)
    if not len(frames) == len(references) == len(margins):
        counts = f"{len(references)} references and {margins_list.name} {len(margins)} margins"
        raise RecordingError(f"{frames_list} has {len(frames)} frames, {references_list.name} {counts}; give as many")
    find = partial(find_image, folder=frames_list.parent, root=options.image_root or frames_list.parent)
    trials: dict[Path, dict[Path, float]] = {}
    for (number, frame), (at, reference), margin in zip(frames, references, margins.tolist(), strict=True):
        rows = trials.setdefault(find(reference, f"{references_list}, line {at}"), {})
        image = find(frame, f"{frames_list}, line {number}")
        if image in rows:
            raise RecordingError(f"{frames_list}, line {number} lists {image} twice with one reference; list it once")
        rows[image] = margin
    base, digits, captures = trial_name(stem or "thesis"), len(str(len(trials))), []
    for number, (reference, rows) in enumerate(trials.items(), start=1):
        name = base if len(trials) == 1 else f"{base}-{number:0{digits}d}"
        paths = tuple(sorted(rows, key=lambda image: natural_key(str(image))))
        moved = () if paths == tuple(rows) else (f"{name}: frames were put into the natural order of their names.",)
        size = common_size((reference, *paths))
        captures.append(
            Capture(
                trial=name,
                source=f"{name} of {frames_list}",
                frame_time_s=evenly_spaced(len(paths), frame_rate=rate),
                frame_size=size,
                read_frames=partial(map, partial(read_image, size=size), paths),
                notes=(note, times, *moved),
                labels=labels_of_margins(np.array([rows[image] for image in paths])),
                reference=read_image(reference, size=size),
            )
        )
    return captures


def _read_lines(path: Path) -> list[tuple[int, str]]:
    """Read the lines of a list that are not empty, with their numbers from 1."""
    if not path.exists():
        raise RecordingError(f"{path} does not exist; the lists of a set must lie in one folder")
    if lines := [(number, line.strip()) for number, line in text_lines(path)]:
        return lines
    raise RecordingError(f"{path} is empty; list one entry a line")


def _read_margins(path: Path) -> tuple[np.ndarray, str]:
    values = []
    for number, line in _read_lines(path):
        try:
            values.append(float(line))
        except ValueError:
            if values or not line.isalpha():  # no header
                wrong = f"{path}, line {number} is {line[:40]!r}, not a safety margin"
                raise RecordingError(f"{wrong}; mend the line") from None
    margins = np.array(values)
    if not np.isfinite(margins).any():
        raise RecordingError(f"{path} holds no safety margin; give one a line")
    # no margin as a fraction comes near 2, percents all do
    percent = bool(np.nanmax(margins) > 2)
    margins = margins / 100 if percent else margins
    require_possible(margins, name="safety_margin", where=path.name)
    return margins, f"{path.name}: safety margins were read as {'percent' if percent else 'fractions'}, by their size."
