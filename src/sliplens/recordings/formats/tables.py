"""Forces from a table in a text file (CSV), with notes on what was guessed."""

import codecs
import csv
import re
import unicodedata
from array import array
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from math import isfinite, nan
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sliplens.errors import InputError, RecordingError
from sliplens.files import require_file
from sliplens.recordings.capture import Forces
from sliplens.recordings.labels.axes import typical_step
from sliplens.recordings.options import ReadOptions
from sliplens.recordings.trial import MOST_FORCE_N

_SEPARATORS = ("\t", ";", ",", " ")  # a comma may be a decimal one where another separator is there; " " is any space
TEXT_TABLES = frozenset({".csv", ".tsv", ".txt"})  #: Suffixes of tables in text files.
_HEAD = 200  # lines, of which most are rows: what comes before the header is text
_LACKING = ("", "nan", "na", "n/a", "null")  # fields of a sample that dropped out
_LONGEST_LINE = 100_000  # characters; a file without line breaks would be held whole
_COARSE_STAMPS, _COARSE_SHARE = 3, 0.1  # distinct stamps, and share of samples without their own, of a coarse clock
_NO_TABLES = {".toml", ".json", ".yaml", ".yml", ".ini", ".md"}  # text that may look like columns
_CSV = "export the table as CSV in UTF-8"

