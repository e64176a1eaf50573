"""Lag between camera and force sensor, by cross-correlation: the image moves when the force changes."""

from collections.abc import Iterable
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import RecordingError
from sliplens.images import Soft
from sliplens.recordings.capture import Forces
from sliplens.recordings.labelling import Lag
from sliplens.recordings.labels.axes import find_spans, infer_axes, mean_force, typical_step
from sliplens.recordings.options import LabelSettings

Frames: TypeAlias = Float[np.ndarray, " frames"]
Intervals: TypeAlias = Float[np.ndarray, " intervals"]


def measure_motion(softened: Iterable[Soft]) -> Frames:
    """Return the mean absolute difference of softened frames from their predecessors, in grey levels; 0 first."""
    return np.array([0.0, *(np.mean(np.abs(soft - before)) for before, soft in pairwise(softened))], dtype=np.float64)


# Lossless repeats change nothing, and repeats of lossy video up to an eighth of what the frames beside them do; noise
# alone makes frames of a working camera differ by more, and what rests does so for longer than three frames.
_STILL = 0.15
_MOST_IN_A_ROW = 3
_LEAST_SHARE, _FEWEST = 0.1, 5


def describe_repeats(motion: Frames, time_s: Frames) -> str | None:
    """Describe how many frames repeat the one before, by their `measure_motion`; None where next to none does.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.recordings.labels.lag import describe_repeats
    >>> doubled = np.tile([1.0, 0.0], 30)  # every second frame shows nothing new
    >>> describe_repeats(doubled, np.arange(60) / 30).split(";")[0]
    '28 of 60 frames repeat the one before: the camera took about 16 frames a second, and the file says 30'
    """
    change = motion[1:]
    if len(change) < _FEWEST:
        return None
    still = np.zeros(len(change), dtype=bool)
    for count in range(1, _MOST_IN_A_ROW + 1):
        for at in range(1, len(change) - count):
            if change[at : at + count].max() < _STILL * min(change[at - 1], change[at + count]):
                still[at : at + count] = True
    repeats = int(still.sum())
    if repeats < max(_FEWEST, _LEAST_SHARE * len(motion)):
        return None
    rate_hz = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
    taken_hz = rate_hz * (1 - repeats / len(motion))
    rates = f"the camera took about {taken_hz:.3g} frames a second, and the file says {rate_hz:.3g}"
    cure = "record at the camera's rate, or leave the repeats out on export (`ffmpeg -vf mpdecimate`)"
    return f"{repeats} of {len(motion)} frames repeat the one before: {rates}; {cure}"


# lags tried in the time of a frame, and least step between them; between them the peak is a parabola's
_STEPS_A_FRAME, _LEAST_LAG_S = 16, 5e-4
LONGEST_LAG_S = 0.25  #: Longest lag tried, either way.
_BLOCKS = 24  # stretches of a trial that are resampled: long enough to hold a slip, many enough to draw from
_LEAST_INTERVALS, _LEAST_CORRELATION = 2 * _BLOCKS, 0.3
_OVERLAP = 0.7  # share of the frames that must have forces for a lag to be tried
_LOAD_WINDOW_S, _PART = 0.03, (0.25, 0.75)  # of the load whose release is timed between these shares of it
_SUDDEN_STEPS = 2.0  # a fall between these within so many frames has a sharp time, however the gel yields
_LOADED_SHARE = 0.15  # of the load of a trial: a larger force is a contact
_APART_S = 0.3  # contacts that are closer are one, and the image may move as long about it
# a lag beyond so many sigmas, and frames, is no accident; a clock of another speed makes sigma large as well
_FAR_SIGMAS, _FAR_FRAMES = 2.0, 2.0
_LEAST_FRAMES = 24  # of fewer, noise alone correlates by as much as a contact does
# quantile of the image motion in the contacts, and the share of it that shows another contact in as many frames
_MOVES, _LEAST_MOVES = (0.98, 0.5), 3


