import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sliplens.codec import load_result, save_result
from sliplens.errors import CheckpointError, InputError, SliplensError
from sliplens.explainers.attribution import Attribution
from sliplens.explainers.table import EXPLAINERS
from sliplens.files import output_folder
from sliplens.models import Network, load_checkpoint
from sliplens.recordings import Dataset
from sliplens.results import Explanation, load_explanation
from sliplens.results.faithfulness import DeletionScores
from sliplens.study import explain_frames, frames_from_dataset, score_explained
from sliplens.study.explaining import network_inputs

METHODS = ("grad-cam", "integrated-gradients")


@pytest.fixture(scope="module")
def trained(difference_run: Path) -> Network:
    return load_checkpoint(difference_run)


def explain(trained: Network, data: Dataset, target: Path, **more: object) -> Explanation:
    chosen = frames_from_dataset(trained, data, levels=(1.0, 0.0))
    config = {"weights_sha256": trained.manifest.weights_sha256}
    with output_folder(target, stage="explain", config=config) as out:
        parts = out.folder / "parts"
        found = explain_frames(trained, chosen, methods=METHODS, parts=parts, **more)  # pyright: ignore[reportArgumentType]
        shutil.rmtree(parts)
        save_result(found, out.folder)
    return found


@pytest.fixture(scope="module")
def explanations(trained: Network, small_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("explained") / "maps"
    explain(trained, small_dataset, target)
    return target


def test_explanations_come_back_without_loss(trained: Network, small_dataset: Dataset, tmp_path: Path):
    written = explain(trained, small_dataset, tmp_path / "maps")
    back = load_explanation(tmp_path / "maps")
    assert back.frames == written.frames
    np.testing.assert_array_equal(back.images, written.images)
    np.testing.assert_array_equal(back.pictures, written.pictures)
    assert back.methods == written.methods
    for method in METHODS:
        np.testing.assert_array_equal(back.relevance[method], written.relevance[method])
        np.testing.assert_array_equal(back.saliency[method], written.saliency[method])


def test_the_table_holds_the_networks_answers(trained: Network, explanations: Path):
    back = load_explanation(explanations)
    answers = trained.predict(network_inputs(trained, back))
    np.testing.assert_allclose([frame.prediction for frame in back.frames], answers.numpy(), atol=1e-6)


def made(parts: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in parts.rglob("arrays.npz")}


def test_an_interrupted_explanation_goes_on_after_the_last_map(
    trained: Network, small_dataset: Dataset, explanations: Path, tmp_path: Path
):
    def interrupt(done: int, total: int) -> None:
        assert total == 4
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        explain(trained, small_dataset, tmp_path / "maps", on_progress=interrupt)
    parts = tmp_path / ".maps.partial" / "parts"
    before = made(parts)
    assert len(before) == 3
    seen: dict[str, int] = {}

    def look(done: int, total: int) -> None:
        seen.update(made(parts))

    explain(trained, small_dataset, tmp_path / "maps", on_progress=look)
    assert before.items() <= seen.items()  # the three maps were not made again
    first, second = load_explanation(explanations), load_explanation(tmp_path / "maps")
    for method in METHODS:
        np.testing.assert_array_equal(first.relevance[method], second.relevance[method])


def test_maps_are_the_same_in_another_process(
    trained: Network, small_dataset: Dataset, explanations: Path, tmp_path: Path, elsewhere: str
):
    explain(trained, small_dataset, tmp_path / "maps", on=elsewhere)
    first, second = load_explanation(explanations), load_explanation(tmp_path / "maps")
    for method in METHODS:
        np.testing.assert_array_equal(first.relevance[method], second.relevance[method])
        np.testing.assert_array_equal(first.saliency[method], second.saliency[method])


def test_a_map_that_is_not_finite_is_told_and_not_kept(trained: Network, small_dataset: Dataset, tmp_path: Path):
    def holes(*given: Any, **options: Any) -> Attribution:
        found = EXPLAINERS["grad-cam"](*given, **options)
        found.relevance[:, :2, 0] = torch.nan
        return found

    chosen = frames_from_dataset(trained, small_dataset, levels=(1.0,))
    with pytest.raises(SliplensError, match=r"the map of .* by holes holds NaN or infinity in 2 of \d+ pixels"):
        explain_frames(trained, chosen, methods=["holes"], explainers={"holes": holes}, parts=tmp_path)
    assert not list(tmp_path.glob("trial=*/*"))


def test_an_unknown_method_lists_those_there_are(trained: Network, small_dataset: Dataset):
    chosen = frames_from_dataset(trained, small_dataset)
    with pytest.raises(InputError, match="no explainer named 'lime'; choose from grad-cam, integrated-gradients, poly"):
        explain_frames(trained, chosen, methods=("lime",))


def change_maps(explanations: Path, tmp_path: Path, **changes: np.ndarray) -> Path:
    folder = tmp_path / "changed"
    shutil.copytree(explanations, folder)
    maps = dict(np.load(folder / "arrays.npz"))
    np.savez(folder / "arrays.npz", **(maps | changes))  # pyright: ignore[reportArgumentType]
    return folder


def test_a_map_of_another_shape_is_refused(explanations: Path, tmp_path: Path):
    folder = change_maps(explanations, tmp_path, **{"relevance/grad-cam": np.zeros((2, 32, 31), np.float32)})
    with pytest.raises(InputError, match=r"holds float32 of shape \(2, 32, 31\) as 'relevance/grad-cam' where"):
        load_explanation(folder)


def test_a_missing_map_is_refused(explanations: Path, tmp_path: Path):
    folder = change_maps(explanations, tmp_path, **{"relevance/grad-cam": np.zeros((1, 32, 32), np.float32)})
    with pytest.raises(
        InputError,
        match=r"holds float32 of shape \(1, 32, 32\) as 'relevance/grad-cam' where",
    ):
        load_explanation(folder)


def test_truncated_maps_are_refused(explanations: Path, tmp_path: Path):
    folder = change_maps(explanations, tmp_path)
    (folder / "arrays.npz").write_bytes((folder / "arrays.npz").read_bytes()[:500])
    with pytest.raises(InputError, match=r"arrays\.npz cannot be read as arrays .*; .*`sliplens explain`"):
        load_explanation(folder)


def test_a_folder_of_another_stage_is_refused(tmp_path: Path):
    with output_folder(tmp_path / "run", stage="train", config={}) as out:
        (out.folder / "result.json").write_text("{}")
    with pytest.raises(InputError, match="holds no explanations; make them with sliplens explain"):
        load_explanation(tmp_path / "run")


def test_scores_follow_from_the_stored_curves(trained: Network, explanations: Path, tmp_path: Path):
    explained = load_explanation(explanations)
    save_result(score_explained(trained, explained, steps=8), tmp_path)
    scored = load_result(tmp_path, DeletionScores, command="sliplens score")
    assert set(scored.methods) == {*METHODS, "random"}
    for method, score in scored.methods.items():
        curve, auc = scored.curves[method], []
        for frame in explained.frames:
            answers = curve.predictions[curve.frame_ids.index(frame.id)]
            assert len(answers) == 8
            auc.append(np.mean([(1 - abs(frame.prediction - answer)) ** 2 for answer in answers]))
        assert score.mean == pytest.approx(np.mean(auc), abs=1e-6)
        assert score.sd == pytest.approx(np.std(auc), abs=1e-6)


def test_explanations_of_another_network_are_refused(raw_run: Path, explanations: Path):
    with pytest.raises(CheckpointError, match="made with another network; explain the frames again with this run"):
        score_explained(load_checkpoint(raw_run), load_explanation(explanations))


def test_alarms_say_when_the_fill_decides_and_when_no_method_beats_chance(trained: Network, explanations: Path):
    class Stubborn(torch.nn.Module):
        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return torch.full((len(images), 1), 0.7)

    result = score_explained(replace(trained, model=Stubborn()), load_explanation(explanations), steps=4)
    assert "the fill decides in 2 of 2 frames" in result.alarms[0]
    assert "grad-cam does not beat a random order (1.000 against 1.000)" in result.alarms
