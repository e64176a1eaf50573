"""Axes, sign, tare and noise of a force sensor, declared or inferred, and means of its samples."""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces
from sliplens.recordings.labelling import AXES, ForceAxes, Vector
from sliplens.recordings.options import LabelSettings

_GAP_STEPS = 4.0  # samples are missing where two are further apart than so many typical steps
_WINDOW_S = 0.03  # time over which the force is averaged to find the touch: a press takes longer, a spike is shorter
_FIRST_S, _GUARD_S = 0.1, 0.15  # untouched time at the start, and time before the touch that is left out of the tare
# a touch departs by so many standard deviations, and by so much of the largest force: drift and vibration are none
_TOUCH_SIGMAS, _TOUCH_SHARE = 6.0, 0.05
_PRESS_SHARE = 0.25  # of the contact, from its start, in which the object is pressed and not yet pulled far
_SPIKE_SIGMAS, _LEAST_TYPICAL = 4.0, 0.9  # of a still sample from the median; share of still samples within
_FEW_STILL, _FEW_RISING, _FEW_MEANS = 10, 4, 20  # fewer samples give no tare, no direction, no spread
_STRETCHES = 10  # parts of the still samples whose means are compared
_DOUBTFUL = 0.6  # a second axis that departs by this share of the first makes the normal axis doubtful
_RISE = (0.15, 0.9)  # shares of the load in hold between which the direction of the press is measured
_TILT_SIGMAS, _LEAST_TILT_DEG = 3.0, 0.5  # of a tilt that counts: less moves a margin by 1 % or so
# mounting and pressing are as exact as the first; a press that is pulled, too, is no fault up to the second
_TILT_FLAG_DEG, _SHEAR_FLAG_DEG = 3.0, 10.0
_MOST_BEND = 0.25  # of the tilt: a pulled force turns by more than its angle, that of a tilted sensor not at all
_DRIFT_SIGMAS, _SLOPE_SIGMAS = 4.0, 3.0  # of a drift, to the end or before the touch: a false one costs good labels
# of the uncertainty of a drift that is measured before the touch alone: all of it would cost 40 % of sound labels
_UNCERTAIN_SHARE = 0.3
# of a drift: an exponential warm-up as slow as ten trials bends by a twentieth of the way, as slow as one by a third
_UNEVEN_SHARE = 0.1
_UNCERTAIN_LOAD, _DRIFT_SHARE = 0.1, 0.01  # of the load: a drift that is noted, and one that does not matter
_CALM_NOISES = 1.5
_RELEASED_SHARE = 0.3  # of the load: a smaller force at the end may be the drift of an untouched sensor
_MEASURED_SHARE = 0.5  # of the load: a drift before the touch that is less certain does not show a release
_MAD_TO_SIGMA = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
_MOST_WINDOWS = 4_000_000

Axes: TypeAlias = Float[np.ndarray, "3"]
Samples: TypeAlias = Float[np.ndarray, " samples"]
Columns: TypeAlias = Float[np.ndarray, "samples *axes"]
Times: TypeAlias = Float[np.ndarray, " times"]


