"""What a layer's activations and their gradients make of its cells, for the family of class activation maps."""

import torch
from jaxtyping import Float
from torch import Tensor


def grad_cam_map(
    activations: Float[Tensor, "batch channels rows columns"],
    gradients: Float[Tensor, "batch channels rows columns"],
) -> Float[Tensor, "batch rows columns"]:
    """Grad-CAM before any ReLU: sum over c of alpha_c A_c, alpha_c the mean over space of df/dA_c.

    In margin units for each cell: for a head f = bias + w . mean over space of A, alpha_c = w_c / (rows x columns), so
    the cells add up to f - bias without any further normalisation.

    Parameters
    ----------
    activations
        A, the output of a layer.
    gradients
        df/dA in margin units over the activation's.

    References
    ----------
    Selvaraju et al., *Grad-CAM: Visual explanations from deep networks via gradient-based localization*, ICCV 2017,
    eqs. 1 and 2, without the ReLU of eq. 2: a regressor's negative evidence is evidence.
    """
    return (gradients.mean(dim=(2, 3), keepdim=True) * activations).sum(dim=1)


def hires_cam_map(
    activations: Float[Tensor, "batch channels rows columns"],
    gradients: Float[Tensor, "batch channels rows columns"],
) -> Float[Tensor, "batch rows columns"]:
    """HiResCAM: sum over c of df/dA_c A_c, cell by cell, in margin units; Grad-CAM where the gradient is constant.

    Parameters
    ----------
    activations, gradients
        A, the output of a layer, and df/dA.

    References
    ----------
    Draelos and Carin, *Use HiResCAM instead of Grad-CAM for faithful explanations of convolutional neural networks*,
    2020, eq. 3.
    """
    return (gradients * activations).sum(dim=1)


def layer_cam_map(
    activations: Float[Tensor, "batch channels rows columns"],
    gradients: Float[Tensor, "batch channels rows columns"],
) -> Float[Tensor, "batch rows columns"]:
    """LayerCAM before its last ReLU: sum over c of relu(df/dA_c) A_c, cell by cell, in margin units.

    Parameters
    ----------
    activations, gradients
        A, the output of a layer, and df/dA.

    References
    ----------
    Jiang et al., *LayerCAM: Exploring hierarchical class activation maps for localization*, IEEE TIP 2021, eqs. 4 to 6,
    without the ReLU of eq. 6.
    """
    return (torch.relu(gradients) * activations).sum(dim=1)
