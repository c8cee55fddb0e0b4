"""The commands that repeat a run, and the settings that they would not repeat."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

from hyrl_mj import learning
from hyrl_mj.judging.game import Robustness
from hyrl_mj.learning import STAGES, Settings, preset
from hyrl_mj.policies import ALGORITHMS
from hyrl_mj.runs.directory import Run


def commands(run: Run, robustness: Robustness | None) -> list[str]:
    """Returns the commands that repeat the run, and its examination if that had options of its own."""
    r, lines = robustness, [beginning(run)]
    if r and (r.episodes or r.attacks or not run.is_examined_as_usual):
        lines.append(_examination(r))
    return lines


def beginning(run: Run, out: Path | None = None) -> str:
    """Returns the command that begins or continues such a run; a call if the agent is not from a file."""
    s, agent = run.settings, run.agent
    options: dict[str, object] = {"eps": s.eps} if s.sensor is None else {"noise": s.sensor}
    options |= {"seed": s.seed, "preset": s.preset}
    if not agent and s.stage1.algorithm != run.task.learning.algorithm:
        options["algorithm"] = s.stage1.algorithm
    if s.horizon is not None:
        options["horizon"] = s.horizon
    if s.everywhere:
        options["all_coordinates"] = True
    if changes := _changes(run):
        options["set"] = changes
    if out is not None:
        options["out"] = str(out)
    if agent and not agent.source:
        given = ", ".join(f"{name}={value!r}" for name, value in options.items())
        return f"hyrl_mj.robustify({s.task!r}, policy, {given})"
    words = ["hyrl-mj", *(["robustify", s.task, *agent.options] if agent else ["run", s.task])]
    for name, value in options.items():
        words.append(f"--{name.replace('_', '-')}")
        if isinstance(value, dict):
            words += [f"{setting}={json.dumps(new)}" for setting, new in value.items()]
        elif value is not True:
            words.append(f"{value}")
    return shlex.join(words)


def _examination(robustness: Robustness) -> str:
    """Returns the command that repeats an examination."""
    command = ["hyrl-mj", "robustness", "RUN", "--eps", f"{robustness.eps}"]
    if robustness.everywhere:
        command.append("--all-coordinates")
    if robustness.near_critical:
        command.append("--near-critical")
    counts = robustness.episodes
    if counts:
        kinds = list(dict.fromkeys(c.noise for c in counts))
        one = [c for c in counts if (c.noise, c.controller) == (kinds[0], "hyrl")]
        command += ["--episodes", f"{sum(c.episodes for c in one)}", "--noise", ",".join(kinds)]
    if robustness.attacks:
        command += ["--attack-rounds", f"{robustness.attacks[0].rounds}"]
        command += ["--attack-starts", f"{robustness.attacks[0].starts}"]
    if counts or robustness.attacks:
        command += ["--seed", f"{robustness.seed}"]
    return shlex.join(command)


def changed(run: Run) -> list[str]:
    """Returns the names of the settings that the command does not repeat with this version."""
    s, again = run.settings, learning.changed(_again(run), _changes(run))
    compared = [name for name in vars(s) if _is_known(run) or name not in STAGES]
    return [n.replace("_", " ") for n in compared if getattr(s, n) != getattr(again, n)]


def _changes(run: Run) -> dict[str, object]:
    """Returns the settings that differ from those of this version's preset, as --set takes them."""
    every = learning.changes(run.settings, _again(run))
    return {n: v for n, v in every.items() if _is_known(run) or n.partition(".")[0] not in STAGES}


def _again(run: Run) -> Settings:
    """Returns the settings of this version's preset with the options of a run."""
    s = run.settings
    algorithm = None if run.agent or not _is_known(run) else s.stage1.algorithm
    again = preset(
        run.task, s.preset, eps=s.eps, seed=s.seed, horizon=s.horizon,
        agent=run.agent, algorithm=algorithm,
    )  # fmt: skip
    return replace(again, everywhere=s.everywhere, sensor=s.sensor)


def _is_known(run: Run) -> bool:
    """Whether the algorithm is SB3's own; another one is not imported, so its settings are not compared."""
    return bool(run.agent) or run.settings.stage1.algorithm in ALGORITHMS
