"""The best reading of the margin: closed forms, conditioning of Gaussians, and what an unbiased reading must obey."""

import numpy as np
import pytest
from bounds import least_sigma

from sliplens.errors import ContactError
from sliplens.simulation import CHROMATOUCH, Nuisances, SimulationRecipe, plan_trials
from sliplens.simulation.intervention import (
    MARGIN,
    NOISE_PX,
    UNKNOWNS,
    FilmedTrial,
    marker_readings,
    marker_sensitivity,
    prior_sigma,
    reading_gain,
    visible_markers,
)
from sliplens.simulation.nuisances import Grasp, Touch
from sliplens.simulation.trials import prepare_trial

NAMES = (MARGIN, "log_friction", "log_load")
PRIOR = {"log_friction": 0.2, "log_load": 0.5}


@pytest.fixture
def jacobian(rng) -> np.ndarray:
    return rng.normal(size=(8, 3))


@pytest.fixture(scope="module")
def trial() -> FilmedTrial:
    plan = plan_trials(SimulationRecipe(dry_trials=3, wet_trials=1, frames_per_trial=24, seed=5))[-1]
    loading, film = prepare_trial(plan)
    return FilmedTrial(plan=plan, loading=loading, film=film)


def test_with_priors_the_reading_is_the_mean_of_the_conditioned_gaussian(jacobian):
    prior = {MARGIN: 0.3, **PRIOR}
    spread = np.diag(np.square([prior[name] for name in NAMES]))
    expected = (spread @ jacobian.T @ np.linalg.inv(jacobian @ spread @ jacobian.T + 0.4**2 * np.eye(8)))[0]
    gain = reading_gain(jacobian, NAMES, noise_px=0.4, prior=prior)
    np.testing.assert_allclose(gain, expected, rtol=1e-9)
    # and shrinks by what is left of the prior's variance
    bound = least_sigma(jacobian, NAMES, noise_px=0.4, prior=prior)
    assert gain @ jacobian[:, 0] == pytest.approx(1 - bound**2 / 0.3**2, rel=1e-9)


def test_the_error_is_the_bound_of_the_sensor_too():
    touch, prior = Touch(grasp=Grasp(normal_force_n=1.2)), prior_sigma(Nuisances(), wet=False)
    for jacobian in marker_sensitivity(np.array([0.2, 0.5, 0.8]), sensor=CHROMATOUCH, touch=touch):
        bound = least_sigma(jacobian, UNKNOWNS, noise_px=0.1, prior=prior)
        gain = reading_gain(jacobian, UNKNOWNS, noise_px=0.1, prior=prior)
        passed = gain @ jacobian
        # columns from metres to radians: digits are lost to their angles, not to their lengths
        assert passed[0] == pytest.approx(1, rel=1e-6)
        spread = sum((passed[UNKNOWNS.index(name)] * sigma) ** 2 for name, sigma in prior.items())
        assert np.sqrt(0.1**2 * gain @ gain + spread) == pytest.approx(bound, rel=1e-6)


def test_a_markers_effect_is_what_the_reading_loses_with_it(trial):
    frame = int(np.nanargmin(np.abs(trial.loading.safety_margin - 0.5)))
    margin = trial.loading.safety_margin[frame]
    seen, effects = marker_readings(trial, frame)
    np.testing.assert_array_equal(seen, visible_markers(CHROMATOUCH))
    # slow: the normal equations, and each marker put back by hand
    [one] = marker_sensitivity(np.array([margin]), sensor=CHROMATOUCH, touch=trial.touch(frame))
    prior = prior_sigma(trial.plan.recipe.nuisances, wet=True)
    jacobian = one / NOISE_PX
    precision = np.diag([0.0, *(1 / prior[name] ** 2 for name in UNKNOWNS[1:])])
    gain = np.linalg.solve(jacobian.T @ jacobian + precision, jacobian.T)[0] / NOISE_PX
    moved = (trial.film.motion.centres_px[frame] - trial.film.motion.rest_px)[seen]
    for marker in range(0, len(seen), 7):
        back = moved.copy()
        back[marker] = 0
        # the condition of the normal equations is the square of the problem's
        assert gain @ (moved - back).ravel() == pytest.approx(effects[marker], rel=1e-4, abs=1e-6)


def test_without_contact_there_is_no_margin_to_read(trial):
    with pytest.raises(ContactError, match=r"frame 0 of .* has no contact, and so no margin; choose"):
        marker_readings(trial, 0)
