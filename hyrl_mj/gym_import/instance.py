"""One instance of an environment, which plays an episode from its start to its end.

A sample has two phases. `act` steps the environment; then `sense` gives what it observes under the noise of
that sample. Where wrappers lie around the environment, its own `step` pauses inside of theirs between the
two, so that stacks, delays, filters and normalisation see what a sensor would have sent.
"""

from __future__ import annotations

import copy
import math
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj.errors import BadInput, HyrlError, brief
from hyrl_mj.gym_import import fingerprint as written
from hyrl_mj.gym_import.expressions import entry
from hyrl_mj.gym_import.observations import flat, observers, shaped, unlike
from hyrl_mj.gym_import.opening import (
    actions_of,
    checked_step,
    layers,
    made,
    peeled,
    physics_of,
    steps_of,
)
from hyrl_mj.gym_import.pausing import Pausing
from hyrl_mj.gym_import.physics import Physics, set_pins
from hyrl_mj.gym_import.specification import Derived, EnvironmentSpec
from hyrl_mj.system.generators import global_state


class Seen(NamedTuple):
    """A sample of a run: MuJoCo's state (S,) after it, the observation (o,), and the report (r,)."""

    state: np.ndarray
    observation: np.ndarray
    report: Sequence[float]


class Passed(NamedTuple):
    """What the innermost environment and its wrappers pass to each other in a sample.

    The action is None of a reset, which has no ends, else `terminated` and `truncated`.
    """

    action: Any
    observation: Any
    ends: tuple[Any, ...]


# What is put before names of parts of MuJoCo's state, among those of what is remembered.
OF_STATE = "MuJoCo's "
TICK = 1.1  # after that a clock in whole seconds has gone on [s]


