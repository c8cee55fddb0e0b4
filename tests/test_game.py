"""The worst-case game and its limit: slow plain twins, planted controllers with known values, and MuJoCo."""

from functools import cache
from itertools import count, pairwise, product

import numpy as np
import pytest
from planted import (
    EXACT,
    circle_controller,
    circle_policy,
    halves,
    homing_controller,
    homing_policy,
    ideal_controller,
    one_way_policy,
    sign_policy,
)

from hyrl_mj import HybridController, Noise, make_partition, simulate
from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game.lattice import ON_NODE, Lattice
from hyrl_mj.judging.game.limit import Limit, fewest_samples
from hyrl_mj.judging.game.scores import LIMIT, Game, worst_signal
from hyrl_mj.judging.game.solver import LOST, NEVER, Answers, lasting, noisy_moves, solve
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.sets import Grid
from hyrl_mj.tasks import Outcome, get_task

PI = np.pi
# From the axis the pillar can be passed only if x <= this.
LAST_CHANCE = 1.5 - 0.751 * np.sqrt(2)
BOUNDS = (0.0, 0.05, 0.1, 0.2)


# ---- a slow plain twin


def around(grid, z):
    """The numbers of the nodes around a point (d,)."""
    index = (grid.chart.wrap(z[None])[0] - grid.chart.low) / grid.spacing
    near = []
    for i, n, periodic in zip(index, grid.counts, grid.chart.periodic, strict=True):
        on_node = abs(i - round(i)) <= ON_NODE
        either = {round(i)} if on_node else {int(np.floor(i)), int(np.ceil(i))}
        near.append({k % n if periodic else min(max(k, 0), n - 1) for k in either})
    return {int(np.ravel_multi_index(at, grid.counts)) for at in product(*near)}


def twin_moves(lattice, controller, bound):
    """Where noise can lead (row, node): one state, one noise and one sample of the plant at a time."""
    task, grid, modes = lattice.task, lattice.grid, controller.modes
    plant, periodic = task.plant(1), np.array(grid.chart.periodic)
    window = [int(b / s + 1e-6) for b, s in zip(bound, grid.spacing, strict=True)]

    @cache
    def ends(node, level):
        plant.set_state(task.state(grid.nodes[[node]])[0])
        plant.step(lattice.levels[[level]])
        ending, z = task.ending(plant.measurement)[0], task.z(plant.measurement)
        if ending == Outcome.REACHED:
            return {lattice.nodes}
        lives = ending == Outcome.RUNNING and task.chart.contains(z)[0]
        return around(grid, z[0]) if lives else {lattice.nodes + 1}

    @cache
    def answer(q, index):
        measured = (grid.chart.low + grid.spacing * index)[None]
        mode = controller.initial_mode(measured) if q is None else np.array([q])
        u, after = controller.step(mode, measured)
        return int(np.abs(lattice.levels - u).sum(axis=1).argmin()), modes.index(after[0])

    moves = {}
    for (row, q), node in product(enumerate((*modes, None)), range(lattice.nodes)):
        if task.ending(grid.nodes[[node]])[0] != Outcome.RUNNING:
            continue
        at, found = np.unravel_index(node, grid.counts), set()
        for shift in product(*[range(-w, w + 1) for w in window]):
            index = np.where(periodic, np.add(at, shift) % grid.counts, np.add(at, shift))
            level, mode = answer(q, tuple(int(k) for k in index))
            found |= {(mode, place) for place in ends(node, level)}
        moves[row, node] = found
    return moves


def twin_values(lattice, moves, rows, most=None):
    """The game's value, layer by layer: what fails, or must have arrived, in k samples, at most `most`."""
    value = np.full((rows, lattice.places), NEVER)
    value[:, [*np.flatnonzero(lattice.failed), lattice.nodes + 1]] = LOST
    value[:, [*np.flatnonzero(lattice.arrived), lattice.nodes]] = 0
    for k in count(1) if most is None else range(1, most + 1):
        lost = {s: LOST - k for s in moves if any(value[t] > NEVER for t in moves[s])}
        won = {s: k for s in moves if all(value[t] < NEVER for t in moves[s])}
        new = {s: v for s, v in (lost | won).items() if value[s] == NEVER}
        if not new:
            return value
        for state, found in new.items():
            value[state] = found
    return value


def renamed(controller):
    """The same hybrid controller with other numbers for its modes."""
    number = {0: 2, 1: 5}
    return HybridController(
        controller.task,
        {number[q]: policy for q, policy in controller.policies.items()},
        {number[q]: flow for q, flow in controller.flow_sets.items()},
    )


