"""Backbones: any TorchVision classifier, with one output."""

import torchvision
from torch import nn

from sliplens.errors import ModelError

DEFAULT_BACKBONE = "shufflenet_v2_x1_0"


def backbone_names() -> list[str]:
    """Names of the classifiers that TorchVision can build."""
    return torchvision.models.list_models(module=torchvision.models)


def build_model(backbone: str = DEFAULT_BACKBONE) -> nn.Module:
    """Build a classifier from scratch, its last layer replaced by one output: the safety margin.

    Parameters
    ----------
    backbone
        Name in TorchVision's table of classifiers.

    Returns
    -------
    Module
        Takes (batch, 3, height, width) and returns (batch, 1), untrained, drawn from torch's current random state.

    Raises
    ------
    ModelError
        If TorchVision has no classifier of that name.

    References
    ----------
    Ma et al., *ShuffleNet V2* (2018); Polak, section 4 ("Training details").
    """
    if backbone not in backbone_names():
        raise ModelError(f"there is no backbone named {backbone!r}; choose a TorchVision classifier such as resnet18")
    return torchvision.models.get_model(backbone, weights=None, num_classes=1)
