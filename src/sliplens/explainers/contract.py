"""The call that all explainers share: checks, the network held still, the clock, the record."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import InputError
from sliplens.explainers.explanation import Explanation, Progress
from sliplens.explainers.frozen_model import Clock, Held, Subject, holding


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a method found out of a batch."""

    subject: Subject
    """What was explained, with both predictions."""
    relevance: Float[Tensor, "batch height width"]
    """Signed maps in margin units, in the network's type."""
    method: str
    """Key of the explainer in `EXPLAINERS`."""
    target: str = "f(x) - f(reference)"
    """What the relevance adds up to, in words."""
    complete: bool
    """Whether the relevance of an image is meant to add up to f(x) - f(b)."""
    findings: Iterable[str] = ()
    """Warnings of the method itself."""
    more: Mapping[str, Any] = field(default_factory=dict)
    """Further fields of `Explanation`."""


class Method(ABC):
    """An explainer whose own work is one function of checked images and a network that is held still."""

    def __call__(
        self,
        model: nn.Module,
        images: Shaped[Tensor, "*batch channels height width"],
        *,
        reference: Shaped[Tensor, "..."] | None = None,
        on_progress: Progress | None = None,
    ) -> Explanation:
        """Explain a batch; see `Explainer` for the arguments and errors."""
        clock = Clock()
        with holding(model, images, reference=reference) as held:
            found = self._explain(held, on_progress=on_progress)
        return found.subject.explanation(
            found.relevance,
            method=found.method,
            clock=clock,
            complete=found.complete,
            target=found.target,
            findings=found.findings,
            **found.more,
        )

    @abstractmethod
    def _explain(self, held: Held, *, on_progress: Progress | None) -> Found:
        """Make the maps of `held.images`; gradients are on."""


def require_at_least_one(name: str, **options: int) -> None:
    """Refuse options that count something and are below 1.

    Raises
    ------
    InputError
        Naming the method and the option.
    """
    for option, value in options.items():
        if value < 1:
            raise InputError(f"{name}'s {option} is {value}; give at least 1")
