"""One instance of an environment, which plays an episode from its start to its end.

A sample has two phases. `act` steps the environment; then `sense` gives what it observes under the noise of
that sample. Where wrappers lie around the environment, its own `step` waits inside of theirs between the two,
so that stacks, delays, filters and normalisation see what a sensor would have sent.
"""

from __future__ import annotations

import random
import re
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj.environments import fingerprint as written
from hyrl_mj.environments.expressions import entry
from hyrl_mj.environments.opening import Source, global_seed, made, physics_of
from hyrl_mj.errors import BadInput, HyrlError, brief

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
# The names under which environments compute their observations.
OBSERVER = re.compile(r"_?((get|compute|make|build)_?)?(ob|obs|observe|observation)s?")


@dataclass(frozen=True)
class Recipe:
    """How instances are made, and what they report.

    Attributes:
        source: how the environment is made and reset.
        noisy: places (d,) in a state of MuJoCo that the coordinates of the chart are in.
        observer: the name of what computes the observation, of those that `observers` gives; "" if none does.
        keys: entries of `info` that are reported.
        places: pairs of names whose distance is reported, each as a kind and an index for both.
        solid: (ngeom,) bool, the geoms of the robot.
        harmless: geoms that the robot has touched without an end of the episode.
        anew: whether a reset changes what the next one does to a wrapper: each episode takes a new instance.
        lags: whether what is observed after a step is computed from quantities of a physics step before.
    """

    source: Source
    noisy: tuple[int, ...] = ()
    observer: str = ""
    keys: tuple[tuple[str | int, ...], ...] = ()
    places: tuple[tuple[tuple[str, int], tuple[str, int]], ...] = ()
    solid: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    harmless: frozenset[int] = frozenset()
    lags: bool = True
    anew: bool = False

    def with_source(self, source: Source) -> Recipe:
        """Returns the recipe for an environment that is made or reset in another way."""
        return replace(self, source=source)

    @property
    def width(self) -> int:
        """The number of columns of a report: reward, terminated, truncated, touch, entries, distances."""
        return 4 + len(self.keys) + len(self.places)


class Worn(HyrlError):
    """An instance is not like a new one after its reset."""


# Data that one instance at a time copies its own into, by all sizes of the model: many take much memory.
_SPARE: dict[tuple[int, ...], mujoco.MjData] = {}


def _spare_of(model: mujoco.MjModel) -> mujoco.MjData:
    """Returns data of MuJoCo that are laid out as those of a model."""
    names = [name for name in dir(model) if name.startswith("n") and name.islower()]
    sizes = tuple(v for name in names if isinstance(v := getattr(model, name), int))
    if sizes not in _SPARE:
        _SPARE[sizes] = mujoco.MjData(model)
    return _SPARE[sizes]


class Physics:
    """MuJoCo's state in an environment, or in the plant of an environment of this package."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, plant: Any):
        self.model, self.data, self._plant = model, data, plant
        self._size = mujoco.mj_stateSize(model, STATE)
        self._spare = _spare_of(model)
        self._other: mujoco.MjData | None = None
        self._left: np.ndarray | None = None

    @property
    def is_plant(self) -> bool:
        """Whether a plant of this package holds the state, which `data` only shows."""
        return self._plant is not None

    def read(self) -> np.ndarray:
        """Returns MuJoCo's state (S,)."""
        if self._plant is not None:
            mujoco.mj_setState(self.model, self.data, self._plant.state[0], STATE)
        return self.shown()

    def shown(self) -> np.ndarray:
        """Returns the state (S,) in MuJoCo's data."""
        state = np.empty(self._size)
        mujoco.mj_getState(self.model, self.data, state, STATE)
        return state

    def write(self, state: np.ndarray) -> None:
        """Sets MuJoCo's state (S,) and computes what follows from it."""
        mujoco.mj_setState(self.model, self.data, state, STATE)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_rnePostConstraint(self.model, self.data)  # forces of contacts on bodies
        mujoco.mj_setState(self.model, self.data, state, STATE)
        if self._plant is not None:
            self._plant.put(state[None])

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Puts everything back after the block, derived quantities included."""
        if self._plant is not None:
            state = self._plant.state
            yield
            self._plant.put(state)
            return
        mujoco.mj_copyData(self._spare, self.model, self.data)
        yield
        mujoco.mj_copyData(self.data, self.model, self._spare)

    def leave_for(self, state: np.ndarray) -> None:
        """Goes to a state (S,) until `come_back`."""
        self._left, self._other = self.read(), self._other or mujoco.MjData(self.model)
        mujoco.mj_copyData(self._other, self.model, self.data)
        self.write(state)

    def come_back(self) -> None:
        """Puts everything back as it was before `leave_for`, if that was called."""
        if self._left is not None:
            if self._plant is not None:
                self._plant.put(self._left[None])
            mujoco.mj_copyData(self.data, self.model, self._other)
            self._left = None


def columns_of(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Returns the places in a state of MuJoCo of each of its parts, such as "qpos"."""
    found, at = {}, 0
    for part in mujoco.mjtState.__members__.values():
        name = part.name.removeprefix("mjSTATE_").lower()
        if part.value.bit_count() == 1 and part & STATE:
            size = mujoco.mj_stateSize(model, part)
            found[name], at = np.arange(at, at + size), at + size
    return found


