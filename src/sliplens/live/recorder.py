"""Recording a running source into a data set, frame by frame, and force samples that come as lines of text."""

import itertools
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Event, Thread
from typing import TextIO

import numpy as np

from sliplens.errors import RecordingError
from sliplens.live.mailbox import Outlet
from sliplens.live.reading import LiveFrame
from sliplens.recordings.capture import Forces, Frame
from sliplens.recordings.dataset import Dataset, Journal, JournalHeader, begin_recording, finish_recording, load_dataset
from sliplens.recordings.formats.tables import UNITS, guess_force_columns, guess_time_column, trial_name, unit_of
from sliplens.recordings.trial import TrialFacts

_MOST_WAITING_BYTES = 256 * 2**20
_STUCK_S = 30.0  # in which not a single frame could be written
_FACTS = TrialFacts(trial="live")


class Recorder(Outlet[tuple[LiveFrame, Frame | None]]):
    """Records frames into a data set, a new one or one that is there, as trials `NAME-1`, `NAME-2` and so on.

    A trial ends, and the next begins, where the reference is taken again, the size changes or the clock jumps back. A
    process that is killed loses the frame that it was writing; `recover_dataset` makes trials of the rest.

    Parameters
    ----------
    folder
        Data set.
    facts
        Who, when and what; `trial` is the NAME.
    source
        Name of the camera, stream or file.
    simulated
        True where no real sensor is behind it.

    Raises
    ------
    RecordingError
        If the folder is something else, or is being recorded.
    """

    verb, cure = "recorded", "make room, and record again: what is there stays"

    def __init__(
        self,
        folder: Path | str,
        *,
        facts: TrialFacts = _FACTS,
        source: str = "frames in memory",
        simulated: bool = False,
    ) -> None:
        self.folder, self._facts, self._source = Path(folder), facts, source
        if (name := facts.trial) != trial_name(name):
            raise RecordingError(f"trial {name[:40]!r} is no file name; use letters, digits, dots, dashes, underscores")
        lock, taken = begin_recording(self.folder, simulated=simulated)
        self._finish, self._taken = cache(lambda: finish_recording(self.folder, lock)), set(taken)
        self._journal: Journal | None = None
        self._last: LiveFrame | None = None
        self._first_s = 0.0
        self._reference: Frame | None = None
        super().__init__(str(folder), send=self._write, end=self._end_trial, most_bytes=_MOST_WAITING_BYTES)

    def add(self, frame: LiveFrame, reference: Frame | None = None) -> None:
        """Take a frame, and the sensor untouched; another thread writes it, or loses it where that is far behind."""
        self.put((frame, reference), size_bytes=frame.image.nbytes)

    def close(self) -> Dataset | None:
        """Write the waiting frames and make trials; None where there is no frame at all.

        Raises
        ------
        RecordingError
            If the disk does not answer: what was recorded stays, and `recover_dataset` makes trials of it.
        OSError
            If there is no room; the same holds.
        """
        written = -1
        while not self.finish(_STUCK_S):
            if self.sent == written:
                self.shut(discard=True)
                raise RecordingError(
                    f"{self.folder} takes no more frames, {written} were written; end this program and look after "
                    f"the disk, then run `sliplens recover {self.folder}`"
                )
            written = self.sent
        self._finish()
        return load_dataset(self.folder) if self.sent else None

    def _write(self, item: tuple[LiveFrame, Frame | None]) -> None:
        (frame, reference), last = item, self._last
        goes_on = last is not None and frame.size == last.size and frame.time_s > last.time_s
        is_same = reference is self._reference or np.array_equal(np.asarray(reference), np.asarray(self._reference))
        if self._journal is None or not goes_on or not is_same:
            self._begin_trial(frame, reference)
        assert self._journal is not None
        first_s, forces = self._first_s, frame.forces
        forces = None if forces is None else replace(forces, time_s=forces.time_s - first_s)
        margin = frame.safety_margin
        self._journal.append(frame.image, time_s=frame.time_s - first_s, safety_margin=margin, forces=forces)
        self._last = frame

    def _end_trial(self) -> None:
        if self._journal is not None:
            self._journal.close()

    def _begin_trial(self, frame: LiveFrame, reference: Frame | None) -> None:
        self._end_trial()
        names = (f"{self._facts.trial}-{number}" for number in itertools.count(1))
        facts = replace(self._facts, trial=next(name for name in names if name not in self._taken))
        forces = None if frame.forces is None else frame.forces.source
        header = JournalHeader(facts=facts, source=self._source, size=frame.size, forces=forces)
        fits = reference is not None and reference.shape == frame.image.shape
        self._journal = Journal(self.folder, header, reference=reference if fits else None)
        self._taken.add(facts.trial)
        self._first_s, self._reference = frame.time_s, reference


