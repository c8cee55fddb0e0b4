"""Sets on grids agree with shapes whose distance is known, the better the finer the grid."""

import numpy as np
import pytest
from drawn import grid_sets, points as drawn_points
from hypothesis import given, strategies as st

from hyrl_mj import BadInput, Chart
from hyrl_mj.sets import Complement, Everything, Grid, GridSet

PI = np.pi
LINE = Chart(("x",), ("m",), (-1.0,), (1.0,), (False,))
RING = Chart(("theta",), ("rad",), (0.0,), (2 * PI,), (True,))
PLANE = Chart(("x", "y"), ("m", "m"), (-1.0, -1.0), (2.0, 1.0), (False, False))
TUBE = Chart(("theta", "y"), ("rad", "m"), (0.0, -1.0), (2 * PI, 1.0), (True, False))

SLAB = Chart(
    ("x", "y", "theta"), ("m",) * 3, (-1.0, 0.0, -PI), (1.0, 3.0, PI), (False, False, True)
)


def interval(z):
    return np.maximum(-0.5 - z[:, 0], z[:, 0] - 0.3)


def disc(z):
    return np.linalg.norm(z - [0.4, 0.1], axis=1) - 0.6


def arc(z):
    """The arc of half-width 0.8 around 0.2: it runs over the seam at 0."""
    return np.abs(RING.difference(z, 0.2))[:, 0] - 0.8


def patch(z):
    """A disc on the tube, over its seam."""
    return np.linalg.norm(TUBE.difference(z, [0.1, 0.0]), axis=1) - 0.7


SHAPES = {
    "interval": (LINE, interval),
    "disc": (PLANE, disc),
    "arc": (RING, arc),
    "patch": (TUBE, patch),
}


def points(chart, n=4000, seed=0):
    return np.random.default_rng(seed).uniform(chart.low, chart.high, (n, chart.dimension))


def on_grid(chart, shape, cells):
    grid = Grid.with_cells(chart, cells)
    return GridSet.from_mask(grid, shape(grid.nodes) <= 0)


def worst_error(chart, shape, cells):
    """Largest error of the signed distance near the boundary."""
    z = points(chart)
    exact = shape(z)
    near = np.abs(exact) < 0.25
    return np.abs(on_grid(chart, shape, cells).signed_distance(z) - exact)[near].max()


@pytest.fixture(params=SHAPES.values(), ids=SHAPES.keys())
def case(request):
    return request.param


# ---- signed distance


def test_signed_distance_is_right_to_a_cell(case):
    chart, shape = case
    for cells in (20, 60, 240):
        assert worst_error(chart, shape, cells) <= 1.5 * Grid.with_cells(chart, cells).cell


def test_a_full_and_an_empty_set(case):
    chart, _ = case
    grid, z = Grid.with_cells(chart, 20), points(chart)
    full = GridSet.from_mask(grid, np.ones(len(grid.nodes), dtype=bool))
    empty = GridSet.from_mask(grid, np.zeros(len(grid.nodes), dtype=bool))
    assert full.contains(z).all()
    assert not empty.contains(z).any()
    assert full.eroded(0.5).contains(z).all()
    assert not empty.dilated(0.5).contains(z).any()


# ---- algebra


ANY_CHART = st.sampled_from([LINE, RING, PLANE, TUBE, SLAB])
TWO_SETS = ANY_CHART.flatmap(lambda c: st.tuples(grid_sets(c, 2), drawn_points(c)))


@given(TWO_SETS)
def test_union_intersection_complement(case):
    (left, right), _ = case
    nodes = left.grid.nodes
    a, b = left.values <= 0, right.values <= 0
    np.testing.assert_array_equal((left | right).mask, a | b)
    np.testing.assert_array_equal((left & right).mask, a & b)
    np.testing.assert_array_equal((~left).mask, ~a | (left.values == 0))
    np.testing.assert_array_equal((~(left | right)).values, (~left & ~right).values)
    np.testing.assert_allclose(left.signed_distance(nodes), left.values, atol=1e-12)


@given(TWO_SETS)
def test_between_nodes_a_union_is_no_smaller_and_an_intersection_no_larger(case):
    (left, right), z = case
    a, b = left.signed_distance(z), right.signed_distance(z)
    assert ((left | right).signed_distance(z) <= np.minimum(a, b) + 1e-12).all()
    assert ((left & right).signed_distance(z) >= np.maximum(a, b) - 1e-12).all()
    np.testing.assert_allclose((~left).signed_distance(z), -a, atol=1e-12)


def test_dilation_and_erosion_move_the_boundary_by_their_amount():
    whole = on_grid(PLANE, disc, 150)
    z = np.array([[0.4 + 0.6 + dx, 0.1] for dx in (-0.25, -0.15, 0.15, 0.25)])
    np.testing.assert_array_equal(whole.dilated(0.2).contains(z), [True, True, True, False])
    np.testing.assert_array_equal(whole.eroded(0.2).contains(z), [True, False, False, False])


