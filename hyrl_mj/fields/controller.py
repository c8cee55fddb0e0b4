"""Controllers for fields: a mode is the post in focus, its side, and the sense of turning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.fields.driving import Driving
from hyrl_mj.fields.files import MOST_POSTS, read_field
from hyrl_mj.fields.focus import MODES_OF_POST, choose, decoded, encoded, turn_sense
from hyrl_mj.fields.guard import Guard
from hyrl_mj.fields.seen import Seen
from hyrl_mj.policies import (
    Controller,
    HybridController,
    MlpPolicy,
    ObservationPolicy,
    Policy,
    PolicyController,
    check_modes,
)
from hyrl_mj.tasks import LEFT, RIGHT, Field, FieldTask, Layouts, Task, only_post, wrapped


def way_past(
    local: Field, view: np.ndarray, side: np.ndarray, sense: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the ways on sides (n,) of the one post of measurements (n, 10).

    Args:
        local: the task of the policies.
        view: (n, 10) measurements.
        side: (n,) on which the post is passed.
        sense: (n,) in which robots turned before, 0 for none.

    Returns:
        (n,) angles from the heading to the way [rad]; (n,) in which sense to turn, 1 against the clock, -1
        with it; (n, 17) what the policies observe.
    """
    directions, lengths = local.directions(view)
    direction = np.where(side == LEFT, directions[:, 0], directions[:, 1])
    turn = wrapped(direction - view[:, 2])
    sense = turn_sense(turn, sense)
    view = np.concatenate([view, sense[:, None]], axis=1)
    return turn, sense, local.observed(view, directions, lengths)


def guard_of(task: FieldTask, eps: float) -> Guard:
    """Returns what keeps a robot away from posts, and going; `noise` is the bound on its position [m]."""
    low, high = task.input_limits
    return Guard(task.body, eps, float(low[0]), float(high[0]), float(high[1]))


