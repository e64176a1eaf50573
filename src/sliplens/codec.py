"""Records on disk, typed as they are declared: JSON for what is short, Parquet for columns, NPZ for arrays.

A record is a frozen dataclass. Its declaration is what its file must hold: a field that is missing, of another type or
not finite is reported in one sentence with its place and its cure, by msgspec for JSON and by jaxtyping for arrays.
"""

import re
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from textwrap import shorten, wrap
from types import NoneType
from typing import Annotated, Any, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from jaxtyping import AbstractArray, jaxtyped

from sliplens.errors import InputError, SliplensError
from sliplens.files import read_json, require_file, whole_file, write_json

RESULT_FILE = "result.json"  #: Record of a folder.
ARRAYS_FILE = "arrays.npz"  #: Arrays beside it.

Record = TypeVar("Record")
_Columns = TypeVar("_Columns", bound="Columns")
Scalar: TypeAlias = str | int | float | None  #: Cell of a table.

UNKNOWN = "NaN where it is not known"  #: Beside the bounds of a column or an array: a number may be missing.


class _Described:
    """Base of results and of tables, whose columns may have any name."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.__repr__ = _Described.__repr__  # in the class itself: `dataclass` then makes none

    def __repr__(self) -> str:
        head = getattr(self, "summary", None) or (type(self).__doc__ or "").partition("\n")[0]
        short, long = [], []
        for field in fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, field.name)
            if field.name != "summary" and (text := _words(value, _unit(type(self), field.name))):
                label = re.sub("_(n|px|s|ms|hz|m|deg)$", "", field.name).replace("_", " ")
                lines = short if isinstance(value, str | int | float | Path) else long
                lines.append(shorten(f"{label}: {text}", 110, placeholder=" ..."))
        lines = [*wrap(", ".join(short), 110, max_lines=3), *long]
        if (over := len(lines) - _MOST_LINES + 2) > 1:
            lines[-over:] = [f"and {over} more"]
        text = "\n  ".join([f"{type(self).__name__}: {shorten(head, 240, placeholder=' ...')}", *lines])
        return text.replace("margin units", getattr(self, "unit_words", "margin units"))

    def to_arrow(self) -> pa.Table:
        """Convert the main rows to an Arrow table.

        These are the values a row of a result that has a length, else its first table, else a row for each of its first
        records, else its numbers and texts in one row.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # pyright: ignore[reportArgumentType]
        if isinstance(self, Sized):
            rows = {name: np.asarray(value) for name, value in values.items() if isinstance(value, np.ndarray | tuple)}
            return pa.table({name: value for name, value in rows.items() if value.shape == (len(self),)})
        if table := next((value for value in values.values() if isinstance(value, Columns)), None):
            return table.to_arrow()
        for value in values.values():
            records = value.values() if isinstance(value, Mapping) else value if isinstance(value, tuple) else ()
            if records and all(map(is_dataclass, records)):
                return pa.Table.from_pylist(table_rows(value))
        return pa.Table.from_pylist(table_rows([self]))


class Result(_Described):
    """Base of results: a `repr` of ten lines at most with numbers and units, and a table.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from sliplens.codec import Result
    >>> @dataclass(frozen=True)
    ... class Press(Result):
    ...     '''One press of a fingertip.'''
    ...
    ...     object: str
    ...     force_n: float
    >>> Press("cup", 1.25)
    Press: One press of a fingertip.
      object: cup, force: 1.25 N
    >>> Press("cup", 1.25).to_arrow().to_pylist()
    [{'object': 'cup', 'force_n': 1.25}]
    """

    def frame(self) -> Any:
        """Convert the main rows to a pandas table, or to the Arrow table where pandas is not installed."""
        return self.to_arrow().to_pandas() if find_spec("pandas") else self.to_arrow()


_MOST_LINES = 10
_UNITS = {
    "n": "N", "px": "px", "s": "s", "ms": "ms", "hz": "Hz", "m": "m", "deg": "degrees", "minutes": "min",
    "seconds": "s", "mse": "(margin units squared)", "mae": "margin units",
}  # fmt: skip


def _unit(kind: type, name: str) -> str:
    """Return the unit of a field: that of its declaration, else of its name."""
    with suppress(NameError):  # of a type that only type checkers import
        hint = get_type_hints(kind, include_extras=True).get(name)
        for fact in (fact for part in (hint, *get_args(hint)) for fact in getattr(part, "__metadata__", ())):
            if isinstance(fact, msgspec.Meta) and fact.description:
                return fact.description
    return _UNITS.get(name.rpartition("_")[2], "")


