"""Many forward passes of one network, by the fastest engine at hand that answers as the network does."""

import hashlib
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.errors import InputError, ModelError
from sliplens.export.extras import import_openvino, missing_packages
from sliplens.export.folding import fold_batch_norm

PARITY = 1e-5
"""How far an engine's answer may lie from the network's own, times its size where that is above 1: float32 sums in
another order move an answer by a tenth of it, and channels of one layer differ by a hundred times as much."""
WORTH_FOLDING, WORTH_CONVERTING = 100, 1500
"""Passes of a network, those of earlier calls included, from which it pays to prepare an engine: folding takes as long
as 20 passes, a conversion as 1000."""

Run = Callable[[Iterable[Tensor]], Iterator[Tensor]]


@dataclass(frozen=True, kw_only=True)
class Passes:
    """A network ready for many passes; valid while the network is held still."""

    engine: str
    """`plain`, `folded` or `openvino`."""
    batch_size: int
    """Images in a batch; the last one may be shorter."""
    run: Run
    """Predictions (batch,) of batches of images, in their order, a few of them under way at once."""


def prepare(
    model: nn.Module,
    images: Float[Tensor, "batch 3 height width"],
    predictions: Float[Tensor, " batch"],
    *,
    passes: int,
    engine: str = "auto",
    batch_size: int | None = None,
) -> Passes:
    """Make a network ready for many passes without gradients, and check that it answers as before.

    Parameters
    ----------
    model
        Network in evaluation mode, one number an image.
    images, predictions
        Images of the size to come, and what the network says of them: an engine that says anything else is not used.
    passes
        How many there will be: an engine that would not pay for its preparation is not used by `auto`.
    engine
        `plain`, the network as it is; `folded`, batch normalisation folded into the convolutions; `openvino`, that
        converted to OpenVINO; `auto`, the last of them that can be used.
    batch_size
        Images in a batch; None for what suits the engine.

    Raises
    ------
    InputError
        If there is no such engine, or it is asked for by name and cannot be used here.
    ModelError
        If an engine that is asked for by name cannot run the network, or answers otherwise.
    """
    if engine not in {"auto", *_BUILDERS}:
        raise InputError(f"there is no engine named {engine!r} for passes; choose auto, {', '.join(_BUILDERS)}")
    _SPENT[model] = spent = _SPENT.get(model, 0) + passes
    names = [engine] if engine != "auto" else [name for name in _BUILDERS if spent >= _WORTH[name]]
    for name in names:
        obstacle = _obstacle(name, model, images)
        if obstacle is not None:
            if engine != "auto":
                raise InputError(f"the engine {name} cannot be used: {obstacle}")
            continue
        try:
            ready = Passes(
                engine=name,
                batch_size=batch_size or _batch_size(name, images),
                run=_BUILDERS[name](model, images, batch_size or _batch_size(name, images)),
            )
            if name == "plain":
                return ready  # it is what the predictions came from
            found = torch.cat(list(ready.run(images.split(ready.batch_size))))
            if agrees(found, predictions):
                return ready
            reason = f"its answers differ by {float((found - predictions).abs().max()):.2g}"
        except Exception as error:
            # whatever a converter cannot do, the network itself still can
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        if engine != "auto":
            raise ModelError(f"the engine {name} cannot run {type(model).__name__} ({reason}); choose auto")
    raise AssertionError  # plain has no obstacle


def agrees(found: Float[Tensor, " batch"], expected: Float[Tensor, " batch"]) -> bool:
    """Whether an engine's answers are the network's own, but for rounding."""
    return bool(((found - expected).abs() <= PARITY * expected.abs().clamp_min(1)).all())


