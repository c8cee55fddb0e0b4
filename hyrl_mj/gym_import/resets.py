"""What the resets of an environment lead to, and what of it follows from the place of the robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.gym_import.attributes import numbers_in
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.fingerprint import differing
from hyrl_mj.gym_import.instance import Instance

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
    values, of_model = dict[str, list[Any]](), dict[str, np.ndarray]()
    rows, first = list[dict[str, np.ndarray]](), None
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
                of_part = of_model.setdefault(name, np.tile(usual, (RESETS, 1)))
                of_part[seed] = part.ravel()
        rows.append(numbers_in(instance.inner))
    tables = {**of_model, **tabled(rows)}
    tables = {name: table for name, table in tables.items() if (table != table[0]).any()}
    return Resets(np.array(states), differ, tables, violation)


def tabled(rows: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Returns a table (n, k) of each name by which n rows have k numbers."""
    names = [
        n for n, numbers in rows[0].items() if all(_is_as(row.get(n), numbers) for row in rows)
    ]
    return {name: np.array([row[name] for row in rows]) for name in names}


def _is_as(numbers: np.ndarray | None, others: np.ndarray) -> bool:
    return numbers is not None and len(numbers) == len(others)


def violation_of(instance: Instance, joints: bool = False) -> float:
    """Returns by how much equality constraints and limits of tendons are violated at most [m, rad].

    With `joints`, those of joints, too.
    """
    kinds, off, kind = instance.data.efc_type, instance.data.efc_pos, mujoco.mjtConstraint
    limits = [kind.mjCNSTR_LIMIT_TENDON] + [kind.mjCNSTR_LIMIT_JOINT] * joints
    equal, beyond = np.abs(off[kinds == kind.mjCNSTR_EQUALITY]), -off[np.isin(kinds, limits)]
    return float(np.append(equal, beyond).max(initial=0.0))


# ---- what follows the place


# What gives numbers (k,) at a state (S,).
Predict = Callable[[np.ndarray], np.ndarray]


def terms_of(instance: Instance, states: np.ndarray) -> np.ndarray:
    """Returns the terms (n, t), of states (n, S), that what follows from the robot's place is a sum of."""
    spec = instance.spec
    own = [i for i in own_of(instance) if i in spec.qpos and i not in spec.places]
    others = [states[:, own]] if len(own) < RESETS // 2 else []
    return np.column_stack([spec.terms(spec.z(states)), *others])


def predicted(instance: Instance, states: np.ndarray, table: np.ndarray) -> Predict | None:
    """Returns what gives numbers, as tables (n, k) of states (n, S) hold them; None if none follows it.

    A number, or its square as of a distance, may be a sum of the terms. One that does not follow the place
    is NaN.
    """
    if not np.isfinite(table).all():
        return None
    terms, varies = terms_of(instance, states), np.ptp(table, axis=0) > 1e-9
    plain, square = (np.linalg.lstsq(terms, t, rcond=None)[0] for t in (table, table**2))

    def exact(fit: np.ndarray, values: np.ndarray) -> np.ndarray:
        off = np.abs(terms @ fit - values).max(axis=0)
        return varies & (off <= 1e-6 * np.maximum(np.ptp(values, axis=0), 1e-9))

    is_plain = exact(plain, table)
    is_square = exact(square, table**2) & ~is_plain & (table >= 0).all(axis=0)
    if not (is_plain | is_square).any():
        return None

    def predict(state: np.ndarray) -> np.ndarray:
        of = terms_of(instance, state[None])[0]
        root = np.sqrt(np.maximum(of @ square, 0))
        return np.where(is_plain, of @ plain, np.where(is_square, root, np.nan))

    return predict


def following(
    instance: Instance, states: np.ndarray, tables: Mapping[str, np.ndarray]
) -> dict[str, Predict]:
    """Returns what gives numbers, by the names of their tables (n, k) of states (n, S), if they follow it."""
    found = {name: predicted(instance, states, table) for name, table in tables.items()}
    return {name: predict for name, predict in found.items() if predict is not None}


def follows(instance: Instance, resets: Resets, name: str) -> bool:
    """Returns whether an attribute or a part of the model follows the place that resets lead to."""
    if (table := resets.numbers.get(name)) is None:
        return False
    if (predict := predicted(instance, resets.states, table)) is None:
        return False
    told = np.array([predict(state) for state in resets.states])
    return np.allclose(np.where(np.isnan(told), table[0], told), table, SAME, SAME)