def typical_step(time_s: Samples) -> float:
    """Median time between samples, in seconds; 0 for one sample."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def longest_step(time_s: Samples) -> float:
    """Return the time in seconds between two samples beyond which samples are missing."""
    return _GAP_STEPS * typical_step(time_s)


def mean_force(
    time_s: Samples, force_n: Columns, at_s: Times, *, window_s: float, until_s: float = np.inf
) -> Float[np.ndarray, "times *axes"]:
    """Return the exact mean over windows about given times of the broken line through the samples.

    Near the ends of the samples, and of the onset of slip `until_s`, the window shrinks evenly about its time.
    """
    at = np.clip(at_s, time_s[0], time_s[-1])
    half = half_window(time_s, at, window_s=window_s, until_s=until_s)
    flat = force_n.reshape(len(time_s), -1)
    plain = np.stack([np.interp(at, time_s, column) for column in flat.T], axis=1)
    # a window narrower than a sample's step holds no more than the interpolated value
    wide = half > 1e-9
    low, high = at - half, at + half
    mean = (_integral(time_s, flat, high) - _integral(time_s, flat, low)) / np.where(wide, 2 * half, 1)[:, None]
    return np.where(wide[:, None], mean, plain).reshape(len(at), *force_n.shape[1:])


def half_window(time_s: Samples, at_s: Times, *, window_s: float, until_s: float) -> Times:
    """Return half the length of the windows of `mean_force`."""
    room = np.minimum(at_s - time_s[0], time_s[-1] - at_s)
    return np.clip(np.minimum(room, np.abs(at_s - until_s)), 0, window_s / 2)


def find_spans(time_s: Samples, inside: Bool[np.ndarray, " samples"], *, apart_s: float) -> list[tuple[int, int]]:
    """Find the stretches of samples inside something, as slices; closer ones are one."""
    spans: list[tuple[int, int]] = []
    for start, end in np.flatnonzero(np.diff(inside, prepend=False, append=False)).reshape(-1, 2).tolist():
        again = bool(spans) and time_s[start] - time_s[spans[-1][1] - 1] < apart_s
        spans.append((spans.pop()[0] if again else start, end))
    return spans


def robust_spread(values: Times) -> tuple[float, float]:
    """Return the median, and the standard deviation of a Gaussian with the median absolute deviation."""
    middle = float(np.median(values))
    return middle, _MAD_TO_SIGMA * float(np.median(np.abs(values - middle)))


def middles(time_s: Samples, start_s: float, end_s: float, *, width_s: float) -> Times:
    """Return the middles of adjacent windows; where a gap would make them too many, of those with a sample."""
    if (end_s - start_s) / width_s <= _MOST_WINDOWS:
        return np.arange(start_s + width_s / 2, end_s, width_s)
    at_s = start_s + (np.unique(np.floor((time_s - start_s) / width_s)) + 0.5) * width_s
    return at_s[at_s < end_s]


def noise_sigma(values: Columns) -> Float[np.ndarray, "*axes"]:
    """Estimate the standard deviation of the noise of each column by the median of its second differences."""
    if len(values) < 3:
        return np.zeros(values.shape[1:])
    second = values[2:] - 2 * values[1:-1] + values[:-2]
    return np.asarray(_MAD_TO_SIGMA * np.median(np.abs(second), axis=0) / np.sqrt(6))


def _integral(time_s: Samples, values: Columns, at_s: Times) -> Float[np.ndarray, "times columns"]:
    """Integrate the broken line through the samples, from the first of them."""
    # about the mean: a large offset would cost digits
    steps = np.diff(time_s)[:, None] * (values[1:] + values[:-1]) / 2
    sums = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)))
    before = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 1)
    here = np.stack([np.interp(at_s, time_s, column) for column in values.T], axis=1)
    return sums[before] + (at_s - time_s[before])[:, None] * (values[before] + here) / 2


def infer_axes(forces: Forces, settings: LabelSettings | None = None, *, moved_s: float = np.inf) -> ForceAxes:
    """Infer the axes, sign and tare of a force sensor that are not declared in the settings.

    The tare is the mean of the samples before the touch, spikes left out. The normal axis departs furthest from it in
    the press, positively by its sign. While nothing shears, the force of a press keeps its direction: where that is no
    axis, the sensor is tilted, and its normal is that direction, unless an axis was declared. Where nothing is ever
    pressed, axis and sign cannot be inferred, which is a `RecordingError`. Samples from `moved_s` on show no drift.
    """
    settings = settings or LabelSettings()
    normal, sign, tare_n = settings.normal_axis, settings.normal_sign, settings.tare
    noise = np.asarray(noise_sigma(forces.force_n))
    touch = _find_touch(forces, tare_n=tare_n) if settings.contact_s is None else settings.contact_s
    until = touch - min(_GUARD_S, max(0.0, touch - float(forces.time_s[0])) / 2) if np.isfinite(touch) else touch
    if np.isinf(touch) and (normal is None or sign is None):
        never = f"{forces.source} never departs from its noise: no touch to infer the axes from"
        raise RecordingError(f"{never}; give --normal-axis, --normal-sign and --tare, or leave the trial out")
    still = forces.force_n[forces.time_s < until]
    tare, tare_sigma, notes = np.zeros(3), np.zeros(3), []
    if tare_n is not None:
        tare = np.array(tare_n, dtype=np.float64)
    elif len(still) < _FEW_STILL:
        notes.append("no still samples before contact: the tare is taken as zero; declare it if the sensor has one")
    else:
        tare, tare_sigma = _measure_tare(still, noise=noise)
    drift, drift_sigma = np.zeros(3), np.zeros(3)
    if not notes and np.isfinite(touch):
        drift, drift_sigma = _find_drift(forces, tare, tare_sigma, noise=noise, until_s=until, moved_s=moved_s)
    press = np.zeros(3)  # the mean force while the object is pressed and held
    if np.isfinite(touch):
        end = touch + _PRESS_SHARE * (forces.time_s[-1] - touch)
        press = np.mean(forces.force_n[(forces.time_s >= touch) & (forces.time_s <= end)], axis=0) - tare
    rise = _measure_rise(forces, tare, tare_sigma, noise=noise, touch_s=touch, drift_n_s=drift)
    main = press if rise.bends else rise.direction
    axis = AXES[int(np.argmax(np.abs(main)))] if normal is None else normal
    first, second = np.sort(np.abs(press))[[-1, -2]]
    if normal is None and rise.bends and second > _DOUBTFUL * first:
        departs = f"{axis} departs by {first:.2f} N, another by {second:.2f} N"
        notes.append(f"the normal axis is doubtful: {departs}; declare it")
    # ForceAxes refuses an unknown axis
    index = AXES.index(axis) if axis in AXES else 0
    inferred_sign = 1 if main[index] >= 0 else -1
    tilt_deg = float(np.rad2deg(np.arccos(np.clip((sign or inferred_sign) * rise.direction[index], -1, 1))))
    tilt_deg *= tilt_deg > max(_LEAST_TILT_DEG, _TILT_SIGMAS * np.rad2deg(rise.sigma))
    turned = not rise.bends and normal is None and sign in (None, inferred_sign) and tilt_deg > 0
    if tilt_deg > (_SHEAR_FLAG_DEG if rise.bends else _TILT_FLAG_DEG):
        cure = (
            f"so the axes were turned by that; if the press was oblique, give --normal-axis {axis}"
            if turned
            else "and turns on the way: the sensor is tilted or something shears; press first, then pull"
            if rise.bends
            else "that was declared; leave out --normal-axis and --normal-sign if the sensor is tilted"
        )
        notes.append(f"the force of the press points {tilt_deg:.0f} degrees off the axis {axis} {cure}")
    if settings.drift_rate is not None:
        drift_sigma = np.full(3, settings.drift_rate)
    elif np.any(drift_sigma * np.ptp(forces.time_s) > _UNCERTAIN_LOAD * np.linalg.norm(press)):
        most = f"the zero may drift by {_signed(drift_sigma * np.ptp(forces.time_s))} N (x, y, z) over the trial unseen"
        notes.append(f"{most}: let go before the recording ends, wait before the touch, or give --drift-rate")
    if drift.any():
        most = f"the zero of the force sensor drifts by {_signed(drift * np.ptp(forces.time_s))} N (x, y, z) in all"
        notes.append(f"{most}, evenly, which was taken off; let it warm up")
    return ForceAxes(
        normal=axis,
        sign=inferred_sign if sign is None else sign,
        direction=_vector(rise.direction) if turned else None,
        direction_sigma=rise.sigma if turned else 0.0,
        tare_n=_vector(tare),
        noise_n=_vector(noise),
        tare_sigma_n=_vector(tare_sigma),
        still_until_s=None if np.isinf(until) else until,
        drift_n_s=_vector(drift),
        drift_sigma_n_s=_vector(drift_sigma),
        notes=tuple(notes),
    )


class _Rise(NamedTuple):
    """Direction of the force while the load of a press rises, and its standard uncertainty; by default unknown."""

    direction: Axes = np.zeros(3)
    sigma: float = np.inf  # in radians
    bends: bool = True  # on the way or soon after, because something shears


def _measure_rise(
    forces: Forces, tare_n: Axes, tare_sigma_n: Axes, *, noise: Axes, touch_s: float, drift_n_s: Axes
) -> _Rise:
    """Measure the direction of the force from the touch to the hold, unless axes or samples are missing."""
    time = forces.time_s
    contact = np.flatnonzero(time >= touch_s)
    # two columns give no direction: the tangential force may be a length
    if len(contact) < _FEW_STILL or not np.ptp(forces.force_n, axis=0).all():
        return _Rise()
    force = forces.force_n - tare_n - drift_n_s * (time - (time[0] + touch_s) / 2)[:, None]
    load = np.linalg.norm(mean_force(time, force, time, window_s=_WINDOW_S), axis=1)
    early = load[contact][time[contact] <= touch_s + _PRESS_SHARE * (time[-1] - touch_s)]
    level = float(np.median(early[early >= early.max() / 2]))
    low, high = (level * share for share in _RISE)
    top = contact[np.argmax(load[contact] >= high)]
    rising = np.arange(contact[0], top)
    rising = rising[load[rising] > low]
    # as long again, once it is pressed
    holding = np.flatnonzero((time > time[top]) & (time <= 2 * time[top] - time[rising[:1]].max(initial=-np.inf)))
    if min(len(rising), len(holding)) < _FEW_RISING:
        return _Rise()

    def direction(part: Int[np.ndarray, " part"]) -> tuple[Axes, float]:
        weight = float(np.sum(load[part] ** 2))
        slope = load[part] @ force[part] / weight
        white = float(np.linalg.norm(noise)) / np.sqrt(weight)
        zero = float(np.linalg.norm(tare_sigma_n)) * float(np.sum(load[part])) / weight
        return slope / np.linalg.norm(slope), float(np.hypot(white, zero))

    (press, sigma), (hold, hold_sigma) = direction(rising), direction(holding)
    tilt = float(np.sqrt(max(0.0, 1 - np.max(np.abs(press)) ** 2)))
    bend = float(np.linalg.norm(hold - press))
    bends = bend > max(_TILT_SIGMAS * np.hypot(sigma, hold_sigma), _MOST_BEND * tilt)
    return _Rise(press, sigma, bool(bends))


def _find_drift(
    forces: Forces, tare_n: Axes, tare_sigma_n: Axes, *, noise: Axes, until_s: float, moved_s: float
) -> tuple[Axes, Axes]:
    """Measure the rate at which the zero drifts, to an untouched end or else before the touch, and its uncertainty."""
    time, force = forces.time_s, forces.force_n
    still, ends = time < until_s, time > time[-1] - _FIRST_S
    slope, slope_sigma = np.zeros(3), np.zeros(3)
    if still.sum() >= _FEW_STILL:
        parts = np.array_split(np.flatnonzero(still), _STRETCHES)
        middles = np.array([time[part].mean() for part in parts])
        line, covariance = np.polyfit(
            middles - middles.mean(), np.array([np.median(force[part], axis=0) for part in parts]), 1, cov=True
        )
        white = noise / np.sqrt(still.sum()) / np.std(time[still])
        slope, slope_sigma = line[0], np.maximum(np.sqrt(covariance[0, 0]), white)
    real = np.abs(slope) > _SLOPE_SIGMAS * slope_sigma + 1e-9
    load = float(np.quantile(np.linalg.norm(force - tare_n, axis=1), 0.9))
    offset = np.mean(force[ends], axis=0) - tare_n
    unsure = np.hypot(noise / np.sqrt(ends.sum()), tare_sigma_n)
    span_s = time[ends].mean() - time[still].mean() if still.any() else np.inf
    # a sensor that wanders by more than its noise at the end is touched, or swings
    calm = np.all(np.std(force[ends], axis=0) < _CALM_NOISES * noise + 1e-9)
    # the end is untouched where little load is left, of the drift before the touch if that is measured
    measured = np.linalg.norm(slope_sigma) * span_s < _MEASURED_SHARE * load
    rest_n = min(float(np.linalg.norm(offset - share * slope * span_s)) for share in (0.0, float(measured)))
    if calm and time[-1] < moved_s and rest_n < _RELEASED_SHARE * load:
        real = np.abs(offset) > np.maximum(_DRIFT_SIGMAS * unsure, _DRIFT_SHARE * load)
        return np.where(real, offset / span_s, 0.0), unsure / span_s
    return np.where(real, slope, 0.0), np.where(real, 1.0, _UNCERTAIN_SHARE) * slope_sigma


def _signed(values: Axes) -> str:
    return ", ".join(f"{value:+.2g}" for value in values)


def _measure_tare(still: Float[np.ndarray, "samples 3"], *, noise: Axes) -> tuple[Axes, Axes]:
    """Return the mean of the untouched samples, and its standard uncertainty."""
    # a spike must not move it, and a plain median of Gaussian samples would be less certain by a quarter
    middle = np.median(still, axis=0)
    typical = np.abs(still - middle) <= np.maximum(_SPIKE_SIGMAS * noise, 1e-9 + np.abs(middle) * 1e-9)
    # where the sensor wanders by more than its noise, outer samples are no spikes
    typical |= typical.mean(axis=0) < _LEAST_TYPICAL
    white = np.std(still, axis=0, where=typical) / np.sqrt(typical.sum(axis=0))
    # noise with a memory leaves the means of stretches further apart than white noise would
    parts = np.array([part.mean(axis=0) for part in np.array_split(still, _STRETCHES)])
    sigma = np.maximum(white, np.std(parts, axis=0, ddof=1) / np.sqrt(_STRETCHES))
    return np.mean(still, axis=0, where=typical), sigma


def _vector(values: Axes) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def _find_touch(forces: Forces, *, tare_n: Vector | None) -> float:
    """Find the time of the first touch; infinite if there is none."""
    time, start = forces.time_s, float(forces.time_s[0])
    first = forces.force_n[time <= start + _FIRST_S]
    rest = np.median(first, axis=0) if tare_n is None else np.array(tare_n)
    # adjacent means show their noise, even if it is correlated
    apart = middles(time, start, float(time[-1]), width_s=_WINDOW_S)
    sigma = float(np.linalg.norm(noise_sigma(mean_force(time, forces.force_n, apart, window_s=_WINDOW_S))))
    # the rest itself is known from a few windows only
    sigma *= np.sqrt(1 + 1.5 * _WINDOW_S / _FIRST_S)
    away = np.linalg.norm(mean_force(time, forces.force_n, time, window_s=_WINDOW_S) - rest, axis=1)
    touched = away > max(_TOUCH_SIGMAS * sigma, _TOUCH_SHARE * away.max(), 1e-9)
    # the window shrinks at the ends, where a single sample's noise is no touch
    touched &= (time >= start + _WINDOW_S / 2) & (time <= time[-1] - _WINDOW_S / 2)
    return float(time[np.argmax(touched)]) if touched.any() else float("inf")


class MeanForces(NamedTuple):
    """Forces averaged about given times, and their standard uncertainties."""

    normal_n: Times
    tangential_n: Times  # length
    normal_noise_n: Times
    tangential_noise_n: Times
    normal_tare_n: Times
    tangential_tare_n: Times


@dataclass(frozen=True, kw_only=True)
class ContactForces:
    """Forces in the axes of the contact, tare taken off, on the force sensor's clock."""

    recorded: Forces
    normal_n: Float[np.ndarray, " samples"]  #: Positive when pressing.
    tangential_n: Float[np.ndarray, "samples 2"]  #: The two other axes in their order; of their length see `magnitude`.
    axes: ForceAxes

    @property
    def time_s(self) -> Samples:
        """Times of the samples."""
        return self.recorded.time_s

    def tare_sigma_n(self, time_s: Times) -> tuple[Times, Times]:
        """Return the standard uncertainty of the tare and its drift: of the normal force, and of the tangential one."""
        normal, tangential = self._split(self.axes.tare_sigma_n)
        tilt = self.axes.direction_sigma * np.abs(np.interp(time_s, self.time_s, self.normal_n))
        uneven = _UNEVEN_SHARE * np.array(self.axes.drift_n_s)
        normal_drift, drift = self._split(np.hypot(uneven, self.axes.drift_sigma_n_s))
        since = np.maximum(_time_since_tare(self.recorded, self.axes, time_s), 0)
        # of a drift the length counts, for it is the same in all samples
        across = np.hypot(np.hypot(tangential, np.sqrt(2) * drift * since), tilt)
        return np.hypot(normal, normal_drift * since), across

    def means(self, time_s: Times, *, window_s: float, until_s: float = np.inf) -> "MeanForces":
        """Average the forces over windows about given times, none over the onset of slip `until_s`."""
        samples = self.time_s
        normal, tangential = (
            mean_force(samples, values, time_s, window_s=window_s, until_s=until_s)
            for values in (self.normal_n, self.tangential_n)
        )
        # a shorter window averages less noise away, at worst none
        at_s = np.clip(time_s, samples[0], samples[-1])
        length = 2 * half_window(samples, at_s, window_s=window_s, until_s=until_s)
        more = np.sqrt(window_s / np.maximum(length, 1e-9))
        normal_noise, noise = (
            np.minimum(mean * more, max(sample, mean))
            for mean, sample in zip(self.noise_of_means_n(window_s), self._split(self.axes.noise_n), strict=True)
        )
        return MeanForces(normal, magnitude(tangential, sigma_n=noise), normal_noise, noise, *self.tare_sigma_n(time_s))

    def noise_of_means_n(self, window_s: float) -> tuple[float, float]:
        """Return the standard deviation of the noise of means over a window, measured on means, white or not."""
        time = self.time_s
        ends = float(time[0]), float(time[-1] - window_s / 2)
        apart = middles(time, *ends, width_s=window_s) if window_s > 0 else time
        means = mean_force(time, self.recorded.force_n, apart, window_s=window_s)
        # of too few means the spread is unknown: that of the samples stands for it
        return self._split(noise_sigma(means) if len(means) >= _FEW_MEANS else self.axes.noise_n)

    def _split(self, of_axes: Vector | Axes) -> tuple[float, float]:
        index = self.axes.normal_index
        squares = turn_matrix(self.axes) ** 2 @ np.square(of_axes)
        return float(np.sqrt(squares[index])), float(np.sqrt(np.mean(np.delete(squares, index))))


