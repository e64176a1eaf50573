"""Class activation maps that keep their sign, and the activations that they weigh."""

import weakref
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import partial
from itertools import groupby, pairwise
from typing import ClassVar, NamedTuple, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.errors import ModelError
from sliplens.explainers.attribution import Attribution, check_slopes, scale_to, spread
from sliplens.explainers.contract import Comparison, Method, frozen, require_at_least_one
from sliplens.progress import report_each


@contextmanager
def capture(model: nn.Module, names: Sequence[str], *, differentiable: bool = False) -> Iterator[dict[str, Tensor]]:
    """Record the output of each named module in every forward pass made inside, by name.

    Names are those of `model.named_modules()`; of a module called twice the last output counts. `differentiable`
    starts the graph anew at each recorded output: of several modules only the last one's gradient is whole.
    """
    outputs: dict[str, Tensor] = {}
    modules = dict(model.named_modules())

    def keep(name: str, _module: nn.Module, _arguments: object, output: Tensor) -> Tensor:
        outputs[name] = output.detach().requires_grad_(differentiable)
        # the rest of the network gets a copy: an in-place ReLU would overwrite the record
        return outputs[name].clone()

    with ExitStack() as stack:
        for name in names:
            stack.callback(modules[name].register_forward_hook(partial(keep, name)).remove)
        yield outputs


Shape: TypeAlias = tuple[int, int, int]
"""Channels, rows and columns of a map."""


class Layer(NamedTuple):
    """A module whose output is a map."""

    name: str
    """Its name in `model.named_modules()`."""
    shape: Shape

    @property
    def channels(self) -> int:
        """Channels of the map."""
        return self.shape[0]


class _Call(NamedTuple):
    """One call of a module, with the calls made inside it in the order in which they ran."""

    name: str
    module: nn.Module
    input_shape: Shape | None
    output_shape: Shape | None
    inner: "list[_Call]"


def find_layers(
    model: nn.Module, images: Float[Tensor, "batch colours height width"], *, names: Sequence[str] | None = None
) -> tuple[Layer, ...]:
    """Find the layers to explain, in the order in which they run: fine to coarse in the usual network.

    The network is run once, with one image, and its main path followed, not into blocks and their branches but into
    plain `Sequential` containers, wrappers whose output is no map, and blocks that shrink the map by more than two.
    Each resolution and width gives its last map; layers without parameters (pooling) and 1 x 1 maps are left out. For
    TorchVision's ShuffleNetV2 these are conv1, stage2, stage3, stage4 and conv5. With `names`, as
    `model.named_modules()` has them, those modules are taken instead.

    Raises
    ------
    ModelError
        If a name is unknown or its module gives no map, or if the network has no layer with a map, or maps with the
        channels last, such as a Swin transformer.
    """
    root = _record(model, images)
    path = _main_path(root)
    layers = _distinct(path)
    if names is None and any(_is_channels_last(step) for step in path):
        raise ModelError(
            f"{type(model).__name__} has maps with their channels last, which methods of the CAM family do not take; "
            "use integrated-gradients, smooth-grad, occlusion or shapley"
        )
    if names is not None:
        return _named(model, root, names, others=layers)
    if not layers:
        raise ModelError(
            f"{type(model).__name__} has no layer with a spatial map for images of {images.shape[-2]} x "
            f"{images.shape[-1]} pixels; use larger images, a convolutional network, or integrated gradients"
        )
    return layers


def cached_layers(
    model: nn.Module, images: Float[Tensor, "batch colours height width"], *, names: Sequence[str] | None = None
) -> tuple[Layer, ...]:
    """Return the layers that `find_layers` finds, cached per model, image size and names: its pass is expensive."""
    modules = tuple((name, weakref.ref(module)) for name, module in model.named_modules())
    key = (modules, tuple(images.shape[1:]), None if names is None else tuple(names))
    entry = _LAYER_CACHE.get(model)
    if entry is None or entry[0] != key:
        _LAYER_CACHE[model] = entry = (key, find_layers(model, images, names=names))
    return entry[1]


_LAYER_CACHE: weakref.WeakKeyDictionary[nn.Module, tuple[object, tuple[Layer, ...]]] = weakref.WeakKeyDictionary()


