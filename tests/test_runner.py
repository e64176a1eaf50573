"""Parts of a work: complete or absent, resumed, the same bytes from every executor."""

import os
import sys
from collections.abc import Callable
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import SimpleNamespace

import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from counted_parts import Count, CountInThreads, parts
from data_sets import contents

from sliplens.errors import InputError, PartError
from sliplens.files import locked, require_new_table
from sliplens.progress import reporting
from sliplens.runner import Part, part, run_parts, run_table

TITLE = "Counting"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    (tmp_path / "log").mkdir()
    return tmp_path / "log"


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def make(
    work: Count,
    out: Path,
    every: list[Part] | None = None,
    *,
    listener: Callable[[int, int], None] | None = None,
    **options: object,
) -> None:
    with reporting(listener):
        run_parts(work, parts() if every is None else every, out, **options)  # pyright: ignore


def test_a_part_is_made_once_and_only_what_is_missing_is_made_again(log: Path, out: Path):
    calls: list[tuple[int, int]] = []
    make(Count(log=log), out, listener=lambda done, total: calls.append((done, total)))
    assert sorted(contents(out)) == [each.path for each in parts()]  # and nothing else
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)
    assert calls[-1] == (15, 15)
    before = contents(out)
    (out / parts()[0].path).unlink()
    make(Count(log=log), out)
    assert contents(out) == before
    assert Count(log=log).tries() == {"a": 2, "b": 1, "c": 1, "d": 1, "e": 1}


def test_whatever_shapes_a_part_names_it():
    same = {"trial": "a", "frames": 3, "recipe": 1, "content": "a"}
    others = [{"frames": 4}, {"first": 1}, {"content": "b"}, {"recipe": 2}]
    keys = [part("a", **{**same, **change}).path for change in [{}, *others]]  # pyright: ignore[reportArgumentType]
    assert len(set(keys)) == len(keys)


def test_an_interruption_loses_only_the_part_being_made(log: Path, out: Path):
    def interrupt(done: int, _: int) -> None:
        if done == 8:  # within the third
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(Count(log=log), out, listener=interrupt)
    assert sum(path.suffix == ".parquet" and path.name[0] != "." for path in out.rglob("*")) == 2
    make(Count(log=log), out)
    assert sorted(contents(out)) == [each.path for each in parts()]
    assert Count(log=log).tries() == {"a": 1, "b": 1, "c": 2, "d": 1, "e": 1}


@pytest.mark.parametrize("fault", ["refuse", "damaged"])
def test_a_part_that_fails_stops_no_other_and_is_tried_again_by_the_next_call(log: Path, out: Path, fault: str):
    work = Count(log=log, **{fault: frozenset("bd")})  # pyright: ignore[reportArgumentType]
    with pytest.raises(PartError, match="2 of 5 could not be done") as raised:
        make(work, out)
    assert set(raised.value.errors) == {"b", "d"}
    assert work.tries() == dict.fromkeys("abcde", 1)
    assert len(contents(out)) == 3
    make(Count(log=log), out)
    assert sorted(contents(out)) == [each.path for each in parts()]
    assert Count(log=log).tries() == {"a": 1, "b": 2, "c": 1, "d": 2, "e": 1}


def test_a_full_disk_ends_the_work(log: Path, out: Path):
    with pytest.raises(OSError, match="No space left"):
        make(Count(log=log, no_room=frozenset("b")), out)
    assert Count(log=log).tries() == {"a": 1, "b": 1}
    make(Count(log=log), out)
    assert sorted(contents(out)) == [each.path for each in parts()]


@pytest.mark.parametrize("on", ["serial", "processes=2"])
def test_an_error_of_the_preparation_is_raised_once(log: Path, out: Path, on: str):
    with pytest.raises(InputError, match=r"^the network is gone$"):
        make(Count(log=log, broken="the network is gone"), out, on=on)
    assert not Count(log=log).tries()


def test_threads_make_the_same_bytes_and_an_interruption_ends_them(log: Path, out: Path, tmp_path: Path):
    make(Count(log=log), out)
    (tmp_path / "log-2").mkdir()
    work = CountInThreads(log=tmp_path / "log-2", refuse=frozenset("b"))

    def interrupt(done: int, _: int) -> None:
        if done >= 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(work, tmp_path / "other", listener=interrupt)
    assert len(list((tmp_path / "other").glob("trial=*/[!.]*.parquet"))) < 4
    calls: list[int] = []
    with pytest.raises(PartError, match="1 of 5"):
        make(work, tmp_path / "other", listener=lambda done, _: calls.append(done))
    assert calls[-1] == 12
    make(Count(log=work.log), tmp_path / "other")
    assert contents(tmp_path / "other") == contents(out)


