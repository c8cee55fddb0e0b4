"""The examination: what noise can do to the policy and to the hybrid controller of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.game import LATTICE, OVER, UNWINNABLE, Maps, Robustness, compare
from hyrl_mj.policies import Controller
from hyrl_mj.proof import examine
from hyrl_mj.runs.directory import Run
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import Noise, usual_kinds
from hyrl_mj.stages import (
    Attack,
    Budget,
    NoisyEpisodes,
    Partition,
    Regions,
    attack,
    attack_starts,
    noisy_episodes,
    shown_arcs,
)
from hyrl_mj.system.progress import Say
from hyrl_mj.tasks import SPARING, Effort
from hyrl_mj.viz import robustness_sentence

# The most starts of an attack: each keeps signals of a whole episode.
MOST_STARTS = 100_000


@dataclass(frozen=True)
class ExamineOptions:
    """The options of an examination under noise.

    Attributes:
        eps: bound of the noise, in the units of the chart; by default the run's.
        episodes: noisy episodes for each kind of noise and each controller; by default none where the worst
            case can be computed and not only estimated, on charts of one or two dimensions.
        noise: kinds of noise in the episodes; by default none,uniform,alternating,adversarial, without the
            last in environments of others.
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
    episodes: int | None = None
    noise: tuple[str, ...] = ()
    all_coordinates: bool = False
    near_critical: bool = False
    seed: int = 0
    attack_starts: int | None = None
    attack_seconds: float | None = None
    attack_rounds: int | None = None

    def budget(self, run: Run) -> Budget | None:
        """Returns how long a run is attacked, or None if it is not.

        Raises:
            BadInput: an impossible time or number of rounds, or both.
        """
        if self.attack_starts is not None and not 1 <= self.attack_starts <= MOST_STARTS:
            raise BadInput(
                f"{self.attack_starts} starts cannot be attacked: give a number from 1 to {MOST_STARTS:,}"
            )
        if self.attack_seconds is None and self.attack_rounds is None:
            attacked = self.attack_starts is not None or not run.exact
            return Budget(rounds=effort_of(run).attack_rounds) if attacked else None
        return Budget(self.attack_seconds, self.attack_rounds)


USUAL = ExamineOptions()


def effort_of(run: Run) -> Effort:
    """Returns what may be spent on the examination of a run."""
    return SPARING if run.settings.preset == "smoke" else run.task.effort


def examination_plan(run: Run) -> str:
    """Returns how a run will be examined, and why not in another way, before anything is trained."""
    if run.why_no_game:
        return f"by noisy episodes and an attack, because {run.why_no_game}"
    grid = run.lattice_grid
    wanted = run.settings.lattice or LATTICE[run.task.chart.dimension]
    nodes = f"{' x '.join(map(str, grid.counts))} nodes"
    if max(grid.counts) < wanted:
        nodes += f" (fewer than {wanted:,} on a side, which would not fit into the memory)"
    if run.exact:
        return f"by the worst-case game on {nodes}"
    return f"by noisy episodes and an attack, and by the worst-case game on {nodes}: {run.why_estimate}"


def examine_stage(run: Run, say: Say, options: ExamineOptions = USUAL) -> None:
    """Examines policy and hybrid controller under noise; all files are written at the end."""
    budget = options.budget(run)  # a wrong one is refused before the work
    robustness, maps = examine_controllers(run, run.loops, run.split, options)
    if budget is not None:
        regions = Regions(run.critical_set.points, _winnable(run, maps), options.near_critical)
        attacks = attack_controllers(run, run.loops, regions, budget, options)
        counts = tuple(found.count for found in attacks.values())
        quiet = {name: found.quiet for name, found in attacks.items()}
        under = compare("attack", quiet, {name: found.ends for name, found in attacks.items()})
        comparisons = (*robustness.comparisons, under)
        robustness = replace(robustness, attacks=counts, comparisons=comparisons)
        for name, arc in shown_arcs(attacks).items():
            arc.save(run.attack_path(name))
    if maps is not None:
        draw_robustness(run, robustness, maps, run.path / "figures")
        maps.save(run.path / "robustness.npz")
    robustness.save(run.path / "robustness.json")
    if run.agent and run.agent.why_no_function:
        say(f"{run.agent.why_no_function}: noisy episodes stand in for the worst case")
    say(robustness_sentence(robustness))


def examine_controllers(
    run: Run,
    controllers: dict[str, Controller],
    partition: Partition,
    options: ExamineOptions = USUAL,
) -> tuple[Robustness, Maps | None]:
    """Examines controllers by name, and returns the result, and the maps if the game was played.

    `partition` decides which mode the first measurement should select.
    """
    task, points = run.task, run.critical_set.points
    eps = run.settings.noise if options.eps is None else options.eps
    everywhere = options.all_coordinates or run.settings.everywhere
    count, seed = options.episodes, options.seed
    task.check_noise(eps, everywhere)
    if count is None and not run.exact:
        count = effort_of(run).episodes
    if count is not None and count < 1:
        raise BadInput(f"{count} episodes cannot be simulated: give at least 1")
    kinds = options.noise or usual_kinds(task)
    noises = tuple(Noise(kind, eps, everywhere) for kind in kinds)
    game, maps = None, None
    if run.why_no_game is None:
        bounds = tuple(dict.fromkeys((0.0, eps / 2, eps)))
        game, maps = examine(
            task, points, partition, controllers, bounds, everywhere, run.settings.lattice
        )
    episodes = NoisyEpisodes((), ())
    if count is not None:
        regions = Regions(points, _winnable(run, maps), options.near_critical)
        episodes = noisy_episodes(task, regions, controllers, noises, count, seed)
    counted = Robustness(
        eps, everywhere, game, episodes.counts, seed, comparisons=episodes.comparisons
    )
    return counted, maps


def _winnable(run: Run, maps: Maps | None) -> tuple[Grid, np.ndarray] | None:
    """Returns the game's nodes with those (N,) bool that are winnable, None where that is not known."""
    if maps is None or not run.exact:
        return None
    classes = [*maps.map.values()][-1]  # of the hybrid controller
    return maps.grid(run.task.chart), ~np.isin(classes, (UNWINNABLE, OVER))


def attack_controllers(
    run: Run,
    controllers: dict[str, Controller],
    regions: Regions,
    budget: Budget,
    options: ExamineOptions,
) -> dict[str, Attack]:
    """Attacks controllers by name, from the same starts.

    Where every mode is the agent itself, the hybrid controller does under each signal what the agent does,
    and is tried under the signals that were found against the agent.
    """
    task, eps = run.task, run.settings.noise if options.eps is None else options.eps
    n = options.attack_starts or effort_of(run).attack_starts
    starts = attack_starts(task, regions, eps, n, options.seed)
    everywhere = options.all_coordinates or run.settings.everywhere
    if not run.keeps_agent:
        return attack(task, controllers, starts, eps, budget, everywhere, options.seed)
    alone = {"policy": controllers["policy"]}
    found = attack(task, alone, starts, eps, budget, everywhere, options.seed)["policy"]
    return {
        name: found if name in alone else found.on(name, task, controllers[name])
        for name in controllers
    }


def draw_robustness(run: Run, robustness: Robustness, maps: Maps, folder: Path) -> None:
    """Draws the maps and the curve of the game."""
    from hyrl_mj.viz import figures

    assert robustness.game is not None
    shown = figures.shown_game(run, robustness.game, maps)
    figures.draw_all(shown, folder)
