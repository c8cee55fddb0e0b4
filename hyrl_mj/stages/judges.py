"""The judges of stage 6: by the worst-case game, by noisy episodes, by an attack, or by the share won."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import Protocol

import numpy as np

from hyrl_mj.judging import Budget, attack, game
from hyrl_mj.learning import ModeSettings
from hyrl_mj.learning.training import Score
from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.sets import distance_to
from hyrl_mj.simulation import (
    KINDS,
    SENSOR,
    AttackSettings,
    LoopSettings,
    Noise,
    Sensor,
    closed_loop,
    covers_sensor,
)
from hyrl_mj.stages.mode_states import ModeStates
from hyrl_mj.tasks import Outcome

# Starts from which a policy is attacked.
ATTACKED = 64
# A number of a batch, and the kind of noise that it is played with.
Play = tuple[int, str]


@dataclass(frozen=True)
class Judged:
    """What a judge says of a policy.

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


class Judge(Protocol):
    """Says how good the policies of a mode are.

    Attributes:
        enough: score with which a training may end.
        nearly: score with which no training is expected to do better; none by default.
        settled: share of a training after which scores count.
        noise: noise on the measurements during training.
        margin: noise of so many times the bound has to be survived.
    """

    enough: Score
    nearly: Score = (np.inf,)
    settled: float = 0.0
    noise: Noise
    margin: float

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        """Judges a policy; `twin` is the share that its mirror image wins, if it is the image of one."""

    def won(self, policy: Policy, judged: Judged) -> float:
        """Returns the share that a policy wins, as in `ModeResult`, from what `judge` said of it."""


class ByGame(Judge):
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

    def __init__(self, states: ModeStates, settings: ModeSettings):
        self.states, self.settings = states, settings
        self.lattice = game.Lattice.tabulate(states.task, states.within.regular)
        after = self.lattice.after
        inside = np.append(states.within.mask, [True, False])[after]
        fewest, _ = game.fewest_samples(self.lattice, after, inside)
        self.fewest = int(fewest[states.nodes][fewest[states.nodes] < game.NEVER].max(initial=0))

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        states, settings = self.states, self.settings
        answers, moves = self._moves(policy)
        value = game.solve(moves)[0, :-2]
        lost = np.flatnonzero(states.wanted & (value >= game.NEVER))
        if len(lost):
            samples = np.where(value > game.NEVER, game.LOST - value, states.task.max_steps)[lost]
            elsewhere = len(lost) <= settings.few * len(states.nodes)
            elsewhere = elsewhere and not states.selected[lost].any()
            score = -len(lost) / len(states.nodes), -np.inf
            return Judged(score, elsewhere, lost, np.maximum(samples, 1.0) ** settings.urgency)
        delay = (value[states.nodes].max() / max(self.fewest, 1) - 1) / settings.allowed_delay
        miss = self._miss(answers, moves) / states.task.precision
        score = 0.0, -float(max(delay, miss))
        return Judged(score, score >= self.enough)

    def won(self, policy: Policy, judged: Judged) -> float:
        _, moves = self._moves(policy)
        value = game.solve(moves, self.states.task.max_steps)[0, :-2]
        return float((value[self.states.nodes] < game.NEVER).mean())

    def _moves(self, policy: Policy) -> tuple[game.Answers, game.Moves]:
        """Returns the answers of a policy, and the moves of the noise."""
        bound = self.states.bound
        answers = game.Answers.ask(self.lattice, PolicyController(policy), bound)
        return answers, game.noisy_moves(answers, bound)

    def _miss(self, answers: game.Answers, moves: game.Moves) -> float:
        """Returns the miss, from the answers of a policy and the moves of the noise."""
        states, task = self.states, self.states.task
        grid, after = self.lattice.grid, self.lattice.after
        still = game.lasting(moves, states.wanted)
        if still.any():
            return float(task.miss(grid.nodes[still]).max() - states.bound.max())
        # Follow the runs without noise to their last nodes on the chart; the next sample ends most of them.
        # The answers of a controller with one mode are levels.
        level = answers.index[0][answers.middle].ravel()
        last = states.early
        for _ in range(task.max_steps):
            place = after[level[last], 0, last]
            last = np.unique(np.where(place < self.lattice.nodes, place, last))
        plant = task.plant(len(last))
        plant.set_state(*task.state(grid.nodes[last]))
        plant.step(self.lattice.levels[level[last]])
        ends = np.vstack([grid.nodes[last], task.z(plant.measurement)])
        return float(task.miss(ends).max())


