"""Wrappers, noise and ends: episodes are played as the environment plays them, or it is refused by name."""

import abc
import copy
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from environments import (
    GOAL,
    STARTS,
    XML,
    Delayed,
    Flat,
    Puck,
    always,
    ends,
    flat_task,
    numbers,
    outcomes,
    pilot,
    plain,
)  # fmt: skip
from gymnasium import spaces
from gymnasium.wrappers import (
    ClipAction,
    DelayObservation,
    DtypeObservation,
    FlattenObservation,
    FrameStackObservation,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
    TimeLimit,
)
from planted import without_judges

from hyrl_mj import BadInput, Noise, closed_loop, from_callable, from_gymnasium, simulate
from hyrl_mj.gym_import import trials
from hyrl_mj.gym_import.opening import Description
from hyrl_mj.gym_import.pool import Pool
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import LoopSettings, Programmes, Recorded, Rules

pytestmark = pytest.mark.slow  # a second for each environment


@pytest.fixture(autouse=True)
def unjudged(request, monkeypatch):
    """New instances judge the runs of tests; those of inspections only for tests that ask for `judged`."""
    if "judged" not in request.fixturenames:
        without_judges(monkeypatch)


@pytest.fixture
def judged():
    """See `unjudged`."""


# ---- ways on which noise does not come


class Telling(Flat):
    """Does not observe its place, and tells something of it in info or in an attribute."""

    tells = ""

    def _get_obs(self):
        return np.concatenate([np.zeros(2), GOAL - self.seen(), self.data.qvel])

    def begin(self, place):
        self.keep(place)

    def step(self, action):
        *found, info = super().step(action)
        place = self.seen()
        self.keep(place)
        return *found, info | ({"x": float(place[0])} if self.tells == "x" else {})

    def keep(self, place):
        kept = {"pose": place, "above": bool(place[1] > 0)}
        vars(self).update({name: kept[name] for name in kept if name == self.tells})


class By(gym.Wrapper):
    """Shows in place of the first numbers of an observation what else a step tells."""

    def __init__(self, env, look):
        super().__init__(env)
        self.look = look

    def step(self, action):
        observation, *rest = self.env.step(action)
        told = np.ravel(self.look(self, *rest))
        return np.append(told, observation[len(told) :]), *rest


class ByLastInfo(gym.Wrapper):
    """Shows what it was told a sample before."""

    def reset(self, **options):
        self.told = -1.4
        return self.env.reset(**options)

    def step(self, action):
        observation, *rest = self.env.step(action)
        before, self.told = self.told, rest[-1]["x"]
        return np.append(before, observation[1:]), *rest


class Before(gym.Wrapper):
    """Shows where the robot was before the step."""

    def step(self, action):
        before = self.unwrapped.data.qpos.copy()
        observation, *rest = self.env.step(action)
        return np.append(before, observation[2:]), *rest


class Odometer(gym.Wrapper):
    """Shows how far it has come from its start."""

    def reset(self, **options):
        found = self.env.reset(**options)
        self.begun = self.unwrapped.data.qpos.copy()
        return found

    def step(self, action):
        observation, *rest = self.env.step(action)
        return np.append(self.unwrapped.data.qpos - self.begun, observation[2:]), *rest


class Copying(gym.Wrapper):
    def step(self, action):
        copy.deepcopy(self.env)
        return self.env.step(action)


def telling(what):
    return type("Telling", (Telling,), {"tells": what})()


def by(what, look):
    return lambda: By(telling(what), look)


