"""The plants are the paper's equations, and never take what they cannot digest."""

import copy
import os
import pickle
import re
import signal

import mujoco
import numpy as np
import pytest
from planted import euler, random_states

from hyrl_mj.errors import BadInput
from hyrl_mj.physics import mjcf
from hyrl_mj.physics.plant import Plant
from hyrl_mj.tasks import get_task
from hyrl_mj.tasks.vehicle import Vehicle

PAIRS = 2_000


def test_one_sample_is_the_papers_equation_and_a_step_backward_inverts_it(task):
    rng = np.random.default_rng(1)
    z, u = random_states(task, PAIRS, rng), task.draw_inputs(PAIRS, rng)
    plant = task.plant(PAIRS)
    plant.set_state(task.state(z)[0])
    plant.step(u)
    np.testing.assert_allclose(task.z(plant.measurement), euler(task, z, u), rtol=0, atol=1e-6)
    plant.step_backward(u)
    np.testing.assert_allclose(task.z(plant.measurement), z, rtol=0, atol=1e-6)


PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.01"/>
  <custom><numeric name="sample_time" data="0.02"/></custom>
  <worldbody>
    <body name="ball">
      <freejoint name="free"/>
      <geom size="0.1" mass="1"/>
      <site name="middle"/>
      <site name="turned" euler="10 0 0"/>
      <body name="rod" pos="0.3 0 0">
        <joint name="hinge" axis="0 1 0"/>
        <geom name="bob" size="0.05" pos="0.3 0 0" mass="0.2"/>
        <site name="tip" pos="0.3 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="hinge" ctrlrange="-1 1"/></actuator>
  <sensor>SENSORS</sensor>
</mujoco>
"""


@pytest.mark.parametrize(
    ("sensors", "read_from_the_state"),
    [
        ('<jointpos joint="hinge"/><jointvel joint="hinge"/>', True),
        ('<jointvel joint="hinge"/>', True),
        ('<jointpos joint="hinge" cutoff="0.01"/>', False),
        ('<framequat objtype="xbody" objname="ball"/><jointpos joint="hinge"/>', True),
        ('<framepos objtype="site" objname="middle"/><gyro site="middle"/>', True),
        ('<framelinvel objtype="xbody" objname="ball"/>', True),
        ('<framelinvel objtype="body" objname="ball"/>', False),
        ('<framepos objtype="xbody" objname="rod"/>', False),
        ('<framepos objtype="xbody" objname="ball" reftype="site" refname="tip"/>', False),
        ('<framexaxis objtype="xbody" objname="ball"/>', False),
        ('<gyro site="turned"/>', False),
        ('<jointpos joint="hinge"/><framepos objtype="site" objname="tip"/>', False),
        ('<framelinvel objtype="site" objname="tip"/><jointvel joint="hinge"/>', False),
        ('<accelerometer site="tip"/>', False),
    ],
)
def test_the_measurement_is_what_the_sensors_give_now(sensors, read_from_the_state):
    model = mujoco.MjModel.from_xml_string(PENDULUM.replace("SENSORS", sensors))
    assert (mjcf.state_columns(model) is not None) == read_from_the_state
    plant, data = Plant(model, ("push",), 3), mujoco.MjData(model)
    # A quaternion may have any length.
    qpos = np.outer([1, 2, 1], [0, 0, 0, 0.8, 0, 0.6, 0, 0.4])
    plant.set_state(qpos, np.random.default_rng(0).normal(size=(3, 7)))
    rows = np.array([0, 2])
    for u in (None, 0.3, -0.7):
        if u is not None:
            plant.step(np.full((2, 1), u), rows)
        for state, measured in zip(plant.state, plant.measurement, strict=True):
            mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_forward(model, data)
            np.testing.assert_allclose(measured, data.sensordata, rtol=0, atol=1e-12)


def test_only_the_addressed_copies_move(vehicle):
    plant = vehicle.plant(4)
    plant.set_state(np.zeros((4, 2)))
    plant.step(np.array([[1.0], [-1.0]]), np.array([1, 3]))
    expected = [[0, 0], [0.05, 0.05], [0, 0], [0.05, -0.05]]
    np.testing.assert_allclose(plant.qpos, expected, atol=1e-9)
    np.testing.assert_array_equal(plant.measurement, plant.qpos)


def test_set_state_forgets_the_last_input_and_keeps_the_speed(vehicle):
    plant = vehicle.plant(1)
    plant.set_state(np.zeros((1, 2)))
    plant.step(np.array([[1.0]]))
    plant.set_state(np.zeros((1, 2)))
    np.testing.assert_array_equal(plant.measurement, [[0.0, 0.0]])
    plant.step(np.array([[0.0]]))
    np.testing.assert_allclose(plant.measurement, [[0.05, 0.0]], atol=1e-9)


# ---- bad input


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1.5])
def test_a_bad_input_names_its_simulation_and_changes_nothing(vehicle, value):
    plant = vehicle.plant(5)
    plant.set_state(np.zeros((5, 2)))
    before, u = plant.state, np.zeros((5, 1))
    u[2] = value
    for inputs, ids, number in ((u, None, 2), (u[1:3], np.array([1, 4]), 4)):
        with pytest.raises(
            BadInput, match=rf"simulation {number}.*{value:g}|{value:g}.*simulation"
        ):
            plant.step(inputs, *([] if ids is None else [ids]))
        np.testing.assert_array_equal(plant.state, before)


@pytest.mark.parametrize("shape", [(3,), (3, 2), (2, 1)])
def test_an_input_of_the_wrong_shape_says_the_right_one(vehicle, shape):
    plant = vehicle.plant(3)
    before = plant.state
    with pytest.raises(BadInput, match=r"\(3, 1\)"):
        plant.step(np.zeros(shape))
    np.testing.assert_array_equal(plant.state, before)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_bad_state_names_its_simulation_and_changes_nothing(vehicle, value):
    task = vehicle
    plant = task.plant(3)
    plant.set_state(task.state(np.array(task.scene.starts[:3]))[0])
    before, qpos = plant.state, plant.qpos
    qpos[1, 0] = value
    with pytest.raises(BadInput, match=r"\[1, 0\]|simulation 1") as caught:
        plant.set_state(qpos)
    assert str(value) in str(caught.value)
    with pytest.raises(BadInput, match="qvel"):
        plant.set_state(np.ones_like(qpos), np.full_like(qpos, value))
    np.testing.assert_array_equal(plant.state, before)


def test_a_state_of_the_wrong_shape_says_the_right_one(vehicle):
    with pytest.raises(BadInput, match=r"qpos has shape \(3, 1\).*\(3, 2\)"):
        vehicle.plant(3).set_state(np.zeros((3, 1)))


def test_an_unknown_actuator_lists_the_known(vehicle):
    with pytest.raises(BadInput, match=r"'steering'.*forward_speed, lateral_velocity"):
        Plant(vehicle.model, ("steering",), 1)


def test_an_input_without_limits_is_refused(vehicle):
    with pytest.raises(BadInput, match=r"forward_speed needs a ctrlrange"):
        Plant(vehicle.model, ("forward_speed",), 1)


# ---- plants that go wrong

ROCKET = """
<mujoco model="rocket">
  <option timestep="0.05" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="x" type="slide"/>
      <geom size="0.1" mass="1" contype="0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="thrust" joint="x" gear="1e15" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <jointpos joint="x"/>
  </sensor>
