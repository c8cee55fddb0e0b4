"""What runs leave behind, what wrappers look at, what an id stands for: as a new process would have it."""

import array
import functools
import gc
import itertools
import multiprocessing
import random
import re
import sys
import threading
import time
from functools import partial

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from environments import GOAL, XML, Puck
from gymnasium import spaces
from gymnasium.wrappers import (
    ClipAction,
    FlattenObservation,
    NormalizeObservation,
    RecordEpisodeStatistics,
    TimeLimit,
)

from hyrl_mj import BadInput, from_callable, from_gymnasium, get_task, simulate
from hyrl_mj.gym_import import inspection, making
from hyrl_mj.gym_import.fingerprint import Unknown, fingerprint, is_known, of_model
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.opening import Description
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.simulation import Noise, Recorded

pytestmark = pytest.mark.slow  # a second for each environment
STARTS = np.array([[1.0, 0.9], [0.9, -0.9], [-1.4, 0.5]])


def pilot(observation):
    """Drives around the rock to the goal, by the place alone: observations (n, 6), sorted by name."""
    place, velocity = observation[:, :2], observation[:, 4:6]
    corner = np.column_stack([np.full(len(place), 0.9), np.where(place[:, 1] >= 0, 0.8, -0.8)])
    target = np.where(place[:, :1] < 0.6, corner, GOAL)
    up = (place[:, 0] < 0.6) & (np.abs(place[:, 1]) < 0.6)
    target[up, 0] = place[up, 0]
    ahead = target - place
    return 3 * ahead / np.maximum(np.linalg.norm(ahead, axis=1), 0.05)[:, None] - 0.5 * velocity


def outcomes(make, noise=0.0, steps=60, starts=STARTS, **given):
    """Returns how the pilot's runs end, and after how many samples."""
    return ends(from_gymnasium(make, steps=steps, **given), noise, starts)


def ends(task, noise=0.0, starts=STARTS):
    """The same, of a task."""
    signal = None
    if noise:
        shape = task.max_steps + 1, len(starts), len(task.noisy)
        values = noise * np.random.default_rng(0).uniform(-1, 1, shape) * task.noisy
        signal = Recorded(values, noise)
    agent = from_callable(lambda o: np.clip(pilot(np.asarray(o)), -4, 4), task)
    return [(arc.outcome, len(arc.t) - 1) for arc in simulate(task, agent, starts, signal)]


@functools.cache
def flat():
    """The task of the puck as it is, with a vector for its observation."""
    return from_gymnasium(lambda: FlattenObservation(Puck()), steps=60)


@functools.cache
def plain(noise=0.0):
    """How they end in it."""
    return ends(flat(), noise)


# ---- what wrappers look at, and write


class Judged(gym.Wrapper):
    """Tells success from MuJoCo's state."""

    def step(self, action):
        observation, _, terminated, truncated, _ = self.env.step(action)
        off = np.linalg.norm(self.unwrapped.data.qpos - GOAL)
        return observation, -off, terminated, truncated, {"success": bool(off < 0.25)}


class Stopwatch(gym.Wrapper):
    """Counts the samples at the goal in MuJoCo's data."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        data = self.unwrapped.data
        data.userdata[0] += info["success"]
        info["success"] = bool(data.userdata[0] >= 3)
        return observation, reward, terminated, truncated, info


class Ranging(gym.ObservationWrapper):
    """Observes the distance of the goal, which it reads from MuJoCo's state."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Box(-np.inf, np.inf, (7,))

    def observation(self, observation):
        off = np.linalg.norm(self.unwrapped.data.qpos - GOAL)
        return np.append(observation, off).astype(np.float32)


class RangingJudge(Ranging):
    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        info["success"] = bool(observation[-1] < 0.25)
        return observation, reward, terminated, truncated, info


class Counting(Puck):
    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(
            XML.replace("<worldbody>", '<size nuserdata="1"/><worldbody>')
        )
        self.data = mujoco.MjData(self.model)
        self.action_space = spaces.Box(-4.0, 4.0, (2,), dtype=np.float64)


