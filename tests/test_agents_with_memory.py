"""Agents with a memory that they declare close loops; who remembers anything else is refused by name."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from planted import sign_policy, spare
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecNormalize
from trapped import HONEST, TRAPS

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, Noise, from_callable, simulate
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.judging.game import Answers, Lattice
from hyrl_mj.policies import PolicyController, agent_at, memory_at_start
from hyrl_mj.policies.external import read_agent
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import LoopSettings, Programmes, Rules, closed_loop

TASKS = ("unit_circle", "vehicle")


def steering(task):
    """An agent that steers by what it sees, at more than two inputs."""

    def act(o):
        turn = np.tanh(3 * o[:, -1:])
        if task.input_levels is None:
            return turn
        return np.rint((turn[:, 0] + 1) / 2 * (len(task.input_levels) - 1)).astype(int)

    return act


def starts_of_vehicle(n):
    return np.random.default_rng(0).uniform((0, 0.3), (0.2, 0.4), (n, 2))


@pytest.mark.slow
def test_what_the_traps_below_are_set_in_is_taken(circle, vehicle):
    for task in (circle, vehicle):
        read_agent(task, steering(task))
    read_agent(circle, Honest())
    read_agent(vehicle, Plain(vehicle, ""))
    for n in (1, 20, 300):
        agent = hyrl_mj.from_callable(turning, vehicle)
        simulate(vehicle, agent, starts_of_vehicle(n), Noise("uniform", 0.1))


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("trap", TRAPS)
def test_who_answers_otherwise_is_refused_with_both_answers(trap, name):
    task = hyrl_mj.get_task(name)
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
    late = {"calls": 20} if trap == "counts" else {}
    agent = hyrl_mj.from_callable(TRAPS[trap](turning, vehicle, **late), vehicle)
    with pytest.raises(
        BadInput, match=r"the function answers .* and, (asked again later|in a batch)"
    ):
        simulate(vehicle, agent, starts_of_vehicle(starts), Noise("uniform", 0.1))


def test_a_closed_loop_of_many_runs_notices_what_begins_later(vehicle):
    def of_the_rows(observation):
        late = observation[:, 1].mean() < 2.8 and len(observation) > 8  # on its way
        return turning(observation.mean(axis=0) + 0 * observation if late else observation)

    agent = hyrl_mj.from_callable(of_the_rows, vehicle)
    with pytest.raises(BadInput, match=r"the function answers .* and, in a batch"):
        simulate(vehicle, agent, starts_of_vehicle(300), Noise("uniform", 0.1))


def test_a_closed_loop_notices_who_answers_otherwise_alone(vehicle):
    agent = hyrl_mj.from_callable(lambda o: turning(o) * (len(o) > 1), vehicle)
    with pytest.raises(BadInput, match=r"the function answers .* and, alone, with"):
        simulate(vehicle, agent, starts_of_vehicle(20), Noise("uniform", 0.1))


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
        ("shape", r"of shape \(\d+,\) for \d+ measurements"),
        ("number", "not finite"),
        ("error", "raised LookupError"),
    ],
)
def test_what_else_a_policy_may_do_is_named(spoils, message, vehicle):
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
    for seed, name in enumerate(TASKS):
        task = hyrl_mj.get_task(name)
        agent = HONEST[kind](task, np.random.default_rng(seed))
        given = read_agent(task, agent)
        z0 = task.starts(10, np.random.default_rng(seed))
        simulate(task, given.policy, z0, Noise("uniform", 0.1))


@pytest.mark.slow
def test_two_traps_at_once_are_noticed_as_well(vehicle):
    torch.set_num_threads(1)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        agent = steering(vehicle)
        for trap in rng.choice(list(TRAPS), 2, replace=False):
            agent = TRAPS[trap](agent, vehicle)
        with pytest.raises(BadInput):
            read_agent(vehicle, agent)


# ---- agents that declare their memory, and the same as plain Python, one robot at a time


def turn(observation):
    """Goes to the side on which it is: observations (n, k) -> inputs (n, 1)."""
    return np.tanh(3 * observation[:, 1:2])


class Chunked:
    """Plans four inputs and plays them one after the other; it remembers how many are left, and them."""

    def start(self, n):
        return np.zeros((n, 5))

    def act(self, memory, observation):
        left = memory[:, :1]
        plan = np.where(left > 0, memory[:, 1:], turn(observation) * [1.0, 0.8, 0.6, 0.4])
        left = np.where(left > 0, left, 4) - 1
        return plan[:, :1], np.hstack([left, np.roll(plan, -1, axis=1)])


def chunked(observations):
    plan = []
    for observation in observations:
        plan = plan or [
            float(turn(observation[None])[0, 0]) * part for part in (1.0, 0.8, 0.6, 0.4)
        ]
        yield plan.pop(0)


class Filtered:
    """Acts by a moving average of the observation; it remembers whether there is one, and it."""

    def start(self, n):
        return np.zeros((n, 3), dtype=np.float32)

    def act(self, memory, observation):
        begun, observation = memory[:, :1] > 0, observation[:, :2]
        mean = np.where(begun, 0.75 * memory[:, 1:] + 0.25 * observation, observation)
        return turn(mean), np.hstack([np.ones_like(mean[:, :1]), mean])


def filtered(observations):
    mean = observations[0]
    for observation in observations:
        mean = np.float32(0.75) * mean + np.float32(0.25) * observation
        yield turn(mean[None])[0, 0]


class Recurrent:
    """As RecurrentPPO: `predict` takes and gives a state of two arrays (layers, n, size)."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        n = len(observation)
        h, c = state or (np.zeros((2, n, 2), np.float32), np.zeros((1, n, 2), np.float32))
        goes_on = 1 - np.asarray(episode_start, np.float32)[:, None]
        h, c = h * goes_on, c * goes_on
        c = 0.5 * c + observation[:, :2]
        h = np.stack([np.tanh(h[1] + c[0]), 0.5 * h[0]])
        return turn(h[0]), (h, c)


