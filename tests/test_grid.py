import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drake_safety.learning.grid import OUTSIDE, Grid

GRID = Grid(resolution=14, cell_length=10.0)
GRIDS = st.builds(Grid, resolution=st.integers(1, 20), cell_length=st.floats(0.1, 100.0))
SEEDS = st.integers(0, 2**32 - 1)


def interpolated(grid, points, values):
    """One value a cell, at points of one map."""
    found, _ = grid.interpolate(np.asarray(points)[None], np.asarray(values)[None, :, None])
    return found[0, :, 0]


@given(GRIDS)
def test_each_centre_lies_in_its_own_cell(grid):
    np.testing.assert_array_equal(grid.locate(grid.centres), np.arange(grid.num_cells))
    # The first coordinate counts rows.
    corners = np.array([[-69.0, -69.0], [-69.0, -59.0], [-59.0, -69.0]])
    np.testing.assert_array_equal(GRID.locate(corners), [0, 1, 14])


@pytest.mark.parametrize("point", [(70.0, 0.0), (0.0, -70.1), (np.nan, 0.0), (np.inf, 0.0)])
def test_a_point_beyond_the_edge_is_outside_and_not_in_the_last_cell(point):
    assert GRID.locate(np.array(point)) == OUTSIDE
    for read in (GRID.interpolate, GRID.look_up):
        values, is_inside = read(np.array([[point]]), np.ones((1, GRID.num_cells, 2)))
        np.testing.assert_array_equal(values, np.zeros((1, 1, 2)))
        assert not is_inside.any()


@given(GRIDS, SEEDS)
def test_scaled_points_are_centred_and_fill_the_grid_but_for_a_tenth(grid, seed):
    half = 0.5 * grid.resolution * grid.cell_length
    scaled = grid.scale(np.random.default_rng(seed).normal(3.0, 20.0, size=(500, 2)))
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=1e-9 * half)
    assert 1.1 * np.abs(scaled).max() == pytest.approx(half)


@given(GRIDS, SEEDS)
def test_interpolation_is_linear_between_the_centres_and_nearest_beyond_the_outermost(grid, seed):
    rng, outermost = np.random.default_rng(seed), np.abs(grid.centres).max()
    points = rng.uniform(-1.0, 1.0, size=(200, 2)) * (outermost + 0.49 * grid.cell_length)
    found = interpolated(grid, points, grid.centres @ [2.0, -3.0] + 5.0)
    expected = np.clip(points, -outermost, outermost) @ [2.0, -3.0] + 5.0
    np.testing.assert_allclose(found, expected, atol=1e-9 * (1.0 + outermost))
    values = rng.uniform(size=grid.num_cells)
    np.testing.assert_allclose(interpolated(grid, grid.centres, values), values, atol=1e-12)


@given(SEEDS)
def test_each_map_reads_its_own_cells(seed):
    rng = np.random.default_rng(seed)
    values = rng.uniform(size=(3, GRID.num_cells, 2))
    points = rng.uniform(-69.0, 69.0, size=(3, 50, 2))
    found, is_inside = GRID.look_up(points, values)
    assert is_inside.all()
    for k in range(3):
        np.testing.assert_array_equal(found[k], values[k][GRID.locate(points[k])])
        alone, _ = GRID.interpolate(points[k : k + 1], values[k : k + 1])
        np.testing.assert_array_equal(GRID.interpolate(points, values)[0][k], alone[0])