def test_what_wrappers_write_to_the_state_stays():
    found = outcomes(lambda: Stopwatch(FlattenObservation(Counting())), 0.2)
    assert {outcome for outcome, _ in found} == {"reached"}
    assert all(late >= early + 2 for (_, late), (_, early) in zip(found, plain(0.2), strict=True))


def test_wrappers_judge_from_the_true_state():
    assert outcomes(lambda: Judged(FlattenObservation(Puck())), 0.2) == plain(0.2)


def test_what_wrappers_observe_of_the_state_is_under_noise():
    task = from_gymnasium(lambda: Ranging(FlattenObservation(Puck())), steps=5)
    noise = np.zeros((6, 1, len(task.noisy)))
    noise[:, :, 0] = 0.1
    agent = from_callable(lambda o: np.zeros((len(o), 2)), task)
    (arc,) = simulate(task, agent, [[-1.0, 0.0]], Recorded(noise, 0.1))
    assert arc.measured[0, 2 + 6] == pytest.approx(2.4, abs=1e-5)
    with pytest.raises(BadInput, match=r"sample\(s\) it is .*, and .* in the new one"):
        outcomes(lambda: RangingJudge(FlattenObservation(Puck())), 0.2)


# ---- ends of episodes


class OnTheLastStep(gym.Wrapper):
    """Tells success when the time is over."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        info["success"] = truncated
        return observation, reward, terminated, truncated, info


@pytest.mark.long
def test_the_shortest_of_several_time_limits_counts_and_a_run_may_be_simulated_for_longer():
    task = from_gymnasium(lambda: TimeLimit(FlattenObservation(TimeLimit(Puck(), 12)), 60))
    assert task.max_steps == 12
    assert max(samples for _, samples in ends(task)) <= 12
    still = from_callable(lambda o: np.zeros((len(o), 2)), task)
    (arc,) = simulate(task, still, [[-1.4, 0.5]], horizon=2.0)
    assert len(arc.t) - 1 == 20


def test_what_is_told_at_a_time_limit_is_not_lost_in_silence():
    make = lambda: OnTheLastStep(TimeLimit(FlattenObservation(Puck()), 10))  # noqa: E731
    with pytest.raises(BadInput, match=r"after 10 sample\(s\) it is stalled, and reached in the"):
        outcomes(make, steps=None)


# ---- what instances share, and what lasts


def curriculum(tolerance):
    """Returns a puck whose goal is the smaller the more episodes there were."""

    class Learning(Puck):
        def reset(self, **options):
            self.tolerance = tolerance()
            return super().reset(**options)

        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            info["success"] = bool(-reward < self.tolerance)
            return observation, reward, terminated, truncated, info

    return Learning


COUNTER = itertools.count()


@pytest.mark.first(1)
@pytest.mark.parametrize("where", ["a closure", "a counter of the module", "a bound method"])
def test_a_curriculum_that_ends_before_it_is_looked_at_is_refused(where):
    episodes = [0]

    def count():
        episodes[0] += 1
        return episodes[0]

    one = {"a closure": count, "a counter of the module": partial(next, COUNTER)}.get(
        where, itertools.count().__next__
    )
    with pytest.raises(BadInput, match=r"goes another way than a new one|all its instances share"):
        outcomes(curriculum(lambda: max(3.0 - 0.1 * one(), 0.3)))


class Sticky(Puck):
    """Remembers in a place that is not reset whether it has been near the rock."""

    most = 5

    def __init__(self):
        super().__init__()
        self.memory = {"model": self.model.opt, "data": mujoco.MjData(self.model)}
        self.remember = partial(self._remember, self.memory["data"])

    def _remember(self, data):
        data.time += bool(np.abs(self.data.qpos).max() < 0.9)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        self.remember()
        info["success"] = info["success"] and self.memory["data"].time < self.most
        return observation, reward, terminated, truncated, info


def test_a_second_state_of_mujoco_is_remembered_and_may_not_outlast_resets():
    with pytest.raises(BadInput, match=r"outlasts resets \(memory\['data'\]\), "):
        from_gymnasium(Sticky, steps=60)
    harmless = type("Harmless", (Sticky,), {"most": np.inf})
    task = from_gymnasium(harmless, steps=60)
    assert ends(task) == ends(task)
    assert not task.abilities.restarts


@pytest.mark.long
def test_variables_of_a_script_are_not_those_of_its_environment(monkeypatch):
    script = type(sys)("a_script")
    monkeypatch.setitem(sys.modules, "a_script", script)
    scripted = type("Scripted", (Puck,), {"__module__": "a_script"})
    script.results = []
    task = from_gymnasium(scripted, steps=60)
    agent = from_callable(lambda o: np.clip(pilot(np.asarray(o)), -4, 4), task)
    for _ in range(2):
        script.results.append(simulate(task, agent, STARTS[0]).outcome)
    assert script.results == ["reached"] * 2


def test_what_cannot_be_written_down_is_compared_as_an_object():
    env = Puck()
    env.rows = (number for number in range(3))
    before = fingerprint(env, env.model, env.data)
    assert isinstance(before["rows"], Unknown)
    assert before == fingerprint(env, env.model, env.data)
    env.rows = (number for number in range(3))
    assert before != fingerprint(env, env.model, env.data)
    assert Unknown() != Unknown()


# ---- steps, data and observations


class Braking(Puck):
    def step(self, action):
        if self.data.qpos[0] > 0.2:
            self.model.opt.timestep = 0.01
        return super().step(action)


class Replaced(Puck):
    def step(self, action):
        result = super().step(action)
        if self.data.qpos[0] > 0.2:
            fresh = mujoco.MjData(self.model)
            fresh.qpos[:], fresh.qvel[:] = self.data.qpos, self.data.qvel
            self.data = fresh
        return result


class Blind(Puck):
    def _get_obs(self):
        seen = super()._get_obs()
        seen["to_goal"] = seen["to_goal"] / (self.data.qpos[0] < 1.2)
        return seen


class Exiting(Puck):
    def step(self, action):
        sys.exit("emergency stop")


@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Braking, "a step of Braking takes|changes|goes another way"),
        (Replaced, "has another model or data of MuJoCo after an episode|goes another way"),
        (Blind, "Blind observes -?(inf|nan) in observation"),
        (Exiting, "step\\(\\) of Exiting raises SystemExit: emergency stop: repair it"),
    ],
)
def test_steps_that_are_unlike_others_are_refused(make, message):
    with pytest.raises(BadInput, match=message):
        outcomes(make)


class Proximity(Puck):
    """Shows how far the rock is, as step() has found it, and 1 beyond 0.4 m."""

    observation_space = spaces.Dict(
        {**Puck.observation_space.spaces, "proximity": spaces.Box(0, 1, (1,))}
    )

    def reset(self, **options):
        self.proximity = 1.0
        return super().reset(**options)

    def step(self, action):
        result = super().step(action)
        off = np.linalg.norm(np.maximum(np.abs(self.data.qpos) - 0.3, 0))
        self.proximity = min(1.0, off / 0.4)
        return self._get_obs(), *result[1:]

    def _get_obs(self):
        return super()._get_obs() | {"proximity": np.array([self.proximity])}


class Since(Puck):
    """Has arrived when it is far from where it started."""

    def reset(self, **options):
        result = super().reset(**options)
        self.begun = self.data.qpos.copy()
        return result

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        info["success"] = bool(np.linalg.norm(self.data.qpos - self.begun) > 0.3)
        return observation, reward, terminated, truncated, info


def test_a_sensor_that_step_reads_is_found_where_it_shows_something():
    with pytest.raises(BadInput, match=r"does not follow its state.*runs in different places"):
        from_gymnasium(Proximity)


def test_what_a_reset_notes_of_its_own_start_is_refused():
    with pytest.raises(BadInput, match="each reset of Since draws begun"):
        from_gymnasium(Since)


class Rare(Puck):
    """Says that it has arrived only where it has."""

    def step(self, action):
        observation, reward, terminated, truncated, _ = super().step(action)
        return (
            observation,
            reward,
            terminated,
            truncated,
            {"is_success": True} if reward > -0.25 else {},
        )


def test_an_entry_of_info_that_only_a_success_brings_is_taken():
    task = from_gymnasium(Rare, steps=60)
    assert task.found["success"].startswith('info["is_success"]')
    assert ends(task) == plain()
    with pytest.raises(BadInput, match="no method of it has that word"):
        from_gymnasium(Rare, success='info["solved"]')


# ---- what an id, or a name, stands for


@pytest.mark.long
def test_of_two_functions_of_one_name_neither_is_taken_for_the_other():
    def made(scale):
        def make():
            return setattr(env := Puck(), "scale", scale) or env

        return make

    one = from_gymnasium(made(1.0), steps=5)
    assert get_task(one.spec) is one
    two = from_gymnasium(made(2.0), steps=5)
    with pytest.raises(BadInput, match="two functions are called make"):
        get_task(one.spec)
    one = None
    assert get_task(two.spec) is two


class Legs(Puck):
    """Succeeds at the last of several goals, which options give as a list."""

    def reset(self, *, seed=None, options=None):
        self.goals = (options or {"goals": [0.0]})["goals"] * 2
        return super().reset(seed=seed)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        info["success"] = info["success"] and len(self.goals) == 4
        return observation, reward, terminated, truncated, info


@pytest.mark.long
def test_options_of_a_reset_are_what_they_were_given_as_and_an_id_may_come_to_mean_another(
    monkeypatch,
):
    assert outcomes(Legs, reset={"goals": [1.0, 2.0]}) == plain()
    seen, given = [], {"reset": {"goals": np.array([1.0, 2.0])}}

    def looked(description, untried):
        seen.append(description)
        raise BadInput("looked at")

    gym.register("Legs-v0", Legs, max_episode_steps=60)
    try:
        task = from_gymnasium("Legs-v0", **given)
        assert ends(task) != plain()
        assert '{"array": [1.0, 2.0]}' in task.spec
        assert from_gymnasium("Legs-v0", **given) is task
        gym.registry.pop("Legs-v0")
        gym.register("Legs-v0", Exiting)
        with pytest.raises(BadInput, match="emergency stop"):
            from_gymnasium("Legs-v0", **given)
        monkeypatch.setattr(making, "inspect", looked)
        with pytest.raises(BadInput, match="looked at"):
            get_task(task.spec)
        assert isinstance(seen[0].reset["goals"], np.ndarray)
    finally:
        gym.registry.pop("Legs-v0")


class Configured(Puck):
    """It takes its settings out of a dictionary, and its model from a file."""

    def __init__(self, settings):
        super().__init__()
        self.share, self.model = (
            settings.pop("share", 1.0),
            mujoco.MjModel.from_xml_path(settings["file"]),
        )
        self.data = mujoco.MjData(self.model)


@pytest.mark.long
def test_settings_are_as_given_in_each_instance_and_a_file_that_changes_is_read_again(tmp_path):
    file = tmp_path / "puck.xml"
    file.write_text(XML)
    given = {"settings": {"share": 0.5, "file": str(file)}}
    gym.register("Configured-v0", Configured)
    try:
        task = from_gymnasium("Configured-v0", kwargs=given, steps=5)
        given["settings"]["share"] = 0.1
        assert Instance(task.specification).inner.share == 0.5
        given["settings"]["share"] = 0.5
        assert from_gymnasium("Configured-v0", kwargs=given, steps=5) is task
        file.write_text(XML.replace('mass="1"', 'mass="2"'))
        other = from_gymnasium("Configured-v0", kwargs=given, steps=5)
        assert (task.model.body_mass[-1], other.model.body_mass[-1]) == (1, 2)
    finally:
        gym.registry.pop("Configured-v0")


class Clipping(Puck):
    """What it observes is what one of its two observers says: they differ where it is fast."""

    def get_obs(self):
        return super()._get_obs()

    def observe(self):
        seen = self.get_obs()
        return seen | {"position": np.clip(seen["position"], -1.45, 1.45)}

    def reset(self, **options):
        super().reset(**options)
        self.data.qpos[0] = max(self.data.qpos[0], -1.4)
        mujoco.mj_forward(self.model, self.data)
        return self.observe(), {}

    def step(self, action):
        result = super().step(0 * action)
        return self.observe(), *result[1:]


@pytest.mark.long
def test_of_several_observers_the_one_that_is_called_counts():
    task = from_gymnasium(Clipping, steps=5)
    noise = np.zeros((6, 1, len(task.noisy)))
    noise[:, :, 0] = -0.1
    agent = from_callable(lambda o: np.zeros((len(o), 2)), task)
    (arc,) = simulate(task, agent, [[-1.4, 0.0]], Recorded(noise, 0.1))
    assert arc.measured[0, 2] == -1.45


def test_sensors_that_hold_their_values_are_refused():
    class Held(Puck):
        def __init__(self):
            super().__init__()
            sensor = (
                '<sensor><jointpos name="px" joint="x" delay="0.1" nsample="6"/></sensor></mujoco>'
            )
            self.model = mujoco.MjModel.from_xml_string(XML.replace("</mujoco>", sensor))
            self.data = mujoco.MjData(self.model)

    with pytest.raises(BadInput, match=r"hold or delay what they measure \(px\)"):
        from_gymnasium(Held)


class Stamped(Puck):
    """Computes one part of what it observes once for each time."""

    stamp, seen = 0.0, np.zeros(2)

    def _get_obs(self):
        if self.data.time != self.stamp:
            self.stamp, self.seen = self.data.time, GOAL - self.data.qpos
        now = {"to_goal": self.seen if self.data.time else GOAL - self.data.qpos}
        return super()._get_obs() | now

    def reset(self, **options):
        self.stamp, self.seen = 0.0, np.zeros(2)
        return super().reset(**options)


def test_what_is_computed_once_for_each_time_is_refused():
    with pytest.raises(BadInput, match=r"is not what it observes in its state|computes what it"):
        from_gymnasium(Stamped, steps=60)


def test_one_environment_in_place_of_what_makes_it_is_refused():
    env = Puck()
    with pytest.raises(
        BadInput, match=r"this Puck is one environment, .* a function that makes it"
    ):
        from_gymnasium(env)
    with pytest.raises(BadInput, match=r"gives the same environment each time, .* make a new one"):
        from_gymnasium(lambda: env)


# ---- what is honest


class Settling(Puck):
    """Its reset takes some steps."""

    def reset(self, **options):
        super().reset(**options)
        for _ in range(2):
            self.step(np.zeros(2))
        self.data.qvel[:] = 0
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}


@pytest.mark.parametrize(
    "wrap", [pytest.param(lambda env: env, marks=pytest.mark.long), FlattenObservation]
)
def test_a_reset_may_step_the_environment(wrap):
    (found,) = outcomes(lambda: wrap(Settling()), starts=STARTS[:1])
    assert found == plain()[0]


def test_a_run_that_begins_in_a_wall_is_over():
    still = from_callable(lambda o: np.zeros((len(o), 2)), flat())
    (arc,) = simulate(flat(), still, [[0.0, 0.0]])
    assert (arc.outcome, len(arc.t)) == ("crashed", 1)


def test_an_episode_may_end_in_the_middle_of_a_step():
    class Short(Puck):
        def step(self, action):
            self.data.ctrl[:] = np.clip(action, -4, 4)
            for _ in range(5):
                mujoco.mj_step(self.model, self.data)
                off = float(np.linalg.norm(self.data.qpos - GOAL))
                if off < 0.25:
                    break
            return self._get_obs(), -off, off < 0.25, False, {"success": off < 0.25}

    assert {outcome for outcome, _ in outcomes(Short)} == {"reached"}


def test_processes_of_a_task_that_nobody_has_end():
    before = {*multiprocessing.active_children()}
    tasks = [from_gymnasium(Puck, steps=2, seed=seed) for seed in range(2)]
    made = {*multiprocessing.active_children()} - before
    assert len(made) >= 2
    del tasks
    making._RECENT.clear()
    gc.collect()
    until = time.monotonic() + 10
    while made & {*multiprocessing.active_children()} and time.monotonic() < until:
        time.sleep(0.05)
    assert not made & {*multiprocessing.active_children()}


# ---- what outlasts resets


def normalised(load):
    env = NormalizeObservation(FlattenObservation(Puck()))
    env.obs_rms.mean, env.obs_rms.var = (
        (env.obs_rms.mean + 0.1, env.obs_rms.var) if load else (0, 1)
    )
    env.update_running_mean = not load
    return env


class Weakening(Puck):
    """Its motors weaken with the episodes; one that counts on is like new in all that matters."""

    episodes, weakens = 0, True

    def reset(self, **options):
        self.episodes += 1
        return super().reset(**options)

    def step(self, action):
        action *= max(0.2, 1 - 0.02 * self.episodes) if self.weakens else 0.5
        return super().step(action)


class OwnGenerator(Puck):
    """Its resets draw the goal by a generator of the constructor."""

    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng(42)

    def reset(self, **options):
        self.aim = self.rng.uniform(-1.5, 1.5)
        return super().reset(**options)


class Lagging(Puck):
    """Its motors lag behind, and its resets do not set that back."""

    def __init__(self):
        super().__init__()
        xml = XML.replace("<motor", '<general dyntype="filter" dynprm="1"')
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.data.qpos[:], self.data.qvel[:] = [-1.4, 0.5], 0
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}


class InTurn(Puck):
    """Three goals in turn."""

    turn = 0

    def reset(self, **options):
        self.turn = (self.turn + 1) % 3
        return super().reset(**options)

    def _get_obs(self):
        to_goal = GOAL + np.array([0, self.turn]) - self.data.qpos
        return super()._get_obs() | {"to_goal": to_goal}


class Promoted(Puck):
    """After a success its motors get weaker."""

    level = 0

    def step(self, action):
        *result, info = super().step(action * 0.8**self.level)
        self.level += info["success"]
        return *result, info


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Lagging, r"Lagging changes .* outlasts resets \(MuJoCo's time, .*'s act.* mj_resetData"),
        (lambda: FlattenObservation(InTurn()), r"changes from .* outlasts resets \(.*turn\)"),
        (Promoted, r"outlasts resets \(level\), "),
        (lambda: normalised(False), r"outlasts .*obs_rms.*set update_running_mean = False"),
        (Weakening, r"outlasts resets \(episodes\), "),
        (
            OwnGenerator,
            r"draws random numbers in reset\(\), from a generator .* not decide \(rng\)",
        ),
    ],
)
def test_what_changes_from_episode_to_episode_is_refused(make, message):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make)


class Seeded(Puck):
    """Its motors are as they should be where its resets have a seed."""

    def reset(self, *, seed=None, options=None):
        observation = super().reset(seed=seed)
        self.share = 1.0 if seed is not None else self.np_random.uniform(0.5, 0.9)
        return observation

    def step(self, action):
        return super().step(action * self.share)


class Champion(Puck):
    """After eight successes its motors get weaker."""

    def __init__(self):
        super().__init__()
        self.wins = []

    def step(self, action):
        *result, info = super().step(action * (1 if len(self.wins) < 8 else 0.5))
        self.wins += [True] * info["success"]
        return *result[:2], info["success"], False, info


class Picky(Puck):
    """Resets draw on which side of the goal it has to arrive, as it learns there."""

    def reset(self, *, seed=None, options=None):
        observation = super().reset(seed=seed)
        self.side = int(self.np_random.choice([-1, 1]))
        return observation

    def step(self, action):
        *result, info = super().step(action)
        return *result, {"success": info["success"] and self.data.qpos[1] * self.side > 0}


@pytest.mark.first(1)
@pytest.mark.parametrize(("make", "what"), [(Seeded, "share"), (Champion, "wins"), (Picky, "side")])
def test_an_environment_that_is_never_replaced_is_a_judge_too(make, what):
    starts = np.random.default_rng(0).uniform((-1.8, 0.7), (1, 1.2), (30, 2))
    with pytest.raises(
        BadInput, match=rf"in a later one. It depends on .*resets .*{what}.*; let reset"
    ):
        outcomes(lambda: FlattenObservation(make()), steps=140, starts=starts)


@pytest.mark.long
def test_statistics_that_are_loaded_are_kept_and_a_count_is_said():
    from_gymnasium(lambda: normalised(True))
    task = from_gymnasium(type("Counting", (Weakening,), {"weakens": False}))
    assert "because of what outlasts resets (episodes)" in task.found["episodes"]


# ---- generators of their own


class Rough(Puck):
    """Each step beside the rock draws from a generator of its own, or only has it."""

    draws, make, draw = True, None, None

    def __init__(self):
        super().__init__()
        self.source = self.make()

    def step(self, action):
        if self.draws and abs(self.data.qpos[0]) < 1.5:
            self.draw(self.source)
        return super().step(action)


SOURCES = {
    "random": (lambda _: random.Random(3), lambda _, source: source.random()),
    "method": (lambda _: random.Random(3).random, lambda _, source: source()),
    "system": (lambda _: random.SystemRandom(), lambda _, source: source.random()),
    "bits": (lambda _: [np.random.PCG64(1)], lambda _, source: source[0].random_raw()),
    "torch": (lambda _: torch.Generator(), lambda _, source: torch.rand(1, generator=source)),
    "global": (lambda _: 0, lambda *_: torch.rand(1)),
}


@pytest.mark.parametrize(("make", "draw"), SOURCES.values(), ids=SOURCES)
def test_random_numbers_in_steps_are_noticed_whoever_draws_them(make, draw):
    kind = type("Drawing", (Rough,), {"make": make, "draw": draw})
    with pytest.raises(BadInput, match=r"draws random numbers in step\(\) \((source|a global)"):
        from_gymnasium(kind)


@pytest.mark.long
def test_generators_that_nobody_draws_from_are_like_any_memory():
    makes = [make for name, (make, _) in SOURCES.items() if name != "system"]
    values = {"make": lambda self: [make(self) for make in makes], "draws": False}
    found = from_gymnasium(type("Holding", (Rough,), values)).specification
    assert found.memoryless
    assert "episodes" not in found.found


class Alarmed(Puck):
    """Remembers in an event of `threading` whether it has been near the right wall."""

    def __init__(self):
        super().__init__()
        self.alarm = threading.Event()

    def reset(self, **options):
        self.alarm.clear()
        return super().reset(**options)

    def step(self, action):
        if self.data.qpos[0] > 0.9:
            self.alarm.set()
        return super().step(action * (0.3 if self.alarm.is_set() else 1.0))


class Cameras(Puck):
    """Remembers in a camera of its model how often it has been stepped."""

    def __init__(self):
        super().__init__()
        xml = XML.replace("<worldbody>", '<worldbody><camera name="eye"/>')
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)

    def step(self, action):
        self.model.cam_fovy[0] += 1e-3
        return super().step(action)


@pytest.mark.parametrize("make", [Alarmed, Cameras])
def test_what_events_and_cameras_hold_is_remembered(make):
    env = make()
    env.reset(seed=0)
    before = fingerprint(env, env.model, env.data)
    env.data.qpos[:] = 1.0, 0.5
    env.step(np.zeros(2))
    assert fingerprint(env, env.model, env.data) != before


class Hidden(array.array):
    """Has attributes, and keeps numbers in C beside them."""


def test_what_objects_of_c_keep_is_written_down_or_unknown():
    env = Puck()
    env.kept = Hidden("d", [1.0])
    env.kept.name = "row"
    before = fingerprint(env, env.model, env.data)
    env.kept[0] = 2.0
    assert fingerprint(env, env.model, env.data) != before
    env.kept = type("Lock", (threading.local,), {})()
    assert not is_known(fingerprint(env, env.model, env.data))


def test_what_an_environment_writes_into_its_model_for_itself_is_remembered():
    xml = '<mujoco><size nuser_geom="1"/><worldbody><geom size="1"/></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    before = of_model(model)
    model.geom_user[0, 0] = 1.0
    assert of_model(model) != before


# ---- what an agent and an environment hand to each other


class Levels(Puck):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(-4, 4, (2,), dtype=np.int64)


class Counted(Puck):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(3, start=-1)


class Stale(Puck):
    """Its reset computes nothing of the place that it leads to."""

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform((-1.8, -1.2), (-1.0, 1.2))
        return self._get_obs(), {}

    def _get_obs(self):
        return super()._get_obs() | {"position": self.data.body("puck").xpos[:2].copy()}


class Clock(gym.Wrapper):
    """Asks the time limit below it."""

    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        return observation, reward - self.env._elapsed_steps, *rest


class Beginning(Puck):
    """Observes how fast it has gone so far, which at the start is 0 / 0."""

    def _get_obs(self):
        rate = float("nan") if self.data.time == 0 else 0.0
        return super()._get_obs() | {"to_goal": np.array([rate, 0.0])}


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        (Levels, {}, "Levels takes a Box of int64 as its actions, .* would be rounded"),
        (Counted, {}, r"counts its actions from -1, .*: let it take Discrete\(3\)"),
        (Stale, {}, r"of Stale returns observation\[0\] of another place .* mj_forward before it"),
        (lambda: Clock(TimeLimit(Puck(), 60)), {}, "do without TimeLimit, which is left out"),
        (Beginning, {}, r"Beginning observes nan in observation\[\d\]"),
        (
            lambda: RecordEpisodeStatistics(Puck()),
            {"success": 'info["episode"]["r"] > 0'},
            "runs are played without RecordEpisodeStatistics, so say it by reward",
        ),
    ],
)
def test_what_would_be_handed_on_otherwise_is_refused(make, given, message):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make, **given)


def test_clipped_actions_have_the_limits_within():
    wrapped = lambda: FlattenObservation(ClipAction(Puck()))  # noqa: E731
    task = from_gymnasium(wrapped, steps=60)
    assert ends(task) == plain()
    assert task.input_limits[1].tolist() == [4.0, 4.0]


class Slow(Puck):
    def step(self, action):
        time.sleep(0.03)
        return super().step(action)


def test_a_slow_environment_is_said_to_take_minutes(caplog):
    for kind in (Puck, Slow):
        inspection._check_times(Instance(EnvironmentSpec(Description(kind))))
    assert [re.sub(r"\d+", "N", text) for text in caplog.messages] == [
        "Slow takes N ms for a reset and N ms for a step: to look at it, before anything else, takes about N "
        "minute(s)"
    ]


# ---- sensors that measure in a small place, or late


class Tag(Puck):
    """A tag on the floor tells the place, and that fix is observed ever after."""

    def reset(self, **options):
        self.fix = np.zeros(2)
        return super().reset(**options)

    def step(self, action):
        found = super().step(action)
        if self.sees():
            self.fix = self.data.qpos.copy()
        return self._get_obs(), *found[1:]

    def sees(self):
        return (self.data.qpos > (1.95, 1.35)).all()  # in a corner

    def _get_obs(self):
        fix = getattr(self, "fix", np.zeros(2))
        return super()._get_obs() | {"to_goal": fix}


class Fix(Tag):
    """It comes every 130 samples."""

    def reset(self, **options):
        self.k = 0
        return super().reset(**options)

    def sees(self):
        self.k += 1
        return self.k % 130 == 0


class Timed(Fix):
    """Observes the last action, and how many times 50 samples have passed, which no place changes."""

    def sees(self):
        return False

    def step(self, action):
        self.k += 1
        self.fix = np.array([action[0], self.k // 50])
        return super().step(action)


@pytest.mark.long
def test_sensors_that_measure_late_or_in_a_small_place_are_refused():
    with pytest.raises(BadInput, match=r"Fix observes does not follow its state: observation\[2\]"):
        from_gymnasium(Fix, steps=150)
    with pytest.raises(
        BadInput, match=r"observation\[\d\] of Tag is not .* step\(\) has stored it"
    ):
        from_gymnasium(Tag, steps=60)  # runs with noise come there


def test_what_is_remembered_apart_from_the_place_is_observed_under_noise():
    task = from_gymnasium(Timed, steps=60)
    agent = from_callable(lambda o: np.full((len(o), 2), 0.5), task)
    arcs = simulate(task, agent, STARTS, Noise("uniform", 0.1))
    assert task.specification.recalled.tolist() == [False, False, True, True, False, False]
    assert all(len(arc.t) for arc in arcs)
