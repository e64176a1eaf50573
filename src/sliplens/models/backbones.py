"""Backbones: any TorchVision classifier, with the outputs that its head needs."""

import math
from collections.abc import Callable

import numpy as np
import torch
import torchvision
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from sliplens.errors import ModelError
from sliplens.extras import Table

BINS = 60
LOWEST, HIGHEST = -0.1, 1.1
"""Ends of the histogram, in margin units: a label's width beyond [0, 1], so that its mean is not pulled inwards."""
_WIDTH_RATIO = 0.75
"""Standard deviation of a label over the width of a bin, as Farebrother et al. recommend."""


class HistogramRegressor(nn.Module):
    """A network whose answer is a histogram over the safety margin; it returns the mean (HL-Gauss).

    `backbone`: takes (batch, 3, height, width) and returns (batch, `bins`) logits; `bins`, `lowest`, `highest`: bins of
    one width, and the margins between which they lie.

    Imani & White, *Improving Regression Performance with Distributional Losses* (2018); Farebrother et al., *Stop
    Regressing* (2024), whose width of a label is taken.
    """

    edges: Tensor
    temperature: Tensor

    def __init__(
        self, backbone: nn.Module, *, bins: int = BINS, lowest: float = LOWEST, highest: float = HIGHEST
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.register_buffer("edges", torch.linspace(lowest, highest, bins + 1))
        self.register_buffer("temperature", torch.tensor(1.0))

    @property
    def centres(self) -> Float[Tensor, " bins"]:
        """Margins in the middle of the bins."""
        return (self.edges[1:] + self.edges[:-1]) / 2

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch 1"]:
        """Mean of the distribution: the safety margin."""
        return (self.probabilities(images) @ self.centres)[:, None]

    def probabilities(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch bins"]:
        """Distribution over the bins, at the temperature that was fitted."""
        return torch.softmax(self.backbone(images) / self.temperature, dim=-1)

    def loss(
        self, images: Float[Tensor, "batch 3 height width"], labels: Float[Tensor, " batch"]
    ) -> tuple[Float[Tensor, ""], Float[Tensor, " batch"]]:
        """Cross-entropy against each label as a Gaussian of the bins' width, and the predicted margins."""
        logits = self.backbone(images).float()
        loss = functional.cross_entropy(logits, histogram_targets(labels, self.edges))
        return loss, torch.softmax(logits / self.temperature, dim=-1) @ self.centres


class Answers(nn.Module):
    """A network that returns all it answers: margins, and the probabilities behind them where it has a histogram."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, image: Float[Tensor, "batch 3 height width"]
    ) -> tuple[Float[Tensor, " batch"]] | tuple[Float[Tensor, " batch"], Float[Tensor, "batch bins"]]:
        """Margins, and probabilities if any."""
        if isinstance(self.model, HistogramRegressor):
            probabilities = self.model.probabilities(image)
            return probabilities @ self.model.centres, probabilities
        return (self.model(image).flatten(),)


def answer_names(model: nn.Module) -> tuple[str, ...]:
    """Names of what `Answers` returns, in its order."""
    return ("margin", "probabilities") if isinstance(model, HistogramRegressor) else ("margin",)


def bin_edges(model: nn.Module) -> Float[np.ndarray, " edges"] | None:
    """Edges of the bins of a histogram, in margin units; None for one number."""
    return model.edges.double().cpu().numpy() if isinstance(model, HistogramRegressor) else None


def histogram_targets(margins: Float[Tensor, " batch"], edges: Float[Tensor, " edges"]) -> Float[Tensor, "batch bins"]:
    """Share of a Gaussian round each label that falls into each bin; each row sums to 1."""
    sigma = _WIDTH_RATIO * (edges[1] - edges[0])
    below = 0.5 * (1 + torch.erf((edges - margins[:, None]) / (math.sqrt(2) * sigma)))
    return (below[:, 1:] - below[:, :-1]) / (below[:, -1:] - below[:, :1])


def margin_loss(
    model: nn.Module, images: Float[Tensor, "batch 3 height width"], labels: Float[Tensor, " batch"]
) -> tuple[Float[Tensor, ""], Float[Tensor, " batch"]]:
    """Loss of training, cross-entropy for a histogram, else the mean squared error; and the predicted margins."""
    if isinstance(model, HistogramRegressor):
        return model.loss(images, labels)
    margins = model(images).reshape(len(images)).float()
    return functional.mse_loss(margins, labels), margins


HEADS = {"point": 1, "histogram": BINS}
"""Outputs of the backbone by head."""


def head_outputs(head: str) -> int:
    """Outputs that a head needs of its backbone."""
    if head not in HEADS:
        raise ModelError(f"there is no head named {head!r}; choose one of {', '.join(HEADS)}")
    return HEADS[head]


DEFAULT_BACKBONE = "shufflenet_v2_x1_0"


BACKBONES: Table[Callable[..., nn.Module]] = Table(
    "backbone",
    "sliplens.backbones",
    {name: torchvision.models.get_model_builder(name) for name in torchvision.models.list_models(torchvision.models)},
)
"""What builds a classifier, called with `num_classes`: TorchVision's, and those that installed packages add by the
entry point `sliplens.backbones`."""


def build_model(backbone: str = DEFAULT_BACKBONE, *, head: str = "point") -> nn.Module:
    """Build a classifier from scratch, its last layer replaced by one output: the safety margin.

    It takes (batch, 3, height, width) and returns (batch, 1), untrained, drawn from torch's current random state.

    Parameters
    ----------
    backbone
        Row of `BACKBONES`; `ModelError` if there is none of that name.
    head
        `point` for one number, `histogram` for the mean of a distribution (`HistogramRegressor`).

    References
    ----------
    Ma et al., *ShuffleNet V2* (2018); Polak, section 4 ("Training details").

    Examples
    --------
    >>> import torch
    >>> from sliplens.models import build_model
    >>> network = build_model("shufflenet_v2_x0_5").eval()
    >>> network(torch.zeros(2, 3, 32, 32)).shape
    torch.Size([2, 1])
    """
    if backbone not in BACKBONES:
        raise ModelError(f"there is no backbone named {backbone!r}; choose a TorchVision classifier such as resnet18")
    model = BACKBONES[backbone](num_classes=head_outputs(head))
    return HistogramRegressor(model) if head == "histogram" else model
