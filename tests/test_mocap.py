"""Bodies driven by mocap are where the task says: at each step, in copies of the plant, and in pictures."""

import copy
import pickle
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from gl import needs_gl
from planted import ChartPolicy

from hyrl_mj import BadInput
from hyrl_mj.physics import mjcf
from hyrl_mj.physics.plant import Plant
from hyrl_mj.physics.rendering import SceneRenderer
from hyrl_mj.policies import PolicyController
from hyrl_mj.sets import Chart
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.tasks import Outcome, Scene, Task, check_task
from hyrl_mj.tasks.vehicle import Vehicle
from hyrl_mj.viz.replay.marks import tracked_points
from hyrl_mj.viz.viewing import show

XML = """
<mujoco model="swing">
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0">
    <flag contact="disable" constraint="disable"/>
  </option>
  <custom><numeric name="sample_time" data="0.05"/></custom>
  <worldbody>
    <camera name="overhead" projection="orthographic" fovy="3" pos="1 0 4"/>
    <body name="ahead" mocap="true" pos="1 0 0.1" euler="0 0 30">
      <geom name="obstacle" type="cylinder" size="0.2 0.1" rgba="1 0 0 1"/>
    </body>
    <body name="hand" mocap="true" pos="2 0 0.1">
      <geom type="box" size="0.02 0.3 0.02"/><site name="tip" pos="0 0.3 0"/>
    </body>
    <body name="robot">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <geom size="0.05" mass="1"/><site name="tracked"/>
    </body>
    <body name="clock"><joint name="phase" axis="0 0 1" armature="1"/><geom size="0.02" mass="1"/></body>
  </worldbody>
  <actuator>
    <velocity name="ahead" joint="x" kv="1e7"/>
    <velocity name="lateral" joint="y" kv="1e7" ctrlrange="-1 1"/>
    <velocity name="turning" joint="phase" kv="1e7"/>
  </actuator>
  <sensor>
    <jointpos name="x" joint="x"/><jointpos name="y" joint="y"/><jointpos name="phase" joint="phase"/>
    SENSORS
  </sensor>
  <keyframe><key ctrl="1 0 2"/></keyframe>
</mujoco>
"""
SEEN = '<framepos objtype="body" objname="ahead"/><framepos objtype="site" objname="tip"/>'
RATE, N = 2.0, 50


class Swing(Task):
    """A point drives past a pillar that swings across, and past a hand that turns; the phase is measured.

    Args:
        sensors: further sensors; by default they measure the two bodies, too.
    """

    name, env_id = "swing", "hyrl_mj/Swing-v0"
    description = "planted"
    chart = Chart(
        ("x", "y", "phase"), ("m", "m", "rad"), (0, -1, -np.pi), (2, 1, np.pi), (False, False, True)
    )
    inputs = ("lateral",)
    max_steps = 45
    worst_reward = 0.0
    start_low, start_high = (0.0, -0.5, -np.pi), (0.2, 0.5, np.pi)
    observation_low, observation_high = (-9.0,) * 3, (9.0,) * 3
    scene = Scene(starts=((0.0, 0.0, 0.0),), time=2.0, mode_names=("left", "right"))

    def __init__(self, sensors=SEEN):
        self.model = mujoco.MjModel.from_xml_string(XML.replace("SENSORS", sensors))
        self.noisy = (0.0, 1.0, 0.0) + (0.0,) * 6 * bool(sensors)

    def mocap(self, qpos):
        """The pillar's and the hand's poses (n, 2, 7): the hand turns about its middle."""
        poses = np.tile(mjcf.mocap_frames(self.model), (len(qpos), 1, 1))
        poses[:, 0, 1] = 0.5 * np.sin(qpos[:, 2])
        poses[:, 1, 3], poses[:, 1, 6] = np.cos(qpos[:, 2] / 2), np.sin(qpos[:, 2] / 2)
        return poses

    def observation(self, measured):
        return np.column_stack([measured[:, :2], np.sin(measured[:, 2])])

    def reward(self, measurement, u):
        return np.ones(len(measurement))

    def ending(self, measurement):
        return np.where(measurement[:, 0] >= 2, Outcome.REACHED, Outcome.RUNNING)

    def direction(self, path):
        return np.where(path[-1, :, 1] > 0, 0, 1)

    def miss(self, z):
        return np.abs(z[:, 1])


@pytest.fixture(scope="module")
def swing():
    return Swing()


def places(task, z):
    """Where the pillar and the tip of the hand are at chart points (n, 3): (n, 6) [m]."""
    phase = z[:, 2]
    x, y = task.model.body("hand").pos[:2]
    tip = [x - 0.3 * np.sin(phase), y + 0.3 * np.cos(phase), 0 * phase + 0.1]
    return np.column_stack([0 * phase + 1, 0.5 * np.sin(phase), 0 * phase + 0.1, *tip])


