"""The paper's figures: what is in them, by matplotlib's own objects, and what is written."""

from __future__ import annotations

import re
from base64 import b64decode
from copy import copy
from dataclasses import replace
from html import unescape
from types import SimpleNamespace

import numpy as np
import pytest
from figure_parts import (
    EPS,
    arcs_of,
    controller_of,
    policy_of,
    sets_of,
    shown_of,
    where,
    written,
)  # fmt: skip
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Wedge
from matplotlib.path import Path as Outline
from matplotlib.quiver import Quiver
from planted import Cube, decisions, extended, plane_policy, without_pictures

import hyrl_mj
from hyrl_mj import BadInput, HybridController, Outcome, Scene, simulate
from hyrl_mj.sets import Everything, Grid, GridSet
from hyrl_mj.stages.partition import Partition
from hyrl_mj.viz import colours, figures
from hyrl_mj.viz.figures import charts, runs, style
from hyrl_mj.viz.figures.vector_field import vector_field
from hyrl_mj.viz.pages import pictures
from hyrl_mj.viz.section import Section

CIRCLE, VEHICLE = hyrl_mj.get_task("unit_circle"), hyrl_mj.get_task("vehicle")
ARCS = {task.name: arcs_of(task) for task in (CIRCLE, VEHICLE)}
TASKS = pytest.mark.parametrize("task", [CIRCLE, VEHICLE], ids=lambda task: task.name)
NONE = hyrl_mj.CriticalSet(np.empty((0, 2)), np.zeros(0, dtype=int), 0.01, 0.1)


SHOWN = {task.name: shown_of(task, ARCS[task.name]) for task in (CIRCLE, VEHICLE)}
NAMES = figures.names(VEHICLE, "policy", "controller")
OURS = ("overview", "policy", "extended_sets", "runs")
EVERY_FIGURE = pytest.mark.parametrize("name", NAMES)


def draw(name, task, path=None, /, **changes):
    """Draws a figure of the planted run, with some of what it shows replaced."""
    shown = copy(SHOWN[task.name])
    vars(shown).update(changes)
    return written(figures.FIGURES[name].draw(shown), path)


def lines_of(panel, colour, style="-"):
    """The data (N, 2) of the lines of a colour in a panel."""
    return [
        np.transpose(line.get_data())
        for line in panel.lines
        if to_hex(line.get_color()) == colour and line.get_linestyle() == style
    ]


def marks_of(panel, marker, colour):
    """Where (k, 2) there are markers of a shape and colour in a panel."""
    found = [
        np.transpose(line.get_data())
        for line in panel.lines
        if line.get_marker() == marker and to_hex(line.get_color()) == colour
    ]
    return np.concatenate(found) if found else np.empty((0, 2))


def filled(panel, colour):
    """The outlines of all fields of a colour in a panel."""
    return [
        outline
        for part in panel.collections
        for outline in part.get_paths()
        if len(part.get_facecolor()) and to_hex(part.get_facecolor()[0]) == colour
    ]


def inside(outlines: list[Outline], *points):
    """Whether points lie in the outlines; in an even number of them is outside."""
    loops = [loop for outline in outlines for loop in outline.to_polygons()]
    return [bool(sum(Outline(loop).contains_point(p) for loop in loops) % 2) for p in points]


# ---- all of them


