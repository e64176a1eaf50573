"""Displacements from a difference image alone: each marker shows twice, where it was and where it is."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from sliplens.errors import ImageError, InputError
from sliplens.extras import import_cv2

Pixels: TypeAlias = Float32[np.ndarray, "spots pixels"]
Model: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""Doublets of a window, by the place and displacement of each."""

_SWEEPS = 20


def resolve_signs(
    place_px: Float[np.ndarray, "markers 2"], way_px: Float[np.ndarray, "markers 2"], *, pressed: bool
) -> Float[np.ndarray, " markers"]:
    """Signs, 1 or -1, that make neighbouring displacements agree.

    Signs spread from the longest displacement to its neighbours, strongest agreement first, and are then flipped one by
    one while that brings them closer to what the neighbours say.

    `pressed`: choose the sign of all so that the displacements point away from their middle; left as it falls if False.
    """
    distance = np.linalg.norm(place_px[:, None] - place_px[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    pitch = np.median(distance.min(axis=1))
    closeness = np.exp(-0.5 * (distance / (1.2 * pitch)) ** 2)
    # long displacements that lie along one line bind most
    bond = closeness * (way_px @ way_px.T)
    signs = np.zeros(len(place_px))
    signs[np.argmax(np.linalg.norm(way_px, axis=1))] = 1
    while not signs.all():
        pull = np.where(signs[:, None] != 0, signs[:, None] * bond, 0)
        pull[:, signs != 0] = 0
        told, at = np.unravel_index(np.argmax(np.abs(pull)), pull.shape)
        if not pull[told, at]:
            signs[signs == 0] = 1  # nothing binds the rest: they did not move, or move athwart or far away
            break
        signs[at] = np.sign(pull[told, at])
    for _ in range(_SWEEPS):
        field = bond @ signs
        wrong = signs * field < 0
        if not wrong.any():
            break
        # one at a time: two neighbours that flip together stay apart
        signs[np.argmin(signs * field)] *= -1
    outward = (place_px - place_px.mean(axis=0)) * way_px
    return -signs if pressed and (outward.sum(axis=1) * signs).sum() < 0 else signs


_LENGTHS = (0.8, 1.6, 2.5, 3.5, 4.5, 6.0, 7.5, 9.0, 10.5, 12.0, 14.0)  # pixels, for markers of 6.5 px
_ANGLES = 12
_OFFSETS = np.arange(-4.0, 4.1, 1.0)
_ROUNDS = 12
_FEWEST = 4
_LEAST_CORRELATION = 0.6
_LONGEST = 15.0 / 6.5  # radii


@dataclass(frozen=True, kw_only=True)
class Doublets:
    """Markers of a difference image; pixel coordinates are (x, y), pixel centres at whole numbers."""

    rest_px: Float[np.ndarray, "markers 2"]
    """Place of each in T_0."""
    displacement_px: Float[np.ndarray, "markers 2"]
    """Displacement to its place in T_n."""
    correlation: Float[np.ndarray, " markers"]
    """Correlation of the image with the fitted doublet: 1 is a perfect fit."""
    amplitude: Float[np.ndarray, " markers"]
    """Grey levels by which a marker differs from what it covers."""
    whole: Bool[np.ndarray, " markers"]
    """False where the edge of the image cuts a doublet."""

    def __len__(self) -> int:
        return len(self.rest_px)


def fit_doublets(
    difference: UInt8[np.ndarray, "height width 3"],
    *,
    radius_px: float = 6.3,
    edge_px: float = 0.9,
    pressed: bool = True,
) -> Doublets:
    """Fit |disc at rest - disc moved| around every spot of an absolute difference image.

    The mean of the channels is compared with A |S(x - x_0) - S(x - x_0 - d)| + B, S a disc with a logistic edge: first
    a search over lengths, directions and places, then Gauss-Newton in all six parameters. Which of the two places is
    the older one does not show: signs are chosen so that neighbours move alike, and the sign of all so that the skin
    moves outwards as it does when it is pressed.

    Parameters
    ----------
    difference
        |T_n - T_0| in grey levels, RGB; a constant factor does not matter.
    radius_px, edge_px
        Of the markers: where half of their contrast is left, and the width of the logistic edge; by default those of
        the ChromaTouch. Half a pixel of error in the radius moves short displacements by about as much.
    pressed
        Whether the skin is pressed apart; if False, the common sign is left as it falls.

    Raises
    ------
    InputError
        If a length is not positive, or OpenCV is missing.
    ImageError
        If fewer than 4 doublets are found.

    References
    ----------
    The doublets of the published ChromaTouch images: Polak, *Explainable Neural Networks for Incipient Slip Sensing in
    Robot Tactile Learning*, Fig. 4.
    """
    if radius_px <= 0 or edge_px <= 0:
        raise InputError(f"radius and edge of the markers must be positive, got {radius_px:g} and {edge_px:g} px")
    signal = difference.astype(np.float32).mean(axis=-1)
    middle = _find_middles(signal, radius_px)
    if len(middle) < _FEWEST:
        raise ImageError(
            f"the difference image shows {len(middle)} doublets, at least {_FEWEST} are needed; "
            "was it made against the untouched sensor?"
        )
    half = int(np.ceil(radius_px * (1 + _LONGEST / 2) + 3 * edge_px))
    patches, weight, whole = _cut(signal, middle, half)
    doublet = partial(_doublet, half=half, radius_px=radius_px, edge_px=edge_px)
    found = _search(signal, middle, half, doublet, scale=radius_px / 6.5)
    found, correlation, amplitude = _polish(patches, weight, found, doublet)
    place, way = middle + found[:, :2], found[:, 2:]
    keep = (
        (correlation > _LEAST_CORRELATION)
        & (np.linalg.norm(found[:, :2], axis=1) < 1.5 * radius_px)
        & (np.linalg.norm(way, axis=1) < _LONGEST * radius_px * 1.1)
    )
    if keep.sum() < _FEWEST:
        raise ImageError(
            f"only {int(keep.sum())} spots of the difference image look like a marker seen twice; "
            "name the markers' radius, or use the raw frames"
        )
    place, way = place[keep], way[keep]
    way = way * resolve_signs(place, way, pressed=pressed)[:, None]
    return Doublets(
        rest_px=place - way / 2,
        displacement_px=way,
        correlation=correlation[keep],
        amplitude=amplitude[keep],
        whole=whole[keep],
    )


def _find_middles(signal: Float32[np.ndarray, "height width"], radius_px: float) -> Float[np.ndarray, "spots 2"]:
    """Places where both images of a marker together are brightest."""
    cv2 = import_cv2()
    smooth = cv2.GaussianBlur(signal - float(np.median(signal)), (0, 0), radius_px, borderType=cv2.BORDER_REFLECT)
    reach = 2 * int(1.5 * radius_px) + 1
    highest = cv2.dilate(smooth, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    rows, columns = np.nonzero((smooth == highest) & (smooth > 0.15 * np.percentile(smooth, 99)))
    return np.stack([columns, rows], axis=1).astype(float)


def _cut(
    signal: Float32[np.ndarray, "height width"], middle: Float[np.ndarray, "spots 2"], half: int
) -> tuple[Pixels, Pixels, Bool[np.ndarray, " spots"]]:
    """Windows, where they lie inside the image, and which lie wholly inside but for their margin."""
    steps = np.arange(-half, half + 1)
    rows, columns = (middle[:, axis, None].astype(np.int64) + steps for axis in (1, 0))
    height, width = signal.shape
    inside_rows, inside_columns = (rows >= 0) & (rows < height), (columns >= 0) & (columns < width)
    patches = signal[np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None, :]]
    inside = inside_rows[:, :, None] & inside_columns[:, None, :]
    edge = half // 2
    whole = np.all((middle >= edge) & (middle <= np.array([width, height]) - 1 - edge), axis=1)
    count = len(middle)
    return patches.reshape(count, -1), inside.reshape(count, -1).astype(np.float32), whole


def _disc(x: np.ndarray, y: np.ndarray, radius_px: float, edge_px: float) -> np.ndarray:
    return 1 / (1 + np.exp(np.clip((np.hypot(x, y) - radius_px) / edge_px, -30, 30)))


def _doublet(found: np.ndarray, half: int, radius_px: float, edge_px: float) -> np.ndarray:
    """Unit doublets in a window: middle x, y and displacement x, y of each."""
    y, x = (axis.ravel()[None] for axis in np.mgrid[-half : half + 1, -half : half + 1].astype(float))
    places = (found[:, :2] + sign * found[:, 2:] / 2 for sign in (-1, 1))
    then, now = (_disc(x - place[:, :1], y - place[:, 1:], radius_px, edge_px) for place in places)
    return np.abs(now - then)


def _search(
    signal: np.ndarray, middle: Float[np.ndarray, "spots 2"], half: int, doublet: Model, *, scale: float
) -> Float[np.ndarray, "spots 4"]:
    """Best of a grid of doublets, by their correlation with the image."""
    angle = np.arange(_ANGLES) * np.pi / _ANGLES
    ways = np.array(_LENGTHS)[:, None, None] * scale * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    tried = np.concatenate([np.zeros((ways.size // 2, 2)), ways.reshape(-1, 2)], axis=1)
    models = doublet(tried)
    models = models - models.mean(axis=1, keepdims=True)
    models = (models / np.linalg.norm(models, axis=1, keepdims=True)).T.astype(np.float32)
    best, found = np.full(len(middle), -np.inf), np.zeros((len(middle), 4))
    offsets = np.unique(np.round(_OFFSETS * scale))
    for offset in np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2):
        patches, _, _ = _cut(signal, middle + offset, half)
        score = ((patches - patches.mean(axis=1, keepdims=True)) / patches.std(axis=1, keepdims=True)) @ models
        at = score.argmax(axis=1)
        value = score[np.arange(len(middle)), at]
        better = value > best
        best = np.where(better, value, best)
        found[better] = np.concatenate([np.broadcast_to(offset, (len(middle), 2)), tried[at, 2:]], axis=1)[better]
    return found


def _polish(
    patches: Pixels, weight: Pixels, found: Float[np.ndarray, "spots 4"], doublet: Model
) -> tuple[Float[np.ndarray, "spots 4"], Float[np.ndarray, " spots"], Float[np.ndarray, " spots"]]:
    """Least squares over place, displacement, amplitude and background; gives their correlation too."""

    def fit(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model = doublet(at)
        total = weight.sum(axis=1)
        mean_model, mean_patch = (weight * model).sum(axis=1) / total, (weight * patches).sum(axis=1) / total
        free = (model - mean_model[:, None]) * weight
        rest = (patches - mean_patch[:, None]) * weight
        power = (free**2).sum(axis=1) + 1e-12
        amplitude = (free * rest).sum(axis=1) / power
        correlation = amplitude * np.sqrt(power / ((rest**2).sum(axis=1) + 1e-12))
        return rest - amplitude[:, None] * free, amplitude, correlation

    residual, amplitude, correlation = fit(found)
    damping = np.full(len(found), 1e-2)
    for _ in range(_ROUNDS):
        step, columns = 0.05, []
        for axis in range(4):
            moved = found.copy()
            moved[:, axis] += step
            columns.append((fit(moved)[0] - residual) / step)
        jacobian = np.stack(columns, axis=-1)
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        diagonal = np.einsum("nii->ni", normal)
        damped = normal + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(4)
        move = -np.linalg.solve(damped, np.einsum("npk,np->nk", jacobian, residual)[..., None])[..., 0]
        tried = found + np.clip(move, -1.5, 1.5)
        new_residual, new_amplitude, new_correlation = fit(tried)
        better = (new_residual**2).sum(axis=1) < (residual**2).sum(axis=1)
        found = np.where(better[:, None], tried, found)
        residual = np.where(better[:, None], new_residual, residual)
        amplitude = np.where(better, new_amplitude, amplitude)
        correlation = np.where(better, new_correlation, correlation)
        damping = np.where(better, damping / 5, damping * 5)
    return found, correlation, amplitude