def find_published_layers(model: nn.Module, images: Float[Tensor, "batch colours height width"]) -> tuple[Layer, ...]:
    """Find the layers of the public code: every module that ends just before the size of the output changes.

    Modules are listed as they end, insides before their block: the size goes down and up again inside a block with two
    branches, and the last layer is missed, since what follows it is no map.

    Public code of Poly-CAM, `find_layer_list`.
    """
    ended = [(call.name, call.output_shape) for call in _finished(_record(model, images))]
    layers: dict[str, Layer] = {}
    for (name, shape), (_, following) in pairwise(ended):
        if shape is None and following is None:
            continue
        if shape is None or following is None:
            break  # the public code stops at what flattens
        if following[1:] != shape[1:]:
            layers[name] = Layer(name, shape)
            if following[1:] == (1, 1):
                break
    if not layers:
        raise ModelError(
            f"{type(model).__name__} has no layer where the size of the map changes, which score='thesis' looks for; "
            "name layers"
        )
    return tuple(layers.values())


def _record(model: nn.Module, images: Tensor) -> _Call:
    """Run the network and return the tree of its module calls."""
    finished: list[_Call] = []  # those whose caller is still at work
    begun: list[int] = []

    def leave(name: str, module: nn.Module, arguments: tuple[object, ...], output: object) -> None:
        first = begun.pop()
        shapes = (_map_shape(arguments[0] if arguments else None), _map_shape(output))
        finished[first:] = [_Call(name, module, *shapes, finished[first:])]

    with ExitStack() as stack, torch.no_grad(), frozen(model):
        for name, module in model.named_modules():
            stack.callback(module.register_forward_pre_hook(lambda *_: begun.append(len(finished))).remove)
            stack.callback(module.register_forward_hook(partial(leave, name)).remove)
        model(images[:1])
    return finished[0]


def _map_shape(value: object) -> Shape | None:
    if not isinstance(value, Tensor) or value.ndim != 4:
        return None
    channels, height, width = value.shape[1:]
    return channels, height, width


def _is_spatial(shape: Shape | None) -> bool:
    return shape is not None and shape[1] * shape[2] > 1


def _is_channels_last(call: _Call) -> bool:
    """Return True if the layer that made a map, the last one with weights, works along its last axis."""
    makers = [
        type(step.module)
        for step in _finished(call)
        if step.output_shape is not None
        and (type(step.module).__name__ == "Permute" or next(step.module.parameters(recurse=False), None) is not None)
    ]
    return bool(makers) and makers[-1] in {nn.LayerNorm, nn.Linear}


def _main_path(call: _Call) -> list[_Call]:
    # the exact forward: a subclass that overrides it may do more than run its items in a row
    is_sequence = type(call.module).forward is nn.Sequential.forward
    if not (call.name == "" or is_sequence or call.output_shape is None or _shrinks_repeatedly(call)):
        return [call]
    steps = [step for inner in call.inner for step in _main_path(inner)]
    if steps and is_sequence and call.name and call.output_shape is not None:
        steps[-1] = steps[-1]._replace(name=call.name)  # the same tensor under the name people know
    return steps


def _shrinks_repeatedly(call: _Call) -> bool:
    if not call.inner or call.input_shape is None or call.output_shape is None:
        return False
    return call.input_shape[1] > 2 * call.output_shape[1] + 1 or call.input_shape[2] > 2 * call.output_shape[2] + 1


def _distinct(steps: list[_Call]) -> tuple[Layer, ...]:
    layers = []
    for shape, group in groupby(steps, key=lambda step: step.output_shape):
        members = list(group)
        has_parameters = any(next(step.module.parameters(), None) is not None for step in members)
        if shape is not None and _is_spatial(shape) and has_parameters:
            layers.append(Layer(members[-1].name, shape))
    return tuple(layers)


