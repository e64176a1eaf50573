"""Removal curves: how far the answer moves as the most, the least, and random parts of an image are removed."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from sliplens.errors import InputError
from sliplens.faithfulness.fills import Fill, Painter
from sliplens.faithfulness.units import Units, random_unit_order, unit_order
from sliplens.intervals import Difference, paired_difference
from sliplens.models.engines import Engine
from sliplens.progress import OnProgress

Predict: TypeAlias = Callable[[Tensor], Tensor] | Engine
"""From inputs (batch, 3, height, width) to answers (batch,), in margin units; or an engine made ready for many passes,
which keeps all cores busy (`sliplens.models.engines.prepare`)."""


def answer_whole(predict: Predict, images: Tensor, *, batch_size: int) -> Float64[np.ndarray, " images"]:
    """Answers on whole images."""
    return _collect(predict, images.split(_size(predict, batch_size)), lambda _: None)


def _paint(
    paint: Painter, orders: np.ndarray, jobs: Sequence[tuple[int, int, int]], *, images: Tensor, batch_size: int
) -> Iterator[Tensor]:
    """Images of which parts are gone, a batch in memory at a time; jobs are image, order and pixels removed."""
    ranked, rank = None, torch.empty(0)
    for start in range(0, len(jobs), batch_size):
        batch = jobs[start : start + batch_size]
        gone = torch.empty((len(batch), *images.shape[-2:]), dtype=torch.bool)
        for row, (image, order, pixels) in enumerate(batch):
            if ranked != (image, order):  # jobs that share one stand together, so that it is ranked once
                ranked, rank = (image, order), torch.empty(orders.shape[-1], dtype=torch.int32)
                rank[torch.from_numpy(orders[order, image])] = torch.arange(len(rank), dtype=torch.int32)
                rank = rank.view(gone.shape[1:])
            gone[row] = rank < pixels
        rows = torch.tensor([image for image, _, _ in batch], device=images.device)
        yield paint(rows, gone.to(images.device))


def _size(predict: Predict, batch_size: int) -> int:
    return predict.batch_size if isinstance(predict, Engine) else batch_size


def _collect(
    predict: Predict, batches: Iterable[Tensor], on_batch: Callable[[Tensor], None]
) -> Float64[np.ndarray, " images"]:
    answers = []
    with torch.no_grad():
        for one in predict.run(batches) if isinstance(predict, Engine) else map(predict, batches):
            answers.append(one.double().cpu().numpy())
            on_batch(one)
    return np.concatenate(answers) if answers else np.empty(0)


AREAS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares of the image that are removed; dense where maps differ most."""
RANDOM_ORDERS = 20


@dataclass(frozen=True, kw_only=True)
class RemovalCurves:
    """Answers of a network while parts of an image are removed in several orders."""

    areas: Float64[np.ndarray, " steps"]
    """Share of the image that is gone at each step, from 0 to 1."""
    answers: Float64[np.ndarray, "orders images steps"]
    """Answers in margin units; at step 0 those on the whole images."""

    @property
    def changes(self) -> Float64[np.ndarray, "orders images steps"]:
        """How far each answer lies from that on the whole image, in margin units."""
        return np.abs(self.answers - self.answers[..., :1])

    def lost(self, towards: Float[np.ndarray, " images"]) -> Float64[np.ndarray, "orders images steps"]:
        """How much of what speaks for the target is gone: changes along the sign of f(x) - f(untouched sensor)."""
        return towards[:, None] * (self.answers[..., :1] - self.answers)

    @property
    def mean_changes(self) -> Float64[np.ndarray, "orders images"]:
        """Area under each curve of changes: the mean change over all shares of the image, by trapezoids from 0."""
        return np.trapezoid(self.changes, self.areas, axis=-1)


