"""Explainers by name, and the call that explains frames with one of them."""

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sliplens.errors import ImageError, InputError, SliplensError
from sliplens.explainers.attribution import Attribution
from sliplens.explainers.cam import GradCam, HiResCam, LayerCam
from sliplens.explainers.contract import Explainer
from sliplens.explainers.gradients import ExpectedGradients, IntegratedGradients, Lrp, SmoothGrad
from sliplens.explainers.occlusion import KnownMarkers, Occlusion, RegionMethod, find_markers, markers_in_frame
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.shapley import Shapley
from sliplens.extras import Table
from sliplens.models import Network
from sliplens.models.checkpoint import open_run
from sliplens.progress import OnProgress

_ROWS: dict[str, Explainer] = {
    "grad-cam": GradCam(),
    "integrated-gradients": IntegratedGradients(),
    "poly-cam": PolyCam(),
    "hires-cam": HiResCam(),
    "layer-cam": LayerCam(),
    "expected-gradients": ExpectedGradients(),
    "smooth-grad": SmoothGrad(),
    "occlusion": Occlusion(),
    "occlusion-marker": Occlusion(markers_px=find_markers),
    "shapley": Shapley(),
    "shapley-marker": Shapley(markers_px=find_markers),
    "lrp": Lrp(),
    "grad-cam-thesis": GradCam(contrast=False, relu=True),
    "integrated-gradients-thesis": IntegratedGradients(black=True, steps=50, max_steps=50),
    "poly-cam-thesis": PolyCam(score="thesis", level=5),
}
EXPLAINERS = Table("method", "sliplens.explainers", _ROWS)
"""The explainers by name, with their default options; use `dataclasses.replace` for others. `lrp` needs an extra.

The last three are the thesis's methods as they were published and run, of f itself; the thesis does not say whether it
ranked the pixels of Integrated Gradients by sign or by size, and here their sign counts as that of all methods does.

An installed package adds its own by the entry point `sliplens.explainers`.
"""
RECOMMENDED_METHOD = "shapley-marker"
"""What explains where no method is named: its maps rank the markers most like the truth in simulation.

Where the markers of a frame are not known the players are tiles (`shapley`).
"""


def explain(
    run: Network | Path | str,
    frames: UInt8[np.ndarray, "batch height width 3"],
    *,
    reference: UInt8[np.ndarray, "height width 3"] | None = None,
    method: str | Explainer | None = None,
    on_progress: OnProgress | None = None,
    **options: Any,
) -> Attribution:
    """Explain why a network reads these safety margins rather than that of the untouched sensor.

    Parameters
    ----------
    run
        The network, its folder, or the name of one that comes with sliplens.
    frames
        Camera frames T_n, 8-bit RGB; without a reference, absolute difference images |T_n - T_0|.
    reference
        Frame of the untouched sensor, T_0. A network on difference images needs none.
    method
        Row of `EXPLAINERS`, or an explainer. If None, Shapley values of the markers (`RECOMMENDED_METHOD`); where they
        are not found, as in difference images, of tiles, and a warning says why.
    options
        Options of the method, such as `budget=0.25` of `poly-cam`: the fields of its class.

    Raises
    ------
    InputError
        If there is no such method or option, or the network needs a reference.
    ImageError
        If the frames are not of the size the network's sensor has.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.explainers.table import explain
    >>> touched = np.zeros((1, 224, 224, 3), dtype=np.uint8)
    >>> touched[:, 80:120, 90:150] = 90
    >>> explanation = explain("chromatouch-difference", touched, method="grad-cam")
    >>> explanation.relevance.shape, explanation.frame().num_rows
    (torch.Size([1, 224, 224]), 1)
    """
    trained = open_run(run)
    named = RECOMMENDED_METHOD if method is None else method
    explainer = get_explainer(named, **options) if isinstance(named, str) else named
    inputs, empty = network_inputs(trained, frames, reference)
    warnings = ()
    if isinstance(explainer, RegionMethod) and explainer.markers_px is find_markers:
        try:
            if reference is None:
                find_markers(inputs[0], empty)  # which tells why there are none
            # they show in the camera's frames, at their full size, whatever the network is shown
            places = tuple(markers_in_frame(frame, image_size=trained.manifest.image_size) for frame in frames)
            explainer = replace(explainer, markers_px=KnownMarkers(images=inputs, places=places))
        except SliplensError as error:
            if method is not None:
                raise
            explainer, warnings = replace(explainer, markers_px=None), (f"tiles, not markers: {error}",)
    explanation = explainer(trained.model, inputs, reference=empty, on_progress=on_progress)
    return replace(explanation, warnings=(*warnings, *explanation.warnings))


def get_explainer(method: str, **options: Any) -> Explainer:
    """Look up a row of `EXPLAINERS`, with other options than it has: the fields of its class.

    Raises
    ------
    InputError
        If there is no such method, or it has no such option; the message lists those there are.

    Examples
    --------
    >>> from sliplens.explainers.table import get_explainer
    >>> get_explainer("occlusion", tile_px=8).tile_px
    8
    """
    explainer = EXPLAINERS.pick(method)
    known = [field.name for field in fields(explainer)] if is_dataclass(explainer) else []
    for name in options:
        if name not in known:
            raise InputError(f"{method} has no option {name!r}; it has {', '.join(known) or 'none'}")
    return replace(explainer, **options) if options else explainer  # pyright: ignore[reportArgumentType]


def network_images(
    trained: Network,
    frames: UInt8[np.ndarray, "batch height width 3"],
    reference: UInt8[np.ndarray, "height width 3"] | None,
) -> tuple[UInt8[Tensor, "batch colours size size"], Float[Tensor, "colours size size"]]:
    """Images of a network before they are normalised, 8 bits, and the input of the untouched sensor, in [0, 1]."""
    if not len(frames):
        raise ImageError("there is no frame to explain; give one at least")
    trained.require_frame_size(frames.shape[1:3])
    encoding, image_size = trained.encoding, trained.manifest.image_size
    if reference is not None:
        images = encoding.compare_small(frames, reference, image_size=image_size)
        return images, encoding.empty(reference, image_size=image_size)
    if not encoding.empty_is_black:
        raise InputError(
            f"a network on {encoding.name} images needs the untouched sensor; give it as reference, on the command "
            "line with --reference IMAGE"
        )
    return encoding.resize(frames, image_size=image_size), torch.zeros(3, image_size, image_size)


def network_inputs(
    trained: Network, frames: UInt8[np.ndarray, "batch _ _ 3"], reference: UInt8[np.ndarray, "_ _ 3"] | None
) -> tuple[Float[Tensor, "batch colours size size"], Float[Tensor, "colours size size"]]:
    """Inputs of a network and that of the untouched sensor, in [0, 1] on its device."""
    images, empty = network_images(trained, frames, reference)
    return trained.encoding.normalise(images).to(trained.device), empty.to(trained.device)