TOLD = r"a wrapper of .* shows in observation\[[01]\], after \d+ sample\(s\), more of the robot"
WAYS = {
    "info": by("x", lambda env, *rest: rest[-1].get("x", -1.4)),
    "the last info": lambda: ByLastInfo(telling("x")),
    "an attribute": by("pose", lambda env, *_: env.unwrapped.pose),
    "a truth": by("above", lambda env, *_: env.unwrapped.above),
    "the reward": lambda: By(Flat(), lambda env, reward, *_: reward),
    "the state": by("", lambda env, *_: env.unwrapped.data.qpos),
    "a cell": by("", lambda env, *_: np.round(env.unwrapped.data.qpos)),
    "derived quantities": lambda: Placed(Flat()),
    "the place before": lambda: Before(Flat()),
    "the way": lambda: Odometer(Flat()),
}


@pytest.fixture(scope="module")
def telling_nothing():
    """What is known of an environment in a wrapper that shows nothing past the noise."""
    return from_gymnasium(by("", lambda *_: []), steps=20).specification


@pytest.mark.parametrize("way", WAYS)
def test_wrappers_that_observe_the_place_past_the_noise_are_refused(way, telling_nothing, judged):
    pool = Pool(Description(WAYS[way], steps=20))
    pool.learn(replace(telling_nothing, description=pool.spec.description))
    with pytest.raises(BadInput, match=TOLD):
        trials.check_noise(pool)


def test_wrappers_that_copy_the_environment_are_refused():
    with pytest.raises(BadInput, match="copies the environment, and noise reaches no copies"):
        from_gymnasium(lambda: Copying(Flat()), steps=20)


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


class Placed(gym.ObservationWrapper):
    """Shows where the body is, which the environment computes a physics step before the end of a step."""

    def observation(self, observation):
        return np.append(self.unwrapped.data.body("puck").xpos[:2], observation[2:])


def test_wrappers_that_read_the_place_seldom_are_refused_in_runs():
    task = from_gymnasium(lambda: Fixes(Flat()), steps=60)  # no trial is so long
    with pytest.raises(BadInput, match=r"shows in observation\[4\], after 45 sample"):
        simulate(task, always(task, 0, 0), [-1.4, 0.5], Noise("uniform", 0.1))


class OnTheLastStep(gym.Wrapper):
    """Tells success when the time is over."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, info | {"success": truncated}


class Steered(gym.Wrapper):
    """Drives to setpoints by what it observes, and judges by that, too."""

    def reset(self, **options):
        self.seen, info = self.env.reset(**options)
        return self.seen, info

    def step(self, action):
        push = 0.8 * np.clip(action, -3, 3) - self.seen[4:] - 0.3 * self.seen[:2]
        self.seen, reward, *ends, _ = self.env.step(np.clip(push, -4, 4))
        return self.seen, reward, *ends, {"success": bool(np.linalg.norm(self.seen[2:4]) < 0.25)}


@pytest.mark.parametrize(
    ("make", "noise", "steps", "message"),
    [
        (lambda: Steered(Flat()), 0.2, 60, "running without the noise, which must not judge"),
        (
            lambda: OnTheLastStep(TimeLimit(Flat(), 10)), 0.0, None,
            r"after 10 sample\(s\) it is stalled, and reached in the",
        ),
    ],
)  # fmt: skip
def test_wrappers_that_judge_by_what_episodes_do_not_show_are_refused_in_runs(
    make, noise, steps, message
):
    with pytest.raises(BadInput, match=message):
        outcomes(make, noise, steps)


# ---- wrappers do what they do


class Judged(gym.Wrapper):
    """Tells success from MuJoCo's state."""

    def step(self, action):
        observation, _, terminated, truncated, _ = self.env.step(action)
        off = np.linalg.norm(self.unwrapped.data.qpos - GOAL)
        return observation, -off, terminated, truncated, {"success": bool(off < 0.25)}


