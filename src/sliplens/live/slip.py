"""Gross slip as the markers alone tell it: no network, nothing learnt, thresholds from the sensor's own stillness."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import InputError
from sliplens.live.reading import MarkerReading, SlipState
from sliplens.markers.estimators import FieldTrial, affine_parts, stick_area

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
class _Usual:
    """What the still sensor showed, in pixels."""

    noise_px: float
    """Standard deviation of a coordinate of a marker."""
    together_px: float
    """The same, were all their motion that of the markers as a whole: more than `noise_px` where a camera trembles."""

    @property
    def step_px(self) -> float:
        """Length that 95 % of the differences between two places of a still marker do not reach."""
        return _RAYLEIGH_95 * float(np.sqrt(2)) * self.noise_px


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
        if len(rest_px) < _FEWEST:
            raise InputError(f"{len(rest_px)} markers are too few to tell slip, at least {_FEWEST} are needed")
        self.limits = limits or SlipLimits()
        self._rest = rest_px
        self._reach_px = float(np.linalg.norm(rest_px - rest_px.mean(axis=0), axis=1).mean())
        self._still: list[tuple[float, Field]] = []
        self._usual: _Usual | None = None
        self._end_contact()

    def update(self, positions_px: Field, time_s: float, /) -> MarkerReading:
        """Take the markers of a frame, in the order of `rest_px`, NaN where one is not seen; times must rise."""
        moved = positions_px - self._rest
        if self._usual is None:
            self._watch_stillness(moved, time_s)
            return MarkerReading(state=SlipState.CANNOT_TELL)
        if np.isfinite(moved[:, 0]).sum() < _FEWEST:
            self._end_contact()
            return MarkerReading(state=SlipState.CANNOT_TELL)
        return self._read(moved, time_s, self._usual)

    def _read(self, moved: Field, time_s: float, usual: _Usual) -> MarkerReading:
        spread = float(affine_parts(self._rest, moved[None])[0, 2])
        if not self._touches(moved, spread, usual):
            self._end_contact()
            return MarkerReading(state=SlipState.CANNOT_TELL, contact=False)
        if self._hold is None or self._pressed_further(moved, spread):
            self._set_hold(moved, spread, time_s)
        assert self._hold is not None
        trial = self._trial(self._hold, moved - self._hold)
        length = float(np.linalg.norm(self._shear(moved)))
        share = stick_area(trial, tolerance_px=usual.step_px)[1, 0]
        self._remember(moved - self._hold, spread, time_s)
        began_s = self._find_recoil(usual)
        if began_s is not None:
            self._slip_s = began_s if self._slip_s is None else self._slip_s
            self._seen_s, self._least_px = time_s, length
        middle_px = self._middle_noise_px(usual)
        self._least_px = min(self._least_px, length)
        slips = self._slip_s is not None and time_s - self._seen_s <= self.limits.hold_s
        if not slips and self._slip_s is not None and length > self._least_px + self.limits.recoil * middle_px:
            self._slip_s = None  # pulled on, and it follows: it sticks again
        state = SlipState.SLIP if slips else SlipState.CANNOT_TELL if self._unknown(time_s) else SlipState.STICKING
        return MarkerReading(
            state=state,
            contact=True,
            shear_px=length if np.isfinite(length) else None,
            stick_share=float(share) if np.isfinite(share) else None,
            slipping_s=time_s - self._slip_s if slips and self._slip_s is not None else None,
        )

    def _unknown(self, time_s: float) -> bool:
        """After a slip, and until the press is over, nobody knows."""
        return self._slip_s is not None or time_s - self._hold_s < self.limits.window_s

    def _watch_stillness(self, moved: Field, time_s: float) -> None:
        if np.isfinite(moved[:, 0]).sum() < _FEWEST:
            return
        self._still.append((time_s, moved))
        limits = self.limits
        if time_s - self._still[0][0] < limits.still_s or len(self._still) < limits.still_frames:
            return
        steps = np.diff(np.stack([field for _, field in self._still]), axis=0)
        # of differences, and their median: creep and a touch that begins count little
        single, together = (
            max(float(np.nanmedian(np.abs(part))) / 0.6745 / np.sqrt(2), _LEAST_NOISE_PX)
            for part in (steps, np.nanmean(steps, axis=1) * np.sqrt(np.isfinite(moved[:, 0]).sum()))
        )
        self._usual = _Usual(noise_px=single, together_px=max(single, together))
        self._still = []

    def _touches(self, moved: Field, spread: float, usual: _Usual) -> bool:
        """Whether the field stands out of the noise, and a contact that was there has not been let go."""
        far_px = float(np.nanquantile(np.linalg.norm(moved, axis=1), 0.9))
        lightest = _LET_GO * self._pressed if self._hold is not None else 0.0
        return bool(far_px > 2 * _RAYLEIGH_95 * usual.noise_px and spread > lightest)

    def _pressed_further(self, moved: Field, spread: float) -> bool:
        """Whether what is stuck, and the shear, count from here on: pressed by much more, and more than it was pulled.

        A pull, too, spreads the markers a little.
        """
        grown_px = (spread - self._pressed) / 2 * self._reach_px
        return bool(spread > _REPRESSED * self._pressed and grown_px > np.linalg.norm(self._shear(moved)))

    def _set_hold(self, moved: Field, spread: float, time_s: float) -> None:
        self._hold, self._pressed, self._hold_s = moved, spread, time_s
        self._pattern = None
        self._window.clear()
        trial = self._trial(moved, 0 * moved)
        self._inner = trial.inner & np.isfinite(moved[:, 0])
        if self._inner.sum() < 2:
            self._inner = np.isfinite(moved[:, 0])

    def _end_contact(self) -> None:
        self._hold: Field | None = None
        self._inner: Bool[np.ndarray, " markers"] = np.ones(len(self._rest), dtype=bool)
        self._pressed = self._hold_s = self._seen_s = 0.0
        self._window: deque[tuple[float, float, Field]] = deque()
        """Time, spread and motion since the press of the last frames."""
        self._pattern: Field | None = None
        self._slip_s: float | None = None
        self._least_px = np.inf

    def _trial(self, pressed: Field, since: Field) -> FieldTrial:
        """Two frames for the estimators: the pressed contact, and some motion since."""
        return FieldTrial(rest_px=self._rest, displacement_px=np.stack([pressed, pressed + since]), hold=0)

    def _middle_noise_px(self, usual: _Usual) -> float:
        """Noise of a difference of two means over the contact's middle."""
        return usual.noise_px * float(np.sqrt(2 / max(int(self._inner.sum()), 1)))

    def _shear(self, moved: Field) -> Float[np.ndarray, "2"]:
        assert self._hold is not None
        since = (moved - self._hold)[self._inner]
        known = np.isfinite(since[:, 0])
        return since[known].mean(axis=0) if known.any() else np.full(2, np.nan)

    def _remember(self, sheared: Field, spread: float, time_s: float) -> None:
        """Take a frame into the window; those that leave it make the pattern."""
        self._window.append((time_s, spread, sheared))
        while len(self._window) > _FEWEST_FRAMES and time_s - self._window[0][0] > self.limits.window_s:
            left_s, _, field = self._window.popleft()
            if self._pattern is None:
                self._pattern = field
            # a marker that was not seen keeps what it had
            share = -np.expm1(-(self._window[0][0] - left_s) / self.limits.pattern_s)
            step = share * (field - self._pattern)
            self._pattern = np.where(np.isfinite(self._pattern), self._pattern + np.nan_to_num(step), field)

    def _find_recoil(self, usual: _Usual) -> float | None:
        """Time at which the skin began to spring back; None where it did not, or where that tells no slip."""
        if self._pattern is None or len(self._window) < 2:
            return None
        assert self._hold is not None
        fields = np.stack([field for *_, field in self._window])
        known = np.isfinite(fields[..., 0]).all(axis=0) & np.isfinite(self._pattern[:, 0])
        if known.sum() < _FEWEST:
            return None
        # a grip that is tightened or loosened moves the markers as its press did
        press = _press_motions(self._rest[known], self._hold[known])
        pattern = self._pattern[known].ravel()
        pattern = pattern - press.T @ (press @ pattern)
        length = float(np.linalg.norm(pattern))
        if length < 2 * self.limits.recoil * usual.together_px:
            return None  # of so little shear the pattern is noise
        pattern = pattern / length
        rigid = _rigid_motions(self._rest[known])
        bent = pattern - rigid.T @ (rigid @ pattern)
        left = max(float(np.linalg.norm(bent)), 1e-9)
        heights = fields[:, known].reshape(len(fields), -1) @ np.stack([pattern, bent / left], axis=1)
        old = np.arange(1, len(fields))[:, None]
        total = np.cumsum(heights, axis=0)
        drop_px = total[:-1] / old - (total[-1] - total[:-1]) / (len(fields) - old)
        ratio = drop_px / np.sqrt(1 / old + 1 / (len(fields) - old)) / [usual.together_px, usual.noise_px]
        cut = int(ratio[:, 0].argmax())
        whole, bending = ratio[cut].tolist()
        drop = float(drop_px[cut, 0])
        # a large motion must show more than noise that happens to bend
        springs = drop >= self.limits.fall * length and whole >= self.limits.recoil
        bends = bending >= max(self.limits.evidence, _BENT_SHARE * left * whole)
        found = springs and bends and not self._is_handled(fields, cut + 1, known, drop / np.sqrt(known.sum()), usual)
        return self._window[cut][0] if found else None

    def _is_handled(
        self,
        fields: Float[np.ndarray, "frames markers 2"],
        cut: int,
        known: Bool[np.ndarray, " markers"],
        drop_px: float,
        usual: _Usual,
    ) -> bool:
        """Whether the contact was let go, pressed or pulled further from a frame of the window on."""
        spreads = np.array([spread for _, spread, _ in self._window])
        pressed = abs(float(spreads[:cut].mean() - spreads[cut:].mean()))
        inner = known & self._inner
        middle = fields[:, inner if inner.any() else known].mean(axis=1)
        before, after = (float(np.linalg.norm(part.mean(axis=0))) for part in (middle[:cut], middle[cut:]))
        pulled = after > before + self.limits.recoil * self._middle_noise_px(usual)
        return bool(pulled or pressed / 2 * self._reach_px > drop_px)


def _press_motions(places_px: Field, pressed_px: Field) -> Float[np.ndarray, "motions coordinates"]:
    """What the press moved, and a spread from the middle, as unit vectors that are orthogonal to each other."""
    arm = places_px - places_px.mean(axis=0)
    return np.linalg.qr(np.stack([pressed_px.ravel(), arm.ravel()], axis=1))[0].T


def _rigid_motions(places_px: Field) -> Float[np.ndarray, "3 coordinates"]:
    """Two shifts and a turn of some markers, as unit vectors that are orthogonal to each other."""
    arm = places_px - places_px.mean(axis=0)
    motions = [np.full_like(arm, [1.0, 0.0]), np.full_like(arm, [0.0, 1.0]), np.stack([-arm[:, 1], arm[:, 0]], axis=1)]
    return np.stack([motion.ravel() / max(float(np.linalg.norm(motion)), 1e-9) for motion in motions])


__all__ = ["SlipDetector", "SlipLimits"]
