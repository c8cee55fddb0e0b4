"""Wrapped environments, slow sensors, conditions and agents of users: as they are, or refused by name."""

import functools
import importlib
import sys
from collections import deque

import gymnasium as gym
import numpy as np
import pytest
from environments import GOAL, Puck
from gymnasium import spaces
from gymnasium.wrappers import DtypeObservation, TimeLimit
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.sac.policies import SACPolicy
from test_truer_environments import STARTS, ends, flat, outcomes, pilot, plain

from hyrl_mj import BadInput, Noise, from_callable, from_gymnasium, load_agent, simulate
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.tasks import check_task, trial

# A second for each environment.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_trials")]
NARROW = spaces.Box(-np.inf, np.inf, (6,), dtype=np.float64)


class Flat(Puck):
    """A puck that observes a vector, as the pilot takes it, and begins anywhere or at home."""

    observation_space = NARROW

    def _get_obs(self):
        place, velocity = self.seen(), self.data.qvel
        return np.concatenate([place, GOAL - place, velocity])

    def seen(self):
        return self.data.qpos.copy()


class Home(Flat):
    """Each of its resets leads to one place."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.data.qpos[:] = -1.4, 0.1
        self.begin()
        return self._get_obs(), {}

    def step(self, action):
        found = super().step(action)
        self.after()
        return (self._get_obs(), *found[1:])

    def begin(self):
        pass

    def after(self):
        pass


def test_a_step_ends_runs_that_nobody_has_looked_at(monkeypatch):
    monkeypatch.setattr(trial, "STEPS", 5_000)  # of the physics, in all episodes
    monkeypatch.setattr(trial, "FEWEST", 4)
    task = flat()
    assert check_task(task) is task
    plant = task.plant(1)
    plant.set_state(*task.state(np.array([[1.2, 0.0]])))
    for _ in range(6):
        plant.step(np.array([[4.0, 0.0]]))
    assert plant.measurement[0, -1] == 1


# ---- ways on which noise does not come


class Telling(Flat):
    """Tells its place in info and in an attribute, and does not observe it itself."""

    def _get_obs(self):
        return np.concatenate([np.zeros(2), GOAL - self.seen(), self.data.qvel])

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        self.pose = self.seen()
        return observation, reward, terminated, truncated, info | {"x": float(self.pose[0])}


class ByInfo(gym.Wrapper):
    def step(self, action):
        observation, *rest = self.env.step(action)
        return np.append(rest[-1].get("x", -1.4), observation[1:]), *rest


class ByAttribute(gym.Wrapper):
    def step(self, action):
        observation, *rest = self.env.step(action)
        return np.append(self.unwrapped.pose, observation[2:]), *rest


class ByReward(gym.Wrapper):
    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        return np.append(reward, observation[1:]), reward, *rest


class ByLastInfo(ByInfo):
    """Shows what it was told a sample before."""

    def reset(self, **options):
        self.told = -1.4
        return self.env.reset(**options)

    def step(self, action):
        observation, *rest = self.env.step(action)
        before, self.told = self.told, rest[-1]["x"]
        return np.append(before, observation[1:]), *rest


class Zoned(Flat):
    """Tells words and truths, which no small displacement changes."""

    def step(self, action):
        *found, info = super().step(action)
        self.above = bool(self.data.qpos[1] > 0)
        return *found, info | {"side": "left" if self.above else "right"}


class ByWord(gym.Wrapper):
    def step(self, action):
        observation, *rest = self.env.step(action)
        return np.append(rest[-1].get("side") == "left", observation[1:]), *rest


class ByTruth(gym.Wrapper):
    def step(self, action):
        observation, *rest = self.env.step(action)
        return np.append(self.unwrapped.above, observation[1:]), *rest


class Usual(Flat):
    """Has attributes of any kind, an array for a reward, and None for `truncated`."""

    walls = [[1, 2], [3]]

    def __init__(self):
        super().__init__()
        self.rooms, self.rows = [[1, 2], [3]], iter([1])

    def step(self, action):
        observation, reward, terminated, _, info = super().step(action)
        return observation, np.array([reward]), terminated, None, info


def test_usual_habits_and_attributes_of_any_kind_are_taken():
    assert outcomes(lambda: DtypeObservation(Usual(), np.float64)) == plain()


@pytest.mark.parametrize(
    ("wrapper", "env", "way"),
    [
        (ByInfo, Telling, "info x"),
        (ByAttribute, Telling, "attribute pose"),
        (ByLastInfo, Telling, "info x"),
        (ByReward, Flat, "the reward"),
        (ByWord, Zoned, "info side"),
        (ByTruth, Zoned, "attribute above"),
    ],
)
def test_wrappers_that_observe_the_place_past_the_noise_are_refused(wrapper, env, way):
    with pytest.raises(BadInput, match=f"a wrapper of .* observes .*{way}.* does not reach"):
        from_gymnasium(lambda: wrapper(env()))


class Before(gym.Wrapper):
    """Shows where the robot was before the step."""

    def step(self, action):
        before = self.unwrapped.data.qpos.copy()
        observation, *rest = self.env.step(action)
        return np.append(before, observation[2:]), *rest


class Fixes(gym.Wrapper):
    """Reads the place once in some samples, and shows that in place of the velocity."""

    every = 45

    def reset(self, **options):
        self.count, self.fix = 0, np.zeros(2)
        return self.env.reset(**options)

    def step(self, action):
        observation, *rest = self.env.step(action)
        self.count += 1
        if self.count % self.every == 0:
            self.fix = self.unwrapped.data.qpos.copy()
        return np.append(observation[:4], self.fix), *rest


class Seldomer(Fixes):
    every = 230


def test_what_wrappers_read_of_the_state_at_any_time_is_under_noise_or_refused():
    with pytest.raises(BadInput, match="has read from MuJoCo's state before it stepped"):
        from_gymnasium(lambda: Before(Flat()))
    assert from_gymnasium(lambda: Fixes(Flat()), steps=60).specification.sensing == "now"
    task = from_gymnasium(lambda: Seldomer(Flat()), steps=240)
    assert not task.specification.sensing  # no trial is so long
    agent = from_callable(lambda seen: np.zeros((len(seen), 2)), task)
    noise = Noise("uniform", 0.1)
    with pytest.raises(BadInput, match=r"has read from MuJoCo's state .* or reads seldom"):
        simulate(task, agent, [-1.4, 0.5], noise)


class Placed(gym.ObservationWrapper):
    """Shows where the body is, which the environment computes a physics step before the end of a step."""

    def observation(self, observation):
        return np.append(self.unwrapped.data.body("puck").xpos[:2], observation[2:])


def test_what_wrappers_read_lags_with_noise_as_without_it():
    assert from_gymnasium(lambda: Placed(Flat())).specification.sensing == "earlier"


class Steered(gym.Wrapper):
    """Drives to setpoints by what it observes, and judges by that, too."""

    def reset(self, **options):
        self.seen, info = self.env.reset(**options)
        return self.seen, info

    def step(self, action):
        push = 0.8 * np.clip(action, -3, 3) - self.seen[4:] - 0.3 * self.seen[:2]
        self.seen, reward, *ends, _ = self.env.step(np.clip(push, -4, 4))
        return self.seen, reward, *ends, {"success": bool(np.linalg.norm(self.seen[2:4]) < 0.25)}


def test_a_wrapper_that_steers_and_judges_by_a_noisy_observation_is_refused():
    with pytest.raises(BadInput, match="running without the noise, which must not judge"):
        outcomes(lambda: Steered(Flat()), 0.2)


class InPlace(gym.ObservationWrapper):
    """Changes what it is given, as a list, or a dictionary of which it takes entries away."""

    def observation(self, observation):
        if isinstance(observation, dict):
            place, to_goal = observation.pop("position"), observation.pop("to_goal")
            return np.concatenate([place, to_goal, observation.pop("velocity")])
        return observation[:2] + observation[2:]  # of arrays a sum


class Listed(Flat):
    def _get_obs(self):
        return super()._get_obs().tolist()


class Vector(InPlace):
    def __init__(self, env):
        super().__init__(env)
        self.observation_space = NARROW


@functools.cache
def flat_puck():
    return from_gymnasium(Flat, steps=60)


@pytest.mark.first(1)
@pytest.mark.parametrize("env", [Puck, Listed])
def test_wrappers_get_what_the_environment_gives_and_may_change_it(env):
    task = from_gymnasium(lambda: Vector(env()), steps=60)
    assert ends(task) == plain()
    assert ends(task, 0.1) == ends(flat_puck(), 0.1)


class Late(Home):
    """A camera that shows the place four samples late."""

    def begin(self):
        self.places = deque([self.data.qpos.copy()] * 5, maxlen=5)

    def after(self):
        self.places.append(self.data.qpos.copy())

    def seen(self):
        return self.places[0] if hasattr(self, "places") else self.data.qpos.copy()


class Seldom(Home):
    """Its first fix comes after 50 samples."""

    def begin(self):
        self.k, self.fix = 0, np.zeros(2)

    def after(self):
        self.k += 1
        if self.k % 50 == 0:
            self.fix = self.data.qpos.copy()

    def _get_obs(self):
        fix = getattr(self, "fix", np.zeros(2))
        return np.concatenate([fix, GOAL - self.data.qpos, self.data.qvel])


@pytest.mark.first(1)
@pytest.mark.parametrize("slow", [Late, Seldom])
def test_sensors_that_hold_or_delay_the_place_are_refused_where_resets_are_alike(slow):
    with pytest.raises(BadInput, match=r"observation\[\d\] .*It is stored by step"):
        from_gymnasium(slow)


class Denied(Flat):
    """Behind the rock step() puts another place into what it observes."""

    def step(self, action):
        observation, *rest = super().step(action)
        if self.data.qpos[0] > 0.6 and abs(self.data.qpos[1]) < 0.75:
            observation[:2] = 0.9, 0.4
        return observation, *rest


def test_what_a_step_does_to_an_observation_is_noticed_where_it_does_it():
    with pytest.raises(BadInput, match=r"has observed 0\.\d in .* gives .* in the same state"):
        outcomes(Denied, 0.15)


class Latching(Flat):
    """Its sensor remembers that it was at a rare place."""

    def _get_obs(self):
        self.docked = getattr(self, "docked", False) or self.data.qpos[0] > 1.3
        return super()._get_obs() + 0.1 * self.docked


def test_an_observer_that_remembers_is_noticed():
    with pytest.raises(BadInput, match=r"docked|in the same state|differs by"):
        outcomes(Latching, 0.3)


class Blind(Flat):
    def _get_obs(self):
        return np.concatenate([self.data.qvel, np.zeros(4)])


def test_noise_that_nothing_observes_is_refused():
    with pytest.raises(BadInput, match="noise on x, y changes nothing that Blind observes"):
        from_gymnasium(Blind)


# ---- judges play with the noise


class Residual(gym.Wrapper):
    """The agent corrects a controller, which sees what it sees."""

    def reset(self, **options):
        self.seen, info = self.env.reset(**options)
        return self.seen, info

    def step(self, action):
        base = np.clip(pilot(self.seen[None])[0], -4, 4)
        self.seen, *rest = self.env.step(0.7 * base + 0.3 * np.asarray(action))
        return self.seen, *rest


def residual(place, noise):
    """Returns after how many samples the pilot arrives, in a loop of its own, under noise (K, 2)."""
    env = Flat()
    env.reset(seed=0)
    env.data.qpos[:], env.data.qvel[:] = place, 0.0
    for k in range(60):
        off = np.concatenate([noise[k], -noise[k], np.zeros(2)])
        u = np.clip(pilot((env._get_obs() + off)[None])[0], -4, 4)
        if env.step(u)[4]["success"]:
            return k + 1
    return None


def test_a_controller_in_a_wrapper_sees_the_noise():
    shape = 61, len(STARTS), 2 + 6 + 3
    noise = 0.1 * np.random.default_rng(0).uniform(-1, 1, shape)
    expected = [residual(start, noise[:, i, :2]) for i, start in enumerate(STARTS)]
    assert [samples for _, samples in outcomes(lambda: Residual(Flat()), 0.1)] == expected


# ---- conditions


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("given", "label"),
    [
        ({"success": "truncated and not terminated"}, "reached"),
        ({"success": "not truncated", "failure": "terminated", "steps": 20}, "stalled"),
    ],
)
def test_who_survives_until_the_time_is_over_succeeds(given, label):
    task = from_gymnasium(lambda: TimeLimit(Flat(), 20), **given)
    agent = from_callable(lambda seen: np.zeros((len(seen), 2)), task)
    arc = simulate(task, agent, [-1.4, 0.5])
    assert (arc.outcome, len(arc.t) - 1) == (label, 20)


# ---- what is told of a mistake


class Still(Flat):
    def step(self, action):
        self.data.qpos += 0.05 * np.asarray(action)
        return self._get_obs(), 0.0, False, False, {"success": False}


class Unrewarded(Flat):
    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, None, *rest


class Alone(Flat):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0]


class Longer(Flat):
    def _get_obs(self):
        return np.append(super()._get_obs(), 1.0)


class Global(Flat):
    def reset(self, *, seed=None, options=None):
        found = super().reset(seed=seed)
        self.goal = np.random.uniform(1.0, 1.5)
        return found

    def step(self, action):
        *found, _ = super().step(action)
        return *found, {"success": bool(self.data.qpos[0] > self.goal)}


class Copying(gym.Wrapper):
    def step(self, action):
        import copy

        copy.deepcopy(self.env)
        return self.env.step(action)


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        (Still, {}, "the time of Still stands still"),
        (Unrewarded, {}, "returns None as its reward"),
        (Alone, {}, r"reset\(\) of Alone returns a ndarray"),
        (Longer, {}, "observes 7 number"),
        (Global, {"seed": 0}, "draws goal from a global generator"),
        (lambda: Copying(Flat()), {}, "copies the environment, and noise reaches no copies"),
    ],
)
def test_mistakes_are_named(make, given, message):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make, **given)


@pytest.mark.long
def test_code_that_is_imported_again_is_another_environment(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    path = tmp_path / "changing.py"
    text = (
        "import gymnasium as gym\nfrom environments import Puck\n\n\nclass Changing(Puck):\n"
        "    def step(self, action):\n        o, r, *rest, info = super().step(action)\n"
        "        return o, r, *rest, {'success': r > -0.25}\n\n\n"
        "gym.register('Changing-v0', 'changing:Changing', max_episode_steps=60)\n"
    )
    path.write_text(text)
    before = from_gymnasium("changing:Changing-v0", steps=5)
    assert from_gymnasium("changing:Changing-v0", steps=5) is before
    path.write_text(text.replace("r > -0.25", "1 / 0"))
    importlib.invalidate_caches()
    importlib.reload(sys.modules["changing"])
    with pytest.raises(BadInput, match="ZeroDivisionError"):
        from_gymnasium("changing:Changing-v0", steps=5)
    del gym.registry["Changing-v0"], sys.modules["changing"]


# ---- agents


class Mirrored(ActorCriticPolicy):
    def get_distribution(self, obs):
        return super().get_distribution(-obs)


class Halved(SACPolicy):
    def _predict(self, observation, deterministic=False):
        return super()._predict(0.5 * observation, deterministic)


@pytest.mark.parametrize(("algorithm", "policy"), [(PPO, Mirrored), (SAC, Halved)])
def test_a_policy_class_of_one_s_own_is_refused(algorithm, policy, circle, tmp_path):
    path = tmp_path / "agent.zip"
    algorithm(policy, TaskVecEnv(BatchedEnv(circle, 1)), device="cpu").save(path)
    with pytest.raises(BadInput, match="its policy is of a class of its own"):
        load_agent(path, circle)


class Far(Flat):
    """Observes places on a map, of which single precision rounds half a metre; a reset has no options."""

    def reset(self, seed=None):
        return Flat.reset(self, seed=seed)

    def seen(self):
        return self.data.qpos + np.array([652_341.0, 5_404_123.0])

    def _get_obs(self):
        return np.concatenate([self.seen(), GOAL - self.data.qpos, self.data.qvel])


@pytest.mark.long
def test_functions_get_the_precision_of_the_environment_and_a_reset_may_have_no_options():
    task = from_gymnasium(Far, steps=60)
    origin = np.array([652_341.0, 5_404_123.0, 0, 0, 0, 0])
    agent = from_callable(lambda seen: np.clip(pilot(seen - origin), -4, 4), task)
    found = [(arc.outcome, len(arc.t) - 1) for arc in simulate(task, agent, STARTS)]
    assert found == plain()
