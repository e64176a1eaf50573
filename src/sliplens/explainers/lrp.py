"""Layer-wise relevance propagation by zennit (an extra)."""

import operator
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from threading import Lock, get_ident
from typing import Any, ClassVar

import torch
from torch import Tensor, fx, nn
from torch.fx.experimental.optimization import fuse
from torch.fx.node import Argument
from torch.fx.proxy import TraceError

from sliplens.explainers.attribution import Attribution, frame_of
from sliplens.explainers.contract import Comparison, Method
from sliplens.extras import require_packages
from sliplens.models.backbones import HistogramRegressor
from sliplens.progress import report_each

_TOLERANCE = 0.1  # share of f(x) by which the relevance may miss it without a warning
_BATCH = 32


@dataclass(frozen=True, kw_only=True)
class Lrp(Method):
    """Layer-wise relevance propagation: alpha-1-beta-0 in convolutions, epsilon in linear layers, flat in the first.

    The prediction is handed back from layer to layer, each giving its inputs their share of its output; the mean of a
    histogram is handed to its logits as gradient times logit. Biases keep their share, and the prediction itself is
    handed back, so there is no completeness gap, and the reference only decides what `saliency` shows.

    Works on a copy whose batch normalisation is folded into the convolutions, and whose means over space and sums of
    branches are made modules: zennit knows rules for modules only.

    References
    ----------
    Bach et al., *On pixel-wise explanations for non-linear classifier decisions by layer-wise relevance propagation*,
    PLOS ONE 2015, eqs. 58 and 60; the composite as in Anders et al., *Software for dataset-wide XAI*, 2021 (zennit).
    """

    method: ClassVar[str] = "lrp"

    def _explain(self, comparison: Comparison) -> Attribution:
        require_packages("zennit", extra="lrp", purpose="LRP")
        prediction = comparison.prediction
        copy = fold_batch_norm(comparison.model)
        for module in copy.modules():
            if isinstance(module, fx.GraphModule):
                _name_functions(module)
        parts = comparison.images.split(_BATCH)
        relevance = torch.cat(
            [_propagate(copy, part) for part in report_each(parts, sizes=[len(part) for part in parts])]
        )
        shares = (relevance.sum(dim=(1, 2, 3)) / prediction).tolist()
        return comparison.attribution(
            frame_of(relevance).sum(dim=1),
            complete=False,
            target="f(x)",
            warnings=[
                f"image {index}: LRP hands back {share:.3g} times f(x); biases keep some of it, products make more"
                for index, share in enumerate(shares)
                if not abs(share - 1) <= _TOLERANCE
            ],
        )


_TRACING = Lock()  # of two at once each would put back what the other one changed


class _Tracer(fx.Tracer):
    """Tracer that lets the networks of other threads run: while torch traces, it changes what all of them call."""

    def __init__(self) -> None:
        super().__init__()
        self._thread = get_ident()

    def call_module(
        self, m: nn.Module, forward: Callable[..., Any], args: tuple[Argument, ...], kwargs: dict[str, Argument]
    ) -> Any:
        """Record the call of a module in this thread; call it in any other."""
        return (
            super().call_module(m, forward, args, kwargs) if get_ident() == self._thread else forward(*args, **kwargs)
        )


def fold_batch_norm(model: nn.Module) -> nn.Module:
    """Copy a network in evaluation mode, with its batch normalisation folded into the convolutions before it.

    A network whose graph torch cannot trace is copied as it is.
    """
    copied = deepcopy(model)
    if isinstance(copied, HistogramRegressor):
        copied.backbone = fold_batch_norm(copied.backbone)
        return copied
    try:
        with _TRACING:
            graph = _Tracer().trace(copied)
        return fuse(fx.GraphModule(copied, graph), inplace=True, no_trace=True)
    except (TraceError, TypeError, NotImplementedError):  # branches on values, or takes a tensor apart
        return copied


class _Sum(nn.Module):
    """A sum of two branches, by the module that zennit has a rule for."""

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        return self.inner(torch.stack(torch.broadcast_tensors(first, second), dim=-1))


def _name_functions(module: fx.GraphModule) -> None:
    """Replace sums of two branches and means over space by modules."""
    from zennit.layer import Sum  # noqa: PLC0415  # pyright: ignore[reportMissingImports] (an extra)

    for place, node in enumerate(list(module.graph.nodes)):
        branches = [argument for argument in node.args if isinstance(argument, fx.Node)]
        dims, replacement = node.kwargs.get("dim", node.args[1] if len(node.args) > 1 else None), None
        if node.op == "call_function" and node.target in {operator.add, operator.iadd, torch.add}:
            replacement = _Sum(Sum()) if len(branches) == 2 else None
        elif node.op == "call_method" and node.target == "mean" and dims in ([2, 3], (2, 3), [-2, -1], (-2, -1)):
            pool = nn.AdaptiveAvgPool2d(1)
            replacement = pool if node.kwargs.get("keepdim", False) else nn.Sequential(pool, nn.Flatten())
        if replacement is not None:
            module.add_submodule(name := f"lrp_{place}", replacement)
            with module.graph.inserting_after(node):
                call = module.graph.call_module(name, tuple(branches))
            node.replace_all_uses_with(call)
            module.graph.erase_node(node)
    module.recompile()


def _propagate(model: nn.Module, images: Tensor) -> Tensor:
    from zennit.composites import EpsilonPlusFlat  # noqa: PLC0415  # pyright: ignore[reportMissingImports] (an extra)

    composite: Any = EpsilonPlusFlat()
    images = images.clone().requires_grad_()
    with composite.context(model) as changed:
        if isinstance(changed, HistogramRegressor):
            logits, _ = changed.split(changed.backbone(images))
            free = logits.detach().requires_grad_()
            mean = torch.softmax(free / changed.temperature, dim=-1) @ changed.centres
            (slopes,) = torch.autograd.grad(mean.sum(), free)
            output, start = logits, slopes * free.detach()
        else:
            output = changed(images)
            start = output.detach()
        (relevance,) = torch.autograd.grad(output, images, grad_outputs=start)
    return relevance
