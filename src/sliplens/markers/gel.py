"""Detection of the gel and the markers in a camera's frames, and the sensor profile that follows."""

from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import KDTree

from sliplens.codec import Result
from sliplens.errors import ImageError, InputError
from sliplens.extras import import_cv2
from sliplens.markers.detect import FEWEST, KINDS, Appearance, detect_markers
from sliplens.recordings.capture import Frame
from sliplens.recordings.sensor import SensorProfile
from sliplens.recordings.source import Frames, open_source

_FIRST_FRAMES = 300  # that are searched for the untouched sensor
_EVERY = 10
_STARTING, _LIT_SHARE = 30, 0.9  # frames of a starting camera; share of their median brightness that is no dark one
_BRIGHTER = 2.0  # a lit gel against what surrounds it
_SURROUND = 0.03, 0.9  # shares of the frame that may be dark around a gel
_REACH = 0.75  # of the markers' spacing, by which the gel extends beyond the outermost of them
_SMALL_SHARE = 80  # the least marker is this part of the shorter side
_COLOURED = 40.0  # grey levels between the channels of a coloured marker against its background


@dataclass(frozen=True, kw_only=True)
class SensorProposal(Result):
    """A sensor profile proposed from a recording, with its evidence."""

    profile: SensorProfile
    picture: UInt8[np.ndarray, "height width 3"]
    """Frame of the camera, from the still beginning."""
    gel_px: tuple[int, int, int, int]
    """Left, top, width and height of the lit part with markers, in the camera's frame."""
    markers_px: Float[np.ndarray, "markers 2"]
    """Markers in the camera's frame, (x, y)."""
    spacing_px: float
    """Median distance of a marker to the next in the profile's frames, in pixels; NaN without markers."""
    notes: tuple[str, ...]
    """Findings and assumptions, a sentence each."""


def propose_profile(
    source: Path | str | Frames, *, name: str, network: str | None = None, size_px: tuple[int, int] | None = (224, 224)
) -> SensorProposal:
    """Propose the profile of a sensor from a recording that begins untouched.

    The gel is the largest lit part of the frame, cropped to the markers. Check the proposal by eye: frames do not show
    turns, mirror images, the lens and the axes of a force sensor.

    Parameters
    ----------
    source
        Video, folder of images, bag, or frames.
    name
        Name of the sensor.
    network
        Network for the frames, named in the profile.
    size_px
        Width and height of the frames it was trained on; None keeps the camera's resolution.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.markers.gel import propose_profile
    >>> frames = np.zeros((3, 48, 64, 3), dtype=np.uint8)
    >>> frames[:, 4:44, 12:52] = 200  # a lit gel without markers
    >>> propose_profile(frames, name="tip", size_px=None).profile.crop_px
    (12, 4, 40, 40)
    """
    capture, *others = open_source(Path(source) if isinstance(source, str) else source)
    # a camera that was just started hands out dark frames
    levels = np.array([frame.mean() for frame in islice(capture.read_frames(), _STARTING)])
    untouched = int(np.argmax(levels >= _LIT_SHARE * np.median(levels)))
    first = islice(capture.read_frames(), untouched, untouched + _FIRST_FRAMES, _EVERY)
    frames, (height, width) = np.stack(list(first)), capture.frame_size
    frame = frames[0]
    bright = frames.max(axis=-1).mean(axis=0)
    if bright.max() < 16:
        raise ImageError(f"the first frames of {capture.source} are black; give a recording with the lamps on")
    notes = [f"read from {capture.source}, {len(frames)} of its first frames"]
    if others:
        notes.append(f"{len(others) + 1} trials are there; the first was used")
    lit = _lit_box(bright)
    notes.append(
        "the whole frame is lit, so it was not cropped by brightness"
        if lit == (0, 0, width, height)
        else f"{lit[2]} x {lit[3]} pixels from ({lit[0]}, {lit[1]}) on are lit"
    )
    kind, places, spacing = _find_markers(frame, lit)
    gel = lit
    if len(places):
        left, top = np.maximum(lit[:2], np.floor(places.min(axis=0) - _REACH * spacing)).astype(int).tolist()
        reach = np.ceil(places.max(axis=0) + _REACH * spacing + 1)
        right, bottom = np.minimum(np.add(lit[:2], lit[2:]), reach).astype(int).tolist()
        gel = left, top, right - left, bottom - top
        notes.append(f"{len(places)} markers of kind {kind}, {spacing:.1f} pixels apart")
    else:
        notes.append("no markers were detected; set their kind in `markers` if there are any")
    crop = gel if size_px is None else _shaped(gel, size_px, (width, height))
    factor = 1.0 if size_px is None else size_px[0] / crop[2]
    notes += [
        f"frame {untouched} is taken as the untouched sensor; change reference_frame if it was touched then",
        "check by eye: rotate_deg, flip and colours; frames do not show lens, force axes and pull_direction_deg",
    ]
    profile = SensorProfile(
        name=name,
        camera_size_px=(width, height),
        crop_px=None if crop == (0, 0, width, height) else crop,
        resize_px=size_px,
        markers=kind,
        reference_frame=untouched,
        network=network,
    )
    return SensorProposal(
        profile=profile, picture=frame, gel_px=gel, markers_px=places, spacing_px=factor * spacing, notes=tuple(notes)
    )


