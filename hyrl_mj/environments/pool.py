"""Instances of an environment in processes, one on each core, which play the episodes of many runs.

Each process is a fork of this one. What an episode does depends on its start, inputs and noise alone, so
results do not depend on the number of processes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from threading import Lock
from typing import Any

import numpy as np

from hyrl_mj import cores
from hyrl_mj.environments import fingerprint as written
from hyrl_mj.environments.instance import Instance, Recipe, Worn
from hyrl_mj.environments.judge import Played, Real
from hyrl_mj.errors import BadInput, HyrlError, brief

# Fewer episodes than this for each process are played by one.
FEWEST = 16
# Instances of each process. A run whose instance plays another one is played again from its start.
MOST = 256
# Runs: number of the plant, row, and number of the process that plays it.
Key = tuple[int, int, int]


@dataclass
class Episode:
    """An episode that is being played.

    Attributes:
        start: MuJoCo's state (S,) in which it begins.
        inputs: inputs (m,) of the samples so far.
        noise: noise (d,) of the samples so far; one more where the last one has been sensed.
        instance: which plays it; None if that plays another one now.
    """

    start: np.ndarray
    inputs: list[np.ndarray] = field(default_factory=list)
    noise: list[np.ndarray] = field(default_factory=list)
    instance: Instance | None = None


class Stage:
    """The instances of one process, and the episodes that they play.

    Args:
        recipe: how instances are made.
    """

    def __init__(self, recipe: Recipe):
        self.recipe = recipe
        self._episodes: dict[Key, Episode] = {}  # in the order of their last use
        self._free: list[Instance] = []
        self._playing = 0
        self._resting: Instance | None = None
        self._tabulating: Instance | None = None
        self._real = Real(recipe)
        self._shared: written.Fingerprint | None = (
            None  # what a new instance shares with all others
        )

    def act(self, keys: Sequence[Key], starts: Any, u: np.ndarray) -> tuple[np.ndarray, ...]:
        """Steps episodes; those that are new begin at `starts`, MuJoCo's states by the run.

        Returns:
            MuJoCo's states (k, S), reports (k, r) and observations (k, o).
        """
        states, reports, seen = [], [], []
        for first in range(0, len(keys), MOST):  # so many have an instance at once
            some = slice(first, first + MOST)
            episodes = [self._opened(key, starts) for key in keys[some]]
            instances = [self._ready(episode) for episode in episodes]
            with instances[0].undrawn():
                for episode, instance, inputs in zip(episodes, instances, u[some], strict=True):
                    if len(episode.noise) == len(episode.inputs):
                        self._sense(episode, np.zeros(len(self.recipe.noisy)))
                    reports.append(instance.act(inputs))
                    episode.inputs.append(inputs)
                    states.append(instance.physics.read())
                    seen.append(instance.observation)
        return np.array(states), np.array(reports), np.array(seen)

    def sense(self, keys: Sequence[Key], starts: Any, noise: np.ndarray) -> tuple[Any, ...]:
        """Gives episodes the noise (k, d) of a sample.

        Returns:
            Observations (k, o), and reports (k, r) where they are complete only now, else None.
        """
        seen, reports = [], []
        for key, row in zip(keys, noise, strict=True):
            episode = self._opened(key, starts)
            instance = self._ready(episode)
            reports.append(self._sense(episode, row))
            seen.append(instance.observation)
        late = [report for report in reports if report is not None]
        return np.array(seen), np.array(late) if len(late) == len(reports) else None

    def leave(self, keys: Sequence[Key]) -> None:
        """Lets the instances of episodes play others.

        Raises:
            BadInput: random numbers were drawn in one of them.
        """
        for key in keys:
            episode = self._episodes.pop(key, None)
            if episode is not None and episode.instance is not None:
                try:
                    episode.instance.finish()
                finally:
                    self._put_back(episode)

    def rest(self, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns what episodes that begin in states (k, S) observe first (k, o), and depths (k,)."""
        seen, depths = [], []
        for start in starts:
            if self._resting is None:
                self._resting = self._new()
            try:
                seen.append(self._resting.rested(start))
            except Worn:
                self._resting = self._new()
                seen.append(self._resting.rested(start))
            depths.append(self._resting.depth())
        return np.array(seen), np.array(depths)

    def branch(self, states: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, ...]:
        """Steps an environment without memory from states (k, S), written directly, with inputs u (k, m).

        Returns what `act` returns.

        Raises:
            BadInput: it remembers something after all.
        """
        if self._tabulating is None:
            self._tabulating = self._new()
            self._tabulating.begin(self._tabulating.physics.read())
        instance, after, reports, seen = self._tabulating, [], [], []
        before = written.fingerprint(instance.env)
        for state, inputs in zip(states, u, strict=True):
            instance.physics.write(state)
            reports.append(instance.act(inputs))
            after.append(instance.physics.read())
            seen.append(instance.observation)
        if changed := written.differing(written.fingerprint(instance.env), before):
            raise BadInput(
                f"{self.recipe.source.name} remembers something in {changed[0]}, as no sampled run showed; "
                "without a memory that is always there it cannot be tabulated"
            )
        return np.array(after), np.array(reports), np.array(seen)

    def check(self, runs: Sequence[Played]) -> None:
        """Plays runs in new environments, and raises `BadInput` if these go another way."""
        self._real.check(runs)

    # ---- instances

    def _opened(self, key: Key, starts: Any) -> Episode:
        episode = self._episodes.pop(key, None) or Episode(starts[key])
        self._episodes[key] = episode
        return episode

    def _ready(self, episode: Episode) -> Instance:
        """Returns the instance of an episode, which has played it up to the present sample."""
        if episode.instance is not None:
            return episode.instance
        episode.instance = instance = self._begun(episode.start)
        for k, noise in enumerate(episode.noise):
            instance.sense(noise)
            if k < len(episode.inputs):
                instance.act(episode.inputs[k])
        if len(episode.inputs) > len(episode.noise):
            raise AssertionError("an episode went on without an observation")
        return instance

    def _begun(self, start: np.ndarray) -> Instance:
        while True:
            instance = self._taken()
            try:
                instance.begin(start)
                return instance
            except Worn as worn:  # a new one takes its place
                instance.quit()
                self._playing -= 1
                if written.is_shared(str(worn)):
                    raise self._is_shared(str(worn)) from None

    def _taken(self) -> Instance:
        """Returns an instance that plays nothing."""
        self._playing += 1
        if not self._free and self._playing > MOST:
            oldest = next(e for e in self._episodes.values() if e.instance is not None)
            self._put_back(oldest)
        return self._free.pop() if self._free else self._new()

    def _new(self) -> Instance:
        instance = Instance(self.recipe)
        shared = written.Fingerprint()
        found = written.fingerprint(instance.env)
        shared.update((name, value) for name, value in found.items() if written.is_shared(name))
        if self._shared is None:
            self._shared = shared
        elif changed := written.differing(shared, self._shared):
            raise self._is_shared(changed[0])
        return instance

    def _is_shared(self, name: str) -> BadInput:
        return BadInput(
            f"{self.recipe.source.name} changes {name}, which all its instances share, so its episodes "
            "depend on each other: keep it in an attribute that reset() sets"
        )

    def _put_back(self, episode: Episode) -> None:
        assert episode.instance is not None
        episode.instance.quit()
        self._free.append(episode.instance)
        episode.instance, self._playing = None, self._playing - 1

    def _sense(self, episode: Episode, noise: np.ndarray) -> np.ndarray | None:
        assert episode.instance is not None
        episode.noise.append(noise)
        return episode.instance.sense(noise)


