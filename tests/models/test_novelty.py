"""Novelty: the distance of Mahalanobis, in features of an early layer."""

import numpy as np
import torch

from sliplens.models import build_model
from sliplens.models.novelty import find_layer, fit_novelty, read_features


def test_the_layer_answers_with_an_eighth_of_the_side_whatever_the_backbone():
    for backbone in ("shufflenet_v2_x0_5", "resnet18", "mobilenet_v3_small"):
        model, images = build_model(backbone).eval(), torch.zeros(1, 3, 64, 64)
        layer = find_layer(model, images)
        assert layer is not None
        shapes = []
        handle = model.get_submodule(layer).register_forward_hook(lambda _, __, out, shapes=shapes: shapes.append(out))
        model(images)
        handle.remove()
        assert shapes[0].shape[-2:] == (8, 8)
        # the same numbers as a whole pass gives
        np.testing.assert_allclose(read_features(model, layer, images), shapes[0].mean(dim=(2, 3)).detach(), rtol=1e-5)


def test_with_all_directions_the_distance_is_that_of_mahalanobis(rng: np.random.Generator):
    model = torch.nn.Sequential(torch.nn.Conv2d(3, 3, 1, bias=False), torch.nn.AvgPool2d(8))
    images = torch.from_numpy(rng.normal(size=(300, 3, 16, 16)) + rng.normal(size=(300, 3, 1, 1))).float()
    novelty = fit_novelty(model, [images[:200]], [images[200:]])
    assert novelty is not None
    features = read_features(model, novelty.layer, images)
    centred = features - features[:200].mean(axis=0)
    inverse = np.linalg.inv(np.cov(features[:200].T, bias=True))
    expected = np.sqrt(np.einsum("ni,ij,nj->n", centred, inverse, centred) / 3)
    # two directions of three are kept, and the rest is the third; numbers are kept to five digits
    np.testing.assert_allclose(novelty.distance(features), expected, rtol=1e-3, atol=1e-3)
    assert np.mean(novelty.distance(features[200:]) > novelty.limit) <= 0.01


def test_too_few_frames_tell_nothing():
    assert fit_novelty(build_model("shufflenet_v2_x0_5").eval(), [torch.zeros(8, 3, 32, 32)], []) is None