# Cells 0.05 m wide: at half speed the vehicle ends between two nodes. Cells 0.1 m wide: always.
TWINS = [
    ("vehicle", (31, 21), sign_policy, (0.1, 0.15)),
    ("vehicle", (31, 31), lambda task: renamed(ideal_controller(task, 0.07)), (0.0, 0.1)),
    ("unit_circle", (150,), circle_policy, (0.2,)),
    ("unit_circle", (150,), lambda task: renamed(circle_controller(task, 0.3)), (0.1,)),
    ("unit_circle", (150,), lambda task: homing_controller(task, 0.1), (0.2,)),
]


@pytest.mark.parametrize(("name", "counts", "controller", "bound"), TWINS)
@pytest.mark.slow
def test_the_game_is_its_slow_twin(vehicle, circle, name, counts, controller, bound):
    task, bound = {"vehicle": vehicle, "unit_circle": circle}[name], np.array(bound)
    lattice, loop = Lattice.tabulate(task, Grid(task.chart, counts)), controller(task)
    loop = loop if isinstance(loop, HybridController) else PolicyController(loop)
    plain = twin_moves(lattice, loop, bound)
    moves = noisy_moves(Answers.ask(lattice, loop, bound), bound)
    assert moves.rows == len(loop.modes) + 1
    value = solve(moves)
    np.testing.assert_array_equal(value, twin_values(lattice, plain, moves.rows))
    for most in (0, 1, 25):  # an episode's time
        short = solve(moves, most)
        np.testing.assert_array_equal(short, twin_values(lattice, plain, moves.rows, most))
        within = (value <= most) | (value >= LOST - most)
        np.testing.assert_array_equal(short, np.where(within, value, NEVER))
    assert len(np.unique(value)) > 10
    targets = np.split(moves.target, moves.counts.cumsum()[:-1])
    for state, target in zip(moves.state[::7], targets[::7], strict=True):
        found = {divmod(int(t), lattice.places) for t in target}
        assert found == plain[divmod(int(state), lattice.places)]


def test_answers_for_more_noise_serve_for_less(vehicle):
    lattice = Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 60))
    loop, bound = ideal_controller(vehicle, 0.07), np.array([0.0, 0.1])
    tight, wide = (Answers.ask(lattice, loop, most) for most in (bound, np.array([0.2, 0.4])))
    np.testing.assert_array_equal(solve(noisy_moves(tight, bound)), solve(noisy_moves(wide, bound)))


def test_a_controller_that_goes_to_a_mode_it_does_not_have_is_refused(vehicle):
    class Lost(PolicyController):
        def step(self, q, measured):
            return self.policy.act(measured), q + 3

    lattice = Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 60))
    with pytest.raises(BadInput, match=r"went to mode 3, it has \(0,\)"):
        Answers.ask(lattice, Lost(sign_policy(vehicle)), np.zeros(2))


# ---- vehicle: planted controllers


def own(game, name, eps):
    """The value (N,) of nodes where the controller picks its start mode."""
    return game.value(name, eps)[-1, :-2]


def test_one_way_wins_the_starts_whose_way_is_open(game_on_vehicle):
    game = game_on_vehicle
    for name, samples in zip(("left", "right"), game.limit.samples, strict=True):
        for eps in (0.0, 0.1):
            won = own(game, name, eps) < NEVER
            np.testing.assert_array_equal(won[game.starts], (samples < NEVER)[game.starts])


def test_the_sign_rule_loses_where_noise_hides_the_sign_and_nowhere_else(game_on_vehicle):
    # It can be held in -eps <= y < eps until no way is open, from wherever it comes.
    game = game_on_vehicle
    y = game.lattice.grid.nodes[:, 1]
    for eps in (0.05, 0.1):
        region = game.starts & game.winnable(eps)
        hidden = (y > -eps - 1e-6) & (y < eps - 1e-6)
        lost = own(game, "sign", eps) >= NEVER
        np.testing.assert_array_equal(lost[region], hidden[region])
        assert lost[game.starts & hidden].all()
        score = game.score("sign", eps)
        assert score.winnable == region.sum() / game.starts.sum()
        assert 0 < score.won == score.won_any == 1 - hidden[region].mean() < 1


