"""Health of a running sensor: checks that withhold a frame's margin, each with its limit and its cure."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from sliplens.images import LEAST_TOUCH, picture_change, soften
from sliplens.live.reading import Check, LiveFrame, small_picture
from sliplens.markers import MarkerStatus, Tracks
from sliplens.markers.camera import CAMERA_CURE, CAMERA_LIMIT_PX, CameraWatch, block_means
from sliplens.models.checkpoint import STRANGE, Estimate, Network
from sliplens.recordings.capture import Frame
from sliplens.shear import DIRECTION_LIMIT, Shear

Plane = Float32[np.ndarray, "height width"]

_WHITE, _BLACK = 250, 5
_TILES = 4
_DIM = 10.0  # grey levels below which a ratio of brightness means nothing
_DROPS_OVER_S = 1.0
_OLDEST_S = 0.1
_BLOCK_PX = 4
_CHANGED_SHARE, _NOISE_SHARE, _LEAST_SQUARE = 1.5, 0.2, 0.02
"""Of the noise of block means: share that shows a change, and share to which its square is known; and the mean square
that rounding makes, in squared grey levels."""
_QUIET_GROWTH = 1.05
"""Of the least noise, from frame to frame: a camera that grows noisier is known again after some frames."""


Measured = float | tuple[float, str] | None
"""Value of a check, with a sentence if `CheckKind.sentence` is not enough; None where there is nothing to measure."""


class HealthMonitor:
    """Checks frames against the untouched sensor.

    Focus, uneven light and, without markers, the camera change slowly: one of them is checked in each frame, and its
    result is at most 0.1 s old. All other checks of `CHECKS` are made in every frame.

    Parameters
    ----------
    reference
        The sensor untouched.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.live import HealthMonitor, LiveFrame
    >>> untouched = np.random.default_rng(0).integers(60, 200, (56, 56, 3), dtype=np.uint8)
    >>> bright = np.clip(1.3 * untouched, 0, 255).astype(np.uint8)
    >>> frame = LiveFrame(image=bright, number=0, time_s=0.0, captured_s=0.0)
    >>> checks = {check.name: check for check in HealthMonitor(untouched).check(frame)}
    >>> checks["exposure"].sentence
    'the picture is 1.3 times as bright as the reference; fix exposure and gain of the camera, or take a new reference'
    """

    def __init__(self, reference: Frame) -> None:
        small = small_picture(reference)
        self._soft, self._sharpness, self._saturated = soften(small), _sharpness(_green(small)), _saturated_share(small)
        self._camera = CameraWatch(small)
        self._before: np.ndarray | None = None
        self._changed_s = 0.0
        self._plane: Plane | None = None
        self._half_planes: list[Plane] = []  # picture at the last change of the upper half, and of the lower one
        self._quiet = np.full(2, np.inf)
        self._force_n: np.ndarray | None = None
        self._changed_force_n: np.ndarray | None = None  # force at the last change of either half
        self._numbers: deque[tuple[float, int]] = deque()
        self._last: dict[str, tuple[float, Check]] = {}  # time and result of each check when it was made last
        self._markers: Tracks | None = None

    def check(self, frame: LiveFrame, markers: Tracks | None = None, /) -> tuple[Check, ...]:
        """Check a frame of the reference's size, and its markers where they are tracked.

        The first check that fails names the cause: faults of the camera come before what they change in the picture.
        """
        self._markers, soft = markers, soften(frame.small)
        # pixels that are neither dark nor saturated in either picture
        both = (self._soft > _DIM) & (soft > _DIM) & (self._soft < _WHITE) & (soft < _WHITE)
        ratio = np.log2(np.where(both, soft, 1) / np.where(both, self._soft, 1))
        self._gain = float(np.median(ratio[both])) if both.any() else 0.0
        self._brighter = np.where(both, ratio - self._gain, np.nan)
        self._change = picture_change(soft * 2**-self._gain, self._soft)
        slow = _SLOW if markers is None else _SLOW[:2]  # markers show the camera's motion at once, the border slowly
        age_s = {name: frame.time_s - self._last[name][0] if name in self._last else np.inf for name in slow}
        # too old ones are due, else the oldest; at the same time it may be another frame, of a source without a clock
        due = [name for name in slow if not 0 < age_s[name] < _OLDEST_S] or [max(slow, key=lambda name: age_s[name])]
        for name in (name for name in CHECKS if name not in slow or name in due):
            measure = CHECKS[name].measure
            self._last.pop(name, None)
            if measure is not None and (measured := measure(self, frame)) is not None:
                value, sentence = measured if isinstance(measured, tuple) else (measured, None)
                self._last[name] = frame.time_s, make_check(name, value, sentence)
        made = [self._last[name] for name in CHECKS if name in self._last]
        return tuple(replace(check, age_s=frame.time_s - then_s) for then_s, check in made)

    def _repeated(self, frame: LiveFrame) -> Measured:
        if self._before is None or not np.array_equal(frame.small, self._before):
            self._before, self._changed_s = frame.small.copy(), frame.time_s
        return max(0.0, frame.time_s - self._changed_s)  # a camera's noise never repeats

    def _halves(self, frame: LiveFrame) -> Measured:
        """Measure how many times as much one half has changed as the other since its last change, noise taken off.

        A half has changed once its mean square difference is above 1.5 times that from frame to frame, its noise; until
        then it is compared with the picture of its last change. The force counts from the last change of either half or
        from the last frame that differs from the one before by more than the quietest frames lately did.
        """
        plane, ratio, changed = block_means(_green(frame.small), _BLOCK_PX), 0.0, self._changed_force_n is None
        noise = np.zeros(2) if self._plane is None else _half_squares(plane - self._plane)
        self._half_planes = self._half_planes or [plane, plane]
        if self._plane is not None:
            self._quiet = np.minimum(noise, _QUIET_GROWTH * self._quiet + _LEAST_SQUARE)
            changed |= bool((noise > _CHANGED_SHARE * self._quiet + _LEAST_SQUARE).any())
        for half in (0, 1):
            squares = _half_squares(plane - self._half_planes[half])
            excess = np.maximum(squares - noise, 0)
            floor = _NOISE_SHARE * noise[half] + _LEAST_SQUARE
            ratio = max(ratio, float(np.sqrt(excess[1 - half] / (excess[half] + floor))))
            if squares[half] > _CHANGED_SHARE * noise[half] + _LEAST_SQUARE:
                self._half_planes[half], changed = plane, True
        self._plane = plane
        self._force_n = self._force_n if frame.forces is None else frame.forces.force_n.mean(axis=0)
        self._changed_force_n = self._force_n if changed else self._changed_force_n
        return ratio

    def _force_change(self, _: LiveFrame) -> Measured:
        if self._force_n is None or self._changed_force_n is None:
            return None
        return float(np.linalg.norm(self._force_n - self._changed_force_n))

    def _drops(self, frame: LiveFrame) -> Measured:
        numbers = self._numbers
        numbers.append((frame.time_s, frame.number))
        while frame.time_s - numbers[0][0] > _DROPS_OVER_S or frame.number < numbers[0][1]:
            numbers.popleft()
        span = numbers[-1][1] - numbers[0][1]
        return max(0.0, 1 - (len(numbers) - 1) / span) if span > 0 else 0.0

    def _exposure(self, _: LiveFrame) -> Measured:
        return abs(self._gain), f"the picture is {2**self._gain:.2g} times as bright as the reference"

    def _touch(self, _: LiveFrame) -> Measured:
        change = f"the picture differs by {self._change:.2g} grey levels from the untouched sensor"
        return self._change, "nothing touches the sensor" if self._change < LEAST_TOUCH else change

    def _focus(self, frame: LiveFrame) -> Measured:
        share = _sharpness(_green(frame.small)) / 2**self._gain / max(self._sharpness, 1e-3)
        return max(0.0, 1 - share), f"edges are {share:.0%} as sharp as in the reference"

    def _camera_motion(self, frame: LiveFrame) -> Measured:
        touches = self._change >= LEAST_TOUCH
        motion = self._camera.update(frame.small, self._markers, touches=touches)
        if motion is None:
            return 0.0, "the border of the picture shows too little to measure a motion of the camera"
        return motion.excess_px, (
            f"since the reference the picture was shifted by {motion.shift_px:.1f} px, turned by "
            f"{motion.turn_deg:+.1f} degrees and zoomed by {100 * motion.zoom:+.1f} %"
        )

    def _light(self, _: LiveFrame) -> Measured:
        """Measure how much brighter or darker than the rest one side of the border is, in powers of 2."""
        height, width = (side // _TILES for side in self._brighter.shape[:2])
        tiles = self._brighter[: _TILES * height, : _TILES * width]
        tiles = tiles.reshape(_TILES, height, _TILES, width, 3).transpose(0, 2, 4, 1, 3)
        # inside the border, contact may brighten or shade
        border = np.pad(np.zeros((_TILES - 2, _TILES - 2), dtype=bool), 1, constant_values=True)
        values = tiles[border].reshape(-1, height * width)
        values = values[np.isfinite(values).sum(axis=1) > 3]
        # the median: markers that moved are few
        worst = float(np.abs(np.nanmedian(values, axis=1)).max(initial=0.0))
        return worst, f"one side of the picture is {2**worst:.2g} times brighter or darker than in the reference"

    def _absent_markers(self, _: LiveFrame) -> Measured:
        """Measure the share of the reference's markers that are not where they should be."""
        if self._markers is None:
            return None
        status = self._markers.status
        if (status == MarkerStatus.LOST).any():
            return 1.0, "the pattern of the markers has jumped, and none can be distinguished from the next"
        absent = np.isin(status, (MarkerStatus.MISSING, MarkerStatus.BROKEN))
        return float(absent.sum() / max(1, (absent | (status == MarkerStatus.FOLLOWED)).sum()))


