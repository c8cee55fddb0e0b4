"""An installed wheel finds its models away from the checkout."""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # a wheel is built and installed

ROOT = Path(__file__).parent.parent


def call(*command, cwd):
    """Run a command without the checkout on its path; what it printed."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    result = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    build = (sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT)
    call(*build, cwd=folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A fresh environment with the wheel in it; what it depends on is borrowed from this one."""
    home = tmp_path_factory.mktemp("venv")
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    (site,) = (home / "lib").glob("python*/site-packages")
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index")
    call(*pip, "--ignore-installed", "--quiet", wheel, cwd=home)
    return python


def test_the_wheel_holds_package_models_and_licence(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    models = {"unit_circle.xml", "vehicle.xml", "common/scene.xml"}
    assert {f"hyrl_mj/models/{name}" for name in models} <= names
    assert {"hyrl_mj/py.typed", "hyrl_mj/cli/main.py", "hyrl_mj/tasks/vehicle.py"} <= names
    templates = {
        "viz/templates/report.html",
        "viz/templates/report.css",
        "export/templates/controller.py",
    }
    assert {f"hyrl_mj/{name}" for name in templates} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not any(name.startswith(("tests/", "scripts/", "models/")) for name in names)


def test_it_is_the_installed_package_that_steps_a_plant_away_from_the_checkout(installed, tmp_path):
    code = (
        "import gymnasium, hyrl_mj\n"
        "print(hyrl_mj.__file__)\n"
        "for name in hyrl_mj.task_names():\n"
        "    env = gymnasium.make(hyrl_mj.get_task(name).env_id)\n"
        "    env.reset(seed=0)\n"
        "    print(name, env.step(env.action_space.sample())[1])\n"
    )
    where, *lines = call(installed, "-c", code, cwd=tmp_path).split("\n")
    assert Path(where).is_relative_to(installed.parent.parent)
    models = Path(__file__).parents[1] / "models"
    assert [line.split()[0] for line in lines if line] == sorted(
        p.stem for p in models.glob("*.xml")
    )


def test_the_command_lists_the_tasks_from_another_folder(installed, tmp_path):
    text = call(installed.parent / "hyrl-mj", "list", cwd=tmp_path)
    assert "unit_circle" in text
    assert "vehicle" in text
