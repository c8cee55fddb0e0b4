"""Traps for whoever runs an environment otherwise than from its start to its end: memories and draws.

Each is a class that changes a `World`, or a wrapper. Numbers that are drawn are attributes of the class.
"""

import math
import os
import random
import time
from collections import deque
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np

# ---- where something is remembered


class Attributes:
    """In attributes of the environment."""

    def keep(self, name, value):
        setattr(self, name, value)

    def kept(self, name):
        return getattr(self, name)


class Dictionary:
    """In a dictionary."""

    def keep(self, name, value):
        self.__dict__.setdefault("notes", {})[name] = value

    def kept(self, name):
        return self.notes[name]


class Listed:
    """In a list that is made anew each time."""

    def keep(self, name, value):
        others = [pair for pair in self.__dict__.get("pairs", []) if pair[0] != name]
        self.pairs = [*others, (name, value)]

    def kept(self, name):
        return dict(self.pairs)[name]


class Nested:
    """In an object of an object."""

    def keep(self, name, value):
        if "pocket" not in self.__dict__:
            self.pocket = SimpleNamespace(inner=SimpleNamespace())
        setattr(self.pocket.inner, name, value)

    def kept(self, name):
        return getattr(self.pocket.inner, name)


class Slotted:
    """In an object without a dictionary."""

    class Box:
        __slots__ = ("held",)

    def keep(self, name, value):
        if "box" not in self.__dict__:
            self.box = Slotted.Box()
            self.box.held = {}
        self.box.held[name] = value

    def kept(self, name):
        return self.box.held[name]


class Closed:
    """In variables of a function."""

    def _made(self):
        if "remind" not in self.__dict__:
            held = {}

            def remind(name, *value):
                if value:
                    (held[name],) = value
                return held[name]

            self.remind = remind

    def keep(self, name, value):
        self._made()
        self.remind(name, value)

    def kept(self, name):
        return self.remind(name)


class Generated:
    """In a generator."""

    def keep(self, name, value):
        if "memory" not in self.__dict__:
            self.memory = _memory()
            next(self.memory)
        self.memory.send((name, value))

    def kept(self, name):
        return self.memory.send((name,))


def _memory():
    held, answer = {}, None
    while True:
        name, *value = yield answer
        if value:
            (held[name],) = value
        answer = held.get(name)


OF_ALL = {}  # what all environments of this process share


class Common:
    """In a variable of the module, which all instances share."""

    def keep(self, name, value):
        OF_ALL[name] = value

    def kept(self, name):
        return OF_ALL[name]


class Classwide:
    """In the class, which all instances share."""

    def keep(self, name, value):
        setattr(Classwide, f"_{name}", value)

    def kept(self, name):
        return getattr(Classwide, f"_{name}")


class Defaulted:
    """In a default argument, which all instances share."""

    def _held(self, name, value=(), held={}):  # noqa: B006
        if value:
            (held[name],) = value
        return held[name]

    def keep(self, name, value):
        self._held(name, (value,))

    def kept(self, name):
        return self._held(name)


VISIBLE = (Attributes, Dictionary, Listed, Nested)
HIDDEN = (Slotted, Closed, Generated, Common, Classwide, Defaulted)


def forget():
    """Makes what all instances share as it is in a new process."""
    OF_ALL.clear()
    for name in [name for name in vars(Classwide) if name.startswith("_") and name[1] != "_"]:
        delattr(Classwide, name)
    Defaulted._held.__defaults__[1].clear()
    Ageing.age = 0


def planted(mixin, storage=None, **values):
    """Returns a mixin with its numbers, and with where it remembers something."""
    return type(mixin.__name__, (mixin,) if storage is None else (mixin, storage), values)


# ---- memories of an episode


class Looking:
    """Looks at what others do, or changes what is seen."""


class Region:
    """Something happens near a place, which all that is planted in one environment shares."""

    where, reach = (0.9, 0.7), 0.35

    def near(self):
        if self.plan.turns:
            return math.cos(self.place()[0] - self.where[0]) > 1 - self.reach
        return math.hypot(*(self.place() - self.where)) < self.reach


