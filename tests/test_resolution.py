"""How fine a lattice is, what does not fit, and the game on charts of three dimensions."""

import math
import re
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from planted import UNICYCLE, ChartPolicy, Cube, Unicycle, extended, spare, steering_policy

import hyrl_mj
from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game import (
    Game,
    Lattice,
    curve_grid,
    lattice as lattice_module,
    lattice_grid,
    resolution,
)
from hyrl_mj.judging.game.resolution import level_counts, longest, probed_hops, resolves
from hyrl_mj.judging.game.solver import NEVER, nodes_within
from hyrl_mj.judging.proof.affine import Unbounded
from hyrl_mj.judging.proof.cells import Cells
from hyrl_mj.judging.worst_case import worst_case
from hyrl_mj.learning import preset
from hyrl_mj.pipeline.runs import examination_plan
from hyrl_mj.policies import PolicyController
from hyrl_mj.runs.directory import Run
from hyrl_mj.sets import Chart, Grid, GridSet
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.stages.grounds import ByEpisodes, ByGame, mode_ground
from hyrl_mj.tasks import Effort, Learning, Outcome
from hyrl_mj.viz.section import Section


@pytest.fixture(scope="module")
def unicycle():
    return Unicycle()


@pytest.fixture(scope="module")
def rough(unicycle):
    """A lattice whose cells are as long as a sample."""
    return Lattice.tabulate(unicycle, lattice_grid(unicycle, 40))


def steps_of(lattice, level, node):
    """Where one sample of the plant leads from nodes (n,) under levels (n,): chart points."""
    plant = lattice.task.plant(len(node))
    plant.set_state(*lattice.task.state(lattice.grid.nodes[node]))
    plant.step(lattice.levels[level])
    return plant.measurement


# ---- how many cells


@pytest.mark.parametrize(("name", "counts"), [("vehicle", (481, 481)), ("unit_circle", (12_000,))])
def test_the_lattices_of_both_paper_problems_are_the_finest(name, counts):
    assert lattice_grid(hyrl_mj.get_task(name)).counts == counts


@pytest.mark.parametrize("levels", [None, 9])
def test_two_inputs_get_as_many_cells_as_fit(levels):
    plane = Cube(lambda z: z[:, 0], d=2)
    plane.learning = Learning(levels=levels)
    finest = lattice_grid(plane)
    plane.effort = Effort(transitions=2**18)
    fewer = lattice_grid(plane)
    inputs = math.prod(level_counts(plane, fewer, probed_hops(plane)))
    assert fewer.counts < finest.counts
    assert 0.8 * 2**18 < len(fewer.nodes) * inputs <= 2**18
    assert len(Lattice.tabulate(plane, fewer).levels) == inputs


def test_all_combinations_of_the_levels_of_two_inputs_can_be_chosen():
    plane = Cube(lambda z: z[:, 0], d=2)
    plane.learning = Learning(levels=3)
    assert plane.input_levels.shape == (9, 2)
    assert {*map(tuple, plane.input_levels)} == {(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)}
    lattice = Lattice.tabulate(plane, lattice_grid(plane, 40))
    np.testing.assert_array_equal(lattice.level_of(plane.input_levels), np.arange(9))
    assert lattice.exact, "a sample moves it by whole cells"


def test_inputs_between_the_levels_of_the_lattice_are_not_exact():
    plane = Cube(lambda z: z[:, 0], d=2)
    lattice = Lattice.tabulate(plane, lattice_grid(plane, 40))
    assert lattice.after.shape[1] == 1, "a sample moves it by whole cells"
    assert not lattice.exact


def test_cells_are_longer_along_a_coordinate_that_changes_faster(unicycle):
    grid, hops = lattice_grid(unicycle, 40), longest(probed_hops(unicycle))
    np.testing.assert_allclose(hops, [0.05, 0.05, 0.1], rtol=0.02)
    np.testing.assert_allclose(grid.spacing / hops, 1.0, rtol=0.05)


def test_a_lattice_that_holds_the_robot_in_its_place_is_refused(vehicle):
    coarse = Grid.with_cells(vehicle.chart, 40)
    assert not resolves(vehicle, coarse, probed_hops(vehicle))
    with pytest.raises(
        BadInput, match=r"no sample moves vehicle.*0\.075 m by 0\.075 m.*--episodes"
    ):
        Lattice.check(vehicle, coarse)
    assert not Lattice.decides(vehicle, coarse)
    assert Lattice.decides(vehicle, Grid.with_cells(vehicle.chart, 60))


def test_the_curve_takes_more_cells_where_a_sample_is_too_short_for_its_own(vehicle, monkeypatch):
    assert curve_grid(vehicle).counts == (241, 241)
    monkeypatch.setitem(resolution.CURVE_CELLS, 2, 40)
    assert curve_grid(vehicle, 120).counts == (121, 121)


