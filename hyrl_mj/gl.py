"""Import MuJoCo with a GL backend that does not stop it.

MuJoCo reads `MUJOCO_GL` once, when it is first imported, and loads the GL library that it names then and
there. Where the library is missing or the name is unknown, `import mujoco` itself fails. Training and
analysis draw nothing and need no GL, so they must not fail with it: another backend is tried, and at last
MuJoCo is imported without one.

Before the next attempt, the modules that the failed one has left in `sys.modules` have to be removed from
it. Python removes the module that failed, and keeps those that it had imported by then. PyOpenGL stays bound
to the backend that failed: EGL after OSMesa ends with "OSMesaPlatform has no attribute EGL". And the MuJoCo
that is imported next lacks `mujoco.rendering`, because Python makes a submodule an attribute of its package
only when it loads the submodule.

A look for the GL library beforehand cannot take the place of an attempt: whether the import succeeds also
depends on the versions of PyOpenGL and MuJoCo and on the environment. An attempt in a child process could,
but each import of this package would wait for a second import of MuJoCo.

Only what an attempt has added is removed; what was imported before it stays as it is.
"""

import importlib
import os
import sys

# GL backends that need no screen, in the order in which they are tried.
HEADLESS = ("egl", "osmesa")


def has_display() -> bool:
    """Whether windows can be opened; elsewhere than on Linux they always can."""
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return bool(shown) or not sys.platform.startswith("linux")


def import_mujoco() -> str:
    """Import MuJoCo with the first GL backend that can be loaded, or else without one.

    These are tried: what `MUJOCO_GL` names; where it is not set, MuJoCo's own choice if there is a display,
    else `HEADLESS`. `MUJOCO_GL` is left at the backend in use or, without one, at the first that was tried.

    Returns:
        Why MuJoCo runs without GL although a backend was tried; empty if it does not.

    Raises:
        Exception: whatever `import mujoco` raises for a reason other than the GL backend.
    """
    asked = os.environ.get("MUJOCO_GL", "")
    if not asked and (has_display() or "mujoco" in sys.modules):
        importlib.import_module("mujoco")
        return ""
    problems = []
    backends = (asked,) if asked else HEADLESS
    for backend in backends:
        problem = _attempt(backend)
        if not problem:
            return ""
        problems.append(f"{backend}: {problem}")
    os.environ["MUJOCO_GL"] = "disable"
    importlib.import_module("mujoco")
    os.environ["MUJOCO_GL"] = backends[0]
    return "; ".join(problems)


def _attempt(backend: str) -> str:
    """Import MuJoCo with one GL backend; a failed import leaves nothing behind.

    Args:
        backend: the value of `MUJOCO_GL`.

    Returns:
        Why the import failed; empty if it succeeded.
    """
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
        # MuJoCo has set it for PyOpenGL, and refuses to load another backend while it is set so.
        os.environ.pop("PYOPENGL_PLATFORM", None)
        if platform is not None:
            os.environ["PYOPENGL_PLATFORM"] = platform
        return f"{type(error).__name__}: {error}"
    return ""


# Why MuJoCo runs without GL although a backend was tried; empty if it does not.
GL_PROBLEM = import_mujoco()