def _batch_size(name: str, images: Tensor) -> int:
    if images.device.type != "cpu":
        return 256  # a graphics card wants to be filled
    if name != "openvino":
        return 64
    # measured on two cores: 16 images of 112 px and 4 of 224 px are the fastest, more of them leave the caches
    return min(16, max(4, 16 * 112**2 // (images.shape[-2] * images.shape[-1])))


def _obstacle(name: str, model: nn.Module, images: Tensor) -> str | None:
    if name == "plain":
        return None
    if any(_has_hooks(module) for module in model.modules()):
        return "the model has hooks, which may change what it says; take them off"
    if name == "openvino":
        if images.device.type != "cpu" or images.dtype != torch.float32:
            return f"it runs float32 on the processor, not {images.dtype} on {images.device.type}; choose folded"
        if missing_packages("openvino"):
            return 'openvino is not installed; `pip install "sliplens[openvino]"`'
    return None


def _has_hooks(module: nn.Module) -> bool:
    return bool(module._forward_hooks or module._forward_pre_hooks)


def _plain(model: nn.Module, _: Tensor, batch_size: int) -> Run:  # noqa: ARG001 (a row of the table)
    def run(batches: Iterable[Tensor]) -> Iterator[Tensor]:
        for batch in batches:
            # convolutions on a CPU then need no reordering
            yield model(batch.contiguous(memory_format=torch.channels_last)).reshape(len(batch))

    return run


def _folded(model: nn.Module, images: Tensor, batch_size: int) -> Run:
    return _plain(fold_batch_norm(model), images, batch_size)


def _openvino(model: nn.Module, images: Tensor, batch_size: int) -> Run:
    key = (tuple(images.shape[1:]), batch_size, torch.get_num_threads(), _hash_weights(model))
    known = _CONVERTED.get(model)
    if known is None or known[0] != key:
        _CONVERTED[model] = known = (key, _convert(model, images, batch_size))
    network = known[1]

    def run(batches: Iterable[Tensor]) -> Iterator[Tensor]:
        # one more than can be worked on: the next batch is made while all cores are busy
        idle = [network.create_infer_request() for _ in range(torch.get_num_threads() + 1)]
        busy: deque[tuple[Any, Tensor, int]] = deque()

        def finish() -> Tensor:
            request, _, length = busy.popleft()
            request.wait()
            idle.append(request)
            # its own memory is written anew by the next call
            return torch.from_numpy(request.get_output_tensor(0).data.copy()).flatten()[:length]

        for batch in batches:
            if not idle:
                yield finish()
            full = batch if len(batch) == batch_size else torch.cat([batch, batch.new_zeros(_rest(batch, batch_size))])
            full = full.contiguous()
            request = idle.pop()
            request.start_async({0: full.numpy()}, share_inputs=True)
            busy.append((request, full, len(batch)))  # the tensor too: the request reads its memory
        while busy:
            yield finish()

    return run


def _rest(batch: Tensor, batch_size: int) -> tuple[int, ...]:
    return (batch_size - len(batch), *batch.shape[1:])


def _convert(model: nn.Module, images: Tensor, batch_size: int) -> Any:
    openvino = import_openvino()
    shape = (batch_size, *images.shape[1:])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch and OpenVINO about each other; the answers are checked
        converted = openvino.convert_model(
            fold_batch_norm(model), example_input=images.new_zeros(shape), input=[openvino.PartialShape(shape)]
        )
    threads = torch.get_num_threads()
    settings = {
        # one batch to a core: together they would wait for each other in every layer
        "NUM_STREAMS": threads,
        "INFERENCE_NUM_THREADS": threads,
        # pinned, the threads of two processes share the first core and leave the second idle
        "ENABLE_CPU_PINNING": False,
        "INFERENCE_PRECISION_HINT": "f32",  # where the processor knows bfloat16 that is the default, at 3 digits
    }
    return openvino.Core().compile_model(converted, "CPU", settings)


def _hash_weights(model: nn.Module) -> str:
    digest = hashlib.blake2b()
    for name, tensor in model.state_dict().items():
        digest.update(name.encode())
        digest.update(tensor.detach().contiguous().flatten().view(torch.uint8).numpy())
    return digest.hexdigest()


_BUILDERS: dict[str, Callable[[nn.Module, Tensor, int], Run]] = {
    "openvino": _openvino,
    "folded": _folded,
    "plain": _plain,
}
_WORTH = {"openvino": WORTH_CONVERTING, "folded": WORTH_FOLDING, "plain": 0}
_SPENT: WeakKeyDictionary[nn.Module, int] = WeakKeyDictionary()
"""Passes that each network was asked for so far: frames are explained one by one."""
_CONVERTED: WeakKeyDictionary[nn.Module, tuple[tuple[Any, ...], Any]] = WeakKeyDictionary()
"""The last conversion of each network."""
