"""Names of coordinates: each stands for one position or velocity of MuJoCo's state."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.environments.instance import Instance
from hyrl_mj.environments.observations import columns_of
from hyrl_mj.environments.opening import AnyChart
from hyrl_mj.errors import BadInput, unknown

INDEXED = re.compile(r"(.+)\[(\d+)\]")
# States at which a name is compared with positions and velocities, and how much of these changes [m, rad].
TRIED, MOVED = 6, 0.05
AGREES = 1e-6
AXES = "xyz"
FREE, SLIDE, HINGE = map(
    int, (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
)
JOINT, SITE, BODY = mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY


@dataclass(frozen=True)
class Coordinate:
    """A coordinate of a chart.

    Attributes:
        name: in figures and messages.
        kind: "qpos" or "qvel".
        index: of the position or the velocity.
        offset: what the coordinate is greater by.
        joint: id of the joint.
        axis: the axis of the world, 0 to 2, along which it moves most; None if it turns.
    """

    name: str
    kind: str
    index: int
    offset: float
    joint: int
    axis: int | None

    @property
    def unit(self) -> str:
        """The unit: "m", "rad", "m/s" or "rad/s"."""
        return ("rad" if self.axis is None else "m") + "/s" * (self.kind == "qvel")

    def described(self) -> str:
        """Returns what it stands for: "qpos[0]"."""
        return f"{self.kind}[{self.index}]"


def coordinates(instance: Instance, chart: AnyChart) -> tuple[Coordinate, ...]:
    """Returns the coordinates that a chart names.

    A name is that of a position or velocity, as qpos[0], of a joint, of a part of the observation, as
    achieved_goal or observation[3], or of a site or a body, which stands for its x and y.

    Raises:
        BadInput: there is no such name, or it is no single position or velocity.
    """
    names = {"": chart} if isinstance(chart, str) else chart
    pairs = names.items() if isinstance(names, Mapping) else (("", name) for name in names)
    found = [c for new, name in pairs for c in _resolved(instance, str(new), str(name))]
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
    match = INDEXED.fullmatch(name)
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
        yield from _fitted(instance, new, name, lambda state: instance.rested(state)[chosen])
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
    if kind_of_joint == FREE and part < len(AXES):
        name = new or f"{AXES[part]} of {name}"
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
    moved = np.tile(state, (TRIED, 1))
    moved[:, at] += np.random.default_rng(0).uniform(-MOVED, MOVED, (TRIED, len(at)))
    values = np.array([get(other) for other in moved])
    for j, column in enumerate(values.T):
        offsets = column[:, None] - moved[:, at]
        alike = np.flatnonzero(np.ptp(offsets, axis=0) < AGREES)
        if not len(alike):
            raise BadInput(
                f"{name}[{j}] is no single position or velocity of {instance.name}, but follows from several "
                f"or from none: name coordinates such as {', '.join(all_names(instance)[:4])}"
            )
        several = f"{new}[{j}]" if new and values.shape[1] > 1 else new
        offset = round(float(offsets[:, alike[0]].mean()), 9)
        yield _of_state(instance, several, *columns[alike[0]], offset)
