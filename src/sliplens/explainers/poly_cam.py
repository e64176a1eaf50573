"""Poly-CAM for a regressor: channel masks, scored by what they keep and what they remove."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, TypeAlias, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sliplens.errors import InputError
from sliplens.explainers.attribution import (
    Approximation,
    Attribution,
    Level,
    change_of,
    check_approximations,
    check_rounding,
    check_weights,
    combine,
    local_change,
    resize,
    scale_to,
    to_masks,
)
from sliplens.explainers.cam import Layer, capture, find_layers, find_published_layers
from sliplens.explainers.contract import Comparison, Method, black_frames
from sliplens.explainers.poly_cam_budget import ChannelSearch, GaussianProcess, Likeness, mask_kernel
from sliplens.models.engines import Engine
from sliplens.progress import report_progress

VARIANTS = {"+": 1, "-": 1, "+/-": 2}
"""Passes a channel that a variant measures: of the image with only the region kept, with it removed, or both."""
Points: TypeAlias = Float[Tensor, "points channels"]
"""Predictions of the masked images of each channel in margin units: a row for what is kept and one for what is removed,
as far as the variant has them."""
Item = TypeVar("Item")


def _measured(variant: str, inside: Item, outside: Item) -> list[Item]:
    return [inside] * ("+" in variant) + [outside] * ("-" in variant)


def regression_support(image: Tensor, empty: Tensor, points: Points, *, variant: str) -> Tensor:
    """Share of f(x) - f(b) that each channel's region supports: 0 for the empty mask, 1 for the full one.

    Unlike a softmax or sigmoid of the output it is signed and does not saturate. The division changes no map, since
    each is normalised, and keeps the numbers clear of the floor of 1e-12 in `combine`.
    """
    effect = torch.stack(_measured(variant, points[0] - empty, image - points[-1])).mean(dim=0)
    change = image - empty
    return effect / change if change else torch.zeros_like(effect)


def thesis_support(image: Tensor, _empty: Tensor, points: Points, *, variant: str) -> Tensor:
    """Compute the score of the public code for a network with one output: the sigmoid of the percentage.

    In float32 it is 1 from 17 % on, so that there the weights of PCAM+/- are all 1 and those of PCAM- all 0.

    Englebert, Cornu and De Vleeschouwer, *Poly-CAM*, ICPR 2022, eqs. 8 to 10, and its public code for the sigmoid of
    a single output.
    """
    image, points = torch.sigmoid(100 * image), torch.sigmoid(100 * points)
    return torch.stack(_measured(variant, points[0], image - points[-1])).sum(dim=0)


@dataclass(frozen=True, kw_only=True)
class Score:
    """A way to weigh channels, with what belongs to it."""

    support: Callable[..., Float[Tensor, " channels"]]
    """How far each channel speaks for the prediction; below 0 it speaks against it, and gets no weight."""
    layers: Callable[[nn.Module, Tensor], tuple[Layer, ...]]
    """Layers of a network, fine to coarse or as they run, found with one image."""
    as_published: bool
    """Masks as the public code makes them, blended with black; otherwise empty for what is nowhere active, blended
    with the reference."""


SCORES = {
    "regression": Score(support=regression_support, layers=find_layers, as_published=False),
    "thesis": Score(support=thesis_support, layers=find_published_layers, as_published=True),
}


@dataclass(frozen=True, kw_only=True)
class _Regions:
    """One image and the regions of all its channels, those of every layer in a row."""

    image: Float[Tensor, "colours height width"]
    """Image x."""
    empty: Float[Tensor, "colours height width"]
    """Image outside a region, b."""
    masks: list[Float[Tensor, "_channels _rows _columns"]]
    """Masks M in [0, 1] at the resolution of each layer; see `to_masks`."""
    variant: str

    def active(self) -> Int[Tensor, " some"]:
        """Channels whose mask is not empty; an empty one keeps nothing and removes nothing. A mask of NaN is active."""
        return torch.nonzero(torch.cat([(masks != 0).flatten(1).any(dim=1) for masks in self.masks])).flatten()

    def blends(self, channels: Int[Tensor, " some"]) -> Float[Tensor, "images colours height width"]:
        """Masked images of some channels, in rising order: all that are kept, then all that are removed."""
        parts, first = [], 0
        for masks in self.masks:
            inside = channels[(channels >= first) & (channels < first + len(masks))] - first
            if len(inside):
                parts.append(resize(masks[inside], _size(self.image)))
            first += len(masks)
        content = (self.image - self.empty) * torch.cat(parts)[:, None]
        return torch.cat(_measured(self.variant, self.empty + content, self.image - content))

    def measure(self, channels: Int[Tensor, " some"], *, engine: Engine, on_channels: Callable[[int], None]) -> Points:
        """Predictions of the masked images of some channels, in rising order, in batches of the engine."""
        passes = VARIANTS[self.variant]
        # of no channels at all, as where nothing differs from the reference, there is still one empty part
        parts = channels.split(max(1, engine.batch_size // passes)) if len(channels) else ()

        def batches() -> Iterator[Tensor]:
            for part in parts:
                # in pieces, where even one channel's images are more than a batch
                yield from self.blends(part).split(engine.batch_size)

        waiting, points = list(parts), []
        pieces: list[Tensor] = []
        for predictions in engine.run(batches()):
            pieces.append(predictions)
            if sum(map(len, pieces)) == passes * len(waiting[0]):
                points.append(torch.cat(pieces).reshape(passes, -1))
                on_channels(len(waiting.pop(0)))
                pieces = []
        return torch.cat(points, dim=1) if points else self.image.new_zeros(passes, 0)


@dataclass(frozen=True, kw_only=True)
class PolyCam(Method):
    """Poly-CAM with the regression score.

    A channel's mask M (its activation between its extreme percentiles, resized to the image) blends the image x with
    the reference b. Its effect in margin units is measured at one or both ends,

        kept     f(b + (x - b) M) - f(b)                "+"
        removed  f(x) - f(b + (x - b) (1 - M))          "-"

    and their mean is "+/-": 0 for the empty mask, f(x) - f(b) for the full one. A channel's weight is
    relu(effect / (f(x) - f(b))), the part that supports the change.

    The layers' maps are refined from the coarsest to the finest. The finest, times how much the image differs from the
    reference thereabouts, is the saliency; the relevance is that scaled to add up to f(x) - f(b), a convention that
    says nothing about how much one pixel contributes.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM: High resolution class activation map for convolutional neural
    networks*, ICPR 2022. The regression score and the budget are ours.
    """

    method: ClassVar[str] = "poly-cam"
    variant: str = "+/-"
    """One of "+", "-" and "+/-"; the last costs two passes a channel, the others one."""
    score: str = "regression"
    """Score of the masked predictions, a key of `SCORES`: `thesis` is that of the public code for a network with one
    output, for comparison with old figures; it takes no reference, and explains nothing."""
    layers: tuple[str, ...] | None = None
    """Names of the layers; by default those that belong to the score."""
    level: int = 0
    """Which level's map is the relevance, counted from the finest, 0; the thesis scored `level=5`. Layers finer than
    that have no part in it, and cost no pass."""
    budget: float = 1.0
    """Share of the channels to measure at first, in (0, 1]; 1 for the exact map. The other channels' weights are
    estimated, and `Attribution.approximations` says what the map is expected to have in common with the exact one."""
    likeness: Likeness | None = Likeness()  # noqa: RUF009 (frozen)
    """Likeness to the exact map until whose expectation channels are measured. None to stop at the budget."""
    engine: str = "auto"
    batch_size: int | None = None
    """Masked images in one pass; None for what suits the engine."""
    levels: bool = False
    """Keep the saliency and the weights of each layer in the explanation, those finer than `level` too."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise InputError(f"Poly-CAM has no variant {self.variant!r}; choose among {', '.join(VARIANTS)}")
        if self.score not in SCORES:
            raise InputError(f"Poly-CAM has no score {self.score!r}; choose among {', '.join(SCORES)}")
        if self.batch_size is not None and self.batch_size < 1:
            raise InputError(f"Poly-CAM's batch_size is {self.batch_size}; give at least 1")
        if not 0 < self.budget <= 1:
            raise InputError(f"Poly-CAM's budget is {self.budget}; give a share of the channels, above 0 and at most 1")

    @torch.no_grad()
    def _explain(self, comparison: Comparison) -> Attribution:
        change = comparison.change.tolist()
        layers = self._find_layers(comparison)
        channels = sum(layer.channels for layer in layers)
        done = 0

        def count(channels_done: int) -> None:
            nonlocal done
            done += channels_done
            report_progress(done, len(comparison.images) * channels)

        # one engine for all rounds and images
        engine = comparison.prepare(
            len(comparison.images) * round(self.budget * channels) * VARIANTS[self.variant],
            engine=self.engine,
            batch_size=self.batch_size,
        )
        names = [layer.name for layer in layers]
        weights, saliencies, maps, approximations = [], [], [], []
        for index in range(len(comparison.images)):
            with capture(comparison.model, names) as outputs:
                comparison.predict(comparison.images[index, None])
            activations = [outputs[name][0] for name in names]
            visible = self._visible(comparison, index)
            shares, estimated = self._weights(comparison, index, activations, visible, engine=engine, count=count)
            weights.append(shares)
            approximations += estimated
            saliencies.append(combine(activations, shares, size=_size(visible)))
            maps.append(saliencies[-1][self._place] * visible)
        levels = tuple(
            Level(
                layer=layer.name,
                saliency=torch.stack([saliency[depth] for saliency in saliencies]).float(),
                weights=torch.stack([shares[depth] for shares in weights]).float(),
            )
            for depth, layer in enumerate(layers if self.levels else ())
        )
        predictions = zip(comparison.prediction.tolist(), comparison.reference_prediction.tolist(), strict=True)
        # weights as published are no effects
        rounding = () if SCORES[self.score].as_published else check_rounding(weights, predictions=predictions)
        attribution = comparison.attribution(
            scale_to(torch.stack(maps), total=comparison.change),
            complete=True,
            warnings=(*check_weights(names, weights, change=change), *check_approximations(approximations), *rounding),
        )
        return replace(attribution, levels=levels, approximations=tuple(approximations), engine=engine.name)

    @property
    def _place(self) -> int:
        """Place of the level that is shown among those that are measured."""
        return self.level if self.levels else 0

    def _visible(self, comparison: Comparison, index: int) -> Tensor:
        """Return where the image differs from the reference: where x = b no mask has an effect."""
        if SCORES[self.score].as_published:
            return torch.ones_like(comparison.images[index, 0])
        return local_change(comparison.images[index], comparison.reference[index])

    def _find_layers(self, comparison: Comparison) -> tuple[Layer, ...]:
        image = comparison.images[:1]
        if self.layers is None:
            layers = SCORES[self.score].layers(comparison.model, image)
        else:
            layers = find_layers(comparison.model, image, names=self.layers)
        if not 0 <= self.level < len(layers):
            raise InputError(f"Poly-CAM has no level {self.level} for {len(layers)} layers; count from 0, the finest")
        # a level is made of its own layer and the coarser ones: the finer ones are measured only where they are kept
        return layers if self.levels else layers[self.level :]

    def _weights(
        self,
        comparison: Comparison,
        index: int,
        activations: list[Tensor],
        visible: Tensor,
        *,
        engine: Engine,
        count: Callable[[int], None],
    ) -> tuple[list[Tensor], list[Approximation]]:
        """Weight >= 0 of each channel, layer by layer, and how far they are estimates."""
        score = SCORES[self.score]
        image, empty = comparison.prediction[index], comparison.reference_prediction[index]
        black = black_frames(comparison.images[index])
        if score.as_published:
            empty = comparison.predict(black[None])[0]
        regions = _Regions(
            image=comparison.images[index],
            empty=black if score.as_published else comparison.reference[index],
            masks=[to_masks(maps, as_published=score.as_published) for maps in activations],
            variant=self.variant,
        )
        sizes = [len(maps) for maps in activations]

        def supports(points: Points) -> Float[Tensor, " some"]:
            return score.support(image, empty, points, variant=self.variant)

        measure = partial(regions.measure, engine=engine, on_channels=count)
        # an empty mask keeps nothing and removes nothing, which needs no pass
        at_empty = torch.stack(_measured(self.variant, empty, image))[:, None]
        active = regions.active()
        count(sum(sizes) - len(active))
        if self.budget < 1 and len(active):
            search = ChannelSearch(
                activations=activations,
                process=GaussianProcess(mask_kernel(change_of(regions.image, regions.empty), regions.masks, active)),
                active=active,
                at_empty=supports(at_empty)[0],
                measure=lambda channels: supports(measure(channels)),
                to_map=lambda weights: combine(activations, weights, size=_size(visible))[self._place] * visible,
                seed=self.seed,
            )
            weights, approximation = search.run(budget=self.budget, likeness=self.likeness)
            count(len(active) - approximation.measured)
            return weights, [approximation]
        points = at_empty.repeat(1, sum(sizes))
        points[:, active] = measure(active)
        return list(torch.relu(supports(points)).split(sizes)), []


def _size(image: Tensor) -> tuple[int, int]:
    return image.shape[-2], image.shape[-1]
