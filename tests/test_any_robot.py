"""Robots that the package has never seen: brought as a file, or by another installed package."""

import json
import os
import re
import sys

import gymnasium
import numpy as np
import pytest
from command_line import call
from gl import needs_gl
from planted import few_noises, spare
from sentences import assert_has_ended

import hyrl_mj
from hyrl_mj import Outcome
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.simulation import way_runs
from hyrl_mj.tasks import registry, trial
from hyrl_mj.tasks.checks import check_task
from hyrl_mj.tasks.registry import reference
from hyrl_mj.tasks.scaffold import TEMPLATES, write_task

# ---- a point mass in space with a pillar: a chart of three dimensions, two inputs, contacts

WASP_XML = """
<mujoco model="wasp">
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/>
  <custom><numeric name="sample_time" data="0.05"/></custom>
  <visual><quality shadowsize="0"/></visual>
  <worldbody>
    <light directional="true" dir="0.2 0.2 -1" castshadow="false"/>
    <geom name="ground" type="plane" size="6 6 0.1" contype="0" conaffinity="0"/>
    <geom name="obstacle" type="cylinder" pos="1.4 0 0.6" size="0.4 0.6"/>
    <site name="set_point" pos="2.6 0 0.5"/>
    <camera name="overhead" projection="orthographic" fovy="3" pos="1.3 0 4" xyaxes="1 0 0 0 1 0"/>
    <body name="wasp">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="body" size="0.08" mass="0.5" rgba="0.9 0.7 0.1 1"/>
      <site name="tracked"/>
    </body>
  </worldbody>
  <actuator>
    <velocity name="ahead" joint="x" kv="10"/>
    <velocity name="aside" joint="y" kv="8" ctrlrange="-1.5 1.5"/>
    <velocity name="aloft" joint="z" kv="8" ctrlrange="-0.5 0.5"/>
  </actuator>
  <sensor>
    <jointpos joint="x"/> <jointpos joint="y"/> <jointpos joint="z"/>
    <contact geom1="body" geom2="obstacle" data="found"/>
  </sensor>
  <keyframe><key ctrl="1 0 0"/></keyframe>
</mujoco>
"""

WASP_PY = """
import numpy as np

import hyrl_mj
from hyrl_mj import Outcome
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj import Chart, Learning, Mirror, Outcome, Scene
from hyrl_mj import mjcf


class Wasp(hyrl_mj.Task):
    name = "wasp"
    description = "a point mass in space"
    chart = Chart(
        ("x", "y", "z"), ("m",) * 3, (0.0, -1.2, 0.2), (2.8, 1.2, 0.8), (False,) * 3
    )
    inputs = ("aside", "aloft")
    noisy = (False, True, False, False)
    max_steps, worst_reward = 60, 0.0
    start_low, start_high = (0.0, -0.5, 0.3), (0.2, 0.5, 0.7)
    scene = Scene(
        starts=((0.0, 0.05, 0.5), (0.0, -0.05, 0.5)), time=3.0, mode_names=("left", "right")
    )
    learning = Learning(horizon=0.3)
    mirror = Mirror((1, -1, 1), (-1, 1))
    observation_low, observation_high = (-1.0, -3.0, -2.0), (5.0, 3.0, 3.0)
    set_point = np.array([2.6, 0.0, 0.5])
    close = 0.6

    def state(self, z, rng=None):
        return z, np.tile([1.0, 0.0, 0.0], (len(z), 1))

    def z(self, measured):
        return measured[:, :3]

    def with_z(self, measured, z):
        return np.hstack([z, measured[:, 3:]])

    def observation(self, measured):
        return measured[:, :3]

    def clearance(self, measured):
        centre = mjcf.geom_pos(self.model, "obstacle")[:2]
        return np.linalg.norm(measured[:, :2] - centre, axis=1) - 0.48

    def reward(self, measured, u):
        near = np.clip(1 - self.clearance(measured) / 0.2, 0, 1)
        off = np.abs(measured[:, 1]) + np.abs(measured[:, 2] - 0.5)
        return np.where(self.failed(measured), 0.0, 3 - np.minimum(off, 2) - near)

    def ending(self, measured):
        ends = np.full(len(measured), Outcome.RUNNING)
        ends[measured[:, 0] >= 2.6] = Outcome.REACHED
        ends[np.abs(measured[:, 1]) >= 1.2] = Outcome.OUT_OF_BOUNDS
        ends[(measured[:, 3] > 0) | (self.clearance(measured) <= 0)] = Outcome.CRASHED
        return ends
"""


