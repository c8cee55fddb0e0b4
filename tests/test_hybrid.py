"""The hybrid controller jumps exactly on its jump set, and is a pure function."""

from dataclasses import dataclass

import numpy as np
import pytest
from drawn import points
from hypothesis import given, strategies as st
from planted import AnalyticSet, ChartPolicy, ideal_controller, random_states

import hyrl_mj
from hyrl_mj import BadInput, HybridController
from hyrl_mj.policies import ON_EDGE
from hyrl_mj.sets import Everything


def constant(task, value):
    return ChartPolicy(task, lambda z: np.full((len(z), 1), value))


def states_of(name):
    """Measurements (n, d) of one of the paper's tasks, also beyond its chart."""
    return points(hyrl_mj.get_task(name).chart)


@pytest.fixture(scope="module")
def two(vehicle):
    return ideal_controller(vehicle, overlap=0.2)


@pytest.fixture(scope="module")
def three(circle):
    """Three modes around the circle, each centred on its own third, half-width 1.3 rad."""
    centres = {1: 0.0, 4: 2 * np.pi / 3, 7: 4 * np.pi / 3}
    return HybridController(
        circle,
        {q: constant(circle, k / 10) for k, q in enumerate(centres)},
        {
            q: AnalyticSet(lambda z, c=c: np.abs(circle.chart.difference(z, c))[:, 0] - 1.3)
            for q, c in centres.items()
        },
    )


# ---- jumps


@given(z=states_of("vehicle"))
def test_it_jumps_exactly_on_the_jump_set(two, z):
    for q in two.modes:
        modes = np.full(len(z), q)
        _, after = two.step(modes, z)
        inside = np.abs(two.flow_sets[q].signed_distance(z)) > ON_EDGE
        jumps = two.jump_set(q).contains(z)
        np.testing.assert_array_equal((after != modes)[inside], jumps[inside])


def test_on_the_edge_it_flows(two):
    z = np.array([[0.1, -0.2], [0.1, -0.2 - 1e-6], [0.1, 0.2], [0.1, 0.2 + 1e-6]])
    np.testing.assert_array_equal(two.step(np.array([0, 0, 1, 1]), z)[1], [0, 1, 1, 0])


def test_the_mode_after_the_jump_acts(two):
    z = np.array([[0.1, -0.3], [0.1, 0.0], [0.1, 0.3]])
    u, q = two.step(np.array([0, 0, 0]), z)
    np.testing.assert_array_equal(u[:, 0], [-1.0, 1.0, 1.0])
    np.testing.assert_array_equal(q, [1, 0, 0])


def test_the_initial_mode_is_the_deepest(two, three):
    z = np.array([[0.1, 0.05], [0.1, -0.05], [0.1, 0.9]])
    np.testing.assert_array_equal(two.initial_mode(z), [0, 1, 0])
    np.testing.assert_array_equal(three.initial_mode(np.array([[0.1], [2.0], [4.0]])), [1, 4, 7])


def test_a_single_mode_never_jumps(vehicle):
    nowhere = AnalyticSet(lambda z: np.ones(len(z)))
    for flow_set in (Everything(), nowhere):
        controller = HybridController(vehicle, {0: constant(vehicle, 0.5)}, {0: flow_set})
        z = random_states(vehicle, 100, np.random.default_rng(0))
        u, q = controller.step(np.zeros(100, dtype=int), z)
        np.testing.assert_array_equal(q, 0)
        np.testing.assert_array_equal(u, 0.5)
        np.testing.assert_array_equal(controller.initial_mode(z), 0)


@dataclass(frozen=True)
class Counted:
    """A set that is the half line z >= 0 or z <= 0, and counts the points that it is asked about."""

    sign: float
    asked: list

    def signed_distance(self, z):
        self.asked.append(len(z))
        return self.sign * z[:, 0]


def test_other_sets_are_asked_only_where_there_is_a_choice(circle):
    sets = {q: Counted(sign, []) for q, sign in ((0, 1.0), (1, -1.0), (2, -2.0))}
    z = np.array([[-1.0], [-0.5], [1.0], [2.0], [3.0]])

    def asked(modes, q):
        for counted in sets.values():
            counted.asked.clear()
        policies = dict.fromkeys(modes, constant(circle, 0.0))
        _, after = HybridController(circle, policies, {m: sets[m] for m in modes}).step(q, z)
        return after.tolist(), [sum(sets[m].asked) for m in modes]

    assert asked((0, 1), np.zeros(5, dtype=int)) == ([0, 0, 1, 1, 1], [5, 0])
    assert asked((0, 1, 2), np.zeros(5, dtype=int)) == ([0, 0, 2, 2, 2], [5, 3, 3])
    assert asked((0, 1, 2), np.array([0, 1, 1, 2, 2])) == ([0, 0, 1, 2, 2], [2, 2, 3])


# ---- a pure function


def test_step_is_pure(two, vehicle):
    z = random_states(vehicle, 500, np.random.default_rng(0))
    q = np.arange(500) % 2
    z_before, q_before = z.copy(), q.copy()
    first = two.step(q, z)
    two.step(1 - q, z[::-1])
    second = two.step(q, z)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(z, z_before)
    np.testing.assert_array_equal(q, q_before)
    assert not np.shares_memory(first[1], q)


@given(z=states_of("unit_circle"), modes=st.lists(st.sampled_from([1, 4, 7]), min_size=8))
def test_a_batch_gives_what_its_rows_give(three, z, modes):
    q = np.array(modes[: len(z)])
    u, after = three.step(q, z)
    assert u.shape == (len(z), 1)
    assert after.dtype.kind == "i"
    for i in range(len(z)):
        u_i, q_i = three.step(q[i : i + 1], z[i : i + 1])
        assert (u_i[0, 0], q_i[0]) == (u[i, 0], after[i])


def test_no_robots_are_no_problem(two):
    u, q = two.step(np.zeros(0, dtype=int), np.zeros((0, 2)))
    assert (u.shape, q.shape) == ((0, 1), (0,))


# ---- bad input


@pytest.mark.parametrize("mode", [2, -1, 0.5, np.nan])
def test_an_unknown_mode_lists_the_known(two, mode):
    with pytest.raises(BadInput, match=r"unknown: choose one of \(0, 1\)") as caught:
        two.step(np.array([0, mode]), np.zeros((2, 2)))
    assert str(mode) in str(caught.value)
    with pytest.raises(BadInput, match=r"choose one of \(0, 1\)"):
        two.flow_set(mode)
    with pytest.raises(BadInput, match=r"choose one of \(0, 1\)"):
        two.jump_set(mode)


@pytest.mark.parametrize("q", [0, np.zeros(3, dtype=int), np.zeros((2, 1), dtype=int)])
def test_modes_of_the_wrong_shape_are_refused(two, q):
    with pytest.raises(BadInput, match=r"2 measurements need q of shape \(2,\)"):
        two.step(q, np.zeros((2, 2)))


def test_bad_measurements_are_refused(two):
    with pytest.raises(BadInput, match=r"measurement\[1, 1\] is nan"):
        two.step(np.zeros(2, dtype=int), np.array([[0.0, 0.0], [0.0, np.nan]]))
    with pytest.raises(BadInput, match=r"\(n, 2\)"):
        two.initial_mode(np.zeros((2, 3)))
    with pytest.raises(BadInput, match=r"measurement\[0, 0\] is inf"):
        two.initial_mode(np.full((1, 2), np.inf))
