"""Which frames the figures show: chosen by their label, so that the network's answer plays no part."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, UInt8

from sliplens.report.panels import choose_frames
from sliplens.report.records import DeletionCurve, Explained
from sliplens.report.trial_charts import TIMES, brighten, brightening
from sliplens.report.workspace import Results

THESIS_LEVEL = 0.2
"""Margin of the frame that the thesis compares methods on (Fig. 8)."""


@dataclass(frozen=True, kw_only=True)
class ShownFrame:
    """A frame of a panel: the margin it stands for, and its place among the explained frames."""

    level: float
    index: int


def explained_of(results: Results, name: str) -> Explained | None:
    """Find the explained frames of the study's source."""
    return results.explanations.get((name, results.study.source))


def shown_frames(results: Results, explained: Explained) -> list[ShownFrame]:
    """Frames of one trial from full stick to full slip; without a choice, those a panel would show."""
    places = {frame.id: index for index, frame in enumerate(explained.frames)}
    choice = results.study.choice
    rows = [frame for frame in choice.frames if frame.shown and frame.id in places] if choice else []
    if rows:
        first = rows[0].trial
        found = [ShownFrame(level=row.level, index=places[row.id]) for row in rows if row.trial == first]
        return sorted(found, key=lambda one: -one.level)
    _, chosen = choose_frames(explained.frames)
    return [ShownFrame(level=level, index=index) for level, index in chosen if level is not None and index is not None]


def bright_pictures(
    explained: Explained, indices: Sequence[int]
) -> tuple[dict[int, UInt8[np.ndarray, "height width 3"]], str]:
    """Pictures of some frames, and what to call them: differences are made brighter all alike, or little would be seen.

    Parameters
    ----------
    explained
        Frames with their pictures.
    indices
        Which of them.
    """
    pictures = {index: explained.pictures[index] for index in indices}
    if explained.input != "difference":
        return pictures, "Input"
    factor = brightening([one[None] for one in pictures.values()])
    name = "Input" if factor == 1 else f"Input {TIMES}\N{NO-BREAK SPACE}{factor:g}"
    return {index: brighten(one, factor) for index, one in pictures.items()}, name


def told_frame(explained: Explained, curves: dict[str, DeletionCurve]) -> int | None:
    """Pick the frame that deletion is shown on: the first of those scored whose label is nearest to 20 %."""
    scored = {name for curve in curves.values() for name in curve.frame_ids}
    labels = {
        index: abs(frame.safety_margin - THESIS_LEVEL)
        for index, frame in enumerate(explained.frames)
        if frame.id in scored and frame.safety_margin is not None
    }
    # labels of frames looked for at one level differ by chance: the first trial's will do
    return min(labels, key=lambda index: (round(labels[index], 2), index), default=None)


def removal_order(saliency: np.ndarray) -> Int[np.ndarray, " pixels"]:
    """Flat indices from most to least salient, ties to the later pixel first, as the score removes them."""
    return np.argsort(saliency.ravel(), kind="stable")[::-1]


def gone(saliency: np.ndarray, pixels: int) -> Bool[np.ndarray, "height width"]:
    """Mark the most salient pixels of a map."""
    mask = np.zeros(saliency.size, dtype=bool)
    mask[removal_order(saliency)[:pixels]] = True
    return mask.reshape(saliency.shape)
