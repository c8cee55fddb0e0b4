"""Copies of an environment that take turns in one: rows of MuJoCo's state and of what it remembers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj.environments.memory import (
    Path,
    Slot,
    changing,
    generators,
    hiding,
    name_of,
    remembered,
    state_of_generator,
)
from hyrl_mj.environments.opening import Source, global_seed, global_state, layers, made, physics_of
from hyrl_mj.errors import BadInput, brief
from hyrl_mj.tasks import Outcome

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
# Episodes and steps in which an environment is watched, under inputs that are held for some steps.
EPISODES, STEPS, HELD = 4, 60, 10
# A geom of a robot that is so much of its size inside of another one is blocked.
INSIDE = 0.5
# Replayed steps differ by no more than this, as a share of the largest number.
REPLAYED, REWARD = 1e-9, 0.1
# The names under which environments compute their observations.
OBSERVERS = ("_get_obs", "get_ob", "get_obs", "_get_observation", "_observation")
# What info calls success.
SUCCESS = ("success", "is_success")


@dataclass(frozen=True)
class Report:
    """What an environment tells of k copies after a step.

    Attributes:
        observation: (k, o), the parts of a Dict one after the other, in the order of their keys.
        reward: (k,).
        terminated, truncated: (k,) bool.
        success: (k,) of info; 0 where it says nothing.
        distance: (k,) between the two places that `Host.between` names [m], else 0.
    """

    observation: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    success: np.ndarray
    distance: np.ndarray

    @property
    def columns(self) -> np.ndarray:
        """All of it as numbers (k, o + 5)."""
        return np.column_stack([*vars(self).values()])

    @staticmethod
    def of(columns: np.ndarray) -> Report:
        """Returns what columns (k, o + 5) tell."""
        reward, terminated, truncated, success, distance = columns[:, -5:].T
        return Report(columns[:, :-5], reward, terminated > 0, truncated > 0, success, distance)


def flat(observation: Any) -> np.ndarray:
    """Returns an observation as a vector, as SB3 flattens it: a Dict in the order of its sorted keys."""
    if isinstance(observation, Mapping):
        return np.concatenate([np.ravel(observation[key]) for key in sorted(observation)])
    return np.ravel(observation)


class Host:
    """An environment that many copies take turns in.

    Args:
        source: how it is made.

    Attributes:
        env: the environment, without the wrappers that count or check.
        model, data: of MuJoCo.
        slots: the attributes that change from step to step.
        base: MuJoCo's state (S,) and what is remembered (A,), after the reset that all copies begin from.
        success_key: what `info` calls success; None as long as it has said nothing.
        between: two places whose distance is reported, such as ("site_xpos", 2); none at first.

    Raises:
        BadInput: it cannot be made, or its state does not tell what comes next.
    """

    def __init__(self, source: Source):
        self.source, self.name = source, source.name
        opened = made(source)
        self.env, self.steps = opened.env, opened.steps
        self.model, self.data, self._plant = opened.model, opened.data, opened.plant
        self.slots: tuple[Slot, ...] = ()
        self.between: tuple[tuple[str, int], tuple[str, int]] | None = None
        self._forward = False
        self.success_key: str | None = None
        self._generators: list[Path] = []
        self._watch()
        self.reset(source.first)
        self.base = self.read()

    # ---- making it what a copy is

    def reset(self, seed: int) -> np.ndarray:
        """Resets the environment with a seed, pins what is pinned, and returns the observation (o,)."""
        observation = self.fresh(seed, self.source.reset)
        self._look()
        if self.source.pinned:
            self._pin()
            return self.observed()
        return flat(observation)

    def fresh(self, seed: int, given: Mapping[str, Any]) -> Any:
        """Resets the environment with a seed and options, and returns its observation."""
        options = {k: np.array(v) if isinstance(v, list) else v for k, v in given.items()}
        with global_seed(seed):
            self.env.action_space.seed(seed)
            try:
                observation, _ = self.env.reset(seed=seed, options=options or None)
            except Exception as error:
                told = f" with the options {dict(given)}" if given else ""
                raise BadInput(
                    f"{self.name} cannot be reset{told} ({brief(error)}): change its options of reset"
                ) from error
        physics = physics_of(self.env)
        if physics is None or physics[0] is not self.model:
            raise BadInput(
                f"reset() of {self.name} builds another model of MuJoCo, and copies share one: let it keep "
                "its model"
            )
        return observation

    def _pin(self) -> None:
        for name, value in self.source.pinned.items():
            kind, _, rest = name.partition("[")
            if kind in ("qpos", "qvel") and rest.endswith("]"):
                values, i = getattr(self.data, kind), rest[:-1]
                if not i.isdigit() or int(i) >= len(values):
                    raise BadInput(
                        f"{self.name} has no {name}: there are {kind}[0] to [{len(values) - 1}]"
                    )
                values[int(i)] = value
                continue
            old = getattr(self.env.unwrapped, name, None)
            if old is None or np.shape(old) != np.shape(value):
                raise BadInput(
                    f"{self.name} has no attribute {name} of shape {np.shape(value)} to pin: name a position "
                    "as qpos[2], or an attribute"
                )
            setattr(self.env.unwrapped, name, np.array(value) if isinstance(value, list) else value)
        self.forward()

    def forward(self) -> None:
        """Computes what follows from MuJoCo's state, without a change of the state."""
        mujoco.mj_forward(self.model, self.data)
        if self._plant is not None:
            self._plant.put(self.read()[0][None])

    def _look(self) -> None:
        """Shows in `data` what the plant of an environment of this package has done."""
        if self._plant is not None:
            mujoco.mj_setState(self.model, self.data, self._plant.state[0], STATE)
            mujoco.mj_forward(self.model, self.data)
            mujoco.mj_setState(self.model, self.data, self._plant.state[0], STATE)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns MuJoCo's state (S,) and what is remembered (A,)."""
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        kept = [slot.read(self.env) for slot in self.slots]
        return state, np.concatenate(kept, dtype=float) if kept else np.empty(0)

    def write(self, state: np.ndarray, memory: np.ndarray) -> None:
        """Makes the environment the copy of a state (S,) and a memory (A,)."""
        mujoco.mj_setState(self.model, self.data, state, STATE)
        if self._plant is not None:
            self._plant.put(state[None])
        at = 0
        for slot in self.slots:
            slot.write(self.env, memory[at : at + slot.size])
            at += slot.size
        if self._forward:
            self.forward()
            mujoco.mj_setState(self.model, self.data, state, STATE)

    def action(self, u: np.ndarray) -> Any:
        """Returns the environment's action for inputs u (m,)."""
        space = self.env.action_space
        if isinstance(space, spaces.Discrete):
            return int(space.start + round(float(u[0])))
        return u.astype(space.dtype).reshape(space.shape)

    def step(self, u: np.ndarray) -> tuple[np.ndarray, float, bool, bool, float, float]:
        """Steps the environment with inputs u (m,), and returns a row of `Report`."""
        observation, reward, terminated, truncated, info = self.env.step(self.action(u))
        self._look()
        key = next((key for key in SUCCESS if key in info), None)
        told = None if key is None else float(info[key])
        if "outcome" in info:  # of an environment of this package
            key, told = "outcome", float(info["outcome"] == Outcome.REACHED.label)
        self.success_key = self.success_key or key
        distance = 0.0
        if self.between is not None:
            first, second = (getattr(self.data, kind)[i] for kind, i in self.between)
            distance = float(np.linalg.norm(first - second))
        return (
            flat(observation),
            float(reward),
            bool(terminated),
            bool(truncated),
            told or 0.0,
            distance,
        )

    # ---- what copies do

    def advance(
        self, states: np.ndarray, memories: np.ndarray, u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, Report]:
        """Returns states (k, S), memories (k, A) and reports of k copies after a step with inputs (k, m)."""
        states, memories, rows = states.copy(), memories.copy(), []
        with self._undrawn():
            for i in range(len(states)):
                self.write(states[i], memories[i])
                rows.append(self.step(u[i]))
                states[i], memories[i] = self.read()
        return states, memories, _report(rows, self.width)

    def observe(self, states: np.ndarray, memories: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns what copies in states (k, S) observe (k, o), and whether they are inside of walls (k,).

        All derived quantities of MuJoCo are up to date.
        """
        found, blocked = np.empty((len(states), self.width)), np.zeros(len(states), dtype=bool)
        for i in range(len(states)):
            self.write(states[i], memories[i])
            if not self._forward:
                self.forward()
            blocked[i] = self._blocked()
            found[i] = self.observed()
        return found, blocked

    def _blocked(self) -> bool:
        """Returns whether a part of the robot is inside of something that does not move."""
        contact, depth = self.data.contact, self._depth
        if not self.data.ncon:
            return False
        return bool((contact.dist < depth[contact.geom].max(axis=1)).any())

    @cached_property
    def _depth(self) -> np.ndarray:
        """How deep geoms may be inside of others (ngeom,) [m], negative: half of a body's own size."""
        model = self.model
        moves = model.body_weldid[model.geom_bodyid] > 0
        return np.where(moves, -INSIDE * model.geom_rbound, -np.inf)

    @cached_property
    def width(self) -> int:
        """o, the number of columns of the observation."""
        return int(spaces.flatdim(self.env.observation_space))

    def observed(self) -> np.ndarray:
        """Returns what the environment observes in its present state (o,)."""
        if self._observer is not None:
            return self._observer()
        # No name is known: it takes a step that lasts no time.
        state, memory = self.read()
        usual = self.model.opt.timestep
        self.model.opt.timestep = 1e-12
        try:
            return self.step(self._middle)[0]
        finally:
            self.model.opt.timestep = usual
            self.write(state, memory)

    @property
    def _middle(self) -> np.ndarray:
        space: Any = self.env.action_space
        return (
            np.zeros(1)
            if isinstance(space, spaces.Discrete)
            else np.ravel(space.low + space.high) / 2
        )

    # ---- what it finds out about itself

    def _watch(self) -> None:
        """Finds what changes from step to step, and how observations are computed, and tries that out."""
        rng = np.random.default_rng(0)
        self._observer: Callable[[], np.ndarray] | None = None
        candidates = self._observers()
        episodes = []
        for seed in range(EPISODES):
            self.reset(seed)
            self._generators = generators(self.env)
            moments = [remembered(self.env)]
            for k in range(STEPS):
                if k % HELD == 0:
                    u = self.drawn(rng)
                observation = self._tried_step(u)
                moments.append(remembered(self.env))
                candidates = [c for c in candidates if _agrees(c, observation)]
            episodes.append(moments)
        self._end_episode(rng)
        episodes[-1].append(remembered(self.env))
        self.slots = changing(episodes, self.name)
        self._observer = candidates[0] if candidates else None
        if self._replays():
            return
        self._forward = True
        if not self._replays():
            places = " or ".join((*hiding(self.env), "elsewhere"))
            raise BadInput(
                f"step() of {self.name} goes on differently from the same state of MuJoCo and the same "
                f"attributes: it remembers something in {places}, or it draws random numbers; leave that "
                "out, or keep it in attributes that are numbers or arrays"
            )

    def _end_episode(self, rng: np.random.Generator) -> None:
        """Goes on to the end of the episode, which some environments note, as dm_control's do."""
        with self._undrawn():
            for _ in range(self.steps or 0):
                _, _, terminated, truncated, _, _ = self.step(self.drawn(rng))
                if terminated or truncated:
                    break

    def drawn(self, rng: np.random.Generator) -> np.ndarray:
        """Returns inputs (m,) at random."""
        space: Any = self.env.action_space
        if isinstance(space, spaces.Discrete):
            return np.array([float(rng.integers(space.n))])
        return np.ravel(rng.uniform(space.low, space.high))

    def _tried_step(self, u: np.ndarray) -> np.ndarray:
        with self._undrawn():
            try:
                return self.step(u)[0]
            except Exception as error:
                raise BadInput(f"step() of {self.name} raises {brief(error)}: repair it") from error

    @contextmanager
    def _undrawn(self) -> Iterator[None]:
        """Raises `BadInput` after steps that have drawn random numbers, as some do in few places only."""
        before = self._random()
        yield
        drawn = [name for name, state in self._random().items() if state != before[name]]
        if drawn:
            raise BadInput(
                f"{self.name} draws random numbers in step() ({drawn[0]}), so its state does not tell what "
                "comes next: make it without that noise"
            )

    def _random(self) -> dict[str, bytes | None]:
        """Returns the states of all generators that a step may draw from, by name."""
        own = {name_of(path): state_of_generator(self.env, path) for path in self._generators}
        return {"a global generator": global_state(), **own}

    def _replays(self) -> bool:
        """Returns whether steps from a state that was read go on as they did, after others in between."""
        rng = np.random.default_rng(1)
        self.reset(0)
        begun, told, inputs = [], [], []
        for _ in range(STEPS):
            begun.append(self.read())
            inputs.append(self.drawn(rng))
            told.append(self.step(inputs[-1]))
        for k in rng.permutation(STEPS - 1):
            self.write(*begun[k])
            again: tuple[Any, ...] = self.step(inputs[k])
            parts = zip((*again, *self.read()), (*told[k], *begun[k + 1]), strict=True)
            for part, (a, b) in enumerate(parts):
                scale = max(float(np.max(np.abs(b), initial=0.0)), 1.0)
                # A reward may be computed from what MuJoCo computed one physics step earlier.
                tolerance = scale * (REWARD if part == 1 else REPLAYED)
                if not np.allclose(a, b, rtol=0, atol=tolerance, equal_nan=True):
                    return False
        return True

    def _observers(self) -> list[Callable[[], np.ndarray]]:
        """Returns functions that may compute the observation of the present state."""
        inner = self.env.unwrapped
        wrappers = [w for w in reversed(layers(self.env)) if isinstance(w, gym.ObservationWrapper)]

        def through(get: Callable[[], Any]) -> Callable[[], np.ndarray]:
            def observe() -> np.ndarray:
                observation = get()
                for wrapper in wrappers:
                    observation = wrapper.observation(observation)
                return flat(observation)

            return observe

        def inside(get: Callable[[Any], Any], own: Callable[[], Any]) -> Callable[[], np.ndarray]:
            return through(lambda: get(_first(own())))

        found = []
        for name in OBSERVERS:
            get = getattr(inner, name, None)
            if callable(get):
                found.append(through(get))
                # An environment around another one, as PointMaze: it takes what the inner one observes.
                for part in vars(inner).values():
                    own = getattr(part, name, None)
                    if isinstance(part, gym.Env) and callable(own):
                        found.append(inside(get, own))
        control: Any = getattr(inner, "_env", None)  # of dm_control
        if hasattr(getattr(control, "task", None), "get_observation"):
            found.append(through(lambda: control.task.get_observation(control.physics)))
        return found


def _first(result: Any) -> Any:
    return result[0] if isinstance(result, tuple) else result


def _agrees(observe: Callable[[], np.ndarray], observation: np.ndarray) -> bool:
    try:
        return np.array_equal(observe(), observation, equal_nan=True)
    except Exception:  # it takes arguments, or is something else
        return False


def _report(rows: Sequence[tuple[Any, ...]], width: int) -> Report:
    if not rows:
        return Report.of(np.empty((0, width + 5)))
    return Report(*map(np.array, zip(*rows, strict=True)))
