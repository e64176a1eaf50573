"""Class activation maps that keep their sign, and the activations that they weigh."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import groupby, pairwise
from typing import ClassVar, NamedTuple, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.errors import ModelError
from sliplens.explainers.attribution import Attribution, scale_to, spread
from sliplens.explainers.contract import BATCH, Comparison, Method, frozen
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


class _Call(NamedTuple):
    """One call of a module, with the calls made inside it in the order in which they ran."""

    name: str
    module: nn.Module
    input_shape: Shape | None
    output_shape: Shape | None
    inner: "list[_Call]"


def find_layers(model: nn.Module, images: Float[Tensor, "batch colours height width"]) -> dict[str, Shape]:
    """Find the layers to explain, in the order in which they run: fine to coarse in the usual network.

    Names are those of `model.named_modules()`. The network is run once, with one image, and its main path followed, not
    into blocks and their branches but into plain `Sequential` containers, wrappers whose output is no map, and blocks
    that shrink the map by more than two. Each resolution and width gives its last map; layers without parameters
    (pooling) and 1 x 1 maps are left out. For TorchVision's ShuffleNetV2 these are conv1, stage2, stage3, stage4 and
    conv5.

    Raises
    ------
    ModelError
        If the network has no layer with a map, or maps with the channels last, such as a Swin transformer.
    """
    path, layers = _main_path(_record(model, images)), dict[str, Shape]()
    if any(_is_channels_last(step) for step in path):
        raise ModelError(
            f"{type(model).__name__} has maps with their channels last, which methods of the CAM family do not take; "
            "use integrated-gradients, smooth-grad, occlusion or shapley"
        )
    for shape, group in groupby(path, key=lambda step: step.output_shape):
        members = list(group)
        has_parameters = any(next(step.module.parameters(), None) is not None for step in members)
        if shape is not None and shape[1] * shape[2] > 1 and has_parameters:
            layers[members[-1].name] = shape
    if not layers:
        raise ModelError(
            f"{type(model).__name__} has no layer with a spatial map for images of {images.shape[-2]} x "
            f"{images.shape[-1]} pixels; use larger images, a convolutional network, or integrated gradients"
        )
    return layers


def find_published_layers(model: nn.Module, images: Float[Tensor, "batch colours height width"]) -> dict[str, Shape]:
    """Find the layers of the public code: every module that ends just before the size of the output changes.

    Modules are listed as they end, insides before their block: the size goes down and up again inside a block with two
    branches, and the last layer is missed, since what follows it is no map.

    Public code of Poly-CAM, `find_layer_list`.
    """
    ended = [(call.name, call.output_shape) for call in _finished(_record(model, images))]
    layers: dict[str, Shape] = {}
    for (name, shape), (_, following) in pairwise(ended):
        if shape is None and following is None:
            continue
        if shape is None or following is None:
            break  # the public code stops at what flattens
        if following[1:] != shape[1:]:
            layers[name] = shape
            if following[1:] == (1, 1):
                break
    if not layers:
        raise ModelError(
            f"{type(model).__name__} has no layer where the size of the map changes, which poly-cam-thesis looks for; "
            "use poly-cam"
        )
    return layers


def _record(model: nn.Module, images: Tensor) -> _Call:
    """Run the network and return the tree of its module calls."""
    if any(isinstance(module, torch.jit.ScriptModule) for module in model.modules()):
        raise ModelError(
            "the layers of a TorchScript module cannot be recorded; explain the module that it was made of, or use "
            "integrated-gradients, smooth-grad, occlusion or shapley"
        )
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
    before, after = call.input_shape, call.output_shape
    shrinks = call.inner and before and after and any(before[side] > 2 * after[side] + 1 for side in (1, 2))
    if not (call.name == "" or is_sequence or after is None or shrinks):
        return [call]
    steps = [step for inner in call.inner for step in _main_path(inner)]
    if steps and is_sequence and call.name and call.output_shape is not None:
        steps[-1] = steps[-1]._replace(name=call.name)  # the same tensor under the name people know
    return steps


def _finished(call: _Call) -> Iterator[_Call]:
    for inner in call.inner:
        yield from _finished(inner)
    yield call


_Maps: TypeAlias = Float[Tensor, "batch channels rows columns"]
_Cells: TypeAlias = Float[Tensor, "batch rows columns"]


@dataclass(frozen=True, kw_only=True)
class GradCam(Method):
    """Grad-CAM of the last layer with a map against the reference, signed, in margin units.

    The relevance of a cell is sum over c of alpha_c (A_c(x) - A_c(b)), alpha_c the mean over space of df/dA_c at x,
    which for a head linear in the mean over space adds up to f(x) - f(b) exactly. The published map weighs the
    activations A(x), which for a regressor are mostly the level that every image has, and its ReLU leaves out negative
    evidence. The map is bilinear between the cells and keeps their total.

    References
    ----------
    Selvaraju et al., *Grad-CAM: Visual explanations from deep networks via gradient-based localization*, ICCV 2017,
    eqs. 1 and 2.
    """

    method: ClassVar[str] = "grad-cam"
    published: bool = False
    """Weigh A(x) and keep the cells above zero, those that raise the prediction, whichever way it went. The map is then
    scaled to add up to |f(x) - f(b)|, a convention; its pixels are ranked and shown in the published order."""

    @staticmethod
    def cells(activations: _Maps, gradients: _Maps) -> _Cells:
        """Sum over c of alpha_c A_c, in margin units."""
        return (gradients.mean(dim=(2, 3), keepdim=True) * activations).sum(dim=1)

    def _explain(self, comparison: Comparison) -> Attribution:
        try:
            *_, layer = find_layers(comparison.model, comparison.images)
        except ModelError:
            _ = comparison.change  # a model that gives no number has a greater fault than one without layers
            raise
        shared, maps, predictions = len(comparison.references) == 1, [], []
        size = comparison.images.shape[-2], comparison.images.shape[-1]
        parts = comparison.images.split(BATCH)
        references = [comparison.references] * len(parts) if shared else comparison.references.split(BATCH)
        pairs = list(zip(parts, references, strict=True))
        for images, empty in report_each(pairs, sizes=[len(images) for images, _ in pairs]):
            # images and references in one pass
            with capture(comparison.model, [layer], differentiable=True) as outputs:
                both = comparison.predict(torch.cat([images, empty]))
            if not both.requires_grad:
                raise ModelError(f"the output of {type(comparison.model).__name__} does not depend on {layer!r}")
            (gradients,) = torch.autograd.grad(both[: len(images)].sum(), outputs[layer])
            activations, base = outputs[layer].detach().tensor_split([len(images)])
            prediction, low = both.detach().tensor_split([len(images)])
            contrast = activations if self.published else activations - base
            cells = self.cells(contrast, gradients[: len(images)])
            maps.append(spread(torch.relu(cells) if self.published else cells, size))
            predictions.append(torch.stack([prediction, low.expand_as(prediction)]))
        comparison.prediction, comparison.reference_prediction = torch.cat(predictions, dim=1)
        relevance = torch.cat(maps)
        if self.published:
            relevance = scale_to(relevance, total=comparison.change.abs())
        return comparison.attribution(
            relevance,
            complete=not self.published,
            target=f"{'f(x)' if self.published else 'f(x) - f(reference)'}, through layer {layer}",
            warnings=comparison.saturated(relevance.abs().sum(dim=(1, 2)).tolist()),
            raises_only=self.published,
        )
