"""Small worlds of MuJoCo as environments, in which traps are planted."""

import math
from dataclasses import dataclass

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

# How long an episode lasts [s], and the physics step for each frame_skip [s].
EPISODE = 4.0
TIMESTEPS = {1: 0.04, 2: 0.02, 3: 0.015, 4: 0.0125, 5: 0.01}
# How far a robot that stands free is from everything else [m].
CLEAR = 0.15
# Where rays of a scan look, as angles [rad].
RAYS = np.arange(6) * np.pi / 3


@dataclass(frozen=True)
class Plan:
    """What a world is like.

    Attributes:
        kind: "slides", "free", "hinge", or "cart" and "door", which are slides beside something that moves.
        actuator: "motor", "velocity", "position" or "filtered".
        frame_skip: physics steps in a step.
        half: of the arena (x, y) [m].
        rock: the island, x, y and half of its sizes [m].
        force: the largest [N or N m], and damping of the joints [N s/m or N m s].
        goal: its place (2,) [m] or (1,) [rad].
        goal_in: where the environment keeps it: "site", "mocap", "qpos", "userdata" or "attribute".
        view: the observation, "box", "dict" or "unsorted".
        levels: whether the action space is Discrete.
        scale: of the actions, where it is a Box.
        success: as for `from_gymnasium`; "info" has the key `word`.
        crashes: whether touching the island terminates.
        scan: whether the observation has rays.
        beacon: the place of a mocap body that can be touched; None without one.
        first: whether what moves beside the robot comes first in the model.
        forward: whether a step ends with `mj_forward`.
        rated: whether the chart has the rate of a hinge, too.
    """

    kind: str = "slides"
    actuator: str = "motor"
    frame_skip: int = 5
    half: tuple[float, float] = (1.6, 1.3)
    rock: tuple[float, float, float, float] = (0.0, 0.0, 0.3, 0.3)
    force: float = 3.0
    damping: float = 2.0
    radius: float = 0.1
    goal: tuple[float, ...] = (1.2, 0.0)
    goal_in: str = "site"
    view: str = "box"
    levels: bool = False
    scale: float = 1.0
    success: str = "info"
    word: str = "success"
    crashes: bool = False
    scan: bool = False
    beacon: tuple[float, float] | None = None
    first: bool = False
    forward: bool = False
    rated: bool = False

    @property
    def turns(self):
        return self.kind == "hinge"

    @property
    def dimension(self):
        return 1 if self.turns else 2

    @property
    def dt(self):
        return self.frame_skip * TIMESTEPS[self.frame_skip]

    @property
    def steps(self):
        return round(EPISODE / self.dt)

    @property
    def beside(self):
        """The x of what moves beside the robot."""
        return self.rock[0] + self.rock[2] + 0.35

    def free(self, place):
        """Whether a robot at a place (2,) touches nothing, and has not arrived."""
        if self.turns:
            return np.cos(place[0] - self.goal[0]) < 0.7
        x, y, hx, hy = self.rock
        room = self.radius + CLEAR
        in_arena = (np.abs(place) < np.array(self.half) - room).all()
        off_rock = (np.abs(place - [x, y]) > np.array([hx, hy]) + room).any()
        beside = self.kind in ("cart", "door") and abs(place[0] - self.beside) < room + 0.3
        touched = self.beacon is not None and np.linalg.norm(place - self.beacon) < 2 * room
        return (
            in_arena
            and off_rock
            and not beside
            and not touched
            and (np.linalg.norm(place - self.goal) > 0.6)
        )

    def starts(self, n, rng):
        """Starts (n, c) in the chart that touch nothing."""
        found = []
        high = np.array([np.pi] if self.turns else self.half)
        while len(found) < n:
            place = rng.uniform(-high, high)
            if self.free(place):
                found.append(place)
        if self.rated:
            found = [[*place, rng.uniform(-1, 1)] for place in found]
        return np.array(found)

    def xml(self):
        joints = ["turn"] if self.turns else ["x", "y"]
        kinds = {
            "motor": f'motor gear="{self.force}"',
            "velocity": f'velocity kv="{self.force}"',
            "position": f'position kp="{3 * self.force}"',
            "filtered": f'general dyntype="filterexact" dynprm="0.1" gainprm="{self.force}"',
        }
        actuators = "".join(
            f'<{kinds[self.actuator]} joint="{j}" name="push_{j}"/>' for j in joints
        )
        body = _hinge(self) if self.turns else _puck(self)
        return f"""
<mujoco model="world">
  <option timestep="{TIMESTEPS[self.frame_skip]}" integrator="implicitfast"/>
  <size nuserdata="4"/>
  <worldbody>{_arena(self)}{body}{_goal(self)}</worldbody>
  <actuator>{"" if self.kind == "free" else actuators}</actuator>
  <sensor><framepos objtype="site" objname="tip" name="seen"/></sensor>
</mujoco>"""


