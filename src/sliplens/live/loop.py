"""Loop of a running sensor: one thread captures, one reads; late frames are dropped and counted."""

import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Condition, Event, Lock, Thread
from typing import TypeAlias, Unpack

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from sliplens.errors import InputError, RecordingError, SourceError
from sliplens.extras import import_cv2, missing_packages, require_keywords
from sliplens.friction import Friction
from sliplens.live.contract import LiveOptions, LiveSource
from sliplens.live.frame_reader import FrameReader, ReaderSettings, ReferenceTaker
from sliplens.live.mailbox import Mailbox, Outlet
from sliplens.live.reading import LiveFrame, Reading
from sliplens.live.recorder import ForceStream, Recorder
from sliplens.live.sinks import Sender
from sliplens.live.sources import Images, open_live
from sliplens.models.checkpoint import Network
from sliplens.models.engines import make_engine
from sliplens.models.wrapping import open_run
from sliplens.recordings.capture import Capture
from sliplens.recordings.dataset import Dataset, save_profile
from sliplens.recordings.sensor import load_profile
from sliplens.recordings.source import read_reference
from sliplens.recordings.trial import TrialFacts

Subscriber = Callable[[Reading, LiveFrame | None], None]
"""Called with each reading and its frame, in the thread that reads; None where there is no frame to it."""

_MOST_FRAMES = 10**6
_RETRY_S = 1.0  # between two tries to open a source that was lost
_PATIENCE_S = 3.0
_SWITCH_S = 5e-4
_FLUSH_S = 5.0


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


LiveInput: TypeAlias = "str | Path | Images | Capture | LiveSource"


class LiveReader(FrameReader):
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
        profile = None if sensor is None else load_profile(sensor)
        if network is None and profile is not None:
            network = profile.network
        run = None if network is None else open_run(network, device=settings.get("device", "cpu"))
        options = settings.get("options") or LiveOptions()
        if run is not None and profile is None:
            options = replace(options, fit_size=run.manifest.frame_size)
        super().__init__(open_live(source, options=options), run, **settings)
        untouched = None if reference is None else read_reference(reference)
        self.recorder: Recorder | None = None
        """Recorder, while it records."""
        self.outputs: tuple[Outlet, ...] = ()
        """Newest recording, and each sink, with what they have sent."""
        self._untouched, self._profile = untouched, profile
        self._engine_name, self._stall_s = settings.get("engine", "auto"), settings.get("stall_s", 1.0)
        self._forces = None if forces is None else ForceStream(forces)
        self._frames: Mailbox[LiveFrame] = Mailbox()
        self._news = Condition()
        self._newest: Reading | None = None
        self._subscribers: dict[Subscriber, None] = {}
        self._stopped, self._over = Event(), Event()
        self._error: BaseException | None = None
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
        return self.colour_doubts + self.network.doubts(sensor=sensor, profile=profile, friction=friction)

    @property
    def troubles(self) -> tuple[str, ...]:
        """Why the recording, a sink or the forces have ended, with the cure."""
        troubles = [outlet.trouble for outlet in self.outputs] + [self._forces.trouble if self._forces else None]
        return tuple(trouble for trouble in troubles if trouble is not None)

    @property
    def entered(self) -> bool:
        """True from when it is first entered."""
        return bool(self._threads)

    @property
    def ended(self) -> str | None:
        """Why no more readings come; None while they may."""
        if not self._over.is_set():
            return None
        error = self._error
        return f"{self.source.name} has ended" if error is None else str(error) or type(error).__name__

    @property
    def failed(self) -> bool:
        """True where it ended because the source or a frame failed."""
        return self._over.is_set() and self._error is not None

    def __enter__(self) -> "LiveReader":
        if self._threads:
            raise InputError("a reader reads once; make another one of the same source")
        with ExitStack() as stack:
            stack.enter_context(_few_threads())
            stack.callback(self._end_outputs)
            stack.enter_context(self.source)
            if self._forces is not None:
                stack.enter_context(self._forces)
            engine = None
            profile, size = self._profile, self.source.size
            untouched = self.source.reference if self._untouched is None else self._untouched
            if profile is not None:
                size, untouched = profile.output_size(size), None if untouched is None else profile.apply(untouched)
            if self.network is not None:
                self.network.require_frame_size(size, what=f"the frames of {self.source.name}")
                # before any thread runs: torch's tracing changes what every thread calls
                frames = min(self.source.count or np.inf, (self.source.rate_hz or 30.0) * (self._seconds or np.inf))
                frames = round(min(frames, _MOST_FRAMES))
                engine = make_engine(self._engine_name, self.network, frames=frames, batch_size=1, streams=1)
            self.begin(engine, untouched, size=size)
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
        if not self._threads:
            raise InputError("nothing is read yet; enter the reader first, with `with reader:`")
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
        if self._error is not None:
            raise self._error

    def subscribe(self, callback: Subscriber) -> Callable[[], object]:
        """Call back with every reading and its frame; returns a function that ends it.

        The callback runs in the thread that reads, which waits for it: do long work elsewhere.
        """
        self._subscribers[callback] = None
        return lambda: self._subscribers.pop(callback, None)

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
            save_profile(Path(folder), profile)
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
            self._error = self._error or error
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
                self._publish(self.read(frame), frame)
            elif self._frames.closed:
                break
            elif time.monotonic() < ends_s:
                self._publish(self.missing(self._trouble or silent), None)

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


def read_live(
    source: LiveInput = "simulated", network: Network | Path | str | None = None, **settings: Unpack[ReaderSettings]
) -> Iterator[Reading]:
    """Iterate over the readings of a running sensor; a slow caller gets the newest.

    Parameters are those of `LiveReader`, which also takes a new reference while it runs, and calls back with every
    reading.

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


__all__ = ["LiveReader", "ReaderSettings", "Subscriber", "read_live"]
