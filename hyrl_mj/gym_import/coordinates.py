"""Coordinates of a chart: each is one position or velocity of MuJoCo's state, and has bounds."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.observations import columns_of
from hyrl_mj.gym_import.opening import AnyChart
from hyrl_mj.gym_import.specification import Coordinate
from hyrl_mj.physics import mjcf
from hyrl_mj.tasks import touching

FREE, SLIDE, HINGE = map(
    int, (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
)
JOINT, SITE, BODY = mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY


def coordinates(instance: Instance, chart: AnyChart) -> tuple[Coordinate, ...]:
    """Returns the coordinates that a chart names.

    A name is that of a position or velocity, as qpos[0], of a joint, of a part of the observation, as
    achieved_goal or observation[3], or of a site or a body, which stands for its x and y.

    Raises:
        BadInput: there is no such name, or it is no single position or velocity.
    """
    names = [chart] if isinstance(chart, str) else chart
    pairs = names.items() if isinstance(names, Mapping) else (("", name) for name in names)
    found = [c for new, name in pairs for c in _resolved(instance, str(new), str(name))]
    if not instance.model.nq:
        raise BadInput(
            f"{instance.name} has no joints, so nothing of it is a position that noise could show elsewhere"
        )
    places = [(c.kind, c.index) for c in found]
    if not found or len(set(places)) < len(places):
        raise BadInput(
            f"the chart {chart!r} names no coordinate, or one of them twice: name each once"
        )
    return tuple(found)


def all_names(instance: Instance) -> list[str]:
    """Returns the names that a chart may use."""
    model = instance.model
    positions = [f"qpos[{i}]" for i in range(model.nq)] + [f"qvel[{i}]" for i in range(model.nv)]
    parts = columns_of(instance.env.observation_space)
    return [*positions, *_named(model, JOINT), *parts, *_named(model, SITE, BODY)]


def _named(model: mujoco.MjModel, *kinds: mujoco.mjtObj) -> list[str]:
    """Returns the names of objects of some kinds, of those that have one."""
    names = [name for kind in kinds for name in mjcf.names(model, kind)]
    return [name for name in dict.fromkeys(names) if not name.startswith("(") and name != "world"]


def _resolved(instance: Instance, new: str, name: str) -> Iterator[Coordinate]:
    model, parts = instance.model, columns_of(instance.env.observation_space)
    match = re.fullmatch(r"(.+)\[(\d+)\]", name)
    base, index = (match.group(1), int(match.group(2))) if match else (name, None)
    if base in ("qpos", "qvel") and index is not None:
        if index >= (model.nq if base == "qpos" else model.nv):
            raise unknown("coordinate", name, all_names(instance))
        yield _of_state(instance, new, base, index)
    elif name in _named(model, JOINT):
        yield _of_state(instance, new, "qpos", int(model.joint(name).qposadr[0]))
    elif base in parts:
        columns = list(range(parts[base].start, parts[base].stop))
        if index is not None and index >= len(columns):
            raise unknown("coordinate", name, [f"{base}[{i}]" for i in range(len(columns))])
        chosen = columns if index is None else [columns[index]]
        yield from _fitted(instance, new, name, lambda state: instance.put(state)[chosen])
    elif base in _named(model, SITE, BODY):
        where, i = mjcf.point_of(model, base)
        axes = [0, 1] if index is None else [index]

        def placed(state: np.ndarray) -> np.ndarray:
            instance.physics.write(state)
            return np.array(getattr(instance.data, where)[i][axes])

        yield from _fitted(instance, new, name, placed)
    else:
        raise unknown("coordinate", name, all_names(instance))


def _of_state(
    instance: Instance, new: str, kind: str, index: int, offset: float = 0.0
) -> Coordinate:
    model = instance.model
    addresses = model.jnt_qposadr if kind == "qpos" else model.jnt_dofadr
    joint = int(np.searchsorted(addresses, index, side="right")) - 1
    kind_of_joint, part = model.jnt_type[joint], index - addresses[joint]
    name = new or _usual_name(model, joint, kind)
    if kind_of_joint == FREE and part < 3:
        name = new or f"{'xyz'[part]} of {name}"
        return Coordinate(name, kind, index, offset, joint, int(part))
    if kind_of_joint not in (SLIDE, HINGE):
        joints = np.flatnonzero(np.isin(model.jnt_type, (SLIDE, HINGE)))
        free = [_usual_name(model, j, "qpos") for j in joints.tolist()]
        raise BadInput(
            f"{kind}[{index}] is a part of an orientation of {instance.name}, for which there is no chart: "
            f"name slides, hinges ({', '.join(free) or 'it has none'}) and places of free joints"
        )
    axis = int(np.abs(model.jnt_axis[joint]).argmax()) if kind_of_joint == SLIDE else None
    return Coordinate(name, kind, index, offset, joint, axis)


def _usual_name(model: mujoco.MjModel, joint: int, kind: str) -> str:
    """Returns the name of a position or velocity after its joint."""
    name = (model.joint(joint).name or f"joint{joint}").rpartition("/")[2]
    return f"{name} rate" if kind == "qvel" else name


def _fitted(
    instance: Instance, new: str, name: str, get: Callable[[np.ndarray], np.ndarray]
) -> Iterator[Coordinate]:
    """Yields the positions or velocities that a function of MuJoCo's state (S,) gives, but for an offset."""
    instance.reset()
    state, places = instance.physics.read(), instance.physics.columns
    columns = [(kind, i) for kind in ("qpos", "qvel") for i in range(len(places[kind]))]
    at = np.concatenate([places["qpos"], places["qvel"]])
    moved = np.tile(state, (6, 1))
    moved[:, at] += np.random.default_rng(0).uniform(-0.05, 0.05, (6, len(at)))
    values = np.array([get(other) for other in moved])
    for j, column in enumerate(values.T):
        offsets = column[:, None] - moved[:, at]
        alike = np.flatnonzero(np.ptp(offsets, axis=0) < 1e-6)
        if not len(alike):
            raise BadInput(
                f"{name}[{j}] is no single position or velocity of {instance.name}, but follows from several "
                f"or from none: name coordinates such as {', '.join(all_names(instance)[:4])}"
            )
        several = f"{new}[{j}]" if new and values.shape[1] > 1 else new
        offset = round(float(offsets[:, alike[0]].mean()), 9)
        kind, i = columns[alike[0]]
        yield _of_state(instance, several, kind, i, offset)