UNITS = {
    "time": {
        "s": (1.0, "s sec secs second seconds"),
        "ms": (1e-3, "ms msec msecs millis millisecond milliseconds"),
        "us": (1e-6, "us usec usecs micros microsecond microseconds \u00b5s \u03bcs"),  # micro sign, mu
        "ns": (1e-9, "ns nsec nsecs nanos nanosecond nanoseconds"),
    },
    "force": {
        "N": (1.0, "n newton newtons"),
        "mN": (1e-3, "mn millinewton millinewtons"),
        "kN": (1e3, "kn kilonewton kilonewtons"),
        "gf": (9.80665e-3, "gf g gram grams gramforce"),
        "kgf": (9.80665, "kgf kg kp kilogram kilograms"),
        "lbf": (4.4482216152605, "lbf lb lbs"),
    },
}
"""Factor of each unit to seconds or newtons, and its spellings."""
_TIME = {"time", "times", "t", "stamp", "timestamp", "timestamps", "ts", "elapsed", "clock"}
_NANOSECONDS = {"nsec", "nsecs", "nanosec", "nanosecs"}
_AXES = {
    **{axis: rf"f(orce)?_?{axis}" for axis in "xyz"},
    "normal": r"f_?n|normal(_?force)?|force_normal",
    "tangential": r"f_?t|(tangential|shear)(_?force)?|force_(tangential|shear)",
    "shear": r"(tangential|shear)(_force)?_[xyz]",
}
"""Ends of the names of columns with a force along an axis, in lower case with underscores between words."""


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Read the lines of a text file that are not empty, with their numbers."""
    try:
        require_file(path)
        with path.open("rb") as stream:
            utf_16 = stream.read(2) in {codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE}  # Excel's "Unicode"
        with path.open(encoding="utf-16" if utf_16 else "utf-8-sig") as stream:
            for number, text in enumerate(iter(lambda: stream.readline(_LONGEST_LINE), ""), start=1):
                if len(text) == _LONGEST_LINE:
                    raise RecordingError(f"{path}, line {number} is too long; {_CSV}")
                if "\0" in text:
                    raise RecordingError(f"{path} is not a text file; {_CSV}")
                if text.strip():
                    yield number, text.rstrip("\r\n")
    except UnicodeError:
        raise RecordingError(f"{path} is not a text file; {_CSV}") from None
    except (InputError, OSError) as error:
        raise RecordingError(str(error)) from None


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """Table in a text file."""

    path: Path
    header: tuple[str, ...]
    rows: Iterator[tuple[int, list[str]]]  #: Number of the line and text of each column, read once, row by row.
    row: str = "line"  #: Name of a row in messages.

    def place(self, number: int) -> str:
        """Return the place of a row for messages."""
        return f"{self.path}, {self.row} {number}"


def open_text_table(path: Path) -> TextTable:
    """Find the separator and the header of a table.

    Before the header may be a byte order mark, comments, lines such as `sep=;` and other text; below it a row of units.
    """
    if path.suffix.lower() in _NO_TABLES:
        raise RecordingError(f"{path} is no table; name one (CSV), with a header and a row a sample")
    lines = text_lines(path)
    head = list(islice(lines, _HEAD))
    plain = [(line, text) for line, text in head if not text.lstrip().startswith(("#", "%"))]
    if not plain:
        raise RecordingError(f"{path} is empty; name a table with a header and a row a sample")
    separator, width = _find_layout(path, plain)
    rows = _split_lines(path, chain(plain, lines), separator, width)
    _, header = first = next(rows)
    if not _WORD.search("".join(header)):
        # `rostopic echo -p` and NumPy write the header as a comment
        above = [_split(path, line, text.lstrip("#% \t"), separator) for line, text in head if line < plain[0][0]]
        commented = [cells for cells in above if len(cells) == width and all(map(_WORD.search, cells))]
        if not commented:
            # names of another number than the rows have: the first row that differs is the error
            if _WORD.search(plain[0][1]):
                deque(_split_lines(path, plain, separator, len(_split(path, *plain[0], separator))), maxlen=0)
            raise RecordingError(f"{path} begins with numbers, not names of columns; begin with time_s,fx,fy,fz")
        rows, header = chain([first], rows), commented[-1]
    for first in islice(rows, 1):
        units = [cell.strip("[]()") for cell in first[1]]
        measures = [unit for quantity in UNITS for unit in units if _find_unit(unit.lower(), quantity)]
        # most of them, for a letter may be a label
        if 2 * len(measures) > len(list(filter(None, units))) and not any(map(str.isdecimal, "".join(units))):
            header = [f"{name} [{unit}]" if unit.strip("-") else name for name, unit in zip(header, units, strict=True)]
        else:
            rows = chain([first], rows)
    return TextTable(path=path, header=tuple(header), rows=rows)


_WORD = re.compile("[a-z]", re.IGNORECASE)


def _find_layout(path: Path, lines: list[tuple[int, str]]) -> tuple[str, int]:
    """Return the separator by which most lines have the same number of columns, and that number."""
    layouts = []
    for place, separator in enumerate(_SEPARATORS):
        counts = Counter(len(_split(path, line, text, separator)) for line, text in lines)
        width, count = max(counts.items(), key=lambda item: (item[0] > 1, item[1], item[0]))
        layouts.append((width > 1, count, -place, width))
    several, _, place, width = max(layouts)
    if not several:
        text = lines[0][1][:40]
        raise RecordingError(f"{path} has a single column {text!r}; separate by commas, semicolons, tabs or spaces")
    return _SEPARATORS[-place], width


def _split(path: Path, line: int, text: str, separator: str) -> list[str]:
    if separator == " ":
        return text.split()
    try:
        (cells,) = csv.reader([text], delimiter=separator, skipinitialspace=separator != "\t")
    except (csv.Error, ValueError) as error:
        raise RecordingError(f"{path}, line {line} cannot be split into columns ({error}); correct it") from None
    return [cell.strip() for cell in cells]


def _split_lines(
    path: Path, lines: Iterable[tuple[int, str]], separator: str, width: int
) -> Iterator[tuple[int, list[str]]]:
    begun = False
    for line, text in lines:
        if text.lstrip().startswith(("#", "%")):
            continue
        cells = _split(path, line, text, separator)
        begun = begun or len(cells) == width
        if begun and len(cells) != width:
            comma = separator == "," and len(cells) > width
            cure = "where decimals are commas, separate the columns by semicolons" if comma else "correct the line"
            raise RecordingError(f"{path}, line {line} has {len(cells)} columns but the header {width}; {cure}")
        if begun:
            yield line, cells


def find_column(table: TextTable, name: str, *, option: str) -> str:
    """Find a column that the user named, as it is written, in any case, or without its unit."""
    for form in (str, str.lower, lambda text: re.sub(r" \[.*", "", text.lower())):
        same = [column for column in table.header if form(column) == form(name.strip())]
        if len(same) == 1:
            return same[0]
    raise RecordingError(f"{table.path} has no column {name!r}, it has {_quote(table.header)}; name it with {option}")


_GROUPED = re.compile(r"([+-]?\d{1,3}(?:([,.'\u2019\s])\d{3})(?:\2\d{3})*)(?:(?!\2)[.,](\d*))?")


def _without_groups(text: str) -> str:
    """Remove separators of thousands, unless a single mark may be a decimal one, and write the minus sign in ASCII."""
    text = text.replace("\u2212", "-")
    grouped = _GROUPED.fullmatch(text)
    if grouped is None or (grouped[3] is None and grouped[2] in ",." and grouped[1].count(grouped[2]) == 1):
        return text
    return re.sub(r"[^\d+-]", "", grouped[1]) + ("" if grouped[3] is None else f"{text[grouped.end(1)]}{grouped[3]}")


def to_number(text: str, *, table: TextTable, line: int, column: str) -> float:
    """Read a finite number, whose decimals may have a comma and whose thousands may be separated."""
    try:
        value = float(_without_groups(text).replace(",", "."))
    except ValueError:
        value = nan
    if not isfinite(value):
        where = f"{table.place(line)}, {column!r}"
        raise RecordingError(f"{where} is {text[:40]!r}, not a finite number; correct or drop the {table.row}")
    return value


def require_unit(unit: str, *, quantity: str, where: str = "") -> str:
    """Return the usual spelling of a unit; `where` names the column that has it, if none was declared."""
    usual = _find_unit(unit.lower(), quantity)
    if usual is None:
        units = f"{where}{unit!r} is no unit of {quantity}; use one of {', '.join(UNITS[quantity])}"
        raise RecordingError(f"{units}, or declare it with --{quantity}-unit" if where else units)
    return usual


def _find_unit(text: str, quantity: str) -> str | None:
    return next((unit for unit, (_, names) in UNITS[quantity].items() if text in names.split()), None)


def unit_of(name: str, *, quantity: str, path: Path) -> str | None:
    """Return the unit in a column's name, in brackets or as its last word; None if there is none."""
    if bracket := re.search(r"[\[(]\s*([^\])]*?)\s*[\])]", name):
        return require_unit(bracket[1], quantity=quantity, where=f"{path}: column {name!r}: ")
    words = _words(name)
    # "f_n" is a normal force, "fx_n" one along x in newtons
    if not words or (quantity == "force" and (len(words) < 2 or _axis(words) is not None)):
        return None
    return _find_unit(words[-1], quantity)


