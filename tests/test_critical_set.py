"""Both searches find planted critical sets in one to four dimensions, and nothing else."""

from functools import partial

import numpy as np
import pytest
from planted import (
    ChartPolicy,
    Cube,
    circle_policy,
    one_way_policy,
    plane_policy,
    sign_policy,
    sphere_policy,
    two_way_circle_policy,
)

from hyrl_mj import BadInput, CriticalSet, find_critical_set
from hyrl_mj.stages.meeting import ranges
from hyrl_mj.tasks import SEARCHES

PI = np.pi
NORMAL = np.array([2.0, -1.0, 2.0]) / 3
RESOLUTION = 1 / 32


@pytest.fixture(params=SEARCHES)
def search(request):
    """`find_critical_set` by each method."""
    return partial(find_critical_set, method=request.param)


def heights(z):
    return z @ NORMAL


def radii(z):
    return np.linalg.norm(z, axis=1)


# ---- one dimension


@pytest.mark.parametrize("angle", [2.345, PI])
def test_a_critical_angle_on_the_circle(search, circle, angle):
    critical = search(circle, circle_policy(circle, angle), 120, RESOLUTION)
    assert critical.pieces == 1
    assert np.abs(critical.points - angle).max() <= critical.resolution
    assert critical.resolution == pytest.approx(2 * PI / 120 / 32)


def test_two_critical_angles_are_two_pieces(search, circle):
    policy = two_way_circle_policy(circle, 2.0, 3.0, 4.0)
    critical = search(circle, policy, 120, RESOLUTION)
    assert critical.pieces == 2
    angles = sorted(critical.points[critical.component == k].mean() for k in range(2))
    assert angles == pytest.approx([2.0, 4.0], abs=critical.resolution)
    assert critical.sentence(circle).startswith("critical set of 2 pieces")


def test_the_range_of_an_angle_goes_the_short_way_round(circle):
    assert ranges(circle.chart, np.array([[6.2], [0.1], [0.0]]), 1e-3) == "theta 6.2 to 6.383 rad"
    everywhere = np.linspace(0, 2 * PI, 40, endpoint=False)[:, None]
    assert ranges(circle.chart, everywhere, 1e-3) == "theta 0 to 6.126 rad"


def test_a_continuous_policy_has_one_too(search, circle):
    policy = ChartPolicy(circle, lambda z: np.tanh(20 * (circle.chart.wrap(z) - PI)))
    critical = search(circle, policy, 120, RESOLUTION)
    assert critical.pieces == 1
    assert np.abs(critical.points - PI).max() <= 2 * critical.resolution


# ---- two dimensions


@pytest.mark.slow
def test_a_critical_line_before_the_obstacle(search, vehicle):
    critical = search(vehicle, sign_policy(vehicle), 60, RESOLUTION)
    x, y = critical.points.T
    assert np.abs(y).max() <= critical.resolution
    assert critical.pieces == 1
    assert x.min() == pytest.approx(0.0, abs=1e-9)
    assert np.diff(np.sort(x)).max() <= 1.01 * critical.spacing, "a gap"
    assert 0.4 <= x.max() <= 0.8


@pytest.mark.slow
def test_a_slanted_critical_line(search, vehicle):
    def line(x):
        return 0.1 - 0.4 * x

    errors = []
    for share in (1 / 2, 1 / 16):
        critical = search(vehicle, sign_policy(vehicle, line), 60, share)
        assert critical.pieces == 1
        errors.append(np.abs(critical.points[:, 1] - line(critical.points[:, 0])).max())
        assert errors[-1] <= critical.resolution
    assert errors[1] < errors[0] / 4


# ---- three dimensions and more


@pytest.mark.parametrize(
    ("d", "radius", "grids", "gain"),
    [
        (3, 0.6, ((10, 1 / 2), (10, 1 / 8)), 2),
        pytest.param(4, 0.8, ((4, 1 / 8), (6, 1 / 8)), 1, marks=pytest.mark.slow),
    ],
)
def test_a_critical_sphere(search, d, radius, grids, gain):
    ball, errors = Cube(radii, d), []
    for cells, share in grids:
        critical = search(ball, sphere_policy(ball, radius), cells, share)
        assert critical.pieces == 1
        errors.append(np.abs(radii(critical.points) - radius).max())
        assert errors[-1] <= min(critical.resolution, share * critical.spacing)
    assert errors[1] < errors[0] / gain


def test_two_critical_planes_are_two_pieces(search):
    cube = Cube(heights)
    policy = plane_policy(cube, NORMAL, lambda s: np.sign(s) * np.where(np.abs(s) < 0.6, -1.0, 1.0))
    critical = search(cube, policy, 12, 1 / 4)
    assert critical.pieces == 2
    for k in range(2):
        s = heights(critical.points[critical.component == k])
        assert np.abs(np.abs(s) - 0.6).max() <= critical.resolution
        assert len(set(np.sign(s))) == 1


# ---- both searches


def test_an_unknown_method_is_refused(circle):
    with pytest.raises(BadInput, match=r"'guess'.*rods, outcome"):
        find_critical_set(circle, circle_policy(circle), 60, RESOLUTION, "guess")


# ---- where there is none


def test_one_way_policies_have_none(search, circle, vehicle):
    clockwise = ChartPolicy(circle, lambda z: np.full((len(z), 1), -1.0))
    none = search(circle, clockwise, 120, RESOLUTION)
    assert (len(none.points), none.pieces) == (0, 0)
    assert "no critical set found at this resolution" in none.sentence(circle)
    assert none.points.shape == (0, 1)
    assert search(vehicle, one_way_policy(vehicle), 60, RESOLUTION).pieces == 0


@pytest.mark.parametrize("u", [-0.5, 0.0])
def test_the_edge_between_crash_and_no_crash_is_not_critical(search, vehicle, u):
    constant = ChartPolicy(vehicle, lambda z: np.full((len(z), 1), u))
    assert search(vehicle, constant, 60, RESOLUTION).pieces == 0


def test_a_set_point_is_not_critical(search, circle):
    target = 3.0
    policy = ChartPolicy(circle, lambda z: np.where(circle.chart.wrap(z) < target, 1.0, -1.0))
    critical = search(circle, policy, 120, RESOLUTION)
    assert (np.abs(critical.points - target) > 0.2).all()
    cube = Cube(radii)
    home = ChartPolicy(cube, lambda z: np.clip(-5 * z, -1, 1))
    assert search(cube, home, 10, 1 / 8).pieces == 0


def test_an_empty_result_can_be_saved(circle, tmp_path):
    CriticalSet(np.empty((0, 1)), np.zeros(0, dtype=int), 0.01, 0.3).save(tmp_path / "c.npz")
    back = CriticalSet.load(tmp_path / "c.npz")
    assert back.points.shape == (0, 1)
    assert "no critical set found" in back.sentence(circle)
