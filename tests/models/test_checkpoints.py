import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sliplens.errors import CheckpointError, ImageError
from sliplens.files import hash_file
from sliplens.models import load, save_checkpoint


@pytest.fixture
def run(tmp_path: Path, difference_run: Path) -> Path:
    shutil.copytree(difference_run, tmp_path / "run")
    return tmp_path / "run"


def edit_manifest(run: Path, **changes: object) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(manifest | changes))


def test_half_precision_weights_are_read_as_the_numbers_they_are(run: Path, tmp_path: Path):
    trained = load(run)
    halves = {
        name: values.half() if values.is_floating_point() else values
        for name, values in trained.model.state_dict().items()
    }
    trained.model.load_state_dict(halves, assign=True)
    save_checkpoint(tmp_path, trained.model, trained.manifest)
    for name, values in load(tmp_path).model.state_dict().items():
        assert values.dtype in {torch.float32, torch.int64}
        torch.testing.assert_close(values, halves[name].to(values.dtype), rtol=0, atol=0)


def test_changed_weights_are_refused(run: Path):
    weights = run / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])
    with pytest.raises(CheckpointError, match=r"model\.safetensors is not the file its manifest describes"):
        load(run)


def test_weights_that_are_no_finite_numbers_are_refused(run: Path, tmp_path: Path):
    trained = load(run)
    with torch.no_grad():
        next(trained.model.parameters()).fill_(float("nan"))
    save_checkpoint(tmp_path, trained.model, trained.manifest)
    with pytest.raises(CheckpointError, match="holds a value that is no finite number"):
        load(tmp_path)


def test_a_pickle_in_place_of_weights_is_refused_unopened(run: Path):
    class Bomb:
        def __reduce__(self) -> tuple:
            return (pytest.fail, ("the pickle was opened",))

    weights = run / "model.safetensors"
    weights.write_bytes(pickle.dumps(Bomb()))
    edit_manifest(run, weights_sha256=hash_file(weights))
    with pytest.raises(CheckpointError, match="does not hold a shufflenet_v2_x1_0 with a point head"):
        load(run)


def test_images_of_the_other_kind_are_noticed(run: Path, raw_run: Path):
    size = load(run).manifest.frame_size
    difference, frame = np.zeros((*size, 3), dtype=np.uint8), np.full((*size, 3), 120, dtype=np.uint8)
    difference[4:9, 4:9] = 60
    load(run).require_kind(difference, what="a.png")
    load(raw_run).require_kind(frame, what="a.png")
    with pytest.raises(ImageError, match="as bright as a camera frame"):
        load(run).require_kind(frame, what="a.png")
    raw = load(raw_run)
    for seen in ("raw", "pair"):
        network = replace(raw, manifest=replace(raw.manifest, input=seen))
        with pytest.raises(ImageError, match="as dark as a difference image"):
            network.require_kind(difference, what="a.png")