class Episodes:
    """Noisy episodes in batches, which start where the hybrid controller may select the mode.

    Attributes:
        starts: (n, d) starts of the episodes.
        batches: the rows of each batch.
        margin: the noise is so many times as large as the bound.
        kinds: the kinds of noise that the episodes may have.
        noise: the noise during training: what the task's own sensor does, if that is late.
        count: number of batches that the task's effort allows.
    """

    def __init__(self, states: ModeStates, settings: ModeSettings):
        self.states, task = states, states.task
        sizes = settings.batches
        self.count = min(task.effort.batches, len(sizes))
        with np.errstate(divide="ignore"):
            most = (task.chart.sides / (2 * states.bound)).min()
        self.margin = min(settings.margin, (1 + most) / 2)  # noise must not hide the whole chart
        bound = self.margin * states.extended.eps
        self.kinds = (*KINDS, SENSOR) if covers_sensor(task, bound) else KINDS
        # A late sensor is late in every column, also in those that the bound says nothing about.
        late = SENSOR in self.kinds and Sensor.parse(task.sensor).late
        self.noise = Noise(SENSOR if late else "uniform", bound)
        picked = states.early[states.selected[states.early]]
        rng, episodes = np.random.default_rng(0), sum(sizes)
        # More than are needed: those too close to where the mode cannot succeed are left out.
        first = rng.choice(picked if len(picked) else states.early, 4 * episodes)
        z = states.grid.around(first, rng)
        # A start may be lost for any policy if not all nodes around it are wanted.
        sure = np.flatnonzero(states.grid.interpolate(states.wanted.astype(float), z) > 1 - 1e-9)
        self.starts = z[np.resize(sure if len(sure) else np.arange(len(z)), episodes)]
        self.batches = np.split(np.arange(episodes), np.cumsum(sizes)[:-1])
        self._plants = {n: task.plant(n) for n in set(sizes)}

    def play(self, policy: Policy, batch: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns which episodes of a batch are won (k,), and how far off they end (k,).

        Without noise they have to end at the set-point, under noise they have to survive.
        """
        rows, states, task = self.batches[batch], self.states, self.states.task
        settings = LoopSettings(plant=self._plants[len(rows)], vary=True, quiet=True)
        noise, controller = Noise(kind, self.noise.bound), PolicyController(policy)
        starts, noisy = self.starts[rows], task.with_noise(states.shares)
        run = closed_loop(noisy, controller, starts, noise, seed=int(rows[0]), settings=settings)
        ends, won = run.path[-1], run.outcome == Outcome.REACHED
        won = won & task.arrived(ends) if kind == game.NO_NOISE else won
        return won, task.miss(ends)

    def share(self, policy: Policy, plays: Sequence[Play]) -> float:
        """Returns the share of the episodes of plays that a policy wins."""
        return float(np.concatenate([self.play(policy, *play)[0] for play in plays]).mean())

    def nodes(self, batch: int, won: np.ndarray) -> np.ndarray:
        """Returns the nodes (l,) next to those starts of a batch that are not won (k,) bool."""
        return self.states.grid.nearest(self.starts[self.batches[batch]][~won])


class Attacked:
    """An attack on the policies of a mode, within the noise of its noisy episodes.

    What is reported comes from the attack of the examination: other starts, another seed, more rounds.

    Args:
        episodes: the episodes.
        attacks: what signals are tried.
        meeting: whether half of the starts are where modes meet, where a mode may have to go against its
            neighbours. A robot with speed of its own cannot begin at rest everywhere there.

    Attributes:
        starts: (n, d) starts of the attack, the others of which are those of episodes.
    """

    def __init__(self, episodes: Episodes, attacks: AttackSettings, meeting: bool):
        self.episodes, self.attacks, states = episodes, attacks, episodes.states
        task, grid = states.task, states.grid
        off = distance_to(task.chart, states.extended.points, grid.nodes[states.nodes])
        near = states.nodes[off <= 2 * float(np.linalg.norm(states.bound / task.chart.scale))]
        half = ATTACKED // 2 if meeting and len(near) else 0
        self.starts = episodes.starts[: ATTACKED - half]
        if half:
            rng = np.random.default_rng(1)
            self.starts = np.vstack([self.starts, grid.around(rng.choice(near, half), rng)])

    def lost(self, policy: Policy) -> np.ndarray:
        """Returns whether a policy loses from the starts (n,), without noise or under a signal."""
        states = self.episodes.states
        found = attack(
            states.task.with_noise(states.shares),
            {"mode": PolicyController(policy)},
            self.starts,
            self.episodes.noise.bound,
            Budget(rounds=1),
            seed=20_220_608,
            settings=self.attacks,
        )["mode"]
        return found.quiet.lost | found.ends.lost


class ByEpisodes(Judge):
    """Judges by noisy episodes and an attack, where the worst case cannot be computed.

    The score is the number of plays that stop no episode, then minus the share of episodes that the next play
    stops; if none is stopped, minus the largest distance from the set-point at the end without noise, as a
    multiple of `allowed`. The last play is the attack: a bias of its whole length is what few episodes draw.
    The mirror image of a policy that wins all of its own mode has been judged there, so the first three
    batches tell.

    Args:
        episodes: the episodes.
        settings: when a policy is good enough.
        policy: the stage-1 policy, which shows how close to the set-point a run can end.
        attacked: the attack; None if another judge attacks.
        without: a kind of noise that no episode has.

    Attributes:
        allowed: allowed distance from the set-point at the end of episodes without noise [chart units].
    """

    def __init__(
        self,
        episodes: Episodes,
        settings: ModeSettings,
        policy: Policy | None,
        attacked: Attacked | None = None,
        without: str = "",
    ):
        self.episodes, self.attacked = episodes, attacked
        kinds = [kind for kind in episodes.kinds if kind != without]
        self.noise, self.margin = episodes.noise, episodes.margin
        count = episodes.count
        # Each batch is played with all kinds of noise before the next.
        self.plays: list[Play] = [*product(range(count), kinds)]
        self.few_plays = self.plays[: 3 * len(kinds)]
        self.enough: Score = (float(len(self.plays) + (attacked is not None)), -1.0)
        # As close as the stage-1 policy ends where it arrives, if it does.
        quiet = [episodes.play(policy, k, game.NO_NOISE) for k in range(count)] if policy else []
        ends = np.concatenate([np.empty(0), *(miss[won] for won, miss in quiet)])
        farthest, task = float(ends.max(initial=0.0)), episodes.states.task
        if np.isfinite(task.precision):
            self.allowed = max(farthest, task.precision)
        else:
            close = settings.miss_share * task.close if len(ends) else task.close
            self.allowed = max(settings.allowed_miss * farthest, close)

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        farthest, plays = 0.0, self.few_plays if twin == 1 else self.plays
        for survived, (batch, kind) in enumerate(plays):
            won, miss = self.episodes.play(policy, batch, kind)
            farthest = max(farthest, miss.max()) if kind == game.NO_NOISE else farthest
            if not won.all():
                return self._lost(survived, ~won, self.episodes.nodes(batch, won))
        survived = len(plays)
        if self.attacked is not None and twin != 1:
            lost = self.attacked.lost(policy)
            if lost.any():
                nodes = self.episodes.states.grid.nearest(self.attacked.starts[lost])
                return self._lost(survived, lost, nodes)
            survived += 1
        score = float(survived), -farthest / self.allowed
        return Judged(score, score[1] >= -1.0)

    def _lost(self, survived: int, lost: np.ndarray, nodes: np.ndarray) -> Judged:
        """Returns that the play after those survived loses some of its starts (k,) bool, at nodes (l,)."""
        return Judged((float(survived), -float(lost.mean())), False, nodes, np.ones(len(nodes)))

    def won(self, policy: Policy, judged: Judged) -> float:
        if not len(judged.lost):
            return 1.0
        if judged.score[0] == len(self.plays):  # it loses under the attack alone
            return 1.0 + judged.score[1]
        return self.episodes.share(policy, self.plays)


class ByAttack(Judge):
    """Judges by an attack first, which finds noise that keeps a robot in a corner: where samples take long.

    The score is the mean of two shares: of episodes that are won without noise, and of starts from which an
    attack does not break the policy. If it loses none of them the score of the noisy episodes follows. A
    policy that wins too few of the first is not attacked, as if it were broken from everywhere. The attack
    stands for the adversary of the episodes, whose looking ahead takes too long here.
    """

    def __init__(self, attacked: Attacked, settings: ModeSettings, policy: Policy | None):
        self.attacked, self.settings = attacked, settings
        self.noisy = ByEpisodes(attacked.episodes, settings, policy, without=KINDS[-1])
        self.noise, self.margin = self.noisy.noise, self.noisy.margin
        self.enough: Score = (1.0, *self.noisy.enough)
        self.nearly: Score = (1 - settings.may_break,)

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        episodes = self.attacked.episodes
        quiet = [episodes.play(policy, k, game.NO_NOISE)[0] for k in range(episodes.count)]
        lost = np.concatenate([episodes.nodes(k, won) for k, won in enumerate(quiet)])
        weight, won = np.ones(len(lost)), float(np.concatenate(quiet).mean())
        if won < self.settings.worth_attacking:
            return Judged((won / 2, 0.0, -1.0), False, lost, weight)
        withstood = 1 - float(self.attacked.lost(policy).mean())
        both = (won + withstood) / 2
        if both < 1:
            return Judged((both, 0.0, -1.0), False, lost, weight)
        noisy = self.noisy.judge(policy)
        return Judged((1.0, *noisy.score), noisy.suffices, noisy.lost, noisy.weight)

    def won(self, policy: Policy, judged: Judged) -> float:
        """Returns the share that a policy wins, which is no larger than what the attack leaves of it."""
        if judged.score[:2] == self.enough[:2]:
            return 1.0  # the same episodes
        share = self.noisy.episodes.share(policy, self.noisy.plays)
        return min(judged.score[0], share)


class ByShare(Judge):
    """Judges by the share of noisy episodes that are won, for a task with a reward for each mode.

    Such a task is trained from all of its starts, and may draw episodes that no policy wins. The episodes are
    those of the last batch. Every training suffices: another would draw other episodes, and win about as
    many.
    """

    enough: Score = (1.0,)
    settled = 0.75

    def __init__(self, states: ModeStates, settings: ModeSettings):
        self.settings, self.episodes = settings, Episodes(states, settings)
        self.noise, self.margin = self.episodes.noise, self.episodes.margin
        self._plays = [(len(settings.batches) - 1, kind) for kind in KINDS[:-1]]

    def judge(self, policy: Policy, twin: float | None = None) -> Judged:
        share = self.episodes.share(policy, self._plays)
        return Judged((share,), twin is None or share >= twin - self.settings.alike)

    def won(self, policy: Policy, judged: Judged) -> float:
        return judged.score[0]
