"""Where the policy of one mode is trained, and how it is judged there (paper, Step 6).

It is judged by the worst-case game, by noisy episodes, by an attack, or by the share of episodes won.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import product

import numpy as np

from hyrl_mj.gym_export import Domain, pay_of
from hyrl_mj.judging import Budget, attack, game
from hyrl_mj.learning import ModeSettings
from hyrl_mj.learning.to_go import NoWay, WayToGo
from hyrl_mj.learning.training import Score
from hyrl_mj.policies import MlpPolicy, Policy, PolicyController
from hyrl_mj.sets import GridSet, distance_to
from hyrl_mj.simulation import (
    KINDS,
    SENSOR,
    AnyNoise,
    AttackSettings,
    LoopSettings,
    Noise,
    Sensor,
    closed_loop,
    covers_sensor,
)
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.partition import Partition
from hyrl_mj.tasks import Outcome, Task

# Starts from which a policy is attacked.
ATTACKED = 64
# A number of a batch, and the kind of noise that it is played with.
Play = tuple[int, str]


@dataclass(frozen=True)
class Judged:
    """What a ground says of a policy.

    Attributes:
        score: higher is better, compared from left to right.
        suffices: whether no other training is needed.
        lost: (k,) nodes from which the policy loses.
        weight: (k,) how many of the later starts are drawn there, in proportion.
    """

    score: Score
    suffices: bool
    lost: np.ndarray = field(default_factory=partial(np.empty, 0, int))
    weight: np.ndarray = field(default_factory=partial(np.empty, 0))


def mode_ground(
    task: Task,
    extended: ExtendedSets,
    mode: int,
    parts: Partition | None = None,
    policy: Policy | None = None,
    table: bool = False,
    settings: ModeSettings = ModeSettings(),
    attacks: AttackSettings = AttackSettings(),
    shaped: bool = False,
) -> ModeGround:
    """Returns the ground of a mode.

    It judges by an attack where the task's effort says so; otherwise by the worst-case game where it decides,
    else by episodes; and a task with a reward for each mode by the share of episodes that are won.

    Args:
        task: the robot and its problem.
        extended: M_ext_i and W_i.
        mode: the mode.
        parts: M_i, the parts that were extended; by default the mode earns its reward everywhere.
        policy: the stage-1 policy, or the agent, which shows how close to the set-point a run can end.
        table: whether a table of inputs can be made, which may succeed where the agent does not.
        settings: where trainings start, and when a policy is good enough.
        attacks: what signals an attack tries.
        shaped: whether trainings are paid for being near to the goal, by the shortest way in the set.
    """
    kind: type[ModeGround]
    if task.for_mode(mode) is not task:
        kind = ByShare
    elif task.effort.attacked:
        kind = ByAttack
    else:
        decides = game.Lattice.decides(task, extended.sets[0].grid)
        kind = ByGame if decides else ByEpisodes
    part = None if parts is None else parts.parts[parts.modes.index(mode)]
    return kind(task, extended, mode, part, policy, table, settings, attacks, shaped)


class ModeGround(ABC):
    """Where one mode has to win: draws starts from there, and judges policies (a `Ground` of `train`).

    These are all states whose measurement can lie in M_ext_i and from which the mode can still succeed; with
    a table this may be anywhere in its set, also outside of W_i.

    Args:
        task, extended, mode, policy, table, settings, attacks, shaped: as in `mode_ground`.
        part: M_i of the mode; None where it earns its reward everywhere.

    Attributes:
        task: the task of the mode.
        bound: (d,) largest error of a measured chart point, along each coordinate.
        within: M_ext_i, widened by it.
        wanted: (N,) bool, the nodes of the set's grid that are such states.
        nodes: (n,) the indices of these nodes.
        early: (k,) those of them where an episode may start; where none may, those where modes meet, or all.
        enough: score with which a training may end.
        nearly: score with which no training is expected to do better; none by default.
        settled: share of a training after which scores count.
        noise: noise on the measurements during training.
        margin: noise of so many times the bound has to be survived.
    """

    enough: Score
    nearly: Score = (np.inf,)
    settled: float = 0.0
    noise: AnyNoise
    margin: float

    def __init__(
        self,
        task: Task,
        extended: ExtendedSets,
        mode: int,
        part: GridSet | None,
        policy: Policy | None,
        table: bool,
        settings: ModeSettings,
        attacks: AttackSettings,
        shaped: bool = False,
    ):
        self.task, self.extended, self.mode = task.for_mode(mode), extended, mode
        self.shaped = shaped
        self.part, self.settings, self.attacks = part, settings, attacks
        self.bound = task.noise_in_chart(extended.eps)
        index = extended.modes.index(mode)
        self.within = extended.sets[index].dilated_by_box(self.bound)
        self.grid = self.within.grid
        possible = self.within.mask & task.goes_on(self.grid.nodes)
        wins = possible & extended.winning[index]
        # Where the stage-1 policy never succeeds, training may still find a way.
        self.wanted = possible if table or not wins.any() else wins
        self.nodes = np.flatnonzero(self.wanted)
        self.early = self._early()
        self._latest: tuple[Policy, Judged] | None = None
        self._prepare(policy)

    def _early(self) -> np.ndarray:
        """Returns the nodes (k,) where episodes begin: starts of the task, or where modes meet, or all."""
        nodes, z = self.nodes, self.grid.nodes[self.nodes]
        if (starts := self.task.may_start(z)).any():
            return nodes[starts]
        near = self._meets(nodes)
        return near if len(near) else nodes

    def _meets(self, nodes: np.ndarray) -> np.ndarray:
        """Returns those of some nodes (k,) that noise can show where modes meet."""
        chart = self.task.chart
        off = distance_to(chart, self.extended.points, self.grid.nodes[nodes])
        return nodes[off <= 2 * float(np.linalg.norm(self.bound / chart.scale))]

    @abstractmethod
    def _prepare(self, policy: Policy | None) -> None:
        """Prepares what policies are judged by."""

    @abstractmethod
    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        """Judges a policy; `twin` is the share that its mirror image wins, if it is the image of one."""

    @abstractmethod
    def won(self, policy: Policy) -> float:
        """Returns the share that a policy wins, as in `ModeResult`."""

    @cached_property
    def selected(self) -> np.ndarray:
        """The nodes (N,) bool at which the hybrid controller may select the mode: its set is the deepest."""
        depth = np.stack([s.values for s in self.extended.sets])
        own = depth.argmin(axis=0) == self.extended.modes.index(self.mode)
        return GridSet.from_mask(self.grid, own).dilated_by_box(self.bound).mask

    def note_losses(self, policy: Policy) -> None:
        """Notes where a policy loses, as its score does."""
        self(policy)

    def __call__(self, policy: Policy) -> Score:
        """Returns the score of a policy. Later starts are drawn where the latest policy has lost."""
        return self.judged(policy).score

    def judged(self, policy: Policy) -> Judged:
        """Returns what `judge` says of a policy, which is not judged twice in turn."""
        if self._latest is None or self._latest[0] is not policy:
            self._latest = policy, self.judge(policy)
        return self._latest[1]

    def suffices(self, policy: Policy) -> bool:
        """Returns whether no other training is needed."""
        return self.judged(policy).suffices

    def won_by_image(self, image: MlpPolicy, won: float) -> float | None:
        """Returns the share that a mirror image wins; None if it is too little.

        The policy that it is the image of wins the share `won` in its own mode.
        """
        self._latest = image, self.judge(image, twin=won)
        return self.won(image) if self.suffices(image) else None

    @property
    def caution(self) -> np.ndarray:
        """The noise (p,) that trainings count on in their rewards."""
        return self.margin * self.extended.eps * np.array(self.task.noisy, dtype=float)

    def domain(self, gamma: float) -> Domain:
        """Returns the domain of training; leaving it costs the worst reward for ever.

        Beyond its part a mode earns nothing: there the task's reward leads to the other way, and it could
        pay to creep or to stay at the edge of the set, because the detour is long and returns are discounted.
        """
        earns, pay = None if self.part is None else self.part.contains, pay_of(self.task)
        if self.shaped:
            with suppress(NoWay):
                pay = WayToGo(self.task, gamma, self.within.contains).pay
        exit_reward = pay.worst / (1 - gamma)
        return Domain(self.starts, self.within.contains, exit_reward, self.caution, earns, pay)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws n starts (n, d): where the game is lost, where the task starts, and all over."""
        early = rng.random(n) < self.settings.task_share
        at = np.where(early, rng.choice(self.early, n), rng.choice(self.nodes, n))
        if self._latest is not None and len(self._latest[1].lost):
            judged = self._latest[1]
            weight = judged.weight / max(judged.weight.sum(), 1e-300)
            lost = rng.choice(judged.lost, n, p=weight)
            at = np.where(rng.random(n) < self.settings.lost_share, lost, at)
        return self.grid.around(at, rng)


