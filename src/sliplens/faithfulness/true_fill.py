"""The true fill: a marker is removed by drawing the scene with that marker unmoved, which only a simulator can do.

Any other fill puts pixels where no marker ever was, and a network may answer to that; here every image is one that the
sensor could have seen, and what is taken away is the marker's motion and nothing else.
"""

from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sliplens.errors import InputError
from sliplens.faithfulness.removal import RANDOM_ORDERS, Faithfulness, Predict, RemovalCurves, answer_whole
from sliplens.progress import OnProgress

Redraw: TypeAlias = Callable[[int, Bool[np.ndarray, "variants markers"]], Float[Tensor, "variants 3 height width"]]
"""From the number of an image, and the markers that are put back in each variant, to the network's inputs."""

SHARES = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Shares of the markers that are put back: each is drawn anew, and of 42 markers one is 2 %."""


def marker_curves(
    predict: Predict,
    redraw: Redraw,
    orders: Int[np.ndarray, "orders images markers"],
    *,
    batch_size: int = 64,
    on_progress: OnProgress | None = None,
) -> RemovalCurves:
    """Answers of a network while markers are put back, in several orders each.

    Orders are places among an image's markers, first to be put back first. The areas of the result are `SHARES` of the
    markers. What several orders ask for is drawn once, `batch_size` images at a time, which bounds the memory.
    """
    areas, (_, images, markers) = np.asarray(SHARES), orders.shape
    counts = np.round(areas * markers).astype(np.int64)
    answers = np.empty((len(orders), images, len(areas)))
    for image in range(images):
        rank = np.argsort(orders[:, image], axis=-1)
        back = rank[:, None] < counts[:, None]
        distinct, asked = np.unique(back.reshape(-1, markers), axis=0, return_inverse=True)
        answered = [
            answer_whole(predict, redraw(image, distinct[start : start + batch_size]), batch_size=batch_size)
            for start in range(0, len(distinct), batch_size)
        ]
        answers[:, image] = np.concatenate(answered)[asked].reshape(back.shape[:2])
        if on_progress is not None:
            on_progress(image + 1, images)
    return RemovalCurves(areas=areas, answers=answers)


def influence_orders(influence: Float[np.ndarray, "images markers"]) -> Int[np.ndarray, "2 images markers"]:
    """Orders of the markers, from the most to the least influential, and from the least to the most.

    Ties fall alike in both: a map that tells nothing has one order, and gains nothing.
    """
    return np.stack([np.argsort(sign * influence, axis=-1, kind="stable") for sign in (-1, 1)])


def score_maps_by_marker(
    predict: Predict,
    redraw: Redraw,
    influence: Mapping[str, Float[np.ndarray, "images markers"]],
    *,
    rng: np.random.Generator,
    towards: Float[np.ndarray, " images"] | None = None,
    random_orders: int = RANDOM_ORDERS,
    batch_size: int = 64,
    on_progress: OnProgress | None = None,
) -> dict[str, Faithfulness]:
    """Score how much each marker matters to several methods (`unit_means`) by putting them back; see `score_maps`."""
    for name, values in influence.items():
        if not np.isfinite(values).all():
            raise InputError(f"{name} gives some marker no finite influence; leave out markers that no pixel shows")
    orders = [influence_orders(values) for values in influence.values()]
    images, markers = orders[0].shape[1:]
    by_chance = [[rng.permutation(markers) for _ in range(images)] for _ in range(random_orders)]
    asked = np.concatenate([*orders, np.array(by_chance)])
    curves = marker_curves(predict, redraw, asked, batch_size=batch_size, on_progress=on_progress)
    return Faithfulness.of_orders(curves, influence, towards=towards)
