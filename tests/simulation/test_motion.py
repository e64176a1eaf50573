"""Where the markers go: symmetries, limits, and the mechanics behind."""

from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from sliplens.mechanics import contact_radius, reduced_modulus, stick_ratio
from sliplens.simulation import CHROMATOUCH, FLAT_GEL
from sliplens.simulation.loading import load_at_margins, move_markers
from sliplens.simulation.nuisances import Grasp
from sliplens.simulation.sensor import FlatPad

WAYS = [(CHROMATOUCH, "calibrated"), (CHROMATOUCH, "half-space"), (FLAT_GEL, "half-space")]
CENTRED = Grasp(contact_offset=(0.0, 0.0), shear_direction_rad=0.0)
MARGINS = np.array([1.0, 0.8, 0.6, 0.4, 0.2, 0.0])
PAD = cast("FlatPad", FLAT_GEL.geometry)


def moved(sensor, displacement, margins=(1.0, 0.8, 0.6, 0.4, 0.2, 0.0), grasp=CENTRED, **more):
    loading = load_at_margins(np.array(margins), grasp=grasp)
    touch = replace(grasp, **{"marker_depth": 0.0, **more})
    return move_markers(sensor, touch, loading=loading, displacement=displacement)


@pytest.mark.parametrize(("sensor", "displacement"), WAYS)
def test_without_load_no_marker_moves(sensor, displacement):
    motion = moved(sensor, displacement, margins=[np.nan])
    np.testing.assert_array_equal(motion.centres_px[0], motion.rest_px)
    np.testing.assert_array_equal(motion.scale[0], 1)
    assert motion.contact_radius_m[0] == motion.stick_radius_m[0] == motion.touch[0] == 0


@pytest.mark.parametrize(("sensor", "displacement"), WAYS)
@pytest.mark.parametrize("depth", [0.0, 0.05])
def test_opposite_pulls_give_opposite_motions(sensor, displacement, depth):
    right = moved(sensor, displacement, marker_depth=depth)
    left = moved(sensor, displacement, grasp=replace(CENTRED, shear_direction_rad=np.pi), marker_depth=depth)
    middle = np.asarray(sensor.geometry.centre_px)
    # the grid of a sensor is its own mirror image: each marker has a twin on the other side
    mirror = (right.rest_px - middle) * [-1, 1] + middle
    twin = np.argmin(np.linalg.norm(right.rest_px[None] - mirror[:, None], axis=-1), axis=1)
    np.testing.assert_allclose(right.rest_px[twin], mirror, atol=1e-9)
    np.testing.assert_allclose((left.centres_px - middle) * [-1, 1] + middle, right.centres_px[:, twin], atol=1e-9)


@pytest.mark.parametrize(("sensor", "displacement"), WAYS)
def test_stick_zone_is_the_share_of_the_contact_that_cattaneo_and_mindlin_give(sensor, displacement):
    motion = moved(sensor, displacement)
    np.testing.assert_allclose((motion.stick_radius_m / motion.contact_radius_m) ** 2, stick_ratio(MARGINS), atol=1e-12)


def test_on_the_half_space_the_stick_zone_moves_as_one_piece():
    margin, grasp = 0.8, replace(CENTRED, normal_force_n=2.0)
    # a gel at nu = 0.5 does not tip: what is seen of the motion is along the pull alone
    sensor = replace(FLAT_GEL, poisson_ratio=0.5)
    motion = moved(sensor, "half-space", margins=[1.0, margin], grasp=grasp)
    radius = PAD.ball_radius_m
    distance = np.linalg.norm(PAD.marker_positions()[:, :2], axis=-1)
    inside = distance < motion.stick_radius_m[1]
    assert inside.sum() == 9
    depth = (motion.contact_radius_m[1] ** 2 - distance[inside] ** 2 / 2) / radius
    shift_px = (motion.centres_px[1] - motion.centres_px[0])[inside]
    # a pinhole of focal length f shows a shift dx at distance D - depth as f dx / (D - depth)
    shift_m = shift_px * ((PAD.camera_distance_m - depth) / PAD.focal_px)[:, None]
    # Johnson (1985), eq. 7.42a, for rubber
    expected_m = 1.5 * grasp.friction * motion.contact_radius_m[1] ** 2 / radius * (1 - margin ** (2 / 3))
    np.testing.assert_allclose(shift_m[:, 0], expected_m, rtol=1e-9)
    np.testing.assert_allclose(shift_m[:, 1], 0, atol=1e-9 * float(expected_m))


@pytest.mark.parametrize(("sensor", "modulus_pa"), [(CHROMATOUCH, 400e3), (FLAT_GEL, 500e3)])
def test_contact_radius_of_the_half_space_is_hertzs(sensor, modulus_pa):
    motion = moved(sensor, "half-space")
    expected = contact_radius(
        CENTRED.normal_force_n,
        sphere_radius_m=sensor.geometry.sphere_radius_m,
        reduced_modulus_pa=reduced_modulus(youngs_modulus_pa=modulus_pa, poisson_ratio=sensor.poisson_ratio),
    )
    np.testing.assert_allclose(motion.contact_radius_m, expected)


def test_a_pressed_gel_pushes_buried_markers_outwards():
    surface, buried = (moved(CHROMATOUCH, "calibrated", margins=[1.0], marker_depth=depth) for depth in (0.0, 0.1))
    ring = slice(1, 7)

    def spread(motion):
        middle = np.asarray(CHROMATOUCH.geometry.centre_px)
        at_rest, now = (
            np.linalg.norm(points[ring] - middle, axis=-1) for points in (motion.rest_px, motion.centres_px[0])
        )
        return (now / at_rest).mean()

    # incompressible gel under the contact has to go somewhere
    assert spread(buried) > spread(surface) + 0.05


def shifted(margin: float, *, let_back: float = 0.0, retaken: float = 0.0) -> np.ndarray:
    """Shift of the markers along and across the pull, that of the pressing taken off."""
    pressed, pulled = (load_at_margins(np.array([value]), grasp=CENTRED) for value in (1.0, margin))
    pulled = replace(pulled, let_back=np.array([let_back]), retaken=np.array([retaken]))
    first, second = (
        move_markers(FLAT_GEL, replace(CENTRED, marker_depth=0.0), loading=one) for one in (pressed, pulled)
    )
    return second.centres_px[0] - first.centres_px[0]


def test_a_pull_that_is_let_back_lags_behind_and_a_closed_loop_leaves_nothing():
    # return-point memory: back where it was let back from, nothing of the loop is left
    np.testing.assert_allclose(shifted(0.4, let_back=0.5, retaken=0.5), shifted(0.4), atol=1e-9)
    # let back to 0.3, the skin is farther along than on the way there, and nearer than where it turned
    way, turned, back = (np.abs(shift).max() for shift in (shifted(0.7), shifted(0.4), shifted(0.7, let_back=0.3)))
    assert way < back < turned
    # pulled again half way, it is between the two branches
    again = np.abs(shifted(0.55, let_back=0.3, retaken=0.15)).max()
    assert np.abs(shifted(0.55)).max() < again < np.abs(shifted(0.55, let_back=0.15)).max()
