"""From a frame to its reading: reference, markers, health, and network, in one thread."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np
from jaxtyping import Float
from torch import Tensor

from sliplens.errors import ImageError, InputError
from sliplens.friction import FrictionLike, SlipLearner, as_friction
from sliplens.images import require_rgb, soften
from sliplens.live.contract import LiveOptions, LiveSource
from sliplens.live.health import HealthMonitor, check_direction, check_novelty, margin_risk
from sliplens.live.reading import OFF, TARGET, Latency, LiveFrame, Reading, SlipState, small_picture
from sliplens.live.slip import SlipDetector
from sliplens.markers import Tracker
from sliplens.models.checkpoint import Network
from sliplens.models.engines import Engine
from sliplens.models.predictions import LEVEL
from sliplens.recordings.capture import Frame
from sliplens.recordings.sensor import SensorProfile
from sliplens.recordings.trial import ContactState, contact_states
from sliplens.shear import ShearEstimator


class ReaderSettings(TypedDict, total=False):
    """Settings of `LiveReader` and `read_live`, each optional."""

    reference: Path | str | Frame | None
    """The sensor untouched, as an image or its path. By default the image that the source brings, else the first still
    picture: leave the sensor untouched until then."""
    options: LiveOptions | None
    """Options of the source."""
    sensor: SensorProfile | Path | str | None
    """Profile of the sensor that frames and reference go through, its file, or the name of one that comes with
    sliplens; it names the network where none is given."""
    friction: FrictionLike | None
    """Coefficient of friction, as `predict` takes it, for a network that predicts F_t / F_n. A slip that the markers
    show narrows a range, until the object is let go; `Reading.friction` states the value used."""
    same_object: bool
    """If True, every grasp is of one object, until `new_object`: the friction that a slip taught counts in later
    grasps."""
    engine: str
    """`torch`, `openvino`, or `auto`, the default, for the fastest that pays for `seconds`, or for hours without it."""
    device: str
    """Device of a network that is loaded here: cpu (default) or cuda."""
    seconds: float | None
    """Time after which it ends; with the source by default."""
    stall_s: float
    """Time without a frame after which a reading says so, 1 second by default."""
    forces: Path | str | None
    """File or named pipe into which another program writes the samples of a force sensor (`ForceStream`)."""
    health: Callable[[Frame], HealthMonitor] | None
    """Called with each new reference, returns the checks of frames: `HealthMonitor` by default; None for none, not
    even of the network's novelty."""
    slip: Callable[[Float[np.ndarray, "markers 2"]], SlipDetector] | None
    """Called with the places of the markers in each new reference, returns the slip detector: `SlipDetector` by
    default; None to track no markers."""


_JUMP_S = 1.0
_NO_CONTACT = "nothing touches the sensor, and without a contact there is no margin; press it"
_STILL_S = 0.3
_STILL_FRAMES = 5
_STILL_GREY = 0.75
_DARK, _BRIGHT = 8.0, 247.0
_WIDE_PX = 5.0


class ReferenceTaker:
    """Search for a moment in which the picture is still and well exposed."""

    def __init__(self) -> None:
        self._begun_s, self._soft, self._frames = 0.0, None, 0

    def offer(self, frame: LiveFrame) -> bool:
        """Take the next frame; True once the picture was still for long enough and can be the reference."""
        soft = soften(frame.image)
        if self._soft is None or float(np.abs(soft - self._soft).mean()) > _STILL_GREY:
            self._begun_s, self._soft, self._frames = frame.time_s, soft, 0
        self._frames += 1
        still = self._frames >= _STILL_FRAMES and frame.time_s - self._begun_s >= _STILL_S
        return still and _DARK < float(soft.mean()) < _BRIGHT


