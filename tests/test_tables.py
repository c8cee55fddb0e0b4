"""The summary's words for sets on a circle."""

from types import SimpleNamespace

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.viz.tables import extent, percent


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        (lambda a: (a > 0.25) & (a < 0.75), "0.251 pi to 0.749 pi"),
        (lambda a: (a > 1.75) | (a < 0.25), "1.751 pi to 0.249 pi"),
        (
            lambda a: (a > 1.75) | (a < 0.25) | ((a > 0.5) & (a < 0.9)),
            "0.501 pi to 0.899 pi, 1.751 pi to 0.249 pi",
        ),
        (lambda a: a >= 0, "everything"),
    ],
)
def test_extent_on_the_circle(inside, words):
    task = hyrl_mj.get_task("unit_circle")
    grid = Grid.with_cells(task.chart, 2000)
    members = GridSet.from_mask(grid, inside(grid.nodes[:, 0] / np.pi))
    run = SimpleNamespace(task=task, extended_sets=SimpleNamespace(modes=(0,), sets=(members,)))
    assert extent(run, 0) == f"extended set {words}"


@pytest.mark.parametrize(
    ("share", "words"),
    [(1.0, "100%"), (0.99999, ">99.99%"), (0.128, "12.80%"), (1e-5, "<0.01%"), (0.0, "0%")],
)
def test_only_what_is_everything_is_called_so(share, words):
    assert percent(share) == words
