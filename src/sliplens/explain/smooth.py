"""SmoothGrad: the gradient averaged over noisy copies of the image."""

from dataclasses import dataclass
from typing import Any

import torch
from captum import attr
from torch import Tensor

from sliplens.errors import InputError
from sliplens.explain.explanation import Progress
from sliplens.explain.health import check_slopes
from sliplens.explain.method import Found, Method, require_at_least_one
from sliplens.explain.subject import Held


@dataclass(frozen=True, kw_only=True)
class SmoothGrad(Method):
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
        require_at_least_one("SmoothGrad", samples=self.samples, batch_size=self.batch_size)
        if not self.noise >= 0:
            raise InputError(f"SmoothGrad's noise is {self.noise}; give a standard deviation of at least 0")

    def _explain(self, held: Held, *, on_progress: Progress | None) -> Found:
        subject = held.predict_all()
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
        return Found(
            subject=subject,
            relevance=relevance,
            method="smooth-grad",
            complete=False,
            target="the linear model of f at x",
            findings=check_slopes(relevance.abs().sum(dim=(1, 2)).tolist(), change=subject.change.tolist()),
        )
