import pytest
import torch

from sliplens.errors import ModelError
from sliplens.models import build_model


@pytest.mark.parametrize("backbone", ["shufflenet_v2_x1_0", "resnet18", "mobilenet_v3_small"])
def test_every_backbone_has_one_output(backbone: str):
    model = build_model(backbone).eval()
    assert model(torch.zeros(2, 3, 64, 64)).shape == (2, 1)


def test_an_unknown_backbone_is_refused():
    with pytest.raises(ModelError, match="no backbone named 'shuffle'; choose a TorchVision classifier"):
        build_model("shuffle")
