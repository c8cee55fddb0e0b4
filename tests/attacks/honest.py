"""The memory that something honest takes, with which that of something hostile is compared."""

import json
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

from attacks import child, command, crafted_agents
from attacks.damage import open_everything
from attacks.material import RUN, TASK, Material
from hyrl_mj.errors import HyrlError
from hyrl_mj.fields import read_field
from hyrl_mj.fields.driving import Driving
from hyrl_mj.policies import read_agent
from hyrl_mj.tasks import get_task

Work = Callable[[], object]
FIELD = {
    "goal_m": [4.0, 0.0],
    "posts": [{"radius_m": 0.3, "positions_m": [[2.0, 0.1]]}],
    "starts": [{"position_m": [3.2, 0.0], "heading_rad": 0.0}],
    "time_s": 1.0,
}
CIRCLE = "hyrl_mj/UnitCircle-v0"
ARGUMENTS = {"pinned": {"qpos[2]": -0.15, "qpos[3]": 0.0}, "success": "reward >= 1"}


@cache
def most(material: Material, kind: str) -> float:
    """Returns the most memory that a process takes for what is honest [MB], which must not be refused."""
    folder, highest = material.folder / f"honest_{kind}", 0.0
    folder.mkdir()
    for work in WORKS[kind](material, folder):
        answer = child(work, folder, seconds=300)
        if broke := answer.broke(ended=(0, 1)):
            raise SystemExit(f"an honest {kind} is refused: {broke}: {answer.err}")
        highest = max(highest, answer.memory)
    return highest


def diagnose(name: str) -> Work:
    """Examines an agent."""
    return command("diagnose", TASK, "--policy", name, "--preset", "smoke", "--out", f"of_{name}")


def explain(env: str, file: str = "arguments.json") -> Work:
    """Looks at an environment with a file of arguments."""
    return command("diagnose", "--explain", "--env", env, "--env-args", file)


def opened_in_every_way(path: Path) -> list[Work]:
    """Returns what is done with a run directory: it is opened, reported, continued and changed."""
    return [
        partial(open_everything, path),
        command("report", TASK, "--out", "page.html"),
        command("export", TASK, "--to", "numpy", "--out", "controller"),
        command("simulate", TASK),
        command(*RUN),
    ]


def agent(name: str) -> Work:
    """Reads an agent, as all commands that take one do."""
    return answering(lambda: read_agent(get_task(TASK), name))


def robot() -> None:
    """Compiles the model of robot.py."""
    assert get_task("robot.py").model is not None


def drive() -> None:
    """Reads field.json, and makes what drives through it."""
    field = read_field("field.json")
    task = Driving(get_task("field"), field.layouts, time=field.time, starts=field.starts)
    assert task.model is not None


def answering(work: Work) -> Work:
    """Returns some work whose error is a sentence, as that of the command line."""

    def answered() -> None:
        try:
            work()
        except HyrlError as error:
            print(f"hyrl-mj: {error}", file=sys.stderr)
            sys.exit(error.exit_status)

    return answered


def _runs(material: Material, folder: Path) -> list[Work]:
    return [*opened_in_every_way(material.copy(folder)), command("replay", TASK)]


def _agents(material: Material, folder: Path) -> list[Work]:
    return [agent(name) for name in crafted_agents.honest(folder)]


def _arguments(material: Material, folder: Path) -> list[Work]:
    (folder / "arguments.json").write_text(json.dumps(ARGUMENTS), encoding="utf-8")
    (folder / "circle.json").write_text('{"chart": {"angle": "theta"}}', encoding="utf-8")
    return [explain("Reacher-v5"), explain(CIRCLE, "circle.json")]


def _models(material: Material, folder: Path) -> list[Work]:
    return [command("new-task", "robot"), answering(robot)]


def _fields(material: Material, folder: Path) -> list[Work]:
    (folder / "field.json").write_text(json.dumps(FIELD), encoding="utf-8")
    return [answering(drive)]


WORKS: dict[str, Callable[[Material, Path], list[Work]]] = {
    "run": _runs,
    "agent": _agents,
    "environment": _arguments,
    "model": _models,
    "field": _fields,
}
