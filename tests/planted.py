"""Planted truths: policies whose critical set is known, and a task in three dimensions."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from hyrl_mj.errors import NoRenderer
from hyrl_mj.files.artifacts import digest
from hyrl_mj.files.manifest import FILES, Entry, Manifest
from hyrl_mj.gym_import import draws, inspection, resets, starts, trials
from hyrl_mj.gym_import.task import EnvironmentTask
from hyrl_mj.judging import episodes, examination, results, worst_case
from hyrl_mj.judging.game import Maps
from hyrl_mj.judging.proof import cells, counterexamples, replays
from hyrl_mj.learning import distillation, presets, training
from hyrl_mj.pipeline import steps
from hyrl_mj.policies.hybrid import HybridController
from hyrl_mj.runs.directory import load_run
from hyrl_mj.sets import Chart, Grid, GridSet
from hyrl_mj.stages import grounds
from hyrl_mj.stages.critical_set import CriticalSet
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.partition import Partition
from hyrl_mj.tasks import Learning, Outcome, Scene, Task, trial
from hyrl_mj.tasks.unit_circle import UnitCircle
from hyrl_mj.viz import diagnosis, section
from hyrl_mj.viz.figures import style


@dataclass(frozen=True)
class Payload:
    """What must never be unpickled: it makes an empty file."""

    path: Path

    def __reduce__(self):
        return Path.touch, (self.path,)


# With so many cells samples at full speed lead from node to node on the circle: 2 pi / 754 = 0.05 / 6.00003.
EXACT = 754
# Settings of a smoke run on the circle whose worst-case game takes two seconds.
FEW_CELLS = {"lattice": 130}
# Settings of the runs of a sweep, which are made in processes that `shorten` does not reach.
TINY = {"stage1.samples": 2048, "stage6.samples": 2048, "lattice": 130, "rods": 100, "cells": 240}


def shorten(patch):
    """Patches preset smoke so that a run takes seconds: less training, coarser grids."""
    for values, new in (
        (presets._SMOKE, {"ppo": 4_096, "dqn": 4_000, "sac": 1_500}),
        (presets._GRIDS, {1: (120, 720), 2: (60, 120)}),
        (presets._GRIDS_DYNAMIC, {2: (24, 48)}),
        (presets._LATTICE_SMOKE, {1: 130, 2: 60, 3: 40}),
    ):
        for key, value in new.items():
            patch.setitem(values, key, value)
    patch.setattr(presets, "_SMOKE_MODES", 4_096)
    patch.setattr(UnitCircle, "max_steps", 80)  # from the far side it takes 63
    patch.setattr(distillation, "STEPS", 200)
    patch.setattr(counterexamples, "MOST_CELLS", 24)
    patch.setattr(cells, "STATES", 300)
    patch.setattr(episodes, "JUDGED", 40)
    patch.setattr(training, "EPISODES", 64)
    patch.setattr(results, "EPISODES", 100)
    attack = {"attack_starts": 60, "attack_rounds": 1}
    spare(patch, checkpoints=2, batches=2, nodes=12, episodes=60, **attack)
    spare_environments(patch)
    without_pictures(patch)


# How a figure is written where nothing is patched.
WRITE = Figure.savefig


def without_pdfs(patch, write=WRITE):
    """Patches figures so that beside each PNG lies no drawing, but a file that could be one."""

    def savefig(figure, content, *, format, **options):
        if format == "pdf":
            content.write(b"%PDF-1.4\n")
        else:
            write(figure, content, format=format, **options)

    patch.setattr(Figure, "savefig", savefig)


def without_pictures(patch):
    """The same, and the PNG is blank: everything is drawn, but not laid out and coloured in."""

    def write(figure, content, *, format, dpi, **options):
        width, height = (round(side * dpi) for side in figure.get_size_inches())
        Image.new("RGB", (width, height), "white").save(content, format)

    without_pdfs(patch, write)


def no_renderer(*arguments, **options):
    """In the place of what draws, as on a machine that cannot."""
    raise NoRenderer("no GL library here")


def without_videos(patch):
    """Patches rendering, as on a machine that cannot draw: there is no video."""
    patch.setattr("hyrl_mj.viz.replay.render_replay", no_renderer)


def few_noises(patch):
    """Patches what is replayed of proofs and played as episodes: without noise, and under one kind."""
    noises = replays._noises

    def few(*arguments):
        return [noise for noise in noises(*arguments) if noise.kind in ("none", "alternating")]

    patch.setattr(replays, "_noises", few)
    patch.setattr(examination, "usual_kinds", lambda *_: ("none", "uniform"))


def spare(patch, **effort):
    """Patches how much is spent on every task: checkpoints at which a policy is judged, and the like."""
    for kind in (Task, EnvironmentTask):
        patch.setattr(kind, "effort", replace(kind.effort, **effort))


def spare_environments(patch):
    """Patches how many runs judge controllers in environments, of which each takes tenths of a second."""
    few = {"batches": 1, "nodes": 6, "episodes": 24}
    patch.setattr(EnvironmentTask, "effort", replace(EnvironmentTask.effort, **few))
    patch.setattr(grounds, "ATTACKED", 12)


def played_before(patch, run):
    """Patches the worst-case game of a run: it is not played again, but what is on disk is taken."""
    played = run.robustness.game, Maps.load(run.path / "robustness.npz")
    patch.setattr(examination, "worst_case", lambda *given: played)


def few_trials(patch):
    """Patches how often an environment is reset and played before it is used.

    What these trials have to find is found in so few, too, but for what the fixture `all_trials` is for.
    That they refuse nothing which is honest is tested with all of them, in `test_trapped_environments`.
    """
    few = {"EPISODES": 4, "SAMPLES": 16, "PLACES": 8, "RESETS": 24}
    few |= {"RUNS": 8, "LENGTH": 40, "FAR": 2}
    for module in (inspection, trials, draws, starts, resets):
        for name in few.keys() & vars(module).keys():
            patch.setattr(module, name, few[name])
    patch.setattr(trials._runs, "__defaults__", (few["EPISODES"],))


def without_judges(patch):
    """Patches the inspection of environments: new instances judge no runs in it, only those of users later.

    This takes a third of the time, and what the other trials find does not depend on it.
    """
    for name in ("check_episodes", "check_noise"):
        patch.setattr(trials, name, lambda pool: None)


def few_steps(patch):
    """Patches for how long a task is tried out before it is used."""
    patch.setattr(trial, "STEPS", 10_000)  # of the physics, in all episodes
    patch.setattr(trial, "FEWEST", 4)


def coarsen(patch):
    """Patches what is shown and played: few pixels, few frames, a simple font, few replays of proofs."""
    patch.setattr(worst_case, "CURVE", worst_case.CURVE[::4])
    patch.setattr(style, "DPI", 60)
    patch.setattr(section, "OVER", 120)
    patch.setitem(style.STYLE, "pdf.fonttype", 3)
    few = {"size": (480, 160), "fps": 2}
    patch.setattr(steps, "SMOKE", replace(steps.SMOKE, **few))
    patch.setattr(diagnosis, "REPLAY", replace(diagnosis.REPLAY, **few))
    starts = {"none": 60, "uniform": 60, "alternating": 60, "worst": 60, "cells": 10, "sensor": 60}
    patch.setattr(replays, "STARTS", starts)
    patch.setattr(replays, "WHOLE", 10)


def euler(task, z, u):
    """One sample of the paper's equations, S + f(S, A) dt: chart points (n, d), inputs (n, 1)."""
    velocity = u if task.name == "unit_circle" else np.hstack([np.ones((len(z), 1)), u])
    return z + velocity * 0.05


