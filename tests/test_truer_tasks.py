"""What users' own robots, noise, sets and functions do that no sample shows: right, or refused by name."""

import copy
import importlib
import os
import pickle
import sys

import mujoco
import numpy as np
import pytest
from command_line import python
from planted import homing_policy
from trapped_plants import CALM, MJCF, TASK, VELOCITY, dial, task_of, vehicle

import hyrl_mj
from hyrl_mj import BadInput, HybridController, Noise, from_callable, get_task, simulate
from hyrl_mj.judging.game import Game
from hyrl_mj.physics import mjcf
from hyrl_mj.physics.plant import Plant
from hyrl_mj.policies import PolicyController
from hyrl_mj.policies.external import read_agent
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import Recorded, Signal, judge_task, noise as noises, register_noise
from hyrl_mj.simulation.real import fresh_model
from hyrl_mj.tasks import Outcome, check_as_made, check_task, checks, described_task, trial

XML, PY, *_ = vehicle()
NAMES = iter(range(1_000))
CRASH = "<= 0.6]"
# A robot that is the same at each physics step, whose inner loop the task gives.
DRIVEN = VELOCITY.format(name="ahead", joint="x", kv=1e7, more="") + VELOCITY.format(
    name="side", joint="y", kv=1e7, more=""
)


def write(folder, py=None, actuators="", text=lambda xml: xml, top=""):
    """The files of a vehicle that passes a pillar, with some parts of its own; returns its path."""
    name = f"truer_{next(NAMES)}"
    held = VELOCITY.format(name="ahead", joint="x", kv=1e9, more="")
    steered = VELOCITY.format(name="u", joint="y", kv=1e9, more='ctrlrange="-1 1"')
    sensors = '<jointpos joint="x"/><jointpos joint="y"/>'
    xml = MJCF.format(name=name, actuators=actuators or held + steered, sensors=sensors, **XML)
    (folder / f"{name}.xml").write_text(text(xml))
    path = folder / f"{name}.py"
    path.write_text(top + TASK.format(name=name, **(PY | (py or {}))))
    return path


class Steer:
    """Past the pillar on the side where the robot is."""

    def act(self, measured):
        y = measured[:, 1]
        return np.where(np.abs(y) >= 0.95, 0.0, np.where(y >= 0, 1.0, -1.0))[:, None]


# ---- what runs and processes find a task by


@pytest.fixture
def wide(tmp_path):
    """A task whose pillar is as wide as the object that is made says."""
    ending = PY["ending"].replace(CRASH, "<= self.radius]")
    own = "    def __init__(self, radius=0.6):\n        self.radius = radius\n"
    return get_task(write(tmp_path, {"ending": ending, "methods": own}))