def make_check(name: str, value: float, sentence: str | None = None, *, cure: str | None = None) -> Check:
    """Compare a value with its limit in `CHECKS`, in the unit of both; a check that fails states its cure."""
    kind = CHECKS[name]
    ok = value >= kind.limit if kind.is_minimum else value <= kind.limit
    sentence = kind.sentence.format(value) if sentence is None else sentence
    if not ok:
        sentence += f"; {kind.cure if cure is None else cure}"
    return Check(name=name, value=value, limit=kind.limit, ok=ok, sentence=sentence)


@dataclass(frozen=True, kw_only=True)
class CheckKind:
    """Row of `CHECKS`: what one check measures, its limit and its cure."""

    measure: Callable[[HealthMonitor, LiveFrame], Measured] | None = None
    """Measures a frame; None of a check of the network."""
    sentence: str = ""
    """Statement of a value."""
    limit: float
    """Bound of healthy values, in the unit of `unit`: seconds, newtons, pixels, grey levels, or a ratio."""
    unit: str
    cure: str
    harm: tuple[float, float] = (0.0, 0.0)
    """Chance that the fault puts the margin off however strong it is, and its growth with severity."""
    is_minimum: bool = False
    """True where healthy values lie above the limit."""


_RESTART = "start the camera again"
CHECKS = {
    "repeated": CheckKind(
        measure=HealthMonitor._repeated, limit=0.25, unit="s", cure=_RESTART, harm=(0.92, 1.06),
        sentence="the picture has not changed by a single pixel for {:.2g} s",
    ),
    "halves": CheckKind(
        measure=HealthMonitor._halves, limit=4.0, unit="ratio", cure=_RESTART, harm=(0.15, 0.02),
        sentence="one half of the picture changes {:.2g} times as much as the other",
    ),
    "frozen": CheckKind(
        measure=HealthMonitor._force_change, limit=0.15, unit="N", cure=_RESTART,
        harm=(0.91, 0.56), sentence="the force changed by {:.2g} N while the picture showed nothing but noise",
    ),
    "late": CheckKind(
        measure=lambda _, frame: max(0.0, time.monotonic() - frame.captured_s) if frame.captured_s > 0 else 0.0,
        limit=0.5, unit="s", cure="close what else uses the processor, or lower --rate",
        sentence="the frame is {:.2g} s old",
    ),
    "drops": CheckKind(
        measure=HealthMonitor._drops, limit=0.8, unit="share", cure="lower --rate or --size, or use another port",
        sentence="{:.0%} of the frames of the last second were lost",
    ),
    "saturation": CheckKind(
        measure=lambda health, frame: max(0.0, _saturated_share(frame.small) - health._saturated), limit=0.06,
        unit="share", cure="correct the exposure or the lamps", harm=(0.16, 0.36),
        sentence="{:.0%} of the picture have turned black or white",
    ),
    "exposure": CheckKind(
        measure=HealthMonitor._exposure, limit=0.2, unit="powers of 2",
        cure="fix exposure and gain of the camera, or take a new reference", harm=(0.47, 1.13),
    ),
    "focus": CheckKind(
        measure=HealthMonitor._focus, limit=0.25, unit="share", harm=(0.31, 0.11),
        cure="clean or focus the lens, and take a new reference",
    ),
    "light": CheckKind(
        measure=HealthMonitor._light, limit=0.2, unit="powers of 2", harm=(0.28, 0.11),
        cure="look after the lamps, or take a new reference",
    ),
    "camera": CheckKind(
        measure=HealthMonitor._camera_motion, limit=CAMERA_LIMIT_PX, unit="px", cure=CAMERA_CURE, harm=(0.56, 0.38)
    ),
    "markers": CheckKind(
        measure=HealthMonitor._absent_markers, limit=0.15, unit="share", harm=(0.33, 1.18),
        sentence="{:.0%} of the markers are not seen where they should be",
        cure="clean the skin and the lens, let go, and take a new reference",
    ),
    "touch": CheckKind(
        measure=HealthMonitor._touch, limit=LEAST_TOUCH, unit="grey levels", cure="press it on something",
        harm=(0.97, 1.20), is_minimum=True,
    ),
    "direction": CheckKind(limit=DIRECTION_LIMIT, unit="standard deviations", cure="", harm=(0.96, 0.67)),
    "novelty": CheckKind(
        limit=-float(np.log10(STRANGE)), unit="powers of 10", harm=(0.06, 0.31),
        cure="use the sensor that the network was trained on, or train it on this one",
    ),
}  # fmt: skip
"""Checks by name, in the order of causes. A frame beyond a limit has no margin.

The limits lie above all values of 80 healthy frames in contact on 16 simulated validation days: exposure, focus and
light at four times the largest and more (`benchmarks/health.py --choose`), halves and frozen at twice the largest of 48
simulated sequences of 0.7 s, camera, direction and novelty as where `predict` withholds. Those of markers, touch and
time are chosen by hand. `harm` was fitted by `benchmarks/health.py --choose --trials 6 --frames 3`; too few of these
show no touch, whose growth is of an earlier fit to twice as many trials.
"""
_SLOW = "focus", "light", "camera"


