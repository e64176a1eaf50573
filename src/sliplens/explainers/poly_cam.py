"""Poly-CAM for a regressor: channel masks, scored by what they keep and what they remove, all of them or some."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from statistics import fmean
from typing import ClassVar, TypeAlias

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from sliplens.errors import InputError
from sliplens.explainers.attribution import (
    ALIKE_R,
    ALIKE_TOP,
    FLOOR,
    Approximation,
    Attribution,
    change_of,
    check_approximations,
    check_weights,
    combine,
    layer_map,
    local_change,
    pearson_r,
    resize,
    scale_to,
    to_masks,
    top_overlap,
    widest,
)
from sliplens.explainers.cam import capture, find_layers, find_published_layers
from sliplens.explainers.contract import Comparison, Method, black_frames, require_at_least_one
from sliplens.models.engines import Engine
from sliplens.progress import report_progress

SCORES = ("regression", "thesis")
_PASSES = 2  # of a channel: the image with only its region, and without it
Likeness: TypeAlias = tuple[float, float]
"""Required likeness of a map from some channels to the exact one: correlation, and overlap of the strongest tenth."""


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """One image with the regions of all its channels, those of every layer in a row."""

    image: Float[Tensor, "colours height width"]
    empty: Float[Tensor, "colours height width"]
    """Image outside a region, b."""
    prediction: Float[Tensor, ""]
    empty_prediction: Float[Tensor, ""]
    activations: list[Float[Tensor, "_channels _rows _columns"]]
    visible: Float[Tensor, "height width"]
    """How much of a change the image shows: where x = b no mask has an effect."""
    published: bool
    """Masks and scores of the public code."""
    engine: Engine
    count: Callable[[int], None]

    @property
    def size(self) -> tuple[int, int]:
        return self.image.shape[-2], self.image.shape[-1]

    @cached_property
    def masks(self) -> list[Float[Tensor, "_channels _rows _columns"]]:
        return [to_masks(maps, as_published=self.published) for maps in self.activations]

    @cached_property
    def active(self) -> Int[Tensor, " some"]:
        """Channels whose mask is not empty; an empty one keeps nothing and removes nothing. A mask of NaN is active."""
        return torch.nonzero(torch.cat([(masks != 0).flatten(1).any(dim=1) for masks in self.masks])).flatten()

    def supports(
        self, kept: Float[Tensor, " channels"], removed: Float[Tensor, " channels"]
    ) -> Float[Tensor, " channels"]:
        """Score channels by the predictions with only their regions, and without them: below 0 they get no weight."""
        if self.published:
            # in float32 the sigmoid of a percentage is 1 from 17 % on, so that all weights are 1
            kept, removed, whole = (torch.sigmoid(100 * value) for value in (kept, removed, self.prediction))
            return kept + (whole - removed)
        change = self.prediction - self.empty_prediction
        effect = ((kept - self.empty_prediction) + (self.prediction - removed)) / 2
        # no map changes by the division, since each is normalised; it keeps clear of the floor in `combine`
        return effect / change if change else torch.zeros_like(effect)

    def measure(self, channels: Int[Tensor, " some"]) -> Float[Tensor, " some"]:
        """Score some channels, in rising order, in batches of the engine."""
        parts = channels.split(max(1, self.engine.batch_size // _PASSES)) if len(channels) else ()

        def batches() -> Iterator[Tensor]:
            for part in parts:
                # in pieces, where even one channel's images are more than a batch
                yield from self._blend(part).split(self.engine.batch_size)

        waiting, points = list(parts), [self.image.new_zeros(_PASSES, 0)]
        pieces: list[Tensor] = []
        for predictions in self.engine.run(batches()):
            pieces.append(predictions)
            if sum(map(len, pieces)) == _PASSES * len(waiting[0]):
                points.append(torch.cat(pieces).reshape(_PASSES, -1))
                self.count(len(waiting.pop(0)))
                pieces = []
        kept, removed = torch.cat(points, dim=1)
        return self.supports(kept, removed)

    def _blend(self, channels: Int[Tensor, " some"]) -> Float[Tensor, "images colours height width"]:
        """Mask images by some channels, in rising order: all that are kept, then all that are removed."""
        parts, first = [], 0
        for masks in self.masks:
            inside = channels[(channels >= first) & (channels < first + len(masks))] - first
            if len(inside):
                parts.append(resize(masks[inside], self.size))
            first += len(masks)
        content = (self.image - self.empty) * torch.cat(parts)[:, None]
        return torch.cat([self.empty + content, self.image - content])

    def weights(self, supports: Float[Tensor, " active"]) -> list[Float[Tensor, " _channels"]]:
        """Weights >= 0 of each layer's channels from the scores of the active ones; an empty mask needs no pass."""
        at_empty = self.supports(self.empty_prediction[None], self.prediction[None])
        every = at_empty.to(supports).repeat(sum(map(len, self.activations)))
        every[self.active] = supports
        return list(torch.relu(every).to(at_empty.dtype).split([len(maps) for maps in self.activations]))

    def to_map(self, weights: Sequence[Float[Tensor, " _channels"]]) -> Float[Tensor, "height width"]:
        return combine(self.activations, weights, size=self.size) * self.visible