class InPlace(gym.ObservationWrapper):
    """Changes what it is given, as a list, or a dictionary of which it takes entries away."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = numbers(6)

    def observation(self, observation):
        if isinstance(observation, dict):
            place, to_goal = observation.pop("position"), observation.pop("to_goal")
            return np.concatenate([place, to_goal, observation.pop("velocity")])
        return observation[:2] + observation[2:]  # of arrays a sum


class Usual(Flat):
    """Has attributes of any kind, a list for an observation, an array for a reward, None for `truncated`.

    Its reset takes some steps.
    """

    walls = [[1, 2], [3]]

    def __init__(self):
        super().__init__()
        self.rooms, self.rows = [[1, 2], [3]], iter([1])

    def _get_obs(self):
        return super()._get_obs().tolist()

    def reset(self, **options):
        super().reset(**options)
        for _ in range(2):
            self.step(np.zeros(2))
        self.data.qvel[:] = 0
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def step(self, action):
        observation, reward, terminated, _, info = super().step(action)
        return observation, np.array([reward]), terminated, None, info


class Judging(Flat):
    """Judges by its own observation, which it is given without noise, and tells nothing but success."""

    def step(self, action):
        observation, _, terminated, truncated, _ = super().step(action)
        off = float(np.linalg.norm(observation[2:4]))
        return observation, -off, terminated, truncated, {"success": True} if off < 0.25 else {}


ALIKE = {
    "usual habits, clipped actions and a judge of the state": (
        lambda: ClipAction(Judged(InPlace(Usual()))), 0.2,
    ),
    "entries that are taken": (lambda: InPlace(Puck()), 0.1),
    "a judge of its own observation": (Judging, 0.1),
}  # fmt: skip


class Halved(gym.Wrapper):
    """Takes other actions, which a property tells, and stumbles over errors as its constructor asks for."""

    def __init__(self, env):
        super().__init__(env)
        np.seterr(over="raise")

    @property
    def action_space(self):
        return spaces.Box(-1.0, 1.0, (2,), dtype=np.float64)

    def step(self, action):
        try:
            return self.env.step(np.asarray(action) * np.exp(np.float64(999)))
        except FloatingPointError:
            return self.env.step(np.asarray(action) * 4.0)


def test_a_wrapper_has_the_actions_and_the_context_of_its_own():
    with np.errstate():
        task = from_gymnasium(lambda: ClipAction(Halved(Flat())), steps=60)
        assert task.input_limits[1].tolist() == [1.0, 1.0]
        assert ends(task, pilot=lambda o: np.clip(pilot(o), -4, 4) / 4) == plain()


class Portal(gym.Wrapper):
    """Moves the robot, where it comes near the goal."""

    def step(self, action):
        result, place = self.env.step(action), self.unwrapped.data.qpos
        place[0] += 0.05 * (place[0] > 1.2 and abs(place[1]) < 0.4)
        return result


def test_a_wrapper_that_seldom_moves_the_robot_after_a_step_is_refused_in_runs():
    with pytest.raises(BadInput, match=r"moves the robot in its step\(\) after that of the env"):
        outcomes(lambda: Portal(Flat()))


class Endless(gym.Wrapper):
    """Takes all ends away."""

    def step(self, action):
        observation, reward, _, _, info = self.env.step(action)
        return observation, reward, False, False, info


@pytest.mark.parametrize("success", [None, "truncated"])
def test_a_time_limit_whose_end_a_wrapper_takes_away_is_refused_in_runs(success):
    with pytest.raises(BadInput, match="goes on after the 20 steps of its TimeLimit"):
        outcomes(lambda: Endless(TimeLimit(Flat(), 20)), steps=None, success=success)
    assert outcomes(lambda: Endless(TimeLimit(Flat(), 20))) == plain()


class Pooled(Flat):
    """Steps in a thread of its own, as each instance has one, which outlasts resets."""

    def __init__(self):
        super().__init__()
        self.threads = ThreadPoolExecutor(1)

    def control(self, action):
        self.threads.submit(super().control, action).result()


class Clocked(Flat):
    """Notes the second in which it was reset, which two instances may have in common."""

    def reset(self, **given):
        self.began = int(time.time())
        return super().reset(**given)


class Helped(Flat, abc.ABC):
    """Has methods that need no instance."""

    @staticmethod
    def same(off):
        return off

    @classmethod
    def near(cls, off):
        return off < 0.25

    def arrived(self, off):
        return self.near(self.same(off))


def test_what_each_instance_has_of_its_own_may_outlast_resets():
    assert outcomes(Pooled) == outcomes(Clocked) == plain()


def test_methods_that_need_no_instance_are_no_memory():
    assert from_gymnasium(Helped, steps=20).specification.memoryless


@pytest.mark.parametrize("name", ALIKE)
def test_runs_end_as_without(name):
    make, noise = ALIKE[name]
    task = from_gymnasium(make, steps=60)
    assert ends(task, noise) == plain(noise)
    assert ends(task) == plain()
    assert task.input_limits[1].tolist() == [4.0, 4.0]


class Stopwatch(gym.Wrapper):
    """Counts the samples at the goal in MuJoCo's data."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        data = self.unwrapped.data
        data.userdata[0] += info["success"]
        return observation, reward, terminated, truncated, {"success": bool(data.userdata[0] >= 3)}


