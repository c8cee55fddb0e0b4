"""A run live in a browser: start, controller, mode and noise are chosen there, and simulated at once."""

from __future__ import annotations

import time
from copy import copy
from functools import cached_property
from threading import Event
from typing import Any

import mujoco
import numpy as np
from PIL.ImageColor import getrgb

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.runs.arcs import OF_RUNS, critical_starts, noisy_arcs
from hyrl_mj.runs.directory import Run
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import noise_kinds
from hyrl_mj.viz.colours import BAD, CRITICAL, OVERLAP
from hyrl_mj.viz.replay import marks
from hyrl_mj.viz.replay.panel import Track
from hyrl_mj.viz.section import Section
from hyrl_mj.viz.shows import replay_floor
from hyrl_mj.viz.tables import escaped
from hyrl_mj.viz.viewing import FPS, PAUSE, served, show

CONTROLLERS = {"HyRL": "hyrl", "the policy alone": "policy"}
SELECTED = "selected by the first measurement"
PLACES = 60  # cells along the longer side of the plane of places that the start is dragged to


def live(run: Run, port: int = 0) -> None:
    """Serves a page on which a run is simulated as its user chooses, until it is interrupted.

    Args:
        run: whose stages up to the policies of the modes are finished.
        port: as in `hyrl_mj.viz.viewing.view`.

    Raises:
        BadInput: no page can be served here; the message says why.
    """
    # The user of the page may change how a model is drawn; compiled models are shared.
    model = copy(run.task.model)
    data = mujoco.MjData(model)
    with served(model, data, port, print) as (server, scene):
        page = Page(run, server)
        last = time.monotonic()
        while True:
            now = time.monotonic()
            page.advance(now - last)
            last = now
            show(page.track, model, data, page.t)
            scene.update_from_mjdata(data)
            time.sleep(max(last + 1 / FPS - time.monotonic(), 0.0))


