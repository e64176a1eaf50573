"""The label of every frame: its forces, its safety margin with uncertainty, its contact state, and its validity."""

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import RecordingError
from sliplens.mechanics import safety_margin, stick_ratio
from sliplens.recordings.labels.axes import ContactForces, ForceAxes
from sliplens.recordings.labels.friction import FrictionEstimate
from sliplens.recordings.labels.interpolation import FrameForces, interpolate_forces
from sliplens.recordings.labels.lag import Lag
from sliplens.recordings.labels.smoothing import mean_force, typical_step
from sliplens.recordings.trial import ContactState

_CONTACT_SIGMAS = 8.0
"""Least normal force of a contact, in standard deviations of its noise."""
_CONTACT_SHARE = 0.05
"""And as a share of the trial's largest: of a lighter touch the margin would be all noise."""
_GAP_STEPS = 4.0
"""Samples further apart than so many typical steps miss others between them."""
_STUCK_SIGMAS = 2.0
"""A margin nearer to 1 than so many standard deviations cannot be told from full stick."""
_RATE_STEPS = 3.0
"""Frames on either side from which it is read how fast the margin changes: fewer would show the noise's changes."""


class Reason(StrEnum):
    """Why a frame has no valid label; empty where it has one."""

    NONE = ""
    MISSING_SAMPLES = "missing samples"
    OUT_OF_RANGE = "outside the force sensor's range"
    NO_CONTACT = "no contact"
    AFTER_GROSS_SLIP = "after gross slip"


@dataclass(frozen=True, kw_only=True)
class Labels:
    """Labels of a trial's frames, and all that they rest on.

    After gross slip the margin is 0 and not valid: the friction that then holds is another one, and the margin never
    silently returns. The friction coefficient is static until the slip, then F_t / F_n, so that in contact every margin
    is 1 - F_t / (mu F_n).
    """

    time_s: Float[np.ndarray, " frames"]
    """On the camera's clock, untouched."""
    force_time_s: Float[np.ndarray, " frames"]
    """On the force sensor's clock: where the forces were taken."""
    normal_force_n: Float[np.ndarray, " frames"]
    """NaN where samples are missing."""
    tangential_force_n: Float[np.ndarray, " frames"]
    friction_coefficient: Float[np.ndarray, " frames"]
    safety_margin: Float[np.ndarray, " frames"]
    """NaN without contact, where samples are missing and outside the sensor's range."""
    safety_margin_sigma: Float[np.ndarray, " frames"]
    """Standard uncertainty; NaN where the label is not valid."""
    stick_ratio: Float[np.ndarray, " frames"]
    """Of a sphere on a flat: the margin to the power 2/3."""
    contact_state: tuple[ContactState, ...]
    valid: Bool[np.ndarray, " frames"]
    reason: tuple[Reason, ...]
    axes: ForceAxes
    friction: FrictionEstimate
    slip_s: float | None
    """First gross slip, on the force sensor's clock; None if there is none."""
    lag: Lag | None
    """As estimated; None if it was not."""
    lag_applied: bool
    contact_threshold_n: float
    window_s: float
    """Time over which the forces of a frame were averaged."""
    gap_s: float
    """Samples further apart than this count as missing."""
    force_range_n: float | None

    def count(self) -> dict[str, int]:
        """Count the frames by reason, those with a valid label as 'valid'."""
        return dict(Counter(str(reason) or "valid" for reason in self.reason))


def contact_threshold(forces: ContactForces, *, window_s: float) -> float:
    """Least normal force that counts as contact: well above the noise, and a small share of the trial's largest."""
    smooth = mean_force(forces.time_s, forces.normal_n, forces.time_s, window_s=window_s)
    return float(max(_CONTACT_SIGMAS * forces.noise_of_means_n(window_s).normal, _CONTACT_SHARE * smooth.max(), 1e-9))


