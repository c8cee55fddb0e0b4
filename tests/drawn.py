"""Hypothesis strategies: points of a chart and beyond it, and sets with any values at their nodes."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hyrl_mj.sets import Grid, GridSet


def points(chart, most=8):
    """Points (n, d), 1 <= n <= `most`: in the chart, on its ends, and up to three sides beyond them."""
    sides = np.subtract(chart.high, chart.low)
    low, high = chart.low - 3 * sides, chart.high + 3 * sides
    columns = [
        st.sampled_from([float(a), float(b), 0.0]) | st.floats(x, y)
        for a, b, x, y in zip(chart.low, chart.high, low, high, strict=True)
    ]
    return st.lists(st.tuples(*columns), min_size=1, max_size=most).map(np.array)


@st.composite
def grid_sets(draw, chart, count=1):
    """`count` sets on one coarse grid (a tuple), with any signed distances, many of them 0."""
    grid = Grid(chart, tuple(draw(st.integers(2, 6)) for _ in chart.names))
    values = arrays(float, int(np.prod(grid.counts)), elements=st.just(0.0) | st.floats(-2, 2))
    return tuple(GridSet(grid, draw(values)) for _ in range(count))