def test_where_nothing_can_be_won_nothing_is_won(game_on_vehicle, monkeypatch):
    game = game_on_vehicle
    winnable = game.winnable
    monkeypatch.setattr(game, "winnable", lambda eps: winnable(eps) & (eps < 0.06))
    assert game.score("ideal", 0.05).won == 1
    assert game.score("ideal", 0.1).won == 0
    assert game.margin("ideal") < 0.06


@pytest.mark.slow
def test_every_start_is_won_or_lost_and_no_more_are_won_under_more_noise(game_on_vehicle):
    game = game_on_vehicle
    for name in game.controllers:
        # x = 3 m comes some day, and with it the end.
        assert not (game.value(name, 0.1) == NEVER)[:, np.append(game.starts, [True] * 2)].any()
        assert not lasting(game.moves(name, 0.1)).any()
        values = [game.value(name, eps) for eps in (0.0, 0.05, 0.1, 0.2)]
        for less, more in pairwise(values):
            assert (less <= more).all()


# ---- vehicle: the same in MuJoCo


def some(nodes, mask, n=80):
    """At most n of the nodes of a mask, at random: their numbers, and the points."""
    at = np.random.default_rng(0).permutation(np.flatnonzero(mask))[:n]
    assert len(at) > 20
    return at, nodes[at]


@pytest.mark.parametrize(
    ("name", "q0", "eps"), [("sign off", None, 0.1), ("ideal", 1, 0.05), ("narrow", None, 0.1)]
)
def test_the_worst_signal_crashes_lost_starts_in_the_sample_foreseen(
    vehicle, game_on_vehicle, name, q0, eps
):
    game = game_on_vehicle
    value = game.value(name, eps)[-1 if q0 is None else q0, :-2]
    at, z0 = some(game.lattice.grid.nodes, game.starts & (value > NEVER))
    signal = worst_signal(game, name, z0, eps, q0)
    assert np.abs(signal.values).max(initial=0.0) <= eps + 1e-12
    assert not signal.values[..., 0].any(), "x is measured without noise"
    arcs = simulate(vehicle, game.controllers[name], z0, noise=signal, q0=q0)
    assert {arc.outcome for arc in arcs} == {"crashed"}
    samples = [round(arc.t[-1] / vehicle.dt) for arc in arcs]
    np.testing.assert_array_equal(samples, LOST - value[at])


def arrivals(task, arcs):
    """The samples after which arcs have first arrived."""
    first = [np.argmax(task.verdict(arc.z) == Outcome.REACHED) for arc in arcs]
    return np.array([round(arc.t[k] / task.dt) for arc, k in zip(arcs, first, strict=True)])


@pytest.mark.parametrize("kind", ["worst", "adversarial"])
@pytest.mark.parametrize("name", ["sign off", "ideal"])
def test_no_noise_makes_a_won_start_of_the_vehicle_fail(vehicle, game_on_vehicle, name, kind):
    game = game_on_vehicle
    eps = 0.1
    value = own(game, name, eps)
    at, z0 = some(game.lattice.grid.nodes, game.starts & (value < NEVER), 60)
    noise = game.worst_noise(name, eps) if kind == "worst" else Noise(kind, eps)
    arcs = simulate(vehicle, game.controllers[name], z0, noise=noise)
    assert {arc.outcome for arc in arcs} == {"reached"}
    np.testing.assert_array_equal(arrivals(vehicle, arcs), value[at])


# ---- unit circle: planted controllers


def test_values_converge_as_the_lattice_gets_finer(circle):
    band, late = [], []
    for cells in (720, 1500, 3000):
        rules = {"sign": circle_policy(circle), "hysteresis": circle_controller(circle)}
        grid = Grid.with_cells(circle.chart, cells)
        game = Game(circle, halves(circle), rules, 0.3, grid=grid)
        trapped = (own(game, "sign", 0.1) == NEVER).mean() * 2 * PI
        band.append(abs(trapped - 0.2))
        assert band[-1] <= 2 * game.lattice.grid.cell, "one at either edge"
        worst = game.value("hysteresis", 0.1)[:-1, :-2].max()
        late.append(worst - (PI + 0.4 + 0.1 - 0.3) / 0.05)
    assert band[0] > band[1] > band[2]
    assert late[0] > late[1] > late[2] > 0, "it errs to the adversary's side"
    assert late[2] < 0.4 * late[0]


# ---- unit circle: for ever


