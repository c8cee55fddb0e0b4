"""Names of coordinates: each stands for one position or velocity of MuJoCo's state."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj import mjcf
from hyrl_mj.environments.instance import Instance
from hyrl_mj.environments.observations import columns_of_parts
from hyrl_mj.errors import BadInput, unknown

# Chart, as users give it: one name, several, or new names with the names of what they stand for.
AnyChart = str | Sequence[str] | Mapping[str, str]
INDEXED = re.compile(r"(.+)\[(\d+)\]")
# States at which a name is compared with positions and velocities, and how much of these changes [m, rad].
TRIED, MOVED = 6, 0.05
AGREES = 1e-6
AXES = "xyz"
FREE, SLIDE, HINGE = (
    int(kind)
    for kind in (
        mujoco.mjtJoint.mjJNT_FREE,
        mujoco.mjtJoint.mjJNT_SLIDE,
        mujoco.mjtJoint.mjJNT_HINGE,
    )
)


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
    return [*positions, *(n for n in _joints(instance) if n), *_parts(instance), *_places(instance)]


def usual_name(model: mujoco.MjModel, joint: int, velocity: bool) -> str:
    """Returns the name of a coordinate after its joint."""
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"joint{joint}"
    name = name.rpartition("/")[2]
    return f"{name} rate" if velocity else name


def _joints(instance: Instance) -> list[str]:
    return [
        mujoco.mj_id2name(instance.model, mujoco.mjtObj.mjOBJ_JOINT, i) or ""
        for i in range(instance.model.njnt)
    ]


def _places(instance: Instance) -> list[str]:
    kinds = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY
    names = [name for kind in kinds for name in mjcf.names(instance.model, kind)]
    return [name for name in dict.fromkeys(names) if not name.startswith("(") and name != "world"]


def _parts(instance: Instance) -> dict[str, slice]:
    """Returns the parts of the observation, with their columns."""
    space = instance.env.observation_space
    if not isinstance(space, spaces.Dict):
        return {"observation": slice(0, int(spaces.flatdim(space)))}
    return columns_of_parts(space)


def _resolved(instance: Instance, new: str, name: str) -> Iterator[Coordinate]:
    base, index = name, None
    if match := INDEXED.fullmatch(name):
        base, index = match.group(1), int(match.group(2))
    if base in ("qpos", "qvel") and index is not None:
        size = instance.model.nq if base == "qpos" else instance.model.nv
        if index >= size:
            raise unknown("coordinate", name, all_names(instance))
        yield _of_state(instance, new, base, index)
        return
    if name in _joints(instance):
        joint = _joints(instance).index(name)
        yield _of_state(instance, new, "qpos", int(instance.model.jnt_qposadr[joint]))
        return
    parts = _parts(instance)
    if base in parts:
        columns = list(range(parts[base].start, parts[base].stop))
        if index is not None and index >= len(columns):
            raise unknown("coordinate", name, [f"{base}[{i}]" for i in range(len(columns))])
        chosen = columns if index is None else [columns[index]]

        def observed(state: np.ndarray) -> np.ndarray:
            return instance.rested(state)[chosen]

        yield from _fitted(instance, new, name, observed)
        return
    if base in _places(instance):
        kind, i = mjcf.point_of(instance.model, base)
        axes = [0, 1] if index is None else [index]

        def placed(state: np.ndarray) -> np.ndarray:
            instance.physics.write(state)
            return np.array(getattr(instance.data, kind)[i][axes])

        yield from _fitted(instance, new, name, placed)
        return
    raise unknown("coordinate", name, all_names(instance))


def _of_state(
    instance: Instance, new: str, kind: str, index: int, offset: float = 0.0
) -> Coordinate:
    model = instance.model
    addresses = model.jnt_qposadr if kind == "qpos" else model.jnt_dofadr
    joint = int(np.searchsorted(addresses, index, side="right")) - 1
    kind_of_joint, part = model.jnt_type[joint], index - addresses[joint]
    name = new or usual_name(model, joint, kind == "qvel")
    if kind_of_joint == FREE and part < len(AXES):
        name = new or f"{AXES[part]} of {name}"
        return Coordinate(name, kind, index, offset, joint, int(part))
    if kind_of_joint not in (SLIDE, HINGE):
        free = [
            usual_name(model, j, False)
            for j in range(model.njnt)
            if model.jnt_type[j] in (SLIDE, HINGE)
        ]
        raise BadInput(
            f"{kind}[{index}] is a part of an orientation of {instance.name}, for which there is no chart: "
            f"name slides, hinges ({', '.join(free) or 'it has none'}) and places of free joints"
        )
    axis = int(np.abs(model.jnt_axis[joint]).argmax()) if kind_of_joint == SLIDE else None
    return Coordinate(name, kind, index, offset, joint, axis)


def _fitted(
    instance: Instance, new: str, name: str, get: Callable[[np.ndarray], np.ndarray]
) -> Iterator[Coordinate]:
    """Yields the positions or velocities that a function of MuJoCo's state (S,) gives, but for an offset."""
    instance.reset()
    state, places = instance.physics.read(), instance.physics.columns
    rng, columns = np.random.default_rng(0), {"qpos": instance.model.nq, "qvel": instance.model.nv}
    moved: dict[str, list[np.ndarray]] = {kind: [] for kind in columns}
    values = []
    for _ in range(TRIED):
        other = state.copy()
        for kind, count in columns.items():
            other[places[kind]] += rng.uniform(-MOVED, MOVED, count)
            moved[kind].append(other[places[kind]])
        values.append(get(other))
    for j, column in enumerate(np.array(values).T):
        match = [
            (kind, i, offsets.mean())
            for kind, rows in moved.items()
            for i, offsets in enumerate((column[:, None] - np.array(rows)).T)
            if np.ptp(offsets) < AGREES
        ]
        if not match:
            raise BadInput(
                f"{name}[{j}] is no single position or velocity of {instance.name}, but follows from several "
                f"or from none: name coordinates such as {', '.join(all_names(instance)[:4])}"
            )
        kind, i, offset = match[0]
        several = f"{new}[{j}]" if new and len(values[0]) > 1 else new
        yield _of_state(instance, several, kind, i, round(float(offset), 9))
