"""The plane that is drawn of a chart of three dimensions."""

from copy import copy, deepcopy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from planted import ChartPolicy, Cube, sphere_policy

import hyrl_mj
from hyrl_mj import find_critical_set
from hyrl_mj.learning import WaySettings
from hyrl_mj.runs.arcs import overview_arcs
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.partition import Partition
from hyrl_mj.viz import section as section_module
from hyrl_mj.viz.replay.marks import ON_FLOOR, on_floor, tracked_points
from hyrl_mj.viz.section import Section

HEIGHT, RADIUS = 0.3, 0.7
ACROSS = np.sqrt(RADIUS**2 - HEIGHT**2)


class Cut(Cube):
    """A cube that is drawn at c = HEIGHT."""

    scene = replace(Cube.scene, starts=((0.1, 0.2, HEIGHT),))
    start_low, start_high = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    set_point = np.zeros(3)


@pytest.fixture(scope="module")
def cube():
    return Cut(lambda z: np.linalg.norm(z, axis=1))


@pytest.fixture(scope="module")
def section(cube):
    return Section(cube)


@pytest.fixture(scope="module")
def ball(cube):
    grid = Grid.with_cells(cube.chart, 40)
    return GridSet(grid, np.linalg.norm(grid.nodes, axis=1) - RADIUS)


def test_a_ball_becomes_a_disc(section, ball):
    extended = ExtendedSets(
        (0,), (ball,), (ball.mask,), 0.3, 0.1, np.zeros((1, 3)), np.array([0.1]), np.array([[0, 0]])
    )
    cut, part = (
        section.extended_sets(extended),
        section.partition(Partition((0,), (ball,), ball.mask)),
    )
    for found, wins in ((cut.sets[0], cut.winning[0]), (part.parts[0], part.succeeds)):
        assert found.grid.counts == (41, 41)
        from_middle = np.linalg.norm(found.grid.nodes, axis=1)
        inside = from_middle <= ACROSS
        sure = np.abs(from_middle - ACROSS) > 2 * found.grid.cell
        np.testing.assert_array_equal(found.mask[sure], inside[sure])
        np.testing.assert_array_equal(wins[sure], inside[sure])


def test_its_critical_set_is_searched_for_in_the_plane(cube, section, monkeypatch):
    policy = sphere_policy(cube, RADIUS)
    whole = find_critical_set(cube, policy, 8, 1 / 4)
    settings = SimpleNamespace(rods=20, resolution=1 / 16, eps=0.1, ways=WaySettings())
    run = SimpleNamespace(critical_set=whole, steady=policy, settings=settings)
    monkeypatch.setattr(section_module, "CELLS", 20)
    found = section.critical_set(run)
    assert found.points.shape[1] == 2
    assert len(found.points) > 30
    off = np.abs(np.linalg.norm(found.points, axis=1) - ACROSS)
    assert off.max() <= found.resolution


def test_it_says_where_it_is(section):
    chart = section.chart
    assert (chart.names, chart.section) == (("a", "b"), "c = 0.3 m")
    assert section.set_point.tolist() == [0.0, 0.0]


def test_runs_of_the_whole_task_are_cut_to_it():
    rover = hyrl_mj.get_task("rover")
    section, z = Section(rover), rover.starts(20, np.random.default_rng(0))
    np.testing.assert_array_equal(section.lift(z[:, :2]), z * [1, 1, 0])
    np.testing.assert_array_equal(section.noise(0.1), rover.noise_in_chart(0.1)[:2])
    np.testing.assert_array_equal(section.failed(z[:, :2]), rover.failed(rover.at(z * [1, 1, 0])))


def test_an_overview_starts_along_the_longest_side_of_the_start_region(cube, vehicle):
    policy = sphere_policy(cube, RADIUS)
    starts = np.array([arc.z[0] for arc in overview_arcs(cube, policy)])
    assert starts.shape == (24, 3), "the region is all of the plane"
    assert (starts[:, 2] == HEIGHT).all()
    assert len(np.unique(starts[:, :2], axis=0)) == 24
    ahead = ChartPolicy(vehicle, lambda z: np.zeros((len(z), 1)))
    z = np.array([arc.z[0] for arc in overview_arcs(vehicle, ahead)])
    assert (z[:, 0] == vehicle.start_low[0]).all()
    np.testing.assert_allclose(np.diff(z[:, 1]), np.diff(z[:2, 1])[0])


def test_a_plane_is_left_as_it_is(vehicle):
    section = Section(vehicle)
    assert section.chart == vehicle.chart
    assert not section.cut
    something = object()
    assert section.partition(something) is something
    assert section.extended_sets(something) is something


def test_what_lies_on_the_floor_is_below_who_flies(puck):
    points = np.array([[0.1, 0.2, 0.8], [0.3, 0.4, 0.012]])
    laid = on_floor(puck, points)
    np.testing.assert_array_equal(laid[:, :2], points[:, :2])
    assert 0 < laid[0, 2] < 0.02
    assert laid[1, 2] == 0.012


def test_marks_of_a_point_in_the_floor_lie_on_it(puck):
    low = copy(puck)
    low.model = deepcopy(puck.model)
    low.model.site("tracked").pos[2] = -0.3
    assert tracked_points(low, np.zeros((1, 2)))[0, 2] == -2 * ON_FLOOR
    low.model.geom("floor").quat[:] = np.cos(0.2), 0.0, np.sin(0.2), 0.0
    assert tracked_points(low, np.zeros((1, 2)))[0, 2] < -0.2  # a ramp is below it elsewhere


def test_where_there_is_no_critical_set_there_is_none_in_the_plane(cube):
    nothing = hyrl_mj.CriticalSet(np.empty((0, 3)), np.zeros(0, dtype=int), 0.01, 0.1)
    section = Section(cube)
    found = section.critical_set(SimpleNamespace(task=cube, critical_set=nothing))
    assert section.lift(found.points).shape == (0, 3)
