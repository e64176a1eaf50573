"""Forces from a table in a text file (CSV), with notes on what was guessed."""

import codecs
import csv
import re
import unicodedata
from array import array
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
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

_SEPARATORS = ("\t", ";", ",")  # a comma may be a decimal one where another separator is there
_LACKING = ("", "nan", "na", "n/a", "null")  # fields of a sample that dropped out
_COMMENTS = ("#", "%")
_LONGEST_LINE = 100_000  # characters; a file without line breaks would be held whole
_CSV = "export the table as CSV in UTF-8"


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """Table in a text file; its rows are read one at a time."""

    path: Path
    encoding: str
    separator: str
    header: tuple[str, ...]
    first_line: int  #: Line of the file after the header, counted from 1.

    @property
    def names(self) -> str:
        """Names of the columns, for messages."""
        return _quote(self.header)

    def require(self, name: str, *, option: str) -> str:
        """Return the name of a column as the file writes it."""
        exact = [column for column in self.header if column == name]
        same = exact or [column for column in self.header if column.lower() == name.strip().lower()]
        if not same:
            raise RecordingError(f"{self.path} has no column {name!r}, it has {self.names}; name it with {option}")
        if len(same) > 1:
            raise RecordingError(f"{self.path} has {len(same)} columns {name!r}; rename one of them")
        return same[0]

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Iterate over the rows: the number of the line, and the text of each column."""
        for line, text in _lines(self.path, self.encoding):
            if line < self.first_line or _is_comment(text):
                continue
            where = f"{self.path}, line {line}"
            fields = _split(text, self.separator, where=where)
            if len(fields) != len(self.header):
                comma = self.separator == "," and len(fields) > len(self.header)
                cure = "where decimals are commas, separate the columns by semicolons" if comma else "mend the line"
                raise RecordingError(f"{where} has {len(fields)} columns but the header {len(self.header)}; {cure}")
            yield line, fields


def open_text_table(path: Path) -> TextTable:
    """Find the separator and the header of a table, after a byte order mark, comments and empty lines."""
    encoding = _encoding(path)
    for line, text in _lines(path, encoding):
        if _is_comment(text):
            continue
        separator = next((mark for mark in _SEPARATORS if mark in text), None)
        if separator is None:
            raise RecordingError(f"{path} has a single column {text[:40]!r}; separate by commas, semicolons or tabs")
        header = _split(text, separator, where=f"{path}, line {line}")
        if not any(re.search("[a-z]", name, re.IGNORECASE) for name in header):
            raise RecordingError(f"{path} begins with numbers, not names of columns; begin with time_s,fx,fy,fz")
        return TextTable(path=path, encoding=encoding, separator=separator, header=tuple(header), first_line=line + 1)
    raise RecordingError(f"{path} is empty; name a table with a header and a row a sample")


def read_numbers(
    table: TextTable, names: Sequence[str], *, may_lack: Collection[str] = ()
) -> tuple[Float[np.ndarray, "rows columns"], array, bool]:
    """Read columns as finite numbers: the numbers, the line of each row, and True where decimals have commas."""
    places = [table.header.index(name) for name in names]
    values, lines = array("d"), array("q")
    commas = points = False
    for line, fields in table.rows():
        lines.append(line)
        for place in places:
            points |= "." in fields[place]
            commas |= "," in fields[place]
            if table.header[place] in may_lack and fields[place].lower() in _LACKING:
                values.append(nan)
                continue
            values.append(to_number(fields[place], where=f"{table.path}, line {line}, {table.header[place]!r}"))
    if not lines:
        raise RecordingError(f"{table.path} has a header but no row; record the force sensor too")
    if commas and points:
        raise RecordingError(f"{table.path} mixes decimal commas and points; write all numbers in one way")
    return np.frombuffer(values, dtype=np.float64).reshape(-1, len(places)), lines, commas


def to_number(text: str, *, where: str) -> float:
    """Read a finite number, whose decimals may have a comma."""
    if not text:
        raise RecordingError(f"{where} is empty; mend or drop the line")
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        raise RecordingError(f"{where} is {text[:40]!r}, not a number; mend the line, or name another column") from None
    if not isfinite(value):
        raise RecordingError(f"{where} is {text!r}, not a finite number; mend or drop the line")
    return value


def require_rising(time: Float[np.ndarray, " rows"], lines: Sequence[int], *, path: Path, column: str) -> None:
    """Check that times rise from row to row."""
    wrong = np.flatnonzero(~(np.diff(time) > 0))
    if len(wrong):
        before, after = time[wrong[0] : wrong[0] + 2].tolist()
        what = "repeats" if after == before else "falls"
        raise RecordingError(
            f"{path}, line {lines[wrong[0] + 1]}: {column!r} {what} ({before:.9g}, then {after:.9g}); sort it"
        )


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Read the lines of a text file that are not empty, with their numbers."""
    return _lines(path, _encoding(path))


