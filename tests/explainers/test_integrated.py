import torch
from quick import Count, Linear
from small import Returning
from there import there

from sliplens.explainers.gradients import IntegratedGradients


def test_is_exact_on_a_linear_model(images, reference):
    generator = torch.Generator().manual_seed(4)
    weights = torch.randn(3, 64, 64, generator=generator, dtype=torch.float64) / 64**2
    explanation = IntegratedGradients()(Linear(weights), images, reference=reference)
    expected = (weights * (images - reference)).sum(dim=1).float()
    torch.testing.assert_close(explanation.relevance, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(explanation.relevance, expected, atol=0, rtol=1e-5)


def test_steps_grow_until_the_sum_is_complete(network, images, reference):
    model = network("gap")
    fixed = IntegratedGradients(steps=2, max_steps=2)(model, images, reference=reference)
    adaptive = IntegratedGradients(steps=2)(model, images, reference=reference)
    assert bool((there(fixed.completeness_gap) > 0.01 * fixed.change.abs()).any())
    assert bool((there(adaptive.completeness_gap) <= 0.01 * adaptive.change.abs()).all())
    assert any("unexplained, more than 1%" in sentence for sentence in fixed.warnings)
    assert not any("unexplained" in sentence for sentence in adaptive.warnings)


def test_the_steps_go_where_the_network_changes():
    # rises from 0 to 1 within a twentieth of the way
    steep = Returning(lambda images: torch.sigmoid(400 * (images.mean(dim=(1, 2, 3)) - 0.21)))
    images = torch.ones(1, 3, 4, 4, dtype=torch.float64)
    spread = IntegratedGradients(steps=64, max_steps=64)(steep, images)
    counted = Count(steep)
    refined = IntegratedGradients(steps=16)(counted, images)
    assert float(there(spread.completeness_gap)) > 0.01
    assert float(there(refined.completeness_gap)) <= 0.01
    assert sum(counted.batches) < 2 * 64
    # a function of the mean alone: each pixel has the same share, within the tolerance
    torch.testing.assert_close(refined.relevance, torch.full((1, 4, 4), 1 / 16), atol=0, rtol=0.01)


def test_stops_at_the_most_steps_and_says_so():
    # a step that no gradient sees
    jump = Returning(lambda images: (images.mean(dim=(1, 2, 3)) > 0.5).double() + 0 * images.sum(dim=(1, 2, 3)))
    counted = Count(jump)
    explanation = IntegratedGradients(steps=4, max_steps=13)(counted, torch.ones(1, 3, 4, 4, dtype=torch.float64))
    assert there(explanation.completeness_gap).tolist() == [1]
    assert any("leaves 1 of f(x) - f(reference) = 1 unexplained" in sentence for sentence in explanation.warnings)
    # the predictions and one piece of four; then its halves, and the predictions at its start and middle
    assert sum(counted.batches) == 2 + 4 + 2 * 4 + 2


def test_one_pass_is_bounded(network, images):
    counted = Count(network("gap"))
    IntegratedGradients(steps=64, max_steps=128)(counted, images)
    assert max(counted.batches) <= 32