@pytest.mark.first(3)
@TASKS
@EVERY_FIGURE
@pytest.mark.slow
def test_it_is_written_as_png_and_as_pdf_of_one_page(tmp_path, monkeypatch, task, name):
    monkeypatch.setattr(style, "DPI", 80)
    path = tmp_path / "figures" / f"{name}.png"
    draw(name, task, path)
    assert sorted(p.name for p in path.parent.iterdir()) == [f"{name}.pdf", f"{name}.png"]
    pdf = path.with_suffix(".pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert len(re.findall(rb"/Type /Page\b", pdf)) == 1
    for mode in (0, 1) if name in OURS else ():
        colour = colours.mode_colour(mode)
        if name == "extended_sets" and task is VEHICLE:
            colour = style.mode_tint(mode)
        assert len(where(path, colour)) > 20, "each mode is there in its colour"
    if name == "overview":
        draw(name, task, path)
        assert path.with_suffix(".pdf").read_bytes() == pdf, "the same picture is the same file"


@TASKS
@EVERY_FIGURE
def test_its_axes_have_labels_with_units_and_its_legend_hides_nothing(task, name):
    figure = draw(name, task)
    assert style.task_title(task) in figure.get_suptitle()
    assert figure.legends
    assert not any(panel.get_legend() for panel in figure.axes)
    figure.draw_without_rendering()
    unit = re.compile(r"\[(m|s|rad|m/s|rad/s)\]")
    for panel in figure.axes:
        labels = [panel.get_xlabel(), panel.get_ylabel()] + [t.get_text() for t in panel.texts]
        beside = panel.axison and name == "runs" and panel is not figure.axes[0]
        bar = panel.get_label() == "<colorbar>"
        wanted = 1 if beside or bar or not panel.axison else 2
        assert sum(bool(unit.search(label)) for label in labels) >= wanted, labels
    box = figure.legends[0].get_window_extent()
    panels = [panel.get_window_extent() for panel in figure.axes]
    assert not any(box.overlaps(panel) for panel in panels)


@TASKS
def test_the_overview_names_parts_and_end_in_the_picture(task):
    figure = draw("overview", task)
    assert len(figure.legends[0].get_texts()) <= 6
    words = [text.get_text().replace("\n", " ") for text in figure.axes[0].texts]
    for mode in (0, 1):
        assert f"{style.set_label(mode)}, mode {task.mode_name(mode)}" in words
    assert SHOWN[task.name].noisy.outcome.replace("_", " ") in words


@TASKS
@EVERY_FIGURE
def test_a_run_without_a_critical_set_is_drawn(task, name):
    points = np.empty((0, task.chart.dimension))
    figure = draw(name, task, critical=replace(NONE, points=points))
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "critical set M*" not in words


@pytest.mark.parametrize("fails", [1, 2])
def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch, fails):
    written = []

    def savefig(self, content, **_):
        written.append(content)
        content.write(b"half")
        if len(written) == fails:
            raise OSError("no space left on device")

    monkeypatch.setattr(Figure, "savefig", savefig)
    with pytest.raises(BadInput, match=r"cannot be written \(no space"):
        draw("runs", CIRCLE, tmp_path / "runs.png")
    assert len(written) == fails
    assert list(tmp_path.iterdir()) == []


def test_every_figure_is_of_one_kind_and_has_a_caption():
    policy, controller, game = (
        figures.names(VEHICLE, kind) for kind in ("policy", "controller", "game")
    )
    assert sorted([*policy, *controller, *game]) == sorted(figures.FIGURES)
    assert all(entry.caption.endswith(".") for entry in figures.FIGURES.values())


@pytest.mark.slow
def test_a_new_figure_is_an_entry(tmp_path, monkeypatch):
    without_pictures(monkeypatch)

    def draw_title(shown):
        with style.drawing(1.0, shown.task, shown.policy_title) as figure:
            return figure

    monkeypatch.setitem(figures.FIGURES, "title", figures.Entry(draw_title, "policy", "The title."))
    drawn = figures.draw_all(SHOWN["vehicle"], tmp_path, "policy", "controller")
    assert drawn == (*NAMES, "title")
    assert {path.stem for path in tmp_path.iterdir()} == {*NAMES, "title"}
    assert [picture.caption for picture in pictures(tmp_path)][-1] == "The title."


def test_of_one_coordinate_that_is_not_periodic_only_the_runs_are_drawn():
    class Line(type(CIRCLE)):
        chart = hyrl_mj.Chart(("a",), ("m",), (0.0,), (1.0,), (False,))

    assert figures.names(Line(), "policy", "controller") == ("runs",)
    for name in ("overview", "policy", "extended_sets"):
        with pytest.raises(BadInput, match="one coordinate, a, which is not periodic"):
            draw(name, CIRCLE, task=Line())


# ---- overview


