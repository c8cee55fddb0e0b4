"""Coordinates of a chart: each is one position or velocity of MuJoCo's state, and has bounds."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.observations import columns_of
from hyrl_mj.gym_import.opening import AnyChart
from hyrl_mj.gym_import.specification import Axis, Coordinate
from hyrl_mj.physics import mjcf
from hyrl_mj.tasks import touching

FREE, BALL, SLIDE, HINGE = map(
    int,
    (
        mujoco.mjtJoint.mjJNT_FREE,
        mujoco.mjtJoint.mjJNT_BALL,
        mujoco.mjtJoint.mjJNT_SLIDE,
        mujoco.mjtJoint.mjJNT_HINGE,
    ),
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


def own_of(instance: Instance) -> np.ndarray:
    """Returns the places of the robot's positions and velocities in a state of MuJoCo."""
    spec, model = instance.spec, instance.model
    robot = robot_of(model, spec.coordinates)
    body_of_qpos = np.repeat(model.jnt_bodyid, np.diff(np.append(model.jnt_qposadr, model.nq)))
    return np.append(spec.qpos[robot[body_of_qpos]], spec.qvel[robot[model.dof_bodyid]])


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


def axes_of(instance: Instance) -> tuple[Axis | None, ...]:
    """Returns the axis of each coordinate of the chart; None where it moves along none, as where it turns.

    All joints of the robot are moved, and the place of the body that hangs on the coordinates in metres is
    read: in a frame that is turned, or on a base that turns, no axis follows.
    """
    spec, model, data = instance.spec, instance.model, instance.data
    moving = [c for c in spec.coordinates if c.kind == "qpos" and c.axis is not None]
    if not moving:
        return (None,) * len(spec.coordinates)
    body = max(int(model.jnt_bodyid[c.joint]) for c in moving)
    joints = np.flatnonzero(
        robot_of(model, spec.coordinates)[model.jnt_bodyid] & (model.jnt_type != BALL)
    )
    before = instance.physics.read()
    states = np.tile(before, (8, 1))
    rng, places = np.random.default_rng(0), []
    for joint in joints.tolist():
        width = 3 if model.jnt_type[joint] == FREE else 1  # no orientation
        at = spec.qpos[model.jnt_qposadr[joint] + np.arange(width)]
        states[:, at] += rng.uniform(-0.1, 0.1, (len(states), width))
    for state in states:
        instance.physics.write(state)
        places.append(_middle(model, data, body))
    instance.physics.write(before)
    z, found = spec.z(states), list[Axis | None]()
    for i, c in enumerate(spec.coordinates):
        found.append(None)
        if c not in moving:
            continue
        for sign, number in product((1.0, -1.0), range(3)):
            shift = np.array(places)[:, number] - sign * z[:, i]
            if np.ptp(shift) < 1e-6:
                found[i] = Axis(number, sign, round(float(shift.mean()), 9))
    return tuple(found)


def _middle(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """Returns the place (3,) of a body: its origin, or if none of its geoms reaches that, of the nearest."""
    geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] == model.body_weldid[body])
    place = np.array(data.xpos[body])
    off = np.linalg.norm(data.geom_xpos[geoms] - place, axis=1)
    if len(geoms) and (off > model.geom_rbound[geoms]).all():
        return np.array(data.geom_xpos[geoms[off.argmin()]])
    return place


