"""The commands that repeat a run, and the settings that they would not repeat."""

from __future__ import annotations

import shlex
from pathlib import Path

from hyrl_mj.game import Robustness
from hyrl_mj.learning import Settings, preset
from hyrl_mj.policies import Agent
from hyrl_mj.run_directory import Run
from hyrl_mj.tasks import get_task


def commands(settings: Settings, robustness: Robustness | None) -> list[str]:
    """Returns the commands that repeat the run, and its examination if that had options of its own."""
    r, lines = robustness, [beginning(settings)]
    if r and (r.episodes or r.everywhere or r.eps != settings.noise):
        lines.append(_examination(r))
    return lines


def beginning(settings: Settings, out: Path | None = None) -> str:
    """Returns the command that begins or continues such a run; a call if the agent is not from a file."""
    s, agent = settings, settings.stage1 if isinstance(settings.stage1, Agent) else None
    if agent and not agent.source:
        rest = "" if s.horizon is None else f", horizon={s.horizon}"
        rest += "" if out is None else f", out={str(out)!r}"
        return (
            f"hyrl_mj.robustify({s.task!r}, policy, eps={s.noise}, seed={s.seed}, "
            f"preset={s.preset!r}{rest})"
        )
    words = ["hyrl-mj", *(["robustify", s.task, *agent.options] if agent else ["run", s.task])]
    words += ["--eps", f"{s.noise}", "--seed", f"{s.seed}", "--preset", s.preset]
    if not agent and s.stage1.algorithm != get_task(s.task).learning.algorithm:
        words += ["--algorithm", s.stage1.algorithm]
    if s.horizon is not None:
        words += ["--horizon", f"{s.horizon}"]
    if out is not None:
        words += ["--out", f"{out}"]
    return shlex.join(words)


def _examination(robustness: Robustness) -> str:
    """Returns the command that repeats an examination."""
    command = ["hyrl-mj", "robustness", "RUN", "--eps", f"{robustness.eps}"]
    if robustness.everywhere:
        command.append("--all-coordinates")
    counts = robustness.episodes
    if counts:
        kinds = list(dict.fromkeys(c.noise for c in counts))
        one = [c for c in counts if (c.noise, c.controller) == (kinds[0], "hyrl")]
        command += ["--episodes", f"{sum(c.episodes for c in one)}", "--noise", ",".join(kinds)]
        command += ["--seed", f"{robustness.seed}"]
    return shlex.join(command)


def changed(run: Run) -> list[str]:
    """Returns the names of the settings that differ from those of this version's preset."""
    s = run.settings
    again = preset(
        run.task, s.preset, noise=s.noise, seed=s.seed, horizon=s.horizon,
        agent=run.agent, algorithm=None if run.agent else s.stage1.algorithm,
    )  # fmt: skip
    return [n.replace("_", " ") for n, value in vars(s).items() if value != getattr(again, n)]
