"""Holding a network still while it is looked at."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn


@contextmanager
def still(model: nn.Module) -> Iterator[None]:
    """Put a network into evaluation mode without parameter gradients, and give it back as it was.

    In evaluation mode batch normalisation keeps its statistics, and without `requires_grad` no `.grad` can be
    written, so the state that is restored, also after an exception, is the training flag of every module and the
    `requires_grad` of every parameter. Two threads must not hold one network at the same time.
    """
    training = [(module, module.training) for module in model.modules()]
    trainable = [(parameter, parameter.requires_grad) for parameter in model.parameters()]
    try:
        model.eval()
        for parameter, _ in trainable:
            parameter.requires_grad_(False)
        yield
    finally:
        # flag by flag: train() would recurse and undo what a caller had frozen
        for module, flag in training:
            module.training = flag
        for parameter, flag in trainable:
            parameter.requires_grad_(flag)
