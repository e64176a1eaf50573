"""`explain` of a data set: its folder, interrupted and continued, in other processes, and damaged."""

from pathlib import Path

import numpy as np
import pytest

from sliplens.errors import InputError
from sliplens.explainers.explain import network_inputs
from sliplens.explainers.frames import FrameSelection
from sliplens.files import output_folder
from sliplens.models import Network, load
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation, load_explanation
from sliplens.study.explaining import explain

METHODS = ("grad-cam", "integrated-gradients")
SELECT = FrameSelection(levels=(1.0, 0.0))


@pytest.fixture(scope="module")
def trained(difference_run: Path) -> Network:
    return load(difference_run)


@pytest.fixture(scope="module")
def folder(trained: Network, small_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("explained") / "maps"
    explain(trained, small_dataset, method=METHODS, select=SELECT, out=target)
    return target


def require_same(first: Explanation, second: Explanation) -> None:
    assert first.frames == second.frames
    for name in ("images", "references", "pictures"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for method in METHODS:
        np.testing.assert_array_equal(first.relevance[method], second.relevance[method])
        np.testing.assert_array_equal(first.saliency[method], second.saliency[method])


def test_a_folder_holds_the_record_that_is_returned_without_one(trained: Network, small_dataset: Dataset, folder: Path):
    progress = []
    explanation = explain(
        trained, small_dataset, method=METHODS, select=SELECT, on_progress=lambda *step: progress.append(step)
    )
    assert progress[-1] == (4, 4)
    saved = load_explanation(folder)
    require_same(saved, explanation)
    assert list(saved.methods) == list(METHODS)
    predictions = trained.predict(network_inputs(trained, saved)).numpy()
    np.testing.assert_allclose([frame.prediction for frame in saved.frames], predictions, atol=1e-6)


def test_a_complete_folder_is_read_and_not_made_again(folder: Path, trained: Network, small_dataset: Dataset):
    progress = []
    again = explain(
        trained,
        small_dataset,
        method=METHODS,
        select=SELECT,
        out=folder,
        on_progress=lambda *step: progress.append(step),
    )
    assert not progress
    assert again.methods == load_explanation(folder).methods


def part_times(parts: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in parts.rglob("arrays.npz")}


def test_an_interrupted_explanation_continues_after_the_last_map(
    trained: Network, small_dataset: Dataset, folder: Path, tmp_path: Path
):
    def interrupt(done: int, total: int) -> None:
        assert total == 4
        if done == 3:
            raise KeyboardInterrupt

    out = tmp_path / "maps"
    with pytest.raises(KeyboardInterrupt):
        explain(trained, small_dataset, method=METHODS, select=SELECT, out=out, on_progress=interrupt)
    parts = tmp_path / ".maps.partial" / "parts"
    before = part_times(parts)
    assert len(before) == 3
    after: dict[str, int] = {}
    explain(
        trained,
        small_dataset,
        method=METHODS,
        select=SELECT,
        out=out,
        on_progress=lambda *_: after.update(part_times(parts)),
    )
    assert before.items() <= after.items()  # the three maps were not made again
    require_same(load_explanation(out), load_explanation(folder))


def test_a_failure_after_the_last_map_loses_none(
    trained: Network, small_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def fail(*_: object, **__: object) -> None:
        raise OSError("no space left on device")

    out = tmp_path / "maps"
    for name, error in (
        ("sliplens.study.explaining.draw_explanation", OSError),
        ("sliplens.explainers.cam.capture", None),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(name, fail)
            if error is None:  # no map is made again
                assert len(explain(trained, small_dataset, method="grad-cam", select=SELECT, out=out).frames) == 2
            else:
                with pytest.raises(error, match="no space left"):
                    explain(trained, small_dataset, method="grad-cam", select=SELECT, out=out)
    assert not (out / "parts").exists()


def test_maps_are_the_same_in_another_process(
    trained: Network, small_dataset: Dataset, folder: Path, tmp_path: Path, elsewhere: str
):
    found = explain(trained, small_dataset, method=METHODS, select=SELECT, out=tmp_path / "maps", on=elsewhere)
    require_same(found, load_explanation(folder))


def test_a_folder_of_another_stage_is_refused(tmp_path: Path):
    with output_folder(tmp_path / "run", stage="train", config={}) as out:
        (out.folder / "result.json").write_text("{}")
    with pytest.raises(InputError, match="holds no explanations; make them with sliplens explain"):
        load_explanation(tmp_path / "run")
