"""Environments that mislead in what they step, draw, observe, keep or tell are refused by name."""

import array
import multiprocessing
import random
import re
import sys
import threading
import time
import timeit
from functools import partial

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from environments import GOAL, XML, Flat, Growing, Home, Moved, Puck, Secret, numbers, outcomes
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation, TimeLimit

from hyrl_mj import BadInput, from_gymnasium
from hyrl_mj.gym_import import inspection
from hyrl_mj.gym_import.fingerprint import Unknown, fingerprint, is_known
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.opening import Description
from hyrl_mj.gym_import.physics import Physics
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.system.generators import global_state, kept_generators

pytestmark = pytest.mark.slow  # a second for each environment
long = pytest.mark.long


def later(name):
    return pytest.param(name, marks=long)


# ---- what is none, or no single one


class Late(Puck):
    """It has no model before its first reset."""

    def __init__(self):
        super().__init__()
        del self.model

    def __getattr__(self, name):
        if name == "model":
            raise ValueError("call reset first")
        raise AttributeError(name)

    def reset(self, *, seed=None, options=None):
        raise RuntimeError("no file")


class Rebuilding(Puck):
    """It builds its model anew at each reset."""

    def reset(self, *, seed=None, options=None):
        Puck.__init__(self)
        return super().reset(seed=seed, options=options)


class Seen(gym.ObservationWrapper):
    """Shows a picture."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Box(0, 255, (8, 8, 3), dtype=np.uint8)

    def observation(self, observation):
        return np.zeros((8, 8, 3), dtype=np.uint8)


class Several(Puck):
    possible_agents = ("a", "b")


class Alone(Flat):
    """Its reset gives no info."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0]


class Levels(Puck):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(-4, 4, (2,), dtype=np.int64)


class Counted(Puck):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(3, start=-1)


class Held(Puck):
    sensor = '<sensor><jointpos name="px" joint="x" delay="0.1" nsample="6"/></sensor></mujoco>'
    xml = XML.replace("</mujoco>", sensor)


class Sleepy(Puck):
    xml = XML.replace("<worldbody>", '<option><flag sleep="enable"/></option><worldbody>')


class Whole(Flat):
    observation_space = spaces.Box(-9, 9, (6,), dtype=np.int64)


class Longer(Flat):
    def _get_obs(self):
        return np.append(super()._get_obs(), 1.0)


ONE = Puck()
KINDS = {
    "late": (Late, "Late is not simulated by MuJoCo, .* when it is made"),
    "rebuilding": (Rebuilding, "reset.. of Rebuilding builds another model"),
    "image": (lambda: Seen(Puck()), r"observes images \(8, 8, 3\).*vectors"),
    "several": (Several, "several agents"),
    "other physics": ("CartPole-v1", "not simulated by MuJoCo"),
    "no environment": (lambda: 3, "is a int: give a single gymnasium.Env"),
    "several copies": (lambda: gym.make_vec("Reacher-v5", 2), "single gymnasium.Env"),
    "a namespace": ("metaworld/reach-v3", "no environment 'metaworld/reach-v3'.*name the module"),
    "misspelt": ("PointMaze_Mediun-v3", "no environment.*PointMaze_Medium-v3"),
    "broken": (lambda: 1 / 0, r"cannot be made .ZeroDivisionError"),
    "one": (ONE, "this Puck is one environment, .* a function that makes it"),
    "always the same": (lambda: ONE, "gives the same environment each time, .* make a new one"),
    "no info": (Alone, r"reset\(\) of Alone returns a ndarray"),
    "integers": (Levels, "Levels takes a Box of int64 as its actions, .* would be rounded"),
    "from -1": (Counted, r"counts its actions from -1, .*: let it take Discrete\(3\)"),
    "a sensor that holds": (Held, r"hold or delay what they measure \(px\)"),
    "sleep": (Sleepy, "Sleepy cannot be used: puck lets bodies sleep, .*: leave <flag sleep"),
    "floats in whole numbers": (
        Whole,
        "observes numbers in a space of int64, as which SB3 may show agents others",
    ),
    "more than its space": (Longer, "observes 7 number"),
}

