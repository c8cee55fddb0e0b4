#!/usr/bin/env python
"""Quality of finished runs: scripts/quality.py RUN [RUN ...]

Unit circle: mean return of the stage-1 policy from pi +- 0.2 rad (the optimum is -29.05).
Vehicle: share of the winnable starts from which the stage-1 policy passes without noise, on a 50 x 50 grid of
the start box; a start is winnable if steering hard to one side at once passes.
Both: the critical set, the edges of the extended sets, and the paper's replays.
"""

import sys

import numpy as np

import hyrl_mj
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import closed_loop
from hyrl_mj.viz import replay_sentence


def circle_return(task: hyrl_mj.Task, policy: hyrl_mj.MlpPolicy, starts: int = 10_000) -> float:
    """Returns the mean return over 150 samples from starts drawn evenly from pi +- 0.2 rad."""
    env = BatchedEnv(task, starts)
    env.reset(z=np.pi + np.random.default_rng(0).uniform(-0.2, 0.2, (starts, 1)))
    rewards = [env.step(policy.act(env.plant.measurement)).reward for _ in range(task.max_steps)]
    return float(np.sum(rewards) / starts)


class Hard:
    """Steers to one side at the limit, whatever it measures."""

    def __init__(self, u: float):
        self._u = u

    def act(self, measured: np.ndarray) -> np.ndarray:
        return np.full((len(measured), 1), self._u)


def vehicle_share(task: hyrl_mj.Task, policy: hyrl_mj.MlpPolicy) -> float:
    """Returns the share of the winnable starts in [0, 0.5] x [-1, 1] m that the policy passes from."""
    x, y = np.meshgrid(np.linspace(0, 0.5, 50), np.linspace(-1, 1, 50), indexing="ij")
    z0 = np.stack([x.ravel(), y.ravel()], axis=1)

    def outcome(policy: hyrl_mj.Policy) -> np.ndarray:
        return closed_loop(task, PolicyController(policy), z0).outcome

    # Steering hard drives into the wall in the end; it has passed if that comes before a crash.
    winnable = np.any([outcome(Hard(u)) != hyrl_mj.Outcome.CRASHED for u in (-1.0, 1.0)], axis=0)
    won = outcome(policy) == hyrl_mj.Outcome.REACHED
    return float((won & winnable).sum() / winnable.sum())


def describe(run: hyrl_mj.Run) -> str:
    """Returns the figures of one run in one paragraph."""
    arcs = run.arcs()
    paper = [a for (start, who), a in arcs.items() if start != "critical" and who != "policy"]
    lines = [f"{run.path}: {run.task.name}, seed {run.settings.seed}"]
    points = run.critical_set.points
    if run.task.name == "unit_circle":
        lines.append(f"  mean return {circle_return(run.task, run.policy):.2f}")
        lines.append(f"  critical angles {np.round(points[:, 0] / np.pi, 4)} pi")
        nodes = np.linspace(0, 2 * np.pi, 200_001)[:, None]
        for q in run.controller.modes:
            far = nodes[run.controller.flow_set(q).contains(nodes), 0]
            # Around the set-point all sets overlap; the edge beyond M* is printed.
            edge = far[far < 1.5 * np.pi].max() if q == 0 else far[far > 0.5 * np.pi].min()
            lines.append(f"  mode {q} reaches to {edge / np.pi:.4f} pi")
        ends = [abs(run.task.chart.difference(a.z[-1], np.zeros(1)))[0] for a in paper]
        lines.append(f"  at most {max(ends):.3f} rad off after 4 s")
    else:
        share = vehicle_share(run.task, run.policy)
        lines.append(f"  passes from {100 * share:.2f}% of the winnable starts")
        near = points[points[:, 0] <= 0.4]
        lines.append(
            f"  M* for x in [0, 0.4]: {len(near)} points, |y| <= {abs(near[:, 1]).max():.4f} m"
        )
        off = max(abs(a.z[-1, 1]) for a in paper)
        lines.append(f"  |y| <= {off:.3f} m at the end")
    lines.append(f"  {replay_sentence(run, arcs)}")
    for (start, who), arc in arcs.items():
        if start == "critical":
            lines.append(f"  from M*: {who} {arc.outcome} after {arc.t[-1]:.2f} s")
    return "\n".join(lines)


if __name__ == "__main__":
    for path in sys.argv[1:]:
        print(describe(hyrl_mj.load_run(path)))
