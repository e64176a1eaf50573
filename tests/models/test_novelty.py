"""Novelty: the distance of Mahalanobis, in features of an early layer."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from there import there
from torch import nn

from sliplens.models import build_model
from sliplens.models.backbones import Answers
from sliplens.models.novelty import Novelty, find_layer, fit_novelty


def read_features(model: nn.Module, layer: str, images: torch.Tensor) -> np.ndarray:
    [(*_, features)] = Answers(model, layer).run([images])
    return features.double().numpy()


def test_the_layer_answers_with_an_eighth_of_the_side_whatever_the_backbone():
    for backbone in ("shufflenet_v2_x0_5", "resnet18", "mobilenet_v3_small"):
        model, images = build_model(backbone).eval(), torch.zeros(1, 3, 64, 64)
        layer, shapes = there(find_layer(model, images)), []
        handle = model.get_submodule(layer).register_forward_hook(lambda _, __, out, shapes=shapes: shapes.append(out))
        model(images)
        handle.remove()
        assert shapes[0].shape[-2:] == (8, 8)
        # the same numbers as a whole pass gives
        np.testing.assert_allclose(read_features(model, layer, images), shapes[0].mean(dim=(2, 3)).detach(), rtol=1e-5)


def test_with_all_directions_the_distance_is_that_of_mahalanobis(rng: np.random.Generator):
    torch.manual_seed(0)
    model = torch.nn.Sequential(torch.nn.Conv2d(3, 3, 1, bias=False), torch.nn.AvgPool2d(8))
    images = torch.from_numpy(rng.normal(size=(300, 3, 16, 16)) + rng.normal(size=(300, 3, 1, 1))).float()
    novelty = there(fit_novelty(model, [images[:200]], [images[200:]]))
    features = read_features(model, novelty.layer, images)
    centred = features - features[:200].mean(axis=0)
    inverse = np.linalg.inv(np.cov(features[:200].T, bias=True))
    expected = np.sqrt(np.einsum("ni,ij,nj->n", centred, inverse, centred) / 3)
    # two directions of three are kept, and the rest is the third; numbers are kept to five digits
    np.testing.assert_allclose(novelty.distance(features), expected, rtol=1e-3, atol=1e-3)
    assert np.mean(novelty.distance(features[200:]) > novelty.limit) <= 0.01


@pytest.fixture(scope="module")
def sure() -> tuple[nn.Module, Novelty]:
    """A network with a distribution as its answer, and what frames of noise are to it."""
    images = torch.from_numpy(np.random.default_rng(0).uniform(0, 1, (160, 3, 32, 32))).float()
    torch.manual_seed(0)
    model = build_model("shufflenet_v2_x0_5", head="histogram").eval()
    novelty = there(fit_novelty(model, images[:80].split(20), images[80:].split(20)))
    return model, novelty


def test_frames_like_those_of_the_validation_are_known_evenly_and_others_less_the_farther(
    sure: tuple[nn.Module, Novelty],
):
    model, novelty = sure
    # an untrained network spreads all answers alike: what is usual of its features alone
    held = torch.from_numpy(np.random.default_rng(2).uniform(0, 1, (80, 3, 32, 32))).float()
    own = novelty.measure_strangeness(read_features(model, novelty.layer, held), None)
    levels = np.quantile(own, [0, 0.2, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995])
    novelty = replace(novelty, strangeness=tuple(levels.tolist()))
    again = torch.from_numpy(np.random.default_rng(1).uniform(0, 1, (200, 3, 32, 32))).float()
    known = novelty.known(read_features(model, novelty.layer, again), None)
    # of 80 and of 200 frames each share is known to some hundredths
    for share in (0.2, 0.5, 0.8):
        assert np.mean(known < share) == pytest.approx(share, abs=0.15)
    darker = [
        float(novelty.known(read_features(model, novelty.layer, again[:1] * part), None)[0]) for part in (1.0, 0.5, 0.2)
    ]
    assert darker[0] > darker[1] > darker[2]


def test_an_answer_that_is_spread_wide_makes_a_frame_strange_by_itself(sure: tuple[nn.Module, Novelty]):
    model, novelty = sure
    features = read_features(model, novelty.layer, torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(1)))
    narrow, wide = (novelty.known(features, np.array([ratio * there(novelty.spread_limit)]))[0] for ratio in (0.1, 3.0))
    assert wide < 0.005 < narrow


class Watched(nn.Module):
    """A network that another thread passes an image through while this one does."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, 4, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        other = threading.Thread(target=self.first, args=(images + 1,))
        other.start()
        other.join()
        return self.first(images).mean(dim=(1, 2, 3))[:, None]


def test_passes_of_another_thread_are_not_watched():
    model, images = Watched(), torch.ones(1, 3, 8, 8)
    [(_, features)] = Answers(model, "first").run([images])
    torch.testing.assert_close(features, model.first(images).mean(dim=(2, 3)).detach())
