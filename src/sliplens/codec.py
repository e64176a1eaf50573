"""Records on disk, typed as they are declared: JSON for what is short, Parquet for columns, NPZ for arrays.

A record is a frozen dataclass. What it declares is what its file must hold: a field that is missing, of another type or
not finite is told in one sentence with its place and its cure, by msgspec for JSON and by jaxtyping for arrays.
"""

import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import AbstractArray, jaxtyped

from sliplens.errors import InputError
from sliplens.files import to_builtins, write_json

RESULT_FILE = "result.json"
"""Record of a folder."""
ARRAYS_FILE = "arrays.npz"
"""Arrays beside it."""

Record = TypeVar("Record")
_Columns = TypeVar("_Columns", bound="Columns")


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Base of a table: a record whose fields are arrays of one length, a value a row.

    Text columns are declared as `Shaped[np.ndarray, " rows"]`, numbers with their jaxtyping type
    (`Float64[np.ndarray, " rows"]`). NaN stands where a number is unknown.
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
            known, place = np.unique(getattr(self, name), return_inverse=True)
            codes = codes * len(known) + place
        order = np.argsort(codes, kind="stable")
        pieces = np.split(order, np.flatnonzero(np.diff(codes[order])) + 1) if len(order) else []
        pieces.sort(key=lambda rows: rows[0])
        return {tuple(str(getattr(self, name)[rows[0]]) for name in names): self.where(rows) for rows in pieces}

    @classmethod
    def joined(cls: type[_Columns], pieces: Sequence[_Columns]) -> _Columns:
        """One table of the rows of several."""
        return cls(
            **{field.name: np.concatenate([getattr(one, field.name) for one in pieces]) for field in fields(cls)}
        )


def save_record(record: object, path: Path) -> None:
    """Write a record as one indented JSON file, whole or not at all.

    Raises
    ------
    ValueError
        If a number is not finite: JSON has no NaN.
    """
    write_json(path, to_builtins(record))


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
    return from_builtins(_read_json(path, command=command), kind, where=path, command=command)


def from_builtins(values: object, kind: type[Record], *, where: Path | str, command: str) -> Record:
    """Record from what JSON holds of it (`to_builtins`).

    Raises
    ------
    InputError
        If it holds something else than the record declares.

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
    except msgspec.ValidationError as error:
        raise InputError(f"{where} {_told(error)}; make it again with `{command}`") from None


def save_result(result: object, folder: Path) -> None:
    """Write a result into a folder: `result.json`, a Parquet file for each field of `Columns`, `arrays.npz` for arrays.

    What lies beside the JSON is named as its field is; the folder must exist.
    """
    assert is_dataclass(result)
    short, arrays = {}, {}
    for field in fields(result):
        value = getattr(result, field.name)
        if isinstance(value, Columns):
            save_columns(value, folder / f"{field.name}.parquet")
        elif isinstance(value, np.ndarray):
            arrays[field.name] = value
        elif _is_array_mapping(value):
            arrays |= {f"{field.name}/{name}": array for name, array in value.items()}
        else:
            short[field.name] = value
    if arrays:
        save_arrays(arrays, folder / ARRAYS_FILE)
    save_record(short, folder / RESULT_FILE)  # last: a folder with this file is whole


def load_result(folder: Path, kind: type[Record], *, command: str) -> Record:
    """Read what `save_result` wrote of a dataclass; a mistake names the command that makes the folder again.

    Raises
    ------
    InputError
        If a file is missing or damaged, or holds something else than the record declares.
    """
    path = folder / RESULT_FILE
    values = _read_json(path, command=command)
    if not isinstance(values, dict):
        raise InputError(f"{path} holds no JSON object; make it again with `{command}`")
    declared = get_type_hints(kind)
    beside = {name for name, hint in declared.items() if _is_array(hint) or _is_array_mapping_type(hint)}
    columns = {name: _columns_type(hint) for name, hint in declared.items()}
    # None stands in the JSON where there is no table
    tables = {name: table for name, table in columns.items() if table and values.get(name, ...) is not None}
    # one dataclass of what is in the JSON, so that msgspec checks it as declared; defaults are kept
    inside = [field for field in fields(kind) if field.name not in beside | tables.keys()]  # pyright: ignore[reportArgumentType]
    partial = msgspec.defstruct(
        kind.__name__, [(field.name, declared[field.name], _default(field)) for field in inside], kw_only=True
    )
    told = from_builtins(values, partial, where=path, command=command)
    given = {field.name: getattr(told, field.name) for field in inside}
    given |= {name: load_columns(folder / f"{name}.parquet", table, command=command) for name, table in tables.items()}
    if beside:
        arrays = load_arrays(folder / ARRAYS_FILE, command=command)
        with jaxtyped("context"):  # "frames" of one array are as many as "frames" of another
            for name in (field.name for field in fields(kind) if field.name in beside):  # pyright: ignore[reportArgumentType]
                alone = _is_array(declared[name])
                array_kind = declared[name] if alone else get_args(declared[name])[1]
                keys = [name] if alone else [key for key in arrays if key.startswith(f"{name}/")]
                for key in keys:
                    if key not in arrays:
                        raise InputError(f"{folder / ARRAYS_FILE} lacks {key!r}; make it again with `{command}`")
                    if not isinstance(arrays[key], array_kind):
                        raise InputError(
                            f"{folder / ARRAYS_FILE} holds {arrays[key].dtype} of shape {arrays[key].shape} as {key!r} "
                            f"where {_shown(array_kind)} belongs; make it again with `{command}`"
                        )
                given[name] = arrays[name] if alone else {key.removeprefix(f"{name}/"): arrays[key] for key in keys}
    try:
        return kind(**given)
    except ValueError as error:  # of a record that checks what its fields have to do with one another
        raise InputError(f"{folder} {error}; make it again with `{command}`") from None


def keep_part(part: Path | None, kind: type[Record], make: Callable[[], Record]) -> Record:
    """Make a piece of long work, or read it from its folder where an interrupted run has made it; None keeps none."""
    if part is None:
        return make()
    if not (part / RESULT_FILE).is_file():
        piece = make()
        part.mkdir(parents=True, exist_ok=True)
        save_result(piece, part)
    return load_result(part, kind, command="sliplens")


def save_columns(columns: Columns, path: Path) -> None:
    """Write columns as a Parquet file, whole or not at all."""
    part = path.with_name(path.name + ".part")
    pq.write_table(columns.table(), part, compression="zstd")
    part.replace(path)


def load_columns(path: Path, kind: type[_Columns], *, command: str) -> _Columns:
    """Read what `save_columns` wrote.

    Raises
    ------
    InputError
        If the file is missing or damaged, lacks a column, or a column is of another type or has gaps.
    """
    cure = f"make it again with `{command}`"
    names = [field.name for field in fields(kind)]
    try:
        table = pq.read_table(path)
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; {cure}") from None
    except (pa.ArrowException, OSError, ValueError, LookupError) as error:
        raise InputError(f"{path} is not a readable table ({_one_line(error)}); {cure}") from None
    absent = [name for name in names if name not in table.column_names]
    if absent:
        raise InputError(f"{path} lacks the column {absent[0]!r}; {cure}")
    values = {}
    for name, hint in get_type_hints(kind).items():
        column = table[name]
        if column.null_count:
            raise InputError(f"{path} has gaps in the column {name!r}; {cure}")
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            value = np.array(column.to_pylist(), dtype=str)
        else:
            value = column.to_numpy()
        # a context of its own: "rows" of one table need not be as many as "rows" of another
        with jaxtyped("context"):
            fits = not _is_array(hint) or isinstance(value, hint)
        if not fits:
            raise InputError(f"{path} holds {column.type} as {name!r} where {_shown(hint)} belongs; {cure}")
        if (hint is np.ndarray or _shown(hint).startswith("Shaped")) and value.dtype.kind != "U":
            raise InputError(f"{path} holds {column.type} as {name!r} where texts belong; {cure}")
        values[name] = value
    return kind(**values)


def write_tables(tables: Iterable[pa.Table], path: Path | None, schema: pa.Schema) -> pa.Table | None:
    """Write tables as row groups of one Parquet file, each as it comes; whole or not at all.

    A file that is there is replaced; without a path the tables are joined in memory and given back.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    if path is None:
        return pa.concat_tables([schema.empty_table(), *tables]).replace_schema_metadata(schema.metadata)
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = pq.ParquetWriter(part, schema, compression="zstd")
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror or error}); choose another file") from None
    try:
        with writer:
            for table in tables:
                writer.write_table(table.replace_schema_metadata(schema.metadata))
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return None


