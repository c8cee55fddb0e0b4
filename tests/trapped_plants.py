"""Robots with planted traps: plants and task files in which something is not what it seems.

Each of `ROBOTS` is a vehicle that passes a pillar, or a pointer on a dial, with one trap in its files.
`examined` tells what the package says of it, and plays what it calls won with `mujoco.mj_step` alone.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from test_certificate import linear

import hyrl_mj
from hyrl_mj import BadInput
from hyrl_mj.judging.game import NEVER, Game, Lattice
from hyrl_mj.judging.proof import Certificate, why_no_cells
from hyrl_mj.policies import PolicyController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, Noise, closed_loop
from hyrl_mj.stages.partition import Partition
from hyrl_mj.tasks import Outcome, check_task

# Starts that are replayed of each robot, and the noise bound.
STARTS, EPS = 30, 0.05
NUMBER = itertools.count()  # names of tasks are used once

MJCF = """<mujoco model="{name}">
  <option timestep="0.05" integrator="implicitfast" gravity="0 0 0">{flag}</option>
  <custom><numeric name="sample_time" data="0.05"/></custom>
  <default><geom contype="{contact}" conaffinity="{contact}"/></default>
  <worldbody>
    {scenery}
    <body name="robot">
      {joints}
      <geom name="robot" size="0.05" mass="{mass}"/>
      <site name="tracked" size="0.01"/>
    </body>
  </worldbody>
  {more}
  <actuator>{actuators}</actuator>
  <sensor>{sensors}</sensor>
  {keyframe}
</mujoco>
"""
TASK = """import numpy as np
import hyrl_mj
from hyrl_mj import Chart, Learning, Mirror, Outcome, Scene


