"""What a replay adds to the scene: flat bars and discs of one colour, and the marks on the floor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy import ndimage

from hyrl_mj.physics import mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.stages import CriticalSet, ExtendedSets, Partition
from hyrl_mj.tasks import Task
from hyrl_mj.viz.colours import CRITICAL, OVERLAP, rgba
from hyrl_mj.viz.section import Section

# Heights above the tracked site [m], from the floor up: higher marks hide lower ones. Paths have none.
ON_FLOOR, ON_SETS, ON_BOUND, ON_TOP = -0.006, -0.004, -0.002, 0.006
THICKNESS = 0.004  # of a mark [m]
CRITICAL_RADIUS = 0.02  # of a point of M* [m]


def bar(
    scene: mujoco.MjvScene,
    start: np.ndarray,
    end: np.ndarray,
    colour: str,
    width: float,
    height: float = 0.0,
    reach: float = 0.0,
) -> None:
    """Adds a flat bar between two points (3,), which is drawn several times faster than a capsule.

    Args:
        scene, start, end: the scene, and the points [m].
        colour: like "#0072b2", or "#0072b280" if the bar is not opaque.
        width: across [m].
        height: of the bar above the points [m].
        reach: how far the bar goes on beyond either end [m].
    """
    length = float(np.linalg.norm(end - start))
    if length < 1e-9:
        return
    x, y, z = (end - start) / length
    flat = np.hypot(x, y)
    cos, sin = (x / flat, y / flat) if flat > 1e-6 else (1.0, 0.0)
    # Along the bar, across it on the level, and the third axis: NumPy's cross product is slower.
    axes = np.array([[x, -sin, -cos * z], [y, cos, -sin * z], [z, 0.0, flat]])
    size = (length / 2 + reach, width / 2, THICKNESS / 2)
    middle = np.add((start + end) / 2, (0.0, 0.0, height))
    _add(scene, mujoco.mjtGeom.mjGEOM_BOX, size, middle, colour, axes)


def disc(
    scene: mujoco.MjvScene, centre: np.ndarray, radius: float, height: float, colour: str
) -> None:
    """Adds a flat disc around a point (3,), a height above it [m]."""
    size = (radius, THICKNESS / 2, 0.0)
    _add(
        scene,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        size,
        np.add(centre, (0.0, 0.0, height)),
        colour,
        np.eye(3),
    )


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    size: tuple[float, float, float],
    pos: np.ndarray,
    colour: str,
    axes: np.ndarray,
) -> None:
    """Adds a geom to the scene, unless a very long path has used up all geoms."""
    if scene.ngeom < scene.maxgeom:
        geom = scene.geoms[scene.ngeom]
        look = rgba(colour)
        mujoco.mjv_initGeom(geom, kind, np.array(size), pos, axes.ravel(), look)
        # MuJoCo leaves the number of the model's geom that was drawn in this place before.
        geom.objtype, geom.objid = mujoco.mjtObj.mjOBJ_UNKNOWN, -1
        geom.specular = 0  # marks keep the colours of the captions
        geom.transparent = int(look[3] < 1)
        scene.ngeom += 1


def tracked_points(task: Task, qpos: np.ndarray) -> np.ndarray:
    """Returns the points (n, 3) [m] of what the task's scene tracks at positions (n, nq).

    Points in or under the floor are lifted on it: nobody would see the marks below them.
    """
    data, points = mujoco.MjData(task.model), np.empty((len(qpos), 3))
    kind, number = mjcf.point_of(task.model, task.scene.tracked)
    for point, position in zip(points, qpos, strict=True):
        mjcf.place(task.model, data, position, task.mocap)
        point[:] = getattr(data, kind)[number]
    if _is_level(task):
        points[:, 2] = np.maximum(points[:, 2], _ground(task) - 2 * ON_FLOOR)
    return points


def _ground(task: Task) -> float:
    """Returns the height of the geom "floor" [m], -inf if there is none."""
    floor = mujoco.mj_name2id(task.model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    return -np.inf if floor < 0 else float(task.model.geom_pos[floor, 2])


def _is_level(task: Task) -> bool:
    """Returns whether the geom "floor" is a level plane of the world."""
    model = task.model
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    is_plane = floor >= 0 and model.geom_type[floor] == mujoco.mjtGeom.mjGEOM_PLANE
    # It may be turned about the vertical alone.
    return is_plane and not model.geom_bodyid[floor] and not model.geom_quat[floor, 1:3].any()


@dataclass(frozen=True)
class Floor:
    """The marks on the floor: what is known before a run.

    Attributes:
        critical: (k, 3) points of M* [m].
        strips: (s, 2, 3) ends of the strips that make up the overlap of the extended sets [m].
        widths: (s,) width of each strip [m].
    """

    critical: np.ndarray
    strips: np.ndarray
    widths: np.ndarray

    @staticmethod
    def from_sets(
        section: Section,
        critical: CriticalSet,
        partition: Partition,
        extended: ExtendedSets | None,
    ) -> Floor:
        """Returns the marks of results in a section; without sets no overlap."""
        task = section.task

        def places(z: np.ndarray) -> np.ndarray:
            return on_floor(task, tracked_points(task, task.state(section.lift(z))[0]))

        strips, widths, half = [], [], partition.grid.spacing / 2
        for ends in _strips(critical, partition, extended) if extended else ():
            middle = ends.mean(axis=0)
            side = middle + np.where(np.arange(len(half)) == 0, half, 0.0)
            points = places(np.vstack([ends, middle, side]))
            strips.append(points[:2])
            across = 2 * float(np.linalg.norm(points[3] - points[2]))
            # Along a single coordinate a strip has no width of its own.
            widths.append(0.16 if len(half) == 1 else across)
        points, nodes = critical.points, partition.grid.nodes
        # Some 64 nodes tell whether the tracked point moves at all: if not, it tells nothing about M*.
        if np.ptp(places(nodes[:: max(len(nodes) // 64, 1)]), axis=0).max() < 1e-9:
            points = points[:0]
        return Floor(places(points), np.reshape(strips, (-1, 2, 3)), np.array(widths))

    def draw(self, scene: mujoco.MjvScene, larger: float) -> None:
        """Adds the marks to a scene, points of M* larger than usual by a factor."""
        for (start, end), width in zip(self.strips, self.widths, strict=True):
            # The strips are a little longer, so that no gap is seen where they turn.
            bar(scene, start, end, OVERLAP, width, ON_FLOOR, width / 50)
        # Of discs that lie on each other one is drawn: hundreds take a while in each frame.
        radius = larger * CRITICAL_RADIUS
        first = np.unique(np.round(self.critical / radius), axis=0, return_index=True)[1]
        for point in self.critical[first]:
            disc(scene, point, radius, ON_SETS, CRITICAL)


@dataclass(frozen=True)
class Floors:
    """The marks on the floor over time: one set for each of equally spaced values of a periodic coordinate.

    Attributes:
        chart: the task's.
        axis: number of the coordinate; None if the marks stay.
        floors: the marks at each value, from the coordinate's lower end on.
    """

    chart: Chart
    axis: int | None
    floors: tuple[Floor, ...]

    def at(self, z: np.ndarray) -> Floor:
        """Returns the marks at the value that is nearest to that of a chart point (d,)."""
        if self.axis is None:
            return self.floors[0]
        turns = (z[self.axis] - self.chart.low[self.axis]) / self.chart.sides[self.axis]
        return self.floors[round(float(turns) * len(self.floors)) % len(self.floors)]


def on_floor(task: Task, points: np.ndarray) -> np.ndarray:
    """Returns the points (n, 3) [m] on the floor below robots that fly; those of others unchanged.

    A robot flies if its point is more than 0.3 m above the floor.
    """
    ground = _ground(task)
    flies = np.isfinite(ground) & (points[:, 2] > ground + 0.3)
    height = np.where(flies, ground - 2 * ON_FLOOR, points[:, 2])
    return np.column_stack([points[:, :2], height])


def _strips(
    critical: CriticalSet, partition: Partition, extended: ExtendedSets
) -> Iterator[np.ndarray]:
    """Yields the ends (2, d) of strips along the chart's last coordinate that make up the overlap at M*.

    Where the ways have joined again all sets overlap, and no strip is drawn.
    """
    grid, cells = extended.sets[0].regular, 16  # of a strip: it is to follow a bent coordinate
    if not len(critical.points) or len(extended.sets) < 2:
        return  # nothing overlaps
    joined = np.sum([part.contains(grid.nodes) for part in partition.parts], axis=0) > 1
    # How deep a state lies in the second of the sets that hold it, negative inside.
    depth = np.sort([s.signed_distance(grid.nodes) for s in extended.sets], axis=0)[1]
    overlap = ((depth <= 0) & ~joined).reshape(grid.counts)
    pieces, _ = ndimage.label(overlap)
    at_critical = np.unique(pieces.ravel()[grid.nearest(critical.points)])
    overlap = np.isin(pieces, at_critical[at_critical > 0])
    for row in np.arange(overlap.size).reshape(-1, grid.counts[-1]):
        inside = row[overlap.ravel()[row]]
        for run in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1):
            for piece in range(0, len(run), cells):
                strip = run[piece : piece + cells]
                ends = grid.nodes[strip[[0, -1]]]
                ends[:, -1] += [-grid.spacing[-1] / 2, grid.spacing[-1] / 2]
                yield ends
