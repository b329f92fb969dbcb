import numpy as np
import pytest

from drake_safety.learning.grid import OUTSIDE, Grid

GRID = Grid(resolution=14, cell_length=10.0)


def test_each_centre_lies_in_its_own_cell():
    np.testing.assert_array_equal(GRID.locate(GRID.centres), np.arange(GRID.num_cells))


def test_the_first_coordinate_counts_rows():
    assert GRID.locate(np.array([-69.0, -69.0])) == 0
    assert GRID.locate(np.array([-69.0, -59.0])) == 1
    assert GRID.locate(np.array([-59.0, -69.0])) == 14


def interpolated(grid, points, values):
    """One value a cell, at points of one map."""
    found, _ = grid.interpolate(np.asarray(points)[None], np.asarray(values)[None, :, None])
    return found[0, :, 0]


@pytest.mark.parametrize("point", [(70.0, 0.0), (0.0, -70.1), (np.nan, 0.0), (np.inf, 0.0)])
def test_a_point_beyond_the_edge_is_outside_and_not_in_the_last_cell(point):
    assert GRID.locate(np.array(point)) == OUTSIDE
    for read in (GRID.interpolate, GRID.look_up):
        values, is_inside = read(np.array([[point]]), np.ones((1, GRID.num_cells, 2)))
        np.testing.assert_array_equal(values, np.zeros((1, 1, 2)))
        assert not is_inside.any()


def test_scaled_points_are_centred_and_fill_the_grid_but_for_a_tenth():
    points = np.random.default_rng(0).normal(3.0, 20.0, size=(500, 2))
    scaled = GRID.scale(points)
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=1e-9)
    assert 1.1 * np.abs(scaled).max() == pytest.approx(70.0)


def test_interpolation_reproduces_a_linear_function_between_the_outermost_centres():
    points = np.random.default_rng(1).uniform(-65.0, 65.0, size=(200, 2))
    found = interpolated(GRID, points, GRID.centres @ [2.0, -3.0] + 5.0)
    np.testing.assert_allclose(found, points @ [2.0, -3.0] + 5.0, atol=1e-9)
    values = np.random.default_rng(2).uniform(size=GRID.num_cells)
    np.testing.assert_allclose(interpolated(GRID, GRID.centres, values), values, atol=1e-12)


def test_between_the_outermost_centres_and_the_edge_the_nearest_centres_count():
    values = np.arange(GRID.num_cells, dtype=float)
    found = interpolated(GRID, [[-69.9, -69.9], [69.9, -65.0], [-69.0, -60.0]], values)
    np.testing.assert_allclose(found, [0.0, 13 * 14, 0.5])
    one = Grid(resolution=1, cell_length=2.0)
    np.testing.assert_allclose(interpolated(one, [[0.3, -0.7]], [4.0]), [4.0])


def test_each_map_reads_its_own_cells():
    values = np.random.default_rng(3).uniform(size=(3, GRID.num_cells, 2))
    points = np.random.default_rng(4).uniform(-69.0, 69.0, size=(3, 50, 2))
    found, is_inside = GRID.look_up(points, values)
    assert is_inside.all()
    for k in range(3):
        np.testing.assert_array_equal(found[k], values[k][GRID.locate(points[k])])
        alone, _ = GRID.interpolate(points[k : k + 1], values[k : k + 1])
        np.testing.assert_array_equal(GRID.interpolate(points, values)[0][k], alone[0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GRID.scale(np.ones((5, 2))), "extent is 0"),
        (lambda: Grid(resolution=0, cell_length=1.0), "resolution is 0"),
        (lambda: Grid(resolution=3, cell_length=0.0), "cell_length is 0"),
    ],
)
def test_a_grid_without_an_extent_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