def some(task, n=N):
    return task.starts(n, np.random.default_rng(0))


def moved(task, samples=7, n=N, threads=0):
    """A plant after some samples under random inputs, from random starts."""
    plant, rng = task.plant(n, threads), np.random.default_rng(1)
    plant.set_state(*task.state(some(task, n)))
    for _ in range(samples):
        plant.step(rng.uniform(-1, 1, (n, 1)))
    return plant


@pytest.mark.slow
def test_the_task_can_be_used(swing):
    assert check_task(swing) is swing
    assert swing.kinematic


def test_a_state_sets_them_and_they_are_measured(swing):
    z, plant = some(swing), swing.plant(N)
    plant.set_state(*swing.state(z))
    np.testing.assert_allclose(plant.measurement[:, 3:], places(swing, z), atol=1e-12)
    rows = np.array([3, 7])
    plant.set_state(*swing.state(z[:2]), rows)
    np.testing.assert_allclose(plant.measurement[rows, 3:], places(swing, z[:2]), atol=1e-12)
    np.testing.assert_allclose(plant.measurement[8:, 3:], places(swing, z[8:]), atol=1e-12)


def test_they_move_with_the_phase_at_each_step(swing):
    z, plant = some(swing), swing.plant(N)
    plant.set_state(*swing.state(z))
    for k in range(1, 20):
        plant.step(np.zeros((N, 1)))
        now = z + k * 0.05 * np.array([1, 0, RATE])
        np.testing.assert_allclose(plant.measurement[:, 3:], places(swing, now), atol=1e-6)
    rows = np.array([1, 4])
    before = plant.measurement
    plant.step(np.ones((2, 1)), rows)
    still = np.setdiff1d(np.arange(N), rows)
    np.testing.assert_array_equal(plant.measurement[still], before[still])
    now = swing.z(plant.measurement)
    np.testing.assert_allclose(plant.measurement[:, 3:], places(swing, now), atol=1e-12)
    assert (np.abs(plant.measurement[rows] - before[rows])[:, [4, 6, 7]] > 1e-4).all()


def test_backward_steps_bring_them_back(swing):
    plant = moved(swing, 0)
    before = plant.measurement
    for _ in range(10):
        plant.step(np.full((N, 1), 0.3))
    assert np.abs(plant.measurement - before)[:, 4].max() > 0.1
    for _ in range(10):
        plant.step_backward(np.full((N, 1), 0.3))
    np.testing.assert_allclose(plant.measurement, before, atol=1e-5)


def test_the_number_of_threads_and_copies_changes_no_bit(swing):
    plant = moved(swing, threads=1)
    others = (moved(swing, threads=2), pickle.loads(pickle.dumps(plant)), copy.deepcopy(plant))
    for other in others:
        np.testing.assert_array_equal(other.state, plant.state)
        np.testing.assert_array_equal(other.measurement, plant.measurement)
    for one in (plant, *others):
        one.step(np.full((N, 1), 0.2))
    for other in others:
        np.testing.assert_array_equal(other.state, plant.state)


def test_the_whole_state_holds_their_poses(swing):
    plant, data = moved(swing), mujoco.MjData(swing.model)
    poses = swing.mocap(plant.qpos)
    for state, pose in zip(plant.state, poses, strict=True):
        mujoco.mj_setState(swing.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        np.testing.assert_allclose(np.hstack([data.mocap_pos, data.mocap_quat]), pose, atol=1e-12)


def test_joint_sensors_alone_see_the_same_motion(swing):
    quick = Swing(sensors="")
    np.testing.assert_array_equal(moved(quick).state, moved(swing).state)
    assert moved(quick).measurement.shape == (N, 3)


def test_positions_alone_leave_the_orientation(swing):
    model = swing.model
    plant = Plant(model, swing.inputs, 2, mocap=lambda qpos: swing.mocap(qpos)[:, :, :3])
    plant.set_state(np.zeros((2, 3)))
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, plant.state[0], mujoco.mjtState.mjSTATE_INTEGRATION)
    np.testing.assert_allclose(data.mocap_quat[0], model.body("ahead").quat, atol=1e-12)
    np.testing.assert_allclose(np.abs(model.body("ahead").quat[3]), np.sin(np.radians(15)))


def test_without_a_rule_they_stay(swing):
    plant = Plant(swing.model, swing.inputs, 2)
    plant.set_state(np.zeros((2, 3)))
    before = plant.measurement[:, 3:]
    plant.step(np.ones((2, 1)))
    np.testing.assert_array_equal(plant.measurement[:, 3:], before)
    np.testing.assert_allclose(before[0], places(swing, np.zeros((1, 3)))[0], atol=1e-12)


