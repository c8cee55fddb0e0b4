"""What the resets of an environment lead to, and what of it follows from the place of the robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.fingerprint import differing
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.uses import held, numbers_of

# Resets that are looked at, and values of what they leave behind that are told apart.
RESETS, VALUES = 64, 8
# What is added to names of parts of the model.
OF_MODEL = " of its model"
# By how much computed numbers may differ, as a share: rounding.
SAME = 1e-6


@dataclass(frozen=True)
class Resets:
    """What the resets with the seeds 0 to 63 lead to.

    Attributes:
        states: MuJoCo's states (64, S).
        differ: the names of what is remembered otherwise than after the first reset, each with the seeds that
            bring a value for the first time, `VALUES` at most.
        numbers: (64, k) of the attributes and parts of the model that differ and are numbers, by name.
        violation: by how much they violate equality constraints and limits of tendons at most [m, rad].
    """

    states: np.ndarray
    differ: dict[str, list[int]]
    numbers: dict[str, np.ndarray]
    violation: float

    def telling(self, first: int, lasting: set[str]) -> list[int]:
        """Returns the first so many seeds, and those with other, the least and the greatest values.

        What is not drawn, but outlasts resets, is told by its names.
        """
        found = dict.fromkeys(range(first))
        for name, seeds in self.differ.items():
            if name in lasting:
                continue
            if len(seeds) < VALUES:
                found |= dict.fromkeys(seeds)
            elif name in self.numbers:
                column = self.numbers[name][:, np.ptp(self.numbers[name], axis=0).argmax()]
                found |= dict.fromkeys((int(column.argmin()), int(column.argmax())))
        return list(found)[:20]


def resets_of(instance: Instance) -> Resets:
    """Returns what resets lead to."""
    states, differ, violation = [], dict[str, list[int]](), 0.0
    values, numbers = dict[str, list[Any]](), dict[str, dict[int, np.ndarray]]()
    first = None
    for seed in range(RESETS):
        instance.reset(seed)
        states.append(instance.physics.read())
        violation = max(violation, violation_of(instance))
        memory = instance.memory()
        first = first or memory
        for name in differing(first, memory):
            known = values.setdefault(name, [first.get(name)])
            if len(known) <= VALUES and memory.get(name) not in known:
                known.append(memory.get(name))
                differ.setdefault(name, []).append(seed)
            if name.endswith(OF_MODEL) and name != f"opt{OF_MODEL}":
                part = getattr(instance.model, name.removesuffix(OF_MODEL))
                usual = np.frombuffer(first[name], part.dtype).astype(float)
                of_part = numbers.setdefault(name, dict.fromkeys(range(RESETS), usual))
                of_part[seed] = part.ravel().astype(float)
        for name, owner, key in held(instance.inner, {}):
            if (found := numbers_of(owner[key])) is not None:
                numbers.setdefault(name.removeprefix("attribute "), {})[seed] = found
    tables = {
        name: np.array([*rows.values()])
        for name, rows in numbers.items()
        if len(rows) == RESETS and len({len(row) for row in rows.values()}) == 1
    }
    tables = {name: table for name, table in tables.items() if (table != table[0]).any()}
    return Resets(np.array(states), differ, tables, violation)


def violation_of(instance: Instance) -> float:
    """Returns by how much equality constraints and limits of tendons are violated at most [m, rad]."""
    kinds, off = instance.data.efc_type, instance.data.efc_pos
    equal = np.abs(off[kinds == mujoco.mjtConstraint.mjCNSTR_EQUALITY])
    beyond = -off[kinds == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON]
    return float(np.append(equal, beyond).max(initial=0.0))


# ---- what follows the place


def terms_of(spec: EnvironmentSpec, model: mujoco.MjModel, states: np.ndarray) -> np.ndarray:
    """Returns the terms (n, t), of states (n, S), that what follows from the robot's place is a sum of."""
    own = [i for i in own_of(spec, model) if i in spec.qpos and i not in spec.places]
    others = [states[:, own]] if len(own) < RESETS // 2 else []
    return np.column_stack([spec.terms(spec.z(states)), *others])


Predict = Callable[[np.ndarray], np.ndarray]


def predicted(terms: np.ndarray, table: np.ndarray) -> Predict | None:
    """Returns what gives the columns of a table (n, k) from terms (t,), where these tell some that vary.

    A column, or its square as of a distance, may be a sum of the terms; the others stay as in the first row.
    """
    varies = np.ptp(table, axis=0) > 1e-9
    plain, square = (np.linalg.lstsq(terms, t, rcond=None)[0] for t in (table, table**2))

    def exact(fit: np.ndarray, values: np.ndarray) -> np.ndarray:
        off = np.abs(terms @ fit - values).max(axis=0)
        return varies & (off <= 1e-6 * np.maximum(np.ptp(values, axis=0), 1e-9))

    is_plain = exact(plain, table)
    is_square = exact(square, table**2) & ~is_plain & (table >= 0).all(axis=0)
    if not (is_plain | is_square).any():
        return None

    def predict(of: np.ndarray) -> np.ndarray:
        root = np.sqrt(np.maximum(of @ square, 0))
        return np.where(is_plain, of @ plain, np.where(is_square, root, table[0]))

    return predict


def follows(spec: EnvironmentSpec, model: mujoco.MjModel, resets: Resets, name: str) -> bool:
    """Returns whether an attribute or a part of the model follows the place that resets lead to."""
    if (table := resets.numbers.get(name)) is None:
        return False
    terms = terms_of(spec, model, resets.states)
    predict = predicted(terms, table)
    return predict is not None and np.allclose([predict(of) for of in terms], table, SAME, SAME)
