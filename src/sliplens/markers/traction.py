"""Traction from the markers of a soft fingertip, calibrated by a few known loads."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sliplens.errors import InputError

HERTZ = 2 / 3
"""Exponent of the load in the displacement that it causes, of a sphere that is pressed."""
_FEWEST_STATES = 3
_FEWEST_MARKERS = 6


@dataclass(frozen=True, kw_only=True)
class Traction:
    """Load and shear of some frames, as the markers show them."""

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
    """Displacement of each marker per newton of shear, and per newton^(2/3) of load; see `calibrate_traction`."""

    shear: Float[np.ndarray, "2 markers 2"]
    """Displacement in pixels per newton along each axis."""
    press: Float[np.ndarray, "markers 2"]
    """Displacement in pixels per newton^(2/3) of normal force."""
    precision: Float[np.ndarray, "coordinates coordinates"]
    """Inverse covariance of what the model leaves of a calibration state of 1 newton, in 1 / pixels^2."""
    largest_ratio: float
    """Traction ratio that the contact cannot carry: a smaller load than the shear over it is raised to that."""

    def measure(
        self,
        displacement_px: Float[np.ndarray, "frames markers 2"],
        normal_n: Float[np.ndarray, " frames"] | None = None,
    ) -> Traction:
        """Measure the traction of frames by weighted least squares.

        Parameters
        ----------
        displacement_px
            Displacement of the markers from the untouched sensor; NaN where one is not followed.
        normal_n
            Normal force in newtons where it is measured, as by a gripper; estimated from the markers if None.

        Raises
        ------
        InputError
            If the markers are others than those of the calibration, or a normal force is not positive.
        """
        if displacement_px.shape[1:] != self.press.shape:
            raise InputError(
                f"the field has {displacement_px.shape[1]} markers, the calibration {len(self.press)}; track both from "
                "one untouched frame"
            )
        if normal_n is not None and not np.all(normal_n > 0):
            raise InputError("a normal force must be positive, in newtons; leave out frames without contact")
        shear_n, load_n = np.full((len(displacement_px), 2), np.nan), np.full(len(displacement_px), np.nan)
        fields = np.concatenate([self.shear, self.press[None]]).reshape(3, -1)
        for frame, moved in enumerate(displacement_px.reshape(len(displacement_px), -1)):
            seen = np.isfinite(moved)
            if seen.sum() < 2 * _FEWEST_MARKERS:
                continue
            known = fields[:, seen]
            weighted = known @ _marginal(self.precision, seen)
            if normal_n is None:
                *shear_n[frame], pressed = np.linalg.solve(weighted @ known.T, weighted @ moved[seen])
                load_n[frame] = max(pressed, 0.0) ** (1 / HERTZ)
            else:
                load_n[frame] = normal_n[frame]
                rest = moved[seen] - load_n[frame] ** HERTZ * known[2]
                shear_n[frame] = np.linalg.solve(weighted[:2] @ known[:2].T, weighted[:2] @ rest)
        if normal_n is None:
            load_n = np.maximum(load_n, np.maximum(np.linalg.norm(shear_n, axis=1), 1e-9) / self.largest_ratio)
        return Traction(shear_n=shear_n, normal_n=load_n)


def _marginal(
    precision: Float[np.ndarray, "coordinates coordinates"], seen: np.ndarray
) -> Float[np.ndarray, "seen seen"]:
    """Compute the precision of some coordinates where the others are unknown (Schur complement)."""
    if seen.all():
        return precision
    cross = precision[np.ix_(seen, ~seen)]
    return precision[np.ix_(seen, seen)] - cross @ np.linalg.solve(precision[np.ix_(~seen, ~seen)], cross.T)


def calibrate_traction(
    displacement_px: Float[np.ndarray, "states markers 2"],
    force_n: Float[np.ndarray, "_ 3"],
    *,
    largest_ratio: float = 1.0,
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
    largest_ratio
        Traction ratio F_t / F_n that the contact cannot carry.

    Returns
    -------
    TractionModel
        Measures the traction vector of other frames, in axes of the given shear.

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
            f"{states} states of {markers} markers cannot be calibrated; give at least {_FEWEST_STATES} states and "
            f"{_FEWEST_MARKERS} markers"
        )
    shear_n, normal_n = force_n[:, :2], force_n[:, 2]
    if not np.all(normal_n > 0):
        raise InputError("every calibration state needs a normal force above 0 N; leave out the untouched sensor")
    terms = np.concatenate([shear_n, normal_n[:, None] ** HERTZ], axis=1)
    weight = 1 / np.sqrt(normal_n)[:, None]
    if np.linalg.matrix_rank(terms * weight, tol=1e-3 * np.linalg.norm(terms * weight)) < terms.shape[1]:
        raise InputError("the calibration states do not shear in two directions; tilt the sensor about two axes")
    moved = np.nan_to_num(displacement_px.reshape(states, -1))
    fields = np.linalg.lstsq(terms * weight, moved * weight, rcond=None)[0]
    residual = (moved - terms @ fields) * weight
    covariance = residual.T @ residual / states
    level = max(float(np.trace(covariance)) / len(covariance), 1e-6)
    return TractionModel(
        shear=fields[:2].reshape(2, markers, 2),
        press=fields[2].reshape(markers, 2),
        precision=np.linalg.inv((covariance + level * np.eye(len(covariance))) / 2),
        largest_ratio=largest_ratio,
    )