def flat(observation: Any, space: spaces.Space[Any]) -> np.ndarray:
    """Returns an observation as a vector, as SB3 does: the parts of a Dict in the order of its space."""
    if isinstance(space, spaces.Dict):
        return np.concatenate([np.ravel(observation[k]) for k in space.spaces], dtype=float)
    return np.array(observation, dtype=float).ravel()


def _shaped(vector: np.ndarray, like: Any, space: spaces.Space[Any]) -> Any:
    """Returns a vector as an observation of the shape and types of another one."""
    if not isinstance(space, spaces.Dict):
        array = np.asarray(like)
        return vector.astype(array.dtype).reshape(array.shape)
    parts, at = {}, 0
    for key in space.spaces:
        size = np.size(like[key])
        parts[key] = _shaped(vector[at : at + size], like[key], space.spaces[key])
        at += size
    return {key: parts[key] for key in like if key in parts}


def observers(env: gym.Env) -> dict[str, Callable[[], Any]]:
    """Returns functions that may compute the observation of the innermost environment, by name."""
    inner: Any = env.unwrapped
    found: dict[str, Callable[[], Any]] = {}

    def of(owner: Any) -> dict[str, Callable[..., Any]]:
        names = sorted(name for name in dir(type(owner)) if OBSERVER.fullmatch(name))
        return {n: getattr(owner, n) for n in names if callable(getattr(owner, n, None))}

    for name, get in of(inner).items():
        found[name] = get
        # An environment around another one, as PointMaze: it takes what the inner one observes.
        for part_name, part in vars(inner).items():
            if isinstance(part, gym.Env):
                for own_name, own in of(part).items():
                    found[f"{name}({part_name}.{own_name})"] = partial(_through, get, own)
    control: Any = getattr(inner, "_env", None)  # of dm_control
    if hasattr(getattr(control, "task", None), "get_observation"):
        found["task.get_observation"] = lambda: control.task.get_observation(control.physics)
    return found


def _through(get: Callable[[Any], Any], own: Callable[[], Any]) -> Any:
    """Returns what an environment observes of what the one within it does, which may come with an info."""
    result = own()
    return get(result[0] if isinstance(result, tuple) else result)


def _global_state() -> tuple[Any, ...]:
    """Returns how far the global generators of NumPy and Python are."""
    numpy_state: Any = np.random.get_state()
    return numpy_state[2], random.getstate()


