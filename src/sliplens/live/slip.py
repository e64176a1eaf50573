"""Gross slip from the motion of the markers alone: no network, thresholds from the noise of the still sensor."""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from sliplens.errors import InputError
from sliplens.live.reading import MarkerReading, SlipState
from sliplens.markers.estimators import INNER_SHARE, rank_from_centre, stick_share

Field = Float[np.ndarray, "markers 2"]
Fields: TypeAlias = np.ndarray
"""Fields by row, coordinate and marker: not checked in tests, for these helpers run some 20 times a frame."""
Rows: TypeAlias = Int[np.ndarray, " rows"]
Contacts: TypeAlias = Float[np.ndarray, " contacts"]

_FEWEST = 6  # least number of markers that shows the motion of a contact
_FEWEST_FRAMES = 3  # least number of frames in the window, however slow the camera is
_LEAST_NOISE_PX = 0.02  # of compressed video, whose frames repeat, the noise cannot be seen
_REPRESSED = 1 / 0.75
_LET_GO = 0.3
_BENT_SHARE = 0.1  # of what the pattern lets expect; skin that springs back is more rigid than it was sheared
_CONFIRMED_S = 0.3
"""Time after a recoil in which a controller has tightened the grip, and a pull that is let go by hand has gone."""
_CARRIED, _TIGHTENED, _CARRIED_TIGHTENED = 0.7, 1.1, 0.75
"""Least share of the shear that is left after a slip; how much a contact is pressed further, and the same there. Of 12
simulated fingertips (seeds 50 to 61) kinetic friction leaves 0.76 to 0.9, a pull let go to 0.7 leaves 0.64 to 0.72."""
_LEAST_SHEAR, _UNCERTAIN, _NOISE_FRAMES = 20.0, 4.0, 64
"""Shear whose fall counts, and part of a fall that does not, in standard deviations of the mean over the markers; last
frames whose lower quartile of motion against each other is the noise."""
HOLD_FALL, SLIP_FALL = 0.05, 0.1
"""Fall of the mean shear, as a share, up to which a grasp that begins pressed holds, and from which it slips. Chosen on
48 simulated grips (seed 30), 8 to 60 frames a second, 0.1 to 0.2 px of noise: 73 to 98 % fall by more within 0.5 s of
the slip, none before. Spread of increments and slip zone add nothing there (AUC 0.83 and 0.52, the fall 0.999)."""
_RAYLEIGH_95 = 2.45  # 95 % of the lengths of two-dimensional normal noise are below so many standard deviations
_STILL_S, _STILL_FRAMES = 0.4, 12
"""Time at the beginning in which the noise of the markers is measured, and the frames that this takes at least."""
_WINDOW_S, _PATTERN_S, _REPORTED_S = 0.1, 0.4, 0.25
"""Longest time over which a motion is measured, over which the pattern of the shear is averaged, and for which a
detected slip is reported."""
_RECOIL, _EVIDENCE, _FALL = 4.0, 0.5, 0.045
"""Limits chosen on other simulated trials than `benchmarks/slip.py` tests on: motion of the skin against that pattern,
and its part that no rigid motion explains (Dong's residual), in standard deviations of the still sensor's noise; and
the least share of the shear that is lost within the window: a pull that is let go slowly is no slip."""


@dataclass(frozen=True, kw_only=True)
class ContactStates:
    """State of some contacts at one frame, an entry each."""

    ready: Bool[np.ndarray, " contacts"]
    """True where the noise of the markers was measured, and enough of them are visible."""
    contact: Bool[np.ndarray, " contacts"]
    slip: Bool[np.ndarray, " contacts"]
    unknown: Bool[np.ndarray, " contacts"]
    """True where neither slip nor sticking is certain."""
    shear_px: Contacts
    """Mean motion of the contact's middle since it was pressed, in pixels."""
    slipping_s: Contacts
    """Time since the slip began; NaN where nothing slips."""
    slipped_s: Contacts
    """Time since a slip began that is confirmed in this frame; NaN elsewhere."""


class _Frame(NamedTuple):
    """Markers of one frame: motion since they were untouched, 0 where one is not seen."""

    time_s: float
    spread: Contacts
    moved: Float[np.ndarray, "contacts 2 markers"]
    visible: Bool[np.ndarray, "contacts markers"]


