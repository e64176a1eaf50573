"""Records on disk, typed as they are declared: JSON for what is short, Parquet for columns, NPZ for arrays.

A record is a frozen dataclass. What it declares is what its file must hold: a field that is missing, of another type or
not finite is told in one sentence with its place and its cure, by msgspec for JSON and by jaxtyping for arrays.
"""

import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from math import prod
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from jaxtyping import AbstractArray, jaxtyped
from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic

from sliplens.errors import InputError, SliplensError
from sliplens.files import read_json, require_file, to_builtins, whole_file, write_json

RESULT_FILE = "result.json"
"""Record of a folder."""
ARRAYS_FILE = "arrays.npz"
"""Arrays beside it."""

Record = TypeVar("Record")
_Columns = TypeVar("_Columns", bound="Columns")


UNKNOWN = "NaN where it is not known"
"""Beside the bounds of a column or an array: a number may be missing."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Base of a table: a record whose fields are arrays of one length, a value a row.

    Text columns are declared as `Shaped[np.ndarray, " rows"]`, numbers with their jaxtyping type
    (`Float64[np.ndarray, " rows"]`) and, where it is loaded, the bounds of what they can be:
    `Annotated[Float64[np.ndarray, " rows"], msgspec.Meta(ge=0, le=1), UNKNOWN]`, without `UNKNOWN` where every row must
    have a number. What such a field declares holds of arrays as well, and without `UNKNOWN` of a number in JSON.
    """

    def __len__(self) -> int:
        """Number of rows."""
        return len(getattr(self, fields(self)[0].name))

    def where(self: _Columns, rows: np.ndarray) -> _Columns:
        """Rows of a mask, or of these numbers."""
        return type(self)(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def table(self) -> pa.Table:
        """Arrow table with a column a field; NaN stays NaN. `.to_pandas()` where pandas is installed."""
        return pa.table({field.name: getattr(self, field.name) for field in fields(self)})

    def groups(self: _Columns, *names: str) -> dict[tuple[str, ...], _Columns]:
        """Rows of each combination of values of some text columns, in the order in which these first appear."""
        codes = np.zeros(len(self), dtype=np.int64)
        for name in names:
            values, place = np.unique(getattr(self, name), return_inverse=True)
            codes = codes * len(values) + place
        order = np.argsort(codes, kind="stable")
        pieces = np.split(order, np.flatnonzero(np.diff(codes[order])) + 1) if len(order) else []
        pieces.sort(key=lambda rows: rows[0])
        return {tuple(str(getattr(self, name)[rows[0]]) for name in names): self.where(rows) for rows in pieces}

    @classmethod
    def joined(cls: type[_Columns], pieces: Sequence[_Columns]) -> _Columns:
        """One table of the rows of several."""
        names = [field.name for field in fields(cls)]
        return cls(**{name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names})


def save_record(record: object, path: Path) -> None:
    """Write a record as one indented JSON file, whole or not at all; numbers are finite, for JSON has no NaN."""
    write_json(path, record)


def load_record(path: Path, kind: type[Record], *, command: str) -> Record:
    """Read what `save_record` wrote of a dataclass; a mistake names the command that makes the file again.

    Raises
    ------
    InputError
        If the file is missing, is not JSON, or holds something else than the record declares.

    Examples
    --------
    >>> import tempfile
    >>> from dataclasses import dataclass
    >>> from pathlib import Path
    >>> from sliplens.codec import load_record, save_record
    >>> @dataclass(frozen=True)
    ... class Grip:
    ...     normal_force_n: float
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_record(Grip(2.5), Path(folder) / "grip.json")
    ...     load_record(Path(folder) / "grip.json", Grip, command="sliplens grip")
    Grip(normal_force_n=2.5)
    """
    return from_builtins(_read_json(path, command), kind, where=path, command=command)


def from_builtins(values: object, kind: type[Record], *, where: Path | str, command: str) -> Record:
    """Record from what JSON holds of it (`to_builtins`).

    Examples
    --------
    A mistake in a file is one sentence:

    >>> from dataclasses import dataclass
    >>> from sliplens.codec import from_builtins
    >>> @dataclass(frozen=True)
    ... class Grip:
    ...     normal_force_n: float
    >>> from_builtins({"normal_force_n": "much"}, Grip, where="grip.json", command="sliplens grip")
    Traceback (most recent call last):
        ...
    sliplens.errors.InputError: grip.json is not what was written: expected `float`, got `str` at normal_force_n; ...
    """
    try:
        return msgspec.convert(values, kind, dec_hook=_decode, str_keys=True)
    except SliplensError as error:  # of a record that checks itself
        raise type(error)(f"{where}: {error}") from None
    except OverflowError:
        raise InputError(f"{where} holds a number that is too large; {_cure(command)}") from None
    except msgspec.ValidationError as error:
        # in the words of this package: "expected `str`, got `int` at trials[2].day"
        text, _, place = str(error).partition(" - at ")
        place = place.strip("`").removeprefix("$").removeprefix(".") or "its top"
        message = f"is not what was written: {text[0].lower()}{text[1:]} at {place}"
        raise InputError(f"{where} {message}; {_cure(command)}") from None


def save_result(result: object, folder: Path) -> None:
    """Write a result into a folder: `result.json`, a Parquet file for each field of `Columns`, `arrays.npz` for arrays.

    What lies beside the JSON is named as its field is; the folder must exist.
    """
    assert is_dataclass(result)
    short, arrays = {}, {}
    for field in fields(result):
        value = getattr(result, field.name)
        if isinstance(value, Columns):
            write_tables([value.table()], folder / f"{field.name}.parquet", value.table().schema)
        elif isinstance(value, np.ndarray):
            arrays[field.name] = value
        elif _is_array_mapping(value):
            arrays |= {f"{field.name}/{name}": array for name, array in value.items()}
        else:
            short[field.name] = value
    if arrays:
        with whole_file(folder / ARRAYS_FILE) as part, part.open("wb") as stream:
            np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]
    save_record(short, folder / RESULT_FILE)  # last: a folder with this file is whole


