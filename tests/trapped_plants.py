"""Robots with planted traps: plants and task files in which something is not what it seems.

Each is drawn from a seed: a vehicle that passes a pillar, or a pointer on a dial, with one of `TRAPS` in its
files. `examined` tells what the package says of it, and plays what it calls won with `mujoco.mj_step` alone.
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
STARTS, EPS = 60, 0.05
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
    """A drawn robot: its trap, its files and how its policy steers."""

    trap: str
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
    return Robot("", xml, py, "", "", 1e9, "")


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
    return Robot("", xml, py, "", "", 1e9, "")


def ends(robot, code):
    return robot._replace(py=robot.py | {"ending": f"{robot.py['ending']}\n        {code}"})


def methods(robot, code):
    return robot._replace(py=robot.py | {"methods": robot.py["methods"] + code})


def undefined(rng):
    """A quantity that is NaN in a band of x, and no less than -1 elsewhere."""
    a = rng.uniform(0.8, 2.2)
    b = a + rng.uniform(0.15, 0.6)
    band = f"(x - {a:.4f}) * (x - {b:.4f})"
    return str(
        rng.choice(
            [
                f"np.sqrt({band})",
                f"({band}) ** 0.5",
                f"np.exp(np.log({band}))",
                f"np.arccos(1 - np.minimum({band}, 1))",
                f"np.maximum(np.sqrt({band}), 0)",
                f"np.where({band} < 0, np.nan, 1.0)",
                f"np.abs(np.divide(np.maximum({band}, 0), np.maximum({band}, 0)))",
            ]
        )
    )


def trap_honest(rng):
    return vehicle() if rng.random() < 0.6 else dial()


def trap_delay(rng):
    robot, samples = trap_honest(rng), int(rng.integers(1, 8))
    return robot._replace(servo=f'delay="{0.05 * samples:.2f}" nsample="{samples + 1}"')


def trap_filter(rng):
    robot, kind = trap_honest(rng), rng.choice(["filter", "filterexact"])
    return robot._replace(servo=f'dyntype="{kind}" dynprm="{rng.uniform(0.03, 0.5):.3f}"')


def trap_lag(rng):
    robot = vehicle()
    return robot._replace(xml=robot.xml | {"mass": f"{10 ** rng.uniform(1.5, 6):.4g}"}, kv=1e6)


def trap_nan(rng):
    robot = vehicle()
    kind, value = rng.integers(3), undefined(rng)
    if kind == 0:
        return ends(robot, f"ends[~(-1 <= {value})] = Outcome.CRASHED")
    if kind == 1:
        return ends(robot, f"ends = np.where({value} >= -1, ends, Outcome.CRASHED)")
    seen = "x, y = measured.T\n        "
    seen += f"return np.stack([x, np.where(-1 <= {value}, y, -9 * np.sign(y) * x)], axis=1)"
    return robot._replace(py=robot.py | {"observation": seen})


def trap_turns(rng):
    robot, side = dial(), rng.choice([-1, 1])
    first = rng.uniform(0.3, 9.0)
    kind = rng.integers(3)
    if kind == 0:
        return ends(robot, f"ends[{side} * theta >= {first:.4f} + 2 * np.pi] = Outcome.CRASHED")
    if kind == 1:
        wide = rng.choice([1e-3, 0.03, 0.3])
        place = side * (first + 2 * np.pi)
        return ends(robot, f"ends[np.abs(theta - {place:.4f}) < {wide}] = Outcome.CRASHED")
    seen = f"return np.hstack([np.cos(measured), np.sin(measured / {int(rng.integers(2, 5))})])"
    return robot._replace(py=robot.py | {"observation": seen})


def trap_saturation(rng):
    robot, force = vehicle()._replace(kv=1e6), 10 ** rng.uniform(-1, 4)
    if rng.random() < 0.5:
        return robot._replace(servo=f'forcerange="-{force:.4g} {force:.4g}"')
    return robot._replace(on_joint=f'actuatorfrcrange="-{force:.4g} {force:.4g}"')


def trap_held_sensor(rng):
    robot, samples = trap_honest(rng), int(rng.integers(2, 9))
    if rng.random() < 0.5:
        return robot._replace(sensor=f'interval="{0.05 * samples:.2f}" nsample="3"')
    return robot._replace(sensor=f'delay="{0.05 * samples:.2f}" nsample="{samples + 1}"')


def trap_thin_wall(rng):
    robot, x, w = vehicle(), rng.uniform(0.7, 2.5), 10 ** rng.uniform(-3, -1)
    if rng.random() < 0.5:  # ended by ending(), which is asked at samples
        return ends(robot, f"ends[np.abs(x - {x:.4f}) < {w:.5f}] = Outcome.CRASHED")
    wall = f'<geom name="wall" type="box" size="{w:.5f} 3 0.2" pos="{x:.4f} 0 0"/>'
    scenery = robot.xml["scenery"] + wall
    return robot._replace(xml=robot.xml | {"flag": "", "contact": "1", "scenery": scenery}, kv=1e6)


def trap_mirror(rng):
    robot, x, y = vehicle(), rng.uniform(0.6, 2.6), rng.uniform(0.7, 1.2) * rng.choice([-1, 1])
    r = rng.uniform(0.1, 0.3)
    code = f"ends[(x - {x:.3f}) ** 2 + (y - {y:.3f}) ** 2 <= {r:.3f} ** 2] = Outcome.CRASHED"
    robot = ends(robot, code)
    return robot._replace(py=robot.py | {"mirror": "Mirror((1, -1), (-1,))"})


def trap_starts(rng):
    off = rng.uniform(0.02, 0.4)
    code = (
        "\n    def starts(self, n, rng):\n"
        f"        return rng.uniform((0.0, -1.0), (0.4 + {off:.3f}, 1.0), (n, 2))\n"
    )
    return methods(vehicle(), code)


def trap_methods(rng):
    """A method that a proof takes for the default one."""
    robot, by = vehicle(), rng.uniform(0.05, 0.4)
    return methods(
        robot,
        [
            f"\n    def measure(self, sensors):\n        return sensors + np.array([0.0, {by:.3f}])\n",
            f"\n    def measure(self, sensors):\n        return np.minimum(sensors, {3 - by:.3f})\n",
            "\n    def outcome(self, measurement, unstable):\n"
            f"        return np.where(measurement[:, 0] > {3 - by:.3f}, Outcome.CRASHED, "
            "self.ending(measurement))\n",
            "\n    def failed(self, measurement):\n        return np.zeros(len(measurement), dtype=bool)\n",
        ][rng.integers(4)],
    )


def trap_sensor(rng):
    """A sensor that gives something else than the position."""
    robot = vehicle()
    return robot._replace(sensor=f'cutoff="{rng.uniform(2.0, 2.99):.3f}"')


def trap_memory(rng):
    """An end that depends on how often it was asked, or on other rows."""
    if rng.random() < 0.5:
        code = "self.count = self.count + 1\n        "
        code += f"ends[(self.count % {int(rng.integers(3, 60))} == 0) & (x > 1)] = Outcome.CRASHED"
        return ends(vehicle(), code)
    return ends(vehicle(), "ends[(x > 1) & (y > np.sort(y)[-1] - 0.01)] = Outcome.CRASHED")


def trap_spring(rng):
    """A tendon that pulls in a part of the arena alone, against a weak servo."""
    robot, start = vehicle(), rng.uniform(1.0, 2.5)
    more = (
        f'<tendon><fixed name="t" stiffness="1e7" springlength="-9 {start:.3f}"><joint joint="x" coef="1"/>'
        "</fixed></tendon>"
    )
    return robot._replace(xml=robot.xml | {"more": more}, kv=1e6)


TRAPS = {
    name.removeprefix("trap_"): draw
    for name, draw in list(globals().items())
    if name.startswith("trap_")
}


def drawn(seed: int, folder: Path):
    """Writes the files of the robot of a seed, and returns its trap and its task."""
    trap = [*TRAPS][seed % len(TRAPS)]
    robot, name = TRAPS[trap](np.random.default_rng(seed)), f"trapped_{seed}_{next(NUMBER)}"
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
    return trap, hyrl_mj.get_task(folder / f"{name}.py")


def task_of(robot, folder, monkeypatch):
    """The task of one robot."""
    monkeypatch.setitem(globals(), "TRAPS", {"this": lambda rng: robot})
    return drawn(0, folder)[1]


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
    """What the package says of a robot.

    Attributes:
        trap: its trap.
        word: "refused", "estimate" or "proved".
        why: why it is refused, or an estimate.
        wrong: a sentence for each claim that a replay refutes.
        claims: number of starts whose claims were replayed.
    """

    trap: str
    word: str
    why: str
    wrong: tuple[str, ...]
    claims: int


def examined(seed: int, folder: Path) -> Found:
    """Examines the robot of a seed, and replays what is called won of it."""
    rng = np.random.default_rng(seed)
    try:
        trap, task = drawn(seed, folder)
        check_task(task)
        policy = policy_of(task)
        grid = Grid.with_cells(task.chart, 600 if task.chart.dimension == 1 else 60)
        wrong = [*_episodes(task, policy, rng)]
        why = Lattice.why_not(task, grid) or why_no_cells(task, grid.counts)
        if why:
            return Found(trap, "estimate", why, tuple(wrong), STARTS)
        loop = PolicyController(policy)
        everywhere = GridSet.from_mask(grid, np.ones(len(grid.nodes), dtype=bool))
        parts = Partition((0, 1), (everywhere,) * 2, np.ones(len(grid.nodes), dtype=bool))
        game = Game(task, parts, {"policy": loop}, EPS, grid=grid)
        certificate = Certificate.certify(game, {"policy": loop})
        if certificate.cells is None or "policy" not in certificate.answers:
            why = certificate.why_not["policy"]
            return Found(trap, "estimate", why, tuple(wrong), STARTS)
    except BadInput as error:
        return Found([*TRAPS][seed % len(TRAPS)], "refused", str(error), (), 0)
    cells = certificate.cells
    proved = np.flatnonzero((certificate.value("policy", EPS)[-1, :-2] < NEVER) & cells.running)
    won = np.flatnonzero((game.value("policy", EPS)[-1, :-2] < NEVER) & game.lattice.running)
    claims = 0
    for what, at, place in (
        ("proved", proved, lambda k: cells.middle(k) + _inside(k, cells, rng)),
        ("won", won, lambda k: game.lattice.grid.nodes[k]),
    ):
        if len(at):
            z = place(rng.choice(at, STARTS))
            claims += len(z)
            for noise in noises(task, len(z), rng):
                lost = ~replay(task, policy, z, noise)
                if lost.any():
                    wrong.append(f"{what} and lost: {lost.sum()} of {len(z)}, as {z[lost][0]}")
    return Found(trap, "proved" if len(proved) else "nothing proved", "", tuple(wrong), claims)


def _inside(at, cells, rng):
    return rng.uniform(-0.5, 0.5, (len(at), len(cells.counts))) * cells.lattice.grid.spacing


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
