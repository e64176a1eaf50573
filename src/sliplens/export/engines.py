"""Engines: one network, run in several ways that answer alike; a row in a table each."""

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from sliplens.errors import InputError, ModelError
from sliplens.export.answers import INPUT, Answers, answer_names, run_network, to_estimate
from sliplens.export.extras import ONNX_PACKAGES, import_onnxruntime, import_openvino, missing_packages
from sliplens.export.folding import fold_batch_norm
from sliplens.export.onnx_file import export_onnx, require_file_of
from sliplens.models import TrainedModel
from sliplens.models.checkpoints import Estimate

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