class _Recoil(NamedTuple):
    """A contact as its skin began to spring back."""

    time_s: float
    frame: _Frame
    hold: Float[np.ndarray, "2 markers"]
    inner: Bool[np.ndarray, " markers"]


class SlipBatch:
    """Detects slip in many contacts at once, each with its own sensor; `SlipDetector` describes how."""

    def __init__(self, rest_px: Float[np.ndarray, "contacts markers 2"]) -> None:
        contacts, markers, _ = rest_px.shape
        if markers < _FEWEST:
            raise InputError(f"{markers} markers are too few to detect slip, at least {_FEWEST} are needed")
        # fields have the coordinate before the marker: sums over markers are several times faster
        self._rest = np.ascontiguousarray(rest_px.swapaxes(1, 2), dtype=np.float64)
        self._reach_px = np.linalg.norm(_from_middle(self._rest), axis=1).mean(axis=1)
        self._still: list[tuple[float, Fields]] = []
        """Times and motions (NaN where a marker is not seen) of the still frames."""
        self._visible = np.ones((contacts, markers), dtype=bool)
        self._fit = _affine_weights(self._rest, self._visible)
        self._noise_px = np.full(contacts, np.nan)  # standard deviation of a coordinate of a marker of the still sensor
        self._together_px = np.full(contacts, np.nan)
        """Standard deviation if all motion were that of the markers as a whole: more where a camera trembles."""
        self._frames: deque[_Frame] = deque()
        self._window = np.zeros(contacts, dtype=int)  # number of frames in the window of each contact
        self._hold = np.full(self._rest.shape, np.nan)
        """Motion of the markers up to the end of the press; NaN without a contact."""
        self._pattern = np.full(self._rest.shape, np.nan)  # mean motion since then, of the frames that left the window
        self._inner = np.zeros((contacts, markers), dtype=bool)
        self._pressed, self._hold_s, self._recoil_s = np.zeros((3, contacts))
        self._slip_s, self._least_px = np.full(contacts, np.nan), np.full(contacts, np.inf)
        self._recoils_at: dict[int, _Recoil] = {}  # recoils that are not judged yet, by contact
        self._judged_s = np.full(contacts, np.nan)  # time of the recoil that was judged last

    def update(self, positions_px: Float[np.ndarray, "contacts markers 2"], time_s: float, /) -> ContactStates:
        """Take the markers of a frame, in the order of `rest_px`, NaN where one is not seen; times must rise."""
        moved = np.ascontiguousarray(positions_px.swapaxes(1, 2)) - self._rest
        visible = np.isfinite(moved[:, 0])
        moved, count = np.where(visible[:, None], moved, 0), np.count_nonzero(visible, axis=1)
        ready = (count >= _FEWEST) & np.isfinite(self._noise_px)
        if np.isnan(self._noise_px[0]) and (count >= _FEWEST).all():
            self._learn_noise(np.where(visible[:, None], moved, np.nan), time_s)
        if not np.array_equal(visible, self._visible):
            self._visible, self._fit = visible, _affine_weights(self._rest, visible)
        spread = np.einsum("ckm,ckm->c", self._fit[:, 1:], moved)
        stand_out = moved[:, 0] ** 2 + moved[:, 1] ** 2 > ((2 * _RAYLEIGH_95 * self._noise_px) ** 2)[:, None]
        # out of the noise, and a contact that was there has not been let go
        contact = ready & (np.count_nonzero(stand_out, axis=1) > 0.1 * count) & (spread > _LET_GO * self._pressed)
        ends = ~contact & (self._pressed > 0)
        self._hold[ends] = self._pattern[ends] = self._slip_s[ends] = np.nan
        self._pressed[ends] = self._hold_s[ends] = self._recoil_s[ends] = 0.0
        self._inner[ends], self._least_px[ends] = False, np.inf
        shear_px = np.linalg.norm(self._shear(moved, visible), axis=1)
        # what is stuck, and the shear, count from a press that grew by much, and more than it was pulled: a pull, too,
        # spreads the markers a little
        grown_px = (spread - self._pressed) / 2 * self._reach_px
        pressed = (spread > _REPRESSED * self._pressed) & (grown_px > np.nan_to_num(shear_px))
        self._window = np.where(contact & ~pressed, self._window, 0) + contact
        if len(rows := np.flatnonzero(contact & pressed)):
            self._hold[rows] = np.where(visible[rows, None], moved[rows], np.nan)
            self._pressed[rows], self._hold_s[rows] = spread[rows], time_s
            self._pattern[rows], shear_px[rows] = np.nan, 0.0
            mean_px = (self._fit[rows, :1] * moved[rows]).sum(axis=2)
            rank = rank_from_centre(self._rest[rows].swapaxes(1, 2), mean_px=mean_px, divergence=spread[rows])
            inner = (rank < INNER_SHARE) & visible[rows]
            self._inner[rows] = np.where((inner.sum(axis=1) >= 2)[:, None], inner, visible[rows])
        self._frames.append(_Frame(time_s, spread, moved, visible))
        self._shorten_windows(time_s)
        began_s = self._recoils()
        springs = np.isfinite(began_s)
        self._slip_s = np.where(springs & np.isnan(self._slip_s), began_s, self._slip_s)
        self._recoil_s = np.where(springs, time_s, self._recoil_s)
        self._least_px = np.fmin(np.where(springs, np.inf, self._least_px), shear_px)
        slip = np.isfinite(self._slip_s) & (time_s - self._recoil_s <= _REPORTED_S)
        # pulled on, and it follows: it sticks again
        sticks = ~slip & (shear_px > self._least_px + _RECOIL * self._middle_noise_px())
        self._slip_s = np.where(sticks, np.nan, self._slip_s)
        return ContactStates(
            ready=ready,
            contact=contact,
            slip=slip,
            # after a slip, and until the press is over, neither is certain
            unknown=np.isfinite(self._slip_s) | (time_s - self._hold_s < _WINDOW_S),
            shear_px=shear_px,
            slipping_s=np.where(slip, time_s - self._slip_s, np.nan),
            slipped_s=self._confirm(springs, time_s),
        )

    def _confirm(self, springs: Bool[np.ndarray, " contacts"], time_s: float) -> Contacts:
        """Compute the time since the slips that are confirmed now: the load is still there some time after the recoil.

        A contact that slides carries what kinetic friction holds, and one that is tightened takes the load up again; a
        pull that was let go is gone.
        """
        confirmed_s, newest = np.full(len(self._rest), np.nan), self._frames[-1]
        for row in np.flatnonzero(springs).tolist():
            if row not in self._recoils_at and self._slip_s[row] != self._judged_s[row]:
                first, began_s = self._frames[-int(self._window[row])], float(self._slip_s[row])
                middle = self._inner[row] & first.visible[row]
                self._recoils_at[row] = _Recoil(began_s, first, self._hold[row].copy(), middle)
        for row, (began_s, first, hold, middle) in list(self._recoils_at.items()):
            if self._pressed[row] and time_s - began_s < _CONFIRMED_S:
                continue
            del self._recoils_at[row]
            if not self._pressed[row] or time_s - began_s > 2 * _CONFIRMED_S:
                continue
            self._judged_s[row], both = began_s, middle & newest.visible[row]
            before_px = (first.moved[row] - hold)[:, middle].mean(axis=1)
            after_px = (newest.moved[row] - hold)[:, both].mean(axis=1) if both.any() else np.zeros(2)
            carried = float(after_px @ before_px) / max(float(before_px @ before_px), 1e-9)
            tightened = newest.spread[row] > _TIGHTENED * first.spread[row]
            if carried >= (_CARRIED_TIGHTENED if tightened else _CARRIED):
                confirmed_s[row] = time_s - began_s
        return confirmed_s

    def _learn_noise(self, moved: Fields, time_s: float) -> None:
        """Take a still frame; measure the noise once there are enough of them."""
        self._still.append((time_s, moved))
        if time_s - self._still[0][0] < _STILL_S or len(self._still) < _STILL_FRAMES:
            return
        steps = np.diff(np.stack([field for _, field in self._still], axis=1), axis=1)
        mean = np.ma.masked_invalid(steps).mean(axis=3).filled(np.nan)
        mean *= np.sqrt(np.isfinite(moved[:, 0]).sum(axis=1))[:, None, None]
        # of differences, and their median: creep and a touch that begins count little
        single, together = (
            np.maximum(
                np.nanmedian(np.abs(part).reshape(len(moved), -1), axis=1) / 0.6745 / np.sqrt(2), _LEAST_NOISE_PX
            )
            for part in (steps, mean)
        )
        self._noise_px, self._together_px = single, np.maximum(single, together)
        self._still.clear()

    def stick_share(self, row: int) -> float:
        """Compute the share of a contact's markers that move with its middle, in the newest frame."""
        frame = self._frames[-1]
        since = np.where(frame.visible[row], frame.moved[row] - self._hold[row], np.nan)
        # 95 % of the differences between two places of a still marker are shorter
        tolerance_px = _RAYLEIGH_95 * float(np.sqrt(2) * self._noise_px[row])
        return stick_share(self._rest[row].T, self._hold[row].T, since.T, tolerance_px=tolerance_px)

    def spreads(self, row: int) -> bool:
        """Return whether the newest frame shows a press, which spreads the markers more than it moves them together."""
        frame = self._frames[-1]
        moved = frame.moved[row][:, frame.visible[row]]
        together_px = float(np.linalg.norm(moved.mean(axis=1))) if moved.size else np.inf
        return bool(frame.spread[row] / 2 * self._reach_px[row] > together_px)

    def _middle_noise_px(self) -> Contacts:
        """Compute the noise of a difference of two means over the contact's middle."""
        return self._noise_px * np.sqrt(2 / np.maximum(self._inner.sum(axis=1), 1))

    def _shear(self, moved: Fields, visible: Bool[np.ndarray, "contacts markers"]) -> Float[np.ndarray, "contacts 2"]:
        """Compute the mean motion of the contact's middle since it was pressed; NaN without a contact."""
        middle = self._inner & visible & np.isfinite(self._hold[:, 0])
        count = np.count_nonzero(middle, axis=1)[:, None]
        total = np.where(middle[:, None], moved - self._hold, 0).sum(axis=2)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def _shorten_windows(self, time_s: float) -> None:
        """Take frames that are too old out of each window, and into the pattern."""
        frames, count = self._frames, len(self._frames)
        times = [frame.time_s for frame in frames]
        most = max(_FEWEST_FRAMES, sum(time_s - then_s <= _WINDOW_S for then_s in times))
        for at in range(count - int(self._window.max()), count - most):
            rows = np.flatnonzero(self._window >= count - at)
            share = -np.expm1((times[at] - times[at + 1]) / _PATTERN_S)
            field = np.where(frames[at].visible[rows][:, None], frames[at].moved[rows] - self._hold[rows], np.nan)
            pattern = self._pattern[rows]
            blended = pattern + share * (field - pattern)
            # a marker that was not seen keeps what it had
            self._pattern[rows] = np.where(np.isnan(blended), np.where(np.isnan(pattern), field, pattern), blended)
        self._window = np.minimum(self._window, most)
        for _ in range(count - max(1, int(self._window.max()))):
            frames.popleft()

    def _recoils(self) -> Contacts:
        """Find the times at which the skin began to spring back by a slip; NaN where it did not."""
        began_s, frames = np.full(len(self._rest), np.nan), tuple(self._frames)
        rows = np.flatnonzero((self._window > 1) & np.isfinite(self._pattern[:, 0]).any(axis=1))
        if not len(rows):
            return began_s
        inside = np.arange(len(frames))[:, None] >= len(frames) - self._window[rows]
        rest, pattern, hold = (values[rows] for values in (self._rest, self._pattern, self._hold))
        valid = np.isfinite(pattern[:, 0]) & np.isfinite(hold[:, 0])
        for frame, counts in zip(frames, inside, strict=True):
            valid &= frame.visible[rows] | ~counts[:, None]
        rest, pattern, hold = (np.where(valid[:, None], values, 0) for values in (rest, pattern, hold))
        middle = rest.sum(axis=2, keepdims=True) / np.maximum(valid.sum(axis=1), 1)[:, None, None]
        arm = (rest - middle) * valid[:, None]
        # a grip that is tightened or loosened moves the markers as its press did, or from the middle
        press = _unit(hold)
        pattern = _without(pattern, press, _unit(_without(arm, press)))
        length = np.sqrt(np.einsum("rkm,rkm->r", pattern, pattern))
        # of little shear the pattern is noise
        enough = (length >= 2 * _RECOIL * self._together_px[rows]) & (valid.sum(axis=1) >= _FEWEST)
        rows, valid, pattern, arm, length = (values[enough] for values in (rows, valid, pattern, arm, length))
        if not len(rows):
            return began_s
        pattern /= length[:, None, None]
        inside = inside[:, enough].T
        old = np.cumsum(inside, axis=1)[:, :-1]
        new, old, is_cut = self._window[rows, None] - old, np.maximum(old, 1), old > 0
        # the press is no part of the pattern, so that it need not be subtracted
        heights_px = np.stack([np.einsum("rkm,rkm->r", frame.moved[rows], pattern) for frame in frames], axis=-1)
        total = np.cumsum(heights_px * inside, axis=-1)
        drops_px, wide = total[:, :-1] / old - (total[:, -1:] - total[:, :-1]) / new, np.sqrt(1 / old + 1 / new)
        cut = np.where(is_cut, drops_px / wide, -np.inf).argmax(axis=-1)
        drop, wide = (np.take_along_axis(values, cut[:, None], axis=-1)[:, 0] for values in (drops_px, wide))
        whole = drop / wide / self._together_px[rows]
        for at in np.flatnonzero((drop >= _FALL * length) & (whole >= _RECOIL)).tolist():
            row, markers, first = int(rows[at]), valid[at], len(frames) - int(self._window[rows[at]])
            # means over the frames before the cut and after it
            halves = frames[first : cut[at] + 1], frames[cut[at] + 1 :]
            before, after = (np.mean([frame.moved[row] for frame in half], axis=0) for half in halves)
            bent, way = pattern[at], arm[at][::-1] * np.array([[-1.0], [1.0]])
            bent = _without(bent[None], *(_unit(rigid[None]) for rigid in (*np.eye(2)[..., None] * markers, way)))[0]
            residual = np.linalg.norm(bent)
            bending = np.sum((before - after) * bent) / max(residual, 1e-9) / wide[at] / self._noise_px[row]
            # a large motion must show more than noise that happens to bend
            if bending < max(_EVIDENCE, _BENT_SHARE * residual * whole[at]):
                continue
            # a contact that was let go, or pressed or pulled further, was handled
            inner = markers & self._inner[row] if (markers & self._inner[row]).any() else markers
            from_px, to_px = (
                np.linalg.norm((mean - self._hold[row])[:, inner].mean(axis=1)) for mean in (before, after)
            )
            loose, tight = (np.mean([frame.spread[row] for frame in half]) for half in halves)
            pressed_px = abs(loose - tight) / 2 * self._reach_px[row]
            is_pulled = to_px - from_px > _RECOIL * self._middle_noise_px()[row]
            if not is_pulled and pressed_px <= drop[at] / np.sqrt(markers.sum()):
                began_s[row] = frames[cut[at]].time_s
        return began_s


