"""Descriptions of a stranger: environments, their arguments, MJCFs, agents, fields and sweeps, generated.

None may run code, import what lies in the current folder, end in a traceback, or take more than its share.
"""

import json
import os
import sys
from base64 import b64encode
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

import hyrl_mj
from attacks import MARKER, Trial, child, command, crafted_agents, limited
from attacks.crafted_runs import evil
from attacks.forgery import setting, write
from attacks.material import TASK, Material

# Limits on what is refused: seconds of the processor, and memory in MB; and in all for what is tried in a
# process of its own.
SECONDS, MEMORY, LONGEST = 10.0, 200.0, 20.0
# Modules that an installed one might import, and modules of a stranger's: all lie in the current folder.
MODULES = (
    "imageio",
    "glfw",
    "yaml",
    "click",
    "mujoco",
    "evil",
    "gymnasium_robotics",
    "sitecustomize",
)
ESCAPE = "\x1b]0;owned\x07"
IDS = (
    *4 * ("hyrl_mj/UnitCircle-v0", "hyrl_mj/Vehicle-v0", "Reacher-v5", "Ant-v5"), "CartPole-v1",
    "evil:Env-v0", "evil:UnitCircle-v0", "os:Env-v0", "evil", "", ".", "../evil", "a" * 5_000, ESCAPE,
    "hyrl_mj/UnitCircle-v0 ", "evil.sub:Env-v0", ":Env-v0", "evil:hyrl_mj/UnitCircle-v0",
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
# Names of run directories that a shell, a format or a parser could take for something else.
PATHS = (
    " a b ", "it's", 'q"q', "-dash", "--out", "x" * 200, "über", "$(touch executed)", "`touch executed`",
    "a;touch executed", "%s%n", "{0}", "back\\slash", "#", "~", "a&b<c>", "*", "\u202egnp", "new\nline",
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
    makers = {
        "spec": partial(_spec, material),
        "arguments": _arguments,
        "model": _model,
        "agent": _agent,
        "field": _field,
        "sweep": partial(_sweep, material),
        "path": partial(_path, material),
        "threads": partial(_threads, material),
    }
    kinds = [*makers]
    made = []
    for number in range(count):
        kind, seed = kinds[number % len(kinds)], draw.randrange(2**32)
        given = isinstance(makers[kind], partial)  # of the finished runs
        prepare = material.finished if given else Trial.prepare
        made.append(Trial(f"{kind} {seed}", partial(makers[kind], seed), prepare))
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


def plant_modules(folder: Path) -> None:
    """Puts modules into the current folder that leave the marker behind."""
    for name in MODULES:
        evil(folder, f"{name}.py")


def _broke(work: Callable[[], object], folder: Path, seconds: float = SECONDS) -> str:
    """Returns what is wrong with the answer to something hostile."""
    answer = child(limited(work, 4_000), folder, seconds=3 * seconds)
    if broke := answer.broke(ended=(0, 1, 2)):
        return broke
    if any(folder.rglob(MARKER)):
        return "code of the stranger's was executed"
    if answer.status == 2 and len(answer.err.strip()) > 600:
        return f"a sentence of {len(answer.err)} characters"
    if answer.status == 2 and answer.seconds[1] > seconds:
        return f"takes {answer.seconds[1]:.0f} s to be refused"
    return ""


# ---- the trials


def _spec(material: Material, seed: int, folder: Path) -> str:
    """A received run whose task is an environment."""
    draw, path = Random(seed), material.copy(folder)
    plant_modules(folder)
    spec = f"env:{json.dumps({'env': draw.choice(IDS), **_described(draw, folder)})}"
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
    return _broke(work, folder)


def _arguments(seed: int, folder: Path) -> str:
    """A file of arguments that a stranger wrote, for an environment that the user names."""
    draw = Random(seed)
    plant_modules(folder)
    given = _described(draw, folder)
    text = json.dumps(given)
    text = draw.choice([text] * 9 + ["[" * 100_000, "{" * 1_000, '{"a":' * 50_000, "null", "1e400"])
    (folder / "arguments.json").write_text(text, encoding="utf-8")
    env = draw.choice(("Reacher-v5", "hyrl_mj/UnitCircle-v0", "Ant-v5"))
    words = ("diagnose", "--explain", "--env", env, "--env-args", "arguments.json")
    # The user's own command may import a task that the file names: `task` is code by its name.
    if "evil" in text:
        for name in folder.glob("*.py"):
            if name.stem == "evil":
                name.write_text("raise SystemExit", encoding="utf-8")
    return _broke(command(*words), folder, LONGEST)


def _model(seed: int, folder: Path) -> str:
    """A robot whose MJCF is hostile."""
    draw = Random(seed)
    written = child(command("new-task", "robot"), folder)
    if broke := written.broke(ended=(0,)):
        return broke
    _written(draw, folder)
    return _broke(command("run", "robot.py", "--preset", "smoke"), folder, LONGEST)


def _agent(seed: int, folder: Path) -> str:
    """An agent whose pickles are nested, shared, or refer to themselves."""
    draw = Random(seed)
    keys = ("_last_obs", "_last_original_obs", "observation_space", "action_space")
    pickled = {":type:": "x", ":serialized:": b64encode(_pickle(draw)).decode()}
    data = {"num_timesteps": 1_000, **dict.fromkeys(draw.sample(keys, 3), pickled)}
    name = crafted_agents.write_zip(folder, data=data)
    words = ("diagnose", TASK, "--policy", name, "--preset", "smoke", "--out", "out")
    return _broke(command(*words), folder)


def _pickle(draw: Random) -> bytes:
    """Returns a pickle whose size, where it is written out, has no end."""
    # (x, x) of (x, x) of ...: each tuple is twice the one that was memoised before.
    several = range(draw.randint(20, 90))
    doubled = b")\x94" + b"".join(b"h%c\x86\x94" % number for number in several)
    last = b"h%c" % (doubled.count(b"\x94") - 1)
    kind = draw.choice(("key", "value", "itself", "shape", "type"))
    reconstruct = b"cnumpy.core.multiarray\n_reconstruct\n"
    bodies = {
        "key": b"}(" + doubled + b"K\x01u",
        "value": b"}(X\x01\x00\x00\x00a" + doubled + b"u",
        "itself": b"]\x94h\x00a",
        "shape": reconstruct + b"N\x85R(K\x01" + doubled + b"N\x89C\x01atb",
        "type": b"cnumpy.core.numeric\n_frombuffer\n(C\x01a"
        + doubled
        + last
        + b"X\x01\x00\x00\x00CtR",
    }
    return b"\x80\x04" + bodies[kind] + b"."


def _field(seed: int, folder: Path) -> str:
    """A field at the limits of what a file may hold."""
    draw = Random(seed)
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

    def work() -> None:
        from hyrl_mj.errors import BadInput
        from hyrl_mj.fields import read_field
        from hyrl_mj.fields.driving import Driving
        from hyrl_mj.tasks import get_task

        try:
            field = read_field("field.json")
            local = get_task("field")
            drive = Driving(local, field.layouts, time=field.time, starts=field.starts)
            assert drive.model is not None
        except BadInput as error:
            print(f"hyrl-mj: {error}", file=sys.stderr)
            sys.exit(2)

    (folder / "field.json").write_text(text, encoding="utf-8")
    return _broke(work, folder)


def _path(material: Material, seed: int, folder: Path) -> str:
    """A run directory, and a file to write, with odd names."""
    draw = Random(seed)
    run, out = draw.choice(PATHS), draw.choice(PATHS)
    material.copy(folder).rename(folder / run)
    words = draw.choice(
        (
            ("report", run, "--out", f"{out}.html"),
            ("export", run, "--to", "numpy", "--out", out),
            ("replay", run, "--out", f"{out}.png"),
            ("simulate", run),
        )
    )
    return _broke(command(*words), folder)


def _threads(material: Material, seed: int, folder: Path) -> str:
    """A run that several threads open and use at once."""
    path = material.copy(folder)

    def work() -> None:
        def used(number: int) -> bytes:
            run = hyrl_mj.load_run(path)
            q, measured = np.zeros(8, dtype=int), np.full((8, 1), 0.5 + number % 2)
            return b"".join(np.asarray(part).tobytes() for part in run.controller.step(q, measured))

        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(used, range(16)))
        assert len({*found[::2]}) == 1
        assert len({*found[1::2]}) == 1

    return _broke(work, folder)


def _sweep(material: Material, seed: int, folder: Path) -> str:
    """A received folder of a sweep, whose texts are formulas, links, escapes and elements."""
    draw = Random(seed)
    plant_modules(folder)
    (folder / "sweep").mkdir()
    path = material.copy(folder / "sweep")
    texts = (
        "=cmd|'/c calc'!A0", "@SUM(1)", "| a |", "<img src=x onerror=alert(1)>", ESCAPE, "evil.py",
        "[x](javascript:alert(1))", "env:{}", "../..", f"env:{json.dumps({'env': 'evil:X-v0'})}",
    )  # fmt: skip
    setting(path, "task", draw.choice(texts))
    row: dict[str, Any] = {
        "setting": {"task": draw.choice(texts), "algorithm": draw.choice(texts), "eps": 0.1},
        "seed": 0, "state": draw.choice(("done", "stopped")), "verdict": draw.choice(texts),
        "sentence": draw.choice(texts), "seconds": 1.0, "figures": {draw.choice(texts): 1.0},
    }  # fmt: skip
    common = {"preset": "fast", "horizon": None, "set": {}, "everywhere": False}
    write(folder / "sweep" / "sweep.json", {"common": common, "rows": [row]})
    broke = _broke(command("sweep", "--report", "sweep"), folder)
    page = folder / "sweep" / "sweep.html"
    if not broke and page.exists() and "<img src=x" in page.read_text(encoding="utf-8"):
        return "sweep.html holds an element of the stranger's"
    return broke
