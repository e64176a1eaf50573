"""Class activation maps that keep their sign."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from sliplens.errors import InputError, ModelError
from sliplens.explain.clock import Clock
from sliplens.explain.explanation import Explanation, Progress
from sliplens.explain.health import check_maps
from sliplens.explain.layers import capture, find_layers
from sliplens.explain.maps import spread
from sliplens.explain.subject import Subject, explaining


def grad_cam_map(
    activations: Float[Tensor, "batch channels rows columns"],
    gradients: Float[Tensor, "batch channels rows columns"],
) -> Float[Tensor, "batch rows columns"]:
    """Grad-CAM before any ReLU: sum over c of alpha_c A_c, alpha_c the mean over space of df/dA_c.

    In margin units for each cell: for a head f = bias + w . mean over space of A, alpha_c = w_c / (rows x columns), so
    the cells add up to f - bias without any further normalisation.

    Parameters
    ----------
    activations
        A, the output of a layer.
    gradients
        df/dA in margin units over the activation's.

    References
    ----------
    Selvaraju et al., *Grad-CAM: Visual explanations from deep networks via gradient-based localization*, ICCV 2017,
    eqs. 1 and 2, without the ReLU of eq. 2: a regressor's negative evidence is evidence.
    """
    return (gradients.mean(dim=(2, 3), keepdim=True) * activations).sum(dim=1)


@dataclass(frozen=True, kw_only=True)
class GradCam:
    """Grad-CAM of one layer against the reference, signed, in margin units.

    The published map, sum over c of alpha_c A_c(x), adds up to f(x) less the head's bias: for a classifier's logit that
    is evidence, for a regressor it is mostly the level that every image has. What sets x apart is the contrast

        sum over c of alpha_c (A_c(x) - A_c(b)),   alpha_c at x,

    which for a head linear in the mean over space adds up to f(x) - f(b) exactly, whatever the bias.
    The map is bilinear between the layer's cells and keeps their total.

    Parameters
    ----------
    layer
        Name of the layer; by default the last one with a map, as `find_layers` finds it.
    contrast
        Take the reference's activations off. False gives the published map, which does not depend on the reference and
        has no completeness gap; the reference then only decides what `saliency` shows.
    batch_size
        Images in one pass.
    """

    layer: str | None = None
    contrast: bool = True
    batch_size: int = 32

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise InputError(f"Grad-CAM's batch_size is {self.batch_size}; give at least 1")

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
            names = None if self.layer is None else (self.layer,)
            layer = find_layers(model, subject.images[:1], names=names)[-1].name
            parts = []
            done = 0
            pairs = zip(subject.images.split(self.batch_size), subject.reference.split(self.batch_size), strict=True)
            for part, references in pairs:
                parts.append(self._explain(subject, part, references, layer=layer))
                done += len(part)
                if on_progress is not None:
                    on_progress(done, len(subject.images))
            exact = torch.cat(parts)
            gap = (exact.sum(dim=(1, 2)) - subject.change).abs().float() if self.contrast else None
            relevance = exact.float()
        return Explanation(
            relevance=relevance,
            method="grad-cam",
            target=f"{'f(x) - f(reference)' if self.contrast else 'f(x)'}, through layer {layer}",
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

    def _explain(self, subject: Subject, images: Tensor, references: Tensor, *, layer: str) -> Tensor:
        with capture(subject.model, [layer], differentiable=True) as outputs:
            prediction = subject.predict(images)
        if not prediction.requires_grad:
            raise ModelError(f"the output does not depend on layer {layer!r}; choose a layer on the path to the output")
        (gradients,) = torch.autograd.grad(prediction.sum(), outputs[layer])
        activations = outputs[layer].detach()
        if self.contrast:
            with capture(subject.model, [layer]) as outputs, torch.no_grad():
                subject.predict(references)
            activations = activations - outputs[layer]
        cells = grad_cam_map(activations, gradients)
        return spread(cells, (images.shape[-2], images.shape[-1]))
