"""The commands that repeat a run, and the settings that they would not give again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hyrl_mj.learning import Settings, preset
from hyrl_mj.policies import Agent
from hyrl_mj.run_directory import Run
from hyrl_mj.tasks import get_task


def commands(settings: Settings, robustness: Mapping[str, Any] | None) -> list[str]:
    """What to type to repeat the run, and the examination if it was another than the run's own."""
    s = settings
    lines = [beginning(settings)]
    if robustness and (
        robustness["episodes"] or robustness["everywhere"] or robustness["eps"] != s.noise
    ):
        lines.append(_examination(robustness))
    return lines


def beginning(settings: Settings, out: Path | None = None) -> str:
    """What begins such a run, or goes on with it: a command, or a call where the agent is no file."""
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


def _examination(robustness: Mapping[str, Any]) -> str:
    command = ["hyrl-mj", "robustness", "RUN", "--eps", f"{robustness['eps']}"]
    if robustness["everywhere"]:
        command.append("--all-coordinates")
    records = robustness["episodes"]
    if records:
        kinds = list(dict.fromkeys(r["noise"] for r in records))
        one = [r for r in records if (r["noise"], r["controller"]) == (kinds[0], "hyrl")]
        command += ["--episodes", f"{sum(r['episodes'] for r in one)}", "--noise", ",".join(kinds)]
        if "seed" in robustness:  # older files do not tell
            command += ["--seed", f"{robustness['seed']}"]
    return shlex.join(command)


def changed(run: Run) -> list[str]:
    """Settings that the command would not give again: those of a preset of another version."""
    s = run.settings
    again = preset(
        run.task, s.preset, noise=s.noise, seed=s.seed, horizon=s.horizon,
        agent=run.agent, algorithm=None if run.agent else s.stage1.algorithm,
    ).to_json()  # fmt: skip
    return [name.replace("_", " ") for name, value in s.to_json().items() if value != again[name]]
