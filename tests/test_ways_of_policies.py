"""M*, parts and sentences of planted policies whose ways are told by the obstacles that they pass."""

from dataclasses import replace

import numpy as np
import pytest
from planted import ChartPolicy, halves
from planted_field import Field

from hyrl_mj import BadInput, Chart, extend, find_critical_set, make_partition
from hyrl_mj.sets import distance_to
from hyrl_mj.tasks import check_task

ROW = {"_a": (1, 0, 0.3), "_b": (2, 0.2, 0.3)}


WIDE = {"": (2, 0, 0.5)}
EPS = 0.1  # [m]


def ahead(task, low=0.0, high=0.0, until=9.0):
    """Straight on for low < y < high, into the post; else past it on the nearer side. Stops at x = until."""

    def rule(z):
        x, y = z.T
        side = np.where(y >= (low + high) / 2, 1.0, -1.0)
        straight = ((y > low) & (y < high)) | (side * y > 0.7)
        goes = (x < until).astype(float)
        return np.stack([goes, np.where(straight, 0.0, side * goes)], axis=1)

    return ChartPolicy(task, rule)


@pytest.mark.slow
@pytest.mark.first(1)
@pytest.mark.parametrize(("low", "high"), [(-0.15, 0.15), (-0.05, 0.33), (-0.31, 0.08), (0.0, 0.0)])
def test_m_star_is_in_the_middle_of_a_wedge_of_failures(low, high):
    field = Field(WIDE)
    found = find_critical_set(field, ahead(field, low, high), 40, 1 / 32, "outcome", EPS)
    x, y = found.points[found.points[:, 0] < 1].T
    assert len(x) > 5
    assert np.abs(y - (low + high) / 2).max() <= found.resolution
    assert np.diff(np.sort(x)).max() <= 1.01 * found.spacing, "a gap"


@pytest.mark.slow
@pytest.mark.first(1)
@pytest.mark.parametrize(("width", "noise"), [(0.42, EPS), (0.22, 0.05), (0.1, 0.0)])
def test_across_a_wider_wedge_there_is_none(width, noise):
    field = Field(WIDE)
    policy = ahead(field, -width / 2, width / 2)
    assert not len(find_critical_set(field, policy, 40, 1 / 32, "outcome", noise).points)


@pytest.mark.slow
def test_where_no_measurement_helps_any_more_nothing_is_critical():
    """In front of the post both ways are closed from x = 2 - 0.5 sqrt(2) on, whatever is measured."""
    field = Field(WIDE)
    points = find_critical_set(field, ahead(field, -0.1, 0.1), 40, 1 / 32, "outcome", EPS).points
    before = points[points[:, 0] < 1.6, 0]
    closed = 2 - 0.5 * np.sqrt(2)
    assert closed - 0.2 < before.max() < closed


@pytest.mark.slow
def test_ways_without_a_critical_set_between_them_are_said():
    field = Field(ROW)
    policy = ahead(field, -0.3, 0.3)
    partition = make_partition(field, policy, np.empty((0, 2)), 40, EPS)
    assert [field.mode_name(q) for q in partition.modes] == ["12 (any way)"]
    assert partition.parts[0].mask.all()
    names = ", ".join(map(field.mode_name, partition.unparted))
    assert len(partition.unparted) >= 2
    assert partition.sentence(field) == (
        f"share of the chart by mode: 12 (any way) 100%; runs go {names}, but no critical set was found "
        "between these ways, so that they are no modes: if the policy fails over more than 4 eps between "
        "them, train it longer"
    )


@pytest.mark.slow
def test_failed_nodes_take_the_way_of_the_nearest_that_arrives():
    field, low, high = Field(WIDE), -0.05, 0.25
    policy = ahead(field, low, high)
    points = find_critical_set(field, policy, 40, 1 / 32, "outcome", EPS).points
    partition = make_partition(field, policy, points, 40, EPS)
    nodes = partition.grid.nodes
    wedge = (nodes[:, 0] < 1) & (nodes[:, 1] > low + 1e-6) & (nodes[:, 1] < high - 1e-6)
    assert wedge.sum() > 20
    assert not partition.succeeds[wedge].any()
    assert partition.modes == (0, 1)
    off = nodes[wedge, 1] - (low + high) / 2
    sure = np.abs(off) > partition.grid.cell / 2
    for part, side in zip(partition.parts, (1, -1), strict=True):
        np.testing.assert_array_equal(part.mask[wedge][sure], side * off[sure] > 0)


