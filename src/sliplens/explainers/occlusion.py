"""Occlusion: what the prediction loses when a part of the image is replaced by the reference."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from sliplens.errors import InputError
from sliplens.explainers.attribution import Attribution, frame_of
from sliplens.explainers.contract import BATCH, Comparison, Method
from sliplens.markers import detect_markers
from sliplens.recordings import Recording


def find_markers(
    image: Float[Tensor, "colours height width"], reference: Float[Tensor, "colours height width"]
) -> Float[Tensor, "markers 2"]:
    """Find the markers (x, y) that an image shows, in pixels; the reference tells whether they show at all.

    Raises
    ------
    InputError
        If the image is a difference image, or OpenCV is missing.
    ImageError
        If too few markers are found.
    """
    image, reference = frame_of(image), frame_of(reference)
    if not float(reference.std(dim=(1, 2)).max()):
        # a uniform reference is that of differences, in which a marker shows twice or, at rest, not at all
        raise InputError(
            "markers do not show in difference images; give their places (markers_px), or explain camera frames "
            "or a data set, where they are found in the camera's frames"
        )
    pixels = (255 * image).round().clamp(0, 255).to(torch.uint8)
    return torch.from_numpy(detect_markers(pixels.permute(1, 2, 0).cpu().numpy()).centre_px)


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownMarkers:
    """Finder of markers that do not show in an image: those of the most similar image of a list."""

    images: Float[Tensor, "frames colours height width"]
    """Inputs of the network, in [0, 1]."""
    places: tuple[Float[Tensor, "_markers 2"], ...]
    """x and y of the markers of each, in pixels of these images."""

    def __call__(
        self, image: Float[Tensor, "colours height width"], _reference: Float[Tensor, "colours height width"]
    ) -> Float[Tensor, "_markers 2"]:
        """Places of the markers of the nearest image: noise, or the next frame, leaves it the nearest."""
        unlike = [(image.to(listed) - listed).abs().mean() for listed in self.images]
        return self.places[int(torch.stack(unlike).argmin())]


def to_network_px(
    places_px: Float[np.ndarray, "markers 2"], frame_size: Sequence[int], *, image_size: int
) -> Float[Tensor, "markers 2"]:
    """Places (x, y) in a network's image of places in a camera frame of (height, width) pixels."""
    # pixel centres are whole numbers in both images
    scale = image_size / np.array([frame_size[1], frame_size[0]])
    return torch.from_numpy((places_px.astype(np.float64) + 0.5) * scale - 0.5)


def markers_in_frame(frame: UInt8[np.ndarray, "height width 3"], *, image_size: int) -> Float[Tensor, "markers 2"]:
    """Places (x, y) of the markers of a camera frame, in the network's image."""
    return to_network_px(detect_markers(frame).centre_px, frame.shape[:2], image_size=image_size)


def markers_in_recording(recording: Recording, row: int, *, image_size: int) -> Float[Tensor, "markers 2"]:
    """Places (x, y) of the markers of a trial's frame in the network's image: the simulator's, where it has any."""
    if recording.truth is None:
        return markers_in_frame(recording.frames[row], image_size=image_size)
    return to_network_px(recording.truth.marker_px[row], recording.frames.shape[1:3], image_size=image_size)


FindPlaces: TypeAlias = Callable[
    [Float[Tensor, "colours height width"], Float[Tensor, "colours height width"]], Float[Tensor, "markers 2"]
]
"""From an image and its reference, in [0, 1], to x and y of its markers in pixels."""


