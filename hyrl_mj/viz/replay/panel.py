"""One panel of a replay: the arcs of one or more controllers in one scene, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import mujoco
import numpy as np

from hyrl_mj.errors import BadArtifact
from hyrl_mj.physics import mjcf
from hyrl_mj.physics.rendering import GEOMS, HIDDEN, Box, Canvas, SceneRenderer
from hyrl_mj.simulation import NOT_STARTED, HybridArc
from hyrl_mj.tasks import Task
from hyrl_mj.viz.colours import BAD, INK, POLICY, WHITE, mode_colour, rgba
from hyrl_mj.viz.replay import marks

PATH_WIDTH, JUMP_RADIUS = 0.032, 0.055  # [m]


class Track:
    """An arc with the robot's position at each sample, ready to be drawn.

    Args:
        task: the robot and its problem.
        arc: of this task.
        modes: all modes of the run, which share out the colours.

    Raises:
        BadArtifact: the arc is of another task, or its states do not fit the task's model.
    """

    def __init__(self, task: Task, arc: HybridArc, modes: Sequence[int] = (0, 1)):
        self.task, self.arc, self.end = task, arc, float(arc.t[-1])
        # A run that was over before it began has picked no mode.
        self.modes = arc.controller != "policy" and arc.q[-1] != NOT_STARTED
        self._of = modes
        if arc.task != task.name:
            raise BadArtifact(
                f"an arc of {arc.task} cannot be replayed in the scene of {task.name}"
            )
        model, data = task.model, mujoco.MjData(task.model)
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        shape = (len(arc.t), mujoco.mj_stateSize(model, kind))
        if arc.state.shape != shape:
            raise BadArtifact(
                f"the states of an arc of {arc.task} have shape {arc.state.shape}, model "
                f"{mjcf.model_name(model)} needs {shape}: simulate it again"
            )
        # Positions (N, nq) at each row of the arc, those that were measured, and (N, 3) of the site.
        self._qpos = np.empty((len(arc.t), model.nq))
        for i, state in enumerate(arc.state):
            mujoco.mj_setState(model, data, state, kind)
            self._qpos[i] = data.qpos
        # Noise moves the chart's coordinates of a position, and leaves the others as they are.
        rows = np.isfinite(arc.measured).all(axis=1)
        measured = task.chart.near(task.z(arc.measured[rows]), arc.z[rows])
        noise = task.state(measured)[0] - task.state(arc.z[rows])[0]
        self._measured = np.full_like(self._qpos, np.nan)
        self._measured[rows] = self._qpos[rows] + noise
        self.points = marks.tracked_points(task, self._qpos)

    @cached_property
    def jumps(self) -> np.ndarray:
        """Rows right after a jump to a mode of another name; other jumps are not shown."""
        rows = np.flatnonzero(np.diff(self.arc.j) > 0) + 1
        names = [[self.task.mode_name(int(self.arc.q[k])) for k in (row - 1, row)] for row in rows]
        return rows[np.array([before != after for before, after in names], dtype=bool)]

    def colour(self, row: int) -> str:
        """Returns the colour of the path from a row on."""
        if not self.modes:
            return POLICY
        return mode_colour(self.task.colour_of(int(self.arc.q[row]), self._of))

    def tinted(self, row: int) -> frozenset[int]:
        """Returns the ids of the geoms that have the colour of the path from a row on."""
        names = self.task.tinted(int(self.arc.q[row])) if self.modes else ()
        return frozenset(self.task.model.geom(name).id for name in names)

    def qpos(self, t: float) -> np.ndarray:
        """Returns the robot's position (nq,) at time t [s], interpolated between samples."""
        return self._at(t, self._qpos)

    def z(self, t: float) -> np.ndarray:
        """Returns the chart point (d,) at time t [s]."""
        return self._at(t, self.arc.z)

    def point(self, t: float) -> np.ndarray:
        """Returns the position (3,) [m] of the tracked site at time t [s]."""
        return marks.tracked_points(self.task, self.qpos(t)[None])[0]

    def measured(self, t: float) -> np.ndarray:
        """Returns the position (nq,) that was measured at the last sample; NaN without a measurement."""
        return self._measured[self.arc.at(t)]

    def bounds(self, t: float) -> list[np.ndarray]:
        """Returns a line (k, 3) [m] for each noisy coordinate: the points that may be measured."""
        z, qpos = self.z(t), self.qpos(t)
        noise = self.task.noise_in_chart(self.arc.bound)
        share = np.linspace(-1, 1, 5)[:, None]
        lines = [z + share * noise * (np.arange(len(z)) == i) for i in np.flatnonzero(noise)]
        shifts = [self.task.state(line)[0] - self.task.state(z[None])[0] for line in lines]
        return [marks.tracked_points(self.task, qpos + shift) for shift in shifts]

    def _at(self, t: float, values: np.ndarray) -> np.ndarray:
        """Returns values (c,) at time t, interpolated between the rows (N, c)."""
        return np.array([np.interp(t, self.arc.t, column) for column in values.T])


