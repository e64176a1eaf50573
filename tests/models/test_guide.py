"""The examples of docs/export.md do what they say."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from sliplens.images import write_png
from sliplens.models import Network
from sliplens.recordings import Dataset

GUIDE = Path(__file__).parents[2] / "docs" / "export.md"


@pytest.fixture
def blocks() -> list[str]:
    alone = GUIDE.read_text(encoding="utf-8").partition("## Use it without sliplens")[2]
    return re.findall(r"^```python[^\n]*\n(.*?)^```", alone, re.DOTALL | re.MULTILINE)


def test_the_file_is_read_without_sliplens(
    *,
    blocks: list[str],
    onnx_files: dict[str, Path],
    networks: dict[str, Network],
    small_dataset: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    assert "sliplens." not in re.sub(r'"sliplens\.\w+"', "", blocks[0])
    recording = small_dataset.load(small_dataset.select(split="test")[0])
    frame, reference = recording.frames[6], recording.reference
    write_png(tmp_path / "frame.png", frame)
    write_png(tmp_path / "untouched.png", reference)
    (tmp_path / "tip.onnx").write_bytes(onnx_files["histogram"].read_bytes())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ORT_DISABLE_TELEMETRY", "1")
    names: dict = {"os": os}
    exec(compile(blocks[0], str(GUIDE), "exec"), names)
    trained = networks["histogram"]
    inputs = trained.encode(frame[None], reference)
    # Pillow resizes in 8 bits, torch in floats: a grey level of the largest, and the largest itself may be off by one
    largest = names["resized"].max()
    assert np.abs(names["image"].transpose(2, 0, 1) - inputs[0].numpy()).max() <= 2.1 / largest
    estimate = trained.estimate(inputs)
    # what such a level does to an answer; these networks hardly move
    assert names["margin"][0] == pytest.approx(estimate.margin[0], abs=5e-3)
    out = capsys.readouterr().out
    assert f"safety margin {100 * names['margin'][0]:.0f} %" in out
    assert estimate.sigma is not None
    assert names["sigma"] == pytest.approx(estimate.sigma[0], abs=5e-3)
    assert "standard deviation" in out
