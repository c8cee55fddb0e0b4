"""Policies that are functions of the observation: Python callables and ONNX models."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import BadArtifact, BadInput, brief
from hyrl_mj.policies.mlp import ObservationPolicy
from hyrl_mj.tasks import Task, at_levels


@dataclass(frozen=True)
class FunctionPolicy(ObservationPolicy):
    """A function of the observation as a policy.

    Attributes:
        function: observations (n, k) float32 -> inputs (n, m) in the plant's units, which are clipped to
            the task's limits; or the numbers of a discrete task's levels (n,) int.
        name: what messages call it.
    """

    task: Task
    function: Callable[[np.ndarray], Any]
    name: str = "the function"

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        n, m = len(observation), len(self.task.inputs)
        if not n:
            return np.zeros((0, m))
        try:
            actions = np.asarray(self.function(observation.astype(np.float32)))
        except Exception as error:  # a user's code can raise anything
            what = error if isinstance(error, BadInput) else f"it raised {brief(error)}"
            raise BadInput(f"{self.name} cannot be used: {what}") from error
        discrete = self.task.input_levels is not None
        shape, what = ((n,), "integers") if discrete else ((n, m), "inputs")
        if actions.shape != shape:
            raise BadInput(
                f"{self.name} gives shape {actions.shape} for {n} observations, {self.task.name} takes "
                f"{what} of shape {shape}"
            )
        if discrete:
            return at_levels(self.task, actions)
        try:
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
        function: observations (n, k) float32, as the task's environments give them -> inputs (n, m) in
            the plant's units, which are clipped to the task's limits. For a discrete task: the numbers of
            the levels, (n,) integers.
        task: the robot and its problem.

    Raises:
        BadInput: it is not callable. `act` of the policy raises it, too, if the function raises, or
            returns another shape, a number that is not finite, or an integer out of range.
    """
    if not callable(function):
        raise BadInput(
            f"{function!r} cannot be called: give a function from observations (n, k) to inputs (n, m)"
        )
    return FunctionPolicy(task, function)


def from_onnx(path: Path, task: Task, remedy: str) -> FunctionPolicy:
    """Returns the policy of an ONNX file, after a first call of it."""
    try:
        import onnxruntime
    except ImportError:
        raise BadInput('an .onnx file needs onnxruntime: pip install "hyrl-mj[onnx]"') from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised, too
    with artifacts.reading(path, remedy):
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        takes_batches = _check_onnx_input(session.get_inputs(), task)
    input_name, output_name = session.get_inputs()[0].name, session.get_outputs()[0].name

    def function(observation: np.ndarray) -> np.ndarray:
        parts = [observation] if takes_batches else np.split(observation, len(observation))
        outputs = [session.run([output_name], {input_name: part})[0] for part in parts]
        actions = np.concatenate(outputs)
        preferences = task.input_levels is not None and np.issubdtype(actions.dtype, np.floating)
        return _preferred(actions, task) if preferences else actions

    policy = FunctionPolicy(task, function, f"the model of {path}")
    try:
        policy.inputs(np.zeros((2, len(task.observation_low))))
    except BadInput as error:
        raise BadArtifact(str(error)) from error
    return policy


def _check_onnx_input(inputs: list[Any], task: Task) -> bool:
    """Returns whether a model takes batches; other models take one observation at a time."""
    k = len(task.observation_low)
    if len(inputs) != 1 or inputs[0].type != "tensor(float)" or len(inputs[0].shape) != 2:
        takes = ", ".join(f"{i.name}: {i.type} of shape {i.shape}" for i in inputs) or "nothing"
        raise BadArtifact(
            f"the model takes {takes}: it has to take one input, observations (n, {k}) float32"
        )
    rows, columns = inputs[0].shape
    if isinstance(columns, int) and columns != k:
        raise BadArtifact(
            f"the model takes {columns} numbers, an observation of {task.name} has {k}"
        )
    if isinstance(rows, int) and rows != 1:
        raise BadArtifact(
            f"the model takes {rows} observations at a time: export it for any number of them, or for one"
        )
    return rows != 1


def _preferred(preferences: np.ndarray, task: Task) -> np.ndarray:
    """Returns the preferred levels (n,) int for preferences (n, levels)."""
    if preferences.ndim != 2 or preferences.shape[1] != task.learning.levels:
        raise BadInput(
            f"{task.name} takes preferences of shape (n, {task.learning.levels}) or integers (n,), got "
            f"{preferences.dtype} of shape {preferences.shape}"
        )
    if not np.isfinite(preferences).all():
        raise BadInput("a preference is not a finite number")
    return preferences.argmax(axis=1)