@dataclass(frozen=True)
class GuardedPolicy:
    """A policy of one side on the task that it was trained on, with the guard of fields.

    Attributes:
        task: with one post.
        policy: of the side.
        side: on which it passes the post.
        eps: largest error of a measured coordinate [m] that the guard keeps away from posts for.
    """

    task: Field
    policy: ObservationPolicy
    side: int
    eps: float

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) for measurements (n, p).

        Raises:
            BadInput: a wrong shape, or a measurement that is not finite.
        """
        measured = self.task.check_measurement(measured)
        side, sense = np.full(len(measured), self.side), np.zeros(len(measured))
        turn, sense, observed = way_past(self.task, measured[:, :-1], side, sense)
        u = self.policy.inputs(observed)
        return guard_of(self.task, self.eps).inputs(Seen(measured), u, turn, sense)


@dataclass(frozen=True)
class FocusController:
    """H with the logic state (q, lambda): lambda is the post in focus, and q the side on which it is passed.

    Two policies, which were trained on one post, pass any number of posts. With its back to its way a robot
    has another decision to make: in which sense it turns round. The mode holds that, too.

    Attributes:
        task: the field.
        policies: the policy of each side, trained on `task.local`.
        eps: largest error of a measured coordinate [m] that the guard keeps away from posts for.
        first_side: the side on which the first post in focus is passed; None for the shorter way.
    """

    task: Driving
    policies: Mapping[int, ObservationPolicy]
    eps: float
    first_side: int | None = None

    def __post_init__(self) -> None:
        if {*self.policies} != {LEFT, RIGHT}:
            raise BadInput(
                f"the run has {len(self.policies)} mode(s), but fields take a policy for each side, left and "
                "right: make one with hyrl-mj run field --out runs/field, perhaps with another --seed"
            )

    @cached_property
    def modes(self) -> tuple[int, ...]:
        """The modes, in ascending order."""
        return tuple(range(MODES_OF_POST * self.task.layouts.posts))

    @cached_property
    def swing(self) -> float:
        """How far two measurements of the same place can be from each other [m], or a little more."""
        # Without noise, decisions must not follow rounding errors.
        return max(2 * float(np.sqrt(2.0)) * self.eps, 0.1)

    @cached_property
    def guard(self) -> Guard:
        """What keeps the robot away from posts, and going."""
        return guard_of(self.task, self.eps)

    def on_side(self, side: int) -> FocusController:
        """Returns this controller with the side on which it passes the first post in focus."""
        return replace(self, first_side=side)

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        """Returns the modes (n,) to start in, from the first measurements (n, p).

        Raises:
            BadInput: a wrong shape, or a measurement that is not finite.
        """
        measured = self.task.check_measurement(measured)
        return self.begin(np.full(len(measured), -1), measured)[1]

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,) for modes (n,) and measurements (n, p).

        Raises:
            BadInput: a mode that the field does not have, a wrong shape, or a measurement that is not finite.
        """
        measured = self.task.check_measurement(measured)
        return self.answer(check_modes(q, self.modes), measured)

    def begin(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Does `answer`, and begins in the initial mode where q is -1: that of a second look.

        A first look may choose what a second one at the same measurement would change.
        """
        return self.answer(q, measured, looks=2)

    def answer(
        self, q: np.ndarray, measured: np.ndarray, looks: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Does `step` without checks and without branches, so that it can be exported.

        The mode -1 stands for none: focus and side are then chosen with so many looks.
        """
        seen, (focus, side, sense) = Seen(measured), decoded(q)
        for _ in range(looks - 1):
            first = choose(seen, focus, side, self.swing, self.guard.margin)
            focus, side = np.where(q < 0, first[0], focus), np.where(q < 0, first[1], side)
        focus, side = choose(seen, focus, side, self.swing, self.guard.margin)
        if self.first_side is not None:
            side = np.where(q < 0, self.first_side, side)
        turn, sense, observed = way_past(self.task.local, only_post(measured, focus), side, sense)
        u = self.guard.inputs(seen, self._of_policies(observed, side), turn, sense)
        return u, encoded(focus, side, sense)

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
        policy: trained on `task.local`, such as the stage-1 policy.
    """

    task: Driving
    policy: ObservationPolicy

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) for measurements (n, p).

        Raises:
            BadInput: a wrong shape, or a measurement that is not finite.
        """
        measured = self.task.check_measurement(measured)
        nothing = np.full(len(measured), -1)
        focus, _ = choose(Seen(measured), nothing, nothing)
        no_sense = np.zeros((len(measured), 1))
        view = np.hstack([only_post(measured, focus), no_sense])
        return self.policy.inputs(self.task.local.observation(view))


@dataclass(frozen=True)
class TangentLaw(ObservationPolicy):
    """A law without learning: speed cos t and rate of turn 4 t, for the angle t to the way past a post.

    Attributes:
        task: with one post.
        side: on which it passes the post.
    """

    task: Field
    side: int

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        """Returns inputs (n, 2) [m/s], [rad/s] for observations (n, 17)."""
        # Half the sum and half the difference of both sides' ways, each as a cosine and a sine.
        both, apart = observation[:, 10:12], observation[:, 12:14]
        way = both + apart if self.side == LEFT else both - apart
        turn = np.arctan2(way[:, 1], way[:, 0])
        inputs = np.stack([np.maximum(np.cos(turn), 0.0), 4 * turn], axis=1)
        return np.clip(inputs, *self.task.input_limits)


def for_posts(
    local: Field, policies: Mapping[int, ObservationPolicy], eps: float, posts: int
) -> FocusController:
    """Returns a controller for any field of so many posts, from 1 to `MOST_POSTS`.

    Args:
        local: the task on which the policies were trained.
        policies: of each side.
        eps: bound of the noise on the position [m].
        posts: number of posts.

    Raises:
        BadInput: there cannot be so many posts.
    """
    if not 1 <= posts <= MOST_POSTS:
        raise BadInput(f"a field cannot have {posts} posts: give from 1 to {MOST_POSTS}")
    # A field that has so many: rows of five posts, which the robot drives through.
    number = np.arange(posts)
    places = np.stack([-2.0 - 2 * (number // 5), 2.0 * (number % 5) - 4], axis=1)
    layouts = Layouts(places[None, None], np.full((1, posts), 0.5), np.zeros((1, 2)))
    return FocusController(Driving(local, layouts), policies, eps)


def controllers(
    task: Driving,
    policy: ObservationPolicy,
    policies: Mapping[int, ObservationPolicy],
    eps: float,
) -> dict[str, Controller]:
    """Returns the controllers of a field by name: the stage-1 policy alone, HyRL, and HyRL without learning.

    In the modes of the last one a law acts, which tells what is gained by learning. The noise [m] is what
    the hybrid controllers have to bear.
    """
    laws = {side: TangentLaw(task.local, side) for side in (LEFT, RIGHT)}
    return {
        "policy": PolicyController(WithoutMemory(task, policy)),
        "hyrl": FocusController(task, policies, eps),
        "law": FocusController(task, laws, eps),
    }


# ---- what any task gives to those who do not know of fields


def acting_policy(task: Task, policy: Policy, mode: int, eps: float) -> Policy:
    """Returns what acts in a mode under noise of a bound, from the policy that was trained for the mode.

    On the task of fields this is the policy with a guard, on others the policy itself.

    Raises:
        BadInput: the guard needs a network, which the policy is not.
    """
    if not isinstance(task, Field):
        return policy
    if not isinstance(policy, MlpPolicy):
        raise BadInput(
            f"the policy of mode {mode} is a {type(policy).__name__}, and {task.name} takes networks: train "
            f"them with hyrl-mj run {task.name}"
        )
    return GuardedPolicy(task, policy, mode, eps)


def exported_controller(
    controller: HybridController | FocusController, field: str | Path | None = None
) -> HybridController | FocusController:
    """Returns the controller to take away: a controller itself, or of a run of fields the one for fields.

    Args:
        controller: of a run, or one for fields.
        field: the file of a field with as many posts as the controller will see; by default one post.

    Raises:
        BadInput: the file is none of a field, or the task has no use for one.
    """
    guarded = {q: pi for q, pi in controller.policies.items() if isinstance(pi, GuardedPolicy)}
    if guarded:
        one = next(iter(guarded.values()))
        posts = 1 if field is None else read_field(field).layouts.posts
        return for_posts(one.task, {q: pi.policy for q, pi in guarded.items()}, one.eps, posts)
    if field is not None:
        raise BadInput(f"{controller.task.name} has no field of posts: leave --field out")
    return controller
