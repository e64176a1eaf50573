"""Poly-CAM for a regressor: channel masks, scored by what they keep and what they remove."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sliplens.errors import InputError
from sliplens.explainers.activations import Layer, capture, find_layers
from sliplens.explainers.channels import SCORES, VARIANTS, Regions, combine, measure, scale_to
from sliplens.explainers.contract import Method
from sliplens.explainers.explanation import Approximation, Explanation, Level, check_approximations, check_weights
from sliplens.explainers.frozen_model import Comparison, FrozenModel
from sliplens.explainers.maps import local_change, to_masks
from sliplens.explainers.poly_cam_budget import ChannelSearch, Likeness, mask_kernel
from sliplens.models.engines import Engine
from sliplens.progress import OnProgress


@dataclass(frozen=True, kw_only=True)
class PolyCam(Method):
    """Poly-CAM with the regression score.

    A channel's mask M (its activation between its extreme percentiles, resized to the image) blends the image x with
    the reference b. Its effect in margin units is measured at one or both ends,

        kept     f(b + (x - b) M) - f(b)                "+"
        removed  f(x) - f(b + (x - b) (1 - M))          "-"

    and their mean is "+/-": 0 for the empty mask, f(x) - f(b) for the full one. A channel's weight is
    relu(effect / (f(x) - f(b))), the part that supports the change.

    The layers' maps are refined from the coarsest to the finest (`combine`). The finest, times how much the image
    differs from the reference thereabouts (`local_change`), is the saliency; the relevance is that scaled to add up to
    f(x) - f(b), which is a convention: it says nothing about how much one pixel contributes.

    Parameters
    ----------
    variant
        "+", "-" or "+/-"; the last costs two passes a channel, the others one.
    score
        What the masked predictions are turned into, a key of `SCORES`: `thesis` is what the public code did to a
        network with one output, for comparison with old figures; it takes no reference, and explains nothing.
    layers
        Names of the layers; by default those that belong to the score.
    level
        Which level's map is the relevance, counted from the finest, 0. The thesis displayed the finest of its ten, and
        scored the fifth from the coarsest, `level=5`. Layers finer than that have no part in it, and cost no pass.
    budget
        Share of the channels to measure at first, in (0, 1]; 1 for the exact map. Below 1 the other channels' weights
        are estimated, and `Explanation.approximations` says how many were measured and what the map is expected to have
        in common with the exact one.
    likeness
        What that should be: more channels are measured until it is expected, all of them if need be. None to stop at
        the budget, whatever the map is like.
    batch_size
        Masked images in one pass; None for what suits the engine.
    levels
        Keep the saliency and the weights of each layer in the explanation, those finer than `level` too.

    References
    ----------
    Englebert, Cornu and De Vleeschouwer, *Poly-CAM: High resolution class activation map for convolutional neural
    networks*, ICPR 2022. The regression score and the budget are ours.
    """

    variant: str = "+/-"
    score: str = "regression"
    layers: tuple[str, ...] | None = None
    level: int = 0
    budget: float = 1.0
    likeness: Likeness | None = Likeness()  # noqa: RUF009 (frozen)
    engine: str = "auto"
    batch_size: int | None = None
    levels: bool = False
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
    def _explain(self, frozen: FrozenModel, *, on_progress: OnProgress | None) -> Explanation:
        """Progress counts the channels of every image."""
        comparison = frozen.compare()
        layers = self._find_layers(comparison)
        channels = sum(layer.channels for layer in layers)
        done = 0

        def count(channels_done: int) -> None:
            nonlocal done
            done += channels_done
            if on_progress is not None and channels_done:
                on_progress(done, len(comparison.images) * channels)

        # one engine for all rounds and images
        engine = comparison.prepare(
            len(comparison.images) * round(self.budget * channels) * VARIANTS[self.variant].passes,
            engine=self.engine,
            batch_size=self.batch_size,
        )
        names = [layer.name for layer in layers]
        weights, saliencies, shown, approximations = [], [], [], []
        for index in range(len(comparison.images)):
            with capture(comparison.model, names) as outputs:
                comparison.predict(comparison.images[index, None])
            activations = [outputs[name][0] for name in names]
            shown_at = self._shown_at(comparison, index)
            shares, estimated = self._weights(comparison, index, activations, shown_at, engine=engine, count=count)
            weights.append(shares)
            approximations += estimated
            saliencies.append(combine(activations, shares, size=_size(shown_at)))
            shown.append(saliencies[-1][self._place] * shown_at)
        kept = layers if self.levels else ()
        levels = tuple(
            Level(
                layer=layer.name,
                saliency=torch.stack([maps[depth] for maps in saliencies]).float(),
                weights=torch.stack([shares[depth] for shares in weights]).float(),
            )
            for depth, layer in enumerate(kept)
        )
        return comparison.explanation(
            scale_to(torch.stack(shown), total=comparison.change),
            method="poly-cam",
            complete=True,
            warnings=(
                *check_weights(names, weights, change=comparison.change.tolist()),
                *check_approximations(approximations),
            ),
            levels=levels,
            approximations=tuple(approximations),
            engine=engine.name,
        )

    @property
    def _place(self) -> int:
        """Place of the level that is shown among those that are measured."""
        return self.level if self.levels else 0

    def _shown_at(self, comparison: Comparison, index: int) -> Tensor:
        """Where the image shows something: where x = b no mask has an effect."""
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
        shown_at: Tensor,
        *,
        engine: Engine,
        count: Callable[[int], None],
    ) -> tuple[list[Tensor], list[Approximation]]:
        """Weight >= 0 of each channel, layer by layer, and how far they are estimates."""
        score, variant = SCORES[self.score], VARIANTS[self.variant]
        image, empty = comparison.prediction[index], comparison.reference_prediction[index]
        black = torch.zeros_like(comparison.images[index])
        if score.as_published:
            empty = comparison.predict(black[None])[0]
        regions = Regions(
            image=comparison.images[index],
            empty=black if score.as_published else comparison.reference[index],
            masks=tuple(to_masks(maps, as_published=score.as_published) for maps in activations),
        )

        def supports(points: Float[Tensor, "points some"]) -> Float[Tensor, " some"]:
            return score.support(image, empty, points, variant=variant)

        def measured(channels: Int[Tensor, " some"]) -> Float[Tensor, "points some"]:
            return measure(regions, channels, engine=engine, variant=variant, on_channels=count)

        # an empty mask keeps nothing and removes nothing, which needs no pass
        at_empty = torch.stack([empty] * variant.keep + [image] * variant.remove)[:, None]
        active = regions.active()
        count(sum(regions.layer_sizes) - len(active))
        if self.budget < 1 and len(active):
            search = ChannelSearch(
                activations,
                mask_kernel(regions, active),
                active=active,
                at_empty=supports(at_empty)[0],
                measure=lambda channels: supports(measured(channels)),
                to_map=lambda weights: combine(activations, weights, size=_size(shown_at))[self._place] * shown_at,
                seed=self.seed,
            )
            weights, approximation = search.run(budget=self.budget, likeness=self.likeness)
            count(len(active) - approximation.measured)
            return weights, [approximation]
        points = at_empty.repeat(1, sum(regions.layer_sizes))
        points[:, active] = measured(active)
        return list(torch.relu(supports(points)).split(regions.layer_sizes)), []


def _size(image: Tensor) -> tuple[int, int]:
    return image.shape[-2], image.shape[-1]
