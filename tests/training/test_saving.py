from pathlib import Path

import pytest
import torch

from sliplens.errors import InputError
from sliplens.training.module import WholeCheckpoints


def test_a_checkpoint_comes_back(tmp_path: Path):
    files = WholeCheckpoints()
    files.save_checkpoint({"a": torch.arange(3)}, tmp_path / "new" / "last.ckpt")
    assert files.load_checkpoint(tmp_path / "new" / "last.ckpt", weights_only=True)["a"].tolist() == [0, 1, 2]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["last.ckpt"]


def test_a_full_disk_leaves_the_old_checkpoint_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    files = WholeCheckpoints()
    files.save_checkpoint({"epoch": 1}, tmp_path / "last.ckpt")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(
        InputError, match=r"cannot save the checkpoint .*last.ckpt \(No space left on device\); make room"
    ):
        files.save_checkpoint({"epoch": 2}, tmp_path / "last.ckpt")
    assert files.load_checkpoint(tmp_path / "last.ckpt", weights_only=True) == {"epoch": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]
