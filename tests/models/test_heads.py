import numpy as np
import pytest
import torch
from scipy import stats
from small import Returning
from there import there

from sliplens.errors import InputError, ModelError
from sliplens.models import build_model
from sliplens.models.backbones import Answers, HistogramRegressor, histogram_targets, margin_loss
from sliplens.models.calibration import Calibration, conformal_offset, fit_temperature, quantiles
from sliplens.models.checkpoint import Estimate


def test_a_label_becomes_the_share_of_a_gaussian_in_each_bin():
    edges = torch.linspace(-0.1, 1.1, 61, dtype=torch.float64)
    labels = torch.tensor([0.0, 0.33, 1.0]).double()
    told = histogram_targets(labels, edges).numpy()
    # the Gaussian of scipy, cut off at the ends of the histogram
    for row, label in zip(told, labels.tolist(), strict=True):
        below = np.asarray(stats.norm.cdf(edges.numpy(), loc=label, scale=0.75 * 0.02))
        np.testing.assert_allclose(row, np.diff(below) / (below[-1] - below[0]), atol=1e-12)
    np.testing.assert_allclose(told.sum(axis=1), 1)


def test_the_mean_of_a_label_is_the_label_at_both_ends_too():
    model = HistogramRegressor(torch.nn.Identity())
    labels = torch.linspace(0, 1, 101)
    mean = histogram_targets(labels, model.edges) @ model.centres
    # what a bin's middle stands for is off by less than a hundredth of its width, and no end pulls the mean inwards
    assert float((mean - labels).abs().max()) < 0.01 * 0.02


def test_the_answer_is_the_mean_of_the_distribution_and_has_a_gradient():
    model = build_model(head="histogram").eval()
    images = torch.rand(2, 3, 32, 32, requires_grad=True)
    answer = model(images)
    assert isinstance(model, HistogramRegressor)
    assert answer.shape == (2, 1)
    _, probabilities = Answers(model)(images)
    torch.testing.assert_close(answer[:, 0], probabilities @ model.centres)
    answer.sum().backward()
    assert float(there(images.grad).abs().max()) > 0


def test_the_loss_of_a_histogram_is_least_for_the_label_itself():
    labels = torch.tensor([0.2, 0.8])
    targets = histogram_targets(labels, HistogramRegressor(torch.nn.Identity()).edges)
    model = HistogramRegressor(Returning(lambda _: targets.log().clamp(min=-50)))
    loss, told = margin_loss(model, torch.zeros(2, 3, 8, 8), labels)
    # cross-entropy of a distribution with itself is its entropy
    entropy = -(targets * targets.clamp(min=1e-30).log()).sum(dim=1).mean()
    torch.testing.assert_close(loss, entropy, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(told, labels, atol=1e-3, rtol=0)


def test_the_temperature_of_logits_that_were_scaled_is_found(rng: np.random.Generator):
    labels = torch.from_numpy(rng.uniform(0, 1, 200)).float()
    targets = histogram_targets(labels, torch.linspace(-0.1, 1.1, 61))
    true = targets.clamp(min=1e-9).log()
    for factor in (0.3, 1.0, 4.0):
        assert fit_temperature(factor * true, targets) == pytest.approx(factor, rel=1e-2)


def test_quantiles_of_an_even_distribution_and_of_a_gaussian():
    edges = np.linspace(0, 1, 11)
    even = np.full((1, 10), 0.1)
    for share in (0.05, 0.5, 0.72, 0.95):
        assert quantiles(even, edges, share)[0] == pytest.approx(share)
    fine = np.linspace(-1, 2, 3001)
    gauss = np.diff(stats.norm.cdf(fine, 0.4, 0.1))[None]
    for share in (0.05, 0.5, 0.95):
        assert quantiles(gauss, fine, share)[0] == pytest.approx(stats.norm.ppf(share, 0.4, 0.1), abs=1e-4)


def test_conformal_intervals_hold_for_their_share_of_new_frames(rng: np.random.Generator):
    def draw(count: int) -> tuple[np.ndarray, np.ndarray]:
        labels = rng.uniform(0, 1, count)
        return labels, labels + 0.1 * rng.standard_t(3, count)

    (labels, told), (new_labels, new_told) = draw(4000), draw(40_000)
    for level in (0.5, 0.9):
        offset = conformal_offset(told, told, labels, level=level)
        held = np.mean(np.abs(new_told - new_labels) <= offset)
        # both samples are finite: four standard deviations of the two shares
        assert held == pytest.approx(level, abs=4 * np.sqrt(level * (1 - level) * (1 / 4000 + 1 / 40_000)))


def test_an_estimate_tells_its_spread_and_its_interval():
    edges = np.linspace(0, 1, 11)
    probabilities = np.zeros((1, 10))
    probabilities[0, [4, 5]] = 0.5
    calibration = Calibration(temperature=1.0, offsets={"0.9": 0.05}, frames=10, mse=0.01)
    estimate = Estimate(margin=np.array([0.5]), probabilities=probabilities, edges=edges, calibration=calibration)
    assert there(estimate.sigma)[0] == pytest.approx(0.05)
    interval = there(estimate.interval(0.9))
    # 5 % of a distribution that is even from 0.4 to 0.6
    np.testing.assert_allclose([interval[0][0], interval[1][0]], [0.41 - 0.05, 0.59 + 0.05])
    with pytest.raises(InputError, match=r"no level named '0\.75'; choose one of 0\.9"):
        estimate.interval(0.75)


def test_an_unknown_backbone_is_refused():
    with pytest.raises(ModelError, match="no backbone named 'shuffle'; choose a TorchVision classifier"):
        build_model("shuffle")
