"""Scattered nodes stand for grids in charts of four to six dimensions: sets, stages, and their accuracy."""

from dataclasses import replace

import numpy as np
import pytest
from memory import Peak
from planted import Hall, hall_distance, hall_level, hall_policy, hall_slope

from hyrl_mj import BadInput, Chart, Noise, closed_loop
from hyrl_mj.policies import HybridController, PolicyController
from hyrl_mj.sets import Cloud, Grid, GridSet, coarseness, covering, distance_to, resolving
from hyrl_mj.simulation import LoopSettings
from hyrl_mj.stages import ExtendedSets, Partition, extend, find_critical_set, make_partition

EPS = 0.1
SHARES = np.array([1.0, 1, 1, 0, 0, 0])
BOX = Chart(tuple("abcefg"), ("m",) * 6, (-1.0,) * 6, (1.0,) * 6, (False,) * 6)
RING = Chart(
    ("x", "y", "z", "theta"), ("m",) * 3 + ("rad",), (-1.0,) * 4, (1.0,) * 4, (False,) * 3 + (True,)
)


def drawn(n, seed=0, chart=BOX):
    return np.random.default_rng(seed).uniform(chart.low, chart.high, (n, chart.dimension))


def on_surface(n, seed=0):
    """Points (k, 6) where the level of the hall is 0."""
    z = drawn(n, seed)
    z[:, 0] -= hall_level(z)
    return z[np.abs(z[:, 0]) <= 1]


