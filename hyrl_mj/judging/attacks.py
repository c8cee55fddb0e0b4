"""An attack on closed loops: a search for noise signals that make them fail, where no game decides.

Every controller is tried with the same rules in the same order, and then with what is drawn and evolved from
the most dangerous signals. What is reported as lost has been lost again under the recorded signal, which
knows nothing of the loop any more.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.attack_search import Search
from hyrl_mj.judging.episodes import Regions, ends_of
from hyrl_mj.judging.game import AttackCount, Ends, wilson
from hyrl_mj.policies import Controller
from hyrl_mj.simulation import (
    AttackSettings,
    HybridArc,
    Noise,
    Programmes,
    Recorded,
    closed_loop,
    simulate_batch,
)
from hyrl_mj.tasks import Outcome, Task


@dataclass(frozen=True)
class Budget:
    """How long an attack lasts: a time, or a number of rounds.

    The rounds are the same in both cases: the time only decides how many of them are done. At least one is.

    Attributes:
        seconds: time [s]; a round that would take longer than what is left of it does not begin.
        rounds: number of rounds.
        enough: no round follows one after which each controller has lost so many starts; by default all.
    """

    seconds: float | None = None
    rounds: int | None = None
    enough: int | None = None

    def __post_init__(self) -> None:
        if (self.seconds is None) == (self.rounds is None):
            raise BadInput("an attack has a time or a number of rounds: give one of the two")


@dataclass(frozen=True)
class Attack:
    """The strongest signals that were found against one controller.

    Attributes:
        count: from how many starts it loses.
        signal: the strongest signal that is known for each start.
        arcs: the run from each start under its signal.
        quiet, ends: how the runs end without noise, and under the signals.
        strongest: index of the start of the strongest signal: of the earliest failure, or where nothing is
            lost of the run with the greatest danger.
    """

    count: AttackCount
    signal: Recorded
    arcs: tuple[HybridArc, ...]
    quiet: Ends
    ends: Ends
    strongest: int

    @staticmethod
    def from_arcs(
        arcs: Sequence[HybridArc],
        signal: Recorded,
        quiet: Ends,
        dangerous: int,
        **search: Any,
    ) -> Attack:
        """Returns the attack of recorded signals, with the arcs under them.

        Args:
            arcs: of the controller, from each start.
            signal: the signals.
            quiet: how the runs end without noise.
            dangerous: index of the start of the greatest danger.
            search: those fields of the count that the arcs do not tell.
        """
        ends = Ends(
            lost=np.array([arc.outcome != Outcome.REACHED.label for arc in arcs]),
            time=np.array([arc.t[-1] for arc in arcs]),
            way=np.array([np.linalg.norm(np.diff(arc.z, axis=0), axis=1).sum() for arc in arcs]),
        )
        lost = ends.lost & ~quiet.lost
        first = int(np.argmin(np.where(lost, ends.time, np.inf)))
        strongest, losses = first if lost.any() else dangerous, int(lost.sum())
        count = AttackCount(
            **search,
            eps=signal.bound,
            starts=len(arcs),
            unaided=int(quiet.lost.sum()),
            lost=losses,
            interval=wilson(losses, int(np.sum(~quiet.lost))),
            start=tuple(map(float, arcs[strongest].z[0])),
            outcome=arcs[strongest].outcome,
            places=tuple(
                float(x) for arc, beaten in zip(arcs, lost, strict=True) if beaten for x in arc.z[0]
            ),
        )
        return Attack(count, signal, tuple(arcs), quiet, ends, strongest)

    def on(self, name: str, task: Task, controller: Controller) -> Attack:
        """Returns the attack of the same signals on another controller, of a name."""
        starts = np.array([arc.z[0] for arc in self.arcs])
        arcs = simulate_batch(task, controller, starts, self.signal)
        quiet = ends_of(task, closed_loop(task, controller, starts))
        count = self.count
        return Attack.from_arcs(
            arcs, self.signal, quiet, self.strongest, controller=name, everywhere=count.everywhere,
            rounds=count.rounds, seconds=count.seconds, samples=count.samples, tried=count.tried,
        )  # fmt: skip


def attack_starts(task: Task, regions: Regions, bound: float, n: int, seed: int) -> np.ndarray:
    """Returns n starts (n, d): half of them within twice the bound of M*, or all if the regions say so.

    The others are drawn as the task draws them; so are all where M* is empty or far from the starts. Where
    it is known which starts are winnable, only these are taken: fewer than n if they are rare. If none is
    found, all starts are taken.

    Raises:
        BadInput: all are to lie near M*, and no start does, or none that may be won.
    """
    rng = np.random.default_rng([seed, 2])

    def drawn(where: Regions, count: int) -> np.ndarray:
        kept = np.empty((0, task.chart.dimension))
        for _ in range(100 if count else 0):  # fewer are kept where winnable ones are rare
            z = where.draw(task, bound, count, rng)
            kept = np.vstack([kept, z[regions.may_win(z)]])
            if len(kept) >= count:
                break
        return kept[:count]

    if regions.near:
        starts = drawn(regions, n)
        if not len(starts):
            raise BadInput(
                f"no start of {task.name} near its critical set is known to be winnable: leave "
                "--near-critical out"
            )
        return starts
    near = np.empty((0, task.chart.dimension))
    with suppress(BadInput):  # where no start lies near M*
        near = drawn(replace(regions, near=True), n // 2)
    starts = np.vstack([near, drawn(replace(regions, near=False), n - len(near))])
    return starts if len(starts) else task.starts(n, rng)


def shown_arcs(attacks: Mapping[str, Attack]) -> dict[str, HybridArc]:
    """Returns the arc of each controller from one start under its own strongest signal from there.

    The start is that of the strongest signal against the last controller that loses any, or if none does
    against the last one.
    """
    losing = [found for found in attacks.values() if found.count.lost] or [*attacks.values()]
    return {name: found.arcs[losing[-1].strongest] for name, found in attacks.items()}


def attack(
    task: Task,
    controllers: Mapping[str, Controller],
    starts: np.ndarray,
    bound: float,
    budget: Budget,
    everywhere: bool = False,
    seed: int = 0,
    settings: AttackSettings = AttackSettings(),
) -> dict[str, Attack]:
    """Searches for noise signals that make closed loops fail.

    All controllers are tried with the same rules in the same order, from the same starts, as often as the
    budget says; those with several modes are tried with rules about their modes on top. A start that a
    controller loses without noise is left alone, and so is one that it has lost. The rules that are held
    throughout come first; programmes of segments, and levels and switching times, which are drawn and
    evolved from the most dangerous of them (the cross-entropy method, CMA-ES), come after them. The
    coordinates outside the chart begin at their usual values.

    Args:
        task: the robot and its problem.
        controllers: by name.
        starts: (n, d) chart points, the same for all controllers.
        bound: largest magnitude eps >= 0 of the noise, in the unit of the measurement.
        budget: how long to search.
        everywhere: whether the noise acts on all columns of the measurement, not only on the noisy ones.
        seed: seed of the search.
        settings: what signals are tried.

    Returns:
        The attack on each controller, by name. The same rounds give the same on any number of threads.

    Raises:
        BadInput: starts outside the chart, or a bound that cannot be used.
    """
    starts = task.chart.check(starts, task.name)
    shares = Noise("none", bound, everywhere).against(task, None).shares
    began = time.monotonic()
    searches = {
        name: Search(task, loop, starts, bound, shares, seed, settings)
        for name, loop in controllers.items()
    }
    length = max(search.length for search in searches.values())
    for search in searches.values():
        search.prepare(length)
    rounds, enough = 0, min(budget.enough or len(starts), len(starts))
    while any(np.sum(~search.open) < enough for search in searches.values()) or not rounds:
        rounds, before = rounds + 1, time.monotonic() - began
        for search in searches.values():
            search.round(rounds)
        after = time.monotonic() - began
        # The next round will take about as long as this one.
        late = budget.seconds is not None and after + (after - before) > budget.seconds
        if late or rounds == budget.rounds:
            break
    found = {}
    for name, search in searches.items():
        # Replays may be longer than an episode, in which alone the attack acts.
        signal = Recorded(search.signals, bound, Programmes.kind, "none", shares)
        arcs = simulate_batch(task, controllers[name], starts, signal)
        dangerous = int(np.argmax(search.danger))
        found[name] = Attack.from_arcs(
            arcs, signal, search.quiet, dangerous, controller=name, everywhere=everywhere,
            rounds=rounds, seconds=budget.seconds, samples=search.samples, tried=dict(search.tried),
        )  # fmt: skip
    return found