def _words(value: object, unit: str = "") -> str:
    """Describe a value in less than a line; the empty text where there is none."""
    text = ""
    match value:
        case None | pa.Schema():
            pass
        case float() | np.floating():
            text = f"{value:.3g} {unit}".rstrip()
        case int() if not isinstance(value, bool):
            text = f"{value:,} {unit}".rstrip()
        case np.ndarray():
            text = f"{' x '.join(map(str, value.shape))} {value.dtype}"
        case Columns() | pa.Table():
            names = [field.name for field in fields(value)] if isinstance(value, Columns) else value.column_names
            text = f"{len(value):,} rows of {', '.join(names)}"
        case Mapping():
            text = "; ".join(f"{name} {_words(each, unit)}" for name, each in islice(value.items(), 4))
        case tuple():
            text = "; ".join(_words(each, unit) for each in value[:3])
            text = text if len(value) < 4 else f"{len(value)}: {text}; ..."
        case _ if is_dataclass(value) and type(value).__str__ is object.__str__:
            kind = type(value)
            simple = [part for part in vars(value).items() if not isinstance(part[1], tuple | Mapping | np.ndarray)]
            texts = ((name, _words(part, _unit(kind, name))) for name, part in simple)
            text = ", ".join(f"{name} {words}" for name, words in islice(texts, 5) if words)
        case _:
            text = f"{value} {unit}".rstrip() if is_dataclass(value) else str(value)
    return text


def table_rows(records: Mapping[str, Record] | Sequence[Record]) -> list[dict[str, Scalar]]:
    """Return the numbers and texts of records, a row each, with their names where they have any."""
    if isinstance(records, Mapping):
        return [{"name": name} | _flat(record) for name, record in records.items()]
    return [_flat(record) for record in records]


def _flat(record: object, before: str = "") -> dict[str, Scalar]:
    """Return the numbers and texts of a record by name, those of records in it behind the name of their field."""
    cells: dict[str, Scalar] = {}
    for name, value in (record if isinstance(record, Mapping) else vars(record)).items():
        if value is None or isinstance(value, str | int | float | Path):
            cells[f"{before}{name}"] = str(value) if isinstance(value, Path) else value
        elif (is_dataclass(value) or isinstance(value, Mapping)) and not isinstance(value, Columns):
            cells |= _flat(value, f"{before}{name}_")
    return cells


@dataclass(frozen=True, kw_only=True)
class Columns(_Described):
    """Base of a table: a record whose fields are arrays of one length, a value a row.

    Text columns are declared as `Shaped[np.ndarray, " rows"]`, numbers with their jaxtyping type and the bounds that a
    loaded number must keep: `Annotated[Float64[np.ndarray, " rows"], msgspec.Meta(ge=0, le=1), UNKNOWN]`, without
    `UNKNOWN` where every row must have a number.
    """

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(getattr(self, fields(self)[0].name))

    def where(self: _Columns, rows: np.ndarray) -> _Columns:
        """Select rows by a mask or by their numbers."""
        return type(self)(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def groups(self: _Columns, *names: str) -> dict[tuple[str, ...], _Columns]:
        """Group rows by the values of some text columns, in the order in which these first appear."""
        rows: dict[tuple[str, ...], list[int]] = {}
        for row, key in enumerate(zip(*(map(str, getattr(self, name)) for name in names), strict=True)):
            rows.setdefault(key, []).append(row)
        return {key: self.where(np.array(places)) for key, places in rows.items()}

    @classmethod
    def joined(cls: type[_Columns], pieces: Sequence[_Columns]) -> _Columns:
        """Join the rows of several tables."""
        names = [field.name for field in fields(cls)]
        return cls(**{name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names})


def load_record(path: Path, kind: type[Record], *, command: str) -> Record:
    """Read a dataclass that `write_json` wrote; a mistake names the command that makes the file again.

    Raises
    ------
    InputError
        If the file is missing, is not JSON, or holds something else than the record declares.
    """
    values = read_json(path, missing=f"make it with `{command}`", damaged=_cure(command))
    return from_builtins(values, kind, where=path, command=command)


def from_builtins(values: object, kind: type[Record], *, where: Path | str, command: str) -> Record:
    """Convert the content of a JSON file to a record; a mistake is one sentence.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from sliplens.codec import from_builtins
    >>> @dataclass(frozen=True)
    ... class Grip:
    ...     force_n: float
    >>> from_builtins({"force_n": "much"}, Grip, where="a.json", command="sliplens grip")
    Traceback (most recent call last):
        ...
    sliplens.errors.InputError: a.json is not what was written (Expected `float`, got `str` - at `$.force_n`); ...
    """
    try:
        return msgspec.convert(values, kind, dec_hook=_decode, str_keys=True)
    except SliplensError as error:  # of a record that checks itself
        raise type(error)(f"{where}: {error}") from None
    except (OverflowError, msgspec.ValidationError) as error:
        raise InputError(f"{where} is not what was written ({error}); {_cure(command)}") from None


def save_result(result: object, folder: Path) -> None:
    """Write a result into a folder: `result.json`, a Parquet file for each field of `Columns`, `arrays.npz` for arrays.

    What lies beside the JSON is named as its field is; the folder must exist.
    """
    assert is_dataclass(result)
    short, arrays = {}, {}
    for field in fields(result):
        value = getattr(result, field.name)
        if isinstance(value, Columns):
            write_tables([table := value.to_arrow()], folder / f"{field.name}.parquet", table.schema)
        elif isinstance(value, np.ndarray):
            arrays[field.name] = value
        elif isinstance(value, Mapping) and value and all(isinstance(each, np.ndarray) for each in value.values()):
            arrays |= {f"{field.name}/{name}": array for name, array in value.items()}
        else:
            short[field.name] = value
    if arrays:
        with whole_file(folder / ARRAYS_FILE) as part, part.open("wb") as stream:
            np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]
    write_json(folder / RESULT_FILE, short)  # last: a folder with this file is whole