def cloud_of(count):
    return Cloud.even(BOX, count // 2, SHARES).beside(
        on_surface(count // 4), count // 2, 3 * EPS * SHARES, EPS / 8
    )


def below(cloud):
    """The set below the curved level."""
    return GridSet.from_mask(cloud, hall_distance(cloud.nodes) <= 0)


@pytest.fixture(scope="module")
def half():
    return below(cloud_of(8_000))


@pytest.fixture(scope="module")
def close_by():
    z = drawn(40_000, 1)
    z = z[np.abs(hall_distance(z)) < 2 * EPS]
    return z, hall_distance(z)


# ---- sets


@pytest.mark.slow
def test_the_signed_distance_is_the_better_the_more_nodes(close_by):
    z, exact = close_by
    errors = []
    for count in (1_000, 4_000, 16_000):
        off = below(cloud_of(count)).signed_distance(z) - exact
        errors.append(np.sqrt(np.mean(off**2)))
    assert errors[0] > 1.2 * errors[1]
    assert errors[1] > 1.2 * errors[2]
    assert errors[2] < 0.15 * EPS


def test_the_edge_of_a_half_space_is_a_plane():
    normal = np.array([0.6, 0.0, 0.0, 0.8, 0.0, 0.0])
    points = drawn(3_000)
    points -= (points @ normal)[:, None] * normal
    inner = points[(np.abs(points) < 1).all(axis=1)]
    cloud = Cloud.even(BOX, 2_000, SHARES).beside(inner, 2_000, 3 * EPS * SHARES, EPS / 8)
    lower = GridSet.from_mask(cloud, cloud.nodes @ normal <= 0)
    z = drawn(5_000, 2) * 0.8
    z = z[np.abs(z @ normal) < EPS]
    np.testing.assert_allclose(lower.signed_distance(z), z @ normal, atol=0.25 * EPS)


def test_nodes_lie_on_their_own_side(half):
    np.testing.assert_array_equal(half.mask, hall_distance(half.grid.nodes) <= 0)
    np.testing.assert_array_equal(half.contains(half.grid.nodes), half.mask)


def test_values_that_are_linear_are_interpolated_exactly():
    cloud, slope = Cloud.even(BOX, 2_000, SHARES), np.array([1.0, -2, 0.5, 0, 3, 1])
    z = drawn(500, 3) * 0.9
    found = cloud.evaluation(cloud.nodes @ slope + 0.2)(z)
    np.testing.assert_allclose(found, z @ slope + 0.2, atol=5e-3)


def test_a_box_moves_the_edge_as_far_as_its_corners_reach(half, close_by):
    z, exact = close_by
    slope = np.abs(hall_slope(z))
    reach = EPS * slope @ SHARES / np.linalg.norm(slope, axis=1)
    for members, moved in (
        (half.dilated_by_box(EPS * SHARES), exact - reach),
        (half.eroded_by_box(EPS * SHARES), exact + reach),
    ):
        off = np.abs(members.signed_distance(z) - moved)
        assert np.quantile(off, 0.95) < 0.4 * EPS
    assert half.dilated_by_box(np.zeros(6)) is half


@pytest.mark.slow
def test_points_are_projected_along_noisy_coordinates(half, close_by):
    z, exact = close_by
    landed = half.project(z)
    inside = half.contains(z)
    np.testing.assert_array_equal(landed[inside], z[inside])
    assert (half.signed_distance(landed) <= half.grid.cell).all()
    same = (landed[:, 3:] == z[:, 3:]).all(axis=1)
    assert same.mean() > 0.98
    moved = np.linalg.norm(landed - z, axis=1)[same & ~inside]
    assert np.quantile(moved - exact[same & ~inside], 0.95) < 1.5 * EPS


def test_a_full_and_an_empty_set():
    cloud, z = Cloud.even(BOX, 500, SHARES), drawn(100)
    full = GridSet.from_mask(cloud, np.ones(cloud.size, dtype=bool))
    assert full.contains(z).all()
    assert not (~full).contains(z).any()
    assert full.share == 1


def test_a_period_has_no_seam():
    cloud = Cloud.even(RING, 4_000, np.ones(4))
    shape = np.abs(RING.difference(cloud.nodes, np.array([0, 0, 0, 1.0]))[:, 3]) <= 0.4
    around = GridSet.from_mask(cloud, shape)
    z = drawn(300, 4, RING) * np.array([0.5, 0.5, 0.5, 1])
    turned = z + np.array([0, 0, 0, 2.0])
    np.testing.assert_allclose(around.signed_distance(z), around.signed_distance(turned), atol=1e-9)
    away = np.abs(RING.difference(z, np.array([0, 0, 0, 1.0]))[:, 3])
    assert around.contains(z)[away < 0.3].all()
    assert not around.contains(z)[away > 0.5].any()


def test_the_scale_stretches_distances():
    wide = replace(BOX, high=(1.0,) * 5 + (9.0,), low=(-1.0,) * 5 + (-9.0,), scale=(1,) * 5 + (9,))
    unit, stretched = Cloud.even(BOX, 1_500, SHARES), Cloud.even(wide, 1_500, SHARES)
    turn = np.array([1.0] * 5 + [9.0])
    sets = [
        GridSet.from_mask(unit, unit.nodes[:, 5] <= 0),
        GridSet.from_mask(stretched, stretched.nodes[:, 5] <= 0),
    ]
    z = drawn(400, 5)
    np.testing.assert_allclose(
        sets[0].signed_distance(z), sets[1].signed_distance(z * turn), atol=1e-6
    )


def test_points_of_a_surface_are_joined_by_planes(close_by):
    z, exact = close_by
    points = on_surface(4_000)
    off = distance_to(BOX, points, z)
    plain = BOX.tree(points).query(BOX.in_box(z))[0]
    inner = (np.abs(z) < 0.8).all(axis=1)
    assert np.abs(off - np.abs(exact))[inner].mean() < 0.3 * EPS
    assert np.abs(plain - np.abs(exact))[inner].mean() > EPS
    assert (off <= plain + 1e-12).all()
    apart = np.linalg.norm(points[1] - points[0])
    np.testing.assert_allclose(distance_to(BOX, points[:1], points[1:2]), apart)


# ---- which nodes a chart gets


def test_six_dimensions_have_a_cloud_and_seven_a_sentence():
    assert isinstance(covering(BOX, 6), Cloud)
    seven = Chart(tuple("abcdefg"), ("m",) * 7, (0,) * 7, (1,) * 7, (False,) * 7)
    with pytest.raises(
        BadInput, match="a chart of 7 coordinates cannot be covered: give at most 6"
    ):
        covering(seven, 6)
    with pytest.raises(BadInput, match="40 cells make a cloud of 2,560,000 nodes: give at most 26"):
        covering(BOX, 40)


def test_two_dimensions_keep_square_cells():
    plane = Chart(("x", "y"), ("m",) * 2, (0, 0), (3, 1), (False,) * 2)
    noise = np.array([0, 0.01])
    assert resolving(plane, 30, np.zeros((3, 2)), noise) == Grid.with_cells(plane, 30)


def test_in_three_dimensions_cells_are_small_where_noise_acts():
    room = Chart(("x", "y", "v"), ("m", "m", "m/s"), (0, -1, -1), (2, 1, 1), (False,) * 3)
    noise, square = np.array([0, 0.1, 0]), Grid.with_cells(room, 30)
    grid = covering(room, 30, noise)
    assert grid.spacing[1] <= noise[1] / 2
    assert grid.size <= square.size
    assert (grid.spacing[[0, 2]] > square.spacing[[0, 2]]).all()
    assert covering(room, 60, noise).counts == Grid.with_cells(room, 60).counts


def test_cells_longer_than_the_noise_are_said():
    plane = Chart(("x", "y"), ("m",) * 2, (0, 0), (3, 1), (False,) * 2)
    sentence = coarseness(plane, 30, np.array([0, 0.04]))
    assert "0.04 m of noise on y (cells of 0.1)" in sentence
    assert "give more than 30 cells" in sentence
    assert coarseness(plane, 30, np.array([0, 0.1])) is None
    assert coarseness(plane, 30, np.zeros(2)) is None
    assert coarseness(BOX, 8, EPS * SHARES) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nodes": np.zeros((500, 5))}, "do not fit"),
        ({"nodes": np.zeros((7, 6))}, "7 nodes cannot be used"),
        ({"nodes": np.full((500, 6), np.nan)}, "finite"),
        ({"cell": 0.0}, "its cell > 0"),
        ({"shares": -SHARES}, "shares >= 0"),
    ],
)
def test_a_cloud_that_cannot_be_one_is_refused(change, message):
    with pytest.raises(BadInput, match=message):
        replace(Cloud.even(BOX, 500, SHARES), **change)