def test_overview_of_a_plane():
    figure = draw("overview", VEHICLE)
    panel, noisy = figure.axes[0], ARCS["vehicle"]["critical", "policy"]
    for mode, side in ((0, 1), (1, -1)):
        ways = lines_of(panel, colours.mode_colour(mode))
        assert len(ways) == 6
        assert all((side * way[way[:, 0] > 1.2][:, 1] > 0.75).all() for way in ways)
        assert inside(filled(panel, style.mode_tint(mode)), (0.5, side), (0.5, -side)) == [
            True,
            False,
        ]
    (path,) = [way for way in lines_of(panel, colours.POLICY) if len(way) == len(noisy.z)]
    np.testing.assert_allclose(path, noisy.z, atol=1e-9)
    np.testing.assert_allclose(marks_of(panel, "x", colours.BAD), noisy.z[-1:])
    np.testing.assert_allclose(marks_of(panel, "+", colours.GOOD), [VEHICLE.set_point])
    np.testing.assert_allclose(marks_of(panel, "o", colours.INK), decisions(VEHICLE).points)
    np.testing.assert_allclose(marks_of(panel, ".", colours.BAD), noisy.measured[:-1])


def test_the_band_is_all_that_can_be_observed():
    figure = draw("overview", VEHICLE)
    band = filled(figure.axes[0], colours.OBSERVED)
    z = ARCS["vehicle"]["critical", "policy"].z
    for y, held in ((-1.02, False), (-0.98, True), (0.0, True), (0.98, True), (1.02, False)):
        shift = np.array([0.0, y * EPS])
        middle = (z[1:] + z[:-1]) / 2 + shift
        assert all(any(part.contains_point(p) for part in band) == held for p in middle)


def test_overview_of_a_ring():
    figure = draw("overview", CIRCLE)
    panel, noisy = figure.axes[0], ARCS["unit_circle"]["critical", "policy"]
    for mode, side in ((0, 1), (1, -1)):
        ways = lines_of(panel, colours.mode_colour(mode))
        assert ways
        assert all((side * way[:, 1] > -0.02).all() for way in ways)
        assert all(np.isclose(np.linalg.norm(way[0]), runs.CORE) for way in ways)
    (spiral,) = [way for way in lines_of(panel, colours.POLICY) if len(way) == len(noisy.z)]
    radius = runs.CORE + (1 - runs.CORE) * noisy.t / CIRCLE.scene.time
    np.testing.assert_allclose(np.linalg.norm(spiral, axis=1), radius)
    np.testing.assert_allclose(spiral[:, 0] / radius, np.cos(noisy.z[:, 0]), atol=1e-12)
    np.testing.assert_allclose(marks_of(panel, "x", colours.BAD), [[-1, 0]], atol=0.02)
    np.testing.assert_allclose(marks_of(panel, "+", colours.GOOD), [[1, 0]], atol=1e-9)


# ---- policy


def test_policy_of_a_plane():
    figure = draw("policy", VEHICLE)
    image, beside, bar = figure.axes
    values = np.asarray(image.images[0].get_array())
    height = np.linspace(-1.5, 1.5, len(values))
    assert (values[(height > 0.02) & (height < 0.88)] == 1).all()
    assert (values[(height < -0.02) & (height > -0.88)] == -1).all()
    assert (values[height > 0.92] == 0).all()
    np.testing.assert_allclose(bar.get_yticks(), [-1, -0.5, 0, 0.5, 1])
    assert bar.get_ylabel() == "lateral velocity [m/s]"
    np.testing.assert_allclose(marks_of(image, "o", colours.BAD), decisions(VEHICLE).points)
    circles = [line for line in beside.lines if line.get_marker() == "o"]
    found = sorted(tuple(np.ravel(line.get_data())) for line in circles)
    assert found == sorted(VEHICLE.scene.policy_starts)
    assert len(marks_of(beside, "x", colours.BAD)) == 1
    # The planted policy passes the pillar and goes straight on.
    assert len(marks_of(beside, "x", colours.PALE)) == 2
    ((*_, last),) = lines_of(beside, colours.POLICY)
    assert VEHICLE.clearance(last) == 0