def _half_squares(plane: Plane) -> Float[np.ndarray, " 2"]:
    """Mean squares of the upper and the lower half."""
    middle = len(plane) // 2
    return np.array([np.mean(np.square(plane[:middle])), np.mean(np.square(plane[middle:]))], dtype=np.float64)


def check_novelty(estimate: Estimate) -> Check | None:
    """Check how far a frame resembles those of the training; None of a network without novelty.

    The value is the negative decimal logarithm of `Estimate.known`.
    """
    if estimate.known is None:
        return None
    share = float(estimate.known[0])
    sentence = f"{share:.0%} of the frames that the network was tested on are as strange as this picture"
    return make_check("novelty", -float(np.log10(max(share, 1e-30))), sentence)


def check_direction(network: Network, shear: Shear) -> Check:
    """Check the direction of the shear against the directions of the training, in standard deviations (`excess`)."""
    sentence = f"the skin is sheared towards {shear.direction_deg:.0f} degrees (90 is down the image)"
    return make_check("direction", shear.excess(network.directions), sentence, cure=network.direction_reason)


def severity(check: Check) -> float:
    """Compute how far a check is from its limit, as a ratio: above 1 it fails."""
    is_minimum = check.name in CHECKS and CHECKS[check.name].is_minimum
    over, under = (check.limit, check.value) if is_minimum else (check.value, check.limit)
    return over / max(under, 1e-6)