# ---- steps


class Failing(Puck):
    def control(self, action):
        if self.data.qpos[0] > -1:
            raise ValueError("broken")
        super().control(action)


class Exiting(Puck):
    def control(self, action):
        sys.exit("emergency stop")


class Still(Flat):
    """No time passes."""

    def step(self, action):
        self.data.qpos += 0.05 * np.asarray(action)
        return self._get_obs(), 0.0, False, False, {"success": False}


class Unrewarded(Flat):
    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, None, *rest


class Braking(Puck):
    def control(self, action):
        super().control(action)
        if self.data.qpos[0] > 0.2:
            self.model.opt.timestep = 0.01


class Replaced(Puck):
    def after(self):
        if self.data.qpos[0] > 0.2:
            fresh = mujoco.MjData(self.model)
            fresh.qpos[:], fresh.qvel[:] = self.data.qpos, self.data.qvel
            self.data = fresh


class Drawing(Puck):
    """Each step beside the rock draws from a generator."""

    make = draw = None

    def __init__(self):
        super().__init__()
        self.source = self.make()

    def control(self, action):
        if abs(self.data.qpos[0]) < 1.5:
            self.draw(self.source)
        super().control(action)


class Noisy(gym.Wrapper):
    def step(self, action):
        return self.env.step(action + self.unwrapped.np_random.normal(size=2))


class Sampling(Puck):
    """Its drive is as rough as its action space draws, which no seed of reset() decides."""

    def step(self, action):
        return super().step(0.9 * action + 0.1 * self.action_space.sample())


class Loaded(Puck):
    """Its load is drawn by its action space, which no seed of reset() decides, either."""

    def begin(self, place):
        self.share = 0.5 + 0.1 * abs(self.action_space.sample()[0])

    def control(self, action):
        super().control(self.share * action)


SOURCES = {
    "random": (lambda _: random.Random(3), lambda _, source: source.random()),
    "method": (lambda _: random.Random(3).random, lambda _, source: source()),
    "system": (lambda _: random.SystemRandom(), lambda _, source: source.random()),
    "bits": (lambda _: [np.random.PCG64(1)], lambda _, source: source[0].random_raw()),
    "torch": (lambda _: torch.Generator(), lambda _, source: torch.rand(1, generator=source)),
    "global": (lambda _: 0, lambda *_: torch.rand(1)),
}


def drawing(name):
    make, draw = SOURCES[name]
    return type("Drawing", (Drawing,), {"make": make, "draw": draw})


DRAWS = r"draws random numbers in step\(\)"
STEPS = {
    "fails": (Failing, r"step\(\) of Failing raises ValueError: broken: repair it"),
    "exits": (Exiting, r"step\(\) of Exiting raises SystemExit: emergency stop: repair it"),
    "stands still": (Still, "the time of Still stands still"),
    "no reward": (Unrewarded, "returns None as its reward"),
    "takes longer": (Braking, "a step of Braking takes|changes|goes another way"),
    "other data": (Replaced, "has another model or data of MuJoCo after|goes another way"),
    "draws": (lambda: Noisy(Puck()), DRAWS),
    "draws an action": (Sampling, rf"{DRAWS} .action_space"),
    **{f"draws by {name}": (drawing(name), rf"{DRAWS} \((source|a global)") for name in SOURCES},
}

# ---- what is observed


class Unseen(Puck):
    """No method that is known by its name computes what it observes."""

    def what_is_seen(self):
        return Puck._get_obs(self)

    def reset(self, **options):
        gym.Env.reset(self, seed=options.get("seed"))
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.first()
        mujoco.mj_forward(self.model, self.data)
        return self.what_is_seen(), {}

    def step(self, action):
        self.control(action)
        mujoco.mj_step(self.model, self.data, nstep=5)
        close = np.linalg.norm(self.data.qpos - GOAL) < 0.25
        return self.what_is_seen(), 0.0, False, False, {"success": close}

    def _get_obs(self, of):
        raise AssertionError(of)


