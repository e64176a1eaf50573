import json
import os
import re
import runpy
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import distributed

from sliplens.models import load_checkpoint
from sliplens.models.encodings import ENCODINGS
from sliplens.recordings import Dataset
from sliplens.training import evaluate_frames
from sliplens.training.data import EpochShuffle, load_frames

pytestmark = pytest.mark.skipif(
    not (distributed.is_available() and distributed.is_gloo_available()),
    reason="this build of torch has no gloo, through which processes on CPUs talk",
)
SCRIPT = Path(__file__).with_name("two_processes.py")
DDP_VARIABLES = ("LOCAL_RANK", "RANK", "NODE_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


def environment(**more: str) -> dict[str, str]:
    """One thread a process, and nothing that a launcher of these tests may have said."""
    kept = {name: value for name, value in os.environ.items() if name not in DDP_VARIABLES}
    return {**kept, "OMP_NUM_THREADS": "1", **more}


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def test_a_run_of_two_processes_is_whole_and_tells_its_own_error(tmp_path: Path, small_dataset: Dataset):
    words = ["train", small_dataset.folder, "-o", tmp_path / "run", "--devices", "2", "--accelerator", "cpu"]
    # a distribution is calibrated after its error was measured, which shifts its mean
    words += ["--head", "point", "--image-size", "32", "--epochs", "2", "--batch-size", "12"]
    done = subprocess.run(
        [sys.executable, "-m", "sliplens", *map(str, words)],
        env=environment(COLUMNS="200"),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    # one process speaks
    assert [line.split(":")[0].strip() for line in done.stderr.splitlines()] == ["note"]
    assert len(re.findall("wrote", done.stdout)) == 1
    assert len(re.findall("Reading training trials", done.stdout)) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert json.loads((tmp_path / "run" / "result.json").read_text())["processes"] == 2
    trained = load_checkpoint(tmp_path / "run")
    frames = load_frames(
        small_dataset,
        small_dataset.select(split="validation"),
        encoding=ENCODINGS.pick("difference"),
        image_size=32,
    )
    alone = evaluate_frames(trained, frames).conditions["dry"].mse
    # the same weights and frames in other batches: sums of single floats in another order
    assert trained.manifest.metrics["validation_mse"] == pytest.approx(alone, abs=1e-5)


def test_two_processes_started_by_torchrun_take_the_steps_of_one(tmp_path: Path, small_dataset: Dataset):
    port = str(free_port())
    both = []
    for rank in ("0", "1"):
        variables = environment(
            RANK=rank,
            LOCAL_RANK=rank,
            WORLD_SIZE="2",
            MASTER_ADDR="127.0.0.1",
            MASTER_PORT=port,
            TORCHELASTIC_RUN_ID="tests",
        )
        both.append(
            subprocess.Popen(
                [sys.executable, str(SCRIPT), str(tmp_path), str(small_dataset.folder)],
                env=variables,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    # meanwhile the same training in one process
    script = runpy.run_path(str(SCRIPT))
    frames = script["load"](small_dataset.folder)
    script["train"](tmp_path / "alone", frames, script["CONFIG"], devices=1)
    told = [process.communicate(timeout=300)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], told
    notes = json.loads((tmp_path / "notes.json").read_text())

    # without batch normalisation the mean gradient of two halves of a batch is that of the batch. What differs is
    # rounding, of 1e-7, which Adam's division by the gradient's own size makes larger where that is near zero
    shared, alone = (read_errors(tmp_path / name / "metrics.csv") for name in ("plain", "alone"))
    torch.testing.assert_close(shared, alone, rtol=1e-4, atol=0)
    weights = [load_file(tmp_path / name / "model.safetensors") for name in ("plain", "alone")]
    for name, value in weights[0].items():
        torch.testing.assert_close(value, weights[1][name], rtol=1e-3, atol=1e-4)

    # both stop at one step, or the first would wait for the other
    assert notes["stops"][1] == "time limit"

    order = EpochShuffle(44, seed=5).order(0)
    place = order.index(script["BAD_ROW"])
    step, rank = place // 12, place % 2
    rows = order[rank::2][6 * step : 6 * step + 3]
    named = [f"frame {frames[0].frame[row]} of {frames[0].trial[row]}" for row in rows]
    expected = f"nan in epoch 1, at step {step}, for a batch of {', '.join(named)} and 3 more"
    assert expected in notes["error"]


def read_errors(path: Path) -> torch.Tensor:
    rows = [row.split(",") for row in path.read_text().splitlines()[1:]]
    return torch.tensor([[float(row[1]), float(row[2])] for row in rows])
