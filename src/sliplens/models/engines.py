"""Engines: ways to run a network many times, by the fastest at hand that answers as the network itself does."""

import hashlib
import os
import shutil
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from threading import Barrier, Lock, get_ident
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor, fx, nn
from torch.fx.experimental.optimization import fuse
from torch.fx.proxy import TraceError

from sliplens.errors import InputError, ModelError
from sliplens.extras import ONNX_PACKAGES, Table, import_onnxruntime, import_openvino, missing_packages
from sliplens.friction import FrictionLike
from sliplens.models.backbones import Answers, HistogramRegressor, answer_names
from sliplens.models.checkpoint import Estimate, Network
from sliplens.models.onnx import INPUT, TOLERANCE, convert_network, difference, require_file_of, trial_inputs

RunBatches: TypeAlias = Callable[[Iterable[Tensor]], Iterator[tuple[Tensor, ...]]]
"""Answers to batches of images, as `Answers` gives them, in the order of the batches."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """A network ready to be run; valid while the network stays as it is."""

    name: str
    """Row of `ENGINES`."""
    batch_size: int
    """Images in a batch; the last one may be shorter."""
    answers: RunBatches
    """What `Answers` gives, of batches of images; a few batches are under way at once."""

    def run(self, batches: Iterable[Tensor]) -> Iterator[Float[Tensor, " batch"]]:
        """Safety margins of batches of images, in their order; a few batches are under way at once."""
        return (margins for margins, *_ in self.answers(batches))

    def estimate(
        self,
        trained: Network,
        inputs: Float[Tensor, "batch colours size size"] | Iterable[Tensor],
        *,
        friction: FrictionLike | None = None,
    ) -> Estimate:
        """Safety margins of images that the network of the engine has encoded, with how sure it is.

        `inputs`: all images, or batches of them, each of which may be made while the one before is read. `friction`:
        what is known of the coefficient of friction, as `predict` takes it.
        """
        batches = inputs.split(self.batch_size) if isinstance(inputs, Tensor) else inputs
        answers = zip(*self.answers(batches), strict=True)
        return trained.to_estimate(*(torch.cat(parts) for parts in answers), friction=friction)


@dataclass(frozen=True, kw_only=True)
class EngineJob:
    """What an engine is made for."""

    images: Float[Tensor, "batch colours height width"]
    """Images of the size to come, on the network's device."""
    batch_size: int
    streams: int
    """Batches that are worked on at once, by one thread each; with 1, all threads work on one batch."""
    layer: str | None = None
    """As `Answers` takes it."""
    onnx_file: Path | None = None
    """The network as `export_onnx` wrote it, if there is such a file."""


@dataclass(frozen=True, kw_only=True)
class EngineKind:
    """Way to run a network."""

    pays_after: int | None
    """Passes of a network from which it pays to prepare the engine; None for one that is taken by name alone."""
    build: Callable[[nn.Module, EngineJob], RunBatches]
    """Called with a network in evaluation mode, one number an image."""
    batch_size: Callable[[Float[Tensor, "batch colours height width"]], int] = (
        # a graphics card wants to be filled
        lambda images: 64 if images.device.type == "cpu" else 256
    )
    """Images in a batch that suit it."""
    obstacle: Callable[[torch.device], str | None] = lambda _: None
    """Why it cannot be used on a device, with the cure; None if it can."""


