"""Loop of a running sensor: one thread captures, one reads; late frames are dropped and counted."""

import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Condition, Event, Lock, Thread
from typing import TypeAlias, TypedDict, Unpack

import numpy as np
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits
from torch import Tensor

from sliplens.errors import ImageError, InputError, RecordingError, SourceError
from sliplens.extras import import_cv2, missing_packages, require_keywords
from sliplens.friction import Friction, FrictionLike, SlipLearner, as_friction
from sliplens.images import require_rgb, soften
from sliplens.live.contract import LiveOptions, LiveSource
from sliplens.live.health import HealthMonitor, check_direction, check_novelty, margin_risk
from sliplens.live.mailbox import Mailbox, Outlet
from sliplens.live.reading import OFF, TARGET, Latency, LiveFrame, Reading, SlipState, small_picture
from sliplens.live.recorder import ForceStream, Recorder
from sliplens.live.sinks import Sender
from sliplens.live.slip import SlipDetector
from sliplens.live.sources import Images, open_live
from sliplens.markers import Tracker
from sliplens.models.checkpoint import Network
from sliplens.models.engines import Engine, make_engine
from sliplens.models.predictions import LEVEL
from sliplens.models.wrapping import open_run
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import Dataset
from sliplens.recordings.sensor import SENSORS_FOLDER, SensorProfile, load_profile, save_profile
from sliplens.recordings.source import read_reference
from sliplens.recordings.trial import ContactState, TrialFacts, contact_states
from sliplens.shear import ShearEstimator

Subscriber = Callable[[Reading, LiveFrame | None], None]
"""Called with each reading and its frame, in the thread that reads; None where there is no frame to it."""

_MOST_FRAMES = 10**6
_RETRY_S = 1.0  # between two tries to open a source that was lost
_PATIENCE_S = 3.0
_SWITCH_S = 5e-4
_FLUSH_S = 5.0
_JUMP_S = 1.0
_STILL_S, _STILL_FRAMES, _STILL_GREY = 0.3, 5, 0.75
_DARK, _BRIGHT = 8.0, 247.0
_WIDE_PX = 5.0
_lock, _entered, _limits = Lock(), list[object](), ExitStack()


