"""Explanation of chosen frames by one or several explainers, in memory."""

import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from sliplens.errors import InputError, ModelError, SliplensError
from sliplens.explainers.attribution import Attribution, frame_of
from sliplens.explainers.contract import Explainer
from sliplens.explainers.frames import ChosenFrames, FindMarkers
from sliplens.explainers.occlusion import KnownMarkers, RegionMethod, find_markers
from sliplens.explainers.table import RECOMMENDED_METHOD, get_explainer
from sliplens.models import Network
from sliplens.models.engines import expecting
from sliplens.progress import number_of, report_each
from sliplens.results.evaluation import ANSWER
from sliplens.results.explanation import ExplainedFrame, Explanation, MethodNotes, require_saliency, write_overlays
from sliplens.results.study import STUDY_BUDGET

_FULL_STICK = 0.9
"""Safety margin from which a labelled frame counts as one without slip."""
Methods: TypeAlias = str | Explainer | Sequence[str | Explainer]
"""Row of `EXPLAINERS`, an explainer, or several of them."""


def choose_explainers(
    network: Network, chosen: ChosenFrames, methods: Methods | None = None, *, budget: float | None = None
) -> tuple[dict[str, Explainer], tuple[str, ...]]:
    """Make the explainers of frames by name, with the markers and background that the frames have, and warnings.

    If `methods` is None, Shapley values of the markers, or of tiles where no markers are found, with a warning.
    `budget` is the share of the channels that `poly-cam` measures at first; if None, 1 for one frame and
    `STUDY_BUDGET` for several.
    """
    if budget is None:
        budget = 1.0 if len(chosen.ids) == 1 else STUDY_BUDGET
    get_explainer("poly-cam", budget=budget)  # refuses an impossible budget, whatever the method
    if methods is None:
        try:
            return choose_explainers(network, chosen, RECOMMENDED_METHOD)
        except SliplensError as error:  # difference images, another sensor, or no OpenCV
            explainers, _ = choose_explainers(network, chosen, RECOMMENDED_METHOD.removesuffix("-marker"))
            return explainers, (f"tiles, not markers: {error}",)
    inputs, explainers = network.encoding.normalise(chosen.images), {}
    free = torch.from_numpy(chosen.safety_margin >= _FULL_STICK)
    options: dict[str, dict[str, object]] = {
        "poly-cam": {"budget": budget},
        "expected-gradients": {"background": inputs[free] if free.any() else None},
    }
    for method in [methods] if isinstance(methods, str) or callable(methods) else methods:
        if isinstance(method, str):
            explainers[method] = get_explainer(method, **options.get(method, {}))
        else:
            explainers[getattr(method, "method", type(method).__name__)] = method

    def find() -> Sequence[Float[Tensor, "_markers 2"]]:
        if chosen.find_markers is None:
            raise InputError(
                "methods by marker need camera frames with the untouched sensor as reference (--reference), or a data "
                "set: difference images and networks without a reference show no markers"
            )
        return chosen.find_markers()

    return with_markers(explainers, inputs, find), ()


def with_markers(
    explainers: Mapping[str, Explainer], images: Float[Tensor, "frames colours size size"], find: FindMarkers
) -> dict[str, Explainer]:
    """Give the markers of each image to the explainers that need them; they are found for those alone."""
    known_markers = cache(lambda: KnownMarkers(images=images, places=tuple(find())))
    return {
        name: replace(explainer, markers_px=known_markers())
        if isinstance(explainer, RegionMethod) and explainer.markers_px is find_markers
        else explainer
        for name, explainer in explainers.items()
    }


@dataclass(frozen=True, kw_only=True)
class MethodMaps:
    """Maps of some frames by one method."""

    relevance: Annotated[Float32[np.ndarray, "frames height width"], ANSWER]
    notes: MethodNotes


_PASSES_A_MAP = 300
"""Of a map by Poly-CAM on a budget, or by Shapley values."""
_FEW_MAPS = 20


def explain_rows(
    network: Network,
    chosen: ChosenFrames,
    explainer: Explainer,
    rows: Sequence[int],
    *,
    maps: int,
    overlays: Path | None = None,
) -> MethodMaps:
    """Explain some of the frames, by their row numbers, with one explainer; engines are chosen for so many `maps`.

    With `overlays`, a folder, each map is drawn there, on the scale of these frames.
    """
    inputs, references = (
        network.encoding.normalise(values[list(rows)]).to(network.device)
        for values in (chosen.images, chosen.references)
    )
    # the first of few maps is waited for: each then takes the engine that its passes pay for
    passes = _PASSES_A_MAP * maps if maps > _FEW_MAPS else 0
    with nullcontext() if chosen.together else expecting(passes):
        # one reference for all where it is the same, so that it is predicted once
        shared = references[0] if bool((references == references[:1]).all()) else references
        attribution = explainer(network.model, inputs, reference=shared)
    if not isinstance(attribution, Attribution):
        name = getattr(explainer, "method", type(explainer).__name__)
        raise ModelError(f"the explainer {name} returned a {type(attribution).__name__}; it must return an Attribution")
    relevance = attribution.relevance.cpu().numpy()
    for row, values in zip(rows, relevance, strict=True):
        require_saliency(values, inputs.shape[-2:], where=f"the map of {chosen.ids[row]} by {attribution.method}")
    if overlays is not None:
        scale = float(network.manifest.unit == "margin")  # that of other units follows from all frames
        write_overlays(overlays, [chosen.ids[row] for row in rows], _pictures(inputs), relevance, scale=scale)
    gap = attribution.completeness_gap
    notes = MethodNotes(
        seconds_per_frame=attribution.seconds / len(rows),
        warnings=attribution.warnings,
        target=attribution.target,
        raises_only=attribution.raises_only,
        completeness_gap=None if gap is None else tuple(gap.tolist()),
    )
    return MethodMaps(relevance=relevance, notes=notes)


