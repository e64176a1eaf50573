"""Many recordings at once: pair videos with force tables by file name, or list them in a manifest (CSV)."""

import csv
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeAlias

from sliplens.errors import RecordingError
from sliplens.recordings.formats import recognise
from sliplens.recordings.formats.arrays import SUFFIXES
from sliplens.recordings.formats.tables import TEXT_TABLES, trial_name
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.sensor import SensorProfile

_FILES = SUFFIXES | {".mp4", ".m4v", ".mkv", ".mov", ".avi", ".webm", ".mpg", ".mpeg"}
_FORCE_SUFFIX = re.compile(r"[-_. ](forces?|wrench|ft)$", re.IGNORECASE)
_LONGEST_NAME = 255  # characters, of a file or a folder
_LONGEST_HEADER = 100_000  # characters

Column: TypeAlias = tuple[Callable[[str], Any], str]  #: Parser of the cells of a column, and the cure where it fails.


@dataclass(frozen=True, kw_only=True)
class ManifestRow:
    """Recording of one trial, its force table and its facts; None where the manifest names none."""

    trial: str  #: Name of the trial.
    video: Path  #: Video, folder of images or bag.
    sensor: SensorProfile | str | None = None  #: Name of the sensor, or its profile.
    day: int | None = None  #: Counted from 1.
    object: str | None = None  #: Name of the object in the grasp.
    condition: str | None = None  #: State of the surface, such as dry or wet.
    mu: float | None = None  #: Static coefficient of friction.
    reference: Path | int | None = None  #: Image of the untouched sensor, or the number of the frame that shows it.
    reading: ReadOptions = field(default_factory=ReadOptions)  #: Options of reading, each a column of its own.


def find_rows(source: Path) -> tuple[ManifestRow, ...] | None:
    """List the rows of a manifest or of a folder of recordings; None where the path is one recording."""
    if source.is_dir():
        return None if recognise(source) else pair_recordings(source)
    if source.suffix.lower() == ".csv" and source.is_file() and "video" in _read_header(source)[0]:
        return read_rows(source)
    return None


def pair_recordings(folder: Path) -> tuple[ManifestRow, ...]:
    """Pair the videos, folders of images and bags of a folder with the force tables of the same name.

    The table of `cup.mp4` is `cup.csv`, or `cup_forces.csv`. Other files are ignored, and so are data sets of
    sliplens, which may have been made of this very folder.
    """
    tables: dict[str, list[Path]] = {}
    recordings: dict[Path, str] = {}
    for path in (paths := [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]):
        bag = path.is_dir() or path.suffix in {".mcap", ".db3"}
        if path.suffix.lower() in _FILES or (bag and recognise(path) not in {None, "sliplens"}):
            # some systems write an umlaut as two characters
            recordings[path] = unicodedata.normalize("NFC", path.stem if path.is_file() else path.name)
    for path in paths:
        if path.is_file() and path.suffix.lower() in TEXT_TABLES:
            stem = unicodedata.normalize("NFC", path.stem)
            # a recording may itself be named lift_ft
            tables.setdefault(stem if stem in recordings.values() else _FORCE_SUFFIX.sub("", stem), []).append(path)
    if not recordings:
        raise RecordingError(f"{folder} holds no recording (a video, a bag or a folder of images); check the path")
    for path, stem in recordings.items():
        if len(several := tables.get(stem, ())) > 1:
            names = " and ".join(table.name for table in several)
            raise RecordingError(f"{path} has several tables of forces, {names}; rename all but one")
    rows = (
        ManifestRow(trial=trial_name(stem), video=path, reading=ReadOptions(forces=tables.get(stem, [None])[0]))
        for path, stem in recordings.items()
    )
    return _require_unique(tuple(rows), folder)


