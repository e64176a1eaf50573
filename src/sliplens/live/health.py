"""Health of a running sensor: what of a frame speaks against believing its margin, each with its cure."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from sliplens.errors import InputError
from sliplens.live.reading import Check, LiveFrame, small_picture
from sliplens.markers import MarkerStatus, TrackedFrame
from sliplens.markers.camera import CAMERA_CURE, CAMERA_LIMIT_PX, CameraWatch, block_means
from sliplens.models.checkpoint import STRANGE, Estimate, Network
from sliplens.recordings.capture import Forces, Frame
from sliplens.recordings.labels.lag import LEAST_TOUCH, picture_change, soften
from sliplens.shear import DIRECTION_LIMIT, FULL_CIRCLE, Shear

Plane = Float32[np.ndarray, "height width"]

_BRIGHT, _DARK = 250, 5
_TILES = 4
_SEEN = 10.0
"""Grey levels below which a ratio of brightness means nothing."""
_DROPS_OVER_S = 1.0
_OLDEST_S = 0.1
_BLOCK_PX = 4
_CHANGED_SHARE, _NOISE_SHARE, _LEAST_SQUARE = 1.5, 0.2, 0.02
"""Of the noise of means of blocks, that show a change and that a square of it is known to; and squares of grey levels
that rounding makes."""


@dataclass(frozen=True, kw_only=True)
class HealthLimits:
    """Bounds of healthy values; a frame beyond one of them has no margin.

    The defaults lie above all values of 80 healthy frames in contact on 16 simulated validation days: exposure, focus
    and light at four times the largest and more (`benchmarks/health.py --choose`), halves and force at twice the
    largest of 48 simulated sequences of 0.7 s, the camera as `CAMERA_LIMIT_PX` says. Those of markers, touch and time
    are chosen by hand.
    """

    repeated_s: float = 0.25
    """Time for which no pixel has changed: a camera's noise never repeats."""
    late_s: float = 0.5
    """Age of the frame when it is read."""
    drops: float = 0.8
    """Share of the last second's frames that were lost."""
    saturation: float = 0.06
    """Share of the pixels that turned black or white since the reference."""
    exposure: float = 0.2
    """Brightness against the reference, as the ratio's power of 2, up or down."""
    focus: float = 0.25
    """Share of the reference's sharpness that is lost."""
    light: float = 0.2
    """Brightness of one side of the border against the rest, as the ratio's power of 2, up or down."""
    camera_px: float = CAMERA_LIMIT_PX
    """Motion of the border by a shift, turn or zoom of the picture that no contact explains, in pixels of a picture 224
    high."""
    halves: float = 4.0
    """Largest ratio of the changes of the two halves of the picture where one shows its noise alone."""
    frozen_n: float = 0.15
    """Change of the force since the picture last changed by more than its noise, in newtons."""
    markers: float = 0.15
    """Share of the reference's markers that are not seen where they should be."""
    touch: float = LEAST_TOUCH
    """Least change of the picture, in grey levels, that shows a contact."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise InputError(f"the health limit {name} must be positive, got {value:g}")


class HealthMonitor:
    """Checks frames against the untouched sensor.

    Every frame is checked for repeats, delay and losses; for a picture, or half of one, that shows nothing but noise
    while the force or the other half changes; for saturation and exposure; for markers that are missing or have jumped;
    and for a touch. What changes slowly takes turns, one check a frame, and tells of a frame at most 0.1 s ago: focus,
    and light that falls unevenly, as when a lamp is out. A camera that was shifted, turned or zoomed shows in markers
    beyond the contact, in every frame; without markers in the border, which takes its turn with the others, and in a
    contact shows a turn alone.

    Parameters
    ----------
    reference
        The sensor untouched.
    limits
        Bounds of healthy values.

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

    def __init__(self, reference: Frame, limits: HealthLimits | None = None) -> None:
        self.limits = limits or HealthLimits()
        small = small_picture(reference)
        grey = _green(small)
        self._soft, self._sharp, self._lost = soften(small), _sharpness(grey), _saturated(small)
        self._camera, self._stillness = CameraWatch(small), _Stillness()
        self._before: np.ndarray | None = None
        self._changed_s = 0.0
        self._numbers: deque[tuple[float, int]] = deque()
        self._sometimes: dict[str, tuple[float, Check]] = {}

    def check(self, frame: LiveFrame, markers: TrackedFrame | None = None, /) -> tuple[Check, ...]:
        """Check a frame of the reference's size, and its markers where they are followed.

        The first check that is not fine names the cause: what is wrong with the camera comes before what that changes
        in the picture.
        """
        soft = soften(frame.small)
        both = (self._soft > _SEEN) & (soft > _SEEN) & (self._soft < _BRIGHT) & (soft < _BRIGHT)
        ratio = np.log2(np.where(both, soft, 1) / np.where(both, self._soft, 1))
        gain = float(np.median(ratio[both])) if both.any() else 0.0
        touch = self._check_touch(soft, gain)
        slow = {
            "focus": lambda: self._check_focus(_green(frame.small), gain),
            "light": lambda: self._check_light(ratio - gain, both),
            "camera": lambda: self._check_camera(frame, markers, touches=touch.ok),
        }
        # markers tell the camera's motion at once, the border takes as long as the other two
        at_once = () if markers is None else (slow.pop("camera")(),)
        checks = [
            self._check_repeated(frame),
            *self._check_frozen(frame),
            self._check_late(frame),
            self._check_drops(frame),
            self._check_saturation(frame.small),
            self._check_exposure(gain),
            *self._check_sometimes(slow, frame.time_s),
            *at_once,
        ]
        if markers is not None:
            checks.append(self._check_markers(markers))
        return (*checks, touch)

    def _check_sometimes(self, checks: Mapping[str, Callable[[], Check]], time_s: float) -> Iterable[Check]:
        """Checks of what changes slowly, of which a frame brings one anew, and all that would else be too old."""
        age_s = {name: time_s - self._sometimes[name][0] if name in self._sometimes else np.inf for name in checks}
        # of the very same time it may be another frame, of a source without a clock
        due = [name for name in checks if not 0 < age_s[name] < _OLDEST_S]
        for name in due or [max(checks, key=lambda name: age_s[name])]:
            self._sometimes[name] = time_s, checks[name]()
        return [self._sometimes[name][1] for name in checks]

    def _check_repeated(self, frame: LiveFrame) -> Check:
        if self._before is None or not np.array_equal(frame.small, self._before):
            self._before, self._changed_s = frame.small.copy(), frame.time_s
        value = max(0.0, frame.time_s - self._changed_s)
        told = f"the picture has not changed by a single pixel for {value:.2g} s"
        return _judge("repeated", value, self.limits.repeated_s, told, "start the camera again")

    def _check_frozen(self, frame: LiveFrame) -> Iterable[Check]:
        """Check for a picture, or a half of it, that stays as it is but for its noise; forces are known in part."""
        still, cure = self._stillness, "start the camera again"
        still.update(block_means(_green(frame.small), _BLOCK_PX), frame.forces)
        told = f"one half of the picture changes {still.ratio:.2g} times as much as the other"
        yield _judge("halves", still.ratio, self.limits.halves, told, cure)
        if still.force_change_n is not None:
            told = f"the force changed by {still.force_change_n:.2g} N while the picture showed nothing but noise"
            yield _judge("frozen", still.force_change_n, self.limits.frozen_n, told, cure)

    def _check_late(self, frame: LiveFrame) -> Check:
        value = max(0.0, time.monotonic() - frame.captured_s) if frame.captured_s > 0 else 0.0
        cure = "close what else uses the processor, or lower --rate"
        return _judge("late", value, self.limits.late_s, f"the frame is {value:.2g} s old", cure)

    def _check_drops(self, frame: LiveFrame) -> Check:
        self._numbers.append((frame.time_s, frame.number))
        while frame.time_s - self._numbers[0][0] > _DROPS_OVER_S or frame.number < self._numbers[0][1]:
            self._numbers.popleft()
        span = self._numbers[-1][1] - self._numbers[0][1]
        value = max(0.0, 1 - (len(self._numbers) - 1) / span) if span > 0 else 0.0
        told = f"{value:.0%} of the frames of the last second were lost"
        return _judge("drops", value, self.limits.drops, told, "lower --rate or --size, or use another port")

    def _check_saturation(self, image: Frame) -> Check:
        value = max(0.0, _saturated(image) - self._lost)
        told = f"{value:.0%} of the picture have turned black or white"
        return _judge("saturation", value, self.limits.saturation, told, "mend the exposure or the lamps")

    def _check_exposure(self, gain: float) -> Check:
        told = f"the picture is {2**gain:.2g} times as bright as the reference"
        cure = "fix exposure and gain of the camera, or take a new reference"
        return _judge("exposure", abs(gain), self.limits.exposure, told, cure)

    def _check_focus(self, grey: Plane, gain: float) -> Check:
        left = _sharpness(grey) / 2**gain / max(self._sharp, 1e-3)
        told = f"edges are {left:.0%} as sharp as in the reference"
        cure = "clean or focus the lens, and take a new reference"
        return _judge("focus", max(0.0, 1 - left), self.limits.focus, told, cure)

    def _check_light(self, ratio: np.ndarray, known: np.ndarray) -> Check:
        height, width = (side // _TILES for side in ratio.shape[:2])
        # unknown ones sort behind all others
        tiles = np.where(known, ratio, np.inf)[: _TILES * height, : _TILES * width]
        tiles = tiles.reshape(_TILES, height, _TILES, width, 3).transpose(0, 2, 4, 1, 3)
        values = np.sort(tiles.reshape(_TILES, _TILES, 3, -1), axis=-1)
        # inside the border, contact may brighten or shade
        border = np.pad(np.zeros((_TILES - 2, _TILES - 2), dtype=bool), 1, constant_values=True)
        values = values[border].reshape(-1, height * width)
        count = np.isfinite(values).sum(axis=1)
        values, count = values[count > 3], count[count > 3]
        # the median: markers that moved are few
        middle = [np.take_along_axis(values, at[:, None], axis=1) for at in ((count - 1) // 2, count // 2)]
        worst = float(np.abs(np.add(*middle) / 2).max(initial=0.0))
        told = f"one side of the picture is {2**worst:.2g} times brighter or darker than in the reference"
        return _judge("light", worst, self.limits.light, told, "look after the lamps, or take a new reference")

    def _check_camera(self, frame: LiveFrame, markers: TrackedFrame | None, *, touches: bool) -> Check:
        limit, moved = self.limits.camera_px, self._camera.update(frame.small, markers, touches=touches)
        if moved is None:
            told = "the border of the picture shows too little to tell whether the camera has moved"
            return _judge("camera", 0.0, limit, told, "")
        told = (
            f"since the reference the picture was shifted by {moved.shift_px:.1f} px, turned by {moved.turn_deg:+.1f} "
            f"degrees and zoomed by {100 * moved.zoom:+.1f} %"
        )
        return _judge("camera", moved.excess_px, limit, told, CAMERA_CURE)

    def _check_markers(self, markers: TrackedFrame) -> Check:
        status = markers.status
        if (status == MarkerStatus.LOST).any():
            value, told = 1.0, "the pattern of the markers has jumped, and none can be told from the next"
        else:
            absent = np.isin(status, (MarkerStatus.MISSING, MarkerStatus.BROKEN))
            value = float(absent.sum() / max(1, (absent | (status == MarkerStatus.FOLLOWED)).sum()))
            told = f"{value:.0%} of the markers are not seen where they should be"
        cure = "clean the skin and the lens, let go, and take a new reference"
        return _judge("markers", value, self.limits.markers, told, cure)

    def _check_touch(self, soft: np.ndarray, gain: float) -> Check:
        value = picture_change(soft * 2**-gain, self._soft)
        told = f"the picture differs by {value:.2g} grey levels from the untouched sensor"
        touches = value >= self.limits.touch
        sentence = told if touches else "nothing touches the sensor; press it on something"
        return Check(name="touch", value=value, limit=self.limits.touch, ok=touches, sentence=sentence)


class _Stillness:
    """Changes of the two halves of the picture, upper and lower, against their noise.

    A half has changed once its mean square is above 1.5 times that from frame to frame, which is its noise and somewhat
    more; until then it is compared with the picture of its last change.
    """

    def __init__(self) -> None:
        self.ratio = 0.0
        """How many times as much one half has changed as the other since that last changed, noise taken off."""
        self.force_change_n: float | None = None
        """Change of the force since either half changed; None before any force."""
        self._before: Plane | None = None
        self._last: list[Plane] = []
        self._force_n: np.ndarray | None = None
        self._last_force_n: np.ndarray | None = None

    def update(self, plane: Plane, forces: Forces | None) -> None:
        """Take the next frame in means of blocks, and the samples of the force since the one before."""
        if forces is not None:
            self._force_n = forces.force_n.mean(axis=0)
        if self._before is None:
            self._before, self._last = plane, [plane, plane]
        noise = _half_squares(plane - self._before)
        self.ratio, changed = 0.0, False
        for half in (0, 1):
            squares = _half_squares(plane - self._last[half])
            excess = np.maximum(squares - noise, 0)
            floor = _NOISE_SHARE * noise[half] + _LEAST_SQUARE
            self.ratio = max(self.ratio, float(np.sqrt(excess[1 - half] / (excess[half] + floor))))
            if squares[half] > _CHANGED_SHARE * noise[half] + _LEAST_SQUARE:
                self._last[half], changed = plane, True
        if changed or self._last_force_n is None:
            self._last_force_n = self._force_n
        if self._force_n is not None and self._last_force_n is not None:
            self.force_change_n = float(np.linalg.norm(self._force_n - self._last_force_n))
        self._before = plane


def _half_squares(plane: Plane) -> Float[np.ndarray, " 2"]:
    """Mean squares of the upper and the lower half."""
    middle = len(plane) // 2
    return np.array([np.mean(np.square(plane[:middle])), np.mean(np.square(plane[middle:]))], dtype=np.float64)


def check_novelty(estimate: Estimate) -> Check | None:
    """Check how far the network knows a frame, by the estimate of this frame alone; None of a network without novelty.

    The value is the negative decimal logarithm of `Estimate.known`, at its limit where `predict` withholds too.
    """
    if estimate.known is None:
        return None
    known = float(estimate.known[0])
    told = f"{known:.0%} of the frames that the network was tested on are as strange as this picture"
    cure = "use the sensor that it was trained on, or train it on this one"
    return _judge("novelty", -float(np.log10(max(known, 1e-30))), -float(np.log10(STRANGE)), told, cure)


def check_direction(network: Network, shear: Shear) -> Check:
    """Check the direction of the shear against the directions of the network's training.

    The value is the distance from them in standard deviations (`Shear.excess`), at its limit where `predict` withholds
    too.
    """
    trained = network.manifest.pull_direction_deg or FULL_CIRCLE
    told = f"the skin is sheared towards {shear.direction_deg:.0f} degrees (90 is down the image)"
    return _judge("direction", shear.excess(trained), DIRECTION_LIMIT, told, network.doubt_shear(shear) or "")


def severity(check: Check) -> float:
    """How far a check is from its limit, as a ratio: above 1 something is wrong."""
    over, under = (check.limit, check.value) if check.name == "touch" else (check.value, check.limit)
    return over / max(under, 1e-6)


_HARM: dict[str, tuple[float, float]] = {
    "repeated": (0.92, 1.06), "halves": (0.15, 0.02), "frozen": (0.91, 0.56), "saturation": (0.16, 0.36),
    "exposure": (0.47, 1.13), "focus": (0.31, 0.11), "light": (0.28, 0.11), "camera": (0.56, 0.38),
    "markers": (0.33, 1.18), "touch": (0.97, 1.20), "direction": (0.96, 0.67), "novelty": (0.06, 0.31),
}  # fmt: skip
"""Chance that a fault puts the margin off however strong it is, and its growth with severity, by check.

Fitted by `benchmarks/health.py --choose --trials 6 --frames 3`. Too few of these show no touch: the growth of that
is of an earlier fit, to twice as many trials.
"""
_SPREAD = -2.07, 0.59
"""Offset and slope of the logit of what the network itself gives for an error above `OFF`."""


def margin_risk(
    checks: Iterable[Check],
    beyond: float,
    *,
    harm: Mapping[str, tuple[float, float]] | None = None,
    spread: tuple[float, float] = _SPREAD,
) -> float:
    """Chance that the margin of a frame is off by more than 0.2: all checks and the network's spread in one number.

    Each fault, and the network's own doubt, is taken for a cause that puts the margin off by itself (a noisy or):
    1 - P = (1 - P_network) * product of (1 - a (1 - exp(-(b s)^2))) over the checks, s their severity. The numbers a
    and b, and the offset and slope of P_network's logit, are those of greatest likelihood on simulated frames with
    faults of graded strength, read by `chromatouch-pair` (`benchmarks/health.py --choose`); on frames of other days and
    sensors such a chance came true as often as it says.

    Parameters
    ----------
    checks
        Health of the frame.
    beyond
        What the network gives for an error above 0.2, from 0 to 1, as `Estimate.beyond` tells it.
    harm, spread
        Other numbers, while they are fitted.

    References
    ----------
    Pearl, *Probabilistic Reasoning in Intelligent Systems* (1988), section 4.3.2, for the noisy or.
    """
    harm = _HARM if harm is None else harm
    right = 1 / (1 + np.exp(spread[0] + spread[1] * np.log((beyond + 0.01) / (1.01 - beyond))))
    for check in checks:
        most, growth = harm.get(check.name, (0.0, 0.0))
        right *= 1 - most * -np.expm1(-((growth * severity(check)) ** 2))
    return float(1 - right)


def _judge(name: str, value: float, limit: float, told: str, cure: str) -> Check:
    ok = value <= limit
    return Check(name=name, value=value, limit=limit, ok=ok, sentence=told if ok else f"{told}; {cure}")


def _green(image: Frame) -> Plane:
    """Green, which cameras see best."""
    return image[..., 1].astype(np.float32)


def _sharpness(grey: Plane) -> float:
    """Slope of the sharpest fortieth of the pixels, in grey levels a pixel; of means of 3 x 3, above the noise."""
    rows = grey[:-2] + grey[1:-1] + grey[2:]
    means = (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9
    # of every other pixel, down and along
    along = means[1:-1:2, 2::2] - means[1:-1:2, :-2:2]
    down = means[2::2, 1:-1:2] - means[:-2:2, 1:-1:2]
    return float(np.quantile(np.hypot(along, down), 0.975)) / 2


def _saturated(image: Frame) -> float:
    """Share of the pixels that are black or white."""
    red, green, blue = (image[::4, ::4, channel] for channel in range(3))
    white = np.minimum(np.minimum(red, green), blue) >= _BRIGHT
    return float(np.mean(white | (np.maximum(np.maximum(red, green), blue) <= _DARK)))


__all__ = ["HealthLimits", "HealthMonitor", "margin_risk", "severity"]
