"""Tables in text files: what separates the columns, what they are called, and the numbers in them."""

import codecs
import csv
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sliplens.errors import RecordingError

_SEPARATORS = ("\t", ";", ",")  # a comma may be a decimal one where another separator is there
_COMMENTS = ("#", "%")
_PROBED_BYTES = 65536
_CONTROLS = frozenset(range(32)) - frozenset(b"\t\n\r\f\x1a\x1b")


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A table of a text file, its rows read one at a time."""

    path: Path
    encoding: str
    separator: str
    header: tuple[str, ...]
    first_line: int
    """Line of the file after the header, counted from 1."""

    def require(self, name: str, *, option: str) -> str:
        """Return the name of a column as the file writes it.

        Raises
        ------
        RecordingError
            If there is no such column, or more than one.
        """
        same = [there for there in self.header if there == name] or [
            there for there in self.header if there.strip().lower() == name.strip().lower()
        ]
        if not same:
            raise RecordingError(
                f"{self.path} has no column {name!r}, it has {', '.join(map(repr, self.header))}; "
                f"name one of them with {option}"
            )
        if len(same) > 1:
            raise RecordingError(f"{self.path} has {len(same)} columns {name!r}; rename one of them")
        return same[0]

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Read the rows: the number of the line, and a text a column.

        Raises
        ------
        RecordingError
            If a row has more or fewer columns than the header.
        """
        for line, text in _lines(self.path, self.encoding):
            if line < self.first_line or _is_comment(text):
                continue
            fields = _split(text, self.separator, where=f"{self.path}, line {line}")
            if len(fields) == len(self.header) + 1 and not fields[-1]:
                fields.pop()  # some loggers end every row, but not the header, with a separator
            if len(fields) != len(self.header):
                cure = "mend or drop the line"
                if self.separator == "," and len(fields) > len(self.header):
                    cure = "where decimals are commas, separate the columns by semicolons"
                raise RecordingError(
                    f"{self.path}, line {line} has {len(fields)} columns but the header {len(self.header)}; {cure}"
                )
            yield line, fields


def open_table(path: Path) -> TextTable:
    """Find the separator and the header of a table; a byte order mark, comments and empty lines are passed over.

    Raises
    ------
    RecordingError
        If the file is missing or empty, is no text, or has no header.
    """
    encoding = _encoding(path)
    comment = ""
    for line, text in _lines(path, encoding):
        if _is_comment(text):
            comment = text
            continue
        separator = next((mark for mark in _SEPARATORS if mark in text), None)
        if separator is None:
            raise RecordingError(
                f"{path} has a single column {text.strip()[:40]!r}; separate the columns by commas, semicolons or tabs"
            )
        header, first_line = _split(text, separator, where=f"{path}, line {line}"), line + 1
        if all(map(_is_number, header)):
            # NumPy writes the header as a comment
            header, first_line = _split(comment.lstrip("#% "), separator, where=f"{path}, line {line}"), line
            if len(header) != text.count(separator) + 1:
                raise RecordingError(
                    f"{path} begins with numbers, not with the names of its columns; "
                    "add a first line such as time_s,fx,fy,fz"
                )
        return TextTable(path=path, encoding=encoding, separator=separator, header=tuple(header), first_line=first_line)
    raise RecordingError(f"{path} is empty; name a table with a header and a row a sample")


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """Columns of numbers."""

    values: Float[np.ndarray, "rows columns"]
    lines: tuple[int, ...]
    """Line of the file, for each row."""
    decimal_comma: bool


def read_numbers(table: TextTable, names: Sequence[str]) -> Numbers:
    """Read columns of a table as finite numbers.

    Raises
    ------
    RecordingError
        If there is no row, or a field is empty, no number or not finite; the message gives its line.
    """
    places = [table.header.index(name) for name in names]
    values, lines = array("d"), array("q")
    commas = points = False
    for line, fields in table.rows():
        lines.append(line)
        for place in places:
            text = fields[place]
            points |= "." in text
            if "," in text:
                commas = True
                text = text.replace(",", ".")
            values.append(
                to_number(text, shown=fields[place], where=f"{table.path}, line {line}, {_name(table, place)}")
            )
    if not lines:
        raise RecordingError(f"{table.path} has a header but no row; record the force sensor too")
    if commas and points:
        raise RecordingError(f"{table.path} mixes decimal commas and points; write all numbers in one way")
    return Numbers(
        values=np.frombuffer(values, dtype=np.float64).reshape(-1, len(places)),
        lines=tuple(lines),
        decimal_comma=commas,
    )


def to_number(text: str, *, shown: str, where: str) -> float:
    """Read a finite number.

    Raises
    ------
    RecordingError
        If it is none; the message begins with `where`.
    """
    if not text:
        raise RecordingError(f"{where} is empty; mend or drop the line")
    try:
        value = float(text)
    except ValueError:
        raise RecordingError(
            f"{where} is {shown[:40]!r}, not a number; mend the line, or name another column"
        ) from None
    if not isfinite(value):
        raise RecordingError(f"{where} is {shown!r}, not a finite number; mend or drop the line")
    return value


def require_rising(time: Float[np.ndarray, " rows"], lines: Sequence[int], *, path: Path, column: str) -> None:
    """Check that times rise from row to row.

    Raises
    ------
    RecordingError
        Naming the line of the first that does not.
    """
    for row, (before, after) in enumerate(pairwise(time.tolist())):
        if not after > before:
            what = "repeats" if after == before else "falls"
            raise RecordingError(
                f"{path}, line {lines[row + 1]}: {column!r} {what} ({before:.9g}, then {after:.9g}); "
                "sort the rows or mend their stamps"
            )


def _name(table: TextTable, place: int) -> str:
    return repr(table.header[place])


def _encoding(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            start = stream.read(_PROBED_BYTES)
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; check the path") from None
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); name a text file") from None
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"  # "Unicode text" of Excel
    if not _CONTROLS.isdisjoint(start):
        raise RecordingError(f"{path} is not a text file; export the table as CSV")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return "cp1252"  # the micro sign of an older logger on Windows
    return "utf-8-sig"


def _lines(path: Path, encoding: str) -> Iterator[tuple[int, str]]:
    """Read the lines that are not empty, with their numbers."""
    try:
        with path.open(encoding=encoding) as stream:
            for number, text in enumerate(stream, start=1):
                if text.strip():
                    yield number, text.rstrip("\r\n")
    except UnicodeError:
        raise RecordingError(f"{path} is not a text file; export the table as CSV") from None


def _split(text: str, separator: str, *, where: str) -> list[str]:
    try:
        fields = next(csv.reader([text], delimiter=separator, skipinitialspace=separator != "\t"))
    except csv.Error as error:
        raise RecordingError(f"{where} cannot be split into columns ({error}); export the table again") from None
    return [field.strip() for field in fields]


def _is_comment(text: str) -> bool:
    return text.lstrip().startswith(_COMMENTS)


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