_TAIL_S = 0.01


class ForceStream:
    """Samples of a force sensor that another program writes, line by line, into a file or named pipe.

    The first line names the columns, as `import` takes them: `time_s,fx,fy,fz`, or `fn` and `ft`. Times are brought
    to the clock of the frames by the least delay between a sample's time and its arrival; without a column of times a
    sample counts from when it arrives. Of a file, only what is written from now on is read.

    Parameters
    ----------
    path
        File or named pipe.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._closed, self._delay_s = Event(), np.inf
        self._samples = deque[tuple[float, ...]]()  # time on the sensor's clock, time of arrival, and force of each
        self.trouble: str | None = None
        """Why no more samples come, with the cure; None while they may."""

    def __enter__(self) -> "ForceStream":
        if not self.path.exists():
            raise RecordingError(f"{self.path} does not exist; begin to write the forces, then record")
        begin = self.path.stat().st_size  # not when the thread gets to it: what is written meanwhile counts
        Thread(target=self._follow, args=(begin,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()

    def attach(self, frame: LiveFrame) -> LiveFrame:
        """Add to a frame the samples that came since the one before."""
        samples = np.array([self._samples.popleft() for _ in range(len(self._samples))]).reshape(-1, 5)
        stamps_s, arrived_s, force_n = samples[:, 0], samples[:, 1], samples[:, 2:]
        # from the sensor's clock to that of this machine, and on to that of the frames
        time_s = np.where(np.isnan(stamps_s), arrived_s, stamps_s + self._delay_s) + frame.time_s - frame.captured_s
        # samples that dropped out, and those that come after a later one
        good = np.isfinite(force_n).all(axis=1) & (time_s > np.maximum.accumulate(np.append(-np.inf, time_s))[:-1])
        if not good.any():
            return frame
        return replace(frame, forces=Forces(time_s=time_s[good], force_n=force_n[good], source=str(self.path)))

    def _follow(self, begin: int) -> None:
        path, times = self.path, ()
        try:
            with path.open(encoding="utf-8") as file:
                lines = self._lines(file)
                header = next(lines, "time_s,fx,fy,fz")
                separator = next((mark for mark in ("\t", ";", ",") if mark in header), ",")
                names = tuple(name.strip() for name in header.split(separator))
                forces = guess_force_columns(names, path=path)
                with suppress(RecordingError):
                    times = (guess_time_column(names, path=path),)
                columns = [
                    (names.index(name), UNITS[quantity][unit_of(name, quantity=quantity, path=path) or unit][0])
                    for quantity, unit, columns in (("force", "N", forces), ("time", "s", times))
                    for name in columns
                ]
                if file.seekable():
                    file.seek(max(begin, file.tell()))  # past the names, if those came later
                for line in lines:
                    arrived_s, fields = time.monotonic(), line.split(separator)
                    if len(fields) < len(names):
                        counts = f"{len(fields)} columns, {len(names)} are named"
                        self.trouble = f"{path} has a line of {counts}; the forces of {path} end here"
                        return
                    values = [float(fields[at]) * scale for at, scale in columns]
                    force_n, stamp_s = values[: len(forces)], values[-1] if times else np.nan
                    if len(force_n) == 2:  # normal and tangential, as `import` lays them along z and x
                        force_n = [force_n[1], 0.0, force_n[0]]
                    self._delay_s = min(self._delay_s, arrived_s - stamp_s)  # as it is, where that is NaN
                    self._samples.append((stamp_s, arrived_s, *force_n))
        except (RecordingError, OSError, ValueError) as error:
            self.trouble = f"{error}; the forces of {path} end here"

    def _lines(self, file: TextIO) -> Iterator[str]:
        """Iterate over whole lines as they are written, until closed; comments are passed over."""
        text = ""
        while not self._closed.is_set():
            text += file.readline()
            if not text.endswith("\n"):
                self._closed.wait(_TAIL_S)
                continue
            if text.strip() and not text.startswith(("#", "%")):
                yield text.strip()
            text = ""
