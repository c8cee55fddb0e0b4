"""The arcs of a run: which starts are simulated under which noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.judging import Budget, attack
from hyrl_mj.judging.game import (
    CURVE_CELLS,
    LATTICE,
    Game,
    lattice_grid,
    worst_signal,
)
from hyrl_mj.policies import Controller, Policy
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import (
    OF_RUNS,
    AnyNoise,
    HybridArc,
    Noise,
    noise_kinds,
    noise_of,
    samples,
    simulate_batch,
)
from hyrl_mj.tasks import Task


def near_middle(task: Task, z: np.ndarray, most: int) -> np.ndarray:
    """Returns `most` chart points (n, d) that are nearest to the middle of the replay starts, in order."""
    off = task.chart.difference(z, np.mean(task.scene.starts, axis=0))
    return z[np.argsort(np.linalg.norm(off, axis=1), kind="stable")[:most]]


def critical_starts(run: Run) -> np.ndarray:
    """Returns the 16 points (n, d) of M* that are nearest to the replay starts, the nearest first."""
    return near_middle(run.task, run.critical_set.points, 16)


def noisy_arcs(
    run: Run,
    z0: np.ndarray,
    noise: str | AnyNoise,
    eps: float | None = None,
    q0s: Sequence[int | None] = (None,),
    horizon: float | None = None,
    seed: int = 0,
    game: Game | None = None,
) -> dict[str, list[HybridArc]]:
    """Simulates policy and hybrid controller from starts (n, d) under one kind of noise.

    Args:
        run: with its mode policies.
        z0: starts.
        noise: a registered kind; "worst": that of the worst-case game, for each controller; "attack": the
            strongest signal that a search of four rounds finds, for each; or a noise with its bound.
        eps: bound of the noise, by default the run's.
        q0s: start modes of the hybrid controller; with None it picks its start mode.
        horizon: time [s], by default the task's.
        seed: of the noise.
        game: that of `replay_game` with this bound, where the noise is "worst"; by default a new one.

    Returns:
        For each start an arc of "policy", of "hyrl_q0" and so on, and of "hyrl" for a mode of its own.

    Raises:
        BadInput: a value that cannot be used, or a worst case that cannot be played.
    """
    task = run.task  # first: the file of a user's task may register noise
    kinds = (*noise_kinds(), *OF_RUNS)
    sensor: AnyNoise | None = None
    if not isinstance(noise, str):
        sensor, noise = noise, str(noise)
    elif " " in noise.strip():
        sensor = noise_of(task, noise, 0.0)
    if sensor is None and noise not in kinds:
        raise unknown(
            "noise", noise, [*kinds, "a sum as 'uniform 0.05 + delay 1'", "'log LOG.csv'"]
        )
    if sensor is not None and eps is not None:
        raise BadInput(f"the noise {noise!r} tells its own bounds: leave eps out")
    bound = task.check_noise(run.settings.eps if eps is None else eps)
    steps = None if horizon is None else samples(task, horizon)
    if noise == "worst" and game is None:
        game = replay_game(run, bound)
    arcs = {}
    for name, loop in run.controllers.items():
        for q0 in q0s if name == "hyrl" else (None,):
            signal: AnyNoise
            if sensor is not None:
                signal = sensor
            elif noise == "attack":
                begun = loop if q0 is None else _Begun(loop, q0)
                found = attack(
                    task, {name: begun}, z0, bound, Budget(rounds=4), settings=run.settings.attack
                )
                signal = found[name].signal
            elif game is None:
                signal = Noise(noise, bound)
            else:
                signal = worst_signal(game, name, z0, bound, q0, steps)
            key = name if q0 is None else f"{name}_q{q0}"
            arcs[key] = simulate_batch(task, loop, z0, signal, q0, horizon, seed)
    return arcs


def replay_game(run: Run, bound: float) -> Game:
    """Returns the worst-case game whose noise replays show.

    Raises:
        BadInput: it cannot be played.
    """
    if why := run.why_no_game:
        raise BadInput(
            f"{why}: for the strongest noise that a search finds give the noise 'attack'"
        )
    d = run.task.chart.dimension
    cells = max(run.settings.lattice or LATTICE[d], CURVE_CELLS[d])
    return Game(run.task, run.split, run.controllers, bound, grid=lattice_grid(run.task, cells))


@dataclass(frozen=True)
class _Begun:
    """A controller with modes that begins in the mode `q0`, whatever it measures first."""

    controller: Controller
    q0: int

    @property
    def modes(self) -> tuple[int, ...]:
        return self.controller.modes

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        return np.full(len(measured), self.q0)

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.controller.step(q, measured)


def replay_arcs(
    run: Run, noise: str | AnyNoise | None = None, eps: float | None = None
) -> dict[tuple[str, str], HybridArc]:
    """Simulates the replays by start and controller: of the scene (paper, Section V), and one on M*.

    By default the noise is the paper's, and on M* the worst where a game decides. The start on M* is one
    from which the policy is lost then, if there is one near the middle of the scene's starts.
    """
    scene, modes, seed = run.task.scene, run.controller.modes, run.settings.seed
    arcs: dict[tuple[str, str], HybridArc] = {}
    strongest = "worst" if run.exact else "alternating"
    game = None
    if noise == "worst":  # one game for the starts of the scene and that on M*
        game = replay_game(run, run.task.check_noise(run.settings.eps if eps is None else eps))
    starts = np.array(scene.starts, dtype=float)
    for z0, usual in ((starts, "alternating"), (critical_starts(run), strongest)):
        if not len(z0):
            continue
        found = noisy_arcs(run, z0, noise or usual, eps, modes, scene.time, seed, game)
        if z0 is starts:
            names = {f"start{i}": i for i in range(len(starts))}
        else:
            arrives = [arc.arrives(run.task) for arc in found["policy"]]
            names = {"critical": int(np.argmin(arrives))}
        for who, several in found.items():
            arcs |= {(start, who): several[i] for start, i in names.items()}
    return arcs


def attack_replay(run: Run) -> dict[str, HybridArc]:
    """Returns the arcs that the replay of a run plays whose worst case is not decided by a game.

    These are the strongest signals of the attack; {} if the run was not attacked, or its game decides.
    """
    arcs = run.attack_arcs()
    return arcs if arcs and run.robustness.deciding is None else {}


def overview_arcs(task: Task, policy: Policy) -> list[HybridArc]:
    """Simulates a policy without noise, from starts along the longest side of the start region.

    Only the first two coordinates of the chart tell which side that is; the other of the two is at its lower
    end, all further ones are those of the scene's first start. Where the region is all of these two, they are
    drawn.
    """
    chart, low, high = task.chart, np.array(task.start_low), np.array(task.start_high)
    flat = slice(2)
    whole = np.allclose([low[flat], high[flat]], [chart.low[flat], chart.high[flat]])
    runs = 12  # of an even number none starts in the middle
    starts = np.tile(np.array(task.scene.starts[0], dtype=float), (runs, 1))
    if chart.dimension > 1 and whole:
        starts = np.tile(starts, (2, 1))
        drawn = task.starts(len(starts), np.random.default_rng(0))
        starts[:, flat] = drawn[:, flat]
    else:
        starts[:, flat], axis = low[flat], int(np.argmax((high - low)[flat]))
        shares = (np.arange(runs) + 0.5) / runs
        starts[:, axis] = low[axis] + shares * (high - low)[axis]
    return simulate_batch(task, policy, starts, horizon=task.scene.time)


def policy_start_arcs(task: Task, policy: Policy, eps: float, seed: int) -> list[HybridArc]:
    """Simulates a policy from the scene's starts, under the paper's noise (Section III) of bound `eps`."""
    starts, noise = task.scene.policy_starts, Noise("alternating", eps)
    return simulate_batch(task, policy, starts, noise, horizon=task.scene.time, seed=seed)