def estimate_lag(
    frame_time_s: Frames, image_motion: Frames, forces: Forces, *, rng: np.random.Generator, draws: int = 200
) -> Lag:
    """Estimate the lag by cross-correlation of image motion and force rate, each frame keeping its own time.

    For every lag tried, the length of the change of the force from frame to frame is correlated with the motion of the
    image; it depends on neither axes, signs nor tare. A contact yields the more the lighter it is loaded, so the image
    leads the force in a press and trails it in a release; a release weighs no more than makes the two cancel. The
    uncertainty is the spread of the peak when stretches of the trial are resampled. With too few frames the lag is 0,
    and its doubt says why.
    """
    reached = (frame_time_s >= forces.time_s[0] - LONGEST_LAG_S) & (frame_time_s <= forces.time_s[-1] + LONGEST_LAG_S)
    if not reached.any():
        covers = f"no lag up to {LONGEST_LAG_S:g} s lets the forces of {forces.source} cover the frames"
        raise RecordingError(f"{covers}; bring both clocks to the same zero on import")
    frame_time_s, image_motion = frame_time_s[reached], image_motion[reached]
    intervals = len(frame_time_s) - 1
    if intervals < _LEAST_INTERVALS:
        doubt = f"{intervals + 1} frames are too few to estimate a lag from, {_LEAST_INTERVALS + 1} are needed"
        return Lag(lag_s=0.0, sigma_s=0.0, doubt=doubt)
    step = max(typical_step(frame_time_s) / _STEPS_A_FRAME, _LEAST_LAG_S)
    reach = int(np.ceil(LONGEST_LAG_S / step))
    lags = np.arange(-reach, reach + 1) * step
    changes = np.stack([force_changes(frame_time_s - lag, forces) for lag in lags])
    covered = ~np.isnan(changes)
    usable = covered.mean(axis=1) >= _OVERLAP
    if not usable.any():
        return Lag(lag_s=0.0, sigma_s=0.0, doubt="the forces cover too few of the frames to estimate a lag from")
    lags, changes, covered = lags[usable], np.nan_to_num(changes[usable]), covered[usable]
    weights = np.concatenate((np.ones((1, intervals)), _block_weights(intervals, draws=draws, rng=rng)))
    motion, release = image_motion[1:], _find_release(forces, sudden_s=_SUDDEN_STEPS * typical_step(frame_time_s))
    if release is not None:
        # the same weights for every lag: a share that depends on the lag would prefer some
        top = int(np.argmax(_correlations(weights[:1], motion, changes=changes, covered=covered)[0]))
        # a peak of rate r and duration T has a curvature of r^2 / T and an error of T, and r T is the load of both:
        # press and release have the same influence on the lag where they weigh by r^2
        time_s, (pressed_s, let_go_s) = frame_time_s[1:] - lags[top], release
        press, fall = (float(changes[top][part].max(initial=0)) for part in (time_s <= pressed_s, time_s > let_go_s))
        weights *= np.where(time_s > let_go_s, min(1.0, (press / max(fall, 1e-9)) ** 2), 1.0)
    curves = _correlations(weights, motion, changes=changes, covered=covered)
    peaks = np.array([_peak(lags, curve) for curve in curves])
    low, high = np.quantile(peaks[1:], (0.16, 0.84))
    lag, sigma, correlation, doubt = float(peaks[0]), float(high - low) / 2, float(curves[0].max()), ""
    if correlation < _LEAST_CORRELATION:
        doubt = f"image motion and force rate correlate by {correlation:.2f} only, {_LEAST_CORRELATION} is needed"
    elif lag in (lags[0], lags[-1]):
        doubt = f"the correlation still rises at {lag:.3f} s, the longest lag tried"
    elif sigma > (lags[-1] - lags[0]) / 8:
        doubt = f"the lag is uncertain by {sigma:.3f} s: several lags fit alike"
    return Lag(lag_s=lag, sigma_s=sigma, correlation=correlation, doubt=doubt)


