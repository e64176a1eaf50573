"""Attribution maps of a batch, their checks, and arithmetic on maps."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.nn import functional

FLOOR = 1e-12
CHANGE_WINDOW = 15 / 224
"""Side of the square over which a change is averaged, as a share of the image's height: about a marker."""


def resize(maps: Float[Tensor, "*maps rows columns"], size: tuple[int, int]) -> Float[Tensor, "*maps height width"]:
    """Resize maps bilinearly to (height, width) in pixels, corners not aligned; unchanged at the same size."""
    if tuple(maps.shape[-2:]) == tuple(size):
        return maps
    flat = maps.reshape(-1, 1, *maps.shape[-2:])
    return functional.interpolate(flat, size=size, mode="bilinear", align_corners=False).reshape(
        *maps.shape[:-2], *size
    )


def spread(maps: Float[Tensor, "*maps rows columns"], size: tuple[int, int]) -> Float[Tensor, "*maps height width"]:
    """Spread each cell's value over the pixels of a larger image, keeping the total of every map.

    Pixel p receives sum over cells i of B[p, i] m[i] / sum over p' of B[p', i], B the bilinear weights (corners not
    aligned); plain resizing would change the total where the sizes do not divide.
    """

    def received(cells: int, pixels: int) -> Tensor:
        identity = torch.eye(cells, dtype=maps.dtype, device=maps.device)[None]
        weights = functional.interpolate(identity, size=pixels, mode="linear", align_corners=False)
        return weights.sum(dim=-1)[0].clamp_min(FLOOR)

    rows, columns = (received(cells, pixels) for cells, pixels in zip(maps.shape[-2:], size, strict=True))
    return resize(maps / (rows[:, None] * columns), size)


def to_masks(
    maps: Float[Tensor, "*maps rows columns"], *, as_published: bool = False
) -> Float[Tensor, "*maps rows columns"]:
    """Turn each map into a mask in [0, 1]: clip((a - lo) / max(hi, 1e-12), 0, 1), lo and hi its extreme percentiles.

    A map below zero all over gives the empty mask; `as_published` it gives one of ones, divided by 1e-12.

    Englebert, Cornu and De Vleeschouwer, *Poly-CAM: High resolution class activation map for convolutional neural
    networks*, ICPR 2022, and its public code for the division by hi rather than by the range.
    """
    ordered = maps.flatten(-2).sort(dim=-1).values

    def percentile(share: float) -> Tensor:
        # a Python float: `torch.quantile` rounds the rank to the map's type, which in float32 moves the percentile
        rank = share * (ordered.shape[-1] - 1)
        below = int(rank)
        value = torch.lerp(ordered[..., below], ordered[..., min(below + 1, ordered.shape[-1] - 1)], rank - below)
        return value[..., None, None]

    low, high = percentile(0.001), percentile(0.999)
    masks = ((maps - low) / high.clamp_min(FLOOR)).clamp(0, 1)
    return masks if as_published else torch.where(high < 0, torch.zeros_like(masks), masks)


def layer_map(
    activations: Float[Tensor, "channels rows columns"], weights: Float[Tensor, " channels"]
) -> Float[Tensor, "rows columns"]:
    """Sum of weight x activation over the channels, above zero."""
    return torch.relu(torch.einsum("c,chw->hw", weights, activations))


def combine(
    activations: Sequence[Float[Tensor, "_channels _rows _columns"]],
    weights: Sequence[Float[Tensor, " _channels"]],
    *,
    size: tuple[int, int],
) -> Float[Tensor, "height width"]:
    """Turn the channel weights of all layers, fine to coarse, into one saliency in [0, 1], resized to the image.

    From the last layer on a layer's map is divided by itself resized to the coarser result and back (LNorm), then
    multiplied by that result; the finest product is normalised like a mask.

    Englebert, Cornu and De Vleeschouwer, *Poly-CAM*, ICPR 2022, section III, and its public code.
    """
    *finer, coarsest = zip(activations, weights, strict=True)
    product = layer_map(*coarsest)
    for layer in reversed(finer):
        coarser, product = product, layer_map(*layer)
        here = product.shape[-2], product.shape[-1]
        smooth = resize(resize(product, (coarser.shape[-2], coarser.shape[-1])), here)
        product = torch.relu(product / smooth.clamp_min(FLOOR) * resize(coarser, here))
    return resize(to_masks(product), size)


def scale_to(
    saliencies: Float[Tensor, "batch height width"], *, total: Float[Tensor, " batch"]
) -> Float[Tensor, "batch height width"]:
    """Scale each map so that it adds up to its total; a map of zeros stays."""
    sums = saliencies.sum(dim=(1, 2))
    factor = torch.where(sums == 0, torch.zeros_like(sums), total / sums)
    return saliencies * factor[:, None, None]


