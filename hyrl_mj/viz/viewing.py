"""An arc in MuJoCo's own viewer, or in a browser where there is no display.

The page for the browser is served by mjviser, an optional package that shows MuJoCo models with viser. The
web viewer that MuJoCo 4 brings along listens to the whole network, and has no setting for that.
"""

from __future__ import annotations

import logging
import socket
import time
from asyncio import get_running_loop
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from copy import copy
from inspect import isawaitable
from io import StringIO
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import mujoco

from hyrl_mj.errors import LARGEST_NUMBER, LONGEST, BadInput
from hyrl_mj.physics import mjcf
from hyrl_mj.simulation import HybridArc
from hyrl_mj.system.gl import has_display
from hyrl_mj.system.progress import Say
from hyrl_mj.tasks import Task
from hyrl_mj.viz.replay.panel import Track

FPS = 60
PAUSE = 1.0  # [s] between the end of an arc and its beginning
LOOPBACK = "127.0.0.1"
# What a page of ours sends: what its user chooses, its camera, and where a handle is.
MESSAGES = (
    "GuiUpdateMessage", "ViewerCameraMessage", "TransformControlsUpdateMessage",
    "TransformControlsDragStartMessage", "TransformControlsDragEndMessage",
)  # fmt: skip


def view(task: Task, arc: HybridArc, port: int = 0, say: Say = print) -> None:
    """Plays an arc again and again in real time, until the viewer is closed.

    Args:
        task, arc: the arc and its task.
        port: of the web viewer, 1 to 65535; 0 for the first free one from 8080 on.
        say: called with the address of the web viewer.

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


def play(track: Track, model: mujoco.MjModel, data: mujoco.MjData, viewer: Any) -> None:
    """Moves a model along an arc, again and again in real time, until the viewer is closed.

    The viewer has `is_running()`, and `sync()` to show the data. A slow viewer shows fewer frames; the arc
    does not slow down.
    """
    began = due = time.monotonic()
    while viewer.is_running():
        show(track, model, data, (time.monotonic() - began) % (track.end + PAUSE))
        viewer.sync()
        now = time.monotonic()
        due = max(due + 1 / FPS, now)  # frames that are late are not caught up with
        time.sleep(due - now)


def show(track: Track, model: mujoco.MjModel, data: mujoco.MjData, t: float) -> None:
    """Sets the data to the state of an arc at the time t [s], or at its end after that."""
    data.time = t
    mjcf.place(model, data, track.qpos(min(t, track.end)), track.task.mocap)
    mujoco.mj_forward(model, data)


def _window(model: mujoco.MjModel, data: mujoco.MjData) -> AbstractContextManager[Any]:
    """Opens MuJoCo's viewer."""
    from mujoco import viewer

    try:
        return viewer.launch_passive(model, data)
    except RuntimeError as error:  # on macOS, outside of mjpython
        raise BadInput(
            f"MuJoCo's viewer cannot be opened ({error}): make a video with hyrl-mj replay"
        ) from error


@contextmanager
def _web(model: mujoco.MjModel, data: mujoco.MjData, port: int, say: Say) -> Iterator[Any]:
    """Serves a page that is never closed: one that a user closes can be opened again."""
    with served(model, data, port, say) as (_, scene):
        yield SimpleNamespace(is_running=lambda: True, sync=lambda: scene.update_from_mjdata(data))


@contextmanager
def served(
    model: mujoco.MjModel, data: mujoco.MjData, port: int, say: Say
) -> Iterator[tuple[Any, Any]]:
    """Serves a page with a model until the block ends, which gets viser's server and mjviser's scene."""
    try:
        import viser
        from mjviser import ViserMujocoScene
    except ImportError as error:
        raise BadInput(
            f"the viewer for a browser needs the package mjviser ({error}): "
            'pip install "hyrl-mj[view]", or make a video with hyrl-mj replay'
        ) from error

    try:  # viser would wait forever for a port that is in use, reserved or invalid
        socket.create_server((LOOPBACK, port)).close()
    except (OSError, OverflowError) as error:
        raise BadInput(
            f"port {port} cannot be used ({error}): give a free one, 1024 to 65535, or none"
        ) from error
    with redirect_stdout(StringIO()), _for_this_machine():  # viser prints where it listens
        server = viser.ViserServer(host=LOOPBACK, port=port or 8080, verbose=False)
    try:
        # The button would ask a server on the internet for an address that everyone can open.
        server.gui.configure_theme(show_share_button=False)
        scene = ViserMujocoScene(server, model, num_envs=1)
        scene.camera_tracking_enabled = False  # the robot moves, and not the world around it
        scene.create_visualization_gui(
            camera_distance=model.stat.extent,
            camera_azimuth=model.vis.global_.azimuth,
            camera_elevation=-model.vis.global_.elevation,  # MuJoCo's is negative from above
        )
        scene.update_from_mjdata(data)
        address = f"http://{LOOPBACK}:{server.get_port()}/"
        say(f"watch {address} (only from this machine); Ctrl+C ends it")
        yield server, scene
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


@contextmanager
def _for_this_machine() -> Iterator[None]:
    """Lets servers that are begun in the block refuse the pages of other addresses that a browser holds open.

    viser looks neither at the host that a browser asks for nor at the page that asks, sets any attribute of
    a control that a message names, and makes the page public if one asks for that. What a page of ours does
    not send is passed over, and writes nothing to the terminal.
    """
    from websockets.asyncio import server

    class Connection(server.ServerConnection):
        async def recv(self, decode: bool | None = None) -> Any:
            while not _is_usual(content := await super().recv(decode)):
                pass
            return content

    serve, silent = server.serve, logging.getLogger("hyrl_mj.viewer")
    silent.disabled = True

    def checked(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        async def answer(connection: Any, request: Any) -> Any:
            get_running_loop().set_exception_handler(lambda *_: None)  # of viser's thread
            hosts, origins = map(request.headers.get_all, ("Host", "Origin"))
            known = [host.rpartition(":")[0] in (LOOPBACK, "localhost") for host in hosts] == [True]
            if not known or any(urlsplit(origin).netloc != hosts[0] for origin in origins):
                return connection.respond(403, "This page can only be seen from this machine.\n")
            found = process_request and process_request(connection, request)
            return await found if isawaitable(found) else found

        own = {"logger": silent, "max_size": 2**16, "create_connection": Connection}
        return serve(*arguments, process_request=answer, **{**options, **own})

    setattr(server, "serve", checked)  # noqa: B010 - mypy takes it for a type
    try:
        yield
    finally:
        setattr(server, "serve", serve)  # noqa: B010


def _is_usual(content: Any) -> bool:
    """Returns whether a page sends this: a choice of its user, its camera, or the place of a handle."""
    from msgspec import DecodeError, msgpack

    try:
        message = msgpack.decode(content)
        known = message["type"] in MESSAGES and [*message.get("updates", ["value"])] == ["value"]
        values = {**message, **message.get("updates", {})}
    except (DecodeError, TypeError, KeyError, AttributeError, RecursionError):
        return False
    return known and all(_is_plain(values[name], name) for name in values if name != "updates")


def _is_plain(value: Any, name: str) -> bool:
    """Returns whether a value is a short text, a number, or the numbers of a vector, a turn or a colour."""
    if isinstance(value, list):
        numbers = [v for v in value if isinstance(v, int | float) and _is_plain(v, name)]
        return len(value) == len(numbers) == (4 if name == "wxyz" else 3)
    if isinstance(value, str):
        return len(value) <= LONGEST
    return isinstance(value, int | float) and abs(value) <= LARGEST_NUMBER  # not NaN
