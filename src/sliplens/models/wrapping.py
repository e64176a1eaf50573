"""Networks of others: any PyTorch module with one number an image as its output."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.errors import InputError, ModelError
from sliplens.extras import pick
from sliplens.files import hash_json
from sliplens.models.checkpoint import Manifest, Network, hash_weights, load
from sliplens.models.encodings import ENCODINGS

Preprocess: TypeAlias = Callable[[Tensor], Tensor]
"""Differentiable function from images (batch, 3, size, size) in [0, 1] to the input of a module."""
Output: TypeAlias = int | str | Callable[[Any], Tensor]
"""Place of the output in a tuple or along the columns, its key in a dict, or a function that returns it."""
_NEEDS_EVAL = (nn.modules.batchnorm._BatchNorm, nn.modules.dropout._DropoutNd)


class OneOutput(nn.Module):
    """Module with its preprocessing before it and one of its outputs after it, shape (batch,)."""

    def __init__(self, module: nn.Module, preprocess: Preprocess | None = None, output: Output | None = None) -> None:
        super().__init__()
        self.module, self.preprocess, self.output = module, preprocess, output

    def forward(self, images: Float[Tensor, "batch colours height width"]) -> Float[Tensor, " batch"]:
        """Compute one number an image."""
        weights = next((weight for weight in self.module.parameters() if weight.is_floating_point()), images)
        inputs = images.to(weights.dtype)
        if self.preprocess is not None:
            inputs = self.preprocess(inputs)
        values = self.module(inputs.contiguous())
        if callable(self.output):
            values = self.output(values)
        elif isinstance(values, Tensor):
            values = values[:, self.output] if isinstance(self.output, int) and values.ndim > 1 else values
        elif self.output is not None or (isinstance(values, tuple | list) and len(values) == 1):
            values = values[self.output or 0]  # pyright: ignore[reportCallIssue, reportArgumentType] (its own key)
        return one_output(values, len(images))


def one_output(output: object, images: int) -> Float[Tensor, " batch"]:
    """Return the output of a module as one number an image; `ModelError` if it is anything else."""
    if not isinstance(output, Tensor) or tuple(output.shape) not in {(images,), (images, 1)}:
        what = f"shape {tuple(output.shape)}" if isinstance(output, Tensor) else f"type {type(output).__name__}"
        raise ModelError(
            f"the model's output has {what} for {images} image(s), not one number an image; end it with one output, "
            "such as Linear(features, 1), or choose one with sliplens.wrap(model, output=0), its place or its key"
        )
    return output.reshape(images)


def wrap(
    module: nn.Module,
    *,
    size: int = 224,
    encoding: str = "rgb",
    preprocess: Preprocess | None = None,
    output: Output | None = None,
    unit: str = "",
) -> Network:
    """Make a network of any PyTorch module, for `predict`, `explain`, `score`, `run_study` and `read_live`.

    Parameters
    ----------
    module
        Module in evaluation mode that returns one number an image: (batch,) or (batch, 1).
    size
        Height and width of its input, in pixels; frames are resized to it.
    encoding
        Way to make images of frames: `rgb`, the frame divided by 255, or another encoding, such as `difference`.
    preprocess
        Differentiable function from images (batch, 3, size, size) in [0, 1] to the module's input, such as
        `torchvision.transforms.Normalize(mean, std)`.
    output
        For a module with several outputs: the place in a tuple or along the columns, such as 0 for the x force of
        (fx, fy, fz), the key in a dict, or a function of what the module returns.
    unit
        Unit of the output, such as "N", for figures and tables; "margin" for safety margins in [0, 1], which
        `read_live` needs.

    Raises
    ------
    ModelError
        If the module is in training mode and has batch normalisation or dropout, does not run on an image, or does not
        return one number an image.

    See Also
    --------
    load : Load a network of sliplens.
    explain : Explain its predictions.

    Examples
    --------
    >>> import numpy as np, torch
    >>> import sliplens as sl
    >>> module = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * 32 * 32, 3)).eval()
    >>> network = sl.wrap(module, size=32, output=0, unit="N")
    >>> frames = np.random.default_rng(0).integers(256, size=(2, 32, 32, 3), dtype=np.uint8)
    >>> sl.explain(network, frames, method="integrated-gradients").relevance["integrated-gradients"].shape
    (2, 32, 32)
    """
    if not isinstance(module, nn.Module):
        kind = type(module).__name__
        raise ModelError(f"a {kind} is no module; build the torch.nn.Module, and load its weights with load_state_dict")
    trains = [type(part).__name__ for part in module.modules() if part.training and isinstance(part, _NEEDS_EVAL)]
    if size < 1:
        raise ModelError(f"size is {size}; give the height and width of the module's input in pixels, such as 224")
    if trains:
        raise ModelError(
            f"the module is in training mode, in which {trains[0]} makes predictions depend on the batch; call "
            "module.eval() first"
        )
    module = getattr(module, "_orig_mod", module)  # of torch.compile, which runs no hooks
    row, model = pick(ENCODINGS, encoding, noun="encoding"), OneOutput(module, preprocess, output)
    device = next(module.parameters(), torch.empty(0)).device
    try:
        with torch.no_grad():
            model(torch.zeros(2, row.colours, size, size, device=device))
    except ModelError:
        raise
    except Exception as error:  # whatever a module of others raises
        raise ModelError(
            f"the module does not run on images of shape (2, {row.colours}, {size}, {size}) "
            f"({type(error).__name__}: {error}); set size= to a number of pixels, preprocess= to a "
            "function, or output= to an output that it has"
        ) from error
    choice = "" if output is None else getattr(output, "__qualname__", type(output).__qualname__)
    return Network(
        model=model,
        manifest=Manifest(
            backbone=type(module).__name__,
            input=encoding,
            image_size=size,
            frame_size=(size, size),
            sensor="",
            data_hash="",
            head="module",
            target="output",
            unit=unit,
            # networks of one module with other outputs are different networks
            weights_sha256=hash_json([hash_weights(module), output if isinstance(output, int | str) else choice]),
        ),
    )


def open_run(run: object, *, device: str = "cpu", preprocess: Preprocess | None = None) -> Network:
    """Return a network, load it from its folder or by the name of one that comes with sliplens, or wrap a module."""
    if isinstance(run, nn.Module):
        return wrap(run, preprocess=preprocess)
    if preprocess is not None:
        raise InputError("preprocess is for a PyTorch module; networks of sliplens have their own, so leave it out")
    if not isinstance(run, Network | Path | str):
        raise InputError(
            f"{type(run).__name__} is no network; give a network, its folder, its name or a PyTorch module first"
        )
    return run if isinstance(run, Network) else load(run, device=device)
