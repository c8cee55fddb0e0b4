"""What every task must do, tried on this one."""

from pathlib import Path

import pytest

import hyrl_mj
from hyrl_mj.task_tests import *  # noqa: F403


@pytest.fixture
def task():
    return hyrl_mj.get_task(Path(__file__).with_name("my_robot.py"))
