"""What a task's runs pass: the obstacles of its MJCF, and the numbers and names of the ways past them."""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics import mjcf

LEFT, RIGHT, ANY = 0, 1, -1
# A way past more obstacles has no number.
MOST_OBSTACLES = 30
SIDES = ("left", "right")


def islands(model: mujoco.MjModel) -> dict[str, int]:
    """Returns the obstacles by name, each with the id of a geom that stands for it.

    These are the geoms whose names begin with "obstacle", but no planes, which nothing passes. Those that
    touch each other, as the walls of a maze, are one obstacle, of the name of the first. The name is what
    follows "obstacle".

    Raises:
        BadInput: there are more than `MOST_OBSTACLES`, or two have one name.
    """
    geoms = mjcf.obstacles(model)
    ids = [mjcf.object_id(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in geoms]
    ids = [i for i in ids if model.geom_type[i] != mujoco.mjtGeom.mjGEOM_PLANE]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    kept = [group[0] for group in touching(model, data, ids)]
    if len(kept) > MOST_OBSTACLES:
        raise BadInput(
            f"{mjcf.model_name(model)} has {len(kept)} obstacles, and ways are told apart past at most "
            f"{MOST_OBSTACLES}: give the task a direction() of its own"
        )
    found = {i: model.geom(i).name.removeprefix("obstacle").lstrip("_ ") for i in kept}
    for name, count in Counter(found.values()).items():
        if count > 1:
            raise BadInput(
                f"{count} obstacles of {mjcf.model_name(model)} have the name {name!r}, what follows "
                '"obstacle" and "_" in the names of their geoms: give each another one'
            )
    return {name: i for i, name in found.items()}


def touching(model: mujoco.MjModel, data: mujoco.MjData, ids: Sequence[int]) -> list[list[int]]:
    """Returns the geoms of ids (k,) in groups of those that touch each other, and do not move."""
    from scipy.sparse.csgraph import connected_components  # slow to import

    touch = np.zeros((len(ids), len(ids)), dtype=bool)
    for i, k in combinations(range(len(ids)), 2):
        if not mjcf.geoms_move(model, [ids[i], ids[k]]):
            touch[i, k] = mujoco.mj_geomDistance(model, data, ids[k], ids[i], 1e-3, None) <= 1e-6
    count, group = connected_components(touch, directed=False)
    return [[ids[i] for i in np.flatnonzero(group == k).tolist()] for k in range(count)]


def length(vector: np.ndarray) -> np.ndarray:
    """Returns the lengths (...) of vectors (..., 2)."""
    x, y = vector[..., 0], vector[..., 1]
    return np.sqrt(x * x + y * y)


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Returns angles in [-pi, pi) [rad]."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def sides(angle: np.ndarray, half: np.ndarray | float = np.pi / 2) -> np.ndarray:
    """Returns the side on which runs pass obstacles: `LEFT`, `RIGHT` or `ANY`, (n, K) int.

    Args:
        angle: (n, K) at which the start of a run is seen from an obstacle, counted from the end of the run
            and followed back along it [rad].
        half: the obstacle lies between start and end if this angle is no smaller [rad]; by default a right
            one: it lies in the circle over start and end.
    """
    return np.where(np.abs(angle) < half, ANY, np.where(angle > 0, LEFT, RIGHT))


def sides_of_paths(path: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Returns the sides (n, K) on which paths (S, n, 2) pass obstacles at centres (K, 2) or (S, n, K, 2)."""
    away = path[:, :, None] - centres
    bearing = np.arctan2(away[..., 1], away[..., 0])
    return sides(-wrapped(np.diff(bearing, axis=0)).sum(axis=0))


def number_of(pattern: np.ndarray) -> np.ndarray:
    """Returns the numbers (n,) int of patterns (n, K) of `LEFT`, `RIGHT` and `ANY`.

    Bit k is set where obstacle k is passed on the right, bit K + k where any side will do. The way to the
    left of a single obstacle has the number 0, that to its right 1.
    """
    bits = 1 << np.arange(2 * pattern.shape[1])
    return np.asarray(np.hstack([pattern == RIGHT, pattern == ANY]) @ bits)


def pattern_of(number: int, obstacles: int) -> np.ndarray:
    """Returns the pattern (K,) of a number, for K obstacles: the inverse of `number_of`."""
    bits = (number >> np.arange(2 * obstacles)) & 1
    return np.where(bits[obstacles:], ANY, np.where(bits[:obstacles], RIGHT, LEFT))


def way_name(pattern: np.ndarray, names: Sequence[str]) -> str:
    """Returns the name of a way: "left" past a single obstacle, else "left of a, right of b"."""
    if len(names) == 1:
        return "either side" if pattern[0] == ANY else SIDES[pattern[0]]
    sides = [
        f"{SIDES[side]} of {name or 'the obstacle'}"
        for side, name in zip(pattern, names, strict=True)
        if side != ANY
    ]
    return ", ".join(sides) or "any way"