class Instance:
    """An environment that plays episodes, one at a time.

    Args:
        recipe: how it is made.

    Raises:
        BadInput: it cannot be made or reset.
    """

    def __init__(self, recipe: Recipe):
        self.recipe = recipe
        opened = made(recipe.source)
        self.env, self.steps, self.name = opened.env, opened.steps, recipe.source.name
        self.model, self.data = opened.model, opened.data
        self.physics = Physics(opened.model, opened.data, opened.plant)
        self.inner: Any = self.env.unwrapped
        self._observers = observers(self.env)
        self.inner_seen: Any = None  # what the innermost environment observed last
        self._like: written.Fingerprint | None = None  # after its first reset
        self._chain: _Chain | None = None
        self._used = False
        self.start: np.ndarray | None = (
            None  # to which the innermost reset has to lead, below wrappers
        )
        self._offset = np.zeros(len(recipe.noisy))
        if self.env is not self.inner:
            self._chain = _Chain(self)
        self._generators: dict[str, tuple[Any, bytes]] = {}
        self.observation = np.empty(0)

    @property
    def source(self) -> Source:
        """How the environment is made and reset."""
        return self.recipe.source

    # ---- an episode

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> Any:
        """Resets the environment as its user would, pins what is pinned, and returns its observation."""
        seed = self.source.first if seed is None else seed
        given = self.source.reset if options is None else options
        plain = {k: np.array(v) if isinstance(v, list) else v for k, v in given.items()}
        with global_seed(seed):
            self.env.action_space.seed(seed)
            try:
                observation, _ = self.env.reset(seed=seed, options=plain or None)
            except HyrlError:
                raise
            except Exception as error:
                told = f" with the options {dict(given)}" if given else ""
                raise BadInput(
                    f"{self.name} cannot be reset{told} ({brief(error)}): change its options of reset"
                ) from error
        physics = physics_of(self.env)
        if physics is None or physics[0] is not self.model:
            raise BadInput(
                f"reset() of {self.name} builds another model of MuJoCo, and runs are compared on one: let "
                "it keep its model"
            )
        if not self.physics.is_plant:
            self.data = self.physics.data = physics[1]
        if self._chain is None:
            self.inner_seen = observation
        if self.start is None:
            self.pin()
        return observation

    def put(self, state: np.ndarray, seed: int | None = None) -> np.ndarray:
        """Resets the environment and puts it to a state of MuJoCo (S,); returns what it observes there (o,).

        Wrappers see the start as the first observation, as if the reset of the innermost environment had led
        there.
        """
        space = self.env.observation_space
        if self._chain is None:
            self.reset(seed)
            self.physics.write(state)
            return flat(self.watched(), space)
        self.start = state
        try:
            return flat(self.reset(seed), space)
        finally:
            self.start = None

    def drawn(self, rng: np.random.Generator) -> np.ndarray:
        """Returns inputs (m,) at random."""
        space: Any = self.env.action_space
        if isinstance(space, spaces.Discrete):
            return np.array([float(rng.integers(space.n))])
        return np.ravel(rng.uniform(space.low, space.high)).astype(float)

    def pin(self) -> None:
        """Sets what is pinned."""
        if not self.source.pinned:
            return
        self.physics.read()
        for name, value in self.source.pinned.items():
            kind, _, rest = name.partition("[")
            if kind in ("qpos", "qvel", "mocap_pos", "userdata") and rest.endswith("]"):
                values, i = getattr(self.data, kind).reshape(-1), rest[:-1]
                if not i.isdigit() or int(i) >= len(values):
                    held = f"{kind}[0] to [{len(values) - 1}]" if len(values) else f"no {kind}"
                    raise BadInput(f"{self.name} has no {name}: there are {held}")
                if np.ndim(value):
                    raise BadInput(f"pinned {name} is {value}: give one number")
                values[int(i)] = value
                continue
            old: Any = getattr(self.inner, name, None)
            numbers = isinstance(old, bool | int | float | list | tuple | np.ndarray | np.generic)
            if not numbers or np.shape(old) != np.shape(value):
                raise BadInput(
                    f"{self.name} has no attribute {name} of shape {np.shape(value)} to pin: name a "
                    "position as qpos[2], or an attribute"
                )
            setattr(self.inner, name, np.array(value) if isinstance(value, list) else value)
        self.physics.write(self.physics.shown())

    def remembered(self) -> written.Fingerprint:
        """Returns what it remembers now, to compare it: attributes, MuJoCo's state and model."""
        found = written.fingerprint(self.env)
        found.update(
            (f"{name} of its model", value) for name, value in written.of_model(self.model).items()
        )
        found["MuJoCo's state"] = self.physics.read().tobytes()
        return found

    def mark(self) -> None:
        """Notes the generators of random numbers, and compares what is remembered with the first reset.

        Raises:
            Worn: after this reset the instance is not as it was after its first one.
        """
        remembered = self.remembered()
        self._generators = {n: (g, written.state_of(g)) for n, g in remembered.generators.items()}
        if self._like is None:
            self._like = remembered
        elif differ := written.differing(remembered, self._like):
            raise Worn(differ[0])

    def begin(self, start: np.ndarray) -> None:
        """Begins an episode at a state of MuJoCo (S,); `sense` then gives its first observation.

        Raises:
            Worn: after its reset it is not like a new one.
        """
        self.quit()
        if self.recipe.anew:
            if self._used:
                raise Worn("a wrapper")
            self._used = True
        else:
            self.observation = flat(self.reset(), self.env.observation_space)
            self.mark()
        if self._chain is None:
            self.physics.write(start)
            self.inner_seen = self.watched()
            self.observation = flat(self.inner_seen, self.inner.observation_space)
        else:
            self.start = start
            self._chain.ask(lambda: self.reset())

    def act(self, u: np.ndarray) -> np.ndarray:
        """Steps the environment with inputs u (m,), and returns its report (see `Recipe.width`).

        With wrappers the report is complete only after `sense`, which returns it.
        """
        if self._chain is None:
            return self._told(self.stepped(u))
        self._chain.ask(lambda: self.stepped(u))
        return np.zeros(self.recipe.width)

    def sense(self, noise: np.ndarray) -> np.ndarray | None:
        """Computes `observation` under noise (d,) on the chart's coordinates.

        Returns:
            With wrappers the report of the step; None at the start, and without wrappers.
        """
        if self._chain is None:
            if noise.any():
                self.observation = self.observation + self.displaced(noise)
            return None
        result, starting = self._chain.answer(noise), self.start is not None
        if starting:
            self.start = None
            self.observation = flat(result, self.env.observation_space)
            return None
        return self._told(result)

    def finish(self) -> None:
        """Refuses an episode in which random numbers were drawn, at its end."""
        for name, (generator, state) in self._generators.items():
            if written.state_of(generator) != state:
                self._drawn(name)
        self._generators = {}

    def quit(self) -> None:
        """Leaves an episode before its end."""
        self._generators = {}
        if self._chain is not None:
            self._chain.leave()
            self.start = None

    # ---- what it observes

    def watched(self) -> Any:
        """Returns what the innermost environment observes in its present state."""
        watch = self._observers.get(self.recipe.observer)
        if watch is None:
            raise BadInput(
                f"{self.name} has no method that computes what it observes in its present state, so nothing "
                "is known of what it would observe under noise: give it one named _get_obs, without arguments"
            )
        try:
            return watch()
        except Exception as error:
            raise BadInput(
                f"{self.recipe.observer}() of {self.name} raises {brief(error)}: repair it"
            ) from error

    def rested(self, start: np.ndarray) -> np.ndarray:
        """Returns what is first observed (o,) of an episode that begins at a state of MuJoCo (S,)."""
        if self._chain is not None or not len(self.observation):
            self.begin(start)
            self.sense(np.zeros(len(self.recipe.noisy)))
        else:
            self.physics.write(start)
            self.observation = flat(self.watched(), self.inner.observation_space)
        return self.observation

    def displaced(self, noise: np.ndarray) -> np.ndarray:
        """Returns by how much the innermost observation changes (o,) where the chart's coordinates do.

        Where what is observed lags, it is the difference of two observations with all derived quantities
        up to date.
        """
        space, state = self.inner.observation_space, self.physics.read()
        moved = self.moved(state, noise)
        with self.physics.kept():
            here = flat(self.inner_seen, space)
            if self.recipe.lags:
                self.physics.write(state)
                here = flat(self.watched(), space)
            self.physics.write(moved)
            return flat(self.watched(), space) - here

    def moved(self, state: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Returns a state of MuJoCo (S,) with noise (d,) added to the coordinates of the chart."""
        moved = state.copy()
        moved[list(self.recipe.noisy)] += noise
        return moved

    def depth(self) -> float:
        """Returns how deep the robot is inside of something else [m], 0 if it touches nothing."""
        contact = self.data.contact
        if not self.data.ncon:
            return 0.0
        touches = self.recipe.solid[contact.geom].sum(axis=1) == 1
        return float(-min(contact.dist[touches].min(initial=0.0), 0.0))

    def touched(self) -> set[int]:
        """Returns the geoms that the robot touches."""
        pairs = self.data.contact.geom[: self.data.ncon]
        return {int(g) for pair in pairs if self.recipe.solid[pair].sum() == 1 for g in pair}

    # ---- steps

    def action(self, u: np.ndarray) -> Any:
        """Returns the environment's action for inputs u (m,)."""
        space = self.env.action_space
        if isinstance(space, spaces.Discrete):
            return int(space.start + round(float(u[0])))
        return u.astype(space.dtype).reshape(space.shape)

    def stepped(self, u: np.ndarray) -> Any:
        """Returns what the environment's own step returns for inputs u (m,)."""
        action = self.action(u)
        try:
            result = self.env.step(action)
        except HyrlError:
            raise
        except Exception as error:
            raise BadInput(f"step() of {self.name} raises {brief(error)}: repair it") from error
        if not isinstance(result, tuple) or len(result) != 5:
            raise BadInput(
                f"step() of {self.name} returns a {type(result).__name__}: let it return an observation, a "
                "reward, terminated, truncated and info"
            )
        if self._chain is None:
            self.inner_seen = result[0]
        return result

    def _told(self, result: Any) -> np.ndarray:
        observation, reward, terminated, truncated, info = result
        self.observation = flat(observation, self.env.observation_space)
        entries = [entry(info, key) for key in self.recipe.keys]
        if self.physics.is_plant:
            self.physics.read()
        distances = [
            float(np.linalg.norm(getattr(self.data, a)[i] - getattr(self.data, b)[j]))
            for (a, i), (b, j) in self.recipe.places
        ]
        ends = bool(terminated)
        touch = ends and bool(self.touched() - self.recipe.harmless)
        return np.array([reward, ends, bool(truncated), touch, *entries, *distances], dtype=float)

    @contextmanager
    def undrawn(self) -> Iterator[None]:
        """Raises `BadInput` after steps that draw from a global generator of random numbers."""
        before = _global_state()
        yield
        if _global_state() != before:
            self._drawn("a global generator")

    def _drawn(self, name: str) -> None:
        raise BadInput(
            f"{self.name} draws random numbers in step() ({name}), so its state does not tell what comes "
            "next: make it without that noise"
        )


class _Chain:
    """Plays the steps of wrapped environments in a thread that waits for noise inside of the innermost.

    Args:
        instance: of the environment, whose innermost `step` and `reset` are replaced.
    """

    def __init__(self, instance: Instance):
        self._instance = instance
        self._own_step, self._own_reset = instance.inner.step, instance.inner.reset
        instance.inner.step, instance.inner.reset = self._step, self._reset
        self._work: SimpleQueue[Callable[[], Any] | None] = SimpleQueue()
        self._noise: SimpleQueue[np.ndarray | None] = SimpleQueue()
        self._news: SimpleQueue[tuple[str, Any]] = SimpleQueue()
        self._asked = self._busy = False
        self._calls = 0
        Thread(target=_serve, args=(self._work, self._news), daemon=True).start()
        weakref.finalize(self, self._work.put, None)  # the thread ends with the instance

    def ask(self, work: Callable[[], Any]) -> None:
        """Begins a step or a reset, up to where the innermost environment would observe."""
        self._calls, self._asked, self._busy = 0, True, True
        self._work.put(work)
        what, value = self._news.get()
        if what != "sensing":
            self._asked = self._busy = False
            if what == "error":
                raise value
            raise BadInput(
                f"a wrapper of {self._instance.name} does not step the environment in each of its steps: "
                "leave it out"
            )

    def answer(self, noise: np.ndarray) -> Any:
        """Goes on with noise (d,) to the end of the step or reset, and returns its result."""
        self._noise.put(noise)
        what, value = self._news.get()
        self._asked = self._busy = False
        self._instance.physics.come_back()
        if what == "error":
            raise value
        return value

    def leave(self) -> None:
        """Ends a step that waits for noise."""
        if self._busy:
            self.answer(np.zeros(len(self._instance.recipe.noisy)))

    def _step(self, action: Any) -> Any:
        result = self._own_step(action)
        self._instance.inner_seen = result[0]
        if not self._asked:
            return result
        self._count()
        return self._observed(result[0], result[1:])

    def _reset(self, **options: Any) -> Any:
        result = self._own_reset(**options)
        self._instance.inner_seen = result[0]
        if self._instance.start is None:
            return result
        self._instance.pin()
        self._instance.physics.write(self._instance.start)
        observation = self._instance.inner_seen = self._instance.watched()
        if not self._asked:
            return (observation, *result[1:])
        self._count()
        return self._observed(observation, result[1:])

    def _count(self) -> None:
        self._calls += 1
        if self._calls > 1:
            raise BadInput(
                f"a wrapper of {self._instance.name} steps or resets the environment more than once in a "
                "step, and noise comes once a sample: give the environment a frame_skip instead"
            )

    def _observed(self, observation: Any, rest: tuple[Any, ...]) -> tuple[Any, ...]:
        instance, space = self._instance, self._instance.inner.observation_space
        self._news.put(("sensing", None))
        noise = self._noise.get()
        if noise is not None and noise.any():
            vector = flat(observation, space) + instance.displaced(noise)
            observation = _shaped(vector, observation, space)
            # Wrappers that look at MuJoCo's state themselves see it where the sensor does.
            instance.physics.leave_for(instance.moved(instance.physics.read(), noise))
        return (observation, *rest)


def _serve(work: SimpleQueue[Any], news: SimpleQueue[Any]) -> None:
    """Does what is asked for in turn, until that is None; it holds on to nothing in between."""
    while (job := work.get()) is not None:
        try:
            news.put(("done", job()))
        except BaseException as error:
            news.put(("error", error))
        del job
