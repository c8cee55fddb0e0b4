"""Episodes of an environment in one process: instances that play them, and others that judge.

The real environment is the judge: a new one, as its user has it, which is only put to the same starts and
stepped, has to go and to end alike.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium.wrappers import TimeLimit

from hyrl_mj.errors import BadInput
from hyrl_mj.files import trust
from hyrl_mj.gym_import import fingerprint as written
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.instance import OF_STATE, Instance, Passed, begun, outlasting
from hyrl_mj.gym_import.observations import unlike
from hyrl_mj.gym_import.opening import layers
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.system import limits
from hyrl_mj.tasks import Outcome

Arrays = tuple[np.ndarray, ...]
# Runs of a judgement that an environment plays, too, which goes on from episode to episode; all of them where
# something outlasts its resets.
LIVED = 16
# Resets that show what they draw without a seed.
DRAWS = 8


@dataclass(frozen=True)
class Played:
    """Samples of one run.

    Attributes:
        start: MuJoCo's state (S,) in which it begins.
        inputs: (k, m).
        path: (k + 1, d) chart points, before and after each sample.
        outcome: how it ended.
        cut: whether it was cut off after these samples, and its outcome is the verdict on its last state.
        observations: (k + 1, o), or without the last (k, o).
        noise: (k + 1, d) on the chart's coordinates.
        rewards: (k, 1) of the samples, or none.
    """

    start: np.ndarray
    inputs: np.ndarray
    path: np.ndarray
    outcome: int
    cut: bool
    observations: np.ndarray
    noise: np.ndarray
    rewards: np.ndarray | None = None


class Stage:
    """The instances of one process, and the episodes that they play.

    Args:
        spec: what is known of the environment.
    """

    def __init__(self, spec: EnvironmentSpec):
        self.spec = spec
        self._playing: dict[int, Instance] = {}  # by the number of the run
        self._free: list[Instance] = []
        # Which play nothing but what they judge, as their user has them, or without time limits.
        self._judges: dict[bool, list[Instance]] = {True: [], False: []}
        self._lived: dict[bool, Instance] = {}  # which is never replaced
        self._wears = False  # whether something has outlasted a reset
        self._elsewhere: list[Instance] = []
        self._led: list[Instance] = []
        self._resting: Instance | None = None
        self._fresh: Instance | None = None  # which has only been reset
        self._shared: written.Fingerprint | None = None  # by a new instance with all others

    def try_out(self) -> Arrays:
        """Makes, resets and steps an environment within limits of time and memory of this process."""
        limits.limit()
        with trust.received():  # code that an argument names does not run
            instance = self._new(real=False)
            instance.reset()
            instance.stepped(instance.drawn(np.random.default_rng(0)))
        return ()

    def begin(self, runs: np.ndarray, starts: np.ndarray) -> Arrays:
        """Gives runs (k,) an instance each, and begins their episodes at MuJoCo's states (k, S)."""
        for run, start in zip(runs.tolist(), starts, strict=True):
            instance = self._renewed(self._free)
            instance.begin(start)
            self._playing[run] = instance
        return ()

    def act(self, runs: np.ndarray, u: np.ndarray) -> Arrays:
        """Steps runs (k,) with inputs (k, m).

        Returns:
            MuJoCo's states (k, S), observations (k, o) and reports (k, r); the last two come from `sense`
            where wrappers lie around the environment.
        """
        return self._acted([self._playing[run] for run in runs.tolist()], u)

    def sense(self, runs: np.ndarray, noise: np.ndarray) -> Arrays:
        """Gives runs (k,) the noise (k, d) of a sample; returns observations (k, o) and reports (k, r)."""
        instances = [self._playing[run] for run in runs.tolist()]
        for instance, of_run in zip(instances, noise, strict=True):
            instance.sense(of_run)
        return np.array([i.observation for i in instances]), np.array([i.report for i in instances])

    def leave(self, runs: np.ndarray) -> Arrays:
        """Lets the instances of runs (k,) play others.

        Raises:
            BadInput: random numbers were drawn in one of them.
        """
        instances = [self._playing.pop(run) for run in runs.tolist()]
        self._free += instances
        try:
            for instance in instances:
                instance.finish()
        finally:
            for instance in instances:
                instance.quit()
        return ()

    def rest(self, starts: np.ndarray) -> Arrays:
        """Returns what episodes that begin in states (k, S) observe first (k, o), and depths (k,) [m]."""
        seen, depths = [], []
        for start in starts:
            if self._resting is None or self.spec.wrapped:
                self._resting = self._renewed([self._resting] if self._resting else [])
            self._resting.begin(start)
            self._resting.sense()
            seen.append(self._resting.observation)
            depths.append(self._resting.physics.depth(self.spec.solid))
        return np.array(seen), np.array(depths)

    def branch(self, states: np.ndarray, u: np.ndarray) -> Arrays:
        """Steps an environment without memory from states (k, S), written directly, with inputs u (k, m).

        Returns what `act` returns.

        Raises:
            BadInput: it remembers something after all.
        """
        instance = self._renewed(self._free)
        instance.begin(states[0])
        before = instance.memory()
        results = self._acted([instance] * len(u), u, states)
        if changed := written.differing(instance.memory(), before):
            raise BadInput(
                f"{instance.name} remembers something in {changed[0]}, as no sampled run showed; without a "
                "memory that is always there it cannot be tabulated"
            )
        self._free.append(instance)
        return results

    def check(self, runs: Sequence[Played]) -> None:
        """Plays runs in new environments; raises `BadInput` if these go another way."""
        if self._fresh is None:
            self._fresh = self._new(real=False)
            self._fresh.reset()
        for i, run in enumerate(runs):
            # A time limit of its own would end a run that is simulated for longer.
            as_it_is = len(run.inputs) <= self.spec.max_steps
            passed = self._judge(run, run.noise, as_it_is)
            if len(runs) > 1 and (i < LIVED or self._wears) and run.outcome != Outcome.UNSTABLE:
                self._live(run, as_it_is)
            if self.spec.led is not None:
                self._lead(run)
            if run.noise.any():
                self._judge(run, np.zeros_like(run.noise), as_it_is, passed)
            if run.noise.any() and self.spec.wrapped:
                self._check_told(run, passed, i)

    def _judge(
        self, run: Played, noise: np.ndarray, as_it_is: bool, script: Sequence[Passed] = ()
    ) -> list[Passed]:
        """Plays a run in a new environment, as `judge` does, which has its time limit or not.

        Returns:
            What has passed between it and its wrappers.
        """
        real = self._renewed(self._judges[as_it_is], as_it_is)
        real.script = iter(script)
        judge(run, real, noise, self._fresh)
        self._judges[as_it_is].append(real)
        return real.passed

    def _check_told(self, run: Played, passed: Sequence[Passed], seed: int) -> None:
        """Raises `BadInput` if wrappers observe more of the robot than the environment observes.

        They get what they got in a run, but in an environment whose robot is elsewhere, and goes elsewhere.
        """
        other, chart = self._renewed(self._elsewhere), self.spec.chart
        actions = copy.deepcopy(other.inner.action_space)
        actions.seed(seed)
        other.script = iter([one._replace(action=actions.sample()) for one in passed])
        other.is_told, told = True, list[np.ndarray]()
        place = np.random.default_rng(seed).uniform(chart.low, chart.high)
        (start,) = self.spec.state_at(place[None])
        with suppress(BadInput):  # it may not be able to go on from there
            for sample in other.play(start, run.inputs, np.zeros_like(run.noise)):
                told.append(sample.observation)
        self._elsewhere.append(other)
        for k, (seen, shown) in enumerate(zip(run.observations, told, strict=False)):
            if (off := unlike(seen, shown)).any():
                raise BadInput(
                    f"a wrapper of {self.spec.name} shows in observation[{off.argmax()}], after {k} "
                    "sample(s), more of the robot than the environment observes, as from info, the reward, "
                    "an attribute or MuJoCo's state, where noise does not come: let it observe what the "
                    "environment observes, or let the environment observe that"
                )

    def _live(self, run: Played, as_it_is: bool) -> None:
        """Plays a run as a further episode of an environment that is never replaced, as its user has one."""
        if (lived := self._lived.get(as_it_is)) is None:
            lived = self._lived[as_it_is] = Instance(self.spec, as_it_is)
            warmstart = lived.physics.columns["warmstart"]
            lived.own = np.append(own_of(lived), warmstart)
        lived.renew()
        # A reward that no episode is judged by may be normalised by those before.
        rewards = run.rewards if "reward" in self.spec.criterion.asked else None
        judge(replace(run, rewards=rewards), lived, run.noise, None)

    def _lead(self, run: Played) -> None:
        """Plays a run from a reset that is led to its start, as its user would have it lead there."""
        (usual, led), how = (self._renewed(self._led) for _ in range(2)), self.spec.led
        if noted := how.noted(usual, led, run.start):
            led = self._renewed([led])
            with how.to(led, run.start):
                if not self.spec.wrapped:
                    led.reset()
                try:
                    judge(replace(run, rewards=None), led, run.noise, None)
                except BadInput as error:
                    raise how.refused(led.name, noted) from error
        self._led += [usual, led]

    def _acted(
        self, instances: Sequence[Instance], u: np.ndarray, begun: np.ndarray | None = None
    ) -> Arrays:
        """Steps instances with inputs (k, m), from where they are or from states (k, S) written before."""
        states, seen, reports = [], [], []
        with instances[0].undrawn():
            for i, (instance, inputs) in enumerate(zip(instances, u, strict=True)):
                if begun is not None:
                    instance.jump(begun[i])
                instance.act(inputs)
                states.append(instance.physics.read())
                seen.append(instance.observation)
                reports.append(instance.report)
        return np.array(states), np.array(seen), np.array(reports, dtype=float)

    # ---- instances

    def _renewed(self, spare: list[Instance], real: bool = False) -> Instance:
        """Returns an instance that can begin an episode: a spare one, or a new one if these are worn."""
        old = None
        while spare:
            old = spare.pop()
            if not (worn := old.renew()):
                return old
            self._wears = True
            if written.is_shared(worn):
                raise old.sharing(worn)
        return begun(self._new(real), old)

    def _new(self, real: bool) -> Instance:
        instance = Instance(self.spec, real)
        shared = written.shared(instance.env)
        self._shared = self._shared or shared
        if changed := written.differing(shared, self._shared):
            raise instance.sharing(changed[0])
        return instance


