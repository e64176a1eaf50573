"""Marker displacements, found in difference images as in the table `measured_markers.csv`, and by a freer fit.

The table's own method is template matching: a grey image, softened a little, against the absolute difference of two
discs of one size at the table's place of rest, over displacements on a grid. It returns every entry of the reliable
rows exactly. Its discs have one size, sharpness and contrast; those of the real markers differ between the untouched
and the pressed gel, so that it finds small displacements too large (by 1 to 2 px where the crescents are thin; see
`fit_crescents`). Simulated markers are therefore compared with the table after tracking both alike.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares

LABELS = (100, 80, 60, 40, 20, 0)
"""Margins of the table in percent."""

_BORDER_PX = 14
_REACH = 16
"""Half the template's side, in pixels."""
_CORRELATION = 0.85


@dataclass(frozen=True, kw_only=True)
class MarkerTable:
    """Displacements in the real images, by label and marker."""

    rest_px: np.ndarray
    """(markers, 2), whole pixels."""
    displacement_px: np.ndarray
    """(labels, markers, 2)"""
    reliable: np.ndarray
    """(labels, markers): where the template explained the image."""


def read_table(folder: Path) -> MarkerTable:
    """Read the markers that can be relied on.

    Left out are, as the table's makers say, those within 14 px of the border (with them (116, 13)) and the one at the
    apex; those beyond the third ring, whose crescents the border cuts; and single entries whose template correlation
    is below 0.85: two crescents that thin have merged with their noise or with the glare of the lamps.
    """
    with (folder / "measured_markers.csv").open() as stream:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(stream)]
    kept = [
        row
        for row in rows
        if 1 <= row["ring"] <= 3 and all(_BORDER_PX <= row[axis] <= 223 - _BORDER_PX for axis in ("x_ref", "y_ref"))
    ]
    return MarkerTable(
        rest_px=np.array([(row["x_ref"], row["y_ref"]) for row in kept]),
        displacement_px=np.array([[(row[f"dx_{x}"], row[f"dy_{x}"]) for row in kept] for x in LABELS]),
        reliable=np.array([[row[f"corr_{x}"] > _CORRELATION for row in kept] for x in LABELS]),
    )


def track(images: np.ndarray, rest_px: np.ndarray) -> np.ndarray:
    """Displacements found by the table's method from its own places of rest, (frames, markers, 2)."""
    grey = np.stack([gaussian_filter(image.mean(axis=-1), 1.0) for image in images])
    steps = np.arange(-_REACH, _REACH + 1)
    column, row = np.meshgrid(steps, steps)
    grid = np.arange(-13, 13.1, 0.5)
    shifts = np.stack([axis.ravel() for axis in np.meshgrid(grid, grid)], axis=-1)
    moved = _disc(column - shifts[:, :1, None], row - shifts[:, 1:, None], 6.5, 0.7)
    templates = _standardise(np.abs(_disc(column, row, 6.5, 0.7) - moved).reshape(len(shifts), -1))
    found = []
    for x, y in rest_px.astype(int):
        window = grey[:, y - _REACH : y + _REACH + 1, x - _REACH : x + _REACH + 1]
        found.append(shifts[np.argmax(_standardise(window.reshape(len(images), -1)) @ templates.T, axis=1)])
    return np.stack(found, axis=1)


def fit_crescents(images: np.ndarray, rest_px: np.ndarray, expected_px: np.ndarray) -> np.ndarray:
    """Displacements of markers whose size, sharpness and contrast may differ at rest and in contact.

    One fit a marker to the green of all its frames: two discs, at rest and displaced, seen through |.| and noise.

    Parameters
    ----------
    images
        Real frames in contact, (frames, height, width, 3).
    rest_px, expected_px
        Where to start: places (markers, 2) and displacements (frames, markers, 2).
    """
    row, column = np.mgrid[: images.shape[1], : images.shape[2]]
    # every other pixel, as on a chessboard: half the work, and the noise is hardly correlated
    chess = (row + column) % 2 == 0
    found = []
    for place, expected in zip(rest_px, expected_px.transpose(1, 0, 2), strict=True):
        middle = place + expected.mean(axis=0) / 2
        near = chess & (np.hypot(column - middle[0], row - middle[1]) < 18)
        found.append(_fit_pair(column[near], row[near], images[:, near, 1].astype(float), place, expected))
    return np.stack(found, axis=1)


def _fit_pair(x: np.ndarray, y: np.ndarray, green: np.ndarray, place: np.ndarray, expected: np.ndarray) -> np.ndarray:
    def residual(guess: np.ndarray) -> np.ndarray:
        (x0, y0), (old, new), moves = guess[:2], guess[2:8].reshape(2, 3), guess[8:].reshape(-1, 2)
        rest = _disc(x - x0, y - y0, old[0], old[1])
        pressed = np.stack([_disc(x - x0 - dx, y - y0 - dy, new[0], new[1]) for dx, dy in moves])
        noise = 4 + 5 * np.maximum(rest, pressed)
        return ((np.hypot(old[2] * rest - new[2] * pressed, noise) - green) / 15).ravel()

    start = np.concatenate([place, [6.3, 1, 160], [6.7, 1, 145], expected.ravel()])
    reach = np.concatenate([[3, 3], [2, 0.6, 80], [2, 0.6, 80], np.full(expected.size, 4)])
    fit = least_squares(residual, start, bounds=(start - reach, start + reach), loss="soft_l1", max_nfev=40)
    return fit.x[8:].reshape(-1, 2)


def rms(errors: np.ndarray) -> float:
    """Root mean square over all coordinates."""
    return float(np.sqrt(np.mean(errors**2)))


def _disc(x: np.ndarray, y: np.ndarray, radius: float, edge: float) -> np.ndarray:
    return 1 / (1 + np.exp(np.clip((np.hypot(x, y) - radius) / edge, -40, 40)))


def _standardise(rows: np.ndarray) -> np.ndarray:
    centred = rows - rows.mean(axis=1, keepdims=True)
    return centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-9)
