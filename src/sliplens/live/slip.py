"""Gross slip as the markers alone tell it: no network, nothing learnt, thresholds from the sensor's own stillness."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from sliplens.errors import InputError
from sliplens.live.reading import MarkerReading, SlipState
from sliplens.markers.estimators import FieldTrial, stick_area

Field = Float[np.ndarray, "markers 2"]

_FEWEST = 6
"""Markers of the contact without which no motion of it can be told."""
_FEWEST_FRAMES = 3
"""Of the window, however slow the camera is."""
_LEAST_NOISE_PX = 0.02
"""Of compressed video, whose frames repeat, the noise cannot be seen."""
_REPRESSED = 1 / 0.75
_LET_GO = 0.3
_BENT_SHARE = 0.1
"""Of what the pattern lets expect; skin that springs back is more rigid than it was sheared."""
_CONFIRMED_S = 0.3
"""Time after a recoil in which a controller has tightened the grip, and a pull that is let go by hand has gone."""
_CARRIED, _TIGHTENED, _CARRIED_TIGHTENED = 0.7, 1.1, 0.75
"""Least share of the shear that is left after a slip; the same where the contact was pressed further, and how much.
Chosen on 12 simulated fingertips (seeds 50 to 61): kinetic friction of 0.7 to 0.9 of the static one leaves 0.76 to 0.9,
a pull that is let go to 0.7 leaves 0.64 to 0.72. One that is let go by less passes for a slip, too."""
_RAYLEIGH_95 = 2.45
"""95 % of the lengths of two-dimensional normal noise are below so many standard deviations."""


@dataclass(frozen=True, kw_only=True)
class SlipLimits:
    """From when on a motion counts; `recoil` and `evidence` in standard deviations of what the still sensor showed.

    The defaults were chosen on simulated trials of other seeds than `benchmarks/slip.py` tests on.
    """

    still_s: float = 0.4
    """Time at the beginning, in seconds, in which the noise of the markers is measured."""
    still_frames: int = 12
    """Frames that this takes at least."""
    window_s: float = 0.1
    """Longest time over which a motion is looked at, in seconds."""
    pattern_s: float = 0.4
    """Time over which the pattern of the shear is averaged, in seconds."""
    recoil: float = 4.0
    """Motion of the skin against that pattern."""
    evidence: float = 0.5
    """The same, of what no rigid motion explains (Dong's residual)."""
    fall: float = 0.045
    """Least share of the shear that is lost within the window: a pull that is let go slowly is no slip."""
    hold_s: float = 0.25
    """Time for which a slip that was seen is told, in seconds."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise InputError(f"the slip limit {name} must be positive, got {value:g}")


@dataclass(frozen=True, kw_only=True)
class ContactStates:
    """State of some contacts at one frame, an entry each."""

    ready: Bool[np.ndarray, " contacts"]
    """Whether the noise of the markers was measured, and enough of them are seen."""
    contact: Bool[np.ndarray, " contacts"]
    slip: Bool[np.ndarray, " contacts"]
    unknown: Bool[np.ndarray, " contacts"]
    """Whether neither slip nor sticking can be told."""
    shear_px: Float[np.ndarray, " contacts"]
    """Mean motion of the contact's middle since it was pressed, in pixels."""
    slipping_s: Float[np.ndarray, " contacts"]
    """Time since the slip began; NaN where nothing slips."""
    slipped_s: Float[np.ndarray, " contacts"]
    """Time since a slip began that is confirmed in this frame; NaN elsewhere."""


@dataclass(frozen=True, kw_only=True)
class _Recoil:
    """A contact as its skin began to spring back."""

    time_s: float
    spread: float
    hold: Field
    inner: Bool[np.ndarray, " markers"]
    shear_px: Float[np.ndarray, "2"]


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """Markers of one frame: motion since they were untouched, 0 where one is not seen."""

    time_s: float
    spread: Float[np.ndarray, " contacts"]
    moved: Float[np.ndarray, "contacts markers 2"]
    seen: Bool[np.ndarray, "contacts markers"]


class SlipBatch:
    """Detects slip in many contacts at once, each with its own sensor; `SlipDetector` describes how.

    Parameters
    ----------
    rest_px
        Places (x, y) of the markers in the untouched sensors; at least 6 each.
    limits
        From when on a motion counts.

    Raises
    ------
    InputError
        If there are fewer markers.
    """

    def __init__(self, rest_px: Float[np.ndarray, "contacts markers 2"], *, limits: SlipLimits | None = None) -> None:
        contacts, markers, _ = rest_px.shape
        if markers < _FEWEST:
            raise InputError(f"{markers} markers are too few to tell slip, at least {_FEWEST} are needed")
        self.limits = limits or SlipLimits()
        self._rest = rest_px
        self._reach_px = np.linalg.norm(_from_middle(rest_px), axis=2).mean(axis=1)
        self._still: list[list[tuple[float, Field]]] = [[] for _ in range(contacts)]
        self._seen = np.ones((contacts, markers), dtype=bool)
        self._divergence = _divergence_weights(rest_px, self._seen)
        self._noise_px = np.full(contacts, np.nan)
        """Standard deviation of a coordinate of a marker of the still sensor."""
        self._together_px = np.full(contacts, np.nan)
        """The same, were all their motion that of the markers as a whole: more where a camera trembles."""
        self._frames: deque[_Frame] = deque()
        self._window = np.zeros(contacts, dtype=int)
        """How many of the last frames are looked at."""
        self._hold = np.full(rest_px.shape, np.nan)
        """Motion of the markers up to the end of the press; NaN without a contact."""
        self._pattern = np.full(rest_px.shape, np.nan)
        """Mean motion since then, of the frames that left the window."""
        self._inner = np.zeros((contacts, markers), dtype=bool)
        self._pressed, self._hold_s, self._seen_s = np.zeros((3, contacts))
        self._slip_s, self._least_px = np.full(contacts, np.nan), np.full(contacts, np.inf)
        self._recoils_at: dict[int, _Recoil] = {}
        """Recoils that are not judged yet, by contact."""
        self._judged_s = np.full(contacts, np.nan)
        """Time of the recoil that was judged last."""

    def update(self, positions_px: Float[np.ndarray, "contacts markers 2"], time_s: float, /) -> ContactStates:
        """Take the markers of a frame, in the order of `rest_px`, NaN where one is not seen; times must rise."""
        moved = positions_px - self._rest
        seen = np.isfinite(moved[..., 0])
        moved, count = np.where(seen[..., None], moved, 0), seen.sum(axis=1)
        learns = np.isnan(self._noise_px)
        for row in np.flatnonzero(learns & (count >= _FEWEST)).tolist():
            self._learn_noise(row, np.where(seen[row, :, None], moved[row], np.nan), time_s)
        ready = ~learns & (count >= _FEWEST)
        if not np.array_equal(seen, self._seen):
            self._seen, self._divergence = seen, _divergence_weights(self._rest, seen)
        spread = (self._divergence * moved).sum(axis=(1, 2))
        stand_out = (moved**2).sum(axis=2) > ((2 * _RAYLEIGH_95 * self._noise_px) ** 2)[:, None]
        # out of the noise, and a contact that was there has not been let go
        contact = ready & (stand_out.sum(axis=1) > 0.1 * count) & (spread > _LET_GO * self._pressed)
        self._end(np.flatnonzero(~contact & (self._pressed > 0)))
        shear_px = np.linalg.norm(self._shear(moved, seen), axis=1)
        # what is stuck, and the shear, count from a press that grew by much, and more than it was pulled: a pull, too,
        # spreads the markers a little
        grown_px = (spread - self._pressed) / 2 * self._reach_px
        pressed = (spread > _REPRESSED * self._pressed) & (grown_px > np.nan_to_num(shear_px))
        for row in np.flatnonzero(contact & pressed).tolist():
            self._begin(row, np.where(seen[row, :, None], moved[row], np.nan), float(spread[row]), time_s)
            shear_px[row] = 0.0
        self._window = np.where(contact, self._window + 1, 0)
        self._frames.append(_Frame(time_s=time_s, spread=spread, moved=moved, seen=seen))
        self._shorten_windows(time_s)
        return self._states(self._recoils(), shear_px, ready, contact, time_s)

    def _states(
        self,
        began_s: Float[np.ndarray, " contacts"],
        shear_px: Float[np.ndarray, " contacts"],
        ready: Bool[np.ndarray, " contacts"],
        contact: Bool[np.ndarray, " contacts"],
        time_s: float,
    ) -> ContactStates:
        springs = np.isfinite(began_s)
        self._slip_s = np.where(springs & np.isnan(self._slip_s), began_s, self._slip_s)
        self._seen_s = np.where(springs, time_s, self._seen_s)
        self._least_px = np.fmin(np.where(springs, np.inf, self._least_px), shear_px)
        slip = np.isfinite(self._slip_s) & (time_s - self._seen_s <= self.limits.hold_s)
        # pulled on, and it follows: it sticks again
        sticks = ~slip & (shear_px > self._least_px + self.limits.recoil * self._middle_noise_px())
        self._slip_s = np.where(sticks, np.nan, self._slip_s)
        # after a slip, and until the press is over, nobody knows
        unknown = np.isfinite(self._slip_s) | (time_s - self._hold_s < self.limits.window_s)
        return ContactStates(
            ready=ready,
            contact=contact,
            slip=slip,
            unknown=unknown,
            shear_px=shear_px,
            slipping_s=np.where(slip, time_s - self._slip_s, np.nan),
            slipped_s=self._confirm(springs, time_s),
        )

    def _confirm(self, springs: Bool[np.ndarray, " contacts"], time_s: float) -> Float[np.ndarray, " contacts"]:
        """Time since the slips that are confirmed now: some time after the recoil the load is still there.

        A contact that slides carries what kinetic friction holds, and one that is tightened takes the load up again; a
        pull that was let go is gone.
        """
        confirmed_s, newest = np.full(len(self._rest), np.nan), self._frames[-1]
        for row in np.flatnonzero(springs).tolist():
            if row not in self._recoils_at and self._slip_s[row] != self._judged_s[row]:
                first = self._frames[-int(self._window[row])]
                middle = self._inner[row] & first.seen[row]
                self._recoils_at[row] = _Recoil(
                    time_s=float(self._slip_s[row]),
                    spread=float(first.spread[row]),
                    hold=self._hold[row].copy(),
                    inner=middle,
                    shear_px=(first.moved[row] - self._hold[row])[middle].mean(axis=0),
                )
        for row, recoil in list(self._recoils_at.items()):
            if not self._pressed[row] or time_s - recoil.time_s > 2 * _CONFIRMED_S:
                del self._recoils_at[row]
            elif time_s - recoil.time_s >= _CONFIRMED_S:
                del self._recoils_at[row]
                self._judged_s[row] = recoil.time_s
                middle = recoil.inner & newest.seen[row]
                shear_px = (newest.moved[row] - recoil.hold)[middle].mean(axis=0) if middle.any() else np.zeros(2)
                carried = float(shear_px @ recoil.shear_px) / max(float(recoil.shear_px @ recoil.shear_px), 1e-9)
                tightened = newest.spread[row] > _TIGHTENED * recoil.spread
                if carried >= (_CARRIED_TIGHTENED if tightened else _CARRIED):
                    confirmed_s[row] = time_s - recoil.time_s
        return confirmed_s

    def _learn_noise(self, row: int, moved: Field, time_s: float) -> None:
        still, limits = self._still[row], self.limits
        still.append((time_s, moved))
        if time_s - still[0][0] < limits.still_s or len(still) < limits.still_frames:
            return
        steps = np.diff(np.stack([field for _, field in still]), axis=0)
        # of differences, and their median: creep and a touch that begins count little
        single, together = (
            max(float(np.nanmedian(np.abs(part))) / 0.6745 / np.sqrt(2), _LEAST_NOISE_PX)
            for part in (steps, np.nanmean(steps, axis=1) * np.sqrt(np.isfinite(moved[:, 0]).sum()))
        )
        self._noise_px[row], self._together_px[row] = single, max(single, together)
        still.clear()

    def _begin(self, row: int, moved: Field, spread: float, time_s: float) -> None:
        """Begin a contact, or begin it anew."""
        self._hold[row], self._pressed[row], self._hold_s[row] = moved, spread, time_s
        self._pattern[row], self._window[row] = np.nan, 0
        inner = self.trial(row, 0 * moved).inner & np.isfinite(moved[:, 0])
        self._inner[row] = inner if inner.sum() >= 2 else np.isfinite(moved[:, 0])

    def _end(self, rows: Int[np.ndarray, " ended"]) -> None:
        self._hold[rows] = self._pattern[rows] = self._slip_s[rows] = np.nan
        self._pressed[rows] = self._hold_s[rows] = self._seen_s[rows] = 0.0
        self._inner[rows], self._least_px[rows] = False, np.inf

    def trial(self, row: int, since: Field) -> FieldTrial:
        """Two frames of a contact for the estimators: as it was pressed, and some motion since."""
        hold = self._hold[row]
        return FieldTrial(rest_px=self._rest[row], displacement_px=np.stack([hold, hold + since]), hold=0)

    def step_px(self, row: int) -> float:
        """Length that 95 % of the differences between two places of a still marker do not reach."""
        return _RAYLEIGH_95 * float(np.sqrt(2) * self._noise_px[row])

    def since_press(self, row: int) -> Field:
        """Motion of a contact's markers since it was pressed, in the newest frame."""
        frame = self._frames[-1]
        return np.where(frame.seen[row, :, None], frame.moved[row] - self._hold[row], np.nan)

    def _middle_noise_px(self) -> Float[np.ndarray, " contacts"]:
        """Noise of a difference of two means over the contact's middle."""
        return self._noise_px * np.sqrt(2 / np.maximum(self._inner.sum(axis=1), 1))

    def _shear(
        self, moved: Float[np.ndarray, "contacts markers 2"], seen: Bool[np.ndarray, "contacts markers"]
    ) -> Float[np.ndarray, "contacts 2"]:
        """Mean motion of the contact's middle since it was pressed; NaN without a contact."""
        middle = self._inner & seen & np.isfinite(self._hold[..., 0])
        count = middle.sum(axis=1)[:, None]
        total = np.where(middle[..., None], moved - self._hold, 0).sum(axis=1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def _shorten_windows(self, time_s: float) -> None:
        """Take frames that are too old out of each window, and into the pattern."""
        frames, limits = self._frames, self.limits
        times = np.array([frame.time_s for frame in frames])
        while True:
            first = len(times) - np.maximum(self._window, 1)
            late = (self._window > _FEWEST_FRAMES) & (time_s - times[first] > limits.window_s)
            for at in np.unique(first[late]).tolist():
                rows = np.flatnonzero(late & (first == at))
                share = -np.expm1(-(times[at + 1] - times[at]) / limits.pattern_s)
                field = np.where(frames[at].seen[rows, :, None], frames[at].moved[rows] - self._hold[rows], np.nan)
                pattern = self._pattern[rows]
                # a marker that was not seen keeps what it had
                step = np.nan_to_num(share * (field - pattern))
                self._pattern[rows] = np.where(np.isfinite(pattern), pattern + step, field)
            self._window -= late
            if not late.any():
                break
        for _ in range(len(frames) - max(1, int(self._window.max()))):
            frames.popleft()

    def _recoils(self) -> Float[np.ndarray, " contacts"]:
        """Time at which the skin began to spring back; NaN where it did not, or where that tells no slip."""
        began_s = np.full(len(self._rest), np.nan)
        searched = (self._window > 1) & np.isfinite(self._pattern[..., 0]).any(axis=1)
        for count in np.unique(self._window[searched]).tolist():
            rows = np.flatnonzero(searched & (self._window == count))
            frames = [self._frames[at] for at in range(-count, 0)]
            began_s[rows] = self._recoils_of(rows, frames)
        return began_s

    def _recoils_of(self, rows: Int[np.ndarray, " rows"], frames: Sequence[_Frame]) -> Float[np.ndarray, " rows"]:
        """The same of contacts whose windows are these frames."""
        began_s, limits = np.full(len(rows), np.nan), self.limits
        known = np.isfinite(self._pattern[rows, :, 0]) & np.isfinite(self._hold[rows, :, 0])
        for frame in frames:
            known &= frame.seen[rows]
        rest, pattern, hold = (
            np.where(known[..., None], values[rows], 0) for values in (self._rest, self._pattern, self._hold)
        )
        count = np.maximum(known.sum(axis=1), 1)[:, None, None]
        arm = np.where(known[..., None], rest - rest.sum(axis=1, keepdims=True) / count, 0)
        # a grip that is tightened or loosened moves the markers as its press did, or from the middle
        press = _unit(hold)
        pattern = _without(pattern, press, _unit(_without(arm, press)))
        length = np.sqrt((pattern**2).sum(axis=(1, 2)))
        # of little shear the pattern is noise
        enough = (length >= 2 * limits.recoil * self._together_px[rows]) & (known.sum(axis=1) >= _FEWEST)
        if not enough.any():
            return began_s
        rows, known, pattern, arm, length = (values[enough] for values in (rows, known, pattern, arm, length))
        pattern = _unit(pattern)
        old = np.arange(1, len(frames))
        spread = np.sqrt(1 / old + 1 / (len(frames) - old))

        def drops(ways: Fields, of: slice | np.ndarray) -> Float[np.ndarray, "rows cuts"]:
            """Fall of the mean motion along a way from the frames before each cut to those after it."""
            heights = np.stack([np.einsum("rmk,rmk->r", frame.moved[rows[of]], ways) for frame in frames], axis=-1)
            total = np.cumsum(heights, axis=-1)
            return total[:, :-1] / old - (total[:, -1:] - total[:, :-1]) / (len(frames) - old)

        # the press is no part of the pattern, so that it need not be subtracted
        drops_px = drops(pattern, slice(None))
        cut = (drops_px / spread).argmax(axis=-1)
        drop, wide = np.take_along_axis(drops_px, cut[:, None], axis=-1)[:, 0], spread[cut]
        whole = drop / wide / self._together_px[rows]
        springs = (drop >= limits.fall * length) & (whole >= limits.recoil)
        if not springs.any():
            return began_s
        shifts = [_unit(known[springs, :, None] * np.array(way)) for way in ([1.0, 0.0], [0.0, 1.0])]
        turn = _unit(arm[springs][..., ::-1] * np.array([-1.0, 1.0]))
        bent = _without(pattern[springs], *shifts, turn)
        left = np.sqrt((bent**2).sum(axis=(1, 2)))
        bending = np.take_along_axis(drops(_unit(bent), springs), cut[springs, None], axis=-1)[:, 0]
        bending = bending / wide[springs] / self._noise_px[rows[springs]]
        # a large motion must show more than noise that happens to bend
        bends = springs.copy()
        bends[springs] = bending >= np.maximum(limits.evidence, _BENT_SHARE * left * whole[springs])
        began = np.full(len(rows), np.nan)
        for at in np.flatnonzero(bends).tolist():
            drop_px = float(drop[at]) / np.sqrt(known[at].sum())
            if not self._is_handled(int(rows[at]), frames, int(cut[at]) + 1, known[at], drop_px):
                began[at] = frames[cut[at]].time_s
        began_s[enough] = began
        return began_s

    def _is_handled(
        self, row: int, frames: Sequence[_Frame], cut: int, known: Bool[np.ndarray, " markers"], drop_px: float
    ) -> bool:
        """Whether the contact was let go, pressed or pulled further from a frame of the window on."""
        spreads = np.array([frame.spread[row] for frame in frames])
        pressed = abs(float(spreads[:cut].mean() - spreads[cut:].mean()))
        inner = known & self._inner[row]
        markers = inner if inner.any() else known
        middle = np.stack([(frame.moved[row] - self._hold[row])[markers].mean(axis=0) for frame in frames])
        before, after = (float(np.linalg.norm(part.mean(axis=0))) for part in (middle[:cut], middle[cut:]))
        pulled = after > before + self.limits.recoil * self._middle_noise_px()[row]
        return bool(pulled or pressed / 2 * self._reach_px[row] > drop_px)


class SlipDetector:
    """Says of each frame whether the contact slips as a whole, from the motion of its markers.

    When a contact slips, friction falls from its static to its kinetic value and the stretched skin springs back
    against the pull within some hundredths of a second. So a slip is told where the markers move back along the pattern
    in which they were sheared before, and where what is left of that motion besides the best rigid one still follows
    the pattern: a camera that moves takes all markers along. The pattern is the mean shear of the last moments;
    projected on it, dozens of markers of a tenth of a pixel's noise tell a recoil of a few hundredths. Old and new
    frames are told apart where they differ most, in units of what the sensor showed in its first still moments. What
    the press moves is projected out of all that: a gripper tightens and loosens all the time.

    What it cannot tell: a contact that slides on evenly looks as one that holds, and one whose friction does not fall
    has no recoil; after a slip it says "cannot tell" until the shear grows again. A load that is taken away as fast as
    skin springs back passes for a slip.

    Parameters
    ----------
    rest_px
        Places (x, y) of the markers in the untouched sensor; at least 6.
    limits
        From when on a motion counts.

    Raises
    ------
    InputError
        If there are fewer markers.

    References
    ----------
    Dong, Ma, Donlon and Rodriguez, *Maintaining Grasps within Slipping Bounds by Monitoring Incipient Slip*, ICRA 2019.
    Page, *Continuous Inspection Schemes*, Biometrika 41 (1954), for a change told where it is most likely.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.live import SlipDetector
    >>> rest_px = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1).reshape(-1, 2) * 20
    >>> SlipDetector(rest_px).update(rest_px, 0.0).state  # what is still is not known yet
    <SlipState.CANNOT_TELL: 'cannot tell'>
    """

    def __init__(self, rest_px: Field, *, limits: SlipLimits | None = None) -> None:
        self._batch = SlipBatch(rest_px[None], limits=limits)

    def update(self, positions_px: Field, time_s: float, /) -> MarkerReading:
        """Take the markers of a frame, in the order of `rest_px`, NaN where one is not seen; times must rise."""
        batch = self._batch
        states = batch.update(positions_px[None], time_s)
        if not states.ready[0]:
            return MarkerReading(state=SlipState.CANNOT_TELL)
        if not states.contact[0]:
            return MarkerReading(state=SlipState.CANNOT_TELL, contact=False)
        share = float(stick_area(batch.trial(0, batch.since_press(0)), tolerance_px=batch.step_px(0))[1, 0])
        state = SlipState.CANNOT_TELL if states.unknown[0] else SlipState.STICKING
        shear_px, slipping_s, slipped_s = (
            float(values[0]) for values in (states.shear_px, states.slipping_s, states.slipped_s)
        )
        return MarkerReading(
            state=SlipState.SLIP if states.slip[0] else state,
            contact=True,
            shear_px=shear_px if np.isfinite(shear_px) else None,
            stick_share=share if np.isfinite(share) else None,
            slipping_s=slipping_s if np.isfinite(slipping_s) else None,
            slipped_s=slipped_s if np.isfinite(slipped_s) else None,
        )


Fields: TypeAlias = np.ndarray
"""Fields by row and marker, (x, y) last: not checked in tests, for these helpers run some 20 times a frame."""


def _from_middle(places_px: Fields) -> Fields:
    return places_px - places_px.mean(axis=1, keepdims=True)


def _divergence_weights(rest_px: Fields, seen: Bool[np.ndarray, "rows markers"]) -> Fields:
    """Weights of each marker's motion in the divergence of its field, the least-squares fit of `affine_parts`."""
    terms = np.concatenate([np.ones((*seen.shape, 1)), _from_middle(rest_px)], axis=2) * seen[..., None]
    fit = np.linalg.solve(terms.swapaxes(1, 2) @ terms + 1e-9 * np.eye(3), terms.swapaxes(1, 2))
    return fit[:, 1:].swapaxes(1, 2)


def _unit(fields: Fields) -> Fields:
    """Fields of length 1 that are 0 where they were 0."""
    return fields / np.maximum(np.sqrt((fields**2).sum(axis=(1, 2), keepdims=True)), 1e-9)


def _without(fields: Fields, *ways: Fields) -> Fields:
    """Fields less their parts along some ways, which are orthogonal to each other and of length 1."""
    for way in ways:
        fields = fields - (fields * way).sum(axis=(1, 2), keepdims=True) * way
    return fields


__all__ = ["ContactStates", "SlipBatch", "SlipDetector", "SlipLimits"]