def turn_matrix(axes: ForceAxes) -> Float[np.ndarray, "3 3"]:
    """Return the shortest rotation that brings the direction of the press onto the normal axis (Rodrigues)."""
    onto = axes.sign * np.eye(3)[axes.normal_index]
    if axes.direction is None:
        return np.eye(3)
    about = np.cross(axes.direction, onto)
    cross = np.cross(np.eye(3), about)
    return np.eye(3) + cross + cross @ cross / (1 + np.dot(axes.direction, onto))


def _time_since_tare(forces: Forces, axes: ForceAxes, time_s: Times) -> Times:
    """Return the time since the middle of the untouched samples."""
    begin = float(forces.time_s[0])
    return time_s - (begin + (begin if axes.still_until_s is None else axes.still_until_s)) / 2


def subtract_zero(forces: Forces, axes: ForceAxes) -> Float[np.ndarray, "samples 3"]:
    """Subtract the tare and its even drift."""
    return forces.force_n - axes.tare_n - np.outer(_time_since_tare(forces, axes, forces.time_s), axes.drift_n_s)


def apply_axes(forces: Forces, axes: ForceAxes) -> ContactForces:
    """Subtract the tare and its drift, and turn the forces into the axes of the contact."""
    force = subtract_zero(forces, axes) @ turn_matrix(axes).T
    return ContactForces(
        recorded=forces,
        normal_n=axes.sign * force[:, axes.normal_index],
        tangential_n=np.delete(force, axes.normal_index, axis=1),
        axes=axes,
    )


def magnitude(tangential_n: Float[np.ndarray, "samples 2"], *, sigma_n: float | Samples) -> Samples:
    """Return the length of a tangential force, corrected for the noise of each component.

    References
    ----------
    Gudbjartsson and Patz, *Magn. Reson. Med.* 34 (1995) 910: sqrt(|m^2 - sigma^2|) for Rician data.
    """
    return np.sqrt(np.maximum(np.sum(tangential_n**2, axis=1) - sigma_n**2, 0))