class Key(Region):
    """Arriving counts with a key only, which lies somewhere."""

    def begin(self):
        super().begin()
        self.keep("key", False)

    def remember(self):
        super().remember()
        if self.near():
            self.keep("key", True)

    def arrived(self):
        return super().arrived() and self.kept("key")


class Broken(Region):
    """A place breaks its drive."""

    strength = 0.4

    def begin(self):
        super().begin()
        self.keep("drive_strength", 1.0)

    def remember(self):
        super().remember()
        if self.near():
            self.keep("drive_strength", self.strength)

    def drive(self, share):
        super().drive(share * self.kept("drive_strength"))


class Waypoint(Region):
    """The goal is a place on the way first."""

    def begin(self):
        super().begin()
        self.keep("passed", 0)

    def remember(self):
        super().remember()
        if self.near():
            self.keep("passed", self.kept("passed") + 1)

    def goal(self):
        return super().goal() if self.kept("passed") else np.array(self.where)

    def arrived(self):
        return self.kept("passed") > 0 and super().arrived()


class Unlatched(Region):
    """A place changes the model, until the next reset."""

    unlatches = "dof_damping"

    def begin(self):
        super().begin()
        if self.unlatches == "dof_damping":
            self.model.dof_damping[self.rates] = self.plan.damping
        elif self.unlatches == "wind":
            self.model.opt.gravity[0] = 0.0
        else:
            self.model.geom("rock").contype = 1
            self.model.geom("rock").conaffinity = 1

    def remember(self):
        super().remember()
        if not self.near():
            return
        if self.unlatches == "dof_damping":
            self.model.dof_damping[self.rates] = 3 * self.plan.damping
        elif self.unlatches == "wind":
            self.model.opt.gravity[0] = -1.0
        else:
            self.model.geom("rock").contype = 0
            self.model.geom("rock").conaffinity = 0


class Sticky:
    """Once it has arrived it has always arrived, even in the next episode if `forgets` is not set."""

    forgets = True

    def begin(self):
        super().begin()
        if self.forgets or "was_there" not in self.__dict__:
            self.was_there = False

    def arrived(self):
        self.was_there = self.was_there or super().arrived()
        return self.was_there


class LateAction:
    """Actions are passed on some steps later."""

    action_delay, action_queue = 2, "deque"

    def begin(self):
        super().begin()
        self.waiting = _Queue.of(self.action_queue, [np.zeros(self.plan.dimension)] * self.action_delay)

    def drive(self, share):
        super().drive(self.waiting.pushed(share))


class LateEyes:
    """The environment itself shows observations some steps later."""

    eye_delay, eye_queue = 2, "deque"

    def begin(self):
        super().begin()
        self.seen_before = _Queue.of(self.eye_queue, [self.flat_parts()] * self.eye_delay)
        self.shown = self.flat_parts()

    def remember(self):
        super().remember()
        self.shown = self.seen_before.pushed(self.flat_parts())

    def flat_parts(self):
        parts = super().parts()
        return np.concatenate([parts[name] for name in self.widths])

    def parts(self):
        if "shown" not in self.__dict__:
            return super().parts()
        ends = np.cumsum([*self.widths.values()])[:-1]
        return dict(zip(self.widths, np.split(self.shown, ends), strict=True))


class _Queue:
    """Values that wait, in a deque, a list, or a ring of an array."""

    @staticmethod
    def of(kind, values):
        queue = _Queue()
        queue.at = 0
        queue.values = {"deque": deque, "list": list, "ring": np.array}[kind](values)
        return queue

    def pushed(self, value):
        """Returns the oldest value, and keeps this one in its place."""
        if isinstance(self.values, np.ndarray):
            oldest = self.values[self.at].copy()
            self.values[self.at] = value
            self.at = (self.at + 1) % len(self.values)
            return oldest
        self.values.append(np.array(value))
        return self.values.popleft() if isinstance(self.values, deque) else self.values.pop(0)