def load_result(folder: Path, kind: type[Record], *, command: str) -> Record:
    """Read what `save_result` wrote of a dataclass; a mistake names the command that makes the folder again.

    Raises
    ------
    InputError
        If a file is missing or damaged, or holds something else than the record declares.
    """
    path, cure = folder / RESULT_FILE, _cure(command)
    values = _read_json(path, command)
    if not isinstance(values, dict):
        raise InputError(f"{path} holds no JSON object; {cure}")
    declared = get_type_hints(kind, include_extras=True)
    arrays = {name: hint for name, hint in declared.items() if _array_type(hint) is not None}
    columns = {name: _columns_type(hint) for name, hint in declared.items()}
    # None stands in the JSON where there is no table
    tables = {
        name: table
        for name, table in columns.items()
        if table and not (NoneType in get_args(declared[name]) and values.get(name, ...) is None)
    }
    # one dataclass of what is in the JSON, so that msgspec checks it as declared; defaults are kept
    beside = {*arrays, *(name for name, table in columns.items() if table)}
    inside = [field for field in fields(kind) if field.name not in beside]  # pyright: ignore[reportArgumentType]
    partial = make_dataclass(kind.__name__, [(field.name, declared[field.name], copy(field)) for field in inside])
    read = from_builtins(values, partial, where=path, command=command)
    values = {field.name: getattr(read, field.name) for field in inside}
    values |= dict.fromkeys(beside)
    values |= {name: _load_columns(folder / f"{name}.parquet", table, cure) for name, table in tables.items()}
    values |= _load_arrays(folder / ARRAYS_FILE, arrays, cure) if arrays else {}
    try:
        return kind(**values)
    except ValueError as error:  # of a record that checks what its fields have to do with one another
        raise InputError(f"{folder} {error}; {cure}") from None


def keep_part(part: Path | None, kind: type[Record], make: Callable[[], Record]) -> Record:
    """Make a piece of long work, or read it from its folder where an interrupted run has made it; None keeps none."""
    if part is None:
        return make()
    if (part / RESULT_FILE).is_file():
        with suppress(InputError):  # damaged as the machine went down: nobody could make this part alone again
            return load_result(part, kind, command="sliplens")
    piece = make()
    part.mkdir(parents=True, exist_ok=True)
    save_result(piece, part)
    return load_result(part, kind, command="sliplens")


