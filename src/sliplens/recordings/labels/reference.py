"""Reference frame of a trial, the sensor untouched: named or chosen."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from sliplens.errors import RecordingError
from sliplens.images import soften
from sliplens.recordings.capture import Frame
from sliplens.recordings.labelling import ReferenceChoice

_COMPARED = 200  # untouched frames that are compared at most, to bound the memory
# blocks over which the slow part of an image is taken: wider than a contact's rim, narrower than the light's fall
_SMOOTH = 9


def choose_reference(
    read: Callable[[Sequence[int]], Iterable[Frame]],
    untouched: Bool[np.ndarray, " frames"],
    *,
    index: int | None = None,
) -> ReferenceChoice:
    """Choose the reference among the untouched frames before the contact, or take the one that is named.

    The least energy of contact decides: the mean absolute difference from the median of the untouched frames, after the
    slow part of the image is subtracted. A contact changes markers and rims, a lamp that warms up changes all of the
    image alike, and the first frame often holds the hand that started the recording. Only the first stretch of
    untouched frames counts, of a long one 200 frames, evenly spread.

    `read` reads frames of rising numbers; `index` is the reference by hand, which may touch. Without either, and for a
    number that is not there, a `RecordingError` is raised.
    """
    if index is not None and not 0 <= index < len(untouched):
        raise RecordingError(f"the reference is frame {index} of {len(untouched)}; name one from 0 on that is there")
    if index is not None:
        return ReferenceChoice(index=index, method="named")
    places = np.flatnonzero(untouched)
    if not len(places):
        raise RecordingError("no frame is known to be untouched; name the reference frame by hand")
    before = places[places - places[:1] == np.arange(len(places))]
    compared = before[np.linspace(0, len(before) - 1, min(len(before), _COMPARED)).round().astype(int)].tolist()
    soft = list(map(soften, read(compared)))
    middle = np.median(np.stack(soft), axis=0)
    energies = [_energy(image - middle) for image in soft]
    return ReferenceChoice(index=compared[int(np.argmin(energies))], method="least contact energy")


def _energy(difference: Float[np.ndarray, "rows columns 3"]) -> float:
    """Return the mean absolute value after subtracting the mean of a square about each block."""
    from scipy.ndimage import uniform_filter1d  # noqa: PLC0415 (takes as long to import as all else here)

    slow = difference.astype(np.float64)
    for axis in (0, 1):
        slow = uniform_filter1d(slow, _SMOOTH, axis=axis, mode="mirror")
    return float(np.mean(np.abs(difference - slow)))