@pytest.mark.slow
@pytest.mark.first(1)
@pytest.mark.parametrize("eps", [0.0, 0.1])
def test_a_part_is_wide_enough_beside_m_star_for_the_set_of_the_other_mode_to_end_there(eps):
    """The policy decides beside the post, close to where nothing is left to decide."""
    field = Field({"": (2, 0, 0.1)})

    def late(z):
        x, y = z.T
        down = (x < 2.2) & (y < 0.8) & (y > -0.3)
        return np.where(down[:, None], [[0.0, -1.0]], [[1.0, 0.0]])

    policy = ChartPolicy(field, late)
    points = find_critical_set(field, policy, 40, 1 / 32, "outcome", eps).points
    partition = make_partition(field, policy, points, 40, eps)
    assert partition.modes == (0, 1)
    shared = partition.parts[0] & partition.parts[1]
    off = distance_to(field.chart, points, partition.grid.nodes[shared.mask]).min()
    if eps:
        assert off > 5 * eps
        sets = extend(field, policy, points, partition, eps)
        z = np.array([[2.15, 0.8]])
        assert [bool(s.contains(z)[0]) for s in sets.sets] == [True, False]
    else:
        assert off < 0.2, "without noise nothing needs to be wide"


@pytest.mark.slow
def test_a_policy_of_which_nothing_arrives_is_split_all_the_same():
    field = Field(WIDE)
    policy = ahead(field, until=3.8)
    points = find_critical_set(field, policy, 40, 1 / 8, "outcome").points
    before = points[points[:, 0] < 1]
    assert len(before) > 5
    assert np.abs(before[:, 1]).max() <= 0.1
    partition = make_partition(field, policy, points, 40)
    assert partition.modes == (0, 1)
    nodes = partition.grid.nodes
    start = (nodes[:, 0] < 1) & (np.abs(nodes[:, 1]) > 0.01)
    assert not partition.succeeds[nodes[:, 0] < 3.9].any()
    for part, side in zip(partition.parts, (1, -1), strict=True):
        np.testing.assert_array_equal(part.mask[start], side * nodes[start, 1] > 0)


@pytest.mark.slow
def test_where_nothing_is_left_to_decide_states_belong_to_every_part():
    field = Field({"_a": (1, 0, 0.3), "_b": (2.5, 0.6, 0.3)})

    def aside(z):
        """Ahead, and away from the next post while it is less than half a metre aside."""
        x, y = z.T
        off = y - field.posts[np.where(x < 1.4, 0, 1), 1]
        moves = (np.abs(off) < 0.45) & (x < 2.9)
        return np.stack([np.ones(len(z)), np.where(moves, np.where(off >= 0, 1, -1), 0)], axis=1)

    policy = ChartPolicy(field, aside)
    points = find_critical_set(field, policy, 40, 1 / 8, "outcome", EPS).points
    partition = make_partition(field, policy, points, 40, EPS)
    parts = {
        field.mode_name(q).partition(" ")[2]: part
        for q, part in zip(partition.modes, partition.parts, strict=True)
    }
    ways = ("left of a, left of b", "left of a, right of b", "right of a, right of b")
    assert set(parts) == {f"({way})" for way in ways}, "and nobody goes to the right and the left"
    z = np.array([[0.1, 1.0], [0.1, 0.3], [0.1, -0.3], [1.7, 1.1], [1.7, -0.1], [3.3, 0.5]])
    belongs = [[bool(parts[f"({way})"].contains(z[[k]])[0]) for way in ways] for k in range(6)]
    assert belongs == [
        [True, False, False], [False, True, False], [False, False, True],
        [True, False, False], [False, True, True], [True, True, True],
    ]  # fmt: skip


