"""Removal curves: change of the prediction while the most, the least and random parts of an image are removed."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from sliplens.errors import InputError
from sliplens.faithfulness.fills import Fill
from sliplens.models.engines import Engine
from sliplens.progress import report_each, report_progress
from sliplens.results.explanation import require_saliency
from sliplens.results.faithfulness import RemovalCurve

_BATCH = 64
"""Images in a batch of a function, which bounds the memory; an engine has its own number."""
Units = Int[np.ndarray, "height width"]
"""Number of what is removed at once, a pixel, a tile or a marker, that each pixel belongs to, from 0."""
Predict: TypeAlias = Callable[[Tensor], Tensor] | Engine
"""Function from inputs (batch, 3, height, width) to answers (batch,), in margin units; or an engine."""
Redraw: TypeAlias = Callable[
    [int, Bool[np.ndarray, "variants markers"]], Float[Tensor, "variants colours height width"]
]
"""True fill: from the number of an image, and the markers put back in each variant, to the inputs of the network."""
AREAS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares of the image that are removed; dense where maps differ most."""
SHARES = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Shares of the markers that are put back: each is drawn again, and of 42 markers one is 2 %."""
RANDOM_ORDERS = 20


def unit_means(values: Float[np.ndarray, "height width"], units: Units) -> Float[np.ndarray, " units"]:
    """Mean of a map over each unit; NaN for one that no pixel belongs to."""
    count = np.bincount(units.ravel())
    with np.errstate(invalid="ignore"):
        return np.bincount(units.ravel(), weights=values.ravel()) / count


def unit_order(
    influence: Float[np.ndarray, "_ _"], units: Units, *, least_first: bool = False
) -> Int[np.ndarray, " pixels"]:
    """Flat pixel indices, unit by unit, by the mean of the map over each, from the most influential or the least on."""
    require_saliency(influence, units.shape, where="the map to rank by")
    means = unit_means(influence, units)[units.ravel()]
    # units in order, the pixels of each in reading order: lexsort is stable, its last key counts first
    return np.lexsort((units.ravel(), means if least_first else -means))


def random_unit_order(units: Units, *, rng: np.random.Generator) -> Int[np.ndarray, " pixels"]:
    """Flat pixel indices, unit by unit, in random order: the control that every map has to beat."""
    rank = rng.permutation(int(units.max()) + 1)
    return np.argsort(rank[units.ravel()], kind="stable")


def _name_curves(
    names: Iterable[str],
    answers: Float64[np.ndarray, "orders images steps"],
    areas: Sequence[float],
    towards: Float[np.ndarray, " images"],
) -> dict[str, RemovalCurve]:
    """Name the changes towards the baseline: most, then least influential first for each method, then at random."""
    names, shares = list(names), np.asarray(areas, dtype=np.float64)
    lost = towards[:, None] * (answers[..., :1] - answers)
    pairs, random = lost[: 2 * len(names)].reshape(-1, 2, *lost.shape[1:]), lost[2 * len(names) :]
    mean = random.mean(axis=0) if len(random) else np.zeros(lost.shape[1:])
    return {
        name: RemovalCurve(areas=shares, most_first=most, least_first=least, random=mean)
        for name, (most, least) in zip(names, pairs, strict=True)
    }


def _as_engine(predict: Predict) -> Engine:
    """Return an engine that runs a function on each batch, or the engine itself."""
    if isinstance(predict, Engine):
        return predict
    return Engine(name="torch", batch_size=_BATCH, answers=lambda batches: ((predict(batch),) for batch in batches))


@torch.no_grad()
def _answer(engine: Engine, batches: Iterable[Tensor]) -> Float64[np.ndarray, " images"]:
    return np.concatenate([np.empty(0), *(margins.cpu().double().numpy() for margins in engine.run(batches))])


def answer_whole(
    predict: Predict, images: Float[Tensor, "images colours height width"]
) -> Float64[np.ndarray, " images"]:
    """Predict whole images."""
    engine = _as_engine(predict)
    return _answer(engine, images.split(engine.batch_size))


def removal_curves(
    predict: Predict,
    images: Float[Tensor, "images colours height width"],
    orders: Int[np.ndarray, "orders images pixels"],
    *,
    fill: Fill,
    references: Float[Tensor, "images colours height width"] | None = None,
    areas: Sequence[float] = AREAS,
    seed: int = 0,
) -> Float64[np.ndarray, "orders images areas"]:
    """Predict inputs, whole and while parts of them are removed, in several orders each.

    Inputs are in [0, 1], as the references, those of the baseline, where the fill needs them. Orders are flat
    pixel indices, first to be removed first (`unit_order`); areas are shares of the image, rising from 0 to 1.
    """
    shares, size = np.asarray(areas, dtype=np.float64), images.shape[-2:]
    removed = np.round(shares * size[0] * size[1]).astype(np.int64).tolist()
    last, jobs, engine, paint = len(shares) - 1, [], _as_engine(predict), fill(images, references, seed)
    for image in range(len(images)):
        jobs += [(image, order, step) for order in range(len(orders)) for step in range(1, last)]
        # what is left of the image when all is gone depends on no order: answered once
        jobs.append((image, 0, last))

    def paint_jobs() -> Iterator[Tensor]:
        for start in range(0, len(jobs), engine.batch_size):
            batch = jobs[start : start + engine.batch_size]
            gone = torch.zeros((len(batch), size.numel()), dtype=torch.bool)
            for row, (image, order, step) in enumerate(batch):
                gone[row, torch.from_numpy(orders[order, image, : removed[step]])] = True
            rows = torch.tensor([image for image, _, _ in batch], device=images.device)
            yield paint(rows, gone.view(-1, *size).to(images.device))
            report_progress((start + len(batch)) * len(images) // len(jobs), len(images))

    answers = np.empty((len(orders), len(images), len(shares)))
    image_of, order_of, step_of = np.transpose(jobs)
    answers[order_of, image_of, step_of] = _answer(engine, paint_jobs())
    answers[:, :, 0] = answer_whole(engine, images)
    answers[:, :, -1] = answers[0, :, -1]
    return answers


def score_maps(
    predict: Predict,
    images: Float[Tensor, "images colours height width"],
    influence: Mapping[str, Float[np.ndarray, "images height width"]],
    units: Sequence[Units],
    *,
    fill: Fill,
    rng: np.random.Generator,
    towards: Float[np.ndarray, " images"],
    references: Float[Tensor, "images colours height width"] | None = None,
    random_orders: int = RANDOM_ORDERS,
    areas: Sequence[float] = AREAS,
    seed: int = 0,
) -> dict[str, RemovalCurve]:
    """Score the maps of several methods on the same images, against the same random orders, if any.

    Of signed relevance give the part that works towards the target; changes count along `towards`, the sign of
    f(x) - f(baseline) of each image.

    Samek et al., *Evaluating the Visualization of What a Deep Neural Network Has Learned* (2017), most and least
    relevant first.
    """
    orders = [
        np.stack([unit_order(values, unit, least_first=least) for values, unit in zip(maps, units, strict=True)])
        for maps in influence.values()
        for least in (False, True)
    ]
    orders += [np.stack([random_unit_order(unit, rng=rng) for unit in units]) for _ in range(random_orders)]
    answers = removal_curves(
        predict, images, np.stack(orders), fill=fill, references=references, areas=areas, seed=seed
    )
    return _name_curves(influence, answers, areas, towards)


def answer_scenes(
    predict: Predict,
    redraw: Callable[[Bool[np.ndarray, "variants markers"]], Float[Tensor, "variants colours height width"]],
) -> Callable[[Bool[np.ndarray, "variants markers"]], Float64[np.ndarray, " variants"]]:
    """Return a function that predicts one scene with markers put back, and caches what it drew."""
    cache: dict[bytes, float] = {}

    def answer(back: Bool[np.ndarray, "variants markers"]) -> Float64[np.ndarray, " variants"]:
        keys_of_rows = [row.tobytes() for row in back]
        new = {key: row for key, row in zip(keys_of_rows, back, strict=True) if key not in cache}
        keys, drawn = list(new), list(new.values())
        for start in range(0, len(new), _BATCH):
            part = slice(start, start + _BATCH)
            cache.update(zip(keys[part], answer_whole(predict, redraw(np.stack(drawn[part]))), strict=True))
        return np.array([cache[key] for key in keys_of_rows])

    return answer


def score_maps_by_marker(
    predict: Predict,
    redraw: Redraw,
    influence: Mapping[str, Float[np.ndarray, "images markers"]],
    *,
    rng: np.random.Generator,
    towards: Float[np.ndarray, " images"],
    random_orders: int = RANDOM_ORDERS,
) -> dict[str, RemovalCurve]:
    """Score how much each marker matters to several methods (`unit_means`) by putting them back; see `score_maps`."""
    for name, values in influence.items():
        if not np.isfinite(values).all():
            raise InputError(f"{name} gives some marker no finite influence; leave out markers that no pixel shows")
    # ties fall alike in both orders
    signed = [sign * values for values in influence.values() for sign in (-1, 1)]
    images, markers = signed[0].shape
    orders = [np.argsort(values, axis=-1, kind="stable") for values in signed]
    orders += [np.stack([rng.permutation(markers) for _ in range(images)]) for _ in range(random_orders)]
    counts = np.round(np.asarray(SHARES) * markers).astype(np.int64)
    answers = np.empty((len(orders), images, len(counts)))
    for image in report_each(range(images)):
        rank = np.argsort([order[image] for order in orders], axis=-1)
        back = rank[:, None] < counts[:, None]
        answer = answer_scenes(predict, partial(redraw, image))  # draws what several orders share once
        answers[:, image] = answer(back.reshape(-1, markers)).reshape(back.shape[:2])
    return _name_curves(influence, answers, SHARES, towards)
