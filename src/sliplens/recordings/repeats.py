"""Frames that a recorder repeated because its camera was slower than its file says."""

from itertools import islice

import numpy as np
from jaxtyping import Float

from sliplens.images import soften
from sliplens.recordings.capture import Capture
from sliplens.recordings.labels.lag import measure_motion

# Lossless repeats change nothing, and repeats of lossy video up to an eighth of what the frames beside them do; noise
# alone makes frames of a working camera differ by more, and what rests does so for longer than three frames.
_STILL = 0.15
_MOST_IN_A_ROW = 3
_LEAST_SHARE, _FEWEST = 0.1, 5
_INSPECTED = 90  #: Frames from the beginning that `inspect_repeats` reads.


def describe_repeats(motion: Float[np.ndarray, " frames"], time_s: Float[np.ndarray, " frames"]) -> str | None:
    """Describe how many frames repeat the one before, by their `measure_motion`; None where next to none does.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.recordings.repeats import describe_repeats
    >>> doubled = np.tile([1.0, 0.0], 30)  # every second frame shows nothing new
    >>> describe_repeats(doubled, np.arange(60) / 30).split(";")[0]
    '28 of 60 frames repeat the one before: the camera took about 16 frames a second, and the file says 30'
    """
    change = motion[1:]
    if len(change) < _FEWEST:
        return None
    still = np.zeros(len(change), dtype=bool)
    for count in range(1, _MOST_IN_A_ROW + 1):
        for at in range(1, len(change) - count):
            if change[at : at + count].max() < _STILL * min(change[at - 1], change[at + count]):
                still[at : at + count] = True
    repeats = int(still.sum())
    if repeats < max(_FEWEST, _LEAST_SHARE * len(motion)):
        return None
    rate_hz = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
    taken_hz = rate_hz * (1 - repeats / len(motion))
    return (
        f"{repeats} of {len(motion)} frames repeat the one before: the camera took about {taken_hz:.3g} frames a "
        f"second, and the file says {rate_hz:.3g}; record at the camera's rate, or leave the repeats out on export "
        "(`ffmpeg -vf mpdecimate`)"
    )


def inspect_repeats(capture: Capture) -> tuple[str, ...]:
    """Describe repeats among the first frames of a recording, as a note; none without times."""
    if capture.time_s is None:
        return ()
    motion = measure_motion(soften(frame) for frame in islice(capture.read_frames(), _INSPECTED))
    sentence = describe_repeats(motion, capture.time_s[: len(motion)])
    return () if sentence is None else (f"{capture.name}: {sentence}",)
