"""What a run has made: its first policy, HyRL, and the parts of HyRL alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, Unfit, register
from hyrl_mj.policies import HybridController
from hyrl_mj.sets import GridSet
from hyrl_mj.stages import ExtendedSets, HeldInputs, Partition, part_policies, table_for


@register
class StageOne(Alternative):
    """The policy of stage 1, trained without noise."""

    name = "policy"
    title = "RL policy"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        yield Candidate("as trained", given.run.controllers["policy"], given.first)


@register
class Hyrl(Alternative):
    """The hybrid controller of all stages."""

    name = "hyrl"
    title = "HyRL"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        yield Candidate("as made", given.run.controllers["hyrl"], given.samples)


@register
class HysteresisAlone(Alternative):
    """HyRL's sets; each mode continues what the policy of stage 1 decides on its part."""

    name = "hysteresis"
    title = "hysteresis alone"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        run, task = given.run, given.task
        if len(run.extended_sets.modes) < 2:
            raise Unfit("the run has one mode, so that nothing is switched")
        own = run.controller
        policies = part_policies(task, run.steady, run.partition, given.eps)
        yield Candidate(
            "stages 1 to 5", HybridController(task, policies, own.flow_sets, own.starts)
        )


def one_mode(given: Given) -> tuple[ExtendedSets, Partition]:
    """Returns the sets and the partition of a single mode, which is the whole chart."""
    grid = given.run.extended_sets.sets[0].grid
    everywhere = np.ones(len(grid.nodes), dtype=bool)
    whole = GridSet.from_mask(grid, everywhere)
    d = given.task.chart.dimension
    sets = ExtendedSets(
        (0,), (whole,), (everywhere,), 0.0, given.eps, np.empty((0, d)), np.empty(0)
    )
    return sets, Partition((0,), (whole,), everywhere)


@register
class RetrainingAlone(Alternative):
    """One policy for all of the chart, trained as stage 6 trains those of modes, without a switch."""

    name = "retraining"
    title = "stage 6 alone"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        from hyrl_mj.stages.grounds import mode_ground
        from hyrl_mj.stages.retraining import retrain, start_policy

        task, s, steady = given.task, given.run.settings, given.run.steady
        if task.for_mode(0) is not task:
            raise Unfit("the task has a reward for each mode, and one policy has no mode")
        sets, parts = one_mode(given)
        shaped = given.run.arrivals.shaped
        ground = mode_ground(task, sets, 0, parts, steady, False, s.modes, s.attack, shaped)
        each = min(s.stage6.samples, given.samples)
        most = min(s.stage6.attempts, given.samples // each)
        settings = replace(s.stage6, samples=each, attempts=most)
        warm = partial(start_policy, steady, parts)
        policy, result = retrain(ground, settings, given.seed, warm_start=warm)
        yield Candidate("all of the chart", policy, result.attempts * each)


@register
class TableAlone(Alternative):
    """One table of inputs for all of the chart, made as those of modes that stage 6 may make."""

    name = "table"
    title = "table without modes"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        sets, _ = one_mode(given)
        held = HeldInputs.from_sets(given.task, sets, given.run.settings.table)
        if held is None:
            raise Unfit(
                "a table takes a chart of at most two dimensions, few inputs, and an arrival that ends the "
                "episode"
            )
        yield Candidate("all of the chart", table_for(held, 0))
