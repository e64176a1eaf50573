"""Cost of a map: seconds a frame, with warm-up, the device waited for, with and without the forward pass."""

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from sliplens.progress import OnProgress, counted
from sliplens.results.study import MethodTime, Timing
from sliplens.study.material import Material, as_the_thesis_ran

_REPEATS, _SLOW_REPEATS, _SLOW_S = 5, 3, 3.0


def time_explainers(material: Material, *, on_progress: OnProgress | None = None) -> Timing:
    """Time each method on the first frame: the median and the extremes of a few runs.

    The thesis's Poly-CAM is timed with all its channels, as it was run, even where a budget makes its maps.
    """
    model, inputs, references = material.trained.model, material.inputs[:1], material.references[:1]
    forward = float(np.median(_seconds(lambda: material.trained.predict(inputs))))
    methods, counts = {}, []
    for name, explainer in counted(as_the_thesis_ran(material.explainers).items(), on_progress):
        seconds = _seconds(lambda explainer=explainer: explainer(model, inputs, reference=references).relevance)
        median = float(np.median(seconds))
        counts.append(len(seconds))
        # without the forward pass: the thesis left it out of Grad-CAM's time
        methods[name] = MethodTime(
            seconds=median, seconds_without_forward=max(0.0, median - forward), low=min(seconds), high=max(seconds)
        )
    return Timing(
        input=material.explained.input,
        source=material.explained.source,
        device=inputs.device.type,
        threads=torch.get_num_threads(),
        # of the method that takes longest; the others have more
        repeats=min(counts),
        forward_seconds=forward,
        methods=methods,
    )


def _seconds(work: Callable[[], Tensor]) -> list[float]:
    """Seconds of each of a few runs, after one that does not count; fewer where one takes long."""
    seconds: list[float] = []
    work()
    while len(seconds) < (_SLOW_REPEATS if seconds and seconds[0] > _SLOW_S else _REPEATS):
        started = time.perf_counter()
        result = work()
        if result.is_cuda:
            torch.cuda.synchronize(result.device)
        seconds.append(time.perf_counter() - started)
    return seconds