def random_states(task, n, rng):
    """Chart points (n, d) all over the chart."""
    return rng.uniform(task.chart.low, task.chart.high, (n, task.chart.dimension))


@dataclass(frozen=True)
class ChartPolicy:
    """A policy given as a rule from chart points (n, d) to inputs (n, m)."""

    task: Task
    rule: Callable[[np.ndarray], np.ndarray]

    def act(self, measured):
        return self.rule(self.task.z(self.task.check_measurement(measured)))


@dataclass(frozen=True)
class AnalyticSet:
    """A set given by a signed distance in closed form."""

    distance: Callable[[np.ndarray], np.ndarray]

    def signed_distance(self, z):
        return self.distance(z)

    def contains(self, z):
        return self.distance(z) <= 0


def halves(task, cells=240):
    """The partition of either task by its axis of symmetry; where the ways have joined both parts hold."""
    grid = Grid.with_cells(task.chart, cells)
    if task.name == "unit_circle":
        first, joined = grid.nodes[:, 0] < np.pi, task.arrived(grid.nodes)
    else:
        first, joined = grid.nodes[:, 1] >= 0, grid.nodes[:, 0] >= task.obstacle[0]
    parts = tuple(GridSet.from_mask(grid, part | joined) for part in (first, ~first))
    return Partition((0, 1), parts, np.ones(len(grid.nodes), dtype=bool))


