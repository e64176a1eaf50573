"""Faults of a force sensor: samples that no touch explains, found before anything is inferred from them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces
from sliplens.recordings.labelling import ForceFault, Lag, Reason
from sliplens.recordings.labels.axes import infer_axes, mean_force, noise_sigma, turn_matrix, typical_step
from sliplens.recordings.labels.lag import estimate_lag, force_changes
from sliplens.recordings.trial import MOST_FORCE_N

Times: TypeAlias = Float[np.ndarray, " times"]
Samples: TypeAlias = Float[np.ndarray, "samples 3"]
Axis: TypeAlias = Float[np.ndarray, "3"]
Marks: TypeAlias = Int[np.ndarray, " samples"]
Sees: TypeAlias = Callable[[float, float], bool]
"""Whether the image moves as it would at a jump of the force: its time (s) and its size (N)."""

GAP_STEPS = 4.0  # samples further apart than so many typical steps miss others between them
FAULTS = (Reason.NONE, Reason.DROP_OUT, Reason.STUCK, Reason.CLIPPED, Reason.SPIKE, Reason.STEP, Reason.MARKED)
_DROP_OUT, _STUCK, _CLIPPED, _SPIKE, _STEP, MARKED = range(1, len(FAULTS))

_LEAST_RUN = 4  # equal samples: fewer hold a frame's force up by less than its noise
_RUN_CHANCE = 1e-4  # chance that a sensor that works repeats a value as often, anywhere in a trial
# share of the interior samples that are peaks or dips: 2/3 of white noise, none of a smooth curve without noise
_NOISY = 0.3
_WIDEST_SPIKE = 3  # samples; what lasts longer is found by the jumps at its ends
_BESIDE = 4  # samples on either side that a spike is compared with
_SPIKE_SIGMAS = 8.0  # of the noise of a sample; sensors have more outliers than Gaussian noise
_SPIKE_RANGES = 3.0  # and so many ranges of the samples beside it
_SLOW_S = 0.025  # samples further apart cannot tell a jump from a press
_FIT_S, _FIT_SAMPLES = 0.03, (4, 15)  # what of either side of a jump is fitted by a line
_JUMP_SIGMAS = 7.0
_BURST_SIGMAS = 12.0  # of a change from one sample to the next, where there is no room for lines
# of the load: a smaller jump moves the margin by no more than its usual uncertainty, a kink of a press looks as large
_JUMP_SHARE, _BURST_SHARE = 0.04, 0.15
_ASLANT = 0.2  # of a fall of the pull: so much of it may show along the normal, of axes that lie askew by 11 degrees
_AT_REST = 0.1  # of the load: less is let go, however the zero has drifted
_LET_GO_S = 0.3  # longest release that looks like jumps
_SET_S = 0.1  # how far a slip that was set by hand may lie from its jump
_BRIEF_S = 0.1  # a fault as short as this has ended when the force is back near where it was
_LONGEST_LAG_S = 0.25  # where a jump may be seen if the lag is not told
_NO_FLAG = 1e-6  # rounding of a mean of flags that are all 0
_ALIKE = 1.1  # samples, on average, in a row with one value: more are coarse or repeated
_ROUNDS = 3  # a large fault hides small ones


@dataclass(frozen=True, kw_only=True)
class Screened:
    """Force samples, the faulty ones left out."""

    forces: Forces
    marks: Marks
    """Place in `FAULTS` of what each recorded sample suffers from; 0 for none."""
    recorded: Forces
    moved_s: float = np.inf
    """Time from which on samples were moved back by a step."""
    doubts: tuple[str, ...] = ()
    """What was taken for a slip though the image rests, a sentence each."""

    @property
    def faults(self) -> tuple[ForceFault, ...]:
        """Stretches of faulty samples, in the order of time."""
        marks, time, force = self.marks, self.recorded.time_s, self.recorded.force_n
        ends = np.flatnonzero(np.diff(marks, prepend=-1, append=-1))
        faults = []
        for start, end in pairwise(ends.tolist()):
            if marks[start]:
                size = np.nanmax(np.abs(force[start:end]), initial=0.0)
                span = {"start_s": float(time[start]), "end_s": float(time[end - 1])}
                faults.append(ForceFault(kind=FAULTS[marks[start]], largest_n=float(size), **span))
        gaps = np.flatnonzero(np.diff(time) > GAP_STEPS * typical_step(time))
        faults += [
            ForceFault(kind=Reason.MISSING_SAMPLES, start_s=float(time[at]), end_s=float(time[at + 1]))
            for at in gaps.tolist()
        ]
        return tuple(sorted(faults, key=lambda fault: fault.start_s))


def screen_forces(
    forces: Forces, *, sees: Sees = lambda _time_s, _size_n: False, bad_s: Sequence[tuple[float, float]] = ()
) -> Screened:
    """Leave out the samples of a force sensor that are faulty, and tell what they suffer from.

    `bad_s` are the ends of spans, in seconds, that somebody knows to be wrong.

    Numbers that are none, or of no force (`MOST_FORCE_N`); values that a noisy sensor repeats; clipped tops; spikes,
    which neither side of them explains; and what lies between jumps from one sample to the next that the image does not
    see, until the force is back: the jumps cancel, or one change of signs, scales or axes undoes both. Of jumps without
    a way back a fall of the tangential force at constant normal force is a slip, and a fall of both to nothing a
    release; after any other the rest of the trial is marked, and moved back by the jumps to infer the friction from.

    References
    ----------
    Turning points: Kendall and Stuart, *The Advanced Theory of Statistics* 3, 45.18. Spikes: Hampel's identifier, with
    the sides of a sample apart so that an edge is none (Pearson, *IEEE Trans. Control Syst. Technol.* 10 (2002) 55).
    """
    marks = np.zeros(len(forces.time_s), dtype=np.int64)
    marks[~(np.abs(forces.force_n) <= MOST_FORCE_N).all(axis=1)] = _DROP_OUT  # no number, or none of a force
    for start_s, end_s in bad_s:
        marks[(forces.time_s >= start_s) & (forces.time_s <= end_s)] = MARKED
    good = marks == 0
    if good.sum() < 2 * _BESIDE:
        return _leave_out(forces, marks)
    marks[good] = _find_runs(forces.force_n[good])
    shift = np.full(forces.force_n.shape, np.nan)
    for find in (_find_spikes, lambda one: _find_shifts(one, sees=sees)) * _ROUNDS:
        good = np.flatnonzero(marks == 0)
        if len(good) > 2 * _BESIDE:
            some = replace(forces, time_s=forces.time_s[good], force_n=forces.force_n[good])
            marks[good], shift[good] = find(some)
    screened = _leave_out(forces, marks, shift)
    _, slips = _find_breaks(screened.forces, sees=sees)
    doubts = tuple(
        f"the tangential force falls at {at_s:.2f} s while the normal force stays and the image rests, which was taken "
        "for a slip; if the sensor was knocked, mark the frames from there on as bad and give the friction with --mu"
        for at_s in slips
        if not sees(at_s, 0.0)
    )
    return replace(screened, doubts=doubts)


def screen_trial(
    frame_time_s: Times,
    image_motion: Times,
    forces: Forces,
    *,
    lag: Lag | None,
    bad_frames: Sequence[tuple[int, int]] = (),
    slip_s: float | None = None,
    rng: np.random.Generator,
) -> tuple[Screened, Lag]:
    """Screen the forces of a trial, the image as a witness of their jumps, and estimate the lag if it is None.

    A jump at `slip_s`, the slip that was set by hand, in seconds, is no fault.
    """
    at_s = frame_time_s - (0.0 if lag is None else lag.lag_s)
    bad_s = [(float(at_s[first]), float(at_s[last])) for first, last in bad_frames]
    screened = screen_forces(forces, sees=lambda _time_s, _size_n: True, bad_s=bad_s)
    bridged, jumps = _bridge(screened.forces)
    if lag is None:
        try:
            lag = estimate_lag(frame_time_s, image_motion, bridged, rng=rng)
        except RecordingError:
            if len(bridged.time_s) == len(forces.time_s):
                raise
            lag = Lag(lag_s=0.0, sigma_s=0.0, doubt="too many samples of the forces are faulty to tell a lag from")
    if jumps:
        time = frame_time_s - (0.0 if lag.doubt else lag.lag_s)
        changes = np.append(0.0, np.nan_to_num(force_changes(time, bridged)))
        image = image_witness(frame_time_s, image_motion, changes, lag=lag, longest_lag_s=_LONGEST_LAG_S)

        def sees(time_s: float, size_n: float) -> bool:
            return (slip_s is not None and abs(time_s - slip_s) <= _SET_S) or image(time_s, size_n)

        screened = screen_forces(forces, sees=sees, bad_s=bad_s)
    return screened, lag


def _bridge(forces: Forces) -> tuple[Forces, int]:
    """Take all jumps out of the force, and count them: what is left changes as the image does."""
    force, count = forces.force_n.copy(), 0
    if not 0 < typical_step(forces.time_s) <= _SLOW_S:
        return forces, 0
    for _ in range(_ROUNDS):
        jumps = find_jumps(replace(forces, force_n=force), load_n=_load(force))
        for at, _ in jumps:
            few = max(1, min(_fitted(forces), at, len(force) - at))
            force[at:] -= np.median(force[at : at + few], axis=0) - np.median(force[at - few : at], axis=0)
        count += len(jumps)
    return replace(forces, force_n=force), count


def _noise(force_n: Samples) -> Float[np.ndarray, " 3"]:
    """Standard deviation of the noise of each axis, more where neighbours are alike: means get rid of less of it."""
    sigma = np.zeros(3)
    for axis, values in enumerate(force_n.T):
        changes = np.abs(np.diff(values))
        changes = changes[changes > 0]
        # coarse or repeated values change seldom: the median of all changes would be 0, and neighbours are alike
        if len(changes):
            alike = min(len(values) / len(changes), _FIT_SAMPLES[1])
            coarse = np.median(changes) if alike > _ALIKE else 0.0
            sigma[axis] = max(float(noise_sigma(values)), coarse) * np.sqrt(alike)
    return sigma


def _load(force_n: Float[np.ndarray, "samples 3"]) -> float:
    """Size of the forces of a trial."""
    return float(np.quantile(np.linalg.norm(force_n - np.median(force_n[: 2 * _BESIDE], axis=0), axis=1), 0.95))


def faults_at(screened: Screened, time_s: Times, *, window_s: float) -> Marks:
    """Place in `FAULTS` of what the samples about given times suffer from; 0 for none."""
    flags = (screened.marks[:, None] == np.arange(len(FAULTS))).astype(np.float64)
    flags[:, 0] = 0
    means = mean_force(screened.recorded.time_s, flags, time_s, window_s=window_s)
    return np.where(means.max(axis=1) > _NO_FLAG, np.argmax(means, axis=1), 0)


def _leave_out(forces: Forces, marks: Marks, shift: Samples | None = None) -> Screened:
    """Keep the samples without a mark, and those whose shift is known, moved back by it."""
    shift = np.full(forces.force_n.shape, np.nan) if shift is None else shift
    force = np.where(marks[:, None] == 0, forces.force_n, forces.force_n - shift)
    good = np.isfinite(force).all(axis=1)
    kept = replace(forces, time_s=forces.time_s[good], force_n=force[good]) if good.any() else forces
    moved = forces.time_s[good & (marks == _STEP)]
    moved_s = float(moved[0]) if len(moved) else np.inf
    return Screened(forces=kept, marks=marks, recorded=forces, moved_s=moved_s)


def _find_runs(force_n: Float[np.ndarray, "samples 3"]) -> Marks:
    """Values that an axis repeats more often than its noise and its resolution allow."""
    marks = np.zeros(len(force_n), dtype=np.int64)
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
        again = 1 - live.sum() / lengths[live].sum()
        most = np.log(_RUN_CHANCE / len(values)) / np.log(again) if again > 0 else 1.0
        stuck = live & (lengths > max(_LEAST_RUN, most))
        for start, level, length in zip(starts[stuck], levels[stuck], lengths[stuck], strict=True):
            top = level in (values.min(), values.max())
            kind = _CLIPPED if top and level != 0 else _DROP_OUT if level == 0 else _STUCK
            where = values == level if kind == _CLIPPED else slice(start, start + length)
            marks[where] = kind
    return marks


def _find_spikes(forces: Forces) -> tuple[Marks, Samples]:
    """Samples, up to a few in a row, that stand out of those before and of those after them to the same side."""
    force = forces.force_n
    least = _SPIKE_SIGMAS * _noise(force) + 1e-9
    marks = np.zeros(len(force), dtype=np.int64)
    for width in range(1, _WIDEST_SPIKE + 1):
        # a spike at the very ends has one side only, which stands for both
        padded = np.pad(force, ((_BESIDE, _BESIDE), (0, 0)), mode="reflect")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _BESIDE + width, axis=0)
        before, inside, after = np.split(windows, (_BESIDE, _BESIDE + width), axis=-1)
        low, high = (np.median(side, axis=-1) for side in (before, after))
        above = (inside - np.maximum(low, high)[..., None]).min(axis=-1)
        below = (np.minimum(low, high)[..., None] - inside).min(axis=-1)
        spread = np.maximum(np.ptp(before, axis=-1), np.ptp(after, axis=-1))
        found = np.any(np.maximum(above, below) > least + _SPIKE_RANGES * spread, axis=1)
        for start in np.flatnonzero(found).tolist():
            marks[start : start + width] = _SPIKE
    return marks, np.full(force.shape, np.nan)


def _find_breaks(forces: Forces, *, sees: Sees) -> tuple[list[int], list[float]]:
    """Find the samples before which the force jumps unseen, and neither slips nor is let go; and the times of slips."""
    if not 0 < typical_step(forces.time_s) <= _SLOW_S:
        return [], []
    jumps = find_jumps(forces, load_n=_load(forces.force_n))
    unseen = [at for at, size in jumps if not sees(float(forces.time_s[at]), size)]
    unloading = _find_unloading(forces, [at for at, _ in jumps], unseen=set(unseen))
    slips = [float(forces.time_s[at]) for at, slips in unloading.items() if slips]
    return [at for at in unseen if at not in unloading], slips


def _near(force_n: Samples) -> Axis:
    """Difference that two forces may have which are the same: of lines through a few samples, lengthened to meet."""
    return 6 * _noise(force_n) + 0.5 * _JUMP_SHARE * _load(force_n)


def _typical_rate(forces: Forces) -> float:
    """Median rate at which the force changes, in newtons a second."""
    return float(np.median(np.linalg.norm(np.diff(forces.force_n, axis=0), axis=1) / np.diff(forces.time_s)))


def _find_shifts(forces: Forces, *, sees: Sees) -> tuple[Marks, Samples]:
    """Find stretches between jumps of the force that the image does not see, from the first until the force is back.

    Slips and releases are none. Of a step without a way back its size is told, too.
    """
    time, force = forces.time_s, forces.force_n
    marks, shift = np.zeros(len(time), dtype=np.int64), np.full(force.shape, np.nan)
    breaks, _ = _find_breaks(forces, sees=sees)
    if not breaks:
        return marks, shift
    near, sigma = _near(force), _noise(force)
    parts = [_Part.of(forces, start, end) for start, end in pairwise([0, *breaks, len(time)])]
    rate = _typical_rate(forces)
    last, off = parts[0], []
    for part in parts[1:]:
        if off and _is_back(last, off, part, near_n=near, rate_n_s=rate):
            last, off = part, []
        else:
            marks[part.start : part.end] = _STEP
            off.append(part)
    moved = np.zeros(3)
    for before, part in pairwise([last, *off]):
        jump = part.first_n - before.last_n
        if np.any((np.abs(jump) > 6 * sigma) & (np.abs(jump + 2 * before.last_n) < near)):
            break  # a change of sign is no step, and what comes after it cannot be moved back
        moved += jump
        shift[part.start : part.end] = moved
    return marks, shift


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Samples between two jumps, and the force at their ends."""

    start: int
    end: int
    start_s: float
    end_s: float
    first_n: Float[np.ndarray, " 3"]
    last_n: Float[np.ndarray, " 3"]

    @classmethod
    def of(cls, forces: Forces, start: int, end: int) -> "_Part":
        """Lengthen a line through the samples at either end by half a step."""
        time, force = forces.time_s[start:end], forces.force_n[start:end]
        count = _fitted(forces)
        half = typical_step(forces.time_s) / 2
        ends = [
            _level(time[some], force[some], at_s)
            for some, at_s in ((slice(count), time[0] - half), (slice(-count, None), time[-1] + half))
        ]
        return cls(start=start, end=end, start_s=float(time[0]), end_s=float(time[-1]), first_n=ends[0], last_n=ends[1])


