"""What an environment is found to have: walls, islands, bounds of coordinates, and what its resets draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.environments.coordinates import Coordinate
from hyrl_mj.environments.fingerprint import differing
from hyrl_mj.environments.instance import Instance
from hyrl_mj.environments.observations import flat
from hyrl_mj.errors import BadInput
from hyrl_mj.tasks import touching

# Resets that show where episodes start, and those that are compared for all that they draw, with so many
# samples of runs after them.
RESETS, COMPARED, SAMPLES = 64, 4, 20
# What is sampled beyond this many times as far is outside of the chart.
ROOM = 1.2
# Differences of what is observed that are none, as a share of the largest number.
SAME = 1e-9
# Parts of MuJoCo's state that say nothing of where a run goes.
LEFT_OUT = ("warmstart",)


@dataclass(frozen=True)
class Bound:
    """Ends of a coordinate of the chart.

    Attributes:
        low, high: the ends; of a periodic coordinate, one period.
        periodic: whether it lives on a circle.
        why: where that was found, as "its joint".
    """

    low: float
    high: float
    periodic: bool
    why: str


def robot_of(model: mujoco.MjModel, chart: Sequence[Coordinate]) -> np.ndarray:
    """Returns the bodies (nbody,) bool that hang together with the joints of the chart."""
    trees = {int(model.body_treeid[model.jnt_bodyid[c.joint]]) for c in chart}
    return np.isin(model.body_treeid, list(trees))


def names_of_state(instance: Instance) -> list[str]:
    """Returns the names of the entries of a state of MuJoCo, as "qpos[0]"."""
    return [f"{kind}[{i}]" for kind, at in instance.physics.columns.items() for i in range(len(at))]


def states_of_resets(instance: Instance) -> np.ndarray:
    """Returns MuJoCo's states (RESETS, S) that resets lead to."""
    found = []
    for seed in range(RESETS):
        instance.reset(seed)
        found.append(instance.physics.read())
    return np.array(found)


def drawn(instance: Instance, states: np.ndarray, robot: np.ndarray) -> list[str]:
    """Returns the names of what resets draw, beside the robot's own state, and what comes next depends on.

    Args:
        instance: the environment.
        states: MuJoCo's states (n, S) after resets.
        robot: (nbody,) bool, the bodies of the robot.
    """
    model, at = instance.model, instance.physics.columns
    left = np.concatenate([at[kind] for kind in LEFT_OUT])
    varies = np.ptp(states, axis=0) > 0
    varies[left] = False
    for kind, bodies in (("qpos", _bodies_of_qpos(model)), ("qvel", model.dof_bodyid)):
        varies[at[kind][robot[bodies]]] = False
    names = [name for name, v in zip(names_of_state(instance), varies, strict=True) if v]
    told, attributes = [], []
    for _ in range(2):  # what outlasts a reset is not drawn by it
        instance.put(states[0], 0)
        attributes.append(instance.remembered())
        _told(instance)
    lasting, attributes = set(differing(*attributes)), []
    for seed in range(COMPARED):
        one = Instance(instance.recipe) if lasting else instance
        one.put(states[0], seed)
        attributes.append(one.remembered())
        told.append(_told(one))
    changed = {n: None for other in attributes[1:] for n in differing(attributes[0], other)}
    of_model = [n for n in changed if n.endswith(" of its model") and n not in lasting]
    scale = max(float(np.abs(told[0]).max(initial=0.0)), 1.0)
    if all(
        other.shape == told[0].shape
        and np.allclose(other, told[0], rtol=0, atol=SAME * scale, equal_nan=True)
        for other in told
    ):
        return names + of_model
    chance = [name for a in attributes for name in a.generators]
    differ = [
        name
        for name in changed
        if not (
            "_seed" in name
            or name in chance
            or name in of_model
            or name in lasting
            or name == "MuJoCo's state"
        )
    ]
    words = ("goal", "target", "task")
    goals = [name for name in differ if any(word in name for word in words)]
    return names + of_model + (goals or differ) or ["something that no attribute holds"]


def _bodies_of_qpos(model: mujoco.MjModel) -> np.ndarray:
    """Returns the bodies (nq,) that generalised positions move."""
    ends = np.append(model.jnt_qposadr[1:], model.nq)
    return np.repeat(model.jnt_bodyid, ends - model.jnt_qposadr)


def _told(instance: Instance) -> np.ndarray:
    """Returns what an instance tells over some samples."""
    space, runs = (
        instance.env.observation_space,
        instance.wander(np.random.default_rng(0), SAMPLES, 1),
    )
    told = [[*flat(seen, space), reward, ends] for seen, reward, ends, _, _ in runs]
    return np.array(told, dtype=float)


def changed_by_user(instance: Instance) -> list[str]:
    """Returns the names of what the user's options of reset and pinned values change after a reset."""
    found: dict[str, None] = {}
    for seed in range(COMPARED):
        seen = []
        choices: tuple[Mapping[str, Any] | None, ...] = (None, {})
        for options in choices:
            instance.reset(seed, options)
            remembered = instance.remembered()
            state = instance.physics.read()
            names = names_of_state(instance)
            remembered.update((n, float(v)) for n, v in zip(names, state, strict=True))
            seen.append(remembered)
        found |= dict.fromkeys(differing(*seen))
    pinned = [
        name.partition("[")[0] if "[" not in name else name for name in instance.source.pinned
    ]
    return [name for name in (*found, *pinned) if name != "MuJoCo's state"]


