"""The loop of a running sensor: one thread captures, one reads, and what is too late is dropped and counted."""

import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from inspect import signature
from pathlib import Path
from threading import Event, Lock, Thread
from typing import ParamSpec, TypeVar
from weakref import WeakSet

import numpy as np
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from sliplens.errors import InputError, RecordingError, SourceError
from sliplens.extras import import_cv2, missing_packages
from sliplens.friction import Friction, FrictionLike
from sliplens.images import read_image
from sliplens.live.contract import LiveSource, SourceOptions
from sliplens.live.frame_reader import FrameReader, HealthWatch, SlipWatch
from sliplens.live.health import HealthMonitor
from sliplens.live.mailbox import Mailbox
from sliplens.live.reading import LiveFrame, Reading
from sliplens.live.recorder import ForceStream, Recorder, RecordingState
from sliplens.live.sinks import Sender, SinkState
from sliplens.live.slip import SlipDetector
from sliplens.live.sources import Images, ProfiledSource, open_live
from sliplens.models.checkpoint import Network, open_run
from sliplens.models.engines import Engine, make_engine
from sliplens.progress import number_of
from sliplens.recordings.capture import Capture, Frame
from sliplens.recordings.dataset import Dataset, save_profile
from sliplens.recordings.sensor import SensorProfile, load_profile
from sliplens.recordings.trial import TrialFacts

Given = ParamSpec("Given")
Result = TypeVar("Result")
Subscriber = Callable[[Reading, LiveFrame | None], None]
"""Called with each reading and its frame, in the thread that reads; None where there is no frame to it."""

_MOST_FRAMES = 10**6
_RETRY_S = 1.0  # between two tries to open a source that was lost
_PATIENCE_S = 3.0
_SWITCH_S = 5e-4


