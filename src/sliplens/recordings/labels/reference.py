"""Reference frame of a trial, the sensor untouched: named or chosen, and its drift."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import RecordingError
from sliplens.images import soften
from sliplens.recordings.capture import Frame
from sliplens.recordings.labelling import ReferenceChoice
from sliplens.recordings.labels.lag import measure_motion
from sliplens.recordings.options import REFERENCE_METHODS

_STILL_TIMES = 1.5  # a still frame moves by at most so many times the motion of the stillest quarter
_COMPARED = 200  # untouched frames that are compared at most, to bound the memory
_ENDS = 10  # frames at either end of the untouched ones that are compared for drift
# blocks over which the slow part of an image is taken: wider than a contact's rim, narrower than the light's fall
_SMOOTH = 9


def choose_reference(
    read: Callable[[Sequence[int]], Iterable[Frame]],
    untouched: Bool[np.ndarray, " frames"],
    *,
    index: int | None = None,
    method: str = "least contact energy",
) -> ReferenceChoice:
    """Choose the reference among the untouched frames before the contact, or take the one that is named.

    These are the first stretch of untouched frames: a recording that begins pressed has them after its first contact.

    The energy of contact is the mean absolute difference from the median of the untouched frames, after the slow part
    of the image is subtracted: a contact changes markers and rims, while a lamp that warms up changes all of the image
    alike and should not decide. The least energy is the default, for the first frame of a recording often holds
    the hand that started it. Of a long stretch 200 frames are compared, evenly spread.

    `read` reads frames of rising numbers; `untouched` marks the frames without contact; `index` is the reference by
    hand, which may touch. Without either, and for an unknown number or method, a `RecordingError` is raised.
    """
    if method not in REFERENCE_METHODS:
        raise RecordingError(f"the reference cannot be chosen by {method!r}; choose {' or '.join(REFERENCE_METHODS)}")
    if index is not None and not 0 <= index < len(untouched):
        raise RecordingError(f"the reference is frame {index} of {len(untouched)}; name one from 0 on that is there")
    places = np.flatnonzero(untouched)
    if not len(places) and index is None:
        raise RecordingError("no frame is known to be untouched; name the reference frame by hand")
    before = places[places - places[:1] == np.arange(len(places))]
    chosen, how = index, "named"
    if index is None and method == "first still":
        chosen, how = int(before[0]) + _first_still(measure_motion(map(soften, read(before.tolist())))), method
    ends = min(_ENDS, len(places) // 2)
    first, last = places[:ends].tolist(), places[len(places) - ends :].tolist()
    # all of them, or so many evenly spread from the first to the last
    compared = before[np.linspace(0, len(before) - 1, min(len(before), _COMPARED)).round().astype(int)].tolist()
    needed: list[int] = sorted({*compared, *first, *last, *([] if chosen is None else [chosen])})
    soft = dict(zip(needed, map(soften, read(needed)), strict=True))
    middle = np.median(np.stack([soft[place] for place in compared or needed]), axis=0)
    if chosen is None:
        chosen, how = min(compared, key=lambda place: _energy(soft[place] - middle)), method
    drift = None
    if ends:
        start, end = (np.median([soft[place] for place in side], axis=0) for side in (first, last))
        drift = float(np.mean(np.abs(end - start)))
    return ReferenceChoice(
        index=chosen,
        method=how,
        contact_energy=_energy(soft[chosen] - middle),
        drift=drift,
        drift_span=(int(places[0]), int(places[-1])) if len(places) else None,
    )


def _first_still(motion: Float[np.ndarray, " frames"]) -> int:
    """Return the first frame that moves no more than the others, to and from it."""
    if len(motion) < 3:
        return 0
    steps = motion[1:]
    limit = _STILL_TIMES * np.quantile(steps, 0.25)
    moves = np.maximum(np.append(steps, steps[-1]), np.insert(steps, 0, steps[0]))
    return int(np.argmax(moves <= limit)) if np.any(moves <= limit) else int(np.argmin(moves))


def _energy(difference: Float[np.ndarray, "rows columns 3"]) -> float:
    """Return the mean absolute value after subtracting the mean of a square about each block."""
    half = _SMOOTH // 2
    slow = difference.astype(np.float64)
    for axis in (0, 1):
        pads = [(half, half) if axis == side else (0, 0) for side in range(3)]
        padded = np.pad(slow, pads, mode="reflect" if slow.shape[axis] > half else "edge")
        slow = np.mean(np.lib.stride_tricks.sliding_window_view(padded, _SMOOTH, axis=axis), axis=-1)
    return float(np.mean(np.abs(difference - slow)))
