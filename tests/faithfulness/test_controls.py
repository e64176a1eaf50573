"""Maps that know nothing of the network, measures of how maps look, networks with new weights."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from interval_ends import ends_of
from torch import nn

from sliplens.explainers.attribution import change_of
from sliplens.explainers.poly_cam import PolyCam
from sliplens.faithfulness.controls import (
    cascade,
    centre,
    control_maps,
    edges,
    even_channels,
    infidelity,
    lead_over_controls,
    max_sensitivity,
    relative_change,
    relevance_mass,
    resolution,
    total_variation,
)
from sliplens.intervals import paired_difference
from sliplens.results.faithfulness import is_control

REFERENCE = torch.full((1, 3, 60, 60), 0.25)


def two_layers(*, channels: int) -> nn.Sequential:
    torch.manual_seed(3)
    layers = [
        nn.Conv2d(3, channels, 3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(2),
        nn.Conv2d(channels, channels, 3),
        nn.ReLU(),
    ]
    for layer in layers:
        for weights in layer.parameters():
            nn.init.uniform_(weights, 0, 0.1)
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(channels, 1), nn.Flatten(0)).eval()


def spot() -> torch.Tensor:
    images = REFERENCE.clone()
    images[0, :, 20:32, 25:40] += 0.5 * torch.rand(3, 12, 15, generator=torch.Generator().manual_seed(1))
    return images


def test_every_control_gives_a_finite_map_for_each_image_and_is_known_as_one():
    images = torch.rand(2, 3, 60, 60)
    maps = control_maps(two_layers(channels=2), images, REFERENCE.expand_as(images))
    assert set(maps) == {"change", "local-change", "weights-1", "centre", "edges"}
    for name, values in maps.items():
        assert values.shape == (2, 60, 60)
        assert np.isfinite(values).all()
        assert (values >= 0).all()
        assert is_control(name)
    assert not is_control("poly-cam")
    assert is_control("poly-cam-new-weights")


def test_a_network_without_layers_has_the_other_controls():
    flat = nn.Sequential(nn.Flatten(), nn.Linear(3 * 3600, 1), nn.Flatten(0))
    assert set(control_maps(flat, REFERENCE, REFERENCE)) == {"change", "local-change", "centre", "edges"}


def test_edges_are_the_slope_of_a_plane_wherever_it_has_one():
    rows, columns = torch.arange(9.0)[:, None], torch.arange(11.0)
    images = (0.03 * columns + 0.04 * rows).expand(1, 3, 9, 11)
    inside = edges(images)[0, 1:-1, 1:-1]
    torch.testing.assert_close(inside, torch.full_like(inside, 0.05))  # 3, 4, 5
    assert edges(torch.full((1, 3, 9, 9), 0.7)).max() < 1e-6


def test_a_turned_image_has_turned_edges():
    images = torch.rand(1, 3, 8, 8)
    torch.testing.assert_close(edges(images.rot90(1, (2, 3))), edges(images).rot90(1, (1, 2)))


def test_the_change_is_the_mean_distance_from_the_untouched_sensor():
    images = REFERENCE.clone()
    images[0, :, 30, 30] += torch.tensor([0.3, -0.6, 0.0])
    expected = torch.zeros(1, 60, 60)
    expected[0, 30, 30] = 0.3
    torch.testing.assert_close(change_of(images, REFERENCE), expected)


def test_the_local_change_compares_a_marker_with_its_surroundings():
    # everywhere alike: nothing stands out
    even = relative_change(REFERENCE + 0.5, REFERENCE)
    torch.testing.assert_close(even, torch.full((1, 60, 60), 0.5 / 0.501))
    images = REFERENCE.clone()
    images[0, :, 30, 30] += 0.5
    # a marker is 5 pixels wide of these 60, its surroundings 17
    near, around = 0.5 / 25, 0.5 / 289
    alone = relative_change(images, REFERENCE)[0]
    torch.testing.assert_close(alone[28:33, 28:33], torch.full((5, 5), near / (around + 0.001)))
    assert alone.count_nonzero() == 25
    assert not relative_change(REFERENCE, REFERENCE).any()


def test_even_channels_are_poly_cam_where_there_is_but_one_channel_to_weigh():
    model = two_layers(channels=1)
    found = even_channels(model, spot(), REFERENCE)
    explained = PolyCam()(model, spot(), reference=REFERENCE[0]).influence
    torch.testing.assert_close(found / found.max(), explained / explained.max())


def test_even_channels_do_not_know_what_the_answer_is_made_of():
    model = two_layers(channels=4)
    (head,) = [layer for layer in model if isinstance(layer, nn.Linear)]
    before, by_poly_cam = even_channels(model, spot(), REFERENCE), PolyCam()(model, spot(), reference=REFERENCE[0])
    nn.init.normal_(head.weight)
    torch.testing.assert_close(even_channels(model, spot(), REFERENCE), before)
    assert not torch.allclose(PolyCam()(model, spot(), reference=REFERENCE[0]).influence, by_poly_cam.influence)


def test_the_centre_is_in_the_middle():
    bump = centre(torch.rand(2, 3, 9, 9))[0]
    assert bump.flatten().argmax() == 4 * 9 + 4
    torch.testing.assert_close(bump, bump.flip(0))
    torch.testing.assert_close(bump, bump.T)


TRIALS = np.repeat(np.arange(7), 3)


def lead(own: np.ndarray, controls: dict[str, np.ndarray]):
    return lead_over_controls(own, controls, clusters=[TRIALS], rng=np.random.default_rng(5))


def test_a_method_equal_to_a_control_has_no_lead():
    rng = np.random.default_rng(0)
    own, other = rng.normal(0.5, 0.2, (2, 21))
    for controls in ({"edges": own}, {"edges": own, "change": other}):
        found = lead(own, controls)
        low, high = ends_of(found.gap)
        assert low <= found.gap.estimate <= high <= 0
        assert not found.gap.above_zero


def test_a_lead_is_no_larger_than_that_over_any_control_alone_nor_over_chance():
    rng = np.random.default_rng(1)
    own, *others = rng.normal(0.2, 0.3, (6, 21))
    controls = {f"{number}-new-weights": gains for number, gains in enumerate(others)}
    among_all = lead(own, controls)
    alone = [lead(own, {name: gains}) for name, gains in controls.items()] + [lead(own, {})]
    # of seven trials nothing is drawn: the intervals are Student's
    nearest = min(alone, key=lambda one: one.gap.estimate)
    assert (among_all.control, among_all.gap.estimate) == (nearest.control, nearest.gap.estimate)
    lows, highs = zip(*(ends_of(one.gap) for one in alone), strict=True)
    low, high = ends_of(among_all.gap)
    assert low == min(lows)
    # behind one of six is no rare thing: the upper end is that of as many comparisons
    assert high > min(highs)
    gaps = [paired_difference(own, other, clusters=[TRIALS], rng=rng, comparisons=6) for other in (*others, 0 * own)]
    assert high == min(ends_of(gap)[1] for gap in gaps)
    # to name the strongest first and look at no other would say too much
    wild = np.where(TRIALS == 0, -9.0, 0.4) + own.mean()
    uncertain = lead(own + 0.5, {"edges": own, "wild": wild})
    assert uncertain.control == "edges"
    assert lead(own + 0.5, {"edges": own}).gap.above_zero
    assert not uncertain.gap.above_zero


def test_a_method_as_good_as_every_control_is_seldom_behind_or_ahead_for_sure():
    rng, found = np.random.default_rng(0), []
    for _ in range(100):
        # trials differ, in which all maps are alike, and in which each has its own luck
        common, *luck = rng.normal(0, 0.2, (10, 7))
        own, *others = (common[TRIALS] + alone[TRIALS] + 0.5 for alone in luck)
        found.append(lead(own, {f"{number}-new-weights": gains for number, gains in enumerate(others)}).gap)
    # without a correction 0.11 of them
    assert np.mean([gap.below_zero for gap in found]) <= 0.05
    assert np.mean([gap.above_zero for gap in found]) <= 0.025


def test_a_method_that_is_ahead_of_all_in_every_trial_shows_something_and_one_below_chance_does_not():
    gains = np.linspace(0.1, 0.3, 21)
    ahead = lead(gains + 0.2, {"edges": gains, "centre": gains[::-1]})
    assert ahead.gap.estimate == pytest.approx(0.2)
    assert ahead.gap.above_zero
    below = lead(-gains, {})
    assert below.control == "random"
    assert below.gap.estimate == pytest.approx(-0.2)
    assert not below.gap.above_zero
    # frames of one trial are no trials
    few = lead_over_controls(gains + 0.2, {"edges": gains}, clusters=[TRIALS // 2], rng=np.random.default_rng(5))
    assert few.gap.units == 4
    assert not few.gap.above_zero
    one = lead_over_controls(gains + 0.2, {"edges": gains}, clusters=[0 * TRIALS], rng=np.random.default_rng(5))
    assert (one.gap.low, one.gap.high) == (None, None)
    assert not one.gap.above_zero


def test_total_variation_has_its_closed_forms(rng: np.random.Generator):
    assert total_variation(np.ones((5, 5))) == 0
    ramp = np.tile(np.arange(11.0), (11, 1))
    assert total_variation(ramp) == pytest.approx((0.1 + 0) / 2)  # a tenth of the range across, nothing down
    # two independent even numbers differ by 1/3 on average, with a standard deviation of 1/sqrt(18); neighbours share
    # numbers, so four standard errors are doubled
    noise = total_variation(rng.uniform(size=(100, 100)))
    assert noise == pytest.approx(1 / 3, abs=8 / np.sqrt(18 * 2 * 9900) + 0.001)
    assert total_variation(7 * ramp - 3) == pytest.approx(total_variation(ramp))


@pytest.mark.parametrize("spread", [2.0, 5.0, 40.0])
def test_blobs_are_told_apart_as_far_as_they_are_narrow(spread: float):
    rows, columns = np.indices((60, 80))
    markers = np.array([[30.0, 30.0], [46.0, 30.0]])
    square = [(columns - x) ** 2 + (rows - y) ** 2 for x, y in markers]
    saliency = np.exp(-np.stack(square) / (2 * spread**2)).sum(axis=0)
    # two Gaussians 16 px apart: in the middle 2 exp(-32 / s^2), at a centre 1 + exp(-128 / s^2)
    expected = 1 - 2 * np.exp(-32 / spread**2) / (1 + np.exp(-128 / spread**2))
    # the highest of a third of the way is the centre itself, or a little beside it for wide blobs
    assert resolution(saliency, markers) == pytest.approx(max(expected, 0), abs=0.02)


def test_resolution_needs_relevance():
    assert np.isnan(resolution(np.zeros((9, 9)), np.array([[1.0, 1.0], [5.0, 5.0]])))
    assert resolution(np.ones((9, 9)), np.array([[1.0, 1.0], [5.0, 5.0]])) == 0


@pytest.mark.parametrize("colours", [3, 6])
def test_infidelity_has_its_closed_forms(colours: int):
    generator = torch.Generator().manual_seed(0)
    images, references = torch.rand(2, 2, colours, 5, 5, generator=generator)
    references[:, 3:] = images[:, 3:]  # the reference beside the frame stays
    weights = torch.rand(colours, 5, 5, generator=generator)
    exact = (weights * (images - references)).sum(dim=1)

    def infidelities(relevance: torch.Tensor) -> np.ndarray:
        return infidelity(
            lambda values: (weights * values).sum(dim=(1, 2, 3)), images, references, relevance, samples=4000
        )

    np.testing.assert_allclose(infidelities(exact), 0, atol=1e-5)  # the map of a linear network is exact
    # each pixel is gone with probability 1/2: mean square of a sum of coins, whose standard error is below 4 %
    expected = (exact.sum(dim=(1, 2)) ** 2 + (exact**2).sum(dim=(1, 2))) / 4
    np.testing.assert_allclose(infidelities(torch.zeros_like(exact)) ** 2, expected, rtol=0.15)


def test_max_sensitivity_has_its_closed_forms():
    images = torch.full((2, 3, 4, 4), 0.5)
    assert not max_sensitivity(lambda values: torch.ones(len(values), 4, 4), images).any()
    largest = max_sensitivity(lambda values: values.mean(dim=1), images, radius=0.02, samples=20)
    assert (largest > 0).all()
    assert (largest <= 0.02 / 0.5).all()


@pytest.fixture
def truth() -> np.ndarray:
    inside = np.zeros((8, 10), dtype=bool)
    inside[2:5, 3:7] = True
    return inside


def test_a_map_of_the_truth_has_all_its_mass_inside(truth: np.ndarray):
    assert relevance_mass(truth.astype(float), truth) == 1
    assert relevance_mass((~truth).astype(float), truth) == 0


@given(st.integers(0, 1000))
def test_a_map_that_knows_nothing_has_the_share_of_the_truth(seed: int):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(size=(30, 30)) < 0.3
    flat = np.ones((30, 30))
    assert relevance_mass(flat, truth) == pytest.approx(truth.mean())


def test_a_map_of_zeros_has_no_mass(truth: np.ndarray):
    assert np.isnan(relevance_mass(np.zeros((8, 10)), truth))


@pytest.fixture
def model() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(3, 4, 3, padding=1), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 4, 3, padding=1), nn.ReLU(),
        nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 1),
    ).eval()  # fmt: skip


def noise() -> torch.Tensor:
    return torch.rand(4, 3, 16, 16, generator=torch.Generator().manual_seed(2))


def test_layers_lose_their_weights_from_the_output_on_and_the_model_keeps_its_own(model: nn.Module):
    before = {name: value.clone() for name, value in model.state_dict().items()}
    steps = cascade(model, seed=1, stages=4, images=noise())
    for (count, new), expected in zip(steps, (["7"], ["7", "3"], ["7", "3", "1"], ["7", "3", "1", "0"]), strict=True):
        assert count == len(expected)
        changed = {name.split(".")[0] for name, value in new.state_dict().items()
                   if not torch.equal(value, before[name])}  # fmt: skip
        assert changed == set(expected)
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])


def test_the_same_seed_draws_the_same_weights_however_many_stages(model: nn.Module):
    ends = [list(cascade(model, seed=3, stages=stages, images=noise()))[-1] for stages in (1, 2, 4)]
    assert {count for count, _ in ends} == {4}
    (_, first), *others = ends
    for _, network in others:
        for name, value in network.state_dict().items():
            # at each stage a pass more is counted
            assert name.endswith("num_batches_tracked") or torch.equal(value, first.state_dict()[name])
    ((_, other),) = cascade(model, seed=4, stages=1, images=noise())
    assert not torch.equal(other.state_dict()["0.weight"], first.state_dict()["0.weight"])


def test_networks_of_neighbouring_seeds_share_no_weights():
    equal = nn.Sequential(*(nn.Linear(4, 4) for _ in range(3)), nn.Flatten(), nn.Linear(48, 1))
    images = torch.rand(2, 3, 4, 4)
    drawn = [
        value
        for seed in range(3)
        for _, network in cascade(equal, seed=seed, stages=1, images=images)
        for name, value in network.state_dict().items()
        if name in {"0.weight", "1.weight", "2.weight"}
    ]
    assert len(drawn) == 9
    assert len({tuple(value.flatten().tolist()) for value in drawn}) == 9


def test_new_normalisation_has_the_statistics_of_the_images_and_the_network_still_tells_them_apart():
    torch.manual_seed(0)
    blocks = [layer for _ in range(12) for layer in (nn.Conv2d(8, 8, 3, padding=1), nn.BatchNorm2d(8), nn.ReLU())]
    deep = nn.Sequential(nn.Conv2d(3, 8, 1), *blocks[1:], nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(8, 1)).eval()
    images = torch.rand(6, 3, 16, 16, generator=torch.Generator().manual_seed(2))
    ((_, alive),) = cascade(deep, seed=0, stages=1, images=images)
    assert isinstance(alive, nn.Sequential)
    dead, norms = copy.deepcopy(alive), [module for module in alive.modules() if isinstance(module, nn.BatchNorm2d)]
    for module in dead.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.reset_running_stats()
    assert not any(module.training for module in alive.modules())
    assert all(module.momentum == 0.1 for module in norms)
    with torch.no_grad():
        assert dead(images).std() < 1e-6
        assert alive(images).std() > 1e-3
        before, normal = alive[:1](images), norms[0]
    # means of 1,536 float32 numbers below 1: a few units of the seventh digit
    torch.testing.assert_close(normal.running_mean, before.mean(dim=(0, 2, 3)), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(normal.running_var, before.var(dim=(0, 2, 3)), atol=1e-6, rtol=1e-4)
