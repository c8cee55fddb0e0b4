"""Modules import only what lies above them in the data flow, and the package imports lightly."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from planted import random_states

import hyrl_mj
from hyrl_mj.settings import preset
from hyrl_mj.training import build, export

PACKAGE = Path(hyrl_mj.__file__).parent
ORDER = (
    "errors", "progress", "colours", "algorithms", "mjcf", "plant", "noise", "tasks", "settings", "artifacts",
    "policies", "agents", "given", "controllers", "adversary", "rendering", "encoding", "envs", "simulation",
    "task_tests", "symmetry", "training", "distillation", "sets", "lattice", "game", "critical_set",
    "partition", "limit", "extended_sets", "section", "retraining", "hybrid", "export",
    "robustness", "episodes", "run_directory", "tables", "figures", "replay", "viewing", "arcs",
    "doctor", "report", "diagnosis", "pipeline", "summary", "new_task", "cli",
)  # fmt: skip


def layer(dotted):
    """ "hyrl_mj.envs.core" -> "envs"; "" for the package itself."""
    return [*dotted.split("."), ""][1]


def dotted_name(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path):
    """The modules of this package that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.split(".")[0] == "hyrl_mj"}


TOP = (PACKAGE / "__init__.py", PACKAGE / "__main__.py")
TEMPLATES = PACKAGE / "templates"  # copied into a folder of the user's, never imported
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p not in TOP and TEMPLATES not in p.parents)


@pytest.mark.parametrize("path", MODULES, ids=[dotted_name(p) for p in MODULES])
def test_it_imports_only_from_above(path):
    own = layer(dotted_name(path))
    assert own in ORDER, f"{own} has no place in the order"
    for name in imports(path):
        target = layer(name)
        if target == own:
            continue  # inside one folder
        if target == "__version__":
            continue
        assert target in ORDER, f"{path.name} imports {name}"
        assert ORDER.index(target) < ORDER.index(own), f"{path.name} imports {name} below it"


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
    result = subprocess.run(
        [sys.executable, "-c", BLOCKED.format(blocked=set(blocked)) + code],
        capture_output=True, text=True, timeout=60,
        env={**os.environ, "PYTHONPATH": str(PACKAGE.parent), **environment},
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return result.stdout


USE = """
import numpy as np
import hyrl_mj
from hyrl_mj.sets import Everything

policy = hyrl_mj.MlpPolicy.load(__import__("pathlib").Path({path!r}))
u = policy.act(np.load({states!r}))
controller = hyrl_mj.HybridController(policy.task, {{0: policy}}, {{0: Everything()}})
arc = hyrl_mj.simulate(policy.task, controller, policy.task.replay_starts[0], horizon=0.5)
assert len(arc.t) == 11

from hyrl_mj.envs.sb3_policy import Sb3Policy

measured = policy.task.check_state(policy.task.replay_starts)
actions, (q,) = Sb3Policy(policy.task, controller).predict(policy.task.observation(measured))
assert len(actions) == len(q) == len(measured)
assert "torch" not in sys.modules
np.save({out!r}, u)
"""


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
    "PIL", "hyrl_mj.encoding", "hyrl_mj.rendering", "hyrl_mj.replay", "imageio_ffmpeg", "jinja2",
    "matplotlib", "mediapy", "mujoco.batch", "rich", "scipy",
    "stable_baselines3", "tensorboard", "torch", "tqdm",
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


@pytest.mark.parametrize(
    ("code", "heavy"),
    [("import hyrl_mj", HEAVY | {"tyro"}), (HELP, HEAVY)],
    ids=["import", "help"],
)
def test_nothing_heavy_is_loaded_before_it_is_needed(code, heavy):
    out = run_without(set(), f"{code}\nimport sys; print(sorted({heavy} & set(sys.modules)))")
    assert out.splitlines()[-1] == "[]"


def test_public_names_are_there():
    assert [name for name in hyrl_mj.__all__ if not hasattr(hyrl_mj, name)] == []
    assert (PACKAGE / "py.typed").is_file()


def test_the_gl_backend_is_chosen_only_where_the_user_has_not():
    code = "import hyrl_mj, os; print(os.environ.get('MUJOCO_GL'))"
    headless = {"DISPLAY": "", "WAYLAND_DISPLAY": ""}
    unset = "import os; os.environ.pop('MUJOCO_GL', None); "
    assert run_without(set(), unset + code, **headless).strip() == "egl"
    assert run_without(set(), code, MUJOCO_GL="disabled", **headless).strip() == "disabled"