def prepare(
    model: nn.Module,
    images: Float[Tensor, "batch colours height width"],
    predictions: Float[Tensor, " batch"],
    *,
    passes: int,
    engine: str = "auto",
    batch_size: int | None = None,
    streams: int | None = None,
    layer: str | None = None,
    onnx_file: Path | None = None,
) -> Engine:
    """Make a network ready for many passes without gradients, and check that it answers as before.

    Parameters
    ----------
    model
        Network in evaluation mode, one number an image.
    images, predictions
        Images of the size to come, and what the network says of them: an engine that says anything else is not used.
    passes
        How many there will be. `auto` takes no engine that would not pay for its preparation; passes of earlier calls
        count, since frames are explained one by one, unless `counting_passes` says otherwise.
    engine
        Row of `ENGINES`, or `auto` for the fastest that can be used.
    batch_size
        Images in a batch; None for what suits the engine.
    streams
        Batches that are worked on at once, by one thread each; None for one a thread, which is fastest for many
        passes: threads that share a batch wait for each other in every layer. With 1 all threads work on one batch,
        which answers soonest.
    layer
        Of the network, whose features are told last (`Answers`).
    onnx_file
        The network as `export_onnx` wrote it, for `onnxruntime` and `openvino`; converted here if None.

    Raises
    ------
    InputError
        If there is no such engine, or it is asked for by name and cannot be used here.
    ModelError
        If an engine that is asked for by name cannot run the network, or answers otherwise.
    """
    expected = _EXPECTED.get(model)
    if expected is None:
        counted = _COUNTED.get()
        counted[model] = known = counted.get(model, 0) + passes
    else:
        known = max(expected, passes)
    paying = [name for name, kind in ENGINES.items() if kind.pays_after is not None and known >= kind.pays_after]
    paying = [name for name in ENGINES if name in paying or (onnx_file is not None and name in _CONVERTED)]
    for name in [engine] if engine != "auto" else reversed(paying):
        kind = ENGINES.pick(name)
        obstacle = _obstacle(name, kind, model, images)
        if obstacle is not None:
            if engine != "auto":
                raise InputError(f"the engine {name} cannot be used: {obstacle}")
            continue
        job = EngineJob(
            images=images,
            batch_size=batch_size or kind.batch_size(images),
            streams=streams or torch.get_num_threads(),
            layer=layer,
            onnx_file=onnx_file,
        )
        try:
            ready = Engine(name=name, batch_size=job.batch_size, answers=_build(name, kind, model, job))
            if name == "eager":
                return ready  # it is what the predictions came from
            found = torch.cat(list(ready.run(images.split(ready.batch_size))))
            off = difference(found.cpu().numpy(), predictions.cpu().numpy())
            if off <= TOLERANCE:
                return ready
            reason = f"its answers differ by {off:.2g}, {TOLERANCE:g} is allowed"
        except InputError:
            raise
        except Exception as error:
            # whatever a converter cannot do, the network itself still can
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        if engine != "auto":
            cure = "choose another engine" if onnx_file is None else f"export {onnx_file} again"
            raise ModelError(f"the engine {name} cannot run {type(model).__name__} ({reason}); {cure}")
    raise AssertionError  # eager has no obstacle


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch work in this thread alone, so that sums do not depend on the number of cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def expecting(model: nn.Module, passes: int) -> Iterator[None]:
    """Choose engines for so many passes in all, however many of them are made before, here or elsewhere.

    What is worked on in parts is so answered by one engine, whatever was made before.
    """
    before = _EXPECTED.get(model)
    _EXPECTED[model] = passes
    try:
        yield
    finally:
        if before is None:
            del _EXPECTED[model]
        else:
            _EXPECTED[model] = before


def make_engine(
    name: str,
    trained: Network,
    *,
    frames: int = 1,
    batch_size: int = 8,
    streams: int | None = None,
    onnx_file: Path | None = None,
) -> Engine:
    """Make a trained network ready to read frames, and check that it answers as before on black, white and noise.

    Parameters
    ----------
    name
        Row of `ENGINES`, or `auto` for the fastest that can be used.
    trained
        The network, on the device where it is to run.
    frames
        How many there will be, for `auto`: a few do not pay for a conversion.
    batch_size, streams
        As `prepare` takes them; a batch of 1 and a stream of 1 for a running camera.
    onnx_file
        The network as `export_onnx` wrote it, for `onnxruntime` and `openvino`; converted here if None.

    Raises
    ------
    InputError
        If there is no engine of that name, it cannot be used here, or the file is not of this network.
    ModelError
        If the engine cannot run the network, or answers otherwise.

    Examples
    --------
    >>> import torch
    >>> import sliplens as sl
    >>> from sliplens.models.engines import make_engine
    >>> network = sl.load("chromatouch-pair")
    >>> engine = make_engine("folded", network, batch_size=2)
    >>> engine.estimate(network, torch.zeros(3, 6, 112, 112)).margin.shape
    (3,)
    """
    if onnx_file is not None:
        require_file_of(onnx_file, trained)
    *_, images = trial_inputs(trained)
    with expecting(trained.model, frames):  # frames that were read before shape no answer
        return prepare(
            trained.model,
            images.to(trained.device),
            trained.predict(images).to(trained.device),
            passes=frames,
            engine=name,
            batch_size=batch_size,
            streams=streams,
            layer=trained.feature_layer,
            onnx_file=onnx_file,
        )