class Counting(Flat):
    xml = XML.replace("<worldbody>", '<size nuserdata="1"/><worldbody>')


def test_what_wrappers_write_to_the_state_stays():
    found = outcomes(lambda: Stopwatch(Counting()), 0.2)
    assert {outcome for outcome, _ in found} == {"reached"}
    assert all(late >= early + 2 for (_, late), (_, early) in zip(found, plain(0.2), strict=True))


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


def test_attributes_that_change_belong_to_each_run_and_a_time_limit_below_a_wrapper_counts():
    task = from_gymnasium(lambda: Delayed(TimeLimit(Flat(), 200)))
    assert task.max_steps == 200
    assert not task.specification.memoryless
    rng = np.random.default_rng(0)
    z, u = task.starts(3, rng), rng.uniform(-4, 4, (6, 3, 2))
    late, plain = task.plant(3), flat_task().plant(3)
    for plant, t in ((late, task), (plain, flat_task())):
        plant.set_state(*t.state(z))
    plain.step(np.zeros((3, 2)))
    for before in u:
        late.step(before)
        np.testing.assert_allclose(late.qpos, plain.qpos, atol=1e-12)
        plain.step(before)


@pytest.mark.long
def test_loaded_statistics_and_what_is_shared_of_rewards_are_taken_and_a_count_is_said():
    def normalised():
        env = NormalizeObservation(Flat())
        env.obs_rms.mean, env.update_running_mean = env.obs_rms.mean + 0.1, False
        return env

    class Counting(Flat):
        episodes = 0

        def begin(self, place):
            self.episodes += 1

    for make in (normalised, lambda: NormalizeReward(Flat())):
        assert from_gymnasium(make, steps=20).max_steps == 20
    found = from_gymnasium(Counting, steps=20).found
    assert "because of what outlasts resets (episodes)" in found["episodes"]


# ---- ends of episodes


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
    arc = simulate(task, always(task, 0, 0), [-1.4, 0.5])
    assert (arc.outcome, len(arc.t) - 1) == (label, 20)


@pytest.mark.long
def test_the_shortest_of_several_time_limits_counts_and_a_run_may_be_simulated_for_longer():
    task = from_gymnasium(lambda: TimeLimit(DtypeObservation(TimeLimit(Flat(), 12), float), 60))
    assert task.max_steps == 12
    assert max(samples for _, samples in ends(task)) <= 12
    assert len(simulate(task, always(task, 0, 0), [-1.4, 0.5], horizon=2.0).t) - 1 == 20


class Terminating(Flat):
    """Reaching the goal ends the episode, as in the middle of a step, and so does touching something."""

    touching = False

    def step(self, action):
        self.data.ctrl[:] = np.clip(action, -4, 4)
        for _ in range(5):
            mujoco.mj_step(self.model, self.data)
            off = float(np.linalg.norm(self.data.qpos - GOAL))
            if off < 0.25:
                break
        ended = off < 0.25 or bool(self.touching and self.data.ncon)
        return self._get_obs(), (5.0 if off < 0.25 else -off), ended, False, {}


