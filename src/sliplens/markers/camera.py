"""Motion of the camera against the untouched sensor, apart from what a contact does to the skin."""

from dataclasses import dataclass, replace
from functools import reduce
from math import hypot, radians

import numpy as np
from jaxtyping import Complex, Float, Float32

from sliplens.images import LEAST_TOUCH
from sliplens.markers.tracker import Tracks
from sliplens.recordings.capture import Frame

Plane = Float32[np.ndarray, "height width"]

_HALF_PX = 112.0  # half the height of the picture in whose pixels motions are given: limits then suit every camera
CAMERA_LIMIT_PX = 0.8
"""`CameraMotion.excess_px` above which the camera has moved: nearly twice what contacts of a fixed camera reach. Turns
up to 0.3 degrees and zooms up to 0.5 %, on which networks are trained, stay below it."""
CAMERA_CURE = "fasten the camera, and take a new reference"
CAMERA_REASON = f"the camera turned, moved or zoomed since the reference; {CAMERA_CURE}"
"""Reason to withhold a margin."""
_LEAST_RADIUS = 0.62
"""Distance of a marker from the middle, in halves of the picture's shorter side, beyond which the model of a contact
holds: nearer, the contact itself is seen."""
_FEWEST = 10
_PASSES, _SCALE_PX = 5, 0.3  # of the robust fit: its passes, and the misfit at which the weight of a place is halved
_LIGHT_PX = 0.5  # motion below which a contact is left out of the fit: what it moves is then below every limit
_MARKER_SHARES, _BORDER_SHARES = (0.3, 0.2, 0.1), (np.inf, np.inf, 0.5)
"""Shift, zoom and turn that a healthy contact passes for at most: shares of its own motion where markers show that, and
multiples of the misfit where parts of the border do, by which a wide contact is like a shift or a zoom.
Chosen on the markers of 1,380 frames in contact of 170 simulated sensors (series `health-choose-camera`), which exceed
them by 0.43 px at most, and on 120 drawn ones of `health-choose`."""


@dataclass(frozen=True, kw_only=True)
class CameraMotion:
    """Similarity that moves the reference onto a frame, and how far it is beyond what a contact explains."""

    x_px: float
    """Shift to the right, in pixels of a picture 224 high."""
    y_px: float
    """Shift downwards, in the same unit."""
    turn_deg: float
    """Clockwise turn about the middle of the picture, in degrees."""
    zoom: float
    """Share by which the picture is magnified."""
    excess_px: float
    """Largest motion of the border by shift, turn or zoom that no contact explains, in pixels of a picture 224 high."""
    free: bool
    """True where no contact moves the skin, so that all of the motion is the camera's."""

    @property
    def shift_px(self) -> float:
        """Length of the shift, in pixels of a picture 224 high."""
        return hypot(self.x_px, self.y_px)

    @property
    def turn_px(self) -> float:
        """Motion of the border by the turn, in pixels of a picture 224 high."""
        return abs(radians(self.turn_deg)) * _HALF_PX


def marker_camera_motion(markers: Tracks) -> CameraMotion | None:
    """Measure the camera's motion by markers beyond the contact; None where fewer than 10 are seen there.

    With places p and displacements d as complex numbers about the middle of the picture, the camera moves
    d = t + s p, s = zoom + i turn, and a contact near the middle adds c / conj(p) + e / conj(p)^2 + h / |p|: press and
    twist as a source in a plane, the distance of their centre from the middle as a dipole, and shear as the load on a
    half-space. All are fitted by least squares with weights that fall off with the misfit (Cauchy).

    References
    ----------
    Johnson, *Contact Mechanics* (1985), section 3.6, for the decay of a tangential load.
    Holland and Welsch, *Robust regression using iteratively reweighted least-squares*, 1977.
    """
    height, width = markers.size
    half = min(height, width) / 2
    middle = np.array([width - 1, height - 1]) / 2
    motion_px = markers.position_px - markers.rest_px
    place = (markers.position_px - motion_px - middle) @ (1, 1j) / half
    motion = motion_px @ (1, 1j) * (_HALF_PX / half)
    beyond = np.isfinite(motion) & (np.abs(place) > _LEAST_RADIUS)
    if beyond.sum() < _FEWEST:
        return None
    place, motion = place[beyond], motion[beyond]
    contact = np.stack([1 / place.conj(), 1 / place.conj() ** 2, 1 / np.abs(place)], axis=1)
    similarity = np.stack([np.ones_like(place), place], axis=1)
    whole, _ = _fit(np.concatenate([similarity, contact], axis=1), motion)
    moved_px = float(np.sqrt(np.mean(np.abs(contact @ whole[2:]) ** 2)))
    if moved_px > _LIGHT_PX:
        return _as_motion(whole, moved_px, _MARKER_SHARES, free=False)
    return _as_motion(_fit(similarity, motion)[0], 0.0, _MARKER_SHARES, free=True)


