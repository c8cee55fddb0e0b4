"""A hybrid controller for fields: a mode is the post in focus, its side, and the sense of turning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hyrl_mj.fields.focus import Seen, at, choose, turn_sense
from hyrl_mj.policies import Policy, check_modes
from hyrl_mj.tasks import Field, FieldTask, only_post, wrapped

# Modes of a post: two sides, with two senses of turning each.
MODES_OF_POST = 4


@dataclass(frozen=True)
class FocusController:
    """H with the logic state (q, lambda): lambda is the post in focus, and q the side on which it is passed.

    Two policies, which were trained on one post, pass any number of posts. With its back to its way a robot
    has another decision to make: in which sense it turns round. The mode holds that, too.

    Attributes:
        task: the field.
        local: the task on which the policies were trained.
        policies: the policy of each side.
    """

    task: FieldTask
    local: Field
    policies: Mapping[int, Policy]

    @cached_property
    def modes(self) -> tuple[int, ...]:
        """The modes, in ascending order."""
        return tuple(range(MODES_OF_POST * self.task.layouts.posts))

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        """Returns the modes (n,) to start in, from the first measurements (n, p)."""
        nothing = np.full(len(measured), -1)
        return self._next(measured, nothing, nothing, np.zeros(len(measured)))[0]

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,) for modes (n,) and measurements (n, p).

        Raises:
            BadInput: a mode that the field does not have, or a measurement that is not finite.
        """
        q_next, seen = self._next(measured, *decoded(check_modes(q, self.modes)))
        _, side, _ = decoded(q_next)
        u = np.empty((len(q), len(self.task.inputs)))
        for number, policy in self.policies.items():
            rows = side == number
            if rows.any():
                u[rows] = policy.act(seen[rows])
        return u, q_next

    def _next(
        self, measured: np.ndarray, focus: np.ndarray, side: np.ndarray, sense: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the modes (n,) after those of before, and what the policies see (n, 11)."""
        pair = choose(Seen.of(measured), focus, side)
        view = alone(measured, pair.focus, sense)
        directions, _ = self.local.directions(view)
        turn = wrapped(at(directions, pair.side) - measured[:, 2])
        view[:, -1] = turn_sense(turn, sense)
        return encoded(pair.focus, pair.side, view[:, -1]), view


def alone(measured: np.ndarray, focus: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns measurements (n, 11) of the posts in focus (n,) alone, with senses of turning (n,)."""
    return np.hstack([only_post(measured, focus), sense[:, None]])


def encoded(focus: np.ndarray, side: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns the modes (n,) of posts in focus (n,), sides (n,) and senses of turning (n,)."""
    return MODES_OF_POST * focus + 2 * side + (sense < 0)


def decoded(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns focus (n,), side (n,) and sense of turning (n,) of modes (n,)."""
    return q // MODES_OF_POST, q // 2 % 2, 1 - 2 * (q % 2)
