"""Explanations that follow the gradient in the image itself."""

from dataclasses import dataclass

import torch
from captum import attr
from jaxtyping import Shaped
from torch import Tensor, nn

from sliplens.errors import InputError
from sliplens.explain.clock import Clock
from sliplens.explain.explanation import Explanation, Progress
from sliplens.explain.health import check_maps
from sliplens.explain.subject import Subject, explaining

_GROWTH = 4  # nodes are not shared between grids: fourfold, the tries before the last cost a third more, not twice
_ROUNDING = 1e-6  # of |f|: a gap that float32 predictions cannot resolve is no gap


@dataclass(frozen=True, kw_only=True)
class IntegratedGradients:
    """Integrated Gradients along the straight line from the reference, with as many steps as completeness needs.

    Relevance is (x - b) times the integral over t in [0, 1] of df/dx at b + t (x - b), summed over the channels; it
    adds up to f(x) - f(b) when the integral is exact. The number of steps is raised fourfold for each image on its
    own until the sum is within `tolerance` of that, so a batch gives what its images alone would give.

    Parameters
    ----------
    steps
        Steps (Gauss-Legendre nodes) to start with.
    max_steps
        Most steps; an image that needs more keeps its gap and a warning. Equal to `steps` for a fixed number.
    tolerance
        Completeness gap allowed, as a share of |f(x) - f(b)|.
    batch_size
        Steps in one pass.

    References
    ----------
    Sundararajan, Taly and Yan, *Axiomatic attribution for deep networks*, ICML 2017, eq. 1; computed by Captum.
    """

    steps: int = 32
    max_steps: int = 512
    tolerance: float = 0.01
    batch_size: int = 32

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= self.max_steps:
            raise InputError(
                f"integrated gradients has steps = {self.steps} and max_steps = {self.max_steps}; "
                "give 1 <= steps <= max_steps"
            )
        if self.batch_size < 1:
            raise InputError(f"integrated gradients' batch_size is {self.batch_size}; give at least 1")
        if not self.tolerance > 0:
            raise InputError(f"integrated gradients' tolerance is {self.tolerance}; give a share above 0")

    def __call__(
        self,
        model: nn.Module,
        images: Shaped[Tensor, "*batch channels height width"],
        *,
        reference: Shaped[Tensor, "..."] | None = None,
        on_progress: Progress | None = None,
    ) -> Explanation:
        """Explain a batch; see `Explainer` for the arguments and errors. Progress counts images."""
        clock = Clock()
        with explaining(model, images, reference=reference) as subject:
            maps = []
            for index in range(len(subject.images)):
                maps.append(self._explain(subject, index))
                if on_progress is not None:
                    on_progress(index + 1, len(subject.images))
            exact = torch.stack(maps)
            gap = (exact.sum(dim=(1, 2)) - subject.change).abs().float()
            relevance = exact.float()
        return Explanation(
            relevance=relevance,
            method="integrated-gradients",
            target="f(x) - f(reference)",
            prediction=subject.prediction.float(),
            reference_prediction=subject.reference_prediction.float(),
            completeness_gap=gap,
            seconds=clock.seconds(relevance),
            warnings=check_maps(
                relevance,
                prediction=subject.prediction,
                reference_prediction=subject.reference_prediction,
                completeness_gap=gap,
            ),
        )

    def _explain(self, subject: Subject, index: int) -> Tensor:
        image, reference = subject.images[index, None], subject.reference[index, None]
        change = float(subject.change[index])
        largest = max(abs(float(subject.prediction[index])), abs(float(subject.reference_prediction[index])))
        allowed = max(self.tolerance * abs(change), _ROUNDING * largest)
        captum = attr.IntegratedGradients(subject.predict)
        steps = self.steps
        while True:
            contributions = captum.attribute(
                image, baselines=reference, n_steps=steps, internal_batch_size=min(self.batch_size, steps)
            )
            relevance = contributions.detach().sum(dim=1)[0]
            if abs(float(relevance.sum()) - change) <= allowed or steps == self.max_steps:
                return relevance
            steps = min(_GROWTH * steps, self.max_steps)
