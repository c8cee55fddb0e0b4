"""Environments of the tests' own, as users may have them, and how runs in them end."""

import functools
from collections import deque

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj import from_callable, from_gymnasium, simulate
from hyrl_mj.simulation import Recorded

XML = """
<mujoco model="puck">
  <option timestep="0.02" integrator="implicitfast"/>
  <worldbody>
    <geom name="rock" type="box" size="0.3 0.3 0.1" pos="0 0 0.1"/>
    <geom type="box" size="2.2 0.1 0.1" pos="0 1.6 0.1"/>
    <geom type="box" size="2.2 0.1 0.1" pos="0 -1.6 0.1"/>
    <geom type="box" size="0.1 1.7 0.1" pos="2.2 0 0.1"/>
    <geom type="box" size="0.1 1.7 0.1" pos="-2.2 0 0.1"/>
    <site name="goal" pos="1.5 0 0"/>
    <body name="puck" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0" damping="2"/>
      <joint name="y" type="slide" axis="0 1 0" damping="2"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="push_x" joint="x" ctrlrange="-4 4"/><motor name="push_y" joint="y" ctrlrange="-4 4"/>
  </actuator>
</mujoco>
"""
GOAL, PLACE = np.array([1.5, 0.0]), np.array([-1.3, 0.5])
STARTS = np.array([[1.0, 0.9], [0.9, -0.9], [-1.4, 0.5]])


def numbers(size):
    return spaces.Box(-np.inf, np.inf, (size,), dtype=np.float64)


class Puck(gym.Env):
    """A puck that goes around a rock, with what other classes change.

    Attributes:
        xml: its model.
        at: where its place is in MuJoCo's positions and velocities.
        draws: whether resets draw its place, or all lead to one.
        substeps: of the physics, in a step.
    """

    xml, at, draws, substeps = XML, slice(2), True, 5
    observation_space = spaces.Dict(
        {
            "velocity": spaces.Box(-np.inf, np.inf, (2,)),
            "position": spaces.Box(-np.inf, np.inf, (2,)),
            "to_goal": spaces.Box(-np.inf, np.inf, (2,)),
        }
    )

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(self.xml)
        self.data = mujoco.MjData(self.model)
        self.action_space = spaces.Box(-4.0, 4.0, (2,), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        place = self.first()
        self.begin(place)
        self.data.qpos[self.at] = place
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def first(self):
        """Where it begins."""
        return self.np_random.uniform((-1.8, -1.2), (-1.0, 1.2)) if self.draws else PLACE.copy()

    def begin(self, place):
        """What else a reset does."""

    def _get_obs(self):
        place, velocity = self.data.qpos[self.at].copy(), self.data.qvel[self.at].copy()
        return {"position": place, "velocity": velocity, "to_goal": GOAL - place}

    def step(self, action):
        self.control(np.clip(action, -4, 4))
        mujoco.mj_step(self.model, self.data, nstep=self.substeps)
        self.after()
        off = float(np.linalg.norm(self.data.qpos[self.at] - GOAL))
        return self._get_obs(), -off, self.crashed(), False, {"success": self.arrived(off)}

    def control(self, action):
        self.data.ctrl[:] = action

    def after(self):
        """What else a step does, after the physics."""

    def crashed(self):
        return False

    def arrived(self, off):
        return off < 0.25


class Flat(Puck):
    """A puck that observes a vector, as the pilot takes it."""

    observation_space = numbers(6)

    def _get_obs(self):
        return np.concatenate([self.seen(), GOAL - self.seen(), self.data.qvel[self.at]])

    def seen(self):
        return self.data.qpos[self.at].copy()


class Home(Flat):
    """Each of its resets leads to one place, which stands in its code."""

    def first(self):
        return np.array([-1.4, 0.1])


class Floating(Puck):
    """A puck on a free joint, as robots have that walk."""

    joints = XML[XML.index('<joint name="x"') : XML.index('<geom type="sphere"')]
    motors = XML[XML.index("<actuator>") : XML.index("</mujoco>")]
    xml = XML.replace(joints, '<freejoint name="root"/>').replace(motors, "")
    xml = xml.replace("<worldbody>", '<worldbody><geom type="plane" size="3 3 1"/>')

    def control(self, action):
        self.data.qfrc_applied[:2] = action


class Slid(Puck):
    """A puck that each action moves, and that stands still between actions: its place is its whole state."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(-1.0, 1.0, (2,), dtype=np.float64)

    def step(self, action):
        self.data.qpos[:] += 0.2 * np.clip(action, -1, 1)
        self.data.qvel[:] = 0.0
        mujoco.mj_step(self.model, self.data)
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)
        distance = float(np.linalg.norm(self.data.qpos - GOAL))
        return self._get_obs(), -distance, False, False, {"success": distance < 0.25}


class Moved(Puck):
    """Each reset puts the rock elsewhere, in the model itself, unless its options say where."""

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.goal = (options or {}).get("rock", self.np_random.uniform(-0.3, 0.3))
        self.model.geom_pos[0, 1] = self.goal
        return super().reset()  # with another number of the same generator


class Gambling(Puck):
    """It observes one array of two rows, and draws random numbers or fails under inputs of which none is
    drawn at random.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2, 2))

    def _get_obs(self):
        return np.stack([self.data.qpos, self.data.qvel])

    def control(self, action):
        super().control(action)
        if np.all(action == 3.9):
            self.np_random.random()
        if np.all(action == 3.8):
            np.random.rand()
        if np.all(action == 3.7):
            raise RuntimeError("broken")