def fold_batch_norm(model: nn.Module) -> nn.Module:
    """A copy of a network in evaluation mode, its batch normalisation folded into the convolutions before it.

    With its statistics fixed, batch normalisation is an affine map of each channel, and so is what scales and shifts
    the kernels of the convolution before it. A network whose graph torch cannot trace comes back as a plain copy.

    Jacob et al., *Quantization and Training of Neural Networks for Efficient Integer-Arithmetic-Only Inference* (2018),
    eq. 14.
    """
    copied = deepcopy(model)
    if isinstance(copied, HistogramRegressor):
        copied.backbone = fold_batch_norm(copied.backbone)
        return copied
    if isinstance(copied, Answers):
        copied.watched = fold_batch_norm(copied.watched)  # pyright: ignore[reportAttributeAccessIssue]
        return copied
    try:
        with _TRACING:
            graph = _Tracer().trace(copied)
        folded = fuse(fx.GraphModule(copied, graph), inplace=True, no_trace=True)
    except (TraceError, TypeError, NotImplementedError):  # branches on values, or takes a tensor apart
        return copied
    # folding makes new kernels; channels last as `load_checkpoint` has them
    return folded.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


_TRACING = Lock()  # of two at once each would put back what the other one changed


class _Tracer(fx.Tracer):
    """Tracer that lets the networks of other threads run: while torch traces, it changes what all of them call."""

    def __init__(self) -> None:
        super().__init__()
        self._thread = get_ident()

    def call_module(
        self, m: nn.Module, forward: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> Any:
        """Note the call of a module of this thread, and let any other be."""
        if get_ident() != self._thread:
            return forward(*args, **kwargs)
        answer = super().call_module(m, forward, args, kwargs)
        if self.is_leaf_module(m, self.path_of_module(m)):  # it is not called, and so its hooks are not either
            for hook in m._forward_hooks.values():
                hook(m, args, answer)
        return answer


def _obstacle(name: str, kind: EngineKind, model: nn.Module, images: Tensor) -> str | None:
    if name != "eager" and any(module._forward_hooks or module._forward_pre_hooks for module in model.modules()):
        return "the model has hooks, which may change what it says; take them off"
    if name in _CONVERTED and images.dtype != torch.float32:
        return f"it runs float32, not {images.dtype}; choose folded"
    return kind.obstacle(images.device)


def _build(name: str, kind: EngineKind, model: nn.Module, job: EngineJob) -> RunBatches:
    if name == "eager":
        return kind.build(model, job)
    shape, threads = tuple(job.images.shape[1:]), torch.get_num_threads()
    own = (job.batch_size, job.streams, job.layer, job.onnx_file)
    key = (name, shape, job.images.device, threads, *own, _hash_weights(model))
    known = _BUILT.get(model)
    if known is None or known[0] != key:
        _BUILT[model] = known = (key, kind.build(model, job))
    return known[1]


def _hash_weights(model: nn.Module) -> str:
    digest = hashlib.blake2b()
    for name, tensor in model.state_dict().items():
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy())
    return digest.hexdigest()


_Counted: TypeAlias = WeakKeyDictionary[nn.Module, int]
_COUNTED: ContextVar[_Counted] = ContextVar("counted", default=WeakKeyDictionary())  # noqa: B039 (meant to be shared)
"""Passes that each network was asked for so far."""
_EXPECTED: WeakKeyDictionary[nn.Module, int] = WeakKeyDictionary()
"""Passes that are expected of a network in all, wherever they are made."""


