"""The pictures of the worst-case game: what is in them, and what is left when they cannot be drawn."""

from __future__ import annotations

from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from figure_parts import EPS, size_of, where, written
from PIL import Image
from scored import SPACING, score

import hyrl_mj
from hyrl_mj.judging.game.result import (
    LIMIT,
    Curve,
    GameResult,
    MapClass,
    Maps,
    Profile,
    WinningShares,
)
from hyrl_mj.sets import Grid
from hyrl_mj.viz import colours, figures
from hyrl_mj.viz.figures import robustness, style
from hyrl_mj.viz.section import Section

WON, WON_FROM_SOME, UNCLEAR, BEATEN, UNWINNABLE, OVER = MapClass

CIRCLE, VEHICLE = hyrl_mj.get_task("unit_circle"), hyrl_mj.get_task("vehicle")
HYRL = colours.MODES[0]
CURVE = tuple(np.linspace(0, 0.3, 25).tolist())
DPI = style.DPI


@pytest.fixture(autouse=True)
def as_for_people(monkeypatch):
    """Pictures have as many pixels as people get."""
    monkeypatch.setattr(style, "DPI", DPI)


@pytest.fixture
def coarse(monkeypatch):
    """Pictures with a quarter of the pixels, which are drawn faster."""
    monkeypatch.setattr(style, "DPI", 100)


def wins_of(won, won_any, times):
    """What a controller wins; a hundredth less is proved."""
    proved = [tuple(np.maximum(share - 0.01, 0)) for share in (won, won_any)]
    return WinningShares(tuple(won), tuple(won_any), *proved, tuple(times))


def game_of(names, excursion=None, margin=0.05):
    """What `examine` returns, for controllers that lose more and more."""
    eps = np.array(CURVE)
    fall = np.clip(1.2 - 4 * eps, 0, 1)
    wins = {
        name: wins_of(fall, fall if name == "policy" else 0.9 * fall, 3 * fall) for name in names
    }
    wins[LIMIT] = WinningShares((1.0,) * len(eps), tuple(1 - 0.3 * eps), (), (), (3.0,) * len(eps))
    scores = {
        name: (score(EPS, 0.9, 0.8, 0.72, proved=0.7, excursion=excursion),) for name in names
    }
    return GameResult(
        everywhere=False,
        lattice=SPACING,
        scores=scores | {LIMIT: (score(EPS, 0.9, 1.0, 1.0),)},
        margin=dict.fromkeys(names, margin),
        proved_margin=dict.fromkeys(names, margin),
        why_not_proved={},
        miss_without_noise=dict.fromkeys(names, 0.0),
        curve=Curve(CURVE, tuple(1 - 0.2 * eps), wins),
        profile=Profile((), {}),
    )


def maps_of(task, names, rule, cells=40):
    """The maps of `examine`; the classes (N,) are a rule of the nodes (N, d)."""
    grid = Grid.with_cells(task.chart, cells)
    classes = np.asarray(rule(grid.nodes), dtype=np.int8)
    return Maps(EPS, np.array(grid.counts), dict.fromkeys(names, classes))


def critical_of(*points):
    d = len(points[0]) if points else 1
    z = np.array(points, dtype=float).reshape(-1, d)
    return hyrl_mj.CriticalSet(z, np.zeros(len(z), dtype=int), 0.01, 0.1)


def draw_map(task, result, maps, critical, path=None):
    shown = SimpleNamespace(
        task=task, section=Section(task), critical=critical, result=result, maps=maps
    )
    return written(figures.draw_robustness_map(shown), path)


def draw_curve(task, result, path=None):
    shown = SimpleNamespace(task=task, section=Section(task), result=result)
    return written(figures.draw_robustness_curve(shown), path)


