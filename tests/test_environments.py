"""Environments of others as tasks: plant, noise, what is found out about them, and what is refused."""

import functools
import gc
import importlib
import json
import multiprocessing
import pickle
import re
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from command_line import call as command
from environments import (
    XML,
    Floating,
    Gambling,
    Moved,
    Puck,
    always,
    ends,
    outcomes,
    plain,
    puck_agent,
)
from gl import needs_gl
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TimeLimit
from manual import arguments_of_environments
from planted import spare_environments, without_judges, without_pictures

import hyrl_mj
from hyrl_mj import BadInput, Outcome, from_gymnasium, get_task, simulate
from hyrl_mj.gym_import import inspection, making
from hyrl_mj.gym_import.attributes import settings_of
from hyrl_mj.gym_import.coordinates import coordinates
from hyrl_mj.gym_import.fingerprint import code_of, of_model
from hyrl_mj.gym_import.instance import Instance, flat
from hyrl_mj.gym_import.opening import Description
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.judging import results
from hyrl_mj.learning import presets
from hyrl_mj.physics import mjcf
from hyrl_mj.physics.mjcf import camera_of, point_of, rests
from hyrl_mj.physics.rendering import SceneRenderer
from hyrl_mj.pipeline import steps
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import Recorded, closed_loop
from hyrl_mj.stages import grounds
from hyrl_mj.system import cores
from hyrl_mj.tasks import check_task, described_task, reference
from hyrl_mj.viz import section
from hyrl_mj.viz.replay.marks import tracked_points

# A second for each environment.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_steps")]

# What the environments of other packages need, beside their ids; episodes are short.
OTHERS = {name: {**given, "steps": 60} for name, given in arguments_of_environments().items()}
OTHERS[PENDULUM := "dm_control/pendulum-swingup-v0"] |= {
    "steps": None,
    "kwargs": {"task_kwargs": {"time_limit": 1.2}},
}
MAZE = "PointMaze_Large-v3"
# The maze of middle size is made of the same parts.
LATER = pytest.param("PointMaze_Medium-v3", marks=pytest.mark.long)
others = pytest.mark.parametrize(
    "name", [LATER, *(name for name in OTHERS if name not in LATER.values)]
)


@pytest.fixture(autouse=True)
def unjudged(request, monkeypatch):
    """New instances judge no runs of inspections, but of the environments of other packages."""
    if "other" not in request.fixturenames:
        without_judges(monkeypatch)


@pytest.fixture(scope="module")
def puck():
    return from_gymnasium(Puck)  # of 1,000 steps, as nothing tells


@pytest.fixture(scope="module")
def told():
    """A puck of which all is given."""
    return from_gymnasium(
        lambda: TimeLimit(Puck(), 30),
        bounds={"x": (-6, 2)},
        starts="reset",
        success="reward >= -0.3 and distance(puck, goal) < 0.3",
    )


@pytest.fixture(scope="module")
def gambling():
    return from_gymnasium(Gambling, steps=20)


@pytest.fixture(scope="module")
def other():
    """Returns the task of an environment of another package, by its name; each is made once."""
    return functools.cache(lambda name: from_gymnasium(name, **OTHERS[name]))


def test_noise_moves_every_copy_of_a_position(puck):
    plant = puck.plant(1)
    plant.set_state(np.array([[-1.0, 0.5]]), np.array([[0.3, 0.0]]))
    noisy = puck.with_z(plant.measurement, np.array([[-0.9, 0.4]]))
    # velocity, position and to_goal, in the order of the space
    order = [*puck.observation_parts]
    expected = {"position": [-0.9, 0.4], "to_goal": [2.4, -0.4], "velocity": [0.3, 0.0]}
    np.testing.assert_allclose(
        puck.observation(noisy)[0], np.concatenate([expected[k] for k in order])
    )
    noise = np.zeros((1, puck.measurement_columns))
    noise[0, :2] = 0.1, -0.1
    sensed = plant.observe(plant.truth(np.arange(1)), noise, np.arange(1))
    np.testing.assert_allclose(puck.observation(sensed), puck.observation(noisy), atol=1e-12)
    np.testing.assert_allclose(puck.z(sensed), [[-0.9, 0.4]])


def test_results_do_not_depend_on_the_cores(puck, monkeypatch):
    rng, ends = np.random.default_rng(0), []
    z, u = puck.starts(100, rng), rng.uniform(-4, 4, (5, 100, 2))
    for count in (1, 2):
        monkeypatch.setattr(cores, "allowed", count)
        plant = puck.plant(100)
        plant.set_state(*puck.state(z))
        for inputs in u:
            plant.step(inputs)
        ends.append(plant.measurement)
    np.testing.assert_array_equal(*ends)


