from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from interval_ends import ends_of
from torch import Tensor, nn

from sliplens.explainers.attribution import Attribution
from sliplens.explainers.contract import Explainer
from sliplens.explainers.explain import network_inputs, network_references
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.faithfulness.controls import cascade, total_variation
from sliplens.faithfulness.scoring import influences
from sliplens.models import Network
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation, MethodNotes
from sliplens.results.faithfulness import NEW_WEIGHTS
from sliplens.results.study import MarkerTable, Setting, StudyConfig
from sliplens.study.choice import removal_units
from sliplens.study.run import Records, judge_by_truth
from sliplens.study.scoring import Removal, Untrained, measure_maps


class ShowsTheImage:
    """An explainer that never asks the network."""

    def __call__(self, _model: nn.Module, images: Tensor, **_options: object) -> Attribution:
        zero, facts = torch.zeros(len(images)), {"method": "image", "target": "nothing", "seconds": 0.0}
        return Attribution(
            relevance=images.mean(dim=1), prediction=zero + 1, reference_prediction=zero, **cast("Any", facts)
        )


def with_map(explained: Explanation, name: str, relevance: np.ndarray, *, raises_only: bool = False) -> Explanation:
    """The explanation with maps of one more method."""
    notes = MethodNotes(seconds_per_frame=0.0, warnings=(), raises_only=raises_only)
    methods, maps = {**explained.methods, name: notes}, {**explained.relevance, name: relevance.astype(np.float32)}
    return replace(explained, methods=methods, relevance=maps)


def test_the_untrained_controls_leave_the_network_as_it_is_and_depend_on_the_seed(
    network: Network, explained: Explanation
):
    before = {name: value.clone() for name, value in network.model.state_dict().items()}
    quick = {"integrated-gradients": IntegratedGradients(steps=8, max_steps=8)}
    stage = Untrained(trained=network, explained=explained, explainers=quick)
    first, again, other = (replace(stage, seed=seed).make().maps for seed in (1, 1, 2))
    assert set(first) == {"integrated-gradients-new-weights", "weights-1-new-weights"}
    for control, maps in first.items():
        assert maps.shape == explained.relevance["grad-cam"].shape
        np.testing.assert_array_equal(maps, again[control])
        assert np.abs(maps - other[control]).max() > 0
    assert all(torch.equal(value, before[name]) for name, value in network.model.state_dict().items())


def test_each_trial_has_a_network_of_its_own(
    network: Network, explained: Explanation, explainers: dict[str, Explainer]
):
    grad_cam = explainers["grad-cam"]
    stage = Untrained(trained=network, explained=explained, explainers={"grad-cam": grad_cam}, seed=7)
    found, trials = stage.make().maps["grad-cam-new-weights"], explained.clusters[1].tolist()
    inputs, references = network_inputs(network, explained), network_references(network, explained)
    for number, trial in enumerate(dict.fromkeys(trials)):
        # no two trials of this study or the next have the same
        ((_, changed),) = cascade(network.model, seed=7000 + number, stages=1, images=inputs)
        for frame in [place for place, own in enumerate(trials) if own == trial]:
            explanation = grad_cam(changed, inputs[frame, None], reference=references[frame, None])
            np.testing.assert_allclose(found[frame], explanation.influence[0].numpy(), atol=1e-7)


def test_a_map_of_what_raises_the_answer_ranks_by_its_order_and_is_held_against_the_truth_by_its_sign(
    network: Network, explained: Explanation, fine_dataset: Dataset
):
    name, relevance = "grad-cam-thesis", np.abs(explained.relevance["grad-cam"])  # above zero, as the published map is
    first, *others = explained.frames
    fell = replace(first, prediction=first.reference_prediction - 0.3)
    rose = [replace(one, prediction=one.reference_prediction + 0.3) for one in others]
    explained = with_map(replace(explained, frames=(fell, *rose)), name, relevance, raises_only=True)
    networks, config = {"difference": network}, StudyConfig()
    records = Records(folder=Path("nowhere"), data=fine_dataset, networks=networks, config=config, network="difference")
    control = {f"{name}{NEW_WEIGHTS}": relevance}
    vars(records).update(explained=explained, influence={**influences(network, explained), **control})
    # parts are removed in the published order
    np.testing.assert_array_equal(records.influence[name], relevance)
    compared = judge_by_truth(records).maps
    for kind in (name, *control):
        np.testing.assert_array_equal(compared[kind][0], -relevance[0])
        np.testing.assert_array_equal(compared[kind][1:], relevance[1:])
    np.testing.assert_array_equal(compared["grad-cam"], records.influence["grad-cam"])


def test_a_method_that_ignores_the_weights_shows_nothing_about_the_network(network: Network, explained: Explanation):
    image = network_inputs(network, explained).mean(dim=1).numpy() * explained.towards[:, None, None]
    explained, grey = with_map(explained, "image", image), (Setting(fill="grey", unit="pixel"),)
    new = Untrained(trained=network, explained=explained, explainers={"image": ShowsTheImage()}).make().maps
    maps, units = {**influences(network, explained), **new}, removal_units(network, explained, {})
    np.testing.assert_allclose(maps["image-new-weights"], maps["image"], atol=1e-6)
    stage = Removal(trained=network, explained=explained, units=units, maps=maps, settings=grey, random_orders=1)
    (lead,) = [score.lead_over_controls for score in stage.make().scores if score.method == "image"]
    assert lead is not None
    assert ends_of(lead.gap)[1] <= 0
    assert not lead.gap.above_zero


def test_looks_are_those_of_the_saved_maps(
    network: Network, explained: Explanation, explainers: dict[str, Explainer], markers: dict[str, MarkerTable]
):
    quality = measure_maps(network, explained, explainers, markers)
    variation = {
        name: np.mean([total_variation(one) for one in maps.astype(np.float64)])
        for name, maps in explained.saliency.items()
    }
    assert quality.methods["grad-cam"].total_variation == pytest.approx(variation["grad-cam"])
    (compared,) = quality.comparisons
    assert compared.first == "grad-cam"
    assert compared.gap.estimate == pytest.approx(variation["grad-cam"] - variation[compared.second])
