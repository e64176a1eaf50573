"""Bounds on the margin: closed forms, conditioning of Gaussians, and what must make a bound larger or smaller."""

from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from bounds import least_sigma

from sliplens.errors import ContactError
from sliplens.simulation import CHROMATOUCH, FLAT_GEL, Nuisances
from sliplens.simulation.intervention import (
    MARGIN,
    NUISANCES,
    UNKNOWNS,
    marker_sensitivity,
    prior_sigma,
    visible_markers,
)
from sliplens.simulation.loading import DISPLACEMENTS, Displacement
from sliplens.simulation.nuisances import Grasp, draw_day, draw_grasp
from sliplens.simulation.sensor import FlatPad

MARGINS = np.array([0.1, 0.2, 0.5, 0.8, 0.95])
TOUCH = Grasp(shear_exponent=0.6, normal_force_n=1.25)
PRIOR = prior_sigma(Nuisances(), wet=False)
SHEARED = replace(FLAT_GEL, effective_modulus_pa=20_000.0)


def margin_bound(
    jacobian: np.ndarray, *, noise_px: float, prior: dict[str, float], unknowns: tuple[str, ...] = UNKNOWNS
) -> np.ndarray:
    return np.array([least_sigma(part, unknowns, noise_px=noise_px, prior=prior) for part in jacobian])


def without(name):
    return {key: value for key, value in PRIOR.items() if key != name}


@pytest.fixture
def sheared_skin(monkeypatch):
    """A flat pad that nothing moves but the shear of its whole skin: every derivative is elementary."""
    monkeypatch.setitem(
        DISPLACEMENTS,
        "calibrated",
        Displacement(layer=0.0, local_friction=0.0, clamp_exponent=0.0, skin_shear=0.03),
    )
    return marker_sensitivity(MARGINS, sensor=SHEARED, touch=TOUCH, displacement="calibrated")


def shear_px(touch, margins, *, slope):
    """Shift of a dot by the shear of the skin, or its derivative by the margin, from its definition."""
    pad, grasp = cast("FlatPad", SHEARED.geometry), touch
    # the indentation goes with the force to the power 2/3; 0.775 is the friction of the fitted trial
    touching = (grasp.normal_force_n / Grasp().normal_force_n) ** (2 / 3)
    full = 0.03 * pad.sphere_radius_m * grasp.friction / 0.775 * touching
    p = grasp.shear_exponent
    used = -p * margins ** (p - 1) if slope else 1 - margins**p
    # the camera stands behind the gel: a dot under the skin is nearer to it by its depth
    return pad.focal_px / (pad.camera_distance_m - touch.marker_depth * pad.sphere_radius_m) * full * used


def test_derivative_by_the_margin_is_that_of_the_shear_law(sheared_skin):
    along = sheared_skin[:, :, 0].reshape(len(MARGINS), -1, 2)
    direction = TOUCH.shear_direction_rad
    expected = shear_px(TOUCH, MARGINS, slope=True)[:, None, None] * [np.cos(direction), np.sin(direction)]
    # central differences with a relative step of 1e-4 err by 1e-8, times a few for the third derivative
    np.testing.assert_allclose(along, np.broadcast_to(expected, along.shape), rtol=1e-6)


def test_bound_with_known_nuisances_is_the_noise_over_the_slope_of_all_dots(sheared_skin):
    dots = len(visible_markers(SHEARED))
    bound = margin_bound(sheared_skin, noise_px=0.1, prior={})
    np.testing.assert_allclose(bound, 0.1 / np.sqrt(dots) / -shear_px(TOUCH, MARGINS, slope=True), rtol=1e-6)


def test_bound_of_a_linear_gaussian_model_is_the_deviation_of_its_posterior(rng):
    names = (MARGIN, "log_friction", "log_load")
    jacobian = rng.normal(size=(1, 6, 3))
    prior = {MARGIN: 0.3, "log_friction": 0.2, "log_load": 0.5}
    covariance = np.diag(np.square([prior[name] for name in names]))
    seen = jacobian[0] @ covariance @ jacobian[0].T + 0.4**2 * np.eye(6)
    # conditioning of jointly Gaussian unknowns and observations
    posterior = covariance - covariance @ jacobian[0].T @ np.linalg.solve(seen, jacobian[0] @ covariance)
    bound = margin_bound(jacobian, unknowns=names, noise_px=0.4, prior=prior)
    np.testing.assert_allclose(bound, np.sqrt(posterior[0, 0]), rtol=1e-10)


@pytest.mark.parametrize("displacement", ["calibrated", "half-space"])
def test_knowing_more_never_hurts(displacement):
    sensitivity = marker_sensitivity(MARGINS, sensor=CHROMATOUCH, touch=TOUCH, displacement=displacement)
    prior = margin_bound(sensitivity, noise_px=0.1, prior=PRIOR)
    for name in NUISANCES:
        known = margin_bound(sensitivity, noise_px=0.1, prior=without(name))
        unknown = margin_bound(sensitivity, noise_px=0.1, prior={**PRIOR, name: np.inf})
        # rounding in the least squares
        assert np.all(known <= prior * (1 + 1e-9)), name
        assert np.all(prior <= unknown * (1 + 1e-9)), name


@pytest.mark.parametrize("wet", [False, True])
def test_priors_have_the_spread_of_what_is_drawn(wet, rng):
    ranges = Nuisances()
    days = [draw_day(ranges, quantile=rng.uniform(), rng=rng) for _ in range(8_000)]
    drawn = [draw_grasp(ranges, day=day, wet=wet, rng=rng) for day in days]
    # where in its trial a frame lies, from start to end
    when = rng.uniform(-1, 1, len(drawn))
    friction = [grasp.friction * (1 + grasp.friction_drift * at) for grasp, at in zip(drawn, when, strict=True)]
    load = [
        grasp.normal_force_n * (1 + grasp.normal_force_drift * at) * (1 + grasp.creep) / day.modulus_factor
        for grasp, day, at in zip(drawn, days, when, strict=True)
    ]
    columns = {
        "log_friction": np.log(friction),
        "log_load": np.log(load),
        "offset_x": [grasp.contact_offset[0] for grasp in drawn],
        "tilt_y_rad": [grasp.tilt_rad[1] for grasp in drawn],
        "direction_rad": [grasp.shear_direction_rad for grasp in drawn],
        "shear_exponent": [grasp.shear_exponent for grasp in drawn],
    }
    prior = prior_sigma(ranges, wet=wet)
    for name, values in columns.items():
        # a deviation from 8,000 draws errs by 0.8 %; three of that, and the product's higher orders
        assert prior[name] == pytest.approx(np.std(values), rel=0.03), name


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: marker_sensitivity(np.array([0.0]), sensor=FLAT_GEL, touch=TOUCH), "inside"),
        (lambda one: margin_bound(one, noise_px=0.0, prior={}), "noise and priors must be positive"),
        (lambda one: margin_bound(one, noise_px=0.1, prior={"log_friction": 0.0}), "leave fixed unknowns out"),
    ],
)
def test_impossible_questions_are_refused(call, message):
    with pytest.raises(ContactError, match=message):
        call(np.ones((1, 4, len(UNKNOWNS))))