def test_a_single_part_fails_with_its_own_error_and_leaves_nothing(log: Path, out: Path):
    with pytest.raises(InputError, match=r"^a is damaged; record it again$"):
        make(Count(log=log, refuse=frozenset("a")), out, parts("a"))
    assert not contents(out)


def test_processes_make_the_same_bytes_and_survive_a_kill(log: Path, out: Path, tmp_path: Path):
    (tmp_path / "log-2").mkdir()
    make(Count(log=log), out)
    left = tmp_path / "other" / "trial=a"  # by a process that was killed while it made a part, and while it wrote
    left.mkdir(parents=True)
    for name in (".x.parquet.1.draft", "..x.parquet.1.draft.part"):
        (left / name).touch()
    work = Count(log=tmp_path / "log-2", kill=frozenset("b"), refuse=frozenset("e"))
    with pytest.raises(PartError, match="1 of 5") as raised:
        make(work, tmp_path / "other", on="processes=2")
    assert set(raised.value.errors) == {"e"}
    assert work.tries()["b"] == 2
    assert os.getpid() not in {int(path.read_text()) for path in work.log.iterdir()}
    make(Count(log=work.log), tmp_path / "other")
    assert contents(tmp_path / "other") == contents(out)


@pytest.mark.skipif("SLIPLENS_RAY" not in os.environ, reason="takes half a minute; SLIPLENS_RAY=1 runs it")
def test_a_cluster_of_two_nodes_makes_the_same_bytes_and_survives_a_kill(log: Path, out: Path, monkeypatch):
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))  # what its workers import
    make(Count(log=log), out.with_name("serial"))
    cluster = cluster_utils.Cluster()
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        make(Count(log=log, kill=frozenset("b")), out, on=f"ray={cluster.address}")
    finally:
        cluster.shutdown()
    assert contents(out) == contents(out.with_name("serial"))


def test_executors_that_cannot_start_are_refused_with_their_cure(log: Path, out: Path, monkeypatch):
    def init(**_: object) -> None:
        raise Exception("The current node timed out during startup.")  # noqa: TRY002 (as Ray does)

    for on, message in {
        "cloud": "no executor named 'cloud'; choose one of serial, processes",
        "processes=none": "processes=none is no number of processes",
    }.items():
        with pytest.raises(InputError, match=message):
            make(Count(log=log), out, on=on)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"--on ray needs ray, which is not installed.*sliplens\[ray\]"):
        make(Count(log=log), out, on="ray")
    fake = SimpleNamespace(is_initialized=lambda: False, init=init, __spec__=ModuleSpec("ray", None))
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setitem(sys.modules, "ray.exceptions", SimpleNamespace(RayError=OSError))
    with pytest.raises(InputError, match=r"^--on ray has no cluster of Ray \(The current node timed out.*retry$"):
        make(Count(log=log), out, on="ray")


def test_parts_join_into_a_file_or_remain_a_data_set(log: Path, tmp_path: Path):
    table = partial(run_table, Count(log=log), parts(), title=TITLE, recipe={})
    _, rows = table(None)
    assert rows is not None
    table(tmp_path / "a.parquet")
    assert pq.read_table(tmp_path / "a.parquet").to_pylist() == rows.to_pylist()
    assert {path.name for path in tmp_path.iterdir()} == {"a.parquet", "log"}
    table(tmp_path / "set")
    data = ds.dataset(tmp_path / "set", partitioning="hive", exclude_invalid_files=True)
    assert data.to_table().to_pylist() == rows.to_pylist()
    assert data.to_table(filter=ds.field("trial") == "c").to_pylist() == rows.to_pylist()[6:9]
    assert {path.name for path in (tmp_path / "set").iterdir()} == {*(f"trial={name}" for name in "abcde"), "run.json"}
    with pytest.raises(InputError, match="another sliplens is writing"), locked(tmp_path / "b.parquet"):
        table(tmp_path / "b.parquet")


def test_parts_that_outlive_their_table_are_removed(log: Path, tmp_path: Path):
    out, left = tmp_path / "a.parquet", tmp_path / ".a.parquet.partial"
    run_table(Count(log=log), parts("ab"), out, title=TITLE, recipe={})
    make(Count(log=log), left, parts("ab"))
    os.utime(out)  # killed between the table and the removal of its parts
    with pytest.raises(InputError, match="exists"):
        require_new_table(out, suffix=".parquet")
    assert not left.exists()
    make(Count(log=log), left, parts("ab"))
    os.utime(out, (0, 0))  # begun after the file: parts of a replacement
    require_new_table(out, suffix=".parquet", overwrite=True)
    assert left.is_dir()
