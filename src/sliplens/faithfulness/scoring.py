"""Scores of explanations: the sound one in one call, the deletion score of the thesis, and where neither measures."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Float64, Int, UInt8
from scipy.stats import kendalltau
from torch import Tensor

from sliplens.errors import InputError, SaliencyError
from sliplens.explainers.attribution import CLOSE, Attribution
from sliplens.explainers.table import network_inputs
from sliplens.faithfulness.controls import control_maps
from sliplens.faithfulness.fills import Fill, get_fill
from sliplens.faithfulness.removal import (
    AREAS,
    RANDOM_ORDERS,
    Faithfulness,
    Predict,
    removal_curves,
    score_maps,
    tile_units,
)
from sliplens.models import Network
from sliplens.models.checkpoint import open_run
from sliplens.models.engines import Engine, prepare
from sliplens.progress import OnProgress
from sliplens.results.explanation import require_saliency


@dataclass(frozen=True, kw_only=True)
class DeletionCurves:
    """Answers of a network while pixels are removed, for several images."""

    pixels_removed: Int[np.ndarray, " steps"]
    """Pixels that are gone at each step."""
    base: Float64[np.ndarray, " images"]
    """Answer on the whole image, in margin units."""
    predictions: Float64[np.ndarray, "images steps"]
    """Answer at each step, in margin units."""
    control: "DeletionCurves | None" = None
    """The same in random order, where it was asked for: a method that does not beat it has shown nothing."""

    @property
    def scores(self) -> Float64[np.ndarray, "images steps"]:
        """Deletion score D at each step."""
        return deletion_score(self.base[:, None], self.predictions)

    @property
    def auc(self) -> Float64[np.ndarray, " images"]:
        """D_AUC of each image: the mean of D over the steps."""
        return self.scores.mean(axis=1)

    def frame(self) -> pa.Table:
        """Arrow table, a row for each image and step: pixels removed, prediction in margin units, score D."""
        images, steps = self.predictions.shape
        return pa.table(
            {
                "image": np.repeat(np.arange(images), steps),
                "pixels_removed": np.tile(self.pixels_removed, images),
                "prediction": self.predictions.ravel(),
                "score": self.scores.ravel(),
            }
        )


def deletion_score(
    base: Float[np.ndarray, "*shape"], masked: Float[np.ndarray, "*shape2"]
) -> Float[np.ndarray, "*shape3"]:
    """Deletion score D = (1 - |y_base - y_mask|)^2 of answers in margin units; lower means more was destroyed.

    References
    ----------
    Polak, eq. 2 (there in percent, hence divided by 100).

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.faithfulness.scoring import deletion_score
    >>> deletion_score(np.array(0.9), np.array([0.9, 0.4])).round(2)  # nothing destroyed; half of the range
    array([1.  , 0.25])
    """
    return (1 - np.abs(base - masked)) ** 2


def deletion_order(saliency: Float[np.ndarray, "height width"]) -> Int[np.ndarray, " pixels"]:
    """Flat pixel indices from most to least salient; of ties the later pixel first, as in the thesis's masks.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.faithfulness.scoring import deletion_order
    >>> deletion_order(np.array([[0.1, 0.9], [0.5, 0.1]]))
    array([1, 2, 3, 0])
    """
    return np.argsort(saliency.ravel(), kind="stable")[::-1].copy()


def random_order(shape: tuple[int, int], *, rng: np.random.Generator) -> Int[np.ndarray, " pixels"]:
    """Flat pixel indices in random order: the control that every explanation has to beat."""
    return rng.permutation(shape[0] * shape[1])


def deletion_steps(shape: tuple[int, int], *, steps: int | None = None) -> Int[np.ndarray, " steps"]:
    """Pixels removed at each step: as many steps as the image is high, the last of which removes all.

    Polak, section 4 (n_masks = 224 for a 224 x 224 image: 224 steps of 224 pixels).
    """
    pixels = shape[0] * shape[1]
    count = steps or shape[0]
    if not 1 <= count <= pixels:
        raise InputError(f"deletion in {count} steps is impossible with {pixels} pixels; choose 1 to {pixels}")
    return np.round(np.linspace(0, pixels, count + 1)[1:]).astype(np.int64)


def deletion_curves(
    predict: Predict,
    images: Float[Tensor, "images colours height width"],
    orders: Int[np.ndarray, "images pixels"],
    *,
    fill: Fill,
    references: Float[Tensor, "images colours height width"] | None = None,
    steps: int | None = None,
    seed: int = 0,
    batch_size: int = 128,
    on_progress: OnProgress | None = None,
) -> DeletionCurves:
    """Answers of a network while pixels are removed in one order an image (`deletion_order`, `random_order`).

    So many `steps`, the image's height if None, as in the thesis; all else is as for `removal_curves`.

    Examples
    --------
    A network that reads the mean brightness: bright pixels on black, removed one by one.

    >>> import numpy as np
    >>> import torch
    >>> from sliplens.faithfulness.fills import get_fill
    >>> from sliplens.faithfulness.scoring import deletion_curves, deletion_order
    >>> image = torch.zeros(1, 3, 2, 2)
    >>> image[0, :, 0] = 1.0
    >>> order = deletion_order(image[0, 0].numpy())[None]
    >>> curves = deletion_curves(
    ...     lambda inputs: inputs.mean(dim=(1, 2, 3)), image, order, fill=get_fill("black"), steps=4
    ... )
    >>> curves.predictions
    array([[0.25, 0.  , 0.  , 0.  ]])
    """
    removed = deletion_steps((images.shape[-2], images.shape[-1]), steps=steps)
    curves = removal_curves(
        predict,
        images,
        orders[None],
        fill=fill,
        references=references,
        areas=[0.0, *removed / removed[-1]],
        seed=seed,
        batch_size=batch_size,
        on_progress=on_progress,
    )
    answers = curves.answers[0]
    return DeletionCurves(pixels_removed=removed, base=answers[:, 0], predictions=answers[:, 1:])


def saliency_orders(saliency: Float[np.ndarray, "images height width"], shape: tuple[int, int]) -> np.ndarray:
    """Deletion orders of several maps."""
    maps = [require_saliency(each, shape, where=f"saliency map {index}") for index, each in enumerate(saliency)]
    return np.stack([deletion_order(each) for each in maps])


FILL_DECIDES = 0.05
"""An image of nothing but fill that is answered this near to the whole image, in margin units."""
_TIED_TO_LAST = 0.8
_SATURATED = 0.01
_SAME_ORDER = 0.5
_FEWEST = 3


def fill_decides(whole: Float[np.ndarray, " images"], filled: Float[np.ndarray, " images"], *, fill: str) -> list[str]:
    """Say in how many images the fill alone is answered like the whole image: there no map can move the answer."""
    near = int(np.sum(np.abs(whole - filled) < FILL_DECIDES))
    sentence = (
        f"the fill decides in {near} of {len(whole)} frames: an image of nothing but {fill} is answered within "
        f"{FILL_DECIDES:.0%} of the whole frame"
    )
    return [sentence] if near else []


def follows_last_step(
    score: Float[np.ndarray, " images"], last: Float[np.ndarray, " images"], *, name: str
) -> list[str]:
    """Say whether a score follows its own last step, where all is filled and no map has a part."""
    if len(score) < _FEWEST or np.std(score) == 0 or np.std(last) == 0:
        return []
    tied = float(np.corrcoef(score, last)[0, 1])
    if tied < _TIED_TO_LAST:
        return []
    return [f"{name} correlates with its last step by {tied:.2f}: it measures the fill rather than the map"]


def little_to_explain(change: Float[np.ndarray, " images"]) -> list[str]:
    """Say in how many images the answer is nearly that on the untouched sensor, so that its direction is chance."""
    few = int(np.sum(np.abs(change) < CLOSE))
    sentence = (
        f"next to nothing to explain in {few} of {len(change)} frames: the answer lies within {CLOSE} of that on the "
        "untouched sensor, less than networks err by, and the direction that a gain counts along is chance; leave them "
        "out"
    )
    return [sentence] if few else []


def saturated(answers: Float[np.ndarray, " images"]) -> list[str]:
    """Say how many answers lie at an end of [0, 1] or outside: they move one way only."""
    ends = int(np.sum((answers < _SATURATED) | (answers > 1 - _SATURATED)))
    return [f"{ends} of {len(answers)} answers lie at an end of the margin: they can move one way only"] if ends else []


def flat_maps(maps: Mapping[str, Float[np.ndarray, "images height width"]]) -> list[str]:
    """Say which methods gave maps that are constant, or hold NaN: they rank nothing."""
    alarms = []
    for method, values in maps.items():
        bad = int(np.sum(~np.isfinite(values).all(axis=(1, 2))))
        flat = int(np.sum(values.max(axis=(1, 2)) == values.min(axis=(1, 2))))
        alarms += [f"{method}: {bad} of {len(values)} maps hold NaN or infinity"] if bad else []
        alarms += [f"{method}: {flat} of {len(values)} maps are constant and rank nothing"] if flat else []
    return alarms


def rankings_disagree(scores: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Say which fills rank the methods differently, by Kendall's tau; scores by fill, then by method.

    Kendall, *A new measure of rank correlation* (1938).
    """
    alarms = []
    for first, second in combinations(scores, 2):
        methods = sorted(set(scores[first]) & set(scores[second]))
        if len(methods) < _FEWEST:
            continue
        ranked = ([scores[fill][method] for method in methods] for fill in (first, second))
        tau = float(np.asarray(kendalltau(*ranked))[0])
        if not tau >= _SAME_ORDER:
            alarms.append(
                f"{first} and {second} rank the methods differently (Kendall's tau {tau:.2f}): which is best depends "
                "on what removed pixels become"
            )
    return alarms