def save_arrays(arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Write arrays as a compressed NPZ file, whole or not at all."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]
    part.replace(path)


def load_arrays(path: Path, *, command: str) -> dict[str, np.ndarray]:
    """Read what `save_arrays` wrote.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    cure = f"make it again with `{command}`"
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive}
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; {cure}") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} cannot be read as arrays ({_one_line(error)}); {cure}") from None


def _columns_type(hint: object) -> type[Columns] | None:
    """Kind of columns that a field declares, `X` or `X | None`."""
    kinds = [kind for kind in get_args(hint) or (hint,) if kind is not NoneType]
    return kinds[0] if len(kinds) == 1 and isinstance(kinds[0], type) and issubclass(kinds[0], Columns) else None


def _is_array(hint: object) -> bool:
    return isinstance(hint, type) and (issubclass(hint, AbstractArray) or hint is np.ndarray)


def _is_array_mapping_type(hint: object) -> bool:
    return get_origin(hint) in {dict, Mapping} and _is_array(get_args(hint)[1])


def _is_array_mapping(value: object) -> bool:
    return isinstance(value, Mapping) and bool(value) and all(isinstance(item, np.ndarray) for item in value.values())


def _shown(hint: Any) -> str:
    return getattr(hint, "__name__", str(hint)).replace("ndarray, ", "")


def _default(field: Field[Any]) -> Any:
    if field.default_factory is not MISSING:
        return msgspec.field(default_factory=field.default_factory)
    return msgspec.NODEFAULT if field.default is MISSING else field.default


def _decode(kind: Any, value: object) -> object:
    if kind is object:  # whatever JSON holds
        return value
    if kind is Path:
        return Path(str(value))
    raise NotImplementedError(f"{kind} has no form in JSON")


def _read_json(path: Path, *, command: str) -> object:
    try:
        return msgspec.json.decode(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; make it with `{command}`") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({_one_line(error)}); make it again with `{command}`") from None


def _told(error: msgspec.ValidationError) -> str:
    """What msgspec found, in the words of this package: "holds str at trials[2].day where int belongs"."""
    text, _, place = str(error).partition(" - at ")
    place = place.strip("`").removeprefix("$").removeprefix(".") or "its top"
    return f"is not what was written: {text[0].lower()}{text[1:]} at {place}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


__all__ = [
    "ARRAYS_FILE",
    "RESULT_FILE",
    "Columns",
    "from_builtins",
    "keep_part",
    "load_arrays",
    "load_columns",
    "load_record",
    "load_result",
    "save_arrays",
    "save_columns",
    "save_record",
    "save_result",
    "to_builtins",
    "write_tables",
]
