"""Plans of small worlds, and their models in MuJoCo's XML."""

from dataclasses import dataclass

import numpy as np

# How long an episode lasts [s], and the physics step for each frame_skip [s].
EPISODE = 4.0
TIMESTEPS = {1: 0.04, 2: 0.02, 3: 0.015, 4: 0.0125, 5: 0.01}
# How far a robot that stands free is from everything else [m].
CLEAR = 0.15


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