class Page:
    """The controls of the page, and the arc that they ask for.

    What the user changes is noted by the threads of the server; all else is done in `advance`.

    Args:
        run: as in `live`.
        server: a `viser.ViserServer`.

    Attributes:
        track: the arc that is shown.
        t: the time that is shown [s].
    """

    track: Track

    def __init__(self, run: Run, server: Any):
        self.run, self.server, self.t = run, server, 0.0
        task, gui = run.task, server.gui
        self._changed, self._stepped, self._seed, self._told = Event(), Event(), 0, -np.inf
        names = {task.mode_name(q): q for q in run.extended_sets.modes}
        self._modes: dict[str, int | None] = {SELECTED: None, **names}
        self.controller = gui.add_dropdown("controller", tuple(CONTROLLERS))
        self.mode = gui.add_dropdown("start mode of HyRL", tuple(self._modes))
        kinds = [*noise_kinds(), *OF_RUNS]
        self.noise = gui.add_dropdown("noise", kinds, initial_value="alternating")
        eps, unit = run.settings.eps, task.noise_on()[1]
        most = 2 * eps if eps else min(task.chart.scale)
        self.bound = gui.add_slider(f"bound [{unit}]", 0.0, most, most / 100, eps)
        low, high = task.chart.low, task.chart.high
        labels = zip(task.chart.names, task.chart.units, strict=True)
        self.start = [
            gui.add_slider(f"start: {name} [{unit}]", low[i], high[i], (high[i] - low[i]) / 1000, z)
            for i, ((name, unit), z) in enumerate(zip(labels, self._first, strict=True))
        ]
        other = gui.add_button("other random numbers")
        self.playing = gui.add_checkbox("play", True)
        step = gui.add_button("one sample")
        self.told = gui.add_markdown("")
        for control in (self.controller, self.mode, self.noise, self.bound, *self.start):
            control.on_update(lambda _: self._changed.set())
        other.on_click(self._draw_again)
        step.on_click(lambda _: self._stepped.set())
        self._draw_floor()
        at = marks.tracked_points(task, task.state(self._first[None])[0])[0]
        self.handle = server.scene.add_transform_controls(
            "start", 0.4, disable_rotations=True, active_axes=(True, True, False), position=at
        )
        self.handle.on_update(self._drag)
        self._ghost = server.scene.add_icosphere("measured", 0.06, getrgb(BAD), opacity=0.4)
        self._label = server.scene.add_label("mode", "")
        self._simulate()

    def advance(self, seconds: float) -> None:
        """Goes on by a time [s]: simulates anew if something was changed, and shows what is known."""
        if self._changed.is_set():
            self._changed.clear()
            self._simulate()
        if self._stepped.is_set():
            self._stepped.clear()
            self.playing.value = False
            self.t = min(self.t + self.run.task.dt, self.track.end)
        elif self.playing.value:
            self.t = (self.t + seconds) % (self.track.end + PAUSE)
        track, t = self.track, min(self.t, self.track.end)
        task, arc, row = track.task, track.arc, track.arc.at(t)
        measured = track.measured(t)
        self._ghost.visible = bool(np.isfinite(measured).all())
        if self._ghost.visible:
            self._ghost.position = marks.tracked_points(task, measured[None])[0]
        mode = task.mode_name(int(arc.q[row])) if track.modes else "the policy alone"
        above = (0.0, 0.0, 0.2)  # the robot [m]
        self._label.text, self._label.position = mode, np.add(track.point(t), above)
        # Ten times in a second: more often nobody reads it.
        if abs(self.t - self._told) >= 0.1 or not self.playing.value:
            self._told = self.t
            self.told.content = (
                f"**{arc.ending(task).replace('_', ' ')}** after {arc.t[-1]:.2f} s, jumps: {arc.j[-1]}\n\n"
                f"now t = {t:.2f} s, {escaped(task.chart.format(track.z(t)))}, mode: {escaped(mode)}"
            )

    def _simulate(self) -> None:
        """Simulates what the controls ask for; says why if that cannot be done."""
        task, bound = self.run.task, self.bound.value
        z0 = np.array([[slider.value for slider in self.start]])
        try:
            # Others than the page may ask for anything.
            for control in (self.controller, self.mode, self.noise):
                if control.value not in control.options:
                    raise unknown("choice", control.value, control.options)
            who, q0 = CONTROLLERS[self.controller.value], self._modes[self.mode.value]
            z0 = task.chart.check(z0, task.name)
            arcs = noisy_arcs(self.run, z0, self.noise.value, bound, (q0,), seed=self._seed)
        except BadInput as error:
            if not hasattr(self, "track"):  # there is nothing else to show
                raise
            self.told.content = f"**{escaped(error)}**"
            return
        found = {name.split("_")[0]: arc for name, (arc,) in arcs.items()}
        modes = self.run.extended_sets.modes
        self.t, self._told, self.track = 0.0, -np.inf, Track(task, found[who], modes)
        for name, arc in found.items():
            self._draw_path(name, Track(task, arc, modes), 0.03 if name == who else 0.01)

    def _draw_path(self, name: str, track: Track, width: float) -> None:
        """Draws the way of an arc, in the colours of its modes."""
        points = np.add(track.points, (0.0, 0.0, marks.ON_TOP))
        if len(points) > 1:
            colours = np.array([getrgb(track.colour(row)) for row in range(len(points) - 1)])
            segments = np.stack([points[:-1], points[1:]], axis=1)
            pairs = np.repeat(colours[:, None], 2, axis=1)
            self.server.scene.add_line_segments(f"paths/{name}", segments, pairs, thickness=width)

    def _draw_floor(self) -> None:
        """Draws M*, and where the extended sets overlap."""
        floor = replay_floor(self.run).at(self._first)
        if len(floor.strips):
            self.server.scene.add_line_segments(
                "overlap", floor.strips, getrgb(OVERLAP), thickness=float(floor.widths.mean())
            )
        if len(floor.critical):
            above = np.add(floor.critical, (0.0, 0.0, marks.ON_TOP))
            self.server.scene.add_point_cloud(
                "critical set", above, getrgb(CRITICAL), point_size=0.03, point_shape="circle"
            )

    @cached_property
    def _first(self) -> np.ndarray:
        """The start (d,) with which the page begins: on M*, or that of the scene."""
        return np.array([*critical_starts(self.run), *self.run.task.scene.starts][0], dtype=float)

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """Chart points (n, 2 or 1) of the plane that is drawn, and where [m] (n, 3) the robot is there."""
        section = Section(self.run.task, self._first[2:])
        nodes = Grid.with_cells(section.chart, PLACES).nodes
        qpos = self.run.task.state(section.lift(nodes))[0]
        return nodes, marks.tracked_points(self.run.task, qpos)

    def _drag(self, _: Any) -> None:
        """Takes the start that is nearest to where the handle has been dragged."""
        nodes, places = self._places
        nearest = np.linalg.norm((places - self.handle.position)[:, :2], axis=1).argmin()
        for slider, value in zip(self.start, nodes[nearest], strict=False):
            slider.value = float(value)
        self._changed.set()

    def _draw_again(self, _: Any) -> None:
        """Draws what is random in the noise anew."""
        self._seed += 1
        self._changed.set()