def load_result(folder: Path, kind: type[Record], *, command: str) -> Record:
    """Read a dataclass that `save_result` wrote; a mistake names the command that makes the folder again.

    Raises
    ------
    InputError
        If a file is missing or damaged, or holds something else than the record declares.
    """
    cure, declared, stored = _cure(command), get_type_hints(kind, include_extras=True), {}
    arrays = {name: hint for name, hint in declared.items() if _is_array(hint)}
    kinds = {name: (get_args(hint) or (hint,))[0] for name, hint in declared.items()}  # of `X` or `X | None`
    tables = {name: each for name, each in kinds.items() if isinstance(each, type) and issubclass(each, Columns)}
    # one dataclass of what is in the JSON, so that msgspec checks it as declared; defaults are kept
    inside = [field for field in fields(kind) if field.name not in {*arrays, *tables}]  # pyright: ignore[reportArgumentType]
    short = [(field.name, declared[field.name], copy(field)) for field in inside]
    # None stands in the JSON where there is no table
    partial = make_dataclass(kind.__name__, [*short, *((name, Any, ...) for name in tables)])
    read = load_record(folder / RESULT_FILE, partial, command=command)
    values = {field.name: getattr(read, field.name) for field in inside}
    for name, table in tables.items():
        absent = NoneType in get_args(declared[name]) and getattr(read, name) is None
        values[name] = None if absent else _load_columns(folder / f"{name}.parquet", table, cure)
    path = folder / ARRAYS_FILE
    if arrays:
        room = max(_MOST_REPEATED, MOST_TIMES * require_file(path, missing=cure))
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
                if (expanded := sum(info.file_size for info in archive.zip.infolist())) > room:
                    raise InputError(f"{path} claims arrays of {expanded:,} bytes; {cure}")
                stored = dict(archive)
        except ARRAY_DAMAGE as error:
            raise InputError(f"{path} cannot be read as arrays ({one_line(error)}); {cure}") from None
    with jaxtyped("context"):  # "frames" of one array are as many as "frames" of another
        for name, hint in arrays.items():
            mapping = _inner(hint) is not hint
            keys = [key for key in stored if key.startswith(f"{name}/")] if mapping else [name]
            for key in keys:
                if key not in stored:
                    raise InputError(f"{path} lacks {key!r}; {cure}")
                fits = isinstance(stored[key], _kind(_inner(hint)))
                _require_array(stored[key], _inner(hint), fits=fits, name=key, path=path, cure=cure)
            values[name] = {key[len(name) + 1 :]: stored[key] for key in keys} if mapping else stored[name]
    try:
        return kind(**values)
    except ValueError as error:  # of a record that checks what its fields have to do with one another
        raise InputError(f"{folder} {error}; {cure}") from None


