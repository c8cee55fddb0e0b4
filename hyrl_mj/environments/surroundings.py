"""What an environment is found to have: walls, islands, bounds of coordinates, and where resets lead."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.environments.coordinates import Coordinate
from hyrl_mj.environments.copies import Host, flat
from hyrl_mj.environments.memory import name_of, remembered, same
from hyrl_mj.tasks import touching

# Resets that show where episodes start.
RESETS = 64
# Resets that are compared for what they draw.
RESETS_COMPARED = 4
# Steps of the runs under inputs at random that show how far coordinates go, and for how long inputs are held.
RUNS, STEPS, HELD = 16, 150, 15
# What is sampled beyond this many times as far is outside of the chart.
ROOM = 1.2
# What a reset may change in MuJoCo's model so that runs go on differently.
MODEL = (
    "body_pos", "body_quat", "body_mass", "body_inertia", "geom_pos", "geom_quat", "geom_size",
    "geom_friction", "geom_contype", "geom_conaffinity", "dof_damping", "dof_armature", "dof_frictionloss",
    "actuator_gear", "actuator_gainprm", "actuator_biasprm", "hfield_data",
)  # fmt: skip
# What goes no farther than this stands [m].
STANDS = 1e-6


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


@dataclass(frozen=True)
class Runs:
    """Runs under inputs at random.

    Attributes:
        points: (n, d) chart points that they met.
        worst_reward: the least reward.
        moved: (nq,) bool, the positions that changed.
        farthest: name of the body that went farthest, or of the geom where no body went anywhere.
    """

    points: np.ndarray
    worst_reward: float
    moved: np.ndarray
    farthest: str


def sampled_runs(host: Host, chart: Sequence[Coordinate]) -> Runs:
    """Returns runs under inputs at random."""
    rng, points, rewards = np.random.default_rng(0), [], []
    bodies, geoms = [], []
    moved = np.zeros(host.model.nq, dtype=bool)
    for seed in range(RUNS):
        host.reset(seed)
        begun = host.data.qpos.copy()
        for k in range(STEPS):
            if k % HELD == 0:
                u = host.drawn(rng)
            _, reward, terminated, truncated, _, _ = host.step(u)
            points.append([getattr(host.data, c.kind)[c.index] + c.offset for c in chart])
            rewards.append(reward)
            bodies.append(host.data.xpos.copy())
            geoms.append(host.data.geom_xpos.copy())
            moved |= np.abs(host.data.qpos - begun) > 0
            if terminated or truncated:
                break
    host.write(*host.base)
    farthest = _farthest(host.model.body, bodies) or _farthest(host.model.geom, geoms)
    return Runs(np.array(points), float(min(rewards)), moved, farthest)


def _farthest(named: Callable[[int], Any], places: Sequence[np.ndarray]) -> str:
    """Returns the name of what goes farthest, of places (k, n, 3) [m]; none if nothing does."""
    went = np.ptp(places, axis=0).sum(axis=1)
    return str(named(int(went.argmax())).name) if went.max() > STANDS else ""


def starts_of(host: Host) -> np.ndarray:
    """Returns the positions and velocities (RESETS, nq + nv) that resets lead to."""
    found = []
    for seed in range(RESETS):
        host.reset(seed)
        found.append(np.concatenate([host.data.qpos, host.data.qvel]))
    host.write(*host.base)
    return np.array(found)


def drawn_goals(host: Host, resets: np.ndarray, moved: np.ndarray) -> list[str]:
    """Returns the names of what resets draw and steps never change, though what comes next depends on it.

    Args:
        host: the environment.
        resets: (n, nq + nv) positions and velocities after resets.
        moved: (nq,) bool, the positions that change in sampled runs.
    """
    drawn = np.ptp(resets[:, : host.model.nq], axis=0) > 0
    names = [f"qpos[{i}]" for i in np.flatnonzero(drawn & ~moved)]
    state, memory = host.base
    rng = np.random.default_rng(0)
    u, told, attributes, models = host.drawn(rng), [], [], []
    for seed in range(RESETS_COMPARED):
        host.reset(seed)
        attributes.append(remembered(host.env))
        models.append(_physics(host))
        host.write(state, memory)
        told.append(np.append(host.step(u)[0], host.step(u)[1:3]))
    host.reset(host.source.first)
    host.write(state, memory)
    names += [
        f"{name} of its model"
        for name in MODEL
        if any((other[name] != models[0][name]).any() for other in models)
    ]
    if all(np.allclose(other, told[0], rtol=0, atol=1e-9, equal_nan=True) for other in told):
        return names
    slots = {slot.path for slot in host.slots}
    differing = [
        name_of(path)
        for path, value in attributes[0].items()
        if path not in slots and not all(same(value, a.get(path)) for a in attributes[1:])
    ]
    differing = [name for name in differing if "random" not in name]  # generators and their seeds
    words = ("goal", "target", "task")
    goals = [name for name in differing if any(word in name for word in words)]
    return names + (goals or differing) or ["a part of its model"]


def _physics(host: Host) -> dict[str, np.ndarray]:
    """Returns copies of what a reset may change in the model, by name."""
    return {name: getattr(host.model, name).copy() for name in MODEL}


def heeds_options(host: Host) -> bool:
    """Returns whether resets with the user's options lead elsewhere than those without."""
    heeds = False
    for seed in range(RESETS_COMPARED):
        seen = []
        for options in (host.source.reset, {}):
            observation = flat(host.fresh(seed, options))
            told = {"observation": observation, **_physics(host)}
            seen.append([*remembered(host.env).items(), *told.items()])
        alike = len(seen[0]) == len(seen[1]) and all(
            path == other and same(a, b) for (path, a), (other, b) in zip(*seen, strict=True)
        )
        heeds = heeds or not alike
    host.reset(host.source.first)
    host.write(*host.base)
    return heeds