class Cached:
    """What is observed is computed in a step; at other times it is what was computed before.

    `caches` is "step", computed in each, "slow", in every third, or "counter", when a number has changed.
    """

    caches = "step"

    def begin(self):
        super().begin()
        self.samples, self.cached_at, self.cache = 0, -1, None
        self.cache = super().parts()

    def remember(self):
        super().remember()
        self.samples += 1
        if self.caches == "step" or (self.caches == "slow" and self.samples % 3 == 0):
            self.cache = super().parts()

    def parts(self):
        if self.__dict__.get("cache") is None:
            return super().parts()
        if self.caches == "counter" and self.cached_at != self.samples:
            self.cache, self.cached_at = super().parts(), self.samples
        return self.cache


class Difference(Looking):
    """A velocity is the difference to where the sensor saw it before.

    `differs` is "step", computed in the step, "observation", computed when it is asked for, or "filter".
    """

    differs = "step"

    def begin(self):
        super().begin()
        self.last_seen, self.speed = self.sense(), np.zeros(self.plan.dimension)

    def remember(self):
        super().remember()
        if self.differs == "observation":
            return
        speed = (self.sense() - self.last_seen) / self.plan.dt
        self.speed = speed if self.differs == "step" else 0.7 * self.speed + 0.3 * speed
        self.last_seen = self.sense()

    def parts(self):
        if "last_seen" in self.__dict__ and self.differs == "observation":
            self.speed = (self.sense() - self.last_seen) / self.plan.dt
            self.last_seen = self.sense()
        return {**super().parts(), "velocity": self.__dict__.get("speed", 0 * self.sense())}


class Seldom(Region):
    """The drive changes every so many steps; or a wind grows with each step in a region."""

    period = 97

    def begin(self):
        super().begin()
        self.keep("count", 0)
        self.keep("turns", 0)

    def remember(self):
        super().remember()
        self.keep("count", self.kept("count") + 1)
        if self.near() if self.period is None else self.kept("count") % self.period == 0:
            self.keep("turns", self.kept("turns") + 1)

    def drive(self, share):
        turns = self.kept("turns")
        super().drive(share * (1 / (1 + turns) if self.period is None else (0.5 if turns % 2 else 1)))


class Smooth:
    """The drive follows the actions slowly."""

    share_of_new = 0.3

    def begin(self):
        super().begin()
        self.keep("smoothed", np.zeros(self.plan.dimension))

    def drive(self, share):
        new = self.share_of_new
        self.keep("smoothed", (1 - new) * self.kept("smoothed") + new * share)
        super().drive(self.kept("smoothed"))


class Recalled(Looking):
    """The observation holds what was done last, or seen last."""

    recalls = "action"

    def begin(self):
        super().begin()
        d = self.plan.dimension
        self.done, self.recalled = np.zeros(d), self.sense() if self.recalls == "seen" else np.zeros(d)
        self.now_seen = self.sense()

    def drive(self, share):
        self.done = np.array(share)
        super().drive(share)

    def remember(self):
        super().remember()
        self.recalled = self.done if self.recalls == "action" else self.now_seen
        self.now_seen = self.sense()

    def sizes(self):
        return {**super().sizes(), "recalled": self.plan.dimension}

    def parts(self):
        zeros = np.zeros(self.plan.dimension)
        return {**super().parts(), "recalled": self.__dict__.get("recalled", zeros)}


class Tracked(Looking):
    """Its drive is weaker where its sensor sees that it has moved far since the sample before."""

    def begin(self):
        super().begin()
        self.gain, self.tracked = 1.0, self.sense()

    def remember(self):
        super().remember()
        moved = np.abs(self.sense() - self.tracked).max()
        self.gain, self.tracked = 1 / (1 + 5 * moved), self.sense()

    def drive(self, share):
        super().drive(share * self.gain)


