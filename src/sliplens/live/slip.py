"""Gross slip as the markers alone tell it: no network, nothing learnt, thresholds from the sensor's own stillness."""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import InputError
from sliplens.live.reading import MarkerReading, SlipState
from sliplens.markers.estimators import FieldTrial, affine_parts, displacement_entropy, rigid_residual, stick_area

Field = Float[np.ndarray, "markers 2"]

_FEWEST = 6
"""Markers of the contact without which no motion of it can be told."""
_LEAST_NOISE_PX = 0.02
"""Of compressed video, whose frames repeat, the noise cannot be seen."""
_ENTROPY_NOISE_PX = 0.1
"""Noise of a marker for which the bins of `displacement_entropy` are wide enough."""
_REPRESSED = 1 / 0.75
_LET_GO = 0.3
_RAYLEIGH_95 = 2.45
"""95 % of the lengths of two-dimensional normal noise are below so many standard deviations."""


@dataclass(frozen=True, kw_only=True)
class SlipLimits:
    """From when on a motion counts, in standard deviations of what the sensor showed while it was still.

    The defaults were chosen on simulated trials of other seeds than `benchmarks/slip.py` tests on.
    """

    still_s: float = 0.4
    """Time at the beginning, in seconds, in which the noise of the markers is measured."""
    still_frames: int = 12
    """Frames that this takes at least."""
    window_s: float = 0.1
    """Longest time over which a motion is looked at, in seconds."""
    recoil: float = 4.0
    """Motion of the contact's middle against its shear."""
    evidence: float = 3.0
    """Dong's rigid residual, and the entropy of the motion, over what is usual."""
    moving_share: float = 0.9
    """Share of markers below which the contact no longer moves as one."""
    hold_s: float = 0.25
    """Time for which a slip that was seen is told, in seconds."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise InputError(f"the slip limit {name} must be positive, got {value:g}")


@dataclass(frozen=True, kw_only=True)
class _Usual:
    """What the still sensor showed."""

    noise_px: float
    """Standard deviation of a coordinate of a marker."""
    residual_px: float
    residual_sigma: float
    entropy: float
    entropy_sigma: float

    @property
    def step_px(self) -> float:
        """Length that 95 % of the differences between two places of a still marker do not reach."""
        return _RAYLEIGH_95 * float(np.sqrt(2)) * self.noise_px


class SlipDetector:
    """Says of each frame whether the contact slips as a whole, from the motion of its markers.

    When a contact slips, friction falls from its static to its kinetic value and the stretched skin springs back
    against the pull, middle first, within some hundredths of a second. So a slip is told where the middle of the
    contact moves back against its shear while it is pressed as before, and where two of three say that the skin does
    not move as one: Dong's residual from a rigid motion, Sui's share of markers that move with the middle, and the
    entropy of the motion. Each is compared with what the sensor showed in its first still moments.

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
    Sui et al., *Incipient Slip Detection Method for Soft Objects with Vision-Based Tactile Sensor*, Measurement 2022.
    Hu et al., *Learning to Detect Slip through Tactile Estimation of the Contact Force Field and its Entropy*,
    arXiv:2303.00935.

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
        self._before: deque[tuple[float, Field]] = deque()
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
        reading = self._read(moved, time_s, self._usual)
        self._before.append((time_s, moved))
        while time_s - self._before[0][0] > self.limits.window_s:
            self._before.popleft()
        return reading

    def _read(self, moved: Field, time_s: float, usual: _Usual) -> MarkerReading:
        spread = float(affine_parts(self._rest, moved[None])[0, 2])
        if not self._touches(moved, spread, usual):
            self._end_contact()
            return MarkerReading(state=SlipState.CANNOT_TELL, contact=False)
        if self._hold is None or self._pressed_further(moved, spread):
            self._set_hold(moved, spread, time_s)
        assert self._hold is not None
        trial = self._trial(self._hold, moved - self._hold)
        shear = self._shear(moved)
        length = float(np.linalg.norm(shear))
        share = stick_area(trial, tolerance_px=usual.step_px)[1, 0]
        began_s = self._find_recoil(moved, spread, usual)
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
        fields = np.stack([field for _, field in self._still])
        # of differences, and their median: creep and a touch that begins count little
        step_px = np.nanmedian(np.abs(np.diff(fields, axis=0)))
        noise_px = max(float(step_px) / 0.6745 / np.sqrt(2), _LEAST_NOISE_PX)
        steps = [
            (rigid_residual(trial)[1, 1], self._entropy(trial, noise_px))
            for trial in (self._trial(0 * a, b - a) for a, b in pairwise(fields))
        ]
        middle = np.nanmedian(steps, axis=0)
        sigma = np.nanmedian(np.abs(np.array(steps) - middle), axis=0) / 0.6745
        # so few frames tell the spread to a fifth at best, and none of video that repeats
        self._usual = _Usual(
            noise_px=noise_px,
            residual_px=float(middle[0]),
            residual_sigma=float(max(sigma[0], 0.1 * noise_px)),
            entropy=float(middle[1]),
            entropy_sigma=float(max(sigma[1], 0.05)),
        )
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
        trial = self._trial(moved, 0 * moved)
        self._inner = trial.inner & np.isfinite(moved[:, 0])
        if self._inner.sum() < 2:
            self._inner = np.isfinite(moved[:, 0])

    def _end_contact(self) -> None:
        self._hold: Field | None = None
        self._inner: Bool[np.ndarray, " markers"] = np.ones(len(self._rest), dtype=bool)
        self._pressed = self._hold_s = self._seen_s = 0.0
        self._slip_s: float | None = None
        self._least_px = np.inf

    def _trial(self, pressed: Field, since: Field) -> FieldTrial:
        """Two frames for the estimators: the pressed contact, and some motion since."""
        return FieldTrial(rest_px=self._rest, displacement_px=np.stack([pressed, pressed + since]), hold=0)

    def _entropy(self, trial: FieldTrial, noise_px: float) -> float:
        scale = _ENTROPY_NOISE_PX / noise_px
        scaled = FieldTrial(rest_px=self._rest, displacement_px=scale * trial.displacement_px, hold=0)
        return float(displacement_entropy(scaled)[1, 0])

    def _middle_noise_px(self, usual: _Usual) -> float:
        """Noise of a difference of two means over the contact's middle."""
        return usual.noise_px * float(np.sqrt(2 / max(int(self._inner.sum()), 1)))

    def _shear(self, moved: Field) -> Float[np.ndarray, "2"]:
        assert self._hold is not None
        since = (moved - self._hold)[self._inner]
        known = np.isfinite(since[:, 0])
        return since[known].mean(axis=0) if known.any() else np.full(2, np.nan)

    def _find_recoil(self, moved: Field, spread: float, usual: _Usual) -> float | None:
        """Time at which the middle began to spring back; None where it did not, or where that tells no slip."""
        assert self._hold is not None
        least_px = self.limits.recoil * self._middle_noise_px(usual)
        now, best_px, start = self._shear(moved), least_px, None
        for time_s, field in self._before:
            if time_s < self._hold_s:
                continue
            then = self._shear(field)
            length = float(np.linalg.norm(then))
            back_px = float((then - now) @ then) / length if length > least_px else 0.0
            if back_px > best_px:
                best_px, start = back_px, (time_s, field)
        if start is None:
            return None
        began_s, field = start
        pressed_px = abs(spread - affine_parts(self._rest, field[None])[0, 2]) / 2 * self._reach_px
        if not pressed_px < best_px:
            return None  # let go, or pressed further
        trial = self._trial(self._hold, moved - field)
        residual = float(rigid_residual(trial)[1, 1])
        votes = (
            residual > usual.residual_px + self.limits.evidence * usual.residual_sigma,
            float(stick_area(trial, tolerance_px=usual.step_px)[1, 0]) < self.limits.moving_share,
            self._entropy(trial, usual.noise_px) > usual.entropy + self.limits.evidence * usual.entropy_sigma,
        )
        return began_s if sum(votes) >= 2 else None


__all__ = ["SlipDetector", "SlipLimits"]