def test_an_error_in_another_process_is_told(gambling, monkeypatch):
    monkeypatch.setattr(cores, "allowed", 2)
    plant = gambling.plant(100)
    plant.set_state(*gambling.state(np.tile([[-1.0, 0.5]], (100, 1))))
    u = np.zeros((100, 2))
    u[-1] = 3.7  # of the second half
    with pytest.raises(BadInput, match=r"step\(\) of Gambling raises RuntimeError: broken"):
        plant.step(u)
    plant.set_state(*gambling.state(np.tile([[-1.0, 0.5]], (100, 1))))
    plant.step(np.zeros((100, 2)))  # what was left unsaid is not taken for another answer
    assert np.isfinite(plant.measurement).all()


def test_a_start_inside_of_a_wall_has_crashed(puck):
    plant = puck.plant(2)
    plant.set_state(np.array([[0.0, 0.0], [1.0, 0.0]]))
    assert puck.ending(plant.measurement).tolist() == [2, 0]
    free = puck.plant(200)
    free.set_state(*puck.state(puck.starts(200, np.random.default_rng(0))))
    assert (puck.ending(free.measurement) == 0).all()


def test_the_environment_of_a_task_gives_the_episodes_of_the_task():
    vehicle = hyrl_mj.get_task("vehicle")
    (x0, y0), (x1, y1) = vehicle.chart.low, vehicle.chart.high
    task = from_gymnasium(
        vehicle.env_id,
        chart={"x": "qpos[0]", "y": "qpos[1]"},
        noisy=(0, 1),
        bounds={"x": (x0, x1), "y": (y0, y1)},
    )
    rng = np.random.default_rng(0)
    z, paths = vehicle.starts(4, rng), []
    noise = rng.uniform(-0.1, 0.1, (vehicle.max_steps, 4))
    low, high = (float(limit[0]) for limit in vehicle.input_limits)
    for one, inputs in ((vehicle, (low, high)), (task, (0.0, len(vehicle.input_levels) - 1.0))):
        signal = np.zeros((*noise.shape, one.measurement_columns))
        signal[..., 1] = noise
        run = closed_loop(one, sided(one, *inputs), z, Recorded(signal, 0.1, "uniform"))
        paths.append((run.length, run.path, run.outcome == 1))
    for a, b in zip(*paths, strict=True):
        np.testing.assert_array_equal(a, b)


def sided(task, low, high):
    """A controller with one of two inputs, by the side of y = 0."""
    act = lambda measured: np.where(task.z(measured)[:, 1:] >= 0, high, low)  # noqa: E731
    return PolicyController(SimpleNamespace(act=act))


def test_an_episode_ends_where_info_tells_success(puck, told):
    assert simulate(puck, always(puck, 4, 0), [1.0, 0.0]).outcome == "reached"
    late = simulate(told, always(told, 0, 0), [1.3, 0.0])
    assert (late.outcome, len(late.t)) == ("reached", 31)
    assert told.specification.criterion.points == ((("xpos", 1), ("site_xpos", 0)),)


@pytest.mark.parametrize(
    ("chart", "names"),
    [
        ("position", ["x", "y"]),
        (["qpos[0]", "qpos[1]", "qvel[0]"], ["x", "y", "x rate"]),
        ({"east": "x", "north": "y"}, ["east", "north"]),
        ("puck", ["x", "y"]),
        (["to_goal[1]"], None),
        (["x", "position[0]"], None),
        (["heading"], None),
        (["position[7]"], None),
    ],
)
def test_charts_are_named_as_users_name_things(chart, names, puck):
    if names is not None:
        assert [c.name for c in coordinates(puck._instance, chart)] == names
        return
    with pytest.raises(BadInput, match=r"no single position|twice|unknown coordinate"):
        coordinates(puck._instance, chart)


def test_what_was_not_given_is_found_and_said(puck, told):
    assert list(puck.chart.names) == ["x", "y"]
    np.testing.assert_allclose([puck.chart.low, puck.chart.high], [(-2.3, -1.7), (2.3, 1.7)])
    assert puck.inputs == ("push_x", "push_y")
    assert puck.dt == pytest.approx(0.1)
    assert puck.max_steps == 1_000
    for name in ("chart", "success", "bounds", "starts", "steps", "noise", "ways"):
        assert puck.found[name]
    assert told.max_steps == 30
    assert (told.chart.low[0], told.chart.high[0]) == (-6, 2)
    assert -1.8 <= told.start_low[0] < told.start_high[0] <= -1.0


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("PointMaze_Medium-v3", {}, "each reset of .* draws .*goal.*pin it.*goal_cell"),
        ("Reacher-v5", {}, "does not tell in its info when it succeeds"),
        (
            "PointMaze_Medium-v3",
            {"reset": {"goal_cel": [6, 6]}},
            "change nothing in PointMaze_Medium-v3, which draws .*goal",
        ),
    ],
)
def test_what_environments_of_packages_lack_is_said(name, given, message):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(name, **given)