def homing_moves(circle, eps=0.1, dead=0.0):
    """The moves of the homing policy under noise, how far off its nodes are (n,), and a cell [rad]."""
    lattice = Lattice.tabulate(circle, Grid.with_cells(circle.chart, EXACT))
    loop, bound = PolicyController(homing_policy(circle, dead)), np.array([eps])
    moves = noisy_moves(Answers.ask(lattice, loop, bound), bound)
    return moves, circle.miss(lattice.grid.nodes), lattice.grid.cell


@pytest.mark.parametrize(("eps", "dead", "less"), [(0.0, 0, 1), (0.1, 0, 1), (0.1, 0.3, 2)])
def test_a_policy_is_held_at_the_edge_of_its_dead_zone_and_the_noise(circle, eps, dead, less):
    moves, miss, cell = homing_moves(circle, eps, dead)
    reach = miss[lasting(moves, miss < 1)].max()
    assert dead + eps - less * cell <= reach <= dead + eps + 2 * cell


def test_runs_are_not_held_where_they_never_come(circle):
    # At the far side noise can hold a memoryless policy; runs from near the set-point never get there.
    moves, miss, cell = homing_moves(circle)
    assert miss[lasting(moves)].max() == pytest.approx(PI, abs=cell)
    assert miss[lasting(moves, miss > 3)].max() == pytest.approx(PI, abs=cell)
    assert miss[lasting(moves, miss < 3)].max() < 0.2


def test_runs_are_held_where_they_come_in_the_end(circle):
    moves, miss, _ = homing_moves(circle)
    from_afar = lasting(moves, (miss > 1) & (miss < 3))
    np.testing.assert_array_equal(from_afar, lasting(moves, miss < 1))
    assert from_afar.any()


def test_a_run_that_swings_for_ever_is_held_at_both_ends(circle):
    lattice = Lattice.tabulate(circle, Grid.with_cells(circle.chart, EXACT))
    loop, bound = PolicyController(circle_policy(circle)), np.zeros(1)
    moves = noisy_moves(Answers.ask(lattice, loop, bound), bound)
    start = np.arange(EXACT) == 3  # 0.025 rad: one sample from there to the other side, and back
    assert np.flatnonzero(lasting(moves, start)).tolist() == [3, EXACT - 3]


# ---- unit circle: the same in MuJoCo


def test_the_worst_signal_keeps_trapped_starts_from_arriving(circle, game_on_circle):
    game = game_on_circle
    eps = 12 * game.lattice.grid.cell
    at = np.flatnonzero(own(game, "sign", eps) == NEVER)
    z0 = game.lattice.grid.nodes[at]
    signal = worst_signal(game, "sign", z0, eps)
    assert len(signal.values) == circle.max_steps
    assert np.abs(signal.values).max() <= eps + 1e-9
    arcs = simulate(circle, game.controllers["sign"], z0, noise=signal)
    assert {arc.outcome for arc in arcs} == {"stalled"}
    assert max(np.abs(arc.z - PI).max() for arc in arcs) < 0.2


@pytest.mark.parametrize(
    ("name", "kind"), [("sign", "worst"), ("hysteresis", "worst"), ("hysteresis", "adversarial")]
)
def test_no_noise_makes_a_won_start_of_the_circle_late(circle, game_on_circle, name, kind):
    game = game_on_circle
    eps = 12 * game.lattice.grid.cell
    value = own(game, name, eps)
    at, z0 = some(game.lattice.grid.nodes, value < NEVER, 60)
    noise = game.worst_noise(name, eps) if kind == "worst" else Noise(kind, eps)
    arcs = simulate(circle, game.controllers[name], z0, noise=noise)
    assert all(circle.arrived(arc.z).any() for arc in arcs)
    assert (arrivals(circle, arcs) <= value[at]).all()
    if kind == "worst":
        np.testing.assert_array_equal(arrivals(circle, arcs), value[at])


# ---- the limit: the ways


def test_each_way_past_the_pillar_is_open_as_far_as_geometry_says(game_on_vehicle):
    game = game_on_vehicle
    x, y = game.lattice.grid.nodes.T
    for side, samples in zip((1, -1), game.limit.samples, strict=True):
        room, open_ = LAST_CHANCE - x + side * y, samples < NEVER
        assert open_[game.starts & (room > game.lattice.grid.cell)].all()
        assert not open_[game.starts & (room < -game.lattice.grid.cell)].any()
        # It takes as long as the line is far.
        open_ &= game.starts
        np.testing.assert_array_equal(samples[open_], np.ceil((3 - x[open_]) / 0.05 - 1e-6))


