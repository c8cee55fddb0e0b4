"""An agent that is no function of what it sees is refused by name, wherever it is examined."""

import numpy as np
import pytest
import torch
from planted import sign_policy
from trapped import HONEST, TRAPS

import hyrl_mj
from hyrl_mj import BadInput, Noise, simulate
from hyrl_mj.policies.external import read_agent

TASKS = ("unit_circle", "vehicle")


def steering(task):
    """An agent that steers by what it sees, at more than two inputs."""

    def act(o):
        turn = np.tanh(3 * o[:, -1:])
        if task.input_levels is None:
            return turn
        return np.rint((turn[:, 0] + 1) / 2 * (len(task.input_levels) - 1)).astype(int)

    return act


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("trap", TRAPS)
def test_who_answers_otherwise_is_refused_with_both_answers(trap, name):
    task = hyrl_mj.get_task(name)
    read_agent(task, steering(task))
    with pytest.raises(
        BadInput,
        match=r"the function answers the measurement \(.*\) with \(.*\) and, .*, "
        r"with \(.*\): give one whose answer .* without chance or memory",
    ):
        read_agent(task, TRAPS[trap](steering(task), task))


def turning(observation):
    """An agent of the vehicle whose answer changes as it drives."""
    return np.rint(2 + 2 * np.sin(5 * observation.sum(axis=1))).astype(int)


IN_LOOPS = ("holds_six", "filters", "delays", "draws", "normalises_running", "counts")


@pytest.mark.parametrize("trap", IN_LOOPS)
@pytest.mark.parametrize("starts", [1, 20])
def test_a_closed_loop_notices_it_too(trap, starts, vehicle):
    """From one start, too, and without a trial before."""
    z0 = np.random.default_rng(0).uniform((0, 0.3), (0.2, 0.4), (starts, 2))
    late = {"calls": 20} if trap == "counts" else {}
    simulate(vehicle, hyrl_mj.from_callable(turning, vehicle), z0, Noise("uniform", 0.1))
    agent = hyrl_mj.from_callable(TRAPS[trap](turning, vehicle, **late), vehicle)
    with pytest.raises(
        BadInput, match=r"the function answers .* and, (asked again later|in a batch)"
    ):
        simulate(vehicle, agent, z0, Noise("uniform", 0.1))


class Plain:
    """A policy of the user's own, which changes what it should not."""

    def __init__(self, task, spoils):
        self.policy, self.spoils, self.buffer = sign_policy(task), spoils, np.zeros((10_000, 1))

    def act(self, measured):
        u = self.policy.act(measured)
        if self.spoils == "input":
            measured *= 0.5
        if self.spoils == "answer":
            self.buffer[: len(u)] = u
            return self.buffer[: len(u)]
        if self.spoils == "shape" and (np.abs(measured[:, 1]) > 0.9).any():
            return u[:, 0]
        if self.spoils == "number":
            return np.where(measured[:, 1:] > 0.8, np.nan, u)
        if self.spoils == "error" and (measured[:, 1:] > 0.8).any():
            raise LookupError("no such place")
        return u


@pytest.mark.parametrize(
    ("spoils", "message"),
    [
        ("input", "changes the measurements that it is given"),
        ("answer", "changes an answer that it gave before"),
        ("shape", r"of shape \(1280,\) for 1280 measurements"),
        ("number", "not finite"),
        ("error", "raised LookupError"),
    ],
)
def test_what_else_a_policy_may_do_is_named(spoils, message, vehicle):
    read_agent(vehicle, Plain(vehicle, ""))
    with pytest.raises(BadInput, match=message):
        read_agent(vehicle, Plain(vehicle, spoils))


def test_a_function_with_a_buffer_of_its_own_is_taken(circle):
    """Its answers are copied before it is asked again, and what it is given is a copy."""
    buffer = np.zeros((10_000, 1))

    def act(o):
        o[:] = np.tanh(3 * o)
        buffer[: len(o)] = o[:, 1:]
        return buffer[: len(o)]

    read_agent(circle, act)


@pytest.mark.slow
@pytest.mark.parametrize("kind", HONEST)
def test_honest_agents_are_taken(kind):
    torch.set_num_threads(1)
    for seed in range(4):
        task = hyrl_mj.get_task(TASKS[seed % 2])
        agent = HONEST[kind](task, np.random.default_rng(seed))
        given = read_agent(task, agent)
        z0 = task.starts(10, np.random.default_rng(seed))
        simulate(task, given.policy, z0, Noise("uniform", 0.1))


@pytest.mark.slow
def test_two_traps_at_once_are_noticed_as_well(vehicle):
    torch.set_num_threads(1)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        agent = steering(vehicle)
        for trap in rng.choice(list(TRAPS), 2, replace=False):
            agent = TRAPS[trap](agent, vehicle)
        with pytest.raises(BadInput):
            read_agent(vehicle, agent)