@pytest.mark.parametrize("own", [True, False])
def test_random_numbers_that_few_steps_draw_are_refused_when_they_are(own, gambling, monkeypatch):
    task = gambling

    def gamble():
        plant.step(u + (3.9 if own else 3.8))
        plant.end()

    for allowed in (2, 1):
        monkeypatch.setattr(cores, "allowed", allowed)
        plant, u = task.plant(60), np.zeros((60, 2))
        plant.set_state(*task.state(np.tile([[-1.0, 0.5]], (60, 1))))
        plant.step(u)
        plant.end()
        plant.set_state(*task.state(np.tile([[-1.0, 0.5]], (60, 1))))
        with pytest.raises(BadInput, match=r"draws random numbers in step\(\)"):
            gamble()


def test_an_observation_in_rows_is_a_vector_row_by_row(gambling):
    plant = gambling.plant(2)
    plant.set_state(np.array([[-1.0, 0.5], [-1.5, 0.0]]), np.array([[0.1, 0.2], [0.3, 0.4]]))
    wanted = [[-1.0, 0.5, 0.1, 0.2], [-1.5, 0.0, 0.3, 0.4]]
    np.testing.assert_allclose(gambling.observation(plant.measurement), wanted, atol=1e-12)


class Through(Puck):
    """Its contacts are switched off; its model has words that MuJoCo warns of."""

    settings = '<compiler settotalmass="14"/><option><flag contact="disable"/></option>'
    xml = XML.replace('<mujoco model="puck">', f'<mujoco model="puck">{settings}')


def test_walls_that_nothing_collides_with_are_none_and_warnings_are_not_written(
    tmp_path, monkeypatch
):
    register(monkeypatch, "Through-v0", Through, max_episode_steps=20)
    done = command("run", "--env", "Through-v0", cwd=tmp_path)
    assert done.returncode == 2
    assert "no walls that can be passed on both sides" in done.stderr
    assert "nothing is decided on the chart" in done.stderr
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"success": "close"}, r"success 'close' cannot be used: 'close' is not known"),
        ({"success": "distance(puck, moon) < 1"}, "unknown site, body or geom.*'moon'"),
        ({"noisy": (1,)}, r"noisy has 1 share.*2 coordinate"),
        ({"bounds": {"z": (0, 1)}}, "bounds for z.*x, y"),
        ({"pinned": {"qpos[9]": 0}}, r"no qpos\[9\]"),
        (
            {"pinned": {"speed": 0}},
            "pinned speed of Puck is no number of MuJoCo's data: .* by a seed",
        ),
        ({"starts": "there"}, "unknown starts"),
        ({"kwargs": {"depth": 3}}, r"cannot be made .TypeError"),
        ({"steps": "many"}, "steps 'many' cannot be used: give an integer from 1"),
        ({"steps": 0}, "steps 0 cannot be used"),
        ({"pinned": {"qpos[1]": 0.5}}, r"qpos\[1\] is the coordinate y of the chart.*leave it out"),
        ({"bounds": {"x": 3}}, r"bounds of x 3 cannot be used: .*low.*high"),
        ({"bounds": {"x": [2, -2]}}, r"bounds of x \[2, -2\] cannot be used"),
        ({"bounds": [1, 2]}, "bounds .* give a dictionary"),
        ({"noisy": "ab"}, "noisy 'ab' cannot be used: give a list of numbers"),
        ({"noisy": [-1, 2]}, "numbers from 0 on"),
        ({"noisy": [0, 0]}, "above 0 for at least one"),
        ({"chart": 3}, "chart 3 cannot be used: give a name"),
        ({"seed": -1}, "seed -1 cannot be used"),
        ({"reset": [1]}, "reset .* give a dictionary"),
        (
            {"kwargs": {"render_mode": "human"}},
            "render_mode 'human' cannot be used: give rgb_array",
        ),
        ({"pinned": {"qpos[0]": "a"}}, "pinned .* give a finite number"),
        ({"pinned": {"qpos[0]": [[1], [1, 2]]}}, "pinned .* give a finite number"),
        ({"success": 3}, "success 3 cannot be used"),
        ({"success": "reward >= nan"}, "nan is no finite number"),
    ],
)
def test_wrong_arguments_are_refused_with_what_is_allowed(options, message):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(Puck, **options)


