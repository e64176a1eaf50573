import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from torch import distributed

from sliplens.models import load_checkpoint
from sliplens.models.encodings import ENCODINGS
from sliplens.recordings import Dataset
from sliplens.training import evaluate_frames
from sliplens.training.data import load_frames

pytestmark = pytest.mark.skipif(
    not (distributed.is_available() and distributed.is_gloo_available()),
    reason="this build of torch has no gloo, through which processes on CPUs talk",
)
DDP_VARIABLES = ("LOCAL_RANK", "RANK", "NODE_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


def environment(**more: str) -> dict[str, str]:
    """One thread a process, and nothing that a launcher of these tests may have said."""
    kept = {name: value for name, value in os.environ.items() if name not in DDP_VARIABLES}
    return {**kept, "OMP_NUM_THREADS": "1", **more}


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
        encoding=ENCODINGS["difference"],
        image_size=32,
    )
    alone = evaluate_frames(trained, frames).conditions["dry"].mse
    # the same weights and frames in other batches: sums of single floats in another order
    assert trained.manifest.metrics["validation_mse"] == pytest.approx(alone, abs=1e-5)