_SPREAD = -2.07, 0.59  # offset and slope of the logit of what the network itself gives for an error above `OFF`


def margin_risk(
    checks: Iterable[Check],
    beyond: float,
    *,
    harm: Mapping[str, tuple[float, float]] | None = None,
    spread: tuple[float, float] = _SPREAD,
) -> float:
    """Compute the chance that the margin of a frame is off by more than 0.2.

    Each fault, and the network's own doubt, counts as a cause that puts the margin off by itself (a noisy or):
    1 - P = (1 - P_network) * product of (1 - a (1 - exp(-(b s)^2))) over the checks, s their severity. The numbers a
    and b, and the offset and slope of P_network's logit, are those of greatest likelihood on simulated frames with
    faults of graded strength and `chromatouch-pair` (`benchmarks/health.py --choose`); on frames of other days and
    sensors the predicted chance matched the observed share.

    Parameters
    ----------
    checks
        Health of the frame.
    beyond
        Probability that the network gives an error above 0.2 (`Estimate.beyond`).
    harm, spread
        Numbers in place of those of `CHECKS`, while they are fitted.

    References
    ----------
    Pearl, *Probabilistic Reasoning in Intelligent Systems* (1988), section 4.3.2, for the noisy or.
    """
    harm = {name: kind.harm for name, kind in CHECKS.items()} if harm is None else harm
    right = 1 / (1 + np.exp(spread[0] + spread[1] * np.log((beyond + 0.01) / (1.01 - beyond))))
    for check in checks:
        most, growth = harm.get(check.name, (0.0, 0.0))
        right *= 1 - most * -np.expm1(-((growth * severity(check)) ** 2))
    return float(1 - right)


def _green(image: Frame) -> Plane:
    return image[..., 1].astype(np.float32)  # cameras see it best


def _sharpness(grey: Plane) -> float:
    """Measure the slope of the sharpest fortieth of the pixels, in grey levels a pixel; of means of 3 x 3."""
    rows = grey[:-2] + grey[1:-1] + grey[2:]
    means = (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9
    # of every other pixel, down and along
    along = means[1:-1:2, 2::2] - means[1:-1:2, :-2:2]
    down = means[2::2, 1:-1:2] - means[:-2:2, 1:-1:2]
    return float(np.quantile(np.hypot(along, down), 0.975)) / 2


def _saturated_share(image: Frame) -> float:
    """Measure the share of the pixels that are black or white."""
    red, green, blue = (image[::4, ::4, channel] for channel in range(3))
    white = np.minimum(np.minimum(red, green), blue) >= _WHITE
    return float(np.mean(white | (np.maximum(np.maximum(red, green), blue) <= _BLACK)))
