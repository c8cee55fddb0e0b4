"""Stage 7 (paper, Step 7): the hybrid system that joins the mode policies with hysteresis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.policies.controllers import check_inputs, check_modes
from hyrl_mj.policies.mlp import Policy
from hyrl_mj.sets import Complement, StateSet

if TYPE_CHECKING:
    from hyrl_mj.tasks import Task

# A point this close to the edge of a flow set is on the edge [chart units].
ON_EDGE = 1e-9
Rows = np.ndarray | slice


@dataclass(frozen=True)
class HybridController:
    """H = (C, F, D, G) with state (z, q) (paper, Step 7, equations (9) and (10)), sampled.

    In mode q the policy pi_q flows on C_q = M_ext_q. On D_q, the closure of the rest, q jumps to the other
    mode; among several, to the one whose flow set holds z most deeply. On the edge, where both are allowed,
    the controller flows, so that noise of exactly the bound does not switch the mode. The controller is a
    pure function of measurement and mode.

    Attributes:
        task: gives the chart and checks measurements.
        policies: the policy of each mode.
        flow_sets: C_q of each mode.
        starts: a set for each mode that selects the start mode; by default the flow sets.
    """

    task: Task
    policies: Mapping[int, Policy]
    flow_sets: Mapping[int, StateSet]
    starts: Mapping[int, StateSet] | None = None

    def __post_init__(self) -> None:
        starts = self.flow_sets if self.starts is None else self.starts
        for name, sets in {"flow sets": self.flow_sets, "start sets": starts}.items():
            if set(sets) != set(self.policies) or not sets:
                raise BadInput(
                    f"{name} of modes {sorted(sets)} do not fit policies of modes "
                    f"{sorted(self.policies)}: give one of each for every mode"
                )

    def __repr__(self) -> str:
        return f"HybridController({self.task.name}, modes {', '.join(map(str, self.modes))})"

    @cached_property
    def modes(self) -> tuple[int, ...]:
        """The modes, in ascending order."""
        return tuple(sorted(self.policies))

    def flow_set(self, q: int) -> StateSet:
        """Returns C_q, where mode q flows."""
        check_modes(np.array([q]), self.modes)
        return self.flow_sets[q]

    def jump_set(self, q: int) -> StateSet:
        """Returns D_q, where mode q jumps."""
        return Complement(self.flow_set(q))

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        """Returns the modes (n,) whose start sets hold the first measurements (n, p) most deeply."""
        z = self.task.z(self.task.check_measurement(measured))
        return self._deepest(self.modes, z, self.starts or self.flow_sets)

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Computes one sample: modes jump where z lies in D_q, then u = pi_q(measured).

        Args:
            q: (n,) int modes.
            measured: (n, p) measurements.

        Returns:
            u (n, m), inputs in the plant's units; q_next (n,) int, the modes after the jumps.

        Raises:
            BadInput: wrong shapes, values that are not finite, or unknown modes.
        """
        measured = self.task.check_measurement(measured)
        q, n = np.asarray(q), len(measured)
        if q.shape != (n,):
            raise BadInput(f"{n} measurements need q of shape ({n},), got {q.shape}")
        rows_of = self._rows(q)
        q_next = self._jump(q, self.task.z(measured), rows_of)
        if q_next is not q:
            rows_of = self._rows(q_next)
        m = len(self.task.inputs)
        u = np.empty((n, m))
        for mode, rows in rows_of.items():
            asked = measured[rows]
            u[rows] = check_inputs(self.policies[mode].act(asked), len(asked), m)
        return u, q_next.astype(int)

    def _jump(self, q: np.ndarray, z: np.ndarray, rows_of: dict[int, Rows]) -> np.ndarray:
        """Returns the modes (n,) after the jumps from z (n, d); q itself without jumps."""
        q_next = q
        for mode, rows in rows_of.items():
            # What is not a number is looked at where it jumps.
            distance = self.flow_sets[mode].signed_distance(z[rows])
            jumps = ~np.less_equal(distance, ON_EDGE)
            if len(self.modes) > 1 and np.count_nonzero(jumps):
                self._check_distance(mode, distance, z[rows])
                others = [other for other in self.modes if other != mode]
                q_next = q.copy() if q_next is q else q_next
                jumping = np.arange(len(q))[rows][jumps]
                q_next[jumping] = self._deepest(others, z[jumping], self.flow_sets)
        return q_next

    def _deepest(
        self, modes: Sequence[int], z: np.ndarray, sets: Mapping[int, StateSet]
    ) -> np.ndarray:
        """Returns those of the modes (n,) whose sets hold z (n, d) most deeply."""
        if len(modes) == 1:
            return np.full(len(z), modes[0])
        distances = [sets[q].signed_distance(z) for q in modes]
        for mode, distance in zip(modes, distances, strict=True):
            self._check_distance(mode, distance, z)
        return np.array(modes)[np.argmin(distances, axis=0)]

    def _check_distance(self, mode: int, distance: np.ndarray, z: np.ndarray) -> None:
        """Raises `BadInput` unless a set of a mode, maybe a user's, gives a number for each point (n, d)."""
        found = np.asarray(distance)
        if found.shape != (len(z),) or found.dtype.kind != "f":
            raise BadInput(
                f"the set of mode {mode} gives signed distances of {found.dtype} and shape {found.shape} for "
                f"{len(z)} points: give floats of shape ({len(z)},)"
            )
        if (blank := np.isnan(found)).any():
            point = self.task.chart.format(z[int(blank.argmax())])
            raise BadInput(
                f"the signed distance to the set of mode {mode} is nan at {point}: give numbers, negative "
                "inside and positive outside"
            )

    def _rows(self, q: np.ndarray) -> dict[int, Rows]:
        """Returns the rows of q (n,) in each mode that occurs; refuses unknown modes."""
        if len(q) == 1 and q[0] in self.modes:
            return {int(q[0]): slice(None)}  # without a copy
        rows = {mode: (q == mode).nonzero()[0] for mode in self.modes}
        if sum(map(len, rows.values())) < len(q):
            check_modes(q, self.modes)
        return {mode: r for mode, r in rows.items() if len(r)}
