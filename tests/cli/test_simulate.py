"""`sliplens simulate`: data sets, previews, and what it says to mistakes."""

import json
from pathlib import Path

import av
import pytest
from command_line import refused, run
from PIL import Image

from sliplens.recordings import load_dataset
from sliplens.simulation import PRESETS, make_recipe

SMALL = ("--dry-trials", "3", "--wet-trials", "1", "--days", "2", "--frames-per-trial", "20")


def test_a_data_set_is_written_whole_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    command = ("simulate", tmp_path / "data", *SMALL, "--sensor", "flat-gel", "--release")
    assert run(*command) == 0
    data = load_dataset(tmp_path / "data")
    assert [trial.split for trial in data.trials] == ["train", "validation", "test", "test"]
    assert {trial.sensor for trial in data.trials} <= {"flat-gel-1", "flat-gel-2"}
    recipe = json.loads((tmp_path / "data" / "run.json").read_text())["config"]["recipe"]
    assert recipe["release"] is True
    assert recipe["sensor"]["name"] == "flat-gel"
    assert {path.name for path in tmp_path.iterdir()} == {"data"}
    assert run(*command) == 0
    assert "kept" in capsys.readouterr().out
    assert "other settings" in refused(capsys, *command, "--seed", 1)


def test_a_preview_and_a_clip_need_no_folder(tmp_path: Path):
    sheet, clip = tmp_path / "sheet.png", tmp_path / "clip.mp4"
    assert run("simulate", *SMALL, "--preview", sheet, "--video", clip) == 0
    with Image.open(sheet) as image:
        assert image.width >= 1600
    with av.open(str(clip)) as container:
        stream = container.streams.video[0]
        assert stream.frames == 240
        assert float(stream.average_rate or 0) == 30
    assert {path.name for path in tmp_path.iterdir()} == {"sheet.png", "clip.mp4"}


def test_options_change_a_preset_and_drop_its_totals():
    assert make_recipe("thesis", release=False, seed=0) == PRESETS["thesis"]
    assert make_recipe() == PRESETS["small"]
    changed = make_recipe("thesis", days=6)
    assert (changed.days, changed.dry_trials, changed.frame_totals) == (6, 191, None)


def test_a_picture_that_cannot_be_is_refused_before_the_other_is_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = ("--preview", tmp_path / "sheet.png", "--video", tmp_path / "clip.avi")
    assert "clip.avi does not end in .mp4" in refused(capsys, "simulate", *SMALL, *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "nothing to do; name a folder to make, or a picture with --preview"),
        (("OUT", "--days", "1"), "days is 1, at least 2 is needed"),
        (("OUT", "--seed", "-1"), "seed is -1"),
        (("OUT", "--sensor", "flat-gel", "--displacement", "calibrated"), "which sensor flat-gel does not have"),
        (("OUT", "--device", "toaster"), "device 'toaster' is not known; use cpu, cuda or cuda:1"),
        (("OUT", "--device", "cuda:99"), "device cuda:99 is not on this machine; use cpu"),
        (("--preview", "OUT.gif"), "does not end in .png, .pdf, .svg"),
        (("--video", "OUT.avi"), "does not end in .mp4"),
    ],
)
def test_mistakes_are_told_in_one_line_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], message: str
):
    named = [word.replace("OUT", str(tmp_path / "out")) for word in words]
    small = [word for pair in zip(SMALL[::2], SMALL[1::2], strict=True) if pair[0] not in words for word in pair]
    assert message in refused(capsys, "simulate", *named, *small)
    assert not list(tmp_path.iterdir())
