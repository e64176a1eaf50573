"""Many forward passes of one network, by the fastest engine at hand that answers as the network does."""

import hashlib
import os
import shutil
import tempfile
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.fx.experimental.optimization import fuse
from torch.fx.proxy import TraceError

from sliplens.errors import InputError, ModelError
from sliplens.extras import ONNX_PACKAGES, import_onnxruntime, import_openvino, missing_packages
from sliplens.models import TrainedModel
from sliplens.models.backbones import HistogramRegressor
from sliplens.models.checkpoint import Estimate
from sliplens.models.onnx import INPUT, Answers, answer_names, export_onnx, require_file_of, run_network, to_estimate


def fold_batch_norm(model: nn.Module) -> nn.Module:
    """A copy of a network in evaluation mode, its batch normalisation folded into the convolutions before it.

    With its statistics fixed, batch normalisation is an affine map of each channel, and so is what scales and shifts
    the kernels of the convolution before it. A network whose graph torch cannot trace comes back as a plain copy.

    Parameters
    ----------
    model
        In evaluation mode.

    References
    ----------
    Jacob et al., *Quantization and Training of Neural Networks for Efficient Integer-Arithmetic-Only Inference*
    (2018), eq. 14.
    """
    copied = deepcopy(model)
    if isinstance(copied, HistogramRegressor):
        copied.backbone = _fold(copied.backbone)
        return copied
    return _fold(copied)


def _fold(model: nn.Module) -> nn.Module:
    try:
        folded = fuse(model)
    except (TraceError, TypeError, NotImplementedError):  # branches on values, or takes a tensor apart
        return model
    # folding makes new kernels; channels last as `load_checkpoint` has them
    return folded.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


