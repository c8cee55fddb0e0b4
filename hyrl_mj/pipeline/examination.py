"""What noise can do to the policy and to the hybrid controller of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.game import BEATEN, WON, WON_FROM_SOME, EpisodeCount, Maps, Robustness, examine
from hyrl_mj.pipeline.options import ExamineOptions
from hyrl_mj.policies import Controller
from hyrl_mj.progress import Say
from hyrl_mj.run_directory import Run
from hyrl_mj.simulation import Noise
from hyrl_mj.stages import Partition, Regions, noisy_episodes
from hyrl_mj.viz import robustness_sentence

# The kinds of noise in episodes by default.
KINDS = ("uniform", "alternating", "adversarial")
# Noisy episodes of a run whose worst case cannot be played exactly, and of one that only shows that all runs.
EPISODES, EPISODES_SMOKE = 1_000, 200
# The examination that belongs to a run.
RUN = ExamineOptions()


def examine_run(run: Run, options: ExamineOptions = RUN, say: Say = print) -> Robustness:
    """Examines policy and hybrid controller under noise, and writes `robustness.json` with its pictures.

    The exact game is played where that is possible; noisy episodes are added on request, and where they are
    the only way. Files are written at the end.

    Args:
        run: a run with its mode policies.
        options: what to examine. The scores are for no noise, half the bound, and the bound.
        say: told the result in a line.

    Raises:
        BadInput: a value that cannot be used.
    """
    robustness, maps = examine_loops(run, run.loops, run.split, options)
    folder = run.path / "figures"
    if maps is not None:
        draw_robustness(run, robustness, maps, folder)
        maps.save(run.path / "robustness.npz")
    robustness.save(run.path / "robustness.json")
    if run.agent and run.agent.stochastic:
        say("the policy draws its inputs: noisy episodes stand in for the worst case")
    say(robustness_sentence(robustness))
    return robustness


def examine_loops(
    run: Run,
    loops: dict[str, Controller],
    partition: Partition,
    options: ExamineOptions = RUN,
) -> tuple[Robustness, Maps | None]:
    """Examines controllers under noise, as `examine_run` does.

    Args:
        run: a run with its critical set.
        loops: the controllers by name.
        partition: decides which mode the first measurement should select.
        options: what to examine.

    Returns:
        The result, and the maps if the game was played.
    """
    task, points = run.task, run.critical_set.points
    eps = run.settings.noise if options.eps is None else options.eps
    everywhere, count, seed = options.all_coordinates, options.episodes, options.seed
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
        winnable = maps.grid(task.chart), np.isin(last, (WON, WON_FROM_SOME, BEATEN))
    counts: tuple[EpisodeCount, ...] = ()
    if count is not None:
        regions = Regions(points, winnable, options.near_critical)
        counts = noisy_episodes(task, regions, loops, noises, count, seed)
    return Robustness(eps, everywhere, game, counts, seed), maps


def draw_robustness(run: Run, robustness: Robustness, maps: Maps, folder: Path) -> None:
    """Draws the map and the curve of the game."""
    from hyrl_mj.viz import figures

    assert robustness.game is not None
    shown = figures.ShownGame(run.task, run.critical_set, robustness.game, maps)
    figures.draw_all(shown, folder)
