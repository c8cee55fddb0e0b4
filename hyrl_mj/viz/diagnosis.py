"""The diagnosis of a policy alone under noise: a run that it loses, and a page about it."""

from __future__ import annotations

from collections.abc import Callable

from markupsafe import Markup

from hyrl_mj.errors import NoRenderer
from hyrl_mj.judging.game import Robustness
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import HybridArc
from hyrl_mj.viz import pages
from hyrl_mj.viz.commands import beginning
from hyrl_mj.viz.figures.style import task_title
from hyrl_mj.viz.options import ReplayOptions
from hyrl_mj.viz.replay import Show, render_replay
from hyrl_mj.viz.report import NO_VIDEO, against_noise, capital
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
    task, folder, agent = run.task, run.path / FOLDER, run.agent
    parts: list[pages.Part] = [[f"{capital(result)}." for result in results]]
    if not len(run.critical_set.points):
        parts.append(
            pages.paragraph(
                "Without a critical set there is nothing to split: to robustify this policy is to train one "
                "policy under noise."
            )
        )
    if arc is not None:
        caption = (
            f"The policy from {task.chart.format(arc.z[0])} under {arc.noise} noise, in real time. The "
            "signal and the run are in diagnosis/worst.npz."
        )
        name = f"Replay of the policy under {arc.noise} noise"
        parts.append(pages.film(folder / "worst.mp4", name, caption) or NO_VIDEO)
    figures = pages.pictures(folder)
    goes_on = "The same run directory then gets a policy for each way, joined with hysteresis:"
    sections: list[pages.Section] = [
        ("Results", parts),
        (
            "Figures",
            figures or [pages.missing("A chart of this kind cannot be drawn in the plane.")],
        ),
        ("Tables", against_noise(run, robustness)),
        ("How to go on", [pages.paragraph(goes_on), pages.code(beginning(run, run.path))]),
    ]
    title, name = task_title(task), pages.name_of(run.path)
    text = pages.fill(
        heading=f"{title}: what noise does to {agent}",
        title=f"{title}: a diagnosis",
        subtitle=Markup(
            "What noise of up to {} {} on what it measures does to <b>{}</b>. Run <b>{}</b>."
        ).format(run.settings.eps, task.noise_on()[1], agent, name),
        sections=sections,
    )
    pages.write(run.path / PAGE, text)
