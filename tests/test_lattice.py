"""The lattice is the plant: nodes, what one sample makes of them, and what it refuses."""

import copy
import re

import numpy as np
import pytest
from planted import Cube

import hyrl_mj
from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game import lattice as lattice_module
from hyrl_mj.judging.game.lattice import Lattice
from hyrl_mj.sets import Chart, Grid
from hyrl_mj.tasks import Outcome, Task, get_task
from hyrl_mj.tasks.vehicle import Vehicle


@pytest.fixture(scope="module")
def lattices(vehicle):
    """By number of cells."""
    return {n: Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, n)) for n in (60, 240)}


@pytest.fixture(scope="module")
def around_circle(circle):
    return Lattice.tabulate(circle, Grid.with_cells(circle.chart, 720))


def stepped(lattice, level, node):
    """One sample of the plant from nodes (n,) under levels (n,): measurements."""
    plant = lattice.task.plant(len(node))
    plant.set_state(lattice.task.state(lattice.grid.nodes[node])[0])
    plant.step(lattice.levels[level])
    return plant.measurement


def some_moves(lattice, n=3000):
    """Random levels (n,) and running nodes (n,)."""
    rng = np.random.default_rng(0)
    return rng.integers(len(lattice.levels), size=n), rng.choice(np.flatnonzero(lattice.running), n)


# ---- vehicle


def test_nodes_of_the_vehicle_have_arrived_on_the_line_and_failed_where_it_crashes(
    vehicle, lattices
):
    lattice = lattices[240]
    x, y = lattice.grid.nodes.T
    wall = np.abs(y) > 1.5 - 1e-6
    np.testing.assert_array_equal(lattice.arrived, (x > 3 - 1e-6) & ~wall)
    np.testing.assert_array_equal(lattice.failed, wall | (np.hypot(x - 1.5, y) <= 0.751))


def test_the_levels_of_a_discrete_task_are_its_own(vehicle, lattices):
    np.testing.assert_array_equal(lattices[240].levels, vehicle.input_levels)


def test_leaving_the_chart_is_a_failure(vehicle):
    alley = hyrl_mj.get_task("vehicle")
    alley.chart = Chart(("x", "y"), ("m", "m"), (0.0, -1.0), (3.0, 1.0), (False, False))
    lattice = Lattice.tabulate(alley, Grid.with_cells(alley.chart, 60))
    left, straight = (lattice.after[k, 0, lattice.grid.nearest([[0.5, 1.0]])[0]] for k in (-1, 2))
    assert left == lattice.nodes + 1
    np.testing.assert_allclose(lattice.grid.nodes[straight], [0.55, 1.0])


class Alley(Vehicle):
    """A set-point that is a line, with the verdict of `Task`: close to the line is close enough."""

    close = 0.3

    def miss(self, z):
        return np.abs(z[:, 1])


Alley.verdict = Task.verdict


def test_where_episodes_end_as_a_success_to_be_close_to_the_set_point_is_not_enough():
    alley = Alley()
    lattice = Lattice.tabulate(alley, Grid.with_cells(alley.chart, 60))
    beside_the_line = np.array([[0.5, 0.0]])
    assert alley.arrived(beside_the_line).all()
    assert (alley.verdict(beside_the_line) == Outcome.STALLED).all()
    assert not lattice.arrived.any()
    assert (lattice.after == lattice.nodes).any(), "the samples over the line arrive"


# ---- unit circle: between nodes, all the way round


def test_the_circle_s_samples_end_between_the_two_nodes_that_they_lead_to(circle, around_circle):
    lattice = around_circle
    level, node = some_moves(lattice)
    ends = circle.chart.wrap(stepped(lattice, level, node))
    nearest, other = lattice.after[level, :, node].T
    near, far = (
        circle.chart.difference(lattice.grid.nodes[k], ends)[:, 0] / lattice.grid.cell
        for k in (nearest, other)
    )
    assert np.abs(near).max() <= 0.5 + 1e-6
    between = nearest != other
    assert between.mean() > 0.9
    np.testing.assert_allclose(np.abs(near - far)[between], 1, atol=1e-6)
    assert (near * far)[between].max() <= 0
    np.testing.assert_allclose(near[~between], 0, atol=1e-2)