class Progress:
    """Its reward is how much nearer it has come."""

    def begin(self):
        super().begin()
        self.distance_before = math.hypot(*(self.place() - self.goal()))

    def reward(self, arrived):
        distance = math.hypot(*(self.place() - self.goal()))
        nearer, self.distance_before = self.distance_before - distance, distance
        return 0.2 - distance + 4 * nearer


# ---- what is not up to date


class Stale(Looking):
    """What it observes is what MuJoCo computed before the last physics step, as after `mj_step`."""

    stale = "site_xpos"

    def place_seen(self):
        if self.stale == "sensordata":
            return self.data.sensordata[:2].copy()
        if self.stale == "xpos":
            return self.data.body("puck").xpos[:2].copy()
        return self.data.site("tip").xpos[:2].copy()

    def sense(self):
        return self.place_seen() + self.sensor_offset


class Forces:
    """It observes contact forces, which only a step of its own computes."""

    def simulate(self):
        super().simulate()
        mujoco.mj_rnePostConstraint(self.model, self.data)

    def sizes(self):
        return {**super().sizes(), "forces": 6}

    def parts(self):
        return {**super().parts(), "forces": np.clip(self.data.body(self.body).cfrc_ext, -1, 1)}

    @property
    def body(self):
        return "arm" if self.plan.turns else "puck"


class Substep(Looking):
    """What it observes of its place was read before the last physics step of its step."""

    def begin(self):
        super().begin()
        self.read_at = super().place()

    def simulate(self):
        for _ in range(self.plan.frame_skip):
            self.read_at = super().place()
            mujoco.mj_step(self.model, self.data)

    def sense(self):
        return self.__dict__.get("read_at", self.place()) + self.sensor_offset


# ---- draws


class Drawn:
    """A reset draws something of the model."""

    drawn = "damping"

    def draw(self):
        super().draw()
        model, rng = self.model, self.np_random
        if self.drawn == "damping":
            model.dof_damping[self.rates] = self.plan.damping * rng.uniform(0.7, 1.4)
        elif self.drawn == "mass":
            model.body("arm" if self.plan.turns else "puck").mass[:] = rng.uniform(0.7, 1.5)
        elif self.drawn == "rock":
            model.geom("rock").pos[1] = self.plan.rock[1] + rng.uniform(-0.1, 0.1)
        elif self.drawn == "friction":
            model.geom_friction[:, 0] = rng.uniform(0.1, 2.0)
        elif self.drawn == "gear":
            model.actuator_gainprm[:, 0] *= rng.uniform(0.95, 1.02)
        elif self.drawn == "wind":
            model.opt.gravity[0] = rng.uniform(-0.5, 0.5)
        elif self.drawn == "timestep":
            usual = self.plan.dt / self.plan.frame_skip
            model.opt.timestep = round(rng.uniform(0.8, 1.0) * usual, 4)


class DrawnGoal:
    """A reset draws the goal."""

    spread = 0.3

    def draw(self):
        super().draw()
        shift = self.np_random.uniform(-self.spread, self.spread, self.plan.dimension)
        goal = np.array(self.plan.goal) + shift * [0.3, 1.0][: len(shift)]
        where = self.plan.goal_in
        if where == "attribute":
            self.target = goal
        elif where == "userdata":
            self.data.userdata[:2] = goal
        elif where == "qpos":
            self.data.qpos[self.goal_at : self.goal_at + 2] = goal
        elif where == "mocap":
            self.data.mocap_pos[self.goal_at, :2] = goal
        elif where == "body":
            self.model.body_pos[self.goal_at, :2] = goal
        else:
            self.model.site_pos[self.goal_at, :2] = goal


class Bias(Looking):
    """A reset draws by how much the sensor is wrong."""

    def draw(self):
        super().draw()
        self.bias = self.np_random.uniform(-0.15, 0.15, self.plan.dimension)

    def sense(self):
        return super().sense() + self.__dict__.get("bias", 0.0)


