"""Backbones: any TorchVision classifier, with the outputs that its head needs."""

import torchvision
from torch import nn

from sliplens.errors import ModelError
from sliplens.models.heads import HistogramRegressor, head_outputs

DEFAULT_BACKBONE = "shufflenet_v2_x1_0"


def backbone_names() -> list[str]:
    """Names of the classifiers that TorchVision can build."""
    return torchvision.models.list_models(module=torchvision.models)


def build_model(backbone: str = DEFAULT_BACKBONE, *, head: str = "point") -> nn.Module:
    """Build a classifier from scratch, its last layer replaced by one output: the safety margin.

    Parameters
    ----------
    backbone
        Name in TorchVision's table of classifiers.
    head
        `point` for one number, `histogram` for the mean of a distribution (`HistogramRegressor`).

    Returns
    -------
    Module
        Takes (batch, 3, height, width) and returns (batch, 1), untrained, drawn from torch's current random state.

    Raises
    ------
    ModelError
        If TorchVision has no classifier, or sliplens no head, of that name.

    References
    ----------
    Ma et al., *ShuffleNet V2* (2018); Polak, section 4 ("Training details").
    """
    if backbone not in backbone_names():
        raise ModelError(f"there is no backbone named {backbone!r}; choose a TorchVision classifier such as resnet18")
    model = torchvision.models.get_model(backbone, weights=None, num_classes=head_outputs(head))
    return HistogramRegressor(model) if head == "histogram" else model