def _encoding(path: Path) -> str:
    try:
        require_file(path)
        with path.open("rb") as stream:
            start = stream.read(2)
    except (InputError, OSError) as error:
        raise RecordingError(str(error)) from None
    return "utf-16" if start in {codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE} else "utf-8-sig"  # that of Excel's "Unicode"


def _lines(path: Path, encoding: str) -> Iterator[tuple[int, str]]:
    try:
        with path.open(encoding=encoding) as stream:
            for number, text in enumerate(iter(lambda: stream.readline(_LONGEST_LINE), ""), start=1):
                if len(text) == _LONGEST_LINE:
                    raise RecordingError(f"{path}, line {number} is too long; {_CSV}")
                if "\0" in text:
                    raise RecordingError(f"{path} is not a text file; {_CSV}")
                if text.strip():
                    yield number, text.rstrip("\r\n")
    except UnicodeError:
        raise RecordingError(f"{path} is not a text file; {_CSV}") from None


def _split(text: str, separator: str, *, where: str) -> list[str]:
    try:
        fields = next(csv.reader([text], delimiter=separator, skipinitialspace=separator != "\t"))
    except csv.Error as error:
        raise RecordingError(f"{where} cannot be split into columns ({error}); export the table again") from None
    return [field.strip() for field in fields]


def _is_comment(text: str) -> bool:
    return text.lstrip().startswith(_COMMENTS)


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
_TIME_WORDS = frozenset({"time", "times", "t", "stamp", "timestamp", "timestamps", "ts", "elapsed", "clock"})
_AXES = {
    **{axis: (f"f{axis}", f"f {axis}", f"force {axis}", f"force{axis}") for axis in "xyz"},
    "normal": ("fn", "f n", "normal", "normal force", "force normal", "normalforce"),
    "tangential": (
        *("ft", "f t", "tangential", "tangential force", "force tangential", "tangentialforce"),
        *("shear", "shear force", "force shear"),
    ),
}
"""Spellings of a force along an axis."""


def unit_of(name: str, *, quantity: str, path: str) -> str | None:
    """Return the unit in a column's name, in brackets or as its last word; None if there is none."""
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]", name)
    if bracket:
        unit = _find_unit(bracket[1].lower(), quantity)
        if unit is None:
            unknown = f"is in {bracket[1]!r}, which is no known unit of {quantity} ({', '.join(UNITS[quantity])})"
            raise RecordingError(f"{path}: {name!r} {unknown}; declare the right one with --{quantity}-unit")
        return unit
    words = _words(name)
    # "f_n" is a normal force, "fx_n" one along x in newtons
    if not words or (quantity == "force" and (len(words) < 2 or _axis(words) is not None)):
        return None
    return _find_unit(words[-1], quantity)


def require_unit(unit: str, *, quantity: str) -> str:
    """Return the usual spelling of a declared unit."""
    usual = _find_unit(unit.lower(), quantity)
    if usual is None:
        raise RecordingError(f"{unit!r} is no unit of {quantity}; use one of {', '.join(UNITS[quantity])}")
    return usual


