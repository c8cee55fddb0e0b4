"""Every task of the package does what each task must do."""

import mujoco
import pytest

import hyrl_mj
from hyrl_mj.physics import mjcf
from hyrl_mj.task_tests import *  # noqa: F403


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