def walls(host: Host) -> list[int]:
    """Returns the geoms that stand still and can be collided with, or are named obstacles, but no planes."""
    model = host.model
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


def islands_of(host: Host, places: np.ndarray) -> dict[str, int]:
    """Returns the walls that can be passed on both sides, by name, each with the id of one geom.

    Walls that touch each other are one. Those that enclose the places (n, 2) where the robot has been are
    no island.
    """
    model, data, ids = host.model, host.data, walls(host)
    if not ids:
        return {}
    found: dict[str, int] = {}
    for group in touching(model, data, ids):
        corners = data.geom_xpos[group][:, :2]
        size = model.geom_rbound[group][:, None]
        low, high = (corners - size).min(axis=0), (corners + size).max(axis=0)
        if (low < places.min(axis=0)).all() and (high > places.max(axis=0)).all():
            continue
        middle = group[int(np.linalg.norm(corners - corners.mean(axis=0), axis=1).argmin())]
        found[f"island {len(found) + 1}"] = middle
    return found


def bounds_of(
    host: Host,
    chart: Sequence[Coordinate],
    samples: np.ndarray,
    given: dict[str, tuple[float, float]],
) -> list[Bound]:
    """Returns the ends of the chart's coordinates.

    Args:
        host: the environment.
        chart: its coordinates.
        samples: (n, d) chart points that sampled runs have met.
        given: ends that the user has given, by name.
    """
    model, found = host.model, []
    for i, c in enumerate(chart):
        if c.name in given:
            low, high = given[c.name]
            found.append(Bound(float(low), float(high), False, "given"))
        elif c.kind == "qpos" and model.jnt_limited[c.joint]:
            low, high = model.jnt_range[c.joint] + c.offset
            found.append(Bound(float(low), float(high), False, "the range of its joint"))
        elif c.kind == "qpos" and c.axis is None:
            found.append(Bound(-np.pi + c.offset, np.pi + c.offset, True, "a joint without limits"))
        elif c.kind == "qpos" and (ids := walls(host)):
            places, size = host.data.geom_xpos[ids][:, c.axis], model.geom_size[ids][:, c.axis]
            found.append(
                Bound(
                    float((places - size).min()), float((places + size).max()), False, "the walls"
                )
            )
        else:
            middle, half = np.median(samples[:, i]), np.ptp(samples[:, i]) / 2
            half = max(ROOM * half, 1e-3)
            found.append(Bound(float(middle - half), float(middle + half), False, "sampled runs"))
    return found