def test_an_object_that_no_run_leads_to_is_refused(wide, tmp_path):
    other, closer, noisy = type(wide)(0.9), copy.deepcopy(wide), wide.with_noise((1.0, 1.0))
    closer.close = 0.9
    assert wide.close == 0.3
    for task, name in ((other, "radius = 0.9"), (closer, "close = 0.9"), (noisy, "noisy = ")):
        with pytest.raises(BadInput, match=f"has {name}.*runs find it by"):
            hyrl_mj.run(task, preset="smoke", out=tmp_path / "run")
    assert pickle.loads(pickle.dumps(other)).radius == 0.9
    assert pickle.loads(pickle.dumps(closer)).close == 0.9
    assert pickle.loads(pickle.dumps(noisy)).noisy == (1.0, 1.0)
    assert pickle.loads(pickle.dumps(wide)).radius == 0.6
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "value"), [("max_steps", 30), ("noisy", (1, 1)), ("close", 0.9)])
def test_a_class_that_was_changed_after_its_file_was_executed_is_refused(
    name, value, tmp_path, monkeypatch
):
    path = write(tmp_path)
    kind, other = type(get_task(path)), imported(write(tmp_path), monkeypatch).Robot
    for changed in (kind, other):
        setattr(changed, name, value)
    for task in (path, kind(), other()):
        with pytest.raises(BadInput, match=rf"{name} is .* executed once more, .* in the file"):
            hyrl_mj.run(task, preset="smoke", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_module_beside_a_task_that_was_changed_in_memory_is_refused(tmp_path):
    (tmp_path / "poles.py").write_text("RADIUS = 0.6\n")
    ending = PY["ending"].replace(CRASH, "<= poles.RADIUS]")
    task = get_task(write(tmp_path, {"ending": ending}, top="import poles\n"))
    assert check_task(task) is task
    sys.modules["poles"].RADIUS = 0.7
    with pytest.raises(BadInput, match=r"ending\(\) gives .* executed once more"):
        check_task(task)
    assert sys.modules["poles"].RADIUS == 0.7


def test_an_attribute_that_nothing_uses_is_taken_if_no_other_one_may_be_meant(tmp_path):
    code = "    starting = 0.1\n    def stated(self):\n        return self.stated\n"
    check_task(get_task(write(tmp_path, {"methods": code})))


def test_a_task_file_is_read_as_it_is_now(tmp_path):
    path = write(tmp_path)
    first = get_task(path)
    text = path.read_text()
    path.write_text(text.replace(CRASH, "<= 0.9]"))
    second, beside = get_task(path), np.array([[1.5, 0.8]])
    assert [Outcome(t.ending(beside)[0]).label for t in (first, second)] == ["running", "crashed"]
    assert first.code != second.code
    with pytest.raises(BadInput, match="of code that has been defined anew"):
        hyrl_mj.run(first, preset="smoke", out=tmp_path / "run")
    path.write_text(text)
    assert type(described_task(str(path))) is type(first)


def test_a_model_is_compiled_as_its_files_are_now(tmp_path):
    part = tmp_path / "pillar.xml"
    part.write_text('<mujoco><worldbody><geom name="mark" size="0.1"/></worldbody></mujoco>')
    include = '<include file="pillar.xml"/>\n</mujoco>'
    path = write(tmp_path, text=lambda xml: xml.replace("</mujoco>", include))
    first = get_task(path)
    assert first.model.geom("mark").size[0] == 0.1
    part.write_text(part.read_text().replace("0.1", "0.2"))
    with pytest.raises(BadInput, match="has changed since"):
        fresh_model(first)
    second = get_task(path)
    assert second.model.geom("mark").size[0] == 0.2
    assert first.code != second.code


def test_a_height_field_is_a_part_of_its_model(tmp_path):
    """MuJoCo tells its name without the folder in which it looks for it."""
    path, field = tmp_path / "model.xml", tmp_path / "meshes" / "hills.bin"
    field.parent.mkdir()
    asset = '<asset><hfield name="hills" file="hills.bin" size="1 1 1 1"/></asset>'
    path.write_text(f'<mujoco><compiler meshdir="meshes"/>{asset}</mujoco>')
    seen = []
    for height in (0.2, 0.7):
        size, heights = np.array([2, 2], dtype=np.int32), np.array([0, 0, height, 1], np.float32)
        field.write_bytes(size.tobytes() + heights.tobytes())
        assert mjcf.load(path).nhfield == 1
        seen.append(mjcf.file_digest(path))
    assert seen[0] != seen[1]


def test_what_lies_beside_a_task_is_part_of_it(tmp_path):
    tasks = []
    for radius in (0.6, 0.9):
        folder = tmp_path / str(radius)
        folder.mkdir()
        (folder / "pillars.py").write_text(f"RADIUS = {radius}\n")
        ending = PY["ending"].replace(CRASH, "<= RADIUS]")
        tasks.append(write(folder, {"ending": ending}, top="from pillars import RADIUS\n"))
    first = get_task(tasks[0])
    with pytest.raises(BadInput, match=r"another module of that name, .*pillars.py: rename"):
        get_task(tasks[1])
    (tasks[0].parent / "pillars.py").write_text("RADIUS = 0.9\n")
    again = get_task(tasks[0])
    assert first.code != again.code
    assert again.ending(np.array([[1.5, 0.8]]))[0] == Outcome.CRASHED


def test_a_missing_task_file_is_said_to_be_missing(tmp_path):
    with pytest.raises(BadInput, match=r"there is no task file .*: if it lies elsewhere, .*--task"):
        described_task(str(tmp_path / "gone.py"))


def imported(path, monkeypatch):
    """The class of a task file that is imported as a module, as users do, and registers it."""
    monkeypatch.syspath_prepend(str(path.parent))
    text = path.read_text().replace("\nclass Robot", "\n@hyrl_mj.register\nclass Robot")
    path.write_text(f"COUNT = []\n{text}")
    return importlib.import_module(path.stem)


def test_a_class_that_is_imported_is_what_a_run_finds(tmp_path, monkeypatch):
    module = imported(write(tmp_path), monkeypatch)
    check_as_made(module.Robot())
    path = tmp_path / f"{module.__name__}.py"
    check_as_made(get_task(path))
    check_as_made(module.Robot())  # of the same code
    path.write_text(path.read_text() + "# changed\n")
    with pytest.raises(BadInput, match="of code that has been defined anew"):
        check_as_made(module.Robot())


def test_what_cannot_be_compared_does_not_matter(tmp_path):
    own = (
        "    def __init__(self):\n"
        "        self.tree = cKDTree(np.eye(3))\n        self.rows = [[1, 2], [3]]\n"
        "        self.table = {'a': np.arange(3)}\n        self.rule = lambda z: z\n"
        "        self._kept = None\n"
    )
    task = get_task(write(tmp_path, {"methods": own}, top="from scipy.spatial import cKDTree\n"))
    task._kept = 3
    check_as_made(task)
    assert pickle.loads(pickle.dumps(task)).rows == [[1, 2], [3]]
    task.rows[1].append(4)
    with pytest.raises(BadInput, match="has rows = "):
        check_as_made(task)


def test_copies_of_a_task_keep_what_they_are_given(tmp_path):
    task = get_task(write(tmp_path))
    for one in (copy.copy(task), copy.deepcopy(task)):
        one.side = 1
        assert pickle.loads(pickle.dumps(one)).side == 1
    assert not hasattr(task, "side")


def test_a_package_beside_a_task_is_read_as_it_is_now(tmp_path):
    package = tmp_path / "pillars_of"
    (package / "logging").mkdir(parents=True)
    (package / "__init__.py").write_text("from .sizes import RADIUS\n")
    (package / "logging" / "__init__.py").write_text("")
    (package / "sizes.py").write_text("from . import logging\nRADIUS = 0.6\n")
    ending = PY["ending"].replace(CRASH, "<= RADIUS]")
    path = write(tmp_path, {"ending": ending}, top="from pillars_of import RADIUS\n")
    first, beside = get_task(path), np.array([[1.5, 0.8]])
    (package / "sizes.py").write_text("RADIUS = 0.95\n")
    second = get_task(path)
    assert [t.ending(beside)[0] == Outcome.CRASHED for t in (first, second)] == [False, True]
    assert first.code != second.code


def test_a_model_of_another_file_is_judged_by_that(tmp_path):
    other = write(tmp_path)
    own = "    @property\n    def model(self):\n        return hyrl_mj.mjcf.load(MODEL)\n"
    top = f"from pathlib import Path\nMODEL = Path({str(other.with_suffix('.xml'))!r})\n"
    path = write(tmp_path, {"methods": own}, top=top)
    path.with_suffix(".xml").unlink()
    assert simulate(get_task(path), Steer(), [0.0, 0.5]).outcome == "reached"


def test_a_model_that_no_file_holds_is_no_robot_of_a_run(tmp_path):
    path = write(tmp_path)
    xml = path.with_suffix(".xml")
    own = f"    model = mujoco.MjModel.from_xml_string({xml.read_text()!r})\n"
    path.write_text("import mujoco\n" + path.read_text() + own)
    xml.unlink()
    with pytest.raises(BadInput, match=r"there is no .*\.xml, by which a run knows its robot"):
        check_task(get_task(path))


@pytest.mark.slow
def test_the_digest_of_a_task_is_the_same_in_each_process(tmp_path):
    names = [f"part_{i}" for i in range(8)]
    for name in names:
        (tmp_path / f"{name}.py").write_text(f"VALUE = {name!r}\n")
    path = tmp_path / "whole.py"
    path.write_text("".join(f"import {name}\n" for name in names))
    code = (
        "from pathlib import Path; from hyrl_mj.files.sources import digest_of; "
        f"print(digest_of(Path({str(path)!r})))"
    )
    told = [python(code, env=os.environ | {"PYTHONHASHSEED": seed}).stdout for seed in "12"]
    assert told[0] == told[1] > ""


# ---- what simulations go on with


@pytest.mark.parametrize(
    "own",
    [
        {"ending": "measured[:, 1] = np.abs(measured[:, 1])\n        " + PY["ending"]},
        {"observation": "measured *= 0.5\n        return measured"},
        {
            "methods": "    def measure(self, sensors):\n"
            "        sensors[:, 1] %= 1.0\n        return sensors\n"
        },
    ],
    ids=["ending", "observation", "measure"],
)
def test_a_method_that_writes_to_what_it_is_given_is_refused(own, tmp_path):
    task = get_task(write(tmp_path, own))
    with pytest.raises(BadInput, match=r"writes to an array that is read-only, line \d+.*a copy"):
        check_task(task)
    with pytest.raises(BadInput, match="writes to an array"):
        simulate(task, from_callable(lambda seen: np.full(len(seen), 2), task), [0.0, 0.5])


def test_an_inner_loop_gets_its_inputs_at_each_step(tmp_path):
    own = (
        "    def control(self, u, qpos, qvel):\n        u *= 0.5\n"
        "        return np.hstack([np.ones((len(u), 1)), u])\n"
    )

    def text(xml):
        numeric = '<numeric name="side" data="-1 1"/></custom>'
        return xml.replace("</custom>", numeric).replace('timestep="0.05"', 'timestep="0.01"')

    path = write(tmp_path, {"methods": own}, DRIVEN, text)
    path.write_text(path.read_text().replace('inputs = ("u",)', 'inputs = ("side",)'))
    with pytest.raises(BadInput, match=r"control\(\) .* writes to an array"):
        simulate(get_task(path), Steer(), [0.0, 0.5])
    path.write_text(path.read_text().replace("u *= 0.5", "u = u - u.mean(axis=0)"))
    with pytest.raises(BadInput, match=r"control\(\) gives .* for the same row"):
        trial.try_methods(get_task(path))


def test_an_input_may_act_only_where_another_one_does(tmp_path):
    own = (
        "    def control(self, u, qpos, qvel):\n        speed, turn = u.T\n"
        "        return np.column_stack([speed, speed * turn])\n"
    )
    numerics = "".join(f'<numeric name="{name}" data="-1 1"/>' for name in ("speed", "turn"))
    path = write(
        tmp_path,
        {"methods": own},
        DRIVEN,
        lambda xml: xml.replace("</custom>", numerics + "</custom>"),
    )
    path.write_text(path.read_text().replace('inputs = ("u",)', 'inputs = ("speed", "turn")'))
    trial.try_inputs(get_task(path))  # a car that stands does not turn


def test_runs_of_a_user_s_robot_are_played_again_where_they_are_simulated(tmp_path):
    own = (
        "    def state(self, z, rng=None):\n"
        "        return z, 0.1 * np.random.standard_normal(z.shape)\n"
    )
    soft = VELOCITY.format(name="ahead", joint="x", kv=20, more="") + VELOCITY.format(
        name="u", joint="y", kv=5, more='ctrlrange="-1 1"'
    )
    task = get_task(write(tmp_path, {"methods": own}, soft))
    with pytest.raises(BadInput, match="is not simulated as MuJoCo alone simulates it"):
        simulate(task, Steer(), [0.0, 0.5])


@pytest.mark.parametrize(("key", "speed"), [('ctrl="3 0"', 0.5), ('ctrl="0.25 0"', 0.25)])
def test_a_held_control_is_clamped_as_mujoco_does(key, speed, tmp_path):
    held = VELOCITY.format(name="ahead", joint="x", kv=1e9, more='ctrlrange="-0.5 0.5"')
    steered = VELOCITY.format(name="u", joint="y", kv=1e9, more='ctrlrange="-1 1"')
    path = write(tmp_path, None, held + steered, lambda xml: xml.replace('ctrl="1 0"', key))
    task = get_task(path)
    judge_task(task)
    plant = task.plant(1)
    plant.set_state(np.zeros((1, 2)))
    plant.step(np.zeros((1, 1)))
    assert plant.qpos[0, 0] == pytest.approx(0.05 * speed)


@pytest.mark.parametrize("clamps", [True, False])
def test_controls_are_clamped_where_mujoco_does(clamps, tmp_path):
    """Also one that is held at 0 without a keyframe, and those of an inner loop."""
    flag = "" if clamps else '<flag clampctrl="disable"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="0 0 0">{flag}</option><custom><numeric name="v" data="-9 9"/></custom>'
        '<worldbody><body><joint name="x" type="slide"/><geom size="1"/></body></worldbody>'
        '<actuator><velocity name="v" joint="x" kv="9e3" ctrlrange="0.5 2"/><motor name="u" joint="x" '
        'ctrlrange="-1 1"/></actuator><sensor><jointpos joint="x"/></sensor></mujoco>'
    )

    def control(u, qpos, qvel):
        return np.hstack([u, 0 * u])

    for inputs, loop, u in ((("u",), None, 0.0), (("v",), control, 9.0)):
        plant, data = Plant(model, inputs, 1, control=loop), mujoco.MjData(model)
        data.ctrl[0] = u
        for _ in range(5):
            plant.step(np.array([[u]]))
            mujoco.mj_step(model, data)
        np.testing.assert_array_equal(plant.qpos[0], data.qpos)


