"""Explain frames, one piece at a time, so that an interrupted run loses at most one map."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sliplens.errors import InputError
from sliplens.explain import EXPLAINERS, Explainer, Explanation
from sliplens.models import TrainedModel
from sliplens.study.frames import ChosenFrames
from sliplens.study.saved import Explained, ExplainedFrame, save_explained

Progress = Callable[[int, int], None]
DEFAULT_METHODS = ("grad-cam", "integrated-gradients", "poly-cam")
"""The three methods the thesis compares."""


def require_methods(methods: Sequence[str], explainers: Mapping[str, object] = EXPLAINERS) -> None:
    """Refuse a method that is not in the table.

    Raises
    ------
    InputError
        Listing those there are.
    """
    for name in methods:
        if name not in explainers:
            raise InputError(f"there is no explainer named {name!r}; choose from {', '.join(explainers)}")


def explain_frames(
    trained: TrainedModel,
    chosen: ChosenFrames,
    folder: Path,
    *,
    methods: Sequence[str] = DEFAULT_METHODS,
    explainers: Mapping[str, Explainer | Sequence[Explainer]] = EXPLAINERS,
    on_map: Progress | None = None,
) -> Explained:
    """Explain frames with several methods and write the result.

    Each map is written under `parts` as soon as it is there; a second call with the same folder goes on after the last.

    Parameters
    ----------
    trained
        The network.
    chosen
        The frames.
    folder
        Where the result is written; must exist.
    methods
        Names in the table of explainers.
    explainers
        The table, where their options are not the default ones; a method whose options differ from frame to frame has
        one explainer for each.
    on_map
        Called with the number of maps done and the number of all.

    Raises
    ------
    InputError
        If a method is unknown.
    """
    require_methods(methods, explainers)
    parts = folder / "parts"
    parts.mkdir(exist_ok=True)
    inputs = trained.encoding.normalise(chosen.images).to(trained.device)
    untouched = chosen.references.to(trained.device)
    relevance: dict[str, Any] = {}
    saliency: dict[str, Any] = {}
    notes: dict[str, Any] = {}
    total = len(methods) * len(inputs)
    for number, method in enumerate(methods):
        pieces = []
        for index in range(len(inputs)):
            part = parts / f"{method}-{index:05d}.npz"
            if not part.is_file():
                one = slice(index, index + 1)
                explain = explainers[method]
                if isinstance(explain, Sequence):
                    explain = explain[index]
                explanation = explain(trained.model, inputs[one], reference=untouched[one])
                _save_part(part, explanation)
            with np.load(part, allow_pickle=False) as archive:
                pieces.append({name: archive[name] for name in archive.files})
            if on_map is not None:
                on_map(number * len(inputs) + index + 1, total)
        relevance[method] = np.stack([piece["relevance"] for piece in pieces])
        saliency[method] = np.stack([piece["saliency"] for piece in pieces])
        notes[method] = _notes(pieces, chosen.ids)
    # the same answers for every method: asked once, on all frames
    predictions = trained.predict(inputs)
    references = trained.predict(chosen.references)
    explained = Explained(
        input=trained.encoding.name,
        source=chosen.source,
        frames=tuple(
            ExplainedFrame(
                id=chosen.ids[index],
                trial=chosen.trial[index],
                condition=chosen.condition[index],
                safety_margin=_or_none(float(chosen.safety_margin[index])),
                prediction=float(predictions[index]),
                reference_prediction=float(references[index]),
            )
            for index in range(len(inputs))
        ),
        images=chosen.images,
        relevance=relevance,
        saliency=saliency,
        weights_sha256=trained.manifest.weights_sha256,
    )
    save_explained(explained, folder, pictures=(255 * inputs).round().to(torch.uint8).cpu(), methods=notes)
    shutil.rmtree(parts)
    return explained


def _save_part(path: Path, explanation: Explanation) -> None:
    hidden = path.with_suffix(".part.npz")
    np.savez(
        hidden,
        allow_pickle=False,
        relevance=explanation.relevance[0].cpu().numpy(),
        saliency=explanation.saliency[0].cpu().numpy(),
        seconds=np.float64(explanation.seconds),
        warnings=np.array(explanation.warnings, dtype=np.str_),
    )
    hidden.replace(path)


def _notes(pieces: list[dict[str, np.ndarray]], ids: Sequence[str]) -> dict[str, Any]:
    warnings: dict[str, list[str]] = {}
    for name, piece in zip(ids, pieces, strict=True):
        for warning in piece["warnings"]:
            # each frame was explained by itself: its place in that batch of one tells nothing
            warnings.setdefault(str(warning).removeprefix("image 0: "), []).append(name)
    return {
        "seconds_per_frame": float(np.mean([piece["seconds"] for piece in pieces])),
        "warnings": [f"{', '.join(names)}: {warning}" for warning, names in warnings.items()],
    }


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