def frame_of(images: Float[Tensor, "*batch colours height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """Frame of each input, which is what is explained: without the reference that some networks see beside it."""
    return images[..., :3, :, :]


def with_reference_of(
    frames: Float[Tensor, "frames _ height width"], images: Float[Tensor, "images colours height width"]
) -> Float[Tensor, "batch colours height width"]:
    """Frames of some inputs beside the references of others; one may be there for all of the others."""
    count = max(len(frames), len(images))
    halves = frame_of(frames), images[:, 3:]
    return torch.cat([half.expand(count, -1, -1, -1) for half in halves], dim=1)


def black_frames(images: Float[Tensor, "*batch colours height width"]) -> Float[Tensor, "*batch colours height width"]:
    """Return images whose frame is black; the reference beside it, if any, stays."""
    black = images.clone()
    frame_of(black).zero_()
    return black


def change_of(
    images: Float[Tensor, "*batch colours height width"], references: Float[Tensor, "*batch colours height width"]
) -> Float[Tensor, "*batch height width"]:
    """Mean of |x - b| over the colours of the frame."""
    return frame_of(images - references).abs().mean(dim=-3)


def local_change(
    image: Float[Tensor, "colours height width"], reference: Float[Tensor, "colours height width"], *, widths: int = 1
) -> Float[Tensor, "height width"]:
    """Mean of `change_of` over a square of some `CHANGE_WINDOW` around each pixel, the border repeated."""
    change = change_of(image, reference)
    reach = round(widths * CHANGE_WINDOW * change.shape[0]) // 2
    padded = functional.pad(change[None, None], [reach] * 4, mode="replicate")
    return functional.avg_pool2d(padded, 2 * reach + 1, stride=1)[0, 0]


def lacks_float64(values: Shaped[Tensor, "*any"]) -> bool:
    """Return True for values on a device without float64, Apple's MPS."""
    return values.device.type == "mps"


def widest(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return values in float64, or in float32 on devices that have no other."""
    return values.float() if lacks_float64(values) else values.double()


def pearson_r(first: Float[Tensor, "height width"], second: Float[Tensor, "height width"]) -> float:
    """Correlation of two maps over their pixels; NaN where one of them is constant."""
    first, second = (values.flatten() - values.mean() for values in (widest(first), widest(second)))
    return float(first @ second / (first.norm() * second.norm()))


def top_overlap(
    first: Float[Tensor, "height width"], second: Float[Tensor, "height width"], *, share: float = 0.1
) -> float:
    """Return the share of the strongest pixels of a map that are among the strongest of another."""
    count = max(1, round(share * first.numel()))
    strongest = torch.zeros(first.numel(), dtype=torch.bool, device=first.device)
    strongest[first.flatten().topk(count).indices] = True
    return float(strongest[second.flatten().topk(count).indices].sum()) / count


@dataclass(frozen=True, kw_only=True)
class Approximation:
    """Likeness of an approximate map to the exact one, estimated from its measurements."""

    measured: int
    """Channels whose effect was measured."""
    channels: int
    """Channels that an exact map would measure."""
    pearson_r: float
    """Expected correlation with the exact map over the pixels; NaN where the map is constant."""
    top_overlap: float
    """Expected share of the strongest tenth of the pixels that is the exact map's too."""


@dataclass(frozen=True, kw_only=True)
class Attribution:
    """Maps of a batch of images by one method: why a network predicts f(x) rather than f(reference)."""

    relevance: Float[Tensor, "batch height width"]
    """Signed contribution of each pixel in margin units (float32): above zero where it raises the prediction."""
    target: str
    """Quantity that the relevance adds up to, in words."""
    prediction: Float[Tensor, " batch"]
    """f(x), the safety margin of each image."""
    reference_prediction: Float[Tensor, " batch"]
    """f(reference), the safety margin of what each image is compared with."""
    completeness_gap: Float[Tensor, " batch"] | None = None
    """|sum of the relevance - (f(x) - f(reference))| in margin units; None where the sum is not promised."""
    method: str = ""
    """Name of the method; set when the call ends."""
    seconds: float = 0.0
    """Wall-clock time of the call for all images, device work included."""
    warnings: tuple[str, ...] = ()
    """Reasons not to trust a map, one sentence each."""
    approximations: tuple[Approximation, ...] = ()
    """Likeness of each image's map to the exact one; empty where the maps are exact."""
    engine: str = "torch"
    """Engine that ran the network, one of `models.engines.ENGINES`."""
    raises_only: bool = False
    """True if the maps only hold what raises the prediction, such as published maps with a ReLU."""

    @property
    def change(self) -> Float[Tensor, " batch"]:
        """f(x) - f(reference), the difference that is explained, in margin units."""
        return self.prediction - self.reference_prediction

    @property
    def influence(self) -> Float[Tensor, "batch height width"]:
        """Relevance along the change of the prediction, which ranks pixels: sign(f(x) - f(reference)) relevance.

        In margin units. A map that `raises_only` is ranked as it was published, whichever way the prediction went.
        """
        if self.raises_only:
            return self.relevance
        return self.change.sign().to(self.relevance.dtype)[:, None, None] * self.relevance