class FrameReader:
    """Reads frames one after another, each against the untouched sensor; `read` is called in one thread.

    A frame is checked while the network runs, whose output is dropped where a check withholds the margin.

    Parameters are those of `LiveReader`.
    """

    def __init__(self, source: LiveSource, network: Network | None, **settings: Unpack[ReaderSettings]) -> None:
        self.source, self.network = source, network
        self.engine: Engine | None = None
        """Engine of the network; set by `begin`."""
        self.reference: Frame | None = None
        """The sensor untouched, as the next frame is compared with it."""
        self.colour_doubts: tuple[str, ...] = ()
        """Doubts about the colours of the reference for this network."""
        self.markers_px: tuple[np.ndarray, np.ndarray] | None = None
        """Places (x, y) of the markers at rest and in the newest frame, in pixels, NaN where one is not seen.

        None where no markers are tracked.
        """
        self.learner: SlipLearner
        """Friction that was set, and that slips teach."""
        self._same_object = settings.get("same_object", False)
        self.new_object(settings.get("friction"))
        self._make_health, self._make_slip = settings.get("health", HealthMonitor), settings.get("slip", SlipDetector)
        self._health: HealthMonitor | None = None
        self._shear: ShearEstimator | None = None
        self._slip: SlipDetector | None = None
        self._tracker: Tracker | None = None
        self._smaller = 1
        self.taker: ReferenceTaker | None = None
        """Search for a new reference, until it is taken."""
        self._last: Reading | None = None
        self._dropped = 0

    def new_object(self, friction: FrictionLike | None = None) -> None:
        """Begin another object: the friction that was set or learnt is dropped.

        Parameters
        ----------
        friction
            Friction of the new one, as `LiveReader` takes it; unknown if None.

        Raises
        ------
        InputError
            If the friction is none, or the network takes none.
        """
        if friction is not None or self._same_object:
            if self.network is None:
                option = "--same-object" if friction is None else "--friction"
                raise InputError(f"{option} needs a network; name one with --network")
            self.network.require_ratio()
        # a new one, not emptied: the reading thread may still teach the one before
        self.learner = SlipLearner(None if friction is None else as_friction(friction), same_object=self._same_object)

    def begin(self, engine: Engine | None, reference: Frame | None, *, size: tuple[int, int] | None = None) -> None:
        """Prepare for frames of the open source, of its size if None, with an image of the untouched sensor if any."""
        self.engine, self._size = engine, size or self.source.size
        if reference is None:
            self.taker = ReferenceTaker()
            return
        require_rgb(reference, what="levels of the reference")
        if reference.shape[:2] != self._size:
            raise ImageError(
                f"the reference has {_in_pixels(reference.shape[:2])} pixels, the frames of {self.source.name} have "
                f"{_in_pixels(self._size)}; name an image of this camera with --reference, or leave it out"
            )
        self._set_reference(reference)

    def missing(self, why: str) -> Reading:
        """Make the reading of a moment without a frame."""
        last = self._last or Reading(number=-1, time_s=np.nan, captured_s=np.nan)
        begin = Reading(number=last.number, time_s=last.time_s, captured_s=last.captured_s)
        return replace(begin, withheld=why, dropped=self._dropped)

    def read(self, frame: LiveFrame) -> Reading:
        """Read the next frame."""
        require_rgb(frame.image, what=f"levels of frame {frame.number} of {self.source.name}")
        last = self._last
        self._dropped += 0 if last is None else max(0, frame.number - last.number - 1)
        begin = Reading(
            number=frame.number,
            time_s=frame.time_s,
            captured_s=frame.captured_s,
            dropped=self._dropped,
            true_margin=frame.safety_margin,
            latency=Latency(decode_ms=frame.decode_ms),
        )
        why = self._unready(last, frame)
        reading = self._read(begin, frame) if why is None else replace(begin, withheld=why)
        total_ms = 1e3 * (time.monotonic() - frame.captured_s)
        self._last = replace(reading, latency=replace(reading.latency, total_ms=total_ms))
        return self._last

    def _read(self, begin: Reading, frame: LiveFrame) -> Reading:
        """Read a frame that can be compared with the reference."""
        network = self.network
        if network is None or self.engine is None or self.reference is None:
            return self._check(begin, frame)
        checked, begun = list[Reading](), time.perf_counter()
        inputs = network.encode(frame.image[None], self.reference)
        encoded = time.perf_counter()

        def batches() -> Iterator[Tensor]:
            yield inputs  # the batch is under way: an engine looks for the next one first
            checked.append(self._check(begin, frame))

        [parts] = self.engine.answers(batches())
        [reading] = checked
        network_ms = 1e3 * (time.perf_counter() - encoded) - reading.latency.checks_ms
        latency = replace(reading.latency, encode_ms=1e3 * (encoded - begun), network_ms=network_ms)
        return self._estimate(replace(reading, latency=latency), frame, network, parts)

    def _unready(self, last: Reading | None, frame: LiveFrame) -> str | None:
        """Explain why a frame cannot be compared with a reference, after taking a new one where that is due."""
        name = self.source.name
        if last is not None:
            passed_s = frame.time_s - last.time_s
            off_s = passed_s - self.source.speed * (frame.captured_s - last.captured_s)
            if not (passed_s > 0 and abs(off_s) <= _JUMP_S):
                self._begin_anew()
                return f"the clock of {name} jumped by {off_s:+.3g} s; the next frame is read again"
        if frame.size != self._size:
            sizes = f"{_in_pixels(frame.size)} pixels, they were {_in_pixels(self._size)}"
            return f"the frames of {name} are now {sizes}; set the camera as it was, or start again"
        if (taker := self.taker) is not None and taker.offer(frame):
            self.taker = None
            self._set_reference(frame.image)
        if self.reference is None:
            return "there is no reference frame yet; the picture must be still for a moment: leave the sensor untouched"
        return None

    def _check(self, begin: Reading, frame: LiveFrame) -> Reading:
        """Track the markers of a frame and check its health; returns its reading without the margin."""
        begun = time.perf_counter()
        tracked = markers = None
        if self._tracker is not None and self._slip is not None:
            tracked = self._tracker.update(frame.image if self._smaller == 1 else frame.small)
            rest_px = self._tracker.rest.centre_px
            self.markers_px = self._in_frame(rest_px), self._in_frame(tracked.position_px)
            markers = self._slip.update(self.markers_px[1], frame.time_s)
        health = () if self._health is None else self._health.check(frame, tracked)
        if self._shear is not None and self.network is not None and all(check.ok for check in health):
            health = (*health, check_direction(self.network, self._shear.estimate(frame.image)))
        latency = replace(begin.latency, checks_ms=1e3 * (time.perf_counter() - begun))
        withheld, slip = next((check.sentence for check in health if not check.ok), None), markers and markers.state
        reading = replace(begin, slip=slip, markers=markers, health=health, withheld=withheld, latency=latency)
        untouched = any(check.name == "touch" and not check.ok for check in health)
        touches = not untouched and (markers is None or markers.contact is not False)
        if not touches:
            withheld = withheld or (None if self.network is None else _NO_CONTACT)
            reading = replace(reading, contact_state=ContactState.NO_CONTACT, withheld=withheld)
        slipping_s = None if markers is None else markers.slipped_s  # of a pull that was let go it is None
        self.learner.update(frame.time_s, slipping_s=slipping_s, touches=touches)
        return reading

    def _estimate(self, reading: Reading, frame: LiveFrame, network: Network, parts: tuple[Tensor, ...]) -> Reading:
        """Add the margin to a checked reading, unless it is withheld."""
        if reading.withheld is not None:
            return reading
        friction = self.learner.friction
        estimate = network.to_estimate(*parts, friction=friction)
        novelty = None if self._health is None else check_novelty(estimate)
        if novelty is not None:
            reading = replace(reading, health=(*reading.health, novelty))
            if not novelty.ok:
                return replace(reading, withheld=novelty.sentence)
        ratio = None if estimate.ratio is None else float(estimate.ratio.mean[0])
        if ratio is not None and estimate.ratio is not None:
            self.learner.note(ratio, sigma=float(estimate.ratio.sigma[0]), time_s=frame.time_s)
        interval = estimate.interval(LEVEL)
        values = np.concatenate([estimate.margin] if interval is None else [estimate.margin, *interval]).clip(0, 1)
        [state] = contact_states(values[:1], without=ContactState.UNKNOWN)
        margin, *ends = values.tolist()
        low, high = ends or (None, None)
        slip = reading.slip
        if slip is not None and slip is not SlipState.SLIP and high is not None and high < TARGET[0]:
            slip = SlipState.WILL_SLIP
        return replace(
            reading,
            slip=slip,
            margin=margin,
            low=low,
            high=high,
            ratio=ratio,
            friction=None if friction is None else str(friction),
            risk=margin_risk(reading.health, float(estimate.beyond(OFF)[0])) if reading.health else None,
            contact_state=state,
        )

    def _set_reference(self, image: Frame) -> None:
        self.reference = image
        self.colour_doubts = () if self.network is None else self.network.doubts(frame=image)
        self._health = None if self._make_health is None else self._make_health(image)
        network = None if self._health is None else self.network
        self._shear = None if network is None else network.shear_estimator(image)
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Forget earlier frames, where frames no longer follow each other."""
        self.learner.release()
        self._last = None
        self.markers_px = None
        if self._make_slip is not None and self.reference is not None:
            try:
                self._tracker, self._smaller, small = Tracker(self.reference), 1, small_picture(self.reference)
                factor = len(self.reference) // len(small)
                # a disc as wide as several pixels is measured as well in block means, in a third of the time
                if factor > 1 and self._tracker.rest.appearance.radius_px >= _WIDE_PX * factor:
                    self._tracker, self._smaller = Tracker(small), factor
                self._slip = self._make_slip(self._in_frame(self._tracker.rest.centre_px))
            except (ImageError, InputError):
                self._tracker = self._slip = None  # it shows no markers, or too few

    def _in_frame(self, places_px: Float[np.ndarray, "markers 2"]) -> Float[np.ndarray, "markers 2"]:
        """Convert places of the picture in which markers are tracked to the frame; pixel centres are whole numbers."""
        return (places_px + 0.5) * self._smaller - 0.5


def _in_pixels(size: tuple[int, ...]) -> str:
    return f"{size[0]} x {size[1]}"