@pytest.mark.slow
@pytest.mark.parametrize("task", [CIRCLE, VEHICLE], ids=lambda task: task.name)
def test_each_class_that_occurs_has_its_colour(tmp_path, task):
    occurring = (WON, WON_FROM_SOME, UNCLEAR)
    path, names = tmp_path / "figures" / "map.png", ("policy", "hyrl")
    maps = maps_of(task, names, lambda z: np.arange(len(z)) % 40 // 14)
    critical = critical_of(task.scene.starts[2])
    draw_map(task, game_of(names), maps, critical, path)
    for k, colour in enumerate(figures.CLASS_COLOURS):
        assert (len(where(path, colour)) > 1000) == (k in occurring), MapClass(k).label
    width, height = size_of(path)
    assert 1200 < width <= 1600
    assert 800 < height < 1600
    assert sorted(p.name for p in path.parent.iterdir()) == ["map.pdf", "map.png"]


@pytest.mark.slow
def test_a_map_is_drawn_the_right_way_round(tmp_path, coarse):
    path = tmp_path / "map.png"

    def upper_left(z):
        return np.where((z[:, 0] < 1.0) & (z[:, 1] > 0.5), BEATEN, UNWINNABLE)

    maps = maps_of(VEHICLE, ["hyrl"], upper_left)
    draw_map(VEHICLE, game_of(["hyrl"]), maps, critical_of((0.0, 0.0)), path)
    corner, rest = (where(path, figures.CLASS_COLOURS[k]) for k in (BEATEN, UNWINNABLE))
    right, up = np.median(corner, axis=0) - np.median(rest, axis=0)
    assert right < -50
    assert up > 50


def test_arcs_of_a_ring_lie_at_their_angle(tmp_path, coarse):
    path = tmp_path / "map.png"

    def through_the_end_of_the_period(z):
        return np.where(np.cos(z[:, 0] - 0.25) > 0.9, BEATEN, UNWINNABLE)

    maps = maps_of(CIRCLE, ["hyrl"], through_the_end_of_the_period, cells=360)
    draw_map(CIRCLE, game_of(["hyrl"]), maps, critical_of(), path)
    ring = where(path, figures.CLASS_COLOURS[UNWINNABLE])
    # The ring without its legend: the other arc lies to the right, a little above the centre.
    ring = ring[ring[:, 1] > 100]
    centre = ring[:, 0].min() + np.ptp(ring[:, 1]) / 2, (ring[:, 1].min() + ring[:, 1].max()) / 2
    found = where(path, figures.CLASS_COLOURS[BEATEN])
    x, y = np.median(found[found[:, 1] > 100], axis=0) - centre
    assert np.arctan2(y, x) == pytest.approx(0.25, abs=0.05)


def test_a_single_node_of_a_ring_is_seen(tmp_path):
    path = tmp_path / "map.png"
    maps = maps_of(CIRCLE, ["hyrl"], lambda z: (np.arange(len(z)) == 700) * BEATEN, cells=6000)
    draw_map(CIRCLE, game_of(["hyrl"]), maps, critical_of(), path)
    found = where(path, figures.CLASS_COLOURS[BEATEN])
    assert (found[:, 1] > 200).sum() > 20, "beside what is in the legend"


def test_the_critical_set_lies_at_its_angle(tmp_path, coarse):
    maps, pictures = maps_of(CIRCLE, ["hyrl"], lambda z: WON + 0 * z[:, 0]), []
    for critical in (critical_of(), critical_of((0.75 * np.pi,))):
        path = tmp_path / "map.png"
        draw_map(CIRCLE, game_of(["hyrl"]), maps, critical, path)
        pictures.append(np.asarray(Image.open(path).convert("RGB"))[::-1].astype(int))
    changed = np.argwhere(np.abs(pictures[1] - pictures[0]).max(axis=-1) > 100)[:, ::-1]
    ring, changed = (
        found[found[:, 1] > 100] for found in (where(path, figures.CLASS_COLOURS[WON]), changed)
    )
    x, y = np.median(changed, axis=0) - (ring.min(axis=0) + ring.max(axis=0)) / 2
    assert np.arctan2(y, x) == pytest.approx(0.75 * np.pi, abs=0.05)


@pytest.mark.slow
def test_each_curve_has_its_colour(tmp_path, coarse):
    path = tmp_path / "curve.png"
    figure = draw_curve(VEHICLE, game_of(("policy", "hyrl")), path)
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "margin of HyRL: 0.05 m" in words
    for colour in (*(looks["color"] for looks in robustness.CURVES.values()), colours.PALE):
        assert len(where(path, colour)) > 100


@pytest.mark.slow
def test_times_are_drawn_where_runs_last_for_ever(tmp_path, coarse):
    one, two = tmp_path / "one.png", tmp_path / "two.png"
    draw_curve(CIRCLE, game_of(["hyrl"]), one)
    draw_curve(CIRCLE, game_of(["hyrl"], excursion=0.1, margin=None), two)
    assert size_of(two)[1] > size_of(one)[1] + 100
    assert size_of(two)[0] <= 800
    assert len(where(two, HYRL)) > len(where(one, HYRL))


@pytest.mark.slow
def test_the_users_own_style_is_neither_used_nor_changed(tmp_path, coarse):
    names = ["hyrl"]
    draw_curve(VEHICLE, game_of(names), tmp_path / "plain.png")
    with matplotlib.rc_context({"figure.facecolor": "black", "font.size": 30}):
        before = dict(matplotlib.rcParams)
        draw_curve(VEHICLE, game_of(names), tmp_path / "styled.png")
        assert dict(matplotlib.rcParams) == before
    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "styled.png").read_bytes()


def test_angles_are_multiples_of_pi():
    angles = np.pi * np.array([-1, -0.5, 0, 0.5, 1, 1.5, 2])
    assert [style.angle(x) for x in angles] == ["-π", "-π/2", "0", "π/2", "π", "3π/2", "2π"]
