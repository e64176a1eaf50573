"""The reference frame of a trial, the sensor untouched: named, or chosen; and how it drifts."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from jaxtyping import Bool, Float, UInt8

from sliplens.errors import RecordingError
from sliplens.recordings.labels.motion import soften

_STILL_TIMES = 1.5
"""A frame that moves by so many times what the stillest quarter of its fellows do is not still."""
_ENDS = 10
"""Frames at either end of the untouched ones that are compared for drift."""
_SMOOTH = 9
"""Blocks over which the slow part of an image is taken: wider than a contact's rim, narrower than the light's fall."""


@dataclass(frozen=True, kw_only=True)
class Reference:
    """The sensor untouched, and how sure that is."""

    image: UInt8[np.ndarray, "height width 3"]
    index: int
    """Of the frame it is."""
    method: str
    contact_energy: float
    """Mean absolute high-pass difference from the median untouched frame, in grey levels."""
    drift: float
    """Mean absolute difference between the first and the last untouched frames, in grey levels; NaN if too few."""
    drift_span: tuple[int, int] | None
    """First and last untouched frame: without a release, both before the contact. None if there is none."""


REFERENCES = ("least contact energy", "first still")
"""Ways to choose a reference frame."""


def choose_reference(
    read_frames: Callable[[], Iterator[UInt8[np.ndarray, "height width 3"]]],
    untouched: Bool[np.ndarray, " frames"],
    *,
    index: int | None = None,
    method: str = "least contact energy",
) -> Reference:
    """Choose the reference among the untouched frames before the contact, or take the one that is named.

    These are the first stretch of untouched frames: a recording that begins pressed has them after its first contact.

    The energy of contact is the mean absolute difference from the median of the untouched frames, after the slow part
    of the image is taken off: what a contact changes is markers and rims, while a lamp that warms up changes all of the
    image alike and should not decide. The least energy is the default, for the first frame of a recording often holds
    the hand that started it.

    Parameters
    ----------
    read_frames
        Begins anew at every call, as that of a `Capture`.
    untouched
        Which frames have no contact, as the forces say.
    index
        The reference by hand; it may touch.
    method
        `least contact energy` or `first still`.

    Raises
    ------
    RecordingError
        If no frame is untouched and none is named, or the name or method is none.
    """
    if method not in REFERENCES:
        raise RecordingError(f"the reference cannot be chosen by {method!r}; choose {' or '.join(REFERENCES)}")
    if index is not None and not 0 <= index < len(untouched):
        raise RecordingError(f"the reference is frame {index} of {len(untouched)}; name one from 0 on that is there")
    places = [int(place) for place in np.flatnonzero(untouched)]
    if not places and index is None:
        raise RecordingError("no frame is known to be untouched; name the reference frame by hand")
    before = [place for place in places if untouched[places[0] : place].all()]

    wanted = {*places, *([] if index is None else [index])}
    # no further than to the last of them
    opening = islice(read_frames(), max(wanted) + 1)
    soft = {place: soften(frame) for place, frame in enumerate(opening) if place in wanted}
    still = np.stack([soft[place] for place in before or sorted(wanted)])
    middle = np.median(still, axis=0)
    energy = {place: float(np.mean(np.abs(_high_pass(one - middle)))) for place, one in soft.items()}
    if index is not None:
        chosen, how = index, "named"
    elif method == "first still":
        chosen, how = before[_first_still(still)], method
    else:
        chosen, how = min(before, key=lambda place: energy[place]), method
    return Reference(
        image=next(islice(read_frames(), chosen, None)),
        index=chosen,
        method=how,
        contact_energy=energy[chosen],
        drift=_drift([soft[place] for place in places]),
        drift_span=(places[0], places[-1]) if places else None,
    )


def _first_still(soft: Float[np.ndarray, "frames rows columns 3"]) -> int:
    """First frame that moves no more than its fellows, to and from it."""
    if len(soft) < 3:
        return 0
    steps = np.mean(np.abs(np.diff(soft, axis=0)), axis=(1, 2, 3))
    limit = _STILL_TIMES * np.quantile(steps, 0.25)
    moves = np.maximum(np.append(steps, steps[-1]), np.insert(steps, 0, steps[0]))
    return int(np.argmax(moves <= limit)) if np.any(moves <= limit) else int(np.argmin(moves))


def _drift(soft: Sequence[Float[np.ndarray, "rows columns 3"]]) -> float:
    """Mean absolute difference of the medians of the first and the last few."""
    count = min(_ENDS, len(soft) // 2)
    if count == 0:
        return float("nan")
    return float(np.mean(np.abs(np.median(soft[-count:], axis=0) - np.median(soft[:count], axis=0))))


def _high_pass(image: Float[np.ndarray, "rows columns 3"]) -> Float[np.ndarray, "rows columns 3"]:
    """Take the mean of a square about each block off."""
    half = _SMOOTH // 2
    slow = image.astype(np.float64)
    for axis in (0, 1):
        pads = [(half, half) if axis == side else (0, 0) for side in range(3)]
        padded = np.pad(slow, pads, mode="reflect" if slow.shape[axis] > half else "edge")
        slow = np.mean(np.lib.stride_tricks.sliding_window_view(padded, _SMOOTH, axis=axis), axis=-1)
    return image - slow
