"""SmoothGrad: the gradient averaged over noisy copies of the image."""

from dataclasses import dataclass
from typing import Any

import torch
from captum import attr
from jaxtyping import Shaped
from torch import Tensor, nn

from sliplens.errors import InputError
from sliplens.explain.clock import Clock
from sliplens.explain.explanation import Explanation, Progress
from sliplens.explain.subject import explaining


@dataclass(frozen=True, kw_only=True)
class SmoothGrad:
    """SmoothGrad times what the image adds to the reference, signed, in margin units.

    Relevance is (x - b) times the mean of df/dx over x plus normal noise, summed over the channels. The gradient alone,
    which was published, has another unit than the other maps and lights up where the image equals the reference. The
    relevance is what the linear model through x says; for a linear network it adds up to f(x) - f(b), for any other to
    nothing in particular, so it has no completeness gap.

    Parameters
    ----------
    samples
        Noisy copies of each image.
    noise
        Standard deviation of the noise, in units of the input's range [0, 1].
    batch_size
        Copies in one pass.
    seed
        Of the noise, the same for each image.

    References
    ----------
    Smilkov et al., *SmoothGrad: removing noise by adding noise*, 2017, section 3; computed by Captum.
    """

    samples: int = 32
    noise: float = 0.1
    batch_size: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise InputError(f"SmoothGrad's samples is {self.samples}; give at least 1")
        if self.batch_size < 1:
            raise InputError(f"SmoothGrad's batch_size is {self.batch_size}; give at least 1")
        if not self.noise >= 0:
            raise InputError(f"SmoothGrad's noise is {self.noise}; give a standard deviation of at least 0")

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
            tunnel = attr.NoiseTunnel(attr.Saliency(subject.predict))

            def smoothed(index: int) -> Tensor:
                image, empty = subject.images[index, None], subject.reference[index, None]
                # Captum draws from the global state, which is given back as it was
                with torch.random.fork_rng(devices=[image.device] if image.is_cuda else []):
                    torch.manual_seed(self.seed)
                    gradient: Any = tunnel.attribute(
                        image,
                        nt_type="smoothgrad",
                        nt_samples=self.samples,
                        nt_samples_batch_size=min(self.batch_size, self.samples),
                        stdevs=float(self.noise),
                        abs=False,
                    )
                return (gradient.detach() * (image - empty)).sum(dim=1)[0]

            relevance = subject.each_image(smoothed, on_progress=on_progress)
        return subject.explanation(
            relevance, method="smooth-grad", clock=clock, complete=False, target="the linear model of f at x"
        )