def decisions(task):
    """The critical set that belongs to `halves`."""
    on_axis = np.stack([np.linspace(0, 0.4, 9), np.zeros(9)], axis=-1)
    points = np.array([[np.pi]]) if task.name == "unit_circle" else on_axis
    return CriticalSet(points, np.zeros(len(points), dtype=int), resolution=0.01, spacing=0.05)


def extended(sets, winning=None, horizon=0.3, eps=0.1):
    """Extended sets of modes 0, 1, ... that meet nowhere; `winning` is (N,) bool of each mode, or all win."""
    grid = sets[0].grid
    winning = winning or [np.ones(grid.size, dtype=bool) for _ in sets]
    nowhere = np.empty((0, grid.chart.dimension)), np.empty(0)
    modes = tuple(range(len(sets)))
    return ExtendedSets(modes, tuple(sets), tuple(winning), horizon, eps, *nowhere)


def flow_sets(controller, cells):
    """The flow sets of a controller, at the nodes of a grid."""
    grid = Grid.with_cells(controller.task.chart, cells)
    flows = [controller.flow_set(q) for q in controller.modes]
    return [GridSet(grid, flow.signed_distance(grid.nodes)) for flow in flows]


# ---- unit circle


def circle_policy(task, critical=np.pi):
    """Clockwise (-1) below the critical angle, counter-clockwise (+1) above it."""
    return ChartPolicy(task, lambda z: np.where(task.chart.wrap(z) < critical, -1.0, 1.0))


def two_way_circle_policy(task, first=2.0, between=3.0, second=4.0):
    """Runs part at two angles, and meet at a third one between them and at the set-point."""

    def rule(z):
        theta = task.chart.wrap(z)
        down = (theta < first) | ((theta >= between) & (theta < second))
        return np.where(down, -1.0, 1.0)

    return ChartPolicy(task, rule)


def circle_controller(task, overlap=0.4):
    """Clockwise or counter-clockwise at full speed; the flow sets share pi +- `overlap`."""
    return HybridController(
        task,
        {0: ChartPolicy(task, lambda z: -np.ones_like(z)), 1: ChartPolicy(task, np.ones_like)},
        {
            0: AnalyticSet(lambda z: task.chart.wrap(z)[:, 0] - np.pi - overlap),
            1: AnalyticSet(lambda z: np.pi - overlap - task.chart.wrap(z)[:, 0]),
        },
    )


def homing(offset, dead=0.0):
    """Back to offset 0 in one sample, if that can be; nothing up to `dead`: inputs (n, 1)."""
    return np.where(np.abs(offset) <= dead, 0.0, np.clip(-offset / 0.05, -1.0, 1.0))


def homing_policy(task, dead=0.0):
    """Homing to the set-point, the short way."""
    return ChartPolicy(task, lambda z: homing(task.chart.difference(z, np.zeros(1)), dead))


def homing_controller(task, overlap=0.4, near=1.0):
    """Homing clockwise or counter-clockwise; the flow sets share pi +- `overlap` and 0 +- `near`."""
    turn = 2 * np.pi

    def clockwise(z):
        theta = task.chart.wrap(z)
        return homing(np.where(theta > turn - near, theta - turn, theta))

    def counter(z):
        theta = task.chart.wrap(z)
        return homing(np.where(theta < near, theta, theta - turn))

    def below(z):
        theta = task.chart.wrap(z)[:, 0]
        return np.minimum(theta - np.pi - overlap, turn - near - theta)

    def above(z):
        theta = task.chart.wrap(z)[:, 0]
        return np.minimum(np.pi - overlap - theta, theta - near)

    return HybridController(
        task,
        {0: ChartPolicy(task, clockwise), 1: ChartPolicy(task, counter)},
        {0: AnalyticSet(below), 1: AnalyticSet(above)},
    )


# ---- vehicle


def pass_on(side, y, clear=0.9):
    """Steer to one side (+1 left, -1 right) until beside the obstacle, then straight on: (n, 1)."""
    return np.where(side * y < clear, side, 0.0)[:, None]


def sign_policy(task, line=lambda x: 0 * x):
    """Pass on the left above the line y = line(x), on the right below it."""
    return ChartPolicy(
        task, lambda z: pass_on(np.where(z[:, 1] >= line(z[:, 0]), 1.0, -1.0), z[:, 1])
    )