def test_what_breaks_down_begins_anew_with_its_bodies(swing):
    plant = swing.plant(2)
    plant.set_state(np.zeros((2, 3)), np.array([[0.0, 0.0, 0.0], [0.0, 1e300, 0.0]]))
    plant.step(np.zeros((2, 1)))
    assert plant.unstable.tolist() == [False, True]
    np.testing.assert_allclose(plant.measurement[:, 3:], places(swing, plant.qpos), atol=1e-12)
    assert np.abs(plant.qpos).max() < 1


class Wrapped(Swing):
    """The phase is measured as an angle between -pi and pi."""

    def measure(self, sensors):
        angle = np.arctan2(np.sin(sensors[:, 2]), np.cos(sensors[:, 2]))
        return np.column_stack([sensors[:, :2], angle, sensors[:, 3:]])


@pytest.mark.parametrize("kind", [Swing, Wrapped])
def test_a_closed_loop_unwraps_the_phase_and_carries_them(kind):
    swing = kind()
    policy = ChartPolicy(swing, lambda z: np.zeros((len(z), 1)))
    z0 = np.array([[0.0, 0.0, 3.0], [0.0, 0.2, -3.0]])
    settings = LoopSettings(record=True, quiet=True)
    runs = closed_loop(swing, PolicyController(policy), z0, settings=settings)
    k = np.arange(len(runs.path))[:, None]
    np.testing.assert_allclose(runs.path[..., 2], z0[:, 2] + 0.05 * RATE * k, atol=1e-5)
    expected = places(swing, runs.path[:-1, 0])
    np.testing.assert_allclose(runs.measured[:, 0, 3:], expected, atol=1e-9)


# ---- pictures


@needs_gl
def test_a_picture_shows_them_at_the_phase(swing):
    renderer = SceneRenderer(swing.model, 120, 120, mocap=swing.mocap)
    across = {}
    for phase in (-1.2, 0.0, 1.2):
        renderer.place(np.array([-5.0, 0.0, phase]), "overhead")
        picture = renderer.draw().astype(int)
        red = picture[..., 0] - picture[..., 1:].max(axis=-1) > 60
        across[phase] = 60 - np.argwhere(red)[:, 0].mean()
    renderer.close()
    pixels = 0.5 * np.sin(1.2) * 120 / 3
    assert across[1.2] - across[0.0] == pytest.approx(pixels, abs=1.5)
    assert across[0.0] - across[-1.2] == pytest.approx(pixels, abs=1.5)


def test_viewers_and_marks_show_them_at_the_phase(swing):
    track = SimpleNamespace(qpos=lambda t: np.array([0.0, 0.0, t]), end=9.0, task=swing)
    data = mujoco.MjData(swing.model)
    show(track, swing.model, data, 1.0)
    assert data.body("ahead").xpos[1] == pytest.approx(0.5 * np.sin(1.0))
    on_hand = copy.copy(swing)
    on_hand.scene = Scene(((0.0, 0.0, 0.0),), 2.0, ("left", "right"), tracked="tip")
    tip = tracked_points(on_hand, np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(tip, places(swing, np.array([[0.0, 0.0, 1.0]]))[:, 3:], atol=1e-9)


# ---- mistakes


def by_row(self, qpos):
    return np.tile(np.arange(len(qpos))[:, None, None] * 0.1, (1, 2, 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mocap", "said"),
    [
        (Swing, lambda self, qpos: qpos, r"mocap\(\) gives shape .*2 mocap body\(s\)"),
        (Swing, lambda self, qpos: np.full((len(qpos), 2, 3), np.nan), r"mocap\(\) gives \[\[nan"),
        (Swing, by_row, "let it depend on this row alone"),
        (Swing, lambda self, qpos: qpos[:, 9], r"mocap\(\) of the task swing raises IndexError"),
        (Vehicle, lambda self, qpos: qpos, "has no mocap body"),
    ],
)
def test_a_rule_that_gives_no_poses_is_refused(kind, mocap, said):
    task = type("Wrong", (kind,), {"mocap": mocap, "source": None})()
    with pytest.raises(BadInput, match=said) as error:
        check_task(task)
    assert "\n" not in str(error.value)


def test_a_keyframe_that_places_a_mocap_body_elsewhere_is_refused():
    keyed = XML.replace("SENSORS", "").replace(
        '<key ctrl="1 0 2"/>', '<key ctrl="1 0 2" mpos="1 0 0.1 2 1 0.1"/>'
    )
    with pytest.raises(BadInput, match=r"places mocap body hand at \[2\.0, 1\.0, 0\.1\]"):
        Plant(mujoco.MjModel.from_xml_string(keyed), ("lateral",), 1)
    same = keyed.replace("2 1 0.1", "2 0 0.1")
    assert Plant(mujoco.MjModel.from_xml_string(same), ("lateral",), 1).n == 1
