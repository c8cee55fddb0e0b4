"""The limit: the ways that are open, what can be won at all, and that nothing planted wins more."""

from itertools import pairwise

import numpy as np
import pytest
from planted import (
    circle_controller,
    circle_policy,
    decisions,
    halves,
    ideal_controller,
    one_way_policy,
    sign_policy,
)

from hyrl_mj import make_partition
from hyrl_mj.judging.game.lattice import Lattice
from hyrl_mj.judging.game.limit import Limit, fewest_samples
from hyrl_mj.judging.game.scores import LIMIT, Game
from hyrl_mj.judging.game.solver import NEVER, solve
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.sets import Grid
from hyrl_mj.tasks import get_task

PI = np.pi
# From the axis the pillar can be passed only if x <= this.
LAST_CHANCE = 1.5 - 0.751 * np.sqrt(2)
BOUNDS = (0.0, 0.05, 0.1, 0.2)


@pytest.fixture(scope="module")
def on_vehicle(vehicle):
    controllers = {
        "left": PolicyController(one_way_policy(vehicle)),
        "sign": PolicyController(sign_policy(vehicle)),
        "slanted": PolicyController(sign_policy(vehicle, lambda x: x - 0.3)),
        "ideal": ideal_controller(vehicle, 0.15, clear=1.0),
        "narrow": ideal_controller(vehicle, 0.05, clear=1.0),
    }
    grid = Grid.with_cells(vehicle.chart, 240)
    return Game(vehicle, halves(vehicle), controllers, max(BOUNDS), grid=grid)


@pytest.fixture(scope="module")
def on_circle(circle):
    # On 754 nodes full speed leads from node to node.
    controllers = {
        "sign": PolicyController(circle_policy(circle)),
        "hysteresis": circle_controller(circle),
    }
    grid = Grid.with_cells(circle.chart, 754)
    return Game(circle, halves(circle), controllers, max(BOUNDS), grid=grid)


@pytest.fixture(scope="module", params=["vehicle", "unit_circle"])
def game(request, on_vehicle, on_circle):
    return {"vehicle": on_vehicle, "unit_circle": on_circle}[request.param]


# ---- the ways


def test_each_way_past_the_pillar_is_open_as_far_as_geometry_says(on_vehicle):
    grid = on_vehicle.lattice.grid
    x, y = grid.nodes.T
    for side, samples in zip((1, -1), on_vehicle.limit.samples, strict=True):
        room = LAST_CHANCE - x + side * y
        assert (samples < NEVER)[on_vehicle.starts & (room > grid.cell)].all()
        assert not (samples < NEVER)[on_vehicle.starts & (room < -grid.cell)].any()


def test_a_way_past_the_pillar_takes_as_long_as_the_line_is_far(on_vehicle):
    x = on_vehicle.lattice.grid.nodes[:, 0]
    for samples in on_vehicle.limit.samples:
        open_ = on_vehicle.starts & (samples < NEVER)
        np.testing.assert_array_equal(samples[open_], np.ceil((3 - x[open_]) / 0.05 - 1e-6))


def test_each_way_round_the_circle_is_open_and_takes_the_time_it_takes(on_circle):
    theta = on_circle.lattice.grid.nodes[:, 0]
    out = ~on_circle.lattice.arrived
    clockwise, counter = on_circle.limit.samples
    np.testing.assert_array_equal(clockwise[out], np.ceil((theta[out] - 0.3) / 0.05))
    np.testing.assert_array_equal(counter[out], np.ceil((2 * PI - theta[out] - 0.3) / 0.05))
    assert not on_circle.limit.samples[:, ~out].any()


def test_the_ways_lead_where_they_say(on_vehicle):
    # Following the chosen levels brings each node one sample closer to its end.
    lattice, limit = on_vehicle.lattice, on_vehicle.limit
    for samples, level in zip(limit.samples, limit.level, strict=True):
        at = np.flatnonzero((samples < NEVER) & (samples > 0))
        after = lattice.after[level[at], 0, at]
        np.testing.assert_array_equal(np.append(samples, [0, NEVER])[after], samples[at] - 1)


# ---- what can be won


def last_on_the_axis(game, eps):
    nodes = game.lattice.grid.nodes
    on_axis = game.starts & (np.abs(nodes[:, 1]) < 1e-9)
    return nodes[on_axis & game.winnable(eps), 0].max()


@pytest.mark.parametrize("eps", BOUNDS)
def test_the_last_winnable_start_on_the_axis_has_room_for_the_noise(on_vehicle, eps):
    # Noise hides at which side of the axis it is: from y = 0 that costs nothing.
    assert last_on_the_axis(on_vehicle, eps) == pytest.approx(LAST_CHANCE, abs=0.0125)


