"""`sliplens train`: what it refuses, and what a crash leaves."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from command_line import refused
from data_sets import save_dataset
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sliplens.cli import main
from sliplens.models import load
from sliplens.recordings import Dataset
from sliplens.recordings.dataset import write_dataset_table

SMALL = ("--image-size", "32", "--epochs", "3", "--batch-size", "11", "--head", "point", "--untouched-share", "0")


def words(data: Path, output: Path, *more: str) -> list[str]:
    small = dict(zip(SMALL[::2], SMALL[1::2], strict=True))
    options = [word for name, value in small.items() if name not in more for word in (name, value)]
    return ["train", str(data), "-o", str(output), *options, *more]


def train(*arguments: Any) -> int:
    return main(words(*arguments))


def divided(data: Dataset, folder: Path, **changes: dict[str, object]) -> Path:
    """The small data set with another table: changes by split, `split=None` leaves it out."""
    folder.mkdir()
    (folder / "trials").symlink_to(data.folder / "trials")
    table = [replace(info, **changes.get(info.split, {})) for info in data.trials]  # pyright: ignore[reportArgumentType]
    write_dataset_table(folder, [info for info in table if info.split], simulated=True)
    return folder


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Sums of several threads have other last digits, and another test may have set their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, small_dataset: Dataset) -> Path:
    """A training that nothing disturbed."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    assert train(small_dataset.folder, folder, "--logger", "tensorboard") == 0
    return folder


def test_a_run_holds_its_learning_curve_and_what_its_logger_kept(finished: Path):
    names = {path.name for path in finished.iterdir()}
    expected = {"model.safetensors", "manifest.json", "metrics.csv", "result.json", "run.json", "curves.png"}
    expected.add("curve.parquet")
    assert names == expected | {"tensorboard"}
    with Image.open(finished / "curves.png") as picture:
        assert np.asarray(picture).std() > 0  # not blank
    assert len((finished / "metrics.csv").read_text().splitlines()) == 4


def test_the_logger_tells_what_the_table_tells(finished: Path):
    events = EventAccumulator(str(finished / "tensorboard")).Reload()
    assert set(events.Tags()["scalars"]) >= {"train_mse", "validation_mse", "learning_rate"}
    rows = [row.split(",") for row in (finished / "metrics.csv").read_text().splitlines()[1:]]
    for column, name in ((1, "train_mse"), (2, "validation_mse")):
        told = [one.value for one in events.Scalars(name)]
        # the table keeps six digits
        assert told == pytest.approx([float(row[column]) for row in rows], rel=1e-5)
    recipe = yaml.safe_load((finished / "tensorboard" / "hparams.yaml").read_text())
    assert recipe["batch_size"] == 11
    assert recipe["input"] == "difference"


def test_hardware_and_logger_are_no_part_of_the_recipe(finished: Path, small_dataset: Dataset, capsys):
    assert train(small_dataset.folder, finished, "--accelerator", "cpu") == 0
    assert "made before with the same settings" in " ".join(capsys.readouterr().out.split())


def test_a_training_killed_in_an_epoch_goes_on_to_the_same_end(finished: Path, small_dataset: Dataset, tmp_path: Path):
    script = """
import os, signal, sys, torch
from sliplens.cli import main
from sliplens.training.module import Regressor

step = Regressor.training_step

def killed(self, batch, batch_idx):
    if self.global_step == 6:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self, batch, batch_idx)

Regressor.training_step = killed
torch.set_num_threads(1)
main(sys.argv[1:])
"""
    arguments = words(small_dataset.folder, tmp_path / "run")
    done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, timeout=300, check=False)
    assert done.returncode == -signal.SIGKILL
    # four steps an epoch: the second epoch was half done
    assert (tmp_path / ".run.partial" / "checkpoints" / "last.ckpt").exists()
    assert train(small_dataset.folder, tmp_path / "run") == 0
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == (finished / "model.safetensors").read_bytes()

    def errors(folder: Path) -> list[list[str]]:
        return [row.split(",")[:3] for row in (folder / "metrics.csv").read_text().splitlines()]

    assert errors(tmp_path / "run") == errors(finished)


