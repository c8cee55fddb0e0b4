"""Tables of inputs as the policies of modes, and the game on environments whose chart is their state."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from environments import Puck, Slid, puck_agent
from planted import ChartPolicy, extended, spare_environments

from hyrl_mj import BadArtifact, from_gymnasium
from hyrl_mj.judging.game import Lattice, lattice_grid
from hyrl_mj.judging.worst_case import worst_case
from hyrl_mj.learning import preset, training
from hyrl_mj.pipeline.steps import _retrained
from hyrl_mj.policies import PolicyController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import Signal, closed_loop, policy_runs
from hyrl_mj.stages import Partition, PartPolicy
from hyrl_mj.stages.grounds import ByAttack, mode_ground
from hyrl_mj.stages.retraining import retrain
from hyrl_mj.stages.tables import (
    HeldInputs,
    TablePolicy,
    _in_reach,
    _left,
    _under_noise,
    table_for,
)
from hyrl_mj.tasks import Outcome

pytestmark = pytest.mark.slow  # tables take seconds

EPS = 0.15


@pytest.fixture(autouse=True)
def few_runs(monkeypatch):
    spare_environments(monkeypatch)


@pytest.fixture(scope="module")
def puck():
    return from_gymnasium(Puck, steps=80)


@pytest.fixture(scope="module")
def slid():
    return from_gymnasium(Slid, steps=80, bounds={"x": (-2.3, 2.3), "y": (-1.7, 1.7)})


def of_masks(grid, *masks):
    """Returns extended sets of modes 0, 1, ... that are masks (N,) of a grid."""
    return extended([GridSet.from_mask(grid, mask) for mask in masks], masks, 0.0, EPS)


@pytest.fixture(scope="module")
def held(puck):
    """Mode 0 passes on the upper side of the rock, mode 1 on any, mode 2 beside one column of nodes."""
    grid = Grid.with_cells(puck.chart, 24)
    x, y = grid.nodes.T
    beside = np.abs(x - np.unique(x)[5]) > 1e-9
    return HeldInputs.from_sets(
        puck, of_masks(grid, (y > -0.3) | (x > 0.6), np.ones(grid.size, dtype=bool), beside)
    )


@pytest.mark.long
def test_held_inputs_lead_where_the_environment_leads_under_them(puck, held):
    row, a = len(held.rows) // 3, 7
    plant = puck.plant(1)
    plant.set_state(*puck.state(held.grid.nodes[held.rows[[row]]]))
    for _ in range(held.samples):
        if puck.ending(plant.measurement)[0] == Outcome.RUNNING:
            plant.step(held.inputs[[a]])
    np.testing.assert_array_equal(puck.z(plant.measurement)[0], held.ends[a, row])
    gone = np.linalg.norm(held.ends - held.grid.nodes[held.rows], axis=2).max(axis=0)
    assert np.median(gone) >= 1.5 * EPS, "inputs are held until they tell"


@pytest.mark.parametrize("how", ["worst", "mean"])
def test_what_noise_may_hide_is_found_as_by_one_node_after_another(held, how):
    grid, values = held.grid, np.random.default_rng(0).normal(size=held.grid.size)
    robots = np.isin(np.arange(grid.size), held.rows)
    found = _in_reach(grid, np.array([EPS, 0.0]), values, robots, how)
    nodes, cell = grid.nodes, grid.spacing
    reach = np.ceil(EPS / cell[0]) * cell[0] + 1e-9
    for i in range(0, len(nodes), 29):
        off = np.abs(nodes - nodes[i])
        near = values[robots & (off[:, 0] <= reach) & (off[:, 1] < cell[1] / 2)]
        expected = (
            near.max(initial=-np.inf) if how == "worst" else near.mean() if len(near) else np.inf
        )
        assert found[i] == pytest.approx(expected, abs=1e-9)


def test_how_far_arrival_is_under_noise_is_found_as_by_one_node_after_another(held):
    """Noise takes the worst of what it can show with the probability `worst`, and anything otherwise."""
    nodes, grid, rng = held.grid.nodes, held.grid, np.random.default_rng(0)
    table, worst = rng.integers(len(held.inputs), size=grid.size), held.settings.worst
    left = rng.uniform(0, 100, len(held.rows))
    after = held.after(left, 0)
    found = _under_noise(held, table)(after)
    cells = np.ceil(held.bound / grid.spacing - 1e-9)
    everywhere = left[held.nearest]
    for i in range(0, len(held.rows), 17):
        near = (np.abs(nodes - nodes[held.rows[i]]) <= cells * grid.spacing + 1e-9).all(axis=1)
        costs = []
        for a in table[near]:
            value = grid.interpolate(everywhere, held.ends[a, [i]])[0]
            if held.arrived[a, i]:
                value = 0.0
            lost = held.failed[a, i] or held.leaves[0, a, i]
            costs.append(held.never if lost else value)
        expected = worst * max(costs) + (1 - worst) * np.mean(costs)
        assert found[i] == pytest.approx(expected)


def test_a_held_input_leaves_the_set_if_it_does_after_some_sample(held):
    """A strip that the robot jumps over in the time for which an input is held is not passed."""
    grid = held.grid
    column = np.unique(grid.nodes[:, 0])[5]
    starts, ends = grid.nodes[held.rows][:, 0], held.ends[..., 0]
    over = (starts < column) & (ends > column + 0.6 * grid.spacing[0])
    assert over.any()
    assert held.leaves[2][over].all()
    before = (starts < column) & (ends < column - grid.spacing[0])
    assert not held.leaves[2][before].any()


class Corner(Signal):
    """Noise that shows the robot at one corner of its bound all the time."""

    def __init__(self, task, corner):
        super().__init__(EPS, np.zeros(task.measurement_columns))
        self.shares[:2] = corner

    def sample(self, now):
        return np.tile(self.bound * self.shares, (len(now.rows), 1))


def test_a_table_goes_the_way_of_its_mode_whatever_noise_shows(puck, held):
    """Along the upper side of the rock, also from starts below the line that leads to it."""
    table = table_for(held, 0)
    z = np.stack(np.meshgrid([-1.8, -1.4, -1.0], [0.0, 0.5, 1.0]), axis=-1).reshape(-1, 2)
    path = policy_runs(puck, table, z).path
    passing = np.abs(path[..., 0]) < 0.1
    assert (path[..., 1][passing] > 0).all()
    for corner in ((0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        run = closed_loop(puck, PolicyController(table), z, Corner(puck, corner))
        assert (run.outcome == Outcome.REACHED).all(), corner


def test_later_tables_reckon_with_the_noise_and_arrive_earlier(held):
    def usual(mode, tables):
        settings = replace(held.settings, tables=tables)
        inputs = table_for(replace(held, settings=settings), mode).inputs
        table = np.abs(held.inputs[:, None] - inputs).sum(axis=2).argmin(axis=0)
        return _left(held, mode, _under_noise(held, table))[held.own(mode)].mean()

    later = [usual(mode, 6) for mode in (0, 1)]
    first = [usual(mode, 1) for mode in (0, 1)]
    assert later[0] < first[0]
    assert later[1] < first[1]
    assert sum(later) < 0.95 * sum(first)


def test_a_table_leads_back_from_where_noise_shows_the_robot_outside_of_the_set(puck, held):
    table = table_for(held, 0)
    z = np.stack(np.meshgrid([-1.8, -1.4, -1.0], [-0.45, -0.4]), axis=-1).reshape(-1, 2)
    assert not held.extended.sets[0].contains(z).any()
    plant = puck.plant(len(z))
    plant.set_state(*puck.state(z))
    assert (table.act(plant.measurement)[:, 1] > 0).all()


def test_a_table_is_read_as_it_was_written(puck, held, tmp_path):
    table = table_for(held, 1)
    table.save(tmp_path / "mode_0.safetensors")
    again = TablePolicy.load(path := tmp_path / "mode_0_table.npz", puck)
    measured = puck.plant(3).measurement
    np.testing.assert_array_equal(again.act(measured), table.act(measured))
    replace(again, inputs=again.inputs[1:]).save(tmp_path / "mode_0.safetensors")
    with pytest.raises(BadArtifact, match="does not fit"):
        TablePolicy.load(path, puck)


@pytest.mark.parametrize(
    ("scores", "taken"),
    [
        ({"pi_i": 0.8, "agent": 0.7, "table": 0.9}, "table"),
        ({"pi_i": 0.8, "agent": 0.7, "table": 0.75}, "pi_i"),
        ({"pi_i": 1.0, "agent": 1.0, "table": 1.0}, "pi_i"),
        ({"pi_i": 0.1, "agent": 1.0, "table": 0.2}, "table"),
        ({"pi_i": 0.1, "agent": 1.0}, "agent"),
        ({"pi_i": 0.96, "agent": 0.1}, "pi_i"),
        ({"pi_i": 0.1, "agent": 0.96}, "agent"),
    ],
)
def test_the_best_of_what_is_given_is_taken_and_nothing_is_trained(
    puck, held, scores, taken, monkeypatch
):
    """The first that wins all is; without a table the agent, too, and what wins nearly all."""
    made = TablePolicy(puck, held.grid, np.zeros((held.grid.size, 2)))

    class Ground:
        task, mode, enough, nearly = puck, 1, (1.0,), (0.95,)

        def kind(self, policy):
            if policy is made:
                return "table"
            return "agent" if policy.whole else "pi_i"

        def __call__(self, policy):
            return (scores[self.kind(policy)],)

        def suffices(self, policy):
            return self(policy) >= self.enough

        def won(self, policy):
            return scores[self.kind(policy)]

    half = GridSet.from_mask(held.grid, held.grid.nodes[:, 0] < 0)
    part = PartPolicy(puck, ChartPolicy(puck, lambda z: z), half.eroded(0.1), 0.1)
    monkeypatch.setattr("hyrl_mj.stages.retraining.table_for", lambda held, mode: made)
    given = held if "table" in scores else None
    untrained = [part] if given else [part, part.undivided]
    _, result = retrain(Ground(), SimpleNamespace(attempts=1), 0, untrained=untrained, held=given)
    assert (result.policy, result.attempts, result.won) == (taken, 0, scores[taken])


@pytest.mark.parametrize(("modes", "tried"), [(1, ["policy"]), (2, [])])
def test_the_policy_of_stage_1_is_tried_first_where_nothing_is_decided(
    modes, tried, vehicle, monkeypatch, tmp_path
):
    grid = Grid.with_cells(vehicle.chart, 24)
    every = np.ones(grid.size, dtype=bool)
    sets = of_masks(grid, *[every] * modes)
    partition = Partition(sets.modes, tuple(sets.sets), every)
    settings = preset(vehicle, "smoke")
    policy = training.export(training.build(vehicle, settings.stage6, seed=0), vehicle)
    grounds = partial(mode_ground, vehicle, sets)

    def retrained(ground, *given, untrained, **more):
        assert all(one is policy for one in untrained)  # which can be bounded, and exported
        return ["policy" for _ in untrained]

    monkeypatch.setattr("hyrl_mj.stages.retraining.retrain", retrained)
    assert _retrained(grounds, None, settings, policy, partition, tmp_path, 0) == tried


def test_a_policy_is_judged_without_noise_and_by_an_attack(puck):
    grid = Grid.with_cells(puck.chart, 24)
    sets = of_masks(grid, np.ones(grid.size, dtype=bool))
    ground = mode_ground(puck, sets, 0)
    assert isinstance(ground, ByAttack)
    policy = SimpleNamespace(act=lambda m: np.clip(puck_agent(puck.observation(m)), -4, 4))
    idle = SimpleNamespace(act=lambda m: np.zeros((len(m), 2)))
    both = ground(policy)[0]
    assert 0.5 < both < 1
    assert ground.won(policy) <= both, "what the attack breaks is not won"
    assert ground(idle)[0] < 0.1


def test_no_table_where_arrival_does_not_end_an_episode(puck, held):
    kept = from_gymnasium(Puck, steps=40, success="reward >= -0.25")
    grid = Grid.with_cells(kept.chart, 8)
    assert HeldInputs.from_sets(kept, of_masks(grid, np.ones(grid.size, dtype=bool))) is None
    assert kept.learning.cells == round((800_000 / 40) ** 0.5 - 0.5), (
        "fewer cells for whole episodes"
    )
    assert puck.learning.cells is None


def test_whether_the_chart_is_the_state_is_tried_out(puck, slid):
    assert slid.chart_is_state
    assert not puck.chart_is_state, "it has a speed"
    assert "larger state" in Lattice.why_not(puck)
    z = slid.starts(5, np.random.default_rng(0))
    plant = slid.plant(5)
    plant.set_state(*slid.state(z))
    np.testing.assert_array_equal(slid.observation(slid.at(z)), slid.observation(plant.measurement))


def test_its_lattice_leads_to_where_it_goes_and_never_into_a_wall(slid):
    lattice = Lattice.tabulate(slid, lattice_grid(slid, 16))
    assert lattice.estimate
    ends = lattice.after[:, 0][:, lattice.running]
    inside = ends < lattice.nodes
    assert lattice.running[ends[inside]].all()
    nodes = lattice.grid.nodes
    off = nodes[ends[inside]] - np.broadcast_to(nodes[lattice.running], (*ends.shape, 2))[inside]
    assert np.abs(off).max() < 0.2 + 3 * lattice.grid.spacing.max()
    assert (ends == lattice.nodes).any(), "it arrives"


def test_the_game_on_an_environment_is_an_estimate_with_its_reason(slid):
    grid = Grid.with_cells(slid.chart, 24)
    halves = [GridSet.from_mask(grid, sign * grid.nodes[:, 1] >= 0) for sign in (1, -1)]
    loops = {
        "policy": PolicyController(
            SimpleNamespace(act=lambda m: puck_agent(slid.observation(m)) / 4)
        )
    }
    points = np.array([[-1.0, 0.0]])
    result, maps = worst_case(slid, points, halves, loops, (0.0, 0.2), False, 22)
    assert result.estimate
    assert "contacts" in result.why_not_proved["policy"]
    quiet, noisy = result.scores["policy"]
    assert quiet.won >= noisy.won
    assert quiet.not_broken == 1
    assert maps.map["policy"].shape == (np.prod(maps.grid_counts),)