def read_rows(path: Path) -> tuple[ManifestRow, ...]:
    """Read a manifest: a CSV with a row a trial and the columns of `ManifestRow`, of which `video` alone is required.

    Paths are relative to the manifest; `reference` is an image or the number of a frame. A column named as an option of
    `ReadOptions`, such as `time_unit` or `force_columns` (separated by spaces), sets it for its trial.
    """
    folder = path.parent
    names = [item.name for kind in (ManifestRow, ReadOptions) for item in fields(kind) if item.name != "reading"]
    columns: dict[str, Column] = dict.fromkeys(names, (str, ""))
    columns |= dict.fromkeys(("day", "skip_frames"), (int, "write a whole number"))
    columns |= dict.fromkeys(("mu", "frame_rate", "start_s"), (float, "write a number with a decimal point"))
    columns |= dict.fromkeys(("video", "forces", "times", "image_root"), (folder.joinpath, ""))
    columns["sensor"] = (lambda text: str(folder / text) if text.endswith(".toml") else text, "")
    columns["reference"] = (lambda text: int(text) if text.isdecimal() else folder / text, "name an image or a frame")
    columns["force_columns"] = (lambda text: tuple(text.split()), "")
    rows = []
    for where, cells in read_csv(path, columns, what="a manifest", needed="video"):
        for name, text in cells.items():
            if max(map(len, re.split(r"[/\\]", text))) > _LONGEST_NAME:
                raise RecordingError(f"{where}: {name} has {len(text):,} characters, which no name has; correct it")
        facts = dict(parse_cells(cells, columns, where))
        facts["trial"] = trial_name(facts.get("trial") or facts["video"].stem)
        options = {name: facts.pop(name) for name in vars(ReadOptions()).keys() & facts.keys()}
        rows.append(ManifestRow(**facts, reading=ReadOptions(**options)))
    if not rows:
        raise RecordingError(f"{path} lists no trial; write a row for each below the header")
    return _require_unique(tuple(rows), path)


def _require_unique(rows: tuple[ManifestRow, ...], where: Path) -> tuple[ManifestRow, ...]:
    if repeated := [name for name, count in Counter(row.trial for row in rows).items() if count > 1]:
        raise RecordingError(f"{where} has several trials named {', '.join(repeated)}; give each a name of its own")
    return rows


def _read_header(path: Path) -> tuple[list[str], str]:
    """Read the column names, in small letters, and find the delimiter."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            line = stream.readline(_LONGEST_HEADER)
    except (OSError, UnicodeDecodeError):
        return [], ","
    delimiter = max(",;\t", key=line.count)
    return [name.strip().strip('"').lower() for name in line.strip("\r\n").split(delimiter)], delimiter


def read_csv(path: Path, columns: Collection[str], *, what: str, needed: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Read a table that a person wrote; yields the place of each row and its cells that are not empty, by column."""
    (names, delimiter), keys = _read_header(path), set[str]()
    if unknown := [name for name in names if name not in columns]:
        raise RecordingError(f"{path} has a column {unknown[0]!r}; {what} has {', '.join(columns)}")
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, delimiter=delimiter)
            next(reader)
            for cells in reader:
                where = f"{path}, line {reader.line_num}"
                if len(cells) > len(names):
                    raise RecordingError(f"{where}: {len(cells)} cells but {len(names)} columns; correct the row")
                filled = {name: cell.strip() for name, cell in zip(names, cells, strict=False) if cell.strip()}
                if not filled:
                    continue
                if needed not in filled:
                    raise RecordingError(f"{where}: the column {needed} is empty; write one row a trial and name it")
                if needed == "trial" and filled["trial"] in keys:
                    raise RecordingError(f"{where}: {filled['trial']} has a row already; write one row a trial")
                keys.add(filled[needed])
                yield where, filled
    except (UnicodeDecodeError, csv.Error, StopIteration) as error:
        raise RecordingError(f"{path} cannot be read as CSV ({error}); export it again as UTF-8") from None


def parse_cells(cells: Mapping[str, str], columns: Mapping[str, Column], where: str) -> Iterator[tuple[str, Any]]:
    """Parse the cells of a row by their columns; yields names and values."""
    for name, text in cells.items():
        parse, cure = columns[name]
        try:
            yield name, parse(text)
        except (ValueError, KeyError):
            raise RecordingError(f"{where}: {name} is {text[:40]!r}; {cure}") from None