MOST_EXPANDED, MOST_TIMES = 256 * 2**20, 100
"""Bytes that a compressed table may hold, or how many times its size; ours hold some ten times theirs."""
_MOST_ROWS, _MOST_REPEATED = 2**25, 2**31  # rows, and bytes of values that are written once and counted often
COLUMN_KINDS: dict[str, Callable[[pa.DataType], bool]] = {
    "numbers": lambda kind: pa.types.is_floating(kind) or pa.types.is_integer(kind),
    "whole numbers": pa.types.is_integer,
    "true and false": pa.types.is_boolean,
    "texts": lambda kind: pa.types.is_string(kind) or pa.types.is_large_string(kind),
    "bytes": lambda kind: pa.types.is_binary(kind) or pa.types.is_large_binary(kind),
    "values": lambda _: True,
    "lists of numbers": lambda kind: pa.types.is_fixed_size_list(kind) and pa.types.is_floating(kind.value_type),
}
"""Kind of values of a column, from its declaration."""


def open_table(path: Path) -> pq.ParquetFile:
    """Open a Parquet file; `read_table` would import pandas."""
    return pq.ParquetFile(path, memory_map=True)


@contextmanager
def open_parquet(
    path: Path, columns: Mapping[str, str], *, cure: str, error: type[InputError] = InputError
) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file that must have these columns, each of a kind (`COLUMN_KINDS`), before any row is read.

    Raises
    ------
    InputError
        If the file is missing or no Parquet, lacks a column or holds another kind in it, expands too far, or is damaged
        where it is read inside.
    """
    size = require_file(path, missing=cure, error=error)
    try:
        with open_table(path) as file:
            schema, rows = file.schema_arrow, file.metadata.num_rows
            groups = [file.metadata.row_group(group) for group in range(file.num_row_groups)]
            chunks = [group.column(at) for group in groups for at in range(group.num_columns)]
            for name, kind in columns.items():
                kinds = [schema.field(at).type for at in schema.get_all_field_indices(name)]
                if len(kinds) != 1:
                    lacks = f"has several columns {name!r}" if kinds else f"lacks the column {name!r}"
                    raise error(f"{path} {lacks}; {cure}")
                if not COLUMN_KINDS[kind](kinds[0]):
                    raise error(f"{path} holds {kinds[0]} as {name!r} where {kind} belong; {cure}")
            expanded = sum(chunk.total_uncompressed_size for chunk in chunks)
            listed = [chunk for chunk in chunks if columns.get(chunk.path_in_schema) in {"bytes", "values"}]
            once = [chunk for chunk in listed if "DICT" in str(chunk.encodings)]
            repeated = max((chunk.total_uncompressed_size * chunk.num_values for chunk in once), default=0)
            if rows > _MOST_ROWS or expanded > max(MOST_EXPANDED, MOST_TIMES * size) or repeated > _MOST_REPEATED:
                raise error(f"{path} has {size:,} bytes and claims {rows:,} rows of {expanded:,} bytes; {cure}")
            yield file
    # names, too, may be no text, and an array of any size may be asked for
    except (pa.ArrowException, OSError, ValueError, LookupError, MemoryError) as raised:
        raise error(f"{path} is not a readable Parquet file ({one_line(raised)}); {cure}") from None


def read_parquet(
    path: Path, columns: Mapping[str, str], *, cure: str, error: type[InputError] = InputError
) -> pa.Table:
    """Read columns of a Parquet file that `open_parquet` accepts, with no value missing."""
    with open_parquet(path, columns, cure=cure, error=error) as file:
        table = file.read(columns=list(columns))
    if gaps := [name for name in columns if table.column(name).null_count]:
        raise error(f"{path} has gaps in the column {gaps[0]!r}; {cure}")
    return table


_LARGEST = 1e12  # no stage measures more of anything, infinity among them; seconds since 1970 are 2e9


def _is_array(hint: Any) -> bool:
    """Return True for the declaration of arrays, `X` or `Mapping[str, X]`."""
    kind = _kind(_inner(hint))
    return isinstance(kind, type) and (issubclass(kind, AbstractArray) or kind is np.ndarray)


def _inner(hint: Any) -> Any:
    """Return the declaration of the values of a mapping, or the declaration itself."""
    return get_args(hint)[1] if get_origin(hint) in {dict, Mapping} else hint


def _kind(hint: Any) -> Any:
    """Return the type of an array without its bounds."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _words_of(hint: Any) -> str:
    return getattr(_kind(hint), "__name__", str(hint)).replace("ndarray, ", "")


