"""Environments with planted traps and honest ones: hyrl_mj runs each as it runs alone, or refuses it.

`python tests/trapped_environments.py 300 100` tries more of them, from more starts.
"""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from trapped_environments import both, honest, is_failure, judged, together, trapped
from traps.honest import HONEST
from traps.judge import difference, played
from traps.kinds import ALONE, TRAPS
from traps.worlds import World

import hyrl_mj

# Starts of each case here.
FEW = 2
# What only differs in the second episode of an instance, or only for those who run it otherwise than alone.
LATER = ("sticky success", "outlives resets")
HARMLESS = (
    "cached value", "order of a Dict", "no method observes", "success and collision terminate",
    "wrapper order", "frames and filters",
)  # fmt: skip
# Of traps that an environment is accepted with, two are in one, as some seed draws it.
TWO = {
    ("latch", "action delay"): 0,
    ("latch in the model", "initial motion"): 1,
    ("sticky success", "recalled input or observation"): 2,
    ("rare attribute", "wrapper order"): 0,
    ("stale fields", "order of a Dict"): 1,
    ("frames and filters", "success and collision terminate"): 0,
}
PAIRED = [name for pair in TWO for name in pair]
# What is honest, each once: what lies around an environment, and what is in it.
TOGETHER = (
    (("hinge",), *HONEST[1:4], *HONEST[5:7], HONEST[9]),
    (ALONE, HONEST[0], HONEST[4], *HONEST[7:9]),
)


def tried(case):
    """What is wrong with how hyrl_mj runs a case; "" if nothing is."""
    verdict, why = judged(case, FEW)
    return f"{case.name} ({', '.join(case.traps)}): {verdict}: {why}" * is_failure(
        case.traps, verdict
    )


def later(values):
    """Cases that only the long lane tries."""
    return [pytest.param(value, marks=pytest.mark.long) for value in values]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*(name for name in TRAPS if name not in PAIRED), *later(PAIRED)])
def test_no_trap_is_wrong_in_silence(name):
    assert not tried(trapped(2 * [*TRAPS].index(name)))


@pytest.mark.first(2)
@pytest.mark.slow
@pytest.mark.parametrize("pair", TWO, ids=", ".join)
def test_two_traps_in_one_environment_are_accepted_and_right(pair):
    assert judged(both(*pair, TWO[pair]), FEW) == ("right", "")


@pytest.mark.slow
@pytest.mark.parametrize("i", later(range(len(HONEST))))
def test_honest_environments_are_accepted_and_right(i, all_trials):
    assert not tried(honest(i))


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize(("kinds", "plants"), [(kinds, plants) for kinds, *plants in TOGETHER])
def test_whatever_is_honest_is_accepted_and_right_together(kinds, plants, all_trials):
    assert not tried(together(kinds, *plants))


# ---- traps and judge themselves, which only the long lane tries


def runs_of(case, env=None):
    """The truth from some starts, with both agents, under noise; in one environment if it is given."""
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, (case.steps + 2, case.pilot.plan.dimension))
    return [
        played(case, agent, z0, noise, env=env)
        for agent in (case.pilot, case.other)
        for z0 in case.starts[:FEW]
    ]


def differ(some, others):
    return any(
        a.z.shape != b.z.shape or (a.z != b.z).any() or a.outcome != b.outcome
        for a, b in zip(some, others, strict=True)
    )


def alone(name):
    """The first cases that have one trap, and no wrapper."""
    first = 2 * [*TRAPS].index(name)
    cases = [trapped(first + 2 * len(TRAPS) * i) for i in range(8)]
    return [case for case in cases if not isinstance(case.factory(), gym.Wrapper)]


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in TRAPS if name not in (*LATER, *HARMLESS)])
def test_traps_change_what_happens(name):
    def is_changed(case):
        kind = type(case.factory().unwrapped)
        plain = replace(case, factory=type("Plain", (World,), {"plan": kind.plan}))
        if case.factory().observation_space != plain.factory().observation_space:
            return True
        return differ(runs_of(case), runs_of(plain))

    assert any(is_changed(case) for case in alone(name))


@pytest.mark.long
@pytest.mark.parametrize("name", LATER)
def test_some_traps_change_the_next_episode(name):
    def is_changed(case):
        env = case.factory()
        return differ(runs_of(case, env), runs_of(case))

    assert any(is_changed(case) for case in alone(name))


@pytest.mark.long
def test_the_judge_notices_any_difference():
    case = honest(0)
    task = hyrl_mj.from_gymnasium(case.factory, **case.given)
    arc = hyrl_mj.simulate(task, hyrl_mj.from_callable(case.pilot, task), case.starts[0])
    still = np.zeros((case.steps + 2, case.pilot.plan.dimension))
    run = played(case, case.pilot, case.starts[0], still)
    assert difference(arc, run) == ""
    assert "in truth" in difference(arc, replace(run, outcome="unstable"))
    assert "the last sample" in difference(arc, replace(run, t=2 * run.t))
    assert "samples" in difference(arc, replace(run, t=run.t[:-1], z=run.z[:-1], u=run.u[:-1]))
    for name, k in (("z", 1), ("u", 0)):
        moved = getattr(run, name).copy()
        moved[k] += 1e-6
        assert f"{name} at sample {k}" in difference(arc, replace(run, **{name: moved}))
