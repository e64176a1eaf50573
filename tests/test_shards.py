"""Shards: present means done, a failure ends nothing but itself, and where a part was made does not show."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import SimpleNamespace

import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from shard_work import Count, CountInThreads, shards

from sliplens.cli import main
from sliplens.errors import InputError, ShardError, SliplensError
from sliplens.files import hash_file, remove
from sliplens.parts import TRIES, Doing, Shard, read_status, require_new_table, shard
from sliplens.shards import Crew, make_parts, make_table

TITLE = "Counting"
Make = Callable[..., None]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    (tmp_path / "log").mkdir()
    return tmp_path / "log"


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def make(work: Count | Crew, out: Path, *, given: Callable[[], Iterator[Shard]] = shards, **more: object) -> None:
    make_parts(work, given, out, title=TITLE, **more)  # pyright: ignore[reportArgumentType]


def content(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): hash_file(path) for path in folder.rglob("*") if path.is_file()}


def test_every_part_is_there_once_and_what_is_there_is_not_made_again(log: Path, out: Path):
    seen: list[tuple[int, int]] = []
    make(Count(log=log), out, on_progress=lambda done, total: seen.append((done, total)))
    assert sorted(content(out)) == [one.part for one in shards()]  # and nothing else
    assert [done for done, _ in seen] == sorted({done for done, _ in seen})
    assert seen[-1] == (15, 15)
    before = content(out)
    (out / next(shards()).part).unlink()
    make(Count(log=log), out)
    assert content(out) == before
    assert Count(log=log).tries() == {"a": 2, "b": 1, "c": 1, "d": 1, "e": 1}


def test_a_part_of_another_recipe_is_another_part(log: Path, out: Path):
    make(Count(log=log), out, given=partial(shards, "a"))
    make(Count(log=log), out, given=partial(shards, "a", recipe=2))
    assert Count(log=log).tries() == {"a": 2}
    first, second = (next(shards("a", recipe=recipe)).key for recipe in (1, 2))
    assert first != second
    for more in ({"frames": 4}, {"first": 1}, {"shown": "b"}):
        other = shard("a", **{"trial": "a", "frames": 3, "recipe": 1, "shown": "a", **more})  # pyright: ignore
        assert other.key != first


def test_an_interruption_loses_the_part_that_was_being_made(log: Path, out: Path):
    def interrupt(done: int, _: int) -> None:
        if done == 8:  # in the midst of the third
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(Count(log=log), out, on_progress=interrupt)
    assert sum(path.suffix == ".parquet" and path.name[0] != "." for path in out.rglob("*")) == 2
    make(Count(log=log), out)
    assert sorted(content(out)) == [one.part for one in shards()]
    assert Count(log=log).tries() == {"a": 1, "b": 1, "c": 2, "d": 1, "e": 1}


def test_what_fails_three_times_is_set_aside_until_it_is_asked_for(log: Path, out: Path):
    work = Count(log=log, refuse=frozenset("bd"))
    with pytest.raises(ShardError, match=r"2 of 5 could not be done.*--retry-failed") as raised:
        make(work, out)
    assert raised.value.why == {name: f"{name} is damaged; record it again" for name in "bd"}
    assert work.tries() == {"a": 1, "b": TRIES, "c": 1, "d": TRIES, "e": 1}
    (status,) = read_status(out)
    assert (status.done, status.shards, status.frames_done, status.frames) == (3, 5, 9, 15)
    assert {one.name: len(one.why) for one in status.failed} == {"b": TRIES, "d": TRIES}
    with pytest.raises(ShardError):
        make(Count(log=log), out)
    assert Count(log=log).tries()["b"] == TRIES  # not tried
    make(Count(log=log), out, retry_failed=True)
    assert sorted(content(out)) == [one.part for one in shards()]
    assert read_status(out) == []


def test_what_was_made_after_all_is_no_failure(log: Path, out: Path):
    with pytest.raises(ShardError):
        make(Count(log=log, refuse=frozenset("b")), out)
    [failed] = out.rglob("*.failed")
    note = failed.read_bytes()
    make(Count(log=log), out, retry_failed=True)
    failed.parent.mkdir()  # as if killed before the note of the failure was gone
    failed.write_bytes(note)
    make(Count(log=log), out)
    assert sorted(content(out)) == [one.part for one in shards()]


def test_a_full_disk_ends_all_and_sets_nothing_aside(log: Path, out: Path):
    for _ in range(TRIES):
        with pytest.raises(OSError, match="No space left"):
            make(Count(log=log, no_room=frozenset("b")), out)
    assert Count(log=log).tries() == {"a": 1, "b": TRIES}
    make(Count(log=log), out)
    assert sorted(content(out)) == [one.part for one in shards()]


def test_what_a_kind_of_shards_lacks_ends_all_and_sets_nothing_aside(log: Path, out: Path):
    with pytest.raises(InputError, match=r"^the network of b is gone$"):
        make(Count(log=log, unready=frozenset("b")), out)
    assert Count(log=log).tries() == {"a": 1, "b": 1}
    make(Count(log=log), out)
    assert sorted(content(out)) == [one.part for one in shards()]


def test_a_damaged_recording_is_tried_once(log: Path, out: Path):
    with pytest.raises(ShardError) as raised:
        make(Count(log=log, damaged=frozenset("b")), out)
    assert list(raised.value.why) == ["b"]
    for _ in range(2):  # and not again before it is asked for
        assert Count(log=log).tries() == dict.fromkeys("abcde", 1)
        with pytest.raises(ShardError):
            make(Count(log=log), out)
    make(Count(log=log), out, retry_failed=True)
    assert sorted(content(out)) == [one.part for one in shards()]


def test_threads_make_the_same_bytes_and_an_interruption_ends_them(log: Path, out: Path, tmp_path: Path):
    make(Count(log=log), out)
    (tmp_path / "log-2").mkdir()
    seen: list[int] = []
    work = CountInThreads(log=tmp_path / "log-2", refuse=frozenset("b"))

    def interrupt(done: int, _: int) -> None:
        seen.append(done)
        if done >= 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(work, tmp_path / "other", on_progress=interrupt)
    assert len(list((tmp_path / "other").glob("trial=*/*.parquet"))) < 4
    with pytest.raises(ShardError, match="1 of 5"):
        make(work, tmp_path / "other", on_progress=lambda done, _: seen.append(done))
    assert seen[-1] == 12
    make(Count(log=work.log), tmp_path / "other", retry_failed=True)
    assert content(tmp_path / "other") == content(out)


def test_a_single_shard_fails_with_its_own_error_and_leaves_nothing(log: Path, out: Path):
    with pytest.raises(InputError, match=r"^a is damaged; record it again$"):
        make(Count(log=log, refuse=frozenset("a")), out, given=partial(shards, "a"))
    assert not content(out)


def test_what_is_wrong_with_all_is_told_once(log: Path, out: Path):
    with pytest.raises(InputError, match=r"^the network is gone$"):
        make(Count(log=log, broken="the network is gone"), out)
    assert not Count(log=log).tries()


def test_processes_make_the_same_bytes_and_survive_a_kill(log: Path, out: Path, tmp_path: Path):
    (tmp_path / "log-2").mkdir()
    make(Count(log=log), out)
    work = Count(log=tmp_path / "log-2", kill=frozenset("b"), refuse=frozenset("e"))
    with Crew(work, on="processes=2", most=5) as crew:
        with pytest.raises(ShardError, match="1 of 5"):
            make(crew, tmp_path / "other")
        assert work.tries() == {"a": 1, "b": 2, "c": 1, "d": 1, "e": TRIES}
        pids = {int(path.read_text()) for path in work.log.iterdir()}
        assert os.getpid() not in pids
        assert len(pids) >= 2
        # who is there already does what comes next, and whoever was killed in between is replaced
        last = int((work.log / "e-0").read_text())
        make(crew, tmp_path / "more", given=partial(shards, "wx"))
        assert last in {int((work.log / f"{name}-0").read_text()) for name in "wx"}
        os.kill(last, signal.SIGKILL)
        make(crew, tmp_path / "more", given=partial(shards, "wxyz"))
    make(Count(log=work.log), tmp_path / "other", retry_failed=True)
    assert content(tmp_path / "other") == content(out)


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
    assert content(out) == content(out.with_name("serial"))


def test_without_ray_it_is_told_how_to_get_it(log: Path, out: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"--on ray needs ray, which is not installed.*sliplens\[ray\]"):
        make(Count(log=log), out, on="ray")


def test_a_cluster_that_does_not_start_is_told(log: Path, out: Path, monkeypatch: pytest.MonkeyPatch):
    def init(**_: object) -> None:
        raise Exception("The current node timed out during startup.")  # noqa: TRY002 (as Ray does)

    fake = SimpleNamespace(is_initialized=lambda: False, init=init, __spec__=ModuleSpec("ray", None))
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setitem(sys.modules, "ray.exceptions", SimpleNamespace(RayError=OSError))
    with pytest.raises(InputError, match=r"^--on ray has no cluster of Ray \(The current node timed out.*try again$"):
        make(Count(log=log), out, on="ray")


def test_a_place_that_is_not_known_is_told(log: Path, out: Path):
    with pytest.raises(InputError, match="no place to work named 'cloud'; choose one of serial, processes"):
        make(Count(log=log), out, on="cloud")
    with pytest.raises(InputError, match="processes=none is no number of processes"):
        make(Count(log=log), out, on="processes=none")


def test_who_makes_a_part_is_seen_while_it_is_made(log: Path, out: Path, capsys: pytest.CaptureFixture[str]):
    seen: list[Doing] = []

    def look(done: int, _: int) -> None:
        if done == 5:
            seen.extend(read_status(out)[0].doing or ())
            assert main(["status", str(out)]) == 0

    make(Count(log=log), out, on_progress=look)
    assert [(one.name, one.process) for one in seen] == [("b", os.getpid())]
    told = capsys.readouterr().out
    assert "Counting, --on serial: 1 of 5 shards, 3 of 15 frames" in told
    assert f"b: process {os.getpid()} of" in told
    # a lock that nobody holds any more
    state = out / "_shards"
    state.mkdir()
    (state / "0123456789abcdef.doing").write_text("{}")
    assert main(["status", str(out)]) == 0
    assert "is worked on in parts now" in capsys.readouterr().out
    with pytest.raises(InputError, match=r"nothing was begun at .*nowhere"):
        read_status(out.with_name("nowhere"))


def test_the_driver_holds_a_few_shards_however_many_come(log: Path, out: Path):
    ahead = most = 0

    def many() -> Iterator[Shard]:
        nonlocal ahead
        for number in range(20):
            ahead += 1
            yield shard(f"t{number}", trial=f"t{number}", frames=3, recipe=1, shown="", suffix=".parquet")

    def done(_: Shard) -> None:
        nonlocal ahead, most
        most, ahead = max(most, ahead), ahead - 1

    ahead = -20  # they are counted first
    make(Count(log=log), out, given=many, on_part=done)
    assert most <= 2


def test_the_driver_keeps_nothing_of_ten_thousand_shards(log: Path, out: Path, monkeypatch: pytest.MonkeyPatch):
    def many() -> Iterator[Shard]:
        for number in range(10_000):
            yield shard(number, trial=f"t{number}", frames=1, recipe=0, shown="", suffix=".parquet")

    blocks: list[int] = []  # of memory, as each shard is done
    monkeypatch.setattr("sliplens.shards.look_for", lambda _, given: ((one, True) for one in given))
    out.mkdir()
    make(Count(log=log), out, given=many, on_part=lambda _: blocks.append(sys.getallocatedblocks()))
    assert len(blocks) == 10_000
    assert blocks[-1] - blocks[99] < 15_000  # of which the list itself holds one a shard


def test_parts_join_into_a_file_or_stay_a_data_set(log: Path, tmp_path: Path):
    def table(out: Path | None, **more: object):
        return make_table(Count(log=log), shards, out, title=TITLE, recipe={}, **more)  # pyright: ignore

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
    with pytest.raises(SliplensError, match="another sliplens is writing"), _writing(tmp_path / "b.parquet"):
        table(tmp_path / "b.parquet")


def test_a_table_whose_parts_were_left_is_made_again_by_the_same_work_alone(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out, left = tmp_path / "a.parquet", tmp_path / ".a.parquet.partial"

    def table(recipe: int = 1, **more: object) -> bytes:
        given = partial(shards, "ab", recipe=recipe)
        make_table(Count(log=log), given, out, title=TITLE, recipe={}, **more)  # pyright: ignore[reportArgumentType]
        return out.read_bytes()

    def killed(path: Path) -> None:
        if path == left:
            raise KeyboardInterrupt
        remove(path)

    with monkeypatch.context() as patch:
        patch.setattr("sliplens.parts.remove", killed)
        with pytest.raises(KeyboardInterrupt):
            table()
    first = out.read_bytes()
    require_new_table(out, suffix=".parquet")
    for other in (partial(table, 2), partial(table, resumable=False)):
        with pytest.raises(InputError, match="exists"):
            other()
    assert table() == first
    assert Count(log=log).tries() == {"a": 1, "b": 1}
    with pytest.raises(InputError, match="exists"):
        require_new_table(out, suffix=".parquet")
    left.mkdir()  # begun after the file, which is of something else
    os.utime(out, (0, 0))
    with pytest.raises(InputError, match="exists"):
        require_new_table(out, suffix=".parquet")


def _writing(out: Path):
    from sliplens.parts import parts_folder  # noqa: PLC0415

    return parts_folder(out)