def _lit_box(bright: Float[np.ndarray, "height width"]) -> tuple[int, int, int, int]:
    """Find left, top, width and height of the largest lit part; the whole frame if its border is not dark."""
    cv2 = import_cv2()
    height, width = bright.shape
    soft = cv2.GaussianBlur(bright.astype(np.float32), (0, 0), max(1.0, min(height, width) / 100))
    level, lit = cv2.threshold(soft.clip(0, 255).astype(np.uint8), 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    # markers are holes in the lit part, closed before its extent is measured
    side = 2 * (min(height, width) // 16) + 1
    lit = cv2.morphologyEx(np.pad(lit, side), cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))[side:-side, side:-side]
    dark, inside = bright[lit == 0], bright[lit == 1]
    low, high = _SURROUND
    border = np.concatenate([lit[0], lit[-1], lit[:, 0], lit[:, -1]])
    apart = len(dark) > 0 and len(inside) > 0 and inside.mean() > _BRIGHTER * dark.mean() + 8 and level > 0
    # light that falls off towards the edge passes Otsu's threshold too, but leaves no dark border all along a side
    if not apart or not low < len(dark) / bright.size < high or np.mean(border == 0) < 0.25:
        return 0, 0, width, height
    _, _, stats, _ = cv2.connectedComponentsWithStats(lit)
    x, y, across, down = stats[1 + np.argmax(stats[1:, cv2.CC_STAT_AREA]), :4].tolist()
    return x, y, across, down


def _find_markers(
    frame: Frame, lit: tuple[int, int, int, int]
) -> tuple[str | None, Float[np.ndarray, "markers 2"], float]:
    """Find kind, places and spacing of the markers; None and NaN where they form no pattern."""
    x, y, across, down = lit
    part = frame[y : y + down, x : x + across]
    low = max(2.0, min(across, down) / _SMALL_SHARE)
    sized = replace(KINDS["auto"], radius_px=(low, max(40.0, low + 1)))
    nothing = None, np.empty((0, 2)), np.nan
    try:
        markers = detect_markers(part, sized)
    except ImageError:
        return nothing
    centres = markers.centre_px[markers.whole & (markers.roundness > 0.6)]
    if len(centres) < FEWEST + 2:
        return nothing
    distance = KDTree(centres).query(centres, k=2)[0][:, 1]
    spacing = float(np.median(distance))
    # dirt lies anywhere; the markers of a pattern have a neighbour at its spacing
    centres = centres[(distance > 0.6 * spacing) & (distance < 1.7 * spacing)]
    if len(centres) < FEWEST + 2:
        return nothing
    return _kind(part, centres, markers.appearance), centres + np.array([x, y]), spacing


def _kind(part: Frame, centres: Float[np.ndarray, "markers 2"], look: Appearance) -> str:
    """Choose the row of `KINDS` for markers of an appearance."""
    at = centres.round().astype(int)
    inside = np.median(part[at[:, 1], at[:, 0]].astype(float), axis=0)
    change = inside - np.median(part.reshape(-1, 3).astype(float), axis=0)
    if change.sum() > 0:
        return "tactip" if look.weights.sum() > 0 and np.ptp(change) < _COLOURED else "auto"
    return "chromatouch" if np.ptp(change) > _COLOURED else "gelsight-mini"


def _shaped(
    gel: tuple[int, int, int, int], size_px: tuple[int, int], frame: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Fit a box of a shape about the middle of the gel into the frame."""
    shape = size_px[0] / size_px[1]
    across = min(max(gel[2], gel[3] * shape), frame[0], frame[1] * shape)
    width, height = round(across), round(across / shape)
    if min(width, height) < 8:
        raise InputError(f"a gel of {gel[2]} x {gel[3]} pixels is too small; move the camera nearer")
    x, y = round(gel[0] + (gel[2] - width) / 2), round(gel[1] + (gel[3] - height) / 2)
    return min(max(x, 0), frame[0] - width), min(max(y, 0), frame[1] - height), width, height