class _SharedCores:
    """Threads of the whole process, held down from when the first reader is entered until the last one is left.

    A frame is checked in one thread and read by the network in another, and the page draws beside them. Threads that
    share one step of that wait for each other, and some spin meanwhile: on cores that are all in use a matrix of
    markers takes ten times as long by two threads as by one.
    """

    def __init__(self) -> None:
        self._lock, self._readers, self._restore = Lock(), 0, ExitStack()

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Hold them down."""
        with self._lock:
            if not self._readers:
                with ExitStack() as held:
                    self._hold(held.callback)
                    self._restore = held.pop_all()
            self._readers += 1
        try:
            yield
        finally:
            with self._lock:
                self._readers -= 1
                if not self._readers:
                    self._restore.close()

    def _hold(self, later: Callable[..., object]) -> None:
        later(threadpool_limits(1, user_api="blas").restore_original_limits)
        threads = torch.get_num_threads()
        later(torch.set_num_threads, threads)
        torch.set_num_threads(max(1, threads - 1))  # the checks have a core
        # a thread that has waited for a core waits for Python too, and the usual 5 ms are a third of a frame
        later(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(_SWITCH_S)
        # what is there by now stays: to look through all of it for garbage takes as long as half a frame
        later(gc.unfreeze)
        gc.freeze()
        if not missing_packages("cv2", extra="markers"):
            cv2 = import_cv2()
            later(cv2.setNumThreads, cv2.getNumThreads())
            cv2.setNumThreads(1)


_share_cores = _SharedCores()


class LiveReader:
    """Readings of a running sensor; a context manager that captures and reads while it is entered.

    One thread captures and one reads, with a place for the newest frame only between them: a network that is slower
    than the camera drops frames, counts them, and never lags behind. While it is entered, NumPy's matrices and OpenCV
    have one thread and torch has one less than before, in the whole process.

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
        What is known of the coefficient of friction, as `predict` takes it, for a network that tells F_t / F_n. A slip
        that the markers tell narrows a range down, until the object is let go; `Reading.friction` says what was
        assumed.
    same_object
        Whether every grasp is of one object, until `new_object`: what a slip taught of its friction then counts in the
        grasps that follow. Left out, it does not: the next grasp may be of something else.
    sequence
        Whether what the frames of a contact so far tell counts too, as `predict` takes it. Health and markers tell when
        a contact ends: without both, all frames count as one.
    engine
        `torch`, `openvino`, or `auto` for OpenVINO where it pays for `seconds`, or for hours where that is None, and
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
        Called with each new reference, gives what checks the frames; None for no checks, not even of the network's
        answer (`check_novelty`).
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
    >>> with sl.LiveReader(frames, "chromatouch-pair", reference=frames[0], engine="torch") as reader:
    ...     readings = list(reader.readings())
    >>> readings[-1].number
    19
    """

    def __init__(
        self,
        source: "str | Path | Images | Capture | LiveSource" = "simulated",
        network: Network | Path | str | None = None,
        *,
        reference: Path | str | Frame | None = None,
        options: SourceOptions | None = None,
        sensor: SensorProfile | Path | str | None = None,
        friction: FrictionLike | None = None,
        same_object: bool = False,
        sequence: bool = False,
        engine: str = "auto",
        device: str = "cpu",
        smoothing_s: float = 0.0,
        seconds: float | None = None,
        stall_s: float = 1.0,
        forces: Path | str | None = None,
        health: Callable[[Frame], HealthWatch] | None = HealthMonitor,
        slip: Callable[[Float[np.ndarray, "markers 2"]], SlipWatch] | None = SlipDetector,
    ) -> None:
        if not smoothing_s >= 0:
            raise InputError(f"--smoothing must be 0 or more seconds, got {smoothing_s:g}")
        if seconds is not None and not seconds > 0:
            raise InputError(f"--seconds must be positive, got {seconds:g}")
        profile = None if sensor is None else load_profile(sensor)
        if network is None and profile is not None:
            network = profile.network
        self.network = None if network is None else open_run(network, device=device)
        options = options or SourceOptions()
        if self.network is not None and profile is None:
            options = replace(options, fit_size=self.network.manifest.frame_size)
        self.source = open_live(source, options=options)
        named = read_image(Path(reference)) if isinstance(reference, Path | str) else reference
        if profile is not None:
            self.source = ProfiledSource(self.source, profile)
            named = None if named is None else profile.apply(named)
        self.recorder: Recorder | None = None
        """What records, while something is recorded."""
        self.senders: list[Sender] = []
        """What sends readings to other programs."""
        self._recorded: Recorder | None = None
        self._named, self._profile = named, profile
        self._engine_name, self._seconds, self._stall_s = engine, seconds, stall_s
        self._forces = None if forces is None else ForceStream(forces)
        self._reader = FrameReader(
            self.source,
            self.network,
            friction=friction,
            same_object=same_object,
            sequence=sequence,
            smoothing_s=smoothing_s,
            health=health,
            slip=slip,
        )
        self._frames: Mailbox[LiveFrame] = Mailbox()
        self._telling = Lock()
        self._newest: Reading | None = None
        self._listening: WeakSet[Mailbox[Reading]] = WeakSet()  # until nobody takes from them any more
        self._subscribers: list[Subscriber] = []
        self._stopped, self._over = Event(), Event()
        self._error: BaseException | None = None
        self._trouble: str | None = None
        self._threads: list[Thread] = []
        self._stack = ExitStack()

    @property
    def reference(self) -> Frame | None:
        """The sensor untouched, as the next frame is compared with it."""
        return self._reader.reference

    @property
    def engine(self) -> Engine | None:
        """What runs the network, while it is entered."""
        return self._reader.engine

    @property
    def markers_px(self) -> tuple[Float[np.ndarray, "markers 2"], Float[np.ndarray, "markers 2"]] | None:
        """Places (x, y) of the markers at rest and in the newest frame, in pixels, NaN where one is not seen.

        None where none are followed.
        """
        return self._reader.markers_px

    @property
    def outputs(self) -> tuple[RecordingState | SinkState, ...]:
        """How far the recording is, the last one where none goes on, and each sink."""
        recorder = self._recorded
        return (*(() if recorder is None else (recorder.state,)), *(sender.state for sender in self.senders))

    @property
    def doubts(self) -> tuple[str, ...]:
        """What the network was not made for, a sentence each.

        Another sensor, one that is pulled in another direction, friction that it was not trained on, and grey frames
        once one was compared.
        """
        network, profile, doubts = self.network, self._profile, [self._reader.doubt]
        if network is not None:
            doubts += [] if profile is None else [network.doubt(profile.name), network.doubt_direction(profile)]
            doubts.append(network.doubt_friction(self._reader.learner.friction))
        return tuple(doubt for doubt in doubts if doubt is not None)

    @property
    def troubles(self) -> tuple[str, ...]:
        """What has ended beside the reading, with the cure: the recording, a sink, or the forces."""
        troubles = [state.trouble for state in self.outputs] + [self._forces.trouble if self._forces else None]
        return tuple(trouble for trouble in troubles if trouble is not None)

    @property
    def entered(self) -> bool:
        """Whether it reads, or has read."""
        return bool(self._threads)

    @property
    def ended(self) -> str | None:
        """Why no more readings come; None while they may."""
        if not self._over.is_set():
            return None
        return (
            f"{self.source.name} has ended" if self._error is None else str(self._error) or type(self._error).__name__
        )

    @property
    def failed(self) -> bool:
        """Whether it ended because the source or a frame failed."""
        return self._over.is_set() and self._error is not None

    def __enter__(self) -> "LiveReader":
        if self._threads:
            raise InputError("a reader reads once; make another one of the same source")
        with ExitStack() as stack:
            stack.enter_context(_share_cores())
            stack.callback(self._end_outputs)
            stack.enter_context(self.source)
            if self._forces is not None:
                stack.enter_context(self._forces)
            engine = None
            if self.network is not None:
                self.network.require_frame_size(self.source.size, what=f"the frames of {self.source.name}")
                engine = self._make_engine(self.network)
            self._reader.begin(engine, self.source.reference if self._named is None else self._named)
            self._stack = stack.pop_all()
        jobs = (self._capture, self._frames.close), (self._infer, self._finish)
        self._threads = [Thread(target=self._run, args=job, daemon=True) for job in jobs]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop capturing and reading; those who wait for readings are told that there are no more."""
        self._end()
        for thread in self._threads:
            thread.join(_PATIENCE_S)  # a driver that hangs is left to itself
        self._stack.close()
        self._end_outputs()

    def readings(self) -> Iterator[Reading]:
        """Readings as they come; who asks late, even after the end, gets the newest.

        `Reading.number` tells what was left out.

        Raises
        ------
        InputError
            If the reader was not entered.
        SliplensError
            If the source breaks off for good, or a frame cannot be read.
        """
        if not self._threads:
            raise InputError("nothing is read yet; enter the reader first, with `with reader:`")
        place: Mailbox[Reading] = Mailbox()
        with self._telling:  # from now on, not from when the first is asked for
            if self._newest is not None:
                place.put(self._newest)
            if self._over.is_set():
                place.close()
            self._listening.add(place)
        return self._take_all(place)

    def _take_all(self, place: Mailbox[Reading]) -> Iterator[Reading]:
        while (reading := place.take()) is not None:
            yield reading
        if self._error is not None:
            raise self._error

    def subscribe(self, callback: Subscriber) -> Callable[[], None]:
        """Have every reading and its frame told, none left out; gives what ends it.

        The callback is called in the thread that reads, which waits for it: hand on what takes long.
        """
        self._subscribers.append(callback)

        def end() -> None:
            with suppress(ValueError):
                self._subscribers.remove(callback)

        return end

    @property
    def learnt(self) -> Friction | None:
        """What slips taught of the friction of the object that slipped last, for a grasp to come; None before any."""
        return self._reader.learner.learnt

    @property
    def lesson(self) -> str | None:
        """The same in a sentence, with what to type the next time; None before any slip."""
        learner = self._reader.learner
        if learner.learnt is None:
            return None
        slips = number_of(learner.slips, "slip")
        return (
            f"the object that slipped: friction {learner.learnt.mean:.2f} +- {learner.learnt.sigma:.2f}, from {slips}; "
            f"tell it when you hold the same again, with --friction {learner.learnt.text}"
        )

    def new_object(self, friction: FrictionLike | None = None) -> None:
        """Say that another object is held from now on: what was told or learnt of the friction is dropped.

        Parameters
        ----------
        friction
            What is known of the new one's, as `LiveReader` takes it; nothing if None.

        Raises
        ------
        InputError
            If the friction is none, or the network cannot be told any.
        """
        self._reader.begin_object(friction, same_object=self._reader.learner.same_object)

    def take_reference(self) -> None:
        """Take a new reference as soon as the picture is still; the old one holds until then."""
        self._reader.asked.set()

    def send_to(self, *sinks: str) -> None:
        """Send every reading and its frame to other programs from now on, until it is closed.

        Each is the name of a row of `SINKS`, with its address after a colon. A slow one loses readings and counts them,
        and one that breaks off tells that in `troubles`; the reading goes on.

        Raises
        ------
        InputError
            If there is no such sink, or it cannot be opened.
        """
        for name in sinks:
            sender = Sender(name)
            self.senders.append(sender)
            self.subscribe(sender.put)

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
        recorder = Recorder(folder, facts=facts, source=self.source.name, simulated=self.source.simulated)
        if self._profile is not None:
            try:
                save_profile(Path(folder), self._profile)
            except BaseException:
                recorder.close()
                raise
        self.recorder = self._recorded = recorder
        return recorder

    def stop_recording(self) -> Dataset | None:
        """End the recording; gives its data set, None where there is none, or no frame of it."""
        recorder, self.recorder = self.recorder, None
        return None if recorder is None else recorder.close()

    def _end_outputs(self) -> None:
        for sender in self.senders:
            sender.close()
        self.stop_recording()

    def _make_engine(self, network: Network) -> Engine:
        """The engine that was named, or the fastest that pays for the frames to come."""
        rate_hz, seconds = self.source.rate_hz or 30.0, self._seconds or np.inf
        frames = min(self.source.count or np.inf, rate_hz * seconds, _MOST_FRAMES)
        # before any thread runs: torch's tracing changes what every thread calls
        return make_engine(self._engine_name, network, frames=round(frames), batch_size=1, streams=1)

    def _end(self) -> None:
        self._stopped.set()
        self.source.close()
        self._frames.close()

    def _run(self, job: Callable[[], None], end: Callable[[], None]) -> None:
        try:
            job()
        except BaseException as error:
            self._error = self._error or error
        finally:  # whoever is woken by the end asks for the error
            end()

    def _capture(self) -> None:
        """Capture until the source ends; one that is lost is opened again until it is back."""
        while not self._stopped.is_set():
            try:
                for frame in self.source.frames():
                    if self._stopped.is_set():
                        return
                    self._trouble = None
                    self._take(frame)
            except SourceError as error:
                if not self.source.reconnects:
                    raise
                self._trouble = str(error)
                self._reconnect()
            else:
                return

    def _take(self, frame: LiveFrame) -> None:
        if self._forces is not None:
            frame = self._forces.attach(frame)
        # other threads may end the recording, or take a new reference, at any time
        if (recorder := self.recorder) is not None and (reference := self.reference) is not None:
            recorder.set_reference(reference)
            recorder.add(frame)
        self._frames.put(frame)

    def _reconnect(self) -> None:
        while not self._stopped.wait(_RETRY_S):
            self.source.__exit__(None, None, None)
            try:
                self.source.__enter__()
            except SourceError as error:
                self._trouble = str(error)
                continue
            if self._stopped.is_set():  # nobody else gives it back any more
                self.source.__exit__(None, None, None)
            return

    def _infer(self) -> None:
        ends_s = np.inf if self._seconds is None else time.monotonic() + self._seconds
        silent = f"{self.source.name} has given no frame for {self._stall_s:g} s; {self.source.cure}"
        while (left_s := ends_s - time.monotonic()) > 0:
            frame = self._frames.take(min(self._stall_s, left_s))
            if frame is not None:
                self._tell(self._reader.read(frame), frame)
            elif self._frames.closed:
                break
            elif time.monotonic() < ends_s:
                self._tell(self._reader.missing(self._trouble or silent), None)

    def _finish(self) -> None:
        self._end()
        with self._telling:
            self._over.set()
            for place in self._listening:
                place.close()

    def _tell(self, reading: Reading, frame: LiveFrame | None) -> None:
        self.source.hear(reading)
        with self._telling:
            self._newest = reading
            for place in self._listening:
                place.put(reading)
        for callback in tuple(self._subscribers):
            callback(reading, frame)


def _takes_what(function: Callable[Given, object]) -> Callable[[Callable[..., Result]], Callable[Given, Result]]:
    """Declare that a function takes what another one takes."""

    def declare(declared: Callable[..., Result]) -> Callable[Given, Result]:
        vars(declared)["__signature__"] = signature(function).replace(
            return_annotation=signature(declared).return_annotation
        )
        return declared

    return declare


@_takes_what(LiveReader)
def read_live(*given: object, **options: object) -> Iterator[Reading]:
    """Readings of a running sensor, one after another; who is slow gets the newest.

    Parameters are those of `LiveReader`, such as the coefficient of `friction` that is told; that also takes a new
    reference while it runs, and tells every reading to whoever subscribes.

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
    with LiveReader(*given, **options) as reader:  # pyright: ignore[reportArgumentType] (declared above)
        yield from reader.readings()


__all__ = ["HealthWatch", "LiveReader", "SlipWatch", "Subscriber", "read_live"]