def test_the_activation_of_the_keyframe_holds(tmp_path):
    held = '<intvelocity name="ahead" joint="x" kp="200" kv="20" actrange="-9 9"/>'
    steered = VELOCITY.format(name="u", joint="y", kv=1e9, more='ctrlrange="-1 1"')
    path = write(
        tmp_path, None, held + steered, lambda xml: xml.replace('ctrl="1 0"', 'ctrl="0 0" act="1"')
    )
    task = get_task(path)
    judge_task(task)
    plant = task.plant(1)
    plant.set_state(np.zeros((1, 2)))
    for _ in range(40):
        plant.step(np.zeros((1, 1)))
    assert plant.qpos[0, 0] > 0.5


def test_the_time_begins_as_in_the_keyframe(tmp_path):
    def text(xml):
        return xml.replace("</sensor>", "<clock/></sensor>").replace("<key ", '<key time="2" ')

    ends = "ends = np.where(measured[:, 0] >= 3, Outcome.REACHED, 0)"
    own = {"noisy": "(False, True, False)", "ending": ends, "observation": "return measured[:, :2]"}
    task = get_task(write(tmp_path, own, text=text))
    assert judge_task(task) == 50
    plant = task.placed(np.zeros((1, 2)))
    plant.step(np.zeros((1, 1)))
    np.testing.assert_allclose(plant.measurement[0, 2], 2 + task.dt)