def label_frames(
    frame_time_s: Float[np.ndarray, " frames"],
    forces: ContactForces,
    *,
    friction: FrictionEstimate,
    lag: Lag | None = None,
    apply_lag: bool = False,
    contact_threshold_n: float | None = None,
    force_range_n: float | None = None,
    window_s: float | None = None,
    gap_s: float | None = None,
    friction_change: float = 0.0,
) -> Labels:
    """Label frames, each at its own time.

    The force of a frame is the mean over a short window of the line through the samples; no window reaches over the
    onset of slip. Noise, tare, friction, lag and a change of the friction on the way to the slip all enter the
    uncertainty of the margin, as independent of each other. A lag that is known but not applied counts as an error of
    its size.

    Parameters
    ----------
    frame_time_s
        Times on the camera's clock.
    forces
        In the axes of the contact.
    friction
        Static friction, estimated or given. Where it tells no onset, gross slip begins with the first frame whose
        forces clearly lie outside the friction cone.
    lag
        The camera's lag, as far as it is known.
    apply_lag
        Take the forces of a frame at its time less the lag.
    contact_threshold_n
        Least normal force of a contact; chosen by `contact_threshold` if None.
    force_range_n
        What each axis of the force sensor can measure, either way; None if it is not known.
    window_s
        Time over which forces are averaged, the time of a frame if None; 0 interpolates between two samples.
    gap_s
        Samples further apart count as missing; a few of their typical steps if None.
    friction_change
        Relative standard deviation of the change of friction from touch to slip, where it is known to drift.

    Raises
    ------
    RecordingError
        If a lag is to be applied that is not known or doubtful.
    """
    if apply_lag and (lag is None or lag.doubt):
        cause = "it is not estimated" if lag is None else lag.doubt
        raise RecordingError(f"the lag cannot be applied: {cause}; give the lag by hand or leave it out")
    window = typical_step(frame_time_s) if window_s is None else window_s
    gap = _GAP_STEPS * typical_step(forces.time_s) if gap_s is None else gap_s
    threshold = contact_threshold(forces, window_s=window) if contact_threshold_n is None else contact_threshold_n
    onset = np.inf if friction.onset_s is None else friction.onset_s

    def forces_at(time_s: Float[np.ndarray, " frames"]) -> FrameForces:
        return interpolate_forces(
            forces, time_s, window_s=window, gap_s=gap, until_s=onset, force_range_n=force_range_n
        )

    shift = lag.lag_s if lag is not None and apply_lag else 0.0
    unsure = 0.0 if lag is None else lag.sigma_s if apply_lag else float(np.hypot(lag.lag_s, lag.sigma_s))
    time = frame_time_s - shift
    at = forces_at(time)
    contact = at.normal_n >= threshold
    used = _used(at, friction, threshold)
    # a chord as short as the lag's uncertainty would count the noise of its ends, which `_variance` counts already
    reach = max(unsure, _RATE_STEPS * typical_step(frame_time_s), 1e-9)
    # up to the slip only: beyond it there is no margin to be wrong about, and a window at it would shrink to a sample
    end = np.minimum(time + reach, onset - window / 2)
    early, late = (_used(forces_at(moment), friction, threshold) for moment in (end - 2 * reach, end))
    swing = (late - early) / 2 * unsure / reach
    drift = friction_change * _remaining(time, contact, until_s=onset)
    sigma = np.sqrt(_variance(at, friction, threshold) + swing**2 + (used * drift) ** 2)

    reliable = contact & ~at.missing & ~at.out_of_range
    slip_s = friction.onset_s
    if slip_s is None and np.any(outside := reliable & (used > 1 + sigma)):
        slip_s = float(time[np.argmax(outside)])
    slipped = time >= (np.inf if slip_s is None else slip_s)
    margin = safety_margin(np.where(contact, at.normal_n, 0.0), at.tangential_n, friction.mu)
    margin = np.where(at.missing | at.out_of_range, np.nan, np.where(slipped & contact, 0.0, margin))
    valid = reliable & ~slipped
    holds = np.where(slipped & contact & (at.tangential_n > 0), used * friction.mu, friction.mu)
    return Labels(
        time_s=frame_time_s,
        force_time_s=time,
        normal_force_n=np.where(at.missing, np.nan, at.normal_n),
        tangential_force_n=np.where(at.missing, np.nan, at.tangential_n),
        friction_coefficient=holds,
        safety_margin=margin,
        safety_margin_sigma=np.where(valid, sigma, np.nan),
        stick_ratio=stick_ratio(margin),
        contact_state=_states(contact, slipped=slipped, stuck=used < _STUCK_SIGMAS * sigma),
        valid=valid,
        reason=_reasons(at, contact, slipped),
        axes=forces.axes,
        friction=friction,
        slip_s=slip_s,
        lag=lag,
        lag_applied=apply_lag,
        contact_threshold_n=threshold,
        window_s=window,
        gap_s=gap,
        force_range_n=force_range_n,
    )


def _used(at: FrameForces, friction: FrictionEstimate, threshold_n: float) -> Float[np.ndarray, " frames"]:
    """Share of the friction that is used, F_t / (mu F_n); of a lighter touch than the threshold, as if it were that."""
    return at.tangential_n / (friction.mu * np.maximum(at.normal_n, threshold_n))


def _variance(at: FrameForces, friction: FrictionEstimate, threshold_n: float) -> Float[np.ndarray, " frames"]:
    """Variance of the margin from that of the forces and of the friction."""
    normal, used = np.maximum(at.normal_n, threshold_n), _used(at, friction, threshold_n)
    return (
        (at.tangential_sigma_n / (friction.mu * normal)) ** 2
        + (used * at.normal_sigma_n / normal) ** 2
        + (used * friction.sigma / friction.mu) ** 2
    )


def _remaining(
    time_s: Float[np.ndarray, " frames"], contact: Bool[np.ndarray, " frames"], *, until_s: float
) -> Float[np.ndarray, " frames"]:
    """Share of the way from touch to slip that is still to go: 1 at the touch, 0 from the slip on."""
    if not contact.any():
        return np.zeros(len(time_s))
    touch, end = time_s[np.argmax(contact)], min(until_s, time_s[-1])
    return np.clip((end - time_s) / max(end - touch, 1e-9), 0, 1)


def _states(
    contact: Bool[np.ndarray, " frames"], *, slipped: Bool[np.ndarray, " frames"], stuck: Bool[np.ndarray, " frames"]
) -> tuple[ContactState, ...]:
    names = (ContactState.NO_CONTACT, ContactState.FULL_SLIP, ContactState.CONTACT, ContactState.INCIPIENT_SLIP)
    return tuple(names[index] for index in np.select([~contact, slipped, stuck], [0, 1, 2], default=3))


def _reasons(
    at: FrameForces, contact: Bool[np.ndarray, " frames"], slipped: Bool[np.ndarray, " frames"]
) -> tuple[Reason, ...]:
    """The first reason that holds; a frame without samples cannot be known to touch."""
    names = (Reason.MISSING_SAMPLES, Reason.OUT_OF_RANGE, Reason.NO_CONTACT, Reason.AFTER_GROSS_SLIP, Reason.NONE)
    flags = [at.missing, at.out_of_range, ~contact, slipped]
    return tuple(names[index] for index in np.select(flags, [0, 1, 2, 3], default=4))
