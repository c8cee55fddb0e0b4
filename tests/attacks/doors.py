"""Descriptions of a stranger: environments, their arguments, MJCFs, agents, fields and sweeps, generated.

None may run code, import what lies in the current folder, end in a traceback, or take more than its share.
"""

import json
import os
from base64 import b64encode
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from attacks import Trial, child, command, crafted_agents, folders, resisted
from attacks.crafted_runs import evil
from attacks.folders import ESCAPE, plant_modules
from attacks.forgery import setting
from attacks.honest import ARGUMENTS, CIRCLE, agent, answering, drive, explain, most, robot
from attacks.material import TASK, Material

# Seconds of the processor within which what is tried in a process of its own must be refused.
LONGEST = 20.0
IDS = (
    *4 * (CIRCLE, "hyrl_mj/Vehicle-v0", "Reacher-v5", "Ant-v5"), "CartPole-v1",
    "evil:Env-v0", "evil:UnitCircle-v0", "os:Env-v0", "evil", "", ".", "../evil", "a" * 5_000, ESCAPE,
    f"{CIRCLE} ", "evil.sub:Env-v0", ":Env-v0", "evil:hyrl_mj/UnitCircle-v0",
)  # fmt: skip
DIGITS = int("9" * 400)
NAMES = (
    "qpos[0]",
    "qpos[²]",
    "core",
    "__class__",
    "__dict__",
    "z",
    ESCAPE,
    "a" * 5_000,
    "qpos[99999999999]",
)
EXPRESSIONS = (
    "__import__('os').system('touch executed')", "open('executed', 'w')", "(" * 5_000, "x" * 100_000,
    "info['a'].__class__", "reward >= 1e400", "distance('a', 'b') <= 1 ** 99999999", ESCAPE, "lambda: 1",
)  # fmt: skip
# Share of the descriptions in which one thing is wrong: in the others there are several.
POINTED = 0.6
# What tells arguments of the robot arm from those of the circle.
ROBOT = {"xml_file", "frame_skip", *ARGUMENTS}
# Arguments of which one is wrong.
WRONG: tuple[dict[str, Any], ...] = (
    {"pinned": {"qpos[²]": 1}}, {"pinned": {"core": 1}}, {"pinned": {"__class__": 1}},
    {"reset": {"z": [1, [2]]}}, {"pinned": {"qpos[0]": DIGITS}}, {"noisy": [10**400]},
    {"bounds": {"theta": [0, float("inf")]}}, {"chart": {"\x1b[31m": "theta"}},
    {"chart": ["a" * 3_000_000]}, {"success": "(" * 5_000}, {"success": "a" * 100_000},
    {"kwargs": {"\x1b": 1}}, {"steps": 10**400}, {"seed": -(10**400)},
    {"reset": {"a": {"array": ["a" * 10**6] + [""] * 400}}}, {"pinned": {"z": ["a" * 10**6] + [""] * 400}},
)  # fmt: skip
# Hostile models: the text of an MJCF, in which {fifo} is a file that nobody writes to.
# fmt: off
MODELS = {
    "attaches itself": '<asset><model name="m" file="robot.xml"/></asset><worldbody><attach model="m" '
    'body="b" prefix="p"/><body name="b"><geom size="1"/></body></worldbody>',
    "includes itself": '<include file="robot.xml"/>',
    "includes a FIFO": '<include file="fifo"/>',
    "a mesh of a FIFO": '<asset><mesh name="m" file="fifo" content_type="model/obj"/></asset>',
    "a wide height field": '<asset><hfield name="h" nrow="{big}" ncol="{big}" size="1 1 1 1"/></asset>',
    "a large texture": '<asset><texture name="t" type="2d" builtin="flat" width="{big}" height="{big}"/>'
    "</asset>",
    "replicates": '<worldbody><replicate count="{many}" offset="1 0 0"><geom size="1"/></replicate>'
    "</worldbody>",
    "keys": '<size nkey="{many}"/>',
    "memory": '<size memory="{many}M"/>',
    "user data": '<size nuserdata="{many}"/>',
    "iterations": '<option iterations="2000000000" tolerance="0" integrator="implicit"/><worldbody><body>'
    '<freejoint/><geom size="1" mass="1"/></body><geom type="plane" size="9 9 1" pos="0 0 0.5"/></worldbody>',
    "flex": '<worldbody><flexcomp name="f" type="grid" count="{some} {some} {some}" spacing="1 1 1" '
    'radius="0.1"/></worldbody>',
    "nested bodies": "<worldbody>" + "<body>" * 30_000 + "</body>" * 30_000 + "</worldbody>",
    "an escape in a name": '<worldbody><geom name="&#27;[31m" size="1"/></worldbody>',
    "a plugin": '<extension><plugin plugin="evil.plugin"/></extension>',
    "no number": '<worldbody><geom size="nan"/></worldbody>',
    "an unknown default": '<worldbody><geom class="b" size="1"/></worldbody>',
}
# fmt: on


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns trials of each kind, drawn at random."""
    # What makes a trial, what its memory is compared with, how many of 23 are of this kind, and how many at
    # most: of those in which little is drawn there are few.
    kinds = {
        "spec": (_spec, "run", 4, count),
        "arguments": (_arguments, "environment", 4, count),
        "agent": (_agent, "agent", 5, count),
        "model": (_model, "model", 3, count),
        "field": (_field, "field", 2, count),
        "sweep": (folders.sweep, "run", 1, count),
        "path": (folders.path, "run", 1, count),
        "threads": (folders.threads, "run", 1, 2),
        "other": (_other, "run", 1, count),
        "modules": (folders.modules, "environment", 1, 4),
    }
    turns = [kind for turn in range(5) for kind in kinds if kinds[kind][2] > turn]
    made: list[Trial] = []
    for number in range(count):
        kind, seed = turns[number % len(turns)], draw.randrange(2**32)
        make, compared, _, at_most = kinds[kind]
        if number // len(turns) < at_most:
            honest = partial(most, material, compared)
            attempt = partial(_attempt, make, material, honest, seed)
            made.append(Trial(f"{kind} {seed}", attempt, honest))
    return made


# ---- what is drawn


def _value(draw: Random, folder: Path, depth: int = 0) -> Any:
    """Returns a value that a stranger may write as an argument."""
    leaves: list[Callable[[], Any]] = [
        lambda: str(evil(folder)),
        lambda: "evil.py",
        lambda: str(_written(draw, folder)),
        lambda: "robot.xml",
        lambda: "evil",
        lambda: "evil:X",
        lambda: "../../../../etc/passwd",
        lambda: f"env:{json.dumps({'env': draw.choice(IDS), 'kwargs': {'task': 'evil.py'}})}",
        lambda: ESCAPE,
        lambda: "a" * 100_000,
        lambda: DIGITS,
        lambda: -1,
        lambda: 10**9,
        lambda: float("inf"),
        lambda: None,
        lambda: True,
        lambda: 0.5,
    ]
    if depth < 3 and draw.random() < 0.3:
        inner = [_value(draw, folder, depth + 1) for _ in range(draw.randrange(4))]
        return inner if draw.random() < 0.5 else {draw.choice(NAMES): part for part in inner}
    if depth == 0 and draw.random() < 0.03:
        nested: Any = []
        for _ in range(200):
            nested = [nested]
        return nested
    return draw.choice(leaves)()


def _described(draw: Random, folder: Path) -> dict[str, Any]:
    """Returns the arguments of `from_gymnasium` as a stranger may write them."""
    given: dict[str, Any] = {}
    keys = ("task", "xml_file", "frame_skip", "width", "noise", "id", "entry_point", "evil")
    if draw.random() < 0.7:
        given["kwargs"] = {
            draw.choice(keys): _value(draw, folder) for _ in range(draw.randint(1, 2))
        }
    for name in draw.sample(("reset", "pinned", "chart", "noisy", "bounds", "success", "failure",
                             "steps", "starts", "seed", "evil", "reset"), draw.randrange(3)):  # fmt: skip
        if name in ("success", "failure"):
            given[name] = draw.choice(EXPRESSIONS)
        elif name in ("reset", "pinned", "bounds") and draw.random() < 0.8:
            given[name] = {draw.choice(NAMES): _value(draw, folder)}
        else:
            given[name] = _value(draw, folder)
    return given


def _pointed(draw: Random, folder: Path) -> tuple[str, dict[str, Any]]:
    """Returns the id and the arguments of an environment in which nothing is wrong but one thing, at most."""
    name = draw.choice(NAMES)
    doors = (
        {"kwargs": {"task": str(evil(folder))}},
        {"chart": {name: "theta"}},
        {"kwargs": {"xml_file": str(_written(draw, folder))}},
        {"kwargs": {"frame_skip": 10**9}},
        ARGUMENTS,
    )
    given = draw.choice((*3 * doors, *WRONG))
    return "Reacher-v5" if ROBOT & given.get("kwargs", given).keys() else CIRCLE, given


def _written(draw: Random, folder: Path) -> Path:
    """Writes a hostile MJCF, and returns its path."""
    name = draw.choice([*MODELS])
    numbers = {
        "{big}": draw.choice((30_000, 10**6)),
        "{many}": draw.choice((10**8, 2 * 10**9)),
        "{some}": 300,
    }
    text = MODELS[name]
    for mark, number in numbers.items():
        text = text.replace(mark, str(number))
    path = folder / "robot.xml"
    path.write_text(f"<mujoco>{text}</mujoco>", encoding="utf-8")
    if not (folder / "fifo").exists():
        os.mkfifo(folder / "fifo")
    return path


# ---- the trials: each is of some finished runs, the memory of what is honest, and random numbers


def _attempt(
    make: Callable[[Material, float, Random, Path], str],
    material: Material,
    honest: Callable[[], float],
    seed: int,
    folder: Path,
) -> str:
    return make(material, honest(), Random(seed), folder)


def _spec(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A received run whose task is an environment."""
    path = material.copy(folder)
    plant_modules(folder)
    env, given = draw.choice(IDS), _described(draw, folder)
    if draw.random() < POINTED:
        env, given = _pointed(draw, folder)
    spec = f"env:{json.dumps({'env': env, **given})}"
    spec = draw.choice(
        [spec] * 9 + ["env:", "env:{", "env:[" + "[" * 100_000, "env:null", 'env:{"env":1}']
    )
    setting(path, "task", spec)
    work = draw.choice(
        (
            command("report", TASK, "--out", "page.html"),
            command("export", TASK, "--to", "numpy", "--out", "controller"),
            command("simulate", TASK),
            command("replay", TASK),
        )
    )
    return resisted(work, folder, memory)


