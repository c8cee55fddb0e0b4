"""What the figures show: results of a run, cut to the section of its chart that can be drawn."""

from __future__ import annotations

from functools import cached_property

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game import GameResult, Maps
from hyrl_mj.policies import Policy
from hyrl_mj.runs.arcs import overview_arcs, policy_start_arcs
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets, Partition
from hyrl_mj.viz.section import Section


class Shown:
    """What the figures of a run show, which is read, or simulated where no stage has saved it, when needed.

    Args:
        run: whose stages that a figure shows are finished.
        noisy: a run of the policy under noise, from M* if there is one; by default the replay.
        game, maps: the worst-case game and the class of every node; by default those of the run.

    Attributes:
        task: the task, with all of its chart.
        section: of the chart that is drawn, of a chart of one or two dimensions all of it.
        algorithm: that trained the policy, "DQN".
        policy_title: what legends call the policy: "RL policy (DQN)".
        replays: arcs by start ("start0", ..., "critical") and controller ("policy", "hyrl_q0", ...), under
            the same noise.
    """

    def __init__(
        self,
        run: Run,
        noisy: HybridArc | None = None,
        game: GameResult | None = None,
        maps: Maps | None = None,
    ):
        self._run, self.task, self.section = run, run.task, Section(run.task)
        self.algorithm, self.policy_title = run.settings.stage1.title, run.policy_title
        self._noisy, self._game, self._maps = noisy, game, maps

    @cached_property
    def policy(self) -> Policy:
        """The policy of stage 1, at its mean or mode where it is sampled."""
        return self._run.steady

    @cached_property
    def critical(self) -> CriticalSet:
        """M* in the section."""
        return self.section.critical_set(self._run)

    @cached_property
    def partition(self) -> Partition:
        """The parts M_i in the section."""
        return self.section.partition(self._run.partition)

    @cached_property
    def noisy(self) -> HybridArc:
        """A run of the policy under noise, from M* if there is one."""
        if self._noisy is not None:
            return self._noisy
        start = "critical" if ("critical", "policy") in self.replays else "start0"
        return self.replays[start, "policy"]

    @cached_property
    def noiseless(self) -> list[HybridArc]:
        """Runs of the policy from starts all along the start region."""
        return overview_arcs(self.task, self.policy)

    @cached_property
    def paper(self) -> list[HybridArc]:
        """Runs of the policy from the scene's starts, under the paper's noise."""
        s = self._run.settings
        return policy_start_arcs(self.task, self.policy, s.eps, s.seed)

    @cached_property
    def sets(self) -> ExtendedSets:
        """The extended sets M_ext_i in the section."""
        return self.section.extended_sets(self._run.extended_sets)

    @cached_property
    def replays(self) -> dict[tuple[str, str], HybridArc]:
        return self._run.arcs()

    @cached_property
    def result(self) -> GameResult:
        """The scores, margins and curves of the worst-case game; raises `BadInput` if none is played."""
        if (game := self._game or self._run.robustness.game) is None:
            raise BadInput(
                f"there is no map and no curve: no game is played, because {self._run.why_no_game}"
            )
        return game

    @cached_property
    def maps(self) -> Maps:
        """The class of every node in the section."""
        return self.section.maps(self._maps or self._run.maps)
