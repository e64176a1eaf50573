"""What a map costs: seconds a frame, with warm-up, the device waited for, with and without the forward pass."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sliplens.files import write_json
from sliplens.study.explaining import RESULT_FILE
from sliplens.study.material import Material, as_the_thesis_ran

_REPEATS, _SLOW_REPEATS, _SLOW_S = 5, 3, 3.0


def time_explainers(material: Material, folder: Path, *, on_method: Callable[[int, int], None] | None = None) -> None:
    """Time each method on one frame, and write the median and the extremes of a few runs.

    The thesis's Poly-CAM is timed with all its channels, as it was run, even where a budget makes its maps.

    Parameters
    ----------
    material
        The network, frames (the first is timed) and methods.
    folder
        Gets `result.json`; must exist.
    on_method
        Called with the methods done and their number.
    """
    model, inputs, references = material.trained.model, material.inputs[:1], material.references[:1]
    forward = float(np.median(_seconds(lambda: material.trained.predict(inputs))))
    told, counts = {}, []
    for number, (name, explainer) in enumerate(as_the_thesis_ran(material.explainers).items(), start=1):
        seconds = _seconds(lambda one=explainer: one(model, inputs, reference=references).relevance)
        middle = float(np.median(seconds))
        counts.append(len(seconds))
        told[name] = {
            "seconds": middle,
            # what the thesis left out of Grad-CAM's time
            "seconds_without_forward": max(0.0, middle - forward),
            "low": min(seconds),
            "high": max(seconds),
        }
        if on_method is not None:
            on_method(number, len(material.explainers))
    write_json(
        folder / RESULT_FILE,
        {
            "input": material.explained.input,
            "source": material.explained.source,
            "device": inputs.device.type,
            "threads": torch.get_num_threads(),
            # of the method that takes longest; the others have more
            "repeats": min(counts),
            "forward_seconds": forward,
            "methods": told,
        },
    )


def _seconds(work: Callable[[], Tensor]) -> list[float]:
    """Seconds of each of a few runs, after one that does not count; fewer where one takes long."""
    found: list[float] = []
    work()
    while len(found) < (_SLOW_REPEATS if found and found[0] > _SLOW_S else _REPEATS):
        started = time.perf_counter()
        result = work()
        if result.is_cuda:
            torch.cuda.synchronize(result.device)
        found.append(time.perf_counter() - started)
    return found
