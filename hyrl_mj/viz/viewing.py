"""Look inside: an arc in MuJoCo's own viewer, or in a browser where there is no display.

The page for the browser is served by mjviser, an optional package that shows MuJoCo models with viser. The
web viewer that MuJoCo 4 brings along listens to the whole network, and has no setting for that.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from copy import copy
from io import StringIO
from typing import TYPE_CHECKING, Protocol

import mujoco

from hyrl_mj.errors import BadInput
from hyrl_mj.gl import has_display
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks import Task
from hyrl_mj.viz.replay.panel import Track

if TYPE_CHECKING:
    from mjviser import ViserMujocoScene

FPS = 60
PAUSE = 1.0  # [s] between the end of an arc and its beginning
LOOPBACK = "127.0.0.1"
FIRST_PORT = 8080  # that is tried where none is given
Say = Callable[[str], None]


class Viewer(Protocol):
    """What shows the data of a model."""

    def is_running(self) -> bool:
        """Whether it has not been closed."""

    def sync(self) -> None:
        """Show the data as they are now."""


def view(task: Task, arc: HybridArc, port: int = 0, say: Say = print) -> None:
    """Play an arc again and again in real time, until the viewer is closed.

    Args:
        task: what the arc is of.
        arc: the arc.
        port: of the web viewer, 1 to 65535; 0 for the first free one from 8080 on.
        say: told where the web viewer is.

    Raises:
        BadArtifact: the arc is not of this task's model.
        BadInput: no viewer can be opened here; the message says why.
    """
    track = Track(task, arc)
    # Viewers change how a model is drawn, and let their user change more; compiled models are shared.
    model = copy(task.model)
    data = mujoco.MjData(model)
    show(track, model, data, 0.0)
    with _window(model, data) if has_display() else _web(model, data, port, say) as viewer:
        play(track, model, data, viewer)


def play(track: Track, model: mujoco.MjModel, data: mujoco.MjData, viewer: Viewer) -> None:
    """Move a model along an arc, again and again in real time, until the viewer is closed.

    A viewer that takes long is shown fewer frames; the arc does not slow down.

    Args:
        track: the arc.
        model, data: what the viewer shows; the data are changed.
        viewer: the viewer.
    """
    began = time.monotonic()
    due = began
    while viewer.is_running():
        show(track, model, data, (time.monotonic() - began) % (track.end + PAUSE))
        viewer.sync()
        now = time.monotonic()
        due = max(due + 1 / FPS, now)  # frames that are late are not caught up with
        time.sleep(due - now)


def show(track: Track, model: mujoco.MjModel, data: mujoco.MjData, t: float) -> None:
    """Bring the data to where an arc is at the time t [s], or at its end after that."""
    data.time = t
    data.qpos[:] = track.qpos(min(t, track.end))
    mujoco.mj_forward(model, data)


def _window(model: mujoco.MjModel, data: mujoco.MjData) -> AbstractContextManager[Viewer]:
    from mujoco import viewer

    try:
        return viewer.launch_passive(model, data)
    except RuntimeError as error:  # on macOS, outside of mjpython
        raise BadInput(
            f"MuJoCo's viewer cannot be opened ({error}): make a video with hyrl-mj replay"
        ) from error


@contextmanager
def _web(model: mujoco.MjModel, data: mujoco.MjData, port: int, say: Say) -> Iterator[Viewer]:
    try:
        import viser
        from mjviser import ViserMujocoScene
    except ImportError as error:
        raise BadInput(
            f"there is no display, and the viewer for a browser takes the package mjviser ({error}): "
            'pip install "hyrl-mj[view]", or make a video with hyrl-mj replay'
        ) from error

    _check_free(port)
    with redirect_stdout(StringIO()):  # it has its own way of telling where it listens
        server = viser.ViserServer(host=LOOPBACK, port=port or FIRST_PORT, verbose=False)
    try:
        # The button would ask a server on the internet for an address that everyone can open.
        server.gui.configure_theme(show_share_button=False)
        scene = ViserMujocoScene(server, model, num_envs=1)
        scene.camera_tracking_enabled = False  # the robot moves, and not the world around it
        shown = model.vis.global_
        scene.create_visualization_gui(
            camera_distance=model.stat.extent,
            camera_azimuth=shown.azimuth,
            camera_elevation=-shown.elevation,  # MuJoCo's is negative from above
        )
        page = _Page(scene, data)
        page.sync()
        say(
            f"watch http://{LOOPBACK}:{server.get_port()}/ (only from this machine); Ctrl+C ends it"
        )
        yield page
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


class _Page:
    """A model on a page that viser serves.

    Args:
        scene: the model, as viser shows it.
        data: where its parts are.
    """

    def __init__(self, scene: ViserMujocoScene, data: mujoco.MjData):
        self._scene, self._data = scene, data

    def is_running(self) -> bool:
        """True: a page that is closed can be opened again, and Ctrl+C ends it."""
        return True

    def sync(self) -> None:
        """Send the positions to all who have the page open."""
        self._scene.update_from_mjdata(self._data)


def _check_free(port: int) -> None:
    """Refuse a port that cannot be listened on: viser would take another one, or wait forever.

    Args:
        port: on the loopback interface; 0 for any.

    Raises:
        BadInput: the port is taken, is reserved for root, or is no port number.
    """
    try:
        socket.create_server((LOOPBACK, port)).close()
    except (OSError, OverflowError) as error:
        raise BadInput(
            f"port {port} cannot be used ({error}): give a free one, 1024 to 65535, or none"
        ) from error
