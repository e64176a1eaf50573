"""The call that all explainers share: checks, a frozen network, the clock, the record."""

import time
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Shaped
from torch import Tensor, nn

from sliplens.errors import InputError
from sliplens.explainers.explanation import Explanation
from sliplens.explainers.frozen_model import FrozenModel, freeze
from sliplens.progress import OnProgress


@runtime_checkable
class Explainer(Protocol):
    """A frozen dataclass whose fields are the options of a method and whose call explains a batch."""

    def __call__(
        self,
        model: nn.Module,
        images: Shaped[Tensor, "*batch channels height width"],
        *,
        reference: Shaped[Tensor, "..."] | None = None,
        on_progress: OnProgress | None = None,
    ) -> Explanation:
        """Explain f(x) - f(reference) of a regressor with one output.

        Parameters
        ----------
        model
            Network from images (batch, 3, height, width) to one safety margin each, (batch,) or (batch, 1).
            It is put into evaluation mode for the call and given back as it was.
        images
            Images x, float in [0, 1], shape (batch, 3, height, width).
        reference
            What the images are compared with, float in [0, 1], one for all (3, height, width) or one each
            (batch, 3, height, width); by default zeros, the untouched sensor of difference images.

        Raises
        ------
        ImageError
            If the images or the reference have a wrong shape, type or range, or hold NaN.
        ModelError
            If the network has several outputs, predicts NaN, or lacks a layer that the method needs.
        """
        ...


class Method(ABC):
    """An explainer whose own work is one function of checked images and a frozen network."""

    def __call__(
        self,
        model: nn.Module,
        images: Shaped[Tensor, "*batch channels height width"],
        *,
        reference: Shaped[Tensor, "..."] | None = None,
        on_progress: OnProgress | None = None,
    ) -> Explanation:
        """Explain a batch; see `Explainer` for the arguments and errors."""
        start = time.perf_counter()
        with freeze(model, images, reference=reference) as frozen:
            explanation = self._explain(frozen, on_progress=on_progress)
        if explanation.relevance.is_cuda:
            torch.cuda.synchronize(explanation.relevance.device)
        return replace(explanation, seconds=time.perf_counter() - start)

    @abstractmethod
    def _explain(self, frozen: FrozenModel, *, on_progress: OnProgress | None) -> Explanation:
        """Explain `frozen.images` (`Comparison.explanation`); gradients are on."""


def require_at_least_one(name: str, **options: int) -> None:
    """Refuse options that count something and are below 1."""
    for option, value in options.items():
        if value < 1:
            raise InputError(f"{name}'s {option} is {value}; give at least 1")