def guess_time_column(table: TextTable) -> str:
    """Find the column that holds times by its name."""
    times = []
    for name in table.header:
        words = _words(_without_unit(name))
        by_word = bool(_TIME_WORDS & set(words)) and _axis(words) is None  # "f_t" is a tangential force
        if by_word or (len(words) == 1 and _find_unit(words[0], "time")):
            times.append(name)
    return _require_single(times, table=table, what="the time", option="--time-column")


def guess_force_columns(table: TextTable) -> tuple[str, ...]:
    """Find the columns with the force along x, y and z, or the normal and the tangential force, by their names."""
    columns: dict[str, list[str]] = {axis: [] for axis in _AXES}
    for name in table.header:
        words = _words(_without_unit(name))
        axis = _axis(words) or _axis(words[:-1])
        if axis is not None:
            columns[axis].append(name)
    option = "--force-columns"
    for axes in (("x", "y", "z"), ("normal", "tangential")):
        if all(columns[axis] for axis in axes):
            return tuple(
                _require_single(columns[axis], table=table, what=f"the force ({axis})", option=option) for axis in axes
            )
    alone = columns["z"] + columns["normal"]
    if alone and not columns["x"] + columns["y"] + columns["tangential"]:
        lacks = f"{table.path} has a normal force ({alone[0]!r}) but no tangential force that is known by its name"
        raise RecordingError(f"{lacks}, and a safety margin needs both; name its columns with {option}")
    nothing = "has no columns that look like forces (fx, fy, fz or fn, ft)"
    raise RecordingError(f"{table.path} {nothing} among {table.names}; name them with {option}")


def guess_time_unit(time: Float[np.ndarray, " samples"]) -> str:
    """Guess the unit of times from their size: by the date where they count from 1970, else by the usual step."""
    size, step = float(np.abs(time[-1])), typical_step(time)
    for unit, since_1970 in (("ns", 1e17), ("us", 1e14), ("ms", 1e11), ("s", 1e8)):
        if size >= since_1970 and (unit != "s" or step < 0.5):
            return unit
    return next((unit for unit, most in (("s", 0.5), ("ms", 500.0), ("us", 5e5)) if step <= most), "ns")


def _words(name: str) -> Sequence[str]:
    return re.findall(r"[0-9a-z\u00b5\u03bc]+", name.lower())


def _without_unit(name: str) -> str:
    return re.sub(r"[\[(].*", "", name)


def _axis(words: Sequence[str]) -> str | None:
    """Return the axis in the last words of a name: "wrench.force.x" is the force along x."""
    ends = {" ".join(words[-count:]) for count in (1, 2)}
    return next((axis for axis, spellings in _AXES.items() if ends & set(spellings)), None)


def _find_unit(text: str, quantity: str) -> str | None:
    return next((unit for unit, (_, names) in UNITS[quantity].items() if text in names.split()), None)


def _quote(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))


def _require_single(names: Sequence[str], *, table: TextTable, what: str, option: str) -> str:
    if not names:
        raise RecordingError(f"{table.path} has no column that looks like {what} among {table.names}; give {option}")
    if len(names) > 1:
        raise RecordingError(f"{table.path}: {what} could be any of {_quote(names)}; name the right one with {option}")
    return names[0]


def evenly_spaced(count: int, *, frame_rate: float) -> Float[np.ndarray, " frames"]:
    """Return times of frames taken at a declared rate, in seconds from the first."""
    if not (isfinite(frame_rate) and frame_rate > 0):
        raise RecordingError(f"a frame rate of {frame_rate} frames/s cannot be; declare a positive one")
    return np.arange(count) / frame_rate


def trial_name(text: str) -> str:
    """Make a name of a trial: letters of any script, digits, dots, dashes and underscores."""
    # some systems write an umlaut as two characters
    return re.sub(r"[^\w.-]+", "-", unicodedata.normalize("NFC", text)).strip("-.") or "trial"


def require_trial_name(trial: str) -> None:
    """Check that the name of a trial can name a file."""
    if trial_name(trial) != trial:
        raise RecordingError(f"trial {trial[:40]!r} cannot name a file; use letters, digits, dots, dashes, underscores")


