"""What the scores of one network work on: its explanations, what was explained, and the fastest way to ask it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import cache
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Shaped
from torch import Tensor

from sliplens.explainers import EXPLAINERS, Explainer, Likeness, PolyCam, get_explainer
from sliplens.explainers.occlusion import KnownMarkers, RegionMethod, to_network_px
from sliplens.faithfulness.removal import Units, marker_units, tile_units
from sliplens.models import Run
from sliplens.recordings import Dataset
from sliplens.results.explanation import Explained
from sliplens.results.study import ChosenFrame, MarkedFrame
from sliplens.study.choice import network_places
from sliplens.study.explaining import frames_at, network_inputs, require_methods

THESIS_POLY_CAM = "poly-cam-thesis"
_THESIS = ("grad-cam-thesis", "integrated-gradients-thesis", THESIS_POLY_CAM)
STUDY_METHODS = (*_THESIS, "grad-cam", "integrated-gradients", "poly-cam", "occlusion", "shapley-marker")
"""The thesis's three as published, the same against the untouched sensor, occlusion, Shapley values of the markers."""
STUDY_BUDGET = 0.15
"""Share of the channels that Poly-CAM measures at first: more where the map asks for it."""
_AS_PUBLISHED = Likeness(pearson_r=0.999, top_overlap=0.97)
"""Of the thesis's map, compared with what was published; its weights are nearly all 1, so that this costs little."""


def study_explainers(methods: Sequence[str] = STUDY_METHODS, *, budget: float = STUDY_BUDGET) -> dict[str, Explainer]:
    """Explainers of a study: rows of `EXPLAINERS`, Poly-CAM with some of the channels measured at first."""
    require_methods(methods)
    own: dict[str, Explainer] = {
        "poly-cam": get_explainer("poly-cam", budget=budget),
        THESIS_POLY_CAM: get_explainer(THESIS_POLY_CAM, budget=budget, likeness=_AS_PUBLISHED),
    }
    return {name: own.get(name) or EXPLAINERS[name] for name in methods}


def with_markers(
    explainers: Mapping[str, Explainer],
    images: Float[Tensor, "frames colours size size"],
    places: Callable[[], Sequence[Float[Tensor, "_markers 2"]]],
) -> dict[str, Explainer]:
    """The same, but those that look for markers are told their places in each image, which are asked only for them."""
    find = cache(lambda: KnownMarkers(images=images, places=tuple(places())))
    return {
        name: replace(one, markers_px=find()) if isinstance(one, RegionMethod) and callable(one.markers_px) else one
        for name, one in explainers.items()
    }


def without_markers(explainers: Mapping[str, Explainer]) -> dict[str, Explainer]:
    """The same where markers are not known: tiles are asked instead."""
    named = {name.removesuffix("-marker"): one for name, one in explainers.items()}
    return {name: EXPLAINERS[name] if isinstance(one, RegionMethod) else one for name, one in named.items()}


def as_the_thesis_ran(explainers: Mapping[str, Explainer]) -> dict[str, Explainer]:
    """The same, but the thesis's Poly-CAM with all its channels: for what it costs, not for what it shows."""
    return {
        name: replace(one, budget=1.0) if name == THESIS_POLY_CAM and isinstance(one, PolyCam) else one
        for name, one in explainers.items()
    }


Option: TypeAlias = bool | int | float | str | Likeness | Tensor | None
"""Value of a field of an explainer."""


def method_options(explainers: Mapping[str, Explainer]) -> dict[str, dict[str, Option]]:
    """Options of each explainer by name: what a map depends on beside the network and the frame."""
    return {
        name: {
            option: value
            # a row that an installed package added may be any callable; what finds markers is code, not an option
            for option, value in (vars(explainer) if is_dataclass(explainer) else {}).items()
            if not callable(value)
        }
        for name, explainer in explainers.items()
    }


_TILE_PX = 16


@dataclass(frozen=True, kw_only=True)
class Material:
    """Explanations of some frames with all that belongs to them."""

    trained: Run
    explained: Explained
    inputs: Float[Tensor, "frames colours size size"]
    """What the network got, in [0, 1]."""
    references: Float[Tensor, "frames colours size size"]
    """The untouched sensor for each frame."""
    chosen: tuple[ChosenFrame, ...]
    markers: Mapping[str, MarkedFrame]
    """By frame, in camera pixels; frames in which none could be followed are absent."""
    explainers: Mapping[str, Explainer]
    """By name, with the options that made the maps."""

    @property
    def clusters(self) -> Shaped[np.ndarray, "2 frames"]:
        """Day and trial of each frame."""
        return self.explained.clusters

    def towards_target(self, method: str) -> Float[np.ndarray, "frames size size"]:
        """The part of a method's relevance that works towards each frame's target."""
        return self.explained.relevance[method] * self.explained.towards[:, None, None]

    def units(self) -> dict[str, list[Units]]:
        """What can be removed at once, for each frame: pixels, tiles, and markers where they are known in every one."""
        shape = (self.inputs.shape[-2], self.inputs.shape[-1])
        count = len(self.inputs)
        tile = max(1, round(_TILE_PX * shape[0] / 224))
        found = {"pixel": [tile_units(shape, size=1)] * count, "tile": [tile_units(shape, size=tile)] * count}
        if all(frame.id in self.markers for frame in self.explained.frames):
            found["marker"] = [
                marker_units(shape, centres, reach_px=reach)
                for centres, reach in (self.places(frame.id) for frame in self.explained.frames)
            ]
        return found

    def places(self, frame: str) -> tuple[Float[np.ndarray, "seen 2"], float]:
        """Where the network sees the markers of a frame, and how far each one reaches (`network_places`)."""
        size = self.trained.manifest.frame_size
        return network_places(self.markers[frame], frame_size=(size[0], size[1]), image_size=self.inputs.shape[-1])


def gather(
    trained: Run,
    explained: Explained,
    data: Dataset,
    chosen: tuple[ChosenFrame, ...],
    *,
    markers: Mapping[str, MarkedFrame],
    explainers: Mapping[str, Explainer],
) -> Material:
    """Gather what the scores need of the chosen frames, each of which is explained."""
    places = {frame.id: at for at, frame in enumerate(explained.frames)}
    counted = explained.take([places[frame.id] for frame in chosen])
    frames = frames_at(trained, data, [(frame.trial, frame.frame) for frame in chosen])
    inputs = network_inputs(trained, counted)
    return Material(
        trained=trained,
        explained=counted,
        inputs=inputs,
        references=frames.references.to(trained.device),
        chosen=chosen,
        markers=markers,
        explainers=with_markers(explainers, inputs, lambda: seen_places(trained, chosen, markers)),
    )


def seen_places(
    trained: Run, chosen: Sequence[ChosenFrame], markers: Mapping[str, MarkedFrame]
) -> list[Float[Tensor, "_markers 2"]]:
    """Where the markers of each frame are, in the network's pixels; those that were not followed are left out."""
    now = [markers[frame.id].now_px for frame in chosen]
    known = [places[np.isfinite(places).all(axis=1)] for places in now]
    manifest = trained.manifest
    return [to_network_px(places, manifest.frame_size, image_size=manifest.image_size) for places in known]