def _find_release(forces: Forces, *, sudden_s: float) -> tuple[float, float] | None:
    """Return the times at which the load is pressed and begins to fall; None where it holds or falls suddenly."""
    time, (load, _) = forces.time_s, _measure_load(forces)
    hold = float(np.median(load[load >= load.max() / 2]))
    light, heavy = (time[load >= share * hold] for share in _PART)
    fall_s = float(light[-1] - heavy[-1])
    if light[-1] == time[-1] or fall_s <= sudden_s:
        return None
    # the quarter of the load before is released in about the time of the half between
    return float(heavy[0]), float(heavy[-1]) - fall_s


def force_changes(time_s: Frames, forces: Forces) -> Intervals:
    """Return the length of the change of the force from frame to frame; NaN beyond the ends of the samples."""
    # averaged over a frame's time: like the image, the change then covers the whole time since the last frame
    force = mean_force(forces.time_s, forces.force_n, time_s, window_s=typical_step(time_s))
    inside = (time_s >= forces.time_s[0]) & (time_s <= forces.time_s[-1])
    force[~inside] = np.nan
    return np.linalg.norm(np.diff(force, axis=0), axis=1)


def doubt_lag(lag: Lag | None, *, applied: bool, frame_s: float) -> str:
    """Describe a measured lag at which labels are those of another time; empty where there is none."""
    if lag is None or lag.correlation is None:
        return ""  # set by hand, or of too few frames to measure it
    size_s = 0.0 if applied else abs(lag.lag_s)
    far = size_s > _FAR_FRAMES * frame_s and (bool(lag.doubt) or size_s > _FAR_SIGMAS * lag.sigma_s)
    if not far and lag.correlation >= _LEAST_CORRELATION:
        return ""
    late = f"{'late' if lag.lag_s > 0 else 'early'} by {1000 * size_s:.0f} +- {1000 * lag.sigma_s:.0f} ms"
    measured = f"unknown: {lag.doubt}" if lag.doubt else f"{size_s / frame_s:.1f} frames"
    rate = "give --frame-rate or --time-unit if a clock runs wrong"
    zero = "--start-s, --lag-ms or --apply-lag if only its zero differs"
    return f"the camera is {late} ({measured}); check that the forces are those of this video, {rate}, and {zero}"


def doubt_agreement(frame_time_s: Frames, image_motion: Frames, forces: Forces, lag: Lag) -> tuple[str, ...]:
    """Describe the contacts in which the image does not move as the force changes, a sentence each.

    Of the correlations of the values and of their logarithms the larger counts: the first is that of press and slip,
    the second does not break where a single fast change falls between two frames.
    """
    time = frame_time_s - lag.lag_s
    change = np.append(np.nan, force_changes(time, forces))
    covered = np.isfinite(change)
    load, still_until_s = _measure_load(forces)
    loaded = (load > _LOADED_SHARE * float(np.quantile(load, 0.95))) & (forces.time_s >= still_until_s)
    spans = [forces.time_s[[start, end - 1]] for start, end in find_spans(forces.time_s, loaded, apart_s=_APART_S)]
    near = [(time >= start - _APART_S) & (time <= end + _APART_S) for start, end in spans]
    doubts = []
    for inside in near or [np.ones(len(time), dtype=bool)]:
        some = inside & covered
        if some.sum() < _LEAST_FRAMES:
            continue
        correlation = _agreement(change[some], image_motion[some])
        if correlation < _LEAST_CORRELATION:
            span = f"from {time[some][0]:.2f} to {time[some][-1]:.2f} s"
            why = f"(correlation {correlation:.2f}, {_LEAST_CORRELATION} is needed)"
            cure = "check that the forces are those of this video"
            doubts.append(f"image and force do not move together {span} {why}; {cure}")
    idle = covered & ~np.any(near, axis=0)
    if near and not doubts and idle.any():
        motion, (quantile, share) = image_motion[covered & ~idle], _MOVES
        base = float(np.quantile(motion, 0.1))
        moves = idle & (image_motion - base > share * (float(np.quantile(motion, quantile)) - base))
        if moves.sum() >= _LEAST_MOVES:
            at = time[moves]
            correlation = _agreement(change[idle], image_motion[idle])
            span = f"from {at[0]:.2f} to {at[-1]:.2f} s, and the forces rest (correlation {correlation:.2f})"
            doubts.append(f"the image moves as in a contact {span}; check that the force sensor ran")
    return tuple(doubts)


