"""A chart knows which points are the same, and how far apart two are, on circles and off them."""

from dataclasses import replace

import numpy as np
import pytest
from drawn import points
from hypothesis import given, strategies as st

from hyrl_mj import Chart

PI = np.pi
CHARTS = {
    "line": Chart(("x",), ("m",), (-1.0,), (1.0,), (False,)),
    "ring": Chart(("theta",), ("rad",), (0.0,), (2 * PI,), (True,)),
    "tube": Chart(("theta", "y"), ("rad", "m"), (-PI, -1.0), (PI, 2.0), (True, False)),
    "scaled": Chart(
        ("theta", "y"), ("rad", "m"), (-PI, -1.0), (PI, 2.0), (True, False), scale=(0.5, 3)
    ),
}
BOTH = st.sampled_from(list(CHARTS.values())).flatmap(
    lambda chart: st.tuples(st.just(chart), points(chart), points(chart))
)


@given(BOTH)
def test_a_wrapped_point_is_the_same_point_inside_the_period(case):
    chart, z, _ = case
    wrapped, periodic = chart.wrap(z), np.array(chart.periodic)
    assert (wrapped >= chart.low)[:, periodic].all()
    assert (wrapped < chart.high)[:, periodic].all()
    turns = (wrapped - z) / chart.sides
    np.testing.assert_allclose(turns, np.where(periodic, np.round(turns), 0), atol=1e-9)
    np.testing.assert_allclose(chart.wrap(wrapped), wrapped, atol=1e-12)


@given(BOTH)
def test_a_difference_leads_from_one_point_to_the_other_the_short_way(case):
    chart, a, b = case
    a, b = a[: len(b)], b[: len(a)]
    delta = chart.difference(a, b)
    turns = (b + delta - a) / chart.sides
    np.testing.assert_allclose(turns, np.where(chart.periodic, np.round(turns), 0), atol=1e-9)
    assert (np.abs(delta) <= np.where(chart.periodic, chart.sides / 2 + 1e-9, np.inf)).all()


@given(BOTH)
def test_its_search_tree_measures_the_short_way(case):
    chart, a, b = case
    distance, _ = chart.tree(a).query(chart.in_box(b))
    plain = np.linalg.norm(chart.difference(b[:, None], a[None]) / chart.scale, axis=2).min(axis=1)
    np.testing.assert_allclose(distance, plain, atol=1e-9)


@given(BOTH)
def test_a_periodic_coordinate_contains_every_angle(case):
    chart, z, _ = case
    inside = ((z >= chart.low) & (z <= chart.high))[:, ~np.array(chart.periodic)].all(axis=1)
    np.testing.assert_array_equal(chart.contains(z), inside)


def test_distances_are_between_points_divided_by_the_scale():
    chart = CHARTS["scaled"]
    a, b = np.array([[PI - 0.1, 0.0], [0.0, 0.0]]), np.array([[0.1 - PI, 0.0], [0.0, 1.5]])
    np.testing.assert_allclose(chart.distance(a, b), [0.4, 0.5])
    assert CHARTS["tube"].scale == (1.0, 1.0)


@pytest.mark.parametrize(
    ("scale", "unit"), [((), "rad, m"), ((0.5, 1), "m"), ((0.5, 2), "scaled units")]
)
def test_distances_have_the_unit_of_what_is_not_scaled(scale, unit):
    assert replace(CHARTS["tube"], scale=scale).unit == unit


def test_a_point_is_named_with_its_units():
    assert CHARTS["tube"].format(np.array([0.5, -0.123456])) == "theta = 0.5 rad, y = -0.1235 m"


@pytest.mark.parametrize("angle", [-1e-300, -1e-17, 2 * PI, -2 * PI, np.nextafter(2 * PI, 0)])
def test_a_tiny_angle_below_the_seam_is_not_the_end_of_the_period(angle):
    assert 0 <= CHARTS["ring"].wrap(np.array([[angle]]))[0, 0] < 2 * PI


def test_points_are_brought_next_to_others_by_whole_periods():
    chart = Chart(("x", "a"), ("m", "rad"), (0.0, -np.pi), (1.0, np.pi), (False, True))
    z = np.array([[0.3, 3.1], [0.3, -3.1], [7.0, 0.5]])
    to = np.array([[0.0, 3.0], [0.0, 9.4], [0.0, -25.0]])
    near = chart.near(z, to)
    np.testing.assert_array_equal(near[:, 0], z[:, 0])
    np.testing.assert_allclose(near[:, 1], [3.1, -3.1 + 4 * np.pi, 0.5 - 8 * np.pi])
    assert near[0, 1] == z[0, 1], "a point that is near stays the same to the bit"


def test_arrays_and_lists_are_taken_as_tuples():
    given = Chart(["theta"], ["rad"], np.zeros(1), np.array([2 * PI]), np.array([True]))
    assert given == CHARTS["ring"]
    assert hash(given) == hash(CHARTS["ring"])
