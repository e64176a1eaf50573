"""Static friction of a trial: the ratio of tangential to normal force at which the contact slips as a whole."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from sliplens.errors import RecordingError
from sliplens.recordings.labelling import Found, FrictionEstimate
from sliplens.recordings.labels.axes import ContactForces, Samples, magnitude, mean_force, typical_step

_REACH_S = 0.08  # how far the break may lie from the rough guess
_TRIES = 41  # breaks tried over that reach
# lengths of the fall that are tried, from a sudden drop to that of a soft fingertip
_FALLS_S = (0.005, 0.007, 0.01, 0.014, 0.02, 0.028, 0.04, 0.056, 0.08)
_LEAST_BEFORE, _LEAST_AFTER = 6, 3  # samples that the two sides of a break need
_LEAST_LINE = 4  # samples that a line up to a break needs
_PARAMETERS = 7  # what a fit takes from the noise: five numbers, and where the break and the end of the fall lie
_MEMORY = 0.2  # residuals that correlate by more are drawn together
_LONGEST_BLOCK = 0.1  # longest block, as a share of the samples


@dataclass(frozen=True, kw_only=True)
class Break:
    """A line that rises to a break, falls, and goes on level."""

    time_s: float
    level: float
    """At the break."""
    levels: Float[np.ndarray, " draws"]
    """At the breaks of the bootstrap's draws."""
    times_s: Float[np.ndarray, " draws"]


def fit_break(
    time_s: Samples,
    values: Samples,
    *,
    about_s: float,
    rng: np.random.Generator,
    draws: int,
    reach_s: float = _REACH_S,
) -> Break:
    """Fit a parabola that at a break goes over into a fall and then a line, by least squares.

    Every break within reach and a few lengths of the fall are tried; the bootstrap draws blocks of the residuals anew
    and fits the break anew with each. Samples too few for that tell the break as a line up to somewhere between two of
    them.
    """
    tried = [
        (moment, fall)
        for moment in about_s + np.unique(np.linspace(-reach_s, reach_s, _TRIES))
        for fall in _FALLS_S
        if np.sum(time_s < moment) >= _LEAST_BEFORE and np.sum(time_s > moment + fall) >= _LEAST_AFTER
    ]
    if not tried:
        return _bracket_break(time_s, values, about_s=about_s, rng=rng, draws=draws)
    moments, falls = np.array(tried).T
    since = time_s - moments[:, None]
    before, after = np.minimum(since, 0), np.maximum(since, 0)
    fall, end = np.minimum(after / falls[:, None], 1), np.maximum(after - falls[:, None], 0)
    # level at the break, slope and bend before it, depth of the fall, slope after it
    bases, triangles = np.linalg.qr(np.stack((np.ones_like(since), before, before**2, fall, end), axis=2))
    (index,), (level,) = _best(bases, triangles, values[:, None])
    fitted = bases[index] @ (bases[index].T @ values)
    residuals = values - fitted
    # a fit takes from the residuals what its parameters explain of the noise
    residuals = (residuals - residuals.mean()) * np.sqrt(len(values) / max(1, len(values) - _PARAMETERS))
    drawn = fitted[:, None] + residuals[_blocks(residuals, draws=draws, rng=rng)]
    chosen, levels = _best(bases, triangles, drawn)
    return Break(time_s=float(moments[index]), level=float(level), levels=levels, times_s=moments[chosen])


def _bracket_break(time_s: Samples, values: Samples, *, about_s: float, rng: np.random.Generator, draws: int) -> Break:
    """Lengthen the line through the last samples before a break to anywhere before the next sample."""
    # the break itself is rough: what lies half a step beyond may still be before it
    near = np.flatnonzero(time_s <= about_s + typical_step(time_s) / 2)
    before = near[max(0, len(near) - _LEAST_BEFORE) : np.argmax(values[near]) + 1] if len(near) else near
    if len(before) < _LEAST_LINE or before[-1] + 1 == len(time_s):
        raise RecordingError(
            f"only {np.sum(time_s < about_s)} samples before the slip at {about_s:.2f} s and "
            f"{np.sum(time_s > about_s)} after it can be used; record the forces faster or give the friction with --mu"
        )
    last_s, next_s = time_s[before[-1] : before[-1] + 2]
    line = np.polynomial.Polynomial.fit(time_s[before], values[before], 1)
    noise = np.std(values[before] - line(time_s[before]), ddof=2)
    times = rng.uniform(last_s, next_s, draws)
    middle = float(last_s + next_s) / 2
    return Break(
        time_s=middle, level=float(line(middle)), levels=line(times) + rng.normal(0, noise, draws), times_s=times
    )


def _best(
    bases: Float[np.ndarray, "breaks samples parameters"],
    triangles: Float[np.ndarray, "breaks parameters parameters"],
    values: Float[np.ndarray, "samples draws"],
) -> tuple[Int[np.ndarray, " draws"], Float[np.ndarray, " draws"]]:
    """Which break explains each column best, and the level there."""
    draws = values.shape[1]
    explained, chosen, levels = np.full(draws, -np.inf), np.zeros(draws, dtype=int), np.zeros(draws)
    for index, (basis, triangle) in enumerate(zip(bases, triangles, strict=True)):
        shares = basis.T @ values
        power = np.sum(shares**2, axis=0)
        better = power > explained
        if better.any():
            explained[better], chosen[better] = power[better], index
            levels[better] = np.linalg.solve(triangle, shares[:, better])[0]
    return chosen, levels


