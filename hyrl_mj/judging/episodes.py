"""Noisy episodes in bulk: how often controllers reach the set-point, for charts and plants of any kind."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from itertools import product

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game import NO_NOISE, Comparison, Ends, EpisodeCount, compare, wilson
from hyrl_mj.physics.plant import Plant
from hyrl_mj.policies import Controller
from hyrl_mj.sets import Grid, check_points, distance_to
from hyrl_mj.simulation import LoopSettings, NamedNoise, Rollout, closed_loop, judge
from hyrl_mj.system import cores
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Outcome, Task

# Episodes, also of attacks, that are simulated at once, which limits the memory.
BATCH = 4_096
# Episodes that plain MuJoCo plays once more, spread over all kinds of noise and controllers; lost ones first.
JUDGED = 500


@dataclass(frozen=True)
class Regions:
    """The start regions of a task for which noisy episodes are counted separately.

    Attributes:
        points: (N, d) of M*; starts within twice the noise bound of M* are one region.
        winnable: a grid and (N,) bool, which of its nodes are winnable. A start is winnable if all nodes
            around it are; the other starts are one region.
        near: whether all episodes start within twice the noise bound of M*.
    """

    points: np.ndarray
    winnable: tuple[Grid, np.ndarray] | None = None
    near: bool = False

    def draw(self, task: Task, bound: float, n: int, rng: np.random.Generator) -> np.ndarray:
        """Returns n starts (n, d) from the task's distribution, for noise up to a bound.

        Raises:
            BadInput: the starts have to lie near M*, but M* is empty or no start of the task is near it.
        """
        if not self.near:
            return task.starts(n, rng)
        if not len(self.points):
            raise BadInput(
                "the critical set is empty, so no episode starts near it: leave --near-critical out"
            )
        kept, drawn = np.empty((0, task.chart.dimension)), 0
        while len(kept) < n:
            z = task.starts(n, rng)
            kept = np.vstack([kept, z[self._close(task, bound, z)]])
            drawn += n
            if not len(kept) and drawn >= 100_000:
                raise BadInput(
                    f"of {drawn:,} starts of {task.name} none lies within {2 * bound:g} of its critical "
                    "set: leave --near-critical out, or start elsewhere"
                )
        return kept[:n]

    def split(self, task: Task, bound: float, z0: np.ndarray) -> dict[str, np.ndarray]:
        """Returns which of the starts (n, d) lie in each region, (n,) bool by its name."""
        near = self._close(task, bound, z0)
        if self.winnable is None:
            return {"near M*": near, "elsewhere": ~near}
        won = self.may_win(z0)
        return {"near M*": near & won, "elsewhere": ~near & won, "not winnable": ~won}

    def may_win(self, z: np.ndarray) -> np.ndarray:
        """Returns whether starts (n, d) are winnable, or may be for all that is known: (n,) bool."""
        if self.winnable is None:
            return np.ones(len(z), dtype=bool)
        grid, winnable = self.winnable
        return np.asarray(grid.interpolate(winnable.astype(float), z) > 1 - 1e-9)

    def _close(self, task: Task, bound: float, z: np.ndarray) -> np.ndarray:
        """Returns whether starts (n, d) lie within twice the noise bound of M*: (n,) bool."""
        return np.asarray(distance_to(task.chart, self.points, z) <= 2 * bound)


def noisy_episodes(
    task: Task,
    regions: Regions,
    controllers: Mapping[str, Controller],
    noises: Sequence[NamedNoise],
    count: int,
    seed: int = 0,
) -> tuple[tuple[EpisodeCount, ...], tuple[Comparison, ...]]:
    """Simulates noisy episodes, and counts their outcomes by noise, controller and start region.

    All controllers get the same starts, and the same noise signals unless these depend on the loop.

    Args:
        task: the robot and its problem.
        regions: the start regions.
        controllers: by name.
        noises: kinds and bounds.
        count: episodes for each noise and controller.
        seed: seed of starts and noise.

    Returns:
        The counts by noise, controller and start region, and a comparison of the controllers under each
        noise, from the same starts; none where no episodes are without noise.

    Raises:
        BadInput: a noise bound that hides the state space, no starts near M*, or episodes that plain MuJoCo
            plays otherwise.
    """
    check_points(task.chart, regions.points, task.name)
    for noise in noises:
        task.check_noise(noise.bound, noise.everywhere)
    near = max(noise.bound for noise in noises)  # all begin alike
    pairs, firsts = list(product(noises, controllers)), range(0, count, BATCH)
    sizes = {first: min(BATCH, count - first) for first in firsts}
    judged = math.ceil(JUDGED / len(pairs))
    batches = [
        (controllers[name], noise, first, n, 0 if first else judged)
        for (noise, name), (first, n) in product(pairs, sizes.items())
    ]
    # The plants are used again: new ones for each batch would fragment the memory.
    plants = {} if cores.has_pool() else {n: task.plant(n) for n in {*sizes.values()}}
    counts: list[EpisodeCount] = []
    ends: dict[tuple[str, float], dict[str, Ends]] = {}
    with progress_bar(None, "noisy episodes", "episodes", count * len(pairs)) as progress:
        ended = cores.in_processes(partial(_play, plants, task, regions, near, seed), batches)
        for noise, name in pairs:
            played = []
            for n, batch in zip(sizes.values(), ended):  # noqa: B905 - the next pair goes on
                played.append(batch)
                progress.update(n)
            of_ends, outcome, inside = zip(*played, strict=True)
            counts += _count(noise, name, np.concatenate(outcome), inside)
            whole = map(np.concatenate, zip(*map(astuple, of_ends), strict=True))
            ends.setdefault((noise.kind, noise.bound), {})[name] = Ends(*whole)
    quiet = next((own for (kind, _), own in ends.items() if kind == NO_NOISE), None)
    noisy = [(kind, own) for (kind, _), own in ends.items() if kind != NO_NOISE]
    comparisons = [compare(kind, quiet, own) for kind, own in noisy] if quiet else []
    return tuple(counts), tuple(comparisons)


def ends_of(task: Task, run: Rollout) -> Ends:
    """Returns how runs end."""
    way = np.linalg.norm(np.diff(run.path, axis=0), axis=2).sum(axis=0)
    return Ends(run.outcome != Outcome.REACHED, run.length * task.dt, way)


def _play(
    plants: Mapping[int, Plant],
    task: Task,
    regions: Regions,
    near: float,
    seed: int,
    batch: tuple[Controller, NamedNoise, int, int, int],
) -> tuple[Ends, np.ndarray, dict[str, np.ndarray]]:
    """Plays episodes at once: the next n after the `first` of one controller and noise.

    What lies near M* is told by the bound `near`; `judged` of them are played once more by plain MuJoCo.

    Returns:
        How they end, the outcome (n,) of each, and which lie in each region, (n,) bool by its name.
    """
    controller, noise, first, n, judged = batch
    seeds = np.random.SeedSequence([seed, first]).generate_state(2)
    z0 = regions.draw(task, near, n, np.random.default_rng(seeds[0]))
    plant = plants.get(n) or task.plant(n)
    settings = LoopSettings(vary=True, plant=plant, quiet=True, record=judged > 0, states=False)
    runs = closed_loop(task, controller, z0, noise, seed=int(seeds[1]), settings=settings)
    if judged:
        lost_first = np.argsort(runs.outcome == Outcome.REACHED, kind="stable")
        if isinstance(plant, Plant):
            start = task.state(z0, settings.rng_of_starts(int(seeds[1])))
            judge(task, runs, start, lost_first[:judged])
        else:  # every loss of an environment is played again
            rows = lost_first[: max(judged, int((runs.outcome != Outcome.REACHED).sum()))]
            task.verify(z0, runs, rows)
    return ends_of(task, runs), runs.outcome, regions.split(task, near, z0)


def _count(
    noise: NamedNoise, name: str, outcome: np.ndarray, regions: Sequence[dict[str, np.ndarray]]
) -> Iterator[EpisodeCount]:
    """Yields how the episodes of each region ended, from outcomes (n,) and the regions of each batch."""
    for region in regions[0]:
        inside = np.concatenate([batch[region] for batch in regions])
        numbers = np.bincount(outcome[inside], minlength=len(Outcome))
        reached, total = int(numbers[Outcome.REACHED]), int(numbers.sum())
        if total:
            yield EpisodeCount(
                noise=noise.kind,
                eps=noise.bound,
                everywhere=noise.everywhere,
                controller=name,
                region=region,
                episodes=total,
                outcomes={Outcome(i).label: int(n) for i, n in enumerate(numbers) if n},
                reached=reached / total,
                interval=wilson(reached, total),
            )
