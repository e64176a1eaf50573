"""Answers of a network to many images of which parts are removed, in batches across images and steps."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float64, Int
from torch import Tensor

from sliplens.explain.passes import Passes
from sliplens.faithfulness.fills import Painter

Predict: TypeAlias = Callable[[Tensor], Tensor] | Passes
"""From inputs (batch, 3, height, width) to answers (batch,), in margin units; or an engine made ready for many passes,
which keeps all cores busy (`sliplens.explain.passes.prepare`)."""


@dataclass(frozen=True, kw_only=True)
class Removal:
    """One image, of which so many pixels of an order are gone."""

    image: int
    order: Int[np.ndarray, " pixels"]
    """Flat pixel indices; removals that share one stand together, so that it is ranked once."""
    pixels: int


def answer_whole(predict: Predict, images: Tensor, *, batch_size: int) -> Float64[np.ndarray, " images"]:
    """Answers on whole images."""
    return _collect(predict, images.split(_size(predict, batch_size)), lambda _: None)


def answer_removals(
    predict: Predict,
    paint: Painter,
    removals: Iterable[Removal],
    *,
    shape: tuple[int, int],
    device: torch.device,
    batch_size: int,
    on_answers: Callable[[int], None] | None = None,
) -> Float64[np.ndarray, " removals"]:
    """Answers on images of which parts are removed.

    Parameters
    ----------
    predict
        The network.
    paint
        Makes the images, a batch in memory at a time.
    removals
        What to answer, in this order.
    shape, device
        Height and width of the images, and where they are.
    batch_size
        Images at a time; an engine has its own.
    on_answers
        Called with the number of answers so far.
    """
    done = 0

    def count(answers: Tensor) -> None:
        nonlocal done
        done += len(answers)
        if on_answers is not None:
            on_answers(done)

    batches = _paint(paint, removals, shape=shape, device=device, batch_size=_size(predict, batch_size))
    return _collect(predict, batches, count)


def _paint(
    paint: Painter, removals: Iterable[Removal], *, shape: tuple[int, int], device: torch.device, batch_size: int
) -> Iterator[Tensor]:
    ranked, rank = None, torch.empty(0)
    left = iter(removals)
    while some := list(islice(left, batch_size)):
        gone = torch.empty((len(some), *shape), dtype=torch.bool)
        for at, removal in enumerate(some):
            if removal.order is not ranked:
                ranked = removal.order
                rank = torch.empty(len(ranked), dtype=torch.int32)
                rank[torch.from_numpy(ranked)] = torch.arange(len(ranked), dtype=torch.int32)
                rank = rank.view(shape)
            gone[at] = rank < removal.pixels
        rows = torch.tensor([removal.image for removal in some], device=device)
        yield paint(rows, gone.to(device))


def _size(predict: Predict, batch_size: int) -> int:
    return predict.batch_size if isinstance(predict, Passes) else batch_size


def _collect(
    predict: Predict, batches: Iterable[Tensor], on_batch: Callable[[Tensor], None]
) -> Float64[np.ndarray, " images"]:
    answers = []
    with torch.no_grad():
        for one in predict.run(batches) if isinstance(predict, Passes) else map(predict, batches):
            answers.append(one.double().cpu().numpy())
            on_batch(one)
    return np.concatenate(answers) if answers else np.empty(0)
