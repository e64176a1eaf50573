"""Batch normalisation folded into the convolutions before it, for methods that need a plain chain of layers."""

from collections.abc import Callable
from copy import deepcopy
from threading import Lock, get_ident
from typing import Any

from torch import fx, nn
from torch.fx.experimental.optimization import fuse
from torch.fx.node import Argument
from torch.fx.proxy import TraceError

from sliplens.models.backbones import HistogramRegressor


def fold_batch_norm(model: nn.Module) -> nn.Module:
    """Copy a network in evaluation mode, with its batch normalisation folded into the convolutions before it.

    With its statistics fixed, batch normalisation is an affine map of each channel, and so is what scales and shifts
    the kernels of the convolution before it. A network whose graph torch cannot trace is copied as it is.

    References
    ----------
    Jacob et al., *Quantization and Training of Neural Networks for Efficient Integer-Arithmetic-Only Inference* (2018),
    eq. 14.
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
        if get_ident() != self._thread:
            return forward(*args, **kwargs)
        return super().call_module(m, forward, args, kwargs)