def _blocks(residuals: Samples, *, draws: int, rng: np.random.Generator) -> Int[np.ndarray, "samples draws"]:
    """Indices that draw blocks of neighbours anew, a column a draw; white noise is drawn sample by sample."""
    count = len(residuals)
    power = max(float(residuals @ residuals), 1e-300)
    longest = max(1, int(_LONGEST_BLOCK * count))
    remembers = np.array([residuals[lag:] @ residuals[:-lag] / power > _MEMORY for lag in range(1, longest)])
    memory = longest if remembers.all() else int(np.argmin(remembers))
    # a memory of one sample needs blocks of a few, for each is cut at its ends
    length = min(longest, 1 + 4 * memory)
    starts = rng.integers(0, count - length + 1, (int(np.ceil(count / length)), 1, draws))
    return (starts + np.arange(length)[:, None]).reshape(-1, draws)[:count]


# times over which the forces are averaged to find roughly where the ratio breaks off: the longer finds faint falls
_WINDOWS_S = (0.03, 0.1)
_DROP_SIGMAS = 5.0  # a fall of the averaged ratio by so many standard deviations of its noise is no chance
_DROP_SHARE = 0.03  # and by so much of the ratio: less is a wobble of the hand that pulls
_DROP_S = 0.25  # time in which the ratio must have fallen: slip is sudden, letting go is slow
_PULLED_SHARE = 0.5  # a slip is looked for where the ratio is this share of its largest or more
# and where the normal force is this share of its largest: in a light touch the ratio is all noise
_PRESSED_SHARE = 0.25
_STEP_S = 0.06  # time over which the ratio before and after a fall is compared to place it
_HELD_SHARE = 0.5  # a fall across which less than this share of the normal force stays is letting go, not slip
_BEFORE_S, _AFTER_S = 0.6, 0.2  # what of the ratio is fitted, before and after its break
_BEFORE_STEPS, _AFTER_STEPS = 12, 6  # and of slow samples at least so many
_BAND = (0.16, 0.84)  # quantiles that hold 68 %
_SEEN_SIGMAS = 3.0  # an image that moves by so many standard deviations more than before sees the slip
_QUIET_S = 0.5  # time before the onset that tells how much the image moves without slip


@dataclass(frozen=True, kw_only=True)
class ImageMotion:
    """How much each frame differs from the one before, at the frames' times on the force sensor's clock."""

    time_s: Float[np.ndarray, " frames"]
    motion: Float[np.ndarray, " frames"]
    """See `measure_motion`; the first value is not used."""


def estimate_friction(
    forces: ContactForces,
    *,
    contact_threshold_n: float,
    rng: np.random.Generator,
    image: ImageMotion | None = None,
    slip_s: float | None = None,
    draws: int = 300,
) -> FrictionEstimate:
    """Estimate static friction at the onset of gross slip, with a bootstrap interval.

    The slip is the first sudden fall of F_t / F_n from its height so far while the normal force stays. About it the
    ratio is fitted by a line that breaks off: rising until the onset, falling after it; mu_s is its value at the break.
    Where several falls compete, the one that the image moves at wins. Below `contact_threshold_n`, a normal force in
    newtons, the ratio means nothing. A trial that never slips is a `RecordingError`: its friction is larger than all
    that was seen, no more.
    Where somebody knows the onset, `slip_s`, the ratio breaks off there.
    """
    candidates, highest = [slip_s] if slip_s is not None else [], 0.0
    for window_s in _WINDOWS_S:
        if not candidates:
            candidates, highest = _find_falls(forces, window_s=window_s, contact_threshold_n=contact_threshold_n)
    if not candidates:
        raise RecordingError(
            f"the trial never slips (F_t / F_n reaches {highest:.2f} without breaking off), so its friction is "
            "unknown; give it with --mu, or in the column mu of a manifest"
        )
    # a slip that the image does not see is a knock at the force sensor, unless no fall is seen
    seen = [rough for rough in candidates if (_image_sigmas(image, rough) or 0) >= _SEEN_SIGMAS]
    rough = (seen or candidates)[0]
    step = typical_step(forces.time_s)
    near = forces.time_s >= rough - max(_BEFORE_S, _BEFORE_STEPS * step)
    near &= forces.time_s <= rough + max(_AFTER_S, _AFTER_STEPS * step)
    near &= forces.normal_n > contact_threshold_n
    if not np.any(near & (forces.time_s <= rough)):
        raise RecordingError(f"nothing presses before the slip at {rough:.2f} s; set it later, or the contact earlier")
    pull = forces.tangential_n[near & (forces.time_s <= rough)].mean(axis=0)
    # along the direction of the pull: a projection is not biased by noise
    ratio = forces.tangential_n[near] @ (pull / np.linalg.norm(pull)) / forces.normal_n[near]
    reach_s = _REACH_S if slip_s is None else 0.0
    fit = fit_break(forces.time_s[near], ratio, about_s=rough, rng=rng, draws=draws, reach_s=reach_s)
    # no resampling of the slip can show the uncertainty of the tare
    (normal,), (tangential,) = forces.tare_sigma_n(np.array([fit.time_s]))
    tare = np.hypot(tangential, fit.level * normal)
    low, high = np.quantile(fit.levels + rng.normal(0, float(tare / forces.normal_n[near].mean()), draws), _BAND)
    if low <= 0:
        raise RecordingError(
            f"the slip at {fit.time_s:.2f} s tells a friction of {fit.level:.2g} with a 68 % interval from {low:.2g} "
            f"to {high:.2g}, which is none; give the coefficient of friction with --mu"
        )
    early, late = np.quantile(fit.times_s, _BAND)
    return FrictionEstimate(
        mu=fit.level,
        low=float(min(low, fit.level)),
        high=float(max(high, fit.level)),
        onset_s=fit.time_s,
        found=Found.INFERRED,
        method="F_t / F_n at the slip set by hand"
        if slip_s is not None
        else "break of F_t / F_n" + (", seen in the image" if seen else ""),
        onset_sigma_s=float(late - early) / 2,
        image_sigmas=_image_sigmas(image, fit.time_s),
    )