def read_force_table(path: Path, options: ReadOptions) -> tuple[Forces, tuple[str, ...]]:
    """Read times and forces from a text table with a header, and notes of what was declared or guessed.

    What is not declared is guessed from the names of the columns (`time_s`, `t [ms]`, `stamp`; `fx`, `force_x [mN]`,
    `wrench.force.x`; `fn` and `ft`), the unit of the time also from its steps.
    """
    table, time_column, force_columns = open_text_table(path), options.time_column, options.force_columns
    time_name = guess_time_column(table) if time_column is None else table.require(time_column, option="--time-column")
    if force_columns is None:
        names = guess_force_columns(table)
    elif len(force_columns) not in {2, 3}:
        raise RecordingError(f"{len(force_columns)} force columns were named; name x, y, z, or normal, tangential")
    else:
        names = tuple(table.require(name, option="--force-columns") for name in force_columns)
        if len(set(names)) < len(names):
            raise RecordingError(f"the force columns {', '.join(names)} repeat; name each once")
    values, lines, decimal_comma = read_numbers(table, [time_name, *names], may_lack=names)
    time = values[:, 0]
    require_rising(time, lines, path=path, column=time_name)
    time_unit, how = _time_unit(table, time_name, options.time_unit, time)
    factors, units = _force_factors(table, names, options.force_unit)
    forces = values[:, 1:] * factors
    large = np.any(np.abs(forces) > MOST_FORCE_N, axis=1)
    if large.any():
        at = int(np.argmax(large))
        size = f"{path}, line {lines[at]}: {np.nanmax(np.abs(forces[at])):.4g} N is no force of a fingertip"
        raise RecordingError(f"{size}; declare the right one with --force-unit")
    by_name = "by its name" if time_column is None else "declared"
    by_names = "by their names" if force_columns is None else "declared"
    axes = "x, y, z" if len(names) == 3 else "normal (laid along z), tangential (laid along x)"
    notes = [
        f"{path.name}: times are those of column {time_name!r} ({by_name}), in {time_unit} ({how}).",
        f"{path.name}: forces are those of {_quote(names)} as {axes} ({by_names}), in {units}.",
    ]
    if decimal_comma:
        notes.append(f"{path.name}: commas were read as decimal points.")
    if len(names) == 2:
        # normal and tangential: z points into the gel, the tangential force has no direction and is laid along x
        forces = np.stack([forces[:, 1], np.zeros(len(forces)), forces[:, 0]], axis=1)
    time_s = time * UNITS["time"][time_unit][0]
    return Forces(time_s=time_s, force_n=np.ascontiguousarray(forces), source=str(path)), tuple(notes)


def _time_unit(
    table: TextTable, name: str, declared: str | None, time: Float[np.ndarray, " samples"]
) -> tuple[str, str]:
    if declared is not None:
        return require_unit(declared, quantity="time"), "declared"
    unit = unit_of(name, quantity="time", path=str(table.path))
    if unit is not None:
        return unit, "by its name"
    unit = guess_time_unit(time)
    span = (time[-1] - time[0]) * UNITS["time"][unit][0]
    return unit, f"guessed: {len(time)} samples in {span:.4g} s"


def _force_factors(
    table: TextTable, names: Sequence[str], declared: str | None
) -> tuple[Float[np.ndarray, " columns"], str]:
    if declared is not None:
        unit = require_unit(declared, quantity="force")
        return np.full(len(names), UNITS["force"][unit][0]), f"{unit} (declared)"
    by_name = [unit_of(name, quantity="force", path=str(table.path)) for name in names]
    units = [unit or "N" for unit in by_name]
    how = "assumed, for the names give no unit" if None in by_name else "by their names"
    return np.array([UNITS["force"][unit][0] for unit in units]), f"{', '.join(dict.fromkeys(units))} ({how})"


def place_on_clock(
    time_s: Float[np.ndarray, " frames"], options: ReadOptions, *, source: str
) -> tuple[Float[np.ndarray, " frames"], Forces | None, tuple[str, ...]]:
    """Return times of frames on the clock of the forces in the table beside them, these forces, and notes."""
    start_s = options.start_s
    samples, notes = (None, ()) if options.forces is None else read_force_table(options.forces, options)
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