def one_way_policy(task, side=1.0, clear=0.9):
    """Pass on one side, from wherever."""
    return ChartPolicy(task, lambda z: pass_on(np.full(len(z), side), z[:, 1], clear))


def ideal_controller(task, overlap=0.15, clear=0.9):
    """The vehicle's hybrid controller with ideal policies; the flow sets share |y| <= `overlap`."""
    return HybridController(
        task,
        {0: one_way_policy(task, 1.0, clear), 1: one_way_policy(task, -1.0, clear)},
        {0: AnalyticSet(lambda z: -z[:, 1] - overlap), 1: AnalyticSet(lambda z: z[:, 1] - overlap)},
    )


# ---- a task with a chart of three to six dimensions

CUBE = """
<mujoco model="cube">
  <option timestep="0.05" integrator="implicitfast" gravity="0 0 0">
    <flag contact="disable" constraint="disable"/>
  </option>
  <worldbody>
    <body>
      JOINTS
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    ACTUATORS
  </actuator>
  <sensor>
    SENSORS
  </sensor>
</mujoco>
"""


UNICYCLE = """
<mujoco model="unicycle">
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0">
    <flag contact="disable" constraint="disable"/>
  </option>
  <custom>
    <numeric name="sample_time" data="0.05"/>
    <numeric name="turn_rate" data="-2 2"/>
  </custom>
  <worldbody>
    <body>
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="heading" type="hinge" axis="0 0 1"/>
      <geom size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="x" kv="1e6"/>
    <velocity joint="y" kv="1e6"/>
    <velocity joint="heading" kv="1e6"/>
  </actuator>
  <sensor><jointpos joint="x"/><jointpos joint="y"/><jointpos joint="heading"/></sensor>
</mujoco>
"""


class Cube(Task):
    """A point that moves at will in a cube; runs differ by whether a level rises or falls.

    Args:
        level: chart points (n, d) -> (n,).
        d: its dimension, at most 6.
        noisy: share of the noise on each coordinate; by default 1.
    """

    name = "cube"
    description = "planted"
    scene = Scene(starts=(), time=0.6, mode_names=("up", "down"))
    max_steps = 12

    def __init__(self, level, d=3, noisy=None):
        self.level, self.noisy, names = level, noisy or (True,) * d, "abcefg"[:d]
        self.chart = Chart(tuple(names), ("m",) * d, (-1.0,) * d, (1.0,) * d, (False,) * d)
        self.inputs = tuple(f"v{name}" for name in names)
        axes = ("1 0 0", "0 1 0", "0 0 1", "1 1 1", "1 -1 0", "0 1 -1")
        # An armature keeps the inertia of joints that are not independent regular.
        inertia = "" if d < 4 else 'armature="1" '
        joint = '<joint name="{}" type="slide" ' + inertia + 'axis="{}"/>'
        velocity = '<velocity name="v{0}" joint="{0}" kv="1e9" ctrlrange="-1 1"/>'
        parts = {
            "JOINTS": [joint.format(name, axis) for name, axis in zip(names, axes, strict=False)],
            "ACTUATORS": [velocity.format(name) for name in names],
            "SENSORS": [f'<jointpos joint="{name}"/>' for name in names],
        }
        xml = CUBE
        for key, lines in parts.items():
            xml = xml.replace(key, "".join(lines))
        self.model = mujoco.MjModel.from_xml_string(xml)

    def observation(self, measured):
        return measured

    def reward(self, measurement, u):
        return np.zeros(len(measurement))

    def ending(self, measurement):
        return np.full(len(measurement), Outcome.RUNNING)

    def verdict(self, measurement):
        return np.full(len(measurement), Outcome.RUNNING)

    def arrived(self, z):
        return np.full(len(z), True)

    def miss(self, z):
        return np.zeros(len(z))

    def starts(self, n, rng):
        return rng.uniform(-1, 1, (n, self.chart.dimension))

    def direction(self, path):
        return np.where(self.level(path[-1]) > self.level(path[0]), 0, 1)


# Slope of the level in the hall, and half the height of the hall.
TILT, HALL = np.array([1.0, 0.5, 0.0, -0.3, 0.0, 0.0]), 0.9


def hall_level(z):
    """A curved level (...,) of points (..., 6)."""
    return z @ TILT + 0.3 * z[..., 4] ** 2 - 0.1 * np.sin(2 * z[..., 2]) - 0.1


def hall_slope(z):
    """The slope (n, 6) of the level at points (n, 6)."""
    slope = np.tile(TILT, (len(z), 1))
    slope[:, 4] += 0.6 * z[:, 4]
    slope[:, 2] -= 0.2 * np.cos(2 * z[:, 2])
    return slope


