"""Mistakes on the command line: one sentence with its cure, exit code 2, and nothing written."""

from pathlib import Path

import numpy as np
import pytest
from command_line import refused, run
from own_recording import write_forces, write_video
from PIL import Image

from sliplens.recordings import Dataset, Recording

SMALL = "--dry-trials 3 --wet-trials 1 --days 2 --frames-per-trial 20"
MISTAKES = {
    "train NOTHING -o OUT": "the data set NOTHING does not exist; check the path",
    "train DATA -o OUT --start-from RUN --input raw --image-size 32": "has the input difference, and raw is to be",
    "train DATA -o OUT --start-from NOTHING": "NOTHING does not exist; check the path",
    "train DATA -o OUT --image-size 16": "--image-size must be 32 to 4096, got 16",
    "train DATA -o OUT --batch-size 1": "--batch-size must be 2 to 1e",
    "train DATA -o OUT --logger wandb": "no logger named 'wandb'; choose csv or tensorboard, or in Python one of",
    "train DATA -o OUT --condition oily": "and condition oily; it has test/dry, test/wet, train/dry, validation/dry",
    "explain RUN --frames FRAMES/tall -o OUT": "a_20.png are 50 x 48 pixels but the network was",
    "explain RUN -o OUT": "requires an argument",
    "explain RUN DATA": "name the folder of the maps with -o",
    "predict RUN DATA -o OUT.txt": "does not end in .parquet or .csv",
    "predict RUN DATA -o OUT.csv --batch-size 0": "--batch-size must be at least 1, got 0",
    "predict NOTHING DATA -o OUT.csv": "the run NOTHING does not exist",
    "predict RUN NOTHING -o OUT.csv": "NOTHING does not exist",
    "predict RUN DATA -o OUT.csv --split exam": "no trial with split exam",
    "study DATA -o OUT --network RUN chromatouch-difference --trials 4": "two networks read the input difference",
    "study DATA -o OUT --method guess": "no method named 'guess'",
    "report EMPTY": "EMPTY",
    "demo EMPTY/..": "is no demo; choose another folder",
    f"simulate {SMALL}": "name the folder of the data set with -o",
    "simulate OUT --days 1": "days is 1, but at least 2 are needed",
    f"simulate OUT --seed -1 {SMALL}": "seed is -1",
    "predict VIDEO --device toaster": "device 'toaster' is not known; use cpu, cuda or cuda:1",
    "predict VIDEO --device cuda:99": "device cuda:99 is not on this machine; use cpu",
    "import VIDEO -o OUT --sensor mine": "has no forces to label it by; give their table",
    "import VIDEO -o OUT --sensor mine --forces NOTHING": "NOTHING does not exist",
    "import VIDEO -o OUT --sensor mine --forces PROFILE": "is no table; name one (CSV)",
    "import VIDEO -o OUT --sensor EMPTY/tip --forces FORCES": "there is no sensor profile",
    "import VIDEO -o OUT --sensor tip.tml --forces FORCES": "there is no sensor profile tip.tml; name a file",
    "predict RUN VIDEO --sensor tip.tml": "there is no sensor profile tip.tml; name a file",
    "import VIDEO -o OUT --sensor mine --format papyrus": "no format named 'papyrus'; choose one of sliplens",
    "import VIDEO -o OUT --sensor mine --image-topic /camera": "is read as video, which does not take --image-topic",
    "import VIDEO -o OUT --sensor mine --forces FORCES --test-trials 2": "2 to test are more than 1; give fewer",
    "import VIDEO -o OUT --sensor mine --forces FORCES --test-trials -1": "numbers of trials are not negative",
    "import VIDEO -o OUT --sensor mine --forces FORCES --reference-frame 999": "the reference is frame 999 of 240",
    "split DATA --splits NOTHING": "name trial, object or day",
    "split DATA --splits object": "the object of",
    "split NOTHING --splits trial": "does not exist",
    "label DATA --draft OUT -o EMPTY": "leave",
    "export onnx DATA -o OUT.onnx": "does not exist; make it with",
    "export onnx RUN -o OUT": "does not end in .onnx",
    "track DATA -o OUT.csv": "does not end in .parquet",
    "track DATA -o OUT.parquet --trial other": "no trial other",
    "track FRAMES/good -o OUT.parquet --reference-frame 9": "has no frame 9",
    "track FRAMES/good -o OUT.parquet": "one frame and no reference",
    "view DATA --trial nobody -o OUT.rrd": "has no trial nobody; it has train-dry-0",
    "view DATA -o OUT.html": "does not end in .rrd",
    "view NOTHING": "does not exist",
    "live 99": "the camera /dev/video99 is not there; plug it in",
    "live 0 --size 640": "--size requires 2",
    "live simulated --sink paper": "there is no sink named 'paper'; choose one of json",
    "live simulated --speed 2": "a simulated chromatouch takes no --speed; leave it out",
    "live nowhere": "nowhere is no source that is known",
    "live DATA --sensor PROFILE --no-page": "the run trained-elsewhere does not exist",
    "hold grip": "--gripper requires an argument",
    "hold grip --gripper tcp://nowhere": "is no address of a gripper",
    "hold grip:anvil --gripper dry-run": "there is no object named 'anvil'",
    "hold simulated --gripper dry-run --reference one.png two.png": "an image for each source, 1, got 2",
    "hold simulated --gripper dry-run --controller fixed --set speed=3": "has no constant 'speed'",
    "hold simulated --gripper dry-run --sensor PROFILE": "the run trained-elsewhere does not exist",
    "grip -o OUT --set target": "write NAME=NUMBER",
    "grip -o OUT --network NOTHING": "the run NOTHING does not exist",
}
"""Message of each mistake."""