class Furnished(Puck):
    """Around it are a door and a crate."""

    xml = XML.replace(
        "</worldbody>",
        '<body pos="0 3 0.2"><joint type="slide" range="-1 1" limited="true"/><geom size="0.1"/></body>'
        '<body pos="0 4 0.2"><freejoint/><geom size="0.1"/></body></worldbody>',
    )


@pytest.mark.parametrize(
    ("pinned", "message"),
    [
        ({"qpos[2]": 1.2}, r"pinned qpos\[2\] of Furnished violates a range .* by 0.2 m or rad"),
        ({"qpos[6]": 0.7}, r"pinned qpos\[6\] of Furnished is a part of a quaternion"),
        ({"qpos[2]": np.nan}, "pinned .* give a finite number"),
    ],
)
def test_pinned_positions_are_such_as_the_robot_can_have(pinned, message):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(Furnished, steps=20, pinned=pinned)
    pinned = {"qpos[2]": 0.9, "qpos[6]": 0.0, "qpos[7]": 1.0}
    inspection._check_pinned(Instance(EnvironmentSpec(Description(Furnished, pinned=pinned))))


ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="tip">
      <joint name="turn" axis="0 0 1" damping="0.5"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.03" contype="0" conaffinity="0"/>
      <site name="tip" pos="0.5 0 0"/>
    </body>
    <site name="goal" pos="-0.5 0 0"/>
  </worldbody>
  <actuator><motor name="push" joint="turn" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class Arm(gym.Env):
    """An arm that turns freely, and begins near one angle."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,))
    action_space = spaces.Box(-1.0, 1.0, (1,))
    begins, limits = 4.7, ""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(
            ARM.replace("damping", f"{self.limits} damping")
        )
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[0] = self.begins + self.np_random.uniform(-0.1, 0.1)
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def _get_obs(self):
        angle = self.data.qpos[0]
        return np.array([np.cos(angle), np.sin(angle), self.data.qvel[0]])

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=5)
        return (
            self._get_obs(),
            0.0,
            False,
            False,
            {"success": bool(np.cos(self.data.qpos[0]) > 0.99)},
        )


class Stopped(Arm):
    limits = 'range="-90 180"'
    begins = 0.0


@pytest.mark.parametrize(
    ("env", "given", "message"),
    [
        (
            Stopped,
            {"bounds": {"turn": [-1.7, 1]}},
            "reach beyond the range of its joint, -1.5708 to",
        ),
        (Arm, {"bounds": {"turn": [-180, 180]}}, "more than a turn"),
        (
            Stopped,
            {"bounds": {"turn": [1, 2]}, "starts": "reset"},
            "resets of .* lead to turn -0.0",
        ),
        (Stopped, {"success": "distance(tip, goal) <= 0.1"}, "several things .* have the name tip"),
    ],
)
def test_charts_and_names_that_mean_something_else_are_refused(env, given, message):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(env, steps=5, **given)


def test_a_whole_turn_that_is_given_is_periodic_and_resets_may_lead_to_another_turn():
    success = {"success": 'distance("body tip", goal) <= 0.1'}
    task = from_gymnasium(
        Arm, steps=5, starts="reset", bounds={"turn": [-3.1416, 3.1416]}, **success
    )
    assert task.chart.periodic == (True,)
    assert task.specification.criterion.points[0][0][0] == "xpos"
    assert -1.69 < task.start_low[0] < task.start_high[0] < -1.48


def test_what_resets_draw_is_pinned_by_a_seed_or_by_options_that_they_heed():
    task, env, places = from_gymnasium(Moved, seed=3, steps=20), Moved(), []
    for seed in (0, 3):
        env.reset(seed=seed)
        places.append((env.model.geom_pos[0, 1], env.goal))
    assert "with seed 3" in task.found["goal"]
    assert (task.model.geom_pos[0, 1], task._instance.inner.goal) == places[1]
    assert places[0] != places[1]
    assert from_gymnasium(Moved, reset={"rock": 0.2}, steps=20).model.geom_pos[0, 1] == 0.2


def test_the_code_of_an_environment_is_that_of_its_files(tmp_path, monkeypatch, puck):
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "my_puck.py"
    path.write_text(
        "import my_rules\nfrom environments import Puck\nclass Mine(Puck):\n    push = 1\n"
    )
    beside = tmp_path / "my_rules.py"
    beside.write_text("")
    module = importlib.import_module("my_puck")

    def code():
        """Of the task, whose environment is another one meanwhile."""
        vars(puck).pop("code", None)  # which is kept
        return puck.code

    codes = [code()]
    monkeypatch.setattr(puck._instance, "env", module.Mine())
    codes.append(code())
    path.write_text(path.read_text() + "# changed\n")
    assert code() == codes[1], "it has not been imported again"
    monkeypatch.setattr(puck._instance, "env", importlib.reload(module).Mine())
    codes.append(code())
    beside.write_text("crashed = 1\n")
    monkeypatch.setattr(puck._instance, "env", importlib.reload(module).Mine())
    codes.append(code())
    # What it reads from files of its own shows in what it holds; an object of a notebook is of no file.
    monkeypatch.setattr(puck, "_settings", settings_of(module.Mine()) | {"radius": b"0.05"})
    codes.append(code())
    assert len({*codes}) == len(codes) == 5
    del puck.code


def test_settings_and_the_code_of_a_notebook_are_written_down_for_each_process():
    def of(radius, text="return False"):
        """As a cell of a notebook makes it."""
        names = {"Puck": Puck, "__name__": "a_notebook"}
        exec(f"class Cell(Puck):\n def crashed(self): {text}", names)
        env = names["Cell"]()
        env.config = {"radius": radius, "of": "here", "file": "/a/map.npy"}
        return settings_of(env), code_of(env, lambda: radius)

    one, other = of(0.25), of(0.05)
    assert [name for name in one[0] if one[0][name] != other[0][name]] == ["config"]
    assert b"here" in one[0]["config"]
    assert b"map" not in one[0]["config"]
    assert one == of(0.25)
    assert one[1] == other[1] != of(0.25, "return True")[1]


def test_a_free_joint_has_places_that_a_chart_may_name_but_no_orientation():
    task = from_gymnasium(Floating, steps=20)
    assert task.chart.names == ("x of root", "y of root")
    assert task.chart.units == ("m", "m")
    np.testing.assert_allclose(task.chart.low, (-2.3, -1.7))
    assert list(task.obstacles) == ["island 1"]
    assert coordinates(task._instance, ["qvel[1]"])[0].unit == "m/s"
    with pytest.raises(BadInput, match=r"qpos\[4\] is a part of an orientation"):
        coordinates(task._instance, ["qpos[0]", "qpos[4]"])


def test_a_module_of_the_current_folder_is_found_and_again_only_as_it_was(tmp_path, monkeypatch):
    module = tmp_path / "beside_me.py"
    module.write_text(
        "import gymnasium as gym\nfrom environments import Puck\n"
        "gym.register('Beside-v0', entry_point=Puck, max_episode_steps=50)\n"
    )
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    done = command("diagnose", "--env", "beside_me:Beside-v0", "--explain", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 'info["success"]' in done.stdout
    monkeypatch.chdir(tmp_path)
    spec = 'env:{"env": "beside_me:Beside-v0"}'
    assert described_task(spec).max_steps == 50
    making._MADE.pop(spec)  # as another process would begin
    module.write_text(module.read_text() + "# changed\n")
    with pytest.raises(BadInput, match=r"use it once, as with .*--env beside_me:Beside-v0"):
        described_task(spec)
    del gym.registry["Beside-v0"], sys.modules["beside_me"]


# ---- what an id, or a name, stands for


@pytest.mark.long
def test_of_two_functions_of_one_name_neither_is_taken_for_the_other():
    def made(scale):
        def make():
            return setattr(env := Puck(), "scale", scale) or env

        return make

    one = from_gymnasium(made(1.0), steps=5)
    assert get_task(one.spec) is one
    two = from_gymnasium(made(2.0), steps=5)
    with pytest.raises(BadInput, match="two functions are called make"):
        get_task(one.spec)
    one = None
    assert get_task(two.spec) is two


class Legs(Puck):
    """Succeeds at the last of several goals, which options give as a list."""

    def reset(self, *, seed=None, options=None):
        self.goals = (options or {"goals": [0.0]})["goals"] * 2
        return super().reset(seed=seed)

    def arrived(self, off):
        return off < 0.25 and len(self.goals) == 4


class Failing(Puck):
    def control(self, action):
        raise ValueError("emergency stop")


def register(monkeypatch, name, kind, **given):
    spec = EnvSpec(name, entry_point=kind, **given)
    monkeypatch.setitem(gym.registry, name, spec)


@pytest.mark.long
def test_options_of_a_reset_are_what_they_were_given_as_and_an_id_may_come_to_mean_another(
    monkeypatch,
):
    assert outcomes(Legs, reset={"goals": [1.0, 2.0]}) == plain()
    seen, given = [], {"reset": {"goals": np.array([1.0, 2.0])}}

    def looked(description, untried):
        seen.append(description)
        raise BadInput("looked at")

    register(monkeypatch, "Legs-v0", Legs, max_episode_steps=60)
    task = from_gymnasium("Legs-v0", **given)
    assert ends(task) != plain()
    assert '{"array": [1.0, 2.0]}' in task.spec
    assert from_gymnasium("Legs-v0", **given) is task
    register(monkeypatch, "Legs-v0", Failing)
    with pytest.raises(BadInput, match="emergency stop"):
        from_gymnasium("Legs-v0", **given)
    monkeypatch.setattr(making, "inspect", looked)
    with pytest.raises(BadInput, match="looked at"):
        get_task(task.spec)
    assert isinstance(seen[0].reset["goals"], np.ndarray)


class Configured(Puck):
    """It takes its settings out of a dictionary, and its model from a file."""

    def __init__(self, settings):
        self.share, self.xml = settings.pop("share", 1.0), Path(settings["file"]).read_text()
        super().__init__()


@pytest.mark.long
def test_settings_are_as_given_in_each_instance_and_a_file_that_changes_is_read_again(
    tmp_path, monkeypatch
):
    file = tmp_path / "puck.xml"
    file.write_text(XML)
    given = {"settings": {"share": 0.5, "file": str(file)}}
    register(monkeypatch, "Configured-v0", Configured)
    task = from_gymnasium("Configured-v0", kwargs=given, steps=5)
    given["settings"]["share"] = 0.1
    assert Instance(task.specification).inner.share == 0.5
    given["settings"]["share"] = 0.5
    assert from_gymnasium("Configured-v0", kwargs=given, steps=5) is task
    file.write_text(XML.replace('mass="1"', 'mass="2"'))
    other = from_gymnasium("Configured-v0", kwargs=given, steps=5)
    assert (task.model.body_mass[-1], other.model.body_mass[-1]) == (1, 2)


@pytest.mark.long
def test_code_that_is_imported_again_is_another_environment(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    path = tmp_path / "changing.py"
    text = (
        "import gymnasium as gym\nfrom environments import Puck\n\n\nclass Changing(Puck):\n"
        "    def arrived(self, off):\n        return off < 0.25\n\n\n"
        "gym.register('Changing-v0', 'changing:Changing', max_episode_steps=60)\n"
    )
    path.write_text(text)
    before = from_gymnasium("changing:Changing-v0", steps=5)
    assert from_gymnasium("changing:Changing-v0", steps=5) is before
    path.write_text(text.replace("off < 0.25", "1 / 0"))
    importlib.invalidate_caches()
    importlib.reload(sys.modules["changing"])
    with pytest.raises(BadInput, match="ZeroDivisionError"):
        from_gymnasium("changing:Changing-v0", steps=5)
    del gym.registry["Changing-v0"], sys.modules["changing"]


def test_an_mjcf_is_compiled_once_for_all_instances_unless_it_names_other_files(
    tmp_path, monkeypatch
):
    compiled = []

    def counting(name, own):
        monkeypatch.setitem(mjcf._OWN, name, count := lambda xml: compiled.append(name) or own(xml))
        monkeypatch.setattr(mujoco.MjModel, name, count)

    monkeypatch.setattr(mjcf, "_LATEST", {})
    for name, own in [*mjcf._OWN.items()]:
        counting(name, own)
    path = tmp_path / "puck.xml"
    path.write_text(XML)
    with mjcf.compiled_once():
        one, two = Puck().model, mujoco.MjModel.from_xml_path(str(path))
        one.body_mass[-1] = 2
        assert compiled == ["from_xml_string"]
        assert of_model(two) == of_model(Puck().model)
        assert of_model(two) != of_model(one)
        path.write_text(XML.replace('mass="1"', 'mass="3"'))
        assert mujoco.MjModel.from_xml_path(str(path)).body_mass[-1] == 3
        part = tmp_path / "part.xml"
        part.write_text("<mujoco><size nuserdata='1'/></mujoco>")
        path.write_text(f"<mujoco><include file='{part}'/></mujoco>")
        for size in (1, 2):
            part.write_text(f"<mujoco><size nuserdata='{size}'/></mujoco>")
            assert mujoco.MjModel.from_xml_path(str(path)).nuserdata == size
        with pytest.raises(ValueError, match="nowhere"):
            mujoco.MjModel.from_xml_path("nowhere.xml")
    assert compiled == ["from_xml_string", *["from_xml_path"] * 4]
    assert Puck().model.body_mass[-1] == 1
    assert len(compiled) == 6


def test_processes_of_a_task_that_nobody_has_end():
    before = {*multiprocessing.active_children()}
    task = from_gymnasium(Puck, steps=2)
    made = {*multiprocessing.active_children()} - before
    assert made
    del task
    making._RECENT.clear()
    gc.collect()
    until = time.monotonic() + 10
    while made & {*multiprocessing.active_children()} and time.monotonic() < until:
        time.sleep(0.05)
    assert not made & {*multiprocessing.active_children()}


@needs_gl
def test_the_free_camera_from_above_shows_the_whole_chart(told):
    task = told
    renderer = SceneRenderer(task.model, 320, 240)
    renderer.place(np.zeros(2), task.scene.camera)
    corners = np.array(
        [[x, y, 0.1] for x in (-6, 2) for y in (task.chart.low[1], task.chart.high[1])]
    )
    pixels, _ = renderer.project(corners)
    assert ((pixels >= 0) & (pixels <= (320, 240))).all()
    renderer.close()


def test_an_agent_that_is_missing_is_said_before_the_environment_is_tried_out(tmp_path):
    status, _, error = command(
        "diagnose", "--env", "Nowhere-v0", "--policy", str(tmp_path / "no.zip")
    )
    assert status == 2
    assert "there is no file" in error


def test_free_cameras_are_there_for_every_model(puck):
    model = puck.model
    assert rests(model, camera_of(model, "free"))
    assert camera_of(model, "overhead").elevation == -90
    assert point_of(model, "tracked") == ("xpos", 1)
    with pytest.raises(BadInput, match=r"'chase'.*overhead, free"):
        camera_of(model, "chase")


class Quick(Puck):
    substeps = 10


def test_an_agent_is_diagnosed_and_made_robust_in_its_own_environment(tmp_path, monkeypatch):
    spare_environments(monkeypatch)
    without_pictures(monkeypatch)
    monkeypatch.setattr(section, "OVER", 60)  # each cell is another start
    monkeypatch.setitem(presets._GRIDS_DYNAMIC, 2, (14, 18))  # coarser than preset smoke
    monkeypatch.setattr(grounds, "ATTACKED", 6)
    few = {"episodes": 8, "attack_starts": 10, "attack_rounds": 1}
    monkeypatch.setattr(steps, "SPARING", replace(steps.SPARING, **few))
    monkeypatch.setattr(results, "EPISODES", 100)
    task = from_gymnasium(Quick, steps=20, bounds={"x": (-1.7, 1.8), "y": (-1.2, 1.2)})
    path, said = tmp_path / "puck", []
    options = {"preset": "smoke", "eps": 0.1, "out": path, "say": said.append}
    diagnosed = hyrl_mj.diagnose(task, puck_agent, **options)
    assert (path / "diagnosis.html").is_file()
    points = diagnosed.critical_set.points
    assert len(points) > 5
    assert (np.abs(points[points[:, 0] < -0.5, 1]) < 0.05).all()
    run = hyrl_mj.robustify(task, puck_agent, **options)
    assert (path / "replay.png").is_file()
    lost = {count.controller: count.lost for count in run.robustness.attacks}
    assert lost["hyrl"] < lost["policy"]
    again = hyrl_mj.load_run(path, puck_agent)
    q, measured = np.array([0, 1]), np.tile(task.plant(1).measurement, (2, 1))
    np.testing.assert_array_equal(
        again.controller.step(q, measured)[0], run.controller.step(q, measured)[0]
    )


# ---- of other packages; last, because their many copies take memory that each new process would copy


@pytest.mark.first(2)
@others
def test_copies_go_on_as_the_environment_alone_does(name, other):
    task, rng = other(name), np.random.default_rng(0)
    z = task.starts(3, rng)
    plant = task.plant(3)
    plant.set_state(*task.state(z))
    inputs = rng.uniform(*task.input_limits, (20, 3, len(task.inputs)))
    seen = []
    for u in inputs:
        plant.step(u)
        seen.append(task.observation(plant.measurement))
    for i in range(3):  # one after the other, in an environment of its own
        instance = Instance(task.specification)
        instance.reset()
        instance.physics.write(task.specification.state_at(z)[i])
        for k, u in enumerate(inputs):
            observation, *_ = instance.env.step(instance.action(u[i]))
            space = instance.env.observation_space
            np.testing.assert_array_equal(flat(observation, space), seen[k][i])


def test_an_environment_that_counts_its_steps_ends_the_episode_of_each_copy(other):
    # After its last step dm_control resets the environment in the next step, whoever's it is.
    task = other(PENDULUM)
    assert task.max_steps == 60
    three, alone = task.plant(3), task.plant(1)
    for plant, angles in ((three, [0.0, 1.0, 2.0]), (alone, [1.0])):
        plant.set_state(*task.state(np.column_stack([angles, np.zeros(plant.n)])))
        for _ in range(task.max_steps):
            plant.step(np.zeros((plant.n, 1)))
    np.testing.assert_array_equal(three.qpos[1], alone.qpos[0])
    # It counts its steps itself. What succeeds at the last of them has arrived: the first stands upright.
    assert task.ending(three.measurement).tolist() == [
        Outcome.REACHED,
        Outcome.STALLED,
        Outcome.STALLED,
    ]


@pytest.mark.first(3)
@others
def test_the_tasks_of_other_packages_are_complete(name, other):
    task = other(name)
    check_task(task)
    assert set(task.found) >= {"bounds", "starts", "ways"}
    point_of(task.model, task.scene.tracked)
    camera_of(task.model, task.scene.camera)


@pytest.mark.parametrize(
    ("name", "islands"),
    [
        pytest.param("PointMaze_Medium-v3", 1, marks=pytest.mark.long),
        (MAZE, 3),
        ("pointmaze-medium-singletask-v0", 1),
        ("Reacher-v5", 0),
    ],
)
def test_islands_are_the_walls_that_can_be_passed_on_both_sides(name, islands, other):
    task = other(name)
    assert len(task.obstacles) == islands
    assert task.gives_direction == (islands == 0)


def test_a_task_is_made_again_from_its_text(other):
    task = other(MAZE)
    assert reference(task).startswith("env:")
    assert described_task(reference(task)) is task
    assert pickle.loads(pickle.dumps(task)).chart == task.chart
    assert hyrl_mj.get_task(task) is task
    loud = task.noisy_everywhere()
    assert pickle.loads(pickle.dumps(loud)).noisy == loud.noisy
    with pytest.raises(BadInput, match="describes no environment"):
        described_task("env:{}")
    with pytest.raises(BadInput, match="imports no module that you have not used before"):
        described_task('env:{"env": "this:Puck-v0"}')
    with pytest.raises(BadInput, match="made by the function elsewhere"):
        described_task('env:{"env": {"function": "elsewhere"}}')


def test_a_target_that_is_drawn_is_pinned_as_the_message_says(other):
    given = OTHERS["Reacher-v5"]
    with pytest.raises(BadInput, match="draws qpos") as refused:
        from_gymnasium("Reacher-v5", chart="qpos[0]", success=given["success"])
    assert "goal_cell" not in str(refused.value)
    advised = json.loads(re.search(r"with values as (\{.*?\}\})", str(refused.value))[1])
    assert advised == {"pinned": dict.fromkeys(given["pinned"], 0.1)}
    found = other("Reacher-v5").specification
    pinned = {f"qpos[{i}]": found.state[found.qpos[i]] for i in (2, 3)}
    assert pinned == pytest.approx(given["pinned"])


@pytest.mark.parametrize(
    ("name", "tracked", "kind"),
    [
        (MAZE, "particle", "xpos"),
        ("Reacher-v5", "fingertip", "xpos"),
        # Its only body turns about its own origin.
        (PENDULUM, "mass", "geom_xpos"),
    ],
)
def test_replays_draw_the_path_of_what_goes_farthest(name, tracked, kind, other):
    task = other(name)
    assert task.scene.tracked == tracked
    assert tracked in task.found["camera"]
    assert point_of(task.model, tracked)[0] == kind
    points = tracked_points(task, task.state(task.starts(20, np.random.default_rng(0)))[0])
    assert np.ptp(points, axis=0).max() > 0.1


def test_the_command_line_explains_what_was_found(tmp_path, other):
    other(MAZE)
    path = tmp_path / "goal.json"
    path.write_text(json.dumps(OTHERS[MAZE]))
    env = ("--env", MAZE, "--env-args", str(path))
    status, out, _ = command("diagnose", *env, "--explain")
    assert status == 0
    for part in (
        "achieved_goal",
        "island 1",
        "from the walls",
        "{'goal_cell': [3, 6]}",
        "0.01 s",
        '{"goal_cell": [3, 6]} (given)',
    ):
        assert part in out
    ways = (
        "bounds",
        "starts",
        "reset, pinned or seed",
        "noisy",
        "kwargs, such as frame_skip",
        "task.scene",
    )
    assert [way for way in ways if f"(to change it, give {way}" not in out] == []
    assert command("diagnose", *env)[0] == 2
    path.write_text(json.dumps({"goal": 3}))
    status, _, error = command("run", *env)
    assert status == 2
    assert "unknown argument in" in error
    path.write_text("{")
    assert "is no JSON" in command("run", *env)[2]
    path.unlink()
    status, _, error = command("run", *env)
    assert status == 2
    assert "goal.json cannot be read" in error
    assert "not both" in command("run", "vehicle", "--env", "Reacher-v5")[2]
    assert "need an --env" in command("run", "vehicle", "--explain")[2]