@dataclass(frozen=True, kw_only=True)
class Faithfulness:
    """What the removal of parts says of the maps of one method, image by image, in margin units.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.faithfulness import Faithfulness
    >>> first, last, random = [[0, 0.4, 0.4]], [[0, 0.0, 0.4]], [[0, 0.2, 0.4]]
    >>> faithfulness = Faithfulness(areas=np.array([0, 0.5, 1.0]), curves=np.array([first, last, random]))
    >>> faithfulness.symmetric_gain, faithfulness.at(0.5)[0]
    (array([0.2]), array([0.4]))
    """

    areas: Float64[np.ndarray, " steps"]
    """Share of the image that is gone at each step, from 0 to 1."""
    curves: Float64[np.ndarray, "3 images steps"]
    """Change of the answer at each step: the most, the least influential parts, and random ones removed first (the mean
    over the random orders). Along the target where it was given, else its size."""
    method: str = ""
    """Name of what was scored, where it has one."""
    fill: str = ""
    """Name of what removed pixels became, where it has one."""
    controls: Mapping[str, "Faithfulness"] = field(default_factory=dict)
    """The same of maps that know nothing of the network, by name (`CONTROLS`), where they were scored too."""
    alarms: tuple[str, ...] = ()
    """Why the score may not measure the maps, a sentence each."""

    @classmethod
    def of_orders(
        cls, curves: RemovalCurves, names: Iterable[str], *, towards: Float[np.ndarray, " images"] | None
    ) -> "dict[str, Faithfulness]":
        """Scores by method from curves whose orders are most and least first of each method, then the random ones."""
        names = list(names)
        changes = curves.changes if towards is None else curves.lost(towards)
        random = changes[2 * len(names) :].mean(axis=0)
        return {
            name: cls(areas=curves.areas, curves=np.stack([changes[2 * row], changes[2 * row + 1], random]))
            for row, name in enumerate(names)
        }

    @property
    def most_first(self) -> Float64[np.ndarray, " images"]:
        """Mean change over all shares of the image, the most influential parts first."""
        return np.trapezoid(self.curves[0], self.areas, axis=-1)

    @property
    def least_first(self) -> Float64[np.ndarray, " images"]:
        """The same, the least influential parts first."""
        return np.trapezoid(self.curves[1], self.areas, axis=-1)

    @property
    def random(self) -> Float64[np.ndarray, " images"]:
        """The same, mean over the random orders."""
        return np.trapezoid(self.curves[2], self.areas, axis=-1)

    @property
    def symmetric_gain(self) -> Float64[np.ndarray, " images"]:
        """Symmetric relevance gain: most less least influential first; 0 for a map that tells nothing.

        References
        ----------
        Bluecher, Vielhaben and Strodthoff, *Decoupling Pixel Flipping and Occlusion Strategy* (2024): SRG.
        """
        return self.most_first - self.least_first

    @property
    def gain_over_random(self) -> Float64[np.ndarray, " images"]:
        """Most influential first less random orders."""
        return self.most_first - self.random

    def interval(self, *, trials: np.ndarray | None = None, seed: int = 0) -> Difference:
        """Mean symmetric gain over the images in margin units, with its 95 % interval.

        Parameters
        ----------
        trials
            Trial of each image: whole trials are resampled, since frames of one resemble one another.
        """
        nothing = np.zeros_like(self.symmetric_gain)
        return paired_difference(self.symmetric_gain, nothing, trials=trials, rng=np.random.default_rng(seed))

    def frame(self) -> pa.Table:
        """Arrow table of the curves, a row for each image and share of it removed, in margin units."""
        images, steps = self.curves.shape[1:]
        return pa.table(
            {
                "image": np.repeat(np.arange(images), steps),
                "area": np.tile(self.areas, images),
                **dict(zip(("most_first", "least_first", "random"), self.curves.reshape(3, -1), strict=True)),
            }
        )

    def at(self, area: float) -> Float64[np.ndarray, "3 images"]:
        """Changes where a share of the image, one of `areas`, is gone: most first, least first, random."""
        step = np.flatnonzero(np.isclose(self.areas, area))
        if not len(step):
            raise InputError(f"there is no step at {area:g} of the image; choose one of {self.areas.tolist()}")
        return self.curves[:, :, step[0]]