class Colliding(Terminating):
    touching = True


class Monitor(gym.Wrapper):
    """A user's wrapper with the name of one that only counts: this one turns the actions."""

    def step(self, action):
        return self.env.step(-np.asarray(action))


def east(observation):
    """An agent that drives to the right, and up or down by the second number that it sees."""
    up = np.where(observation[:, 1] > 0, 1.0, -1.0)
    return np.column_stack([np.full(len(observation), 1.5), up])


# 0.25 m, at which an episode ends, from 0.1 m above the goal: where it is now, not a physics step before.
NEAR = "distance(puck, goal) < 0.2693"
BOTH = f"terminated and reward >= 4 and {NEAR}"


@pytest.mark.parametrize(
    ("make", "success"),
    [
        (Terminating, NEAR),
        (Colliding, BOTH),
        (lambda: Monitor(Terminating()), "terminated"),
    ],
)
def test_an_end_at_the_goal_is_an_arrival_and_a_collision_is_none(make, success):
    task = from_gymnasium(make, success=success, steps=80)
    turned = -1 if success == "terminated" else 1
    agent = from_callable(lambda o: turned * east(o), task)
    assert simulate(task, agent, [1.2, 0.0]).outcome == "reached"
    if make is Colliding:
        assert simulate(task, agent, [-1.0, 0.0]).outcome == "crashed"


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        (Colliding, {"success": "terminated"}, "touches what it does not touch elsewhere"),
        (Puck, {"success": 'info["won"]'}, "that word: name an entry of info; it has had success"),
        (Puck, {"failure": 'info["success"]'}, "it is a success .* and a failure"),
        (type("Solved", (Puck,), {"arrived": lambda *_: True}), {}, "Solved is a success after its first"),
        (
            lambda: RecordEpisodeStatistics(Puck()), {"success": 'info["episode"]["r"] > 0'},
            "runs are played without RecordEpisodeStatistics, so say it by reward",
        ),
    ],
)  # fmt: skip
def test_conditions_that_mislead_are_refused(make, given, message, judged):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make, **given)


def test_a_run_that_begins_in_a_wall_is_over_and_so_is_one_that_has_arrived():
    task = flat_task()
    arc = simulate(task, always(task, 0, 0), [0.0, 0.0])
    assert (arc.outcome, len(arc.t)) == ("crashed", 1)
    # The rock ends at x = -0.3, and the puck is 0.1 m wide: it may touch no deeper than runs do.
    assert task.goes_on(np.array([[-0.41, 0.0], [-0.36, 0.0]])).tolist() == [True, False]
    plant = task.plant(1)
    plant.set_state(*task.state(np.array([[1.2, 0.0]])))
    for _ in range(6):  # nobody looks at it
        plant.step(np.array([[4.0, 0.0]]))
    assert plant.measurement[0, -1] == 1


# ---- what runs remember, and see


