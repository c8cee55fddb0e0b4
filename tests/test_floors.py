"""The marks on the floor of a replay are those at the phase of the frame."""

from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
from gl import needs_gl
from PIL import ImageColor
from planted import halves
from test_gate import expert, met

import hyrl_mj
from hyrl_mj import Noise, simulate
from hyrl_mj.learning import WaySettings
from hyrl_mj.physics.rendering import Canvas
from hyrl_mj.sets import Chart
from hyrl_mj.viz import section as section_module
from hyrl_mj.viz.colours import CRITICAL
from hyrl_mj.viz.replay.marks import Floor, Floors
from hyrl_mj.viz.replay.panel import Panel, Track
from hyrl_mj.viz.section import SECTIONS, Section, critical_sets, sections

SIZE = (300, 300)


@pytest.fixture(scope="module")
def gate():
    return hyrl_mj.get_task("gate")


@pytest.fixture(scope="module")
def cuts(gate):
    """Sections at eight phases."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section_module, "SECTIONS", 8)
        return sections(gate)[1]


@pytest.fixture(scope="module")
def found(gate, cuts):
    """M* of the expert in each section."""
    settings = SimpleNamespace(rods=12, resolution=1 / 16, eps=0.0, ways=WaySettings())
    run = SimpleNamespace(
        task=gate,
        steady=expert(gate),
        settings=settings,
        critical_set=SimpleNamespace(points=np.zeros((1, 3))),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section_module, "CELLS", 20)
        together = critical_sets(run, cuts)
        np.testing.assert_array_equal(cuts[5].critical_set(run).points, together[5].points)
    return together


@pytest.fixture(scope="module")
def floors(gate, cuts, found):
    """The marks on the floor at each phase, without an overlap."""
    parts = SimpleNamespace(grid=halves(hyrl_mj.get_task("vehicle"), 8).grid)
    marks = [
        Floor.from_sets(cut, critical, parts, None)
        for cut, critical in zip(cuts, found, strict=True)
    ]
    return Floors(gate.chart, 2, tuple(marks))


def test_a_period_is_cut_into_equal_parts(gate, vehicle):
    axis, cuts = sections(gate)
    assert axis == 2
    assert [len(cut.rest) for cut in cuts] == [1] * SECTIONS
    turns = np.arange(SECTIONS) / SECTIONS
    np.testing.assert_allclose([cut.rest[0] for cut in cuts], -np.pi + 2 * np.pi * turns)
    assert cuts[0].chart.section == "phase = -3.14159 rad"


@pytest.mark.parametrize("name", ["vehicle", "rover", "unit_circle"])
def test_what_has_no_further_periodic_coordinate_has_one_section(name):
    task = hyrl_mj.get_task(name)
    axis, cuts = sections(task)
    assert axis is None
    assert len(cuts) == 1
    np.testing.assert_array_equal(cuts[0].rest, Section(task).rest)


@pytest.mark.slow
def test_each_section_has_the_critical_set_at_its_phase(gate, cuts, found):
    for cut, critical in zip(cuts, found, strict=True):
        assert len(critical.points) > 5
        off = critical.points[:, 1] - met(gate, cut.lift(critical.points))
        assert np.abs(off).max() <= critical.resolution
    # They are not all the same: half a period later it is mirrored.
    first, later = (np.sort(found[i].points[:, 1]) for i in (1, 5))
    assert np.abs(first - later).max() > 0.3


@pytest.mark.slow
def test_the_marks_are_those_of_the_nearest_phase(gate, floors):
    for turns, number in ((0, 0), (0.4, 0), (0.6, 1), (7.4, 7), (7.6, 0), (8, 0), (19, 3), (-1, 7)):
        z = np.array([0.5, 0.1, -np.pi + turns * np.pi / 4])
        assert floors.at(z) is floors.floors[number]
    chart = Chart(("x",), ("m",), (0.0,), (1.0,), (False,))
    one = Floors(chart, None, floors.floors[:1])
    assert one.at(np.array([0.7])) is floors.floors[0]


@pytest.mark.slow
@needs_gl
def test_a_replay_draws_them_anew_as_the_phase_goes_on(gate, floors):
    noise = Noise("alternating", 0.1)
    arcs = [simulate(gate, expert(gate), [0.0, y, 0.0], noise=noise) for y in (-0.2, 0.6)]
    tracks = [Track(gate, arc) for arc in arcs]

    def drawn(*times):
        picture = np.zeros((*SIZE[::-1], 3), np.uint8)
        with closing(Canvas(gate.model, *SIZE)) as canvas:
            panel = Panel(gate, tracks, canvas, *SIZE, "overhead", floors)
            for t in times:
                panel.draw(t, picture)
        return picture, panel

    later, panel = drawn(0.0, 0.5, 1.2)
    np.testing.assert_array_equal(later, drawn(1.2)[0])
    first, _ = drawn(0.0)
    here, there = (floors.at(tracks[0].z(t)) for t in (1.2, 0.0))
    assert here is not there
    red = [
        (np.abs(picture.astype(int) - ImageColor.getrgb(CRITICAL)).max(axis=-1) < 24)
        for picture in (later, first)
    ]
    for floor, shown in ((here, red[0]), (there, red[1])):
        pixels = panel._renderer.project(floor.critical)[0].round().astype(int)
        assert shown[pixels[:, 1], pixels[:, 0]].mean() > 0.5
    assert (red[0] ^ red[1]).sum() > red[0].sum() / 2