def test_policy_of_a_ring():
    figure = draw("policy", CIRCLE)
    ring, beside, bar = figure.axes
    low, high = (to_hex(bar.collections[-1].cmap(x)) for x in (0.0, 1.0))
    wedges = [patch for patch in ring.patches if isinstance(patch, Wedge)]
    for angle, colour in ((90, low), (179, low), (181, high), (270, high)):
        at = [w for w in wedges if (angle - w.theta1) % 360 < (w.theta2 - w.theta1) % 360.001]
        assert [to_hex(w.get_facecolor()) for w in at] == [colour]
    assert bar.get_ylabel() == "turn rate [rad/s]"
    (spoke,) = lines_of(ring, colours.BAD)
    assert (spoke[:, 0] < 0).all()
    np.testing.assert_allclose(spoke[:, 1], 0, atol=1e-9)
    ends = [line.get_xdata()[0] for line in beside.lines if line.get_marker() == "x"]
    assert ends == [pytest.approx(4.0)] * 3
    np.testing.assert_allclose(marks_of(beside, "x", colours.BAD), [[4, np.pi]], atol=EPS)


def test_the_papers_starts_of_the_policy():
    angles = np.array(CIRCLE.scene.policy_starts)[:, 0]
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    np.testing.assert_allclose(points, [(-0.81, 0.59), (-0.95, -0.31), (-1, 0)], atol=5e-3)
    assert set(VEHICLE.scene.policy_starts) == {(0.0, 0.15), (0.0, 0.0), (0.0, -0.15)}


# ---- extended sets


def test_extended_sets_of_a_plane():
    figure = draw("extended_sets", VEHICLE)
    whole, near = figure.axes
    shared = filled(whole, colours.OVERLAP)
    at = ((0.3, 0.0), (0.3, 0.18), (0.3, -0.18), (0.3, 0.22), (0.3, -0.22), (2.5, 1.0))
    assert inside(shared, *at) == [True, True, True, False, False, True]
    for mode, side in ((0, 1), (1, -1)):
        tint = filled(whole, style.mode_tint(mode))
        assert inside(tint, (0.3, 0.5 * side), (0.3, -0.5 * side)) == [True, False]
    (room,) = lines_of(near, colours.BAD)
    assert np.ptp(room[:, 1]) == pytest.approx(2 * EPS)
    assert near.get_ylim() == pytest.approx((-0.4, 0.4))


@pytest.mark.parametrize("share", [0.5, 0.0])
def test_noise_is_drawn_as_wide_as_its_share_of_the_bound(share):
    task = VEHICLE.with_noise((0.0, share))
    near = figures.draw_extended_sets(shown_of(task, arcs_of(task))).axes[1]
    rooms = lines_of(near, colours.BAD)
    assert len(rooms) == (share > 0)
    for room in rooms:
        assert np.ptp(room[:, 1]) == pytest.approx(2 * share * EPS)


def test_extended_sets_of_a_ring_have_their_ends_in_multiples_of_pi():
    figure = draw("extended_sets", CIRCLE)
    (panel,) = figure.axes
    ends = {t.get_text(): t for t in panel.texts if t.get_text().count(".")}
    expected = [sets_of(CIRCLE).sets[q].pieces()[0] for q in (0, 1)]
    for mode, values in enumerate(expected):
        for value in values:
            text = ends.pop(f"{value / np.pi:.2f}π")
            assert to_hex(text.get_color()) == colours.mode_colour(mode)
            x, y = text.get_position()
            assert np.arctan2(y, x) % (2 * np.pi) == pytest.approx(value)
    assert not ends
    (far,) = [w for w in panel.patches
              if isinstance(w, Wedge) and to_hex(w.get_facecolor()) == colours.mode_colour(0)]  # fmt: skip
    assert far.theta2 % 360 == pytest.approx(np.degrees(np.pi + 0.2), abs=1.5)


# ---- runs


