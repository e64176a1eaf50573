"""Scores of explanations in one call: the sound one against controls, and the thesis's deletion score."""

from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from sliplens.arrays import require_saliency
from sliplens.errors import SaliencyError
from sliplens.explainers import Explanation
from sliplens.explainers.table import network_inputs, open_run
from sliplens.faithfulness.alarms import controls_win, fill_decides, flat_maps, saturated
from sliplens.faithfulness.controls import control_maps
from sliplens.faithfulness.deletion import (
    DeletionCurves,
    deletion_curves,
    deletion_steps,
    random_order,
    saliency_orders,
)
from sliplens.faithfulness.fills import get_fill
from sliplens.faithfulness.removal import AREAS, RANDOM_ORDERS, Faithfulness, score_maps, tile_units
from sliplens.models import Run
from sliplens.models.engines import Engine, prepare
from sliplens.progress import OnProgress

Frames: TypeAlias = UInt8[np.ndarray, "images height width 3"]
Maps: TypeAlias = Explanation | Float[np.ndarray, "maps rows columns"]
"""Explanation of the frames, or the influence of each pixel of the network's input: larger where it matters more."""
_CHECKED_IMAGES = 4
_TILES_ACROSS = 14


def score(
    run: Run | Path | str,
    frames: Frames,
    maps: Maps,
    *,
    reference: UInt8[np.ndarray, "height width 3"] | None = None,
    fill: str = "reference",
    unit: Literal["pixel", "tile"] = "pixel",
    random_orders: int = RANDOM_ORDERS,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> Faithfulness:
    """Score maps by removing what they call influential first, and last, against random orders and controls.

    The score is the symmetric gain, in margin units: how much further the answer moves towards that on the untouched
    sensor with the most influential parts removed first rather than the least. A map that gains no more than the
    controls, which know nothing of the network, has shown nothing.

    Parameters
    ----------
    run
        The network that was explained, its folder, or the name of one that comes with sliplens.
    frames, reference
        As `explain` took them.
    maps
        What `explain` gave; or an array, larger where a pixel matters more to f(x) - f(reference).
    fill
        What removed pixels become, a row of `FILLS`; `reference`, the untouched sensor, is the one that networks know.
    unit
        What is removed at once: pixels, or square tiles of a fourteenth of the image.
    random_orders
        How many random orders are removed beside.

    Raises
    ------
    InputError
        If there is no such fill, or the network needs a reference.
    SaliencyError
        If there is not a map a frame, or one has another size than the network's input, or holds NaN.
    """
    fill_of_name, trained = get_fill(fill), open_run(run)
    inputs, empty = network_inputs(trained, frames, reference)
    method = maps.method if isinstance(maps, Explanation) else "maps"
    influence = {method: _influence(maps, inputs)}
    influence |= control_maps(trained.model, inputs, empty.expand_as(inputs))
    whole, untouched = (trained.predict(images).double().numpy() for images in (inputs, empty[None]))
    towards = np.sign(whole - untouched)
    shape = (inputs.shape[-2], inputs.shape[-1])
    units = tile_units(shape, size=1 if unit == "pixel" else max(1, shape[0] // _TILES_ACROSS))
    orders = 2 * len(influence) + random_orders
    scores = score_maps(
        prepare_passes(trained, inputs, len(inputs) * orders * (len(AREAS) - 2)),
        inputs,
        influence,
        [units] * len(inputs),
        fill=fill_of_name,
        rng=np.random.default_rng(seed),
        references=empty.expand_as(inputs),
        towards=towards,
        random_orders=random_orders,
        seed=seed,
        on_progress=on_progress,
    )
    named = {name: replace(each, method=name, fill=fill) for name, each in scores.items()}
    own = named.pop(method)
    filled = whole - towards * own.curves[0, :, -1]
    alarms = (
        *saturated(whole),
        *flat_maps({method: influence[method]}),
        *fill_decides(whole, filled, fill=fill),
        *controls_win({method: own}, named),
    )
    return replace(own, controls=named, alarms=alarms)


def score_by_deletion(
    run: Run | Path | str,
    frames: Frames,
    maps: Maps,
    *,
    reference: UInt8[np.ndarray, "height width 3"] | None = None,
    fill: str = "grey",
    steps: int | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> DeletionCurves:
    """Score maps as the thesis does: remove the most salient pixels step by step, beside a random order (`control`).

    Kept to compare with published figures; `score` is the one to rely on (docs/deletion.md). Arguments are those of
    `score`, and `steps` until every pixel is gone; the image's height if None, as in the thesis.

    References
    ----------
    Polak, section 4 and eq. 2.
    """
    fill_of_name, trained = get_fill(fill), open_run(run)
    inputs, empty = network_inputs(trained, frames, reference)
    shape = (inputs.shape[-2], inputs.shape[-1])
    salient = np.maximum(_influence(maps, inputs), 0)
    rng = np.random.default_rng(seed)
    orders = np.concatenate([saliency_orders(salient, shape), [random_order(shape, rng=rng) for _ in salient]])
    curves = deletion_curves(
        prepare_passes(trained, inputs, len(orders) * len(deletion_steps(shape, steps=steps))),
        torch.cat([inputs, inputs]),
        orders,
        fill=fill_of_name,
        references=empty.expand(len(orders), -1, -1, -1),
        steps=steps,
        seed=seed,
        on_progress=on_progress,
    )
    own, control = (
        DeletionCurves(pixels_removed=curves.pixels_removed, base=base, predictions=predictions)
        for base, predictions in zip(np.split(curves.base, 2), np.split(curves.predictions, 2), strict=True)
    )
    return replace(own, control=control)


def prepare_passes(trained: Run, inputs: Float[Tensor, "images colours size size"], passes: int) -> Engine:
    """Make an engine ready for so many passes of a network, checked on a few of its inputs, on the network's device."""
    some = inputs[:_CHECKED_IMAGES].to(trained.device)
    return prepare(trained.model, some, trained.predict(some).to(trained.device), passes=passes)


def _influence(maps: Maps, inputs: Tensor) -> Float64[np.ndarray, "images height width"]:
    values = maps.influence.double().cpu().numpy() if isinstance(maps, Explanation) else maps.astype(np.float64)
    if len(values) != len(inputs):
        raise SaliencyError(f"there are {len(values)} maps of {len(inputs)} frames; explain the frames that are scored")
    for index, each in enumerate(values):
        require_saliency(each, inputs.shape[-2:], where=f"map {index}")
    return values
