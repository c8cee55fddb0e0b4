"""The plane that is drawn of a chart of three dimensions."""

from dataclasses import replace

import numpy as np
import pytest
from planted import Cube, sphere_policy

from hyrl_mj import LoopSettings, closed_loop, find_critical_set
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.partition import Partition
from hyrl_mj.viz.replay.marks import on_floor
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
    return Section.of(cube)


@pytest.fixture(scope="module")
def ball(cube):
    grid = Grid.with_cells(cube.chart, 40)
    return GridSet(grid, np.linalg.norm(grid.nodes, axis=1) - RADIUS)


def test_a_ball_becomes_a_disc(section, ball):
    extended = ExtendedSets(
        (0,), (ball,), (ball.mask,), 0.3, 0.1, np.zeros((1, 3)), np.array([0.1])
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


def test_its_critical_set_is_searched_for_in_the_plane(cube, section):
    policy = sphere_policy(cube, RADIUS)
    whole = find_critical_set(cube, policy, 8, 1 / 4)
    found = section.critical_set(whole, policy, 20, 1 / 16)
    assert found.points.shape[1] == 2
    assert len(found.points) > 30
    off = np.abs(np.linalg.norm(found.points, axis=1) - ACROSS)
    assert off.max() <= found.resolution


def test_runs_in_it_are_those_of_the_whole_task(cube, section):
    z = np.array([[0.2, 0.1], [-0.5, 0.4]])
    loop = PolicyController(sphere_policy(cube, RADIUS))
    seen = closed_loop(section.task, loop, z, settings=LoopSettings(steps=5))
    whole = closed_loop(cube, loop, section.lift(z), settings=LoopSettings(steps=5))
    np.testing.assert_array_equal(seen.path, whole.path[..., :2])
    np.testing.assert_array_equal(seen.measured, whole.measured)


def test_it_says_where_it_is(section):
    chart = section.task.chart
    assert (chart.names, chart.section) == (("a", "b"), "c = 0.3 m")
    assert section.task.set_point.tolist() == [0.0, 0.0]


def test_a_plane_is_left_as_it_is(vehicle):
    section = Section.of(vehicle)
    assert section.task is vehicle
    assert not section.cut
    something = object()
    assert section.partition(something) is something
    assert section.extended_sets(something) is something
    assert section.arc(something) is something


def test_what_lies_on_the_floor_is_below_who_flies(puck):
    points = np.array([[0.1, 0.2, 0.8], [0.3, 0.4, 0.012]])
    laid = on_floor(puck, points)
    np.testing.assert_array_equal(laid[:, :2], points[:, :2])
    assert 0 < laid[0, 2] < 0.02
    assert laid[1, 2] == 0.012