class Infinite(Puck):
    def _get_obs(self):
        seen = super()._get_obs()
        return seen | {"to_goal": seen["to_goal"] / (self.data.qpos[0] < 1.2)}


class Beginning(Puck):
    """Observes how fast it has gone so far, which at the start is 0 / 0."""

    def _get_obs(self):
        rate = float("nan") if self.data.time == 0 else 0.0
        return super()._get_obs() | {"to_goal": np.array([rate, 0.0])}


class Stale(Puck):
    """Its reset computes nothing of the place that it leads to."""

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.first()
        return self._get_obs(), {}

    def _get_obs(self):
        return super()._get_obs() | {"position": self.data.body("puck").xpos[:2].copy()}


class Blind(Flat):
    def _get_obs(self):
        return np.concatenate([self.data.qvel, np.zeros(4)])


class Difference(Puck):
    """It observes a velocity that is the difference to where it was a step ago."""

    observation_space, before = numbers(4), None

    def begin(self, place):
        self.before = None

    def control(self, action):
        self.before = self.data.qpos.copy()
        super().control(action)

    def _get_obs(self):
        before = self.data.qpos if self.before is None else self.before
        return np.concatenate([self.data.qpos, (self.data.qpos - before) / 0.1])


class Cached(Puck):
    """It observes a place that reset() and step() have stored."""

    observation_space, place = numbers(4), np.zeros(2)

    def begin(self, place):
        self.place = place

    def after(self):
        self.place = self.data.qpos.copy()

    def _get_obs(self):
        return np.concatenate([self.place, self.data.qvel])


class Stamped(Puck):
    """Computes one part of what it observes once for each time."""

    stamp, seen = 0.0, np.zeros(2)

    def begin(self, place):
        self.stamp, self.seen = 0.0, np.zeros(2)

    def _get_obs(self):
        if self.data.time != self.stamp:
            self.stamp, self.seen = self.data.time, GOAL - self.data.qpos
        return super()._get_obs() | {
            "to_goal": self.seen if self.data.time else GOAL - self.data.qpos
        }


class Proximity(Puck):
    """Shows how far the rock is, as step() has found it, and 1 beyond 0.4 m."""

    observation_space = spaces.Dict(
        {**Puck.observation_space.spaces, "proximity": spaces.Box(0, 1, (1,))}
    )

    def begin(self, place):
        self.proximity = 1.0

    def after(self):
        off = np.linalg.norm(np.maximum(np.abs(self.data.qpos) - 0.3, 0))
        self.proximity = min(1.0, off / 0.4)

    def _get_obs(self):
        return super()._get_obs() | {"proximity": np.array([self.proximity])}


class Pressed(Puck):
    """It observes forces of contacts, which only its own step computes."""

    observation_space = spaces.Dict(
        {**Puck.observation_space.spaces, "force": spaces.Box(-1, 1, (6,))}
    )

    def after(self):
        mujoco.mj_rnePostConstraint(self.model, self.data)

    def _get_obs(self):
        return super()._get_obs() | {"force": np.clip(self.data.body("puck").cfrc_ext, -1, 1)}


ANTS = "AntMaze_Medium-v5", {"reset": {"goal_cell": [6, 6]}, "chart": ["qpos[0]", "qpos[1]"]}


class Fixed(Home):
    """It observes where it was when its sensor measured last."""

    def begin(self, place):
        self.k, self.fix = 0, np.zeros(2)

    def after(self):
        self.k += 1
        if self.sees():
            self.fix = self.data.qpos.copy()

    def _get_obs(self):
        return np.concatenate([self.fix, GOAL - self.data.qpos, self.data.qvel])


class Seldom(Fixed):
    def sees(self):
        return self.k % 50 == 0


class Tag(Fixed):
    """A tag on the floor, in a corner, tells the place."""

    first = Flat.first

    def sees(self):
        return (self.data.qpos > (1.95, 1.35)).all()


