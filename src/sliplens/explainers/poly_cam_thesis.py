"""What the public Poly-CAM code did in the thesis, so that its figures can be compared."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.errors import ModelError
from sliplens.explainers.activations import Layer, map_calls

PERCENT = 100
"""The thesis's network answers in percent, ours in margin units."""


def thesis_support(
    image: Float[Tensor, ""],
    *,
    kept: Float[Tensor, " channels"] | None,
    removed: Float[Tensor, " channels"] | None,
) -> Float[Tensor, " channels"]:
    """What the public code makes the weights of, for a network with one output; a weight is this or 0.

    The score is a sigmoid s of the percentage. PCAM+: s(kept); PCAM-: s(image) - s(removed); PCAM+/-:
    s(kept) + s(image) - s(removed). In float32 s is 1 from 17 % on, so that there the weights of PCAM+/- are all
    1 and those of PCAM- all 0.

    Parameters
    ----------
    image
        f(x) in margin units.
    kept, removed
        f(x M) and f(x (1 - M)) for the mask M of each channel; None for what the variant does not use.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM*, ICPR 2022, eqs. 8 to 10, and its public code for the sigmoid of
    a single output.
    """
    parts = []
    if kept is not None:
        parts.append(_score(kept))
    if removed is not None:
        parts.append(_score(image) - _score(removed))
    return torch.stack(parts).sum(dim=0)


def _score(margins: Tensor) -> Tensor:
    return torch.sigmoid(PERCENT * margins)


def find_published_layers(model: nn.Module, images: Float[Tensor, "batch 3 height width"]) -> tuple[Layer, ...]:
    """Layers as the public code finds them: every module that ends just before the size of the output changes.

    Modules are listed as they end, insides before their block. For TorchVision's ShuffleNetV2 at 224 px these are ten:
    conv1, maxpool, stage2.0.branch1, stage2.0.branch2.2, stage2, stage3.0.branch1, stage3.0.branch2.2, stage3,
    stage4.0.branch1 and stage4.0.branch2.2. The size goes down and up again inside a block with two branches, and
    the last layer is missed, since what follows it is no map.

    Parameters
    ----------
    model
        Network; it is held still for the pass.
    images
        Images to run it on; one is enough.

    Raises
    ------
    ModelError
        If there is no such layer.

    References
    ----------
    Public code of Poly-CAM, `find_layer_list`.
    """
    ended = map_calls(model, images)
    found: dict[str, Layer] = {}
    for (name, shape), (_, following) in pairwise(ended):
        if shape is None and following is None:
            continue
        if shape is None or following is None:
            break  # the public code stops at what flattens
        if following[1:] != shape[1:]:
            found[name] = Layer(name=name, channels=shape[0], height=shape[1], width=shape[2])
            if following[1:] == (1, 1):
                break
    if not found:
        raise ModelError(
            f"{type(model).__name__} has no layer where the size of the map changes, which score='thesis' looks for; "
            "name layers"
        )
    return tuple(found.values())