def judge(run: Played, real: Instance, noise: np.ndarray, fresh: Instance | None) -> None:
    """Plays a run in an environment that its user would make.

    That is put to the start and stepped, past all that lets episodes be played side by side. There is no
    tolerance: the same code computes the same from the same numbers. Without the run's noise, and with the
    actions that wrappers passed on under it, the run goes and ends alike.

    Args:
        run: the run.
        real: the environment.
        noise: (k + 1, d) that of the run, or none.
        fresh: another one, which has only been reset: what it observes in a state shows what `real` has
            stored on its way there; None where `real` goes on from other episodes.

    Raises:
        BadInput: the run went otherwise.
    """
    spec, heard = real.spec, noise is run.noise
    samples = []
    for sample in real.play(run.start, run.inputs, noise):
        samples.append(sample)
        known = len(samples) > 1 and np.isfinite(sample.state).all()
        if fresh is None or not (heard and noise.any() and known):
            continue
        shown = noise[len(samples) - 1]
        if (stored := real.recalls(fresh, sample.state, shown) & ~spec.recalled).any():
            raise BadInput(
                f"observation[{stored.argmax()}] of {real.name} is not what it observes in its state, after "
                f"{len(samples) - 1} sample(s): step() has stored it on the way, as a sensor that measures "
                "now and then, and noise does not reach it; compute it from the state"
            )
    if real.own is None:
        real.finish()
    states, observations, reports = zip(*samples, strict=True)
    path = np.vstack([run.path[:1], spec.z(np.array(states[1:]).reshape(-1, len(run.start)))])
    if len(samples) == 1:
        return
    if not heard and not np.array_equal(path, run.path, equal_nan=True):
        raise _notes(spec)
    told = np.array(reports[1:], dtype=float)
    if heard:
        seen = observations[: len(run.observations)]
        _compare(real, "observation", run.observations, seen)
        _compare(real, "the chart's coordinate", run.path, path)
        _compare(real, "reward", run.rewards, told[:, :1])
    if run.outcome == Outcome.UNSTABLE:
        return
    over = run.cut and len(run.inputs) == spec.max_steps
    if over and not told[-1, 1:3].any() and any(isinstance(o, TimeLimit) for o in layers(real.env)):
        raise BadInput(
            f"{real.name} goes on after the {spec.max_steps} steps of its TimeLimit, whose end a wrapper "
            "around it takes away: give steps, the number of samples of an episode"
        )
    success, ends = spec.criterion.judged(told)
    if run.cut and ends[-1] == Outcome.RUNNING:
        ends[-1] = spec.criterion.verdict(success[-1:])[0]
    expected = np.append(np.full(len(ends) - 1, int(Outcome.RUNNING)), run.outcome)
    if (wrong := np.flatnonzero(ends != expected)).size:
        if not (heard or spec.wrapped):
            raise _notes(spec)
        k = int(wrong[0])
        ours, theirs = (Outcome(int(values[k])).label for values in (expected, ends))
        how = "" if heard else " without the noise, which must not judge"
        raise _goes_another_way(real, f"after {k + 1} sample(s) it is {ours}, and {theirs}{how}")