class SeldomAnywhere(Fixed):
    first = Flat.first

    def sees(self):
        return self.k % 130 == 0


class Delayed(Home):
    """A camera that shows the place four samples late."""

    def begin(self, place):
        self.places = [place] * 5

    def after(self):
        self.places = [*self.places[1:], self.data.qpos.copy()]

    def seen(self):
        return self.places[0]


class Servo(Flat):
    """Brakes beside the right wall, by the observation of the step before."""

    def reset(self, **options):
        self.last, info = super().reset(**options)
        return self.last, info

    def step(self, action):
        beyond = max(self.last[0] - 1.2, 0.0)
        self.last, *rest = super().step(np.asarray(action) - [2.0 * beyond, 0.0])
        return self.last, *rest


class Clipped(Flat):
    """Clips what it observes to the room, which only noise leaves."""

    def step(self, action):
        observation, *rest = super().step(action)
        observation[0] = np.clip(observation[0], -2.05, 2.05)
        return observation, *rest


RIG = '<body name="rig" {}pos="0 0 2">{}<geom size="0.1" mass="1" contype="0" conaffinity="0"/></body>'
SLIDES = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0"))


def rigged(beside):
    return XML.replace("</worldbody>", f"{beside}</worldbody>")


class Rigged(Home):
    """A camera above the robot is put there by code, and where it is is observed."""

    xml, part, rig = rigged(RIG.format('mocap="true" ', "")), "mocap_pos", slice(2)

    def after(self):
        getattr(self.data, self.part).flat[self.rig] = self.data.qpos[:2] + 0.1
        mujoco.mj_forward(self.model, self.data)

    def _get_obs(self):
        place, rig = self.data.qpos[:2], getattr(self.data, self.part).flat[self.rig]
        return np.concatenate([place, self.data.qvel[:2], rig])


class OnJoints(Rigged):
    xml, part, rig = rigged(RIG.format("", SLIDES)), "qpos", slice(2, 4)


class InUserdata(Rigged):
    """It notes where it is in MuJoCo's data, and does not observe that."""

    xml, part = rigged('</worldbody><size nuserdata="2"/><worldbody>'), "userdata"
    _get_obs = Flat._get_obs


class Noted(gym.ObservationWrapper):
    """It observes what is noted there."""

    def observation(self, observation):
        return np.append(self.unwrapped.data.userdata, observation[2:])


class Chasing(Rigged):
    """Something chases it, and is observed: that is no copy."""

    def after(self):
        rig = self.data.mocap_pos[0]
        rig[:2] += 0.1 * (self.data.qpos[:2] - rig[:2])
        mujoco.mj_forward(self.model, self.data)


class Filtered(InUserdata):
    """An average of where it was is observed."""

    _get_obs = Rigged._get_obs

    def after(self):
        self.data.userdata[:] += 0.2 * (self.data.qpos[:2] - self.data.userdata)


FOLLOWS, COPIES = "does not follow its state", "observes shows {}.*, to which code copies the place"
OBSERVED = {
    "by no known method": (Unseen, "no method that computes what it observes"),
    "infinite": (Infinite, "Infinite observes -?(inf|nan) in observation"),
    "0 / 0": (Beginning, r"Beginning observes nan in observation\[\d\]"),
    "stale": (Stale, r"of Stale returns observation\[0\] of another place .* mj_forward before it"),
    "nothing": (Blind, "noise on x, y changes nothing that Blind observes"),
    "a difference": (Difference, rf"{FOLLOWS}: observation\[2\]"),
    "a cache": (Cached, "each reset of Cached draws place"),
    "once a time": (Stamped, "is not what it observes in its state|computes what it"),
    "a scan": (Proximity, rf"{FOLLOWS}.*runs in different places"),
    "forces": (Pressed, r"observation\[\d+\] .* include_cfrc_ext_in_observation=False"),
    "late": (Delayed, r"observation\[\d\] .*It is stored by step"),
    "seldom": (Seldom, r"observation\[\d\] .*It is stored by step"),
    "by its controller": (Servo, r"step\(\) of Servo moves the robot by what _get_obs"),
    "in the room": (Clipped, r"step\(\) of Clipped changes what _get_obs\(\) gives"),
    "a copy": (Rigged, COPIES.format(r"mocap_pos\[0\]")),
    "a copy on joints": (OnJoints, COPIES.format(r"qpos\[2\]")),
    "a filtered copy": (Filtered, COPIES.format(r"userdata\[0\]")),
    "a noted copy": (lambda: Noted(InUserdata()), "a wrapper of .* shows in observation"),
}