def test_runs_in_a_plane():
    figure = draw("runs", VEHICLE)
    arcs, panels = ARCS["vehicle"], figure.axes
    assert [panel.get_title() for panel in panels] == [
        "started in q0 = 0 (left)",
        "started in q0 = 1 (right)",
    ]
    for q, panel in enumerate(panels):
        expected = [arcs[f"start{i}", "policy"].z for i in range(5)]
        found = lines_of(panel, colours.POLICY)
        assert len(found) == 5, "the run from M* is none of the paper's"
        for way, z in zip(found, expected, strict=True):
            np.testing.assert_allclose(way, z)
        assert lines_of(panel, colours.mode_colour(q))
        crashed = sum(arcs[f"start{i}", "policy"].outcome == "crashed" for i in range(5))
        assert len(marks_of(panel, "x", colours.BAD)) == crashed > 0
        jumps = [arcs[f"start{i}", f"hyrl_q{q}"].j[-1] for i in range(5)]
        assert len(marks_of(panel, "D", colours.INK)) == sum(jumps)


def test_jumps_over_time_are_marked_and_change_the_colour():
    figure = draw("runs", CIRCLE)
    arcs, panel = ARCS["unit_circle"], figure.axes[0]
    rows = [(arc, np.flatnonzero(np.diff(arc.j)))
            for (start, who), arc in arcs.items() if who == "hyrl_q0" and start != "critical"]  # fmt: skip
    expected = [(arc.t[k], arc.z[k, 0]) for arc, at in rows for k in at]
    assert expected
    np.testing.assert_allclose(marks_of(panel, "D", colours.INK), expected)
    assert min(way[0, 1] for way in lines_of(panel, colours.mode_colour(1))) > np.pi
    assert panel.get_ylabel() == "theta [rad]"
    heights = {float(np.ravel(way[:, 1])[0]) for way in lines_of(panel, colours.GOOD, "--")}
    assert heights == {0.0, 2 * np.pi}


# ---- charts of other kinds


class Cut(Cube):
    """A chart of three dimensions, drawn at c = -0.3."""

    scene = Scene(starts=((0.1, 0.2, -0.3),), time=0.3, mode_names=("up", "down"))
    start_low, start_high = (-0.5,) * 3, (0.5,) * 3


def test_of_three_dimensions_a_section_is_drawn_and_the_runs_over_time():
    cube = Cut(lambda z: z[:, 0])
    policy = plane_policy(cube, np.array([[1.0, 0.0, 0.0]]), np.sign)
    loop = HybridController(cube, {0: policy, 1: policy}, {0: Everything(), 1: Everything()})
    starts = np.array([[0.1, 0.2, -0.3]])
    arcs = {("start0", "policy"): simulate(cube, policy, starts)[0]}
    for q in (0, 1):
        arcs["start0", f"hyrl_q{q}"] = simulate(cube, loop, starts, q0=q)[0]
    run = SimpleNamespace(
        task=cube, policy_title="RL policy (PPO)", steady=policy, arcs=lambda: arcs,
        settings=SimpleNamespace(stage1=SimpleNamespace(title="PPO"), eps=EPS, seed=0),
    )  # fmt: skip
    shown = figures.Shown(run)
    grid = Grid.with_cells(shown.section.chart, 20)
    half = GridSet(grid, grid.nodes[:, 0])
    parts = Partition((0, 1), (half, ~half), half.mask)
    vars(shown).update(critical=NONE, partition=parts, sets=extended([half, ~half]))
    assert figures.names(cube, "policy", "controller") == NAMES
    for draw_one in (figures.draw_overview, figures.draw_policy_map, figures.draw_extended_sets):
        figure = draw_one(shown)
        assert figure.get_suptitle().startswith("Cube at c = -0.3 m: ")
        assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("a [m]", "b [m]")
    panels = np.reshape(figures.draw_runs(shown).axes, (3, 2))
    assert [panel.get_ylabel() for panel in panels[:, 0]] == ["a [m]", "b [m]", "c [m]"]
    for row, coordinate in zip(panels, range(3), strict=True):
        for panel in row:
            (way,) = lines_of(panel, colours.POLICY)
            np.testing.assert_allclose(way[:, 1], arcs["start0", "policy"].z[:, coordinate])


