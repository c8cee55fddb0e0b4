"""Where three or more ways meet: jumps, chatter, overlaps, and what the run says of a lack of room."""

from itertools import product

import numpy as np
import pytest
from junctions import EPS, NUMBERS, Gates, four_ways, thin_way, three_ways

from hyrl_mj import Noise, extend, find_critical_set, make_partition, simulate
from hyrl_mj.stages import meeting

JUNCTIONS = pytest.mark.parametrize("make", [three_ways, four_ways])
CELLS = 60


def around(task, far, n=41):
    """Points (n * n, 2) of a square around the junction."""
    axis = np.linspace(-far, far, n)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


# ---- jumps


@JUNCTIONS
def test_a_jump_goes_to_the_mode_whose_set_holds_the_state_most_deeply(make):
    task = make()
    controller = task.controller(task.widened(0.05))
    z = np.random.default_rng(0).uniform(-0.9, 0.9, (4_000, 2))
    owner = np.array(task.modes)[task.sector(z)]
    for q, members in zip(task.modes, task.widened(0.05), strict=True):
        _, after = controller.step(np.full(len(z), q), z)
        stays = members.contains(z)
        # The mode left, the state lies deepest in the sector that holds it.
        np.testing.assert_array_equal(after, np.where(stays, q, owner))
        assert set(after) == set(task.modes)
    np.testing.assert_array_equal(controller.initial_mode(z), owner)


# ---- chatter


def cycles(controller, z, eps, n=9):
    """Whether some noise within `eps` changes the mode for ever at points (k, 2) that stay: (k,) bool."""
    modes = np.array(controller.modes)
    noise = eps * np.array(list(product(np.linspace(-1, 1, n), repeat=2)))
    measured = (z[:, None] + noise).reshape(-1, 2)
    follows = np.zeros((len(z), len(modes), len(modes)), dtype=bool)
    for i, q in enumerate(modes):
        _, after = controller.step(np.full(len(measured), q), measured)
        for k, other in enumerate(modes):
            follows[:, i, k] = (after == other).reshape(len(z), -1).any(axis=1) & (k != i)
    # A mode on a cycle comes back to itself after as many changes as there are modes, or fewer.
    reached = follows.copy()
    for _ in modes:
        reached = reached | np.einsum("zij,zjk->zik", reached, follows)
    return reached[:, np.arange(len(modes)), np.arange(len(modes))].any(axis=1)


@JUNCTIONS
def test_no_noise_within_the_bound_keeps_the_mode_changing_at_a_junction(make):
    task, z = make(), around(make(), 4 * EPS)
    wide = task.controller(task.widened(2 * EPS))
    assert not cycles(wide, z, EPS).any()
    narrow = task.controller(task.widened(0.4 * EPS))
    assert cycles(narrow, z, EPS).any(), "a test that no sets fail tests nothing"


def test_beside_a_thin_way_an_overlap_of_one_bound_is_not_enough():
    task = thin_way()
    z = around(task, 4 * EPS)
    assert not cycles(task.controller(task.widened(2 * EPS)), z, EPS).any()
    # Each of the two wide modes ends within the bound of the other across the tip of the thin one.
    chatters = z[cycles(task.controller(task.widened(0.99 * EPS)), z, EPS)]
    assert len(chatters)


class Worst:
    """A controller whose measurements an adversary moves so that the mode changes whenever it can."""

    def __init__(self, inner, eps):
        self.inner, self.modes = inner, inner.modes
        self.noise = eps * np.array(list(product((-1, -0.5, 0, 0.5, 1), repeat=2)))

    def initial_mode(self, measured):
        return self.inner.initial_mode(measured)

    def step(self, q, measured):
        moved = (measured[:, None] + self.noise).reshape(-1, 2)
        u, after = self.inner.step(np.repeat(q, len(self.noise)), moved)
        after = after.reshape(len(q), -1)
        chosen = (after != q[:, None]).argmax(axis=1)
        rows = np.arange(len(q))
        return u.reshape(*after.shape, -1)[rows, chosen], after[rows, chosen]


@JUNCTIONS
@pytest.mark.parametrize("kind", ["alternating", "worst"])
def test_from_a_junction_every_mode_gets_out_with_at_most_one_jump(make, kind):
    task, starts = make(), around(make(), 2 * EPS, 7)
    controller = task.controller(task.widened(2 * EPS))
    for q in task.modes:
        loop = controller if kind == "alternating" else Worst(controller, EPS)
        noise = Noise("alternating", EPS) if kind == "alternating" else None
        arcs = simulate(task, loop, starts, noise, q)
        assert {arc.outcome for arc in arcs} == {"reached"}
        assert max(arc.j[-1] for arc in arcs) <= 1