class SlipDetector:
    """Detector of a slip of the contact as a whole, from the motion of its markers.

    When a contact slips, friction falls from its static to its kinetic value and the stretched skin springs back
    against the pull within some hundredths of a second. A slip is detected where the markers move back along the
    pattern in which they were sheared before, and where the residual of the best rigid motion still follows the
    pattern: a camera that moves takes all markers along. The pattern is the mean shear of the last moments; projected
    on it, dozens of markers of a tenth of a pixel's noise show a recoil of a few hundredths. The window is cut where
    the frames before and after differ most, in units of the noise of the first still moments. The motion of the press
    is projected out of all that: a gripper tightens and loosens all the time.

    Its limits: a contact that slides on evenly looks like one that holds, and one whose friction does not fall has no
    recoil; after a slip the state is "cannot tell" until the shear grows again. A load that is taken away as fast as
    skin springs back passes for a slip.

    All this needs an untouched frame and 0.4 s of stillness. Until a press was seen, as in a grasp that begins pressed,
    the mean shear is watched: a contact that holds carries its load, so that the shear grows or stays; one that slips
    loses part of it, a share of the largest shear beyond the noise of the mean.

    Parameters
    ----------
    rest_px
        Places (x, y) of the markers in the untouched sensor, or at the beginning of the grasp; at least 6.

    Raises
    ------
    InputError
        If there are fewer markers.

    References
    ----------
    Dong, Ma, Donlon and Rodriguez, *Maintaining Grasps within Slipping Bounds by Monitoring Incipient Slip*, ICRA 2019.
    Page, *Continuous Inspection Schemes*, Biometrika 41 (1954), for a change placed where it is most likely.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.live import SlipDetector
    >>> rest_px = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1).reshape(-1, 2) * 20
    >>> SlipDetector(rest_px).update(rest_px, 0.0).state  # what is still is not known yet
    <SlipState.CANNOT_TELL: 'cannot tell'>
    """

    def __init__(self, rest_px: Field) -> None:
        self._batch, self._rest_px = SlipBatch(rest_px[None]), rest_px
        self._before = np.full((2, *rest_px.shape), np.nan)
        self._noises_px: deque[float] = deque(maxlen=_NOISE_FRAMES)
        self._largest_px, self._press_seen = 0.0, False

    def update(self, positions_px: Field, time_s: float, /) -> MarkerReading:
        """Take the markers of a frame, in the order of `rest_px`, NaN where one is not seen; times must rise."""
        batch = self._batch
        states = batch.update(positions_px[None], time_s)
        fall, contact, slips = self._shear_fall(positions_px), bool(states.contact[0]), bool(states.slip[0])
        free = False if states.ready[0] else None
        self._press_seen |= contact and batch.spreads(0)
        if not self._press_seen:
            slips |= fall is not None and fall >= SLIP_FALL
            holds, touches = fall is not None and fall <= HOLD_FALL, contact or fall is not None
            return MarkerReading(state=_state(slips, holds), contact=True if touches else free, fall=fall)
        if not contact:
            return MarkerReading(state=SlipState.CANNOT_TELL, contact=free)
        shear_px, share, slipping_s, slipped_s = (
            float(value) if np.isfinite(value) else None
            for value in (states.shear_px[0], batch.stick_share(0), states.slipping_s[0], states.slipped_s[0])
        )
        state, times = _state(slips, not states.unknown[0]), {"slipping_s": slipping_s, "slipped_s": slipped_s}
        return MarkerReading(state=state, contact=True, shear_px=shear_px, stick_share=share, **times)

    def _shear_fall(self, positions_px: Field) -> float | None:
        """Compute the fall of the mean shear as a share; None before any shear, or without markers."""
        moved = positions_px - self._rest_px
        visible = np.isfinite(moved[:, 0])
        if visible.sum() < _FEWEST:
            return None
        mean = moved[visible].mean(axis=0)
        # second differences: skin that moves on evenly is no noise
        bends = moved - mean - 2 * self._before[1] + self._before[0]
        self._before = np.stack([self._before[1], moved - mean])
        bends = bends[np.isfinite(bends[:, 0])]
        if len(bends) >= _FEWEST:
            self._noises_px.append(float(np.median(np.abs(bends))) / 0.6745 / np.sqrt(6))
        shear_px = float(np.linalg.norm(mean))
        self._largest_px = max(self._largest_px, shear_px)
        if not self._noises_px:
            return None
        noise_px = max(float(np.quantile(self._noises_px, 0.25)), _LEAST_NOISE_PX) / np.sqrt(visible.sum())
        if self._largest_px <= _LEAST_SHEAR * noise_px:
            return None
        return float(max(0.0, self._largest_px - shear_px - _UNCERTAIN * noise_px) / self._largest_px)


def _state(slips: bool, holds: bool) -> SlipState:
    return SlipState.SLIP if slips else SlipState.STICKING if holds else SlipState.CANNOT_TELL


def _from_middle(places_px: Fields) -> Fields:
    return places_px - places_px.mean(axis=2, keepdims=True)


def _affine_weights(rest_px: Fields, visible: Bool[np.ndarray, "rows markers"]) -> Fields:
    """Compute the weights of each marker in the mean and the divergence (x and y) of its field, as `affine_parts`."""
    terms = np.insert(_from_middle(rest_px), 0, 1.0, axis=1) * visible[:, None]
    return np.linalg.solve(terms @ terms.swapaxes(1, 2) + 1e-9 * np.eye(3), terms)


def _unit(fields: Fields) -> Fields:
    """Scale fields to length 1; those of 0 stay 0."""
    length = np.sqrt(np.einsum("rkm,rkm->r", fields, fields))
    return fields / np.maximum(length, 1e-9)[:, None, None]


def _without(fields: Fields, *ways: Fields) -> Fields:
    """Subtract from fields their parts along some others, which are orthogonal to each other and of length 1."""
    for way in ways:
        fields = fields - np.einsum("rkm,rkm->r", fields, way)[:, None, None] * way
    return fields