def recurrent(observations):
    model, state = Recurrent(), None
    for k, observation in enumerate(observations):
        start = np.array([k == 0])
        action, state = model.predict(observation[None], state, start, deterministic=True)
        yield action[0, 0]


AGENTS = {
    "chunked": (Chunked, chunked),
    "filtered": (Filtered, filtered),
    "recurrent": (Recurrent, recurrent),
}


def as_alone(task, plain, measured):
    """What the same agent in plain Python answers to the measurements (K, p) of one run: (K, 1)."""
    return np.array(list(plain(task.observation(measured).astype(np.float32))))[:, None]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "noise"),
    [
        ("chunked", "uniform"),
        ("filtered", "uniform"),
        ("recurrent", "uniform"),
        ("chunked", "none"),
        ("recurrent", "adversarial"),
    ],
)
def test_it_closes_a_loop_as_it_does_alone(kind, noise, puck):
    """Under noise that looks ahead, too, which asks the controller often."""
    make, plain = AGENTS[kind]
    policy = from_callable(make(), puck)
    starts = puck.starts(5, np.random.default_rng(0))
    arcs = simulate(puck, policy, starts, Noise(noise, 0.1))
    assert len({len(arc.t) for arc in arcs}) > 1  # so that rows are left out on the way
    for start, arc in zip(starts, arcs, strict=True):
        expected = as_alone(puck, plain, arc.measured[:-1])
        np.testing.assert_allclose(arc.u[:-1], expected, rtol=0, atol=1e-6)
        assert np.abs(arc.u[:-1] - policy.act(arc.measured[:-1])).max() > 1e-3
        if noise != "uniform":  # which is drawn for all runs at once
            np.testing.assert_array_equal(simulate(puck, policy, start, Noise(noise, 0.1)).u, arc.u)


class Phases:
    """One of three gains, which changes on stripes: as an agent with a memory, and as a controller."""

    modes = (0, 1, 2)

    def start(self, n):
        return np.zeros((n, 1))

    def act(self, memory, observation):
        gain = np.array([1.0, 0.4, -0.6])[memory.astype(int)]
        return gain * turn(observation), (memory + np.floor(14 * observation[:, 1:2]) % 2) % 3

    def initial_mode(self, measured):
        return np.zeros(len(measured), int)

    def step(self, q, measured):
        observation = measured[:, :3].astype(np.float32)
        u, memory = self.act(q[:, None].astype(float), observation)
        return u, memory[:, 0].astype(int)


