import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sliplens.errors import InputError
from sliplens.files import (
    hash_json,
    output_folder,
    read_json,
    remove,
    to_builtins,
    whole_file,
)


def make(target: Path, config: dict, *, text: str = "x", overwrite: bool = False) -> bool:
    with output_folder(target, stage="test", config=config, overwrite=overwrite) as out:
        if not out.complete:
            (out.folder / "data.txt").write_text(text)
        return out.complete


def test_an_interrupted_folder_keeps_its_pieces_for_the_same_recipe_only(tmp_path: Path):
    target = tmp_path / "result"

    def interrupted(config: dict) -> list[str]:
        found: list[str] = []
        with pytest.raises(KeyboardInterrupt), output_folder(target, stage="test", config=config) as out:  # noqa: PT012
            found += sorted(path.name for path in out.folder.iterdir() if not path.name.startswith("."))
            (out.folder / "piece").write_text("x")
            raise KeyboardInterrupt
        return found

    assert interrupted({"seed": 1}) == []
    assert not target.exists()
    assert interrupted({"seed": 1}) == ["piece"]
    assert interrupted({"seed": 2}) == []


def test_an_interrupted_replacement_goes_on_too(tmp_path: Path):
    target = tmp_path / "result"
    make(target, {"seed": 1})
    with pytest.raises(KeyboardInterrupt), output_folder(target, stage="test", config={}, overwrite=True) as out:  # noqa: PT012
        (out.folder / "piece").write_text("x")
        raise KeyboardInterrupt
    assert (target / "data.txt").read_text() == "x"
    with output_folder(target, stage="test", config={}, overwrite=True) as out:
        assert (out.folder / "piece").read_text() == "x"
    assert not (target / "data.txt").exists()


def test_a_folder_that_another_is_writing_is_refused_and_left_alone(tmp_path: Path):
    target = tmp_path / "result"
    with output_folder(target, stage="test", config={"seed": 1}) as out:
        (out.folder / "piece").write_text("x")
        for seed in (1, 2):
            with pytest.raises(InputError, match="another sliplens is writing"):
                make(target, {"seed": seed})
        assert (out.folder / "piece").read_text() == "x"
        assert not target.exists()
    assert (target / "piece").exists()
    assert read_json(target / "run.json")["stage"] == "test"
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_what_is_removed_while_it_is_made_is_not_called_complete(tmp_path: Path):
    target = tmp_path / "result"
    with (  # noqa: PT012
        pytest.raises(InputError, match=r"was removed while .*result was being made; give the command again"),
        output_folder(target, stage="test", config={}) as out,
    ):
        (out.folder / "first").write_text("x")
        shutil.rmtree(out.folder)
        out.folder.mkdir()
        (out.folder / "second").write_text("x")
    assert not list(tmp_path.iterdir())


def test_what_was_killed_while_it_replaced_a_folder_leaves_it_whole(tmp_path: Path):
    target = tmp_path / "result"
    make(target, {"seed": 1})
    target.rename(tmp_path / ".result.replaced")  # as if killed right then
    assert make(target, {"seed": 1}) is True
    shutil.copytree(target, tmp_path / ".result.replaced")  # and a moment later
    assert make(target, {"seed": 1}) is True
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_a_mistake_before_the_first_piece_leaves_nothing_behind(tmp_path: Path):
    with pytest.raises(InputError), output_folder(tmp_path / "result", stage="test", config={}):
        raise InputError("the data are broken")
    assert not list(tmp_path.iterdir())


def test_the_same_recipe_finds_its_result_and_makes_nothing(tmp_path: Path):
    assert make(tmp_path / "result", {"seed": 1}) is False
    assert make(tmp_path / "result", {"seed": 1}, text="y") is True
    assert (tmp_path / "result" / "data.txt").read_text() == "x"


