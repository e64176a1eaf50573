"""`explain` of a data set: its folder, interrupted and continued, in other processes, and damaged."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sliplens.errors import InputError
from sliplens.explainers.explain import network_inputs
from sliplens.explainers.frames import FrameSelection
from sliplens.files import output_folder
from sliplens.models import Network
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation, load_explanation
from sliplens.study.explaining import explain

METHODS = ("grad-cam", "integrated-gradients")
MakeMaps = Callable[..., Explanation]


@pytest.fixture(scope="module")
def explain_all(network: Network, small_dataset: Dataset) -> MakeMaps:
    return partial(explain, network, small_dataset, method=METHODS, select=FrameSelection(levels=(1.0, 0.0)))


@pytest.fixture(scope="module")
def folder(explain_all: MakeMaps, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("explained") / "maps"
    explain_all(out=target)
    return target


def require_same(first: Explanation, second: Explanation) -> None:
    assert first.frames == second.frames
    for name in ("images", "references", "pictures"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for method in METHODS:
        np.testing.assert_array_equal(first.relevance[method], second.relevance[method])
        np.testing.assert_array_equal(first.saliency[method], second.saliency[method])


def test_a_folder_holds_the_record_that_is_returned_without_one(explain_all: MakeMaps, network: Network, folder: Path):
    progress = []
    explanation = explain_all(on_progress=lambda *step: progress.append(step))
    assert progress[-1] == (4, 4)
    saved = load_explanation(folder)
    require_same(saved, explanation)
    assert list(saved.methods) == list(METHODS)
    predictions = network.predict(network_inputs(network, saved)).numpy()
    np.testing.assert_allclose([frame.prediction for frame in saved.frames], predictions, atol=1e-6)


def test_a_complete_folder_is_read_and_not_made_again(explain_all: MakeMaps, folder: Path):
    progress = []
    again = explain_all(out=folder, on_progress=lambda *step: progress.append(step))
    assert not progress
    assert again.methods == load_explanation(folder).methods


def part_times(parts: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in parts.rglob("arrays.npz")}


def test_an_interrupted_explanation_continues_after_the_last_map(explain_all: MakeMaps, folder: Path, tmp_path: Path):
    def interrupt(done: int, total: int) -> None:
        assert total == 4
        if done == 3:
            raise KeyboardInterrupt

    out, parts = tmp_path / "maps", tmp_path / ".maps.partial" / "parts"
    with pytest.raises(KeyboardInterrupt):
        explain_all(out=out, on_progress=interrupt)
    before = part_times(parts)
    assert len(before) == 3
    after: dict[str, int] = {}
    explain_all(out=out, on_progress=lambda *_: after.update(part_times(parts)))
    assert before.items() <= after.items()  # the three maps were not made again
    require_same(load_explanation(out), load_explanation(folder))


def test_a_failure_after_the_last_map_loses_none(
    explain_all: MakeMaps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def fail(*_: object, **__: object) -> None:
        raise OSError("no space left on device")

    out = tmp_path / "maps"
    with monkeypatch.context() as patch:
        patch.setattr("sliplens.study.explaining.draw_explanation", fail)
        with pytest.raises(OSError, match="no space left"):
            explain_all(method="grad-cam", out=out)
    monkeypatch.setattr("sliplens.explainers.cam.capture", fail)  # no map is made again
    assert len(explain_all(method="grad-cam", out=out).frames) == 2
    assert not (out / "parts").exists()


def test_maps_are_the_same_in_another_process(explain_all: MakeMaps, folder: Path, tmp_path: Path, elsewhere: str):
    require_same(explain_all(out=tmp_path / "maps", on=elsewhere), load_explanation(folder))


def test_a_folder_of_another_stage_is_refused(tmp_path: Path):
    with output_folder(tmp_path / "run", stage="train", config={}) as out:
        (out.folder / "result.json").write_text("{}")
    with pytest.raises(InputError, match="holds no explanations; make them with sliplens explain"):
        load_explanation(tmp_path / "run")