def _find_unloading(forces: Forces, jumps: Sequence[int], *, unseen: set[int]) -> dict[int, bool]:
    """Find the jumps with which a contact slips or is let go, and tell those at which a slip begins.

    A fall of the tangential force at constant normal force is a slip, a fall of both to nothing a release. Neither
    comes back, at once or with a later jump, of which the image may have seen some. Jumps that a release may hold are
    looked at together.
    """
    if not unseen:
        return {}
    try:
        axes = infer_axes(forces)
    except RecordingError:
        return {}  # nothing is ever loaded
    time, force = forces.time_s, forces.force_n - axes.tare_n
    normal = axes.sign * turn_matrix(axes)[axes.normal_index]
    near_n = _near(forces.force_n)
    count, near, least = _fitted(forces), float(np.linalg.norm(near_n)), _JUMP_SHARE * _load(forces.force_n)
    groups: list[list[int]] = []
    for at in jumps:
        if groups and time[at] - time[groups[-1][-1]] <= _LET_GO_S:
            groups[-1].append(at)
        else:
            groups.append([at])
    spans = [(max(1, group[0] - count), min(len(time) - 1, group[-1] + count)) for group in groups]
    levels = [
        [np.median(part, axis=0) for part in (force[max(0, start - count) : start], force[end : end + count])]
        for start, end in spans
    ]
    ends = [0, *(group[0] for group in groups), len(time)]
    starts = [0, *(group[-1] for group in groups)]
    parts = [_Part.of(forces, start, end) for start, end in zip(starts, ends[1:], strict=True)]
    rate = _typical_rate(forces)

    def back(leaves: int, comes: int) -> bool:
        """Whether the second of two groups takes back what the first did."""
        off = parts[leaves + 1 : comes + 1]
        return _is_back(parts[leaves], off, parts[comes + 1], near_n=near_n, rate_n_s=rate)

    unloading = {}
    faulty: list[int] = []  # groups that are neither slip nor release
    for place, (group, (start, end), (before, after)) in enumerate(zip(groups, spans, levels, strict=True)):
        if unseen.isdisjoint(group):
            continue
        others = [(left, place) for left in faulty] + [(place, later) for later in range(place + 1, len(groups))]
        faulty.append(place)
        pull = before - normal * (normal @ before)
        along = pull / max(float(np.linalg.norm(pull)), 1e-12)
        basis = np.stack((normal, along))
        course = np.concatenate((before[None], force[start:end], after[None])) @ basis.T
        beside = np.linalg.norm(force[start:end] - course[1:-1] @ basis, axis=1)
        fallen = course[0] - course[-1]
        aslant = _ASLANT * abs(fallen[1])
        # no force grows, reverses, or grows again
        falls = np.all(np.abs(course - np.minimum.accumulate(course)) <= near + aslant)
        falls &= np.all(course >= -near - aslant) and np.all(beside <= near + aslant)
        slips = abs(fallen[0]) <= near + aslant
        let_go = float(np.linalg.norm(after)) <= near + _AT_REST * float(np.linalg.norm(before))
        if course[0, 0] <= near or not (falls and (slips or let_go)):
            continue
        # sliding friction holds no more than static friction: who pulls harder later has not slipped
        later = np.lib.stride_tricks.sliding_window_view(force[start:], count, axis=0).mean(axis=-1) @ basis.T
        harder = later[:, 1] / np.maximum(later[:, 0], course[0, 0] / 2) > (course[0, 1] + near) / course[0, 0]
        if not harder.any() and not any(back(*pair) for pair in others):
            faulty.remove(place)
            unloading |= {at: bool(slips and fallen[1] > least and at == group[0]) for at in group}
    return unloading


