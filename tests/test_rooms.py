"""Rooms are entered by their doors, and the package imports lightly. The order of rooms is checked by
import-linter: see its contract in pyproject.toml.
"""

import importlib
import os
from pathlib import Path

import grimp
import numpy as np
import pytest
from command_line import python
from planted import random_states

import hyrl_mj
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.training import build, export

PACKAGE = Path(hyrl_mj.__file__).parent
GRAPH = grimp.build_graph("hyrl_mj", cache_dir=None)
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))


@pytest.mark.parametrize("room", ROOMS)
def test_others_use_only_what_a_room_exports(room):
    door = importlib.import_module(f"hyrl_mj.{room}")
    assert door.__doc__, "the door says what the room is for"
    assert [
        name for name in door.__all__ if not hasattr(door, name) and not is_module(room, name)
    ] == []
    inside = {door.__name__, *GRAPH.find_descendants(door.__name__)}
    for module in inside - {door.__name__}:
        for importer in GRAPH.find_modules_that_directly_import(module) - inside:
            exported = module.split(".")[2]
            assert exported in door.__all__, f"{importer} imports {module}, not the door {room}"


def is_module(room, name):
    return f"hyrl_mj.{room}.{name}" in GRAPH.modules


# ---- what has to work without torch

BLOCKED = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {blocked}:
            raise ImportError(name + " is not here")

sys.meta_path.insert(0, Refuse())
"""


def run_without(blocked, code, **environment):
    """Run code in a fresh interpreter where importing some packages raises."""
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent), **environment}
    result = python(BLOCKED.format(blocked=set(blocked)) + code, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout


USE = """
import numpy as np
import hyrl_mj
from hyrl_mj.sets import Everything

policy = hyrl_mj.MlpPolicy.load(__import__("pathlib").Path({path!r}))
u = policy.act(np.load({states!r}))
controller = hyrl_mj.HybridController(policy.task, {{0: policy}}, {{0: Everything()}})
arc = hyrl_mj.simulate(policy.task, controller, policy.task.scene.starts[0], horizon=0.5)
assert len(arc.t) == 11

from hyrl_mj.gym_export.sb3_policy import Sb3Policy

measured = policy.task.chart.check(policy.task.scene.starts, policy.task.name)
actions, (q,) = Sb3Policy(policy.task, controller).predict(policy.task.observation(measured))
assert len(actions) == len(q) == len(measured)
assert "torch" not in sys.modules
np.save({out!r}, u)
"""


@pytest.mark.slow
def test_a_saved_policy_works_without_torch(task, tmp_path):
    policy = export(build(task, preset(task, "smoke").stage1, seed=0), task)
    policy.save(tmp_path / "p.safetensors")
    states = random_states(task, 200, np.random.default_rng(0))
    np.save(tmp_path / "z.npy", states)
    names = {"path": "p.safetensors", "states": "z.npy", "out": "u.npy"}
    code = USE.format(**{key: str(tmp_path / name) for key, name in names.items()})
    run_without({"torch", "stable_baselines3", "tensorboard"}, code)
    np.testing.assert_allclose(np.load(tmp_path / "u.npy"), policy.act(states), atol=1e-6)


# Slow to import, and seldom needed.
HEAVY = {
    "PIL", "hyrl_mj.viz.encoding", "hyrl_mj.physics.rendering", "hyrl_mj.viz.replay", "imageio_ffmpeg",
    "jinja2", "matplotlib", "mediapy", "mujoco.batch", "pydantic", "rich", "scipy",
    "stable_baselines3", "tensorboard", "torch", "tqdm", "viser",
}  # fmt: skip
HELP = """
import sys
from hyrl_mj import cli

sys.argv = ["hyrl-mj", "--help"]
try:
    cli.main()
except SystemExit:
    print()
"""


@pytest.mark.fast(1)
@pytest.mark.parametrize(
    ("code", "heavy"), [("import hyrl_mj", HEAVY | {"tyro"}), (HELP, HEAVY)], ids=["import", "help"]
)
def test_nothing_heavy_is_loaded_before_it_is_needed(code, heavy):
    out = run_without(set(), f"{code}\nimport sys; print(sorted({heavy} & set(sys.modules)))")
    assert out.splitlines()[-1] == "[]"


def test_public_names_are_there():
    assert [name for name in hyrl_mj.__all__ if not hasattr(hyrl_mj, name)] == []
    assert (PACKAGE / "py.typed").is_file()