def controls_win(scores: Mapping[str, Faithfulness], controls: Mapping[str, Faithfulness]) -> list[str]:
    """Say which methods gain no more than a map that knows nothing of the network, or than random orders."""
    alarms = []
    best = max(controls, key=lambda name: float(controls[name].symmetric_gain.mean()), default=None)
    for method, score in scores.items():
        gain = float(score.symmetric_gain.mean())
        if gain <= 0:
            alarms.append(f"{method} does not beat a random order: its symmetric gain is {gain:.3f}")
        elif best is not None and gain <= (control := float(controls[best].symmetric_gain.mean())):
            alarms.append(f"{method} gains {gain:.3f}, no more than the control {best} ({control:.3f})")
    return alarms


Frames: TypeAlias = UInt8[np.ndarray, "images height width 3"]
Maps: TypeAlias = Attribution | Float[np.ndarray, "maps rows columns"]
"""Attribution of the frames, or a number for each pixel of the network's input, whose meaning `signed` names."""
_CHECKED_IMAGES = 4
_TILES_ACROSS = 14


def score(
    run: Network | Path | str,
    frames: Frames,
    maps: Maps,
    *,
    signed: bool = True,
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
    controls, which know nothing of the network, has shown nothing. Every frame that is given counts; an alarm says of
    how many the answer is nearly that on the untouched sensor, which a study leaves out (`worth_scoring`).

    Parameters
    ----------
    run
        The network that was explained, its folder, or the name of one that comes with sliplens.
    frames, reference
        As `explain` took them.
    maps
        What `explain` gave; or an array (frames, size, size) of one number a pixel of the network's input.
    signed
        Meaning of an array. True: above zero where a pixel raises the prediction, as `Attribution.relevance` and the
        attributions of Captum, summed over the colours. Pixels then rank by sign(f(x) - f(reference)) times the map,
        as those of an `Attribution` do. False: larger where a pixel matters more, whichever way the prediction went,
        as a saliency in [0, 1].
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
        If there is not a map a frame, or one has another size than the network's input, or holds NaN; or if a signed
        array has no number below zero for a frame whose prediction fell.
    """
    fill_of_name, trained = get_fill(fill), open_run(run)
    inputs, empty = network_inputs(trained, frames, reference)
    method = maps.method if isinstance(maps, Attribution) else "maps"
    whole, untouched = (trained.predict(images).double().numpy() for images in (inputs, empty[None]))
    towards = np.sign(whole - untouched)
    influence = {method: _influence(maps, inputs, towards=towards, signed=signed)}
    influence |= control_maps(trained.model, inputs, empty.expand_as(inputs))
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
        *little_to_explain(whole - untouched),
        *saturated(whole),
        *flat_maps({method: influence[method]}),
        *fill_decides(whole, filled, fill=fill),
        *controls_win({method: own}, named),
    )
    return replace(own, controls=named, alarms=alarms)


def score_by_deletion(
    run: Network | Path | str,
    frames: Frames,
    maps: Maps,
    *,
    signed: bool = True,
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
    whole, untouched = (trained.predict(images).double().numpy() for images in (inputs, empty[None]))
    salient = np.maximum(_influence(maps, inputs, towards=np.sign(whole - untouched), signed=signed), 0)
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


def prepare_passes(trained: Network, inputs: Float[Tensor, "images colours size size"], passes: int) -> Engine:
    """Make an engine ready for so many passes of a network, checked on a few of its inputs, on the network's device."""
    some = inputs[:_CHECKED_IMAGES].to(trained.device)
    return prepare(trained.model, some, trained.predict(some).to(trained.device), passes=passes)


def _influence(
    maps: Maps, inputs: Tensor, *, towards: Float[np.ndarray, " images"], signed: bool
) -> Float64[np.ndarray, "images height width"]:
    """Rank the pixels by what works towards the prediction, `towards` the sign of f(x) - f(reference)."""
    of_record = isinstance(maps, Attribution)
    values = maps.influence.double().cpu().numpy() if of_record else maps.astype(np.float64)
    if len(values) != len(inputs):
        raise SaliencyError(f"there are {len(values)} maps of {len(inputs)} frames; explain the frames that are scored")
    for index, each in enumerate(values):
        require_saliency(each, inputs.shape[-2:], where=f"map {index}")
    if of_record or not signed:
        return values
    for index in np.flatnonzero((towards < 0) & (values.min(axis=(1, 2)) >= 0) & (values.max(axis=(1, 2)) > 0)):
        raise SaliencyError(
            f"map {index} has no number below 0, but the prediction of its frame is lower than that of the untouched "
            "sensor, which a signed map must explain by pixels that lower it; if its numbers say how much a pixel "
            "matters whichever way, give signed=False"
        )
    return towards[:, None, None] * values