def test_sleeping_models_are_refused_with_a_sentence(tmp_path):
    sleeps = CALM.replace("/>", ' sleep="enable"/>')
    task = get_task(write(tmp_path, text=lambda xml: xml.replace(CALM, sleeps)))
    with pytest.raises(BadInput, match="lets bodies sleep"):
        task.plant(2)


# ---- noise


@pytest.fixture
def kinds(monkeypatch):
    """The kinds of noise, of which those of a test are forgotten after it."""
    monkeypatch.setattr(noises, "_KINDS", dict(noises._KINDS))


def registered(sample, **own):
    """A kind of noise whose method `sample` is given."""
    own |= {"kind": "own", "sample": sample}
    register_noise(type("Own", (Signal,), own))
    return Noise("own", 0.1)


def saw(self, now):
    k = now.k
    k %= 4
    return ((k - 1.5) / 1.5 * self.bound)[:, None] * self.shares


def looks_ahead(self, now):
    now.plant.step(np.ones((1, 1)))
    return np.zeros_like(now.measurement)


def unseeded(self, now):
    return np.random.default_rng().uniform(-0.1, 0.1, now.measurement.shape) * self.shares


def counting(self, now):
    type(self).count += 1
    return np.full(now.measurement.shape, (-0.1) ** (type(self).count % 2 + 1)) * self.shares


