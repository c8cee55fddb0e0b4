"""The replay: stage-1 policy and hybrid controller under the same noise, as a video or a picture."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from hyrl_mj.errors import BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.physics import mjcf
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Task
from hyrl_mj.viz.encoding import ENCODERS, video
from hyrl_mj.viz.options import USUAL, ReplayOptions
from hyrl_mj.viz.replay.marks import Floor, Floors
from hyrl_mj.viz.replay.screen import Screen, Show

__all__ = ["Floor", "Floors", "Show", "check_replay", "render_replay"]


def render_replay(
    task: Task,
    shows: Sequence[Show],
    path: Path,
    options: ReplayOptions = USUAL,
    *,
    floor: Floors | None = None,
) -> None:
    """Writes a video that plays shows one after the other, with a poster beside it; or the poster alone.

    Args:
        task: the task of the arcs; its `scene` names the site whose path is drawn.
        shows: the arcs to play.
        path: of the video, an mp4 or a gif, with the poster as a PNG of the same name; or of a PNG for
            the poster alone. The poster shows the end of the first show.
        options: how the replay is rendered.
        floor: the marks on the floor.

    Raises:
        BadArtifact: an arc is not of this task or its model.
        BadInput: nothing to play, or a value that cannot be used.
        NoRenderer: there is no GL library or no video encoder.
    """
    check_replay(task, path, options)
    camera = options.camera or task.scene.camera
    if not shows or not all(show.policy for show in shows):
        raise BadInput("there is nothing to replay: give shows with arcs of the policy")
    screens = [Screen(task, show, options, camera, floor) for show in shows]
    poster = screens[0].poster()
    if path.suffix in ENCODERS:
        times = [screen.times(options.fps, options.slow_motion) for screen in screens]
        frames = chain.from_iterable(map(Screen.frames, screens, times))
        with video(path, *options.size, options.fps) as add:
            for frame in progress_bar(frames, "rendering", "frames", sum(map(len, times))):
                add(frame)
    with artifacts.replacing(path.with_suffix(".png")) as temporary:
        poster.save(temporary)


def check_replay(task: Task, path: Path, options: ReplayOptions) -> None:
    """Raises `BadInput` if no replay of a task can be written to a path with these options."""
    if path.suffix not in (formats := (*ENCODERS, ".png")):
        raise BadInput(f"{path} is no replay: give a name that ends in one of {', '.join(formats)}")
    mjcf.camera_of(task.model, options.camera or task.scene.camera)