MOST_EXPANDED, MOST_TIMES = 256 * 2**20, 100
"""Bytes that a compressed table may hold, or how many times its size; ours hold some ten times theirs."""
_MOST_ROWS = 2**25
_MOST_ARRAYS = 2**31  # bytes that arrays or texts of a small file may expand to, a thousand times what most do
_MOST_TEXT = 2**27  # characters, were all texts of a column as long as the longest, as NumPy keeps them
COLUMN_KINDS: dict[str, Callable[[pa.DataType], bool]] = {
    "numbers": lambda kind: pa.types.is_floating(kind) or pa.types.is_integer(kind),
    "whole numbers": pa.types.is_integer,
    "true and false": pa.types.is_boolean,
    "texts": lambda kind: pa.types.is_string(kind) or pa.types.is_large_string(kind),
    "bytes": lambda kind: pa.types.is_binary(kind) or pa.types.is_large_binary(kind),
    "values": lambda _: True,
    "lists of numbers": lambda kind: pa.types.is_fixed_size_list(kind) and pa.types.is_floating(kind.value_type),
}
"""What a column may hold, by its words."""


@contextmanager
def parquet_errors(path: Path, *, cure: str, error: type[InputError] = InputError) -> Iterator[None]:
    """Tell in one sentence what Arrow raises of a missing or damaged file, whatever is read of it inside."""
    try:
        yield
    except FileNotFoundError:
        raise error(f"{path} does not exist; {cure}") from None
    # names, too, may be no text, and an array of any size may be asked for
    except (pa.ArrowException, OSError, ValueError, LookupError, MemoryError) as raised:
        raise error(f"{path} is not a readable Parquet file ({one_line(raised)}); {cure}") from None


def open_table(path: Path, **how: Any) -> pq.ParquetFile:
    """Open a Parquet file on disk or in a store; `read_table` would import pandas."""
    return pq.ParquetFile(path, memory_map=True, **how)


def open_parquet(
    path: Path, columns: Mapping[str, str], *, cure: str, error: type[InputError] = InputError
) -> pq.ParquetFile:
    """Open a Parquet file that must have these columns, each of a kind (`COLUMN_KINDS`), before any row is read.

    Raises
    ------
    InputError
        If the file is missing or no Parquet, lacks a column or holds another kind in it, or expands too far.
    """
    try:
        size = require_file(path, missing=cure)
    except InputError as raised:
        raise error(str(raised)) from None
    with parquet_errors(path, cure=cure, error=error):
        file = open_table(path)
        schema, rows = file.schema_arrow, file.metadata.num_rows
        names = schema.names
        groups = [file.metadata.row_group(group) for group in range(file.num_row_groups)]
        chunks = [group.column(at) for group in groups for at in range(group.num_columns)]
        expanded = sum(chunk.total_uncompressed_size for chunk in chunks)
        kinds = {name: schema.field(name).type for name in columns if names.count(name) == 1}
        # what is written once and counted often grows as it is read; texts are bounded as they are read
        whole = {name for name, kind in columns.items() if kind in {"bytes", "values"}}
        repeated = max(
            (
                chunk.total_uncompressed_size * chunk.num_values
                for chunk in chunks
                if chunk.path_in_schema in whole
                and chunk.physical_type == "BYTE_ARRAY"
                and any("DICT" in encoding for encoding in chunk.encodings)
            ),
            default=0,
        )
    if absent := sorted(name for name in columns if name not in names):
        raise error(f"{path} lacks the column {', '.join(map(repr, absent))}; {cure}")
    for name, kind in columns.items():
        if name not in kinds:
            raise error(f"{path} has several columns {name!r}; {cure}")
        if not COLUMN_KINDS[kind](kinds[name]):
            raise error(f"{path} holds {kinds[name]} as {name!r} where {kind} belong; {cure}")
    room = max(MOST_EXPANDED, MOST_TIMES * size)
    if rows > _MOST_ROWS or expanded > room or repeated > _MOST_ARRAYS:
        raise error(f"{path} has {size:,} bytes and claims {rows:,} rows of {expanded:,} bytes; {cure}")
    return file


def read_parquet(
    path: Path, columns: Mapping[str, str], *, cure: str, error: type[InputError] = InputError
) -> pa.Table:
    """Columns of a Parquet file as `open_parquet` lets it in, with no value missing."""
    open_parquet(path, columns, cure=cure, error=error).close()
    texts = [name for name, kind in columns.items() if kind == "texts"]
    with parquet_errors(path, cure=cure, error=error):
        # a text that is repeated is held once until its length is known
        with open_table(path, read_dictionary=texts) as file:
            table = file.read(columns=list(columns))
        for name in texts:
            chunks = table.column(name).chunks
            longest = max((len(text or "") for chunk in chunks for text in chunk.dictionary.to_pylist()), default=0)
            if longest * table.num_rows > _MOST_TEXT:
                raise ValueError(f"{table.num_rows:,} texts of {longest:,} characters in {name!r}")
            plain = pa.chunked_array([chunk.dictionary_decode() for chunk in chunks], pa.string())
            table = table.set_column(table.column_names.index(name), name, plain)
    if gaps := [name for name in columns if table.column(name).null_count]:
        raise error(f"{path} has gaps in the column {gaps[0]!r}; {cure}")
    return table


