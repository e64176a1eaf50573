"""Backbones: any TorchVision classifier, with the outputs that its head needs."""

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import import_module
from threading import get_ident
from types import ModuleType
from typing import Any, TypeAlias, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from sliplens.errors import ModelError
from sliplens.extras import pick


def _import_torchvision() -> ModuleType:
    """Import TorchVision without torch's compiler, which takes as long as torch and serves a function not used here."""
    compiler = "torch._dynamo.utils"
    if "torchvision" in sys.modules or compiler in sys.modules:
        return import_module("torchvision")
    sys.modules[compiler] = stand_in = ModuleType(compiler)
    stand_in.is_compile_supported = lambda device: import_module(compiler).is_compile_supported(device)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        return import_module("torchvision")
    finally:
        del sys.modules[compiler]


_classifiers = _import_torchvision().models

BINS = 60
LOWEST, HIGHEST = -0.1, 1.1
"""Ends of the histogram, in margin units: a label's width beyond [0, 1], so that its mean is not pulled inwards."""
RATIO_BINS = 80
RATIO_LOWEST, RATIO_HIGHEST = -0.1, 1.5
"""Ends of the histogram over the traction ratio F_t / F_n: below 0 as below a margin of 0, above what rubber holds."""
_WIDTH_RATIO = 0.75
"""Standard deviation of a label over the width of a bin, as Farebrother et al. recommend."""


class HistogramRegressor(nn.Module):
    """Network with a histogram over the safety margin as its output; it returns the mean (HL-Gauss).

    `backbone` returns (batch, `BINS`) logits, and `RATIO_BINS` more if `ratio`, for a histogram over F_t / F_n.

    Imani & White, *Improving Regression Performance with Distributional Losses* (2018); Farebrother et al., *Stop
    Regressing* (2024), whose width of a label is taken.
    """

    edges: Tensor
    temperature: Tensor
    ratio_edges: Tensor | None
    ratio_temperature: Tensor | None

    def __init__(self, backbone: nn.Module, *, ratio: bool = False) -> None:
        super().__init__()
        self.backbone = backbone
        self.register_buffer("edges", torch.linspace(LOWEST, HIGHEST, BINS + 1))
        self.register_buffer("temperature", torch.tensor(1.0))
        # None is not part of the weights: files of networks with one output stay the same
        ratio_edges = torch.linspace(RATIO_LOWEST, RATIO_HIGHEST, RATIO_BINS + 1) if ratio else None
        self.register_buffer("ratio_edges", ratio_edges)
        self.register_buffer("ratio_temperature", torch.tensor(1.0) if ratio else None)

    @property
    def centres(self) -> Float[Tensor, " bins"]:
        """Margins in the middle of the bins."""
        return bin_centres(self.edges)

    def forward(self, images: Float[Tensor, "batch *input"]) -> Float[Tensor, "batch 1"]:
        """Mean of the distribution: the safety margin."""
        return (torch.softmax(self.split(self.backbone(images))[0] / self.temperature, dim=-1) @ self.centres)[:, None]

    def split(
        self, logits: Float[Tensor, "batch all_bins"]
    ) -> tuple[Float[Tensor, "batch bins"], Float[Tensor, "batch ratio_bins"]]:
        """Split logits into those over the margin and those over the ratio; the second may have no columns."""
        return logits[:, :BINS], logits[:, BINS:]


RunBatches: TypeAlias = Callable[[Iterable[Tensor]], Iterator[tuple[Tensor, ...]]]
"""Function from batches of images to the outputs of `Answers`, in the order of the batches."""


class Answers(nn.Module):
    """Network that returns all outputs: margins, and probabilities of its histograms.

    With `layer`, a module of the network, the mean over the image of each of its channels comes last, for `Novelty`.
    """

    def __init__(self, model: nn.Module, layer: str | None = None) -> None:
        super().__init__()
        self.model, self.layer = model, layer

    def forward(self, image: Float[Tensor, "batch *input"]) -> tuple[Any, ...]:
        """Compute margins (batch,); probabilities (batch, bins) of the margin, then of the ratio, if it has them.

        Then features (batch, channels of `layer`), if there is a layer.
        """
        features, thread, handle = [], get_ident(), None

        def record(_: nn.Module, __: object, output: Any) -> None:  # no tensor while torch traces it
            if get_ident() == thread:  # another thread may explain the network of a running sensor meanwhile
                features.append(output.mean(dim=(2, 3)))

        if self.layer:
            handle = self.model.get_submodule(self.layer).register_forward_hook(record)
        try:
            answer = (self.model.backbone if isinstance(self.model, HistogramRegressor) else self.model)(image)
        finally:
            if handle is not None:
                handle.remove()
        if not isinstance(self.model, HistogramRegressor):
            return answer.flatten(), *features
        logits, ratio_logits = self.model.split(answer)
        probabilities = torch.softmax(logits / self.model.temperature, dim=-1)
        margins = probabilities @ self.model.centres
        if self.model.ratio_temperature is None:
            return margins, probabilities, *features
        return margins, probabilities, torch.softmax(ratio_logits / self.model.ratio_temperature, dim=-1), *features

    def run(self, batches: Iterable[Tensor]) -> Iterator[tuple[Tensor, ...]]:
        """Compute the outputs of batches of images, each as it comes, on the network's device."""
        device = next(self.model.parameters(), torch.empty(0)).device
        for batch in batches:
            with torch.no_grad():
                # convolutions on a processor then need no reordering
                answers = self(batch.to(device).contiguous(memory_format=torch.channels_last))
            yield answers


