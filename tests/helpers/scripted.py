"""A live source that gives frames by a script, and the readings of them."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

import sliplens as sl
from sliplens.errors import SourceError
from sliplens.live.contract import LiveSource
from sliplens.live.reading import LiveFrame, Reading
from sliplens.models.checkpoint import Network

plain_reader = partial(sl.LiveReader, health=None, slip=None, engine="torch", stall_s=10.0)
"""What is captured and read, without judging it, however slow the machine is."""


def frame_of(image: np.ndarray, number: int, *, time_s: float | None = None) -> LiveFrame:
    return LiveFrame(image=image, number=number, time_s=0.05 * number if time_s is None else time_s, captured_s=0.0)


def frames_of(images: np.ndarray, numbers: Sequence[int] | None = None) -> list[LiveFrame]:
    return [frame_of(image, number) for image, number in zip(images, numbers or range(len(images)), strict=True)]


class Scripted(LiveSource):
    """Gives frames, if patient once the one before was read, and does the rest of its script, also opened again."""

    name, cure, rate_hz, reconnects = "the fake", "give it a push", 1000.0, True

    def __init__(
        self, *script: "LiveFrame | Callable[[Scripted], object]", refuses: int = 0, patient: bool = True
    ) -> None:
        self.script, self.refuses, self.patient = list(script), refuses, patient
        self.size = next(step.size for step in script if isinstance(step, LiveFrame))
        self.read, self.opened = Event(), 0
        self.read.set()

    def open(self, _: ExitStack, /) -> None:
        self.opened += 1
        if 1 < self.opened <= 1 + self.refuses:
            raise SourceError(f"{self.name} is not there; plug it in")

    def frames(self) -> Iterator[LiveFrame]:
        while self.script:
            step = self.script.pop(0)
            if not isinstance(step, LiveFrame):
                step(self)
                continue
            if self.patient:
                self.wait()
            yield replace(step, captured_s=time.monotonic())

    def wait(self) -> None:
        """Wait until a reading came since the last frame."""
        assert self.read.wait(timeout=10)
        self.read.clear()

    def all_readings(
        self, reader: sl.LiveReader | Network | Path | str | None = None, **settings: Any
    ) -> list[Reading]:
        """Readings of a reader, or of a network without checks but those of the settings."""
        heard: list[Reading] = []

        def next_one(reading: Reading, _: LiveFrame | None) -> None:
            heard.append(reading)
            self.read.set()

        if not isinstance(reader, sl.LiveReader):
            reader = plain_reader(self, reader, **settings)
        reader.subscribe(next_one)
        with reader:
            list(reader.readings())
        return heard


def source_of(images: np.ndarray, numbers: Sequence[int] | None = None, *, patient: bool = True) -> Scripted:
    return Scripted(*frames_of(images, numbers), patient=patient)
