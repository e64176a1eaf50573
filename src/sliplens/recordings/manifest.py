"""Many recordings at once: what belongs to which trial, from a folder's names or from a table (CSV)."""

import csv
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from sliplens.errors import RecordingError
from sliplens.progress import number_of
from sliplens.recordings.formats import recognise
from sliplens.recordings.formats.tables import trial_name

_VIDEOS = frozenset({".mp4", ".m4v", ".mkv", ".mov", ".avi", ".webm", ".mpg", ".mpeg"})
_TABLES = frozenset({".csv", ".tsv", ".txt"})
_FORCE_WORDS = re.compile(r"[-_. ](forces?|wrench|ft)$", re.IGNORECASE)
_LONGEST_NAME = 255  # characters, of a file or a folder
_LONGEST = 100_000  # characters of a field; those of a manifest are paths and words


@dataclass(frozen=True, kw_only=True)
class ManifestRow:
    """Recording of one trial, its table of forces, and what is known of it; None where nobody says."""

    trial: str
    """Name of the trial."""
    video: Path
    """Video, folder of images or bag."""
    forces: Path | None = None
    """Table of forces beside it."""
    sensor: str | None = None
    """Name of the sensor, or its profile."""
    day: int | None = None
    """Counted from 1."""
    object: str | None = None
    """What was held."""
    condition: str | None = None
    """State of the surface, such as dry or wet."""
    mu: float | None = None
    """Static coefficient of friction."""
    reference: Path | int | None = None
    """Image of the untouched sensor, or the number of the frame that shows it."""


_COLUMNS = tuple(field.name for field in fields(ManifestRow))


def find_rows(source: Path) -> tuple[ManifestRow, ...] | None:
    """Rows of a manifest or of a folder of recordings; None where the path is one recording."""
    if source.is_dir():
        return None if recognise(source) else pair_recordings(source)
    if source.suffix.lower() == ".csv" and source.is_file() and "video" in _header(source)[0]:
        return read_manifest(source)
    return None


def pair_recordings(folder: Path) -> tuple[ManifestRow, ...]:
    """Pair the videos, folders of images and bags of a folder with the tables of forces of the same name.

    The table of `cup.mp4` is `cup.csv`, or `cup_forces.csv`. What is neither is passed over; so are data sets
    of sliplens, which may well have been made of this very folder.

    Raises
    ------
    RecordingError
        If there is no recording, two have one name, or a recording has two tables.
    """
    tables: dict[str, list[Path]] = {}
    recordings: dict[str, list[Path]] = {}
    seen = [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]
    texts = [path for path in seen if path.is_file() and path.suffix.lower() in _TABLES]
    for path in seen:
        bag = path.is_dir() or path.suffix in {".mcap", ".db3"}
        if path.suffix.lower() in _VIDEOS or (bag and recognise(path) not in {None, "sliplens"}):
            recordings.setdefault(_same(path.stem if path.is_file() else path.name), []).append(path)
    for path in texts:
        stem = _same(path.stem)
        # a recording may itself be named lift_ft
        tables.setdefault(stem if stem in recordings else _FORCE_WORDS.sub("", stem), []).append(path)
    if not recordings:
        raise RecordingError(
            f"{folder} holds no recording (looked for videos such as .mp4, bags, and folders of images); check the path"
        )
    for what, found in (("recordings", recordings), ("tables of forces", tables)):
        for stem, paths in found.items():
            if len(paths) > 1 and stem in recordings:
                raise RecordingError(
                    f"{folder} has several {what} named {stem} ({', '.join(path.name for path in paths)}); rename all "
                    "but one, or say what belongs together in a manifest (CSV)"
                )
    rows = tuple(
        ManifestRow(trial=trial_name(stem), video=path, forces=tables.get(stem, [None])[0])
        for stem, (path,) in recordings.items()
    )
    _require_different(rows, str(folder))
    return rows


def _same(name: str) -> str:
    """Name as one spelling: some systems write an umlaut as two characters."""
    return unicodedata.normalize("NFC", name)


def read_manifest(path: Path) -> tuple[ManifestRow, ...]:
    """Read a manifest: a CSV with a row a trial and the columns of `ManifestRow`, of which `video` alone must be there.

    Paths are relative to the manifest; `reference` is an image or the number of a frame.

    Raises
    ------
    RecordingError
        If a column is not known, or a row names no recording or gives a number that is none.
    """
    header, delimiter = _header(path)
    if strange := [name for name in header if name not in _COLUMNS]:
        raise RecordingError(f"{path} has a column {strange[0]!r}; a manifest has {', '.join(_COLUMNS)}")
    rows = tuple(_read_rows(path, delimiter))
    if not rows:
        raise RecordingError(f"{path} lists no trial; write a row for each below the header")
    _require_different(rows, str(path))
    return rows


def _require_different(rows: tuple[ManifestRow, ...], where: str) -> None:
    twice = [name for name, count in Counter(row.trial for row in rows).items() if count > 1]
    if twice:
        raise RecordingError(f"{where} has several trials named {', '.join(twice)}; give each a name of its own")


def _header(path: Path) -> tuple[list[str], str]:
    """Names of the columns in small letters, and what stands between them."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            line = stream.readline(_LONGEST)
    except (OSError, UnicodeDecodeError):
        return [], ","
    delimiter = max(",;\t", key=line.count)
    return [name.strip().strip('"').lower() for name in line.strip("\r\n").split(delimiter)], delimiter


def _read_rows(path: Path, delimiter: str) -> Iterator[ManifestRow]:
    names = _header(path)[0]
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, delimiter=delimiter)
            next(reader)
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                if len(cells) > len(names):
                    raise RecordingError(
                        f"{path}, line {reader.line_num}: {number_of(len(cells), 'cell')} but "
                        f"{number_of(len(names), 'column')}; mend the row"
                    )
                said = {name: cell.strip() for name, cell in zip(names, cells, strict=False) if cell.strip()}
                yield _row(said, path, f"{path}, line {reader.line_num}")
    except (UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path} cannot be read as CSV ({error}); export it again as UTF-8") from None


def _row(said: Mapping[str, str], path: Path, where: str) -> ManifestRow:
    if "video" not in said:
        raise RecordingError(f"{where}: no video is named; name the recording of the trial")
    folder, reference = path.parent, said.get("reference")
    for name, text in said.items():
        if max(map(len, re.split(r"[/\\]", text))) > _LONGEST_NAME:
            raise RecordingError(f"{where}: {name} has {len(text):,} characters, which no name has; mend it")
    numbers: dict[str, float | int] = {}
    for name, kind in (("day", int), ("mu", float)):
        if name in said:
            try:
                numbers[name] = kind(said[name])
            except ValueError:
                raise RecordingError(f"{where}: {name} is {said[name]!r}, which is no number; mend it") from None
    sensor = said.get("sensor")
    if sensor is not None and sensor.endswith(".toml"):
        sensor = str(folder / sensor)
    return ManifestRow(
        trial=trial_name(said.get("trial") or Path(said["video"]).stem),
        video=folder / said["video"],
        forces=folder / said["forces"] if "forces" in said else None,
        sensor=sensor,
        object=said.get("object"),
        condition=said.get("condition"),
        reference=None if reference is None else int(reference) if reference.isdecimal() else folder / reference,
        **numbers,  # pyright: ignore[reportArgumentType]
    )


__all__ = ["ManifestRow", "find_rows", "pair_recordings", "read_manifest"]