def _words(name: str) -> list[str]:
    """Split the name of a column without its unit in brackets."""
    return re.findall(r"[0-9a-z\u00b5\u03bc]+", re.sub(r"[\[(].*", "", name.lower()))


def _axis(words: list[str]) -> str | None:
    """Return the axis in the last words of a name: "wrench.force.x" is the force along x."""
    name = "_".join(words)
    return next((axis for axis, end in _AXES.items() if re.search(f"(^|_)({end})$", name)), None)


def force_axis(name: str) -> str | None:
    """Return the axis of a column with a force; None for another column."""
    words = _words(name)
    return _axis(words) or _axis(words[:-1])  # the last word may be a unit


def is_time(name: str) -> bool:
    """Return True for a column of times, by its name or its unit."""
    words, bracket = _words(name), re.search(r"[\[(]\s*(\w+)\s*[\])]", name.lower())
    if _find_unit(bracket[1] if bracket else words[0] if len(words) == 1 else "", "time"):
        return True
    # "f_t" is a tangential force, "F/T" a force/torque sensor
    return bool(_TIME & {*words[:1], *(word for word in words if word != "t")}) and _axis(words) is None


def guess_time_column(header: Sequence[str], *, path: Path) -> str:
    """Find the column that holds times."""
    times = list(filter(is_time, header))
    if len(times) > 1:  # a ROS message has a stamp of its own beside the time of its arrival
        times = [name for name in times if {"header", "stamp"} <= set(_words(name))] or times
    if len(times) != 1:
        looks = f"{len(times) or 'no'} columns that look like the time among {_quote(header)}"
        raise RecordingError(f"{path} has {looks}; name it with --time-column")
    return times[0]


def _seconds_and_nanoseconds(header: Sequence[str]) -> tuple[str, ...]:
    """Find a column of whole seconds and one of the nanoseconds beside them; none if there is no such pair."""
    last = {name: (_words(name) or [""])[-1] for name in header}
    pairs = [[name for name, word in last.items() if word in words] for words in ({"sec", "secs"}, _NANOSECONDS)]
    return tuple(names[0] for names in pairs) if [len(names) for names in pairs] == [1, 1] else ()


def guess_force_columns(header: Sequence[str], *, path: Path) -> tuple[str, ...]:
    """Find the columns with the force along x, y and z, or the normal and the tangential force, by their names."""
    columns: dict[str, list[str]] = {axis: [] for axis in _AXES}
    for name in header:
        if axis := force_axis(name):
            columns[axis].append(name)
    for axes in (("x", "y", "z"), ("shear", "normal"), ("normal", "tangential")):
        names = [name for axis in axes for name in columns[axis]]
        if all(columns[axis] for axis in axes) and len(names) == (2 if "tangential" in axes else 3):
            return tuple(names)
    looks = f"has no columns that look like forces (fx, fy, fz or fn, ft) among {_quote(header)}"
    raise RecordingError(f"{path} {looks}; name them with --force-columns")


def _quote(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))


