"""Policies of Python code: functions of the observation, modules of torch, and agents with a memory."""

import inspect
import sys
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np

from hyrl_mj.errors import BadInput, brief
from hyrl_mj.policies import sb3_metadata
from hyrl_mj.policies.mlp import MemoryPolicy, ObservationPolicy, Policy
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
            if np.ma.is_masked(answer):
                raise BadInput(
                    "it masks some of its numbers: fill them in, as preferences with -inf"
                )
            actions = np.asarray(answer)
            if actions.dtype == object:
                actions = np.array(actions.tolist())
            if discrete and actions.ndim > 1 and actions.dtype.kind == "f":
                actions = _preferred(actions, self.task)
        except Exception as error:  # a user's code can raise anything
            what = error if isinstance(error, BadInput) else f"it raised {brief(error)}"
            raise BadInput(f"{self.name} cannot be used: {what}") from error
        shape, what = ((n,), "integers") if discrete else ((n, m), "inputs")
        if actions.shape != shape:
            of = "" if actions.ndim else f"a {type(answer).__name__} of "
            raise BadInput(
                f"{self.name} gives {of}shape {actions.shape} for {n} observations, {self.task.name} takes "
                f"{what} of shape {shape}"
            )
        if discrete:
            return at_levels(self.task, actions)
        if actions.dtype.kind not in "biuf":
            raise BadInput(f"{self.name} gives {actions.flat[0]!r}: an input is a number")
        actions = actions.astype(float)
        finite = np.isfinite(actions)
        if not finite.all():
            raise BadInput(
                f"{self.name} gives {actions[~finite][0]}: inputs of {self.task.name} are finite numbers"
            )
        return np.clip(actions, *self.task.input_limits)


class AgentWithMemory(Protocol):
    """What `from_callable` takes as an agent with a memory.

    All that it remembers is in one array (n, ...) of floats, with a row for each run, which keeps its shape
    and type.
    """

    def start(self, n: int) -> np.ndarray:
        """Returns the memory (n, ...) of n runs at their start, the same for each: a robot's at rest."""

    def act(self, memory: np.ndarray, observation: np.ndarray) -> tuple[Any, np.ndarray]:
        """Returns inputs for observations (n, k), as a function does, and the next memory (n, ...)."""


class Predicts(Protocol):
    """What `from_callable` takes as a model of SB3, recurrent or not."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Returns inputs for observations (n, k), and the next state, None without one."""


# What `from_callable` takes.
PythonAgent = Callable[[np.ndarray], Any] | AgentWithMemory | Predicts