# ---- sets


class Split:
    """A planted junction with its partition and its extended sets."""

    def __init__(self, task):
        self.task, policy = task, task.policy()
        self.critical = find_critical_set(task, policy, 40, 1 / 16, "outcome", EPS)
        points = self.critical.points
        self.parts = make_partition(task, policy, points, CELLS, EPS)
        self.sets = extend(task, policy, points, self.parts, EPS)


@pytest.fixture(scope="module")
def split():
    return {make: Split(make()) for make in (three_ways, four_ways)}


@pytest.mark.slow
@JUNCTIONS
def test_the_sets_hold_their_parts_and_two_bounds_more_where_they_meet(split, make):
    case, task = split[make], split[make].task
    assert case.sets.modes == case.parts.modes == task.modes
    z = around(task, 0.7, 71)
    slack = 2 * case.parts.grid.cell
    for k, (members, part) in enumerate(zip(case.sets.sets, case.parts.parts, strict=True)):
        assert members.mask[part.mask].all()
        assert members.contains(z[task.within(k, z, 2 * EPS - slack)]).all()
        # Beyond that and a sample's hop, a set holds nothing.
        assert not members.contains(z[~task.within(k, z, 2 * EPS + 0.05 + slack)]).any()
    middle = np.zeros((1, 2))
    assert all(members.contains(middle).all() for members in case.sets.sets)
    assert not case.sets.narrow.any()
    assert "change over" not in case.sets.sentence(task)


@pytest.mark.slow
@JUNCTIONS
def test_the_sets_that_were_found_do_not_chatter_either(split, make):
    case = split[make]
    assert not cycles(case.task.controller(case.sets.sets), around(case.task, 4 * EPS), EPS).any()


@pytest.mark.slow
@JUNCTIONS
def test_neighbours_meet_along_their_edge_and_all_in_the_junction(split, make):
    case, task = split[make], split[make].task
    k = len(task.modes)
    far = 0.5 * np.stack([np.cos(task.edges), np.sin(task.edges)], axis=1)
    found = meeting.meet(meeting.around(far, case.parts.parts))
    for i, meet in enumerate(found):
        expected = np.zeros((k, k), dtype=bool)
        expected[i - 1, i] = expected[i, i - 1] = True
        np.testing.assert_array_equal(meet, expected)
    (middle,) = meeting.meet(meeting.around(np.zeros((1, 2)), case.parts.parts))
    np.testing.assert_array_equal(middle, ~np.eye(k, dtype=bool))


# ---- room


@pytest.fixture(scope="module")
def gates():
    return Split(Gates())


def test_room_is_asked_of_the_modes_that_meet_alone(gates):
    sets = gates.sets
    assert sets.modes == NUMBERS
    assert {tuple(pair) for pair in sets.between.tolist()} == {(1, 4), (4, 6), (6, 9)}
    for post, pair in zip(Gates.POSTS, ((1, 4), (4, 6), (6, 9)), strict=True):
        here = (sets.between == pair).all(axis=1)
        np.testing.assert_allclose(sets.points[here, 1], post, atol=0.02)
        # To pass on either side from 2 eps beyond takes as long as the way there and around the post.
        narrow = sets.points[here & sets.narrow, 0]
        enough = 2 * EPS - gates.parts.grid.cell + Gates.HALF
        assert narrow.min() == pytest.approx(-enough, abs=gates.critical.spacing + 0.03)
        assert (sets.points[here & ~sets.narrow, 0] < narrow.min()).all()


def test_what_is_said_is_said_of_each_piece(gates):
    text = gates.sets.sentence(gates.task)
    assert text.count(", from a = -0.") == 3
    for pair in ("1 and 4", "4 and 6", "6 and 9"):
        assert f"between {pair}, from" in text
    assert text.count("switching safely needs 0.2 m") == 3
    assert "share" in text


def test_no_more_than_three_pieces_are_spelled_out(gates):
    from dataclasses import replace

    sets = gates.sets
    doubled = replace(
        sets,
        modes=(*sets.modes, 12),
        sets=(*sets.sets, sets.sets[0]),
        winning=(*sets.winning, sets.winning[0]),
        points=np.vstack([sets.points, sets.points[:1]]),
        room=np.append(sets.room, 0.0),
        between=np.vstack([sets.between, [9, 12]]),
    )
    text = doubled.sentence(gates.task)
    assert text.count("switching safely needs") == 3
    assert text.endswith("so it is in places between 1 other pair of modes")