# ---- walls, and the bounds that follow


class Bound(NamedTuple):
    """Ends of a coordinate of the chart, of a periodic one of one period, and where they were found."""

    low: float
    high: float
    periodic: bool
    why: str


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


def bounds_of(
    instance: Instance, met: np.ndarray, begun: np.ndarray
) -> tuple[list[Bound], dict[str, int]]:
    """Returns the ends of the chart's coordinates, and what can be passed on both sides: `islands` of a spec.

    Walls that touch each other are one. Those around all sampled runs are the end of the chart in the plane;
    the others can be passed, and there is room for that.

    Args:
        instance: the environment.
        met: (n, d) chart points that sampled runs have met.
        begun: (n, d) chart points that resets have led to.
    """
    spec, model, data = instance.spec, instance.model, instance.data
    ids, others, islands = list[int](), list[int](), dict[str, int]()
    if len(spec.coordinates) >= 2 and all(c.unit == "m" for c in spec.coordinates[:2]):
        places = (met - spec.offset)[:, :2]
        for geoms in touching(model, data, walls(model).tolist()):
            centres, size = data.geom_xpos[geoms][:, :2], model.geom_rbound[geoms][:, None]
            low, high = (centres - size).min(axis=0), (centres + size).max(axis=0)
            if ((low < places) & (places < high)).all():
                ids += geoms
            else:
                others += geoms
                middle = np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmin()
                islands[f"island {len(islands) + 1}"] = geoms[int(middle)]
    samples, passing = (
        np.vstack([met, begun]),
        2 * float(model.geom_rbound[spec.solid].max(initial=0.0)),
    )
    found = []
    for i, c in enumerate(spec.coordinates):
        if c.name in spec.description.bounds:
            low, high = spec.description.bounds[c.name]
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
            half = max(1.2 * half, 1e-3)  # what is farther than sampled runs go is outside
            low, high, why = float(middle - half), float(middle + half), "sampled runs"
            if c.kind == "qpos" and others:
                ends = _extent(instance, others, c, passing)
                low, high, why = min(low, ends[0]), max(high, ends[1]), "sampled runs and walls"
            found.append(Bound(low, high, False, why))
    return found, islands


def _extent(
    instance: Instance, geoms: Sequence[int], c: Coordinate, room: float
) -> tuple[float, float]:
    """Returns the ends of geoms along the axis of a coordinate, with room beside them."""
    rows: Any = list(geoms)
    places, sizes = instance.data.geom_xpos[rows][:, c.axis], instance.model.geom_size[rows]
    is_box = instance.model.geom_type[rows] == mujoco.mjtGeom.mjGEOM_BOX
    size = np.where(is_box, sizes[:, c.axis], sizes[:, 0])
    return float((places - size).min()) - room, float((places + size).max()) + room
