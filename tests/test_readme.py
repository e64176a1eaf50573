"""What the README shows in Python runs as it stands, on small networks and data."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from own_recording import write_forces, write_video

from sliplens.files import DEFAULT_NETWORK
from sliplens.live import LiveReader
from sliplens.models import Manifest, build_model, save_checkpoint
from sliplens.recordings import Dataset, Recording
from sliplens.results.study import StudyConfig
from sliplens.simulation import PRESETS, plan_trials, simulate_trial
from sliplens.training import RECIPES

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


IMAGE_SIZE = 32


@pytest.fixture(scope="module")
def grip() -> Recording:
    """A simulated grip of 8 s, every fourth pixel."""
    whole = simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=240))
    return replace(whole, frames=whole.frames[:, ::4, ::4].copy(), reference=whole.reference[::4, ::4].copy())


@pytest.fixture
def folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_dataset: Dataset, fine_dataset: Dataset, grip: Recording
) -> Path:
    """Folder in which the names of the README stand for small things: networks, a data set, a recording."""
    (tmp_path / "data").symlink_to(small_dataset.folder)
    (tmp_path / "grips").symlink_to(fine_dataset.folder)
    write_forces(grip, tmp_path / "cup.csv")
    write_video(grip, tmp_path / "cup.mp4")  # Matroska, whatever its name: FFmpeg looks inside
    manifest = Manifest(
        backbone="shufflenet_v2_x1_0",
        head="histogram",
        input="pair",
        image_size=IMAGE_SIZE,
        frame_size=(small_dataset.trials[0].height, small_dataset.trials[0].width),
        sensor="test-sensor",
        data_hash="none",
    )
    (tmp_path / DEFAULT_NETWORK).mkdir()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        save_checkpoint(tmp_path / DEFAULT_NETWORK, build_model(head="histogram", colours=6).eval(), manifest)
    small = replace(RECIPES["default"], image_size=IMAGE_SIZE, batch_size=16)
    monkeypatch.setitem(RECIPES, "default", small)
    for option in ("random_orders", "trials"):
        monkeypatch.setitem(StudyConfig.__init__.__kwdefaults__ or {}, option, 1)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run live for a twentieth of the time."""
    begin = LiveReader.__init__

    def begin_short(self: LiveReader, *args: Any, seconds: float, **options: Any) -> None:
        begin(self, *args, seconds=seconds / 20, **options)

    monkeypatch.setattr(LiveReader, "__init__", begin_short)


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_what_the_readme_shows_runs(block: str, folder: Path, small_dataset: Dataset, hurry: None):
    if "simulated" in block:  # its frames are of the real size, and so is the network of the package
        (folder / DEFAULT_NETWORK).rename(folder / "other")
    recording = small_dataset.load(small_dataset.trials[0])
    given = {"frames": recording.frames[6:7], "untouched": recording.reference}
    exec(compile(block, "README.md", "exec"), given)


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_what_the_readme_shows_is_short(block: str):
    assert len(block.splitlines()) <= 10
