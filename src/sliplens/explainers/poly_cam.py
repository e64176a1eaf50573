"""Poly-CAM for a regressor: channel masks, scored by what they keep and what they remove, all of them or some."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import ClassVar, TypeAlias

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from sliplens.errors import InputError
from sliplens.explainers.attribution import (
    FLOOR,
    Approximation,
    Attribution,
    black_frames,
    change_of,
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
from sliplens.explainers.contract import Comparison, Method
from sliplens.models.engines import Engine
from sliplens.progress import report_each, report_progress

_PASSES = 2  # of a channel: the image with only its region, and without it
Likeness: TypeAlias = tuple[float, float]
"""Required likeness of a map from some channels to the exact one: correlation, and overlap of the strongest tenth."""
_ALIKE: Likeness = (0.99, 0.9)


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """One image with the regions of all its channels, those of every layer in a row."""

    image: Float[Tensor, "colours height width"]
    empty: Float[Tensor, "colours height width"]
    """Image outside a region, b."""
    prediction: Float[Tensor, ""]
    empty_prediction: Float[Tensor, ""]
    activations: list[Float[Tensor, "_channels _rows _columns"]]
    published: bool
    """Masks and scores of the public code."""
    engine: Engine

    @cached_property
    def masks(self) -> list[Float[Tensor, "_channels _rows _columns"]]:
        return [to_masks(maps, as_published=self.published) for maps in self.activations]

    @cached_property
    def active(self) -> Int[Tensor, " some"]:
        """Channels whose mask is not empty; an empty one keeps nothing and removes nothing. A mask of NaN is active."""
        return torch.nonzero(torch.cat([(masks != 0).flatten(1).any(dim=1) for masks in self.masks])).flatten()

    def supports(
        self, inside: Float[Tensor, " channels"], outside: Float[Tensor, " channels"]
    ) -> Float[Tensor, " channels"]:
        """Score channels by the predictions with only their regions, and without them: below 0 they get no weight."""
        if self.published:
            # in float32 the sigmoid of a percentage is 1 from 17 % on, so that all weights are 1
            inside, outside, whole = (torch.sigmoid(100 * value) for value in (inside, outside, self.prediction))
            return inside + (whole - outside)
        change = self.prediction - self.empty_prediction
        effect = ((inside - self.empty_prediction) + (self.prediction - outside)) / 2
        # no map changes by the division, since each is normalised; it keeps clear of the floor in `combine`
        return effect / change if change else torch.zeros_like(effect)

    def measure(self, channels: Int[Tensor, " some"], *, before: int = 0) -> Float[Tensor, " some"]:
        """Score some channels, in rising order, in batches of the engine; report them after those `before`."""
        parts, points = channels.split(self.engine.batch_size // _PASSES), [self.image.new_zeros(_PASSES, 0)]
        for predictions in self.engine.run(self._blend(part) for part in parts if len(part)):
            points.append(predictions.reshape(_PASSES, -1))
            before += points[-1].shape[1]
            report_progress(before, len(self.active))
        return self.supports(*torch.cat(points, dim=1))

    def _blend(self, channels: Int[Tensor, " some"]) -> Float[Tensor, "images colours height width"]:
        """Mask images by some channels, in rising order: all that are kept, then all that are removed."""
        parts, first = [], 0
        for masks in self.masks:
            inside = channels[(channels >= first) & (channels < first + len(masks))] - first
            if len(inside):
                parts.append(resize(masks[inside], (self.image.shape[-2], self.image.shape[-1])))
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
        saliency = combine(self.activations, weights, size=(self.image.shape[-2], self.image.shape[-1]))
        # where x = b no mask has an effect
        return saliency if self.published else saliency * local_change(self.image, self.empty)


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
    published: bool = False
    """Score, layers and black masks of the public code for a network with one output, for comparison with old figures;
    it takes no reference, and explains nothing."""
    level: int = 0
    """Which level's map is the relevance, counted from the finest, 0; the thesis scored `level=5`. Layers finer than
    that have no part in it, and cost no pass."""
    budget: float = 1.0
    """Share of the channels to measure at first, in (0, 1]; 1 for the exact map. The other channels' weights are
    estimated, and `Attribution.approximations` says what the map is expected to have in common with the exact one."""
    likeness: Likeness | None = _ALIKE
    """Likeness to the exact map until whose expectation channels are measured. None to stop at the budget."""
    engine: str = "auto"

    def __post_init__(self) -> None:
        if not 0 < self.budget <= 1:
            raise InputError(f"Poly-CAM's budget is {self.budget}; give a share of the channels, above 0 and at most 1")

    @torch.no_grad()
    def _explain(self, comparison: Comparison) -> Attribution:
        changes = comparison.change.tolist()
        layers = (find_published_layers if self.published else find_layers)(comparison.model, comparison.images)
        if not 0 <= self.level < len(layers):
            raise InputError(f"Poly-CAM has no level {self.level} for {len(layers)} layers; count from 0, the finest")
        names = list(layers)[self.level :]  # a level is made of its own layer and the coarser ones
        channels = sum(layers[name][0] for name in names)
        # one engine for all rounds and images
        passes = len(comparison.images) * round(self.budget * channels) * _PASSES
        engine = comparison.prepare(passes, engine=self.engine)
        maps, approximations, warnings = [], [], []
        for index in report_each(range(len(comparison.images)), sizes=[channels] * len(comparison.images)):
            image = comparison.images[index]
            with capture(comparison.model, names) as outputs:
                comparison.predict(image[None])
            empty, empty_prediction = comparison.reference[index], comparison.reference_prediction[index]
            if self.published:
                empty = black_frames(image)
                empty_prediction = comparison.predict(empty[None])[0]
            frame = _Frame(
                image=image,
                empty=empty,
                prediction=comparison.prediction[index],
                empty_prediction=empty_prediction,
                activations=[outputs[name][0] for name in names],
                published=self.published,
                engine=engine,
            )
            approximation = None
            if self.budget < 1 and len(frame.active):
                supports, approximation = _search(frame, budget=self.budget, likeness=self.likeness)
                approximations.append(approximation)
            else:
                supports = frame.measure(frame.active)
            weights = frame.weights(supports)
            maps.append(frame.to_map(weights))
            faults = [_fault(*pair) for pair in zip(names, weights, strict=True)] if changes[index] else []
            # not "below": of a map that holds NaN nothing is expected
            if approximation is not None and not (
                approximation.pearson_r >= _ALIKE[0] and approximation.top_overlap >= _ALIKE[1]
            ):
                faults.append(
                    f"with {approximation.measured} of {approximation.channels} channels measured the map is expected "
                    f"to correlate with the exact one at {approximation.pearson_r:.3f} and to share "
                    f"{approximation.top_overlap:.0%} of its strongest pixels; raise the budget"
                )
            warnings += [f"image {index}: {fault}" for fault in faults if fault is not None]
        return comparison.attribution(
            scale_to(torch.stack(maps), total=comparison.change),
            complete=True,
            warnings=warnings,
            approximations=approximations,
            engine=engine.name,
        )


def _fault(layer: str, weight: Float[Tensor, " channels"]) -> str | None:
    """Describe the fault of the weights of a layer's channels."""
    if bad := int((~weight.isfinite()).sum()):
        return (
            f"{bad} of {len(weight)} channels of layer {layer} have no finite weight, so the model cannot predict "
            "every masked image"
        )
    if not weight.any():
        return f"no channel of layer {layer} supports f(x) - f(reference), so the map is zero"
    if len(weight) > 1 and bool((weight == weight[0]).all()):
        return (
            f"every channel of layer {layer} has the weight {float(weight[0]):.3g}, so the masked passes chose nothing "
            "and the map shows activity only"
        )
    return None


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
    frame: _Frame, *, budget: float, likeness: Likeness | None
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
        supports = frame.measure(frame.active[chosen[order]], before=len(process.chosen) - count)
        process.learn(supports[order.argsort()])

    count = max(1, math.ceil(budget * total))
    first = math.ceil(_FIRST * count)
    rounds = min(_ROUNDS, max(1, count - first))
    for step in range(rounds + 1):
        explore(first + (count - first) * step // rounds)
    while True:
        estimate, _ = process.estimate()
        result = frame.to_map(frame.weights(estimate))
        draws = process.draws(_DRAWS, generator=torch.Generator().manual_seed(0))
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