def _arguments(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A file of arguments that a stranger wrote, for an environment that the user names."""
    plant_modules(folder)
    env = draw.choice(("Reacher-v5", CIRCLE, "Ant-v5"))
    given = _described(draw, folder)
    if draw.random() < POINTED:
        env, given = _pointed(draw, folder)
    text = json.dumps(given)
    text = draw.choice([text] * 9 + ["[" * 100_000, "{" * 1_000, '{"a":' * 50_000, "null", "1e400"])
    (folder / "arguments.json").write_text(text, encoding="utf-8")
    # The user's own command may import a task that the file names: `task` is code by its name.
    if "evil" in text:
        (folder / "evil.py").write_text("raise SystemExit", encoding="utf-8")
    return resisted(explain(env), folder, memory, seconds=LONGEST)


def _model(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A robot whose MJCF is hostile."""
    if broke := child(command("new-task", "robot"), folder).broke(ended=(0,)):
        return broke
    _written(draw, folder)
    return resisted(answering(robot), folder, memory, seconds=LONGEST)


def _agent(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """An agent whose pickles are nested, shared, or refer to themselves."""
    keys = ("_last_obs", "_last_original_obs", "observation_space", "action_space")
    pickled = {":type:": "x", ":serialized:": b64encode(_pickle(draw)).decode()}
    # By its clip_range it is an agent of PPO, whose observations are looked at.
    data = {"num_timesteps": 1_000, "clip_range": 0.2, **dict.fromkeys(keys, pickled)}
    return resisted(agent(crafted_agents.write_zip(folder, data=data)), folder, memory)


def _pickle(draw: Random) -> bytes:
    """Returns a pickle whose size, where it is written out, has no end."""
    # (x, x) of (x, x) of ...: each tuple is twice the one that was memoised before.
    several = range(draw.randint(20, 90))
    doubled = b")\x94" + b"".join(b"h%c\x86\x94" % number for number in several)
    last = b"h%c" % (doubled.count(b"\x94") - 1)
    kind = draw.choice(("key", "value", "itself", "shape", "type", "name"))
    reconstruct = b"cnumpy.core.multiarray\n_reconstruct\n"
    bodies = {
        "key": b"}(" + doubled + b"K\x01u",
        "value": b"}(X\x01\x00\x00\x00a" + doubled + b"u",
        "itself": b"]\x94h\x00a",
        # The name of a function of the module and attribute that it is itself: twice as long each time.
        "name": b"X\x01\x00\x00\x00a\x94"
        + b"".join(b"h%ch%c\x93\x94" % (number, number) for number in several),
        "shape": reconstruct + b"N\x85R(K\x01" + doubled + b"N\x89C\x01atb",
        "type": b"cnumpy.core.numeric\n_frombuffer\n(C\x01a"
        + doubled
        + last
        + b"X\x01\x00\x00\x00CtR",
    }
    return b"\x80\x04" + bodies[kind] + b"."


def _log(memory: float, draw: Random, folder: Path) -> str:
    """A log of many columns, of many gaps, or of many rows."""
    columns, rows, gaps = draw.choice(((190, 60, 0.0), (1, 100_000, 0.5), (2, 200_000, 0.0)))
    names = ",".join(f"c{i},c{i}_ref" for i in range(columns))
    t, lines = 0.0, [f"t,{names}"]
    for _ in range(rows):
        t += 2.0 if draw.random() < gaps else 0.01
        lines.append(f"{t:.2f}," + ",".join(f"{draw.random():.3f},0" for _ in range(columns)))
    (folder / "log.csv").write_text("\n".join(lines), encoding="utf-8")
    return resisted(command("noise", "log.csv"), folder, memory)


def _other(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A log, the folder of a comparison, or a run of another user."""
    if draw.random() < 0.5:
        return folders.user(material, memory, draw, folder)
    return draw.choice((_log, folders.comparison))(memory, draw, folder)


def _field(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A field at the limits of what a file may hold."""
    far = draw.choice((0.01, 1.0, 200.0, 999.0))

    def point() -> list[float]:
        return [draw.uniform(-far, far), draw.uniform(-far, far)]

    posts = [
        {"radius_m": draw.choice((1e-9, 0.01, 0.04, 0.5, 300.0)), "positions_m": [point()]}
        for _ in range(draw.choice((1, 2, 5)))
    ]
    content: Any = {
        "goal_m": point(),
        "posts": posts,
        "starts": [{"position_m": point(), "heading_rad": draw.uniform(-9, 9)}],
    }
    text = json.dumps(content)
    if draw.random() < 0.3:
        text = "{" + ",".join(f'"k{i % 20_000}":1' for i in range(40_000)) + "}"

    (folder / "field.json").write_text(text, encoding="utf-8")
    return resisted(answering(drive), folder, memory)