@dataclass
class _Drawn:
    """The time up to which a track has been drawn, and the part of the picture that it is in."""

    t: float = -1.0
    box: Box = (0, 0, 0, 0)


class Panel:
    """Draws a robot for each track in one scene, at times that never go back.

    What does not change is drawn once: paths stay in the scene, and while the camera rests only the part
    of the picture that has changed is redrawn. A camera on the robot follows that of the first track.
    """

    def __init__(
        self,
        task: Task,
        tracks: Sequence[Track],
        canvas: Canvas,
        width: int,
        height: int,
        camera: str,
        floors: marks.Floors | None = None,
        beside: Sequence[Track] = (),  # of other panels, which show as much
    ):
        self._tracks, self._beside, self._camera = tracks, beside, camera
        self._rests = mjcf.rests(task.model, mjcf.camera_of(task.model, camera))
        # A bar for each row, and all else in the scene, with room to spare.
        geoms = sum(len(track.arc.t) for track in tracks) + GEOMS * (1 + len(tracks))
        self._renderer = SceneRenderer(task.model, width, height, geoms, canvas, task.mocap)
        self._floors, self._last = floors, max(tracks, key=lambda track: track.end)
        self._larger = self._scale()
        self._begin(self._floor_at(0.0))

    def _scale(self) -> float:
        """Returns by how much marks are larger than usual in a wide field, or smaller in a small scene.

        They are made for a picture that shows 3 m across, and are larger beyond 6 m and smaller below 1.6 m.
        A camera that rests sees all paths, if it has to be widened for that.
        """
        if not self._rests:
            return 1.0
        size = np.array([self._renderer.width, self._renderer.height])
        points = np.vstack([track.points for track in self._tracks])
        self._renderer.look(self._tracks[0].qpos(0.0), self._camera)
        middle = size / 2
        shown = np.vstack([points, *[track.points for track in self._beside]])
        if (np.abs(self._renderer.project(shown)[0] - middle) > middle).any():
            ends = self._renderer.extent(shown, np.full(len(shown), JUMP_RADIUS))
            beyond = np.abs(np.array(ends) - middle) / middle
            # Nothing shows what lies behind the camera.
            self._renderer.widening = float(beyond[np.isfinite(beyond)].max(initial=1.0))
            self._renderer.look(self._tracks[0].qpos(0.0), self._camera)
        _, scale = self._renderer.project(points)
        side = float(np.median(size.min() / scale))
        return side / 3.0 if side < 1.6 else max(side / 6.0, 1.0)

    def _begin(self, floor: marks.Floor | None) -> None:
        """Draws anew what stays: the marks on the floor, and where the tracks start."""
        self._floor = floor
        self._renderer.clear()
        scene = self._renderer.scene
        if floor:
            floor.draw(scene, self._larger)
        for track in self._tracks:
            marks.disc(scene, track.points[0], self._larger * 0.035, marks.ON_TOP, INK)
        self._renderer.keep()
        self._drawn = [_Drawn() for _ in self._tracks]

    def _floor_at(self, t: float) -> marks.Floor | None:
        """Returns the marks on the floor at time t [s], by the track that lasts longest."""
        return None if self._floors is None else self._floors.at(self._last.z(t))

    def draw(self, t: float, picture: np.ndarray) -> None:
        """Changes the picture (height, width, 3) of the last call to that of time t [s]."""
        renderer = self._renderer
        if (floor := self._floor_at(t)) is not self._floor:
            self._begin(floor)
        times = [min(t, track.end) for track in self._tracks]
        if all(now <= drawn.t for now, drawn in zip(times, self._drawn, strict=True)):
            return
        whole = self._drawn[0].t < 0 or not self._rests
        renderer.drop()
        since = [max(drawn.t, 0.0) for drawn in self._drawn]
        paths = [self._path(*row) for row in zip(self._tracks, since, times, strict=True)]
        renderer.keep()
        renderer.look(self._tracks[0].qpos(times[0]), self._camera)
        boxes = [self._robot(*row) for row in zip(self._tracks, times, paths, strict=True)]
        if whole:
            renderer.redraw(picture, (0, 0, renderer.width, renderer.height))
        for drawn, now, box in zip(self._drawn, times, boxes, strict=True):
            # The robot is or was in this part.
            left, top = np.minimum(box[:2], drawn.box[:2])
            right, bottom = np.maximum(box[2:], drawn.box[2:])
            if not whole and now > drawn.t and left < right and top < bottom:
                renderer.redraw(picture, (left, top, right, bottom))
            drawn.t, drawn.box = now, box

    def _path(self, track: Track, since: float, t: float) -> np.ndarray:
        """Adds the samples of the path since a time [s] to the scene; returns their points (k, 3)."""
        scene, first, last = self._renderer.scene, track.arc.at(since), track.arc.at(t)
        for row in range(first, last):
            self._segment(track, row, track.points[row + 1])
        for row in track.jumps[(track.jumps > first) & (track.jumps <= last)]:
            height = marks.ON_TOP + marks.THICKNESS
            radius, above = self._larger * JUMP_RADIUS, height + marks.THICKNESS
            marks.disc(scene, track.points[row], radius, height, INK)
            marks.disc(scene, track.points[row], 0.6 * radius, above, WHITE)
        return track.points[first : last + 1]

    def _segment(self, track: Track, row: int, end: np.ndarray) -> None:
        """Adds the path from a row to a point (3,) to the scene."""
        # Where a path comes back in another mode the later one is drawn over the earlier. Square ends
        # as long as half the width close the gaps at bends.
        height = 2e-4 * (track.arc.j[row] % 20)
        start, colour = track.points[row], track.colour(row)
        width = self._larger * PATH_WIDTH
        marks.bar(self._renderer.scene, start, end, colour, width, height, width / 2)

    def _robot(self, track: Track, t: float, path: np.ndarray) -> Box:
        """Adds the robot, its ghost and the noise bound to the scene; returns where all is seen."""
        renderer, scene = self._renderer, self._renderer.scene
        first, point, row = scene.ngeom, track.point(t), track.arc.at(t)
        self._segment(track, row, point)
        tinted = track.tinted(row)
        robot = [scene.geoms[number] for number in renderer.add_robot(track.qpos(t))]
        for geom in robot:
            if geom.objid in tinted:
                geom.rgba[:3] = rgba(track.colour(row))[:3]
        if t < track.end and track.arc.bound > 0:
            for line in track.bounds(t):
                for start, end in pairwise(line):
                    width = self._larger * 0.05
                    marks.bar(scene, start, end, "#785fc873", width, marks.ON_BOUND)
            if np.isfinite(ghost := track.measured(t)).all():
                for geom, number in zip(robot, renderer.add_robot(ghost), strict=True):
                    scene.geoms[number].rgba[3] = 0.35
                    scene.geoms[number].transparent = 1
                    if np.array_equal(geom.pos, scene.geoms[number].pos):  # noise does not move it
                        scene.geoms[number].type = HIDDEN
        if t >= track.end and track.arc.outcome not in ("reached", "running", "waited"):
            for side in ((0.075, 0.075, 0.0), (0.075, -0.075, 0.0)):  # of a cross
                ends = point - self._larger * np.array(side), point + self._larger * np.array(side)
                marks.bar(scene, *ends, BAD, self._larger * PATH_WIDTH, marks.ON_TOP + 0.18)
        geoms = scene.geoms[first : scene.ngeom]
        points = np.vstack([path, *[geom.pos for geom in geoms]])
        radii = [self._larger * JUMP_RADIUS] * len(path) + [renderer.reach(geom) for geom in geoms]
        low, high = renderer.extent(points, np.array(radii))
        size = (renderer.width, renderer.height)  # two pixels more than what has moved
        left, top = np.floor(low.min(axis=0) - 2).clip(0, size).astype(int)
        right, bottom = np.ceil(high.max(axis=0) + 2).clip(0, size).astype(int)
        return left, top, right, bottom
