"""What any task gives to those who do not know of fields; one on which fields are trained gives more."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeGuard

from hyrl_mj.errors import BadInput
from hyrl_mj.fields.controller import FocusController, GuardedPolicy, for_posts
from hyrl_mj.fields.files import read_field
from hyrl_mj.policies import HybridController, MlpPolicy, Policy
from hyrl_mj.tasks import Field, Task


def is_local(task: Task) -> TypeGuard[Field]:
    """Returns whether policies that are trained on a task can drive through fields of posts."""
    return isinstance(task, Field)


def acting_policy(task: Task, policy: Policy, mode: int, eps: float) -> Policy:
    """Returns what acts in a mode under noise of a bound, from the policy that was trained for the mode.

    On the task of fields this is the policy with a guard, on others the policy itself.

    Raises:
        BadInput: the guard needs a network, which the policy is not.
    """
    if not is_local(task):
        return policy
    if not isinstance(policy, MlpPolicy):
        raise BadInput(
            f"the policy of mode {mode} is a {type(policy).__name__}, and {task.name} takes networks: train "
            f"them with hyrl-mj run {task.name}"
        )
    return GuardedPolicy(task, policy, mode, eps)


def exported_controller(
    controller: HybridController, field: Path | None = None
) -> HybridController | FocusController:
    """Returns the controller to take away: the hybrid controller of a run, or one for fields.

    Args:
        controller: of a run.
        field: the file of a field with as many posts as the controller will see; by default one post.

    Raises:
        BadInput: the file is none of a field, or the task has no use for one.
    """
    task = controller.task
    if is_local(task):
        sides: dict[int, Any] = {**controller.policies}  # with guards
        eps = next(iter(sides.values())).eps
        posts = 1 if field is None else read_field(field).layouts.posts
        return for_posts(task, {q: side.policy for q, side in sides.items()}, eps, posts)
    if field is not None:
        raise BadInput(f"{task.name} has no field of posts: leave --field out")
    return controller