def bounds_of(
    instance: Instance, met: np.ndarray, begun: np.ndarray
) -> tuple[list[Bound], dict[str, int], tuple[Axis, ...]]:
    """Returns the ends of the chart's coordinates, and the `islands` and the `plane` of a specification.

    Walls that touch each other are one. Those around all sampled runs are the end of the chart in the plane;
    the others can be passed, and there is room for that.

    Args:
        instance: the environment.
        met: (n, d) chart points that sampled runs have met.
        begun: (n, d) chart points that resets have led to.
    """
    spec, model, data = instance.spec, instance.model, instance.data
    ids, others, islands = list[int](), list[int](), dict[str, int]()
    axes, plane = axes_of(instance), tuple[Axis, ...]()
    pair = [axis for axis in axes[:2] if axis is not None]
    if len({axis.number for axis in pair}) == 2:
        plane = tuple(pair)
        across = [axis.number for axis in plane]
        places = np.column_stack([axis.world(met[:, i]) for i, axis in enumerate(plane)])
        for geoms in touching(model, data, walls(model).tolist()):
            centres, size = data.geom_xpos[geoms][:, across], model.geom_rbound[geoms][:, None]
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
    for i, (c, axis) in enumerate(zip(spec.coordinates, axes, strict=True)):
        if c.name in spec.description.bounds:
            found.append(_given(instance, c, begun))
        elif c.kind == "qpos" and model.jnt_limited[c.joint]:
            low, high = model.jnt_range[c.joint] + c.offset
            found.append(Bound(float(low), float(high), False, "the range of its joint"))
        elif c.kind == "qpos" and c.axis is None and _turns_alike(instance, c, begun):
            found.append(Bound(-np.pi + c.offset, np.pi + c.offset, True, "a joint without limits"))
        elif axis and ids:
            found.append(Bound(*axis.interval(*_extent(instance, ids, axis)), False, "the walls"))
        else:
            middle, half = np.median(samples[:, i]), np.ptp(samples[:, i]) / 2
            half = max(1.2 * half, 1e-3)  # what is farther than sampled runs go is outside
            low, high, why = float(middle - half), float(middle + half), "sampled runs"
            if axis and others:
                first, last = _extent(instance, others, axis)
                ends = axis.interval(first - passing, last + passing)
                low, high, why = min(low, ends[0]), max(high, ends[1]), "sampled runs and walls"
            found.append(Bound(low, high, False, why))
    return found, islands, plane


def _given(instance: Instance, c: Coordinate, begun: np.ndarray) -> Bound:
    """Returns the bounds that a user gives for a coordinate; a whole turn is one of a periodic coordinate.

    Raises:
        BadInput: no run can be there, or each place is there several times.
    """
    spec, model = instance.spec, instance.model
    low, high = map(float, spec.description.bounds[c.name])
    bounds = f"bounds of {c.name} from {low:g} to {high:g} {c.unit}"
    if c.kind == "qpos" and model.jnt_limited[c.joint]:
        first, last = model.jnt_range[c.joint] + c.offset
        if low < first - 1e-3 * (last - first) or high > last + 1e-3 * (last - first):
            raise BadInput(
                f"{bounds} reach beyond the range of its joint, {first:.6g} to {last:.6g} {c.unit}, where no "
                "run stays: give bounds within"
            )
    turns = c.kind == "qpos" and c.axis is None and (high - low) / (2 * np.pi)
    if turns > 0.99 and not model.jnt_limited[c.joint] and _turns_alike(instance, c, begun):
        if turns > 1.01:
            raise BadInput(
                f"{bounds} are more than a turn, of which whole ones change nothing that is seen: give "
                "at most one, in rad"
            )
        middle = (low + high) / 2
        return Bound(middle - np.pi, middle + np.pi, True, "given, a whole turn")
    return Bound(low, high, False, "given")


def _extent(instance: Instance, geoms: Sequence[int], axis: Axis) -> tuple[float, float]:
    """Returns the ends of boxes around geoms along an axis of the world [m]."""
    rows: Any = list(geoms)
    turned = instance.data.geom_xmat[rows].reshape(-1, 3, 3)[:, axis.number]
    middle, half = np.split(instance.model.geom_aabb[rows], 2, axis=1)
    places = instance.data.geom_xpos[rows][:, axis.number] + (turned * middle).sum(axis=1)
    size = (np.abs(turned) * half).sum(axis=1)
    return float((places - size).min()), float((places + size).max())


def _turns_alike(instance: Instance, c: Coordinate, begun: np.ndarray) -> bool:
    """Returns whether whole turns of a coordinate change nothing of what is seen, after steps, too."""
    spec, rng = instance.spec, np.random.default_rng(0)
    i = spec.coordinates.index(c)
    turns = 2 * np.pi * np.array([0, *(sign * 2**k for k in range(7) for sign in (1, -1))])
    for z in begun[:4]:
        inputs, seen = [instance.drawn(rng)] * 4, []
        for turn in turns:
            start = spec.state_at((z + turn * (np.arange(len(z)) == i))[None])[0]
            instance.renew()
            runs = instance.play(start, inputs, np.zeros((len(inputs) + 1, len(z))))
            seen.append(np.concatenate([np.append(one.observation, one.report) for one in runs]))
        usual, *turned = seen
        if not all(np.allclose(usual, other, 1e-6, 1e-6, equal_nan=True) for other in turned):
            return False
    return True