@contextmanager
def counting_passes() -> Iterator[None]:
    """Count passes anew, so that what was run before, or was not as it was there already, chooses no engine.

    Engines differ in the last digits: work that goes on after an interruption has the bytes of the whole only where it
    takes the same ones.
    """
    token = _COUNTED.set(WeakKeyDictionary())
    try:
        yield
    finally:
        _COUNTED.reset(token)


_BUILT: WeakKeyDictionary[nn.Module, tuple[tuple[Any, ...], RunBatches]] = WeakKeyDictionary()
"""What was built last of each network; it must not hold the network itself, which would never die."""


def _compiler_obstacle(device: torch.device) -> str | None:
    # Triton brings its own
    if device.type != "cpu" or any(map(shutil.which, (os.environ.get("CXX", "g++"), "g++", "clang++", "cl"))):
        return None
    return "it needs a C++ compiler and there is none; install g++, or choose another engine"


def _needs(*packages: str, extra: str) -> Callable[[torch.device], str | None]:
    def obstacle(device: torch.device) -> str | None:
        if device.type != "cpu":
            return f"it runs on the processor, not on {device.type}; leave the device out, or choose folded"
        missing = missing_packages(*packages, extra=extra)
        return f"it needs {missing}" if missing else None

    return obstacle


def _torch(change: Callable[[Answers], Callable[..., Any]]) -> Callable[[nn.Module, EngineJob], RunBatches]:
    def build(model: nn.Module, job: EngineJob) -> RunBatches:
        network, device = change(Answers(model, job.layer)), job.images.device

        def run(batches: Iterable[Tensor]) -> Iterator[tuple[Tensor, ...]]:
            for batch in batches:
                with torch.no_grad():
                    # convolutions on a processor then need no reordering
                    answers = network(batch.to(device).contiguous(memory_format=torch.channels_last))
                yield answers

        return run

    return build


def _run_in_streams(submit: Callable[[Tensor], Callable[[], tuple[Tensor, ...]]], streams: int) -> RunBatches:
    """Begin a few batches at once; `submit` begins one and gives what waits for its answers."""

    def run(batches: Iterable[Tensor]) -> Iterator[tuple[Tensor, ...]]:
        # two a stream: whoever makes them may have to wait for a core, and the streams must not
        waiting: deque[Callable[[], tuple[Tensor, ...]]] = deque()
        for batch in batches:
            waiting.append(submit(batch))
            if len(waiting) == 2 * streams:
                yield waiting.popleft()()
        while waiting:
            yield waiting.popleft()()

    return run


def _folded(model: nn.Module, job: EngineJob) -> RunBatches:
    run = _torch(fold_batch_norm)(model, job)
    if job.streams == 1 or job.images.device.type != "cpu":
        return run
    # a sum that threads share is added in another order by each number of them: one thread a batch gives the same
    # bits on every number of cores
    workers = ThreadPoolExecutor(job.streams, thread_name_prefix="folded")
    every = Barrier(job.streams)

    def begin(_: int) -> None:
        torch.get_num_threads()  # makes torch ready in this thread, which would undo what follows
        torch.set_num_threads(1)
        every.wait()  # so that no thread takes two of these

    try:
        with one_thread():  # what was set last is also what other threads begin with
            list(workers.map(begin, range(job.streams)))
    except BaseException:  # a thread that could not start: the others would wait for it at the end of the process
        every.abort()
        workers.shutdown(wait=False, cancel_futures=True)
        raise
    return _run_in_streams(lambda batch: workers.submit(lambda: next(run([batch]))).result, job.streams)


def _onnxruntime(model: nn.Module, job: EngineJob) -> RunBatches:
    runtime = import_onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads() if job.streams == 1 else 1
    # threads that spin while they wait take the cores from those that decode and encode
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    source = (
        convert_network(model, job.images, layer=job.layer).SerializeToString()
        if job.onnx_file is None
        else str(job.onnx_file)
    )
    session = runtime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    names, workers = (
        list(answer_names(model, job.layer)),
        ThreadPoolExecutor(job.streams, thread_name_prefix="onnxruntime"),
    )

    def answer(batch: Tensor) -> tuple[Tensor, ...]:
        return tuple(map(torch.from_numpy, session.run(names, {INPUT: batch.contiguous().numpy()})))

    return _run_in_streams(lambda batch: workers.submit(answer, batch).result, job.streams)


