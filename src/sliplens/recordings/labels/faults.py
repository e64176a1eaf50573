"""Faults of a force sensor: samples that no touch explains, found before axes, friction and margins are estimated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces
from sliplens.recordings.labelling import ForceFault, Lag, Reason
from sliplens.recordings.labels import axes
from sliplens.recordings.labels.lag import LONGEST_LAG_S, estimate_lag, force_changes
from sliplens.recordings.options import LabelSettings
from sliplens.recordings.trial import MOST_FORCE_N

Times: TypeAlias = Float[np.ndarray, " times"]
Samples: TypeAlias = Float[np.ndarray, "samples 3"]
Axis: TypeAlias = Float[np.ndarray, "3"]
Codes: TypeAlias = Int[np.ndarray, " samples"]
ImageMotionTest: TypeAlias = Callable[[float, float], bool]
"""Returns True where the image moves as it would at a jump of the force, given its time (s) and size (N)."""

FAULTS = (Reason.NONE, Reason.DROP_OUT, Reason.STUCK, Reason.CLIPPED, Reason.SPIKE, Reason.STEP, Reason.MARKED)
_DROP_OUT, _STUCK, _CLIPPED, _SPIKE, _STEP, MARKED = range(1, len(FAULTS))

# equal samples: fewer delay a frame's force by less than its noise; chance that a healthy sensor repeats as often
_LEAST_RUN, _RUN_CHANCE = 4, 1e-4
_NOISY = 0.3  # share of the interior samples that turn: 2/3 of white noise, none of a smooth curve without noise
_WIDEST_SPIKE, _BESIDE = 3, 4  # samples; longer faults are found by the jumps at their ends; compared on either side
_SPIKE_SIGMAS, _SPIKE_RANGES = 8.0, 3.0  # of the noise of a sample, and of the range of the samples beside it
_SLOW_S = 0.025  # with a longer step a jump looks like a press
_FIT_S, _FIT_SAMPLES = 0.03, (4, 15)  # part of either side of a jump that a line is fitted to
_JUMP_SIGMAS, _BURST_SIGMAS = 7.0, 12.0  # the second of a change between samples, where there is no room for lines
# of the load: a smaller jump moves the margin by no more than its usual uncertainty, a kink of a press looks as large
_JUMP_SHARE, _BURST_SHARE = 0.04, 0.15
_TILTED_SHARE = 0.2  # of a fall of the pull that may show along the normal: axes that are off by 11 degrees
_REST_SHARE, _RELEASE_S = 0.1, 0.3  # of the load of a released object; longest release that looks like jumps
_REGAINED = 0.8  # of the fall of a slip, that the pull of a sliding contact does not regain
_SLIP_S = 0.1  # largest distance of a slip set by hand from its jump
_BRIEF_S = 0.1  # a fault as short as this has ended when the force is back near its former value
_ROUNDING = 1e-6  # of a mean of flags that are all 0
_COARSE = 1.1  # mean length of runs of equal samples: more are coarse or repeated
_ROUNDS = 3  # a large fault hides small ones
_QUIET_S = 0.3  # time about a jump in which the image moves without it
# of the image motion at such a change of the force elsewhere in the trial, taken at a quantile of the changes
_MOVES_SHARE, _MOVES_SIGMAS, _PULLED = 0.3, 4.0, 0.9


@dataclass(frozen=True, kw_only=True)
class Screened:
    """Force samples without the faulty ones."""

    forces: Forces
    codes: Codes  # index in `FAULTS` of the fault of each recorded sample; 0 for none
    recorded: Forces
    moved_s: float = np.inf  # time from which on samples were moved back by a step
    doubts: tuple[str, ...] = ()  # slips at which the image rests, a sentence each

    @property
    def faults(self) -> tuple[ForceFault, ...]:
        """Stretches of faulty samples, in the order of time."""
        codes, time, force = self.codes, self.recorded.time_s, self.recorded.force_n
        ends = np.flatnonzero(np.diff(codes, prepend=-1, append=-1))
        faults = [
            ForceFault(
                kind=FAULTS[codes[start]], start_s=float(time[start]), end_s=float(time[end - 1]),
                largest_n=float(np.nanmax(np.abs(force[start:end]), initial=0.0)),
            )
            for start, end in pairwise(ends.tolist()) if codes[start]
        ]  # fmt: skip
        gaps = np.flatnonzero(np.diff(time) > axes.longest_step(time))
        faults += [
            ForceFault(kind=Reason.MISSING_SAMPLES, start_s=float(time[at]), end_s=float(time[at + 1]))
            for at in gaps.tolist()
        ]
        return tuple(sorted(faults, key=lambda fault: fault.start_s))

    def codes_at(self, time_s: Times, *, window_s: float) -> Codes:
        """Return the index in `FAULTS` of the fault within a window about given times; 0 for none."""
        flags = (self.codes[:, None] == np.arange(len(FAULTS))).astype(np.float64)
        flags[:, 0] = 0
        means = axes.mean_force(self.recorded.time_s, flags, time_s, window_s=window_s)
        return np.where(means.max(axis=1) > _ROUNDING, np.argmax(means, axis=1), 0)


def screen_forces(
    forces: Forces, *, image_moves: ImageMotionTest = lambda _t, _n: False, bad_s: Sequence[tuple[float, float]] = ()
) -> Screened:
    """Find the faulty samples of a force sensor and leave them out.

    Faults are: values that are no force (`MOST_FORCE_N`); values that a noisy sensor repeats; clipped tops; spikes; and
    the samples between jumps at which the image rests, until the force is back: the jumps cancel, or one change of
    signs, scales or axes undoes both. A jump without a way back is a slip where the tangential force falls at constant
    normal force, and a release where both fall to nothing; after any other the rest of the trial is faulty, and moved
    back by the jumps to estimate the friction from. `bad_s` are spans, in seconds, that are known to be wrong.

    References
    ----------
    Turning points: Kendall and Stuart, *The Advanced Theory of Statistics* 3, 45.18. Spikes: Hampel's identifier, with
    the sides of a sample apart so that an edge is none (Pearson, *IEEE Trans. Control Syst. Technol.* 10 (2002) 55).
    """
    codes = np.zeros(len(forces.time_s), dtype=np.int64)
    codes[~(np.abs(forces.force_n) <= MOST_FORCE_N).all(axis=1)] = _DROP_OUT
    for start_s, end_s in bad_s:
        codes[(forces.time_s >= start_s) & (forces.time_s <= end_s)] = MARKED
    shift = np.full(forces.force_n.shape, np.nan)
    if np.sum(codes == 0) < 2 * _BESIDE:
        return _leave_out(forces, codes, shift)
    codes[codes == 0] = _find_runs(forces.force_n[codes == 0])
    for _ in range(_ROUNDS):
        good = np.flatnonzero(codes == 0)
        if len(good) > 2 * _BESIDE:
            codes[good] = _find_spikes(forces.force_n[good])
        good = np.flatnonzero(codes == 0)
        if len(good) > 2 * _BESIDE:
            rest = replace(forces, time_s=forces.time_s[good], force_n=forces.force_n[good])
            codes[good], shift[good] = _find_steps(rest, image_moves=image_moves)
    screened = _leave_out(forces, codes, shift)
    _, slips_s = _classify_jumps(screened.forces, image_moves=image_moves)
    falls = [f"the tangential force falls at {at_s:.2f} s" for at_s in slips_s if not image_moves(at_s, 0.0)]
    cure = "if the sensor was knocked, mark the frames from there on as bad and give the friction with --mu"
    doubts = (f"{fall} while the image rests, which was taken for a slip; {cure}" for fall in falls)
    return replace(screened, doubts=tuple(doubts))


def screen_trial(
    frame_time_s: Times,
    image_motion: Times,
    forces: Forces,
    *,
    settings: LabelSettings,
    rng: np.random.Generator,
) -> tuple[Screened, Lag]:
    """Screen the forces of a trial by its image, and estimate the lag if not set; a jump at a set slip is no fault."""
    lag, slip_s = None if settings.lag_ms is None else Lag(lag_s=settings.lag_ms / 1e3, sigma_s=0.0), settings.slip_s
    bad_time_s = frame_time_s - (0.0 if lag is None else lag.lag_s)
    bad_s = [(float(bad_time_s[first]), float(bad_time_s[last])) for first, last in settings.bad_frames]
    screened = screen_forces(forces, image_moves=lambda _t, _n: True, bad_s=bad_s)
    continuous, jumps = _remove_jumps(screened.forces)
    if lag is None:
        try:
            lag = estimate_lag(frame_time_s, image_motion, continuous, rng=rng)
        except RecordingError:
            if len(continuous.time_s) == len(forces.time_s):
                raise
            lag = Lag(lag_s=0.0, sigma_s=0.0, doubt="too many samples of the forces are faulty to estimate a lag from")
    if jumps:
        test = _make_motion_test(frame_time_s, image_motion, continuous, lag)

        def image_moves(time_s: float, size_n: float) -> bool:
            return (slip_s is not None and abs(time_s - slip_s) <= _SLIP_S) or test(time_s, size_n)

        screened = screen_forces(forces, image_moves=image_moves, bad_s=bad_s)
    return screened, lag


def _leave_out(forces: Forces, codes: Codes, shift: Samples) -> Screened:
    """Keep the samples without a fault, and those whose shift is known, moved back by it."""
    force = np.where(codes[:, None] == 0, forces.force_n, forces.force_n - shift)
    good = np.isfinite(force).all(axis=1)
    rest = replace(forces, time_s=forces.time_s[good], force_n=force[good]) if good.any() else forces
    moved = forces.time_s[good & (codes == _STEP)]
    return Screened(forces=rest, codes=codes, recorded=forces, moved_s=float(moved[0]) if len(moved) else np.inf)


def _find_runs(force_n: Samples) -> Codes:
    """Find values that an axis repeats more often than its noise and its resolution allow."""
    codes = np.zeros(len(force_n), dtype=np.int64)
    for values in force_n.T:
        starts = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
        levels, lengths = values[starts], np.diff(np.append(starts, len(values)))
        if len(levels) < 3:
            continue
        turns = (levels[1:-1] - levels[:-2]) * (levels[1:-1] - levels[2:]) > 0
        # an untouched sensor may have a dead band, whose value is no fault
        live = levels != values[0]
        if turns.mean() < _NOISY or not live.any():
            continue
        repeat_chance = 1 - live.sum() / lengths[live].sum()
        longest = np.log(_RUN_CHANCE / len(values)) / np.log(repeat_chance) if repeat_chance > 0 else 1.0
        stuck = live & (lengths > max(_LEAST_RUN, longest))
        for start, level, length in zip(starts[stuck], levels[stuck], lengths[stuck], strict=True):
            if level == 0:
                codes[start : start + length] = _DROP_OUT
            elif level in (values.min(), values.max()):
                codes[values == level] = _CLIPPED
            else:
                codes[start : start + length] = _STUCK
    return codes


def _find_spikes(force_n: Samples) -> Codes:
    """Find samples, up to a few in a row, that stand out of those before and of those after them to the same side."""
    least = _SPIKE_SIGMAS * _noise(force_n) + 1e-9
    codes = np.zeros(len(force_n), dtype=np.int64)
    # a spike at the very ends has one side only, which stands for both
    padded = np.pad(force_n, ((_BESIDE, _BESIDE), (0, 0)), mode="reflect")
    for width in range(1, _WIDEST_SPIKE + 1):
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _BESIDE + width, axis=0)
        before, inside, after = np.split(windows, (_BESIDE, _BESIDE + width), axis=-1)
        low, high = (np.median(side, axis=-1) for side in (before, after))
        above = (inside - np.maximum(low, high)[..., None]).min(axis=-1)
        below = (np.minimum(low, high)[..., None] - inside).min(axis=-1)
        spread = np.maximum(np.ptp(before, axis=-1), np.ptp(after, axis=-1))
        spikes = np.any(np.maximum(above, below) > least + _SPIKE_RANGES * spread, axis=1)
        for start in np.flatnonzero(spikes).tolist():
            codes[start : start + width] = _SPIKE
    return codes


def _noise(force_n: Samples) -> Axis:
    """Standard deviation of the noise of each axis, more where neighbours are alike: means reduce it by less."""
    sigma = np.zeros(3)
    for axis, values in enumerate(force_n.T):
        changes = np.abs(np.diff(values))
        # coarse or repeated values change seldom: the median of all changes would be 0, and neighbours are alike
        if len(changes := changes[changes > 0]):
            run = min(len(values) / len(changes), _FIT_SAMPLES[1])
            sigma[axis] = max(float(axes.noise_sigma(values)), np.median(changes) * (run > _COARSE)) * np.sqrt(run)
    return sigma


def _load(force_n: Samples) -> float:
    """Size of the forces of a trial."""
    return float(np.quantile(np.linalg.norm(force_n - np.median(force_n[: 2 * _BESIDE], axis=0), axis=1), 0.95))


def _fit_count(forces: Forces) -> int:
    """Number of samples on either side of a jump that a line is fitted to."""
    return int(np.clip(round(_FIT_S / axes.typical_step(forces.time_s)), *_FIT_SAMPLES))


def _find_jumps(forces: Forces) -> list[tuple[int, float]]:
    """Find the samples before which the force jumps, and the size of the jump, in newtons."""
    if not 0 < axes.typical_step(forces.time_s) <= _SLOW_S:
        return []
    force, step, load_n = forces.force_n, axes.typical_step(forces.time_s), _load(forces.force_n)
    sigma, count = _noise(force), _fit_count(forces)
    change = np.diff(force, axis=0, prepend=force[:1])
    apart = np.diff(forces.time_s, prepend=forces.time_s[0]) > 2 * _FIT_SAMPLES[0] * step
    limit = np.maximum(_BURST_SIGMAS * np.sqrt(2) * sigma, _BURST_SHARE * load_n)
    burst = np.any(np.abs(change) > limit, axis=1) & ~apart
    jumps = [(at, float(np.linalg.norm(change[at]))) for at in np.flatnonzero(burst).tolist()]
    # weights that give the value at the jump of a line through the samples beside it
    weights = np.linalg.pinv(np.stack((np.ones(count), np.arange(count) + 0.5), axis=1))[0]
    limit = np.maximum(_JUMP_SIGMAS * np.sqrt(2) * np.linalg.norm(weights) * sigma, _JUMP_SHARE * load_n)
    for start, end in pairwise([0, *np.flatnonzero(burst | apart).tolist(), len(force)]):
        if end - start < 2 * count:
            continue
        sides = np.lib.stride_tricks.sliding_window_view(force[start:end], count, axis=0)
        jump = sides[count:] @ weights - sides[:-count] @ weights[::-1]
        excess = np.max(np.abs(jump) / limit, axis=1)
        while excess.max() > 1:
            at = int(np.argmax(excess))
            jumps.append((start + count + at, float(np.linalg.norm(jump[at]))))
            excess[max(0, at - count + 1) : at + count] = 0
    return sorted(jumps)


def _remove_jumps(forces: Forces) -> tuple[Forces, int]:
    """Take all jumps out of the force, and count them: the rest changes as the image does."""
    force, total = forces.force_n.copy(), 0
    for _ in range(_ROUNDS):
        jumps = _find_jumps(replace(forces, force_n=force))
        for at, _ in jumps:
            few = max(1, min(_fit_count(forces), at, len(force) - at))
            force[at:] -= np.median(force[at : at + few], axis=0) - np.median(force[at - few : at], axis=0)
        total += len(jumps)
    return replace(forces, force_n=force), total


class _Part(NamedTuple):
    """Samples between two jumps, and the force at their ends."""

    start: int
    end: int
    start_s: float
    end_s: float
    first_n: Axis
    last_n: Axis


def _near(forces: Forces) -> Axis:
    """Return the largest difference of equal forces of a trial."""
    return 6 * _noise(forces.force_n) + 0.5 * _JUMP_SHARE * _load(forces.force_n)


def _cut(forces: Forces, spans: Sequence[tuple[int, int]]) -> list[_Part]:
    """Cut the samples into parts, and extend a line through the samples at either end of each by half a step."""
    count, half, parts = _fit_count(forces), axes.typical_step(forces.time_s) / 2, []
    for start, end in spans:
        time, force = forces.time_s[start:end], forces.force_n[start:end]
        levels = [
            np.polyfit(time[side] - at_s, force[side], 1)[1]
            if len(time[side]) >= _FIT_SAMPLES[0]
            else np.median(force[side], axis=0)
            for side, at_s in ((slice(count), time[0] - half), (slice(-count, None), time[-1] + half))
        ]
        parts.append(_Part(start, end, float(time[0]), float(time[-1]), levels[0], levels[1]))
    return parts


def _find_steps(forces: Forces, *, image_moves: ImageMotionTest) -> tuple[Codes, Samples]:
    """Find the stretches from a jump at which the image rests until the force is back; slips and releases are none."""
    codes, shift = np.zeros(len(forces.time_s), dtype=np.int64), np.full(forces.force_n.shape, np.nan)
    breaks, _ = _classify_jumps(forces, image_moves=image_moves)
    if not breaks:
        return codes, shift
    returns = _make_return_test(forces)
    last, *parts = _cut(forces, list(pairwise([0, *breaks, len(forces.time_s)])))
    faulty: list[_Part] = []
    for part in parts:
        if faulty and returns(last, faulty, part):
            last, faulty = part, []
        else:
            codes[part.start : part.end] = _STEP
            faulty.append(part)
    moved, sigma, near = np.zeros(3), _noise(forces.force_n), _near(forces)
    for before, part in pairwise([last, *faulty]):
        jump = part.first_n - before.last_n
        if np.any((np.abs(jump) > 6 * sigma) & (np.abs(jump + 2 * before.last_n) < near)):
            break  # a change of sign is no step, and the samples after it cannot be moved back
        moved += jump
        shift[part.start : part.end] = moved
    return codes, shift


def _make_return_test(forces: Forces) -> Callable[[_Part, Sequence[_Part], _Part], bool]:
    """Make the test whether the force after some faulty parts continues from its value before them."""
    near = _near(forces)
    rate_n_s = float(np.median(np.linalg.norm(np.diff(forces.force_n, axis=0), axis=1) / np.diff(forces.time_s)))

    def returns(last: _Part, faulty: Sequence[_Part], part: _Part) -> bool:
        jumps = (after.first_n - before.last_n for before, after in pairwise([last, *faulty, part]))
        gap_s = part.start_s - last.end_s
        more = 3 * rate_n_s * gap_s if gap_s <= _BRIEF_S else -np.inf
        if np.all(np.abs(sum(jumps, np.zeros(3))) <= near) or np.all(np.abs(part.first_n - last.last_n) <= near + more):
            return True
        # one change of scale, signs among them, or of axes, that explains both jumps
        inside, outside = np.stack((faulty[0].first_n, faulty[0].last_n)), np.stack((last.last_n, part.first_n))
        scale = np.sum(inside * outside, axis=0) / np.maximum(np.sum(outside**2, axis=0), 1e-12)
        changed = [outside[:, order] for order in permutations(range(3))]
        rests = [(inside - scale * outside) / np.maximum(1, np.abs(scale)), *(inside - each for each in changed)]
        return len(faulty) == 1 and any(np.all(np.abs(rest) <= near) for rest in rests)

    return returns


def _classify_jumps(forces: Forces, *, image_moves: ImageMotionTest) -> tuple[list[int], list[float]]:
    """Find the samples before which the force jumps by a fault, and the times of slips."""
    jumps = _find_jumps(forces)
    resting = [at for at, size in jumps if not image_moves(float(forces.time_s[at]), size)]
    if not resting:
        return [], []
    try:
        # a step at the end must not be taken for a drift
        sensor = axes.infer_axes(forces, moved_s=-np.inf)
    except RecordingError:
        return resting, []  # nothing is ever loaded
    time, force = forces.time_s, axes.subtract_zero(forces, sensor)
    at = np.array([at for at, _ in jumps])
    groups = [group.tolist() for group in np.split(at, np.flatnonzero(np.diff(time[at]) > _RELEASE_S) + 1)]
    starts, ends = [0, *(group[-1] for group in groups)], [*(group[0] for group in groups), len(time)]
    parts, returns = _cut(forces, list(zip(starts, ends, strict=True))), _make_return_test(forces)
    normal = sensor.sign * axes.turn_matrix(sensor)[sensor.normal_index]
    slips_s: list[float] = []
    harmless: set[int] = set()
    faulty: list[int] = []  # groups that are neither slip nor release
    for place, group in enumerate(groups):
        if not any(at in resting for at in group):
            continue
        unloads, slips = _measure_fall(forces, force, group, normal)
        pairs = [(before, place) for before in faulty] + [(place, later) for later in range(place + 1, len(groups))]
        if not unloads or any(returns(parts[a], parts[a + 1 : b + 1], parts[b + 1]) for a, b in pairs):
            faulty.append(place)
            continue
        harmless |= set(group)
        if slips and group[0] in resting:
            slips_s.append(float(time[group[0]]))
    return [at for at in resting if at not in harmless], slips_s


def _measure_fall(forces: Forces, force_n: Samples, group: list[int], normal: Axis) -> tuple[bool, bool]:
    """Compare the force over a group of jumps with a slip or release; whether it unloads, and whether only the pull."""
    count, near = _fit_count(forces), float(np.linalg.norm(_near(forces)))
    start, end = max(1, group[0] - count), min(len(force_n) - 1, group[-1] + count)
    before = np.median(force_n[max(0, start - count) : start], axis=0)
    after = np.median(force_n[end : end + count], axis=0)
    pull = before - normal * (normal @ before)
    along = pull / max(float(np.linalg.norm(pull)), 1e-12)
    basis = np.stack((normal, along))
    course = np.concatenate((before[None], force_n[start:end], after[None])) @ basis.T
    beside = np.linalg.norm(force_n[start:end] - course[1:-1] @ basis, axis=1)
    fallen = course[0] - course[-1]
    limit = near + _TILTED_SHARE * abs(fallen[1])
    # neither force grows on the way, or reverses
    falls = np.all(np.abs(course - np.minimum.accumulate(course)) <= limit)
    falls &= np.all(course >= -limit) and np.all(beside <= limit)
    slips = abs(fallen[0]) <= limit
    released = float(np.linalg.norm(after)) <= near + _REST_SHARE * float(np.linalg.norm(before))
    if course[0, 0] <= near or not (falls and (slips or released)):
        return False, False
    # kinetic friction is no more than static friction: a pull that is harder later shows that nothing slipped here, nor
    # at a fall that the same contact makes up for without being seen to slip
    later = np.lib.stride_tricks.sliding_window_view(force_n[start:], count, axis=0).mean(axis=-1) @ basis.T
    ratio = later[:, 1] / np.maximum(later[:, 0], course[0, 0] / 2)
    harder = np.any(ratio > (course[0, 1] + near) / course[0, 0])
    pressed = np.cumsum(later[:, 0] < course[0, 0] / 2) == 0
    harder |= slips and np.any(ratio[count:][pressed[count:]] > (course[-1, 1] + _REGAINED * fallen[1]) / course[0, 0])
    return not harder, bool(slips and fallen[1] > _JUMP_SHARE * _load(forces.force_n))


def _make_motion_test(frame_time_s: Times, image_motion: Times, forces: Forces, lag: Lag) -> ImageMotionTest:
    """Make the test whether the image moves at a jump, about as much as at other changes of the force in the trial."""
    if len(image_motion) < _BESIDE:
        return lambda _t, _n: True  # without frames the force is believed
    lag_s, step = 0.0 if lag.doubt else lag.lag_s, axes.typical_step(frame_time_s)
    change_n = np.append(0.0, np.nan_to_num(force_changes(frame_time_s - lag_s, forces)))
    reach_s = LONGEST_LAG_S if lag.doubt else 2 * lag.sigma_s + 1.5 * step
    motion, base = image_motion[1:], float(np.quantile(image_motion[1:], 0.1))
    moving = change_n >= np.quantile(change_n[1:], _PULLED)
    moving[0] = False
    per_newton = float(np.median((image_motion[moving] - base) / np.maximum(change_n[moving], 1e-9)))

    def image_moves(time_s: float, size_n: float) -> bool:
        apart_s = np.abs(frame_time_s - time_s - lag_s)[1:]
        near = apart_s <= reach_s
        beside = ~near & (apart_s <= reach_s + _QUIET_S)
        if not near.any() or beside.sum() < _BESIDE:
            return True
        quiet, spread = axes.robust_spread(motion[beside])
        return bool(motion[near].max() - quiet > max(_MOVES_SHARE * per_newton * size_n, _MOVES_SIGMAS * spread))

    return image_moves
