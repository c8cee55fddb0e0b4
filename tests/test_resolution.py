"""How fine a lattice is, what does not fit, and the game on charts of three dimensions."""

import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from planted import Cube, Unicycle, steering_policy

import hyrl_mj
from hyrl_mj.errors import BadInput
from hyrl_mj.game import Game, Lattice, lattice_grid, resolution
from hyrl_mj.game.resolution import corner_hops, level_counts, longest, resolves
from hyrl_mj.game.solver import NEVER, nodes_within
from hyrl_mj.learning import preset
from hyrl_mj.pipeline.examination import examination_plan
from hyrl_mj.policies import PolicyController
from hyrl_mj.run_directory import Run
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.tasks import Learning, Outcome
from hyrl_mj.viz.section import Section


@pytest.fixture(scope="module")
def unicycle():
    return Unicycle()


@pytest.fixture(scope="module")
def rough(unicycle):
    """A lattice whose cells are as long as a sample."""
    return Lattice.of(unicycle, lattice_grid(unicycle, 40))


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
def test_two_inputs_get_as_many_cells_as_fit(monkeypatch, levels):
    plane = Cube(lambda z: z[:, 0], d=2)
    plane.learning = Learning(levels=levels)
    finest = lattice_grid(plane)
    monkeypatch.setattr(resolution, "MOST_TRANSITIONS", 2**20)
    fewer = lattice_grid(plane)
    inputs = math.prod(level_counts(plane, fewer, corner_hops(plane)))
    assert fewer.counts < finest.counts
    assert 0.8 * 2**20 < len(fewer.nodes) * inputs <= 2**20
    assert len(Lattice.of(plane, fewer).levels) == inputs


def test_all_combinations_of_the_levels_of_two_inputs_can_be_chosen():
    plane = Cube(lambda z: z[:, 0], d=2)
    plane.learning = Learning(levels=3)
    assert plane.input_levels.shape == (9, 2)
    assert {*map(tuple, plane.input_levels)} == {(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)}
    lattice = Lattice.of(plane, lattice_grid(plane, 40))
    np.testing.assert_array_equal(lattice.level_of(plane.input_levels), np.arange(9))
    assert lattice.exact, "a sample moves it by whole cells"


def test_inputs_between_the_levels_of_the_lattice_are_not_exact():
    plane = Cube(lambda z: z[:, 0], d=2)
    lattice = Lattice.of(plane, lattice_grid(plane, 40))
    assert lattice.after.shape[1] == 1, "a sample moves it by whole cells"
    assert not lattice.exact


def test_cells_are_longer_along_a_coordinate_that_changes_faster(unicycle):
    grid, hops = lattice_grid(unicycle, 40), longest(corner_hops(unicycle))
    np.testing.assert_allclose(hops, [0.05, 0.05, 0.1], rtol=0.02)
    np.testing.assert_allclose(grid.spacing / hops, 1.0, rtol=0.05)


def test_a_lattice_that_holds_the_robot_in_its_place_is_refused(vehicle):
    coarse = Grid.with_cells(vehicle.chart, 40)
    assert not resolves(vehicle, coarse)
    with pytest.raises(BadInput, match=r"hold vehicle in its place.*0\.075 by 0\.075.*--episodes"):
        Lattice.check(vehicle, coarse)
    assert not Lattice.decides(vehicle, coarse)
    assert Lattice.decides(vehicle, Grid.with_cells(vehicle.chart, 60))


# ---- an inner loop on velocity actuators


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


def test_noise_is_rounded_to_whole_cells_and_never_to_none(rough):
    _, y, heading = rough.grid.spacing
    assert nodes_within(rough, np.array([0.0, 2.6 * y, 0.3 * heading])).tolist() == [0, 3, 1]


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


def test_how_a_run_will_be_examined_is_said_first(unicycle):
    plans = {name: examination_plan(planned(name)) for name in ("vehicle", "rover")}
    assert plans["vehicle"] == "by the worst-case game on 481 x 481 nodes"
    assert re.fullmatch(r"by noisy episodes and an attack, because .* rover .*", plans["rover"])
    rough = SimpleNamespace(
        why_no_game=None,
        exact=False,
        lattice_grid=lattice_grid(unicycle),
        settings=SimpleNamespace(lattice=160),
    )
    plan = examination_plan(rough)
    assert "fewer than 160 on a side" in plan
    assert "an estimate" in plan


def planned(name):
    """A run that has not begun."""
    return Run(Path("nowhere"), preset(hyrl_mj.get_task(name)))


def test_a_map_is_cut_to_the_section_that_is_drawn(unicycle, rough):
    section = Section(unicycle)
    heading = np.round(rough.grid.nodes[:, 2] / rough.grid.spacing[2]).astype(np.int8)
    maps = hyrl_mj.game.Maps(0.1, np.array(rough.grid.counts), {"policy": heading})
    cut = section.maps(maps)
    assert tuple(cut.grid_counts) == rough.grid.counts[:2]
    assert len(cut.map["policy"]) == math.prod(rough.grid.counts[:2])
    assert np.abs(cut.map["policy"]).max() <= 1, "the section lies at heading 0"
