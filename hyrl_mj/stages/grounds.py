"""Where the policy of one mode is trained, and who judges it (paper, Step 6)."""

from __future__ import annotations

import numpy as np

from hyrl_mj.gym_export import Domain
from hyrl_mj.judging import game
from hyrl_mj.learning import ModeSettings
from hyrl_mj.learning.training import Score
from hyrl_mj.policies import MlpPolicy, Policy
from hyrl_mj.sets import GridSet
from hyrl_mj.simulation import AnyNoise, AttackSettings
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.judges import (
    Attacked,
    ByAttack,
    ByEpisodes,
    ByGame,
    ByShare,
    Episodes,
    Judge,
    Judged,
)
from hyrl_mj.stages.mode_states import ModeStates
from hyrl_mj.stages.partition import Partition
from hyrl_mj.tasks import Task


def mode_ground(
    task: Task,
    extended: ExtendedSets,
    mode: int,
    parts: Partition | None = None,
    policy: Policy | None = None,
    table: bool = False,
    settings: ModeSettings = ModeSettings(),
    attacks: AttackSettings = AttackSettings(),
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
    """
    states = ModeStates(task, extended, mode, anywhere=table)
    judge: Judge
    if states.rewarded:
        judge, parts = ByShare(states, settings), None
    elif task.effort.attacked:
        judge = ByAttack(
            Attacked(Episodes(states, settings), attacks, meeting=True), settings, policy
        )
    elif game.Lattice.decides(task, states.grid):
        judge = ByGame(states, settings)
    else:
        episodes = Episodes(states, settings)
        attacked = Attacked(episodes, attacks, meeting=False)
        judge = ByEpisodes(episodes, settings, policy, attacked=attacked)
    part = None if parts is None else parts.parts[parts.modes.index(mode)]
    return ModeGround(states, judge, part, settings)


class ModeGround:
    """Where one mode has to win: draws starts from there, and has policies judged (a `Ground` of `train`).

    Args:
        states: the states from which the mode has to win.
        judge: who judges its policies.
        part: M_i of the mode; None where it earns its reward everywhere.
        settings: where trainings start.
    """

    def __init__(
        self, states: ModeStates, judge: Judge, part: GridSet | None, settings: ModeSettings
    ):
        self.states, self.judge, self.part, self.settings = states, judge, part, settings
        self.task, self.mode = states.task, states.mode
        self.noise: AnyNoise = judge.noise
        self.enough, self.settled = judge.enough, judge.settled
        self._latest: tuple[Policy, Judged] | None = None

    def note_losses(self, policy: Policy) -> None:
        """Notes where a policy loses, as its score does; all starts of a task need no such note."""
        if not self.states.rewarded:
            self(policy)

    def __call__(self, policy: Policy) -> Score:
        """Returns the score of a policy. Later starts are drawn where the latest policy has lost."""
        return self.judged(policy).score

    def judged(self, policy: Policy) -> Judged:
        """Returns what the judge says of a policy, which is not judged twice in turn."""
        if self._latest is None or self._latest[0] is not policy:
            self._latest = policy, self.judge.judge(policy)
        return self._latest[1]

    def suffices(self, policy: Policy) -> bool:
        """Returns whether no other training is needed."""
        return self.judged(policy).suffices

    def nearly_won(self, score: Score) -> bool:
        """Returns whether a score is so good that no training is expected to do better."""
        return score >= self.judge.nearly

    def won(self, policy: Policy) -> float:
        """Returns the share that a policy wins, as in `ModeResult`."""
        return self.judge.won(policy, self.judged(policy))

    def won_by_image(self, image: MlpPolicy, won: float) -> float | None:
        """Returns the share that a mirror image wins; None if it is too little.

        The policy that it is the image of wins the share `won` in its own mode.
        """
        self._latest = image, self.judge.judge(image, twin=won)
        return self.won(image) if self.suffices(image) else None

    def domain(self, gamma: float) -> Domain:
        """Returns the domain of training; leaving it costs the worst reward for ever.

        Beyond its part a mode earns nothing: there the task's reward leads to the other way, and it could
        pay to creep or to stay at the edge of the set, because the detour is long and returns are discounted.
        A mode with a reward of its own is trained from all starts of its task.
        """
        states, task = self.states, self.task
        caution = self.judge.margin * states.extended.eps * np.array(states.shares)
        if states.rewarded:
            return Domain(task.starts, caution=caution)
        exit_reward = task.worst_reward / (1 - gamma)
        earns = None if self.part is None else self.part.contains
        return Domain(self.starts, states.within.contains, exit_reward, caution, earns)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws n starts (n, d): where the game is lost, where the task starts, and all over."""
        states, settings = self.states, self.settings
        early = rng.random(n) < settings.task_share
        at = np.where(early, rng.choice(states.early, n), rng.choice(states.nodes, n))
        if self._latest is not None and len(self._latest[1].lost):
            judged = self._latest[1]
            weight = judged.weight / max(judged.weight.sum(), 1e-300)
            lost = rng.choice(judged.lost, n, p=weight)
            at = np.where(rng.random(n) < settings.lost_share, lost, at)
        return states.grid.around(at, rng)