@pytest.mark.parametrize(
    ("sample", "message"),
    [
        (saw, "writes to an array that it is shown"),
        (looks_ahead, r"noise calls step\(\) of the plant that is simulated"),
        (unseeded, "gives other values where it begins anew with the same seed"),
        (counting, "gives other values where it begins anew"),
    ],
)
def test_noise_that_its_seed_does_not_decide_is_refused(sample, message, vehicle, kinds):
    noise = registered(sample, count=0)
    with pytest.raises(BadInput, match=message):
        simulate(vehicle, Steer(), [0.0, 0.5], noise)


class Filter:
    """A filter that noise of a user's has."""

    def begin(self, n):
        self.value = np.zeros((n, 2))


class Coloured(Signal):
    kind = "coloured"

    def __init__(self, bound, shares):
        super().__init__(bound, shares)
        self.filter = Filter()

    def reset(self, n, rng):
        super().reset(n, rng)
        self.filter.begin(n)

    def sample(self, now):
        white = self.rng.uniform(-self.bound, self.bound, now.measurement.shape)
        self.filter.value = 0.5 * self.filter.value + 0.5 * white
        return self.filter.value * self.shares


def late(self, now):
    if (now.k > 20).any():
        np.random.random()
    return np.zeros_like(now.measurement)