def answer_names(model: nn.Module, layer: str | None = None) -> tuple[str, ...]:
    """Return the names of the outputs of `Answers`, in their order."""
    names = ("margin", "probabilities", "ratio_probabilities")
    names = names[: 1 if not isinstance(model, HistogramRegressor) else 2 if model.ratio_edges is None else 3]
    return names if layer is None else (*names, "features")


def bin_edges(model: nn.Module) -> Float[np.ndarray, " edges"] | None:
    """Return the edges of the bins of a histogram, in margin units; None for a single number."""
    return model.edges.cpu().double().numpy() if isinstance(model, HistogramRegressor) else None


def ratio_edges(model: nn.Module) -> Float[np.ndarray, " edges"] | None:
    """Return the edges of the bins over F_t / F_n; None for a network that predicts the margin alone."""
    edges = model.ratio_edges if isinstance(model, HistogramRegressor) else None
    return None if edges is None else edges.cpu().double().numpy()


_Edges = TypeVar("_Edges", Tensor, np.ndarray)


def bin_centres(edges: _Edges) -> _Edges:
    """Return the values in the middle of the bins of a histogram."""
    return (edges[1:] + edges[:-1]) / 2


def histogram_targets(values: Float[Tensor, " batch"], edges: Float[Tensor, " edges"]) -> Float[Tensor, "batch bins"]:
    """Compute the share of a Gaussian around each label in each bin; each row sums to 1."""
    sigma = _WIDTH_RATIO * (edges[1] - edges[0])
    below = 0.5 * (1 + torch.erf((edges - values[:, None]) / (math.sqrt(2) * sigma)))
    return (below[:, 1:] - below[:, :-1]) / (below[:, -1:] - below[:, :1])


def margin_loss(
    model: nn.Module,
    images: Float[Tensor, "batch *input"],
    labels: Float[Tensor, " batch"],
    ratios: Float[Tensor, " batch"] | None = None,
) -> tuple[Float[Tensor, ""], Float[Tensor, " batch"]]:
    """Compute the training loss and the predicted margins.

    The loss is the mean squared error, or the cross-entropy of a histogram against each label as a Gaussian of the
    bins' width. `ratios`: F_t / F_n of the frames; frames of unknown forces (NaN) count for the margin alone.
    """
    if not isinstance(model, HistogramRegressor):
        margins = model(images).reshape(len(images)).float()
        return functional.mse_loss(margins, labels), margins
    logits, ratio_logits = (part.float() for part in model.split(model.backbone(images)))
    loss = functional.cross_entropy(logits, histogram_targets(labels, model.edges))
    if model.ratio_edges is not None and ratios is not None and (finite := torch.isfinite(ratios)).any():
        targets = histogram_targets(ratios[finite], model.ratio_edges)
        loss = loss + functional.cross_entropy(ratio_logits[finite], targets)
    return loss, torch.softmax(logits / model.temperature, dim=-1) @ model.centres


HEADS = {"point": 1, "histogram": BINS, "margin-and-ratio": BINS + RATIO_BINS}
"""Number of outputs of the backbone, by head."""


def last_layer(model: nn.Module) -> nn.Linear:
    """Return the last linear layer; `ModelError` if there is none."""
    layers = [module for module in model.modules() if isinstance(module, nn.Linear)]
    if not layers:
        raise ModelError(f"{type(model).__name__} has no linear layer; choose a backbone such as resnet18")
    return layers[-1]


def fill_head(model: nn.Module, weights: Mapping[str, Tensor]) -> nn.Module:
    """Fill a network that has one output more or less than these weights; rows for a new ratio are zero."""
    state = model.state_dict()
    for name in state.keys() & weights.keys():
        value, target = weights[name], state[name]
        if value.ndim:
            value = torch.cat([value[: len(target)], torch.zeros_like(target[len(value) :])])
        state[name] = value
    model.load_state_dict(state)
    return model


DEFAULT_BACKBONE = "shufflenet_v2_x1_0"
BACKBONES: dict[str, Callable[..., nn.Module]] = {
    name: _classifiers.get_model_builder(name) for name in _classifiers.list_models(_classifiers)
}
"""Builders of TorchVision's classifiers, called with `num_classes`."""


def build_model(backbone: str = DEFAULT_BACKBONE, *, head: str = "point", colours: int = 3) -> nn.Module:
    """Build a classifier from scratch, its last layer replaced by one output: the safety margin.

    It takes (batch, colours, height, width) and returns (batch, 1), untrained, drawn from torch's current random state.

    `head` is a row of `HEADS`; `colours` the channels of the input, see `Encoding.colours`.

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
    model = BACKBONES[backbone](num_classes=pick(HEADS, head, noun="head"))
    if colours != 3:  # an untrained first layer
        first = next(module for module in model.modules() if isinstance(module, nn.Conv2d))
        first.in_channels = colours
        first.weight = nn.Parameter(first.weight.new_empty(len(first.weight), colours, *first.kernel_size))
        first.reset_parameters()
    return model if head == "point" else HistogramRegressor(model, ratio=head == "margin-and-ratio")
