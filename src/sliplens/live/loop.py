"""The loop of a running sensor: one thread captures, one reads, and what is too late is dropped and counted."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from threading import Condition, Event, Thread
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

from sliplens.errors import ImageError, InputError, RecordingError, SourceError
from sliplens.friction import FrictionLike, SlipLearner, as_friction
from sliplens.images import read_image
from sliplens.live.contract import LiveSource, SourceOptions
from sliplens.live.health import HealthMonitor
from sliplens.live.reading import Check, Latency, LiveFrame, MarkerReading, Reading
from sliplens.live.recorder import ForceStream, Recorder
from sliplens.live.slip import SlipDetector
from sliplens.live.sources import Images, ProfiledSource, open_live
from sliplens.markers import TrackedFrame, Tracker
from sliplens.models.checkpoint import Run, load
from sliplens.models.engines import Engine, make_engine
from sliplens.models.predictions import LEVEL
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import Dataset, keep_profile
from sliplens.recordings.labels.lag import soften
from sliplens.recordings.sensor import SensorProfile, load_profile
from sliplens.recordings.trial import ContactState, TrialFacts, contact_states

Item = TypeVar("Item")
Subscriber = Callable[[Reading, LiveFrame | None], None]
"""Called with each reading and its frame, in the thread that reads; None where there is no frame to it."""


@runtime_checkable
class HealthWatch(Protocol):
    """Judges frames against the reference that it was made for."""

    def check(self, frame: LiveFrame, markers: TrackedFrame | None, /) -> tuple[Check, ...]:
        """Check a frame, and its markers where they are followed; a check that is not fine withholds its margin."""
        ...


@runtime_checkable
class SlipWatch(Protocol):
    """Tells slip from the motion of the markers, frame after frame."""

    def update(self, positions_px: Float[np.ndarray, "markers 2"], time_s: float, /) -> MarkerReading:
        """Take the markers of a frame, NaN where one is not seen."""
        ...


class _Newest(Generic[Item]):
    """Place for the newest of what a thread makes; what nobody took in time is gone."""

    def __init__(self) -> None:
        self._changed, self._item, self._closed = Condition(), None, False

    def put(self, item: Item) -> None:
        with self._changed:
            self._item = item
            self._changed.notify_all()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        return self._closed

    def take(self, timeout_s: float | None = None) -> Item | None:
        """Wait for the newest; None where none came in time, or none will come any more."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed, timeout_s)
            item, self._item = self._item, None
            return item


_MOST_FRAMES = 10**6
_RETRY_S = 1.0  # between two tries to open a source that was lost
_JUMP_S = 1.0
_NO_CONTACT = "nothing touches the sensor, and without a contact there is no margin; press it"
_PATIENCE_S = 3.0
_STILL_S = 0.3
_STILL_FRAMES = 5
_STILL_GREY = 0.75
_DARK, _BRIGHT = 8.0, 247.0


class _ReferenceTaker:
    """Looks for a moment in which the picture is still and well exposed, and keeps a frame of it."""

    def __init__(self) -> None:
        self._since: LiveFrame | None = None
        self._soft: np.ndarray | None = None
        self._frames = 0

    def offer(self, frame: LiveFrame) -> Frame | None:
        """Take the next frame; gives the reference once the picture was still for long enough."""
        soft = soften(frame.image)
        moved = self._soft is None or float(np.abs(soft - self._soft).mean()) > _STILL_GREY
        if moved or self._since is None:
            self._since, self._soft, self._frames = frame, soft, 1
            return None
        self._frames += 1
        if self._frames < _STILL_FRAMES or frame.time_s - self._since.time_s < _STILL_S:
            return None
        brightness = float(soft.mean())
        if not _DARK < brightness < _BRIGHT:
            return None
        return frame.image


class LowPass:
    """Exponential filter of values that come at any times; it delays slow changes by its time constant."""

    def __init__(self, *, time_constant_s: float) -> None:
        self.time_constant_s = time_constant_s
        self._before: tuple[Float[np.ndarray, " values"], float] | None = None

    def forget(self) -> None:
        """Begin anew with the next values."""
        self._before = None

    def update(self, values: Float[np.ndarray, " values"], time_s: float) -> Float[np.ndarray, " values"]:
        """Filtered values at a time; the values themselves where the time constant is 0."""
        if self.time_constant_s > 0 and self._before is not None:
            before, then_s = self._before
            values = before + (values - before) * -np.expm1(-max(0.0, time_s - then_s) / self.time_constant_s)
        self._before = values, time_s
        return values


