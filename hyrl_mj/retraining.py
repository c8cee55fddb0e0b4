"""Stage 6: one policy for each extended set, trained there and nowhere else."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hyrl_mj import symmetry
from hyrl_mj.controllers import PolicyController
from hyrl_mj.envs.core import Domain
from hyrl_mj.extended_sets import ExtendedSets
from hyrl_mj.game import LOST, NEVER, Answers, Moves, lasting, noisy_moves, solve
from hyrl_mj.lattice import Lattice
from hyrl_mj.limit import fewest_samples
from hyrl_mj.noise import Noise
from hyrl_mj.policies import MlpPolicy
from hyrl_mj.settings import Training
from hyrl_mj.tasks.base import Outcome, Task
from hyrl_mj.training import Score, train

# Of the starts of training episodes this share is where the game is lost, if it is; of the others this
# share comes from where the task starts, the rest from all over the mode's domain.
LOST_SHARE = 0.2
TASK_SHARE = 0.7
# States that fail in k samples are met in proportion to k to this power: failures are learned backward.
URGENCY = -1.5
# The latest arrival may be this share behind the fewest samples there are.
ALLOWED_DELAY = 0.03


def retrain(
    task: Task,
    policy: MlpPolicy,
    extended: ExtendedSets,
    mode: int,
    settings: Training,
    seed: int,
    others: Iterable[MlpPolicy] = (),
    log_dir: Path | None = None,
) -> MlpPolicy:
    """Train the policy of one mode (paper, Step 6).

    A policy that passes an obstacle closer than the noise bound is led into it, and no switching cures
    that. So the reward is that of the worst state that the measurement may stand for, and training goes
    on where the worst-case game is lost.

    Args:
        task: what to learn.
        policy: the stage-1 policy; with `settings.warm_start` training goes on from its weights.
        extended: M_ext_i and W_i, from stage 5.
        mode: the mode to train.
        settings: how to train.
        seed: of everything random; each mode and attempt derives its own from it.
        others: policies of other modes: if the mirror image of one is good enough here, it is taken.
        log_dir: where logs and checkpoints go.

    Returns:
        The best policy of all attempts, or the first mirror image that will do.
    """
    ground = ModeGround(task, extended, mode)
    if ground.lattice and task.mirror is not None:
        for image in (symmetry.mirrored(other) for other in others):
            if ground(image) >= ground.enough:
                return image
    best: tuple[Score, MlpPolicy] | None = None
    for attempt in range(settings.attempts):
        found = train(
            task,
            settings,
            seed=int(np.random.SeedSequence([seed, 1 + mode, attempt]).generate_state(1)[0]),
            # Without a game to find the worst noise, chance has to do.
            noise=Noise() if ground.lattice else Noise("uniform", extended.noise),
            domain=ground.domain(settings.gamma),
            start_from=policy if settings.warm_start else None,
            judge=ground if ground.lattice else None,
            log_dir=log_dir,
            label=f"mode {mode}" + (f", attempt {attempt + 1}" if attempt else ""),
        )
        if not ground.lattice:
            return found
        score = ground(found)
        if best is None or score > best[0]:
            best = score, found
        if score >= ground.enough:
            break
    assert best is not None
    return best[1]


class ModeGround:
    """Where one mode has to win: judges its policies there, and draws starts from it (a `Judge`).

    It is every state whose measurement can lie in M_ext_i and from which the mode can still succeed.

    Args:
        task: what is to be learned.
        extended: M_ext_i and W_i.
        mode: the mode.
    """

    def __init__(self, task: Task, extended: ExtendedSets, mode: int):
        self.task, self.extended = task, extended
        self.noise = task.noise_in_chart(extended.noise)
        index = extended.modes.index(mode)
        self.within = extended.sets[index].dilated_by_box(self.noise)
        self.grid = self.within.grid
        self.lattice: Lattice | None = None
        if Lattice.possible(task):
            self.lattice = Lattice.of(task, self.grid)
        within = self.within.mask
        plant = task.plant(len(self.grid.nodes))
        plant.set_state(*task.state(self.grid.nodes))
        alive = task.ending(plant.measurement) == Outcome.RUNNING
        # If the stage-1 policy never succeeds here, training may still find a way.
        wins = extended.winning[index]
        self.wanted = within & alive & (wins if (within & alive & wins).any() else True)
        self.nodes = np.flatnonzero(self.wanted)
        early = self.nodes[task.may_start(self.grid.nodes[self.nodes])]
        self.early = early if len(early) else self.nodes
        self.lost, self._weight = np.empty(0, dtype=int), np.empty(0)
        self.enough: Score = (0.0, -1.0)
        if self.lattice:
            after = self.lattice.after
            inside = np.append(within, [True, False])[after]
            fewest, _ = fewest_samples(self.lattice, after, inside)
            self.fewest = int(fewest[self.nodes][fewest[self.nodes] < NEVER].max(initial=0))

    def domain(self, gamma: float) -> Domain:
        """Where training goes on; leaving it counts as the worst reward for ever."""
        caution = self.extended.noise * np.array(self.task.noisy, dtype=float)
        exit_reward = self.task.worst_reward / (1 - gamma)
        return Domain(self.starts, self.within.contains, exit_reward, caution)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """n starts (n, d): where the game is lost, where the task starts, and all over."""
        at = np.where(
            rng.random(n) < TASK_SHARE, rng.choice(self.early, n), rng.choice(self.nodes, n)
        )
        if len(self.lost):
            lost = rng.choice(self.lost, n, p=self._weight)
            at = np.where(rng.random(n) < LOST_SHARE, lost, at)
        chart, d = self.task.chart, self.task.chart.dimension
        z = self.grid.nodes[at] + rng.uniform(-0.5, 0.5, (n, d)) * self.grid.spacing
        return np.where(chart.periodic, z, np.clip(z, chart.low, chart.high))

    def __call__(self, policy: MlpPolicy) -> Score:
        """Minus the share of states lost; minus delay or miss, whichever is more beyond what is allowed.

        The delay is that of the latest arrival behind the fewest samples there are. The miss is how far
        off the set-point the noise can keep a run for ever, beyond the noise bound itself; where runs end,
        how far off they end without noise.

        Starts are drawn from what the latest policy has lost.
        """
        assert self.lattice is not None
        answers = Answers.of(self.lattice, PolicyController(policy), self.noise)
        moves = noisy_moves(answers, self.noise)
        value = solve(moves)[0, :-2]
        self.lost = np.flatnonzero(self.wanted & (value >= NEVER))
        samples = np.where(value > NEVER, LOST - value, self.task.max_steps)[self.lost]
        weight = np.maximum(samples, 1.0) ** URGENCY
        self._weight = weight / weight.sum()
        if len(self.lost):
            return -len(self.lost) / len(self.nodes), -np.inf
        delay = value[self.nodes].max() / max(self.fewest, 1) - 1
        miss = self._miss(answers, moves)
        return 0.0, -float(max(delay / ALLOWED_DELAY, miss / self.task.precision))

    def _miss(self, answers: Answers, moves: Moves) -> float:
        assert self.lattice is not None
        grid, after = self.lattice.grid, self.lattice.after
        still = lasting(moves, self.wanted)
        if still.any():
            return float(self.task.miss(grid.nodes[still]).max() - self.noise.max())
        # Without noise, down to the last nodes on the chart; the sample after these ends most runs.
        # A controller of one mode answers with levels alone.
        level = answers.letter[0][answers.middle].ravel()
        last = self.early
        for _ in range(self.task.max_steps):
            place = after[level[last], 0, last]
            last = np.unique(np.where(place < self.lattice.nodes, place, last))
        plant = self.task.plant(len(last))
        plant.set_state(*self.task.state(grid.nodes[last]))
        plant.step(self.lattice.levels[level[last]])
        ends = np.vstack([grid.nodes[last], self.task.z(plant.measurement)])
        return float(self.task.miss(ends).max())