def _fit(
    terms: Complex[np.ndarray, "places terms"], motion: Complex[np.ndarray, " places"]
) -> tuple[Complex[np.ndarray, " terms"], Float[np.ndarray, " places"]]:
    """Fit a motion by a robust regression; returns the factors of the terms and the misfit of each place, in pixels."""
    weight, fitted, misfit = np.ones(len(motion)), np.zeros(terms.shape[1], dtype=complex), np.zeros(len(motion))
    for _ in range(_PASSES):
        weighted = terms.conj().T * weight
        fitted = np.linalg.solve(weighted @ terms, weighted @ motion)
        misfit = np.abs(motion - terms @ fitted)
        weight = 1 / (1 + (misfit / _SCALE_PX) ** 2)
    return fitted, misfit


def _as_motion(
    fitted: Complex[np.ndarray, " terms"], healthy_px: float, shares: tuple[float, float, float], *, free: bool
) -> CameraMotion:
    lengths = float(abs(fitted[0])), float(abs(fitted[1].real)), float(abs(fitted[1].imag))
    excess = max(length - share * healthy_px for length, share in zip(lengths, shares, strict=True))
    return CameraMotion(
        x_px=float(fitted[0].real),
        y_px=float(fitted[0].imag),
        turn_deg=float(np.degrees(fitted[1].imag / _HALF_PX)),
        zoom=float(fitted[1].real / _HALF_PX),
        excess_px=max(0.0, excess),
        free=free,
    )


