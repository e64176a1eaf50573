import numpy as np

from sliplens.markers.doublets import resolve_signs

GRID = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2) * 10


def test_one_shift_of_all_markers_gets_one_sign(rng: np.random.Generator):
    flipped = rng.choice([-1.0, 1.0], len(GRID))
    signs = resolve_signs(GRID, flipped[:, None] * np.array([2.0, -1.0]), pressed=False)
    assert len(set(signs * flipped)) == 1


def test_a_press_moves_outwards(rng: np.random.Generator):
    outward = 0.1 * (GRID - GRID.mean(axis=0))
    flipped = rng.choice([-1.0, 1.0], len(GRID))
    signs = resolve_signs(GRID, flipped[:, None] * outward, pressed=True)
    np.testing.assert_array_equal(signs, flipped)


def test_markers_that_nothing_binds_get_a_sign_too():
    way = np.zeros(GRID.shape)
    assert np.all(np.abs(resolve_signs(GRID, way, pressed=True)) == 1)
    way[0] = (3.0, 0.0)  # one alone moves
    assert np.all(np.abs(resolve_signs(GRID, way, pressed=True)) == 1)