def _notes(spec: EnvironmentSpec) -> BadInput:
    return BadInput(
        f"a run of {spec.name} goes or ends otherwise without the noise, with the same actions: step() goes "
        f"by what {spec.observers[0]}() has noted where noise showed the robot, or a wrapper writes to the "
        "environment by what it observes, so let them only read"
    )


def _compare(real: Instance, what: str, ours: np.ndarray | None, theirs: Any) -> None:
    if ours is None or np.array_equal(ours, theirs, equal_nan=True):
        return
    # What outlasts a reset may change how numbers are rounded.
    most = 0.0 if real.own is None else 1e-6
    same = np.isclose(ours, theirs, rtol=most, atol=most, equal_nan=True)
    if (apart := np.argwhere(~same)).size:
        k, i = apart[0]
        values = f"{what}[{i}] is {ours[k][i]:.9g} after {k} sample(s), and {theirs[k][i]:.9g}"
        raise _goes_another_way(real, values)


def _goes_another_way(real: Instance, how: str) -> BadInput:
    if real.own is not None:
        return _changes(real, how)
    return BadInput(
        f"{real.name} goes another way than a new one from the same start with the same inputs: {how} in the "
        "new one; it depends on other episodes, on time, on chance, on a callback of all instances (as of "
        "set_mjcb_passive), on wrappers around a time limit, or on what it observes"
    )


def _changes(lived: Instance, how: str) -> BadInput:
    """Returns the error that a later episode of an instance goes otherwise, with what it may depend on."""
    lasts = outlasting(lived)
    before, other = lived.memory(), dict[str, None]()
    for _ in range(DRAWS):
        lived.reset()
        other |= dict.fromkeys(written.differing(lived.memory(), before))
    draws = [name for name in other if name not in {*lasts, *before.generators}]
    told = {"what outlasts resets": lasts, "what resets without a seed draw": draws}
    causes = [f"{what} ({', '.join(names[:4])})" for what, names in told.items() if names]
    repair = "let reset() set it back, or pin it by reset, pinned or seed"
    if lasts and lasts[0].startswith(OF_STATE):
        repair = "let reset() call mj_resetData"
    elif lasts and lasts[0].startswith("NormalizeObservation"):
        repair = (
            "load its statistics (obs_rms) and set update_running_mean = False where it is made"
        )
    return BadInput(
        f"{lived.name} changes from episode to episode: {how} in a later one. It depends on "
        f"{' or '.join(causes) or 'what no attribute tells'}, and here each episode is played by an "
        f"environment that is like new; {repair}"
    )
