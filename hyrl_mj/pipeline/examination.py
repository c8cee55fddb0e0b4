"""The examination: what noise can do to the policy and to the hybrid controller of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.game import OVER, UNWINNABLE, EpisodeCount, Maps, Robustness
from hyrl_mj.policies import Controller
from hyrl_mj.progress import Say
from hyrl_mj.proof import examine
from hyrl_mj.run_directory import Run
from hyrl_mj.simulation import Noise
from hyrl_mj.stages import Partition, Regions, noisy_episodes
from hyrl_mj.viz import robustness_sentence

# The kinds of noise in episodes by default.
KINDS = ("none", "uniform", "alternating", "adversarial")
# Noisy episodes of a run whose worst case cannot be computed; fewer with preset smoke.
EPISODES, EPISODES_SMOKE = 1_000, 200


@dataclass(frozen=True)
class ExamineOptions:
    """The options of an examination under noise.

    Attributes:
        eps: bound of the noise, in the units of the chart; by default the run's.
        episodes: noisy episodes for each kind of noise and each controller; by default none where the worst
            case can be computed exactly, on charts of one or two dimensions.
        noise: kinds of noise in the episodes; by default none,uniform,alternating,adversarial.
        all_coordinates: add noise to every coordinate of the measurement, not only to the noisy ones of the
            task; always, if the run was made so.
        near_critical: start all episodes within twice the bound of the critical set.
        seed: seed of starts and noise of the episodes.
    """

    eps: float | None = None
    episodes: int | None = None
    noise: tuple[str, ...] = ()
    all_coordinates: bool = False
    near_critical: bool = False
    seed: int = 0


USUAL = ExamineOptions()


def examine_stage(run: Run, say: Say, options: ExamineOptions = USUAL) -> None:
    """Examines policy and hybrid controller under noise; all files are written at the end."""
    robustness, maps = examine_loops(run, run.loops, run.split, options)
    if maps is not None:
        draw_robustness(run, robustness, maps, run.path / "figures")
        maps.save(run.path / "robustness.npz")
    robustness.save(run.path / "robustness.json")
    if run.agent and run.agent.why_no_function:
        say(f"{run.agent.why_no_function}: noisy episodes stand in for the worst case")
    say(robustness_sentence(robustness))


def examine_loops(
    run: Run,
    loops: dict[str, Controller],
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
        count = EPISODES_SMOKE if run.settings.preset == "smoke" else EPISODES
    if count is not None and count < 1:
        raise BadInput(f"{count} episodes cannot be simulated: give at least 1")
    noises = tuple(Noise(kind, eps, everywhere) for kind in options.noise or KINDS)
    game, maps, winnable = None, None, None
    if run.exact:
        bounds = tuple(dict.fromkeys((0.0, eps / 2, eps)))
        game, maps = examine(
            task, points, partition, loops, bounds, everywhere, run.settings.lattice
        )
        last = maps.map[[*loops][-1]]
        winnable = maps.grid(task.chart), ~np.isin(last, (UNWINNABLE, OVER))
    counts: tuple[EpisodeCount, ...] = ()
    if count is not None:
        regions = Regions(points, winnable, options.near_critical)
        counts = noisy_episodes(task, regions, loops, noises, count, seed)
    return Robustness(eps, everywhere, game, counts, seed), maps


def draw_robustness(run: Run, robustness: Robustness, maps: Maps, folder: Path) -> None:
    """Draws the maps and the curve of the game."""
    from hyrl_mj.viz import figures

    assert robustness.game is not None
    shown = figures.ShownGame(run.task, run.critical_set, robustness.game, maps)
    figures.draw_all(shown, folder)
