"""What lies around a robot in an environment: walls, islands, and the bounds of coordinates that follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.environments.coordinates import Coordinate
from hyrl_mj.environments.instance import Instance
from hyrl_mj.tasks import touching

# What is sampled beyond this many times as far is outside of the chart.
ROOM = 1.2


class Bound(NamedTuple):
    """Ends of a coordinate of the chart, of a periodic one of one period, and where they were found."""

    low: float
    high: float
    periodic: bool
    why: str


class Group(NamedTuple):
    """Walls that touch each other, and whether a box around them is around all places of the robot."""

    geoms: list[int]
    encloses: bool


def robot_of(model: mujoco.MjModel, chart: Sequence[Coordinate]) -> np.ndarray:
    """Returns the bodies (nbody,) bool that hang together with the joints of the chart."""
    trees = {int(model.body_treeid[model.jnt_bodyid[c.joint]]) for c in chart}
    return np.isin(model.body_treeid, list(trees))


def walls(model: mujoco.MjModel) -> np.ndarray:
    """Returns the geoms that stand still and can be collided with, or are named obstacles, but no planes."""
    moves = model.body_weldid[model.geom_bodyid] != 0
    kind, meets = model.geom_contype[:, None], model.geom_conaffinity[None]
    pairs = (kind & meets) | (kind & meets).T
    collides = (pairs[:, moves] != 0).any(axis=1)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        collides[:] = False
    named = np.isin(mjcf.names(model, mujoco.mjtObj.mjOBJ_GEOM), mjcf.obstacles(model))
    is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    return np.flatnonzero(~moves & ~is_plane & (collides | named))


def groups_of(instance: Instance, places: np.ndarray) -> list[Group]:
    """Returns the groups of walls that touch each other; the robot has been at places (n, 2)."""
    model, data, found = instance.model, instance.data, []
    for geoms in touching(model, data, walls(model).tolist()):
        centres = data.geom_xpos[geoms][:, :2]
        size = model.geom_rbound[geoms][:, None]
        low, high = (centres - size).min(axis=0), (centres + size).max(axis=0)
        found.append(Group(geoms, bool(((low < places) & (places < high)).all())))
    return found


def islands_of(instance: Instance, groups: Sequence[Group]) -> dict[str, int]:
    """Returns the groups of walls that can be passed on both sides, by name, each with the id of one geom."""
    found: dict[str, int] = {}
    for geoms in [group.geoms for group in groups if not group.encloses]:
        centres = instance.data.geom_xpos[geoms][:, :2]
        middle = np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmin()
        found[f"island {len(found) + 1}"] = geoms[int(middle)]
    return found


def bounds_of(
    instance: Instance,
    chart: Sequence[Coordinate],
    samples: np.ndarray,
    given: Mapping[str, tuple[float, float]],
    groups: Sequence[Group],
) -> list[Bound]:
    """Returns the ends of the chart's coordinates.

    Args:
        instance: the environment.
        chart: its coordinates.
        samples: (n, d) chart points that sampled runs have met.
        given: ends that the user has given, by name.
        groups: walls. Those that enclose all runs are the end of the chart; beside others there is room to
            pass.
    """
    model, found = instance.model, []
    ids = [g for group in groups if group.encloses for g in group.geoms]
    others = [g for group in groups if not group.encloses for g in group.geoms]
    solid = np.flatnonzero(robot_of(model, chart)[model.geom_bodyid])
    passing = 2 * float(model.geom_rbound[solid].max(initial=0.0))
    for i, c in enumerate(chart):
        if c.name in given:
            low, high = given[c.name]
            found.append(Bound(float(low), float(high), False, "given"))
        elif c.kind == "qpos" and model.jnt_limited[c.joint]:
            low, high = model.jnt_range[c.joint] + c.offset
            found.append(Bound(float(low), float(high), False, "the range of its joint"))
        elif c.kind == "qpos" and c.axis is None:
            found.append(Bound(-np.pi + c.offset, np.pi + c.offset, True, "a joint without limits"))
        elif c.kind == "qpos" and ids:
            found.append(Bound(*_extent(instance, ids, c, 0.0), False, "the walls"))
        else:
            middle, half = np.median(samples[:, i]), np.ptp(samples[:, i]) / 2
            half = max(ROOM * half, 1e-3)
            low, high, why = float(middle - half), float(middle + half), "sampled runs"
            if c.kind == "qpos" and others:
                ends = _extent(instance, others, c, passing)
                low, high, why = min(low, ends[0]), max(high, ends[1]), "sampled runs and walls"
            found.append(Bound(low, high, False, why))
    return found


def _extent(
    instance: Instance, geoms: Sequence[int], c: Coordinate, room: float
) -> tuple[float, float]:
    """Returns the ends of geoms along the axis of a coordinate, with room beside them."""
    rows: Any = list(geoms)
    places, sizes = instance.data.geom_xpos[rows][:, c.axis], instance.model.geom_size[rows]
    is_box = instance.model.geom_type[rows] == mujoco.mjtGeom.mjGEOM_BOX
    size = np.where(is_box, sizes[:, c.axis], sizes[:, 0])
    return float((places - size).min()) - room, float((places + size).max()) + room