class Delayed(gym.Wrapper):
    """Applies each action a step late: it remembers the last one, as an array or None."""

    last = None

    def reset(self, **options):
        self.last = None
        return self.env.reset(**options)

    def step(self, action):
        before, self.last = self.last, np.array(action)
        return self.env.step(np.zeros(2) if before is None else before)


class Growing(gym.Wrapper):
    """Remembers all actions, and pushes the harder the more there are."""

    def __init__(self, env):
        super().__init__(env)
        self.actions = deque()

    def step(self, action):
        self.actions.append(action)
        return self.env.step(np.asarray(action) * min(1.0, 0.01 * len(self.actions)))


class Secret(gym.Wrapper):
    """Counts steps in a variable that no attribute holds."""

    def __init__(self, env):
        super().__init__(env)
        count = 0

        def scale():
            nonlocal count
            count += 1
            return 1.0 / (1 + count % 7)

        self.scale = scale

    def step(self, action):
        return self.env.step(np.asarray(action) * self.scale())


# ---- agents, and how their runs end


def puck_agent(observation):
    """Goes around the rock on the nearer side: above it from y >= 0, else below."""
    (x, y), to_goal = observation[:, :2].T, observation[:, 2:4]
    behind = x < 0.6
    side = np.where(y >= 0, 1.0, -1.0)
    target = np.where(
        behind[:, None],
        np.stack([0.9 * np.ones_like(x), 0.9 * side], axis=1),
        np.stack([x, y], axis=1) + to_goal,
    )
    ahead = target - np.stack([x, y], axis=1)
    first = behind & (np.abs(y) < 0.6) & (x < -0.3)
    ahead[first] = np.stack([0 * x, side], axis=1)[first]
    length = np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    return 4 * ahead / length - 1.0 * observation[:, 4:]


def pilot(observation):
    """Drives around the rock to the goal, by the place alone: observations (n, 6), sorted by name."""
    place, velocity = observation[:, :2], observation[:, 4:6]
    corner = np.column_stack([np.full(len(place), 0.9), np.where(place[:, 1] >= 0, 0.8, -0.8)])
    target = np.where(place[:, :1] < 0.6, corner, GOAL)
    up = (place[:, 0] < 0.6) & (np.abs(place[:, 1]) < 0.6)
    target[up, 0] = place[up, 0]
    ahead = target - place
    return 3 * ahead / np.maximum(np.linalg.norm(ahead, axis=1), 0.05)[:, None] - 0.5 * velocity


def always(task, *u):
    """An agent that gives the same inputs everywhere."""
    return from_callable(lambda o: np.tile(np.array(u, dtype=float), (len(o), 1)), task)


def ends(task, noise=0.0, starts=STARTS, pilot=pilot):
    """Returns how the pilot's runs end, and after how many samples."""
    signal = None
    if noise:
        shape = task.max_steps + 1, len(starts), len(task.noisy)
        values = noise * np.random.default_rng(0).uniform(-1, 1, shape) * task.noisy
        signal = Recorded(values, noise)
    agent = from_callable(lambda o: np.clip(pilot(np.asarray(o)), -4, 4), task)
    return [(arc.outcome, len(arc.t) - 1) for arc in simulate(task, agent, starts, signal)]


def outcomes(make, noise=0.0, steps=60, starts=STARTS, **given):
    """The same, in an environment that is looked at first."""
    return ends(from_gymnasium(make, steps=steps, **given), noise, starts)


@functools.cache
def flat_task():
    """The task of the puck as it is, with a vector for its observation."""
    return from_gymnasium(Flat, steps=60)


@functools.cache
def plain(noise=0.0):
    """How the pilot's runs end in it."""
    return ends(flat_task(), noise)
