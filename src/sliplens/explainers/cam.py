"""Class activation maps that keep their sign."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.errors import ModelError
from sliplens.explainers.activations import Layer, capture, recall_layers
from sliplens.explainers.contract import Comparison, Method, require_at_least_one
from sliplens.explainers.explanation import Explanation, check_slopes
from sliplens.explainers.maps import scale_to, spread
from sliplens.progress import OnProgress

_Maps: TypeAlias = Float[Tensor, "batch channels rows columns"]
_Cells: TypeAlias = Float[Tensor, "batch rows columns"]


@dataclass(frozen=True, kw_only=True)
class _Cam(Method):
    """One layer's cells, weighted by the gradient at the image; the map is bilinear between them and keeps their total.

    The published maps weigh the activations A(x), which for a regressor are mostly the level that every image has. What
    sets x apart from the reference is the contrast A(x) - A(b), weighted by the same gradient.
    """

    layer: str | None = None
    """Name of the layer; by default the last one with a map, as `find_layers` finds it."""
    contrast: bool = True
    """Take the reference's activations off. False gives the published map, which does not depend on the reference and
    has no completeness gap; the reference then only decides what `saliency` shows."""
    relu: bool = False
    """Keep the cells above zero alone, as published; their map is then scaled to add up to f(x) - f(b), so that the
    order of its pixels is the published one. That is a convention, and says nothing of what one pixel contributes."""
    batch_size: int = 32

    method: ClassVar[str]
    one_sided: ClassVar[bool] = False
    """Whether gradients count along the change of the prediction, where some are left out. If not, the contrast adds
    up to f(x) - f(b) for a head linear in the mean over space."""

    @staticmethod
    @abstractmethod
    def cells(activations: _Maps, gradients: _Maps) -> _Cells:
        """Relevance of the layer's cells in margin units, before any ReLU."""

    def __post_init__(self) -> None:
        require_at_least_one(type(self).__name__, batch_size=self.batch_size)

    def _explain(self, comparison: Comparison, *, on_progress: OnProgress | None) -> Explanation:
        layer = self._find_layer(comparison)
        maps, predictions, reference_predictions = [], [], []
        empty = reference_prediction = torch.empty(0)
        for part in torch.arange(len(comparison.images)).split(self.batch_size):
            # images and references in one pass; one reference for all is looked at once
            shared = comparison.references[: 0 if maps else 1]
            references = comparison.references[part] if len(comparison.references) > 1 else shared
            activations, gradients, prediction = _differentiate(
                comparison, torch.cat([comparison.images[part], references]), count=len(part), layer=layer
            )
            if len(references):
                empty, reference_prediction = activations[len(part) :], prediction[len(part) :]
            activations, prediction = activations[: len(part)], prediction[: len(part)]
            change = (prediction - reference_prediction)[:, None, None, None]
            sign = change.sign() if self.one_sided else torch.ones_like(change)
            cells = self.cells(activations - empty if self.contrast else activations, sign * gradients)
            cells = torch.relu(cells) if self.relu else sign[:, 0] * cells
            maps.append(spread(cells, (comparison.images.shape[-2], comparison.images.shape[-1])))
            predictions.append(prediction)
            reference_predictions.append(reference_prediction.expand_as(prediction))
            if on_progress is not None:
                on_progress(sum(map(len, maps)), len(comparison.images))
        comparison = comparison.knowing(torch.cat(predictions), torch.cat(reference_predictions))
        relevance = scale_to(torch.cat(maps), total=comparison.change) if self.relu else torch.cat(maps)
        return comparison.explanation(
            relevance,
            method=self.method,
            complete=self.contrast and not self.one_sided and not self.relu,
            target=f"{'f(x) - f(reference)' if self.contrast else 'f(x)'}, through layer {layer.name}",
            warnings=check_slopes(relevance.abs().sum(dim=(1, 2)).tolist(), change=comparison.change.tolist()),
        )

    def _find_layer(self, comparison: Comparison) -> Layer:
        names = None if self.layer is None else (self.layer,)
        try:
            return recall_layers(comparison.model, comparison.images[:1], names=names)[-1]
        except ModelError:
            _ = comparison.change  # a model that gives no number has a greater fault than one without layers
            raise


def _differentiate(comparison: Comparison, batch: Tensor, *, count: int, layer: Layer) -> tuple[Tensor, Tensor, Tensor]:
    """Activations, gradients of the first `count` predictions in them, and predictions of a batch."""
    with capture(comparison.model, [layer.name], differentiable=True) as outputs:
        predictions = comparison.predict(batch)
    if not predictions.requires_grad:
        raise ModelError(
            f"the output does not depend on layer {layer.name!r}; choose a layer on the path to the output"
        )
    (gradients,) = torch.autograd.grad(predictions[:count].sum(), outputs[layer.name])
    return outputs[layer.name].detach(), gradients[:count], predictions.detach()


@dataclass(frozen=True, kw_only=True)
class GradCam(_Cam):
    """Grad-CAM of one layer against the reference, signed, in margin units.

    The relevance of a cell is sum over c of alpha_c (A_c(x) - A_c(b)), alpha_c the mean over space of df/dA_c at x,
    which for a head linear in the mean over space adds up to f(x) - f(b) exactly, whatever the bias. A regressor's
    negative evidence is evidence, so the ReLU of the published map is left out.

    References
    ----------
    Selvaraju et al., *Grad-CAM: Visual explanations from deep networks via gradient-based localization*, ICCV 2017,
    eqs. 1 and 2.
    """

    method: ClassVar[str] = "grad-cam"

    @staticmethod
    def cells(activations: _Maps, gradients: _Maps) -> _Cells:
        """Sum over c of alpha_c A_c."""
        return (gradients.mean(dim=(2, 3), keepdim=True) * activations).sum(dim=1)


@dataclass(frozen=True, kw_only=True)
class HiResCam(_Cam):
    """HiResCAM of one layer against the reference, signed, in margin units.

    As Grad-CAM, but each cell is weighted by its own gradient, so that the map shows where the layers behind look. With
    the mean over space as head the two are the same. Options are those of `GradCam`.

    References
    ----------
    Draelos and Carin, *Use HiResCAM instead of Grad-CAM for faithful explanations of convolutional neural networks*,
    2020, eq. 3.
    """

    method: ClassVar[str] = "hires-cam"

    @staticmethod
    def cells(activations: _Maps, gradients: _Maps) -> _Cells:
        """Sum over c of df/dA_c A_c."""
        return (gradients * activations).sum(dim=1)


@dataclass(frozen=True, kw_only=True)
class LayerCam(_Cam):
    """LayerCAM of one layer against the reference, signed, in margin units.

    The published map keeps the cells and channels whose gradient is positive, those that raise a class. A regressor's
    prediction may have fallen, so kept are those whose gradient points the way the prediction went: with
    s = sign(f(x) - f(b)) the map is s sum over c of relu(s df/dA_c) (A_c(x) - A_c(b)). The rest is left out, so the map
    adds up to nothing in particular and has no completeness gap. Options are those of `GradCam`.

    References
    ----------
    Jiang et al., *LayerCAM: Exploring hierarchical class activation maps for localization*, IEEE TIP 2021, eqs. 4 to 6,
    without the ReLU of eq. 6.
    """

    method: ClassVar[str] = "layer-cam"
    one_sided: ClassVar[bool] = True

    @staticmethod
    def cells(activations: _Maps, gradients: _Maps) -> _Cells:
        """Sum over c of relu(df/dA_c) A_c."""
        return (torch.relu(gradients) * activations).sum(dim=1)