class ByGame(ModeGround):
    """Judges by the worst-case game, which has to be won from every state.

    The score is minus the share of lost states, then minus the larger of delay and miss, each as a multiple
    of its limit. The delay is how much longer the latest arrival takes than the fewest samples possible. The
    miss is how far from the set-point, beyond the noise bound, noise can keep a run for ever; if runs end, it
    is how far from the set-point they end without noise. A policy suffices, too, that loses few states, at
    none of which the hybrid controller selects its mode.
    """

    enough: Score = (0.0, -1.0)
    noise = Noise()  # the game finds the worst
    margin = 1.0

    def _prepare(self, policy: Policy | None) -> None:
        self.lattice = game.Lattice.tabulate(self.task, self.within.regular)
        after = self.lattice.after
        inside = np.append(self.within.mask, [True, False])[after]
        fewest, _ = game.fewest_samples(self.lattice, after, inside)
        self.fewest = int(fewest[self.nodes][fewest[self.nodes] < game.NEVER].max(initial=0))

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        settings, (answers, moves) = self.settings, self._moves(policy)
        value = game.solve(moves)[0, :-2]
        lost = np.flatnonzero(self.wanted & (value >= game.NEVER))
        if len(lost):
            samples = np.where(value > game.NEVER, game.LOST - value, self.task.max_steps)[lost]
            elsewhere = len(lost) <= settings.few * len(self.nodes)
            elsewhere = elsewhere and not self.selected[lost].any()
            score = -len(lost) / len(self.nodes), -np.inf
            return Judged(score, elsewhere, lost, np.maximum(samples, 1.0) ** settings.urgency)
        delay = (value[self.nodes].max() / max(self.fewest, 1) - 1) / settings.allowed_delay
        miss = self._miss(answers, moves) / self.task.precision
        score = 0.0, -float(max(delay, miss))
        return Judged(score, score >= self.enough)

    def won(self, policy: Policy) -> float:
        _, moves = self._moves(policy)
        value = game.solve(moves, self.task.max_steps)[0, :-2]
        return float((value[self.nodes] < game.NEVER).mean())

    def _moves(self, policy: Policy) -> tuple[game.Answers, game.Moves]:
        """Returns the answers of a policy, and the moves of the noise."""
        answers = game.Answers.ask(self.lattice, PolicyController(policy), self.bound)
        return answers, game.noisy_moves(answers, self.bound)

    def _miss(self, answers: game.Answers, moves: game.Moves) -> float:
        """Returns the miss, from the answers of a policy and the moves of the noise."""
        task, grid, after = self.task, self.lattice.grid, self.lattice.after
        still = game.lasting(moves, self.wanted)
        if still.any():
            return float(task.miss(grid.nodes[still]).max() - self.bound.max())
        # Follow the runs without noise to their last nodes on the chart; the next sample ends most of them.
        # The answers of a controller with one mode are levels.
        level = answers.index[0][answers.middle].ravel()
        last = self.early
        for _ in range(task.max_steps):
            place = after[level[last], 0, last]
            last = np.unique(np.where(place < self.lattice.nodes, place, last))
        plant = task.placed(grid.nodes[last])
        plant.step(self.lattice.levels[level[last]])
        ends = np.vstack([grid.nodes[last], task.z(plant.measurement)])
        return float(task.miss(ends).max())