def test_each_way_round_the_circle_is_open_and_takes_the_time_it_takes(game_on_circle):
    game = game_on_circle
    theta, out = game.lattice.grid.nodes[:, 0], ~game.lattice.arrived
    clockwise, counter = game.limit.samples
    np.testing.assert_array_equal(clockwise[out], np.ceil((theta[out] - 0.3) / 0.05))
    np.testing.assert_array_equal(counter[out], np.ceil((2 * PI - theta[out] - 0.3) / 0.05))
    assert not game.limit.samples[:, ~out].any()
    for eps in BOUNDS:
        assert game.winnable(eps).all()


# ---- the limit: what can be won


def test_a_start_is_winnable_if_each_side_that_may_be_measured_is_open(game_on_vehicle):
    game = game_on_vehicle
    x, y = game.lattice.grid.nodes.T
    on_axis, masks = game.starts & (np.abs(y) < 1e-9), []
    for eps in BOUNDS:
        left, right = LAST_CHANCE - x + y, LAST_CHANCE - x - y
        room = np.minimum(
            np.where(y >= -eps - 1e-6, left, np.inf), np.where(y < eps - 1e-6, right, np.inf)
        )
        winnable = game.winnable(eps)
        assert winnable[game.starts & (room > game.lattice.grid.cell)].all()
        assert not winnable[game.starts & (room < -game.lattice.grid.cell)].any()
        # Noise hides at which side of the axis a start is: on the axis that costs nothing.
        assert x[on_axis & winnable].max() == pytest.approx(LAST_CHANCE, abs=0.0125)
        masks.append(winnable[game.starts])
    for less, more in pairwise(masks):
        assert not (more & ~less).any()
        assert more.sum() < less.sum()


def test_a_single_part_leaves_nothing_to_decide(vehicle):
    partition = make_partition(vehicle, one_way_policy(vehicle), np.empty((0, 2)), 60)
    limit = Limit.solve(Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 120)), partition)
    x, y = limit.lattice.grid.nodes.T
    free = (x <= 0.4) & (np.abs(y) <= 1)
    assert limit.winnable(np.array([0.0, 0.2]))[free].all()
    assert (solve(limit.moves(np.array([0.0, 0.2])))[0, :-2][free] < NEVER).all()


# ---- the limit: its score


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vehicle", "circle"])
def test_the_limit_wins_what_is_winnable_and_no_planted_controller_beats_it(name, request):
    game = request.getfixturevalue(f"game_on_{name}")
    assert game.score(LIMIT, 0.0).won_any == 1.0
    for eps in (0.05, 0.1):
        limit = game.score(LIMIT, eps)
        assert limit.won == 1.0
        for loop in game.controllers:
            score, value = game.score(loop, eps), game.value(loop, eps)[:, :-2]
            assert score.won_any <= limit.won_any
            assert (value[-1] < NEVER)[game.starts].mean() <= limit.winnable + 1e-12
            # Noise may bring a run early, but not the latest of all.
            assert score.won < 1 or score.time >= limit.time


def test_with_room_for_the_noise_the_limit_holds_the_way_that_it_has_picked(game_on_circle):
    game = game_on_circle
    for eps in (0.05, 0.2):
        moves, places = game.moves(LIMIT, eps), game.lattice.places
        going = np.append(~game.lattice.arrived, [False, False])
        origin = np.repeat(moves.state, moves.counts)
        came = np.zeros(moves.rows * places, dtype=bool)
        came[-places:] = going  # not started yet
        for _ in range(80):
            came[moves.target[came[origin] & going[origin % places]]] = True
        jumps = (origin // places != moves.target // places) & (origin < (moves.rows - 1) * places)
        assert jumps.any()
        assert not (jumps & came[origin] & going[origin % places]).any()


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


@pytest.mark.parametrize(
    ("name", "cells", "share"),
    [("vehicle", 60, 0.6), ("vehicle", 75, 0.9), ("unit_circle", 126, 0.9)],
)
def test_the_fewest_samples_are_those_of_a_plain_twin(name, cells, share):
    task = get_task(name)
    lattice = Lattice.tabulate(task, Grid.with_cells(task.chart, cells))
    allowed = np.random.default_rng(0).random(lattice.after.shape) < share
    samples, level = fewest_samples(lattice, lattice.after, allowed)
    expected, levels = plain_samples(lattice, lattice.after, allowed)
    np.testing.assert_array_equal(samples, expected)
    np.testing.assert_array_equal(level[expected < NEVER], levels[expected < NEVER])
    assert len(np.unique(expected)) > 20, "a sample crosses a cell, so that runs arrive"