def _kind_of(hint: Any) -> str:
    """Kind of a column that a field of `Columns` declares."""
    name = _shown(hint)
    if hint is np.ndarray or name.startswith("Shaped"):
        return "texts"
    return "true and false" if name.startswith("Bool") else "whole numbers" if "Int" in name else "numbers"


_SIDES: dict[str, tuple[str, Callable[..., np.ndarray]]] = {
    "ge": ("at least", np.less), "gt": ("above", np.less_equal), "le": ("at most", np.greater),
    "lt": ("below", np.greater_equal),
}  # fmt: skip
"""Bounds of `msgspec.Meta`: their words, and what says that a number is outside."""


def _require_possible(values: np.ndarray, hint: Any, *, name: str, path: Path, cure: str) -> None:
    """Check numbers against the bounds that their field declares, if it does."""
    hint = _one_array(hint)
    facts = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    bounds = [fact for fact in facts if isinstance(fact, msgspec.Meta)]
    sides = {side: limit for bound in bounds for side in _SIDES if (limit := getattr(bound, side)) is not None}
    wrong = np.isnan(values) if bounds and UNKNOWN not in facts else np.zeros(values.shape, dtype=np.bool_)
    for side, limit in sides.items():
        wrong |= _SIDES[side][1](values, limit)
    if wrong.any():
        belong = " and ".join(f"{_SIDES[side][0]} {limit:g}" for side, limit in sides.items())
        raise InputError(f"{path} holds {values[wrong][0]:g} as {name!r}, which must be {belong}; {cure}")


_LARGEST = 1e12
"""No stage measures more of anything, infinity among them; seconds since 1970 are 2e9."""


def _load_columns(path: Path, kind: type[_Columns], cure: str) -> _Columns:
    declared = get_type_hints(kind, include_extras=True)
    kinds = {name: _kind_of(_array_type(hint)) for name, hint in declared.items()}
    table = read_parquet(path, kinds, cure=cure)
    values = {}
    for name, hint in declared.items():
        column = table[name]
        value = np.array(column.to_pylist(), dtype=str) if kinds[name] == "texts" else column.to_numpy()
        # a context of its own: "rows" of one table need not be as many as "rows" of another
        with jaxtyped("context"):
            if not isinstance(value, plain := _array_type(hint)):
                raise InputError(f"{path} holds {column.type} as {name!r} where {_shown(plain)} belongs; {cure}")
        if value.dtype.kind == "f" and (np.abs(value) > _LARGEST).any():
            raise InputError(f"{path} holds {value[np.nanargmax(np.abs(value))]:g} as {name!r}; {cure}")
        _require_possible(value, hint, name=name, path=path, cure=cure)
        values[name] = value
    return kind(**values)


TABLE_SUFFIXES = (".parquet", ".csv", ".json")
"""Endings of the tables that can be written: Parquet, CSV, and JSON with one object a row."""


class _JsonWriter:
    """Rows as a JSON array, one object a line; what is not known is null."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("wb")
        self._first = True

    def __enter__(self) -> "_JsonWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.write(b"[]\n" if self._first else b"\n]\n")
        self._stream.close()

    def write_table(self, table: pa.Table) -> None:
        for row in table.to_pylist():
            self._stream.write((b"[\n" if self._first else b",\n") + msgspec.json.encode(row))
            self._first = False


def _table_writer(part: Path, schema: pa.Schema, suffix: str) -> Any:
    if suffix == ".csv":
        return pa_csv.CSVWriter(part, schema)
    return _JsonWriter(part) if suffix == ".json" else pq.ParquetWriter(part, schema, compression="zstd")


def regrouped(tables: Iterable[pa.Table], *, rows: int) -> Iterator[pa.Table]:
    """The same rows in tables of so many at least, but for the last."""
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
    if path.suffix == ".json":
        return pa.Table.from_pylist(msgspec.json.decode(path.read_bytes()), schema)
    return open_table(path).read()


def write_tables(tables: Iterable[pa.Table], path: Path | None, schema: pa.Schema) -> pa.Table | None:
    """Write tables into one file, each as it comes; whole or not at all.

    The file is Parquet, a row group a table, or by its ending CSV or JSON (`TABLE_SUFFIXES`). A file that is there is
    replaced; without a path the tables are joined in memory and given back.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    if path is None:
        # no empty table before them: each column would begin with an empty chunk
        return pa.concat_tables(list(tables) or [schema.empty_table()]).replace_schema_metadata(schema.metadata)
    with whole_file(path) as part, _table_writer(part, schema, path.suffix) as writer:
        for table in tables:
            writer.write_table(table.replace_schema_metadata(schema.metadata))
    return None


