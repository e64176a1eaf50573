from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from interval_ends import ends_of
from torch import Tensor, nn

from sliplens.explainers.attribution import Attribution
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.explainers.table import get_explainer
from sliplens.faithfulness.controls import cascade, total_variation
from sliplens.faithfulness.scoring import influences
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation, MethodNotes
from sliplens.results.faithfulness import NEW_WEIGHTS
from sliplens.results.study import Setting, StudyConfig
from sliplens.study.choice import Material
from sliplens.study.run import Records, judge_by_truth
from sliplens.study.scoring import Removal, Untrained, measure_maps


class ShowsTheImage:
    """An explainer that never asks the network."""

    def __call__(self, _model: nn.Module, images: Tensor, **_options: object) -> Attribution:
        return Attribution(
            relevance=images.mean(dim=1),
            method="image",
            target="nothing",
            prediction=torch.ones(len(images)),
            reference_prediction=torch.zeros(len(images)),
            seconds=0.0,
        )


def with_map(explained: Explanation, name: str, relevance: np.ndarray, *, raises_only: bool = False) -> Explanation:
    """The explanation with maps of one more method."""
    notes = MethodNotes(seconds_per_frame=0.0, warnings=(), raises_only=raises_only)
    methods, maps = {**explained.methods, name: notes}, {**explained.relevance, name: relevance.astype(np.float32)}
    return replace(explained, methods=methods, relevance=maps)


def test_the_untrained_controls_leave_the_network_as_it_is_and_depend_on_the_seed(material: Material):
    before = {name: value.clone() for name, value in material.trained.model.state_dict().items()}
    small = replace(material, explainers={"integrated-gradients": IntegratedGradients(steps=8, max_steps=8)})
    first, again, other = (Untrained(material=small, seed=seed).make().maps for seed in (1, 1, 2))
    assert set(first) == {"integrated-gradients-new-weights", "weights-1-new-weights"}
    for control, maps in first.items():
        assert maps.shape == (len(material.inputs), *material.inputs.shape[-2:])
        np.testing.assert_array_equal(maps, again[control])
        assert np.abs(maps - other[control]).max() > 0
    assert all(torch.equal(value, before[name]) for name, value in material.trained.model.state_dict().items())


def test_each_trial_has_a_network_of_its_own(material: Material):
    small = replace(material, explainers={"grad-cam": material.explainers["grad-cam"]})
    found = Untrained(material=small, seed=7).make().maps["grad-cam-new-weights"]
    trials = material.explained.clusters[1].tolist()
    for number, trial in enumerate(dict.fromkeys(trials)):
        # no two trials of this study or the next have the same
        ((_, network),) = cascade(material.trained.model, seed=7000 + number, stages=1, images=material.inputs)
        for frame in [place for place, own in enumerate(trials) if own == trial]:
            image, empty = material.inputs[frame, None], material.references[frame, None]
            explanation = material.explainers["grad-cam"](network, image, reference=empty)
            np.testing.assert_allclose(found[frame], explanation.influence[0].numpy(), atol=1e-7)


def test_a_map_of_what_raises_the_answer_ranks_by_its_order_and_is_held_against_the_truth_by_its_sign(
    material: Material, fine_dataset: Dataset
):
    explained, name = material.explained, "grad-cam-thesis"
    relevance = np.abs(explained.relevance["grad-cam"])  # above zero, as the published map is
    first, *others = explained.frames
    fell = replace(first, prediction=first.reference_prediction - 0.3)
    rose = [replace(one, prediction=one.reference_prediction + 0.3) for one in others]
    explained = with_map(replace(explained, frames=(fell, *rose)), name, relevance, raises_only=True)
    records = Records(
        folder=Path("nowhere"),
        data=fine_dataset,
        networks={"difference": material.trained},
        config=StudyConfig(),
        network="difference",
    )
    own = replace(material, explained=explained, explainers={**material.explainers, name: get_explainer(name)})
    control = {f"{name}{NEW_WEIGHTS}": relevance}
    vars(records).update(material=own, influence={**influences(own.trained, own.explained), **control})
    # parts are removed in the published order
    np.testing.assert_array_equal(records.influence[name], relevance)
    compared = judge_by_truth(records).maps
    for kind in (name, *control):
        np.testing.assert_array_equal(compared[kind][0], -relevance[0])
        np.testing.assert_array_equal(compared[kind][1:], relevance[1:])
    np.testing.assert_array_equal(compared["grad-cam"], records.influence["grad-cam"])


def test_a_method_that_ignores_the_weights_shows_nothing_about_the_network(material: Material):
    image = material.inputs.mean(dim=1).numpy() * material.explained.towards[:, None, None]
    explained = with_map(material.explained, "image", image)
    small = replace(material, explained=explained, explainers={"image": ShowsTheImage()})
    maps = {**influences(small.trained, small.explained), **Untrained(material=small).make().maps}
    np.testing.assert_allclose(maps["image-new-weights"], maps["image"], atol=1e-6)
    grey = (Setting(fill="grey", unit="pixel"),)
    stage = Removal(trained=small.trained, explained=explained, units=small.units(), maps=maps, settings=grey)
    scored = replace(stage, random_orders=1).make()
    (lead,) = [score.lead_over_controls for score in scored.scores if score.method == "image"]
    assert lead is not None
    assert ends_of(lead.gap)[1] <= 0
    assert not lead.gap.above_zero


def test_looks_are_those_of_the_saved_maps(material: Material):
    quality = measure_maps(material)
    maps = material.explained.saliency["grad-cam"].astype(np.float64)
    found = quality.methods["grad-cam"]
    assert found.total_variation == pytest.approx(np.mean([total_variation(one) for one in maps]))
    (compared,) = quality.comparisons
    assert found.total_variation is not None
    other = np.mean([total_variation(one) for one in material.explained.saliency[compared.second].astype(np.float64)])
    assert compared.first == "grad-cam"
    assert compared.gap.estimate == pytest.approx(found.total_variation - other)