def _find_falls(forces: ContactForces, *, window_s: float, contact_threshold_n: float) -> tuple[list[float], float]:
    """Rough times at which the ratio suddenly falls from its height so far, and the greatest height."""
    time, step = forces.time_s, max(typical_step(forces.time_s), 1e-9)
    normal = mean_force(time, forces.normal_n, time, window_s=window_s)
    noise = forces.noise_of_means_n(window_s)
    sigma_n = noise.tangential
    tangential = magnitude(mean_force(time, forces.tangential_n, time, window_s=window_s), sigma_n=sigma_n)
    pressed = normal > max(contact_threshold_n, _PRESSED_SHARE * normal.max())
    # the window shrinks at the ends, where a single sample's noise is no fall
    pressed &= (time - time[0] >= window_s / 2) & (time[-1] - time >= window_s / 2)
    # what is not touched cannot slip: a knock, where the contact was set by hand
    pressed &= time >= (-np.inf if forces.axes.still_until_s is None else forces.axes.still_until_s)
    if not pressed.any():
        return [], 0.0
    safe = np.where(pressed, normal, 1)
    ratio = np.where(pressed, tangential / safe, 0)
    sigma = np.where(pressed, np.hypot(sigma_n, ratio * noise.normal) / safe, 0)
    highest = float(ratio[tangential > 3 * sigma_n].max(initial=0))
    # the least that it has fallen to within the time of a slip
    count = min(max(1, round(_DROP_S / step)), len(time))
    padded = np.concatenate((np.where(pressed, ratio, np.inf), np.full(count, np.inf)))
    least = np.lib.stride_tricks.sliding_window_view(padded, count + 1).min(axis=1)
    fall = ratio - least
    enough = pressed & (ratio >= _PULLED_SHARE * highest) & (tangential > 3 * sigma_n)
    falls = enough & (fall > np.maximum(_DROP_SIGMAS * np.sqrt(2) * sigma, _DROP_SHARE * ratio))
    starts = np.flatnonzero(falls & ~np.concatenate(([False], falls[:-1])))
    ends = np.flatnonzero(falls & ~np.concatenate((falls[1:], [False])))
    # of each stretch the moment at which the ratio falls most steeply
    earlier, later = (mean_force(time, ratio, at, window_s=_STEP_S) for at in (time - _STEP_S / 2, time + _STEP_S))
    steep = earlier - later
    # a stretch begins before its fall by the time that a fall may take, and may end as it begins
    tops = [start + int(np.argmax(steep[start : end + count + 1])) for start, end in zip(starts, ends, strict=True)]
    at = np.unique(time[np.array(tops, dtype=int)])
    before, after = (mean_force(time, normal, at + way, window_s=_STEP_S) for way in (-_STEP_S, _STEP_S))
    return at[after > _HELD_SHARE * before].tolist(), highest


def _image_sigmas(image: ImageMotion | None, onset_s: float) -> float | None:
    """How far the image's largest motion at the onset stands out of that before it; None where it cannot be told."""
    if image is None:
        return None
    # a frame's motion happens between it and the one before; a lag may not be known to the frame
    step = typical_step(image.time_s)
    after = image.time_s - onset_s
    quiet = image.motion[1:][(after[1:] < -3 * step) & (after[1:] > -_QUIET_S - 3 * step)]
    burst = image.motion[1:][(after[1:] >= -2 * step) & (after[1:] <= 3 * step)]
    if len(quiet) < 3 or len(burst) == 0:
        return None
    middle = np.median(quiet)
    spread = 1.4826 * np.median(np.abs(quiet - middle))
    return float((burst.max() - middle) / max(spread, 1e-9))
