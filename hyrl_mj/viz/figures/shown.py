"""What the figures show: results of a run, cut to the section of its chart that can be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hyrl_mj.game import GameResult, Maps
from hyrl_mj.policies import Policy
from hyrl_mj.run_directory import Run
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets, Partition
from hyrl_mj.tasks import Task
from hyrl_mj.viz.arcs import overview_arcs, policy_start_arcs
from hyrl_mj.viz.section import Section


@dataclass(frozen=True)
class ShownPolicy:
    """What the figures of a stage-1 policy show.

    Attributes:
        task: in the section.
        algorithm: that trained the policy, "DQN".
        policy: of stage 1, at its mean or mode where it is sampled.
        critical: M*.
        partition: the parts M_i.
        noisy: a run under noise, from M* if there is one.
        noiseless: runs from starts all along the start region.
        paper: runs from the scene's starts of the policy, under the paper's noise.
    """

    task: Task
    algorithm: str
    policy: Policy
    critical: CriticalSet
    partition: Partition
    noisy: HybridArc
    noiseless: tuple[HybridArc, ...]
    paper: tuple[HybridArc, ...]

    @property
    def policy_title(self) -> str:
        """What legends call the policy: "RL policy (DQN)"."""
        return f"RL policy ({self.algorithm})"


@dataclass(frozen=True)
class ShownRun(ShownPolicy):
    """What the figures of a finished run show: its policy, and its hybrid controller.

    Attributes:
        whole: the task with all of its chart.
        sets: M_ext_i.
        replays: arcs on the whole chart by start ("start0", ..., "critical") and controller ("policy",
            "hyrl_q0", ...), under the same noise.
    """

    whole: Task
    sets: ExtendedSets
    replays: Mapping[tuple[str, str], HybridArc]


@dataclass(frozen=True)
class ShownGame:
    """What the figures of the worst-case game show.

    Attributes:
        task: what was played; its chart has two coordinates, or one.
        critical: M*.
        result: the scores, margins and curves.
        maps: the class of every node.
    """

    task: Task
    critical: CriticalSet
    result: GameResult
    maps: Maps


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
        section.arc(noisy),
        tuple(overview_arcs(section, run.steady)),
        tuple(policy_start_arcs(section, run.steady, s.noise, s.seed)),
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
    return ShownRun(**vars(policy), whole=run.task, sets=sets, replays=arcs)
