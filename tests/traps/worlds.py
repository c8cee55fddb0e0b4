"""Small worlds of MuJoCo as environments, in which traps are planted."""

import math

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

from traps.plans import Plan

# Where rays of a scan look, as angles [rad].
RAYS = np.arange(6) * np.pi / 3


class World(gym.Env):
    """An environment after a plan. Traps change its methods.

    All that its sensor reads of the robot's place goes through `sense`. `next_sample`, `sensor_offset` and
    `start` are for the truth alone: it tells there what noise each sample of the sensor has, and where a
    reset leads.
    """

    plan = Plan()

    def __init__(self):
        plan = self.plan
        self.model = mujoco.MjModel.from_xml_string(plan.xml())
        self.data = mujoco.MjData(self.model)
        names = ["turn"] if plan.turns else ["x", "y"]
        joints = [] if plan.kind == "free" else [self.model.joint(name) for name in names]
        self.chart = [int(j.qposadr[0]) for j in joints] or [0, 1]
        self.rates = [int(j.dofadr[0]) for j in joints] or [0, 1]
        self.rest = [i for i in range(self.model.nv) if i not in self.rates]
        self.beside = [i for i in range(self.model.nq) if i not in self.chart]
        self.goal_at = 0
        if not plan.turns:
            kind = plan.goal_in if plan.goal_in in ("mocap", "qpos", "body") else "site"
            goal = self.model.site("goal") if kind == "site" else self.model.body("goal")
            self.goal_at = goal.id if kind != "mocap" else int(goal.mocapid[0])
            if kind == "qpos":
                self.goal_at = int(self.model.joint("goal_x").qposadr[0])
        self.widths = self.sizes()
        self.target = np.array(plan.goal)
        self.start, self.sensor_offset = None, np.zeros(plan.dimension)
        parts = [(name, _numbers(size)) for name, size in self.widths.items()]
        if plan.view == "unsorted":
            self.observation_space = spaces.Dict(parts)
        elif plan.view == "dict":
            self.observation_space = spaces.Dict(dict(parts))
        else:
            self.observation_space = _numbers(sum(self.widths.values()))
        limit = plan.scale * np.ones(plan.dimension)
        self.action_space = spaces.Box(-limit, limit, dtype=np.float64)
        if plan.levels:
            self.action_space = spaces.Discrete(1 + 2 * plan.dimension)

    # ---- of the truth

    def next_sample(self):
        """The sensor samples anew."""

    # ---- an episode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        drawn = self.plan.starts(1, self.np_random)[0]
        self.draw()
        start = drawn if self.start is None else self.start
        self.data.qpos[self.chart] = start[: self.plan.dimension]
        if self.plan.rated:
            self.data.qvel[self.rates] = start[self.plan.dimension :]
        mujoco.mj_forward(self.model, self.data)
        self.next_sample()
        self.begin()
        return self.shown(), {}

    def step(self, action):
        self.drive(self.decoded(action))
        self.simulate()
        if self.plan.forward:
            mujoco.mj_forward(self.model, self.data)
        self.next_sample()
        self.remember()
        return self.shown(), *self.judged()

    def draw(self):
        """Draws what a reset draws, beside the start."""

    def begin(self):
        """Sets what is remembered as it is at the start."""

    def remember(self):
        """Remembers something after the physics of a step."""

    def decoded(self, action):
        """The action as shares (m,) of the largest force."""
        if self.plan.levels:
            level, share = int(action), np.zeros(self.plan.dimension)
            if level:
                share[(level - 1) // 2] = 1.0 if level % 2 else -1.0
            return share
        return np.minimum(np.maximum(np.asarray(action, dtype=float) / self.plan.scale, -1), 1)

    def drive(self, share):
        """Passes shares of the largest force on to MuJoCo."""
        if self.plan.kind == "free":
            self.data.qfrc_applied[:2] = self.plan.force * share
            return
        target = self.data.qpos[self.chart] + 0.3 * share
        self.data.ctrl[:] = target if self.plan.actuator == "position" else share

    def simulate(self):
        mujoco.mj_step(self.model, self.data, nstep=self.plan.frame_skip)

    # ---- what it observes, and how it judges

    def place(self):
        """The robot's place (d,)."""
        return self.data.qpos[self.chart].copy()

    def charted(self):
        """The chart point (c,)."""
        rate = self.data.qvel[self.rates] if self.plan.rated else []
        return np.append(self.place(), rate)

    def sense(self):
        """The robot's place (d,), as its sensor reads it."""
        return self.place() + self.sensor_offset

    def goal(self):
        """The goal's place (d,)."""
        where, at = self.plan.goal_in, self.goal_at
        if self.plan.turns:
            return np.array(self.plan.goal)
        if where == "mocap":
            return self.data.mocap_pos[at, :2].copy()
        if where == "qpos":
            return self.data.qpos[at : at + 2].copy()
        if where == "userdata":
            return self.data.userdata[:2].copy()
        if where == "attribute":
            return self.target
        return (self.model.body_pos if where == "body" else self.model.site_pos)[at, :2].copy()

    def sizes(self):
        """How many numbers each part of the observation has."""
        d = self.plan.dimension
        names = {"velocity": d, "position": 2, "to_goal": 2}
        if self.plan.scan:
            names["scan"] = len(RAYS)
        if self.plan.kind in ("cart", "door"):
            names["others"] = len(self.others())
        return names

    def others(self):
        """Positions and velocities of what moves beside the robot."""
        return np.concatenate([self.data.qpos[self.beside], self.data.qvel[self.rest]])

    def parts(self):
        """The parts of the observation."""
        seen, goal = self.sense(), self.goal()
        if self.plan.turns:
            (angle,), (to,) = seen, seen - goal
            position = np.array([math.cos(angle), math.sin(angle)])
            to_goal = np.array([math.cos(to), math.sin(to)])
        else:
            position, to_goal = seen, goal - seen
        found = {
            "velocity": self.data.qvel[self.rates].copy(),
            "position": position,
            "to_goal": to_goal,
        }
        if self.plan.scan:
            found["scan"] = self.scanned(seen)
        if self.plan.kind in ("cart", "door"):
            found["others"] = self.others()
        return found

    def scanned(self, seen):
        """How far rays go from a place (2,) until they meet something (r,) [m]."""
        at, hit = np.array([*seen, 0.1]), np.zeros(1, dtype=np.int32)
        own = self.model.body("puck").id
        return np.array(
            [
                mujoco.mj_ray(
                    self.model,
                    self.data,
                    at,
                    np.array([np.cos(a), np.sin(a), 0.0]),
                    None,
                    1,
                    own,
                    hit,
                )
                for a in RAYS
            ]
        )

    def _get_obs(self):
        return self.shown()

    def shown(self):
        """The observation, of its space."""
        parts = self.parts()
        if self.plan.view == "box":
            return np.concatenate([parts[name] for name in self.widths])
        return {name: np.array(parts[name]) for name in self.widths}

    def arrived(self):
        """Whether the robot is at the goal."""
        if self.plan.turns:
            near = math.cos(*(self.place() - self.goal())) > 0.97
            return near and bool(abs(self.data.qvel[self.rates[0]]) < 1.0)
        return math.hypot(*(self.place() - self.goal())) < 0.25

    def crashed(self):
        """Whether the robot touches the island."""
        if self.plan.turns or not self.plan.crashes:
            return False
        x, y, hx, hy = self.plan.rock
        outside = np.maximum(np.abs(self.place() - [x, y]) - [hx, hy], 0)
        return bool(np.linalg.norm(outside) < self.plan.radius + 0.02)

    def reward(self, arrived):
        """The reward; 2 at the goal."""
        return 2.0 if arrived else -math.hypot(*(self.place() - self.goal()))

    def judged(self):
        """Reward, terminated, truncated and info of a step."""
        arrived, plan = self.arrived(), self.plan
        ends = arrived and plan.success == "terminated"
        info = {plan.word: arrived} if plan.success == "info" else {}
        return self.reward(arrived), bool(ends or self.crashed()), False, info


def _numbers(size):
    return spaces.Box(-np.inf, np.inf, (size,), dtype=np.float64)