def test_another_recipe_is_refused_unless_told_to_overwrite(tmp_path: Path):
    make(tmp_path / "result", {"seed": 1})
    with pytest.raises(InputError, match=r"result holds a result of other settings; .* --overwrite"):
        make(tmp_path / "result", {"seed": 2}, text="y")
    assert (tmp_path / "result" / "data.txt").read_text() == "x"
    make(tmp_path / "result", {"seed": 2}, text="y", overwrite=True)
    assert (tmp_path / "result" / "data.txt").read_text() == "y"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_somebody_else_is_never_touched(tmp_path: Path, overwrite: bool):
    target = tmp_path / "photos"
    target.mkdir()
    (target / "holiday.jpg").write_text("precious")
    with pytest.raises(InputError, match=r"photos .*not made by sliplens"):
        make(target, {}, overwrite=overwrite)
    assert (target / "holiday.jpg").read_text() == "precious"


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path: Path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"cannot write to .*file .*; choose another output folder"):
        make(tmp_path / "file" / "result", {})


def test_hash_does_not_depend_on_the_order_of_keys():
    assert hash_json({"a": 1, "b": (2, 3)}) == hash_json({"b": [2, 3], "a": 1})
    assert hash_json({"a": 1}) != hash_json({"a": 2})


def test_numpy_numbers_and_paths_become_json():
    value = {"a": np.float32(0.5), "b": Path("c"), "d": (np.int64(1),)}
    assert json.loads(json.dumps(to_builtins(value))) == {"a": 0.5, "b": "c", "d": [1]}


def test_a_file_is_written_by_one_at_a_time_and_whole_or_not_at_all(tmp_path: Path):
    target = tmp_path / "new" / "table.csv"
    with whole_file(target) as part:
        part.write_text("first")
        with pytest.raises(InputError, match="another sliplens is writing"), whole_file(target):
            pass
        assert not target.exists()
    with pytest.raises(KeyboardInterrupt), whole_file(target) as part:  # noqa: PT012
        part.write_text("second")
        raise KeyboardInterrupt
    assert target.read_text() == "first"
    assert [path.name for path in target.parent.iterdir()] == ["table.csv"]


def test_what_is_in_a_file_is_on_the_disk_before_its_name(tmp_path: Path, monkeypatch):
    done, replace = [], Path.replace
    monkeypatch.setattr(os, "fsync", lambda stream: done.append(Path(stream.name).read_text()))
    monkeypatch.setattr(Path, "replace", lambda part, to: [done.append(to.name), replace(part, to)])
    with whole_file(tmp_path / "table.csv") as part:
        part.write_text("all")
    assert done == ["all", "table.csv"]


def test_what_cannot_be_written_is_named(tmp_path: Path):
    with pytest.raises(OSError, match="room") as raised, whole_file(tmp_path / "x"):
        raise OSError("no room")  # as libraries raise it, without a name
    assert raised.value.filename == str(tmp_path / "x")
    with pytest.raises(FileNotFoundError) as raised, whole_file(tmp_path / "x"):
        (tmp_path / "other").read_text()
    assert raised.value.filename == str(tmp_path / "other")


def test_whatever_change_a_process_was_killed_before_the_next_one_makes_the_same_and_leaves_nothing(tmp_path: Path):
    script = Path(__file__).parent / "helpers" / "killed.py"
    told = subprocess.run([sys.executable, script, tmp_path], capture_output=True, text=True, timeout=120, check=False)
    assert told.returncode == 0, told.stderr
    tried = json.loads(told.stdout)
    assert {name for name, _ in tried} == {"make", "replace", "file", "table", "split"}
    assert len(tried) > 40


def test_a_folder_that_is_removed_is_there_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "part"
    folder.mkdir()
    (folder / "result.json").write_text("{}")

    def killed(path: Path, **_: object) -> None:
        if path.exists():
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            remove(folder)
    assert not folder.exists()
    remove(folder)
    assert not list(tmp_path.iterdir())