class Episodes(ModeGround):
    """Plays noisy episodes in batches, which start where the hybrid controller may select the mode.

    Attributes:
        begins: (n, d) starts of the episodes.
        batches: the rows of each batch.
        margin: the noise is so many times as large as the bound.
        kinds: the kinds of noise that the episodes may have.
        noise: the noise during training: what the task's own sensor does, if that is late.
        count: number of batches that the task's effort allows.
    """

    noise: Noise

    def _prepare(self, policy: Policy | None) -> None:
        task, sizes = self.task, self.settings.batches
        self.count = min(task.effort.batches, len(sizes))
        with np.errstate(divide="ignore"):
            most = (task.chart.sides / (2 * self.bound)).min()
        self.margin = min(
            self.settings.margin, (1 + most) / 2
        )  # noise must not hide the whole chart
        bound = self.margin * self.extended.eps
        self.kinds = (*KINDS, SENSOR) if covers_sensor(task, bound) else KINDS
        # A late sensor is late in every column, also in those that the bound says nothing about.
        late = SENSOR in self.kinds and Sensor.parse(task.sensor).late
        self.noise = Noise(SENSOR if late else "uniform", bound)
        picked = self.early[self.selected[self.early]]
        rng, episodes = np.random.default_rng(0), sum(sizes)
        # More than are needed: those too close to where the mode cannot succeed are left out.
        first = rng.choice(picked if len(picked) else self.early, 4 * episodes)
        z = self.grid.around(first, rng)
        # A start may be lost for any policy if not all nodes around it are wanted.
        sure = np.flatnonzero(self.grid.evaluation(self.wanted.astype(float))(z) > 1 - 1e-9)
        self.begins = z[np.resize(sure if len(sure) else np.arange(len(z)), episodes)]
        self.batches = np.split(np.arange(episodes), np.cumsum(sizes)[:-1])
        self._plants = {n: task.plant(n) for n in set(sizes)}

    def play(self, policy: Policy, batch: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns which episodes of a batch are won (k,), as the task says, and how far off they end (k,)."""
        rows, task = self.batches[batch], self.task
        settings = LoopSettings(plant=self._plants[len(rows)], vary=True, quiet=True)
        noise, controller = Noise(kind, self.noise.bound), PolicyController(policy)
        starts, seed = self.begins[rows], int(rows[0])
        run = closed_loop(task, controller, starts, noise, seed=seed, settings=settings)
        return run.outcome == Outcome.REACHED, task.miss(run.path[-1])

    def share(self, policy: Policy, plays: Sequence[Play]) -> float:
        """Returns the share of the episodes of plays that a policy wins."""
        return float(np.concatenate([self.play(policy, *play)[0] for play in plays]).mean())

    def lost_nodes(self, batch: int, won: np.ndarray) -> np.ndarray:
        """Returns the nodes (l,) next to those starts of a batch that are not won (k,) bool."""
        return self.grid.nearest(self.begins[self.batches[batch]][~won])


class ByEpisodes(Episodes):
    """Judges by noisy episodes and an attack, where the worst case cannot be computed.

    The score is the number of plays that stop few episodes (`may_break`) before one stops more, then minus
    the mean share that these and that one stop: an episode that no policy wins hides no others. If none is
    stopped an attack follows: a bias of its whole length is what few episodes draw. Then the score is minus
    the share that it breaks, or if it breaks none, minus the largest distance from the set-point at the end
    without noise, as a multiple of `allowed`. That is what a training aims at; for another one to follow a
    task has to ask for a `precision`. The mirror image of a policy that wins all of its own mode has been
    judged there, so the first three batches tell.

    What is reported comes from the attack of the examination: other starts, another seed, more rounds.

    Attributes:
        plays: what is played, in this order: each batch with all kinds of noise before the next.
        attacked: (n, d) starts of the attack.
        allowed: allowed distance from the set-point at the end of episodes without noise [chart units].
    """

    without = ""  # a kind of noise that no episode has

    def _prepare(self, policy: Policy | None) -> None:
        super()._prepare(policy)
        self.attacked = self._attacked()
        kinds = [kind for kind in self.kinds if kind != self.without]
        self.plays: list[Play] = [*product(range(self.count), kinds)]
        self.few_plays = self.plays[: 3 * len(kinds)]
        self.enough = (len(self.plays) + 2.0, -1.0)
        # As close as the stage-1 policy ends where it arrives, if it does.
        quiet = [self.play(policy, k, game.NO_NOISE) for k in range(self.count)] if policy else []
        ends = np.concatenate([np.empty(0), *(miss[won] for won, miss in quiet)])
        farthest, task, settings = float(ends.max(initial=0.0)), self.task, self.settings
        if np.isfinite(task.precision):
            self.allowed = max(farthest, task.precision)
        else:
            close = settings.miss_share * task.close if len(ends) else task.close
            self.allowed = max(settings.allowed_miss * farthest, close)

    def _attacked(self) -> np.ndarray:
        """Returns the starts (n, d) of the attack, those of episodes."""
        return self.begins[:ATTACKED]

    def lost_under_attack(self, policy: Policy) -> np.ndarray:
        """Returns whether a policy loses from the starts `attacked` (n,), without noise or under a signal."""
        found = attack(
            self.task,
            {"mode": PolicyController(policy)},
            self.attacked,
            self.noise.bound,
            Budget(rounds=1),
            seed=20_220_608,
            settings=self.attacks,
        )["mode"]
        return found.quiet.lost | found.ends.lost

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        plays = self.few_plays if twin == 1 else self.plays
        judged = self.by_plays(policy, plays)
        if twin == 1 or len(judged.lost):
            return judged
        lost = self.lost_under_attack(policy)
        if lost.any():
            nodes = self.grid.nearest(self.attacked[lost])
            return self._losing(len(plays) + 1, float(lost.mean()), nodes)
        return judged

    def by_plays(self, policy: Policy, plays: Sequence[Play]) -> Judged:
        """Judges a policy by plays alone, as if no attack broke it."""
        farthest, shares, nodes = 0.0, [], []
        for survived, (batch, kind) in enumerate(plays):
            won, miss = self.play(policy, batch, kind)
            farthest = max(farthest, miss.max()) if kind == game.NO_NOISE else farthest
            shares.append(float(np.mean(~won)))
            nodes.append(self.lost_nodes(batch, won))
            if shares[-1] > self.settings.may_break:
                return self._losing(survived, float(np.mean(shares)), np.concatenate(nodes))
        if any(shares):
            return self._losing(len(plays), float(np.mean(shares)), np.concatenate(nodes))
        score = len(plays) + 2.0, -farthest / self.allowed
        return Judged(score, score[1] >= -1.0 or np.isinf(self.task.precision))

    def _losing(self, survived: int, share: float, nodes: np.ndarray) -> Judged:
        """Returns that a policy loses a share, at nodes (l,), after so many plays that stop few."""
        return Judged((float(survived), -share), False, nodes, np.ones(len(nodes)))

    def won(self, policy: Policy) -> float:
        judged = self.judged(policy)
        if not len(judged.lost):
            return 1.0
        if judged.score[0] == len(self.plays) + 1:  # it loses under the attack alone
            return 1.0 + judged.score[1]
        return self.share(policy, self.plays)


class ByAttack(ByEpisodes):
    """Judges by an attack first, which finds noise that keeps a robot in a corner: where samples take long.

    The score is the mean of two shares: of episodes that are won without noise, and of starts from which an
    attack does not break the policy. If it loses none of them the score of the noisy episodes follows. A
    policy that wins too few of the first is not attacked, as if it were broken from everywhere. The attack
    stands for the adversary of the episodes, whose looking ahead takes too long here.
    """

    without = KINDS[-1]

    def _prepare(self, policy: Policy | None) -> None:
        super()._prepare(policy)
        self.enough = (1.0, *self.enough)
        self.nearly = (1 - self.settings.may_break,)

    def _attacked(self) -> np.ndarray:
        """Returns the starts (n, d) of the attack.

        Half of them lie where modes meet, where a mode may have to go against its neighbours. A robot with
        speed of its own could not begin at rest everywhere there.
        """
        near = self._meets(self.nodes)
        half = ATTACKED // 2 if len(near) else 0
        if not half:
            return super()._attacked()
        rng = np.random.default_rng(1)
        there = self.grid.around(rng.choice(near, half), rng)
        return np.vstack([self.begins[: ATTACKED - half], there])

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        quiet = [self.play(policy, k, game.NO_NOISE)[0] for k in range(self.count)]
        lost = np.concatenate([self.lost_nodes(k, won) for k, won in enumerate(quiet)])
        weight, won = np.ones(len(lost)), float(np.concatenate(quiet).mean())
        if won < self.settings.worth_attacking:
            return Judged((won / 2, 0.0, -1.0), False, lost, weight)
        withstood = 1 - float(self.lost_under_attack(policy).mean())
        both = (won + withstood) / 2
        if both < 1:
            return Judged((both, 0.0, -1.0), False, lost, weight)
        noisy = self.by_plays(policy, self.plays)
        return replace(noisy, score=(1.0, *noisy.score))

    def won(self, policy: Policy) -> float:
        """Returns the share that a policy wins, which is no larger than what the attack leaves of it."""
        score = self(policy)
        if score[:2] == self.enough[:2]:
            return 1.0  # the same episodes
        return min(score[0], self.share(policy, self.plays))


class ByShare(Episodes):
    """Judges by the share of noisy episodes that are won, for a task with a reward for each mode.

    Such a task is trained from all of its starts, and may draw episodes that no policy wins. The episodes are
    those of the last batch. Every training suffices: another would draw other episodes, and win about as
    many.
    """

    enough: Score = (1.0,)
    settled = 0.75

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        share = self.share(policy, [(len(self.batches) - 1, kind) for kind in KINDS[:-1]])
        return Judged((share,), twin is None or share >= twin - self.settings.alike)

    def won(self, policy: Policy) -> float:
        return self(policy)[0]

    def note_losses(self, policy: Policy) -> None:
        """All starts of a task need no such note."""

    def domain(self, gamma: float) -> Domain:
        """Returns the domain of training: its reward leads the mode's way from anywhere."""
        return Domain(self.task.starts, caution=self.caution)