@pytest.fixture(scope="module")
def places(
    tmp_path_factory: pytest.TempPathFactory, small_dataset: Dataset, difference_run: Path, trial: Recording
) -> dict[str, str]:
    """Paths that the mistakes name in capitals."""
    folder = tmp_path_factory.mktemp("mistakes")
    (folder / "empty").mkdir()
    for name, pixels in {
        "good/a_20.png": np.zeros((48, 48, 3), np.uint8),
        "tall/a_20.png": np.zeros((50, 48, 3), np.uint8),
    }.items():
        path = folder / "frames" / name
        path.parent.mkdir(parents=True)
        Image.fromarray(pixels).save(path)
    (folder / "tip.toml").write_text('name = "tip"\nnetwork = "trained-elsewhere"\n', encoding="utf-8")
    return {
        "NOTHING": str(folder / "nothing"),
        "EMPTY": str(folder / "empty"),
        "OUT": str(folder / "out"),
        "FRAMES": str(folder / "frames"),
        "PROFILE": str(folder / "tip.toml"),
        "VIDEO": str(write_video(trial, folder / "cup.mkv")),
        "FORCES": str(write_forces(trial, folder / "cup.csv")),
        "DATA": str(small_dataset.folder),
        "RUN": str(difference_run),
    }


def fill(text: str, places: dict[str, str]) -> str:
    for name, path in places.items():
        text = text.replace(name, path)
    return text


@pytest.mark.parametrize(("words", "message"), MISTAKES.items(), ids=MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_nothing(
    words: str, message: str, places: dict[str, str], capsys: pytest.CaptureFixture[str]
):
    folder = Path(places["OUT"]).parent
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert fill(message, places) in refused(capsys, *(fill(word, places) for word in words.split()))
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize(
    "words",
    [
        "predict RUN DATA -o FILE.csv",
        "track DATA -o FILE.parquet",
        "view DATA -o FILE.rrd",
        "export onnx RUN -o FILE.onnx",
    ],
)
def test_a_file_is_replaced_only_by_overwrite(
    words: str, places: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    if words.startswith("view"):
        pytest.importorskip("rerun")
    if words.startswith("export"):
        pytest.importorskip("onnxscript")
    asked = fill(words.replace("FILE", str(tmp_path / "a")), places).split()
    file = Path(asked[-1])
    file.write_text("somebody's")
    assert "exists; choose another file or pass --overwrite" in refused(capsys, *asked)
    assert file.read_text() == "somebody's"
    if not words.startswith("track"):  # frames of noise show no markers
        assert run(*asked, "--overwrite") == 0
        assert file.read_bytes() != b"somebody's"