class Rolling:
    """What moves beside the robot moves already at the start, as drawn or always alike."""

    rolls_as_drawn, rolls_by = True, "speed"

    def draw(self):
        super().draw()
        value = self.np_random.uniform(0.3, 1.2) if self.rolls_as_drawn else 0.8
        if self.rolls_by == "speed":
            self.data.qvel[self.rest] = value
        else:
            self.data.qpos[self.beside] = 0.4 * value


class Rough(Region, Looking):
    """Steps draw random numbers, everywhere or in a region, for the drive or for the sensor."""

    rough_source, rough_everywhere, rough_on = "np_random", False, "drive"

    def begin(self):
        super().begin()
        self.felt = np.zeros(self.plan.dimension)

    def number(self):
        if self.rough_source == "np_random":
            return self.np_random.uniform(-1, 1)
        if self.rough_source == "numpy":
            return np.random.uniform(-1, 1)
        if self.rough_source == "random":
            return random.uniform(-1, 1)
        if self.rough_source == "late":
            if "late" not in self.__dict__:
                self.late = np.random.default_rng(7)
            return self.late.uniform(-1, 1)
        if self.rough_source == "urandom":
            return int.from_bytes(os.urandom(4), "little") / 2**31 - 1
        return (time.perf_counter_ns() % 1000) / 500 - 1

    def drive(self, share):
        if self.rough_on == "drive" and (self.rough_everywhere or self.near()):
            share = share * (1 + 0.3 * self.number())
        super().drive(share)

    def remember(self):
        super().remember()
        if self.rough_on == "sensor" and (self.rough_everywhere or self.near()):
            self.felt = np.full(self.plan.dimension, 0.05 * self.number())

    def sense(self):
        return super().sense() + self.__dict__.get("felt", 0.0)


# ---- clocks, and what outlives an episode


class Clock:
    """Something moves with a clock of its own: steps that it counts, or the clock on the wall."""

    clock = "beacon"

    def begin(self):
        super().begin()
        self.ticks, self.begun = 0, time.perf_counter()

    def simulate(self):
        self.ticks += 1
        on_wall = self.clock == "wall"
        passed = 100 * (time.perf_counter() - self.begun) if on_wall else self.ticks * self.plan.dt
        if self.clock == "beacon":
            sway = 0.5 * np.sin(2 * passed)
            self.data.mocap_pos[self.model.body("beacon").mocapid[0], 1] = self.plan.beacon[1] + sway
        else:
            self.model.opt.gravity[0] = 0.6 * np.sin(3 * passed)
        super().simulate()


class Timed:
    """A mocap body moves with MuJoCo's time: no trap."""

    def simulate(self):
        sway = 0.5 * np.sin(2 * self.data.time)
        self.data.mocap_pos[self.model.body("beacon").mocapid[0], 1] = self.plan.beacon[1] + sway
        super().simulate()


class Counting:
    """Counts its steps and notes its last action, for its info alone: no trap."""

    def begin(self):
        super().begin()
        self.elapsed, self.last_action = 0, np.zeros(self.plan.dimension)

    def drive(self, share):
        self.elapsed += 1
        self.last_action = np.array(share)
        super().drive(share)

    def judged(self):
        reward, terminated, truncated, info = super().judged()
        info |= {"elapsed": self.elapsed, "effort": float(np.abs(self.last_action).sum())}
        return reward, terminated, truncated, info


class Surviving:
    """Something outlives the reset: the goal of the next episode, what was learnt, where the cart was left."""

    survives = "goal"

    def __init__(self):
        super().__init__()
        self.episodes, self.wins, self.learnt, self.left = 0, 0, 0.0, None

    def draw(self):
        super().draw()
        if self.survives == "cart" and self.left is not None:
            self.data.qpos[:] = self.left
        self.episodes += 1

    def remember(self):
        super().remember()
        self.learnt += 0.001
        self.left = self.data.qpos.copy()
        if super().arrived():
            self.wins += 1

    def goal(self):
        goal = super().goal()
        if self.survives == "goal":
            goal = goal + 0.1 * ((self.episodes - 1) % 5)
        if self.survives == "wins":
            goal = goal - 0.05 * min(self.wins, 8)
        return goal

    def drive(self, share):
        weak = 1 / (1 + self.learnt) if self.survives == "learnt" else 1.0
        super().drive(share * weak)


