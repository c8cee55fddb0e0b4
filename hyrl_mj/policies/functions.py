"""Policies that are functions of the observation: Python functions, modules of torch."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput, brief
from hyrl_mj.policies.mlp import ObservationPolicy
from hyrl_mj.tasks import Task, at_levels, get_task


@dataclass(frozen=True)
class FunctionPolicy(ObservationPolicy):
    """A function of the observation as a policy.

    Attributes:
        function: observations (n, k) -> inputs (n, m) in the plant's units, which are clipped to the task's
            limits. For a discrete task: the numbers of the levels (n,) int, or preferences
            (n, levels).
        name: what messages call it.
    """

    task: Task
    function: Callable[[np.ndarray], Any]
    name: str = "the function"

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        n, m = len(observation), len(self.task.inputs)
        if not n:
            return np.zeros((0, m))
        discrete = self.task.input_levels is not None
        try:
            kind = np.float64 if self.task.observation_dtype == "float64" else np.float32
            answer = self.function(observation.astype(kind))
            if isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], np.ndarray):
                raise BadInput(
                    "it returns a tuple, as the predict() of SB3 does: give its first part, as lambda o: "
                    "model.predict(o)[0]"
                )
            actions = np.asarray(answer)
            if discrete and actions.ndim > 1 and actions.dtype.kind == "f":
                actions = _preferred(actions, self.task)
        except Exception as error:  # a user's code can raise anything
            what = error if isinstance(error, BadInput) else f"it raised {brief(error)}"
            raise BadInput(f"{self.name} cannot be used: {what}") from error
        shape, what = ((n,), "integers") if discrete else ((n, m), "inputs")
        if actions.shape != shape:
            raise BadInput(
                f"{self.name} gives shape {actions.shape} for {n} observations, {self.task.name} takes "
                f"{what} of shape {shape}"
            )
        if discrete:
            return at_levels(self.task, actions)
        try:
            if actions.dtype.kind == "c":
                raise TypeError
            actions = actions.astype(float)
        except (TypeError, ValueError):
            raise BadInput(f"{self.name} gives {actions.flat[0]!r}: an input is a number") from None
        finite = np.isfinite(actions)
        if not finite.all():
            raise BadInput(
                f"{self.name} gives {actions[~finite][0]}: inputs of {self.task.name} are finite numbers"
            )
        return np.clip(actions, *self.task.input_limits)


def from_callable(function: Callable[[np.ndarray], Any], task: Task) -> FunctionPolicy:
    """Returns a function of the observation as a policy.

    Args:
        function: observations (n, k), float32, or float64 where an environment of others observes that ->
            inputs (n, m) in the plant's units, which are clipped to the task's limits. For a discrete task:
            the numbers of the levels, (n,) integers, or preferences (n, levels). Or a `torch.nn.Module` that
            does so with tensors, which is put into evaluation mode.
        task: the robot and its problem.

    Raises:
        BadInput: it is not callable. `act` of the policy raises it, too, if the function raises, or
            returns another shape, a number that is not finite, or an integer out of range.
    """
    task = get_task(task)
    if not callable(function):
        raise BadInput(
            f"{function!r} cannot be called: give a function from observations (n, k) to inputs (n, m)"
        )
    if _is_module(function):
        return FunctionPolicy(task, _of_arrays(function), "the module")
    return FunctionPolicy(task, function)


def _is_module(function: object) -> bool:
    """Returns whether an object is a `torch.nn.Module`; it is none if nobody has imported torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(function, torch.nn.Module)


def _of_arrays(module: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a `torch.nn.Module` as a function of arrays."""
    import torch

    def function(observation: np.ndarray) -> np.ndarray:
        module.eval()
        weight = next(module.parameters(), torch.empty(0))
        with torch.no_grad():
            answer = module(torch.from_numpy(observation).to(weight.device, weight.dtype))
        if not isinstance(answer, torch.Tensor):
            raise BadInput(f"it gives {type(answer).__name__}, not a tensor")
        actions: np.ndarray = answer.cpu().numpy()
        return actions

    return function


def _preferred(preferences: np.ndarray, task: Task) -> np.ndarray:
    """Returns the preferred levels (n,) int for preferences (n, levels)."""
    assert task.input_levels is not None
    levels = len(task.input_levels)
    if preferences.ndim != 2 or preferences.shape[1] != levels:
        raise BadInput(
            f"{task.name} takes preferences of shape (n, {levels}) or integers (n,), got "
            f"{preferences.dtype} of shape {preferences.shape}"
        )
    if not np.isfinite(preferences).all():
        raise BadInput("a preference is not a finite number")
    return preferences.argmax(axis=1)
