"""What noise can do to the policy and to the hybrid controller of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import BadInput
from hyrl_mj.game import BEATEN, WON, WON_FROM_SOME, examine, save
from hyrl_mj.policies import Controller
from hyrl_mj.progress import Say
from hyrl_mj.run_directory import Run
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import Noise
from hyrl_mj.stages import Partition, Regions, noisy_episodes
from hyrl_mj.viz import robustness_sentence

# The kinds of noise in episodes, unless others are asked for.
KINDS = ("uniform", "alternating", "adversarial")
# Noisy episodes of a run whose worst case cannot be played exactly, and of one that only shows that all runs.
EPISODES, EPISODES_SMOKE = 1_000, 200


def examine_run(
    run: Run,
    eps: float | None = None,
    kinds: Sequence[str] = (),
    count: int | None = None,
    everywhere: bool = False,
    seed: int = 0,
    near: bool = False,
    say: Say = print,
) -> dict[str, Any]:
    """Examine policy and hybrid controller under noise, and write `robustness.json` with its pictures.

    Where the exact game can be played it is; noisy episodes are added on demand, and where they are all
    that there is. Files are written when all is known.

    Args:
        run: with its mode policies.
        eps: noise bound, by default the run's. The scores are for none, half of it, and it.
        kinds: of the noise in episodes, by default `KINDS`.
        count: number of episodes for each kind and controller.
        everywhere: whether noise acts on all columns of the measurement.
        seed: of starts and noise of the episodes.
        near: whether the episodes all start near M*.
        say: told the result in a line.

    Returns:
        What is in `robustness.json`.

    Raises:
        BadInput: a value that cannot be used.
    """
    content, maps = examine_loops(
        run, run.loops, run.split, eps, kinds, count, everywhere, seed, near
    )
    folder = run.path / "figures"
    if maps is not None:
        draw_robustness(run, content, maps, folder)
        artifacts.write_arrays(run.path / "robustness.npz", maps, kind="robustness maps")
    save(run.path / "robustness.json", content)
    if run.agent and run.agent.stochastic:
        say("the policy draws its inputs: noisy episodes stand in for the worst case")
    say(robustness_sentence(content))
    return content


def examine_loops(
    run: Run,
    loops: dict[str, Controller],
    partition: Partition,
    eps: float | None = None,
    kinds: Sequence[str] = (),
    count: int | None = None,
    everywhere: bool = False,
    seed: int = 0,
    near: bool = False,
) -> tuple[dict[str, Any], dict[str, np.ndarray] | None]:
    """What `examine_run` finds out of some controllers, and the maps if the game was played.

    By `partition` what the first measurement calls for is judged.
    """
    task, critical = run.task, run.critical_set
    eps = run.settings.noise if eps is None else eps
    task.check_noise(eps, everywhere)
    if count is None and not run.exact:
        count = EPISODES_SMOKE if run.settings.preset == "smoke" else EPISODES
    if count is not None and count < 1:
        raise BadInput(f"{count} episodes cannot be simulated: give at least 1")
    noises = tuple(Noise(kind, eps, everywhere) for kind in kinds or KINDS)
    content: dict[str, Any] = {"eps": eps, "everywhere": everywhere, "game": None}
    content |= {"episodes": [], "seed": seed}
    winnable, maps = None, None
    if run.exact:
        bounds = tuple(dict.fromkeys((0.0, eps / 2, eps)))
        content["game"], maps = examine(
            task, critical.points, partition, loops, bounds, everywhere, run.settings.lattice
        )
        grid = Grid.from_counts(task.chart, maps["grid_counts"])
        last = maps[f"map_{[*loops][-1]}"]
        winnable = grid, np.isin(last, (WON, WON_FROM_SOME, BEATEN))
    if count is not None:
        regions = Regions(critical, winnable, near)
        content["episodes"] = noisy_episodes(task, regions, loops, noises, count, seed)
    return content, maps


def draw_robustness(
    run: Run, content: dict[str, Any], maps: dict[str, np.ndarray], folder: Path
) -> None:
    """Draw the map and the curve of the game."""
    from hyrl_mj.viz import figures

    shown = figures.ShownGame(run.task, run.critical_set, content["game"], maps)
    figures.draw_all(shown, folder)