class Key(Flat):
    """The goal counts only once the robot has been at a key, far from where random inputs lead.

    What it observes holds the last action, and how many times 50 samples have passed.
    """

    observation_space = numbers(7)
    taken, last, k = False, np.zeros(2), 0

    def begin(self, place):
        self.taken, self.last, self.k = False, np.zeros(2), 0

    def control(self, action):
        self.last, self.k = np.array(action, dtype=float), self.k + 1
        super().control(action)

    def after(self):
        self.taken = self.taken or bool(self.data.qpos[0] > 1.3 and self.data.qpos[1] > 1.0)

    def arrived(self, off):
        return off < 0.25 and self.taken

    def _get_obs(self):
        return np.concatenate([self.data.qpos, self.data.qvel, self.last, [self.k // 50]])


def test_what_a_run_remembers_or_recalls_is_its_own():
    key = from_gymnasium(Key, steps=60)
    goal, at_key = [1.0, 0.0], [1.6, 0.9]
    for u, start in (([0, 4], at_key), ([4, 0], goal)):  # the latter have taken no keys
        arcs = simulate(key, always(key, *u), [start] * 2, horizon=3.0)
        assert [arc.outcome for arc in arcs] == ["stalled"] * 2
    plant = key.plant(2)
    plant.set_state(*key.state(np.array([[-1.0, 0.5], [-1.2, 0.0]])))
    plant.step(np.array([[1.0, 2.0], [3.0, -1.0]]))
    noise = np.zeros((2, key.measurement_columns))
    noise[:, :2] = 0.05
    observed = key.observation(plant.observe(plant.truth(np.arange(2)), noise, np.arange(2)))
    np.testing.assert_allclose(observed[:, 4:], [[1.0, 2.0, 0.0], [3.0, -1.0, 0.0]])
    np.testing.assert_allclose(observed[:, :2], plant.qpos + 0.05)
    assert key.specification.recalled.tolist() == [False] * 4 + [True] * 3
    assert not key.abilities.restarts


class Observing(Puck):
    """What it observes is what one of its two observers says: they differ where it is far to the left."""

    def get_obs(self):
        return super()._get_obs()

    def observe(self):
        seen = self.get_obs()
        return seen | {"position": np.clip(seen["position"], -1.45, 1.45)}

    def first(self):
        return np.maximum(super().first(), -1.4)

    def reset(self, **options):
        super().reset(**options)
        return self.observe(), {}

    def step(self, action):
        result = super().step(0 * action)
        return self.observe(), *result[1:]


@pytest.mark.long
def test_several_observers_have_to_agree():
    with pytest.raises(
        BadInput, match=r"get_obs\(\) and observe\(\) of Observing both give what it"
    ):
        outcomes(Observing, 0.2)


class Far(Flat):
    """Observes places on a map, of which single precision rounds half a metre; a reset has no options."""

    origin = np.array([652_341.0, 5_404_123.0, 0, 0, 0, 0])

    def reset(self, seed=None):
        return super().reset(seed=seed)

    def _get_obs(self):
        return super()._get_obs() + self.origin


def test_functions_get_the_precision_of_the_environment_and_a_reset_may_have_no_options():
    task = from_gymnasium(Far, steps=60)
    assert ends(task, pilot=lambda o: pilot(o - Far.origin)) == plain()


class Parts(Flat):
    """Observes parts within parts."""

    observation_space = spaces.Tuple(
        [spaces.Dict({"place": numbers(2), "to_goal": numbers(2)}), numbers(2)]
    )

    def _get_obs(self):
        place, to_goal, velocity = np.split(super()._get_obs(), 3)
        return {"place": place, "to_goal": to_goal}, velocity


def test_parts_within_parts_are_joined_in_their_order():
    assert outcomes(lambda: FlattenObservation(Parts()), 0.15) == plain(0.15)


def delayed_frames():
    """Shows the puck a sample late, and the frame before."""
    return FrameStackObservation(DelayObservation(FlattenObservation(Puck()), 1), 2)


@pytest.fixture(scope="module")
def framed():
    return from_gymnasium(delayed_frames, steps=25)


def test_noise_reaches_what_lies_around_an_environment_delays_and_frames(framed):
    rng, values = np.random.default_rng(0), np.zeros((6, 1, framed.measurement_columns))
    values[:, 0, :2] = rng.uniform(-0.1, 0.1, (6, 2))
    arc = simulate(
        framed, always(framed, 0.5, 0.1), [-1.0, 0.5], Recorded(values, 0.1), horizon=0.5
    )
    at = 2 * [*Puck.observation_space.spaces].index("position")
    last = arc.measured[4, 2:-3].reshape(-1, 6)[:, at : at + 2]
    np.testing.assert_allclose(last, (arc.z + values[:, 0, :2])[2:4], atol=1e-6)


@pytest.mark.parametrize("is_wrapped", [False, True])
@pytest.mark.parametrize("kind", ["none", "uniform", "alternating", "attack"])
def test_runs_do_not_depend_on_how_many_are_played_side_by_side(
    is_wrapped, kind, framed, monkeypatch
):
    task, rng = framed if is_wrapped else flat_task(), np.random.default_rng(0)
    loop = PolicyController(from_callable(east, task))
    z, found = task.starts(9, rng), []
    settings = LoopSettings(record=True, passing=True, steps=25)
    assert task.abilities.side_by_side > 9
    for side in (9, 2):
        monkeypatch.setattr(task, "abilities", replace(task.abilities, side_by_side=side))
        noise = Noise() if kind in ("none", "attack") else Noise(kind, 0.1)
        if kind == "attack":
            rules = Rules(task, loop, 0.1, np.array(task.noisy))
            programmes = np.random.default_rng(1).integers(rules.ahead, size=(9, 3))
            noise = Programmes(task, loop, rules, programmes, 4)
        run = closed_loop(task, loop, z, noise, seed=1, settings=settings)
        found.append((run, getattr(noise, "values", np.zeros(1)), getattr(noise, "danger", 0)))
    (a, *of_a), (b, *of_b) = found
    assert np.ptp(a.length) > 0
    for name in ("path", "length", "outcome", "q0", "before", "q", "u", "state"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)
    for i, end in enumerate(a.length):
        np.testing.assert_array_equal(a.measured[:end, i], b.measured[:end, i])
        np.testing.assert_array_equal(a.true[:end, i], b.true[:end, i])
    for one, other in zip((a.passing.turned, *of_a), (b.passing.turned, *of_b), strict=True):
        np.testing.assert_array_equal(one, other)


class Behind(Puck):
    """It observes places as `mj_step` leaves them behind: those of the physics step before.

    Around it there are no walls, but the rock.
    """

    xml = "\n".join(line for line in XML.splitlines() if '<geom type="box"' not in line)
    observation_space = gym.spaces.Dict({**Puck.observation_space.spaces, "was_at": numbers(2)})

    def _get_obs(self):
        was_at = self.data.xpos[self.model.body("puck").id, :2].copy()
        return super()._get_obs() | {"was_at": was_at}


def test_what_lags_by_a_physics_step_is_moved_by_noise_where_the_robot_was_then():
    task = from_gymnasium(Behind, steps=60)
    # Walls in the open do not end the chart.
    assert np.all(np.less(task.chart.low, [-1.8, -1.2]))
    assert np.all(np.greater(task.chart.high, [0.5, 1.2]))
    assert "a physics step before" in task.found["lag"]
    assert "lag" not in flat_task().found
    plant, rows = task.plant(2), np.arange(2)
    plant.set_state(*task.state(np.array([[-1.2, 0.4], [-1.2, 0.4]])))
    noise = np.zeros_like(plant.measurement)
    noise[1, :2] = 0.03, -0.02
    for _ in range(3):
        plant.step(np.tile([2.0, 1.0], (2, 1)))
    true, alike = plant.observe(plant.truth(rows), noise, rows)
    seen = slice(-3 - 2, -3)  # before reward, success and outcome
    assert not np.allclose(true[seen], true[:2], rtol=0, atol=1e-4)  # it moves
    np.testing.assert_allclose(alike[seen] - true[seen], noise[1, :2], rtol=0, atol=1e-12)


@pytest.mark.long
def test_variables_of_a_script_are_not_those_of_its_environment(monkeypatch):
    script = type(sys)("a_script")
    monkeypatch.setitem(sys.modules, "a_script", script)
    script.results = []
    task = from_gymnasium(type("Scripted", (Flat,), {"__module__": "a_script"}), steps=60)
    for _ in range(2):
        script.results.append(ends(task, starts=STARTS[:1]))
    assert script.results == [plain()[:1]] * 2
