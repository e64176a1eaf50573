import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from sliplens.explainers import Explanation, IntegratedGradients
from sliplens.faithfulness.map_quality import gini, total_variation
from sliplens.recordings import Dataset
from sliplens.study.map_quality import check_looks
from sliplens.study.material import Material
from sliplens.study.randomisation import check_randomisation, explain_untrained, load_untrained
from sliplens.study.timing import time_explainers


class ShowsTheImage:
    """An explainer that never asks the network."""

    def __call__(self, _model: nn.Module, images: Tensor, **_options: object) -> Explanation:
        return Explanation(
            images=images,
            relevance=images.mean(dim=1),
            method="image",
            target="nothing",
            prediction=torch.ones(len(images)),
            reference_prediction=torch.zeros(len(images)),
            seconds=0.0,
        )


def with_image(material: Material, explainer: ShowsTheImage) -> Material:
    """The material with one more method, whose maps are the images, turned to each frame's target."""
    shown = (material.inputs.mean(dim=1).numpy() * material.towards[:, None, None]).astype(np.float32)
    return replace(
        material,
        explained=replace(material.explained, relevance={"image": shown, **material.explained.relevance}),
        explainers={"image": explainer, **material.explainers},
    )


def test_a_map_that_ignores_the_network_is_found_out(material: Material, tmp_path: Path):
    check_randomisation(with_image(material, ShowsTheImage()), tmp_path)
    told = json.loads((tmp_path / "result.json").read_text())
    assert told["methods"]["image"]["similarity"] == pytest.approx([1.0, 1.0, 1.0])
    assert told["methods"]["image"]["complexity_rise"] == pytest.approx(0)
    assert any(alarm.startswith("image still correlates by 1.00") for alarm in told["alarms"])
    assert told["methods"]["grad-cam"]["similarity"][-1] != pytest.approx(1.0)


def test_a_map_that_only_turns_its_sign_with_the_answers_is_as_similar(material: Material, tmp_path: Path):
    class FollowsTheSign(ShowsTheImage):
        """The image again, as what raises the answer of the trained network and lowers that of every other."""

        def __call__(self, model: nn.Module, images: Tensor, **options: object) -> Explanation:
            found, sign = super().__call__(model, images, **options), 1 if model is material.trained.model else -1
            return replace(found, relevance=sign * found.relevance, prediction=sign * found.prediction)

    check_randomisation(with_image(material, FollowsTheSign()), tmp_path)
    told = json.loads((tmp_path / "result.json").read_text())
    assert told["methods"]["image"]["similarity"] == pytest.approx([1.0, 1.0, 1.0])


def test_the_untrained_control_leaves_the_network_as_it_is(material: Material, tmp_path: Path):
    before = {name: value.clone() for name, value in material.trained.model.state_dict().items()}

    def explain(name: str, seed: int) -> np.ndarray:
        (tmp_path / name).mkdir()
        explain_untrained(material, IntegratedGradients(steps=8, max_steps=8), tmp_path / name, seed=seed)
        return load_untrained(tmp_path / name)

    first, again, other = explain("first", 1), explain("again", 1), explain("other", 2)
    assert first.shape == (len(material.inputs), *material.inputs.shape[-2:])
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0
    assert all(torch.equal(value, before[name]) for name, value in material.trained.model.state_dict().items())


def test_looks_are_those_of_the_saved_maps(material: Material, fine_dataset: Dataset, tmp_path: Path):
    check_looks(material, fine_dataset, tmp_path)
    told = json.loads((tmp_path / "result.json").read_text())
    maps = material.explained.saliency["grad-cam"].astype(np.float64)
    found = told["methods"]["grad-cam"]
    assert found["total_variation"] == pytest.approx(np.mean([total_variation(one) for one in maps]))
    assert found["gini"] == pytest.approx(np.mean([gini(one) for one in maps]))
    (gap,) = told["comparisons"]
    other = np.mean([total_variation(one) for one in material.explained.saliency[gap["second"]].astype(np.float64)])
    assert (gap["first"], gap["measure"]) == ("grad-cam", "total_variation")
    assert gap["estimate"] == pytest.approx(found["total_variation"] - other)
    # frames that follow each other share a reference without noise: nothing shakes, so the maps stay as they are
    assert told["noise_sd"] == 0
    assert found["noise_stability"] == pytest.approx(1.0, abs=1e-4)


def test_the_time_without_the_forward_pass_is_shorter_by_that_pass(material: Material, tmp_path: Path):
    time_explainers(material, tmp_path)
    told = json.loads((tmp_path / "result.json").read_text())
    for one in told["methods"].values():
        assert one["low"] <= one["seconds"] <= one["high"]
        assert one["seconds_without_forward"] == pytest.approx(max(0, one["seconds"] - told["forward_seconds"]))
