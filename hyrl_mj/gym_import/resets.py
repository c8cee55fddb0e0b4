"""What the resets of an environment lead to."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from hyrl_mj.gym_import.fingerprint import differing
from hyrl_mj.gym_import.instance import Instance

# Resets that are looked at.
RESETS = 64
# By how much computed numbers may differ, as a share: rounding.
SAME = 1e-6


@dataclass(frozen=True)
class Resets:
    """What the resets with the seeds 0 to 63 lead to.

    Attributes:
        states: MuJoCo's states (64, S).
        changes: the names of what each of them leaves otherwise than the first, but for generators.
        violation: by how much they violate equality constraints and limits of tendons at most [m, rad].
    """

    states: np.ndarray
    changes: list[set[str]]
    violation: float


def resets_of(instance: Instance) -> Resets:
    """Returns what resets lead to."""
    states, changes, violation, first = [], [], 0.0, None
    for seed in range(RESETS):
        instance.reset(seed)
        states.append(instance.physics.read())
        violation = max(violation, violation_of(instance))
        memory = instance.memory()
        first = first or memory
        names = {name for name in differing(first, memory) if "_seed" not in name}
        changes.append(names - memory.generators.keys())
    return Resets(np.array(states), changes, violation)


def violation_of(instance: Instance, joints: bool = False) -> float:
    """Returns by how much equality constraints and limits of tendons are violated at most [m, rad].

    With `joints`, those of joints, too.
    """
    kinds, off, kind = instance.data.efc_type, instance.data.efc_pos, mujoco.mjtConstraint
    limits = [kind.mjCNSTR_LIMIT_TENDON] + [kind.mjCNSTR_LIMIT_JOINT] * joints
    equal, beyond = np.abs(off[kinds == kind.mjCNSTR_EQUALITY]), -off[np.isin(kinds, limits)]
    return float(np.append(equal, beyond).max(initial=0.0))
