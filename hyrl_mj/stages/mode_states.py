"""The states from which the policy of one mode has to win (paper, Step 6)."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from hyrl_mj.sets import GridSet
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.tasks import Task


class ModeStates:
    """All states whose measurement can lie in M_ext_i and from which the mode can still succeed.

    Args:
        task: the robot and its problem.
        extended: M_ext_i and W_i.
        mode: the mode.
        anywhere: whether the mode may succeed from everywhere in its set, also outside of W_i.

    Attributes:
        task: the task of the mode.
        rewarded: whether that has a reward of its own, which leads the mode's way from anywhere.
        shares: share of the noise bound on each noisy coordinate.
        bound: (d,) largest error of a measured chart point, along each coordinate.
        within: M_ext_i, widened by it.
        wanted: (N,) bool, the nodes of the set's grid that are such states.
        nodes: (n,) the indices of these nodes.
        early: (k,) those of them where an episode may start; all if there are none.
    """

    def __init__(self, task: Task, extended: ExtendedSets, mode: int, anywhere: bool):
        self.task, self.extended, self.mode = task.for_mode(mode), extended, mode
        self.rewarded = self.task is not task
        self.shares = tuple(float(share) for share in self.task.noisy)
        self.bound = task.noise_in_chart(extended.eps)
        index = extended.modes.index(mode)
        self.within = extended.sets[index].dilated_by_box(self.bound)
        self.grid = self.within.grid
        possible = self.within.mask & task.goes_on(self.grid.nodes)
        wins = possible & extended.winning[index]
        # Where the stage-1 policy never succeeds, training may still find a way.
        self.wanted = possible if anywhere or not wins.any() else wins
        self.nodes = np.flatnonzero(self.wanted)
        early = self.nodes[task.may_start(self.grid.nodes[self.nodes])]
        self.early = early if len(early) else self.nodes

    @cached_property
    def selected(self) -> np.ndarray:
        """The nodes (N,) bool at which the hybrid controller may select the mode: its set is the deepest."""
        depth = np.stack([s.values for s in self.extended.sets])
        own = depth.argmin(axis=0) == self.extended.modes.index(self.mode)
        return GridSet.from_mask(self.grid, own).dilated_by_box(self.bound).mask
