"""Stage 6: one policy for each extended set, trained there and nowhere else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrl_mj.envs import Domain
from hyrl_mj.game import (
    LOST,
    NEVER,
    Answers,
    Lattice,
    Moves,
    fewest_samples,
    lasting,
    noisy_moves,
    solve,
)
from hyrl_mj.learning import Training, symmetry
from hyrl_mj.learning.distillation import distil, fits
from hyrl_mj.learning.training import Score, train
from hyrl_mj.policies import ALGORITHMS, MlpPolicy, Policy, PolicyController
from hyrl_mj.sets import GridSet
from hyrl_mj.simulation import LoopSettings, Noise, closed_loop
from hyrl_mj.stages.extended_sets import ExtendedSets, neighbourhood
from hyrl_mj.stages.partition import Partition, part_policies
from hyrl_mj.stages.reachability import longest_hop
from hyrl_mj.tasks import Outcome, Task

# Of the starts of training episodes this share is where the game is lost, if it is; of the others this
# share comes from where the task starts, the rest from all over the mode's domain.
LOST_SHARE = 0.2
TASK_SHARE = 0.7
# States that fail in k samples are met in proportion to k to this power: failures are learned backward.
URGENCY = -1.5
# The latest arrival may be this share behind the fewest samples there are.
ALLOWED_DELAY = 0.03
# The kinds of noise that a policy is judged by where the worst case cannot be played, the mildest first.
JUDGES = ("none", "uniform", "alternating", "adversarial")
# Episodes for each kind of noise that a policy is judged by where the worst case cannot be played, and how
# many at a time: bad policies, which most are, need not be followed through all.
EPISODES, TOGETHER = 256, 64


@dataclass(frozen=True)
class WarmStart:
    """What the first attempt of stage 6 can go on from.

    Attributes:
        policy: the stage-1 policy, or the agent.
        partition: M_i, from stage 3.
    """

    policy: Policy
    partition: Partition

    def policy_for(self, ground: ModeGround, settings: Training, seed: int) -> MlpPolicy | None:
        """Returns the policy that training goes on from; None if it has to start afresh.

        PPO and A2C go on from pi_i, what the policy does on M_i, continued over the boundary (paper, Step
        4), distilled into their network. The policy's own weights would bring its decision along, which
        they do not let go of. Other algorithms go on from the weights, if these fit.

        Args:
            ground: of the mode.
            settings: of the training.
            seed: of weights and points of the distillation.
        """
        task, policy, partition = ground.task, self.policy, self.partition
        if not ALGORITHMS[settings.algorithm].is_actor_critic:
            if isinstance(policy, MlpPolicy) and fits(task, settings, policy):
                return policy
            return None
        hop = longest_hop(task, policy, partition.grid)
        near = neighbourhood(partition.grid, ground.extended.noise, hop)
        index = partition.modes.index(ground.mode)
        part = part_policies(task, policy, partition, near)[index]
        return distil(task, part, ground.starts, settings, seed)


def retrain(
    ground: ModeGround,
    settings: Training,
    seed: int,
    *,
    warm_start: WarmStart | None = None,
    others: Iterable[MlpPolicy] = (),
    log_dir: Path | None = None,
) -> MlpPolicy:
    """Train the policy of one mode (paper, Step 6).

    A policy that passes an obstacle closer than the noise bound is led into it, and no switching cures
    that. So the reward is that of the worst state that the measurement may stand for, and training goes
    on where the worst-case game is lost.

    Args:
        ground: where the mode has to win, and the judge of its policies; see `mode_ground`.
        settings: how to train.
        seed: of everything random; each mode and attempt derives its own from it.
        warm_start: what the first attempt goes on from, if `settings.warm_start` asks for it.
        others: policies of other modes: if the mirror image of one is good enough here, it is taken.
        log_dir: where logs and checkpoints go.

    Returns:
        The best policy of all attempts and the one that they went on from, or the first mirror image that
        is good enough.
    """
    task, mode = ground.task, ground.mode
    if task.mirror is not None:
        for image in (symmetry.mirrored(other) for other in others):
            if ground(image) >= ground.enough:
                return image
    best: tuple[Score, MlpPolicy] | None = None
    for attempt in range(settings.attempts):
        draw = int(np.random.SeedSequence([seed, 1 + mode, attempt]).generate_state(1)[0])
        warm = None
        if warm_start is not None and settings.warm_start and not attempt:
            warm = warm_start.policy_for(ground, settings, draw)
        if warm is not None:
            best = ground(warm), warm
            if best[0] >= ground.enough:
                return warm
        trained = train(
            task,
            settings,
            seed=draw,
            ground=ground,
            start_from=warm,
            log_dir=log_dir,
            label=f"mode {mode}" + (f", attempt {attempt + 1}" if attempt else ""),
        )
        score = ground(trained)
        if best is None or score > best[0]:
            best = score, trained
        if score >= ground.enough:
            break
    assert best is not None
    return best[1]


def mode_ground(task: Task, extended: ExtendedSets, mode: int) -> ModeGround:
    """The ground of a mode: judged by the worst-case game where it can be played, else by episodes."""
    return (ByGame if Lattice.possible(task) else ByEpisodes)(task, extended, mode)


class ModeGround(ABC):
    """Where one mode has to win: draws starts from it, and scores its policies (a `Ground` of `train`).

    It is every state whose measurement can lie in M_ext_i and from which the mode can still succeed.

    Args:
        task: what is to be learned.
        extended: M_ext_i and W_i.
        mode: the mode.

    Attributes:
        enough: the score of a policy that is good enough.
        settled: share of the training after which scores count: from the beginning.
        noise: on the measurements while the mode is trained.
        bound: how far a measured chart point may be off, by coordinate (d,).
    """

    enough: Score
    noise: Noise
    settled = 0.0

    def __init__(self, task: Task, extended: ExtendedSets, mode: int):
        self.task, self.extended, self.mode = task, extended, mode
        self.bound = task.noise_in_chart(extended.noise)
        index = extended.modes.index(mode)
        self.within = extended.sets[index].dilated_by_box(self.bound)
        self.grid = self.within.grid
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
        self._latest: tuple[MlpPolicy, Score] | None = None

    def __call__(self, policy: MlpPolicy) -> Score:
        """The score of a policy. Starts are drawn from what the latest policy has lost."""
        if self._latest is None or self._latest[0] is not policy:
            self._latest = policy, self.score(policy)
        return self._latest[1]

    @abstractmethod
    def score(self, policy: MlpPolicy) -> Score:
        """What `__call__` gives for a policy that was not just asked about."""

    def domain(self, gamma: float) -> Domain:
        """Where training goes on; leaving it counts as the worst reward for ever."""
        caution = self.extended.noise * np.array(self.task.noisy, dtype=float)
        exit_reward = self.task.worst_reward / (1 - gamma)
        return Domain(self.starts, self.within.contains, exit_reward, caution)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws n starts (n, d): where the game is lost, where the task starts, and all over."""
        at = np.where(
            rng.random(n) < TASK_SHARE, rng.choice(self.early, n), rng.choice(self.nodes, n)
        )
        if len(self.lost):
            lost = rng.choice(self.lost, n, p=self._weight)
            at = np.where(rng.random(n) < LOST_SHARE, lost, at)
        return self._around(at, rng)

    def _around(self, at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draws points (n, d) in the cells around nodes at (n,)."""
        n, chart, d = len(at), self.task.chart, self.task.chart.dimension
        z = self.grid.nodes[at] + rng.uniform(-0.5, 0.5, (n, d)) * self.grid.spacing
        return np.where(chart.periodic, z, np.clip(z, chart.low, chart.high))

    def _remember(self, lost: np.ndarray, weight: np.ndarray) -> None:
        """Keeps the nodes (k,) that were lost, and how much of the training each is worth (k,)."""
        self.lost, self._weight = lost, weight / max(weight.sum(), 1e-300)


class ByGame(ModeGround):
    """Judges by the worst-case game, which has to be won from every state.

    The score is minus the share of states lost, then minus delay or miss, whichever exceeds its limit more.

    The delay is that of the latest arrival behind the fewest samples there are. The miss is how far
    off the set-point the noise can keep a run for ever, beyond the noise bound itself; where runs end,
    how far off they end without noise.
    """

    enough: Score = (0.0, -1.0)
    noise = Noise()  # the game finds the worst

    def __init__(self, task: Task, extended: ExtendedSets, mode: int):
        super().__init__(task, extended, mode)
        self.lattice = Lattice.of(task, self.grid)
        after = self.lattice.after
        inside = np.append(self.within.mask, [True, False])[after]
        fewest, _ = fewest_samples(self.lattice, after, inside)
        self.fewest = int(fewest[self.nodes][fewest[self.nodes] < NEVER].max(initial=0))

    def score(self, policy: MlpPolicy) -> Score:
        answers = Answers.of(self.lattice, PolicyController(policy), self.bound)
        moves = noisy_moves(answers, self.bound)
        value = solve(moves)[0, :-2]
        lost = np.flatnonzero(self.wanted & (value >= NEVER))
        samples = np.where(value > NEVER, LOST - value, self.task.max_steps)[lost]
        self._remember(lost, np.maximum(samples, 1.0) ** URGENCY)
        if len(lost):
            return -len(lost) / len(self.nodes), -np.inf
        delay = value[self.nodes].max() / max(self.fewest, 1) - 1
        miss = self._miss(answers, moves)
        return 0.0, -float(max(delay / ALLOWED_DELAY, miss / self.task.precision))

    def _miss(self, answers: Answers, moves: Moves) -> float:
        """Returns how far off the set-point the runs of the last policy end, or are kept by noise."""
        grid, after = self.lattice.grid, self.lattice.after
        still = lasting(moves, self.wanted)
        if still.any():
            return float(self.task.miss(grid.nodes[still]).max() - self.bound.max())
        # Without noise, down to the last nodes on the chart; the sample after these ends most runs.
        # A controller of one mode answers with levels alone.
        level = answers.index[0][answers.middle].ravel()
        last = self.early
        for _ in range(self.task.max_steps):
            place = after[level[last], 0, last]
            last = np.unique(np.where(place < self.lattice.nodes, place, last))
        plant = self.task.plant(len(last))
        plant.set_state(*self.task.state(grid.nodes[last]))
        plant.step(self.lattice.levels[level[last]])
        ends = np.vstack([grid.nodes[last], self.task.z(plant.measurement)])
        return float(self.task.miss(ends).max())


class ByEpisodes(ModeGround):
    """Judges by noisy episodes, where the worst case cannot be played.

    They start where the hybrid controller may pick the mode. Without noise all have to arrive at the
    set-point, under noise to survive. The kinds of noise come in the order of `JUDGES`: the score is how many
    of them stop no episode, then minus the share of episodes that the next one stops.

    Attributes:
        judged: (n, d) where they start.
    """

    enough: Score = (float(len(JUDGES)), 0.0)

    def __init__(self, task: Task, extended: ExtendedSets, mode: int):
        super().__init__(task, extended, mode)
        self.noise = Noise("uniform", extended.noise)
        depth = np.stack([s.values for s in extended.sets])
        deepest = GridSet.from_mask(self.grid, depth.argmin(axis=0) == extended.modes.index(mode))
        picked = deepest.dilated_by_box(self.bound).mask[self.early]
        rng = np.random.default_rng(0)
        first = rng.choice(self.early[picked] if picked.any() else self.early, EPISODES)
        self.judged = self._around(first, rng)
        self._plant = task.plant(TOGETHER)

    def score(self, policy: MlpPolicy) -> Score:
        loop = PolicyController(policy)
        settings = LoopSettings(plant=self._plant, vary=True, quiet=True)
        for survived, kind in enumerate(JUDGES):
            for done in range(0, EPISODES, TOGETHER):
                starts = self.judged[done : done + TOGETHER]
                noise = Noise(kind, self.extended.noise)
                run = closed_loop(self.task, loop, starts, noise, seed=done, settings=settings)
                won = run.outcome == Outcome.REACHED
                if kind == "none":
                    won &= self.task.arrived(run.path[-1])
                lost = self.grid.nearest(starts[~won])
                self._remember(lost, np.ones(len(lost)))
                if len(lost):
                    return float(survived), -len(lost) / (done + TOGETHER)
        return self.enough