def block_means(plane: Plane, factor: int) -> Float32[np.ndarray, "rows columns"]:
    """Average square blocks; what fills no block at the right and below is left out."""
    height, width = (side // factor for side in plane.shape)
    blocks = plane[: height * factor, : width * factor].reshape(height, factor, width, factor)
    # sums of slices: several times as fast as a mean over two axes
    lines = reduce(np.add, [blocks[:, line] for line in range(factor)])
    return reduce(np.add, [lines[..., column] for column in range(factor)]) / np.float32(factor**2)


_BORDER = 0.14  # share of the side: what touches seldom reaches there
_SCALES = 56, 112  # blocks of pixels along the picture's side in which the border is compared, from coarse to fine
_PARTS, _STRAYS = 8, 2  # parts of the border, and how many of them may move otherwise than the others
_TOUCH_BLOCKS = 28  # blocks along the picture's side in which a contact is looked for
_REACH_PX = 24
_STEPS = 2
_TEXTURE = 3.0
"""Grey levels by which blocks of a part must differ, slopes of the light left out, for its motion to show."""
_NO_SHARES = 0.0, 0.0, 0.0
_STILL_PX, _ALIKE_SHARE = 0.07, 0.02
"""Misfit of the parts of an untouched border: what noise alone makes, and more as a share of the motion itself."""


class BorderMotion:
    """Camera's motion from the border of the picture, for sensors without markers.

    The border is cut into eight parts. The motion of each is found by least squares on the slopes of its pixels, from
    coarse to fine, while all parts are turned and zoomed as the similarity through their motions says.

    Lucas and Kanade, *An Iterative Image Registration Technique with an Application to Stereo Vision*, IJCAI 1981.
    """

    def __init__(self, plane: Plane) -> None:
        factors = [max(1, min(plane.shape) // blocks) for blocks in _SCALES]
        self._levels = tuple((_Level(block_means(plane, factor)), factor) for factor in factors)
        self._half, self._level = min(plane.shape) / 2, _brightness(plane)
        coarse, _ = self._levels[0]
        self._textured = int((coarse.texture > _TEXTURE).sum()) >= _PARTS - _STRAYS

    def measure(self, plane: Plane) -> CameraMotion | None:
        """Measure the camera's motion in a picture of the reference's size; None without texture."""
        if not self._textured:
            return None
        plane = plane * np.float32(self._level / _brightness(plane))
        shift, similarity, misfit = np.zeros(_PARTS, dtype=complex), 0j, np.zeros(_PARTS)
        fitted = np.zeros(2, dtype=complex)
        for level, factor in self._levels:
            pixels = np.pad(block_means(plane, factor), _REACH_PX, mode="edge").ravel()
            for _ in range(_STEPS):
                shift = shift + factor * level.steps(pixels, shift / factor, similarity)
                terms = np.stack([np.ones_like(level.places), level.places], axis=1)
                fitted, misfit = _fit(terms, shift * (_HALF_PX / self._half))
                similarity = complex(fitted[1]) / _HALF_PX
        misfit_px, length_px = float(np.sort(misfit)[_PARTS - _STRAYS - 1]), float(np.linalg.norm(fitted))
        free = length_px < _LIGHT_PX or misfit_px < _STILL_PX + _ALIKE_SHARE * length_px
        return _as_motion(fitted, 0.0 if free else misfit_px, _NO_SHARES if free else _BORDER_SHARES, free=free)

    def explains(self, plane: Plane, motion: CameraMotion) -> bool:
        """Return True where the reference, moved so, differs from a picture by less than a contact changes it."""
        from scipy.ndimage import affine_transform  # noqa: PLC0415 (takes as long to import as all else here)

        level, factor = self._levels[-1]
        blocks = block_means(plane * np.float32(self._level / _brightness(plane)), factor)
        similarity, middle = 1 + motion.zoom + 1j * radians(motion.turn_deg), (np.array(blocks.shape) - 1) / 2
        back = 1 / similarity
        to_reference = np.array([[back.real, back.imag], [-back.imag, back.real]])  # of (row, column)
        shift = np.array([motion.y_px, motion.x_px]) * (self._half / _HALF_PX / factor)
        offset = middle - to_reference @ (middle + shift)
        moved = affine_transform(level.plane, to_reference, offset, order=1, mode="nearest")
        difference = block_means(blocks - moved, max(1, min(blocks.shape) // _TOUCH_BLOCKS))
        return float(np.quantile(np.abs(difference), 0.98)) < LEAST_TOUCH  # as `picture_change`


def _brightness(plane: Plane) -> float:
    return max(1.0, float(np.median(plane[::4, ::4])))


class CameraWatch:
    """Camera's motion over the frames of one sensor.

    Markers show it in every frame, where they are followed and enough of them lie beyond the contact. Parts of the
    border show it otherwise. A contact shifts and magnifies the border too, but does not turn it: in a contact only a
    turn counts, and a shift or zoom measured before the contact holds until the contact ends.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.markers.camera import CameraWatch
    >>> pixels = np.random.default_rng(0).integers(60, 200, (28, 28, 3), dtype=np.uint8)
    >>> untouched = np.kron(pixels, np.ones((8, 8, 1), dtype=np.uint8))
    >>> moved = CameraWatch(untouched).update(np.roll(untouched, 2, axis=1), touches=False)
    >>> round(moved.shift_px, 1), moved.excess_px > 0.6
    (2.0, True)
    """

    def __init__(self, reference: Frame) -> None:
        self._border = BorderMotion(reference[..., 1].astype(np.float32))
        self._untouched: CameraMotion | None = None
        """Newest motion of a frame without a contact."""

    def update(self, frame: Frame, markers: Tracks | None = None, *, touches: bool) -> CameraMotion | None:
        """Measure the motion in the next frame; None where neither markers nor the border show any.

        `touches`: True where the frame differs from the reference as by a contact. A camera that moved makes it differ,
        too: a frame that the motion alone explains counts as untouched.
        """
        motion = None if markers is None else marker_camera_motion(markers)
        if motion is not None:
            touches = not motion.free
        else:
            plane = frame[..., 1].astype(np.float32)  # cameras resolve green best
            motion = self._border.measure(plane)
            if motion is None:
                return None
            touches = touches and not self._border.explains(plane, motion)
            if not touches:
                lengths = motion.shift_px, abs(motion.zoom) * _HALF_PX, motion.turn_px
                motion = replace(motion, excess_px=max(lengths))
            elif motion.free:  # else `measure` has left shift and zoom out, and what a contact may turn
                motion = replace(motion, excess_px=motion.turn_px)
        if not touches:
            self._untouched = motion
        before = self._untouched
        return motion if before is None or motion.excess_px > before.excess_px else before


class _Level:
    """Border of a picture at one scale, cut into eight sectors."""

    def __init__(self, plane: Plane) -> None:
        height, width = plane.shape
        wide = max(4, round(_BORDER * min(height, width)))
        rows, columns = np.mgrid[:height, :width]
        # bearing from the middle, the sides of the picture made alike
        bearing = np.arctan2(rows / (height - 1) - 0.5, columns / (width - 1) - 0.5)
        sector = np.floor((bearing / (2 * np.pi) + 1) * _PARTS).astype(int) % _PARTS
        sector[wide:-wide, wide:-wide] = -1
        sector[[0, -1]] = sector[:, [0, -1]] = -1
        self.plane = plane
        down, along = np.gradient(plane)
        self._stride, middle = width + 2 * _REACH_PX, ((width - 1) + 1j * (height - 1)) / 2
        inside = np.nonzero(sector >= 0)
        place, self._part = inside[1] + 1j * inside[0] - middle, sector[inside]
        self._index = (inside[0] + _REACH_PX) * self._stride + inside[1] + _REACH_PX
        self._values, self._slopes = plane[inside], np.stack([along[inside], down[inside]]).astype(np.float32)
        self._inverse = np.zeros((2, len(place)), dtype=np.float32)
        centres, texture = np.zeros(_PARTS, dtype=complex), np.zeros(_PARTS)
        for part in range(_PARTS):
            here = self._part == part
            centres[part] = place[here].mean()
            terms = np.concatenate([self._slopes[:, here].T, np.ones((here.sum(), 1))], axis=1)
            self._inverse[:, here] = np.linalg.pinv(terms, rcond=1e-3)[:2]
            light = np.stack([place[here].real, place[here].imag, np.ones(here.sum())], axis=1)
            texture[part] = np.std(plane[inside][here] - light @ np.linalg.lstsq(light, plane[inside][here])[0])
        arm = place - centres[self._part]
        self._arm = np.stack([arm.real, arm.imag]).astype(np.float32)
        self.places, self.texture = centres / (min(plane.shape) / 2), texture

    def steps(
        self, pixels: Float32[np.ndarray, " pixels"], shift: Complex[np.ndarray, " parts"], similarity: complex
    ) -> Complex[np.ndarray, " parts"]:
        """Measure how far each part lies from where its shift and the common similarity put it, in pixels."""
        start = np.stack([np.real(shift), np.imag(shift)]).astype(np.float32)[:, self._part]
        zoom, turn = np.float32(similarity.real), np.float32(similarity.imag)
        right, down = self._arm
        motion = start + np.stack([zoom * right - turn * down, turn * right + zoom * down])
        whole = np.clip(np.rint(motion), -_REACH_PX, _REACH_PX)
        visible = pixels[self._index + (whole[1] * self._stride + whole[0]).astype(int)]
        # what whole pixels leave of the motion changes the values along their slopes
        unlike = self._values - visible - ((motion - whole) * self._slopes).sum(axis=0)
        steps = [np.bincount(self._part, inverse * unlike, minlength=_PARTS) for inverse in self._inverse]
        return np.clip(steps[0], -1.5, 1.5) + 1j * np.clip(steps[1], -1.5, 1.5)
