"""Figures and replays of runs with more than two modes, whose numbers have gaps and whose names are long."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from figure_parts import EPS
from junctions import NUMBERS, four_ways
from matplotlib.colors import to_rgb
from planted import AnalyticSet, ChartPolicy

import hyrl_mj
from hyrl_mj import ExtendedSets, HybridController, Noise, simulate
from hyrl_mj.sets import Everything, Grid, GridSet
from hyrl_mj.stages import CriticalSet, Partition
from hyrl_mj.viz import figures
from hyrl_mj.viz.colours import MODES, is_light, mode_colour
from hyrl_mj.viz.figures import runs, style
from hyrl_mj.viz.replay.captions import Layout
from hyrl_mj.viz.replay.panel import Track
from hyrl_mj.viz.section import Section

LONG = "right of the first, left of the second, left of the third"
MANY = (*NUMBERS, 32)


def test_the_colours_of_eight_modes_differ():
    assert MODES[:2] == ("#0072b2", "#d55e00")
    for a, b in combinations(range(8), 2):
        assert np.abs(np.subtract(to_rgb(MODES[a]), to_rgb(MODES[b]))).max() > 0.2
        assert mode_colour(a) != mode_colour(b)
        assert style.mode_tint(a) != style.mode_tint(b)


def test_words_on_a_plate_stand_out():
    assert [is_light(colour) for colour in ("#ffffff", "#f0c419", "#ddcc77")] == [True] * 3
    assert not any(is_light(colour) for colour in (*MODES[:2], "#882255", "#000000"))


# ---- figures


@pytest.fixture(scope="module")
def shown():
    """A junction of four ways, with names that are long; the fifth mode is the fourth again."""
    task = four_ways()
    task.mode_name = lambda mode: f"{mode} ({LONG})"
    modes = MANY
    grid = Grid.with_cells(task.chart, 40)
    parts = tuple(GridSet(grid, task.beyond(min(k, 3), grid.nodes)) for k in range(len(modes)))
    sets = tuple(part.dilated(2 * EPS) for part in parts)
    ways = [task.out[min(k, 3)] for k in range(len(modes))]
    policies = {
        q: ChartPolicy(task, lambda z, way=way: np.tile(way, (len(z), 1)))
        for q, way in zip(modes, ways, strict=True)
    }
    flow = {
        q: AnalyticSet(lambda z, k=k: task.beyond(min(k, 3), z, 2 * EPS))
        for k, q in enumerate(modes)
    }
    controller = HybridController(task, policies, flow)
    starts, noise = np.array([[0.05, 0.1], [-0.1, 0.02], [0.02, -0.1]]), Noise("alternating", EPS)
    arcs = {}
    loops = {"policy": (task.policy(), None)} | {f"hyrl_q{q}": (controller, q) for q in modes}
    for who, (loop, q) in loops.items():
        found = simulate(task, loop, starts, noise, q)
        arcs |= {(f"start{i}", who): arc for i, arc in enumerate(found)}
    quiet = tuple(simulate(task, task.policy(), starts))
    winning = (np.ones(grid.size, dtype=bool),) * len(modes)
    return SimpleNamespace(
        task=task,
        section=Section(task),
        algorithm="PPO",
        policy_title="RL policy (PPO)",
        policy=task.policy(),
        critical=CriticalSet(np.zeros((1, 2)), np.zeros(1, dtype=int), 0.01, 0.05),
        partition=Partition(modes, parts, winning[0]),
        noisy=arcs["start0", "policy"],
        noiseless=quiet,
        paper=tuple(arcs[f"start{i}", "policy"] for i in range(3)),
        sets=ExtendedSets(modes, sets, winning, 0.3, EPS, np.empty((0, 2)), np.empty(0)),
        replays=arcs,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["overview", "policy", "extended_sets", "runs"])
def test_words_do_not_lie_over_each_other(shown, name):
    figure = figures.FIGURES[name].draw(shown)
    figure.draw_without_rendering()
    words = [panel.title for panel in figure.axes if panel.axison]
    words += [text for panel in figure.axes for text in panel.texts] + figure.legends[0].get_texts()
    boxes = [text.get_window_extent() for text in words if text.get_text()]
    assert len(boxes) >= 6
    assert not [pair for pair in combinations(boxes, 2) if pair[0].overlaps(pair[1])]
    # No wider than a page: the legend, too.
    assert figure.legends[0].get_window_extent().width <= figure.bbox.width * 1.05


def test_each_start_mode_has_a_panel_and_each_mode_its_colour(shown):
    figure = figures.draw_runs(shown)
    modes = shown.sets.modes
    drawn = [panel for panel in figure.axes if panel.axison]
    assert [panel.get_title() for panel in drawn] == [f"started in q0 = {q}" for q in modes]
    for k, panel in enumerate(drawn):
        colours = {line.get_color() for line in panel.lines}
        assert mode_colour(k) in colours


def test_labels_are_sorted_by_the_numbers_in_them():
    labels = ["mode 14 (b)", "mode 3 (c)", "end", "mode 3 (a)"]
    in_order = ["end", "mode 3 (a)", "mode 3 (c)", "mode 14 (b)"]
    assert sorted(labels, key=style._in_order) == in_order


def test_a_way_with_any_side_in_it_belongs_to_the_modes_that_agree():
    gaps = hyrl_mj.get_task("gaps")
    modes = (0, 1, 3, 7)
    # Bit k: obstacle k on the right; bit 3 + k: on either side.
    for way, found in ((1, [1]), (8, [0, 1]), (8 + 2, [3]), (-1, list(modes)), (2, [])):
        assert runs.modes_of(gaps, modes, way) == found
    assert runs.modes_of(four_ways(), NUMBERS, 5) == []


# ---- captions


@pytest.fixture(scope="module")
def arcs():
    """Runs past three posts, one in each of the modes 0, 1, 3 and 7."""
    gaps = hyrl_mj.get_task("gaps")
    straight = ChartPolicy(gaps, lambda z: np.zeros((len(z), 1)))
    modes = (0, 1, 3, 7)
    loop = HybridController(
        gaps, dict.fromkeys(modes, straight), dict.fromkeys(modes, Everything())
    )
    start, noise = np.array([[0.0, 0.5]]), Noise("alternating", EPS)
    return {q: simulate(gaps, loop, start, noise, q)[0] for q in modes}


def test_captions_of_long_names_fit(arcs):
    arc, task = arcs[3], hyrl_mj.get_task("gaps")
    layout = Layout(480, 480)
    noise = layout.above("HyRL", arc)
    long = layout.above(f"HyRL, started in q = {task.mode_name(3)}", arc)
    # The noise at the right stands as it does beside a short title, with a gap before it.
    width = round(layout.fonts[1].getlength(f"alternating noise, eps = {EPS:g}"))
    np.testing.assert_array_equal(long[:, -width - 20 : -1], noise[:, -width - 20 : -1])
    np.testing.assert_array_equal(long, layout.above("HyRL, started in q = 3", arc))
    below = layout.below({"HyRL": [Track(task, arc, tuple(arcs))]}, 10.0)
    edge = below[:, -12:-2]
    assert (edge == edge[0, 0]).all(), "words end before the edge"


def test_tracks_take_the_colour_of_the_place_of_their_mode(arcs):
    for k, arc in enumerate(arcs.values()):
        assert Track(hyrl_mj.get_task("gaps"), arc, tuple(arcs)).colour(3) == MODES[k]