class Pool:
    """Plays episodes of an environment on all cores.

    Args:
        recipe: how instances are made.
    """

    def __init__(self, recipe: Recipe):
        self.recipe = recipe
        self._stage = Stage(recipe)
        self._owner = os.getpid()
        self._hands: list[Connection] = []
        self._lock = Lock()  # a game attacks several controllers in threads
        self.left: deque[set[Key]] = deque()  # runs of plants that nobody has any more

    def act(
        self, keys: Sequence[Key], starts: Mapping[Key, np.ndarray], u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Does what `Stage.act` does."""
        parts = self._spread("act", keys, starts, u)
        return tuple(_joined(parts, len(keys), i) for i in range(3))  # type: ignore[return-value]

    def sense(
        self, keys: Sequence[Key], starts: Mapping[Key, np.ndarray], noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Does what `Stage.sense` does."""
        parts = self._spread("sense", keys, starts, noise)
        late = all(result[1] is not None for _, result in parts)
        seen = _joined(parts, len(keys), 0)
        return seen, _joined(parts, len(keys), 1) if late else None

    def leave(self, keys: Sequence[Key]) -> None:
        """Does what `Stage.leave` does."""
        if keys:
            self._spread("leave", keys)

    def rest(self, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Does what `Stage.rest` does."""
        rows, parts = self._rows("rest", starts)
        return tuple(_joined([*zip(rows, parts, strict=True)], len(starts), i) for i in range(2))  # type: ignore[return-value]

    def branch(self, states: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, ...]:
        """Does what `Stage.branch` does."""
        rows, parts = self._rows("branch", states, u)
        return tuple(_joined([*zip(rows, parts, strict=True)], len(states), i) for i in range(3))

    def check(self, runs: Sequence[Played]) -> None:
        """Does what `Stage.check` does."""
        count = self.processes(len(runs))
        with self._lock:
            self._opened(count)
            self._at_once([("check", (runs[i::count],)) for i in range(count)])

    def _rows(self, what: str, *arrays: np.ndarray) -> tuple[list[np.ndarray], list[Any]]:
        """Returns rows of arrays for each process, and what it answers to them."""
        with self._lock:
            count = self._opened(self.processes(len(arrays[0])))
            rows = [np.arange(len(arrays[0]))[i::count] for i in range(count)]
            return rows, self._at_once([(what, tuple(a[r] for a in arrays)) for r in rows])

    def _spread(
        self, what: str, keys: Sequence[Key], starts: Any = None, values: np.ndarray | None = None
    ) -> list[tuple[np.ndarray, Any]]:
        """Returns the rows of each process with what it answers; a run stays in its process."""
        while self.left and what != "leave":
            self.leave(sorted(self.left.popleft()))
        with self._lock:
            place = np.array([key[2] for key in keys])
            count = self._opened(int(place.max(initial=0)) + 1)
            rows = [r for i in range(count) if len(r := np.flatnonzero(place == i)) or not i]
            places = [i for i in range(count) if (place == i).any() or not i]
            jobs: list[tuple[str, Any]] = []
            for r in rows:
                mine = [keys[int(i)] for i in r]
                if values is None:
                    jobs.append((what, (mine,)))
                else:
                    new = {key: starts[key] for key in mine if key in starts}
                    jobs.append((what, (mine, new, values[r])))
            answers = self._at_once(jobs, places)
            return [(r, a) for r, a in zip(rows, answers, strict=True) if len(r)]

    def _at_once(self, jobs: list[tuple[str, Any]], places: list[int] | None = None) -> list[Any]:
        """Returns the answers to jobs: the first is done here, the others by other processes."""
        hands = [self._hands[i - 1] for i in (places or range(len(jobs)))[1:]]
        for hand, job in zip(hands, jobs[1:], strict=True):
            hand.send(job)
        results, error = [], None
        try:
            what, arguments = jobs[0]
            results = [getattr(self._stage, what)(*arguments)]
        finally:  # what was asked for is always taken, or it would be taken for another answer
            for hand in hands:
                answer = _answer(hand)
                error = error or (answer if isinstance(answer, Exception) else None)
                results.append(answer)
        if error is not None:
            raise error
        return results

    def processes(self, runs: int) -> int:
        """Returns over how many processes so many runs are spread, this one included."""
        if "fork" not in multiprocessing.get_all_start_methods():
            return 1
        if multiprocessing.current_process().daemon:
            return 1
        return min(cores.count(), max(runs // FEWEST, 1))

    def _opened(self, count: int) -> int:
        """Makes the processes that are missing, and returns their number."""
        if self._owner != os.getpid():
            # Instances and processes of a process that this one was forked from are not ours.
            self._owner, self._hands = os.getpid(), []
            self._stage = Stage(self.recipe)
        context = multiprocessing.get_context("fork") if count > 1 else None
        while context is not None and len(self._hands) < count - 1:
            ours, theirs = context.Pipe()
            worker = context.Process(
                target=_serve,
                args=(theirs, self.recipe, [*self._hands, ours]),
                daemon=True,
            )
            with warnings.catch_warnings():
                # Python 3.12 warns of threads: those of torch and MuJoCo take no part in the children.
                warnings.simplefilter("ignore", DeprecationWarning)
                worker.start()
            theirs.close()
            self._hands.append(ours)
        return count

    def __deepcopy__(self, memo: dict[int, Any]) -> Pool:
        return self


def _joined(parts: Sequence[tuple[np.ndarray, Any]], n: int, i: int) -> np.ndarray:
    """Returns arrays (k, ...) of parts of n rows as one array, each row in its place."""
    first = parts[0][1][i]
    whole = np.empty((n, *first.shape[1:]))
    for rows, result in parts:
        whole[rows] = result[i]
    return whole


def _answer(hand: Connection) -> Any:
    try:
        return hand.recv()
    except EOFError:
        return BadInput(
            "a process that steps an environment has ended: see what it printed, and repair it"
        )


def _serve(work: Connection, recipe: Recipe, others: Sequence[Connection]) -> None:
    """Answers what is asked through a pipe, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for other in others:
        other.close()
    stage = Stage(recipe)
    with suppress(EOFError, BrokenPipeError):
        while True:
            what, arguments = work.recv()
            try:
                answer = getattr(stage, what)(*arguments)
            except HyrlError as error:
                answer = error
            except Exception as error:
                answer = BadInput(f"{recipe.source.name} cannot be stepped: {brief(error)}")
            work.send(answer)
