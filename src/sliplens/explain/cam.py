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
    """Grad-CAM of one layer, signed, in margin units.

    The map is bilinear between the layer's cells and keeps their total. It follows the gradient at x and does not
    depend on the reference, which only decides what `saliency` shows. With a head linear in the mean over space it adds
    up to f(x) less the head's bias, not to f(x) - f(reference), so no completeness gap is given.

    Parameters
    ----------
    layer
        Name of the layer; by default the last one with a map, as `find_layers` finds it.
    batch_size
        Images in one pass.
    """

    layer: str | None = None
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
            for part in subject.images.split(self.batch_size):
                parts.append(self._explain(subject, part, layer=layer))
                done += len(part)
                if on_progress is not None:
                    on_progress(done, len(subject.images))
            relevance = torch.cat(parts).float()
        return Explanation(
            relevance=relevance,
            method="grad-cam",
            target=f"f(x), by its gradient with respect to layer {layer}",
            prediction=subject.prediction.float(),
            reference_prediction=subject.reference_prediction.float(),
            seconds=clock.seconds(relevance),
            warnings=check_maps(
                relevance,
                prediction=subject.prediction,
                reference_prediction=subject.reference_prediction,
                completeness_gap=None,
            ),
        )

    def _explain(self, subject: Subject, images: Tensor, *, layer: str) -> Tensor:
        with capture(subject.model, [layer], differentiable=True) as outputs:
            prediction = subject.predict(images)
        if not prediction.requires_grad:
            raise ModelError(f"the output does not depend on layer {layer!r}; choose a layer on the path to the output")
        (gradients,) = torch.autograd.grad(prediction.sum(), outputs[layer])
        cells = grad_cam_map(outputs[layer].detach(), gradients)
        return spread(cells, (images.shape[-2], images.shape[-1]))