def _require_array(values: np.ndarray, hint: Any, *, fits: bool, name: str, path: Path, cure: str) -> None:
    """Check type and shape, which the caller compares in its own context of sizes, and bounds of an array."""
    facts = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    if not fits:
        actual = f"{values.dtype} of shape {values.shape}"
        raise InputError(f"{path} holds {actual} as {name!r} where {_words_of(hint)} belongs; {cure}")
    for bounds in (fact for fact in facts if isinstance(fact, msgspec.Meta)):
        numbers = values[~np.isnan(values)] if UNKNOWN in facts else values
        for extreme in (numbers.min(), numbers.max()) if numbers.size else ():  # NaN where one is
            try:
                msgspec.convert(float(extreme), Annotated[float, bounds])
            except msgspec.ValidationError as error:
                raise InputError(f"{path} holds {extreme:g} as {name!r} ({error}); {cure}") from None


def _load_columns(path: Path, kind: type[_Columns], cure: str) -> _Columns:
    hints = {name: hint for name, hint in get_type_hints(kind, include_extras=True).items() if _is_array(hint)}
    words = {name: _words_of(hint) for name, hint in hints.items()}
    columns = {
        name: "true and false" if "Bool" in text else "whole numbers" if "Int" in text else "numbers"
        if "Float" in text else "texts"
        for name, text in words.items()
    }  # fmt: skip
    table = read_parquet(path, columns, cure=cure)
    values = {}
    for name, hint in hints.items():
        column = table[name]
        value = np.array(column.to_pylist(), dtype=str) if columns[name] == "texts" else column.to_numpy()
        # a context of its own: "rows" of one table need not be as many as "rows" of another
        with jaxtyped("context"):
            _require_array(value, hint, fits=isinstance(value, _kind(hint)), name=name, path=path, cure=cure)
        if value.dtype.kind == "f" and (np.abs(value) > _LARGEST).any():
            raise InputError(f"{path} holds {value[np.nanargmax(np.abs(value))]:g} as {name!r}; {cure}")
        values[name] = value
    return kind(**values)


ARRAY_DAMAGE = (
    EOFError, OSError, ValueError, LookupError, MemoryError, SyntaxError, TypeError, zipfile.BadZipFile, zlib.error,
    tokenize.TokenError,
)  # fmt: skip
"""Errors of NumPy on a damaged array or archive."""


TABLE_SUFFIXES = (".parquet", ".csv")  #: Endings of the tables that can be written.


def regrouped(tables: Iterable[pa.Table], *, rows: int) -> Iterator[pa.Table]:
    """Join tables to larger ones of so many rows at least, but for the last."""
    waiting: list[pa.Table] = []
    for table in tables:
        waiting.append(table)
        if sum(map(len, waiting)) >= rows:
            yield pa.concat_tables(waiting)
            waiting = []
    if waiting:
        yield pa.concat_tables(waiting)


def read_written(path: Path, schema: pa.Schema) -> pa.Table:
    """Read a table that `write_tables` wrote, or a data set of such, a folder a trial."""
    if path.is_dir():
        return pa.concat_tables([open_table(part).read() for part in sorted(path.glob("*=*/*.parquet"))])
    if path.suffix == ".csv":
        # the writer quotes texts, and leaves null blank
        options = pa_csv.ConvertOptions(column_types=schema, strings_can_be_null=True, quoted_strings_can_be_null=False)
        # none of Python's own: Arrow's thread may let go of it when Python has ended, and that aborts the process
        with pa.OSFile(str(path)) as stream:
            return pa_csv.read_csv(stream, convert_options=options)
    return open_table(path).read()


def write_tables(tables: Iterable[pa.Table], path: Path | None, schema: pa.Schema) -> pa.Table | None:
    """Write tables into one file, each as it comes; whole or not at all.

    The file is CSV by its ending, else Parquet, a row group a table. A file that is there is replaced; without a path
    the tables are joined in memory and returned.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    if path is None:
        # no empty table before them: each column would begin with an empty chunk
        return pa.concat_tables(list(tables) or [schema.empty_table()]).replace_schema_metadata(schema.metadata)
    with whole_file(path) as part:
        csv = path.suffix == ".csv"
        with pa_csv.CSVWriter(part, schema) if csv else pq.ParquetWriter(part, schema, compression="zstd") as writer:
            for table in tables:
                writer.write_table(table.replace_schema_metadata(schema.metadata))
    return None


def _decode(kind: Any, value: object) -> object:
    if kind is object:  # whatever JSON holds
        return value
    if kind is Path:
        return Path(str(value))
    raise NotImplementedError(f"{kind} has no form in JSON")


def _cure(command: str) -> str:
    return f"make it again with `{command}`"


def one_line(error: Exception) -> str:
    """Text of an error, without the line breaks and stacks of Arrow."""
    return " ".join(str(error).split())[:200]
