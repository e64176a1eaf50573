"""Removal curves, controls of new weights and looks of the maps of a small study."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from interval_ends import ends_of
from torch import Tensor, nn

from sliplens.codec import load_result, save_result
from sliplens.explainers.attribution import Attribution
from sliplens.explainers.contract import Explainer
from sliplens.explainers.explain import network_inputs, network_references
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.faithfulness.controls import cascade, total_variation
from sliplens.faithfulness.scoring import influences
from sliplens.models import Network
from sliplens.progress import reporting
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explanation, MethodNotes
from sliplens.results.faithfulness import NEW_WEIGHTS, Faithfulness
from sliplens.results.study import MarkerTable, Setting, StudyConfig
from sliplens.study.choice import removal_units
from sliplens.study.run import Records, judge_by_truth
from sliplens.study.scoring import STUDY_AREAS, Removal, Untrained, measure_maps

GREY_PIXELS = Setting(fill="grey", unit="pixel")
MARKERS = Setting(fill="reference", unit="marker")


@pytest.fixture(scope="module")
def removal(network: Network, explained: Explanation, markers: dict[str, MarkerTable]) -> Removal:
    return Removal(
        trained=network,
        explained=explained,
        maps=influences(network, explained),
        units=removal_units(network, explained, markers),
        settings=(GREY_PIXELS, MARKERS),
        random_orders=2,
    )


@pytest.fixture(scope="module")
def scored(removal: Removal) -> Faithfulness:
    return removal.make()


def test_removing_by_hand_gives_the_same_change(network: Network, explained: Explanation, scored: Faithfulness):
    frame, area = explained.frames[0], 0.2
    relevance = explained.relevance["grad-cam"][0]
    towards = np.sign(frame.prediction - frame.reference_prediction)
    side = relevance.shape[-1]
    order = np.lexsort((np.arange(side * side), -(relevance * towards).ravel()))
    gone = np.zeros(side * side, dtype=bool)
    gone[order[: round(area * side * side)]] = True
    image = network_inputs(network, explained)[0].clone()
    image[:, torch.from_numpy(gone.reshape(side, side))] = 0.5
    # what spoke for the target and is gone
    expected = towards * (frame.prediction - float(network.predict(image[None])[0]))
    curve = scored.curves["grey", "pixel", "grad-cam"]
    found = curve.most_first[curve.frame_ids.index(frame.id), STUDY_AREAS.index(area)]
    assert found == pytest.approx(expected, abs=1e-5)


def test_every_method_and_control_is_scored_under_every_setting(explained: Explanation, scored: Faithfulness):
    names = {*explained.methods, "edges", "change", "local-change", "weights-1", "centre"}
    keys = {(setting.fill, setting.unit, name) for setting in (GREY_PIXELS, MARKERS) for name in names}
    assert {score.key for score in scored.scores} == set(scored.curves) == keys
    assert {score.method for score in scored.scores if not score.control} == set(explained.methods)
    assert (scored.frames, scored.trials, scored.random_orders) == (6, 2, 2)


def test_scores_are_the_areas_under_the_stored_curves(scored: Faithfulness, tmp_path: Path):
    save_result(scored, tmp_path)
    back = load_result(tmp_path, Faithfulness, command="sliplens study")
    assert back.scores == scored.scores
    for score in back.scores:
        curve = back.curves[score.key]
        gain = np.trapezoid(curve.most_first - curve.least_first, np.array(STUDY_AREAS), axis=-1)
        assert score.srg.estimate == pytest.approx(gain.mean())


def test_markers_that_are_not_known_everywhere_are_no_unit(network: Network, explained: Explanation, removal: Removal):
    assert set(removal.units) == {"pixel", "tile", "marker"}
    assert set(removal_units(network, explained, {})) == {"pixel", "tile"}


def test_an_interrupted_run_goes_on_after_the_last_trial(removal: Removal, tmp_path: Path, scored: Faithfulness):
    calls = []

    def interrupt(done: int, total: int) -> None:
        calls.append((done, total))
        if done > 3:  # of three frames each trial has
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), reporting(interrupt):
        removal.make(tmp_path)
    assert len(list(tmp_path.glob("trial=*/*/result.json"))) == 1
    before = len(calls)
    with reporting(lambda done, total: calls.append((done, total))):
        again = removal.make(tmp_path)
    assert all(done >= 3 for done, _ in calls[before:])
    assert calls[-1] == (12, 12)
    assert again.scores == scored.scores


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