def removal_curves(
    predict: Predict,
    images: Float[Tensor, "images 3 height width"],
    orders: Int[np.ndarray, "orders images pixels"],
    *,
    fill: Fill,
    references: Float[Tensor, "images 3 height width"] | None = None,
    areas: Sequence[float] = AREAS,
    seed: int = 0,
    batch_size: int = 64,
    on_progress: OnProgress | None = None,
) -> RemovalCurves:
    """Answers of a network while parts of its input are removed, in several orders each.

    Parameters
    ----------
    predict
        From inputs (batch, 3, height, width) to answers (batch,), in margin units; or an engine made ready.
    images, references
        Inputs in [0, 1], and those of the untouched sensor where the fill needs them.
    orders
        Flat pixel indices, first to be removed first (`unit_order`, `random_unit_order`).
    areas
        Shares of the image to remove, rising from 0 to 1.
    batch_size
        Images that are made and answered at a time: bounds the memory.

    Raises
    ------
    InputError
        If the areas do not rise from 0 to 1.
    """
    shares = np.asarray(areas, dtype=np.float64)
    if shares[0] != 0 or shares[-1] != 1 or np.any(np.diff(shares) <= 0):
        raise InputError(f"areas must rise from 0 to 1, got {list(areas)}")
    removed = np.round(shares * images.shape[-2] * images.shape[-1]).astype(np.int64).tolist()
    last, jobs = len(shares) - 1, []
    for image in range(len(images)):
        jobs += [(image, order, step) for order in range(len(orders)) for step in range(1, last)]
        # what is left of the image when all is gone depends on no order: answered once
        jobs.append((image, 0, last))
    done = 0

    def count(batch: Tensor) -> None:
        nonlocal done
        done += len(batch)
        if on_progress is not None:
            on_progress(done * len(images) // len(jobs), len(images))

    batches = _paint(
        fill(images, references, seed),
        orders,
        [(image, order, removed[step]) for image, order, step in jobs],
        images=images,
        batch_size=_size(predict, batch_size),
    )
    answers = np.empty((len(orders), len(images), len(shares)))
    image_of, order_of, step_of = np.transpose(jobs)
    answers[order_of, image_of, step_of] = _collect(predict, batches, count)
    answers[:, :, 0] = answer_whole(predict, images, batch_size=batch_size)
    answers[:, :, -1] = answers[0, :, -1]
    return RemovalCurves(areas=shares, answers=answers)


def score_maps(
    predict: Predict,
    images: Float[Tensor, "images 3 height width"],
    influence: dict[str, Float[np.ndarray, "images height width"]],
    units: Sequence[Units],
    *,
    fill: Fill,
    rng: np.random.Generator,
    references: Float[Tensor, "images 3 height width"] | None = None,
    towards: Float[np.ndarray, " images"] | None = None,
    random_orders: int = RANDOM_ORDERS,
    areas: Sequence[float] = AREAS,
    seed: int = 0,
    batch_size: int = 64,
    on_progress: OnProgress | None = None,
) -> dict[str, Faithfulness]:
    """Score the maps of several methods on the same images, against the same random orders.

    Maps are larger where a method says that a part of the units (`pixel_units`, `tile_units`, `marker_units`) matters
    more. Of signed relevance give the part that works towards the target, `relevance * sign(target)`, and `towards`,
    the sign of f(x) - f(untouched sensor) of each image: changes count along it; by their size if None.

    Where maps are signed, what speaks against the target is the least influential, and removing it moves the answer the
    other way, as far as removing what speaks for it. By size the two are told apart by nothing: a map of what each
    marker really does then ranks below the same map half shuffled, which it does not along the target (docs/study.md).

    References
    ----------
    Section 3 of the notes on faithfulness; Samek et al., *Evaluating the Visualization of What a Deep Neural Network
    Has Learned* (2017), most and least relevant first.
    """
    orders = [
        np.stack([unit_order(values, unit, least_first=least) for values, unit in zip(maps, units, strict=True)])
        for maps in influence.values()
        for least in (False, True)
    ]
    orders += [np.stack([random_unit_order(unit, rng=rng) for unit in units]) for _ in range(random_orders)]
    curves = removal_curves(
        predict,
        images,
        np.stack(orders),
        fill=fill,
        references=references,
        areas=areas,
        seed=seed,
        batch_size=batch_size,
        on_progress=on_progress,
    )
    return Faithfulness.of_orders(curves, influence, towards=towards)