def test_noise_with_a_memory_of_its_own_is_taken(vehicle, kinds):
    noise = Coloured(0.1, np.array([0.0, 1.0]))
    one, other = (simulate(vehicle, Steer(), [0.0, 0.5], noise, seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.measured, other.measured)
    with pytest.raises(BadInput, match="draws from a global generator"):
        simulate(vehicle, Steer(), [0.0, 0.5], registered(late))


def test_single_precision_reaches_the_bound_and_not_beyond_it(vehicle, kinds):
    noise = registered(lambda self, now: np.tile(np.float32([0.0, 0.1]), (len(now.k), 1)))
    arc = simulate(vehicle, Steer(), [0.0, 0.5], noise)
    assert np.abs(arc.measured[:-1, 1] - arc.z[:-1, 1]).max() <= 0.1 + 1e-15
    assert Recorded(np.full((3, 1, 2), 0.1, dtype=np.float32), 0.1).values.max() == 0.1


# ---- sets, functions and their users' mistakes


@pytest.mark.parametrize(
    ("distance", "message"),
    [
        (lambda z: np.sqrt(1 - z[:, 0]), "is nan at x = 1.5 m"),
        (lambda z: z[:, :1], r"of float64 and shape \(2, 1\)"),
        (lambda z: z[:, 0] < 0, "of bool"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_sets_of_users_give_a_number_for_each_point(distance, message, vehicle):
    own = type("Own", (), {"signed_distance": lambda self, z: distance(z)})()
    whole = type("All", (), {"signed_distance": lambda self, z: np.full(len(z), -1.0)})()
    controller = HybridController(vehicle, {0: Steer(), 1: Steer()}, {0: own, 1: whole})
    with pytest.raises(BadInput, match=message):
        controller.initial_mode(np.array([[1.5, -0.9], [1.5, 0.3]]))


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_mode_does_not_stay_where_its_set_is_no_number(vehicle):
    own = type("Own", (), {"signed_distance": lambda self, z: np.sqrt(1 - z[:, 0]) - 9})()
    whole = type("All", (), {"signed_distance": lambda self, z: np.full(len(z), -1.0)})()
    controller = HybridController(vehicle, {0: Steer(), 1: Steer()}, {0: own, 1: whole})
    with pytest.raises(BadInput, match="is nan at"):
        controller.step(np.zeros(1, dtype=int), np.array([[1.5, -0.9]]))


@pytest.mark.slow
def test_functions_that_differ_away_from_the_starts_are_told_apart(vehicle):
    def near(seen):
        return np.full(len(seen), 2)

    def far(seen):
        return np.where(seen[:, 1] < 1.0, 4, 2)  # close to the set-point

    hashes = {read_agent(vehicle, function).agent.sha256 for function in (near, far)}
    assert len(hashes) == 2


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda seen: (np.zeros((len(seen), 1)), None), "returns a tuple, as the predict"),
        (lambda seen: np.zeros((len(seen), 1), dtype=complex), "an input is a number"),
    ],
)
def test_functions_that_give_something_else_are_told_what(answer, message, circle):
    with pytest.raises(BadInput, match=message):
        simulate(circle, from_callable(answer, "unit_circle"), [3.0])


def test_what_closes_no_loop_is_refused(vehicle):
    with pytest.raises(BadInput, match=r"can close no loop.*from_callable"):
        simulate(vehicle, lambda measured: measured, [0.0, 0.5])
    flat = type("Flat", (), {"act": lambda self, measured: np.zeros(len(measured))})()
    with pytest.raises(BadInput, match=r"inputs of shape \(2,\) for 2 measurements: give \(2, 1\)"):
        simulate("vehicle", flat, [[0.0, 0.5], [0.0, 0.4]])


# ---- what a chart in another order, a seam, a start between nodes and a memory of actuators change


FLIPPED = """    def z(self, measured):
        return measured[:, ::-1]
    def with_z(self, measured, z):
        return z[:, ::-1]
"""


def test_a_chart_in_another_order_than_the_measurement(tmp_path):
    task = get_task(write(tmp_path, {"methods": FLIPPED}))
    z = np.array([[1.0, 0.5]])
    np.testing.assert_array_equal(task.at(z), [[0.5, 1.0]])


def test_a_share_of_noise_that_another_column_has(tmp_path):
    task = get_task(write(tmp_path, {"methods": FLIPPED}))
    task.noisy = (0.5, 1.0)  # of a measurement that begins with y
    measured = task.with_z(np.zeros((9, 2)), task.starts(9, np.random.default_rng(0)))
    with pytest.raises(BadInput, match=r"x by 1, and its share in noisy is 0\.5"):
        checks._check_noise_of_chart(task, measured)
    task.noisy = (1.0, 1.0)
    checks._check_noise_of_chart(task, measured)


def test_a_box_of_starts_across_the_seam(circle):
    task = copy.copy(circle)
    task.start_low, task.start_high = (2.8,), (3.5,)
    inside = task.may_start(np.array([[2.8], [3.37], [3.37 - 2 * np.pi], [2.7], [-2.7], [0.0]]))
    np.testing.assert_array_equal(inside, [True, True, True, False, False, False])


def test_a_start_between_two_nodes_counts(circle):
    task = copy.copy(circle)
    task.start_low = task.start_high = (3.0,)
    task.starts = lambda n, rng: np.full((n, 1), 3.0)
    grid = Grid(task.chart, (720,))
    assert not task.may_start(grid.nodes).any()
    sets = [GridSet(grid, side * grid.nodes[:, :1].sum(axis=1)) for side in (1, -1)]
    game = Game(task, sets, {"policy": PolicyController(homing_policy(task))}, 0.05, grid=grid)
    assert game.starts.sum() == 1
    assert game.score("policy", 0.05).winnable == 1


def test_who_looks_ahead_does_so_from_the_whole_state(tmp_path):
    lagging = (
        '<general name="u" joint="y" dyntype="filterexact" dynprm="0.3" gainprm="1e9" biastype="affine" '
        'biasprm="0 0 -1e9" ctrlrange="-1 1"/>'
    )
    ahead = VELOCITY.format(name="ahead", joint="x", kv=1e9, more="")
    task = get_task(write(tmp_path, actuators=ahead + lagging))
    plant, copies = task.plant(1), task.plant(2)
    plant.set_state(*task.state(np.array([[0.0, 0.3]])))
    for _ in range(5):
        plant.step(np.array([[1.0]]))
    copies.resume(plant.state, np.array([1]))
    for robots, ids in ((plant, [0]), (copies, [1])):
        robots.step(np.array([[0.0]]), np.array(ids))
    np.testing.assert_array_equal(plant.measurement[0], copies.measurement[1])
    assert abs(plant.qvel[0, 1]) > 0.1, "the filter has not forgotten the inputs before"


def test_a_point_off_the_robot_is_no_place_of_it(tmp_path):
    other = '<body pos="5 5 0"><joint type="slide"/><geom size="0.1"/></body></worldbody>'
    own = "    def state(self, z, rng=None):\n        return np.hstack([z, 0 * z[:, :1]]), None\n"

    def text(xml):  # another robot is far away
        xml = xml.replace("<body", '<body pos="0.9 0 0"', 1).replace("</worldbody>", other)
        return xml.replace('qpos="0 0"', 'qpos="0 0 0"')

    moved = get_task(write(tmp_path, {"methods": own}, text=text))
    with pytest.raises(BadInput, match="these are not the place of tracked"):
        trial.try_place(moved)


def test_a_plane_is_passed_on_no_side(tmp_path):
    plane = '<worldbody><geom name="obstacle_floor" type="plane" size="9 9 1" contype="0" conaffinity="0"/>'
    task = get_task(write(tmp_path, text=lambda xml: xml.replace("<worldbody>", plane)))
    assert "floor" not in task.obstacles


def test_an_input_drives_its_own_actuator_after_one_of_two_controls(tmp_path):
    pid = '<pid name="ahead" joint="x" kp="1" kv="1e9" input="pos vel" posrange="-9 9" velrange="-2 2"/>'
    steered = VELOCITY.format(name="u", joint="y", kv=1e9, more='ctrlrange="-1 1"')

    def text(xml):
        return xml.replace('ctrl="1 0"', 'ctrl="0 1 0"')

    task = get_task(write(tmp_path, actuators=pid + steered, text=text))
    judge_task(task)
    plant, data = task.plant(1), mujoco.MjData(task.model)
    plant.step(np.array([[0.5]]))
    data.ctrl[:] = 0, 1, 0.5
    mujoco.mj_step(task.model, data)
    np.testing.assert_array_equal(plant.qpos[0], data.qpos)
    assert data.qpos[1] > 0.02
    assert mjcf.names(task.model, mujoco.mjtObj.mjOBJ_ACTUATOR) == ["ahead", "u"]
    with pytest.raises(BadInput, match=r"actuator ahead of .* has 2 controls"):
        Plant(task.model, ("ahead",), 1)


def test_an_obstacle_on_a_body_that_stands_still_is_where_it_is_in_the_world(tmp_path):
    def text(xml):
        nested = '<body pos="1 0.3 0" euler="0 0 90"><geom name="obstacle" size="1" pos="-.3 -.5 0"/></body>'
        return xml.replace("obstacle", "other").replace("<worldbody>", "<worldbody>" + nested)

    model = get_task(write(tmp_path, text=text)).model
    np.testing.assert_allclose(mjcf.geom_pos(model, "obstacle"), [1.5, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(mjcf.site_pos(model, "tracked"), np.zeros(3))  # on the robot


# What is measured beside x and y is a height, which is 0 wherever a robot is put on its chart.
LIFTED = {
    "noisy": "(False, True, False)",
    "ending": "x, y, h = measured.T\n        ends = np.where((x >= 3) & (h > 1), Outcome.REACHED, 0)",
}
HEIGHT = (
    "    def measure(self, sensors):\n        return np.hstack([sensors, 0 * sensors[:, :1]])\n"
)


@pytest.mark.parametrize(
    ("own", "height", "outcome"),
    [
        ({}, "", "stalled"),
        (
            {"ending": "ends = np.where(measured[:, 0] > 5.0, int(Outcome.REACHED), 0)"},
            "",
            "stalled",
        ),
        ({"ending": "ends = np.zeros(len(measured), int)"}, "", "reached"),
        (LIFTED, HEIGHT, "stalled"),
    ],
)
def test_who_is_still_under_way_has_not_arrived_where_the_end_says_who_has(
    own, height, outcome, tmp_path
):
    miss = "    def miss(self, z):\n        return np.abs(z[:, 1])\n"
    task = get_task(write(tmp_path, own | {"max_steps": "10", "methods": miss + height}))
    assert task.ends_well == (outcome == "stalled")
    assert (
        Outcome(task.verdict(task.placed(np.array([[0.6, 0.1]])).measurement)[0]).label == outcome
    )


@pytest.mark.parametrize(
    ("robot", "chart"),
    [
        (vehicle(), '("x", "y"), ("m", "m"), (0.0, -1.5), (3.0, 1.5), (False, True)'),
        (dial(), '("theta",), ("rad",), (0.0,), (np.pi,), (True,)'),
        (dial(), '("theta",), ("deg",), (0.0,), (360.0,), (True,)'),
        (dial(), '("theta",), ("deg",), (0.0,), (2 * np.pi,), (True,)'),
    ],
)
def test_a_period_that_is_no_whole_turn_is_refused(robot, chart, tmp_path):
    task = task_of(robot._replace(py=robot.py | {"chart": chart}), tmp_path)
    with pytest.raises(
        BadInput,
        match=r"comes back after .*(the robot is elsewhere|360 in degrees and 2 pi in rad)",
    ):
        checks._check_turns(task, task.chart.draw(9, np.random.default_rng(0)))
