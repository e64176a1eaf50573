"""Recordings as they are in files: frames and forces, nothing interpreted."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from itertools import islice
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, UInt8

from sliplens.errors import RecordingError
from sliplens.images import require_rgb
from sliplens.recordings.labelling import ReferenceChoice
from sliplens.recordings.trial import Labels, Recording, TrialFacts, require_rising

Frame: TypeAlias = UInt8[np.ndarray, "height width 3"]  #: RGB image of the camera.


@dataclass(frozen=True, kw_only=True)
class Forces:
    """Samples of a force sensor, on its own clock and axes."""

    time_s: Float[np.ndarray, " _"]
    force_n: Float[np.ndarray, "_ 3"]
    """x, y, z of the sensor, sign and tare as recorded; NaN where a sample dropped out."""
    source: str  #: Topic, file or column names in messages.

    def __post_init__(self) -> None:
        if len(self.time_s) == 0:
            raise RecordingError(f"{self.source} has no force sample; record the force sensor too")
        if len(self.force_n) != len(self.time_s):
            raise RecordingError(f"{self.source} has other times than forces; give as many")
        require_rising(self.time_s, what=self.source)
        if not np.isfinite(self.force_n).all(axis=1).any():
            raise RecordingError(f"{self.source} has no sample that is a number; record the force sensor too")


@dataclass(frozen=True, kw_only=True)
class Capture(TrialFacts):
    """One trial as recorded; facts that its source does not have are the defaults."""

    source: str  #: File, folder or topic in messages.
    frame_time_s: Float[np.ndarray, " _"]
    """Times on the clock of the camera, from the same zero as the forces; all NaN where they are unknown."""
    frame_size: tuple[int, int]  #: Height and width, in pixels.
    read_frames: Callable[[], Iterator[Frame]]
    """Iterate from the first frame at every call: one RGB image for each time, in their order."""
    forces: Forces | None = None  #: None where only images were recorded.
    notes: tuple[str, ...] = ()  #: Assumptions and omissions of the reader, a sentence each, to be shown to the user.
    labels: Labels | None = None  #: Labels that came with the frames; None where they are to be estimated.
    reference: Frame | None = None  #: Image of the untouched sensor, where it was recorded apart from the frames.
    reference_index: int | None = None  #: Number of the untouched frame, by the source or its reader.
    reference_choice: ReferenceChoice | None = None
    """How the image of the untouched sensor was chosen; None where unknown."""
    split: str = ""  #: Split in the source; empty where it has none.
    simulated: bool = False
    files: tuple[str, ...] | None = None  #: Names of the images of a folder.
    opened: str = "frames in memory"  #: Path that was opened, for messages and metadata.

    def __post_init__(self) -> None:
        if len(self) == 0:
            raise RecordingError(f"{self.source} has no frame; leave it out or record it again")
        if self.time_s is not None:
            require_rising(self.frame_time_s, what=f"the frames of {self.source}")
        if self.reference is not None:
            require_rgb(self.reference, what="levels of the reference")

    def __len__(self) -> int:
        return len(self.frame_time_s)

    @property
    def time_s(self) -> Float[np.ndarray, " frames"] | None:
        """Times of the frames; None where they are unknown."""
        return None if np.isnan(self.frame_time_s).all() else self.frame_time_s

    @property
    def safety_margin(self) -> Float[np.ndarray, " frames"] | None:
        """Labels, NaN where a frame has no valid one; None where the source has no labels."""
        labels = self.labels
        return None if labels is None else np.where(labels.labelled, labels.safety_margin, np.nan)

    @property
    def read_reference(self) -> Callable[[], Frame] | None:
        """Function that reads the reference frame T_0; None where it is unknown."""
        image, index = self.reference, self.reference_index
        if image is not None:
            return lambda: image
        return None if index is None else lambda: next(islice(self.read_frames(), index, None))

    @property
    def frame_rate_hz(self) -> float:
        """Frames a second for playback, 1 to 120; 25 where times are unknown."""
        if self.time_s is None or len(self) < 2:
            return 25.0
        return float(np.clip(1 / np.median(np.diff(self.time_s)), 1, 120))


def capture_recording(recording: Recording) -> Capture:
    """Open a trial in memory with its labels and its reference frame."""
    return Capture(
        **{field.name: getattr(recording, field.name) for field in fields(TrialFacts)},
        source=recording.trial,
        frame_time_s=recording.time_s,
        frame_size=(recording.reference.shape[0], recording.reference.shape[1]),
        read_frames=recording.frames.__iter__,
        labels=recording,
        reference=recording.reference,
        simulated=recording.truth is not None,
    )
