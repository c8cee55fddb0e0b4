"""What an alternative is, and what it is given."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.learning import Training, preset
from hyrl_mj.policies import Controller, Policy, as_controller
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import LoopSettings, Noise, closed_loop
from hyrl_mj.tasks import Outcome, Task


class Unfit(BadInput):
    """An alternative does not fit the task, or lacks a package: its row says so, and the others go on."""


@dataclass(frozen=True)
class Candidate:
    """One setting of an alternative.

    Attributes:
        label: what differs from the others of the same alternative, as "3 samples".
        acts: what closes the loop: a controller, or a policy alone.
        samples: of the environment, that its trainings took; 0 if it goes by the policies of the run.
    """

    label: str
    acts: Controller | Policy
    samples: int = 0


@dataclass(frozen=True)
class Given:
    """What an alternative may use: all that HyRL's run has made, and as many samples.

    Attributes:
        run: a finished run of HyRL on the task.
        seed: seed of all random numbers.
    """

    run: Run
    seed: int

    @property
    def task(self) -> Task:
        """The robot and its problem, with the noise of the run."""
        return self.run.task

    @property
    def eps(self) -> float:
        """The bound of the noise."""
        return self.run.settings.eps

    @property
    def first(self) -> int:
        """The number of samples that the trainings of stage 1 took."""
        own, attempts = self.run.settings.stage1, range(self.run.arrivals.trainings)
        return sum(own.attempt(k).samples for k in attempts) if isinstance(own, Training) else 0

    @property
    def samples(self) -> int:
        """The number of samples that the trainings of the whole run took, which each alternative may take."""
        trainings = sum(mode.attempts for mode in self.run.retraining.modes)
        return self.first + self.run.settings.stage6.samples * trainings

    def training(self, algorithm: str | None = None) -> Training:
        """Returns the settings of stage 1 with all the samples, by default with the run's algorithm.

        Where the task's reward led the policy of stage 1 to no goal, episodes are paid for as its own were.

        Raises:
            Unfit: the run has an agent in place of stage 1.
        """
        s = self.run.settings
        own = s.stage1
        if not isinstance(own, Training):
            raise Unfit(f"stage 1 of the run is the agent {own.source}, which nothing here trains")
        if algorithm not in (None, own.algorithm):
            own = preset(
                self.task, s.preset, eps=s.eps, seed=s.seed, horizon=None, algorithm=algorithm
            ).stage1
            assert isinstance(own, Training)
        if self.run.arrivals.shaped:
            own = own.attempt(1)
        return replace(own, samples=self.samples)

    def noise(self, kind: str) -> Noise:
        """Returns noise of a kind with the bound of the run."""
        return Noise(kind, self.eps, self.run.settings.everywhere)

    def won(self, acts: Controller | Policy, kinds: tuple[str, ...]) -> float:
        """Returns the least share of starts that are won under some kinds of noise.

        The starts and the noise are others than those of the examination, by which nothing is chosen.
        """
        loop = as_controller(acts)
        z0 = self.task.starts(TRIED, np.random.default_rng([self.seed, 1]))
        settings = LoopSettings(vary=True, quiet=True)
        runs = (
            closed_loop(self.task, loop, z0, self.noise(kind), seed=self.seed, settings=settings)
            for kind in kinds
        )
        return min(float((run.outcome == Outcome.REACHED).mean()) for run in runs)


# Starts from which a training is judged. The error of a share is then at most 3 percent.
TRIED = 256


@dataclass(frozen=True)
class Remembering:
    """A policy with a memory before that of stage 1; without its memory it answers as that does."""

    task: Task
    policy: Policy

    def act(self, measured: np.ndarray) -> np.ndarray:
        return self.policy.act(measured)


class Alternative(ABC):
    """What people would do instead.

    Attributes:
        name: as in `hyrl-mj compare --only NAME`.
        title: as in tables.
    """

    name: str
    title: str

    @abstractmethod
    def candidates(self, given: Given) -> Iterator[Candidate]:
        """Yields its settings, of which the best is taken.

        Raises:
            Unfit: it does not fit the task.
        """


AnyAlternative = TypeVar("AnyAlternative", bound=Alternative)
_KNOWN: dict[str, Alternative] = {}


def register(kind: type[AnyAlternative]) -> type[AnyAlternative]:
    """Registers an alternative by its name; a class decorator.

    Raises:
        BadInput: another class has that name.
    """
    other = type(_KNOWN.get(kind.name))
    if kind.name in _KNOWN and (other.__module__, other.__qualname__) != (
        kind.__module__,
        kind.__qualname__,
    ):
        raise BadInput(
            f"{kind.__name__} cannot be registered: the alternative {kind.name!r} is already "
            f"{other.__module__}.{other.__qualname__}, so choose another name"
        )
    _KNOWN[kind.name] = kind()
    return kind


def registered() -> dict[str, Alternative]:
    """Returns all alternatives by name, in the order of their making: first those of the run itself."""
    first = ("policy", "hyrl")
    return {name: _KNOWN[name] for name in (*first, *(n for n in sorted(_KNOWN) if n not in first))}
