"""Batch normalisation folded into the convolutions before it: the same function in fewer passes over the memory."""

from copy import deepcopy

import torch
from torch import nn
from torch.fx.experimental.optimization import fuse
from torch.fx.proxy import TraceError

from sliplens.models.heads import HistogramRegressor


def fold_batch_norm(model: nn.Module) -> nn.Module:
    """A copy of a network in evaluation mode, its batch normalisation folded into the convolutions before it.

    With its statistics fixed, batch normalisation is an affine map of each channel, and so is what scales and shifts
    the kernels of the convolution before it. A network whose graph torch cannot trace comes back as a plain copy.

    Parameters
    ----------
    model
        In evaluation mode.

    References
    ----------
    Jacob et al., *Quantization and Training of Neural Networks for Efficient Integer-Arithmetic-Only Inference*
    (2018), eq. 14.
    """
    copied = deepcopy(model)
    if isinstance(copied, HistogramRegressor):
        copied.backbone = _fold(copied.backbone)
        return copied
    return _fold(copied)


def _fold(model: nn.Module) -> nn.Module:
    try:
        folded = fuse(model)
    except (TraceError, TypeError, NotImplementedError):  # branches on values, or takes a tensor apart
        return model
    # folding makes new kernels; channels last as `load_checkpoint` has them
    return folded.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