class Instance:
    """An environment that plays episodes, one at a time.

    Args:
        spec: what is known of the environment, of which the description is enough for a first one.
        real: whether it has all wrappers of its user, also those that end or count episodes; they are left
            out where the user gives `steps`.

    Attributes:
        is_wrapped: whether wrappers lie around the environment.
        observation: (o,) what the environment observed last, with its wrappers.
        report: numbers (r,) of the last sample: reward, terminated, truncated, whether it ended in touch with
            what the robot does not touch elsewhere, entries of `info`, distances.
        inner_seen: what the innermost environment observed last.
        draws_globally: whether a reset has drawn from a global generator.
        start: the state of MuJoCo to which the innermost reset has to lead, below wrappers.
        passed: what has passed between the innermost environment and its wrappers since the start.
        script: in a trial, what passes instead: the actions of each sample.
        is_told: whether, in a trial, wrappers also get the observations and ends of the script.
        lead: in a trial, is told of each line of Python that a reset takes, as by `sys.settrace`, and of its
            end.
        own: for one that goes on from episode to episode as its user's does: the places in a state of what a
            start decides. All else is as its resets leave it, and after the first these have a seed only
            where what they draw is pinned by it.

    Raises:
        BadInput: it cannot be made or reset.
    """

    def __init__(self, spec: EnvironmentSpec, real: bool = False):
        self._thread: Pausing | None = None  # first, because it says why there can be no copy
        env = made(spec.description)
        physics = physics_of(env)
        assert physics is not None
        self.spec, self.name, self.steps = spec, spec.name, steps_of(env)
        self._as_it_is = real and spec.description.steps is None
        names = [type(one).__name__ for one in layers(env)]
        self.env, (self.model, self.data) = env if self._as_it_is else peeled(env), physics
        self.physics = Physics(self.model, self.data)
        self.inner: Any = self.env.unwrapped
        kept = [type(one).__name__ for one in layers(self.env)]
        self._left_out = ", ".join(name for name in names if name not in kept)
        self.is_wrapped = self.env is not self.inner
        self._space, self._actions = self.env.observation_space, actions_of(self.env)
        self._columns = int(spaces.flatdim(self._space))
        self._observers = observers(self.env)
        self.observation, self.inner_seen = np.empty(0), None
        numbers = 4 + len(spec.criterion.keys) + len(spec.criterion.points)
        self.report: Sequence[float] = (0.0,) * numbers
        self.start: np.ndarray | None = None
        self._like: written.Fingerprint | None = None  # after its first reset
        self._begun = written.Fingerprint()  # after the reset of its episode
        self.draws_globally = self._at_start = self._was_reset = False
        self.own: np.ndarray | None = None
        self._samples = 0
        self._placed: mujoco.MjData | None = None
        self.passed, self.is_told = list[Passed](), False
        self.script: Iterator[Passed] = iter(())
        self.lead: Any = None
        if self.is_wrapped:
            self._put_in()

    def learn(self, **facts: Any) -> None:
        """Adds to what is known of the environment."""
        self.spec = replace(self.spec, **facts)

    # ---- an episode

    def reset(self, seed: int | None = None, plain: bool = False) -> Any:
        """Resets the environment as its user would, pins what is pinned, and returns its observation.

        Args:
            seed: of the reset, by default the one that all runs begin from.
            plain: whether the options and the pins that the user gives are left out.
        """
        description = self.spec.description
        by_seed = self.lead or description.seed is not None or "goal" in self.spec.found
        if seed is None and (self.own is None or by_seed or not self._was_reset):
            seed = description.seed or 0
        given = {} if plain else description.reset
        options = copy.deepcopy(dict(given))  # which the environment may change
        # Some environments draw from the global generators; `kept_generators` puts these back.
        if seed is not None:
            np.random.seed(seed)
            random.seed(seed)
            if self.own is None or self.lead:  # a user of one that goes on does not seed them
                self._actions.seed(seed)
        given_options = {"options": options} if options else {}
        before, tracer = global_state(), sys.gettrace()
        try:
            if self.lead is not None:
                sys.settrace(self.lead)
            result = self.env.reset(seed=seed, **given_options)
        except HyrlError:
            raise
        except (Exception, SystemExit) as error:
            told = f" with the options {dict(given)}" if given else ""
            raise BadInput(
                f"{self.name} cannot be reset{told} ({brief(error)}): "
                f"{'change its options of reset' if given else self._repair(error)}"
            ) from error
        finally:
            if self.lead is not None:
                sys.settrace(tracer)
        if not isinstance(result, tuple) or len(result) != 2:
            raise BadInput(
                f"reset() of {self.name} returns a {type(result).__name__}: let it return an observation and "
                "info"
            )
        observation, self._was_reset = result[0], True
        self.draws_globally |= global_state() != before
        physics = physics_of(self.env)
        if physics is None or physics[0] is not self.model:
            raise BadInput(
                f"reset() of {self.name} builds another model of MuJoCo, and runs are compared on one: let "
                "it keep its model"
            )
        self.data = self.physics.data = physics[1]
        if not self.is_wrapped:
            self.inner_seen = observation
        if self.start is None and not plain:
            self.pin()
        return observation

    def put(self, state: np.ndarray, seed: int | None = None) -> np.ndarray:
        """Resets the environment and puts it to a state of MuJoCo (S,); returns what it observes there (o,).

        Wrappers see the start as the first observation, as if the reset of the innermost environment had led
        there.
        """
        if not self.is_wrapped:
            self.reset(seed)
        self.begin(state, seed)
        self.sense()
        return self.observation

    def play(
        self, start: np.ndarray, inputs: Iterable[np.ndarray], noises: np.ndarray
    ) -> Iterator[Seen]:
        """Yields what is seen of a run at its start, after a reset (see `renew`), and after each sample.

        Args:
            start: MuJoCo's state (S,).
            inputs: (k, m) of the samples.
            noises: (k + 1, d) on the coordinates of the chart.
        """
        self.begin(start)
        self.sense(noises[0])
        yield Seen(start, self.observation, ())
        yield from self.goes_on(inputs, noises[1:])

    def goes_on(self, inputs: Iterable[np.ndarray], noises: np.ndarray) -> Iterator[Seen]:
        """Yields what is seen after each sample from where it is; as `play`, with noises (k, d)."""
        for u, noise in zip(inputs, noises, strict=True):
            self.act(u)
            state = self.physics.read()  # as the environment itself has left it
            self.sense(noise)
            yield Seen(state, self.observation, self.report)

    def arrive(self, state: np.ndarray) -> None:
        """Puts the innermost environment to a start (S,), and has it observe."""
        if self.own is not None:
            given, state = state, self.physics.read()
            state[self.own] = given[self.own]
        if self.lead is not None:
            self.lead.end()
        self.physics.write(state)
        self.inner_seen, self._at_start, self._samples = self.watched(), True, 0
        self.passed = []

    def pin(self) -> None:
        """Sets what is pinned."""
        if pinned := self.spec.description.pinned:
            set_pins(self.data, pinned, self.name)
            self.physics.write(self.physics.read())

    def memory(self) -> written.Fingerprint:
        """Returns what it remembers now outside of its state in MuJoCo: attributes, and MuJoCo's model."""
        return written.fingerprint(self.env, self.physics)

    def remembered(self) -> written.Fingerprint:
        """Returns what it remembers now, to compare it: `memory`, and the parts of MuJoCo's state."""
        found, state = self.memory(), self.physics.read()
        for part, at in self.physics.columns.items():
            found[f"{OF_STATE}{part}"] = state[at].tobytes()
        return found

    def jump(self, state: np.ndarray) -> None:
        """Puts an environment without memory into a state (S,), anywhere in an episode."""
        self.physics.write(state)
        self._samples = 0  # the time limit of an episode is no part of a state

    def mark(self) -> str:
        """Notes what is remembered after a reset; returns what is not as after the first, "" if all is."""
        self._begun = self.remembered()
        self._like = self._like or self._begun
        return next(iter(written.differing(self._begun, self._like)), "")

    def handed_on(self, new: Instance) -> list[str]:
        """Returns the names of what has outlasted episodes of this one, and is so in a new one, too."""
        now, then = self._begun, new._begun
        worn = written.differing(now, self._like or now)
        return [name for name in worn if name in now and name in then and now[name] == then[name]]

    def renew(self) -> str:
        """Leaves the episode before, and gets ready for another one.

        Returns:
            What of it is not like a new one, so that it can play no other; "" if all is.
        """
        self.quit()
        self.reset()
        return self.mark()

    def begin(self, start: np.ndarray, seed: int | None = None) -> None:
        """Begins an episode at a state of MuJoCo (S,); with wrappers, `sense` gives its first observation."""
        if self._thread is None:
            self.arrive(start)
            self.observation = self._flat(self.inner_seen)
        else:
            self.start = start
            self._ask(lambda: self.reset(seed))

    def act(self, u: np.ndarray) -> None:
        """Steps the environment with inputs u (m,); with wrappers, `sense` gives what it comes to."""
        if self._thread is None:
            self.take(self.stepped(u))
        else:
            self._ask(lambda: self.stepped(u))

    def sense(self, noise: np.ndarray | None = None) -> None:
        """Has the environment observe under noise (d,) on the chart's coordinates, by default none."""
        if self._thread is None:
            if noise is not None and noise.any():
                self.observation = self._flat(self.displaced(noise))
            return
        what = "step" if self.start is None else "reset"
        own = self.physics.read() if self.start is None else self.start
        result = self._answer(noise)
        if unlike(self.physics.read(), own)[self.spec.places].any():
            raise BadInput(
                f"a wrapper of {self.name} moves the robot in its {what}() after that of the environment, "
                "and noise and the chart are taken before: let the environment itself do so"
            )
        if self.start is None:
            self.take(result)
        else:
            self.start, self.observation = None, self._flat(result)

    def finish(self) -> None:
        """Refuses an episode in which random numbers were drawn, or what is shared or looked at changed."""
        physics = physics_of(self.env)
        if physics is None or physics[0] is not self.model or physics[1] is not self.data:
            raise BadInput(
                f"{self.name} has another model or data of MuJoCo after an episode than before it: let it "
                "keep those that its reset leads to"
            )
        differ = written.differing(written.shared(self.env), self._begun)
        if changed := [name for name in differ if written.is_shared(name)]:
            raise self.sharing(changed[0])
        for name, generator in self._begun.generators.items():
            if written.state_of(generator) != self._begun[name]:
                raise self._drawing(name)

    def sharing(self, name: str) -> BadInput:
        """Returns the error that an environment changes what all its instances share."""
        return BadInput(
            f"{self.name} changes {name}, which all its instances share, so its episodes depend on each "
            "other: keep it in an attribute that reset() sets"
        )

    def quit(self) -> None:
        """Leaves an episode before its end."""
        if self._thread is not None and self._thread.busy:
            self._answer(None)
        self.start = None

    # ---- below wrappers

    def _put_in(self) -> None:
        """Puts a step and a reset into the innermost environment that pause for the noise of a sample."""
        inner = self.inner
        self._own_step, self._own_reset = inner.step, inner.reset
        self._resetting = False  # its own reset may step it
        self._calls = 0  # of the step, in a sample
        try:
            inner.step, inner.reset = self._inner_step, self._inner_reset
        except Exception as error:
            raise BadInput(
                f"{self.name} allows no attributes beside its own ({brief(error)}), and noise comes in "
                "by its step() below the wrappers: let it allow them, or leave the wrappers out"
            ) from error
        self._thread = Pausing()

    def _ask(self, work: Callable[[], Any]) -> None:
        """Begins a step or a reset, up to where the innermost environment would observe."""
        assert self._thread is not None
        self._calls = 0
        self._thread.begin(work)
        if not self._thread.busy:
            raise BadInput(
                f"a wrapper of {self.name} does not step the environment in each of its steps: leave it out"
            )

    def _answer(self, noise: np.ndarray | None) -> Any:
        """Goes on with noise (d,) to the end of the step or reset, and returns its result."""
        assert self._thread is not None
        return self._thread.go_on(noise)

    def _inner_step(self, action: Any) -> Any:
        if self._resetting:
            return self._own_step(action)
        told = next(self.script, None)
        action = action if told is None else told.action
        action, result = copy.deepcopy(action), self._own_step(action)
        self.inner_seen = copy.deepcopy(result[0])  # wrappers may change theirs in place
        return self._observed(action, result[0], result[1:], told)

    def _inner_reset(self, **options: Any) -> Any:
        self._resetting = True
        try:
            result = self._own_reset(**options)
        finally:
            self._resetting = False
        self.inner_seen = copy.deepcopy(result[0])
        if self.start is None:
            return result
        self.pin()
        self.arrive(self.start)
        seen = copy.deepcopy(self.inner_seen)
        return self._observed(None, seen, result[1:], next(self.script, None))

    def _observed(
        self, action: Any, observation: Any, rest: tuple[Any, ...], told: Passed | None
    ) -> tuple[Any, ...]:
        """Returns what wrappers get of a step or a reset: in a sample, after its noise is known."""
        assert self._thread is not None
        if self._thread.busy:
            self._calls += 1
            if self._calls > 1:
                raise BadInput(
                    f"a wrapper of {self.name} steps or resets the environment more than once in a step, and "
                    "noise comes once a sample: give the environment a frame_skip instead"
                )
            noise = self._thread.pause()
            if noise is not None and noise.any():
                observation = self.displaced(noise)
        if self.is_told and told is not None:
            observation = copy.deepcopy(told.observation)
            rest = *rest[:-3], *told.ends, rest[-1]
        self.passed.append(Passed(action, copy.deepcopy(observation), rest[-3:-1]))
        return (observation, *rest)

    # ---- what it observes

    def _flat(self, observation: Any) -> np.ndarray:
        """Returns an observation as a vector (o,), which its space describes."""
        try:
            vector = flat(observation, self._space)
        except KeyError as error:
            raise BadInput(
                f"an observation of {self.name} has no {error}, as its space has"
            ) from None
        if len(vector) != self._columns:
            raise BadInput(
                f"{self.name} observes {len(vector)} number(s), and its observation_space has "
                f"{self._columns}: let them be as many"
            )
        return vector

    def watched(self) -> Any:
        """Returns what the innermost environment observes in its present state."""
        space, names, seen = self.inner.observation_space, self.spec.observers, list[Any]()
        for name in names:
            try:
                seen.append(self._observers[name]())
            except Exception as error:
                raise BadInput(
                    f"{name}() of {self.name} raises {brief(error)}: repair it"
                ) from error
            if len(seen) > 1 and unlike(flat(seen[0], space), flat(seen[-1], space)).any():
                raise BadInput(
                    f"{names[0]}() and {name}() of {self.name} both give what it observes, but differ where "
                    "noise may show the robot: let one of them have another name"
                )
        return seen[0]

    def displaced(self, noise: np.ndarray) -> Any:
        """Returns what the innermost environment observes with noise (d,) on the chart's coordinates.

        Where what is observed is known to show derived quantities of a physics step before, these are
        computed where the robot was then, with the noise. Where it is not known which they are, what is
        observed changes by the difference of two observations with all of them up to date.
        """
        state, space = self.physics.read(), self.inner.observation_space
        derived: Derived = "now" if self._at_start else self.spec.derived
        given = flat(self.inner_seen, space)
        seen = self.seen_as(derived, state, noise)
        if derived == "unknown":
            seen = given + (seen - self.seen_as("now", state, np.zeros(len(noise))))
        again = flat(self.watched(), space)
        if (off := unlike(again, given)).any():
            column = int(off.argmax())
            raise BadInput(
                f"{self.name} has observed {given[column]:.6g} in observation[{column}], and "
                f"{self.spec.observers[0]}() gives {again[column]:.6g} in the same state: let it compute all "
                "that is observed, and remember nothing"
            )
        return shaped(seen, self.inner_seen, space)

    def seen_as(self, derived: Derived, state: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Returns the innermost observation (o,) of a state (S,) under noise (d,), as `derived` says."""
        self.physics.leave()
        moved = self.moved(state, noise)
        if derived == "earlier":
            self.physics.write(self.moved(self.physics.earlier(state), noise))
            self.physics.show(moved)
        else:
            self.physics.write(moved)
        seen = flat(self.watched(), self.inner.observation_space)
        self.physics.come_back()
        return seen

    def recalls(self, fresh: Instance, state: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Returns which columns (o,) it observes otherwise than one that was only reset.

        Both observe in a state (S,) with noise (d,) on the coordinates of the chart.
        """
        seen = self.seen_as("now", state, noise)
        fresh.physics.write(self.moved(state, noise))
        return unlike(seen, flat(fresh.watched(), self.inner.observation_space))

    def moved(self, state: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Returns a state of MuJoCo (S,) with noise (d,) added to the coordinates of the chart."""
        moved = state.copy()
        moved[self.spec.places] += noise
        return moved

    # ---- steps

    def drawn(self, rng: np.random.Generator) -> np.ndarray:
        """Returns inputs (m,) at random."""
        space: Any = self._actions
        if isinstance(space, spaces.Discrete):
            return np.array([float(rng.integers(space.n))])
        return np.ravel(rng.uniform(space.low, space.high)).astype(float)

    def action(self, u: np.ndarray) -> Any:
        """Returns the environment's action for inputs u (m,)."""
        space: Any = self._actions
        if isinstance(space, spaces.Discrete):
            return round(float(u[0]))
        return u.astype(space.dtype).reshape(space.shape)

    def stepped(self, u: np.ndarray) -> Any:
        """Returns what the environment's own step returns for inputs u (m,)."""
        action, self._at_start, began = self.action(u), False, self.data.time
        try:
            result = self.env.step(action)
        except HyrlError:
            raise
        except (Exception, SystemExit) as error:
            if "SimpleQueue" in str(error):  # of what pauses below the wrappers
                raise BadInput(
                    f"a wrapper of {self.name} copies the environment, and noise reaches no copies: let it "
                    "look ahead in an environment of its own"
                ) from error
            raise BadInput(
                f"step() of {self.name} raises {brief(error)}: {self._repair(error)}"
            ) from error
        result = checked_step(result, self.name)
        if not self.is_wrapped:
            self.inner_seen = result[0]
        took, dt = self.data.time - began, self.spec.dt
        if took < 0:
            raise BadInput(
                f"the time of {self.name} goes back in step(): it is reset at its ends, which its user has "
                "to do, or its simulation diverges and MuJoCo resets it (limit its inputs, or take a smaller "
                "timestep)"
            )
        self._samples += 1
        goes_on = dt and not (result[2] or result[3])
        if goes_on and abs(took - dt) > 1e-3 * dt:  # rounding of differences of the time
            raise BadInput(
                f"a step of {self.name} takes {took:.6g} s, and others {dt:.6g} s: let each take as long"
            )
        return result

    def _repair(self, error: BaseException) -> str:
        """Returns what to do about an error, of which a wrapper that is left out may be the cause."""
        left_out = self._left_out and isinstance(error, AttributeError)
        return "repair it" + (
            f", or let it do without {self._left_out}, which is left out" if left_out else ""
        )

    def take(self, result: Any) -> None:
        """Notes the observation and the report of what a step has returned."""
        observation, reward, terminated, truncated, info = result
        self.observation = self._flat(observation)
        # The limit of `steps`, or that of a wrapper which episodes are played without.
        over = self._samples == self.spec.max_steps and not self._as_it_is
        over &= "truncated" in self.spec.criterion.asked
        truncated = bool(truncated) or over
        touch = bool(terminated) and bool(
            self.physics.touched(self.spec.solid) - self.spec.harmless
        )
        report = [reward, bool(terminated), bool(truncated), touch]
        report += [entry(info, key) for key in self.spec.criterion.keys]
        if self.spec.criterion.points:
            # Where things are now: the environment's own data may show a physics step before.
            self._placed = self._placed or mujoco.MjData(self.model)
            for part in ("qpos", "mocap_pos", "mocap_quat"):
                getattr(self._placed, part)[:] = getattr(self.data, part)
            mujoco.mj_kinematics(self.model, self._placed)
        for (a, i), (b, j) in self.spec.criterion.points:
            away = getattr(self._placed, a)[i] - getattr(self._placed, b)[j]
            report.append(math.sqrt(away.dot(away)))
        self.report = report

    def wander(self, rng: np.random.Generator, samples: int, held: int) -> Iterator[Any]:
        """Yields what each step returns under inputs at random, each held for so many samples, to the end."""
        with self.undrawn():
            for k in range(samples):
                if k % held == 0:
                    u = self.drawn(rng)
                result = self.stepped(u)
                yield result
                if result[2] or result[3]:
                    break

    @contextmanager
    def undrawn(self) -> Iterator[None]:
        """Raises `BadInput` after steps that draw from a global generator of random numbers."""
        before = global_state()
        yield
        if global_state() != before:
            raise self._drawing("a global generator")

    def _drawing(self, name: str) -> BadInput:
        return BadInput(
            f"{self.name} draws random numbers in step() ({name}), so its state does not tell what comes "
            "next: make it without that noise"
        )


def renewed(instance: Instance) -> Instance:
    """Returns what can play another run: an instance, or a new one if something outlasts its resets."""
    return begun(Instance(instance.spec), instance) if instance.renew() else instance


def begun(new: Instance, worn: Instance | None) -> Instance:
    """Returns a new instance after its first reset.

    Raises:
        BadInput: what has outlasted episodes of a worn one is in it, too, as from shared memory or a file.
    """
    new.renew()
    if worn and worn._like and (kept := worn.handed_on(new)):
        time.sleep(TICK)  # a clock has gone on then
        another = Instance(new.spec)
        another.renew()
        for name in kept:
            if name in worn.handed_on(another):
                raise new.sharing(name)
    return new


def to_end(run: Iterable[Seen]) -> Iterator[Seen]:
    """Yields what is seen of a run to the first end of its episode."""
    for seen in run:
        yield seen
        if any(seen.report[1:3]):
            return


def outlasting(old: Instance) -> list[str]:
    """Returns the names of what the reset with the seed leaves otherwise in an instance than in a new one."""
    seed, remembered = old.spec.description.seed or 0, []
    for one in (Instance(old.spec), Instance(old.spec), old):
        one.quit()
        one.reset(seed)
        # Who goes on from episode to episode does not seed the space of actions, which may never have drawn.
        if one._actions._np_random is None:
            one._actions.seed(seed)
        remembered.append(one.remembered())
    new, twin, now = remembered
    # Names of files differ between any two, say, and the warm start tells nothing of where a run goes.
    passed = {*written.differing(new, twin), f"{OF_STATE}warmstart"}
    return [name for name in written.differing(now, new) if name not in passed]
