"""Which GL backend MuJoCo is imported with, and what is left of one that does not go."""

import os
from pathlib import Path

import pytest
from command_line import python

from hyrl_mj.system import gl

HIDDEN = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY", "PYTHONPATH")

# Stands in for MuJoCo: a package whose import goes well with the backends in GOOD, and otherwise fails as
# MuJoCo's does, with a part of it and PyOpenGL imported.
MUJOCO = """
import os
import mujoco.part
backend = os.environ.get("MUJOCO_GL", "")
if backend in ("egl", "osmesa"):
    assert not os.environ.get("PYOPENGL_PLATFORM"), "bound to another backend"
    os.environ["PYOPENGL_PLATFORM"] = backend
    import OpenGL
    assert OpenGL.platform == backend, "PyOpenGL is bound to " + OpenGL.platform
if backend not in os.environ["GOOD"].split(","):
    raise AttributeError("no " + backend)
"""
OPENGL = "import os; platform = os.environ.get('PYOPENGL_PLATFORM', 'its own choice')"


def in_process(code, environment):
    """Runs code in a process of its own, of whose environment nothing else speaks of GL."""
    kept = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    return python(code, env=kept | environment)


@pytest.fixture
def ask(tmp_path):
    """A function that imports the module in a process of its own, and tells what it prints after that."""
    for name, content in (("mujoco", MUJOCO), ("OpenGL", OPENGL)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(content)
    (tmp_path / "mujoco" / "part.py").write_text("")
    load = (
        "import importlib.util, os, sys\n"
        f"spec = importlib.util.spec_from_file_location('gl', {str(Path(gl.__file__))!r})\n"
        "gl = importlib.util.module_from_spec(spec)\n"
    )

    def run(code, good, before="", **environment):
        environment = {"PYTHONPATH": str(tmp_path), "GOOD": good} | environment
        return in_process(f"{load}{before}\nspec.loader.exec_module(gl)\n{code}", environment)

    return run


TELL = (
    "print(os.environ.get('MUJOCO_GL'), os.environ.get('PYOPENGL_PLATFORM'), repr(gl.GL_PROBLEM))"
)


@pytest.mark.parametrize(
    ("good", "said"),
    [("egl", "egl egl ''"), ("egl,osmesa", "egl egl ''"), ("osmesa", "osmesa osmesa ''")],
)
def test_without_a_display_the_first_backend_that_goes_is_taken(ask, good, said):
    child = ask(TELL, good)
    assert child.stdout.strip() == said, child.stderr


def test_where_none_goes_mujoco_runs_without_and_the_reasons_are_kept(ask):
    child = ask(TELL + "\nprint('mujoco' in sys.modules)", "disable")
    assert child.stdout.splitlines() == [
        "egl None 'egl: AttributeError: no egl; osmesa: AttributeError: no osmesa'",
        "True",
    ], child.stderr


def test_a_backend_that_was_asked_for_is_the_only_one_tried(ask):
    child = ask(TELL, "egl,disable", MUJOCO_GL="osmesa")
    assert child.stdout.strip() == "osmesa None 'osmesa: AttributeError: no osmesa'", child.stderr
    child = ask(TELL, "osmesa,egl", MUJOCO_GL="osmesa")
    assert child.stdout.strip() == "osmesa osmesa ''", child.stderr


def test_nothing_of_a_failed_import_is_left(ask):
    """Python would not set a submodule that it finds in sys.modules as an attribute of the new package."""
    child = ask("import mujoco.part; print(mujoco.part is sys.modules['mujoco.part'])", "disable")
    assert child.stdout.strip() == "True", child.stderr


def test_what_was_imported_before_stays_as_it_is(ask):
    child = ask(
        "print(sys.modules['OpenGL'] is mine, os.environ['PYOPENGL_PLATFORM'])",
        "disable",
        before="import OpenGL; mine = OpenGL",
        PYOPENGL_PLATFORM="glx",
    )
    assert child.stdout.split() == ["True", "glx"], child.stderr
    child = ask(
        "print(sys.modules['mujoco'] is mine, os.environ.get('MUJOCO_GL'), repr(gl.GL_PROBLEM))",
        "",
        before="os.environ['GOOD'] = ','; import mujoco; mine = mujoco; os.environ['GOOD'] = ''",
    )
    assert child.stdout.split() == ["True", "None", "''"], child.stderr


def test_with_a_display_the_choice_is_mujoco_s_and_so_is_the_error(ask):
    child = ask(TELL, ",egl", DISPLAY=":0")
    assert child.stdout.strip() == "None None ''", child.stderr
    child = ask(TELL, "egl,osmesa,disable", DISPLAY=":0")
    assert child.returncode == 1
    assert "AttributeError: no" in child.stderr


@pytest.mark.parametrize(
    ("environment", "said"), [({}, "egl"), ({"MUJOCO_GL": "disabled"}, "disabled")]
)
def test_the_real_mujoco_gets_a_backend_only_where_the_user_has_named_none(environment, said):
    environment = {"PYTHONPATH": str(Path(gl.__file__).parents[1])} | environment
    child = in_process("import hyrl_mj, os; print(os.environ.get('MUJOCO_GL'))", environment)
    assert child.stdout.strip() == said, child.stderr


@pytest.mark.parametrize(
    ("platform", "environment", "display"),
    [
        ("linux", {}, False),
        ("linux", {"DISPLAY": ""}, False),
        ("linux", {"DISPLAY": ":0"}, True),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, True),
        ("darwin", {}, True),
        ("win32", {}, True),
    ],
)
def test_only_linux_can_be_without_a_display(platform, environment, display, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(gl.sys, "platform", platform)
    assert gl.has_display() == display