def tile_regions(size: tuple[int, int], *, tile_px: int) -> Int[Tensor, "height width"]:
    """Number of the square tile in which each pixel lies; tiles at the right and lower border may be smaller."""
    if tile_px < 1:
        raise InputError(f"tiles of {tile_px} pixels are impossible; choose 1 or more")
    rows, columns = (torch.arange(length) // tile_px for length in size)
    return rows[:, None] * (int(columns.max()) + 1) + columns


def marker_regions(
    size: tuple[int, int], centres_px: Float[Tensor, "markers 2"], *, radius_px: float | None = None
) -> Int[Tensor, "height width"]:
    """Number of the nearest marker of each pixel, and one number more for the pixels that none reaches.

    A marker reaches, by default, half of the median distance between neighbours; pixel centres lie at whole numbers.
    """
    if not len(centres_px) or (radius_px is None and len(centres_px) < 2):
        raise InputError(f"regions around markers need two or more, and there are {len(centres_px)}; choose tiles")
    rows, columns = (torch.arange(length, dtype=torch.float64) for length in size)
    pixels = torch.stack(torch.broadcast_tensors(columns, rows[:, None]), dim=-1).reshape(-1, 2)
    centres = centres_px.double()
    if radius_px is None:
        between = torch.cdist(centres, centres).fill_diagonal_(torch.inf).amin(dim=1)
        radius_px = float(between.median()) / 2
    distance, nearest = torch.cdist(pixels, centres).min(dim=1)
    return torch.where(distance <= radius_px, nearest, len(centres)).reshape(size)


@dataclass(frozen=True, kw_only=True)
class RegionMethod(Method):
    """Base of methods whose regions are tiles, or markers where their places are set."""

    tile_px: int = 16
    """Side of a tile, in pixels."""
    markers_px: Float[Tensor, "markers 2"] | FindPlaces | None = None
    """x and y of the markers in the image that the network sees, (markers, 2), or what finds them in each image, such
    as `find_markers`; they are then the regions, and what lies between them is one more."""

    def __post_init__(self) -> None:
        tile_regions((1, 1), tile_px=self.tile_px)  # refuses an impossible side
        if isinstance(self.markers_px, Tensor):
            marker_regions((1, 1), self.markers_px)

    @property
    def method(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Name of the method, with `-marker` where the regions are markers."""
        return type(self).__name__.lower() + ("" if self.markers_px is None else "-marker")

    @property
    def _unit(self) -> str:
        return f"tiles of {self.tile_px} px" if self.markers_px is None else "markers"

    def _regions(self, image: Tensor, empty: Tensor) -> Tensor:
        size = image.shape[-2], image.shape[-1]
        if self.markers_px is None:
            return tile_regions(size, tile_px=self.tile_px).to(image.device)
        places = self.markers_px if isinstance(self.markers_px, Tensor) else self.markers_px(image, empty)
        return marker_regions(size, places).to(image.device)


@dataclass(frozen=True, kw_only=True)
class Occlusion(RegionMethod):
    """Occlusion by tile, or by marker where the markers' places are given, signed, in margin units.

    The relevance of a region is f(x) - f(x with the region as in the reference), spread evenly over its pixels. Where
    regions work together, or stand in for each other, they do not add up to f(x) - f(b), so there is no completeness
    gap.

    References
    ----------
    Zeiler and Fergus, *Visualizing and understanding convolutional networks*, ECCV 2014, section 4.2; by Captum.
    """

    @torch.no_grad()
    def _explain(self, comparison: Comparison) -> Attribution:
        from captum import attr  # noqa: PLC0415 (half a second, for some explainers alone)

        tiles = -(-comparison.images.shape[-2] // self.tile_px) * -(-comparison.images.shape[-1] // self.tile_px)
        engine = comparison.prepare(len(comparison.images) * tiles)  # markers are about as many

        def predict(images: Tensor) -> Tensor:
            return torch.cat(list(engine.run(images.split(engine.batch_size))))

        def effect(index: int) -> Tensor:
            image, empty = comparison.images[index, None], comparison.reference[index, None]
            regions = self._regions(image[0], empty[0])
            effects = attr.FeatureAblation(predict).attribute(
                image, baselines=empty, feature_mask=regions[None, None], perturbations_per_eval=BATCH
            )
            # Captum gives every pixel and channel the whole effect of its region
            return effects[0, 0] / regions.flatten().bincount()[regions]

        return comparison.attribution(
            comparison.map_each(effect),
            complete=False,
            target=f"f(x) - f(x with one region as in the reference), {self._unit}",
            engine=engine.name,
        )


occlusion_by_marker = partial(Occlusion, markers_px=find_markers)
"""Occlusion by the markers that an image shows."""