# ---- what is drawn, or outlasts resets


class Hasty(Puck):
    """Its motors go by the clock of the machine."""

    def control(self, action):
        super().control(action * (1 + 1e-3 * np.sin(time.time())))


class Site(Puck):
    """Each reset draws a goal, and puts a site there."""

    goal = GOAL

    def first(self):
        self.goal = self.np_random.uniform((1.3, -1), (1.6, 1))
        self.model.site_pos[0, :2] = self.goal
        return super().first()

    def _get_obs(self):
        return super()._get_obs() | {"to_goal": self.goal - self.data.qpos}


class Global(Flat):
    def begin(self, place):
        self.goal = np.random.uniform(1.0, 1.5)

    def arrived(self, off):
        return bool(self.data.qpos[0] > self.goal)


class OwnGenerator(Puck):
    """Its resets draw the goal by a generator of the constructor."""

    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng(42)

    def begin(self, place):
        self.aim = self.rng.uniform(-1.5, 1.5)


class Since(Puck):
    """Has arrived when it is far from where it started."""

    def begin(self, place):
        self.begun = place

    def arrived(self, off):
        return bool(np.linalg.norm(self.data.qpos - self.begun) > 0.3)


class Tide(Puck):
    """It has a border that follows no sum of its place, so that few runs of other resets end as early."""

    def begin(self, place):
        self.wave = float(np.sin(3 * place[0]))

    def crashed(self):
        return self.wave > 0.3 and abs(self.data.qpos[1]) > 1.0


class Worn(Puck):
    """Its motors wear out a little at each reset, by as much as the reset draws."""

    def begin(self, place):
        self.model.actuator_gainprm[:, 0] *= self.np_random.uniform(0.9, 1.0)


class Lagging(Puck):
    """Its motors lag behind, and its resets do not set that back."""

    xml = XML.replace("<motor", '<general dyntype="filter" dynprm="1"')

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.data.qpos[:], self.data.qvel[:] = [-1.4, 0.5], 0
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}


class InTurn(Flat):
    """Three goals in turn."""

    turn = 0

    def begin(self, place):
        self.turn = (self.turn + 1) % 3

    def _get_obs(self):
        return np.append(super()._get_obs()[:5], self.turn)


class Promoted(Puck):
    """After a success its motors get weaker."""

    level = 0

    def control(self, action):
        super().control(action * 0.8**self.level)

    def arrived(self, off):
        self.level += off < 0.25
        return off < 0.25


class Sticky(Puck):
    """Remembers in a second state of MuJoCo, which is not reset, whether it has been near the rock."""

    most = 5

    def __init__(self):
        super().__init__()
        self.memory = {"model": self.model.opt, "data": mujoco.MjData(self.model)}
        self.remember = partial(self._remember, self.memory["data"])

    def _remember(self, data):
        data.time += bool(np.abs(self.data.qpos).max() < 0.9)

    def after(self):
        self.remember()

    def arrived(self, off):
        return off < 0.25 and self.memory["data"].time < self.most


def normalised():
    return NormalizeObservation(Flat())


class Clock(gym.Wrapper):
    """Asks the time limit below it."""

    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        return observation, reward - self.env._elapsed_steps, *rest


