"""An agent as others have it: SB3's own DQN on the vehicle, trained and saved without any of our additions.

    python scripts/plain_dqn.py agent.zip --seed 0
    hyrl-mj robustify vehicle --policy agent.zip

Half a minute. Its networks respect no symmetry; SB3's `EvalCallback` keeps the policy with the best return.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback

import hyrl_mj
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv

SAMPLES = 300_000


def main() -> None:
    """Train, save, and say how often the agent arrives without noise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="the zip to write")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    options = parser.parse_args()
    torch.set_num_threads(1)
    task = hyrl_mj.get_task("vehicle")
    model = DQN(
        "MlpPolicy",
        TaskVecEnv(BatchedEnv(task, 64)),
        seed=options.seed,
        device="cpu",
        gamma=0.9664,
        learning_rate=lambda left: 1e-3 * max(left, 0.02),
        buffer_size=200_000,
        learning_starts=min(2_000, options.samples // 2),
        batch_size=256,
        train_freq=1,
        gradient_steps=4,
        target_update_interval=3_000,
        n_steps=5,
        exploration_final_eps=0.05,
        exploration_fraction=0.5,
        policy_kwargs={"net_arch": [64, 64]},
    )
    best = options.out.parent / f".{options.out.stem}"
    judged = TaskVecEnv(BatchedEnv(task, 64))
    judged.seed(options.seed)
    watch = EvalCallback(
        judged,
        n_eval_episodes=256,
        eval_freq=max(options.samples // 64 // 40, 2),
        best_model_save_path=str(best),
        verbose=0,
        warn=False,
    )
    model.learn(options.samples, callback=watch)
    (best / "best_model.zip").replace(options.out)
    best.rmdir()
    policy = hyrl_mj.load_agent(options.out, task)
    starts = hyrl_mj.sets.Grid.with_cells(task.chart, 60).nodes
    starts = starts[task.may_start(starts)]
    arcs = hyrl_mj.simulate(task, policy, starts)
    print(
        f"{options.out}: arrives from {sum(arc.arrives(task) for arc in arcs)} of {len(arcs)} starts"
    )


if __name__ == "__main__":
    main()