def explain_frames(network: Network, chosen: ChosenFrames, explainers: Mapping[str, Explainer]) -> Explanation:
    """Explain frames with several explainers."""
    jobs, maps = list(product(explainers, chosen.batches)), {}
    for name, rows in report_each(jobs, sizes=[len(rows) for _, rows in jobs]):
        count = len(chosen.ids) * len(explainers)
        maps.setdefault(name, []).append(explain_rows(network, chosen, explainers[name], rows, maps=count))
    return join_maps(network, chosen, maps)


def join_maps(
    network: Network,
    chosen: ChosenFrames,
    maps: Mapping[str, Sequence[MethodMaps]],
    *,
    warnings: Sequence[str] = (),
) -> Explanation:
    """Make the record of maps, with the predictions of the frames; those of a method are in the order of the frames."""
    normalised, references = (network.encoding.normalise(values) for values in (chosen.images, chosen.references))
    # predicted once for all methods, on all frames
    estimate, compared = network.estimate(normalised.to(network.device)), network.predict(references).tolist()
    withheld = estimate.withheld(np.ones(len(normalised), dtype=bool))  # all are taken for touches
    reasons = dict(zip(chosen.ids, withheld, strict=True))
    return Explanation(
        input=network.encoding.name,
        source=chosen.source,
        unit=network.manifest.unit,
        weights_sha256=network.manifest.weights_sha256,
        frames=tuple(
            ExplainedFrame(
                id=chosen.ids[index],
                trial=chosen.trial[index],
                day=chosen.day[index],
                condition=chosen.condition[index],
                safety_margin=float(margin) if np.isfinite(margin) else None,
                prediction=float(estimate.margin[index]),
                withheld=withheld[index],
                reference_prediction=compared[index],
                baseline_frame=chosen.baseline_frame[index],
            )
            for index, margin in enumerate(chosen.safety_margin)
        ),
        methods={method: _notes(pieces, reasons, (*chosen.warnings, *warnings)) for method, pieces in maps.items()},
        images=chosen.images.numpy(),
        references=chosen.references.numpy(),
        pictures=_pictures(normalised),
        baseline=chosen.baseline,
        relevance={method: np.concatenate([piece.relevance for piece in pieces]) for method, pieces in maps.items()},
    )


def _pictures(inputs: Float[Tensor, "frames colours size size"]) -> UInt8[np.ndarray, "frames size size 3"]:
    """Return the frames of network inputs in 8 bits, for viewing."""
    return (255 * frame_of(inputs.cpu()).permute(0, 2, 3, 1)).round().to(torch.uint8).contiguous().numpy()


_MOST_NAMES = 3
"""Frames that a warning names."""


def _notes(pieces: Sequence[MethodMaps], withheld: Mapping[str, str | None], warnings: Sequence[str]) -> MethodNotes:
    """Join what is known of a method's maps; a warning of several frames is written once, with their names.

    `withheld`: why the prediction of each frame, by its name, is not reliable; None where it is.
    """
    frames_of, ids = dict[str, list[str]](), list(withheld)
    for name, reason in withheld.items():
        if reason is not None:
            frames_of.setdefault(f"the prediction is withheld: {reason}", []).append(name)
    first = 0
    for piece in pieces:
        names = ids[first : first + len(piece.relevance)]
        for warning in piece.notes.warnings:
            match = re.match(r"image (\d+): ", warning)
            text = warning if match is None else warning[match.end() :]
            frames_of.setdefault(text, []).extend(names if match is None else [names[int(match[1])]])
        first += len(piece.relevance)
    texts = list(warnings)
    for text, names in frames_of.items():
        more = ", \N{HORIZONTAL ELLIPSIS}" if len(names) > _MOST_NAMES else ""
        some = ", ".join(names[:_MOST_NAMES])
        texts.append(f"{len(names)} of {number_of(len(ids), 'frame')} ({some}{more}): {text}")
    gaps = [piece.notes.completeness_gap for piece in pieces]
    return replace(
        pieces[0].notes,
        seconds_per_frame=sum(piece.notes.seconds_per_frame * len(piece.relevance) for piece in pieces) / len(ids),
        warnings=tuple(texts),
        completeness_gap=None if None in gaps else sum((gap for gap in gaps if gap is not None), ()),
    )


def network_inputs(network: Network, explanation: Explanation) -> Float[Tensor, "frames colours size size"]:
    """Return the network's inputs of explained frames, in [0, 1], on its device."""
    return network.encoding.normalise(torch.from_numpy(explanation.images)).to(network.device)


def network_references(network: Network, explanation: Explanation) -> Float[Tensor, "frames colours size size"]:
    """Return the network's inputs of the baseline of each explained frame, in [0, 1], on its device."""
    return network.encoding.normalise(torch.from_numpy(explanation.references)).to(network.device)