@pytest.mark.parametrize("eps", BOUNDS)
def test_a_start_is_winnable_if_each_side_that_may_be_measured_is_open(on_vehicle, eps):
    cell = on_vehicle.lattice.grid.cell
    x, y = on_vehicle.lattice.grid.nodes.T
    left, right = LAST_CHANCE - x + y, LAST_CHANCE - x - y
    room = np.minimum(
        np.where(y >= -eps - 1e-6, left, np.inf), np.where(y < eps - 1e-6, right, np.inf)
    )
    winnable = on_vehicle.winnable(eps)
    assert winnable[on_vehicle.starts & (room > cell)].all()
    assert not winnable[on_vehicle.starts & (room < -cell)].any()


def test_less_is_winnable_under_more_noise(on_vehicle):
    masks = [on_vehicle.winnable(eps) for eps in BOUNDS]
    for less, more in pairwise(masks):
        assert not (more & ~less)[on_vehicle.starts].any()
        assert more[on_vehicle.starts].sum() < less[on_vehicle.starts].sum()


@pytest.mark.parametrize("eps", BOUNDS)
def test_everything_is_winnable_on_the_circle(on_circle, eps):
    assert on_circle.winnable(eps).all()


def test_the_planted_parts_are_those_of_stage_3(vehicle, on_vehicle):
    partition = make_partition(vehicle, sign_policy(vehicle), decisions(vehicle).points, 60)
    limit = Limit.solve(on_vehicle.lattice, partition)
    for eps in (0.0, 0.1):
        bound = on_vehicle.bound(eps)
        off = limit.winnable(bound) != on_vehicle.winnable(eps)
        assert off[on_vehicle.starts].mean() < 0.02


def test_a_single_part_leaves_nothing_to_decide(vehicle):
    partition = make_partition(vehicle, one_way_policy(vehicle), np.empty((0, 2)), 60)
    limit = Limit.solve(Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 120)), partition)
    x, y = limit.lattice.grid.nodes.T
    free = (x <= 0.4) & (np.abs(y) <= 1)
    assert limit.winnable(np.array([0.0, 0.2]))[free].all()
    assert (solve(limit.moves(np.array([0.0, 0.2])))[0, :-2][free] < NEVER).all()


# ---- its score


@pytest.mark.parametrize("eps", BOUNDS)
def test_the_limit_wins_all_that_is_winnable_with_its_own_start_mode(game, eps):
    score = game.score(LIMIT, eps)
    assert score.won == 1.0


def test_without_noise_the_limit_wins_from_every_start_mode(game):
    assert game.score(LIMIT, 0.0).won_any == 1.0


@pytest.mark.parametrize("eps", [0.05, 0.1, 0.2])
def test_with_room_for_the_noise_the_limit_holds_the_way_that_it_has_picked(on_circle, eps):
    moves, places = on_circle.moves(LIMIT, eps), on_circle.lattice.places
    going = np.append(~on_circle.lattice.arrived, [False, False])
    origin = np.repeat(moves.state, moves.counts)
    came = np.zeros(moves.rows * places, dtype=bool)
    came[-places:] = going  # not started yet
    for _ in range(80):
        came[moves.target[came[origin] & going[origin % places]]] = True
    jumps = (origin // places != moves.target // places) & (origin < (moves.rows - 1) * places)
    assert jumps.any()
    assert not (jumps & came[origin] & going[origin % places]).any()


@pytest.mark.parametrize("eps", [0.05, 0.1])
def test_no_planted_controller_beats_the_limit(game, eps):
    limit = game.score(LIMIT, eps)
    for name in game.answers:
        score, value = game.score(name, eps), game.value(name, eps)[:, :-2]
        assert score.won_any <= limit.won_any
        assert (value[-1] < NEVER)[game.starts].mean() <= limit.winnable + 1e-12
        # Noise may bring a run early, but not the latest of all.
        assert score.won < 1 or score.time >= limit.time


def plain_samples(lattice, after, allowed):
    """The fewest samples to arrival, one pass over all transitions after the other."""
    samples = np.full(lattice.places, NEVER)
    samples[:-2][lattice.arrived] = 0
    samples[-2] = 0
    level = np.zeros(lattice.nodes, dtype=int)
    while True:
        by_level = np.where(allowed, samples[after], NEVER).max(axis=1)
        fewest = by_level.min(axis=0)
        fresh = lattice.running & (samples[:-2] == NEVER) & (fewest < NEVER)
        if not fresh.any():
            return samples[:-2], level
        samples[:-2][fresh] = fewest[fresh] + 1
        level[fresh] = by_level.argmin(axis=0)[fresh]


@pytest.mark.parametrize(("name", "cells"), [("vehicle", 60), ("vehicle", 47), ("unit_circle", 90)])
@pytest.mark.parametrize("share", [1.0, 0.6])
def test_the_fewest_samples_are_those_of_a_plain_twin(name, cells, share):
    task = get_task(name)
    lattice = Lattice.tabulate(task, Grid.with_cells(task.chart, cells))
    allowed = np.random.default_rng(0).random(lattice.after.shape) < share
    samples, level = fewest_samples(lattice, lattice.after, allowed)
    expected, levels = plain_samples(lattice, lattice.after, allowed)
    np.testing.assert_array_equal(samples, expected)
    np.testing.assert_array_equal(level[expected < NEVER], levels[expected < NEVER])
