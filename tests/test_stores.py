"""Object stores: what is read from them and written to them is what it would be on disk, whole or absent."""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from data_sets import contents
from shard_work import Count, shards

from sliplens import load_dataset, predict
from sliplens.cli import main
from sliplens.errors import InputError, ShardError
from sliplens.files import StoredPath, as_path, output_folder, remove
from sliplens.parts import TRIES, read_status
from sliplens.recordings import Dataset
from sliplens.results.explanation import load_explanation
from sliplens.shards import make_parts, make_table
from sliplens.study.workspace import explain_source

SETTINGS = {
    "AWS_ACCESS_KEY_ID": "somebody",
    "AWS_SECRET_ACCESS_KEY": "secret",
    "AWS_EC2_METADATA_DISABLED": "true",
    "AWS_DEFAULT_REGION": "us-east-1",
}


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Address of a server that speaks S3, on this machine."""
    reason = "a server of S3 is played by moto"
    server = pytest.importorskip("moto.server", reason=reason).ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    with contextlib.redirect_stdout(None):
        server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def client(server: str, monkeypatch: pytest.MonkeyPatch):
    """Another client of the store."""
    for name, value in (SETTINGS | {"AWS_ENDPOINT_URL": server}).items():
        monkeypatch.setenv(name, value)
    return pytest.importorskip("boto3", reason="it comes with moto").client("s3")


@pytest.fixture
def bucket(client) -> str:
    name = f"lab-{len(client.list_buckets()['Buckets'])}"
    client.create_bucket(Bucket=name)
    return f"s3://{name}"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    (tmp_path / "log").mkdir()
    return tmp_path / "log"


def upload(data: Dataset, target: str) -> str:
    StoredPath(target).upload(data.folder)
    return target


def test_a_path_in_a_store_reads_as_one_on_disk_does(bucket: str, tmp_path: Path):
    for name in ("a/b.txt", "a/c/d.txt", "e.json"):
        for folder in (tmp_path, as_path(bucket)):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(name)
    stored = as_path(Path(f"{bucket}/"))  # a path that was made without knowing
    assert str(stored / "a" / "b.txt") == f"{bucket}/a/b.txt"
    assert contents(stored) == contents(tmp_path)
    for ask in (Path.exists, Path.is_file, Path.is_dir):
        for name in ("a", "a/b.txt", "a/b", "nothing", "."):
            assert ask(stored / name) == ask(tmp_path / name), (ask, name)
    for pattern in ("*", "a/*", "*/*.txt", "*/*/*"):
        files = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.glob(pattern) if path.is_file())
        assert sorted(str(path.relative_to(stored)) for path in stored.glob(pattern)) == files
    assert {path.name for path in stored.iterdir()} == {"a", "e.json"}
    remove(stored / "a")
    (stored / "e.json").unlink()
    assert not stored.exists()
    with pytest.raises(FileNotFoundError):
        (stored / "e.json").stat()


def test_parts_in_a_store_are_those_on_disk(bucket: str, log: Path, tmp_path: Path):
    make_parts(Count(log=log), shards, tmp_path / "out", title="Counting")
    out = as_path(f"{bucket}/out")
    make_parts(Count(log=log), shards, out, title="Counting")
    assert contents(out) == contents(tmp_path / "out")
    tries = Count(log=log).tries()
    (out / next(shards()).part).unlink()
    make_parts(Count(log=log), shards, out, title="Counting")
    assert contents(out) == contents(tmp_path / "out")
    assert Count(log=log).tries() == tries | {"a": tries["a"] + 1}


def test_an_upload_that_was_not_finished_is_no_part(bucket: str, client, log: Path):
    out, one = as_path(f"{bucket}/out"), next(shards())
    key = {"Bucket": bucket[5:], "Key": f"out/{one.part}"}
    begun = client.create_multipart_upload(**key)["UploadId"]
    client.upload_part(**key, UploadId=begun, PartNumber=1, Body=b"half of a part")
    make_parts(Count(log=log), shards, out, title="Counting")
    assert Count(log=log).tries()["a"] == 1
    assert pq.ParquetFile((out / one.part).open()).read().num_rows == 3


def test_failures_in_a_store_are_seen_from_elsewhere(bucket: str, log: Path, capsys: pytest.CaptureFixture[str]):
    out = as_path(f"{bucket}/out")
    with pytest.raises(ShardError, match="1 of 5"):
        make_parts(Count(log=log, refuse=frozenset("b")), shards, out, title="Counting")
    (status,) = read_status(f"{bucket}/out")
    assert (status.done, status.shards, status.doing) == (4, 5, None)
    assert [(one.name, len(one.why)) for one in status.failed] == [("b", TRIES)]
    assert main(["status", f"{bucket}/out"]) == 0
    assert "failed, 3 times: b: b is damaged" in capsys.readouterr().out
    with pytest.raises(ShardError):
        make_parts(Count(log=log), shards, out, title="Counting")
    make_parts(Count(log=log), shards, out, title="Counting", retry_failed=True)
    assert sorted(contents(out)) == sorted(one.part for one in shards())
    assert read_status(out) == []


def test_a_table_in_a_store_is_complete_when_it_says_so(bucket: str, log: Path, tmp_path: Path):
    def make(out: str, **more: object):
        given = {"recipe": {}, "refuse": frozenset(), **more}
        work = Count(log=log, refuse=given.pop("refuse"))  # pyright: ignore[reportArgumentType]
        return make_table(work, shards, as_path(out), title="Counting", **given)  # pyright: ignore[reportArgumentType]

    make(str(tmp_path / "a.parquet"))
    make(f"{bucket}/a.parquet")
    assert as_path(f"{bucket}/a.parquet").read_bytes() == (tmp_path / "a.parquet").read_bytes()
    assert list(contents(as_path(bucket))) == ["a.parquet"]  # and no parts
    with pytest.raises(ShardError):
        make(f"{bucket}/set", refuse=frozenset("c"))
    assert not as_path(f"{bucket}/set/run.json").exists()
    make(f"{bucket}/set", retry_failed=True)
    make(str(tmp_path / "set"))
    left, right = contents(as_path(f"{bucket}/set")), contents(tmp_path / "set")
    assert left.pop("run.json")
    assert right.pop("run.json")
    assert left == right
    before = Count(log=log).tries()
    make(f"{bucket}/set")
    assert Count(log=log).tries() == before
    with pytest.raises(InputError, match="holds a result of other settings"):
        make(f"{bucket}/set", recipe={"another": 1})
    make(f"{bucket}/set", recipe={"another": 1}, overwrite=True)
    assert len(contents(as_path(f"{bucket}/set"))) == 6
    as_path(f"{bucket}/mine/diary.txt").write_text("mine")
    with pytest.raises(InputError, match="was not made by sliplens"):
        make(f"{bucket}/mine", overwrite=True)
    assert as_path(f"{bucket}/mine/diary.txt").read_text() == "mine"


def test_a_folder_that_was_begun_by_another_recipe_is_begun_anew(bucket: str):
    out = as_path(f"{bucket}/out")
    with contextlib.suppress(KeyboardInterrupt), output_folder(out, stage="test", config=1) as output:
        (output.parts / "old").write_text("old")
        raise KeyboardInterrupt
    assert (out / "old").exists()
    with output_folder(out, stage="test", config=2) as output:
        (output.folder / "new").write_text("new")
    assert sorted(contents(out)) == ["new", "run.json"]


def test_margins_of_a_data_set_in_a_store_are_those_on_disk(
    bucket: str, small_dataset: Dataset, difference_run: Path, elsewhere: str
):
    data = upload(small_dataset, f"{bucket}/data")
    assert load_dataset(data).hash == small_dataset.hash
    stored = predict(difference_run, data, split="test", on=elsewhere, out=f"{bucket}/margins")
    about, *parts = sorted(contents(as_path(f"{bucket}/margins")))
    assert about == "run.json"
    trials = [f"trial={one.trial}" for one in small_dataset.select(split="test")]
    assert [name.rpartition("/")[0] for name in parts] == trials
    local = predict(difference_run, small_dataset, split="test").frame()
    assert stored.frame().to_pylist() == local.to_pylist()


def test_maps_in_a_store_are_those_on_disk(bucket: str, small_dataset: Dataset, difference_run: Path, tmp_path: Path):
    data = load_dataset(upload(small_dataset, f"{bucket}/data"))
    own = {"methods": ("grad-cam",), "levels": (1.0, 0.5)}
    explain_source(difference_run, small_dataset, out=tmp_path / "maps", **own)
    found = explain_source(difference_run, data, out=as_path(f"{bucket}/maps"), **own)
    expected = load_explanation(tmp_path / "maps")
    assert found.relevance["grad-cam"].tobytes() == expected.relevance["grad-cam"].tobytes()
    assert sorted(contents(as_path(f"{bucket}/maps"))) == sorted(contents(tmp_path / "maps"))


def test_what_is_wrong_with_a_store_is_one_sentence(
    bucket: str, small_dataset: Dataset, difference_run: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    data = upload(small_dataset, f"{bucket}/data")

    def told(*words: str) -> str:
        assert main(["predict", str(difference_run), *words]) == 2
        return " ".join(capsys.readouterr().err.split())

    assert "there is no bucket nowhere for s3://nowhere/data" in told("s3://nowhere/data")
    assert "there is no bucket nowhere" in told(data, "--split", "test", "-o", "s3://nowhere/margins")
    assert f"the source {bucket}/nothing does not exist" in told(f"{bucket}/nothing")
    assert "names no bucket" in told("s3://")
    assert main(["view", data]) == 2
    assert f"sliplens view reads and writes no {data}" in " ".join(capsys.readouterr().err.split())
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")  # where nobody listens
    sentence = told(data)
    assert f"{data} cannot be reached" in sentence
    assert "check the network" in sentence
    assert not Path("s3:").exists()
