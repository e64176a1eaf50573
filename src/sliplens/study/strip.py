"""One trial read and explained from stick to slip, for a first look."""

from collections.abc import Sequence

import numpy as np
import torch

from sliplens.errors import RecordingError
from sliplens.models import Run
from sliplens.progress import OnProgress
from sliplens.recordings import Recording
from sliplens.results.strip import Strip, StripReadings
from sliplens.study.explaining import nearest_frame
from sliplens.study.material import study_explainers

_LEVELS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
_CONFIDENCE = 0.9


def explain_trial(
    run: Run,
    recording: Recording,
    *,
    source: str,
    method: str = "poly-cam",
    budget: float = 1.0,
    levels: Sequence[float] = _LEVELS,
    on_progress: OnProgress | None = None,
) -> Strip:
    """Read every frame of a trial, and explain those nearest to a few safety margins.

    Parameters
    ----------
    source
        `simulated` or `real`.
    method
        Explainer of the maps (`study_explainers`).
    budget
        Share of the channels that `poly-cam` measures at first.
    levels
        Safety margins whose frames are explained, in [0, 1]; a frame that is nearest to two is shown once.
    """
    margin = np.where(recording.labelled, recording.safety_margin, np.nan)
    if not np.isfinite(margin).any():
        raise RecordingError(f"trial {recording.trial} has no labelled frame; label it first")
    shown = tuple(sorted({nearest_frame(margin, level) for level in levels}))
    inputs = run.encode(recording.frames, recording.reference)
    estimate = run.estimate(inputs)
    unknown = np.full(len(margin), np.nan)
    low, high = estimate.interval(_CONFIDENCE) or (unknown, unknown)
    reference = run.encoding.empty(recording.reference, image_size=run.manifest.image_size)
    explainer = study_explainers([method], budget=budget)[method]
    explanation = explainer(
        run.model, inputs[list(shown)], reference=reference.expand(len(shown), -1, -1, -1), on_progress=on_progress
    )
    return Strip(
        trial=recording.trial,
        condition=recording.condition,
        source=source,
        input=run.manifest.input,
        method=method,
        readings=StripReadings(
            time_s=recording.time_s.astype(np.float64),
            contact_state=np.array([str(state) for state in recording.contact_state]),
            safety_margin=margin.astype(np.float64),
            prediction=estimate.margin.astype(np.float64),
            low=low.astype(np.float64),
            high=high.astype(np.float64),
        ),
        shown=shown,
        pictures=recording.frames[list(shown)],
        relevance=explanation.relevance.to(torch.float32).cpu().numpy(),
    )