def test_complement_shares_the_boundary_and_nothing_else():
    grid = Grid.with_cells(LINE, 4)
    whole = GridSet(grid, np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))
    z = np.array([[-0.5], [0.0], [0.5]])
    np.testing.assert_array_equal(whole.contains(z), [True, True, False])
    np.testing.assert_array_equal(Complement(whole).contains(z), [False, True, True])
    np.testing.assert_array_equal(Complement(whole).signed_distance(z), [0.5, 0.0, -0.5])


def test_everything():
    z = points(PLANE)
    assert Everything().contains(z).all()
    assert (Everything().signed_distance(z) < -1e9).all()
    assert not Complement(Everything()).contains(z).any()


# ---- grids


def test_cells_are_square_and_periods_have_no_double_node():
    grid = Grid.with_cells(PLANE, 30)
    assert grid.counts == (31, 21)
    np.testing.assert_allclose(grid.spacing, [0.1, 0.1])
    ring = Grid.with_cells(RING, 8)
    np.testing.assert_allclose(ring.nodes[:, 0], np.arange(8) * PI / 4)
    assert Grid.with_cells(TUBE, 60).counts == (60, 20)


def test_the_scale_makes_cells_square_and_decides_what_is_nearest():
    chart = Chart(("x", "v"), ("m", "m/s"), (0, 0), (1, 4), (False, False), scale=(1, 4))
    grid = Grid.with_cells(chart, 10)
    assert grid.counts == (11, 11)
    lower = GridSet.from_mask(grid, grid.nodes @ [1, -0.25] <= 1e-9)  # x <= v / 4
    outside = np.array([[0.8, 1.6]])
    # At 45 degrees in scaled units, to a cell.
    assert lower.signed_distance(outside) == pytest.approx(0.4 / np.sqrt(2), abs=0.1)
    np.testing.assert_allclose(lower.project(outside), [[0.6, 2.4]], atol=0.11)
    np.testing.assert_allclose(lower.dilated_by_box(np.array([0.2, 0])).values[0], -0.2, atol=0.1)


def test_the_edge_lies_half_way_between_nodes_of_long_cells():
    room = Chart(("x", "y"), ("m", "m"), (0, 0), (1, 1), (False, False))
    grid = Grid(room, (3, 41))
    for axis, middle in ((0, 0.25), (1, 0.4875)):
        part = GridSet.from_mask(grid, grid.nodes[:, axis] <= middle)
        z = np.full((2, 2), 0.5)
        z[:, axis] = middle - 1e-3, middle + 1e-3
        np.testing.assert_array_equal(part.contains(z), [True, False])


def interpolated_in_turn(whole, point):
    """The value of a set at one point (d,), by `np.interp` along one coordinate after the other."""
    grid, table = whole.grid, whole.values.reshape(whole.grid.counts)
    for i, x in enumerate(grid.chart.wrap(point[None])[0]):
        if grid.chart.periodic[i]:
            table = np.concatenate([table, table[:1]])
        at = np.linspace(grid.chart.low[i], grid.chart.high[i], len(table))
        table = np.apply_along_axis(lambda line, x=x, at=at: np.interp(x, at, line), 0, table)
    return table


@given(TWO_SETS)
def test_interpolation_is_that_of_each_coordinate_in_turn(case):
    (whole, _), z = case
    exact = [interpolated_in_turn(whole, point) for point in z]
    np.testing.assert_allclose(whole.signed_distance(z), exact, atol=1e-9)


@given(TWO_SETS)
def test_a_point_alone_gives_what_it_gives_among_many(case):
    (whole, _), z = case
    np.testing.assert_array_equal(
        whole.signed_distance(z), [whole.signed_distance(point[None])[0] for point in z]
    )


@given(TWO_SETS)
def test_the_nearest_node_is_the_nearest(case):
    (whole, _), z = case
    chart, grid = whole.grid.chart, whole.grid
    distance = np.linalg.norm(chart.difference(z[:, None], grid.nodes[None]), axis=2)
    chosen = distance[np.arange(len(z)), grid.nearest(z)]
    np.testing.assert_allclose(chosen, distance.min(axis=1), atol=1e-9)


def test_numbers_that_do_not_fit_a_grid_are_refused():
    with pytest.raises(BadInput, match="2 dimensions"):
        Grid.from_counts(LINE, np.array([3, 3]))
    with pytest.raises(BadInput, match=r"\(5,\).*3 nodes"):
        GridSet(Grid(LINE, (3,)), np.zeros(5))
    with pytest.raises(BadInput, match="finite"):
        GridSet(Grid(LINE, (3,)), np.full(3, np.nan))