@dataclass(frozen=True, kw_only=True)
class PolyCam(Method):
    """Poly-CAM with the regression score.

    A channel's mask M (its activation between its extreme percentiles, resized to the image) blends the image x with
    the reference b. Its effect in margin units is the mean of

        kept     f(b + (x - b) M) - f(b)
        removed  f(x) - f(b + (x - b) (1 - M))

    which is 0 for the empty mask and f(x) - f(b) for the full one. A channel's weight is relu(effect / (f(x) - f(b))),
    the part that supports the change.

    The layers' maps are refined from the coarsest to the finest. The finest, times how much the image differs from the
    reference thereabouts, is the saliency; the relevance is that scaled to add up to f(x) - f(b), a convention that
    says nothing about how much one pixel contributes.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM: High resolution class activation map for convolutional neural
    networks*, ICPR 2022. The regression score and the budget are ours.
    """

    method: ClassVar[str] = "poly-cam"
    score: str = "regression"
    """One of `SCORES`: `thesis` is that of the public code for a network with one output, for comparison with old
    figures; it takes no reference, and explains nothing."""
    layers: tuple[str, ...] | None = None
    """Names of the layers; by default those that belong to the score."""
    level: int = 0
    """Which level's map is the relevance, counted from the finest, 0; the thesis scored `level=5`. Layers finer than
    that have no part in it, and cost no pass."""
    budget: float = 1.0
    """Share of the channels to measure at first, in (0, 1]; 1 for the exact map. The other channels' weights are
    estimated, and `Attribution.approximations` says what the map is expected to have in common with the exact one."""
    likeness: Likeness | None = (ALIKE_R, ALIKE_TOP)
    """Likeness to the exact map until whose expectation channels are measured. None to stop at the budget."""
    engine: str = "auto"
    batch_size: int | None = None
    """Masked images in one pass; None for what suits the engine."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.score not in SCORES:
            raise InputError(f"Poly-CAM has no score {self.score!r}; choose among {', '.join(SCORES)}")
        require_at_least_one("Poly-CAM", batch_size=1 if self.batch_size is None else self.batch_size)
        if not 0 < self.budget <= 1:
            raise InputError(f"Poly-CAM's budget is {self.budget}; give a share of the channels, above 0 and at most 1")
        if self.likeness is not None and not all(0 <= value <= 1 for value in self.likeness):
            raise InputError(f"Poly-CAM's likeness is {self.likeness}; give two numbers from 0 to 1")

    @torch.no_grad()
    def _explain(self, comparison: Comparison) -> Attribution:
        change, published = comparison.change.tolist(), self.score == "thesis"
        find = find_published_layers if published and self.layers is None else partial(find_layers, names=self.layers)
        layers = find(comparison.model, comparison.images[:1])
        if not 0 <= self.level < len(layers):
            raise InputError(f"Poly-CAM has no level {self.level} for {len(layers)} layers; count from 0, the finest")
        layers = layers[self.level :]  # a level is made of its own layer and the coarser ones
        channels = sum(layer.channels for layer in layers)
        done = 0

        def count(channels_done: int) -> None:
            nonlocal done
            done += channels_done
            report_progress(done, len(comparison.images) * channels)

        # one engine for all rounds and images
        engine = comparison.prepare(
            len(comparison.images) * round(self.budget * channels) * _PASSES,
            engine=self.engine,
            batch_size=self.batch_size,
        )
        names = [layer.name for layer in layers]
        weights, maps, approximations = [], [], []
        for index, image in enumerate(comparison.images):
            with capture(comparison.model, names) as outputs:
                comparison.predict(image[None])
            empty = black_frames(image) if published else comparison.reference[index]
            frame = _Frame(
                image=image,
                empty=empty,
                prediction=comparison.prediction[index],
                empty_prediction=comparison.predict(empty[None])[0]
                if published
                else comparison.reference_prediction[index],
                activations=[outputs[name][0] for name in names],
                visible=torch.ones_like(image[0]) if published else local_change(image, empty),
                published=published,
                engine=engine,
                count=count,
            )
            count(channels - len(frame.active))
            if self.budget < 1 and len(frame.active):
                supports, approximation = _search(frame, budget=self.budget, likeness=self.likeness, seed=self.seed)
                count(len(frame.active) - approximation.measured)
                approximations.append(approximation)
            else:
                supports = frame.measure(frame.active)
            weights.append(frame.weights(supports))
            maps.append(frame.to_map(weights[-1]))
        attribution = comparison.attribution(
            scale_to(torch.stack(maps), total=comparison.change),
            complete=True,
            warnings=(*check_weights(names, weights, change=change), *check_approximations(approximations)),
        )
        return replace(attribution, approximations=tuple(approximations), engine=engine.name)


_GRID = 14  # cells a side on which masks are compared; more cells change nothing
_LENGTH = 3.0  # of the kernel, in median distances between masks
_NUGGET = 1e-3  # share of the variance that masks alike may still differ by
_JITTER = 1e-6
_FIRST = 0.3  # share of the budget spent before any effect is estimated
_ROUNDS = 6
_DRAWS = 16
_GROWTH = 1.25  # channels measured after a further round, over those before it
_SURE = 2  # allowed over expected shortfall; the true one was found to be up to 1.7 times the expected
_NEARLY_ALL = 0.75  # where so many would be measured, the rest costs little and leaves nothing to estimate


def _mask_kernel(frame: _Frame) -> Float[Tensor, "active active"]:
    """Covariance of the effects of two channels: exp(-distance of what their masks uncover / length).

    What a mask uncovers is its mean over each of 14 x 14 cells, times the contrast |x - b| there. Rasmussen and
    Williams, *Gaussian processes for machine learning* (2006), eq. 4.18.
    """
    contrast = change_of(frame.image, frame.empty)
    weights = functional.adaptive_avg_pool2d(contrast[None], _GRID).flatten()
    # cells smaller than the grid's are averaged, larger ones repeated
    pooled = [functional.adaptive_avg_pool2d(maps[:, None], _GRID).flatten(1) for maps in frame.masks]
    features = widest(torch.cat(pooled)[frame.active]) * widest(weights)
    distance = torch.cdist(features, features)
    return torch.exp(-distance / (_LENGTH * distance.median().clamp_min(1e-12)))


class GaussianProcess:
    """Gaussian process of the effects of all channels, some of which are measured one after another.

    The factor L of the covariance is built column by column (a pivoted Cholesky decomposition), so that the variance
    that is left after each choice is known before anything is measured.

    Rasmussen and Williams, *Gaussian processes for machine learning* (2006), eqs. 2.23 and 2.24.
    """

    def __init__(self, kernel: Float[Tensor, "channels channels"]) -> None:
        self._kernel = kernel
        self._factor = kernel.new_zeros(len(kernel), 0)
        self._variance = kernel.diagonal().clone()
        self.chosen: list[int] = []
        """Channels chosen so far, in their order."""
        self._effects = kernel.new_zeros(0)

    def choose(self, count: int, *, importance: Float[Tensor, " channels"]) -> Int[Tensor, " count"]:
        """Choose channels, each the one with the most importance x standard deviation left after those before it."""
        first = len(self.chosen)
        self._factor = torch.cat([self._factor, self._factor.new_zeros(len(self._factor), count)], dim=1)
        free = torch.ones_like(self._variance)
        free[self.chosen] = -1  # never again, even where nothing is uncertain
        for place in range(first, first + count):
            pivot = int(torch.where(free > 0, self._variance * importance**2, -1.0).argmax())
            root = math.sqrt(float(self._variance[pivot]) + _NUGGET)
            column = (self._kernel[:, pivot] - self._factor[:, :place] @ self._factor[pivot, :place]) / root
            column[pivot] = root
            self._factor[:, place] = column
            self._variance = (self._variance - column**2).clamp_min(0)
            free[pivot] = -1
            self.chosen.append(pivot)
        return torch.tensor(self.chosen[first:], device=self._kernel.device)

    def learn(self, effects: Float[Tensor, " count"]) -> None:
        """Add the measured effects of the channels chosen last, in their order."""
        self._effects = torch.cat([self._effects, effects.to(self._effects)])

    def estimate(self) -> tuple[Float[Tensor, " channels"], Float[Tensor, " channels"]]:
        """Effect of every channel, and its standard deviation: 0 for those measured."""
        chosen, factor, mean = torch.tensor(self.chosen), self._factor[:, : len(self.chosen)], self._effects.mean()
        residual = torch.linalg.solve_triangular(factor[chosen], (self._effects - mean)[:, None], upper=False)
        estimate = mean + (factor @ residual)[:, 0]
        estimate[chosen] = self._effects
        # the prior variance that makes what was measured most likely (eq. 5.8 solved for a factor of the kernel)
        deviation = (self._variance * (residual**2).mean()).sqrt()
        deviation[chosen] = 0
        return estimate, deviation

    def draws(self, count: int, *, generator: torch.Generator) -> Float[Tensor, "count channels"]:
        """Draw effects of every channel from the distribution conditional on those measured."""
        estimate, deviation = self.estimate()
        draws, free = estimate.repeat(count, 1), torch.nonzero(deviation > 0).flatten()
        if len(free):
            factor = self._factor[free, : len(self.chosen)]
            covariance = self._kernel[free][:, free] - factor @ factor.T
            covariance.diagonal().add_(_JITTER)
            root, _ = torch.linalg.cholesky_ex(covariance)
            noise = torch.randn(count, len(free), generator=generator, dtype=root.dtype).to(root.device)
            draws[:, free] += deviation[free[0]] / self._variance[free[0]].sqrt() * (noise @ root.T)
        return draws


def _search(
    frame: _Frame, *, budget: float, likeness: Likeness | None, seed: int
) -> tuple[Float[Tensor, " active"], Approximation]:
    """Measure channels where they matter to the map, and estimate the scores of the others from them.

    A share of the channels (`budget`, in (0, 1)) is measured at first, more until the likeness is reached. The scores
    are taken for a Gaussian process over the masks, from which maps that may be the exact one are drawn.
    """
    process, total = GaussianProcess(_mask_kernel(frame)), len(frame.active)

    def explore(until: int) -> None:
        if (count := until - len(process.chosen)) < 1:
            return
        chosen = process.choose(count, importance=widest(_importance(frame, process)))
        order = chosen.argsort()
        process.learn(frame.measure(frame.active[chosen[order]])[order.argsort()])

    count = max(1, math.ceil(budget * total))
    first = math.ceil(_FIRST * count)
    rounds = min(_ROUNDS, max(1, count - first))
    for step in range(rounds + 1):
        explore(first + (count - first) * step // rounds)
    while True:
        estimate, _ = process.estimate()
        result = frame.to_map(frame.weights(estimate))
        draws = process.draws(_DRAWS, generator=torch.Generator().manual_seed(seed))
        drawn = [frame.to_map(frame.weights(supports)) for supports in draws]
        approximation = Approximation(
            measured=len(process.chosen),
            channels=total,
            pearson_r=fmean(pearson_r(result, other) for other in drawn),
            top_overlap=fmean(top_overlap(result, other) for other in drawn),
        )
        expected = approximation.pearson_r, approximation.top_overlap
        # not "short > allowed": of a map that holds NaN nothing is expected
        if (
            likeness is None
            or count == total
            or all(_SURE * (1 - value) <= 1 - required for value, required in zip(expected, likeness, strict=True))
        ):
            return estimate, approximation
        wanted = math.ceil(_GROWTH * count)
        count = total if wanted > _NEARLY_ALL * total else wanted
        explore(count)


def _importance(frame: _Frame, process: GaussianProcess) -> Float[Tensor, " active"]:
    """Compute how much an error of each score changes the map."""
    norms = [maps.flatten(1).norm(dim=1) for maps in frame.activations]
    if not process.chosen:
        return torch.cat([norm / norm.norm().clamp_min(FLOOR) for norm in norms])[frame.active]
    estimate, deviation = process.estimate()
    layers = zip(norms, frame.activations, frame.weights(estimate), strict=True)
    shares = [norm / layer_map(maps, weights).norm().clamp_min(FLOOR) for norm, maps, weights in layers]
    odds = torch.special.ndtr(estimate / deviation.clamp_min(FLOOR))
    return torch.cat(shares)[frame.active].clamp_max(1 / FLOOR) * odds