def scale_times(
    time: Float[np.ndarray, " rows"], lines: Sequence[int], *, table: TextTable, column: str, unit: str | None = None
) -> tuple[Float[np.ndarray, " rows"], str]:
    """Convert times of a column, which must rise, to seconds; return also the unit and where it is known from.

    A unit that is not given is that in the column's name, else a guess from the size of the times: by the date where
    they count from 1970, else by the usual step.
    """
    time, shared = _spread(time)
    wrong = np.flatnonzero(~(np.diff(time) > 0))
    if len(wrong):
        before, after = time[wrong[0] : wrong[0] + 2].tolist()
        what = "repeats" if after == before else "falls"
        where = table.place(lines[wrong[0] + 1])
        raise RecordingError(f"{where}: {column!r} {what} ({before:.9g}, then {after:.9g}); sort it")
    if unit is not None:
        usual, how = require_unit(unit, quantity="time"), "declared"
    elif usual := unit_of(column, quantity="time", path=table.path):
        how = "by its name"
    else:
        size, step = float(np.abs(time[-1])), typical_step(time)
        dated = (("ns", 1e17), ("us", 1e14), ("ms", 1e11), *([("s", 1e8)] if step < 0.5 else []))
        usual = next((unit for unit, since_1970 in dated if size >= since_1970), None)
        usual = usual or next((unit for unit, most in (("s", 0.5), ("ms", 500.0), ("us", 5e5)) if step <= most), "ns")
        how = f"guessed: {len(time)} samples in {(time[-1] - time[0]) * UNITS['time'][usual][0]:.4g} s"
    how += f"; {shared} samples share a stamp of a coarse clock, and are spread evenly" if shared else ""
    return time * UNITS["time"][usual][0], f"{usual} ({how})"


def _spread(time: Float[np.ndarray, " rows"]) -> tuple[Float[np.ndarray, " rows"], int]:
    """Spread samples with the same stamp evenly up to the next, if many share one; return also their number."""
    stamps, first, count = np.unique(time, return_index=True, return_counts=True)
    shared = len(time) - len(stamps)
    if len(stamps) < _COARSE_STAMPS or shared < _COARSE_SHARE * len(time) or np.any(np.diff(time) < 0):
        return time, 0
    step = np.append(np.diff(stamps), np.median(np.diff(stamps)))
    number = np.arange(len(time)) - np.repeat(first, count)
    return time + number * np.repeat(step / count, count), shared


def evenly_spaced(count: int, *, frame_rate: float) -> Float[np.ndarray, " frames"]:
    """Return times of frames taken at a declared rate, in seconds from the first."""
    if not (isfinite(frame_rate) and frame_rate > 0):
        raise RecordingError(f"a frame rate of {frame_rate} frames/s cannot be; declare a positive one")
    return np.arange(count) / frame_rate


def trial_name(text: str) -> str:
    """Make a name of a trial: letters of any script, digits, dots, dashes and underscores."""
    # some systems write an umlaut as two characters
    return re.sub(r"[^\w.-]+", "-", unicodedata.normalize("NFC", text)).strip("-.") or "trial"


def read_force_table(table: TextTable, options: ReadOptions) -> tuple[Forces, tuple[str, ...]]:
    """Read times and forces from a table with a header, and notes of what was declared or guessed.

    What is not declared is guessed from the names of the columns (`time_s`, `t [ms]`, `stamp`; `fx`, `force_x [mN]`,
    `wrench.force.x`; `fn` and `ft`), the unit of the time also from its steps.
    """
    path = table.path
    if options.time_column is not None:
        times, by_name = (find_column(table, options.time_column, option="--time-column"),), "declared"
    else:
        times = _seconds_and_nanoseconds(table.header) or (guess_time_column(table.header, path=path),)
        by_name = "by its name"
    names, by_names = choose_force_columns(table, options)
    numbers, lines, notes = read_numbers(table, (*times, *names), complete=len(times))
    time = numbers[:, 0] + 1e-9 * numbers[:, 1] if len(times) == 2 else numbers[:, 0]
    time_name, unit = " and ".join(times), "s" if len(times) == 2 else options.time_unit
    time_s, in_time = scale_times(time, lines, table=table, column=time_name, unit=unit)
    force_n, words = scale_forces(numbers[:, len(times) :], lines, names, options, table=table)
    notes = (
        f"{path.name}: times are those of column {time_name!r} ({by_name}), in {in_time}.",
        f"{path.name}: forces are those of {_quote(names)} as {words[0]} ({by_names}), {words[1]}.",
        *notes,
    )
    return Forces(time_s=time_s, force_n=force_n, source=str(path)), notes