# ---- the stages on six dimensions


class Case:
    """The hall with its stages on a number of nodes."""

    def __init__(self, rods, cells):
        self.task = Hall()
        self.policy = hall_policy(self.task)
        self.critical = find_critical_set(self.task, self.policy, rods, 1 / 32, "outcome")
        points = self.critical.points
        self.partition = make_partition(self.task, self.policy, points, cells, EPS)
        self.extended = extend(self.task, self.policy, points, self.partition, EPS)

    def error(self, close_by):
        """The error of the boundary between the parts."""
        z, exact = close_by
        return np.sqrt(np.mean((self.partition.parts[0].signed_distance(z) + exact) ** 2))


@pytest.fixture(scope="module")
def case():
    return Case(7, 8)


@pytest.mark.slow
def test_the_critical_set_is_the_surface(case):
    assert case.critical.pieces == 1
    assert np.abs(hall_distance(case.critical.points)).max() <= case.critical.resolution * 2


@pytest.mark.slow
def test_the_parts_meet_at_the_surface(case, close_by):
    assert case.partition.modes == (0, 1)
    z, exact = close_by
    up, down = case.partition.parts
    clear = np.abs(exact) > 0.5 * EPS
    assert (up.contains(z) == (exact > 0))[clear].mean() > 0.985
    assert (down.contains(z) == (exact < 0))[clear].mean() > 0.985


@pytest.mark.slow
def test_the_extended_sets_hold_what_noise_can_reach_and_not_much_more(case):
    z = drawn(20_000, 6)
    distance = hall_distance(z)
    side = {0: -1, 1: 1}
    shift = np.random.default_rng(0).uniform(-EPS, EPS, z.shape) * SHARES
    for mode, members in zip(case.extended.modes, case.extended.sets, strict=True):
        depth = side[mode] * hall_distance(z + shift)
        held = members.contains(z)
        assert held[depth <= -0.2 * EPS].mean() > 0.995
        # Twice the noise and a sample along every noisy coordinate, at 45 degrees.
        assert held[side[mode] * distance > (2 * EPS + 0.05) * 1.75].mean() < 0.01


@pytest.mark.slow
def test_noise_does_not_make_the_hybrid_controller_chatter(case):
    task = case.task
    sets = dict(zip(case.extended.modes, case.extended.sets, strict=True))
    hybrid = HybridController(task, {0: hall_policy(task, 1.0), 1: hall_policy(task, -1.0)}, sets)
    z0 = drawn(20_000, 7)
    z0 = z0[np.abs(hall_distance(z0)) < EPS][:500]
    settings = LoopSettings(record=True)
    for kind in ("uniform", "alternating"):
        noise = Noise(kind, EPS)
        alone = closed_loop(task, PolicyController(case.policy), z0, noise, settings=settings)
        runs = closed_loop(task, hybrid, z0, noise, settings=settings)
        assert (runs.q != runs.before).sum(axis=0).max() <= 1
        assert (runs.q != runs.before).any(axis=0).mean() < 0.01
    reversals = (np.diff(np.sign(alone.u[:, :, 0]), axis=0) != 0).sum(axis=0)
    assert reversals.mean() > 3, "the policy alone dithers"


@pytest.mark.slow
def test_sets_on_scattered_nodes_survive_being_written(case, tmp_path):
    z = drawn(200, 8)
    for result, kind in ((case.partition, Partition), (case.extended, ExtendedSets)):
        result.save(tmp_path / "sets.npz")
        back = kind.load(tmp_path / "sets.npz", case.task)
        before, after = (getattr(r, "parts", None) or r.sets for r in (result, back))
        for a, b in zip(before, after, strict=True):
            np.testing.assert_array_equal(a.signed_distance(z), b.signed_distance(z))


@pytest.mark.slow
@pytest.mark.long
def test_errors_fall_with_the_nodes_within_the_memory(case, close_by):
    with Peak() as memory:
        fine = Case(11, 13)
    coarse_points, fine_points = (
        np.sqrt(np.mean(hall_distance(c.critical.points) ** 2)) for c in (case, fine)
    )
    assert fine_points < 0.8 * coarse_points
    assert fine.error(close_by) < 0.75 * case.error(close_by)
    assert memory.megabytes < 500