OUTLASTS, ACT = r"outlasts resets \({}", "MuJoCo's time, .*'s act"
EPISODE = "from episode to episode: .* on .*{}"
DRAWN = {
    "a rock": (Moved, {}, r"draws geom_pos of its model.*pin it"),
    "options that it does not know": (
        Moved, {"reset": {"stone": 3}}, "change nothing in Moved, which draws geom_pos",
    ),
    "a site": (Site, {}, "draws site_pos of its model, goal.*pin it"),
    "of a global generator": (Global, {"seed": 0}, "draws goal from a global generator"),
    "of its own": (OwnGenerator, {}, r"in reset\(\), from a generator .* not decide \(rng\)"),
    "by its space": (Loaded, {"seed": 0}, EPISODE.format("share")),
    "where it began": (Since, {}, "each reset of Since draws begun"),
    "a border of its place": (Tide, {"steps": 60}, "each reset of Tide draws wave"),
    "wear": (Worn, {}, "draws actuator_gainprm of its model"),
    "activations": (
        Lagging, {}, f"Lagging changes .* {OUTLASTS.format(ACT)}.* mj_resetData",
    ),
    "the clock": (Hasty, {}, "each reset of Hasty draws something .* depends on the clock"),
    "in turn": (InTurn, {}, f"changes from .* {OUTLASTS.format('.*turn')}"),
    "statistics": (normalised, {}, "outlasts .*obs_rms.*set update_running_mean = False"),
    "a hidden count": (lambda: Secret(Puck()), {}, EPISODE.format("Secret.*scale.count")),
    "all actions": (lambda: Growing(Puck()), {}, EPISODE.format("Growing.*actions")),
    "a limit": (lambda: Clock(TimeLimit(Puck(), 60)), {}, "do without TimeLimit, which is left out"),
}  # fmt: skip

TABLE = {
    **{name: (make, {}, message) for name, (make, message) in (KINDS | STEPS).items()},
    **{f"observes {name}": (make, {}, message) for name, (make, message) in OBSERVED.items()},
    **{f"draws or keeps {name}": row for name, row in DRAWN.items()},
}  # fmt: skip
# What outlasts resets as something else does that is tried, and a place that is copied as another one.
MORE = "draws or keeps statistics", "observes a copy on joints"


@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize("name", [later(name) if name in MORE else name for name in TABLE])
def test_what_misleads_is_refused_by_name(name):
    make, given, message = TABLE[name]
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make, **{"steps": 60, **given})


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("make", "steps", "message"),
    [
        (Sticky, 60, OUTLASTS.format(r"memory\['data'\]\), ")),
        (Tag, 60, r"observation\[\d\] of Tag is not .* step\(\) has stored it"),
        (SeldomAnywhere, 150, rf"SeldomAnywhere observes {FOLLOWS}: observation\["),
        (Promoted, 60, OUTLASTS.format(r"level\), ")),
    ],
)
def test_what_misleads_seldom_is_refused_by_more_trials(make, steps, message, all_trials):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make, steps=steps)


@long
def test_forces_of_an_ant_are_refused_and_without_them_it_does_not_lag_behind(all_trials):
    name, given = ANTS
    with pytest.raises(
        BadInput, match=r"observation\[\d+\] .* include_cfrc_ext_in_observation=False"
    ):
        from_gymnasium(name, **given)
    kwargs = {"include_cfrc_ext_in_observation": False}
    assert "lag" not in from_gymnasium(name, kwargs=kwargs, **given).found


@pytest.mark.parametrize("make", [Chasing, InUserdata])
def test_what_chases_the_robot_or_is_not_observed_is_no_copy(make):
    assert from_gymnasium(make, steps=20).max_steps == 20


# ---- what only shows in runs


def curriculum(count):
    """Returns a puck whose goal is the smaller the more episodes there were."""

    class Learning(Puck):
        def begin(self, place):
            self.tolerance = max(3.0 - 0.1 * count(), 0.3)

        def arrived(self, off):
            return off < self.tolerance

    return Learning


def closure():
    episodes = [0]

    def count():
        episodes[0] += 1
        return episodes[0]

    return count


