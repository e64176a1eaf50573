"""Maps, and a control, of the network with weights that were drawn anew."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from torch import Tensor, nn

from sliplens.explainers import Explainer, Explanation, IntegratedGradients, PolyCam
from sliplens.faithfulness.controls import cascade, histogram_entropy, randomisation_scores, smooth_maps
from sliplens.progress import OnProgress, counted
from sliplens.results.study import Randomisation, RandomisedMethod, UntrainedMaps
from sliplens.study.explaining import mean_of_known
from sliplens.study.material import Material

STAGES = 3
_SMOOTH_WITHIN_S = 1.0
"""Methods that take longer a frame are not explained sixteen times over."""
_STILL_SIMILAR = 0.5

Maps = Float[np.ndarray, "frames height width"]


def randomise_weights(
    material: Material, *, frames: int = 2, seed: int = 0, on_progress: OnProgress | None = None
) -> Randomisation:
    """Explain networks whose weights are drawn anew from the output on, to see how far the maps change.

    Parameters
    ----------
    frames
        How many of the frames, from the first on.

    References
    ----------
    See `sliplens.faithfulness.controls`.
    """
    inputs, references = material.inputs[:frames], material.references[:frames]
    methods, alarms = {}, []
    for name, whole in counted(material.explainers.items(), on_progress):
        explainer = _shortened(whole)

        def explain(model: nn.Module, images: Tensor, explainer: Explainer = explainer) -> Maps:
            return _influence(explainer(model, images, reference=references))

        started = time.perf_counter()
        scores = randomisation_scores(
            explain,
            material.trained.model,
            inputs,
            seed=seed,
            stages=STAGES,
            before=material.towards_target(name)[:frames],
        )
        seconds = (time.perf_counter() - started) / STAGES / len(inputs)
        similarity = tuple(mean_of_known(row) for row in scores.similarity)
        methods[name] = RandomisedMethod(
            layers=tuple(scores.layers),
            similarity=similarity,
            complexity_rise=mean_of_known(scores.complexity_rise),
            smooth_complexity_rise=_smooth_rise(material, explain, inputs, seed=seed)
            if seconds <= _SMOOTH_WITHIN_S
            else None,
        )
        if similarity[-1] is not None and similarity[-1] > _STILL_SIMILAR:
            alarms.append(
                f"{name} still correlates by {similarity[-1]:.2f} with its maps when all weights are new: it shows the "
                "image rather than what the network learned"
            )
    return Randomisation(
        input=material.explained.input,
        source=material.explained.source,
        frames=len(inputs),
        methods=methods,
        alarms=tuple(alarms),
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
        np.array([histogram_entropy(values) for values in smooth_maps(explain, network, inputs, seed=seed)])
        for network in (model, _untrained(model, inputs, seed=seed))
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return mean_of_known((after - before) / before)


def explain_untrained(
    material: Material, explainer: Explainer, *, seed: int = 0, on_progress: OnProgress | None = None
) -> UntrainedMaps:
    """Explain the network with all weights drawn anew: a control that every map has to beat."""
    model = _untrained(material.trained.model, material.inputs, seed=seed)
    maps = []
    for index in counted(range(len(material.inputs)), on_progress):
        frame = slice(index, index + 1)
        maps.append(_influence(explainer(model, material.inputs[frame], reference=material.references[frame]))[0])
    return UntrainedMaps(
        input=material.explained.input, source=material.explained.source, maps=np.stack(maps).astype(np.float64)
    )


def _influence(explanation: Explanation) -> Maps:
    """The part of the relevance that works towards the network's own target: the sign of another's says nothing."""
    return explanation.influence.double().cpu().numpy()


def _untrained(model: nn.Module, images: Tensor, *, seed: int) -> nn.Module:
    ((_, untrained),) = cascade(model, seed=seed, stages=1, images=images)
    return untrained