def test_noise_that_looks_ahead_knows_the_memory(puck):
    """It chooses as against a controller whose modes are the memory."""
    starts = puck.starts(8, np.random.default_rng(0))
    noise = Noise("adversarial", 0.1)
    settings = LoopSettings(steps=30, record=True, quiet=True)
    agent = PolicyController(from_callable(Phases(), puck))
    one, two = (
        closed_loop(puck, loop, starts, noise, settings=settings) for loop in (agent, Phases())
    )
    assert len(np.unique(two.q)) == 3
    assert len(np.unique(two.noise)) > 2
    np.testing.assert_array_equal(one.outcome, two.outcome)
    np.testing.assert_allclose(one.u, two.u, rtol=0, atol=1e-9)


def test_an_attack_asks_and_changes_no_memory(puck):
    loop = PolicyController(from_callable(Chunked(), puck))
    rules = Rules(puck, loop, 0.1, np.array(puck.noisy, dtype=float))
    rng, starts = np.random.default_rng(0), puck.starts(6, np.random.default_rng(1))
    programmes = rng.integers(len(rules.all), size=(6, 4))
    programmes[:, 1] = rules.ahead
    signal = Programmes(puck, loop, rules, programmes, segment=3)
    run = closed_loop(puck, loop, starts, signal, settings=LoopSettings(record=True, quiet=True))
    assert np.ptp(run.noise)
    for row, end in enumerate(run.length):
        expected = as_alone(puck, chunked, run.measured[:end, row])
        np.testing.assert_allclose(run.u[:end, row], expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_agents_whose_memory_shows_late_are_not_taken_for_each_other(vehicle):
    class Held:
        """Holds its first level for some samples."""

        def __init__(self, samples):
            self.samples = samples

        def start(self, n):
            return np.zeros((n, 2))

        def act(self, memory, observation):
            level = np.where(memory[:, 0] % self.samples, memory[:, 1], 4 * (observation[:, 2] > 0))
            return level.astype(int), np.column_stack([memory[:, 0] + 1, level])

    held = {read_agent(vehicle, Held(samples)).agent.sha256 for samples in (5, 6, 9, 20, 30)}
    assert len(held) == 5


def test_a_run_backward_has_no_memory(circle):
    policy = from_callable(Chunked(), circle)
    settings = LoopSettings(steps=6, backward=True, record=True, quiet=True)
    run = closed_loop(circle, PolicyController(policy), np.array([[1.0]]), settings=settings)
    np.testing.assert_array_equal(run.u[:, 0], policy.act(run.measured[:, 0]))


@pytest.mark.slow
def test_a_model_of_sb3_contrib_acts_as_there(circle):
    contrib = pytest.importorskip("sb3_contrib")
    env = TaskVecEnv(BatchedEnv(circle, 1, threads=1))
    kwargs = {"lstm_hidden_size": 8, "n_lstm_layers": 2, "net_arch": [8]}
    model = contrib.RecurrentPPO("MlpLstmPolicy", env, seed=0, device="cpu", policy_kwargs=kwargs)
    policy = read_agent(circle, model).policy
    assert memory_at_start(PolicyController(policy), 3).shape == (3, 33)
    starts = circle.starts(3, np.random.default_rng(0))
    for arc in simulate(circle, policy, starts, Noise("uniform", 0.1), horizon=0.5):
        state, theirs = None, []
        for k, observation in enumerate(circle.observation(arc.measured[:-1]).astype(np.float32)):
            begins = np.array([k == 0])
            action, state = model.predict(observation[None], state, begins, deterministic=True)
            theirs.append(action[0])
        np.testing.assert_allclose(arc.u[:-1], theirs, atol=1e-5)


def test_a_model_begins_as_it_does_without_a_state(circle):
    """Not with zeros, where it begins otherwise and heeds no `episode_start`."""

    class Eager:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            before = np.full((1, len(observation), 1), 0.5) if state is None else state[0]
            mean = 0.9 * before + 0.1 * observation[None, :, 1:]
            return mean[0], (mean,)

    policy = read_agent(circle, Eager()).policy
    for arc in simulate(circle, policy, [[1.0], [4.0]], horizon=0.5):
        state = None
        for u, seen in zip(arc.u, circle.observation(arc.measured[:-1]), strict=False):
            action, state = Eager().predict(seen[None], state)
            np.testing.assert_allclose(u, action[0], atol=1e-6)
    memory, (u, after) = (
        policy.start(2),
        policy.act_after(policy.start(2), np.array([[1.0], [4.0]])),
    )
    memory[1] = after[1]  # one run begins, and the other goes on
    mixed = policy.act_after(memory, np.array([[1.0], [4.0]]))[0]
    np.testing.assert_allclose(mixed, [u[0], [0.9 * u[1, 0] + 0.1 * np.sin(4.0)]], atol=1e-6)


def test_which_of_two_methods_acts_is_asked(circle):
    class Both:
        def __call__(self, observation):
            return turn(observation)

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return 0.5 * turn(observation), None

    with pytest.raises(
        BadInput, match=r"can be called, and has predict\(\) as well.*agent\.predict"
    ):
        from_callable(Both(), circle)
    with pytest.raises(BadInput, match="Both is a class: give an object of it"):
        from_callable(Both, circle)

    class Acts:
        def act(self, state):
            return turn(np.atleast_2d(state))

    with pytest.raises(BadInput, match=r"act\(state\) of .* takes observations, it seems"):
        read_agent(circle, Acts())


def test_a_model_without_a_state_is_a_function(circle):
    class Plain:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return turn(observation), None

    given = read_agent(circle, Plain())
    assert not given.agent.remembers
    assert given.agent.sha256 == read_agent(circle, turn).agent.sha256


# ---- what is no such agent


class Honest(Chunked):
    """Spoils nothing; those below change one thing of it."""


class Hidden(Honest):
    calls = 0

    def act(self, memory, observation):
        u, memory = super().act(memory, observation)
        self.calls += len(observation) == 1
        return u * (1 + 0.1 * np.sin(self.calls)), memory


class HiddenLater(Honest):
    """Remembers beside its memory, and shows it only in the next one."""

    last = 0.0

    def act(self, memory, observation):
        u, memory = super().act(memory, observation)
        memory[:, -1] += self.last
        self.last = 0.01 * observation[-1, 0]
        return u, memory


class OfTheBatch(Honest):
    def act(self, memory, observation):
        u, memory = super().act(memory, observation)
        memory[:, 1] = memory[:, 1].mean()
        return u, memory


class Growing(Honest):
    def act(self, memory, observation):
        return turn(observation), np.hstack([memory, observation])


def remembering(memory):
    """An agent with another memory at its start, or after it."""

    class Other(Honest):
        def act(self, before, observation):
            return turn(observation), memory(len(before))

    return Other


def starting(memory):
    class Other(Honest):
        def start(self, n):
            return memory(n)

    return Other


SPOILT = {
    "hidden": (Hidden, r"the agent answers .* and, asked again .* without chance or another"),
    "later": (HiddenLater, r"with a memory of .* and, asked again later, with a memory of"),
    "of the batch": (OfTheBatch, r"with a memory of .* and, in a batch of"),
    "grows": (Growing, r"of shape \(16, 7\) of one float64 of shape \(16, 5\): keep the shape"),
    "of another type": (remembering(lambda n: np.zeros((n, 5), "f")), "memory float32 of shape"),
    "integers": (
        remembering(lambda n: np.zeros((n, 5), int)),
        "of type int64: give an array of fl",
    ),
    "a list": (remembering(lambda n: [0.0] * n), "a memory of type list: give an array of floats"),
    "not finite": (remembering(lambda n: np.full((n, 5), np.nan)), "a memory of nan: give finite"),
    "of other runs": (remembering(lambda n: np.zeros((n + 1, 5))), r"\(17, 5\) for 16 runs"),
    "starts as integers": (
        starting(lambda n: np.zeros((n, 5), int)),
        r"start\(\) of the agent giv",
    ),
    "starts by row": (
        starting(lambda n: np.arange(5.0 * n).reshape(n, 5)),
        r"other rows than start",
    ),
    "starts at random": (starting(lambda n: np.random.rand(n, 5)), r"other rows than start\(1\)"),
    "starts with an error": (starting(lambda n: 1 / 0), r"start\(1\) raised ZeroDivisionError"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SPOILT)
def test_a_memory_that_is_none_is_refused(kind, circle):
    make, message = SPOILT[kind]
    with pytest.raises(BadInput, match=message):
        read_agent(circle, make())


def test_a_closed_loop_notices_a_hidden_memory_too(circle):
    starts = circle.starts(20, np.random.default_rng(0))
    for make in (HiddenLater, OfTheBatch):
        with pytest.raises(BadInput, match=r"the agent answers .* with a memory of"):
            simulate(circle, from_callable(make(), circle), starts)


def test_what_it_lacks_is_said(circle):
    class NoPair(Honest):
        def act(self, memory, observation):
            return turn(observation)

    class Flat(Recurrent):
        def predict(self, *args, **kwargs):
            return super().predict(*args, **kwargs)[0], np.zeros(1)

    class Plain:
        def predict(self, observation):
            return turn(observation)

    with pytest.raises(BadInput, match=r"as that of SB3: give .* lambda o: model\.predict\(o\)"):
        from_callable(Plain(), circle)
    with pytest.raises(
        BadInput, match=r"act\(\) gives no pair: give the inputs and the next memory"
    ):
        from_callable(NoPair(), circle).act(np.zeros((2, 1)))
    with pytest.raises(BadInput, match=r"give a tuple of arrays of shape \(layers, n, size\)"):
        from_callable(Flat(), circle)
    with pytest.raises(BadInput, match=r"as hyrl_mj\.from_callable\(function, task\)"):
        simulate(circle, Chunked(), [1.0])
    lattice = Lattice.tabulate(circle, Grid.with_cells(circle.chart, 60))
    loop = PolicyController(from_callable(Chunked(), circle))
    with pytest.raises(
        BadInput, match="a function of the measurement, and this policy has a memory"
    ):
        Answers.ask(lattice, loop, np.zeros(1))


def test_a_model_of_other_observations_or_actions_is_refused(circle, tmp_path):
    model = PPO("MlpPolicy", TaskVecEnv(BatchedEnv(circle, 1)), n_steps=64)
    assert from_callable(model, circle).act(np.ones((2, 1))).shape == (2, 1)
    for task, why in (("gate", r"observes \(2,\), and gate gives \(4,\)"), ("vehicle", "gives")):
        with pytest.raises(BadInput, match=why):
            from_callable(model, hyrl_mj.get_task(task))
    env = VecNormalize(TaskVecEnv(BatchedEnv(circle, 1)))
    trained = PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu").learn(8)
    trained.save(tmp_path / "model.zip")
    with pytest.raises(
        BadInput, match="was trained under VecNormalize"
    ):  # its statistics are not in it
        from_callable(PPO.load(tmp_path / "model.zip", device="cpu"), circle)
    with pytest.raises(BadInput, match="was trained under VecNormalize"):
        from_callable(PPO("MlpPolicy", env, n_steps=64), circle)
    for space in (gym.spaces.Box(-2, 2, (1,)), gym.spaces.MultiDiscrete([5])):
        model.action_space = space
        with pytest.raises(BadInput, match="give a function that scales them"):
            from_callable(model, circle)
    vehicle = hyrl_mj.get_task("vehicle")
    levels = PPO("MlpPolicy", TaskVecEnv(BatchedEnv(vehicle, 1)), n_steps=64, device="cpu")
    assert from_callable(levels, vehicle).act(np.ones((2, 2))).shape == (2, 1)
    spaces = gym.spaces.MultiBinary(5), gym.spaces.MultiDiscrete([5]), gym.spaces.Box(-1, 1, (5,))
    for space in (*spaces, gym.spaces.Discrete(4)):
        levels.action_space = space
        with pytest.raises(BadInput, match="vehicle takes one of 5 levels"):
            from_callable(levels, vehicle)


def test_a_model_with_masks_is_refused(vehicle):
    class Masked:
        def predict(self, observation, state=None, episode_start=None, action_masks=None):
            return np.zeros(len(observation), dtype=int), None

    with pytest.raises(BadInput, match="a mask allows, and vehicle has no masks"):
        from_callable(Masked(), vehicle)


def test_a_model_that_saw_what_a_wrapper_made_is_refused(circle, tmp_path):
    env = gym.wrappers.NormalizeObservation(gym.make(circle.env_id))
    model = PPO("MlpPolicy", env, n_steps=64, seed=0, device="cpu").learn(64)
    model.save(tmp_path / "model.zip")
    given = [PPO.load(tmp_path / "model.zip", env=other, device="cpu") for other in (None, env)]
    for found in (model, *given):
        with pytest.raises(
            BadInput, match=r"wrapper such as NormalizeObservation: .* asks the model"
        ):
            from_callable(found, circle)


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_a_model_that_was_trained_on_plain_observations_is_taken(algorithm, circle, tmp_path):
    env = VecNormalize(TaskVecEnv(BatchedEnv(circle, 1)), norm_obs=False)  # of rewards alone
    options = {"n_steps": 8, "batch_size": 8} if algorithm is PPO else {"learning_starts": 100}
    for envs in (env, env.venv):
        model = algorithm("MlpPolicy", envs, seed=0, device="cpu", **options).learn(8)
        model.save(tmp_path / "model.zip")
        for found in (model, algorithm.load(tmp_path / "model.zip", device="cpu")):
            assert from_callable(found, circle).act(np.ones((2, 1))).shape == (2, 1)


def test_a_model_that_does_not_tell_what_was_normalised_is_refused(tmp_path):
    rover = hyrl_mj.get_task("rover")
    env = VecNormalize(TaskVecEnv(BatchedEnv(rover, 1)), norm_obs=False)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu").learn(8)
    model.save(tmp_path / "model.zip")
    with pytest.raises(BadInput, match=r"nothing in the model tells .* or .* rewards alone"):
        from_callable(PPO.load(tmp_path / "model.zip", device="cpu"), rover)
    again = PPO.load(tmp_path / "model.zip", env=env, device="cpu")
    plant = rover.placed(rover.starts(2, np.random.default_rng(0)))
    assert from_callable(again, rover).act(plant.measurement).shape == (2, len(rover.inputs))


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_another_environment_does_not_make_a_normalised_model_plain(algorithm, circle, tmp_path):
    options = {"n_steps": 8, "batch_size": 8} if algorithm is PPO else {"learning_starts": 100}
    plain = TaskVecEnv(BatchedEnv(circle, 1))
    model = algorithm("MlpPolicy", VecNormalize(plain), seed=0, device="cpu", **options).learn(8)
    model.save(tmp_path / "model.zip")
    given = algorithm.load(tmp_path / "model.zip", device="cpu")
    given.set_env(plain)
    for found in (given, algorithm.load(tmp_path / "model.zip", env=plain, device="cpu")):
        with pytest.raises(BadInput, match=r"nothing in the model tells .* load it without"):
            from_callable(found, circle)


# ---- from the command line


def test_python_code_is_named_by_its_module_and_object(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_agents.py").write_text(
        "class Group:\n    @staticmethod\n    def steer(o):\n        return o[:, :1]\n\n\nthree = 3\n"
        "import os\n\nos.chdir('/')\n"
    )
    found = agent_at(Path("my_agents:Group.steer"))
    assert Path.cwd() == tmp_path, "where a run is written to"
    assert found(np.ones((2, 3))).tolist() == [[1], [1]]
    (tmp_path / "my_agents:Group.steer").touch()  # a file comes first
    assert agent_at(Path("my_agents:Group.steer")) == Path("my_agents:Group.steer")
    for name, why in (
        ("my_agents:three", "is of type int"),
        ("my_agents:four", "cannot be imported: AttributeError"),
        ("my_agents:", "cannot be imported"),
        ("no_such_module:agent", "cannot be imported: ModuleNotFoundError"),
    ):
        with pytest.raises(BadInput, match=why):
            agent_at(Path(name))
    with pytest.raises(BadArtifact, match="no file"):
        agent_at(Path("agent.zip"))


# ---- in a run


@pytest.mark.slow
def test_a_diagnosis_says_so_and_goes_on(small_runs, circle, tmp_path, monkeypatch):
    spare(monkeypatch, episodes=12, batches=1, attack_starts=12, attack_rounds=1)
    said, out = [], tmp_path / "run"
    run = hyrl_mj.diagnose("unit_circle", Chunked(), preset="smoke", out=out, say=said.append)
    assert any("it has a memory: noisy episodes stand in for the worst" in line for line in said)
    assert "which this policy is not (it has a memory)" in run.why_no_game
    assert "function, with a memory" in (out / "diagnosis.html").read_text()
    again = hyrl_mj.load_run(out, policy=Chunked())
    assert again.agent.remembers
    with pytest.raises(BadInput, match="answers otherwise"):
        _ = hyrl_mj.load_run(out, policy=Filtered()).policy
