import re
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import numpy as np
import pyarrow as pa
import pytest
from jaxtyping import Float32, Float64, Int64
from msgspec import Meta

from sliplens.codec import (
    TABLE_SUFFIXES,
    UNKNOWN,
    Columns,
    load_record,
    load_result,
    read_written,
    save_result,
    write_json,
    write_tables,
)
from sliplens.errors import InputError
from sliplens.grip import records as grip_records
from sliplens.results import evaluation, explanation, faithfulness, study

NEVER_LOADED = {faithfulness.DeletionCurve, faithfulness.RemovalCurve}
"""Records of `results` that are made of tables when these have been read."""


@dataclass(frozen=True, kw_only=True)
class Rows(Columns):
    trial: np.ndarray
    frame: Int64[np.ndarray, " rows"]
    margin: Float64[np.ndarray, " rows"]


@dataclass(frozen=True, kw_only=True)
class Part:
    name: str
    error: float | None
    curve: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Found:
    input: str
    parts: tuple[Part, ...]
    by_name: Mapping[str, float]
    rows: Rows
    maps: Mapping[str, Float32[np.ndarray, "frames height width"]]
    one: Float64[np.ndarray, " steps"]
    notes: tuple[str, ...] = ()


def found() -> Found:
    return Found(
        input="raw",
        parts=(Part(name="a", error=None, curve=(0.0, 0.5)), Part(name="b", error=0.25, curve=())),
        by_name={"dry": np.float64(0.5).item()},
        rows=Rows(trial=np.array(["t", "t"]), frame=np.array([0, 1]), margin=np.array([np.nan, 1.0])),
        maps={"grad-cam": np.ones((2, 3, 3), dtype=np.float32)},
        one=np.array([1.0, np.inf]),
    )


def test_a_result_comes_back_as_it_was(tmp_path):
    save_result(found(), tmp_path)
    back = load_result(tmp_path, Found, command="sliplens x")
    wanted = found()
    assert (back.input, back.by_name, back.notes) == (wanted.input, wanted.by_name, ())
    assert back.parts == wanted.parts
    for name in ("trial", "frame", "margin"):
        np.testing.assert_array_equal(getattr(back.rows, name), getattr(wanted.rows, name))
    np.testing.assert_array_equal(back.maps["grad-cam"], wanted.maps["grad-cam"])
    np.testing.assert_array_equal(back.one, wanted.one)
    assert back.rows.frame.dtype == np.int64


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"raw"', "7", r"Expected `str`, got `int` - at `\$.input`"),
        ('"error": 0.25', '"error": "x"', r"at `\$.parts\[1\].error"),
        ('"input"', '"output"', "missing required field `input`"),
        ('"error": 0.25', '"error": NaN', "not valid JSON"),
        ("0.0,\n", '"x",\n', r"at `\$.parts\[0\].curve"),
        ("{", "[", "not valid JSON"),
    ],
)
def test_a_damaged_file_is_told_with_its_place_and_its_cure(tmp_path, old, new, said):
    save_result(found(), tmp_path)
    path = tmp_path / "result.json"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=said) as error:
        load_result(tmp_path, Found, command="sliplens x")
    assert str(path) in str(error.value)
    assert "`sliplens x`" in str(error.value)


@pytest.mark.parametrize("name", ["result.json", "rows.parquet", "arrays.npz"])
@pytest.mark.parametrize("damage", ["absent", "garbage"])
def test_a_file_that_is_missing_or_no_such_file_is_told(tmp_path, name, damage):
    save_result(found(), tmp_path)
    if damage == "absent":
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_bytes(b"garbage")
    with pytest.raises(InputError, match=name):
        load_result(tmp_path, Found, command="sliplens x")