@pytest.mark.slow
def test_stage_6_asks_episodes_where_two_inputs_do_not_fit(monkeypatch):
    plane = Cube(lambda z: z[:, 0], d=2)
    plane.start_low, plane.start_high = (-0.5, -0.5), (0.5, 0.5)
    grid = Grid.with_cells(plane.chart, 120)
    part = GridSet.from_mask(grid, np.ones(len(grid.nodes), dtype=bool))
    sets = extended([part])
    assert type(mode_ground(plane, sets, 0)) is ByGame
    monkeypatch.setattr(lattice_module, "MOST_TRANSITIONS", 1_000)
    assert type(mode_ground(plane, sets, 0)) is ByEpisodes


# ---- an inner loop on velocity actuators


class Course(Unicycle):
    """The input is the course: that by the least input is the same as by the greatest."""

    chart = Chart(("x", "y"), ("m", "m"), (-1.0, -1.0), (1.0, 1.0), (False, False))
    noisy = (True, True)
    learning = Learning()

    def __init__(self):
        joint = '      <joint name="heading" type="hinge" axis="0 0 1"/>\n'
        xml = UNICYCLE.replace(joint, "").replace('<velocity joint="heading" kv="1e6"/>', "")
        xml = xml.replace('<jointpos joint="heading"/>', "").replace('"-2 2"', '"-3.14159 3.14159"')
        self.model = mujoco.MjModel.from_xml_string(xml)

    def control(self, u, qpos, qvel):
        return np.column_stack([np.cos(u), np.sin(u)])

    def ending(self, measurement):
        away = np.abs(measurement).max(axis=1)
        return np.where(away >= 0.9, Outcome.REACHED, Outcome.RUNNING)


class Sluggish(Course):
    """The inner loop limits the acceleration, so that speeds matter."""

    def control(self, u, qpos, qvel):
        wanted = np.column_stack([np.cos(u), np.sin(u)])
        return qvel + np.clip(wanted - qvel, -0.1, 0.1)


class Docked(Course):
    """The inner loop stops the robot in one place."""

    def control(self, u, qpos, qvel):
        docked = np.linalg.norm(qpos - (0.31, 0.17), axis=1, keepdims=True) < 0.06
        return np.where(docked, 0.0, super().control(u, qpos, qvel))


@pytest.mark.slow
def test_inputs_that_an_inner_loop_bends_are_tabulated_in_between():
    course = Course()
    lattice = Lattice.tabulate(course, lattice_grid(course, 60))
    assert len(lattice.levels) > 6
    assert np.ptp(lattice.hops, axis=0).min() > 0.09, "it goes every way"


@pytest.mark.slow
def test_an_inner_loop_that_depends_on_the_place_is_tabulated_everywhere():
    docked = Docked()
    lattice = Lattice.tabulate(docked, lattice_grid(docked, 80))
    held = np.linalg.norm(lattice.grid.nodes - (0.31, 0.17), axis=1) < 0.05
    assert held.any()
    stays = (lattice.after[:, 0] == np.arange(lattice.nodes)).all(axis=0)
    assert stays[held].all()


@pytest.mark.slow
def test_nothing_is_proved_of_a_robot_with_an_inner_loop():
    course = Course()
    with pytest.raises(Unbounded, match="an inner loop"):
        Cells.cover(Lattice.tabulate(course, lattice_grid(course, 60)))


def test_an_inner_loop_with_a_memory_makes_no_kinematic_robot():
    assert Course().kinematic
    assert not Sluggish().kinematic
    assert Lattice.why_not(Sluggish())


def test_a_robot_whose_inner_loop_gives_speeds_runs_backward(unicycle):
    assert unicycle.kinematic
    rng = np.random.default_rng(0)
    z = rng.uniform(unicycle.chart.low, unicycle.chart.high, (50, 3))
    u, plant = rng.uniform(-2, 2, (50, 1)), unicycle.plant(50)
    plant.set_state(z)
    plant.step(u)
    assert np.abs(plant.measurement - z).max() > 0.04
    plant.step_backward(u)
    # Five steps of 10 ms hold the heading at which they begin: backward it is that at their end.
    np.testing.assert_allclose(plant.measurement, z, atol=2e-3)


# ---- three dimensions


@pytest.mark.slow
def test_samples_are_rounded_to_nodes_around_their_ends_and_right_on_average(rough):
    assert rough.estimate
    assert not rough.exact
    assert rough.after.shape[1] == 1
    rng = np.random.default_rng(0)
    nodes = rng.choice(np.flatnonzero(rough.running), 20_000)
    level = rng.integers(len(rough.levels), size=len(nodes))
    after = rough.after[level, 0, nodes]
    on = after < rough.nodes
    off = rough.grid.nodes[after[on]] - steps_of(rough, level[on], nodes[on])
    assert (np.abs(off) <= rough.grid.spacing * (1 + 1e-6)).all()
    assert (np.abs(off.mean(axis=0)) < 0.02 * rough.grid.spacing).all()
    assert (np.abs(off).mean(axis=0) > 0.1 * rough.grid.spacing)[:2].all()


@pytest.mark.slow
def test_noise_is_rounded_to_whole_cells_and_never_to_none(rough):
    _, y, heading = rough.grid.spacing
    assert nodes_within(rough, np.array([0.0, 2.6 * y, 0.3 * heading])).tolist() == [0, 3, 1]


