"""Environments of the tests' own, as users may have them."""

from collections import deque

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

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
GOAL = np.array([1.5, 0.0])


class Puck(gym.Env):
    """A puck that goes around a rock, with what the classes below change."""

    observation_space = spaces.Dict(
        {
            "velocity": spaces.Box(-np.inf, np.inf, (2,)),
            "position": spaces.Box(-np.inf, np.inf, (2,)),
            "to_goal": spaces.Box(-np.inf, np.inf, (2,)),
        }
    )

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        self.action_space = spaces.Box(-4.0, 4.0, (2,), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform((-1.8, -1.2), (-1.0, 1.2))
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def _get_obs(self):
        position = self.data.qpos.copy()
        return {"position": position, "velocity": self.data.qvel.copy(), "to_goal": GOAL - position}

    def step(self, action):
        self.data.ctrl[:] = np.clip(action, -4, 4)
        mujoco.mj_step(self.model, self.data, nstep=5)
        distance = float(np.linalg.norm(self.data.qpos - GOAL))
        return self._get_obs(), -distance, False, False, {"success": distance < 0.25}


class Floating(Puck):
    """A puck on a free joint, as robots have that walk."""

    def __init__(self):
        super().__init__()
        joints = XML[XML.index('<joint name="x"') : XML.index('<geom type="sphere"')]
        xml = XML.replace(joints, '<freejoint name="root"/>')
        motors = xml[xml.index("<actuator>") : xml.index("</mujoco>")]
        xml = xml.replace(motors, "").replace(
            "<worldbody>", '<worldbody><geom type="plane" size="3 3 1"/>'
        )
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:2] = self.np_random.uniform((-1.8, -1.2), (-1.0, 1.2))
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def _get_obs(self):
        position = self.data.qpos[:2].copy()
        return {
            "position": position,
            "velocity": self.data.qvel[:2].copy(),
            "to_goal": GOAL - position,
        }

    def step(self, action):
        self.data.qfrc_applied[:2] = np.clip(action, -4, 4)
        mujoco.mj_step(self.model, self.data, nstep=5)
        distance = float(np.linalg.norm(self.data.qpos[:2] - GOAL))
        return self._get_obs(), -distance, False, False, {"success": distance < 0.25}


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


class Delayed(gym.Wrapper):
    """Applies each action a step late: it remembers the last one, as an array or None."""

    def __init__(self, env):
        super().__init__(env)
        self.last = None

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


class Noisy(gym.Wrapper):
    """Draws random numbers in its steps."""

    def step(self, action):
        return self.env.step(action + self.unwrapped.np_random.normal(size=2))


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

    def step(self, action):
        result = super().step(action)
        if np.all(np.asarray(action) == 3.9):
            self.np_random.random()
        if np.all(np.asarray(action) == 3.8):
            np.random.rand()
        if np.all(np.asarray(action) == 3.7):
            raise RuntimeError("broken")
        return result


class Seen(gym.ObservationWrapper):
    """Shows a picture."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Box(0, 255, (8, 8, 3), dtype=np.uint8)

    def observation(self, observation):
        return np.zeros((8, 8, 3), dtype=np.uint8)


class Several(Puck):
    """Has several agents."""

    possible_agents = ("a", "b")


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
