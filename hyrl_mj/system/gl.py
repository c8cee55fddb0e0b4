"""Imports MuJoCo with a GL backend that does not stop it.

MuJoCo reads `MUJOCO_GL` when it is first imported and loads the GL library at once. Where the library is
missing or the name is unknown, `import mujoco` itself fails. Training and analysis draw nothing and must not
fail with it: other backends are tried, and at last MuJoCo is imported without one.

Before the next attempt, the modules that the failed one has added are removed from `sys.modules`: PyOpenGL
stays bound to the backend that failed, and Python makes a submodule an attribute of its package only when it
loads the submodule. Looking for the GL library beforehand is not enough, because the import also depends on
the versions of PyOpenGL and MuJoCo; an attempt in a child process would double the time of every import.
"""

import importlib
import os
import sys
from contextlib import chdir
from pathlib import Path


def has_display() -> bool:
    """Returns whether windows can be opened: without a display they cannot on Linux."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return bool(display) or not sys.platform.startswith("linux")


def import_mujoco() -> str:
    """Imports MuJoCo with the first GL backend that can be loaded, or else without one.

    The backend that `MUJOCO_GL` names is tried; where it is not set, MuJoCo's own choice if there is a
    display, else those that need no screen. `MUJOCO_GL` is left at the backend in use or, without one, at the
    first tried.
    Returns why all backends failed; empty if one was loaded or none was needed.
    """
    chosen = os.environ.get("MUJOCO_GL", "")
    if not chosen and (has_display() or "mujoco" in sys.modules):
        importlib.import_module("mujoco")
        return ""
    problems = []
    backends = (chosen,) if chosen else ("egl", "osmesa")
    for backend in backends:
        if not (problem := _attempt(backend)):
            return ""
        problems.append(f"{backend}: {problem}")
    os.environ["MUJOCO_GL"] = "disable"
    importlib.import_module("mujoco")
    os.environ["MUJOCO_GL"] = backends[0]
    return "; ".join(problems)


def _attempt(backend: str) -> str:
    """Imports MuJoCo with one GL backend; a failure leaves nothing behind, and its reason is returned."""
    imported = set(sys.modules)
    platform = os.environ.get("PYOPENGL_PLATFORM")
    os.environ["MUJOCO_GL"] = backend
    try:
        importlib.import_module("mujoco")
    # Each backend fails in its own way: RuntimeError, ImportError, AttributeError, ...
    except Exception as error:
        for name in sys.modules.keys() - imported:
            if name.partition(".")[0] in ("mujoco", "OpenGL"):
                del sys.modules[name]
        # MuJoCo has set this for PyOpenGL, and refuses to load another backend while it is set.
        os.environ.pop("PYOPENGL_PLATFORM", None)
        if platform is not None:
            os.environ["PYOPENGL_PLATFORM"] = platform
        return f"{type(error).__name__}: {error}"
    return ""


# Why all GL backends failed; empty if one was loaded or none was needed.
GL_PROBLEM = import_mujoco()


def spare_matplotlib() -> None:
    """Lets a file `matplotlibrc` of the current folder, and a backend, have no part in figures.

    matplotlib reads that file when it is imported, whatever it is.
    """
    os.environ["MPLBACKEND"] = "agg"
    if os.path.lexists("matplotlibrc"):
        with chdir(Path(__file__).parent):
            importlib.import_module("matplotlib")
