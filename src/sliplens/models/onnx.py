"""Export of a network as an ONNX file, with its encoding in the metadata, checked before it appears."""

import json
import warnings
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sliplens._version import __version__
from sliplens.errors import ModelError
from sliplens.extras import ONNX_PACKAGES, import_onnxruntime, require_packages
from sliplens.files import require_new_file, to_builtins, whole_file
from sliplens.models.backbones import Answers, answer_names, bin_edges, ratio_edges
from sliplens.models.checkpoint import Network
from sliplens.models.wrapping import open_run

if TYPE_CHECKING:
    from onnx import ModelProto


INPUT = "image"
OPSET = 18
"""Version of the file's operators: the oldest that torch writes without converting, read by ONNX Runtime from 1.14."""
TOLERANCE = 1e-4
"""Largest difference of an engine's prediction from the network's own, times its size where that is above 1.

Float32 sums in another order move predictions by 4e-5 at most; a wrong kernel or bfloat16 by 1e-3 or more."""


def export_onnx(run: Network | Path | str, out: Path | str, *, overwrite: bool = False) -> Path:
    """Write a network as an ONNX file, which appears once ONNX Runtime predicts the same as the network.

    Input `image` is float32 (batch, 3, size, size), of a `pair` network (batch, 6, size, size), encoded and normalised;
    outputs are `margin` (batch,), for a histogram `probabilities` (batch, bins), `ratio_probabilities` of a network
    that predicts F_t / F_n, and `features` (batch, channels) of a network with a `Novelty`. The batch may be of any
    size. Properties of the model, as JSON: `sliplens.manifest`, `sliplens.input` (how frames become an input) and
    `sliplens.output` (edges of the bins).

    Parameters
    ----------
    run
        The network, its folder, or the name of one that comes with sliplens.
    out
        File to write; its name ends in `.onnx`.
    overwrite
        If True, replace a file of that name.

    See Also
    --------
    load : Load the network to export.

    Examples
    --------
    >>> import sliplens as sl
    >>> sl.export_onnx("chromatouch-pair", "tip.onnx")  # doctest: +SKIP
    PosixPath('tip.onnx')
    """
    path = Path(out)
    require_new_file(path, suffix=".onnx", overwrite=overwrite)
    require_packages(*ONNX_PACKAGES, extra="onnx", purpose="an ONNX file")
    network = open_run(run)
    proto = _convert(network)
    _describe(proto, network)
    with whole_file(path) as part:
        part.write_bytes(proto.SerializeToString())
        _check_parity(part, network)
    return path


def _convert(network: Network) -> "ModelProto":
    """Convert a network to ONNX: input `image`, outputs named by `answer_names`, a batch of any size."""
    copied = deepcopy(network.model).to("cpu", memory_format=torch.contiguous_format)  # pyright: ignore[reportCallIssue]
    size = network.manifest.image_size
    # two images: torch takes a batch of one for a constant
    example = torch.zeros(2, network.encoding.colours, size, size)
    with warnings.catch_warnings():
        # of torch about its own parts; what counts is checked afterwards
        warnings.simplefilter("ignore")
        try:
            program = torch.onnx.export(
                Answers(copied, network.feature_layer).eval(),
                (example,),
                dynamo=True,
                input_names=[INPUT],
                output_names=list(answer_names(network.model, network.feature_layer)),
                dynamic_shapes={INPUT: {0: torch.export.Dim("batch", min=1)}},
                opset_version=OPSET,
                external_data=False,
                verbose=False,
            )
        except (torch.onnx.OnnxExporterError, RuntimeError, ValueError, TypeError) as error:
            reason = next(iter(str(error).strip().splitlines()), "no reason given")
            raise ModelError(
                f"torch {torch.__version__} cannot export the network ({reason}); train another backbone"
            ) from None
    assert program is not None  # with `dynamo`
    return program.model_proto


def _describe(proto: "ModelProto", network: Network) -> None:
    # torch notes where in whose source files each node was made
    values = (*proto.graph.input, *proto.graph.output, *proto.graph.value_info, *proto.graph.initializer)
    for part in (proto, proto.graph, *proto.graph.node, *values):
        del part.metadata_props[:]
        part.doc_string = ""
    proto.producer_name, proto.producer_version = "sliplens", __version__
    manifest, encoding = network.manifest, network.encoding
    edges, of_ratio = bin_edges(network.model), ratio_edges(network.model)
    properties = {
        "sliplens.manifest": asdict(manifest),
        "sliplens.input": {
            "encoding": encoding.name,
            "frame_size": manifest.frame_size,
            "channels": "RGB" * (encoding.colours // 3),
            "compare": encoding.formula,
            "image_size": manifest.image_size,
            "resize": "bilinear, antialiased, pixel centres at halves, rounded to 8 bits",
            "scale": "the image's own maximum, at least 1" if encoding.own_maximum else "255",
            "neutral": encoding.neutral,
        },
        "sliplens.output": {
            "margin": "safety margin; 1 full stick, 0 onset of full slip; not clipped",
            "bin_edges": None if edges is None else edges.tolist(),
            "ratio_bin_edges": None if of_ratio is None else of_ratio.tolist(),
        },
    }
    for key, value in properties.items():
        proto.metadata_props.add(key=key, value=json.dumps(to_builtins(value)))


@torch.no_grad()
def _check_parity(path: Path, network: Network) -> None:
    """Check that ONNX Runtime predicts the same as the network, on black, white and noise, alone and in a batch."""
    runtime, names, worst = import_onnxruntime(), answer_names(network.model, network.feature_layer), 0.0
    cure = "nothing was written, export it with other versions of torch and onnxscript"
    try:
        session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        for inputs in trial_inputs(network):
            outputs = session.run(list(names), {INPUT: inputs.numpy()})
            for output, answer in zip(outputs, network.answers([inputs]), strict=True):
                worst = np.maximum(worst, difference(output, answer.cpu().numpy()))  # NaN stays
    except Exception as error:  # its errors have no other base
        reason = str(error).splitlines()[0]
        raise ModelError(f"ONNX Runtime cannot run the exported network ({reason}); {cure}") from None
    if not worst <= TOLERANCE:
        raise ModelError(f"the exported network's predictions differ by {worst:.2g}, {TOLERANCE:g} is allowed; {cure}")


def difference(values: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference, divided by the expected size where that is above 1; NaN if shapes differ."""
    if values.shape != expected.shape:
        return float("nan")
    return float(np.max(np.abs(values - expected) / np.maximum(np.abs(expected), 1)))


def trial_inputs(network: Network) -> Iterator[Float[Tensor, "batch colours size size"]]:
    """Make the inputs that a network and its copies are compared on: black, white, noise; alone and in a batch."""
    generator, size = torch.Generator().manual_seed(0), network.manifest.image_size
    for shape in ((count, network.encoding.colours, size, size) for count in (1, 7)):
        yield from (torch.zeros(shape), torch.ones(shape), torch.rand(shape, generator=generator))