class Seeded(Flat):
    """Its motors are as they should be where its resets have a seed."""

    def reset(self, *, seed=None, options=None):
        observation = super().reset(seed=seed)
        self.share = 1.0 if seed is not None else self.np_random.uniform(0.5, 0.9)
        return observation

    def control(self, action):
        super().control(action * self.share)


class Champion(Flat):
    """After eight successes its motors get weaker."""

    def __init__(self):
        super().__init__()
        self.wins = []

    def step(self, action):
        *result, info = super().step(action * (1 if len(self.wins) < 8 else 0.5))
        self.wins += [True] * info["success"]
        return *result[:2], info["success"], False, info


class Picky(Flat):
    """Resets draw on which side of the goal it has to arrive, as it learns there."""

    def reset(self, *, seed=None, options=None):
        observation = super().reset(seed=seed)
        self.side = int(self.np_random.choice([-1, 1]))
        return observation

    def arrived(self, off):
        return off < 0.25 and self.data.qpos[1] * self.side > 0


class Denied(Flat):
    """Behind the rock step() puts another place into what it observes."""

    def step(self, action):
        observation, *rest = super().step(action)
        if self.data.qpos[0] > 0.6 and abs(self.data.qpos[1]) < 0.75:
            observation[:2] = 0.9, 0.4
        return observation, *rest


class Latching(Flat):
    """Its sensor remembers that it was at a rare place."""

    def _get_obs(self):
        self.docked = getattr(self, "docked", False) or self.data.qpos[0] > 1.3
        return super()._get_obs() + 0.1 * self.docked


class Watching(Flat):
    """Its observer notes whether it has been near the rock, and that ends an episode."""

    def begin(self, place):
        self.near = False

    def _get_obs(self):
        self.near = self.near or bool(np.abs(self.data.qpos).max() < 0.72)
        return super()._get_obs()

    def crashed(self):
        return self.near


class Flagged(Flat):
    """All of its instances share a flag, which a reset lowers and a place far to the right raises."""

    raised = {"flag": False}

    def begin(self, place):
        self.raised["flag"] = False

    def after(self):
        self.raised["flag"] = self.raised["flag"] or bool(self.data.qpos[0] > 1.4)


class Raised(Flat):
    """The more wins there were, in whatever process, the weaker are its motors."""

    def __init__(self, level):
        super().__init__()
        self.level = level

    def arrived(self, off):
        self.level.value += off < 0.25
        return off < 0.25

    def control(self, action):
        self.data.ctrl[:] = action * 0.9 ** min(self.level.value, 5)


LEVEL = multiprocessing.Value("i", 0)


class RaisedByAll(Raised):
    def __init__(self):
        super().__init__(LEVEL)


def raised():
    level = multiprocessing.Value("i", 0)
    return lambda: Raised(level)


MANY = np.random.default_rng(0).uniform((-1.8, 0.7), (1, 1.2), (30, 2))
EVER = r"in a later one. It depends on .*resets .*{}.*; let reset"
SHARED = "goes another way than a new one|all its instances share"
IN_RUNS = {
    "a curriculum in a closure": (lambda: curriculum(closure()), 0.0, SHARED),
    "a judge of resets without a seed": (lambda: Seeded, None, EVER.format("share")),
    "a judge of many wins": (lambda: Champion, None, EVER.format("wins")),
    "a judge of sides": (lambda: Picky, None, EVER.format("side")),
    "a denied place": (lambda: Denied, 0.15, r"step\(\) of Denied changes what|in the same state"),
    "an observer that remembers": (lambda: Latching, 0.3, r"docked|in the same state|differs by"),
    "an observer that judges": (lambda: Watching, 0.3, r"without the noise.* _get_obs\(\) has noted"),
    "a level of all processes": (lambda: RaisedByAll, 0.0, r"module .*LEVEL\..*, which all its inst"),
    "a level of all": (raised, 0.0, r"changes level\..*, which all its instances share"),
    "a flag of all": (lambda: Flagged, 0.0, r"class Flagged\.raised, which all its instances share"),
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        "a curriculum in a closure",
        "a judge of many wins",
        "a denied place",
        "an observer that remembers",
        "an observer that judges",
        "a flag of all",
        "a level of all processes",
        "a level of all",
        *map(later, ("a judge of resets without a seed", "a judge of sides")),
    ],
)
def test_what_misleads_in_some_runs_only_is_refused_there(name):
    kind, noise, message = IN_RUNS[name]
    more = {"steps": 140, "starts": MANY} if noise is None else {}
    with pytest.raises(BadInput, match=message):
        outcomes(kind(), noise or 0.0, **more)