Run = Callable[[Tensor], tuple[np.ndarray, ...]]
EXPORT_PAYS_AFTER = 4000
"""Frames: an export takes some 10 s of a processor, and ONNX Runtime then saves 2 to 9 ms a frame."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """A network ready to be run."""

    name: str
    """Row of `ENGINES`."""
    trained: TrainedModel
    run: Run
    """Answers as `Answers` gives them."""

    def __call__(self, inputs: Float32[Tensor, "batch 3 size size"]) -> Estimate:
        """Safety margins of encoded frames.

        Parameters
        ----------
        inputs
            As `TrainedModel.encode` makes them, on the processor.
        """
        return to_estimate(self.trained, self.run(inputs))


@dataclass(frozen=True, kw_only=True)
class EngineKind:
    """How networks are run in one way."""

    words: str
    """What it does, for people."""
    obstacle: Callable[[torch.device], str | None]
    """Why it cannot be used for a network on a device, with the cure; None if it can."""
    build: Callable[[TrainedModel, Path | None], Run]
    """Called with the network, and an ONNX file of it if there is one."""


def make_engine(name: str, trained: TrainedModel, *, onnx_file: Path | None = None) -> Engine:
    """Make a network ready to be run by an engine.

    Parameters
    ----------
    name
        Row of `ENGINES`.
    trained
        The network, on the device where it is to run.
    onnx_file
        The network as `export_onnx` wrote it, for `onnxruntime` and `openvino`; exported on the fly if None.

    Raises
    ------
    InputError
        If there is no engine of that name, it cannot be used here, or the file is not of this network.
    """
    if name not in ENGINES:
        raise InputError(f"there is no engine named {name!r}; choose one of {', '.join(ENGINES)}")
    obstacle = ENGINES[name].obstacle(_device(trained.model))
    if obstacle is not None:
        raise InputError(f"the engine {name} cannot be used: {obstacle}")
    return Engine(name=name, trained=trained, run=ENGINES[name].build(trained, onnx_file))


def fastest_engine(trained: TrainedModel, *, onnx_file: Path | None = None, frames: int | None = None) -> str:
    """Name of the engine to run a network by: the fastest that was measured and is at hand.

    `compiled` is never chosen: it takes minutes to begin.

    Parameters
    ----------
    trained
        The network, on its device.
    onnx_file
        Its ONNX file, if there is one.
    frames
        How many there will be; many if None. For a few an export does not pay.
    """
    few = frames is not None and frames < EXPORT_PAYS_AFTER and onnx_file is None
    order = ("folded",) if few else ("onnxruntime", "openvino", "folded")
    return next(name for name in order if ENGINES[name].obstacle(_device(trained.model)) is None)


def _device(model: nn.Module) -> torch.device:
    return next(model.parameters()).device


def _no_obstacle(_: torch.device) -> None:
    return None


def _compiler_obstacle(device: torch.device) -> str | None:
    if device.type != "cpu":  # Triton brings its own
        return None
    compilers = [name for name in (os.environ.get("CXX"), "g++", "clang++", "cl") if name]
    if any(shutil.which(name) for name in compilers):
        return None
    return "it needs a C++ compiler and there is none; install g++, or choose another engine"


def _needs(*packages: str, extra: str) -> Callable[[torch.device], str | None]:
    def obstacle(device: torch.device) -> str | None:
        if device.type != "cpu":
            return f"it runs on the processor, not on {device.type}; leave the device out, or choose folded"
        missing = missing_packages(*packages)
        return f'{" and ".join(missing)} missing; `pip install "sliplens[{extra}]"`' if missing else None

    return obstacle


def _torch_run(network: nn.Module, device: torch.device) -> Run:
    return lambda inputs: run_network(network, inputs.to(device))


def _eager(trained: TrainedModel, _: Path | None) -> Run:
    return _torch_run(Answers(trained.model).eval(), _device(trained.model))


def _folded(trained: TrainedModel, _: Path | None) -> Run:
    return _torch_run(Answers(fold_batch_norm(trained.model)).eval(), _device(trained.model))


def _compiled(trained: TrainedModel, _: Path | None) -> Run:
    from torch._dynamo.exc import TorchDynamoException  # noqa: PLC0415 (takes seconds)

    compiled = torch.compile(Answers(fold_batch_norm(trained.model)).eval())
    device = _device(trained.model)

    @torch.no_grad()
    def run(inputs: Tensor) -> tuple[np.ndarray, ...]:
        try:
            return tuple(answer.cpu().numpy() for answer in compiled(inputs.to(device)))
        except TorchDynamoException as error:
            reason = str(error).strip().splitlines()[0]
            raise ModelError(f"torch cannot compile the network here ({reason}); choose another engine") from None

    return run


def _onnxruntime(trained: TrainedModel, onnx_file: Path | None) -> Run:
    runtime = import_onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    # threads that spin while they wait take the cores from those that decode and encode
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")

    def load(path: Path) -> Any:
        return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    session = _load("ONNX Runtime", load, trained, onnx_file)
    names = list(answer_names(trained.model))
    return lambda inputs: tuple(session.run(names, {INPUT: inputs.numpy()}))


def _openvino(trained: TrainedModel, onnx_file: Path | None) -> Run:
    openvino = import_openvino()
    settings: dict[str, Any] = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": torch.get_num_threads(),
        "INFERENCE_PRECISION_HINT": "f32",  # where the processor knows bfloat16 that is the default, at 3 digits
    }

    def load(path: Path) -> Any:
        return openvino.Core().compile_model(str(path), "CPU", settings)

    network = _load("OpenVINO", load, trained, onnx_file)
    names = answer_names(trained.model)

    def run(inputs: Tensor) -> tuple[np.ndarray, ...]:
        answers = network({INPUT: inputs.numpy()})
        return tuple(np.array(answers[name]) for name in names)  # its own memory is written anew by the next call

    return run


def _load(words: str, load: Callable[[Path], Any], trained: TrainedModel, onnx_file: Path | None) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        if onnx_file is None:
            export_onnx(trained, path := Path(folder) / "network.onnx")
        else:
            require_file_of(path := onnx_file, trained)
        try:
            return load(path)
        except Exception as error:  # the errors of ONNX Runtime have no other base
            reason = str(error).strip().splitlines()[0]
            raise ModelError(f"{words} cannot load {path} ({reason}); export the run again") from None


ENGINES = {
    "eager": EngineKind(words="torch as it is", obstacle=_no_obstacle, build=_eager),
    "folded": EngineKind(
        words="torch, batch normalisation folded into the convolutions", obstacle=_no_obstacle, build=_folded
    ),
    "compiled": EngineKind(words="torch.compile of the folded network", obstacle=_compiler_obstacle, build=_compiled),
    "onnxruntime": EngineKind(words="ONNX Runtime", obstacle=_needs(*ONNX_PACKAGES, extra="onnx"), build=_onnxruntime),
    "openvino": EngineKind(
        words="OpenVINO, from the ONNX file",
        obstacle=_needs(*ONNX_PACKAGES, "openvino", extra="onnx,openvino"),
        build=_openvino,
    ),
}
"""Ways to run a network; each answers within 1e-4 of `eager`."""


PARITY = 1e-5
"""How far an engine's answer may lie from the network's own, times its size where that is above 1: float32 sums in
another order move an answer by a tenth of it, and channels of one layer differ by a hundred times as much."""
WORTH_FOLDING, WORTH_CONVERTING = 100, 1500
"""Passes of a network, those of earlier calls included, from which it pays to prepare an engine: folding takes as long
as 20 passes, a conversion as 1000."""

RunBatch = Callable[[Iterable[Tensor]], Iterator[Tensor]]


@dataclass(frozen=True, kw_only=True)
class Passes:
    """A network ready for many passes; valid while the network is held still."""

    engine: str
    """`plain`, `folded` or `openvino`."""
    batch_size: int
    """Images in a batch; the last one may be shorter."""
    run: RunBatch
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


def _plain(model: nn.Module, _: Tensor, batch_size: int) -> RunBatch:  # noqa: ARG001 (a row of the table)
    def run(batches: Iterable[Tensor]) -> Iterator[Tensor]:
        for batch in batches:
            # convolutions on a CPU then need no reordering
            yield model(batch.contiguous(memory_format=torch.channels_last)).reshape(len(batch))

    return run


def _fold_for_passes(model: nn.Module, images: Tensor, batch_size: int) -> RunBatch:
    return _plain(fold_batch_norm(model), images, batch_size)


def _openvino_for_passes(model: nn.Module, images: Tensor, batch_size: int) -> RunBatch:
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


_BUILDERS: dict[str, Callable[[nn.Module, Tensor, int], RunBatch]] = {
    "openvino": _openvino_for_passes,
    "folded": _fold_for_passes,
    "plain": _plain,
}
_WORTH = {"openvino": WORTH_CONVERTING, "folded": WORTH_FOLDING, "plain": 0}
_SPENT: WeakKeyDictionary[nn.Module, int] = WeakKeyDictionary()
"""Passes that each network was asked for so far: frames are explained one by one."""
_CONVERTED: WeakKeyDictionary[nn.Module, tuple[tuple[Any, ...], Any]] = WeakKeyDictionary()
"""The last conversion of each network."""
