"""Poly-CAM with a budget: the choice of channels, the estimate of the others, and its error."""

import math

import pytest
import torch

from sliplens.explainers.attribution import pearson_r, top_overlap
from sliplens.explainers.poly_cam import GaussianProcess, PolyCam
from sliplens.progress import reporting


def kernel_of(places):
    return torch.exp(-torch.cdist(places, places))


@pytest.fixture
def places():
    return torch.rand(40, 2, generator=torch.Generator().manual_seed(7), dtype=torch.float64)


@pytest.fixture
def effects(places):
    return torch.sin(3 * places[:, 0]) - places[:, 1]


def test_the_estimate_is_that_of_the_dense_formula(places, effects):
    kernel = kernel_of(places)
    field = GaussianProcess(kernel)
    for _ in range(2):
        field.learn(effects[field.choose(6, importance=torch.ones(40, dtype=torch.float64))])
    chosen = torch.tensor(field.chosen)
    assert len(set(field.chosen)) == 12
    # eqs. 2.23 and 2.24 with the nugget as noise, inverted outright
    inverse = torch.linalg.inv(kernel[chosen][:, chosen] + 1e-3 * torch.eye(12, dtype=torch.float64))
    residual = effects[chosen] - effects[chosen].mean()
    mean = effects[chosen].mean() + kernel[:, chosen] @ inverse @ residual
    mean[chosen] = effects[chosen]
    scale = residual @ inverse @ residual / 12
    variance = scale * (kernel - kernel[:, chosen] @ inverse @ kernel[chosen]).diagonal()
    variance[chosen] = 0
    estimate, deviation = field.estimate()
    torch.testing.assert_close(estimate, mean)
    torch.testing.assert_close(deviation, variance.clamp_min(0).sqrt(), atol=1e-7, rtol=1e-5)


def test_each_choice_is_where_the_most_is_at_stake(places):
    kernel = kernel_of(places)
    importance = torch.linspace(1, 2, 40, dtype=torch.float64)
    field = GaussianProcess(kernel)
    chosen = field.choose(5, importance=importance).tolist()
    for count in range(5):
        before = torch.tensor(chosen[:count], dtype=torch.long)
        noisy = kernel[before][:, before] + 1e-3 * torch.eye(count, dtype=torch.float64)
        left = (kernel - kernel[:, before] @ torch.linalg.inv(noisy) @ kernel[before]).diagonal()
        stake = importance**2 * left
        stake[before] = -1
        assert chosen[count] == int(stake.argmax())


def test_draws_scatter_as_the_field_says(places, effects):
    field = GaussianProcess(kernel_of(places))
    field.learn(effects[field.choose(10, importance=torch.ones(40, dtype=torch.float64))])
    estimate, deviation = field.estimate()
    draws = field.draws(4000, generator=torch.Generator().manual_seed(1))
    # four standard errors of a mean and of a standard deviation of 4000 normal draws; 1e-6 of jitter on the variance
    assert bool(((draws.mean(dim=0) - estimate).abs() <= 4 * deviation / math.sqrt(4000) + 1e-9).all())
    left = deviation > 0
    assert bool((draws.std(dim=0)[left] / deviation[left] - 1).abs().max() < 4 / math.sqrt(8000) + 0.01)
    assert bool((draws[:, ~left] == estimate[~left]).all())


def test_the_error_that_is_told_is_not_smaller_than_the_error(network, images):
    model = network("small shufflenet")
    exact = PolyCam()(model, images)
    rough = PolyCam(budget=0.4, likeness=None)(model, images)
    for index, told in enumerate(rough.approximations):
        assert told.measured == math.ceil(0.4 * told.channels)
        truth = exact.influence[index], rough.influence[index]
        # the mean of 16 maps that may be, against the one that is: their spread is of the size of their error
        assert pearson_r(*truth) >= told.pearson_r - (1 - told.pearson_r)
        assert top_overlap(*truth) >= told.top_overlap - (1 - told.top_overlap)
        warned = any(f"image {index}: with {told.measured} of" in text for text in rough.warnings)
        assert warned == (told.pearson_r < 0.99 or told.top_overlap < 0.9)


def test_the_thesis_score_has_a_budget_too(network, images):
    model = network("small shufflenet")
    exact = PolyCam(published=True)(model, images)
    near = PolyCam(published=True, budget=0.5, likeness=(0.95, 0.9))(model, images)
    for index in range(len(images)):
        assert pearson_r(exact.influence[index], near.influence[index]) >= 0.95


def test_more_is_measured_where_the_map_is_not_expected_to_be_alike(network, images):
    model, asked = network("small shufflenet"), (0.9, 0.6)
    exact = PolyCam()(model, images)
    once = PolyCam(budget=0.4, likeness=None)(model, images)
    further = PolyCam(budget=0.4, likeness=asked)(model, images)
    more = []
    for index, (first, last) in enumerate(zip(once.approximations, further.approximations, strict=True)):
        # half of what may be missing: the draws do not know all that can go wrong
        enough = [1 - one.pearson_r <= 0.05 and 1 - one.top_overlap <= 0.2 for one in (first, last)]
        assert enough[1]
        assert (last.measured > first.measured) == (not enough[0])
        assert pearson_r(exact.influence[index], further.influence[index]) >= 0.9
        assert top_overlap(exact.influence[index], further.influence[index]) >= 0.6
        more.append(not enough[0])
        if enough[0]:
            torch.testing.assert_close(further.relevance[index], once.relevance[index])
    assert set(more) == {True, False}  # both cases are here


def test_all_channels_are_measured_where_nothing_less_is_asked(network, images):
    model, seen = network("small shufflenet"), []
    explain = PolyCam(budget=0.25, likeness=(1.0, 0.9))
    with reporting(lambda *step: seen.append(step)):
        explanation = explain(model, images[:1])
    (told,) = explanation.approximations
    assert told.measured == told.channels
    assert (told.pearson_r, told.top_overlap) == (pytest.approx(1, abs=1e-9), 1)
    exact = PolyCam()(model, images[:1])
    assert exact.approximations == ()
    torch.testing.assert_close(explanation.relevance, exact.relevance)
    done, totals = zip(*seen, strict=True)
    assert list(done) == sorted(done)
    assert set(totals) == {done[-1]} == {72}
