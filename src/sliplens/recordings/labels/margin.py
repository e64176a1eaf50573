"""Labels of frames: forces, safety margin with uncertainty, contact state and validity."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import RecordingError
from sliplens.mechanics import safety_margin, stick_ratio
from sliplens.recordings.capture import Forces
from sliplens.recordings.labelling import BY_HAND, FrictionEstimate, LabelBasis, Lag, Reason, describe_faults
from sliplens.recordings.labels import axes
from sliplens.recordings.labels.axes import ContactForces, MeanForces, Samples
from sliplens.recordings.labels.faults import FAULTS, MARKED, Screened, screen_trial
from sliplens.recordings.labels.friction import ImageMotion, estimate_friction, find_contacts
from sliplens.recordings.labels.lag import doubt_agreement, doubt_lag
from sliplens.recordings.options import LabelSettings
from sliplens.recordings.trial import ContactState, Labels

Frames: TypeAlias = Float[np.ndarray, " frames"]


# least normal force of a contact, by its noise and its largest: of a lighter touch the margin would be all noise
_CONTACT_SIGMAS, _CONTACT_SHARE = 8.0, 0.05
LARGEST_SIGMA = 0.2
"""Largest standard uncertainty of a valid margin: beyond, full stick and slip are hardly different."""
_STUCK_SIGMAS = 2.0  # a margin nearer to 1 than so many standard deviations cannot be distinguished from full stick
_RATE_STEPS = 3.0  # frames on either side over which the rate of the margin is measured: fewer would show the noise
_MOST_LOST = 0.5  # share of the samples between touch and slip that may be faulty
_PLAUSIBLE_FRICTION, _USUAL_FRICTION = (0.05, 4.0), 1.5  # of soft skins on anything; of dry rubber on glass
_PLAUSIBLE_N = 0.05, 200.0  # largest force of a contact: ten times a sensor's noise, and twice the hardest pinch
# half way, by ratio, from equal lengths to one that is half the other: a rate is usually wrong by two or more
_LIKE_SPANS = 0.7
_NEAR_LAG_S = 0.12  # clocks that run alike fit best within some frames; others, if at all, far off


@dataclass(frozen=True, kw_only=True)
class FoundLabels(Labels):
    """Labels from forces, with the estimates behind them.

    After gross slip the margin is 0 and not valid until the contact is released and loaded again, for the friction then
    is another. The friction coefficient is static until the slip, then F_t / F_n, so that in contact every margin is
    1 - F_t / (mu F_n).
    """

    # required here: a keyword needs no default, though the base has one
    safety_margin_sigma: Float[np.ndarray, " _"]  # pyright: ignore[reportGeneralTypeIssues]
    valid: Bool[np.ndarray, " _"]  # pyright: ignore[reportGeneralTypeIssues]
    reason: tuple[Reason, ...]  # pyright: ignore[reportGeneralTypeIssues]
    force_time_s: Float[np.ndarray, " _"]  # pyright: ignore[reportGeneralTypeIssues]
    basis: LabelBasis


def contact_threshold(forces: ContactForces, *, window_s: float) -> float:
    """Return the least normal force of a contact, well above the noise, and a share of the largest force."""
    smooth = axes.mean_force(forces.time_s, forces.normal_n, forces.time_s, window_s=window_s)
    return float(max(_CONTACT_SIGMAS * forces.noise_of_means_n(window_s)[0], _CONTACT_SHARE * smooth.max(), 1e-9))


def label_frames(
    frame_time_s: Frames,
    forces: ContactForces,
    *,
    friction: FrictionEstimate,
    lag: Lag | None = None,
    settings: LabelSettings = LabelSettings(),  # noqa: B008 (frozen)
    screened: Screened | None = None,
) -> FoundLabels:
    """Label frames, each at its own time.

    The force of a frame is the mean over its time; no window reaches over the onset of slip. Noise, tare, friction, lag
    and a change of the friction enter the uncertainty of the margin, as independent of each other; a lag that is known
    but not applied counts as an error of its size. Where the friction has no onset, gross slip begins with the first
    frame whose forces clearly lie outside the friction cone, and lasts until the contact is loaded again.
    """
    apply_lag = settings.apply_lag or settings.lag_ms is not None
    if apply_lag and (lag is None or lag.doubt):
        cause = "it is not estimated" if lag is None else lag.doubt
        raise RecordingError(f"the lag cannot be applied: {cause}; give the lag by hand or leave it out")
    window = axes.typical_step(frame_time_s)
    threshold = contact_threshold(forces, window_s=window)
    onset = np.inf if friction.onset_s is None else friction.onset_s
    forces_at = partial(forces.means, window_s=window, until_s=onset)
    shift = lag.lag_s if lag is not None and apply_lag else 0.0
    unsure = 0.0 if lag is None else lag.sigma_s if apply_lag else float(np.hypot(lag.lag_s, lag.sigma_s))
    time = frame_time_s - shift
    at = forces_at(time)
    # the neighbours of a time on a sample are both that sample
    samples, count = forces.time_s, len(forces.time_s)
    before = samples[np.maximum(np.searchsorted(samples, time, side="right") - 1, 0)]
    after = samples[np.minimum(np.searchsorted(samples, time), count - 1)]
    missing = (time < samples[0]) | (time > samples[-1]) | (after - before > axes.longest_step(samples))
    contact = (at.normal_n >= threshold) & (time >= (-np.inf if settings.contact_s is None else settings.contact_s))
    used = _used(at, friction, threshold)
    # a chord as short as the lag's uncertainty would count the noise of its ends, which `variance` counts already
    reach = max(unsure, _RATE_STEPS * axes.typical_step(frame_time_s), 1e-9)
    # up to the slip only: beyond it there is no margin to be wrong about, and a window at it would shrink to a sample
    end = np.where(time < onset, np.minimum(time + reach, onset - window / 2), time + reach)
    early, late = (_used(forces_at(moment), friction, threshold) for moment in (end - 2 * reach, end))
    swing = (late - early) / 2 * unsure / reach
    # distance in time from the slip, where friction is known, as a share of the time from touch to slip, at most 1
    drift = np.full(len(time), settings.friction_change)
    if contact.any() and friction.onset_s is not None:
        drift *= np.clip(np.abs(onset - time) / max(onset - time[np.argmax(contact)], 1e-9), 0, 1)
    normal = np.maximum(at.normal_n, threshold)
    variance = (
        (at.tangential_noise_n**2 + at.tangential_tare_n**2) / (friction.mu * normal) ** 2
        + (at.normal_noise_n**2 + at.normal_tare_n**2) * (used / normal) ** 2
        + (used * friction.sigma / friction.mu) ** 2
    )
    sigma = np.sqrt(variance + swing**2 + (used * drift) ** 2)

    fault = np.zeros(len(time), dtype=np.int64) if screened is None else screened.codes_at(time, window_s=window)
    for first, last in settings.bad_frames:
        fault[first : last + 1] = MARKED
    reliable = contact & ~missing & (fault == 0)
    slip_s = friction.onset_s
    if slip_s is None and np.any(outside := reliable & (used > 1 + sigma)):
        slip_s = float(time[np.argmax(outside)])
    onsets = () if slip_s is None else (slip_s, *(later_s - window / 2 for later_s in friction.later_onsets_s))
    # a contact that has slipped has no label until it is released and loaded again
    slipped, touches = np.zeros(len(time), dtype=bool), find_contacts(forces, contact_threshold_n=threshold)
    for onset_s in onsets:
        anew_s = next((start_s for start_s, _ in touches if start_s > onset_s), np.inf)
        slipped |= (time >= onset_s) & (time < anew_s)
    margin = safety_margin(np.where(contact, at.normal_n, 0.0), at.tangential_n, friction.mu)
    margin = np.where(missing | (fault > 0), np.nan, np.where(slipped & contact, 0.0, margin))
    other_time = bool(doubt_lag(lag, applied=apply_lag, frame_s=window))
    valid = reliable & ~slipped & (sigma <= LARGEST_SIGMA) & (not other_time)
    holds = np.where(slipped & contact & (at.tangential_n > 0), used * friction.mu, friction.mu)
    return FoundLabels(
        force_time_s=time,
        normal_force_n=np.where(missing, np.nan, at.normal_n),
        tangential_force_n=np.where(missing, np.nan, at.tangential_n),
        friction_coefficient=holds,
        safety_margin=margin,
        safety_margin_sigma=np.where(valid, sigma, np.nan),
        stick_ratio=stick_ratio(margin),
        contact_state=_first_of(_STATES, ~contact, slipped, used <= _STUCK_SIGMAS * sigma),
        valid=valid,
        # a frame without samples, or with wrong ones, cannot be known to touch
        reason=_first_of(
            _REASONS,
            *(fault == kind for kind in range(1, len(FAULTS))),
            missing,
            ~contact,
            slipped,
            ~valid & (other_time or bool(friction.notes)),
            ~valid,
        ),
        basis=LabelBasis(
            axes=forces.axes,
            friction=friction,
            slip_s=slip_s,
            lag=lag,
            lag_applied=apply_lag,
            contact_threshold_n=threshold,
            faults=() if screened is None else screened.faults,
        ),
    )


def _used(at: MeanForces, friction: FrictionEstimate, threshold_n: float) -> Frames:
    """Compute the used share of the friction, F_t / (mu F_n), with at least the threshold for F_n."""
    return at.tangential_n / (friction.mu * np.maximum(at.normal_n, threshold_n))


_STATES = (ContactState.NO_CONTACT, ContactState.FULL_SLIP, ContactState.CONTACT, ContactState.INCIPIENT_SLIP)
_REASONS = (
    *FAULTS[1:],
    Reason.MISSING_SAMPLES, Reason.NO_CONTACT, Reason.AFTER_GROSS_SLIP, Reason.CONTRADICTED,
    Reason.TOO_UNCERTAIN, Reason.NONE,
)  # fmt: skip
_Word = TypeVar("_Word", ContactState, Reason)


def _first_of(words: Sequence[_Word], *flags: Bool[np.ndarray, " frames"]) -> tuple[_Word, ...]:
    """Return the word of the first flag that is True for a frame; the last word where none is."""
    return tuple(words[index] for index in np.select(flags, list(range(len(flags))), default=len(flags)))


def label_trial(
    frame_time_s: Frames, image_motion: Frames, forces: Forces, *, settings: LabelSettings, rng: np.random.Generator
) -> FoundLabels:
    """Label the frames of a trial: axes, lag, friction and margins, in that order.

    The lag is estimated unless it is set, even if it is not applied, to compare the image with falls of the force.
    """
    require_inside(settings, frames=len(frame_time_s), time_s=forces.time_s)
    screened, lag = screen_trial(frame_time_s, image_motion, forces, settings=settings, rng=rng)
    try:
        contact = axes.apply_axes(screened.forces, axes.infer_axes(screened.forces, settings, moved_s=screened.moved_s))
        friction = estimate_friction(
            contact,
            contact_threshold_n=contact_threshold(contact, window_s=axes.typical_step(frame_time_s)),
            rng=rng,
            image=ImageMotion(time_s=frame_time_s - (0.0 if lag.doubt else lag.lag_s), motion=image_motion),
            slip_s=settings.slip_s,
            mu=settings.mu,
            friction_change=settings.friction_change,
        )
        labels = label_frames(frame_time_s, contact, friction=friction, lag=lag, settings=settings, screened=screened)
        doubts = (
            *contact.axes.notes,
            *friction.notes,
            *screened.doubts,
            *_find_doubts(contact, labels.basis, frame_time_s=frame_time_s, recorded_s=forces.time_s),
            *doubt_agreement(frame_time_s, image_motion, screened.forces, lag),
        )
        return replace(labels, basis=replace(labels.basis, doubts=doubts))
    except RecordingError as error:
        if not screened.faults:
            raise
        steps = [fault.start_s for fault in screened.faults if fault.kind is Reason.STEP]
        slip = f"; if the contact slips at {steps[0]:.2f} s, give --slip-s {steps[0]:.2f}" if steps else ""
        raise RecordingError(f"{error} (left out were: {'; '.join(describe_faults(screened.faults))}{slip})") from None


def require_inside(settings: LabelSettings, *, frames: int, time_s: Frames) -> None:
    """Check that the settings lie within a trial of so many frames, with force samples at these times."""
    for first, last in settings.bad_frames:
        if not 0 <= first <= last < frames:
            raise RecordingError(f"frames {first} to {last} cannot be marked as bad: name them from 0 to {frames - 1}")
    if settings.reference_frame is not None and not 0 <= settings.reference_frame < frames:
        raise RecordingError(f"the reference is frame {settings.reference_frame} of {frames}; name one from 0 on")
    begin, end = float(time_s[0]), float(time_s[-1])
    for event, at_s in (("contact", settings.contact_s), ("slip", settings.slip_s)):
        if at_s is not None and not begin <= at_s <= end:
            raise RecordingError(f"the {event} is set to {at_s:.2f} s; set it from {begin:.2f} to {end:.2f} s")
    if settings.contact_s is not None and settings.slip_s is not None and settings.slip_s <= settings.contact_s:
        raise RecordingError(f"the slip is set to {settings.slip_s:.2f} s, before the contact; set the contact first")


def _find_doubts(forces: ContactForces, basis: LabelBasis, *, frame_time_s: Frames, recorded_s: Samples) -> list[str]:
    """Describe an implausible friction, a contact that pulls more than it presses, and clocks of different lengths."""
    friction, lag = basis.friction, basis.lag
    other_time = doubt_lag(lag, applied=basis.lag_applied, frame_s=axes.typical_step(frame_time_s))
    doubts = [other_time] if other_time else []
    first_s, last_s = frame_time_s[[0, -1]] - (lag.lag_s if lag is not None and basis.lag_applied else 0.0)
    if basis.slip_s is not None and not first_s <= basis.slip_s <= last_s:
        outside = f"the forces slip at {basis.slip_s:.2f} s, and the frames are from {first_s:.2f} to {last_s:.2f} s"
        doubts.append(f"{outside}; if the camera ran then, give --frame-rate, --time-unit or --start-s")
    begin = recorded_s[0] if basis.axes.still_until_s is None else basis.axes.still_until_s
    pull = recorded_s[(recorded_s > begin) & (recorded_s < (begin if friction.onset_s is None else friction.onset_s))]
    if np.isin(pull, forces.time_s, invert=True).sum() > _MOST_LOST * len(pull):
        raise RecordingError("most samples between touch and slip are faulty; give the friction with --mu")
    low, high = _PLAUSIBLE_FRICTION
    usual = f"that of a fingertip lies between {low:g} and {high:g}"
    if not low <= friction.mu <= high:
        if friction.method != BY_HAND:
            cure = "give --normal-axis, or --mu"
            raise RecordingError(f"the friction comes out as {friction.mu:.3g}, and {usual}; {cure}")
        doubts.append(f"a friction of {friction.mu:.3g} was given, and {usual}")
    elif friction.mu > _USUAL_FRICTION:
        seldom = f"that of a fingertip seldom exceeds {_USUAL_FRICTION:g}: check --normal-axis and --mu"
        doubts.append(f"the friction is {friction.mu:.3g}, and {seldom}")
    pressed_n = float(forces.normal_n.max())
    if not _PLAUSIBLE_N[0] <= pressed_n <= _PLAUSIBLE_N[1]:
        usual = f"a fingertip presses with {_PLAUSIBLE_N[0]:g} to {_PLAUSIBLE_N[1]:g} N"
        doubts.append(f"the largest normal force is {pressed_n:.3g} N, and {usual}; give --force-unit on import")
    pulls, presses = (np.mean(side > basis.contact_threshold_n) for side in (-forces.normal_n, forces.normal_n))
    if pulls > presses:
        samples = f"{100 * pulls:.0f} % of the samples, positive in {100 * presses:.0f} %"
        doubts.append(f"the normal force is negative in {samples}; give its sign with --normal-sign")
    fits = lag is not None and not lag.doubt and lag.correlation is not None and abs(lag.lag_s) <= _NEAR_LAG_S
    frames_s, forces_s = float(np.ptp(frame_time_s)), float(np.ptp(recorded_s))
    if not fits and min(frames_s, forces_s) < _LIKE_SPANS * max(frames_s, forces_s):
        lengths = f"the frames last {frames_s:.2f} s and the forces {forces_s:.2f} s"
        cure = "if a clock runs wrong, give --frame-rate or --time-unit on import"
        doubts.append(f"{lengths}, the image does not move with the force; {cure}")
    return doubts