@pytest.fixture(scope="module")
def wasp(tmp_path_factory):
    """The file of a task, in a folder of its own."""
    folder = tmp_path_factory.mktemp("robots")
    (folder / "wasp.xml").write_text(WASP_XML)
    (folder / "wasp.py").write_text(WASP_PY)
    return folder / "wasp.py"


@pytest.fixture
def unknown_tasks(monkeypatch):
    """Tasks that are registered in this test are forgotten after it."""
    monkeypatch.setattr(registry, "_REGISTRY", {**registry._REGISTRY})
    monkeypatch.setattr(registry, "_FILES", {**registry._FILES})


@pytest.fixture(scope="module", autouse=True)
def short_trials():
    """A tenth of the episodes by which a task is tried out."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trial, "STEPS", trial.STEPS // 10)
        yield


@needs_gl
@pytest.mark.slow
def test_a_robot_from_its_own_folder_goes_through_the_whole_pipeline(
    small_runs, quickly_judged, wasp, tmp_path, monkeypatch
):
    spare(monkeypatch, attack_starts=12, attack_rounds=1)
    few_noises(monkeypatch)
    assert len(WASP_PY.strip().splitlines()) <= 90
    words = ("--preset", "smoke", "--set", "rods=8", "cells=14", "lattice=20")
    words += ("stage1.samples=2048", "stage6.samples=2048")
    done = call("run", os.path.relpath(wasp, tmp_path), *words, cwd=tmp_path)
    assert_has_ended(done)
    out = tmp_path / "runs" / "wasp"
    assert (out / "replay.mp4").stat().st_size > 1_000
    assert (out / "report.html").is_file()
    records = json.loads((out / "robustness.json").read_text())["episodes"]
    assert {r["controller"] for r in records} == {"policy", "hyrl"}
    # It is found again, from anywhere.
    again = call("replay", out, "--starts", "paper", "--out", "v.png", cwd=out.parent)
    assert again.returncode == 0, again.stderr
    assert (out.parent / "v.png").is_file()


@pytest.mark.slow
def test_its_critical_set_is_found_and_its_parts_are_the_two_sides(wasp):
    task = check_task(hyrl_mj.get_task(wasp))

    class Sides:
        def act(self, measured):
            side = np.where(measured[:, 1] >= 0.1, 1.5, -1.5)
            aside = np.where(np.abs(measured[:, 1]) < 0.8, side, 0.0)
            return np.stack([aside, np.zeros(len(measured))], axis=1)

    critical = hyrl_mj.find_critical_set(task, Sides(), 20, 1 / 16, "outcome")
    assert critical.pieces == 1
    assert np.abs(critical.points[:, 1] - 0.1).max() <= critical.resolution
    partition = hyrl_mj.make_partition(task, Sides(), critical.points, 20)
    assert partition.modes == (0, 1)
    before = np.array([[0.1, 0.4, 0.5], [0.1, -0.4, 0.5]])
    assert [part.contains(before).tolist() for part in partition.parts] == [
        [True, False],
        [False, True],
    ]


def test_gymnasium_knows_it(wasp):
    task = hyrl_mj.get_task(wasp)
    env = gymnasium.make("hyrl_mj/Wasp-v0")
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert task.chart.contains(info["z"])
    assert reference(hyrl_mj.get_task("wasp")) == str(wasp)


@pytest.mark.slow
def test_an_installed_package_can_offer_tasks(unknown_tasks, wasp, tmp_path, monkeypatch):
    described = tmp_path / "site" / "wasps-1.0.dist-info"
    described.mkdir(parents=True)
    (described / "METADATA").write_text("Metadata-Version: 2.1\nName: wasps\nVersion: 1.0\n")
    (described / "entry_points.txt").write_text("[hyrl_mj.tasks]\nwasp = wasp:Wasp\n")
    registry._REGISTRY.pop("wasp", None)
    monkeypatch.setattr(registry, "_INSTALLED", set())
    monkeypatch.delitem(sys.modules, "wasp", raising=False)
    monkeypatch.syspath_prepend(described.parent)
    run = call("run", "wasp", cwd=tmp_path)
    assert run.returncode == 2
    assert "the task wasp of wasp:Wasp cannot be imported" in run.stderr
    broken = call("list")
    assert broken.returncode == 0
    assert "the task wasp of wasp:Wasp cannot be imported" in broken.stdout
    assert "vehicle" in broken.stdout
    monkeypatch.syspath_prepend(wasp.parent)
    listed = call("list")
    assert listed.returncode == 0, listed.stderr
    assert re.search(r"^wasp +hyrl_mj/Wasp-v0 +a point mass in space$", listed.stdout, re.M)
    task = check_task(hyrl_mj.get_task("wasp"))
    assert reference(task) == "wasp"
    assert task.model_path == wasp.with_suffix(".xml")


# ---- a task to start from


def test_a_new_task_is_written_into_a_folder(tmp_path):
    """That it passes its own tests is tried where the manual says how to begin with it."""
    assert call("new-task", "sledge_2", "--folder", "mine", cwd=tmp_path).returncode == 0
    names = {p.name for p in (tmp_path / "mine").iterdir()}
    assert names == {"sledge_2.py", "sledge_2.xml", "test_sledge_2.py"}


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("2fast", "letters, digits"),
        ("class", "letters, digits"),
        ("_", "letters, digits"),
        ("vehicle", "a task vehicle already"),
        ("numpy", "a Python package numpy already"),
        # Its class would hide what the file imports.
        ("outcome", "another use for the word Outcome"),
        ("true", "another use for the word True"),
    ],
)
def test_a_name_that_cannot_be_one_is_refused(tmp_path, name, says):
    done = call("new-task", name, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert says in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("there", ["a file", "a link to nothing"])
def test_nothing_is_overwritten(there, tmp_path):
    if there == "a file":
        (tmp_path / "mine.xml").write_text("precious")
    else:
        (tmp_path / "mine.xml").symlink_to(tmp_path / "elsewhere.xml")
    with pytest.raises(hyrl_mj.BadInput, match=r"mine\.xml exists already"):
        write_task("mine", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.xml"]


# ---- what is wrong is said before any training

PY, XML = "my_robot.py", "my_robot.xml"
MISTAKES = {
    "a tag that is not closed": (XML, "</worldbody>", "", r"my_robot\.xml: .*[Ll]ine.*\d+"),
    "an unknown attribute": (XML, 'kv="12"', 'kw="12"', r"my_robot\.xml: .*kw.*line \d+"),
    "no MJCF": (XML, None, None, r"no MJCF model at .*my_robot\.xml"),
    "no task file": (PY, None, None, r"no task file .*my_robot\.py.*new-task my_robot"),
    "an import that fails": (PY, "import numpy", "import nunpy", r"'nunpy', line \d+"),
    "no Python": (PY, "class MyRobot", "clas MyRobot", r"SyntaxError.*my_robot\.py, line \d+"),
    "an error of its own": (PY, "WALL = 1.4", "WALL = 1 / 0", r"ZeroDivisionError.*line \d+"),
    "no task": (PY, "(hyrl_mj.Task)", "", r"must define one task.*none"),
    "a name that is taken": (
        PY, 'name = "my_robot"', 'name = "vehicle"', r"and so does .*vehicle\.py: rename",
    ),
    "a part is missing": (PY, r"    max_steps = 70\n.*crash.*\n", "", r"no max_steps, worst_reward"),
    "a method is missing": (PY, "def ending", "def finish", r"not finished.*ending"),
    "no actuators": (
        XML, '<actuator>.*</actuator>| ctrl="1 0"', "", r"my_robot\.xml has no actuators",
    ),
    "an actuator of another name": (XML, 'name="lateral"', 'name="side"', r"'lateral'.*side"),
    "a limit is missing": (XML, ' ctrlrange="-1 1"', "", r"lateral needs a ctrlrange"),
    "a chart of the wrong dimension": (PY, r'\("m", "m"\)', '("m",)', r"2 name.*1 value.*units"),
    "one number for two ends": (PY, r"\(0\.0, -1\.5\)", "0.0", r"2 name.*1 value.*low"),
    "two coordinates of one name": (PY, r'\("x", "y"\)', '("y", "y")', r"a text of its own"),
    "a dataclass": (
        PY, "@hyrl_mj.register", "from dataclasses import dataclass\n@hyrl_mj.register\n@dataclass",
        r"which tasks are equal.*dataclass\(eq=False\)",
    ),
    "an id that Gymnasium does not take": (
        PY, "    max_steps", '    env_id = "my id"\n    max_steps', r"env_id 'my id'.*Malformed",
    ),
    "a z of the wrong dimension": (
        PY, "    def obs", "    def z(self, m):\n        return m[:, :1]\n\n    def obs",
        r"z\(\) .* gives shape \(64, 1\)",
    ),
    "starts of the wrong dimension": (PY, r"\(0\.0, -0\.8\)", "(0.0,)", r"start_low .*a tuple of 2 values"),
    "a measurement of the wrong size": (
        PY, "noisy = .*\n", "noisy = (True,) * 3\n", r"measures 4.*`noisy` has 3",
    ),
    "an observation outside its space": (
        PY, r"\(5\.0, 3\.0, 3\.0\)", "(0.1, 3.0, 3.0)", r"observation\[0\] is .*0\.1: widen",
    ),
    "a start that has crashed": (
        XML, 'pos="1.6 0 0.1"', 'pos="0.2 0 0.1"', r"starts are over before they begin: x = .*crashed",
    ),
    "a start outside the chart": (PY, r"\(0\.3, 0\.8\)", "(0.3, 1.8)", r"starts outside its chart"),
    "a sample time that does not fit": (
        XML, 'data="0.05"', 'data="0.045"', r"0\.045 s is no multiple of the physics step 0\.01 s",
    ),
    "a state that is not the chart's": (
        PY, "return z, np.stack", "return 1.01 * z, np.stack", r"state\(\) and z\(\) do not belong",
    ),
    "nothing to track": (
        PY, r"time=3\.2", 'time=3.2, tracked="followed"', r"site, body or geom .*'followed'.*tracked",
    ),
    "no camera": (PY, r"time=3\.2", 'time=3.2, camera="above"', r"camera .*'above'.*overhead"),
    "a reward that is one number": (
        PY, r"return np\.where\(self\.failed.*\n", "return np.zeros(1)\n", r"reward\(\)",
    ),
    "an error in a method": (
        PY, r"close = np\.maximum", "close = np.maximal", r"AttributeError.*'maximal', line \d+",
    ),
    "a flat observation": (
        PY, r"return measured\[:, :3\]", "return measured[:, 0]", r"observation\(\) of .* gives shape",
    ),
    "starts the wrong way round": (PY, r"\(0\.0, -0\.8\)", "(0.0, 1.0)", r"start_low is greater"),
    "an unknown algorithm": (PY, "levels=5", 'levels=5, algorithm="sarsa"', r"algorithm 'sarsa'.*ppo, a2c"),
    "an unknown field of the training": (
        PY, "levels=5", 'levels=5, training={"sample": 9}', r"learning\.training .* 'sample'.*samples",
    ),
    "a value that a training cannot have": (
        PY, "levels=5", 'levels=5, modes={"gamma": 2}', r"learning\.modes of my_robot: gamma",
    ),
    "more units than inputs": (
        PY, r'\("m/s",\)', '("m/s", "m")', r"input_units has 2 value\(s\), and there are 1 input",
    ),
    "dqn without levels": (PY, "levels=5", 'algorithm="dqn"', r"dqn needs levels"),
    "a mirror of the wrong length": (
        PY, r"\(1, -1, -1\)", "(1, -1)", r"mirror\.observation is \(1, -1\): give 3",
    ),
    "a set-point of the wrong dimension": (
        PY, r"\[3\.0, 0\.0\]", "[3.0]", r"set_point has shape \(1,\)",
    ),
    "a scene that is none": (PY, r"scene = Scene\(", "scene = dict(", r"scene is .*hyrl_mj\.Scene"),
    "no time to show": (PY, r"time=3\.2", "time=0.0", r"scene\.time 0\.0 cannot be used: give a"),
    "one mode": (PY, r'\("left", "right"\)', '("left",)', r"mode_names"),
    "a replay start outside": (PY, r"\(0\.0, 0\.15\)\)", "(0.0, 9.0))", r"y = 9 m.*outside"),
}  # fmt: skip


@pytest.mark.fast(3)
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_before_any_training(unknown_tasks, tmp_path, mistake):
    file, old, new, says = MISTAKES[mistake]
    for name in (PY, XML):
        text = (TEMPLATES / name).read_text()
        if name == file and old is not None:
            changed = re.sub(old, new, text, flags=re.DOTALL if "<" in old else 0)
            assert changed != text
            text = changed
        if name != file or old is not None:
            (tmp_path / name).write_text(text)
    done = call("run", PY, "--preset", "smoke", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert re.search(says, done.stderr, re.DOTALL), done.stderr
    assert "my_robot" in done.stderr
    assert not (tmp_path / "runs").exists()


# ---- a simulation that breaks down


def test_a_simulation_that_breaks_down_ends_its_episode_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rocket = '<motor name="aside" joint="y" gear="1e15" ctrlrange="-1.5 1.5"/>'
    xml = re.sub('<velocity name="aside".*?/>', rocket, WASP_XML).replace("wasp", "rocket_wasp")
    (tmp_path / "rocket_wasp.xml").write_text(xml)
    text = WASP_PY.replace('"wasp"', '"rocket_wasp"').replace("class Wasp", "class RocketWasp")
    (tmp_path / "rocket_wasp.py").write_text(text)
    task = hyrl_mj.get_task(tmp_path / "rocket_wasp.py")

    class Push:
        def act(self, measured):
            aside = np.where(measured[:, 1] > 0.55, 1.5, 0.0)
            return np.stack([aside, np.zeros(len(measured))], axis=1)

    z0 = np.array([[0.0, y, 0.5] for y in (0.5, 0.6, -0.55)])
    runs, rollout = way_runs(task, Push(), z0)
    assert rollout.outcome.tolist() == [Outcome.REACHED, Outcome.UNSTABLE, Outcome.REACHED]
    assert rollout.length[1] == 1
    np.testing.assert_array_equal(rollout.path[1:, 1], rollout.path[:-1, 1])
    assert runs.usable.tolist() == [True, False, True]
    assert runs[np.array([0])].differ(runs[np.array([2])]).tolist() == [True]
    calm = hyrl_mj.closed_loop(task, PolicyController(Push()), z0[[0, 2]])
    np.testing.assert_array_equal(rollout.path[:, [0, 2]], calm.path)

    env = BatchedEnv(task, 3)
    env.reset(z=z0)
    result = env.step(Push().act(env.plant.measurement))
    assert [Outcome(o).label for o in result.outcome] == ["running", "unstable", "running"]
    assert result.terminated.tolist() == [False, True, False]
    assert result.reward[1] == task.worst_reward
    assert np.isfinite(result.observation).all()
