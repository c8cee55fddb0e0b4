"""A step of the hybrid controller gives what a plain one gives, row by row and written out."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from planted import ChartPolicy, random_states

from hyrl_mj import HybridController
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.training import build, export
from hyrl_mj.sets import Grid, GridSet

LAYERS = {
    "dqn": ("q_net.q_net.0", "q_net.q_net.2", "q_net.q_net.4"),
    "ppo": ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net"),
}


# ---- the plain twin


def plain_distance(flow_set, z):
    """Signed distance of one point (d,), corner by corner of its cell."""
    chart, counts = flow_set.grid.chart, flow_set.grid.counts
    values = flow_set.values.reshape(counts)
    below, share = [], []
    for x, low, high, periodic, count in zip(
        z, chart.low, chart.high, chart.periodic, counts, strict=True
    ):
        if periodic:
            index = (x - low) % (high - low) / (high - low) * count
        else:
            index = min(max((x - low) / (high - low) * (count - 1), 0.0), count - 1.0)
        below.append(int(index))
        share.append(index - int(index))
    total = 0.0
    for corner in product((0, 1), repeat=len(counts)):
        weight = np.prod([s if up else 1 - s for up, s in zip(corner, share, strict=True)])
        if weight > 0:
            total += weight * values[tuple((np.array(below) + corner) % counts)]
    return total


def plain_act(policy, measured):
    """The input (m,) for one measurement (p,), in double precision."""
    x = policy.task.observation(measured[None])[0]
    names = LAYERS[policy.algorithm]
    squash = {"relu": lambda v: max(v, 0.0), "tanh": np.tanh}[policy.activation]
    for name in names:
        weight, bias = (
            policy.weights[f"{name}.{part}"].astype(float) for part in ("weight", "bias")
        )
        x = np.array([np.dot(row, x) + b for row, b in zip(weight, bias, strict=True)])
        if name != names[-1]:
            x = np.array([squash(v) for v in x])
    if policy.task.input_levels is not None:
        return policy.task.input_levels[int(np.argmax(x))]
    low, high = policy.task.input_limits
    return np.array([min(max(v, a), b) for v, a, b in zip(x, low, high, strict=True)])


def plain_step(controller, q, measured):
    """Input (m,) and mode after one sample of one robot."""
    distances = {
        mode: plain_distance(flow_set, controller.task.z(measured[None])[0])
        for mode, flow_set in controller.flow_sets.items()
    }
    if distances[q] > 1e-9:
        q = min((mode for mode in sorted(distances) if mode != q), key=distances.__getitem__)
    return plain_act(controller.policies[q], measured), q


# ---- what it is asked


def rough_set(task, seed, cells=25):
    """A set with many pieces, with nodes exactly on its edge."""
    grid, rng = Grid.with_cells(task.chart, cells), np.random.default_rng(seed)
    turns = 2 * np.pi * (grid.nodes - task.chart.low) / np.subtract(task.chart.high, task.chart.low)
    depth = sum(np.cos(k * turns + rng.uniform(0, 6)).sum(axis=1) / k for k in (1, 2, 3))
    return GridSet(grid, np.where(np.abs(depth) < 0.2, 0.0, depth))


def network(task, seed):
    """An untrained network, its weights far from the cautious ones that training starts from."""
    model = build(task, replace(preset(task, "smoke").stage1, symmetric=False), seed=seed)
    for parameter in model.policy.parameters():
        parameter.data *= 2.0
    return export(model, task)


def awkward_states(chart, grid, rng):
    """Chart points on nodes, at the ends of the chart and past them, at the seam and turns away."""
    low, high = np.array(chart.low), np.array(chart.high)
    ends = np.array(list(product((0.0, 1.0), repeat=chart.dimension))) * (high - low) + low
    ends = np.concatenate([ends, rng.choice([low, high], (50, 1)).reshape(-1, chart.dimension)])
    beyond = rng.uniform(low - 2 * (high - low), high + 2 * (high - low), (200, chart.dimension))
    just = [np.nextafter(ends, side) for side in (-np.inf, np.inf)]
    return np.concatenate([grid.nodes, ends, *just, -ends, ends + high - low, beyond])


@pytest.fixture(scope="module", params=[(0, 1), (1, 4, 7)], ids=["two modes", "three modes"])
def controller(task, request):
    modes = request.param
    return HybridController(
        task,
        {q: network(task, seed) for seed, q in enumerate(modes)},
        {q: rough_set(task, seed) for seed, q in enumerate(modes)},
    )


# ---- comparisons


def test_a_step_gives_what_a_plain_one_gives(controller, task):
    rng = np.random.default_rng(0)
    awkward = awkward_states(task.chart, controller.flow_sets[1].grid, rng)
    z = np.concatenate([random_states(task, 300, rng), awkward])
    q = rng.choice(controller.modes, len(z))
    u, q_next = controller.step(q, z)
    plain = [plain_step(controller, mode, row) for mode, row in zip(q, z, strict=True)]
    np.testing.assert_array_equal(q_next, [mode for _, mode in plain])
    tolerance = 1e-5 if task.input_levels is None else 0.0
    np.testing.assert_allclose(u, [inputs for inputs, _ in plain], rtol=0, atol=tolerance)
    assert 0.1 < (q_next != q).mean() < 0.9
    assert set(q_next) == set(controller.modes)
    assert len(np.unique(u)) > 1


# ---- what it does not do


@dataclass(frozen=True)
class Counted:
    """A set that is the half line z >= 0 or z <= 0, and counts the points that it is asked about."""

    sign: float
    asked: list

    def signed_distance(self, z):
        self.asked.append(len(z))
        return self.sign * z[:, 0]

    def contains(self, z):
        return self.signed_distance(z) <= 0


def test_other_sets_are_asked_only_where_there_is_a_choice(circle):
    sets = {q: Counted(sign, []) for q, sign in ((0, 1.0), (1, -1.0), (2, -2.0))}
    nothing = ChartPolicy(circle, np.zeros_like)
    z = np.array([[-1.0], [-0.5], [1.0], [2.0], [3.0]])

    def asked(modes, q):
        for counted in sets.values():
            counted.asked.clear()
        chosen = {m: sets[m] for m in modes}
        _, after = HybridController(circle, dict.fromkeys(modes, nothing), chosen).step(q, z)
        return after.tolist(), [sum(sets[m].asked) for m in modes]

    assert asked((0, 1), np.zeros(5, dtype=int)) == ([0, 0, 1, 1, 1], [5, 0])
    assert asked((0, 1, 2), np.zeros(5, dtype=int)) == ([0, 0, 2, 2, 2], [5, 3, 3])
    assert asked((0, 1, 2), np.array([0, 1, 1, 2, 2])) == ([0, 0, 1, 2, 2], [2, 2, 3])