def _require_claimed(archive: zipfile.ZipFile, info: zipfile.ZipInfo, room: int) -> int:
    """Bytes of an array, which must be as many as its header claims: that much memory is taken before it is read."""
    with archive.open(info) as member:
        read = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}[read_magic(member)]
        shape, _, kind = read(member)
    if prod(shape) * kind.itemsize > min(info.file_size, room):
        raise ValueError(f"{info.filename} claims {kind} of shape {shape}")
    return info.file_size


_NO_ARRAYS = (
    OSError, ValueError, LookupError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error, tokenize.TokenError,
)  # fmt: skip
"""What NumPy raises of a damaged archive; its headers are read as text of Python where they are old."""


def _load_arrays(path: Path, declared: Mapping[str, Any], cure: str) -> dict[str, Any]:
    """Arrays of the fields of a record, each alone or a mapping of several."""
    room = max(_MOST_ARRAYS, MOST_TIMES * require_file(path, missing=cure))
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            for info in archive.zip.infolist():
                room -= _require_claimed(archive.zip, info, room)
            arrays = {name: archive[name] for name in archive}
    except _NO_ARRAYS as error:
        raise InputError(f"{path} cannot be read as arrays ({one_line(error)}); {cure}") from None
    loaded = {}
    with jaxtyped("context"):  # "frames" of one array are as many as "frames" of another
        for name, hint in declared.items():
            kind, alone = _array_type(hint), hint is _one_array(hint)
            keys = [name] if alone else [key for key in arrays if key.startswith(f"{name}/")]
            for key in keys:
                if key not in arrays:
                    raise InputError(f"{path} lacks {key!r}; {cure}")
                if not isinstance(arrays[key], kind):
                    actual = f"{arrays[key].dtype} of shape {arrays[key].shape}"
                    raise InputError(f"{path} holds {actual} as {key!r} where {_shown(kind)} belongs; {cure}")
                _require_possible(arrays[key], hint, name=key, path=path, cure=cure)
            loaded[name] = arrays[name] if alone else {key[len(name) + 1 :]: arrays[key] for key in keys}
    return loaded


def _columns_type(hint: object) -> type[Columns] | None:
    """Kind of columns that a field declares, `X` or `X | None`."""
    kinds = [kind for kind in get_args(hint) or (hint,) if kind is not NoneType]
    return kinds[0] if len(kinds) == 1 and isinstance(kinds[0], type) and issubclass(kinds[0], Columns) else None


def _one_array(hint: Any) -> Any:
    return get_args(hint)[1] if get_origin(hint) in {dict, Mapping} else hint


def _array_type(hint: object) -> Any:
    """Type of the arrays that a field declares, `X` or `Mapping[str, X]`; None where it declares none."""
    kind = _one_array(hint)
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    return kind if isinstance(kind, type) and (issubclass(kind, AbstractArray) or kind is np.ndarray) else None


def _is_array_mapping(value: object) -> bool:
    return isinstance(value, Mapping) and bool(value) and all(isinstance(item, np.ndarray) for item in value.values())


def _shown(hint: Any) -> str:
    return getattr(hint, "__name__", str(hint)).replace("ndarray, ", "")


def _decode(kind: Any, value: object) -> object:
    if kind is object:  # whatever JSON holds
        return value
    if kind is Path:
        return Path(str(value))
    raise NotImplementedError(f"{kind} has no form in JSON")


def _cure(command: str) -> str:
    return f"make it again with `{command}`"


def _read_json(path: Path, command: str) -> object:
    return read_json(path, missing=f"make it with `{command}`", damaged=_cure(command))


def one_line(error: Exception) -> str:
    """Text of an error, without the line breaks and stacks of Arrow."""
    return " ".join(str(error).split())[:200]


__all__ = [
    "Columns", "from_builtins", "keep_part", "load_record", "load_result", "save_record", "save_result", "to_builtins",
    "write_tables",
]  # fmt: skip