# ---- what is said


def test_rare_ways_and_names_that_no_run_shows_are_said(vehicle, monkeypatch):
    partition = halves(vehicle, 30)
    assert partition.sentence(vehicle).endswith("%")
    named = replace(vehicle.scene, mode_names=("left", "right", "below"))
    monkeypatch.setattr(type(vehicle), "scene", named)
    assert partition.sentence(vehicle).endswith("; no run that arrives goes 2 (below)")
    rare = replace(partition, dropped=(2,))
    assert rare.sentence(vehicle).endswith("; less than 1% goes 2 (below): no mode")


# ---- what is wrong with a task


class Rail(Field):
    """A field of which y alone is the chart."""

    start_low, start_high = (-1.0,), (1.0,)
    scene = replace(Field.scene, starts=((0.0,),), policy_starts=())
    set_point = np.zeros(1)

    def __init__(self, posts):
        super().__init__(posts)
        self.chart = Chart(("y",), ("m",), (-2.0,), (2.0,), (False,))
        self.noisy = (True, True)

    def state(self, z, rng=None):
        return np.hstack([0 * z, z]), None

    def z(self, measured):
        return measured[:, 1:]

    def with_z(self, measured, z):
        return np.hstack([measured[:, :1], z])


def looking(where, **attributes):
    """A field with one post whose places in the plane are `where(measured)`."""
    kind = type(
        "Looking", (Field,), {"where": lambda self, measured: where(measured), **attributes}
    )
    return kind(WIDE)


WRONG = {
    "no obstacle": (lambda: Field(), 'field.xml has no obstacle: .* "obstacle", or .*direction'),
    "one coordinate": (lambda: Rail(WIDE), r"chart has one coordinate \(y\).* a where\(measured\), or"),
    "a plane of one axis": (lambda: looking(lambda m: m, plane=(0, 0)), r"plane is \(0, 0\): give two"),
    "a plane of no axis": (lambda: looking(lambda m: m, plane=(0, 3)), r"plane is \(0, 3\): give two"),
    "one place": (lambda: looking(lambda m: 0 * m + 1.5), r"where\(\) puts all .* at one place, as \[1.5, 1"),
    "one line": (lambda: looking(lambda m: m[:, [1, 1]]), r"where\(\) puts all .* on a line"),
    "one column": (lambda: looking(lambda m: m * [1, 0]), r"where\(\) puts all .* on a line"),
    "three columns": (lambda: looking(lambda m: m[:, [0, 1, 1]]), r"where\(\) .*shape \(64, 3\)"),
    "no places": (lambda: looking(lambda m: m / 0), r"where\(\) gives \[.*inf"),
    "a name that is taken": (
        lambda: Field({"_a": (1, 0, 0.1), "a": (2, 0, 0.1)}), "2 obstacles of field have the name 'a'"
    ),
    "too many obstacles": (
        lambda: Field({f"_{k}": (k, 3, 0.1) for k in range(31)}), "31 obstacles, .* at most 30"
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_is_one_sentence(mistake):
    task, says = WRONG[mistake]
    with pytest.raises(BadInput, match=says) as refused:
        check_task(task())
    text = str(refused.value)
    assert text.startswith("the task of field cannot be used: ")
    assert "\n" not in text
    assert len(text) < 400


@pytest.mark.slow
def test_what_is_right_is_taken():
    for task in (Field(WIDE), Field(ROW), looking(lambda m: m + 0)):
        assert check_task(task) is task
    rail = type("Placed", (Rail,), {"where": lambda self, measured: measured})(WIDE)
    assert check_task(rail) is rail, "x is 0 at each start, and grows"
    way = {"direction": lambda self, path: np.where(path[-1, :, 0] > 0, 0, 1)}
    rail = type("Directed", (Rail,), way)(WIDE)
    rail.scene = replace(rail.scene, mode_names=("left", "right"))
    assert check_task(rail) is rail
