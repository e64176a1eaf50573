"""Estimates from a marker field: its affine parts, the end of the press, the sticking share, and the traction."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sliplens.errors import InputError

_PRESSED_SHARE = 0.9  # of the trial's largest spread, at which the press is complete, creep aside
_PULL_PX = 0.2  # of the inner markers' mean motion: several times its noise
_HERTZ = 2 / 3  # exponent of the load in the displacement that it causes, of a sphere that is pressed
_LARGEST_RATIO = 1.0  # that a contact carries: a load that is smaller than the shear over it is raised
_FEWEST_STATES, _FEWEST_MARKERS = 3, 6
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


@dataclass(frozen=True, kw_only=True)
class MarkerTraction:
    """Load and shear of some frames, as the markers show them; NaN where fewer than 6 are followed."""

    shear_n: Float[np.ndarray, "frames 2"]
    """Tangential force in newtons, on the axes of the calibration."""
    normal_n: Float[np.ndarray, " frames"]
    """Normal force in newtons, as given, or from how far the field spreads."""

    @property
    def vector(self) -> Float[np.ndarray, "frames 2"]:
        """Shear over load: the traction ratio F_t / F_n with its direction."""
        return self.shear_n / self.normal_n[:, None]

    @property
    def ratio(self) -> Float[np.ndarray, " frames"]:
        """Traction ratio F_t / F_n."""
        return np.linalg.norm(self.vector, axis=1)

    @property
    def direction_deg(self) -> Float[np.ndarray, " frames"]:
        """Direction of the pull, from 0 to 360 degrees, counted from the first axis towards the second."""
        return np.degrees(np.arctan2(self.shear_n[:, 1], self.shear_n[:, 0])) % 360


@dataclass(frozen=True, kw_only=True)
class TractionModel:
    """Displacement of each marker by shear and load; see `calibrate_traction`."""

    fields: Float[np.ndarray, "3 markers 2"]
    """Displacement in pixels per newton along each axis of shear, and per newton^(2/3) of normal force."""
    covariance: Float[np.ndarray, "coordinates coordinates"]
    """Covariance of what these leave of a state of 1 newton, in square pixels, coordinate after coordinate."""

    def measure(
        self, displacement_px: Float[np.ndarray, "frames _ 2"], normal_n: Float[np.ndarray, " frames"] | None = None
    ) -> MarkerTraction:
        """Measure the traction of frames by weighted least squares.

        Parameters
        ----------
        displacement_px
            Displacement of the markers from the untouched sensor, in pixels; NaN where one is not followed.
        normal_n
            Normal force in newtons where it is measured, as by a gripper; estimated from the markers if None.

        Raises
        ------
        InputError
            If the markers are others than those of the calibration, or a normal force is not positive.
        """
        frames, markers = displacement_px.shape[:2]
        if markers != self.fields.shape[1]:
            raise InputError(
                f"the field has {markers} markers, the calibration {self.fields.shape[1]}; track both from one "
                "untouched frame"
            )
        if normal_n is not None and not np.all(normal_n > 0):
            raise InputError("a normal force must be positive, in newtons; leave out frames without contact")
        parts = np.full((frames, 3), np.nan)
        for frame, moved in enumerate(displacement_px.reshape(frames, -1)):
            followed = np.isfinite(moved)
            if followed.sum() < 2 * _FEWEST_MARKERS:
                continue
            fields, rest = self.fields.reshape(3, -1)[:, followed], moved[followed]
            if normal_n is not None:
                parts[frame, 2] = normal_n[frame] ** _HERTZ
                fields, rest = fields[:2], rest - parts[frame, 2] * fields[2]
            weighted = np.linalg.solve(self.covariance[np.ix_(followed, followed)], fields.T)
            parts[frame, : len(fields)] = np.linalg.solve(fields @ weighted, rest @ weighted)
        shear_n, load_n = parts[:, :2], np.maximum(parts[:, 2], 0) ** (1 / _HERTZ)
        least_n = np.maximum(np.linalg.norm(shear_n, axis=1), 1e-9) / _LARGEST_RATIO
        return MarkerTraction(shear_n=shear_n, normal_n=np.maximum(load_n, least_n) if normal_n is None else normal_n)


def calibrate_traction(
    displacement_px: Float[np.ndarray, "states markers 2"], force_n: Float[np.ndarray, "_ 3"]
) -> TractionModel:
    """Calibrate markers by known loads: five states, one of them vertical, are enough.

    A dome under load is spread by the press, as Hertz's contact by F_n^(2/3), and sheared in proportion to F_t. Both
    fields are fitted for each marker; states weigh by 1 / F_n, as their errors grow with the load. What a dome does
    besides (it leans, its contact wanders) is the covariance of the residuals, shrunk by half towards equal ones; it
    weighs the markers when traction is measured.

    Parameters
    ----------
    displacement_px
        Displacement of each marker from the untouched sensor, in pixels; markers with a NaN count as unmoved.
    force_n
        Shear along two axes and normal force, in newtons.

    Raises
    ------
    InputError
        If states or markers are too few, a normal force is not positive, or the states have no shear in two directions.

    References
    ----------
    Johnson, *Contact Mechanics* (1985), sections 4.2 and 7.2. Ledoit and Wolf, *A well-conditioned estimator for
    large-dimensional covariance matrices*, 2004, for the shrinkage.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.markers import calibrate_traction
    >>> place_px = np.array([[x, y] for x in (-40.0, 0, 40) for y in (-40.0, 0, 40)])
    >>> force_n = np.array([[0.0, 0, 1], [0.3, 0, 1], [0, 0.3, 1], [-0.3, 0, 1], [0, 0, 8]])
    >>> moved_px = force_n[:, None, :2] + 0.01 * force_n[:, None, 2:] ** (2 / 3) * place_px
    >>> model = calibrate_traction(moved_px, force_n)
    >>> heavier_px = np.array([2.0, 0]) + 0.01 * 5 ** (2 / 3) * place_px  # 2 N of shear, 5 N of load
    >>> model.measure(heavier_px[None]).ratio.round(2)
    array([0.4])
    """
    states, markers, _ = displacement_px.shape
    if len(force_n) != states:
        raise InputError(f"{states} fields but {len(force_n)} forces; give a force for each state")
    if states < _FEWEST_STATES or markers < _FEWEST_MARKERS:
        raise InputError(
            f"{states} states of {markers} markers cannot be calibrated; give {_FEWEST_STATES} and {_FEWEST_MARKERS}"
        )
    if not np.all(force_n[:, 2] > 0):
        raise InputError("every calibration state needs a normal force above 0 N; leave out the untouched sensor")
    weight = force_n[:, 2:] ** -0.5
    terms = np.concatenate([force_n[:, :2], force_n[:, 2:] ** _HERTZ], axis=1) * weight
    if np.linalg.matrix_rank(terms, tol=1e-3 * np.linalg.norm(terms)) < 3:
        raise InputError("the calibration states do not shear in two directions; tilt the sensor about two axes")
    moved = np.nan_to_num(displacement_px.reshape(states, -1)) * weight
    fields = np.linalg.lstsq(terms, moved, rcond=None)[0]
    residual = moved - terms @ fields
    covariance = residual.T @ residual / states
    level = max(float(np.trace(covariance)) / len(covariance), 1e-6)
    shrunk = (covariance + level * np.eye(len(covariance))) / 2
    return TractionModel(fields=fields.reshape(3, markers, 2), covariance=shrunk)