@contextmanager
def _few_threads() -> Iterator[None]:
    """Limit the threads of the whole process while any reader is entered; the last one that leaves undoes it.

    Threads that share one step wait for each other: a matrix of markers takes ten times as long by two as by one.
    """
    with _lock:
        _entered.append(None)
        if len(_entered) == 1:
            restore, threads = _limits.callback, torch.get_num_threads()
            restore(threadpool_limits(1, user_api="blas").restore_original_limits)
            restore(torch.set_num_threads, threads)
            torch.set_num_threads(max(1, threads - 1))  # the checks have a core
            # a thread that has waited for a core waits for Python too, and the usual 5 ms are a third of a frame
            restore(sys.setswitchinterval, sys.getswitchinterval())
            sys.setswitchinterval(_SWITCH_S)
            # existing objects stay: to search all of them for garbage takes as long as half a frame
            restore(gc.unfreeze)
            gc.freeze()
            if not missing_packages("cv2", extra="markers"):
                cv2 = import_cv2()
                restore(cv2.setNumThreads, cv2.getNumThreads())
                cv2.setNumThreads(1)
    try:
        yield
    finally:
        with _lock:
            _entered.pop()
            if not _entered:
                _limits.close()


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
    """If True, every grasp is of one object, until `new_object`: the friction estimated from a slip counts in later
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


LiveInput: TypeAlias = "str | Path | Images | Capture | LiveSource"


class LiveReader:
    """Readings of a running sensor; a context manager that captures and predicts while it is entered.

    One thread captures and one reads, with a place for the newest frame only between them: a network that is slower
    than the camera drops frames, counts them, and never lags behind. While it is entered, NumPy's matrices and OpenCV
    have one thread and torch has one less than before, in the whole process. A frame is checked while the network runs,
    whose output is dropped where a check withholds the margin.

    Parameters
    ----------
    source
        As `open_live` takes it: `simulated`, a path, frames, or a source.
    network
        Network, its folder, or the name of one that comes with sliplens; None for markers and health alone.
    **settings
        As `ReaderSettings` lists them.

    Raises
    ------
    InputError
        If the source or the network is not there, or a setting cannot be used.
    ImageError
        If the frames are of another size than those of the network's sensor.

    See Also
    --------
    read_live : Iterate over readings, without the rest.
    hold_grip : Control a gripper by a reader.

    Examples
    --------
    >>> import numpy as np
    >>> import sliplens as sl
    >>> frames = np.full((20, 224, 224, 3), 128, dtype=np.uint8)
    >>> with sl.LiveReader(frames, "chromatouch-pair", reference=frames[0], engine="torch") as reader:
    ...     readings = list(reader.readings())
    >>> readings[-1].number
    19
    """

    def __init__(
        self,
        source: LiveInput = "simulated",
        network: Network | Path | str | None = None,
        **settings: Unpack[ReaderSettings],
    ) -> None:
        require_keywords(LiveReader, settings)
        self._seconds = settings.get("seconds")
        if self._seconds is not None and not self._seconds > 0:
            raise InputError(f"--seconds must be positive, got {self._seconds:g}")
        sensor, reference, forces = (settings.get(name) for name in ("sensor", "reference", "forces"))
        self._profile = None if sensor is None else load_profile(sensor)
        if network is None and self._profile is not None:
            network = self._profile.network
        self.network = None if network is None else open_run(network, device=settings.get("device", "cpu"))
        if self.network is not None and (unit := self.network.manifest.unit) != "margin":
            raise InputError(
                f"a running sensor needs safety margins from 0 to 1, and this module predicts {unit or 'numbers'}; if "
                'these are margins, give sliplens.wrap(module, unit="margin"), else use predict on a recording'
            )
        options = settings.get("options") or LiveOptions()
        if self.network is not None and self._profile is None:
            options = replace(options, fit_size=self.network.manifest.frame_size)
        self.source = open_live(source, options=options)
        self.learner: SlipLearner
        """Friction that was set, and that slips teach."""
        self._same_object = settings.get("same_object", False)
        self.new_object(settings.get("friction"))
        self.reference = None if reference is None else read_reference(reference)
        """The sensor untouched, as the next frame is compared with it."""
        self.taker: ReferenceTaker | None = None
        """Search for a new reference, until it is taken."""
        self.markers_px: tuple[np.ndarray, np.ndarray] | None = None
        """Places (x, y) of the markers at rest and in the newest frame, in pixels, NaN where one is not seen.

        None where no markers are tracked.
        """
        self.recorder: Recorder | None = None
        """Recorder, while it records."""
        self.outputs: tuple[Outlet, ...] = ()
        """Newest recording, and each sink, with what they have sent."""
        self._make_health, self._make_slip = settings.get("health", HealthMonitor), settings.get("slip", SlipDetector)
        self._health: HealthMonitor | None = None
        self._shear: ShearEstimator | None = None
        self._slip: SlipDetector | None = None
        self._tracker: Tracker | None = None
        self._smaller, self._dropped, self._colour_doubts = 1, 0, ()
        self._engine_name, self._stall_s = settings.get("engine", "auto"), settings.get("stall_s", 1.0)
        self.engine: Engine | None = None
        """Engine of the network, while it is entered."""
        self._forces = None if forces is None else ForceStream(forces)
        self._frames: Mailbox[LiveFrame] = Mailbox()
        self._news, self._stopped, self._over = Condition(), Event(), Event()
        self._last: Reading | None = None  # reading of the last frame; None where frames do not follow each other
        self._newest: Reading | None = None
        self._subscribers: dict[Subscriber, None] = {}
        self.error: BaseException | None = None
        """Failure of the source or a frame that ended it."""
        self._trouble: str | None = None
        self._threads: list[Thread] = []
        self._stack = ExitStack()

    @property
    def doubts(self) -> tuple[str, ...]:
        """Ways in which this use differs from the network's training, a sentence each.

        Another sensor or direction of the pull, other friction, and grey frames once a reference was taken.
        """
        if self.network is None:
            return ()
        profile, friction = self._profile, self.learner.friction
        sensor = "" if profile is None else profile.name
        return self._colour_doubts + self.network.doubts(sensor=sensor, profile=profile, friction=friction)

    @property
    def troubles(self) -> tuple[str, ...]:
        """Why the recording, a sink or the forces have ended, with the cure."""
        troubles = [outlet.trouble for outlet in self.outputs] + [self._forces.trouble if self._forces else None]
        return tuple(trouble for trouble in troubles if trouble is not None)

    @property
    def ended(self) -> str | None:
        """Why no more readings come; None while they may."""
        if not self._over.is_set():
            return None
        error = self.error
        return f"{self.source.name} has ended" if error is None else str(error) or type(error).__name__

    def require_entered(self) -> None:
        """Refuse a reader that was never entered."""
        if not self._threads:
            raise InputError("there is no reading yet; enter the reader first, with `with reader:`")

    def __enter__(self) -> "LiveReader":
        if self._threads:
            raise InputError("a reader reads once; make another one of the same source")
        with ExitStack() as stack:
            stack.enter_context(_few_threads())
            stack.callback(self._end_outputs)
            stack.enter_context(self.source)
            if self._forces is not None:
                stack.enter_context(self._forces)
            self._size = self.source.size
            untouched, self.reference = self.source.reference if self.reference is None else self.reference, None
            if self._profile is not None:
                self._size = self._profile.output_size(self._size)
                untouched = None if untouched is None else self._profile.apply(untouched)
            if self.network is not None:
                self.network.require_frame_size(self._size, what=f"the frames of {self.source.name}")
                # before any thread runs: torch's tracing changes what every thread calls
                frames = min(self.source.count or np.inf, (self.source.rate_hz or 30.0) * (self._seconds or np.inf))
                frames = round(min(frames, _MOST_FRAMES))
                self.engine = make_engine(self._engine_name, self.network, frames=frames, batch_size=1, streams=1)
            if untouched is None:
                self.take_reference()
            else:
                require_rgb(untouched, what="levels of the reference")
                if untouched.shape[:2] != self._size:
                    raise ImageError(
                        f"the reference has {_in_pixels(untouched.shape[:2])} pixels, the frames of {self.source.name} "
                        f"have {_in_pixels(self._size)}; name an image of this camera with --reference, or leave it out"
                    )
                self._set_reference(untouched)
            self._stack = stack.pop_all()
        jobs = (self._capture, self._frames.shut), (self._infer, self._finish)
        self._threads = [Thread(target=self._run, args=job, daemon=True) for job in jobs]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop capturing and reading; iterators of readings end."""
        self._end()
        for thread in self._threads:
            thread.join(_PATIENCE_S)  # a driver that hangs is left to itself
        self._stack.close()
        self._end_outputs()

    def readings(self) -> Iterator[Reading]:
        """Iterate over readings as they come; a slow or late caller, even after the end, gets the newest.

        Gaps in `Reading.number` show what was left out.

        Raises
        ------
        InputError
            If the reader was not entered.
        SliplensError
            If the source breaks off for good, or a frame cannot be read.
        """
        self.require_entered()
        reading = None
        while True:
            with self._news:
                while self._newest is reading and not self._over.is_set():
                    self._news.wait()
                if self._newest is reading:
                    break
                reading = self._newest
            assert reading is not None
            yield reading
        if self.error is not None:
            raise self.error

    def subscribe(self, callback: Subscriber) -> Callable[[], object]:
        """Call back with every reading and its frame; returns a function that ends it.

        The callback runs in the thread that reads, which waits for it: do long work elsewhere.
        """
        self._subscribers[callback] = None
        return lambda: self._subscribers.pop(callback, None)

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

    @property
    def learnt(self) -> Friction | None:
        """Friction of the object that slipped last, for a later grasp; None before any slip."""
        return self.learner.learnt

    def take_reference(self) -> None:
        """Take a new reference as soon as the picture is still; the old one holds until then."""
        self.taker = ReferenceTaker()

    def send_to(self, *sinks: str) -> None:
        """Send every reading and its frame to other programs from now on, until it is closed.

        Each is the name of a sink (docs/live.md), with its address after a colon. A slow sink loses readings and counts
        them, and one that fails is listed in `troubles`; the reading goes on.

        Raises
        ------
        InputError
            If there is no such sink, or it cannot be opened.
        """
        for name in sinks:
            self.outputs += (sender := Sender(name),)
            self.subscribe(sender.add)

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
        facts, profile = facts or TrialFacts(trial="live"), self._profile
        trained = "" if self.network is None else self.network.manifest.sensor
        facts = replace(facts, sensor=facts.sensor or trained if profile is None else profile.name)
        recorder = Recorder(folder, facts=facts, source=self.source.name, simulated=self.source.simulated)
        self.recorder = recorder
        self.outputs = (recorder, *(output for output in self.outputs if isinstance(output, Sender)))
        if profile is not None:
            save_profile(profile, Path(folder) / SENSORS_FOLDER / f"{profile.name}.toml")
        return recorder

    def stop_recording(self) -> Dataset | None:
        """End the recording; returns its data set, None where nothing was recorded."""
        recorder, self.recorder = self.recorder, None
        return None if recorder is None else recorder.close()

    def _end_outputs(self) -> None:
        for output in self.outputs:
            if isinstance(output, Sender) and not output.finish(_FLUSH_S):
                output.shut(discard=True)
        self.stop_recording()

    def _end(self) -> None:
        self._stopped.set()
        self.source.close()
        self._frames.shut()

    def _run(self, job: Callable[[], None], end: Callable[[], None]) -> None:
        try:
            job()
        except BaseException as error:
            self.error = self.error or error
        finally:  # a caller that the end wakes raises the error
            end()

    def _capture(self) -> None:
        """Capture until the source ends; one that is lost is opened again until it is back."""
        lost = False
        while not (self._stopped.wait(_RETRY_S) if lost else self._stopped.is_set()):
            try:
                if lost:
                    self.source.__exit__(None, None, None)
                    self.source.__enter__()
                    if self._stopped.is_set():  # `close` has left it already
                        self.source.__exit__(None, None, None)
                        return
                for frame in self.source.frames():
                    if self._stopped.is_set():
                        return
                    self._trouble = None
                    self._take(frame)
            except SourceError as error:
                if not self.source.reconnects:
                    raise
                lost, self._trouble = True, str(error)
            else:
                return

    def _take(self, frame: LiveFrame) -> None:
        if self._profile is not None and frame.size == self.source.size:  # one of another size is withheld
            begun_s = time.perf_counter()
            image = self._profile.apply(frame.image)
            frame = replace(frame, image=image, decode_ms=frame.decode_ms + 1e3 * (time.perf_counter() - begun_s))
        if self._forces is not None:
            frame = self._forces.attach(frame)
        # other threads may end the recording, or take a new reference, at any time
        if (recorder := self.recorder) is not None and (reference := self.reference) is not None:
            recorder.add(frame, reference)
        self._frames.put(frame)

    def _infer(self) -> None:
        ends_s = np.inf if self._seconds is None else time.monotonic() + self._seconds
        silent = f"{self.source.name} has given no frame for {self._stall_s:g} s; {self.source.cure}"
        while (left_s := ends_s - time.monotonic()) > 0:
            frame = self._frames.take(min(self._stall_s, left_s))
            if frame is not None:
                self._publish(self._read(frame), frame)
            elif self._frames.closed:
                break
            elif time.monotonic() < ends_s:
                self._publish(self._missing(self._trouble or silent), None)

    def _finish(self) -> None:
        self._end()
        with self._news:
            self._over.set()
            self._news.notify_all()

    def _publish(self, reading: Reading, frame: LiveFrame | None) -> None:
        self.source.update_reading(reading)
        with self._news:
            self._newest = reading
            self._news.notify_all()
        for callback in tuple(self._subscribers):
            callback(reading, frame)

    def _missing(self, why: str) -> Reading:
        """Make the reading of a moment without a frame."""
        last = self._last or Reading(number=-1, time_s=np.nan, captured_s=np.nan)
        clock = {"number": last.number, "time_s": last.time_s, "captured_s": last.captured_s}
        return Reading(**clock, withheld=why, dropped=self._dropped)

    def _read(self, frame: LiveFrame) -> Reading:
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
        reading = self._predict(begin, frame) if why is None else replace(begin, withheld=why)
        total_ms = 1e3 * (time.monotonic() - frame.captured_s)
        self._last = replace(reading, latency=replace(reading.latency, total_ms=total_ms))
        return self._last

    def _predict(self, begin: Reading, frame: LiveFrame) -> Reading:
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
            why = "nothing touches the sensor, and without a contact there is no margin; press it"
            withheld = withheld or (None if self.network is None else why)
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
        self._colour_doubts = () if self.network is None else self.network.doubts(frame=image)
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


def read_live(
    source: LiveInput = "simulated", network: Network | Path | str | None = None, **settings: Unpack[ReaderSettings]
) -> Iterator[Reading]:
    """Iterate over the readings of a running sensor; a slow caller gets the newest.

    Parameters are those of `LiveReader`.

    Raises
    ------
    SliplensError
        If the source or the network is not there, does not fit, or breaks off.

    See Also
    --------
    LiveReader : Context manager with a new reference, counters and callbacks.
    predict : Predict recorded frames.

    Examples
    --------
    >>> import sliplens as sl
    >>> reading = next(sl.read_live("simulated"))
    >>> reading.margin is None, reading.true_margin is None  # no network, no touch yet
    (True, True)
    """
    with LiveReader(source, network, **settings) as reader:
        yield from reader.readings()


def _in_pixels(size: tuple[int, ...]) -> str:
    return f"{size[0]} x {size[1]}"