def test_neighbouring_levels_lead_a_cell_apart_at_most(circle):
    lattice = Lattice.tabulate(circle, Grid.with_cells(circle.chart, 240))
    reach = 2 * 0.05 / lattice.grid.cell  # of one sample, in cells
    assert len(lattice.levels) == int(np.ceil(reach)) + 1
    np.testing.assert_allclose(lattice.levels[[0, -1], 0], [-1, 1])
    assert np.ptp(np.diff(lattice.levels[:, 0])) < 1e-12


def test_the_circle_s_nodes_have_arrived_within_the_band(around_circle):
    theta = around_circle.grid.nodes[:, 0]
    np.testing.assert_array_equal(
        around_circle.arrived, np.abs((theta + 3) % (2 * np.pi) - 3) <= 0.3
    )
    assert around_circle.running.all()
    assert not around_circle.failed.any()


# ---- what it refuses


def test_a_chart_of_four_dimensions_is_refused():
    cube = Cube(lambda z: z[:, 0], d=4)
    with pytest.raises(BadInput, match=r"1 to 3 dimensions, that of cube has 4.*--episodes"):
        Lattice.check(cube)


def test_a_plant_whose_state_is_more_than_the_chart_is_refused(circle):
    heavy = hyrl_mj.get_task("unit_circle")
    heavy.model = copy.copy(circle.model)
    heavy.model.actuator_biasprm[0, 2] = -1.0  # a weak servo: the pointer's speed matters
    with pytest.raises(BadInput, match=r"unit_circle has a larger state.*--episodes"):
        Lattice.check(heavy)


def test_a_measurement_of_more_than_the_chart_is_refused():
    seeing = hyrl_mj.get_task("unit_circle")
    seeing.noisy = (True, True)
    assert Lattice.why_not(seeing)


@pytest.mark.parametrize(
    ("u", "message"),
    [
        ([[0.0], [np.nan]], "[nan] cannot be applied"),
        ([[0.0], [-1.01]], "[-1.01] cannot be applied: the limits of vehicle are [-1.0] to [1.0]"),
        ([[0.0], [0.3]], "[0.3] is not one of the levels of vehicle: [-1.0, -0.5, 0.0, 0.5, 1.0]"),
        ([[0.0, 0.0]], "gives (n, 1) inputs, got (1, 2)"),
        ([0.0], "gives (n, 1) inputs, got (1,)"),
    ],
)
def test_an_input_that_the_vehicle_does_not_take_is_refused(lattices, u, message):
    with pytest.raises(BadInput, match=re.escape(message)):
        lattices[60].level_of(np.array(u))


def test_the_level_of_an_input_is_its_own_or_the_nearest(lattices, around_circle):
    np.testing.assert_array_equal(
        lattices[60].level_of(lattices[60].levels + 1e-7), np.arange(len(lattices[60].levels))
    )
    u = np.random.default_rng(0).uniform(-1, 1, (500, 1))
    off = np.abs(around_circle.levels[around_circle.level_of(u)] - u)
    np.testing.assert_allclose(off[:, 0], np.abs(around_circle.levels[:, 0] - u).min(axis=1))


@pytest.mark.parametrize("name", ["vehicle", "unit_circle"])
def test_a_plant_that_moves_all_states_alike_is_stepped_from_few(name, monkeypatch):
    task = get_task(name)
    grid = Grid.with_cells(task.chart, 150)
    monkeypatch.setattr(lattice_module, "SAMPLE", 20)
    few = Lattice.tabulate(task, grid)
    monkeypatch.setattr(lattice_module, "SAMPLE", 10**9)
    every = Lattice.tabulate(task, grid)
    np.testing.assert_array_equal(few.after, every.after)
    np.testing.assert_allclose(few.hops, every.hops, atol=1e-12)
    np.testing.assert_allclose(every.uneven, 0, atol=1e-12)


def test_where_some_states_move_differently_all_are_stepped(vehicle, monkeypatch):
    monkeypatch.setattr(lattice_module, "ALIKE", -1.0)
    monkeypatch.setattr(lattice_module, "SAMPLE", 20)
    grid = Grid.with_cells(vehicle.chart, 60)
    stepped = Lattice.tabulate(vehicle, grid)
    monkeypatch.undo()
    np.testing.assert_array_equal(stepped.after, Lattice.tabulate(vehicle, grid).after)
