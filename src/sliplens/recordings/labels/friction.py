"""Static friction of a trial: the ratio of tangential to normal force at the onset of gross slip."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sliplens.errors import RecordingError
from sliplens.friction import MOST_FRICTION
from sliplens.recordings.labelling import BY_HAND, FrictionEstimate
from sliplens.recordings.labels import axes
from sliplens.recordings.labels.axes import ContactForces, Samples, Times

_REACH_S, _TRIES = 0.08, 41  # how far the break may lie from the rough guess, and breaks tried over that reach
# lengths of the fall that are tried, from a sudden drop to that of a soft fingertip
_FALLS_S = (0.005, 0.007, 0.01, 0.014, 0.02, 0.028, 0.04, 0.056, 0.08)
_LEAST_BEFORE, _LEAST_AFTER, _LEAST_LINE = 6, 3, 4  # samples that the sides of a break, and a line up to it, need
_GAP_S = 0.04  # a gap of the samples that may hide a slip: over a shorter one the fit changes little
_PARAMETERS = 7  # degrees of freedom of a fit: five coefficients, the time of the break, the end of the fall
_MEMORY, _LONGEST_BLOCK = 0.2, 0.1  # residuals that correlate by more are resampled together; share of the samples


class Break(NamedTuple):
    """A line that rises to a break, falls, and goes on level."""

    time_s: float
    level: float  # at the break
    levels: Float[np.ndarray, " draws"]  # at the breaks of the bootstrap's draws


def fit_break(
    time_s: Samples, values: Samples, *, about_s: float, rng: np.random.Generator, draws: int, reach_s: float = _REACH_S
) -> Break:
    """Fit a parabola that at a break goes over into a fall and then a line, by least squares.

    The bootstrap resamples blocks of the residuals. With too few samples the break lies between two of them.
    """
    tried = [
        (moment, fall)
        for moment in about_s + np.unique(np.linspace(-reach_s, reach_s, _TRIES))
        for fall in _FALLS_S
        if np.sum(time_s < moment) >= _LEAST_BEFORE and np.sum(time_s > moment + fall) >= _LEAST_AFTER
    ]
    if not tried:
        # the break itself is rough: a sample half a step beyond may still be before it
        near = np.flatnonzero(time_s <= about_s + axes.typical_step(time_s) / 2)
        before = near[max(0, len(near) - _LEAST_BEFORE) : np.argmax(values[near]) + 1] if len(near) else near
        between_s = tuple(time_s[before[-1] :][:2]) if len(before) else ()
        return bracket_break(time_s[before], values[before], between_s=between_s, rng=rng, draws=draws)
    moments, falls = np.array(tried).T
    since = time_s - moments[:, None]
    before, after = np.minimum(since, 0), np.maximum(since, 0)
    fall, end = np.minimum(after / falls[:, None], 1), np.maximum(after - falls[:, None], 0)
    # level at the break, slope and bend before it, depth of the fall, slope after it
    bases, triangles = np.linalg.qr(np.stack((np.ones_like(since), before, before**2, fall, end), axis=2))
    (index,), (level,) = _best(bases, triangles, values[:, None])
    fitted = bases[index] @ (bases[index].T @ values)
    residuals = values - fitted
    # the parameters of a fit explain a part of the noise
    residuals = (residuals - residuals.mean()) * np.sqrt(len(values) / max(1, len(values) - _PARAMETERS))
    drawn = fitted[:, None] + residuals[_blocks(residuals, draws=draws, rng=rng)]
    return Break(float(moments[index]), float(level), _best(bases, triangles, drawn)[1])


def bracket_break(
    time_s: Samples, values: Samples, *, between_s: Sequence[float], rng: np.random.Generator, draws: int
) -> Break:
    """Extend the line through samples to a break anywhere between two times."""
    if len(time_s) < _LEAST_LINE or len(between_s) < 2:
        few = f"only {len(time_s)} samples up to the slip, or none after it, can be used"
        raise RecordingError(f"{few}; record the forces faster or give the friction with --mu")
    line = np.polynomial.Polynomial.fit(time_s, values, 1)
    noise = np.std(values - line(time_s), ddof=2) * np.sqrt(_LEAST_LINE / len(time_s))
    times, middle_s = rng.uniform(between_s[0], between_s[1], draws), float(np.mean(between_s))
    return Break(middle_s, float(line(middle_s)), line(times) + rng.normal(0, noise, draws))


def _best(
    bases: Float[np.ndarray, "breaks samples parameters"],
    triangles: Float[np.ndarray, "breaks parameters parameters"],
    values: Float[np.ndarray, "samples draws"],
) -> tuple[Int[np.ndarray, " draws"], Float[np.ndarray, " draws"]]:
    """Return the index of the break that fits each column best, and the level there."""
    shares = np.swapaxes(bases, 1, 2) @ values
    chosen = np.argmax(np.sum(shares**2, axis=1), axis=0)
    best = shares[chosen, :, np.arange(values.shape[1]), None]
    return chosen, np.linalg.solve(triangles[chosen], best)[:, 0, 0]


def _blocks(residuals: Samples, *, draws: int, rng: np.random.Generator) -> Int[np.ndarray, "samples draws"]:
    """Return indices that resample blocks of neighbours, a column a draw; white noise is resampled singly."""
    count = len(residuals)
    power = max(float(residuals @ residuals), 1e-300)
    longest = max(1, int(_LONGEST_BLOCK * count))
    remembers = np.array([residuals[lag:] @ residuals[:-lag] / power > _MEMORY for lag in range(1, longest)])
    memory = longest if remembers.all() else int(np.argmin(remembers))
    # a memory of one sample needs blocks of a few, for each is cut at its ends
    length = min(longest, 1 + 4 * memory)
    starts = rng.integers(0, count - length + 1, (int(np.ceil(count / length)), 1, draws))
    return (starts + np.arange(length)[:, None]).reshape(-1, draws)[:count]


_WINDOWS_S = (0.03, 0.1)  # over which forces are averaged to find a break roughly: the longer finds faint falls
# a fall of the averaged ratio is significant by its noise, and by its size: less is a wobble of the hand that pulls
_DROP_SIGMAS, _DROP_SHARE = 5.0, 0.03
_DROP_S = 0.25  # time in which the ratio must have fallen: slip is sudden, a release is slow
PRESSED_SHARE = 0.25  # of the largest normal force: in a lighter touch the ratio is all noise
_STEP_S = 0.06  # time over which the ratio before and after a fall is compared to place it
_NORMAL_SHARE = 0.5  # of the normal force that stays in a slip; less stays in a release
_SUDDEN = 1.5  # the fall of a slip is so many times that in as long a time before or after it
_SLIDING_SHARE = 0.3  # of static friction: kinetic friction is more; a pull that is released falls to nothing
_PULL_SHARE = 0.5  # share of the fall of the ratio that the pull falls by: a firmer press alone is no slip
_APART_S = 0.1  # a load that is lost for less time is the same contact
# time about its break in which the ratio is fitted: the longer is more exact, unless the pull was no parabola so long
_BEFORE_S, _AFTER_S = (0.6, 0.25, 0.1), 0.2
_LIKE_SHARE, _LIKE_SIGMAS = 0.02, 5.0  # a parabola that ends this far from the largest mean ratio there was none
_BEFORE_STEPS, _AFTER_STEPS = 12, 6  # and of slow samples at least so many
_BAND = (0.16, 0.84)  # quantiles that hold 68 %
_IMAGE_SIGMAS, _QUIET_S = 3.0, 0.5  # image motion that shows the slip, against that of so long a time before
LAW_SIGMAS, _LAW_SHARE = 3.0, 0.01  # a ratio contradicts the friction by more of both: a break lies between samples


@dataclass(frozen=True, kw_only=True)
class ImageMotion:
    """Difference of each frame from the one before, at the times of the frames on the clock of the force sensor."""

    time_s: Float[np.ndarray, " frames"]
    motion: Float[np.ndarray, " frames"]  #: See `measure_motion`; the first value is not used.


class _MeanRatio(NamedTuple):
    """Forces averaged about each sample, and their ratio where something presses; 0 elsewhere."""

    time_s: Samples
    normal_n: Samples
    tangential_n: Samples
    ratio: Samples
    sigma: Samples  # of the ratio's noise
    least: Samples  # ratio less 5 standard deviations of its noise
    tare_sigma: Samples  # of the ratio for the uncertainty of the tare
    pressed: Bool[np.ndarray, " samples"]  # the normal force is large enough for a ratio
    pulled: Bool[np.ndarray, " samples"]  # the tangential force is more than noise, too


def find_contacts(forces: ContactForces, *, contact_threshold_n: float) -> tuple[tuple[float, float], ...]:
    """Find the contacts: spans of time, in seconds, each from a touch to its release; light or short ones are none."""
    time = forces.time_s
    normal = axes.mean_force(time, forces.normal_n, time, window_s=_STEP_S)
    spans, least = axes.find_spans(time, normal > contact_threshold_n, apart_s=_APART_S), PRESSED_SHARE * normal.max()
    return tuple((float(time[start]), float(time[end - 1])) for start, end in spans if normal[start:end].max() >= least)


def estimate_friction(
    forces: ContactForces,
    *,
    contact_threshold_n: float,
    rng: np.random.Generator,
    image: ImageMotion | None = None,
    slip_s: float | None = None,
    mu: float | None = None,
    friction_change: float = 0.0,
    draws: int = 300,
) -> FrictionEstimate:
    """Estimate static friction at the onset of gross slip, with a bootstrap interval, and when each contact slips.

    A slip is a sudden fall of F_t / F_n while the normal force stays, from a height that the contact exceeds neither
    before nor after it. About the first slip the ratio is fitted by a line that breaks off: rising until the onset,
    falling after it; mu_s is its value at the break. Of several falls of a contact the first at which the image moves
    counts, or else the first. `friction_change` is the relative standard deviation of friction within the trial.

    Friction and slip are independent: where `slip_s` sets the onset, in seconds, the ratio breaks off there; where `mu`
    sets the friction, the slips are found as well. If the friction contradicts the forces, because the ratio exceeds it
    or slips elsewhere by more than 3 sigma, the difference counts as an error, and the notes give the numbers.
    """
    if not np.ptp(forces.tangential_n, axis=0).any():
        # a sensor that measures it has noise, a simulated pull changes
        never = f"{forces.recorded.source} has no tangential force (both axes but {forces.axes.normal} never change)"
        raise RecordingError(f"{never}, and a margin needs it; name the columns of all axes with --force-columns")
    spans = find_contacts(forces, contact_threshold_n=contact_threshold_n)
    means = [_mean_ratio(forces, window_s=window_s, contact_threshold_n=contact_threshold_n) for window_s in _WINDOWS_S]
    rough: list[float] = []
    elsewhere: list[float] = []  # than the slip that is set
    for start, end in spans:
        falls = [_find_falls(mean, start_s=start, end_s=end, friction_change=friction_change) for mean in means]
        # where samples are missing, the faint falls as well: a clear one later may be that of a sliding contact
        hidden = [time_s for time_s in chain(*falls) if np.ptp(_find_gap(forces.time_s, time_s)) > 0]
        times = sorted({*next(filter(None, falls), []), *hidden})
        # a slip at which the image rests is less likely
        visible = [time_s for time_s in times if _is_seen(image, *_find_gap(forces.time_s, time_s))]
        target = elsewhere if slip_s is not None and start <= slip_s <= end else rough
        target += (visible or times)[:1]
    slips: list[FrictionEstimate] = []
    for time_s in [*sorted(rough if slip_s is None else [*rough, slip_s]), *elsewhere]:
        reach_s = 0.0 if time_s == slip_s else _REACH_S
        limits = {"contact_threshold_n": contact_threshold_n, "reach_s": reach_s, "draws": draws}
        try:
            slips.append(_fit_slip(forces, time_s, means=means[0], **limits, rng=rng))
        except RecordingError:
            if mu is None and not slips:
                raise
            value = slips[0].mu if mu is None else mu  # the friction is known without it
            slips.append(FrictionEstimate(mu=value, low=value, high=value, onset_s=time_s))
    other = slips.pop() if elsewhere else None
    # the window that shows most surely how far the ratio reaches
    mean = max(means, key=lambda mean: float(mean.least.max()))
    first = slips[0] if slips else None
    if mu is not None:
        estimate = FrictionEstimate(mu=mu, low=mu, high=mu, onset_s=first and first.onset_s)
    elif first is None:
        never = f"the trial never slips (F_t / F_n reaches {mean.ratio[mean.least.argmax()]:.2f} without breaking off)"
        raise RecordingError(f"{never}, so its friction is unknown; give it with --mu, or in a manifest")
    elif first.low <= 0:
        interval = f"{first.mu:.2g} with a 68 % interval from {first.low:.2g} to {first.high:.2g}, which is none"
        raise RecordingError(f"the slip at {first.onset_s:.2f} s gives a friction of {interval}; give it with --mu")
    elif first.onset_s == slip_s:
        estimate = replace(first, method="F_t / F_n at the slip set by hand")
    else:
        moves = _is_seen(image, *_find_gap(forces.time_s, first.onset_s or 0.0))
        estimate = replace(first, method="break of F_t / F_n" + (", seen in the image" if moves else ""))
    estimate = replace(estimate, later_onsets_s=tuple(slip.onset_s or 0.0 for slip in slips[1:]))
    compared = other if mu is None else first
    notes, error = _find_contradictions(estimate, compared, means=mean, slip_s=slip_s, friction_change=friction_change)
    if not notes:
        return estimate
    half = float(np.hypot(estimate.sigma, error))
    low, high = max(0.0, estimate.mu - half), estimate.mu + half
    return replace(estimate, low=low, high=high, notes=tuple(notes))


def _find_contradictions(
    friction: FrictionEstimate,
    slip: FrictionEstimate | None,
    *,
    means: _MeanRatio,
    slip_s: float | None,
    friction_change: float,
) -> tuple[list[str], float]:
    """Compare a friction with the forces and a slip; returns contradictions, and the error of the friction for them."""
    mu, declared, ratio, time = friction.mu, friction.method == BY_HAND, means.ratio, means.time_s
    written = f"{mu:.2f}" if declared else f"{mu:.2f} ({friction.low:.2f} to {friction.high:.2f})"
    notes, error, counts = [], 0.0, "whose difference counts as an error of the friction"
    if slip is not None:
        apart = abs(slip.mu - mu)
        if apart > max(LAW_SIGMAS * np.hypot(friction.sigma, slip.sigma), _LAW_SHARE * mu):
            value = f"{slip.mu:.2f} ({slip.low:.2f} to {slip.high:.2f}) at the slip at {slip.onset_s:.2f} s"
            origin = "was given" if declared else f"follows from the slip that was set to {friction.onset_s:.2f} s"
            differs = f"F_t / F_n is {value}, and a friction of {written} {origin}, {counts}"
            notes.append(f"{differs}; leave it out, or set --slip-s there")
            error = apart
    highest = int(np.argmax(means.least))
    # the uncertainty of a friction that comes from these forces includes their tare
    sigma, onset_s = float(means.tare_sigma[highest]) if declared else friction.sigma, friction.onset_s
    # on the way to the slip friction may still change, as in the labels' own uncertainty
    begin = float(time[np.argmax(means.pulled)])
    far = 1.0 if onset_s is None else abs(float(time[highest]) - onset_s) / max(onset_s - begin, 1e-9)
    sigma = np.hypot(sigma, friction_change * min(far, 1.0) * mu)
    if not notes and means.least[highest] > mu + max(LAW_SIGMAS * sigma, _LAW_SHARE * mu):
        when = "before" if onset_s is None or time[highest] < onset_s else "after"
        where = "nothing slips" if onset_s is None else f"{when} the slip at {onset_s:.2f} s"
        reaches = f"F_t / F_n reaches {ratio[highest]:.2f} at {time[highest]:.2f} s, {where}"
        notes.append(f"{reaches}, and the friction is {written}, {counts}; set the slip with --slip-s, or give --mu")
        error = float(ratio[highest]) - mu
    if slip_s is not None:
        before = ratio[(time > slip_s - _DROP_S) & (time <= slip_s) & means.pulled]
        after = ratio[(time > slip_s) & (time <= slip_s + 2 * _DROP_S) & means.pulled]
        if len(before) and len(after) and after.min() > (1 - _DROP_SHARE) * before.mean():
            levels = f"it is {before.mean():.2f} before it and at least {after.min():.2f} after it"
            where = f"the slip that was set to {slip_s:.2f} s"
            notes.append(f"F_t / F_n does not fall at {where}: {levels}; set it where it falls")
    return notes, error


def _fit_slip(
    forces: ContactForces,
    rough_s: float,
    *,
    means: _MeanRatio,
    contact_threshold_n: float,
    reach_s: float,
    rng: np.random.Generator,
    draws: int,
) -> FrictionEstimate:
    """Fit the break of the ratio about the rough time of a slip."""
    time, step = forces.time_s, axes.typical_step(forces.time_s)
    between_s = _find_gap(time, rough_s)
    hidden = between_s[1] > between_s[0] and reach_s > 0
    until_s = between_s[0] if hidden else rough_s
    lengths_s = list(_BEFORE_S)
    while True:
        near = time >= until_s - max(lengths_s.pop(0), _BEFORE_STEPS * step)
        near &= time <= until_s + (0 if hidden else max(_AFTER_S, _AFTER_STEPS * step))
        near &= forces.normal_n > contact_threshold_n
        before = near & (time <= until_s)
        if not before.any():
            raise RecordingError(f"nothing presses before the slip at {rough_s:.2f} s; set it later")
        pull = forces.tangential_n[before].mean(axis=0)
        # along the direction of the pull: a projection is not biased by noise
        ratio = forces.tangential_n[near] @ (pull / np.linalg.norm(pull)) / forces.normal_n[near]
        if hidden:
            fit = bracket_break(time[near], ratio, between_s=between_s, rng=rng, draws=draws)
            break
        fit = fit_break(time[near], ratio, about_s=rough_s, rng=rng, draws=draws, reach_s=reach_s)
        top = np.abs(means.time_s - fit.time_s) <= _STEP_S
        apart = abs(fit.level - means.ratio[top].max(initial=0.0))
        like = _LIKE_SHARE * fit.level + _LIKE_SIGMAS * means.sigma[top].max(initial=0.0)
        if reach_s == 0 or not lengths_s or apart <= like:
            break
    # no resampling of the slip can show the uncertainty of the tare
    (normal,), (tangential,) = forces.tare_sigma_n(np.array([fit.time_s]))
    tare = float(np.hypot(tangential, fit.level * normal)) / float(forces.normal_n[near].mean())
    low, high = np.quantile(fit.levels + rng.normal(0, tare, draws), _BAND)
    low, high = float(min(low, fit.level)), float(max(high, fit.level))
    mu = float(np.clip(fit.level, 1e-9, MOST_FRICTION))  # where the interval reaches 0 there is none
    return FrictionEstimate(mu=mu, low=low, high=high, onset_s=fit.time_s)


def _mean_ratio(forces: ContactForces, *, window_s: float, contact_threshold_n: float) -> _MeanRatio:
    time = forces.time_s
    means = forces.means(time, window_s=window_s)
    pressed = means.normal_n > max(contact_threshold_n, PRESSED_SHARE * means.normal_n.max())
    # the window shrinks at the ends, where a single sample's noise is no fall
    pressed &= (time - time[0] >= window_s / 2) & (time[-1] - time >= window_s / 2)
    # without a contact nothing slips: a knock, where the contact was set by hand
    pressed &= time >= (-np.inf if forces.axes.still_until_s is None else forces.axes.still_until_s)
    safe = np.where(pressed, means.normal_n, 1)
    ratio = np.where(pressed, means.tangential_n / safe, 0)
    sigma, tare = (
        np.where(pressed, np.hypot(across, ratio * along) / safe, 0)
        for along, across in zip(means[2::2], means[3::2], strict=True)
    )
    least, pulled = ratio - _DROP_SIGMAS * sigma, pressed & (means.tangential_n > 3 * means.tangential_noise_n)
    return _MeanRatio(time, means.normal_n, means.tangential_n, ratio, sigma, least, tare, pressed, pulled)


def _find_falls(means: _MeanRatio, *, start_s: float, end_s: float, friction_change: float) -> list[float]:
    """Rough times at which the ratio of a contact suddenly falls from a height that it exceeds nowhere."""
    step = max(axes.typical_step(means.time_s), 1e-9)
    span = (means.time_s >= start_s) & (means.time_s <= end_s)
    # on a clock that stands still in a gap: there the ratio may have fallen as suddenly as elsewhere
    steps = np.diff(means.time_s, prepend=means.time_s[0])
    time = np.cumsum(np.where(steps > max(axes.longest_step(means.time_s), _GAP_S), step, steps))
    inside, pressed = span & means.pulled, span & means.pressed
    if not inside.any():
        return []
    # where nothing presses, as before and after it: the end of a contact is no fall
    ratio = np.interp(time, time[pressed], means.ratio[pressed])
    # the least that it has fallen to within the time of a slip
    count = min(max(1, round(_DROP_S / step)), len(time))
    padded = np.concatenate((np.where(means.ratio > 0, means.ratio, np.inf), np.full(count, np.inf)))
    fall = means.ratio - np.lib.stride_tricks.sliding_window_view(padded, count + 1).min(axis=1)
    least = np.maximum(_DROP_SIGMAS * np.sqrt(2) * means.sigma, _DROP_SHARE * means.ratio)
    falling = inside & (fall > least)
    if not falling.any():
        return []
    reach_s = max(_STEP_S, step)

    def mean(values: Samples, at_s: Times) -> Times:
        return axes.mean_force(time, values, at_s, window_s=reach_s)

    # the moments at which the ratio falls most steeply, up to the time of a slip after it is seen to fall
    steep = mean(ratio, time - reach_s / 2) - mean(ratio, time + reach_s)
    beside = max(1, round(reach_s / step))
    around = np.lib.stride_tricks.sliding_window_view(np.pad(steep, beside, mode="edge"), 2 * beside + 1)
    soon = np.lib.stride_tricks.sliding_window_view(np.pad(falling, (count, 0)), count + 1).any(axis=1)
    tops = np.flatnonzero(soon & (steep > 0) & (steep == around.max(axis=1)))
    highest = float(means.least[inside].max())
    allowed = max(_DROP_SHARE, LAW_SIGMAS * friction_change)
    falls = []
    for top in tops.tolist():
        if highest > float(means.ratio[max(0, top - 2 * beside) : top + 1].max()) * (1 + allowed):
            continue
        places = time[top] + reach_s * np.array([-3.5, -1.0, 1.5, 4.0])
        earlier, before, after, later = mean(ratio, places)
        normal, pull = (mean(values, places[1:3]) for values in (means.normal_n, means.tangential_n))
        slips = (
            normal[1] > _NORMAL_SHARE * normal[0],
            before - after > _PULL_SHARE * least[top],
            after > _SLIDING_SHARE * before,
            before - after > _SUDDEN * max(earlier - before, after - later),
            1 - pull[1] / pull[0] > _PULL_SHARE * (1 - after / before),
        )
        if all(slips):
            falls.append(float(means.time_s[top]))
    return sorted(falls)


def _find_gap(time_s: Samples, at_s: float) -> tuple[float, float]:
    """Find the gap of the samples that lies at a time or close to it, from end to end; the time itself without one."""
    wide = np.diff(time_s) > max(axes.longest_step(time_s), _GAP_S)
    near = np.flatnonzero(wide & (time_s[:-1] < at_s + _STEP_S) & (time_s[1:] > at_s - _STEP_S))
    return (float(time_s[near[0]]), float(time_s[near[0] + 1])) if len(near) else (at_s, at_s)


def _is_seen(image: ImageMotion | None, begin_s: float, end_s: float) -> bool:
    """Return True where the image moves far more within a time in which the contact begins to slip than before it."""
    if image is None:
        return False
    # the motion of a frame happens between it and the one before; a lag may be uncertain by a frame
    step, time, motion = axes.typical_step(image.time_s), image.time_s[1:], image.motion[1:]
    quiet = motion[(time - begin_s < -3 * step) & (time - begin_s > -_QUIET_S - 3 * step)]
    burst = motion[(time - begin_s >= -2 * step) & (time - end_s <= 3 * step)]
    if len(quiet) < 3 or len(burst) == 0:
        return False
    middle, spread = axes.robust_spread(quiet)
    return bool(burst.max() - middle >= _IMAGE_SIGMAS * max(spread, 1e-9))
