"""What the figures show: results of a run, cut to the section of its chart that can be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hyrl_mj.judging.game import GameResult, Maps
from hyrl_mj.policies import Policy
from hyrl_mj.runs.arcs import overview_arcs, policy_start_arcs
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets, Partition
from hyrl_mj.tasks import Task
from hyrl_mj.viz.section import Section


@dataclass(frozen=True)
class ShownPolicy:
    """What the figures of a stage-1 policy show.

    Attributes:
        section: of the chart that is drawn, of a chart of one or two dimensions all of it.
        algorithm: that trained the policy, "DQN".
        policy: of stage 1, at its mean or mode where it is sampled.
        critical: M* in the section.
        partition: the parts M_i in the section.
        noisy: a run under noise, from M* if there is one.
        noiseless: runs from starts all along the start region.
        paper: runs from the scene's starts of the policy, under the paper's noise.
    """

    section: Section
    algorithm: str
    policy: Policy
    critical: CriticalSet
    partition: Partition
    noisy: HybridArc
    noiseless: tuple[HybridArc, ...]
    paper: tuple[HybridArc, ...]

    @property
    def task(self) -> Task:
        """The task, with all of its chart."""
        return self.section.task

    @property
    def policy_title(self) -> str:
        """What legends call the policy: "RL policy (DQN)"."""
        return f"RL policy ({self.algorithm})"


@dataclass(frozen=True)
class ShownRun(ShownPolicy):
    """What the figures of a finished run show: its policy, and its hybrid controller.

    Attributes:
        sets: M_ext_i in the section.
        replays: arcs by start ("start0", ..., "critical") and controller ("policy",
            "hyrl_q0", ...), under the same noise.
    """

    sets: ExtendedSets
    replays: Mapping[tuple[str, str], HybridArc]


@dataclass(frozen=True)
class ShownGame:
    """What the figures of the worst-case game show.

    Attributes:
        section: of the chart that is drawn.
        critical: M* in the section.
        result: the scores, margins and curves.
        maps: the class of every node in the section.
    """

    section: Section
    critical: CriticalSet
    result: GameResult
    maps: Maps

    @property
    def task(self) -> Task:
        """The task, with all of its chart."""
        return self.section.task


def shown_policy(run: Run, noisy: HybridArc) -> ShownPolicy:
    """Returns what the figures of a run's policy show; simulates the arcs that no stage has saved.

    The run needs its critical set and partition. `noisy` is a run of the policy under noise, from M* if
    there is one.
    """
    section, s = Section(run.task), run.settings
    return ShownPolicy(
        section,
        s.stage1.title,
        run.steady,
        section.critical_set(run),
        section.partition(run.partition),
        noisy,
        tuple(overview_arcs(run.task, run.steady)),
        tuple(policy_start_arcs(run.task, run.steady, s.eps, s.seed)),
    )


def shown_game(run: Run, result: GameResult, maps: Maps) -> ShownGame:
    """Returns what the figures of a run's game show."""
    section = Section(run.task)
    return ShownGame(section, section.critical_set(run), result, section.maps(maps))


def shown_run(run: Run) -> ShownRun:
    """Returns what the figures of a run show; its replays have been simulated."""
    arcs, sets = run.arcs(), Section(run.task).extended_sets(run.extended_sets)
    start = "critical" if ("critical", "policy") in arcs else "start0"
    policy = shown_policy(run, arcs[start, "policy"])
    return ShownRun(**vars(policy), sets=sets, replays=arcs)