def check_pins(instance: Instance) -> None:
    """Raises `BadInput` if a pinned attribute contradicts what is drawn where the attribute was.

    An attribute that, after each reset, is a copy of a place in the model or in the state is one after the
    resets that pin it, too.
    """
    pins = {name: v for name, v in instance.source.pinned.items() if hasattr(instance.inner, name)}
    if not pins:
        return
    source, seen = instance.source, []
    for seed in range(COMPARED):
        instance.recipe = replace(instance.recipe, source=source.unpinned)
        instance.reset(seed)
        seen.append(
            ({n: np.ravel(getattr(instance.inner, n)).copy() for n in pins}, _places(instance))
        )
    instance.recipe = replace(instance.recipe, source=source)
    instance.reset()
    places = _places(instance)
    for name, value in pins.items():
        own = np.ravel(value).astype(float)
        if all(np.array_equal(a[name], seen[0][0][name]) for a, _ in seen):
            continue  # no reset draws it
        for place, now in places.items():
            copies = len(own) <= len(now) and all(
                np.array_equal(a[name], p[place][: len(own)]) for a, p in seen
            )
            if copies and not np.array_equal(own, now[: len(own)]):
                raise BadInput(
                    f"pinned {name} is {own.tolist()}, and {place} of {instance.name}, which each reset puts "
                    f"at the same place, stays at {now[: len(own)].tolist()}: pin it by options of reset or "
                    "by a seed"
                )


def _places(instance: Instance) -> dict[str, np.ndarray]:
    """Returns places of the model and of the state by name, each as numbers (k,)."""
    instance.physics.read()
    model, data, found = instance.model, instance.data, {}
    for kind, owner in (
        ("site_pos", model),
        ("body_pos", model),
        ("geom_pos", model),
        ("mocap_pos", data),
    ):
        for i, row in enumerate(np.reshape(getattr(owner, kind), (-1, 3))):
            found[f"{kind}[{i}]"] = row.copy()
    for i in range(model.nq):
        found[f"qpos[{i}:]"] = data.qpos[i:].copy()
    return found


# ---- walls


def walls(model: mujoco.MjModel) -> list[int]:
    """Returns the geoms that stand still and can be collided with, or are named obstacles, but no planes."""
    contacts = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    still = (model.body_weldid[model.geom_bodyid] == 0) & (
        model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
    )
    moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)
    meets = [
        bool(
            (
                (model.geom_contype[g] & model.geom_conaffinity[moving])
                | (model.geom_contype[moving] & model.geom_conaffinity[g])
            ).any()
        )
        for g in range(model.ngeom)
    ]
    kind = mujoco.mjtObj.mjOBJ_GEOM
    named = np.isin(mjcf.names(model, kind), mjcf.obstacles(model))
    return [int(g) for g in np.flatnonzero(still & (contacts & np.array(meets) | named))]


@dataclass(frozen=True)
class Group:
    """Walls that touch each other.

    Attributes:
        geoms: their ids.
        low, high: corners (2,) of a box around them, in the plane.
        encloses: whether this box is around all places where the robot has been.
    """

    geoms: tuple[int, ...]
    low: np.ndarray
    high: np.ndarray
    encloses: bool


def groups_of(instance: Instance, places: np.ndarray) -> list[Group]:
    """Returns the groups of walls that touch each other; the robot has been at places (n, 2)."""
    model, data, found = instance.model, instance.data, []
    for group in touching(model, data, ids) if (ids := walls(model)) else ():
        centres = data.geom_xpos[group][:, :2]
        size = model.geom_rbound[group][:, None]
        low, high = (centres - size).min(axis=0), (centres + size).max(axis=0)
        encloses = bool((low < places.min(axis=0)).all() and (high > places.max(axis=0)).all())
        found.append(Group(tuple(map(int, group)), low, high, encloses))
    return found


def islands_of(instance: Instance, groups: Sequence[Group]) -> dict[str, int]:
    """Returns the groups of walls that can be passed on both sides, by name, each with the id of one geom."""
    found: dict[str, int] = {}
    for group in groups:
        if not group.encloses:
            ids = list(group.geoms)
            centres = instance.data.geom_xpos[ids][:, :2]
            middle = np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmin()
            found[f"island {len(found) + 1}"] = ids[int(middle)]
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
    instance: Instance, ids: Sequence[int], c: Coordinate, room: float
) -> tuple[float, float]:
    """Returns the ends of geoms along the axis of a coordinate, with room beside them."""
    rows: Any = list(ids)
    places, size = (
        instance.data.geom_xpos[rows][:, c.axis],
        instance.model.geom_size[rows][:, c.axis],
    )
    round_ = instance.model.geom_type[rows] != mujoco.mjtGeom.mjGEOM_BOX
    size = np.where(round_, instance.model.geom_size[rows][:, 0], size)
    return float((places - size).min()) - room, float((places + size).max()) + room
