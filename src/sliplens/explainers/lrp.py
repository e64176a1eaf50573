"""Layer-wise relevance propagation through zennit, an extra."""

import operator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, fx, nn

from sliplens.explainers.contract import Comparison, Method
from sliplens.explainers.explanation import Explanation
from sliplens.extras import require_packages
from sliplens.models.backbones import HistogramRegressor
from sliplens.models.engines import fold_batch_norm
from sliplens.progress import OnProgress

_KEPT = 0.1  # share of f(x) by which the relevance may miss it without a warning


@dataclass(frozen=True, kw_only=True)
class Lrp(Method):
    """Layer-wise relevance propagation: alpha-1-beta-0 in convolutions, epsilon in linear layers, flat in the first.

    The prediction is handed back from layer to layer, each giving its inputs their share of its output. A histogram
    has no share of its own: its mean is handed to the logits as gradient times logit. Biases keep their share, and
    the prediction itself is handed back, not its difference from the reference, so there is no completeness gap, and
    the reference only decides what `saliency` shows.

    Works on a copy whose batch normalisation is folded into the convolutions, and whose means over space and sums of
    branches, functions in TorchVision's networks, are made modules: zennit knows rules for modules only.

    References
    ----------
    Bach et al., *On pixel-wise explanations for non-linear classifier decisions by layer-wise relevance propagation*,
    PLOS ONE 2015, eqs. 58 and 60; the composite as in Anders et al., *Software for dataset-wide XAI*, 2021 (zennit).
    """

    batch_size: int = 32

    def _explain(self, comparison: Comparison, *, on_progress: OnProgress | None) -> Explanation:
        require_packages("zennit", extra="lrp", purpose="LRP")
        prediction = comparison.prediction
        copy = fold_batch_norm(comparison.model)
        for module in copy.modules():
            if isinstance(module, fx.GraphModule):
                _name_functions(module)
        parts = []
        for part in comparison.images.split(self.batch_size):
            parts.append(_propagate(copy, part))
            if on_progress is not None:
                on_progress(sum(map(len, parts)), len(comparison.images))
        relevance = torch.cat(parts)
        shares = (relevance.sum(dim=(1, 2)) / prediction).tolist()
        return comparison.explanation(
            relevance,
            method="lrp",
            complete=False,
            target="f(x)",
            warnings=[
                f"image {index}: LRP hands back {share:.3g} times f(x); biases keep some of it, products make more"
                for index, share in enumerate(shares)
                if not abs(share - 1) <= _KEPT
            ],
        )


class _Sum(nn.Module):
    """A sum of two branches, by the module that zennit has a rule for."""

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        return self.inner(torch.stack(torch.broadcast_tensors(left, right), dim=-1))


def _name_functions(module: fx.GraphModule) -> None:
    """Replace sums of two branches and means over space by modules."""
    from zennit.layer import Sum  # noqa: PLC0415  # pyright: ignore[reportMissingImports] (an extra)

    for place, node in enumerate(list(module.graph.nodes)):
        branches = [argument for argument in node.args if isinstance(argument, fx.Node)]
        if node.op == "call_function" and node.target in {operator.add, operator.iadd, torch.add}:
            replacement = _Sum(Sum()) if len(branches) == 2 else None
        elif node.op == "call_method" and node.target == "mean" and _over_space(node):
            pool = nn.AdaptiveAvgPool2d(1)
            replacement = pool if node.kwargs.get("keepdim", False) else nn.Sequential(pool, nn.Flatten())
        else:
            replacement = None
        if replacement is not None:
            module.add_submodule(name := f"lrp_{place}", replacement)
            with module.graph.inserting_after(node):
                named = module.graph.call_module(name, tuple(branches))
            node.replace_all_uses_with(named)
            module.graph.erase_node(node)
    module.recompile()


def _over_space(node: fx.Node) -> bool:
    dims = node.kwargs.get("dim", node.args[1] if len(node.args) > 1 else None)
    return isinstance(dims, list | tuple) and tuple(dims) in {(2, 3), (-2, -1)}


def _propagate(model: nn.Module, images: Tensor) -> Tensor:
    from zennit.composites import EpsilonPlusFlat  # noqa: PLC0415  # pyright: ignore[reportMissingImports] (an extra)

    composite: Any = EpsilonPlusFlat()
    images = images.clone().requires_grad_()
    with composite.context(model) as changed:
        if isinstance(changed, HistogramRegressor):
            logits, _ = changed.logits(images)
            free = logits.detach().requires_grad_()
            mean = torch.softmax(free / changed.temperature, dim=-1) @ changed.centres
            (slopes,) = torch.autograd.grad(mean.sum(), free)
            output, start = logits, slopes * free.detach()
        else:
            output = changed(images)
            start = output.detach()
        (relevance,) = torch.autograd.grad(output, images, grad_outputs=start)
    return relevance.sum(dim=1)