</mujoco>
"""


@pytest.fixture
def rocket(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "rocket.xml"
    path.write_text(ROCKET)
    return Plant(mjcf.load(path), ("thrust",), 3)


def test_a_simulation_that_breaks_down_is_told_and_leaves_the_others_alone(rocket):
    rocket.set_state(np.array([[0.1], [0.2], [0.3]]))
    rocket.step(np.array([[0.0], [1.0], [0.0]]))
    np.testing.assert_array_equal(rocket.unstable, [False, True, False])
    np.testing.assert_array_equal(rocket.measurement, [[0.1], [0.0], [0.3]])
    rocket.step(np.zeros((2, 1)), np.array([0, 2]))
    np.testing.assert_array_equal(rocket.unstable, [False, True, False])
    rocket.set_state(np.array([[0.5]]), ids=np.array([1]))
    rocket.step(np.zeros((3, 1)))
    assert not rocket.unstable.any()
    np.testing.assert_array_equal(rocket.measurement, [[0.1], [0.5], [0.3]])


def test_a_state_that_mujoco_resets_for_its_acceleration_is_unstable(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    servo = '<velocity name="thrust" joint="x" kv="1e9" ctrlrange="-20 20"/>'
    xml = re.sub("<motor .*/>", servo, ROCKET).replace(
        "<option", '<option integrator="implicitfast"'
    )
    (tmp_path / "strong.xml").write_text(xml)
    plant = Plant(mjcf.load(tmp_path / "strong.xml"), ("thrust",), 2)
    plant.set_state(np.array([[0.1], [0.2]]))
    plant.step(np.array([[5.0], [15.0]]))
    np.testing.assert_array_equal(plant.unstable, [False, True])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "strong.xml"))
    data = mujoco.MjData(model)
    data.qpos, data.ctrl = 0.2, 15.0
    mujoco.mj_step(model, data)
    assert data.qpos == plant.qpos[1] == 0


def test_a_plant_with_inertia_cannot_run_backward(rocket):
    assert not rocket.invertible
    with pytest.raises(BadInput, match=r"rocket cannot be run backward"):
        rocket.step_backward(np.zeros((3, 1)))


def test_a_model_that_is_not_there_or_not_one(tmp_path):
    with pytest.raises(BadInput, match=r"no MJCF model at .*nothing\.xml"):
        mjcf.load(tmp_path / "nothing.xml")
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody></mujoco>")
    with pytest.raises(BadInput, match=r"cannot compile .*broken\.xml"):
        mjcf.load(tmp_path / "broken.xml")


# ---- geometry is read from the MJCF


def test_the_task_follows_the_geometry_of_its_mjcf():
    spec = mujoco.MjSpec.from_file(str(mjcf.models_dir() / "vehicle.xml"))
    spec.geom("obstacle").size[0] = 0.5
    spec.geom("obstacle").pos[:2] = 1.2, 0.1
    spec.site("arena").size[1] = 1.1
    spec.site("set_point").pos[0] = 2.5
    spec.actuator("lateral_velocity").ctrlrange = (-2.0, 2.0)
    task = Vehicle()
    task.model = spec.compile()
    np.testing.assert_allclose(task.clearance(np.array([[0.2, 0.1]])), [0.5])
    assert task.chart.low == (0.0, -1.1)
    assert task.chart.high == (3.0, 1.1)
    np.testing.assert_allclose(task.distance_to_go(np.array([[0.0, 0.0]])), [2.5])
    np.testing.assert_allclose(task.input_levels[:, 0], [-2, -1, 0, 1, 2])


# ---- copies, and forked processes


def in_its_middle(task, threads):
    """Returns a plant in the middle of its episodes, and inputs that go on."""
    rng = np.random.default_rng(0)
    plant = task.plant(5, threads)
    plant.set_state(*task.state(task.starts(5, rng), rng))
    inputs = [task.draw_inputs(5, rng) for _ in range(10)]
    for u in inputs:
        plant.step(u)
    return plant, inputs


def gone_on(plant, inputs):
    for u in inputs:
        plant.step(u)
    return plant.state


@pytest.mark.parametrize(
    ("name", "copied"),
    [("vehicle", copy.deepcopy), ("rover", lambda plant: pickle.loads(pickle.dumps(plant)))],
    ids=["copy", "pickle"],
)
def test_a_copy_goes_on_to_the_bit(name, copied):
    plant, inputs = in_its_middle(get_task(name), 2)
    twin = copied(plant)
    np.testing.assert_array_equal(twin.measurement, plant.measurement)
    before = plant.state
    after = gone_on(twin, inputs)
    np.testing.assert_array_equal(plant.state, before, "the copy has a memory of its own")
    np.testing.assert_array_equal(gone_on(plant, inputs), after)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_forked_process_goes_on_to_the_bit_and_ends(vehicle, threads):
    plant, inputs = in_its_middle(vehicle, threads)
    reader, writer = os.pipe()
    child = os.fork()
    if not child:  # a process that hangs is ended by its alarm
        signal.alarm(20)
        os.write(writer, gone_on(plant, inputs).tobytes())
        plant = None  # deletes what it may not delete
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        told = pipe.read()
    assert os.waitpid(child, 0)[1] == 0
    assert told == gone_on(plant, inputs).tobytes()


@pytest.mark.parametrize("n", [0, 1.5, True])
def test_a_number_of_copies_that_is_none_is_refused(vehicle, n):
    with pytest.raises(BadInput, match=r"the number of copies of a robot .* from 1 to"):
        vehicle.plant(n)


@pytest.mark.parametrize("timestep", ["0.03", "0.2"])
def test_a_sample_of_no_whole_number_of_steps_is_refused(timestep):
    xml = (
        f'<mujoco model="odd"><option timestep="{timestep}"/><custom><numeric name="sample_time" '
        'data="0.05"/></custom><worldbody><body><joint name="x" type="slide"/><geom size="1"/></body>'
        '</worldbody><actuator><velocity name="v" joint="x" ctrlrange="-1 1"/></actuator><sensor>'
        '<jointpos joint="x"/></sensor></mujoco>'
    )
    with pytest.raises(BadInput, match=rf"0\.05 s is no multiple of the physics step {timestep} s"):
        Plant(mujoco.MjModel.from_xml_string(xml), ("v",), 1)