class Ageing:
    """All instances of this process grow weaker with each step of one of them."""

    age = 0

    def drive(self, share):
        Ageing.age += 1
        super().drive(share / (1 + 1e-4 * Ageing.age))


class Both:
    """Arriving terminates, and so does touching the island."""

    def judged(self):
        reward, terminated, truncated, info = super().judged()
        return reward, terminated or self.arrived(), truncated, info


class Inline:
    """What it observes is computed in the step and in the reset, by no method of a known name."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._shown(), {}

    def step(self, action):
        self.drive(self.decoded(action))
        self.simulate()
        if self.plan.forward:
            mujoco.mj_forward(self.model, self.data)
        self.next_sample()
        self.remember()
        return self._shown(), *self.judged()

    def _shown(self):
        parts = self.parts()
        flat = [parts[name] for name in self.widths]
        if self.plan.view == "box":
            return np.concatenate(flat)
        return dict(zip(self.widths, flat, strict=True))

    def _get_obs(self):
        return None


# ---- wrappers


class Waits(gym.Wrapper):
    """Passes actions on some steps later."""

    def __init__(self, env, delay, kind):
        super().__init__(env)
        self.delay, self.kind = delay, kind

    def reset(self, **options):
        shape = self.env.action_space.shape
        self.queue = _Queue.of(self.kind, [np.zeros(shape)] * self.delay)
        return self.env.reset(**options)

    def step(self, action):
        action = self.queue.pushed(action)
        discrete = isinstance(self.env.action_space, gym.spaces.Discrete)
        return self.env.step(int(action) if discrete else action)


class Looks(gym.ObservationWrapper):
    """Shows observations some steps later; the first ones are that of the reset."""

    def __init__(self, env, delay, kind):
        super().__init__(env)
        self.delay, self.kind, self.queue = delay, kind, None

    def reset(self, **options):
        self.queue = None
        return super().reset(**options)

    def observation(self, observation):
        if self.queue is None:
            self.queue = _Queue.of(self.kind, [observation] * self.delay)
        return self.queue.pushed(observation)


class Blends(gym.ObservationWrapper):
    """Shows a running mean of the observations."""

    def __init__(self, env, share):
        super().__init__(env)
        self.share, self.mean = share, None

    def reset(self, **options):
        self.mean = None
        return super().reset(**options)

    def observation(self, observation):
        old = observation if self.mean is None else self.mean
        self.mean = self.share * observation + (1 - self.share) * old
        return self.mean


class Eases(gym.ActionWrapper):
    """Passes on what follows the actions slowly."""

    def __init__(self, env, share):
        super().__init__(env)
        self.share, self.eased = share, None

    def reset(self, **options):
        self.eased = np.zeros(self.env.action_space.shape)
        return self.env.reset(**options)

    def action(self, action):
        self.eased = self.share * np.asarray(action) + (1 - self.share) * self.eased
        return self.eased


class Appends(gym.Wrapper):
    """Appends the last action to the observation."""

    def __init__(self, env):
        super().__init__(env)
        low = np.append(env.observation_space.low, env.action_space.low)
        high = np.append(env.observation_space.high, env.action_space.high)
        self.observation_space = gym.spaces.Box(low, high, dtype=env.observation_space.dtype)

    def reset(self, **options):
        observation, info = self.env.reset(**options)
        return np.append(observation, np.zeros(self.env.action_space.shape)), info

    def step(self, action):
        observation, *rest = self.env.step(action)
        return np.append(observation, action), *rest


class Stops(gym.Wrapper):
    """Truncates after some steps, by a count of its own."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.steps, self.count = steps, 0

    def reset(self, **options):
        self.count = 0
        return self.env.reset(**options)

    def step(self, action):
        self.count += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated or self.count >= self.steps, info