def _level(
    time_s: Float[np.ndarray, " samples"], force_n: Float[np.ndarray, "samples 3"], at_s: float
) -> Float[np.ndarray, " 3"]:
    if len(time_s) < _FIT_SAMPLES[0]:
        return np.median(force_n, axis=0)
    return np.polyfit(time_s - at_s, force_n, 1)[1]


def _is_back(last: _Part, off: list[_Part], part: _Part, *, near_n: Float[np.ndarray, " 3"], rate_n_s: float) -> bool:
    """Whether the force after some faulty parts goes on from where it was before them."""

    def near(difference: Float[np.ndarray, " 3"], more: float = 0.0) -> bool:
        return bool(np.all(np.abs(difference) <= near_n + more))

    chain = [last, *off, part]
    if near(sum((after.first_n - before.last_n for before, after in pairwise(chain)), np.zeros(3))):
        return True
    gap = part.start_s - last.end_s
    if gap <= _BRIEF_S and near(part.first_n - last.last_n, 3 * rate_n_s * gap):
        return True
    if len(off) > 1:
        return False
    # one change of scale, signs among them, or of axes, that explains both jumps
    (one,) = off
    inside, outside = np.stack((one.first_n, one.last_n)), np.stack((last.last_n, part.first_n))
    scale = np.sum(inside * outside, axis=0) / np.maximum(np.sum(outside**2, axis=0), 1e-12)
    if all(near(row) for row in (inside - scale * outside) / np.maximum(1, np.abs(scale))):
        return True
    return any(
        near(one.first_n - last.last_n[list(order)]) and near(one.last_n - part.first_n[list(order)])
        for order in permutations(range(3))
    )