def _measure_load(forces: Forces) -> tuple[Float[np.ndarray, " samples"], float]:
    """Return the length of the force without its tare, and the time until which nothing touches the sensor."""
    # neither axis nor sign matters to a length
    axes, time = infer_axes(forces, LabelSettings(normal_axis="x", normal_sign=1)), forces.time_s
    load = np.linalg.norm(mean_force(time, forces.force_n - axes.tare_n, time, window_s=_LOAD_WINDOW_S), axis=1)
    return load, np.inf if axes.still_until_s is None else axes.still_until_s


def _agreement(change_n: Intervals, motion: Intervals) -> float:
    """Return the larger of the correlations of the values and of their logarithms; 0 where either is constant."""
    values = np.array((np.maximum(change_n, 0), motion))
    if np.any(np.ptp(values, axis=1) < 1e-9):
        return 0.0
    logs = np.log(values + np.maximum(np.median(values, axis=1, keepdims=True), 1e-9))
    return max(float(np.corrcoef(pair)[0, 1]) for pair in (values, logs))


def _correlations(
    weights: Float[np.ndarray, "draws intervals"],
    motion: Intervals,
    *,
    changes: Float[np.ndarray, "lags intervals"],
    covered: Bool[np.ndarray, "lags intervals"],
) -> Float[np.ndarray, "draws lags"]:
    """Correlate the motion with the changes of the force, for every draw of weights and every lag."""
    mask = covered.astype(np.float64)
    # centred first: the sums below lose digits where a mean is large
    motion, changes = motion - motion.mean(), (changes - changes.mean()) * mask
    total = weights @ mask.T
    first, second = (weights * motion) @ mask.T / total, weights @ changes.T / total
    product = (weights * motion) @ changes.T / total - first * second
    variances = ((weights * motion**2) @ mask.T / total - first**2) * (weights @ (changes**2).T / total - second**2)
    return product / np.sqrt(np.where(variances > 0, variances, np.inf))


def _peak(lags: Float[np.ndarray, " lags"], curve: Float[np.ndarray, " lags"]) -> float:
    """Find the maximum of a curve between the lags tried: the top of the parabola through those of one frame."""
    top = int(np.argmax(curve))
    near = slice(max(0, top - _STEPS_A_FRAME // 4), top + _STEPS_A_FRAME // 4 + 1)
    if top in (0, len(lags) - 1):
        return float(lags[top])
    centre = lags[top]
    bend, slope, _ = np.polyfit(lags[near] - centre, curve[near], 2)
    shift = -slope / (2 * bend) if bend < 0 else 0.0
    return float(np.clip(centre + shift, lags[near][0], lags[near][-1]))


def _block_weights(intervals: int, *, draws: int, rng: np.random.Generator) -> Float[np.ndarray, "draws intervals"]:
    """Count how often each interval is drawn when whole stretches are, as neighbours in time are not independent."""
    length = int(np.ceil(intervals / _BLOCKS))
    starts = rng.integers(0, intervals, (draws, _BLOCKS))
    # round the end: every interval is as likely as any other
    drawn = (starts[..., None] + np.arange(length)) % intervals
    weights = np.zeros((draws, intervals))
    np.add.at(weights, (np.arange(draws)[:, None, None], drawn), 1.0)
    return weights