class LiveReader:
    """Readings of a running sensor; a context manager that captures and reads while it is entered.

    One thread captures and one reads, with a place for the newest frame only between them: a network that is slower
    than the camera drops frames, counts them, and never lags behind.

    Parameters
    ----------
    source
        As `open_live` takes it: `simulated`, a path, frames, or a source.
    network
        Network, its folder, or the name of one that comes with sliplens; None for markers and health alone.
    reference
        The sensor untouched, as an image or its path; what the source brings if None, else it is taken when the picture
        is still at first: leave the sensor untouched until then.
    options
        Wishes for the source.
    sensor
        Profile of the sensor that frames and reference go through, its file, or the name of one that comes along;
        where it names a network and `network` is None, that one is read by.
    friction
        What is known of the coefficient of friction, as `predict` takes it, for a network that tells F_t / F_n. Slips
        that the markers tell narrow a range down; `Reading.friction` says what was assumed.
    engine
        Row of `ENGINES`; `auto` for the fastest at hand that pays for `seconds`, or for hours where that is None, and
        that may take seconds to be made.
    device
        Device of a network that is loaded here: cpu or cuda.
    smoothing_s
        Time constant of a low-pass on margin and interval, in seconds; `Reading.lag_s` tells the delay. 0 for none.
    seconds
        Time after which it ends; with the source if None.
    stall_s
        Time without a frame after which a reading says so, in seconds.
    forces
        File or named pipe into which another program writes the samples of a force sensor, as `ForceStream` reads it.
    health
        Called with each new reference and the network, gives what checks the frames; None for no checks.
    slip
        Called with the places of the markers in each new reference, gives what tells slip from their motion; None for
        not following them. A sensor without markers is read without.

    Raises
    ------
    InputError
        If the source or the network is not there, or an option cannot be used.
    ImageError
        If the frames are of another size than those of the network's sensor.

    Examples
    --------
    >>> import numpy as np
    >>> import sliplens as sl
    >>> frames = np.full((20, 224, 224, 3), 128, dtype=np.uint8)
    >>> with sl.LiveReader(frames, "chromatouch-difference", reference=frames[0], engine="eager") as reader:
    ...     readings = list(reader.readings())
    >>> len(readings) + readings[-1].dropped
    20
    """

    def __init__(
        self,
        source: "str | Path | Images | Capture | LiveSource" = "simulated",
        network: Run | Path | str | None = None,
        *,
        reference: Path | str | Frame | None = None,
        options: SourceOptions | None = None,
        sensor: SensorProfile | Path | str | None = None,
        friction: FrictionLike | None = None,
        engine: str = "auto",
        device: str = "cpu",
        smoothing_s: float = 0.0,
        seconds: float | None = None,
        stall_s: float = 1.0,
        forces: Path | str | None = None,
        health: Callable[[Frame, Run | None], HealthWatch] | None = HealthMonitor,
        slip: Callable[[Float[np.ndarray, "markers 2"]], SlipWatch] | None = SlipDetector,
    ) -> None:
        if not smoothing_s >= 0:
            raise InputError(f"--smoothing must be 0 or more seconds, got {smoothing_s:g}")
        if seconds is not None and not seconds > 0:
            raise InputError(f"--seconds must be positive, got {seconds:g}")
        profile = None if sensor is None else load_profile(sensor)
        if network is None and profile is not None:
            network = profile.network
        self.network = load(network, device=device) if isinstance(network, Path | str) else network
        self._friction = None if friction is None else SlipLearner(as_friction(friction))
        if self._friction is not None:
            if self.network is None:
                raise InputError("--friction makes a margin of what a network reads; name one with --network")
            self.network.require_ratio()
        options = options or SourceOptions()
        if self.network is not None and profile is None:
            options = replace(options, fit_size=self.network.manifest.frame_size)
        self.source = open_live(source, options=options)
        named = read_image(Path(reference)) if isinstance(reference, Path | str) else reference
        if profile is not None:
            self.source = ProfiledSource(self.source, profile)
            named = None if named is None else profile.apply(named)
        self.reference: Frame | None = None
        """The sensor untouched, as the next frame is compared with it."""
        self.engine: Engine | None = None
        """What runs the network, while it is entered."""
        self._named, self._profile = named, profile
        self._engine_name, self._seconds, self._stall_s = engine, seconds, stall_s
        self._smooth = LowPass(time_constant_s=smoothing_s)
        self.recorder: Recorder | None = None
        """What records, while something is recorded."""
        self._forces = None if forces is None else ForceStream(forces)
        self._make_health, self._make_slip = health, slip
        self._health: HealthWatch | None = None
        self._slip: SlipWatch | None = None
        self._tracker: Tracker | None = None
        self._frames: _Newest[LiveFrame] = _Newest()
        self._listening: list[_Newest[Reading]] = []
        self._subscribers: list[Subscriber] = []
        self._latest: Reading | None = None
        self._taker: _ReferenceTaker | None = None
        self._asked, self._stopped, self._over = Event(), Event(), Event()
        self._error: BaseException | None = None
        self._trouble: str | None = None
        self._last: LiveFrame | None = None
        self._dropped = 0
        self._threads: list[Thread] = []
        self._stack = ExitStack()

    def __enter__(self) -> "LiveReader":
        with ExitStack() as stack:
            stack.callback(self.stop_recording)
            stack.enter_context(self.source)
            if self._forces is not None:
                stack.enter_context(self._forces)
            if self.network is not None:
                self.network.require_frame_size(self.source.size, what=f"the frames of {self.source.name}")
                self.engine = self._make_engine(self.network)
            untouched = self.source.reference if self._named is None else self._named
            if untouched is None:
                self._taker = _ReferenceTaker()
            else:
                self._set_reference(untouched)
            self._stack = stack.pop_all()
        self._threads = [Thread(target=self._run, args=(job,), daemon=True) for job in (self._capture, self._infer)]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop capturing and reading; those who wait for readings are told that there are no more."""
        self._stopped.set()
        self.source.close()
        self._frames.close()
        for thread in self._threads:
            thread.join(_PATIENCE_S)  # a driver that hangs is left to itself
        self._stack.close()

    def readings(self) -> Iterator[Reading]:
        """Readings as they come; who asks late gets the newest, and `Reading.number` tells what was left out.

        Raises
        ------
        SliplensError
            If the source breaks off for good, or a frame cannot be read.
        """
        place: _Newest[Reading] = _Newest()
        self._listening.append(place)
        if self._over.is_set():
            place.close()
        try:
            while (reading := place.take()) is not None:
                yield reading
        finally:
            self._listening.remove(place)
        if self._error is not None:
            raise self._error

    def latest(self) -> Reading | None:
        """Newest reading; None before the first."""
        return self._latest

    def subscribe(self, callback: Subscriber) -> Callable[[], None]:
        """Have every reading and its frame told, none left out; gives what ends it.

        The callback is called in the thread that reads, which waits for it: hand on what takes long.
        """
        self._subscribers.append(callback)

        def end() -> None:
            with suppress(ValueError):
                self._subscribers.remove(callback)

        return end

    def take_reference(self) -> None:
        """Take a new reference as soon as the picture is still; the old one holds until then."""
        self._asked.set()

    def record(self, folder: Path | str, *, facts: TrialFacts | None = None) -> Recorder:
        """Record every frame from now on, read or not, into a data set, a new one or one that is there.

        Frames before there is a reference are left out. `facts`: who, when and what, as `Recorder` takes them.

        Raises
        ------
        RecordingError
            If something is recorded already, or the folder is something else.
        """
        if self.recorder is not None:
            raise RecordingError(f"{self.recorder.folder} is being recorded; stop that first")
        facts = facts or TrialFacts(trial="live")
        if self._profile is not None:
            facts = replace(facts, sensor=self._profile.name)
        if self.network is not None and not facts.sensor:
            facts = replace(facts, sensor=self.network.manifest.sensor)
        self.recorder = Recorder(
            folder,
            facts=facts,
            source=self.source.name,
            simulated=self.source.simulated,
            reference=self.reference,
        )
        if self._profile is not None:
            keep_profile(Path(folder), self._profile)
        return self.recorder

    def stop_recording(self) -> Dataset | None:
        """End the recording; gives its data set, None where there is none, or no frame of it."""
        recorder, self.recorder = self.recorder, None
        return None if recorder is None else recorder.close()

    def _make_engine(self, network: Run) -> Engine:
        """The engine that was named, or the fastest that pays for the frames to come."""
        rate_hz, seconds = self.source.rate_hz or 30.0, self._seconds or np.inf
        frames = min(self.source.count or np.inf, rate_hz * seconds, _MOST_FRAMES)
        # before any thread runs: torch's tracing changes what every thread calls
        return make_engine(self._engine_name, network, frames=round(frames), batch_size=1, streams=1)

    def _run(self, job: Callable[[], None]) -> None:
        try:
            job()
        except BaseException as error:
            self._error = self._error or error
            self._stopped.set()
            self.source.close()
            self._frames.close()

    def _capture(self) -> None:
        """Capture until the source ends; one that is lost is opened again until it is back."""
        try:
            while not self._stopped.is_set():
                try:
                    for frame in self.source.frames():
                        if self._stopped.is_set():
                            return
                        self._trouble = None
                        if self._forces is not None:
                            frame = self._forces.attach(frame)  # noqa: PLW2901
                        if self.recorder is not None and self.reference is not None:
                            self.recorder.add(frame)
                        self._frames.put(frame)
                except SourceError as error:
                    if not self.source.reconnects:
                        raise
                    self._trouble = str(error)
                    self._reconnect()
                else:
                    return
        finally:
            self._frames.close()

    def _reconnect(self) -> None:
        while not self._stopped.wait(_RETRY_S):
            self.source.__exit__(None, None, None)
            try:
                self.source.__enter__()
            except SourceError as error:
                self._trouble = str(error)
            else:
                return

    def _infer(self) -> None:
        ends_s = np.inf if self._seconds is None else time.monotonic() + self._seconds
        try:
            while (left_s := ends_s - time.monotonic()) > 0:
                frame = self._frames.take(min(self._stall_s, left_s))
                if frame is not None:
                    self._tell(self._read(frame), frame)
                elif self._frames.closed:
                    break
                elif time.monotonic() < ends_s:
                    self._tell(self._missing(), None)
        finally:
            self._stopped.set()
            self.source.close()
            self._over.set()
            for place in tuple(self._listening):
                place.close()

    def _tell(self, reading: Reading, frame: LiveFrame | None) -> None:
        self._latest = reading
        for place in tuple(self._listening):
            place.put(reading)
        for callback in tuple(self._subscribers):
            callback(reading, frame)

    def _missing(self) -> Reading:
        """Reading where no frame came."""
        last, source = self._last, self.source
        return Reading(
            number=-1 if last is None else last.number,
            time_s=np.nan if last is None else last.time_s,
            captured_s=np.nan if last is None else last.captured_s,
            withheld=self._trouble or f"{source.name} has given no frame for {self._stall_s:g} s; {source.cure}",
            dropped=self._dropped,
        )

    def _set_reference(self, image: Frame) -> None:
        if self.recorder is not None:
            self.recorder.set_reference(image)
        self.reference = image
        self._health = None if self._make_health is None else self._make_health(image, self.network)
        self._begin_anew()

    def _look_for_reference(self, frame: LiveFrame) -> None:
        if self._asked.is_set():
            self._asked.clear()
            self._taker = _ReferenceTaker()
        if self._taker is not None and (image := self._taker.offer(frame)) is not None:
            self._taker = None
            self._set_reference(image)

    def _read(self, frame: LiveFrame) -> Reading:
        last, self._last = self._last, frame
        self._dropped += 0 if last is None else max(0, frame.number - last.number - 1)
        jump_s = 0.0 if last is None else self._clock_jump(last, frame)
        if jump_s:
            self._begin_anew()
        begin = Reading(
            number=frame.number,
            time_s=frame.time_s,
            captured_s=frame.captured_s,
            dropped=self._dropped,
            true_margin=frame.safety_margin,
        )
        if frame.size != self.source.size or jump_s:
            return self._withhold(begin, frame, self._sentence(frame, jump_s))
        self._look_for_reference(frame)
        if self.reference is None:
            still = "the picture must be still for a moment: leave the sensor untouched"
            return self._withhold(begin, frame, f"there is no reference frame yet; {still}")
        followed = markers = None
        if self._tracker is not None and self._slip is not None:
            followed = self._tracker.update(frame.image)
            markers = self._slip.update(followed.position_px[: len(self._tracker.rest)], frame.time_s)
        health = () if self._health is None else self._health.check(frame, followed)
        withheld = next((check.sentence for check in health if not check.ok), None)
        reading = replace(begin, slip=markers and markers.state, markers=markers, health=health)
        untouched = any(check.name == "touch" and not check.ok for check in health)
        if untouched or (markers is not None and markers.contact is False):
            reading = replace(reading, contact_state=ContactState.NO_CONTACT)
            withheld = withheld or (None if self.network is None else _NO_CONTACT)
        if self._friction is not None:
            slipping_s = None if markers is None else markers.slipping_s
            touches = reading.contact_state != ContactState.NO_CONTACT
            self._friction.update(frame.time_s, slipping_s=slipping_s, touches=touches)
        if self.network is None or withheld is not None:
            return self._withhold(reading, frame, withheld)
        return self._estimate(reading, frame)

    def _withhold(self, reading: Reading, frame: LiveFrame, why: str | None) -> Reading:
        self._smooth.forget()
        latency = Latency(decode_ms=frame.decode_ms, total_ms=_since_ms(frame.captured_s))
        return replace(reading, withheld=why, latency=latency)

    def _clock_jump(self, last: LiveFrame, frame: LiveFrame) -> float:
        """Seconds by which the clock of the source jumped; 0 where it went on."""
        passed_s = frame.time_s - last.time_s
        off_s = passed_s - self.source.speed * (frame.captured_s - last.captured_s)
        return off_s if passed_s <= 0 or abs(off_s) > _JUMP_S else 0.0

    def _sentence(self, frame: LiveFrame, jump_s: float) -> str:
        if frame.size == self.source.size:
            return f"the clock of {self.source.name} jumped by {jump_s:+.3g} s; the next frame is read again"
        (height, width), (before_height, before_width) = frame.size, self.source.size
        return (
            f"the frames of {self.source.name} are now {height} x {width} pixels, they were {before_height} x "
            f"{before_width}; set the camera as it was, or start again"
        )

    def _begin_anew(self) -> None:
        """Forget what came before, where frames no longer follow each other."""
        self._smooth.forget()
        if self._make_slip is not None and self.reference is not None:
            try:
                self._tracker = Tracker(self.reference)
                self._slip = self._make_slip(self._tracker.rest.centre_px)
            except (ImageError, InputError):
                self._tracker = self._slip = None  # it shows no markers, or too few

    def _estimate(self, reading: Reading, frame: LiveFrame) -> Reading:
        assert self.network is not None
        assert self.engine is not None
        assert self.reference is not None
        begun = time.perf_counter()
        inputs = self.network.encode(frame.image[None], self.reference)
        encoded = time.perf_counter()
        friction = None if self._friction is None else self._friction.friction
        estimate = self.engine.estimate(self.network, inputs, friction=friction)
        done = time.perf_counter()
        ratio = None if estimate.ratio is None else float(estimate.ratio.mean[0])
        if self._friction is not None and ratio is not None and estimate.ratio is not None:
            self._friction.note(ratio, sigma=float(estimate.ratio.sigma[0]), time_s=frame.time_s)
        interval = estimate.interval(LEVEL)
        values = [estimate.margin] if interval is None else [estimate.margin, *interval]
        margin, *ends = np.clip(np.concatenate(values), 0, 1)
        margin, *ends = self._smooth.update(np.array([margin, *ends]), frame.time_s).tolist()
        [state] = contact_states(np.array([margin]), without=ContactState.UNKNOWN)
        latency = Latency(
            decode_ms=frame.decode_ms,
            encode_ms=1e3 * (encoded - begun),
            network_ms=1e3 * (done - encoded),
            total_ms=_since_ms(frame.captured_s),
        )
        low, high = ends or (None, None)
        return replace(
            reading,
            margin=margin,
            low=low,
            high=high,
            ratio=ratio,
            friction=None if friction is None else str(friction),
            contact_state=state,
            lag_s=self._smooth.time_constant_s,
            latency=latency,
        )


def _since_ms(captured_s: float) -> float:
    return 1e3 * (time.monotonic() - captured_s)


def read_live(
    source: str | Path | Images | Capture | LiveSource = "simulated",
    network: Run | Path | str | None = None,
    *,
    reference: Path | str | Frame | None = None,
    options: SourceOptions | None = None,
    sensor: SensorProfile | Path | str | None = None,
    friction: FrictionLike | None = None,
    engine: str = "auto",
    device: str = "cpu",
    smoothing_s: float = 0.0,
    seconds: float | None = None,
) -> Iterator[Reading]:
    """Readings of a running sensor, one after another; who is slow gets the newest.

    Parameters are those of `LiveReader`, which also takes a new reference while it runs, and tells every reading to
    whoever subscribes.

    Raises
    ------
    SliplensError
        If the source or the network is not there, does not fit, or breaks off.

    Examples
    --------
    >>> import sliplens as sl
    >>> reading = next(sl.read_live("simulated"))
    >>> reading.margin is None, reading.true_margin is None  # no network, no touch yet
    (True, True)
    """
    with LiveReader(
        source,
        network,
        reference=reference,
        options=options,
        sensor=sensor,
        friction=friction,
        engine=engine,
        device=device,
        smoothing_s=smoothing_s,
        seconds=seconds,
    ) as reader:
        yield from reader.readings()


__all__ = ["HealthWatch", "LiveReader", "SlipWatch", "Subscriber", "read_live"]