class Robot(hyrl_mj.Task):
    name = "{name}"
    env_id = "hyrl_mj/{name}-v0"
    description = "planted"
    chart = Chart({chart})
    inputs = ("u",)
    noisy = {noisy}
    max_steps = {max_steps}
    worst_reward = -10.0
    start_low, start_high = {box}
    scene = Scene(starts={shown}, time=2.0, mode_names=("left", "right"))
    learning = Learning(levels={levels})
    observation_low, observation_high = {limits}
    mirror = {mirror}
    set_point = np.array({goal})
    close = 0.3
    count = 0

    def observation(self, measured):
        {observation}

    def measured(self, observation):
        return {measured}

    def reward(self, measured, u):
        return np.zeros(len(measured))

    def ending(self, measured):
        {ending}
        return ends

    def direction(self, path):
        return np.where(path[-1, :, -1] > path[0, :, -1], 0, 1)
{methods}
"""
CALM = '<flag contact="disable" constraint="disable"/>'
VELOCITY = '<velocity name="{name}" joint="{joint}" kv="{kv:g}" {more}/>'
FILTERED = (
    '<general name="{name}" joint="{joint}" gainprm="{kv:g}" biastype="affine" '
    'biasprm="0 0 -{kv:g}" {more}/>'
)


class Robot(NamedTuple):
    """A robot: what its files hold in the places of the templates."""

    xml: dict[str, str]
    py: dict[str, str]
    servo: str
    on_joint: str
    kv: float
    sensor: str


def vehicle():
    xml = {
        "flag": CALM, "contact": "0", "mass": "1.5", "more": "",
        "scenery": '<geom name="obstacle" type="cylinder" size="0.6 0.1" pos="1.5 0 0" contype="0" '
        'conaffinity="0"/>',
        "joints": '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>',
        "keyframe": '<keyframe><key qpos="0 0" ctrl="1 0"/></keyframe>',
    }  # fmt: skip
    py = {
        "chart": '("x", "y"), ("m", "m"), (0.0, -1.5), (3.0, 1.5), (False, False)',
        "noisy": "(False, True)", "max_steps": "70", "box": "(0.0, -1.0), (0.4, 1.0)",
        "shown": "((0.0, 0.5),)", "limits": "(-99.0, -99.0), (99.0, 99.0)", "mirror": "None",
        "goal": "[3.0, 0.0]", "measured": "observation", "observation": "return measured",
        "ending": "x, y = measured.T\n"
        "        ends = np.full(len(x), Outcome.RUNNING)\n"
        "        ends[x >= 3 - 1e-6] = Outcome.REACHED\n"
        "        ends[np.abs(y) >= 1.5 - 1e-6] = Outcome.OUT_OF_BOUNDS\n"
        "        ends[np.sqrt((x - 1.5) ** 2 + y**2) <= 0.6] = Outcome.CRASHED",
        "methods": "", "levels": "5",
    }  # fmt: skip
    return Robot(xml, py, "", "", 1e9, "")


def dial():
    xml = {
        "flag": CALM, "contact": "0", "mass": "1", "more": "", "scenery": "", "keyframe": "",
        "joints": '<joint name="theta" type="hinge" axis="0 0 1" armature="1"/>',
    }  # fmt: skip
    py = {
        "chart": '("theta",), ("rad",), (0.0,), (2 * np.pi,), (True,)',
        "noisy": "(True,)", "max_steps": "200", "levels": "None",
        "box": "(0.0,), (2 * np.pi,)", "shown": "((3.0,),)",
        "limits": "(-999.0, -999.0), (999.0, 999.0)", "mirror": "None", "goal": "[0.0]",
        "measured": "np.arctan2(observation[:, 1:], observation[:, :1])",
        "observation": "return np.hstack([np.cos(measured), np.sin(measured)])",
        "ending": "theta = measured[:, 0]\n        ends = np.full(len(theta), Outcome.RUNNING)",
        "methods": "    def miss(self, z):\n"
        "        return np.abs(self.chart.difference(z, self.set_point))[:, 0]\n",
    }  # fmt: skip
    return Robot(xml, py, "", "", 1e9, "")


def ends(robot, code):
    return robot._replace(py=robot.py | {"ending": f"{robot.py['ending']}\n        {code}"})


def methods(robot, code):
    return robot._replace(py=robot.py | {"methods": robot.py["methods"] + code})


def mirrored(radius):
    """A vehicle that is no mirror image, because of a second obstacle."""
    robot = ends(
        vehicle(), f"ends[(x - 2.4) ** 2 + (y - 0.8) ** 2 <= {radius} ** 2] = Outcome.CRASHED"
    )
    post = f'<geom name="obstacle_b" size="{radius}" pos="2.4 0.8 0" contype="0" conaffinity="0"/>'
    xml = robot.xml | {"scenery": robot.xml["scenery"] + post}
    return robot._replace(xml=xml, py=robot.py | {"mirror": "Mirror((1, -1), (-1,))"})


BAND = "(x - 1.1) * (x - 1.5)"  # less than 0 between these
# Robots by what is wrong with them.
ROBOTS = {
    "nothing": vehicle(),
    "nothing of a dial": dial(),
    "delay": vehicle()._replace(servo='delay="0.05" nsample="2"'),
    "filter": dial()._replace(servo='dyntype="filterexact" dynprm="0.2"'),
    "lag": vehicle()._replace(kv=1e6, xml=vehicle().xml | {"mass": "1000"}),
    "spring": vehicle()._replace(kv=1e7, on_joint='stiffness="1e7"'),
    "tendon": vehicle()._replace(
        kv=1e6,
        xml=vehicle().xml
        | {
            "more": '<tendon><fixed name="t" stiffness="1e7" springlength="-9 2"><joint joint="x" coef="1"/>'
            "</fixed></tendon>"
        },
    ),
    "weak servo": vehicle()._replace(kv=1e6, servo='forcerange="-5 5"'),
    "weak joint": vehicle()._replace(kv=1e6, on_joint='actuatorfrcrange="-5 5"'),
    "NaN": ends(vehicle(), f"ends[~(np.sqrt({BAND}) >= -1) & (x > 0.5)] = Outcome.CRASHED"),
    "NaN where it chooses": ends(
        vehicle(), f"ends = np.where(np.log({BAND}) >= -99, ends, Outcome.CRASHED)"
    ),
    "a far turn": ends(dial(), "ends[np.abs(theta + 6 * np.pi - 1) < 1e-4] = Outcome.CRASHED"),
    "held sensor": vehicle()._replace(sensor='interval="0.2" nsample="3"'),
    "late sensor": vehicle()._replace(sensor='delay="0.1" nsample="4"'),
    "short sensor": vehicle()._replace(sensor='cutoff="2"'),
    "thin end": ends(vehicle(), "ends[np.abs(x - 1.213) < 1e-3] = Outcome.CRASHED"),
    "thin wall": vehicle()._replace(
        kv=1e6,
        xml=vehicle().xml
        | {
            "flag": "",
            "contact": "1",
            "scenery": '<geom name="wall" type="box" size="0.001 3 0.2" pos="1.213 0 0"/>',
        },
    ),
    "a start that is over": ends(
        vehicle(), "ends[np.hypot(x - 0.2, y - 0.3) < 0.02] = Outcome.CRASHED"
    ),
    "mirror": mirrored(0.05),
    "starts": methods(
        vehicle(),
        "\n    def starts(self, n, rng):\n        return rng.uniform((0.0, -1.0), (0.41, 1.0), (n, 2))\n",
    ),
    "measurement": methods(
        vehicle(), "\n    def measure(self, sensors):\n        return np.minimum(sensors, 2.9)\n"
    ),
    "outcome": methods(
        vehicle(),
        "\n    def outcome(self, measurement, unstable):\n        return self.ending(measurement)\n",
    ),
    "count": ends(
        vehicle(),
        "self.count = self.count + 1\n        ends[(self.count > 5) & (x > 1)] = Outcome.CRASHED",
    ),
    "other rows": ends(vehicle(), "ends[(x > 1) & (y >= y.max() - 0.1)] = Outcome.CRASHED"),
}


def task_of(robot, folder):
    """Writes the files of a robot, and returns its task."""
    name = f"trapped_{next(NUMBER)}"
    actuator = FILTERED if "dyntype" in robot.servo else VELOCITY
    ahead = VELOCITY.format(name="ahead", joint="x", kv=robot.kv, more="")
    joint, ahead = ("y", ahead) if "x" in robot.py["chart"] else ("theta", "")
    drive = actuator.format(
        name="u", joint=joint, kv=robot.kv, more='ctrlrange="-1 1" ' + robot.servo
    )
    joints = ("x", "y") if ahead else ("theta",)
    xml = robot.xml | {
        "name": name,
        "actuators": ahead + drive,
        "sensors": "".join(f'<jointpos joint="{j}" {robot.sensor}/>' for j in joints),
        "joints": robot.xml["joints"].replace("<joint", f"<joint {robot.on_joint}"),
    }
    (folder / f"{name}.xml").write_text(MJCF.format(**xml))
    (folder / f"{name}.py").write_text(TASK.format(name=name, **robot.py))
    return hyrl_mj.get_task(folder / f"{name}.py")


def policy_of(task):
    """A network: past the pillar on the left, or the shorter way to the set-point of the dial."""
    if task.chart.dimension == 1:
        return linear(task, [[0.0, -3.0]], [0.0])
    weights, bias = [[0.0, 0.0]] * 5, [-99.0, -99.0, 0.0, -99.0, 0.95]
    weights[4] = [0.0, -1.0]
    return linear(task, weights, bias)


def replay(task, policy, z, noise):
    """Plays runs from positions z (n, d) with `mj_step` alone; returns whether they arrive: (n,) bool.

    The measurement is the true position and the noise (K, n, d). Nothing of the package's plant is used.
    """
    model = mujoco.MjModel.from_xml_path(str(task.model_path))
    drive, datas = model.actuator("u").id, []
    for start in z:
        data = mujoco.MjData(model)
        if model.nkey:
            data.ctrl[:] = model.key_ctrl[0]
        data.qpos[:] = start
        datas.append(data)
    outcome = np.full(len(z), Outcome.RUNNING)
    for k in range(task.max_steps + 1):
        qpos = np.array([data.qpos for data in datas])
        now = (
            task.ending(qpos)
            if type(task).outcome is hyrl_mj.Task.outcome
            else task.outcome(qpos, False)
        )
        outcome = np.where(outcome == Outcome.RUNNING, now, outcome)
        if k == task.max_steps or (outcome != Outcome.RUNNING).all():
            break
        u = policy.act(qpos + noise[k])[:, 0]
        for data, input_ in zip(datas, u, strict=True):
            data.ctrl[drive] = input_
            mujoco.mj_step(model, data)
    still = outcome == Outcome.RUNNING
    outcome[still] = task.verdict(qpos)[still]
    return outcome == Outcome.REACHED


def noises(task, n, rng):
    """Noise signals (K, n, d) within the bound: none, uniform and alternating."""
    shape = (task.max_steps, n, task.chart.dimension)
    bound = task.noise_in_chart(EPS)
    signs = np.where(np.arange(task.max_steps) % 2, -1.0, 1.0)[:, None, None]
    return np.zeros(shape), rng.uniform(-bound, bound, shape), np.broadcast_to(signs * bound, shape)


class Found(NamedTuple):
    """What is said of a robot, "refused", "estimate" or "proved"; and claims that a replay refutes."""

    word: str
    wrong: tuple[str, ...]


def examined(robot, folder: Path) -> Found:
    """Examines a robot, and replays what is called won of it."""
    rng = np.random.default_rng(0)
    try:
        task = task_of(robot, folder)
        check_task(task)
        policy = policy_of(task)
        grid = Grid.with_cells(task.chart, 600 if task.chart.dimension == 1 else 60)
        wrong = [*_episodes(task, policy, rng)]
        if Lattice.why_not(task, grid) or why_no_cells(task, grid.counts):
            return Found("estimate", tuple(wrong))
        loop = PolicyController(policy)
        everywhere = GridSet.from_mask(grid, np.ones(len(grid.nodes), dtype=bool))
        parts = Partition((0, 1), (everywhere,) * 2, np.ones(len(grid.nodes), dtype=bool))
        game = Game(task, parts, {"policy": loop}, EPS, grid=grid)
        certificate = Certificate.certify(game, {"policy": loop})
    except BadInput:
        return Found("refused", ())
    if "policy" not in certificate.answers:
        return Found("estimate", tuple(wrong))
    cells = certificate.cells
    proved = np.flatnonzero((certificate.value("policy", EPS)[-1, :-2] < NEVER) & cells.running)
    won = np.flatnonzero((game.value("policy", EPS)[-1, :-2] < NEVER) & game.lattice.running)
    for what, at, place in (
        ("proved", proved, lambda k: cells.draw(k, rng)),
        ("won", won, lambda k: game.lattice.grid.nodes[k]),
    ):
        if len(at):
            z = place(rng.choice(at, STARTS))
            for noise in noises(task, len(z), rng):
                lost = ~replay(task, policy, z, noise)
                if lost.any():
                    wrong.append(f"{what} and lost: {lost.sum()} of {len(z)}, as {z[lost][0]}")
    return Found("proved" if len(proved) else "nothing proved", tuple(wrong))


def _episodes(task, policy, rng):
    """Yields where runs of the package end otherwise than with `mj_step`: such runs decide HELD."""
    z = task.starts(STARTS, rng)
    settings = LoopSettings(quiet=True)
    quiet = Noise("none", 0.0)
    run = closed_loop(task, PolicyController(policy), z, quiet, settings=settings)
    ours = run.outcome == Outcome.REACHED
    apart = ours != replay(task, policy, z, noises(task, STARTS, rng)[0])
    if apart.any():
        yield f"{apart.sum()} of {STARTS} episodes end otherwise, as {z[apart][0]}"