@pytest.mark.long
@pytest.mark.slow
def test_the_estimate_agrees_with_runs_of_the_plant(unicycle):
    loop = PolicyController(steering_policy(unicycle, gain=0.4))
    grid = lattice_grid(unicycle, 80)
    everything = [GridSet.from_mask(grid, np.ones(len(grid.nodes), dtype=bool))]
    game = Game(unicycle, everything, {"policy": loop}, 0.1, grid=grid)
    starts = np.flatnonzero(game.starts)[::7]
    won = game.value("policy", 0.0)[-1, starts] < NEVER
    quiet = LoopSettings(quiet=True)
    run = closed_loop(unicycle, loop, grid.nodes[starts], settings=quiet)
    arrived = run.outcome == Outcome.REACHED
    assert 0.1 < arrived.mean() < 0.9, "some starts are won and some are lost"
    assert (won == arrived).mean() > 0.9
    assert abs(won.mean() - arrived.mean()) < 0.03
    noise = game.worst_noise("policy", 0.1)
    worst = closed_loop(unicycle, loop, grid.nodes[starts], noise, settings=quiet)
    lost = arrived.mean() - (worst.outcome == Outcome.REACHED).mean()
    assert lost > 0.5 * (won.mean() - (game.value("policy", 0.1)[-1, starts] < NEVER).mean()) > 0.05


@pytest.mark.slow
def test_in_three_dimensions_nothing_is_proved_and_only_what_was_tried_is_not_broken(monkeypatch):
    spare(monkeypatch, nodes=60)
    cube = Cube(lambda z: z[:, 0])
    cube.start_low, cube.start_high = (-0.5,) * 3, (0.5,) * 3
    cube.ending = lambda m: np.where(m[:, 0] >= 0.9, Outcome.REACHED, Outcome.RUNNING)
    cube.verdict = lambda m: np.full(len(m), Outcome.STALLED)
    still = PolicyController(ChartPolicy(cube, lambda z: np.zeros_like(z)))
    goes = PolicyController(ChartPolicy(cube, lambda z: np.ones_like(z) * (1.0, 0.0, 0.0)))
    cube.max_steps = 40
    grid = lattice_grid(cube, 40)
    parts = [GridSet.from_mask(grid, np.ones(len(grid.nodes), dtype=bool))]
    loops = {"policy": still, "hyrl": goes}
    result, _ = worst_case(cube, np.empty((0, 3)), parts, loops, (0.0, 0.1), cells=40)
    assert result.estimate
    assert [score.not_broken for score in result.scores["policy"]] == [0.0, 0.0]
    assert [score.not_broken for score in result.scores["hyrl"]] == [1.0, 1.0]
    assert all(score.proved is None for score in result.scores["hyrl"])
    assert "three dimensions" in result.why_not_proved["hyrl"]
    assert result.curve.eps == (0.0, 0.1)
    assert result.margin == {"policy": None, "hyrl": None}


def test_how_a_run_will_be_examined_is_said_first(unicycle):
    plans = {name: examination_plan(planned(name)) for name in ("vehicle", "rover")}
    assert plans["vehicle"] == "by the worst-case game on 481 x 481 nodes"
    assert re.fullmatch(r"by noisy episodes and an attack, because .* rover .*", plans["rover"])
    rough = SimpleNamespace(
        why_no_game=None,
        exact=False,
        why_estimate=Lattice.why_estimate(unicycle),
        task=unicycle,
        lattice_grid=lattice_grid(unicycle),
        settings=SimpleNamespace(lattice=160),
    )
    plan = examination_plan(rough)
    assert "fewer than 160 on a side" in plan
    assert plan.endswith("the game is an estimate on a chart of three dimensions")


def planned(name):
    """A run that has not begun."""
    return Run(Path("nowhere"), preset(hyrl_mj.get_task(name)))


@pytest.mark.slow
def test_a_map_is_cut_to_the_section_that_is_drawn(unicycle, rough):
    section = Section(unicycle)
    heading = np.round(rough.grid.nodes[:, 2] / rough.grid.spacing[2]).astype(np.int8)
    maps = hyrl_mj.judging.game.Maps(0.1, np.array(rough.grid.counts), {"policy": heading})
    cut = section.maps(maps)
    assert tuple(cut.grid_counts) == rough.grid.counts[:2]
    assert len(cut.map["policy"]) == math.prod(rough.grid.counts[:2])
    assert np.abs(cut.map["policy"]).max() <= 1, "the section lies at heading 0"


def test_rounding_holds_a_robot_along_a_slow_coordinate_too(vehicle):
    """It crosses a cell along x, and along y only in many samples; where an episode is short, it does not."""
    grid = Grid.with_cells(vehicle.chart, 120)
    fast = probed_hops(vehicle)
    for slower, holds in ((1.0, True), (0.1, False), (1e-5, True)):
        assert resolves(vehicle, grid, fast * (1.0, slower)) == holds
