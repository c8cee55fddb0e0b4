"""The plane that is drawn of a chart of three dimensions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from environments import Puck
from planted import ChartPolicy, Cube, sphere_policy

import hyrl_mj
from hyrl_mj import LoopSettings, Task, closed_loop, find_critical_set
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.partition import Partition
from hyrl_mj.viz import section as section_module
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
    settings = SimpleNamespace(rods=20, resolution=1 / 16, noise=0.1)
    run = SimpleNamespace(critical_set=whole, steady=policy, settings=settings)
    monkeypatch.setattr(section_module, "CELLS", 20)
    found = section.critical_set(run)
    assert found.points.shape[1] == 2
    assert len(found.points) > 30
    off = np.abs(np.linalg.norm(found.points, axis=1) - ACROSS)
    assert off.max() <= found.resolution


def test_runs_in_it_are_those_of_the_whole_task(cube, section):
    z = np.array([[0.2, 0.1], [-0.5, 0.4]])
    loop = PolicyController(sphere_policy(cube, RADIUS))
    seen = closed_loop(section, loop, z, settings=LoopSettings(steps=5))
    whole = closed_loop(cube, loop, section.lift(z), settings=LoopSettings(steps=5))
    np.testing.assert_array_equal(seen.path, whole.path[..., :2])
    np.testing.assert_array_equal(seen.measured, whole.measured)


def test_it_says_where_it_is(section):
    chart = section.chart
    assert (chart.names, chart.section) == (("a", "b"), "c = 0.3 m")
    assert section.set_point.tolist() == [0.0, 0.0]


# Of `Task`, what has to be cut to the plane.
CUT = {
    "arrived", "at", "check_noise", "direction", "for_mode", "goes_on", "may_start", "miss",
    "noise_in_chart", "noisy_everywhere", "set_point", "starts", "state", "with_noise", "with_z", "z",
}  # fmt: skip


class Other:
    """A task all of whose parts are told by their names."""

    def __getattr__(self, name):
        return f"the whole task's {name}"


def test_all_that_has_no_chart_in_it_is_that_of_the_whole_task(section):
    other = object.__new__(Section)
    vars(other).update(whole=Other())
    public = {name for name in vars(Task) if not name.startswith("_")}
    assert public >= CUT
    for name in public - CUT:
        assert getattr(other, name) == f"the whole task's {name}"


def test_it_has_the_time_of_an_environment_of_several_steps_a_sample():
    task = hyrl_mj.from_gymnasium(Puck, steps=30)  # five steps of the physics a sample
    section = Section(task)
    assert section.dt == task.dt == pytest.approx(0.1)
    z, ahead = task.scene.starts[0], ChartPolicy(task, lambda z: np.ones((len(z), 2)))
    arc, whole = (hyrl_mj.simulate(one, ahead, z, horizon=0.5) for one in (section, task))
    np.testing.assert_array_equal(arc.t, whole.t)
    np.testing.assert_array_equal(arc.z, whole.z)
    assert (len(arc.t), arc.t[-1]) == (6, pytest.approx(0.5))


def test_noise_and_modes_of_a_section_are_those_of_the_whole(vehicle):
    section = Section(vehicle)
    everywhere = section.noisy_everywhere()
    assert isinstance(everywhere, Section)
    assert everywhere.noise_on() == vehicle.noisy_everywhere().noise_on() != section.noise_on()
    assert everywhere.noisy == (True, True)
    assert isinstance(section.for_mode(0), Section)


def test_its_task_is_the_whole_one_but_for_the_chart():
    rover = hyrl_mj.get_task("rover")
    before = dict(vars(rover))
    task, rng = Section(rover), np.random.default_rng(0)
    assert {name for name in vars(rover) if name not in before} <= {
        "arena",
        "chart",
        "set_point",
        "model",
    }
    assert (task.name, task.speed) == ("rover", rover.speed)
    with pytest.raises(AttributeError, match="wheel_count"):
        task.wheel_count  # noqa: B018
    z = rover.starts(20, rng)
    plant = task.plant(20)
    plant.set_state(*rover.state(z))
    u = rng.uniform(*task.input_limits, (20, 1))
    plant.step(u)
    measured = plant.measurement
    for ours, theirs in (
        (task.reward(measured, u), rover.reward(measured, u)),
        (task.observation(measured), rover.observation(measured)),
        (task.ending(measured), rover.ending(measured)),
        (task.verdict(measured), rover.verdict(measured)),
        (task.danger(measured), rover.danger(measured)),
        (task.failed(measured), rover.failed(measured)),
        (task.z(measured), rover.z(measured)[:, :2]),
        (task.input_levels, rover.input_levels),
        (
            task.starts(9, np.random.default_rng(1)),
            rover.starts(9, np.random.default_rng(1))[:, :2],
        ),
    ):
        np.testing.assert_array_equal(ours, theirs)
    flat = z * [1, 1, 0]
    for ours, theirs in (
        (task.arrived(z[:, :2]), rover.arrived(flat)),
        (task.miss(z[:, :2]), rover.miss(flat)),
        (task.state(z[:, :2])[0], rover.state(flat)[0]),
        (
            task.direction(np.stack([z, z + 1])[..., :2]),
            rover.direction(np.stack([flat, flat + 1])),
        ),
    ):
        np.testing.assert_array_equal(ours, theirs)
    assert task.learning == rover.learning
    assert task.scene.starts == tuple(start[:2] for start in rover.scene.starts)
    assert (task.scene.mode_names, task.scene.time) == (("left", "right"), 5.0)


def test_a_plane_is_left_as_it_is(vehicle):
    section = Section(vehicle)
    assert section.chart == vehicle.chart
    assert section.scene == vehicle.scene
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