def hall_distance(z):
    """The distance (n,) of points (n, 6) from the level 0, to first order."""
    return hall_level(z) / np.linalg.norm(hall_slope(z), axis=1)


class Hall(Cube):
    """A cube of six dimensions, three of them noisy, that is left where its level is high or low."""

    name = "hall"

    def __init__(self, d=6):
        super().__init__(hall_level, d, (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)[:d])

    def ending(self, measurement):
        out = np.abs(self.level(measurement)) >= HALL
        return np.where(out, Outcome.REACHED, Outcome.RUNNING)

    def verdict(self, measurement):
        return np.full(len(measurement), Outcome.REACHED)

    def direction(self, path):
        return np.where(self.level(path[-1]) >= 0, 0, 1)


def hall_policy(task, side=None):
    """Up or down the level along the noisy coordinates, by its sign, or always to one side (+1 up)."""
    along = TILT * np.array([1, 1, 1, 0, 0, 0]) / np.linalg.norm(TILT[:3])

    def rule(z):
        sign = np.where(task.level(z) >= 0, 1.0, -1.0) if side is None else np.full(len(z), side)
        return sign[:, None] * along

    return ChartPolicy(task, rule)


def plane_policy(task, normal, parting):
    """Along +normal or -normal, by `parting(level)` in {-1, +1}."""
    return ChartPolicy(task, lambda z: parting(task.level(z))[:, None] * normal)


def sphere_policy(task, radius):
    """Out of a sphere or to its centre."""

    def rule(z):
        r = np.linalg.norm(z, axis=1, keepdims=True)
        return np.where(r >= radius, 1.0, -1.0) * z / np.maximum(r, 0.05)

    return ChartPolicy(task, rule)


def believe(path, task=None):
    """Records the files of a run directory as they are now, as if its stages had just written them."""
    run = load_run(path)
    code = run.task.code if task is None else ""
    files = {p.relative_to(path).as_posix(): digest(p) for p in path.rglob("*") if p.is_file()}
    Manifest(path, run.digests)._write(
        {
            stage: Entry(run.digests[stage], code, {}, outputs, version("hyrl-mj"))
            for stage, names in FILES.items()
            if (outputs := {n: content for n, content in files.items() if re.fullmatch(names, n)})
        }
    )


class Unicycle(Task):
    """A rover reduced to kinematics: it drives through a corridor at 1 m/s, and gives its turn rate.

    Its chart of three dimensions is its whole state; an inner loop gives the actuators their speeds.
    """

    name = "unicycle"
    description = "planted"
    chart = Chart(
        ("x", "y", "heading"), ("m", "m", "rad"), (0, -1, -1.4), (2, 1, 1.4), (False,) * 3
    )
    inputs = ("turn_rate",)
    noisy = (False, True, 0.5)
    max_steps = 80
    start_low, start_high = (0.0, -0.8, -1.0), (0.4, 0.8, 1.0)
    scene = Scene(starts=((0.0, 0.0, 0.0),), time=3.0, mode_names=("left", "right"))
    learning = Learning(levels=5)

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(UNICYCLE)

    def control(self, u, qpos, qvel):
        return np.column_stack([np.cos(qpos[:, 2]), np.sin(qpos[:, 2]), u])

    def observation(self, measured):
        return measured

    def reward(self, measurement, u):
        return np.zeros(len(measurement))

    def ending(self, measurement):
        ends = np.full(len(measurement), Outcome.RUNNING)
        ends[measurement[:, 0] >= 2] = Outcome.REACHED
        ends[(np.abs(measurement[:, 1:]) >= (1, 1.4)).any(axis=1)] = Outcome.OUT_OF_BOUNDS
        return ends

    def verdict(self, measurement):
        return np.full(len(measurement), Outcome.STALLED)

    def miss(self, z):
        return np.abs(z[:, 1])

    def direction(self, path):
        return np.where(path[-1, :, 1] > 0, 0, 1)


def steering_policy(task, gain=2.0):
    """Turns a unicycle towards the middle of the corridor, at the nearest of its levels."""

    def rule(z):
        wanted = np.clip(-gain * (z[:, 1] + z[:, 2]), *np.ravel(task.input_limits))
        nearest = np.abs(wanted[:, None] - task.input_levels[:, 0]).argmin(axis=1)
        return task.input_levels[nearest]

    return ChartPolicy(task, rule)
