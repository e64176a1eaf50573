"""What the scores of one network work on: its explanations, what was explained, and the fastest way to ask it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.explain import Explainer
from sliplens.explain.passes import Passes, prepare
from sliplens.faithfulness.units import Units, marker_units, pixel_units, tile_units
from sliplens.models import TrainedModel
from sliplens.recordings import Dataset
from sliplens.study.choice import Pick
from sliplens.study.frames import frames_at
from sliplens.study.saved import Explained
from sliplens.study.states import MarkedFrame, network_places

_TILE_PX = 16
_PARITY_IMAGES = 4


@dataclass(frozen=True, kw_only=True)
class Material:
    """Explanations of some frames with all that belongs to them."""

    trained: TrainedModel
    explained: Explained
    inputs: Float[Tensor, "frames 3 size size"]
    """What the network got, in [0, 1]."""
    references: Float[Tensor, "frames 3 size size"]
    """The untouched sensor for each frame."""
    picks: tuple[Pick, ...]
    markers: Mapping[str, MarkedFrame]
    """By frame, in camera pixels; frames in which none could be followed are absent."""
    explainers: Mapping[str, Explainer]
    """By name, with the options that made the maps."""

    @property
    def trials(self) -> np.ndarray:
        """Trial of each frame."""
        return np.array([frame.trial for frame in self.explained.frames])

    @property
    def towards(self) -> Float[np.ndarray, " frames"]:
        """Sign of each answer's change from that on the untouched sensor, which the maps explain."""
        return np.array([np.sign(one.prediction - one.reference_prediction) for one in self.explained.frames])

    def towards_target(self, method: str) -> Float[np.ndarray, "frames size size"]:
        """The part of a method's relevance that works towards each frame's target."""
        return self.explained.relevance[method] * self.towards[:, None, None]

    def fast(self, passes: int) -> Passes:
        """Make an engine ready for so many passes of the network."""
        return make_fast(self.trained, self.inputs, passes=passes)

    def units(self) -> dict[str, list[Units]]:
        """What can be removed at once, for each frame: pixels, tiles, and markers where they are known in every one."""
        shape = (self.inputs.shape[-2], self.inputs.shape[-1])
        count = len(self.inputs)
        tile = max(1, round(_TILE_PX * shape[0] / 224))
        found = {"pixel": [pixel_units(shape)] * count, "tile": [tile_units(shape, size=tile)] * count}
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


def make_fast(trained: TrainedModel, inputs: Float[Tensor, "frames 3 size size"], *, passes: int) -> Passes:
    """Make an engine ready for so many passes of a network, checked on a few of its inputs, on the network's device."""
    some = inputs[:_PARITY_IMAGES].to(trained.device)
    return prepare(trained.model, some, trained.predict(some).to(trained.device), passes=passes)


def gather(
    trained: TrainedModel,
    explained: Explained,
    data: Dataset,
    picks: tuple[Pick, ...],
    *,
    markers: Mapping[str, MarkedFrame],
    explainers: Mapping[str, Explainer],
) -> Material:
    """Gather what the scores need of some of the explained frames.

    Parameters
    ----------
    trained, explained, data
        The network, its explanations, and the data set that the frames came from.
    picks
        Frames that count, each of which is explained.
    markers, explainers
        See `Material`.
    """
    places = {frame.id: at for at, frame in enumerate(explained.frames)}
    rows = [places[pick.id] for pick in picks]
    some = replace(
        explained,
        frames=tuple(explained.frames[row] for row in rows),
        images=explained.images[torch.tensor(rows)],
        relevance={name: maps[rows] for name, maps in explained.relevance.items()},
        saliency={name: maps[rows] for name, maps in explained.saliency.items()},
    )
    by_trial: dict[str, list[int]] = {}
    for pick in picks:
        by_trial.setdefault(pick.trial, []).append(pick.frame)
    chosen = frames_at(trained, data, by_trial)
    at = {name: row for row, name in enumerate(chosen.ids)}
    return Material(
        trained=trained,
        explained=some,
        inputs=trained.encoding.normalise(some.images).to(trained.device),
        references=chosen.references[torch.tensor([at[pick.id] for pick in picks])].to(trained.device),
        picks=picks,
        markers=markers,
        explainers=explainers,
    )
