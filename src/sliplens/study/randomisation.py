"""Randomisation: what becomes of the maps, and of a control, when the network's weights are drawn anew."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.explainers import Explainer, Explanation, IntegratedGradients, PolyCam
from sliplens.faithfulness.randomisation import cascade, histogram_entropy, randomisation_scores, smooth_maps
from sliplens.files import write_json
from sliplens.study.curves import RANDOMISED
from sliplens.study.explaining import MAPS_FILE, RESULT_FILE, mean_of_known, read_arrays
from sliplens.study.material import Material

STAGES = 3
_SMOOTH_WITHIN_S = 1.0
"""Methods that take longer a frame are not explained sixteen times over."""
_STILL_SIMILAR = 0.5

Maps = Float[np.ndarray, "frames height width"]
Count = Callable[[int, int], None]


def check_randomisation(
    material: Material, folder: Path, *, frames: int = 2, seed: int = 0, on_method: Count | None = None
) -> None:
    """Explain networks whose weights are drawn anew from the output on, and write how far the maps change.

    Parameters
    ----------
    material
        The network, frames and methods.
    folder
        Gets `result.json`; must exist.
    frames
        How many of the frames, from the first on.
    seed
        Of the new weights.
    on_method
        Called with the methods done and their number.

    References
    ----------
    See `sliplens.faithfulness.randomisation`.
    """
    inputs, references = material.inputs[:frames], material.references[:frames]
    told: dict[str, Any] = {}
    alarms = []
    for number, (name, whole) in enumerate(material.explainers.items(), start=1):
        explainer = _shortened(whole)

        def explain(model: nn.Module, images: Tensor, explainer: Explainer = explainer) -> Maps:
            return _towards_target(explainer(model, images, reference=references))

        started = time.perf_counter()
        found = randomisation_scores(
            explain,
            material.trained.model,
            inputs,
            seed=seed,
            stages=STAGES,
            before=material.towards_target(name)[:frames],
        )
        seconds = (time.perf_counter() - started) / STAGES / len(inputs)
        similarity = [mean_of_known(row) for row in found.similarity]
        told[name] = {
            "layers": found.layers,
            "similarity": similarity,
            "complexity_rise": mean_of_known(found.complexity_rise),
            "smooth_complexity_rise": _smooth_rise(material, explain, inputs, seed=seed)
            if seconds <= _SMOOTH_WITHIN_S
            else None,
        }
        if similarity[-1] is not None and similarity[-1] > _STILL_SIMILAR:
            alarms.append(
                f"{name} still correlates by {similarity[-1]:.2f} with its maps when all weights are new: it shows the "
                "image rather than what the network learned"
            )
        if on_method is not None:
            on_method(number, len(material.explainers))
    write_json(
        folder / RESULT_FILE,
        {
            "input": material.explained.input,
            "source": material.explained.source,
            "frames": len(inputs),
            "methods": told,
            "alarms": alarms,
        },
    )


def _shortened(explainer: Explainer) -> Explainer:
    """Without the passes that a network with new weights takes until its map is complete: a correlation needs none."""
    if isinstance(explainer, PolyCam):
        return replace(explainer, likeness=None)
    if isinstance(explainer, IntegratedGradients):
        return replace(explainer, max_steps=explainer.steps)
    return explainer


def _smooth_rise(
    material: Material, explain: Callable[[nn.Module, Tensor], Maps], inputs: Tensor, *, seed: int
) -> float | None:
    model = material.trained.model
    before, after = (
        np.array([histogram_entropy(one) for one in smooth_maps(explain, network, inputs, seed=seed)])
        for network in (model, _untrained(model, inputs, seed=seed))
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return mean_of_known((after - before) / before)


def explain_untrained(
    material: Material, explainer: Explainer, folder: Path, *, seed: int = 0, on_frame: Count | None = None
) -> None:
    """Explain the network with all weights drawn anew: a control that every map has to beat.

    Kept is the part of the relevance that works towards that network's own target.

    Parameters
    ----------
    material
        The network and the frames.
    explainer
        What explains.
    folder
        Gets `maps.npz` and `result.json`; must exist.
    seed
        Of the new weights.
    on_frame
        Called with the frames done and their number.
    """
    model = _untrained(material.trained.model, material.inputs, seed=seed)
    maps = []
    for index in range(len(material.inputs)):
        one = slice(index, index + 1)
        found = explainer(model, material.inputs[one], reference=material.references[one])
        maps.append(_towards_target(found)[0])
        if on_frame is not None:
            on_frame(index + 1, len(material.inputs))
    np.savez_compressed(folder / MAPS_FILE, allow_pickle=False, **{RANDOMISED: np.stack(maps)})
    explained = material.explained
    write_json(
        folder / RESULT_FILE, {"input": explained.input, "source": explained.source, "frames": len(explained.frames)}
    )


def load_untrained(folder: Path) -> Maps:
    """Read what `explain_untrained` wrote.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    return read_arrays(folder / MAPS_FILE)[RANDOMISED]


def _towards_target(found: Explanation) -> Maps:
    """The part of the relevance that works towards the network's own target: the sign of another's says nothing."""
    return (found.relevance * found.change.sign()[:, None, None]).double().cpu().numpy()


def _untrained(model: nn.Module, images: Tensor, *, seed: int) -> nn.Module:
    *_, last = cascade(model, seed=seed, stages=1, images=images)
    return last.model