def test_an_obstacle_of_any_shape_is_drawn_where_runs_end():
    class Walled(type(VEHICLE)):
        def ending(self, measurement):
            x, y = measurement.T
            wall = (abs(x - 1) < 0.2) & (y > 0.5)
            return np.where(wall, Outcome.CRASHED, Outcome.RUNNING)

    figure = draw("runs", VEHICLE, section=Section(Walled()))
    over = filled(figure.axes[0], colours.GREY)
    at = ((1.0, 1.0), (1.0, 0.4), (1.17, 1.4), (1.23, 1.4), (1.5, 0.0))
    assert inside(over, *at) == [True, False, True, False, False]


class Torus(type(VEHICLE)):
    """A plane whose first coordinate has a period."""

    chart = hyrl_mj.Chart(("a", "b"), ("rad",) * 2, (0.0,) * 2, (2 * np.pi,) * 2, (True, False))


def test_a_set_reaches_to_the_end_of_a_period():
    grid = Grid.with_cells(Torus.chart, 20)
    begins, ends = grid.nodes[:, 0] < 1, grid.nodes[:, 0] > 5
    with style.style.context("default"):
        panel = Figure().subplots()
        charts.region(panel, GridSet.from_mask(grid, begins | ends), colours.GREY)
    over = filled(panel, colours.GREY)
    assert inside(over, (0.1, 3.0), (3.0, 3.0), (6.2, 3.0)) == [True, False, True]


def test_a_path_round_a_period_is_broken_at_the_seam():
    z = np.stack([np.linspace(5, 8, 31), np.full(31, 1.0)], axis=1)
    with style.style.context("default"):
        panel = Figure().subplots()
        view = runs.plane_view(panel, Section(Torus()))
        x, y = runs.line(panel, view, np.arange(31), z).get_data()
    assert np.isnan(x).sum() == 1
    assert np.nanmax(np.abs(np.diff(x))) < 0.2
    assert np.nanmax(x) < 2 * np.pi
    assert (y[~np.isnan(y)] == 1).all()
    assert not charts.is_ring(Torus.chart)


# ---- vector fields, and what notebooks show


@TASKS
def test_arrows_are_the_motion_of_the_policy_and_of_each_mode_in_its_set(task):
    controller, sets = controller_of(task), sets_of(task)
    run = SimpleNamespace(
        task=task, extended_sets=sets, controller=controller, critical_set=decisions(task),
        policy_title="RL policy", steady=policy_of(task),
    )  # fmt: skip
    figure = vector_field(run)
    panels = [panel for panel in figure.axes if panel.get_title()]
    assert len(panels) == 3
    for panel, policy, members in zip(
        panels, [run.steady, *controller.policies.values()], [None, *sets.sets], strict=True
    ):
        (arrows,) = (drawn for drawn in panel.collections if isinstance(drawn, Quiver))
        z = np.array(arrows.XY, dtype=float)
        if task is CIRCLE:
            z = np.mod(np.arctan2(z[:, 1], z[:, 0]), 2 * np.pi)[:, None]
        assert len(z) > 10
        assert members is None or members.contains(z).all()
        moved = task.chart.difference(simulate_one(task, policy, z), z)
        if task is CIRCLE:
            moved = moved * np.column_stack([-np.sin(z), np.cos(z)])
        drawn = np.column_stack([arrows.U, arrows.V])
        np.testing.assert_allclose(
            drawn / np.abs(drawn).max(), moved / np.abs(moved).max(), atol=1e-6
        )


def simulate_one(task, policy, z):
    """Chart points (n, d) one sample after others."""
    arcs = simulate(task, policy, z, hyrl_mj.Noise("none", 0.0), horizon=task.dt)
    return np.array([arc.z[-1] for arc in arcs])


@pytest.mark.slow
def test_a_notebook_shows_figures(planted_circle):
    run = planted_circle[0]
    for figure in (run.arcs()["start0", "policy"].plot(), vector_field(run)):
        assert figure._repr_png_().startswith(b"\x89PNG")
    page = run._repr_html_()
    assert str(run.verdict) in unescape(page)
    assert b64decode(page.split("base64,")[1].split('"')[0]).startswith(b"\x89PNG")
    unfinished = hyrl_mj.load_run(run.path)
    object.__setattr__(unfinished, "path", run.path / "nowhere")
    assert "unit_circle" in unfinished._repr_html_()
