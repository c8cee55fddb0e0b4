"""What the resets of an environment lead to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.gym_import.attributes import numbers_in
from hyrl_mj.gym_import.fingerprint import differing
from hyrl_mj.gym_import.instance import Instance

# Resets that are looked at, and values of what they leave behind that are told apart.
RESETS, VALUES = 64, 8
# By how much computed numbers may differ, as a share: rounding.
SAME = 1e-6


@dataclass(frozen=True)
class Resets:
    """What the resets with the seeds 0 to 63 lead to.

    Attributes:
        states: MuJoCo's states (64, S).
        changes: what each of them leaves otherwise than the first, by name.
        sums: of the numbers that attributes and changed parts of the model hold after each, by name.
        violation: by how much they violate equality constraints and limits of tendons at most [m, rad].
    """

    states: np.ndarray
    changes: list[dict[str, Any]]
    sums: list[dict[str, float]]
    violation: float

    def telling(self, first: int, lasting: set[str]) -> list[int]:
        """Returns the first so many seeds, and those with other, the least and the greatest values.

        What is not drawn, but outlasts resets, is told by its names.
        """
        found = dict.fromkeys(range(first))
        for name in dict.fromkeys(n for change in self.changes for n in change if n not in lasting):
            values = [change.get(name) for change in self.changes]
            new = [seed for seed, value in enumerate(values) if value not in values[:seed]]
            sums = np.array([of.get(name, np.nan) for of in self.sums])
            if len(new) <= VALUES:
                found |= dict.fromkeys(new)
            elif np.isfinite(sums).any():
                found |= dict.fromkeys((int(np.nanargmin(sums)), int(np.nanargmax(sums))))
        return list(found)[:20]


def resets_of(instance: Instance) -> Resets:
    """Returns what resets lead to."""
    states, changes, sums, violation, first = [], [], [], 0.0, None
    parts = {f"{name} of its model": part for name, part in instance.physics.parts.items()}
    for seed in range(RESETS):
        instance.reset(seed)
        states.append(instance.physics.read())
        violation = max(violation, violation_of(instance))
        memory = instance.memory()
        first = first or memory
        changes.append({name: memory.get(name) for name in differing(first, memory)})
        changed = {name: parts[name] for name in changes[-1].keys() & parts.keys()}
        numbers = numbers_in(instance.inner) | changed
        sums.append({name: float(np.sum(of)) for name, of in numbers.items()})
    return Resets(np.array(states), changes, sums, violation)


def violation_of(instance: Instance, joints: bool = False) -> float:
    """Returns by how much equality constraints and limits of tendons are violated at most [m, rad].

    With `joints`, those of joints, too.
    """
    kinds, off, kind = instance.data.efc_type, instance.data.efc_pos, mujoco.mjtConstraint
    limits = [kind.mjCNSTR_LIMIT_TENDON] + [kind.mjCNSTR_LIMIT_JOINT] * joints
    equal, beyond = np.abs(off[kinds == kind.mjCNSTR_EQUALITY]), -off[np.isin(kinds, limits)]
    return float(np.append(equal, beyond).max(initial=0.0))
