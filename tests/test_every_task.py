"""Every task of the package does what each task must do."""

import mujoco
import numpy as np
import pytest
from experts import Constant, Expert, moved

import hyrl_mj
from hyrl_mj import Outcome
from hyrl_mj.physics import mjcf
from hyrl_mj.task_tests import *  # noqa: F403

pytestmark = pytest.mark.usefixtures("few_steps")


@pytest.fixture(scope="session", params=hyrl_mj.task_names())
def task(request):
    return hyrl_mj.get_task(request.param)


def test_it_has_its_named_parts(task):
    cameras = mjcf.names(task.model, mujoco.mjtObj.mjOBJ_CAMERA)
    assert {"overhead", "chase", "three_quarter"} <= set(cameras)
    kind = mujoco.mjtObj.mjOBJ_NUMERIC if task.has_inner_loop else mujoco.mjtObj.mjOBJ_ACTUATOR
    assert set(task.inputs) <= set(mjcf.names(task.model, kind))
    sensors = mjcf.names(task.model, mujoco.mjtObj.mjOBJ_SENSOR)
    assert not any(name.startswith("(") for name in sensors), "a sensor without a name"
    joints = [task.model.joint(i).name for i in range(task.model.njnt)]
    bodies = [task.model.body(i).name for i in range(task.model.nbody)]
    assert all(joints)
    assert all(bodies)
    assert mjcf.model_name(task.model) == task.name
    assert task.description
    assert len(task.scene.mode_names) >= 2 or all(task.obstacles), "a mode without a name"


def test_a_plant_does_not_write_to_the_shared_model(task):
    before = task.model.opt.disableflags
    task.plant(1)
    assert task.model.opt.disableflags == before


# ---- the robots with dynamics that an expert drives: with the last of three places to decide at


DRIVEN = pytest.mark.parametrize(("name", "late"), [("rover", 1.4), ("quadrotor", 1.7)])


@DRIVEN
def test_who_decides_late_crashes(name, late):
    robot, starts = hyrl_mj.get_task(name), [[x, 0.0, 0.0] for x in (0.0, 0.3, late)]
    for side in (1, -1):
        outcome = moved(robot, Expert(robot, side), starts).outcome
        assert outcome.tolist() == [Outcome.REACHED, Outcome.REACHED, Outcome.CRASHED]


@pytest.mark.slow
@DRIVEN
def test_an_expert_survives_from_every_start(name, late):
    robot = hyrl_mj.get_task(name)
    z = robot.starts(300, np.random.default_rng(0))
    survived = [moved(robot, Expert(robot, s), z).outcome == Outcome.REACHED for s in (1, -1)]
    assert np.any(survived, axis=0).all()


@pytest.mark.parametrize(("name", "u", "off"), [("rover", 1.1, 1e-4), ("quadrotor", 0.9, 1e-6)])
def test_a_mirror_image_moves_the_mirrored_way(name, u, off):
    robot = hyrl_mj.get_task(name)
    z = robot.starts(20, np.random.default_rng(0))
    runs = [moved(robot, Constant(s * u), z * [1, s, s], steps=15) for s in (1, -1)]
    np.testing.assert_allclose(runs[0].path, runs[1].path * [1, -1, -1], atol=off)
