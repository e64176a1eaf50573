import pytest
import torch
from torch import nn

from sliplens.errors import ImageError
from sliplens.explainers.gradients import ExpectedGradients, IntegratedGradients, SmoothGrad


class Square(nn.Module):
    """Sum of weight x pixel squared: its gradient is linear, so that of the mean is the mean of the gradients."""

    def __init__(self) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.linspace(-1, 1, 3 * 64, dtype=torch.float64).reshape(3, 8, 8) / 64)

    def forward(self, images):
        return (self.weights * images**2).sum(dim=(1, 2, 3))


@pytest.fixture
def small(images):
    return images[..., ::8, ::8].contiguous()


def test_smooth_grad_is_the_mean_gradient_times_what_the_image_adds(small):
    model = Square()
    explanation = SmoothGrad(samples=4000, noise=0.1)(model, small[:1], reference=small[1])
    added = small[0] - small[1]
    expected = (2 * model.weights * small[0] * added).sum(dim=0).detach()
    # standard error of the mean of 4000 gradients 2 w (x + noise), four times
    error = 2 * 0.1 / 4000**0.5 * ((model.weights * added) ** 2).sum(dim=0).sqrt().detach()
    assert bool(((explanation.relevance[0] - expected).abs() <= 4 * error + 1e-7).all())


def test_smooth_grad_leaves_the_random_state_alone(network, small):
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    one = SmoothGrad(samples=3)(network("gap"), small)
    assert torch.equal(torch.rand(3), expected)
    assert torch.equal(SmoothGrad(samples=3)(network("gap"), small).relevance, one.relevance)


def test_expected_gradients_are_the_mean_of_integrated_gradients(small):
    model = Square()
    explanation = ExpectedGradients(background=small[1:])(model, small[:1])
    # for w x^2 integrated gradients are w (x^2 - b^2), whose mean needs no background but the mean of b^2
    expected = (model.weights * (small[0] ** 2 - (small[1:] ** 2).mean(dim=0))).sum(dim=0).detach().float()
    torch.testing.assert_close(explanation.relevance[0], expected, atol=1e-6, rtol=1e-5)
    with torch.no_grad():
        torch.testing.assert_close(explanation.reference_prediction, model(small[1:]).mean()[None].float())
    assert explanation.target == "f(x) - mean of f over the background"
    assert not any("background" in text for text in explanation.warnings)


def test_expected_gradients_without_a_background_are_integrated_gradients(network, small):
    model, integrated = network("gap"), IntegratedGradients(steps=8, max_steps=8)
    alone = ExpectedGradients(steps=8, max_steps=8)(model, small[:2], reference=small[2])
    torch.testing.assert_close(alone.relevance, integrated(model, small[:2], reference=small[2]).relevance)
    assert "no background was given, so the reference alone stands for it" in alone.warnings[-1]


def test_expected_gradients_check_the_background(network, small):
    with pytest.raises(ImageError, match=r"image 0 has values from .*, outside \[0, 1\]"):
        ExpectedGradients(background=small + 5)(network("gap"), small)
