from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplens.errors import InputError
from sliplens.markers.estimators import (
    ESTIMATORS,
    FieldTrial,
    affine_parts,
    edge_over_centre,
    find_hold,
    fit_estimator,
    mean_shear,
    rigid_residual,
    stick_area,
)
from sliplens.simulation import SimulationRecipe, plan_trials
from sliplens.simulation.trials import prepare_trial

PLACES = np.stack(np.meshgrid(np.arange(6) * 20.0, np.arange(6) * 20.0), axis=-1).reshape(-1, 2)
MIDDLE = PLACES.mean(axis=0)


def pressed_and_moved(increments, *, spread=0.05):
    """One frame of a press, then displacements on top of it."""
    press = spread / 2 * (PLACES - MIDDLE)
    return FieldTrial(rest_px=PLACES, displacement_px=np.stack([press, *(press + one for one in increments)]), hold=0)


def simulated(trials, *, seed, noise=0.1):
    """Trials of the simulator, markers taken from its truth."""
    recipe = SimulationRecipe(dry_trials=trials, wet_trials=0, frames_per_trial=40, days=4, seed=seed)
    rng, made = np.random.default_rng(seed), []
    for plan in plan_trials(recipe):
        loading, film = prepare_trial(plan)
        seen = ((film.marker_px > 8) & (film.marker_px < 215)).all(axis=(0, 2))
        rest = film.marker_rest_px[seen].astype(float)
        moved = film.marker_px[:, seen] - rest
        moved = moved + rng.normal(0, noise, moved.shape)
        trial = FieldTrial(rest_px=rest, displacement_px=moved, hold=find_hold(rest, moved))
        made.append((plan.split, trial, loading.safety_margin.astype(float)))
    return made


@pytest.fixture(scope="module")
def made():
    return simulated(12, seed=3)


@given(parts=st.lists(st.floats(-0.1, 0.1), min_size=4, max_size=4))
def test_affine_parts_are_the_derivatives_of_an_affine_field(parts):
    matrix = np.array(parts).reshape(2, 2)
    found = affine_parts(PLACES, (PLACES - MIDDLE)[None] @ matrix.T + np.array([3.0, -2.0]))[0]
    (xx, xy), (yx, yy) = matrix
    np.testing.assert_allclose(found, [3, -2, xx + yy, yx - xy, xx - yy, xy + yx], atol=1e-6)


@given(turn=st.floats(-0.02, 0.02), x=st.floats(-3, 3), y=st.floats(-3, 3))
def test_an_object_that_moves_as_one_slips_nowhere(turn, x, y):
    place = PLACES + 0.025 * (PLACES - MIDDLE)
    arm = place - place.mean(axis=0)
    rigid = np.array([x, y]) + turn * np.stack([-arm[:, 1], arm[:, 0]], axis=-1)
    trial = pressed_and_moved([rigid])
    np.testing.assert_allclose(rigid_residual(trial)[1], 0, atol=1e-9)
    assert stick_area(trial, tolerance_px=0.01)[1, 0] == 1


def test_markers_that_stay_behind_are_residual_and_leave_the_stick_area():
    still = pressed_and_moved([np.zeros_like(PLACES)])
    moved = np.where(still.inner[:, None], [2.0, 0.0], 0.0)
    trial = pressed_and_moved([moved])
    # the mean of both halves lies a pixel from either
    np.testing.assert_allclose(rigid_residual(trial)[1], 1.0, atol=1e-9)
    # the inner third moves as one, the outer third is left behind
    share = trial.inner.sum() / trial.contact.sum()
    assert stick_area(trial, tolerance_px=0.1)[1, 0] == pytest.approx(share)
    np.testing.assert_allclose(mean_shear(trial)[1, 0], 2 * trial.inner.mean())


def test_edge_over_centre_is_the_ratio_of_their_motions():
    still = pressed_and_moved([np.zeros_like(PLACES)])
    moved = np.where(still.inner[:, None], [4.0, 0.0], [1.0, 0.0])
    ratio, middle = edge_over_centre(pressed_and_moved([moved]))[1]
    assert ratio == pytest.approx(1.05 / 4.05)
    assert middle == pytest.approx(4.0)


def test_eccentricity_recovers_the_law_it_is_built_on():
    pulls = np.linspace(0, 3, 13)
    trial = pressed_and_moved([np.tile([pull, 0.0], (36, 1)) for pull in pulls])
    # full slip at 3 px for a divergence of 0.05
    margins = np.concatenate([[np.nan], (1 - pulls / 3) ** 1.5])
    answer = fit_estimator("ikeda-eccentricity", [trial], [margins])(trial)
    np.testing.assert_allclose(answer[1:], margins[1:], atol=0.03)
    # pressed twice as hard, as much motion is half as far on the way
    harder = pressed_and_moved([np.tile([pull, 0.0], (36, 1)) for pull in 2 * pulls], spread=0.1)
    np.testing.assert_allclose(
        fit_estimator("ikeda-eccentricity", [trial], [margins])(harder)[1:], margins[1:], atol=0.03
    )


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if name != "constant"])
def test_every_estimator_reads_more_of_new_trials_than_the_constant(name, made):
    train = [(trial, margin) for split, trial, margin in made if split != "test"]
    test = [(trial, margin) for split, trial, margin in made if split == "test"]
    own, constant = (fit_estimator(one, *map(list, zip(*train, strict=True))) for one in (name, "constant"))
    label = np.concatenate([margin for _, margin in test])
    known = np.isfinite(label)
    errors = [
        np.mean((np.concatenate([one(trial) for trial, _ in test]) - label)[known] ** 2) for one in (own, constant)
    ]
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_the_order_of_markers_does_not_matter_and_a_blind_frame_gets_the_mean_of_the_training_labels(name, made):
    train = [(trial, margin) for _, trial, margin in made[:4]]
    estimator = fit_estimator(name, *map(list, zip(*train, strict=True)))
    trial = replace(made[5][1], displacement_px=made[5][1].displacement_px.copy())
    trial.displacement_px[30] = np.nan
    order = np.random.default_rng(0).permutation(len(trial.rest_px))
    turned = replace(trial, rest_px=trial.rest_px[order], displacement_px=trial.displacement_px[:, order])
    answer = estimator(trial)
    assert answer[30] == pytest.approx(np.nanmean(np.concatenate([margin for _, margin in train])))
    np.testing.assert_allclose(estimator(turned), answer, atol=1e-6)
    assert answer.shape == (len(trial),)
    assert np.all((answer >= 0) & (answer <= 1))


def test_what_cannot_be_fitted_is_refused(made):
    trial = made[0][1]
    with pytest.raises(InputError, match="there is no estimator named 'magic'"):
        fit_estimator("magic", [], [])
    with pytest.raises(InputError, match="do not match"):
        fit_estimator("constant", [trial], [np.zeros(3)])
    with pytest.raises(InputError, match="no frame of the training trials has a label"):
        fit_estimator("constant", [trial], [np.full(len(trial), np.nan)])
    with pytest.raises(InputError, match="3 markers are too few"):
        FieldTrial(rest_px=PLACES[:3], displacement_px=np.zeros((2, 3, 2)), hold=0)
    with pytest.raises(InputError, match="frame 7 of the hold"):
        FieldTrial(rest_px=PLACES, displacement_px=np.zeros((2, 36, 2)), hold=7)
