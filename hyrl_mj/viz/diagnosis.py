"""The diagnosis of a policy alone under noise: a run that it loses, and a page about it."""

from __future__ import annotations

from collections.abc import Callable

from hyrl_mj.errors import NoRenderer
from hyrl_mj.judging.game import Robustness
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import HybridArc
from hyrl_mj.viz.commands import beginning
from hyrl_mj.viz.options import ReplayOptions
from hyrl_mj.viz.replay import Show, render_replay
from hyrl_mj.viz.report import about, fill, film, pictures, write
from hyrl_mj.viz.shows import replay_floor

# In the run directory: the page, and the folder with its pictures and data.
PAGE, FOLDER = "diagnosis.html", "diagnosis"
REPLAY = ReplayOptions(size=(960, 720))  # of the policy alone


def write_worst(run: Run, arc: HybridArc | None, say: Callable[[str], None]) -> None:
    """Writes the arc and its replay, and removes those of an earlier diagnosis."""
    path = run.path / FOLDER / "worst.npz"
    for suffix in (".npz", ".mp4", ".png"):
        path.with_suffix(suffix).unlink(missing_ok=True)
    if arc is None:
        return
    arc.save(path)
    try:
        floor = replay_floor(run, overlap=False)
        show = Show([arc], title=run.policy_title)
        options = REPLAY.lasting(show.seconds)
        render_replay(run.task, [show], path.with_suffix(".mp4"), options, floor=floor)
    except NoRenderer as error:
        say(f"no video: {error}")


def write_page(run: Run, robustness: Robustness, arc: HybridArc | None, results: list[str]) -> None:
    """Writes the page, with the results in sentences.

    Raises:
        BadArtifact: a picture on it is damaged.
        BadInput: it cannot be written.
    """
    folder = run.path / FOLDER
    text = fill(
        "diagnosis.html",
        run.path,
        **about(run, robustness),
        sentences=results,
        arc=arc,
        video=film(folder / "worst.mp4"),
        pictures=pictures(folder),
        command=beginning(run, run.path),
    )
    write(run.path / PAGE, text)