def find_jumps(forces: Forces, *, load_n: float) -> list[tuple[int, float]]:
    """Samples before which the force jumps, and by how much, in newtons.

    A jump is a change from one sample to the next that is too large for any noise, or else a difference of the lines
    through the samples before and after it, where both meet.
    """
    force, step = forces.force_n, typical_step(forces.time_s)
    sigma, count = _noise(force), _fitted(forces)
    change = np.diff(force, axis=0, prepend=force[:1])
    apart = np.diff(forces.time_s, prepend=forces.time_s[0]) > 2 * _FIT_SAMPLES[0] * step
    limit = np.maximum(_BURST_SIGMAS * np.sqrt(2) * sigma, _BURST_SHARE * load_n)
    burst = np.any(np.abs(change) > limit, axis=1) & ~apart
    found = [(at, float(np.linalg.norm(change[at]))) for at in np.flatnonzero(burst).tolist()]
    middle = np.arange(count) + 0.5
    # what a line fitted to samples at these places, counted from a jump, is at the jump
    weights = np.linalg.pinv(np.stack((np.ones(count), middle), axis=1))[0]
    limit = np.maximum(_JUMP_SIGMAS * np.sqrt(2) * np.linalg.norm(weights) * sigma, _JUMP_SHARE * load_n)
    for start, end in pairwise([0, *np.flatnonzero(burst | apart).tolist(), len(force)]):
        if end - start < 2 * count:
            continue
        sides = np.lib.stride_tricks.sliding_window_view(force[start:end], count, axis=0)
        jump = sides[count:] @ weights - sides[:-count] @ weights[::-1]
        excess = np.max(np.abs(jump) / limit, axis=1)
        while excess.max() > 1:
            at = int(np.argmax(excess))
            found.append((start + count + at, float(np.linalg.norm(jump[at]))))
            excess[max(0, at - count + 1) : at + count] = 0
    return sorted(found)


