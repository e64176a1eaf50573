"""Engines: run a network many times, by torch or by OpenVINO, each checked against the network itself."""

import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.errors import InputError, ModelError
from sliplens.extras import import_openvino, missing_packages
from sliplens.models.backbones import Answers, RunBatches, answer_names
from sliplens.models.checkpoint import Network, hash_weights
from sliplens.models.onnx import TOLERANCE, difference, trial_inputs

ENGINES = ("torch", "openvino")
"""Names of the engines. `torch` runs the network itself; `openvino` a copy converted for the processor."""
_CONVERSION_PAYS_AFTER = 1000
"""Passes from which `auto` takes OpenVINO: measured, it takes 2 to 5 s to convert and saves 3 to 15 ms a pass."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """A network ready to be run; valid while the network stays as it is."""

    name: str
    """`torch` or `openvino`."""
    batch_size: int
    """Images in a batch; the last one may be shorter."""
    answers: RunBatches
    """Outputs of `Answers` for batches of images; OpenVINO works on a few batches at once."""

    def run(self, batches: Iterable[Tensor]) -> Iterator[Float[Tensor, " batch"]]:
        """Predict the safety margins of batches of images, in their order."""
        return (margins for margins, *_ in self.answers(batches))


_EXPECTED: ContextVar[int | None] = ContextVar("expected_passes", default=None)


@contextmanager
def expecting(passes: int) -> Iterator[None]:
    """Choose the engines of the enclosed work by its number of passes in all, not by that of each call.

    Engines differ in the last digits: work done in parts, interrupted or not, has the same bytes only where every part
    takes the same engine.
    """
    token = _EXPECTED.set(passes)
    try:
        yield
    finally:
        _EXPECTED.reset(token)


def prepare(
    model: nn.Module,
    images: Float[Tensor, "batch colours height width"],
    *,
    passes: int,
    engine: str = "auto",
    batch_size: int | None = None,
    streams: int | None = None,
    layer: str | None = None,
) -> Engine:
    """Make an engine for a network, and check that it predicts some images as the network does.

    Parameters
    ----------
    images
        Images of the size to come, on the network's device.
    passes
        Number of images to come, for `auto`; within `expecting` that number counts where it is larger.
    engine
        One of `ENGINES`; `auto` takes OpenVINO where it is installed, the network runs on the processor and its
        conversion pays, else torch.
    streams
        Batches that OpenVINO works on at once, by one thread each; by default one a thread, the fastest for many
        passes. With 1 all threads share one batch, which answers soonest.
    layer
        Layer of the network whose features come last among the outputs (`Answers`).
    """
    if engine not in {"auto", *ENGINES}:
        raise InputError(f"there is no engine named {engine!r}; choose one of auto, {', '.join(ENGINES)}")
    passes, obstacle = max(passes, _EXPECTED.get() or 0), find_obstacle(model, images)
    # a graphics card wants to be filled; on a processor a batch should fit the caches
    size = batch_size or (16 if images.device.type == "cpu" else 256)
    plain = Engine(name="torch", batch_size=size, answers=Answers(model, layer).run)
    if engine == "openvino" and obstacle is not None:
        raise InputError(f"the engine openvino cannot be used: {obstacle}")
    if engine == "openvino" or (engine == "auto" and obstacle is None and passes >= _CONVERSION_PAYS_AFTER):
        try:
            converted = _openvino_engine(model, images, batch_size=batch_size, streams=streams, layer=layer)
            answers, expected = (
                torch.cat(list(each.run(images.split(each.batch_size)))) for each in (converted, plain)
            )
            error = difference(answers.numpy(), expected.numpy())
            if error <= TOLERANCE:
                return converted
            reason = f"its predictions differ by {error:.2g}, {TOLERANCE:g} is allowed"
        except Exception as error:  # whatever the converter cannot do, torch still can
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        if engine == "openvino":
            raise ModelError(f"the engine openvino cannot run {type(model).__name__} ({reason}); choose torch")
    return plain


def make_engine(
    name: str, network: Network, *, frames: int = 1, batch_size: int = 8, streams: int | None = None
) -> Engine:
    """Make an engine for a trained network, and check it on black, white and noise.

    `name` is one of `ENGINES`, or `auto`, which decides by `frames`, the number of frames to come; a running camera
    wants a batch of 1 and a stream of 1.

    Examples
    --------
    >>> import torch
    >>> import sliplens as sl
    >>> from sliplens.models.engines import make_engine
    >>> network = sl.load("chromatouch-pair")
    >>> engine = make_engine("torch", network, batch_size=2)
    >>> network.estimate(torch.zeros(3, 6, 112, 112), engine=engine).margin.shape
    (3,)
    """
    *_, images = trial_inputs(network)
    return prepare(
        network.model,
        images.to(network.device),
        passes=frames,
        engine=name,
        batch_size=batch_size,
        streams=streams,
        layer=network.feature_layer,
    )


def find_obstacle(model: nn.Module, images: Tensor) -> str | None:
    """Return why OpenVINO cannot run a network on such images, with the cure; None if it can."""
    if any(module._forward_hooks or module._forward_pre_hooks for module in model.modules()):
        return "the model has hooks, which may change its output; remove them, or choose torch"
    if images.dtype != torch.float32:
        return f"it runs float32, not {images.dtype}; choose torch"
    if images.device.type != "cpu":
        return f"it runs on the processor, not on {images.device.type}; leave out the device, or choose torch"
    missing = missing_packages("openvino", extra="openvino")
    return f"it needs {missing}" if missing else None


_CONVERTED: WeakKeyDictionary[nn.Module, tuple[tuple[object, ...], Engine]] = WeakKeyDictionary()
"""Last conversion of each network, with its settings and the hash of the weights. It saves time and decides nothing;
it must not hold the network itself, which would never be freed."""


def _openvino_engine(
    model: nn.Module, images: Tensor, *, batch_size: int | None, streams: int | None, layer: str | None
) -> Engine:
    """Convert a network, unless it was converted with these settings and weights before."""
    # measured on two cores: 16 images of 112 px and 4 of 224 px are the fastest, more of them leave the caches
    batch_size = batch_size or min(16, max(4, 16 * 112**2 // (images.shape[-2] * images.shape[-1])))
    threads = torch.get_num_threads()
    settings = (batch_size, streams, layer, threads, tuple(images.shape[1:]), hash_weights(model))
    if model not in _CONVERTED or _CONVERTED[model][0] != settings:
        openvino = import_openvino()
        shape = (batch_size, *images.shape[1:])
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # of torch and OpenVINO about each other; the answers are checked
            converted = openvino.convert_model(
                Answers(model, layer).eval(),
                example_input=torch.zeros(shape),
                input=[openvino.PartialShape(shape)],
            )
        streams = streams or threads
        options = {
            "NUM_STREAMS": streams,
            "INFERENCE_NUM_THREADS": max(threads, streams),
            # pinned, the threads of two processes share the first core and leave the second idle
            "ENABLE_CPU_PINNING": False,
            "INFERENCE_PRECISION_HINT": "f32",  # where the processor has bfloat16 that is the default, at 3 digits
        }
        compiled = openvino.Core().compile_model(converted, "CPU", options)
        idle = [compiled.create_infer_request() for _ in range(2 * streams)]
        outputs = len(answer_names(model, layer))

        def submit(batch: Tensor) -> Callable[[], tuple[Tensor, ...]]:
            padding = batch.new_zeros(batch_size - len(batch), *batch.shape[1:])
            full = torch.cat([batch, padding]).contiguous() if len(padding) else batch.contiguous()
            request = idle.pop() if idle else compiled.create_infer_request()  # an interrupted run returns none
            request.start_async({0: full.numpy()}, share_inputs=True)

            def answers(_: Tensor = full) -> tuple[Tensor, ...]:  # the tensor too: the request reads its memory
                request.wait()
                # its own memory is written anew by the next call
                copies = [torch.from_numpy(request.get_output_tensor(at).data.copy()) for at in range(outputs)]
                idle.append(request)
                return tuple(copy[: len(batch)] for copy in copies)

            return answers

        def run(batches: Iterable[Tensor]) -> Iterator[tuple[Tensor, ...]]:
            # two a stream: whoever encodes batches may have to wait for a core, and the streams must not
            waiting: deque[Callable[[], tuple[Tensor, ...]]] = deque()
            for batch in batches:
                waiting.append(submit(batch))
                if len(waiting) == 2 * streams:
                    yield waiting.popleft()()
            while waiting:
                yield waiting.popleft()()

        _CONVERTED[model] = settings, Engine(name="openvino", batch_size=batch_size, answers=run)
    return _CONVERTED[model][1]