def test_arrays_damaged_inside_are_told(tmp_path, rng):
    @dataclass(frozen=True, kw_only=True)
    class Noise:
        noise: Float64[np.ndarray, " values"]

    save_result(Noise(noise=rng.normal(size=1000)), tmp_path)
    path = tmp_path / "arrays.npz"
    whole = path.read_bytes()
    # the head of the compressed stream, and the middle
    for at in (whole.index(b"noise.npy") + len(b"noise.npy") + 20, len(whole) // 2):
        path.write_bytes(whole[:at] + bytes(64) + whole[at + 64 :])
        with pytest.raises(InputError, match="cannot be read as arrays"):
            load_result(tmp_path, Noise, command="sliplens x")


def test_a_column_of_another_type_is_told(tmp_path):
    wrong = Rows(trial=np.array([1.0]), frame=np.array([0]), margin=np.array([0.5]))
    save_result(replace(found(), rows=wrong), tmp_path)
    with pytest.raises(InputError, match="'trial' where texts belong"):
        load_result(tmp_path, Found, command="sliplens x")


@dataclass(frozen=True, kw_only=True)
class Bounded(Columns):
    share: Annotated[Float64[np.ndarray, " rows"], Meta(ge=0, le=1)]
    guess: Annotated[Float64[np.ndarray, " rows"], Meta(gt=0, lt=2), UNKNOWN]


@dataclass(frozen=True, kw_only=True)
class Bound:
    error: Annotated[float, Meta(ge=0)] | None
    rows: Bounded | None
    maps: dict[str, Annotated[Float32[np.ndarray, "frames pixels"], Meta(ge=-1)]]


@pytest.mark.parametrize(
    ("place", "held", "said"),
    [
        ("share", 1.5, "1.5 as 'share' (Expected `float` <= 1.0); make it again with `sliplens x`"),
        ("share", np.nan, "nan as 'share' (Expected"),
        ("guess", 0.0, "0 as 'guess' (Expected `float` > 0.0"),
        ("guess", 2.0, "2 as 'guess' (Expected `float` < 2.0"),
        ("maps", np.inf, ""),
        ("maps", np.nan, "nan as 'maps/a' (Expected `float` >= -1.0"),
        ("error", -1e-9, "Expected `float` >= 0.0 - at `$.error`"),
        ("guess", np.nan, ""),
    ],
)
def test_what_lies_outside_of_the_bounds_of_its_field_is_told(tmp_path, place, held, said):
    values = {"share": 1.0, "guess": 1.0, "maps": -1.0, "error": 0.0} | {place: held}
    rows = {name: np.array([0.5, values[name]]) for name in ("share", "guess")}
    maps = {"a": np.full((1, 2), values["maps"], dtype=np.float32)}
    save_result(Bound(error=values["error"], rows=Bounded(**rows), maps=maps), tmp_path)
    with pytest.raises(InputError, match=re.escape(said)) if said else nullcontext():
        load_result(tmp_path, Bound, command="sliplens x")


def test_a_table_that_may_be_missing_is_none(tmp_path):
    save_result(bound := Bound(error=None, rows=None, maps={"a": np.zeros((1, 1), dtype=np.float32)}), tmp_path)
    assert load_result(tmp_path, Bound, command="sliplens x") == bound
    (tmp_path / "result.json").write_text('{"input": "x", "parts": [], "by_name": {}, "rows": null}')
    with pytest.raises(InputError, match=r"rows\.parquet does not exist"):  # a table that each must have
        load_result(tmp_path, Found, command="sliplens x")


def test_every_number_in_the_tables_and_maps_of_results_has_bounds():
    def declared(kind: type) -> Iterator[tuple[str, object]]:
        for name, hint in get_type_hints(kind, include_extras=True).items():
            one = get_args(hint)[1] if get_origin(hint) is dict else hint
            if "Float" in str(one) and "ndarray" in str(one):
                yield f"{kind.__name__}.{name}", one

    records = [
        one for module in (evaluation, explanation, faithfulness, grip_records, study) for one in vars(module).values()
        if isinstance(one, type) and one.__module__ == module.__name__ and one not in NEVER_LOADED
    ]  # fmt: skip
    numbers = {name: hint for one in records for name, hint in declared(one)}
    assert len(numbers) > 50
    assert [name for name, hint in numbers.items() if not any(isinstance(one, Meta) for one in get_args(hint))] == []


def test_maps_of_another_shape_are_told(tmp_path):
    @dataclass(frozen=True, kw_only=True)
    class Flat:
        maps: Mapping[str, Float32[np.ndarray, "frames pixels"]]

    save_result(Flat(maps={"a": np.ones((2, 3), dtype=np.float32)}), tmp_path)
    deep = {"maps/a": np.ones((2, 3, 3), dtype=np.float32)}
    np.savez_compressed(tmp_path / "arrays.npz", **deep)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="shape"):
        load_result(tmp_path, Flat, command="sliplens x")


def test_a_number_that_is_not_finite_is_never_written(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "part.json", Part(name="a", error=float("nan"), curve=()))
    assert not (tmp_path / "part.json").exists()


def test_a_record_alone_comes_back(tmp_path: Path):
    @dataclass(frozen=True, kw_only=True)
    class Place:
        folder: Path
        share: float
        config: object  # as JSON holds it

    place = Place(folder=tmp_path, share=0.5, config={"a": [1, 2]})
    write_json(tmp_path / "place.json", place)
    assert load_record(tmp_path / "place.json", Place, command="sliplens x") == place


@pytest.mark.parametrize("suffix", TABLE_SUFFIXES)
@pytest.mark.parametrize("rows", [0, 3])
def test_a_table_comes_back_from_every_ending(tmp_path: Path, suffix: str, rows: int):
    schema = pa.schema([("trial", pa.string()), ("frame", pa.int64()), ("margin", pa.float64())])
    table = pa.table({"trial": ["a, b", 'c "d"', "e"], "frame": [0, 1, 2], "margin": [0.25, None, 1 / 3]}, schema)
    path = tmp_path / f"table{suffix}"
    assert write_tables([table.slice(0, min(rows, 1)), table.slice(1, max(rows - 1, 0))], path, schema) is None
    assert read_written(path, schema).equals(table.slice(0, rows))
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_tables_joined_in_memory_have_a_piece_each():
    schema = pa.schema({"trial": pa.string()}, metadata={"kept": "yes"})
    tables = [pa.table({"trial": [name]}, schema.remove_metadata()) for name in "ab"]
    for given, pieces in (tables, [1, 1]), ([], [0]):
        joined = write_tables(given, None, schema)
        assert joined is not None
        assert joined.schema.equals(schema, check_metadata=True)
        assert [len(one) for one in joined["trial"].chunks] == pieces
