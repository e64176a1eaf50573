"""Fingertips: where their markers and cameras are."""

from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplens.simulation import CHROMATOUCH, FLAT_GEL
from sliplens.simulation.sensor import Dome, FlatPad, mix_noise, pick_noise

DOME, PAD = cast("Dome", CHROMATOUCH.geometry), cast("FlatPad", FLAT_GEL.geometry)


@pytest.mark.parametrize("geometry", [DOME, PAD])
def test_rays_look_back_to_where_points_were_seen(geometry):
    points = geometry.marker_positions()
    rays = geometry.rays(geometry.project(points))
    camera = np.array([0, 0, -geometry.camera_offset * geometry.radius_m if geometry is DOME else -0.020])
    ahead = points - camera
    looked_at = ahead[:, 2] > 0.3 * np.linalg.norm(ahead, axis=-1)
    np.testing.assert_allclose(rays[looked_at], (ahead[:, :2] / ahead[:, 2:])[looked_at], atol=1e-9)


@settings(max_examples=40)
@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(0.0, 0.3), st.floats(0, 2 * np.pi), st.floats(0, 1))
def test_skin_in_contact_is_seen_where_the_contact_map_says(cx, cy, contact, bearing, reach):
    """A point of the dome inside the contact, displaced as Hertz says, is seen at its distance from the centre."""
    radius = DOME.radius_m
    centre, a = np.array([cx, cy]) * radius, contact * radius
    sideways = centre + reach * a * np.array([np.cos(bearing), np.sin(bearing)])
    lift = a**2 / radius - np.sum((sideways - centre) ** 2) / (2 * radius)
    # the sphere as Hertz sees it, a paraboloid
    point = np.append(sideways, radius - sideways @ sideways / (2 * radius) - lift)
    rays = DOME.rays(DOME.project(point[None, None]))
    square = DOME.face_distance_squared(rays, contact_centre_m=centre, indentation_m=np.array([a**2 / radius]))
    # the map is computed in single precision, from lengths of the dome's radius
    assert np.sqrt(square[0, 0, 0]) == pytest.approx(reach * a, abs=2e-3 * radius)


def test_rings_are_where_they_were_measured():
    rest = DOME.project(DOME.marker_positions())
    from_apex = np.linalg.norm(rest - np.asarray(DOME.centre_px), axis=-1)
    # measured at 30.9, 62.1 and 93.6 px; markers scatter round their rings by 0.38 px rms: two of that
    rings = np.repeat(np.arange(len(DOME.ring_counts)), DOME.ring_counts)
    for ring, radius in ((1, 30.9), (2, 62.1), (3, 93.6)):
        np.testing.assert_allclose(from_apex[rings == ring], radius, atol=0.76)
    assert sum(DOME.ring_counts) == 82


@pytest.mark.parametrize("noise", [CHROMATOUCH.noise, FLAT_GEL.noise], ids=["chromatouch", "flat-gel"])
def test_neighbours_and_colours_share_the_noise_they_should(noise):
    mixed = mix_noise(pick_noise(400, rng=np.random.default_rng(0)), noise=noise, image_size_px=64).numpy()

    def correlation(one, other):
        return float(np.mean(one * other))

    weight = noise.smoothness
    for axis in (2, 3):
        ahead, behind = (np.take(mixed, range(*ends), axis=axis) for ends in ((1, 64), (0, 63)))
        # the moving average 1, w has this correlation at lag 1, and none beyond
        assert correlation(ahead[2], behind[2]) == pytest.approx(weight / (1 + weight**2), abs=0.01)
    assert correlation(mixed[2, :, 2:], mixed[2, :, :-2]) == pytest.approx(0, abs=0.01)
    assert correlation(mixed[0], mixed[1]) == pytest.approx(noise.red_in_green, abs=0.01)
    assert correlation(mixed[0], mixed[2]) == pytest.approx(0, abs=0.01)
