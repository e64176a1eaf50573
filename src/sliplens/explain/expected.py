"""Expected Gradients: against many references instead of one."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.explain.explanation import Progress
from sliplens.explain.inputs import require_images
from sliplens.explain.integrated import IntegratedGradients
from sliplens.explain.method import Found, Method
from sliplens.explain.subject import Held, holding


@dataclass(frozen=True, kw_only=True)
class ExpectedGradients(Method):
    """Expected Gradients: the mean of Integrated Gradients over a background of references.

    "Why this margin rather than that of frames without slip?": no single frame has to stand for no slip. The relevance
    adds up to f(x) less the mean of f over the background. The published method draws references and points of the
    line at random; here the background is gone through and each line integrated until it is complete, which gives the
    same in the limit, without noise and without a seed.

    Parameters
    ----------
    background
        Frames without slip as the network takes them, float in [0, 1], shape (frames, 3, height, width); the call's
        reference is then not used. Without one the call's reference is the whole background, and a warning says so.
    integrated
        How each line is integrated.

    References
    ----------
    Erion et al., *Improving performance of deep learning models with axiomatic attribution priors and expected
    gradients*, Nature Machine Intelligence 2021, eq. 3.
    """

    background: Float[Tensor, "frames 3 height width"] | None = None
    integrated: IntegratedGradients = field(default_factory=IntegratedGradients)

    def _explain(self, held: Held, *, on_progress: Progress | None) -> Found:
        alone = held.predict_all()
        if self.background is None:
            frames, heights = alone.reference[:, None], alone.reference_prediction[:, None]
        else:
            # checked as images are, and brought to the network's type
            with holding(held.model, require_images(self.background), reference=None) as behind:
                heights = behind.predict_all().prediction.expand(len(alone.images), -1)
                frames = behind.images.expand(len(alone.images), -1, -1, -1, -1)
        subject = alone.predicted(alone.prediction, heights.mean(dim=1))

        def mean_over(index: int) -> Tensor:
            image, end = subject.images[index], subject.prediction[index]
            pairs = zip(frames[index], heights[index], strict=True)
            lines = [self.integrated.integrate(subject, image, frame, ends=(start, end)) for frame, start in pairs]
            return torch.stack([line.relevance for line in lines]).mean(dim=0)

        only = ("no background was given, so the reference alone stands for it, as in integrated gradients",)
        return Found(
            subject=subject,
            relevance=subject.each_image(mean_over, on_progress=on_progress),
            method="expected-gradients",
            complete=True,
            target="f(x) - f(reference)" if self.background is None else "f(x) - mean of f over the background",
            findings=only if self.background is None else (),
        )
