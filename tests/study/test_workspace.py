"""Explanations and their deletion scores as records, with and without a folder."""

from pathlib import Path

import numpy as np
import pytest

from sliplens.errors import CheckpointError, InputError
from sliplens.recordings import Dataset
from sliplens.results import load_explanation
from sliplens.study import explain_source, score_explained

LEVELS = (1.0, 0.0)


def test_a_folder_holds_what_is_given_back_without_one(difference_run: Path, small_dataset: Dataset, tmp_path: Path):
    told = []

    def on_progress(done: int, total: int) -> None:
        told.append((done, total))

    run = {"run": difference_run, "source": small_dataset, "methods": ("grad-cam",), "levels": LEVELS}
    explained = explain_source(**run, on_progress=on_progress)
    assert told[-1] == (2, 2)
    kept = explain_source(**run, out=tmp_path / "maps")
    np.testing.assert_array_equal(kept.relevance["grad-cam"], explained.relevance["grad-cam"])
    assert kept.frames == explained.frames == load_explanation(tmp_path / "maps").frames
    again = explain_source(**run, out=tmp_path / "maps", on_progress=on_progress)
    assert len(told) == 2  # nothing was explained again
    assert again.methods == kept.methods

    scores = score_explained(difference_run, explained, steps=4)
    saved = score_explained(difference_run, tmp_path / "maps", steps=4, out=tmp_path / "scores")
    assert scores.methods == saved.methods
    assert list(scores.methods) == ["grad-cam", "random"]


def test_a_failure_after_the_last_map_loses_none(
    difference_run: Path, small_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run = {"run": difference_run, "source": small_dataset, "methods": ("grad-cam",), "levels": LEVELS}
    run |= {"out": tmp_path / "maps"}

    def fail(*_: object, **__: object) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("sliplens.study.workspace.draw_explained", fail)
        with pytest.raises(OSError, match="no space left"):
            explain_source(**run)
    with monkeypatch.context() as patch:
        patch.setattr("sliplens.explainers.cam._differentiate", fail)  # no map is made again
        assert len(explain_source(**run).frames) == 2
    assert not (tmp_path / "maps" / "parts").exists()


def test_a_mistake_is_told_before_a_network_is_loaded(small_dataset: Dataset):
    with pytest.raises(InputError, match="there is no explainer named 'gradcam'"):
        explain_source("no such run", small_dataset, methods=("gradcam",))
    with pytest.raises(InputError, match="--trials must be at least 1, got 0"):
        explain_source("no such run", small_dataset, trials=0)
    with pytest.raises(InputError, match="there is no fill named 'pink'"):
        score_explained("no such run", Path("no such folder"), fill="pink")


def test_maps_of_another_network_are_refused(difference_run: Path, raw_run: Path, small_dataset: Dataset):
    explained = explain_source(difference_run, small_dataset, methods=("grad-cam",), levels=LEVELS)
    with pytest.raises(CheckpointError, match="these explanations were made with another network"):
        score_explained(raw_run, explained)
