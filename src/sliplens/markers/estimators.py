"""Parts of a marker field: its affine fit, the centre of the contact, the end of the press, and what sticks."""

import numpy as np
from jaxtyping import Float

_PRESSED_SHARE = 0.9  # of the trial's largest spread, at which the press is complete, creep aside
_PULL_PX = 0.2  # of the inner markers' mean motion: several times its noise
INNER_SHARE = 1 / 3
"""Share of the markers, nearest to the centre of the contact, that surely touches."""


def affine_parts(
    rest_px: Float[np.ndarray, "markers 2"], displacement_px: Float[np.ndarray, "frames markers 2"]
) -> Float[np.ndarray, "frames 6"]:
    """Compute the least-squares parts of a field: mean x and y, divergence, curl, and the two parts of pure shear.

    It is the Helmholtz-Hodge decomposition of an affine field about the middle of the markers. Means are in pixels, the
    rest in pixels per pixel; NaN where fewer than 3 markers are followed.

    References
    ----------
    Zhang, Kan, Yang, Tse and Wang, *Effective Estimation of Contact Force and Torque for Vision-based Tactile Sensor
    with Helmholtz-Hodge Decomposition*, 2019.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.markers.estimators import affine_parts
    >>> rest_px = np.array([[0.0, 0], [10, 0], [0, 10], [10, 10]])
    >>> moved_px = np.array([3.0, 0]) + 0.05 * (rest_px - 5)  # 3 px to the right, and 5 % larger both ways
    >>> affine_parts(rest_px, moved_px[None]).round(3)[0, :4]  # mean x and y, divergence, curl
    array([3. , 0. , 0.1, 0. ])
    """
    offset = rest_px - rest_px.mean(axis=0)
    terms = np.concatenate([np.ones((len(offset), 1)), offset], axis=1)
    followed = np.all(np.isfinite(displacement_px), axis=-1)
    weighted = terms[None] * followed[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ terms + 1e-9 * np.eye(3)
    fit = np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ np.where(followed[..., None], displacement_px, 0))
    (mean_x, mean_y), (xx, yx), (xy, yy) = (fit[:, row].T for row in range(3))
    parts = np.stack([mean_x, mean_y, xx + yy, yx - xy, xx - yy, xy + yx], axis=1)
    return np.where(followed.sum(axis=1)[:, None] >= 3, parts, np.nan)


def rank_in_field(
    rest_px: Float[np.ndarray, "markers 2"], pressed_px: Float[np.ndarray, "markers 2"]
) -> Float[np.ndarray, " markers"]:
    """Rank markers, 0 to 1, by their distance from the centre of a press, given the displacement that it caused."""
    parts = affine_parts(rest_px, pressed_px[None])
    return rank_from_centre(rest_px[None], mean_px=parts[:, :2], divergence=parts[:, 2])[0]


def rank_from_centre(
    rest_px: Float[np.ndarray, "fields markers 2"],
    *,
    mean_px: Float[np.ndarray, "fields 2"],
    divergence: Float[np.ndarray, " fields"],
) -> Float[np.ndarray, "fields markers"]:
    """Rank markers, 0 to 1, by their distance from where pressing moved nothing: the centre of the contact.

    Mean and divergence are those of the affine fit (`affine_parts`); without a divergence the middle of the markers is
    the centre.
    """
    middle = rest_px.mean(axis=1)
    reach = np.abs(rest_px - middle[:, None]).max(axis=(1, 2))[:, None] / 2
    spreads = np.abs(np.nan_to_num(divergence)) >= 1e-3
    shift = 2 * mean_px / np.where(spreads, divergence, 1)[:, None]
    centre = middle - np.where(spreads[:, None], np.clip(shift, -reach, reach), 0)
    distance = np.linalg.norm(rest_px - centre[:, None], axis=2)
    return np.argsort(np.argsort(distance, axis=1, kind="stable"), axis=1, kind="stable") / distance.shape[1]


def find_hold(rest_px: Float[np.ndarray, "markers 2"], displacement_px: Float[np.ndarray, "frames markers 2"]) -> int:
    """Find the last frame before the pull of a whole trial.

    The sensor is pressed then, and the inner markers have not yet moved by 0.2 px on average. Pressing ends where the
    divergence first reaches nine tenths of its largest; without a press the first frame is the hold.
    """
    spread = np.nan_to_num(affine_parts(rest_px, displacement_px)[:, 2], nan=-np.inf)
    if spread.max() <= 0:
        return 0
    first = int(np.argmax(spread >= _PRESSED_SHARE * spread.max()))
    inner = rank_in_field(rest_px, displacement_px[first]) < INNER_SHARE
    moved = affine_parts(rest_px[inner], displacement_px[first:, inner] - displacement_px[first, inner])[:, :2]
    pulled = np.flatnonzero(np.linalg.norm(moved, axis=1) > _PULL_PX)
    return max(first + int(pulled[0]) - 1, first) if len(pulled) else first


def stick_share(
    rest_px: Float[np.ndarray, "markers 2"],
    pressed_px: Float[np.ndarray, "markers 2"],
    since_px: Float[np.ndarray, "markers 2"],
    *,
    tolerance_px: float,
) -> float:
    """Compute the share of the contact's markers that move with the rigid motion of its middle.

    The contact is the two thirds of the markers that are nearest to its centre. `pressed_px` is the displacement by the
    press, `since_px` that since then, NaN where a marker is not followed; the share is NaN where none is.

    References
    ----------
    Sui et al., *Incipient Slip Detection Method for Soft Objects with Vision-Based Tactile Sensor*, Measurement 2022.
    """
    rank = rank_in_field(rest_px, pressed_px)
    place = rest_px + pressed_px
    followed = np.all(np.isfinite(since_px) & np.isfinite(place), axis=1)
    contact, middle = followed & (rank < 2 * INNER_SHARE), followed & (rank < INNER_SHARE)
    if middle.sum() < 2:
        return np.nan
    arm, rest = place - place[middle].mean(axis=0), since_px - since_px[middle].mean(axis=0)
    across = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    turn = (across * rest)[middle].sum() / max((arm[middle] ** 2).sum(), 1e-9)
    distance = np.linalg.norm(rest - turn * across, axis=1)
    return float((distance[contact] < tolerance_px).mean())
