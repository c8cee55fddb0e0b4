"""A hybrid controller for fields: a mode is the post in focus, its side, and the sense of turning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hyrl_mj.fields.driving import Driving
from hyrl_mj.fields.focus import Seen, choose, turn_sense
from hyrl_mj.fields.guard import Guard
from hyrl_mj.fields.modes import MODES_OF_POST, NO_MODE, decoded, encoded
from hyrl_mj.policies import (
    Controller,
    ObservationPolicy,
    PolicyController,
    check_modes,
)
from hyrl_mj.tasks import LEFT, RIGHT, Field, FieldTask, only_post, wrapped

# The swing of measurements without noise: decisions must not follow rounding errors [m].
LEAST_SWING = 0.1


@dataclass(frozen=True)
class FocusController:
    """H with the logic state (q, lambda): lambda is the post in focus, and q the side on which it is passed.

    Two policies, which were trained on one post, pass any number of posts. With its back to its way a robot
    has another decision to make: in which sense it turns round. The mode holds that, too.

    Attributes:
        task: the field.
        local: the task on which the policies were trained.
        policies: the policy of each side.
        noise: largest error of a measured coordinate [m] that the guard keeps away from posts for.
        first_side: the side on which the first post in focus is passed; None for the shorter way.
    """

    task: FieldTask
    local: Field
    policies: Mapping[int, ObservationPolicy]
    noise: float
    first_side: int | None = None

    @cached_property
    def modes(self) -> tuple[int, ...]:
        """The modes, in ascending order."""
        return tuple(range(MODES_OF_POST * self.task.layouts.posts))

    @cached_property
    def swing(self) -> float:
        """How far two measurements of the same place can be from each other [m], or a little more."""
        return max(2 * float(np.sqrt(2.0)) * self.noise, LEAST_SWING)

    @cached_property
    def guard(self) -> Guard:
        """What keeps the robot away from posts, and going."""
        low, high = self.task.input_limits
        return Guard(self.task.body, self.noise, float(low[0]), float(high[0]), float(high[1]))

    def on_side(self, side: int) -> FocusController:
        """Returns this controller with the side on which it passes the first post in focus."""
        return replace(self, first_side=side)

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        """Returns the modes (n,) to start in, from the first measurements (n, p).

        Raises:
            BadInput: a wrong shape, or a measurement that is not finite.
        """
        measured = self.task.check_measurement(measured)
        return self.answer(np.full(len(measured), NO_MODE), measured)[1]

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,) for modes (n,) and measurements (n, p).

        Raises:
            BadInput: a mode that the field does not have, a wrong shape, or a measurement that is not finite.
        """
        return self.answer(check_modes(q, self.modes), self.task.check_measurement(measured))

    def answer(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Does `step` without checks and without branches, so that it can be exported.

        The mode -1 stands for none: the answer begins in the initial mode.
        """
        seen, (focus, side, sense) = Seen.of(measured), decoded(q)
        pair = choose(seen, focus, side, self.swing, self.guard.margin)
        side = pair.side
        if self.first_side is not None:
            side = np.where(q < 0, self.first_side, side)
        view = only_post(measured, pair.focus)
        directions, lengths = self.local.directions(view)
        direction = np.where(side == LEFT, directions[:, 0], directions[:, 1])
        turn = wrapped(direction - view[:, 2])
        sense = turn_sense(turn, sense)
        view = np.hstack([view, sense[:, None]])
        observed = self.local.observed(view, directions, lengths)
        u = self._of_policies(observed, side)
        u = self.guard.inputs(seen, u, turn, sense)
        return u, encoded(pair.focus, side, sense)

    def _of_policies(self, observed: np.ndarray, side: np.ndarray) -> np.ndarray:
        """Returns the inputs (n, m) of the policies of sides (n,) for observations (n, 17)."""
        left = side == LEFT
        for number, mine in ((LEFT, left), (RIGHT, ~left)):
            if isinstance(mine, np.ndarray) and mine.all():  # an export does not know
                return self.policies[number].inputs(observed)
        both = [self.policies[number].inputs(observed) for number in (LEFT, RIGHT)]
        return np.where(left[:, None], *both)


@dataclass(frozen=True)
class WithoutMemory:
    """A policy that was trained on one post, in a field: it sees the post that would be in focus at first.

    Attributes:
        task: the field.
        local: the task on which the policy was trained.
        policy: such as the stage-1 policy.
    """

    task: FieldTask
    local: Field
    policy: ObservationPolicy

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) for measurements (n, p).

        Raises:
            BadInput: a wrong shape, or a measurement that is not finite.
        """
        measured = self.task.check_measurement(measured)
        nothing = np.full(len(measured), -1)
        view = only_post(measured, choose(Seen.of(measured), nothing, nothing).focus)
        return self.policy.inputs(
            self.local.observation(np.hstack([view, np.zeros_like(view[:, :1])]))
        )


def controllers(
    task: Driving,
    policy: ObservationPolicy,
    policies: Mapping[int, ObservationPolicy],
    noise: float,
) -> dict[str, Controller]:
    """Returns the controllers of a field by name: the stage-1 policy alone, and the hybrid controller.

    The noise [m] is what the hybrid controller has to bear.
    """
    return {
        "policy": PolicyController(WithoutMemory(task, task.local, policy)),
        "hyrl": FocusController(task, task.local, policies, noise),
    }