def _openvino(model: nn.Module, job: EngineJob) -> RunBatches:
    openvino = import_openvino()
    shape = openvino.PartialShape((job.batch_size, *job.images.shape[1:]))
    core = openvino.Core()
    if job.onnx_file is not None:
        converted = core.read_model(str(job.onnx_file))
        converted.reshape(shape)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch and OpenVINO about each other; the answers are checked
            example = job.images.new_zeros(tuple(int(length) for length in shape.to_shape()))
            converted = openvino.convert_model(
                fold_batch_norm(Answers(model, job.layer).eval()), example_input=example, input=[shape]
            )
    settings = {
        "NUM_STREAMS": job.streams,
        "INFERENCE_NUM_THREADS": max(torch.get_num_threads(), job.streams),
        # pinned, the threads of two processes share the first core and leave the second idle
        "ENABLE_CPU_PINNING": False,
        "INFERENCE_PRECISION_HINT": "f32",  # where the processor knows bfloat16 that is the default, at 3 digits
    }
    network = core.compile_model(converted, "CPU", settings)
    idle = [network.create_infer_request() for _ in range(2 * job.streams)]
    outputs = len(answer_names(model, job.layer))

    def submit(batch: Tensor) -> Callable[[], tuple[Tensor, ...]]:
        missing = job.batch_size - len(batch)
        full = torch.cat([batch, batch.new_zeros(missing, *batch.shape[1:])]) if missing else batch
        full = full.contiguous()
        request = idle.pop() if idle else network.create_infer_request()  # a run that was broken off gives none back
        request.start_async({0: full.numpy()}, share_inputs=True)

        def answers(_: Tensor = full) -> tuple[Tensor, ...]:  # the tensor too: the request reads its memory
            request.wait()
            # its own memory is written anew by the next call
            copies = [torch.from_numpy(request.get_output_tensor(at).data.copy()) for at in range(outputs)]
            idle.append(request)
            return tuple(copy[: len(batch)] for copy in copies)

        return answers

    return _run_in_streams(submit, job.streams)


def _batch_in_cache(images: Tensor) -> int:
    # measured on two cores: 16 images of 112 px and 4 of 224 px are the fastest, more of them leave the caches
    return min(16, max(4, 16 * 112**2 // (images.shape[-2] * images.shape[-1])))


_CONVERTED = ("onnxruntime", "openvino")
_ROWS = {
    # torch as it is, its batch normalisation folded into the convolutions, and torch.compile of that
    "eager": EngineKind(pays_after=0, build=_torch(lambda network: network)),
    # it takes as long as 20 passes
    "folded": EngineKind(
        pays_after=100,
        # of 224 px as many take two thirds of the time a pass that 64 take, of 112 px the same
        batch_size=lambda images: 16 if images.device.type == "cpu" else 256,
        build=_folded,
    ),
    "compiled": EngineKind(
        pays_after=None,  # it takes minutes
        obstacle=_compiler_obstacle,
        build=_torch(lambda network: torch.compile(fold_batch_norm(network))),
    ),
    "onnxruntime": EngineKind(
        pays_after=4000,  # it takes some 10 s, and saves 2 to 9 ms a pass
        batch_size=_batch_in_cache,
        obstacle=_needs(*ONNX_PACKAGES, extra="onnx"),
        build=_onnxruntime,
    ),
    "openvino": EngineKind(
        pays_after=1500,  # it takes as long as 1000 passes
        batch_size=_batch_in_cache,
        obstacle=_needs("openvino", extra="openvino"),
        build=_openvino,
    ),
}
ENGINES = Table("engine", "sliplens.engines", _ROWS)
"""Ways to run a network, from the slowest to the fastest for many passes; each answers within `TOLERANCE` of the
network itself."""