def _fitted(forces: Forces) -> int:
    """Number of samples on either side of a jump that are fitted by a line."""
    return int(np.clip(round(_FIT_S / typical_step(forces.time_s)), *_FIT_SAMPLES))


_QUIET_S = 0.3  # about a jump: what the image moves without it
_SEEN_SHARE = 0.3  # of what the image moves with such a change of the force elsewhere in the trial
_SEEN_SIGMAS = 4.0
_PULLED = 0.9  # quantile of the changes of the force from which it is read how much the image moves with it


def image_witness(
    frame_time_s: Float[np.ndarray, " frames"],
    image_motion: Float[np.ndarray, " frames"],
    change_n: Float[np.ndarray, " frames"],
    *,
    lag: Lag,
    longest_lag_s: float,
) -> Sees:
    """Tell whether the image moves at a jump of the force, about as much as with other forces of the trial.

    `change_n` is the length of the force's change in the time before each frame, as `image_motion` is the image's.
    """
    if len(image_motion) < _BESIDE:
        return lambda _time_s, _size_n: True  # where no frame tells, the force is believed
    step = typical_step(frame_time_s)
    reach = longest_lag_s if lag.doubt else 2 * lag.sigma_s + 1.5 * step
    base = float(np.quantile(image_motion[1:], 0.1))
    moving = change_n >= np.quantile(change_n[1:], _PULLED)
    moving[0] = False
    yielded = float(np.median((image_motion[moving] - base) / np.maximum(change_n[moving], 1e-9)))

    def sees(time_s: float, size_n: float) -> bool:
        after = np.abs(frame_time_s - time_s - (0.0 if lag.doubt else lag.lag_s))
        near = after[1:] <= reach
        beside = ~near & (after[1:] <= reach + _QUIET_S)
        motion = image_motion[1:]
        if not near.any() or beside.sum() < _BESIDE:
            return True
        quiet = float(np.median(motion[beside]))
        spread = 1.4826 * float(np.median(np.abs(motion[beside] - quiet)))
        return bool(motion[near].max() - quiet > max(_SEEN_SHARE * yielded * size_n, _SEEN_SIGMAS * spread))

    return sees
