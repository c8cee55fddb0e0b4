"""Look inside: an arc in MuJoCo's own viewer, or in a browser where there is no display."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock

import mujoco

from hyrl_mj import mjcf
from hyrl_mj.errors import BadInput
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks import Task
from hyrl_mj.viz.replay.panel import Track

FPS = 60
PAUSE = 1.0  # [s] between the end of an arc and its beginning
LOOPBACK = "127.0.0.1"
Say = Callable[[str], None]


def view(task: Task, arc: HybridArc, port: int = 0, say: Say = print) -> None:
    """Play an arc again and again in real time, until the viewer is closed.

    Args:
        task: what the arc is of.
        arc: the arc.
        port: of the web viewer; 0 for the first free one from 8080 on.
        say: told where the web viewer is.

    Raises:
        BadArtifact: the arc is not of this task's model.
        BadInput: no viewer can be opened here; the message says why.
    """
    track, data = Track(task, arc), mujoco.MjData(task.model)
    data.qpos[:] = track.qpos(0.0)
    mujoco.mj_forward(task.model, data)
    with (
        _web(task.model, data, port, say)
        if not mjcf.has_display()
        else _window(task.model, data) as viewer
    ):
        began = time.monotonic()
        while viewer.is_running():
            data.time = (time.monotonic() - began) % (track.end + PAUSE)
            data.qpos[:] = track.qpos(min(data.time, track.end))
            mujoco.mj_forward(task.model, data)
            viewer.sync()
            time.sleep(1 / FPS)


def _window(model: mujoco.MjModel, data: mujoco.MjData) -> AbstractContextManager[Any]:
    from mujoco import viewer

    try:
        return viewer.launch_passive(model, data)
    except RuntimeError as error:  # on macOS, outside of mjpython
        raise BadInput(f"MuJoCo's viewer cannot be opened: {error}") from error


def _web(
    model: mujoco.MjModel, data: mujoco.MjData, port: int, say: Say
) -> AbstractContextManager[Any]:
    try:
        from mujoco.studio import launch_thread, viewer_protocol, web_viewer
        from mujoco.studio.web import web_server
    except ImportError as error:
        raise BadInput(
            f"there is no display, and mujoco {mujoco.__version__} has no web viewer ({error}): "
            "pip install 'mujoco>=4', or render a video with hyrl-mj replay"
        ) from error

    try:
        # The viewer would listen to the whole network, without a password, and has no setting for that.
        socket = web_server.bind_public_socket(LOOPBACK, port)
        socket.listen()  # who comes early waits
    except (OSError, OverflowError, RuntimeError) as error:
        raise BadInput(
            f"port {port} cannot be used ({error}): give a free one, 1024 to 65535"
        ) from error

    def serve(endpoint: Any) -> None:
        with (
            mock.patch.object(web_server, "bind_public_socket", return_value=socket),
            mock.patch.object(web_viewer, "_print_url_banner"),
        ):
            viewer = web_viewer.WebViewer(
                viewer_protocol.ViewerConfig(gfx="web"), endpoint, model=model
            )
        viewer_protocol.run_viewer_loop(viewer)

    say(
        f"watch http://{LOOPBACK}:{socket.getsockname()[1]}/ (only from this machine); Ctrl+C ends it"
    )
    handle = launch_thread.launch_thread(serve)
    handle.set_model(model, data=data)
    return handle
