"""Of fine grids only some nodes are simulated, and near the critical set nothing is lost by it."""

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj.sets import Grid, covering, enough_cells
from hyrl_mj.stages.refinement import THIN, refined, strides, thinned

NOISE = 0.1


@pytest.fixture(scope="module")
def rover():
    return hyrl_mj.get_task("rover")


@pytest.fixture(scope="module")
def grid(rover):
    bound = rover.noise_in_chart(NOISE)
    return covering(rover.chart, enough_cells(rover.chart, bound, 30, 88), bound)


def side(z):
    """Which side a planted policy takes: it decides by the place where it is heading."""
    return (z[:, 1] + 1.3 * z[:, 2] > 0).astype(float)


def test_cells_are_as_short_as_the_noise_needs(rover, grid):
    bound = rover.noise_in_chart(NOISE)
    noisy = bound > 0
    assert (grid.spacing[noisy] <= bound[noisy] / 2 * (1 + 1e-9)).all()
    assert enough_cells(rover.chart, bound, 30, 40) == 40
    assert enough_cells(rover.chart, 0 * bound, 30, 88) == 30


def test_one_node_in_four_along_noisy_coordinates_is_simulated(rover, grid):
    assert strides(rover, grid).tolist() == [1, THIN, THIN]
    rows, (first, second) = thinned(rover, grid)
    assert len(rows) < 1.3 * grid.size / THIN**2
    apart = np.abs(grid.nodes[rows[first]] - grid.nodes[rows[second]]) / grid.spacing
    assert set(np.round(apart.sum(axis=1)).astype(int)) <= {1, THIN}
    ends = grid.nodes[rows]
    np.testing.assert_allclose(
        [ends.min(axis=0), ends.max(axis=0)], [grid.chart.low, grid.chart.high]
    )


def test_all_nodes_of_kinematic_plants_are_simulated():
    vehicle = hyrl_mj.get_task("vehicle")
    grid = Grid.with_cells(vehicle.chart, 40)
    assert (strides(vehicle, grid) == 1).all()
    assert len(thinned(vehicle, grid)[0]) == grid.size


def test_near_the_critical_set_it_is_known_as_if_all_were_simulated(rover, grid):
    asked = []

    def tell(rows):
        asked.append(len(rows))
        return side(grid.nodes[rows])[:, None]

    y = np.linspace(-1, 1, 60)
    points = np.stack(
        [np.tile([0.0, 1.0, 2.0, 3.0, 4.0], 60), np.repeat(y, 5), np.repeat(-y / 1.3, 5)], 1
    )
    everywhere = np.ones(grid.size, dtype=bool)
    known = refined(rover, grid, everywhere, points, 1.0, tell, 1)[:, 0]
    assert sum(asked) < 0.25 * grid.size
    near = np.abs(grid.nodes[:, 1]) < 1.0
    np.testing.assert_array_equal(known[near], side(grid.nodes)[near])
    # Far from it they take after others, no farther than two nodes away.
    far = refined(rover, grid, everywhere, points[:0], 1.0, tell, 1)[:, 0]
    wrong = far != side(grid.nodes)
    assert 0 < wrong.mean() < 0.1
    reach = (np.array([0, 1, 1]) * THIN * grid.spacing * [0, 1, 1.3]).sum()
    assert np.abs(grid.nodes[wrong, 1] + 1.3 * grid.nodes[wrong, 2]).max() <= reach


def test_only_what_is_wanted_is_asked_for(rover, grid):
    wanted = np.abs(grid.nodes[:, 1]) < 0.2
    asked = []

    def tell(rows):
        asked.extend(rows)
        return side(grid.nodes[rows])[:, None]

    refined(rover, grid, wanted, np.zeros((1, 3)), 1.0, tell, 1)
    assert np.abs(grid.nodes[asked, 1]).max() <= 0.2 + THIN * grid.spacing[1]