@pytest.mark.parametrize("z", [np.zeros((3, 4)), np.zeros(2), np.zeros((3, 1))])
def test_points_with_other_coordinates_than_those_of_the_chart_are_refused(z):
    grid = Grid.with_cells(Chart(("x", "y"), ("m", "m"), (0, 0), (1, 1), (False, False)), 4)
    inside = GridSet.from_mask(grid, grid.nodes[:, 0] > 0.5)
    with pytest.raises(
        BadInput, match=r"have shape \(n, 2\), x, y, got .*: of measurements task\.z"
    ):
        inside.contains(z)


def test_the_values_of_a_set_are_frozen():
    whole = on_grid(LINE, interval, 20)
    with pytest.raises(ValueError, match="read-only"):
        whole.values[0] = 1.0


# ---- projection


def test_projection_leaves_inner_points_and_finds_the_nearest_for_others(case):
    chart, shape = case
    whole, z = on_grid(chart, shape, 60), points(chart, 500)
    projected = whole.project(z)
    inside = whole.contains(z)
    np.testing.assert_array_equal(projected[inside], z[inside])
    assert whole.contains(projected).all()
    nodes = whole.grid.nodes[whole.mask]
    brute = np.linalg.norm(chart.difference(z[:, None], nodes[None]), axis=2).min(axis=1)
    ours = np.linalg.norm(chart.difference(z, projected), axis=1)
    # The nearest to the node nearest to z: off by half a cell's diagonal, there and back.
    slack = np.linalg.norm(whole.grid.spacing)
    assert (ours[~inside] <= brute[~inside] + slack + 1e-9).all()


def test_projection_onto_an_empty_set_leaves_points_where_they_are():
    grid = Grid.with_cells(LINE, 10)
    empty, z = GridSet.from_mask(grid, np.zeros(11, dtype=bool)), points(LINE, 5)
    np.testing.assert_array_equal(empty.project(z), z)


# ---- boxes, for noise


def test_a_box_dilates_along_its_sides_only():
    grid = Grid.with_cells(PLANE, 120)
    square = GridSet.from_mask(grid, (np.abs(grid.nodes) <= 0.25 + 1e-9).all(axis=1))
    wide = square.dilated_by_box(np.array([0.0, 0.2]))
    inside = (np.abs(grid.nodes[:, 0]) <= 0.25 + 1e-9) & (np.abs(grid.nodes[:, 1]) <= 0.45 + 1e-9)
    np.testing.assert_array_equal(wide.mask, inside)
    np.testing.assert_array_equal(wide.eroded_by_box(np.array([0.0, 0.2])).mask, square.mask)
    assert square.dilated_by_box(np.zeros(2)) is square


def test_a_box_goes_round_a_periodic_coordinate():
    grid = Grid.with_cells(RING, 360)
    half = np.array([0.3])
    arc_set = GridSet.from_mask(grid, arc(grid.nodes) <= 0)
    theta = RING.difference(grid.nodes, np.array([0.2]))[:, 0]
    np.testing.assert_array_equal(
        arc_set.dilated_by_box(half).mask,  # 17.2 cells are 18
        np.abs(theta) <= 0.8 + 18 * grid.cell - grid.cell / 8,
    )


def test_a_box_may_be_wider_than_half_the_chart():
    grid = Grid.with_cells(LINE, 10)
    corner = GridSet.from_mask(grid, grid.nodes[:, 0] <= -1 + 1e-9)
    wide = corner.dilated_by_box(np.array([1.6]))
    np.testing.assert_array_equal(wide.mask, grid.nodes[:, 0] <= 0.6 + 1e-9)


def test_what_lies_off_the_chart_does_not_erode():
    grid = Grid.with_cells(LINE, 100)
    whole = GridSet.from_mask(grid, grid.nodes[:, 0] >= 0)
    eroded = whole.eroded_by_box(np.array([0.2]))
    np.testing.assert_array_equal(eroded.mask, grid.nodes[:, 0] >= 0.2 - 1e-9)


def test_pieces_of_a_set_in_one_dimension():
    ring, row = Grid(RING, (8,)), Grid(Chart(("x",), ("m",), (0.0,), (9.0,), (False,)), (10,))
    eighth = PI / 4

    def pieces(grid, *inside):
        mask = np.isin(np.arange(len(grid.nodes)), inside)
        return GridSet.from_mask(grid, mask).pieces()

    assert pieces(ring, 7, 0, 1, 4) == [(4 * eighth, 4 * eighth), (7 * eighth, eighth)]
    assert pieces(ring, *range(8)) == [(0.0, 7 * eighth)]
    assert pieces(ring) == pieces(row) == []
    assert pieces(row, 0, 1, 4, 8, 9) == [(0.0, 1.0), (4.0, 4.0), (8.0, 9.0)]
