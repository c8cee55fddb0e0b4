"""A planted field: a point that moves at will in the plane among round posts, and runs along given paths."""

import mujoco
import numpy as np

from hyrl_mj.sets import Chart
from hyrl_mj.simulation import Passing, WayRuns
from hyrl_mj.tasks import Outcome, Scene, Task

FIELD = """
<mujoco model="field">
  <option timestep="0.05" integrator="implicitfast" gravity="0 0 0">
    <flag contact="disable" constraint="disable"/>
  </option>
  <worldbody>
    <camera name="overhead" projection="orthographic" fovy="4" pos="2 0 4"/>
    POSTS
    <body>
      <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <geom size="0.01" mass="1"/><site name="tracked"/>
    </body>
    CLOCK
  </worldbody>
  <actuator>
    <velocity name="vx" joint="x" kv="1e7" ctrlrange="-1 1"/>
    <velocity name="vy" joint="y" kv="1e7" ctrlrange="-1 1"/>
  </actuator>
  <sensor><jointpos joint="x"/><jointpos joint="y"/>SENSOR</sensor>
</mujoco>
"""
POST = '<geom name="obstacle{}" type="cylinder" pos="{} {} 0.1" size="{} 0.1"/>'
CLOCK = '<body><joint name="t" type="slide" axis="0 1 0"/><geom size="0.01" mass="1"/></body>'
# How a post moves by itself: along y, by the value of the third joint.
DRIVEN = {
    "mocap": '<body mocap="true" pos="{0} {1} 0.1">{2}</body>' + CLOCK,
    "joint": '<body pos="{0} {1} 0.1"><joint name="t" type="slide" axis="0 1 0"/>{2}</body>',
}
MOVING = '<geom name="obstacle" type="cylinder" size="0.2 0.1" mass="1"/>'


class Field(Task):
    """Drive from x = 0 to x = 4; a run crashes where it touches a post.

    Args:
        posts: of each post, by name, the centre x, y and the radius [m].
        driven: of a further post at (2, 0), what moves it along y: "mocap" or "joint". The third coordinate
            of the chart says how far [m].
    """

    name, env_id = "field", "hyrl_mj/Field-v0"
    description = "planted"
    inputs = ("vx", "vy")
    noisy = (False, True)
    max_steps = 90
    worst_reward = 0.0
    start_low, start_high = (0.0, -1.0), (0.3, 1.0)
    observation_low, observation_high = (-9.0, -9.0), (9.0, 9.0)
    scene = Scene(starts=((0.0, 0.0),), time=4.2)
    set_point = np.array([4.0, 0.0])

    def __init__(self, posts=None, driven=""):
        self.posts = np.array([*(posts or {}).values()], dtype=float).reshape(-1, 3)
        geoms = "".join(POST.format(name, *post) for name, post in (posts or {}).items())
        body = DRIVEN[driven].format(2, 0, MOVING) if driven else ""
        sensor = '<jointpos joint="t"/>' if driven else ""
        xml = FIELD.replace("POSTS", geoms).replace("CLOCK", body).replace("SENSOR", sensor)
        self.model = mujoco.MjModel.from_xml_string(xml)
        d = 2 + bool(driven)
        names, units = ("x", "y", "t")[:d], ("m",) * d
        self.chart = Chart(names, units, (0.0, -2.0, -9.0)[:d], (4.0, 2.0, 9.0)[:d], (False,) * d)

    def state(self, z, rng=None):
        order = [self.model.joint(name).qposadr[0] for name in self.chart.names]
        qpos = np.empty_like(z)
        qpos[:, order] = z
        return qpos, None

    def observation(self, measured):
        return measured[:, :2]

    def reward(self, measurement, u):
        return np.ones(len(measurement))

    def ending(self, measurement):
        ends = np.full(len(measurement), Outcome.RUNNING)
        ends[measurement[:, 0] >= 4 - 1e-6] = Outcome.REACHED
        for x, y, radius in self.posts:
            off = np.hypot(measurement[:, 0] - x, measurement[:, 1] - y)
            ends[off <= radius] = Outcome.CRASHED
        return ends

    def verdict(self, measurement):
        return np.full(len(measurement), Outcome.STALLED)


class Driven(Field):
    """A field with a post that mocap moves."""

    def __init__(self):
        super().__init__(driven="mocap")

    def mocap(self, qpos):
        place = np.tile([2.0, 0.0, 0.1], (len(qpos), 1, 1))
        place[:, 0, 1] = qpos[:, 2]
        return place


def along(*paths, samples=100):
    """Paths (samples, n, d) along lines between given points, at equal speed."""
    fine = []
    for points in paths:
        points = np.array(points, dtype=float)
        far = np.append(0, np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum())
        at = np.linspace(0, far[-1], samples)
        fine.append(np.stack([np.interp(at, far, column) for column in points.T], axis=1))
    return np.stack(fine, axis=1)


def followed(task, path):
    """How planted paths (S, n, d) pass the obstacles of a task, as the stages see it."""
    n = path.shape[1]
    plant = task.plant(n)
    plant.set_state(*task.state(path[0]))
    passing = Passing.begin(task, plant)
    for z in path[1:]:
        plant.set_state(*task.state(z))
        passing.follow(task, plant, np.arange(n))
    return passing


def runs_along(task, path, arrived=None):
    """The `WayRuns` of planted paths (S, n, d); all of them arrive by default."""
    whole = np.ones(path.shape[1], dtype=bool)
    arrived = whole if arrived is None else arrived
    return WayRuns(whole, arrived, arrived, whole, None, followed(task, path))