def choose_force_columns(table: TextTable, options: ReadOptions) -> tuple[tuple[str, ...], str]:
    """Return the columns of a table with forces, and how they are known."""
    if options.force_columns is None:
        return guess_force_columns(table.header, path=table.path), "by their names"
    names = tuple(find_column(table, name, option="--force-columns") for name in options.force_columns)
    if len(names) not in {2, 3} or len(set(names)) < len(names):
        raise RecordingError(f"columns {_quote(names)} are no force; name each of x, y, z, or normal, tangential")
    return names, "declared"


def scale_forces(
    forces: Float[np.ndarray, "rows columns"],
    lines: Sequence[int],
    names: Sequence[str],
    options: ReadOptions,
    *,
    table: TextTable,
) -> tuple[Float[np.ndarray, "rows 3"], tuple[str, str]]:
    """Convert forces of columns to newtons along x, y, z; return also words for the axes and the units."""
    if options.force_unit is not None:
        units, how_force = [require_unit(options.force_unit, quantity="force")] * len(names), "declared"
    else:
        in_names = [unit_of(name, quantity="force", path=table.path) for name in names]
        units = [unit or "N" for unit in in_names]
        how_force = "assumed, for the names give no unit" if None in in_names else "by their names"
    forces = forces * np.array([UNITS["force"][unit][0] for unit in units])
    large = np.any(np.abs(forces) > MOST_FORCE_N, axis=1)
    if large.any():
        at = int(np.argmax(large))
        size = f"{table.place(lines[at])}: {np.nanmax(np.abs(forces[at])):.4g} N is no force of a fingertip"
        raise RecordingError(f"{size}; declare the right one with --force-unit")
    axes = "x, y, z"
    if len(names) == 2:  # z points into the gel; the tangential force has no direction
        axes = "normal (laid along z), tangential (laid along x)"
        forces = np.stack([forces[:, 1], np.zeros(len(forces)), forces[:, 0]], axis=1)
    return np.ascontiguousarray(forces), (axes, f"in {', '.join(dict.fromkeys(units))} ({how_force})")


def read_numbers(
    table: TextTable, names: Sequence[str], *, complete: int = 0
) -> tuple[Float[np.ndarray, "rows columns"], array, tuple[str, ...]]:
    """Read columns of a table as numbers, the line of each row, and notes; the first `complete` may lack no value."""
    places = [table.header.index(name) for name in names]
    values, lines, commas, points = array("d"), array("q"), False, False
    for line, cells in table.rows:
        lines.append(line)
        for number, place in enumerate(places):
            cell = _without_groups(cells[place])
            commas, points = commas or "," in cell, points or "." in cell
            lacks = number >= complete and cell.lower() in _LACKING
            values.append(nan if lacks else to_number(cell, table=table, line=line, column=table.header[place]))
    if not lines:
        raise RecordingError(f"{table.path} has a header but no row; record the force sensor too")
    if commas and points:
        raise RecordingError(f"{table.path} mixes decimal commas and points; write all numbers in one way")
    numbers = np.frombuffer(values, dtype=np.float64).reshape(-1, len(places))
    return numbers, lines, (f"{table.path.name}: commas are decimal points.",) if commas else ()


def place_on_clock(
    time_s: Float[np.ndarray, " frames"], options: ReadOptions, *, source: str
) -> tuple[Float[np.ndarray, " frames"], Forces | None, tuple[str, ...]]:
    """Return times of frames on the clock of the forces in the table beside them, these forces, and notes."""
    start_s = options.start_s
    table = None if options.forces is None else open_text_table(options.forces)
    samples, notes = (None, ()) if table is None else read_force_table(table, options)
    if start_s is not None:
        if not isfinite(start_s):
            raise RecordingError(f"the first frame cannot start at {start_s} s; give the time of the force clock")
        time_s = time_s - time_s[0] + start_s
        notes += (f"{source}: the first frame was declared to be taken at {start_s:.6g} s of the force clock.",)
    elif samples is not None:
        notes += (f"{source}: the times of its frames and of the forces were taken to count from the same zero.",)
    if samples is not None and (time_s[-1] < samples.time_s[0] or time_s[0] > samples.time_s[-1]):
        spans = f"{source} ({time_s[0]:.6g} to {time_s[-1]:.6g} s) and the forces of {samples.source}"
        span = f"{samples.time_s[0]:.6g} to {samples.time_s[-1]:.6g} s"
        raise RecordingError(f"the frames of {spans} ({span}) have no moment in common; give --start-s")
    return time_s, samples, notes