@dataclass(frozen=True)
class RememberingPolicy(ObservationPolicy):
    """An agent with a memory as a policy; `act` gives its first answer, that of a robot at rest there.

    Attributes:
        agent: the agent.
        name: what messages call it.
    """

    task: Task
    agent: AgentWithMemory
    name: str = "the agent"

    def start(self, n: int) -> np.ndarray:
        try:
            one, memory = self.agent.start(1), self.agent.start(n)
        except Exception as error:  # a user's code can raise anything
            raise BadInput(
                f"{self.name} cannot be used: start({n}) raised {brief(error)}"
            ) from error
        if problem := _no_memory(one, 1) or _no_memory(memory, n):
            raise BadInput(f"start() of {self.name} {problem}")
        if one.shape[1:] != memory.shape[1:] or not (memory == one).all():
            raise BadInput(
                f"start({n}) of {self.name} gives other rows than start(1): give each run the memory of a "
                "robot at rest"
            )
        return np.array(memory)

    def act_after(self, memory: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        measured = self.task.check_measurement(measured)
        return self._after(memory, self.task.observation(measured))

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        return self._after(self.start(len(observation)), observation)[0]

    def _after(self, memory: np.ndarray, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) for observations (n, k), and the next memory (n, ...)."""
        next_memory = memory

        def function(observation: np.ndarray) -> Any:
            nonlocal next_memory
            answer = self.agent.act(memory.copy(), observation)
            if not isinstance(answer, tuple) or len(answer) != 2:
                raise BadInput("its act() gives no pair: give the inputs and the next memory")
            if problem := _no_memory(answer[1], len(memory)):
                raise BadInput(f"its act() {problem}")
            if (now := (answer[1].shape, answer[1].dtype)) != (memory.shape, memory.dtype):
                raise BadInput(
                    f"its act() makes a memory {now[1]} of shape {now[0]} of one {memory.dtype} of shape "
                    f"{memory.shape}: keep the shape and the type"
                )
            next_memory = np.array(answer[1])
            return answer[0]

        return FunctionPolicy(self.task, function, self.name).inputs(observation), next_memory


def _no_memory(memory: object, n: int) -> str:
    """Returns why something is no memory of n runs, "" if it is one."""
    if not isinstance(memory, np.ndarray) or memory.dtype.kind != "f":
        kind = memory.dtype if isinstance(memory, np.ndarray) else type(memory).__name__
        return f"gives a memory of type {kind}: give an array of floats of shape ({n}, ...)"
    if memory.shape[:1] != (n,):
        return f"gives a memory of shape {memory.shape} for {n} runs: give one row for each"
    if not np.isfinite(memory).all():
        return f"gives a memory of {memory[~np.isfinite(memory)][0]}: give finite numbers"
    return ""


@dataclass(frozen=True)
class _Predicting:
    """A recurrent model with SB3's `predict` as an agent with a memory.

    Its memory (n, 1 + size) is whether a run begins, and the state of the model.

    Attributes:
        model: the model, whose state is a tuple of arrays (layers, n, size).
        state: its state after one observation.
        seen: as `_seen_by`.
    """

    model: Predicts
    state: tuple[np.ndarray, ...]
    seen: Callable[[np.ndarray], Any]

    def start(self, n: int) -> np.ndarray:
        memory = np.zeros((n, 1 + sum(part.size for part in self.state)))
        memory[:, 0] = 1.0
        return memory

    def act(self, memory: np.ndarray, observation: np.ndarray) -> tuple[Any, np.ndarray]:
        begins, given, after = memory[:, 0] == 1, [], []
        groups = [rows for rows in map(np.flatnonzero, (begins, ~begins)) if len(rows)]
        for rows in groups:
            # A run begins with the state None, as under SB3, which may stand for others than zeros.
            state = None if begins[rows[0]] else self._state(memory[rows, 1:])
            actions, state = self.model.predict(
                self.seen(observation[rows]), state, begins[rows], deterministic=True
            )
            flat = [np.moveaxis(part, 1, 0).reshape(len(rows), -1) for part in state]
            given.append(np.asarray(actions))
            after.append(np.hstack([np.zeros((len(rows), 1)), *flat]))
        order = np.argsort(np.concatenate(groups))
        return np.concatenate(given)[order], np.concatenate(after)[order]

    def _state(self, memory: np.ndarray) -> tuple[np.ndarray, ...]:
        """Returns the state of the model in the memory (n, size) of runs that have begun."""
        ends = np.cumsum([part.size for part in self.state])[:-1]
        return tuple(
            np.moveaxis(flat.reshape(len(memory), *part[:, 0].shape), 0, 1).astype(part.dtype)
            for flat, part in zip(np.split(memory, ends, axis=1), self.state, strict=True)
        )


def _predicting(model: Predicts, task: Task) -> FunctionPolicy | RememberingPolicy:
    """Returns a model with SB3's `predict` as a policy, which has a memory if the model has a state."""
    _check_model(model, task)
    observation, seen = np.zeros((1, len(task.observation_low)), np.float32), _seen_by(model, task)
    begins = np.ones(1, dtype=bool)
    try:
        _, state = model.predict(seen(observation), None, episode_start=begins, deterministic=True)
    except Exception as error:  # a user's code can raise anything
        raise BadInput(
            f"predict() of {model!r:.80} raised {brief(error)}, where it is called as that of SB3: give a "
            "function that calls it, as lambda o: model.predict(o)"
        ) from error
    if state is None:
        return FunctionPolicy(
            task, lambda o: model.predict(seen(o), deterministic=True)[0], "the model"
        )
    arrays = isinstance(state, tuple) and all(isinstance(part, np.ndarray) for part in state)
    if not arrays or not all(part.ndim == 3 and part.shape[1] == 1 for part in state):
        raise BadInput(
            f"predict() of {model!r:.80} gives a state {state!r:.80}: give a tuple of arrays of shape "
            "(layers, n, size), or an object with start(n) and act(memory, observation)"
        )
    return RememberingPolicy(task, _Predicting(model, state, seen), "the model")


def _seen_by(model: Any, task: Task) -> Callable[[np.ndarray], Any]:
    """Returns how a model sees observations (n, k): in the shape of its space, or as the parts of a Dict."""
    space, parts = getattr(model, "observation_space", None), task.observation_parts
    ends = np.cumsum([*parts.values()])[:-1]
    if isinstance(spaces := getattr(space, "spaces", None), Mapping):
        return lambda o: {
            key: part.reshape(len(o), *spaces[key].shape)
            for key, part in zip(parts, np.split(o, ends, axis=1), strict=True)
        }
    return lambda o: o.reshape(len(o), *(getattr(space, "shape", None) or o.shape[1:]))


def _check_model(model: Any, task: Task) -> None:
    """Raises `BadInput` if an SB3 model was trained on other observations or inputs than those of a task."""
    space = getattr(model, "observation_space", None)
    spaces, k, parts = getattr(space, "spaces", None), len(task.observation_low), {}
    if isinstance(spaces, Mapping):
        ours = parts = dict(task.observation_parts)
    else:
        spaces, ours = {"": space}, {"": k}
    sizes = {key: np.prod(getattr(one, "shape", None) or -1) for key, one in spaces.items()}
    if space is not None and sizes != ours:
        observes = getattr(space, "shape", None) or space
        raise BadInput(
            f"the model observes {observes}, and {task.name} gives {parts or f'({k},)'}: train it on that, "
            "or give a function that makes its observations"
        )
    sb3_metadata.check_model(model, task)
    if "action_masks" in _arguments(getattr(model, "predict", None)):
        raise BadInput(
            f"the model chooses among the actions that a mask allows, and {task.name} has no masks: if each "
            "action is allowed everywhere, give lambda o: model.predict(o, deterministic=True)[0]"
        )
    actions: Any = getattr(model, "action_space", None)
    levels = task.input_levels
    if actions is None:
        return
    shape, n, first = (getattr(actions, name, None) for name in ("shape", "n", "start"))
    if levels is not None and ((shape, n) != ((), len(levels)) or first not in (0, None)):
        raise BadInput(
            f"the model's actions are {actions}, and {task.name} takes one of {len(levels)} levels: train it "
            "on them, or give a function that chooses among them"
        )
    if levels is None:
        own = np.stack(task.input_limits)
        given = np.stack([actions.low, actions.high]) if hasattr(actions, "low") else np.zeros(0)
        if given.shape != own.shape or not np.allclose(given, own):
            raise BadInput(
                f"the model's actions are {actions}, and inputs of {task.name} lie between {own[0]} and "
                f"{own[1]}: give a function that scales them"
            )


def _arguments(function: Any) -> Set[str]:
    """Returns the names of the arguments of a function, none of what tells none."""
    try:
        return inspect.signature(function).parameters.keys()
    except (TypeError, ValueError):
        return set()


def check_act(policy: Policy) -> None:
    """Raises `BadInput` if `act` of a user's policy tells by its argument that it takes observations."""
    first = next(iter(_arguments(policy.act)), "measured")
    if not first.startswith("meas"):
        raise BadInput(
            f"act({first}) of {policy!r:.60} takes observations, it seems, and a policy is asked about "
            "measurements: give hyrl_mj.from_callable(agent.act, task), or call the argument measured"
        )


def declares_memory(agent: object) -> bool:
    """Returns whether an object is an `AgentWithMemory`, for which a task has to be known."""
    methods = (getattr(agent, name, None) for name in ("start", "act"))
    return all(map(callable, methods)) and not isinstance(agent, MemoryPolicy)


def from_callable(function: PythonAgent, task: Task) -> FunctionPolicy | RememberingPolicy:
    """Returns a function of the observation as a policy, or an agent that has a memory.

    Args:
        function: observations (n, k), float32, or float64 where an environment of others observes that ->
            inputs (n, m) in the plant's units, which are clipped to the task's limits. For a discrete task:
            the numbers of the levels, (n,) integers, or preferences (n, levels). Or a `torch.nn.Module` that
            does so with tensors, which is put into evaluation mode. Or an `AgentWithMemory`: an object with
            `start(n)`, which returns the memory (n, ...) of a robot at rest, and `act(memory, observation)`,
            which returns such inputs and the next memory. Or a model with SB3's `predict`, or its policy,
            also one with a state, such as RecurrentPPO.
        task: the robot and its problem.

    Raises:
        BadInput: it is none of these. `act` of the policy raises it, too, if the function raises, or
            returns another shape, a number that is not finite, an integer out of range, or no such memory.
    """
    task = get_task(task)
    if isinstance(function, type):
        raise BadInput(f"{function.__name__} is a class: give an object of it")
    if declares_memory(function):
        policy = RememberingPolicy(task, cast(AgentWithMemory, function))
        policy.start(1)
        return policy
    if _is_module(function):
        # A policy of SB3 is a module, whose forward() draws, or does not scale to the limits of the inputs.
        sb3 = {"state", "episode_start", "deterministic"}
        if sb3 <= _arguments(getattr(function, "predict", None)):
            return _predicting(cast(Predicts, function), task)
        if _last_part(function) == "Tanh":
            check_scaled(task, "the module")
    if callable(function):
        # Of its class: a module may hold a part by that name, as self.act = nn.ReLU().
        if others := [n for n in ("predict", "act") if callable(getattr(type(function), n, None))]:
            raise BadInput(
                f"{type(function).__name__} can be called, and has {others[0]}() as well, which may answer "
                f"otherwise: give a function that calls the one that acts, as lambda o: agent.{others[0]}(o)"
            )
        if _is_module(function):
            return FunctionPolicy(task, _of_arrays(function), "the module")
        return FunctionPolicy(task, function)
    if callable(getattr(function, "predict", None)):
        return _predicting(cast(Predicts, function), task)
    raise BadInput(
        f"{function!r} cannot be called: give a function from observations (n, k) to inputs (n, m), or an "
        "agent with start(n) and act(memory, observation)"
    )


def _is_module(function: object) -> bool:
    """Returns whether an object is a `torch.nn.Module`; it is none if nobody has imported torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(function, torch.nn.Module)


def _last_part(module: Any) -> str:
    """Returns the name of the last part of a `torch.nn.Sequential`, or of another module itself."""
    while True:
        module = getattr(module, "_orig_mod", module)  # of one that torch has compiled
        # One that torch has scripted or traced says what it was.
        name = str(getattr(module, "original_name", type(module).__name__))
        parts = list(module.children())
        if name != "Sequential" or not parts:
            return name
        module = parts[-1]


def check_scaled(task: Task, name: str) -> None:
    """Raises `BadInput` where a model that ends in Tanh has other inputs than a task."""
    low, high = task.input_limits
    if task.input_levels is None and not np.allclose([-low, high], 1):
        raise BadInput(
            f"{name} ends in Tanh, so that it gives numbers between -1 and 1, and inputs of {task.name} lie "
            f"between {low} and {high}: let it scale them, as SB3's unscale_action does"
        )


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
        # NumPy has no bfloat16.
        answer = answer.double() if answer.is_floating_point() else answer
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
    if not np.isfinite(preferences.max(axis=1)).all():  # -inf is of a level that is ruled out
        raise BadInput("a preference is not a finite number")
    return preferences.argmax(axis=1)