def _named(model: nn.Module, root: _Call, names: Sequence[str], *, others: tuple[Layer, ...]) -> tuple[Layer, ...]:
    """Find modules by name, each where it ended last."""
    shapes: dict[str, Shape | None] = {}
    for call in _finished(root):
        shapes.pop(call.name, None)
        shapes[call.name] = call.output_shape
    available, choices = [name for name, _ in model.named_modules() if name], [layer.name for layer in others]
    for name in names:
        if name not in available:
            choices = dict.fromkeys([*choices, *get_close_matches(name, available, n=3)])
            raise ModelError(
                f"{type(model).__name__} has no layer {name!r}; choose among {', '.join(choices)} "
                "or another name of model.named_modules()"
            )
        if not _is_spatial(shapes.get(name)):
            raise ModelError(f"layer {name!r} gives no spatial map; choose among {', '.join(choices) or 'none'}")
    if not names:
        raise ModelError("the list of layers is empty; name at least one, or pass None to have them found")
    return tuple(Layer(name, shape) for name, shape in shapes.items() if shape is not None and name in names)


def _finished(call: _Call) -> Iterator[_Call]:
    for inner in call.inner:
        yield from _finished(inner)
    yield call


_Maps: TypeAlias = Float[Tensor, "batch channels rows columns"]
_Cells: TypeAlias = Float[Tensor, "batch rows columns"]


@dataclass(frozen=True, kw_only=True)
class _Cam(Method):
    """One layer's cells, weighted by the gradient at the image; the map is bilinear between them and keeps their total.

    The published maps weigh the activations A(x), which for a regressor are mostly the level that every image has. What
    sets x apart from the reference is the contrast A(x) - A(b), weighted by the same gradient.
    """

    layer: str | None = None
    """Name of the layer; by default the last one with a map (`find_layers`)."""
    contrast: bool = True
    """Take the reference's activations off. False gives the published map, which does not depend on the reference and
    has no completeness gap; the reference then only decides what `saliency` shows."""
    relu: bool = False
    """Keep the cells above zero alone, as published: those that raise the prediction, whichever way it went. Their map
    is then scaled to add up to |f(x) - f(b)|, a convention; its pixels are ranked and shown in the published order."""
    batch_size: int = 32

    one_sided: ClassVar[bool] = False
    """True if only gradients along the change of the prediction count."""

    @staticmethod
    @abstractmethod
    def cells(activations: _Maps, gradients: _Maps) -> _Cells:
        """Compute the relevance of the layer's cells in margin units, before any ReLU."""

    def __post_init__(self) -> None:
        require_at_least_one(type(self).__name__, batch_size=self.batch_size)

    def _explain(self, comparison: Comparison) -> Attribution:
        try:
            names = None if self.layer is None else (self.layer,)
            layer = cached_layers(comparison.model, comparison.images[:1], names=names)[-1]
        except ModelError:
            _ = comparison.change  # a model that gives no number has a greater fault than one without layers
            raise
        maps, predictions, reference_predictions = [], [], []
        empty = reference_prediction = torch.empty(0)
        parts = torch.arange(len(comparison.images)).split(self.batch_size)
        for part in report_each(parts, sizes=[len(part) for part in parts]):
            # images and references in one pass; a reference shared by all images passes once
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
        comparison = comparison.with_predictions(torch.cat(predictions), torch.cat(reference_predictions))
        relevance = scale_to(torch.cat(maps), total=comparison.change.abs()) if self.relu else torch.cat(maps)
        attribution = comparison.attribution(
            relevance,
            complete=self.contrast and not self.one_sided and not self.relu,
            target=f"{'f(x) - f(reference)' if self.contrast else 'f(x)'}, through layer {layer.name}",
            warnings=check_slopes(
                relevance.abs().sum(dim=(1, 2)).tolist(), change=comparison.change.tolist(), close=comparison.close
            ),
        )
        return replace(attribution, raises_only=self.relu)


def _differentiate(comparison: Comparison, batch: Tensor, *, count: int, layer: Layer) -> tuple[Tensor, Tensor, Tensor]:
    """Compute activations, gradients of the first `count` predictions in them, and predictions of a batch."""
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
    which for a head linear in the mean over space adds up to f(x) - f(b) exactly. A regressor's negative evidence is
    evidence, so the ReLU of the published map is left out.

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
    """HiResCAM: Grad-CAM with each cell weighted by its own gradient.

    With the mean over space as head the two are the same.

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
    """LayerCAM: HiResCAM of the gradients that point the way the prediction went.

    With s = sign(f(x) - f(b)) the map is s sum over c of relu(s df/dA_c) (A_c(x) - A_c(b)); the published one keeps
    the gradients above zero, those that raise a class. It adds up to nothing in particular.

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
