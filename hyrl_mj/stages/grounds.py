"""Where the policy of one mode has to win (paper, Step 6): the starts of its training, and its judge."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import product

import numpy as np

from hyrl_mj import game
from hyrl_mj.envs import Domain
from hyrl_mj.learning.training import Score
from hyrl_mj.policies import MlpPolicy, Policy, PolicyController
from hyrl_mj.sets import GridSet
from hyrl_mj.simulation import LoopSettings, Noise, closed_loop
from hyrl_mj.stages.attacks import Budget, attack
from hyrl_mj.stages.critical_set import distance_to
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.partition import Partition
from hyrl_mj.tasks import Outcome, Task

# If the game is lost from some states, this share of the training episodes starts there.
LOST_SHARE = 0.2
# Of the other episodes, this share starts where the task starts, the rest anywhere in the mode's domain.
TASK_SHARE = 0.7
# States that lose in k samples are drawn in proportion to k to this power: they are learned backward.
URGENCY = -1.5
# The latest arrival may take this share longer than the fewest samples possible.
ALLOWED_DELAY = 0.03
# Share of a mode's states that may be lost where the mode is never selected.
FEW = 1e-3
# Where the worst case cannot be computed: the kinds of noise that judge a policy, the mildest first, and how
# many episodes of each kind are in a batch. Most policies are bad and fail in the first batch; all batches
# are so many episodes that a policy that loses a few in a thousand is found out.
JUDGES = ("none", "uniform", "alternating", "adversarial")
BATCHES = (64, 64, 128, 256, 512)
PLAYS = list(product(range(len(BATCHES)), JUDGES))
# Some episodes lost in a thousand may be missed, but not if the noise is so many times as large as the bound.
MARGIN = 1.2
# The mirror image of a policy that wins all of its own mode has been judged there, so fewer plays tell.
FEW_PLAYS = PLAYS[: 3 * len(JUDGES)]
# The plays by which policies are compared that are not expected to win them all, and how much less a mirror
# image may win.
SHARED = [play for play in PLAYS[-len(JUDGES) :] if play[1] != "adversarial"]
ALIKE = 0.02
# Starts from which a policy is attacked, and rounds of the attack; the second takes much longer. A policy has
# to win this share without noise. Where it withstands nearly all, a training is not expected to do better.
ATTACKED, ROUNDS, WORTH_ATTACKING, MAY_BREAK = 64, 1, 0.9, 0.05
# The seed of the attack by which modes are chosen. What is reported comes from the attack of the examination,
# which has other starts, another seed, and more rounds.
CHOOSING = 20_220_608
# So many starts are drawn for each episode; those too close to where the mode cannot succeed are left out.
SPARE = 4
# There, unless the task has a precision, a policy may end this many times as far off the set-point as the
# stage-1 policy, because it goes the long way, too; or by this share of the distance that counts as arrived.
ALLOWED_MISS, MISS_SHARE = 2.0, 0.75


def mode_ground(
    task: Task,
    extended: ExtendedSets,
    mode: int,
    parts: Partition | None = None,
    policy: Policy | None = None,
    table: bool = False,
) -> ModeGround:
    """Returns the ground of a mode.

    By an attack where the task's effort says so; otherwise by the worst-case game where it decides, else
    by episodes. `table` tells whether a table of inputs can be made.
    """
    if task.for_mode(mode) is not task:
        return ByShare(task, extended, mode, parts, policy)
    if task.effort.attacked:
        return (ByAttackAnywhere if table else ByAttack)(task, extended, mode, parts, policy)
    kind = ByGame if game.Lattice.decides(task, extended.sets[0].grid) else ByEpisodes
    return kind(task, extended, mode, parts, policy)


class ModeGround(ABC):
    """Where one mode has to win: draws starts from it, and scores policies (a `Ground` of `train`).

    These are all states whose measurement can lie in M_ext_i and from which the mode can still succeed.

    Args:
        task: the robot and its problem.
        extended: M_ext_i and W_i.
        mode: the mode.
        parts: M_i, the parts that were extended; by default the mode earns its reward everywhere.
        policy: the stage-1 policy, or the agent, which shows how close to the set-point a run can end.

    Attributes:
        part: M_i of the mode; None where it earns its reward everywhere.
        bound: (d,) largest error of a measured chart point, along each coordinate.
    """

    enough: Score
    noise: Noise
    margin = 1.0  # noise of so many times the bound has to be survived
    settled = 0.0  # scores count from the beginning

    def __init__(
        self,
        task: Task,
        extended: ExtendedSets,
        mode: int,
        parts: Partition | None = None,
        policy: Policy | None = None,
    ):
        self.task, self.extended, self.mode = task.for_mode(mode), extended, mode
        own = self.task is not task
        self.part = None if parts is None or own else parts.parts[parts.modes.index(mode)]
        self.shares = tuple(float(share) for share in task.noisy)
        self.bound = task.noise_in_chart(extended.noise)
        index = extended.modes.index(mode)
        self.within = extended.sets[index].dilated_by_box(self.bound)
        self.grid = self.within.grid
        within = self.within.mask
        alive = task.goes_on(self.grid.nodes)
        # Where the stage-1 policy never succeeds, training may still find a way.
        wins = self._winning(index)
        self.wanted = within & alive & (wins if (within & alive & wins).any() else True)
        self.nodes = np.flatnonzero(self.wanted)
        early = self.nodes[task.may_start(self.grid.nodes[self.nodes])]
        self.early = early if len(early) else self.nodes
        self.lost, self._weight = np.empty(0, dtype=int), np.empty(0)
        self._latest: tuple[Policy, Score] | None = None
        self._prepare(policy)

    def _winning(self, index: int) -> np.ndarray:
        """Returns the nodes (N,) bool from which the mode of an index can succeed, as far as is known."""
        return self.extended.winning[index]

    @abstractmethod
    def _prepare(self, policy: Policy | None) -> None:
        """Prepares the judge."""

    def see(self, policy: Policy) -> None:
        """Notes where a policy loses, as its score does."""
        self(policy)

    def __call__(self, policy: Policy) -> Score:
        """Returns the score of a policy. Later starts are drawn where the latest policy has lost."""
        if self._latest is None or self._latest[0] is not policy:
            self._latest = policy, self.score(policy)
        return self._latest[1]

    def suffices(self, policy: Policy) -> bool:
        """Returns whether no other training is needed.

        The score is `enough`, or the policy loses a `FEW` states at which the hybrid controller never selects
        its mode.
        """
        return self(policy) >= self.enough or self._loses_elsewhere()

    def nearly_won(self, score: Score) -> bool:
        """Returns whether a score is so good that no training is expected to do better."""
        return False

    def won_by_image(self, image: MlpPolicy, won: float) -> float | None:
        """Returns the share that a mirror image wins; None if it is too little.

        The policy that it is the image of wins the share `won` in its own mode.
        """
        return self.won(image) if self.suffices(image) else None

    def _loses_elsewhere(self) -> bool:
        """Returns whether the latest policy lost nothing where its mode may be selected."""
        return False

    @property
    def _selected(self) -> np.ndarray:
        """The nodes (N,) bool at which the hybrid controller may select the mode: its set is the deepest."""
        depth = np.stack([s.values for s in self.extended.sets])
        own = depth.argmin(axis=0) == self.extended.modes.index(self.mode)
        return GridSet.from_mask(self.grid, own).dilated_by_box(self.bound).mask

    @abstractmethod
    def score(self, policy: Policy) -> Score:
        """Computes the score of a policy, and remembers where it lost."""

    @abstractmethod
    def won(self, policy: Policy) -> float:
        """Returns the share that a policy wins, as in `ModeResult`."""

    def domain(self, gamma: float) -> Domain:
        """Returns the domain of training; leaving it costs the worst reward for ever.

        Beyond its part a mode earns nothing: there the task's reward leads to the other way, and it could
        pay to creep or to stay at the edge of the set, because the detour is long and returns are discounted.
        """
        caution = self.margin * self.extended.noise * np.array(self.shares)
        exit_reward = self.task.worst_reward / (1 - gamma)
        earns = None if self.part is None else self.part.contains
        return Domain(self.starts, self.within.contains, exit_reward, caution, earns)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws n starts (n, d): where the game is lost, where the task starts, and all over."""
        early = rng.random(n) < TASK_SHARE
        at = np.where(early, rng.choice(self.early, n), rng.choice(self.nodes, n))
        if len(self.lost):
            lost = rng.choice(self.lost, n, p=self._weight)
            at = np.where(rng.random(n) < LOST_SHARE, lost, at)
        return self._around(at, rng)

    def _around(self, at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draws points (n, d) around the nodes of indices `at` (n,)."""
        return self.grid.around(at, rng)

    def _remember(self, lost: np.ndarray, weight: np.ndarray) -> None:
        """Keeps the lost nodes (k,), and the weights (k,) with which starts are drawn from them."""
        self.lost, self._weight = lost, weight / max(weight.sum(), 1e-300)


class ByGame(ModeGround):
    """Judges by the worst-case game, which has to be won from every state.

    The score is minus the share of lost states, then minus the larger of delay and miss, each as a multiple
    of its limit. The delay is how much longer the latest arrival takes than the fewest samples possible. The
    miss is how far from the set-point, beyond the noise bound, noise can keep a run for ever; if runs end, it
    is how far from the set-point they end without noise.
    """

    enough: Score = (0.0, -1.0)
    noise = Noise()  # the game finds the worst

    def _prepare(self, policy: Policy | None) -> None:
        self.lattice = game.Lattice.tabulate(self.task, self.within.regular)
        after = self.lattice.after
        inside = np.append(self.within.mask, [True, False])[after]
        fewest, _ = game.fewest_samples(self.lattice, after, inside)
        self.fewest = int(fewest[self.nodes][fewest[self.nodes] < game.NEVER].max(initial=0))

    def score(self, policy: Policy) -> Score:
        answers = game.Answers.ask(self.lattice, PolicyController(policy), self.bound)
        moves = game.noisy_moves(answers, self.bound)
        value = game.solve(moves)[0, :-2]
        lost = np.flatnonzero(self.wanted & (value >= game.NEVER))
        samples = np.where(value > game.NEVER, game.LOST - value, self.task.max_steps)[lost]
        self._remember(lost, np.maximum(samples, 1.0) ** URGENCY)
        if len(lost):
            return -len(lost) / len(self.nodes), -np.inf
        delay = value[self.nodes].max() / max(self.fewest, 1) - 1
        miss = self._miss(answers, moves)
        return 0.0, -float(max(delay / ALLOWED_DELAY, miss / self.task.precision))

    def _loses_elsewhere(self) -> bool:
        few = 0 < len(self.lost) <= FEW * len(self.nodes)
        return few and not self._selected[self.lost].any()

    def won(self, policy: Policy) -> float:
        answers = game.Answers.ask(self.lattice, PolicyController(policy), self.bound)
        moves = game.noisy_moves(answers, self.bound)
        value = game.solve(moves, self.task.max_steps)[0, :-2]
        return float((value[self.nodes] < game.NEVER).mean())

    def _miss(self, answers: game.Answers, moves: game.Moves) -> float:
        """Returns the miss, from the answers of a policy and the moves of the noise."""
        grid, after = self.lattice.grid, self.lattice.after
        still = game.lasting(moves, self.wanted)
        if still.any():
            return float(self.task.miss(grid.nodes[still]).max() - self.bound.max())
        # Follow the runs without noise to their last nodes on the chart; the next sample ends most of them.
        # The answers of a controller with one mode are levels.
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
    """Judges by noisy episodes, where the worst case cannot be computed.

    The episodes start where the hybrid controller may select the mode. Without noise all have to arrive at
    the set-point, under noise of `MARGIN` times the bound all have to survive. Each batch is played with all
    kinds of noise in `JUDGES` before the next batch. The score is the number of plays that stop no episode,
    then minus the share of episodes that the next play stops; if none is stopped, minus the largest distance
    from the set-point at the end without noise, as a multiple of `allowed`.

    Attributes:
        judged: (n, d) starts of the episodes.
        allowed: allowed distance from the set-point at the end of episodes without noise [chart units].
    """

    margin = MARGIN

    def _prepare(self, policy: Policy | None) -> None:
        self.plays = PLAYS[: self.task.effort.batches * len(JUDGES)]
        self.enough = float(len(self.plays)), -1.0
        with np.errstate(divide="ignore"):
            most = (self.task.chart.sides / (2 * self.bound)).min()
        self.margin = min(self.margin, (1 + most) / 2)  # noise must not hide the whole chart
        self.noise = Noise("uniform", self.margin * self.extended.noise)
        picked = self._selected[self.early]
        rng, episodes = np.random.default_rng(0), sum(BATCHES)
        first = rng.choice(self.early[picked] if picked.any() else self.early, SPARE * episodes)
        z = self._around(first, rng)
        # A start may be lost for any policy if not all nodes around it are wanted.
        sure = np.flatnonzero(self.grid.interpolate(self.wanted.astype(float), z) > 1 - 1e-9)
        self.judged = z[np.resize(sure if len(sure) else np.arange(len(z)), episodes)]
        self._batches = np.split(np.arange(len(self.judged)), np.cumsum(BATCHES)[:-1])
        self._plants = {n: self.task.plant(n) for n in set(BATCHES)}
        self.allowed = self._allowed(policy)

    def _allowed(self, policy: Policy | None) -> float:
        """Returns `allowed`, by the runs of the stage-1 policy that arrive, if there are any."""
        precision, close = self.task.precision, self.task.close
        plays = [play for play in self.plays if play[1] == JUDGES[0]]
        batches = [self._play(policy, *play) for play in plays] if policy else []
        ends = np.concatenate([np.empty(0), *(miss[won] for won, miss in batches)])
        farthest = float(ends.max(initial=0.0))
        if np.isfinite(precision):
            return max(farthest, precision)
        return max(ALLOWED_MISS * farthest, MISS_SHARE * close if len(ends) else close)

    def score(self, policy: Policy, plays: Sequence[tuple[int, str]] | None = None) -> Score:
        farthest, plays = 0.0, self.plays if plays is None else plays
        for survived, (batch, kind) in enumerate(plays):
            won, miss = self._play(policy, batch, kind)
            farthest = max(farthest, miss.max()) if kind == JUDGES[0] else farthest
            lost = self.grid.nearest(self.judged[self._batches[batch]][~won])
            self._remember(lost, np.ones(len(lost)))
            if len(lost):
                return float(survived), -len(lost) / len(won)
        return float(len(plays)), -farthest / self.allowed

    def won_by_image(self, image: MlpPolicy, won: float) -> float | None:
        if won < 1:
            return super().won_by_image(image, won)
        enough = float(len(FEW_PLAYS)), -1.0
        return won if self.score(image, FEW_PLAYS) >= enough else None

    def won(self, policy: Policy) -> float:
        if self(policy)[0] == self.enough[0]:
            return 1.0  # the same episodes
        return float(np.concatenate([self._play(policy, *play)[0] for play in self.plays]).mean())

    def _play(self, policy: Policy, batch: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns which episodes of a batch are won (k,), and how far off they end (k,)."""
        rows = self._batches[batch]
        settings = LoopSettings(plant=self._plants[len(rows)], vary=True, quiet=True)
        noise, loop = Noise(kind, self.noise.bound), PolicyController(policy)
        seed, starts, task = int(rows[0]), self.judged[rows], self.task.with_noise(self.shares)
        run = closed_loop(task, loop, starts, noise, seed=seed, settings=settings)
        ends, won = run.path[-1], run.outcome == Outcome.REACHED
        won = won & self.task.arrived(ends) if kind == JUDGES[0] else won
        return won, self.task.miss(ends)


class ByAttack(ByEpisodes):
    """Judges by an attack, too, which finds noise that keeps a robot in a corner: where samples take long.

    The score is the mean of two shares: of episodes that are won without noise, and of starts from which an
    attack does not break the policy. If it loses none of them the score of the noisy episodes follows. A
    policy that wins too few of the first is not attacked, as if it were broken from everywhere.

    Attributes:
        attacked: (n, d) starts of the attack.
    """

    def _prepare(self, policy: Policy | None) -> None:
        super()._prepare(policy)
        # The attack stands for the adversary, whose looking ahead takes too long here.
        self.plays = [play for play in self.plays if play[1] != "adversarial"]
        self.enough = (1.0, float(len(self.plays)), -1.0)
        # Half of the starts are where modes meet: there a mode may have to go against its neighbours.
        off = distance_to(self.task, self.extended.points, self.grid.nodes[self.nodes])
        near = self.nodes[off <= 2 * float(np.linalg.norm(self.bound / self.task.chart.scale))]
        rng, half = np.random.default_rng(1), ATTACKED // 2 if len(near) else 0
        meeting = self._around(rng.choice(near, half), rng) if half else self.judged[:0]
        self.attacked = np.vstack([self.judged[: ATTACKED - half], meeting])

    def score(self, policy: Policy, plays: Sequence[tuple[int, str]] | None = None) -> Score:
        quiet = [batch for batch, kind in self.plays if kind == JUDGES[0]]
        wins = np.concatenate([self._play(policy, batch, JUDGES[0])[0] for batch in quiet])
        starts = self.judged[np.concatenate([self._batches[batch] for batch in quiet])]
        lost, won = self.grid.nearest(starts[~wins]), float(wins.mean())
        self._remember(lost, np.ones(len(lost)))
        if won < WORTH_ATTACKING:
            return won / 2, 0.0, -1.0
        starts, budget = self.attacked, Budget(rounds=ROUNDS)
        task, loops = self.task.with_noise(self.shares), {"mode": PolicyController(policy)}
        found = attack(task, loops, starts, self.noise.bound, budget, seed=CHOOSING)["mode"]
        withstood = 1 - (found.count.unaided + found.count.lost) / len(starts)
        both = (won + withstood) / 2
        return (both, *(super().score(policy, plays) if both == 1 else (0.0, -1.0)))

    def nearly_won(self, score: Score) -> bool:
        return score[0] >= 1 - MAY_BREAK

    def won(self, policy: Policy) -> float:
        """Returns the share that a policy wins, which is no larger than what the attack leaves of it."""
        score = self(policy)
        if score[:2] == self.enough[:2]:
            return 1.0  # the same episodes
        episodes = np.concatenate([self._play(policy, *play)[0] for play in self.plays])
        return float(min(score[0], episodes.mean()))


class ByAttackAnywhere(ByAttack):
    """As `ByAttack`, from everywhere in the set: a table may succeed where the agent does not."""

    def _winning(self, index: int) -> np.ndarray:
        return np.ones(self.grid.size, dtype=bool)


class ByShare(ByEpisodes):
    """Judges by the share of noisy episodes that are won, for a task with a reward for each mode.

    Such a task is trained from all of its starts, because its reward leads the mode's own way from anywhere.
    It may draw episodes that no policy wins. The score is the share that is won in the plays `SHARED`.
    """

    settled = 0.75

    def _prepare(self, policy: Policy | None) -> None:
        super()._prepare(policy)
        self.enough = (1.0,)

    def see(self, policy: Policy) -> None:
        """Does nothing: a training draws many times as many episodes as it is judged by."""

    def domain(self, gamma: float) -> Domain:
        """Returns the domain of training: all starts of the task, whose reward leads the mode's own way."""
        caution = self.margin * self.extended.noise * np.array(self.shares)
        return Domain(self.task.starts, caution=caution)

    def score(self, policy: Policy, plays: Sequence[tuple[int, str]] | None = None) -> Score:
        won = [self._play(policy, batch, kind)[0] for batch, kind in SHARED]
        return (float(np.concatenate(won).mean()),)

    def suffices(self, policy: Policy) -> bool:
        return True  # another training would draw other episodes, and win about as many

    def won_by_image(self, image: MlpPolicy, won: float) -> float | None:
        share = self.score(image)[0]
        return share if share >= won - ALIKE else None

    def won(self, policy: Policy) -> float:
        return self(policy)[0]
