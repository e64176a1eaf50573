"""From what was recorded to labels in one go: axes, lag, friction, margins, in that order."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sliplens.recordings.capture import Forces
from sliplens.recordings.labels.axes import apply_axes, infer_axes
from sliplens.recordings.labels.friction import FrictionEstimate, ImageMotion, estimate_friction
from sliplens.recordings.labels.lag import Lag, estimate_lag
from sliplens.recordings.labels.margin import Labels, contact_threshold, label_frames
from sliplens.recordings.labels.smoothing import typical_step


@dataclass(frozen=True, kw_only=True)
class LabelSettings:
    """What is known of a trial beforehand; None is found out."""

    normal: str | None = None
    """Axis of the force sensor that presses: x, y or z."""
    sign: int | None = None
    """1 where pressing is positive as recorded, else -1."""
    tare_n: tuple[float, float, float] | None = None
    """What the sensor reads untouched."""
    friction: FrictionEstimate | None = None
    """Given by hand; see `given_friction`."""
    friction_change: float = 0.0
    """Relative standard deviation of the change of friction from touch to slip."""
    lag: Lag | None = None
    """Measured otherwise."""
    apply_lag: bool = False
    contact_threshold_n: float | None = None
    force_range_n: float | None = None
    window_s: float | None = None
    gap_s: float | None = None


def label_trial(
    frame_time_s: Float[np.ndarray, " frames"],
    image_motion: Float[np.ndarray, " frames"],
    forces: Forces,
    *,
    settings: LabelSettings,
    rng: np.random.Generator,
) -> Labels:
    """Label the frames of a trial.

    The lag is estimated whether or not it is applied, and helps to tell at which fall of the force the image moves.

    Parameters
    ----------
    frame_time_s
        Times on the camera's clock.
    image_motion
        See `measure_motion`.
    forces
        As recorded.
    settings
        What is known beforehand.
    rng
        Source of the bootstraps.

    Raises
    ------
    RecordingError
        If nothing touches, the trial never slips and no friction is given, or a doubtful lag is to be applied.
    """
    declared = None if settings.tare_n is None else np.array(settings.tare_n, dtype=np.float64)
    axes = infer_axes(forces, normal=settings.normal, sign=settings.sign, tare_n=declared)
    turned = apply_axes(forces, axes)
    lag = settings.lag
    if lag is None:
        lag = estimate_lag(frame_time_s, image_motion, forces, rng=rng)
    window = typical_step(frame_time_s) if settings.window_s is None else settings.window_s
    threshold = settings.contact_threshold_n
    if threshold is None:
        threshold = contact_threshold(turned, window_s=window)
    friction = settings.friction
    if friction is None:
        seen = ImageMotion(time_s=frame_time_s - (0.0 if lag.doubt else lag.lag_s), motion=image_motion)
        friction = estimate_friction(turned, contact_threshold_n=threshold, rng=rng, image=seen)
    return label_frames(
        frame_time_s,
        turned,
        friction=friction,
        lag=lag,
        apply_lag=settings.apply_lag,
        contact_threshold_n=threshold,
        force_range_n=settings.force_range_n,
        window_s=window,
        gap_s=settings.gap_s,
        friction_change=settings.friction_change,
    )
