"""What is asked of controllers under noise: the worst-case game, noisy episodes, and an attack."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from hyrl_mj.errors import check_seed
from hyrl_mj.judging.attacks import Budget, attack, attack_starts, shown_arcs
from hyrl_mj.judging.episodes import Regions, noisy_episodes
from hyrl_mj.judging.game import Comparison, EpisodeCount, MapClass, Maps, Robustness, compare
from hyrl_mj.judging.worst_case import worst_case
from hyrl_mj.policies import Controller
from hyrl_mj.ranges import By, Checked, Integer, Number, Optional
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import AttackSettings, HybridArc, noise_of, usual_kinds
from hyrl_mj.tasks import Effort, Task


@dataclass(frozen=True)
class ExamineOptions(Checked):
    """The options of an examination under noise.

    Attributes:
        eps: bound of the noise, in the units of the chart; by default the run's.
        episodes: noisy episodes for each kind of noise and each controller; by default none where the worst
            case can be computed and not only estimated, on charts of one or two dimensions.
        noise: kinds of noise in the episodes, or sums of parts and logs, as for `hyrl-mj simulate`; by
            default none,uniform,alternating,adversarial, without the last in environments of others.
        all_coordinates: add noise to every coordinate of the measurement, not only to the noisy ones of the
            task; always, if the run was made so.
        near_critical: start all episodes and the attack within twice the bound of the critical set.
        seed: seed of starts and noise of the episodes and of the attack.
        attack_starts: number of starts of an attack; by default 400, or 100 in environments of others and
            with preset smoke.
        attack_seconds: time [s] of an attack, a search for noise that makes policy and hybrid controller
            fail; by default a few rounds where the worst case cannot be computed, else none.
        attack_rounds: number of rounds of the attack instead of a time, which repeats an earlier one of as
            many; by default the time decides.
    """

    eps: float | None = None
    episodes: Annotated[int | None, Optional(Integer(1, 10**9))] = None
    noise: tuple[str, ...] = ()
    all_coordinates: bool = False
    near_critical: bool = False
    seed: Annotated[int, By(check_seed)] = 0
    attack_starts: Annotated[int | None, Optional(Integer(1, 10_000))] = None
    attack_seconds: Annotated[float | None, Optional(Number(0, 86_400, above=True))] = None
    attack_rounds: Annotated[int | None, Optional(Integer(1, 100_000))] = None

    def budget(self, effort: Effort, exact: bool) -> Budget | None:
        """Returns how long controllers are attacked, or None if they are not.

        Raises:
            BadInput: both a time and a number of rounds.
        """
        if self.attack_seconds is None and self.attack_rounds is None:
            attacked = self.attack_starts is not None or not exact
            return Budget(rounds=effort.attack_rounds) if attacked else None
        return Budget(self.attack_seconds, self.attack_rounds)


USUAL = ExamineOptions()


@dataclass(frozen=True)
class Subject:
    """Controllers of a task that are examined together, from the same starts.

    Attributes:
        task: the robot and its problem.
        controllers: by name.
        points: (N, d) of M*.
        parts: of each mode the states in which the first measurement should select it.
        eps: the noise bound that they were made for.
        everywhere: whether noise acts on all coordinates.
        cells: lattice cells along the longest side of the chart, as in `lattice_grid`.
        playable: whether the worst-case game can be played against them.
        exact: whether it decides where it is played, and is more than an estimate.
        effort: what may be spent.
        attacks: what signals an attack tries.
        alike: whether all of them answer as the controller "policy" does.
        winnable: whether attacks begin at winnable starts alone, where the game tells which these are.
        curves: whether the game also tells margins, and what is won at all bounds.
    """

    task: Task
    controllers: Mapping[str, Controller]
    points: np.ndarray
    parts: Sequence[GridSet]
    eps: float
    everywhere: bool
    cells: int
    playable: bool
    exact: bool
    effort: Effort
    attacks: AttackSettings = AttackSettings()
    alike: bool = False
    winnable: bool = True
    curves: bool = True


@dataclass(frozen=True)
class Examination:
    """What noise can do to controllers.

    Attributes:
        robustness: the results.
        maps: of the worst-case game; None if it was not played.
        arcs: a run under attack of each controller that was attacked.
    """

    robustness: Robustness
    maps: Maps | None = None
    arcs: Mapping[str, HybridArc] = field(default_factory=dict)


def examine(
    subject: Subject, options: ExamineOptions = USUAL, attacked: bool = False
) -> Examination:
    """Examines controllers under noise, by the game where it can be played, by episodes, and by an attack.

    Args:
        subject: the controllers and their task.
        options: noise bound and kinds, numbers of episodes and attacked starts.
        attacked: whether there is an attack, if the options ask for one or the game does not decide.

    Raises:
        BadInput: a bound that cannot be used, or both a time and a number of rounds.
    """
    task, points = subject.task, subject.points
    eps = subject.eps if options.eps is None else options.eps
    everywhere = options.all_coordinates or subject.everywhere
    task.check_noise(eps, everywhere)
    # A kind that is named twice would count the same episodes twice.
    kinds = dict.fromkeys(options.noise or usual_kinds(task, eps, everywhere))
    noises = [noise_of(task, kind, eps, everywhere) for kind in kinds]
    game, maps = None, None
    if subject.playable:
        bounds = tuple(dict.fromkeys((0.0, eps / 2, eps)))
        game, maps = worst_case(
            task, points, subject.parts, subject.controllers, bounds, everywhere, subject.cells,
            subject.curves,
        )  # fmt: skip
    decides = subject.exact and game is not None and game.decides
    count = options.episodes
    if count is None and not decides:
        count = subject.effort.episodes
    winnable = _winnable(subject, maps) if decides else None
    regions = Regions(points, winnable, options.near_critical)
    counts: tuple[EpisodeCount, ...] = ()
    comparisons: tuple[Comparison, ...] = ()
    if count is not None:
        counts, comparisons = noisy_episodes(
            task, regions, subject.controllers, noises, count, options.seed
        )
    results = Robustness(
        eps, everywhere, game, counts, options.seed,
        comparisons=comparisons, near_critical=options.near_critical,
    )  # fmt: skip
    budget = options.budget(subject.effort, decides) if attacked else None
    if budget is None:
        return Examination(results, maps)
    starts = options.attack_starts or subject.effort.attack_starts
    z0 = attack_starts(task, regions, eps, starts, options.seed)
    # Controllers that answer as the policy does are tried under the signals that were found against it.
    tried = {n: c for n, c in subject.controllers.items() if n == "policy" or not subject.alike}
    found = attack(task, tried, z0, eps, budget, everywhere, options.seed, subject.attacks)
    attacks = {
        name: found[name] if name in found else found["policy"].on(name, task, controller)
        for name, controller in subject.controllers.items()
    }
    quiet = {name: found.quiet for name, found in attacks.items()}
    under = compare("attack", quiet, {name: found.ends for name, found in attacks.items()})
    results = replace(
        results,
        attacks=tuple(found.count for found in attacks.values()),
        comparisons=(*results.comparisons, under),
    )
    return Examination(results, maps, shown_arcs(attacks))


def _winnable(subject: Subject, maps: Maps | None) -> tuple[Grid, np.ndarray] | None:
    """Returns the game's nodes with those (N,) bool that are winnable, None where that is not known."""
    if maps is None or not subject.winnable:
        return None
    classes = [*maps.map.values()][-1]  # of the hybrid controller
    return maps.grid(subject.task.chart), ~np.isin(classes, (MapClass.UNWINNABLE, MapClass.OVER))