def test_a_full_disk_leaves_the_last_whole_epoch(
    small_dataset: Dataset, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
):
    sync, saved = os.fsync, []

    def full(file: int) -> None:
        saved.append(file)
        if len(saved) > 2:  # the best and the last of the first epoch
            raise OSError(28, "No space left on device")
        sync(file)

    monkeypatch.setattr("os.fsync", full)
    line = refused(capsys, *words(small_dataset.folder, tmp_path / "run"))
    assert ".ckpt (No space left on device); make room and give the same command again" in line
    monkeypatch.undo()
    assert train(small_dataset.folder, tmp_path / "run") == 0
    assert len((tmp_path / "run" / "metrics.csv").read_text().splitlines()) == 4


def test_a_loss_that_diverges_is_refused_with_its_cure(
    small_dataset: Dataset, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
):
    from sliplens.training import module  # noqa: PLC0415 (as the command line imports it)

    margin_loss, calls = module.margin_loss, []

    def diverge(*inputs: object) -> tuple:
        calls.append(1)
        loss, margins = margin_loss(*inputs)  # pyright: ignore[reportArgumentType]
        return (loss * float("inf") if len(calls) == 6 else loss), margins

    monkeypatch.setattr(module, "margin_loss", diverge)
    line = refused(capsys, *words(small_dataset.folder, tmp_path / "run"))
    assert "the training loss is inf in epoch 2, at step 5; lower the learning rate" in line


def test_one_condition_alone(small_dataset: Dataset, tmp_path: Path, capsys):
    data = divided(small_dataset, tmp_path / "data", test={"split": "train"})
    assert train(data, tmp_path / "run", "--condition", "dry") == 0
    assert json.loads((tmp_path / "run" / "result.json").read_text())["train_frames"] == 5 * 11  # six but the wet one
    assert json.loads((tmp_path / "run" / "run.json").read_text())["config"]["condition"] == "dry"
    assert "other settings" in refused(capsys, *words(data, tmp_path / "run"))


def with_margin(data: Dataset, folder: Path, margin: float) -> Path:
    """The small data set with one margin for all labelled frames."""
    whole = [data.load(info) for info in data.trials]
    same = [replace(one, safety_margin=np.where(one.labelled, margin, np.nan)) for one in whole]
    save_dataset(folder, *same, split=[info.split for info in data.trials])
    return folder


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda data, folder: divided(data, folder, validation={"split": ""}), "has no trial with split validation"),
        (lambda data, folder: divided(data, folder, validation={"height": 60, "width": 80}), "frames of several sizes"),
        (lambda data, folder: with_margin(data, folder, np.nan), "no frame of the 4 trials has a label"),
        (lambda data, folder: with_margin(data, folder, 1.0), "all 44 labels that"),
    ],
    ids=["no validation split", "two sizes", "no label", "one margin"],
)
def test_data_that_cannot_train_are_refused(small_dataset: Dataset, tmp_path: Path, capsys, make, message: str):
    assert message in refused(capsys, *words(make(small_dataset, tmp_path / "data"), tmp_path / "run"))
    assert {path.name for path in tmp_path.iterdir()} == {"data"}


def test_it_goes_on_from_a_network_at_another_size(finished: Path, small_dataset: Dataset, tmp_path: Path):
    assert train(small_dataset.folder, tmp_path / "more", "--start-from", str(finished), "--image-size", "48") == 0
    start, more = load(finished).manifest, load(tmp_path / "more").manifest
    assert more.started_from == start.weights_sha256
    assert more.image_size == 48
    recipe = json.loads((tmp_path / "more" / "run.json").read_text())["config"]
    assert recipe["started_from"] == start.weights_sha256