def _hinge(plan):
    return f"""
    <body name="arm"><joint name="turn" type="hinge" axis="0 0 1" damping="{plan.damping}"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.04" mass="1"/>
      <site name="tip" pos="0.5 0 0"/></body>"""


def _puck(plan):
    slide = f'type="slide" damping="{plan.damping}"'
    joints = f'<joint name="x" axis="1 0 0" {slide}/><joint name="y" axis="0 1 0" {slide}/>'
    height = plan.radius if plan.kind == "free" else 0.1
    puck = f"""
    <body name="puck" pos="0 0 {height}">{'<freejoint name="root"/>' if plan.kind == "free" else joints}
      <geom name="puck" type="sphere" size="{plan.radius}" mass="1"/><site name="tip"/></body>"""
    beside = {
        "cart": f"""<body name="cart" pos="{plan.beside} 0 0.1">
      <joint name="roll" type="slide" axis="0 1 0" range="-0.7 0.7" limited="true" damping="0.3"/>
      <geom type="box" size="0.06 0.12 0.1" mass="0.5"/></body>""",
        "door": f"""<body name="door" pos="{plan.beside} 0.5 0.1">
      <joint name="swing" type="hinge" axis="0 0 1" damping="0.1"/>
      <geom type="box" size="0.03 0.2 0.1" pos="0 -0.2 0" mass="0.3"/></body>""",
    }.get(plan.kind, "")
    return beside + puck if plan.first else puck + beside


def _arena(plan):
    if plan.turns:
        return ""
    (hx, hy), (x, y, rx, ry) = plan.half, plan.rock
    walls = "".join(
        f'<geom type="box" size="{a} {b} 0.1" pos="{px} {py} 0.1"/>'
        for a, b, px, py in (
            (hx + 0.2, 0.1, 0, hy + 0.1),
            (hx + 0.2, 0.1, 0, -hy - 0.1),
            (0.1, hy + 0.2, hx + 0.1, 0),
            (0.1, hy + 0.2, -hx - 0.1, 0),
        )
    )
    beacon = ""
    if plan.beacon is not None:
        bx, by = plan.beacon
        beacon = f'<body name="beacon" mocap="true" pos="{bx} {by} 0.1"><geom size="{plan.radius}"/></body>'
    floor = '<geom type="plane" size="3 3 1"/>' if plan.kind == "free" else ""
    return f'<geom name="rock" type="box" size="{rx} {ry} 0.1" pos="{x} {y} 0.1"/>{walls}{floor}{beacon}'


def _goal(plan):
    if plan.turns:
        x, y = 0.5 * np.cos(plan.goal[0]), 0.5 * np.sin(plan.goal[0])
        return f'<site name="goal" pos="{x} {y} 0"/>'
    place = f"{plan.goal[0]} {plan.goal[1]} 0.1"
    geom = '<geom size="0.05" contype="0" conaffinity="0"/>'
    goals = {
        "mocap": f'<body name="goal" mocap="true" pos="{place}">{geom}</body>',
        "qpos": f"""<body name="goal" pos="0 0 0.1"><joint name="goal_x" type="slide" axis="1 0 0"/>
          <joint name="goal_y" type="slide" axis="0 1 0"/>{geom}</body>""",
        "body": f'<body name="goal" pos="{place}">{geom}</body>',
    }
    return goals.get(plan.goal_in, f'<site name="goal" pos="{place}"/>')


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