# ---- what is remembered


def fingers(env):
    return fingerprint(env, Physics(env.model, env.data))


class Alarmed(Puck):
    """Remembers in an event of `threading` whether it has been near the right wall."""

    def __init__(self):
        super().__init__()
        self.alarm = threading.Event()

    def after(self):
        if self.data.qpos[0] > 0.9:
            self.alarm.set()


class Cameras(Puck):
    """Remembers in a camera of its model how often it has been stepped, or in numbers of its user."""

    xml = XML.replace("<worldbody>", '<size nuser_geom="1"/><worldbody><camera name="eye"/>')
    part = "cam_fovy"

    def after(self):
        getattr(self.model, self.part).flat[0] += 1e-3


class Users(Cameras):
    part = "geom_user"


class Row(array.array):
    """Has attributes, and keeps numbers in C beside them."""


class Rows(Puck):
    def __init__(self):
        super().__init__()
        self.kept = Row("d", [1.0])
        self.kept.name = "row"

    def after(self):
        self.kept[0] = 2.0


@pytest.mark.parametrize("make", [Alarmed, Cameras, Users, Rows])
def test_what_is_no_plain_attribute_is_remembered_too(make):
    env = make()
    env.reset(seed=0)
    env.data.qpos[:] = 1.0, 0.5
    before = fingers(env)
    env.after()
    assert fingers(env) != before


def test_what_cannot_be_written_down_is_compared_as_an_object():
    env = Puck()
    env.rows = (number for number in range(3))
    before = fingers(env)
    assert isinstance(before["rows"], Unknown)
    assert before == fingers(env)
    env.rows = (number for number in range(3))
    assert before != fingers(env)
    assert Unknown() != Unknown()
    env.rows = type("Lock", (threading.local,), {})()
    assert not is_known(fingers(env))


def test_any_number_of_random_numbers_is_noticed():
    """Also as many as fill the table of the generator, after which its place is the same."""
    with kept_generators():
        np.random.seed(0)
        for count in (1, 312, 624):
            before = global_state()
            np.random.random(count)
            assert global_state() != before


@long
def test_generators_that_nobody_draws_from_are_like_any_memory():
    makes = [make for name, (make, _) in SOURCES.items() if name != "system"]
    values = {"make": lambda self: [make(self) for make in makes], "draw": lambda *_: None}
    found = from_gymnasium(type("Holding", (Drawing,), values), steps=20).specification
    assert found.memoryless
    assert "episodes" not in found.found


def test_a_slow_reset_is_refused(monkeypatch):
    monkeypatch.setattr(timeit, "repeat", lambda *_, **__: [3.2])
    with pytest.raises(BadInput, match=r"reset\(\) of Puck takes 3\.2 s"):
        inspection._check_times(Instance(EnvironmentSpec(Description(Puck))), 0.1)


def test_a_slow_environment_is_said_to_take_minutes(caplog):
    slow = type("Slow", (Puck,), {"after": lambda self: time.sleep(0.03)})
    for kind, making in ((Puck, 0.1), (slow, 0.1), (Puck, 1.0)):
        inspection._check_times(Instance(EnvironmentSpec(Description(kind))), making)
    assert [re.sub(r"\d+", "N", text) for text in caplog.messages] == [
        f"{name} takes N ms to be made, N ms for a reset and N ms for a step: to look at it, before anything "
        "else, takes about N minute(s)"
        for name in ("Slow", "Puck")
    ]
