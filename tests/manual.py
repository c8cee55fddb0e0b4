"""The blocks of README and the manual, and how each is run.

`python tests/manual.py docs/python.md` runs a page.
It makes a run in the current folder, and runs the blocks of each page in order in a folder of its own, which
holds a copy of that run. What would take minutes is shortened, and what needs a network, root or a person at
the screen is checked without running it; `SHORTER` and `instead` say how.
"""

import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planted import TINY

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
LANGUAGES = ("bash", "python", "toml", "json")
# Python that would train for a minute.
SHORTER = {
    'preset="smoke", out="runs/circle_seeds")': f'preset="smoke", out="runs/circle_seeds", set={TINY})',
    'hyrl_mj.run("my_robot.py")': 'hyrl_mj.run("my_robot.py", preset="smoke")',
    "eps=0.1, seed=0)": 'eps=0.1, seed=0, preset="smoke")',
    "learn(300)": "learn(110)",
    'camera="chase")': 'camera="chase", size=(480, 160), fps=2)',
}
TRAINING = ("run", "robustify", "diagnose", "sweep")
EPISODES, FRAMES, SIZE = "20", "2", "480x160"
# What is spent on every task, also with preset smoke.
EFFORT = {"checkpoints": 2, "batches": 1, "nodes": 6, "episodes": 20}
EFFORT |= {"attack_starts": 12, "attack_rounds": 1}
# Scripts that have tests of their own; here their options are looked up.
TESTED = (
    "scripts/benchmark.py",
    "scripts/fields.py",
    "scripts/gallery.py",
    "scripts/outside_agents.py",
    "scripts/reproduce_paper.py",
    "tests/attack.py",
    "tests/trapped_environments.py",
)


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        page: the file.
        line: the number of its first line of text.
        language: what stands behind the fence.
        text: its text.
    """

    page: Path
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"

    @property
    def commands(self) -> list[list[str]]:
        """The words of each command of a block of bash, without comments."""
        lines = (shlex.split(line, comments=True) for line in self.text.splitlines())
        return [words for words in lines if words]


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(page, text.count("\n", 0, match.start(2)) + 1, match[1], match[2])
        for match in re.finditer(r"^```(.*)\n((?:.*\n)*?)^```$", text, re.MULTILINE)
    ]


def shortened(words: list[str]) -> list[str]:
    """A command of `hyrl-mj` that takes seconds: preset smoke, few episodes, frames and pixels."""
    words = list(words)
    if words[0] in TRAINING and not {"--preset", "--report"} & {*words}:
        words += ["--preset", "smoke"]
    if words[0] in ("sweep", "compare") and "--report" not in words:
        words += ["--set", *(f"{name}={value}" for name, value in TINY.items())]
    if words[0] == "replay":
        words += ["--fps", FRAMES, *(() if "--size" in words else ("--size", SIZE))]
    for option, value in (("--episodes", EPISODES), ("--size", SIZE)):
        if option in words:
            words[words.index(option) + 1] = value
    return words


def call(words: list[str]) -> None:
    """Call the command line in this process."""
    from hyrl_mj import cli

    sys.argv = ["hyrl-mj", *words]
    try:
        cli.main()
    except SystemExit as end:
        # Status 1 of a short training is its verdict, FAILED.
        if end.code and not (end.code == 1 and words[0] in TRAINING):
            raise AssertionError(f"hyrl-mj {shlex.join(words)}: status {end.code}") from end


def arguments_of_environments() -> dict[str, dict]:
    """Returns the arguments in JSON files of the environments that the manual makes robust, by their ids."""
    files: dict[str, dict] = {}
    found = {}
    for block in blocks(ROOT / "docs" / "your-environment.md"):
        for words in block.commands if block.language == "bash" else ():
            match words:
                case ["echo", text, ">", file]:
                    files[file] = json.loads(text)
                case ["hyrl-mj", "robustify", "--env", name, "--env-args", file, *_]:
                    found[name] = files[file]
    return found


def extras() -> dict[str, list[str]]:
    """The optional dependencies of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)["project"]["optional-dependencies"]


def instead(words: list[str]) -> bool:
    """Checks a command that is not run, and says whether it is one of these."""
    setup = (ROOT / "scripts" / "setup.sh").read_text(encoding="utf-8")
    match words:
        case [("scripts/demo" | "scripts/test") as script, *options]:  # minutes, network
            subprocess.run(["bash", "-n", ROOT / script], check=True)
            text = (ROOT / script).read_text(encoding="utf-8")
            assert all(option in text for option in options)
        case ["source", path]:  # what setup.sh has made
            assert path.removesuffix("/bin/activate") in setup
        case ["pip", "install", what] | ["python", "-m", "pip", "install", what]:  # network
            name, _, extra = what.removesuffix("]").partition("[")
            assert (
                name in (".", "hyrl-mj") and (not extra or extra in extras())
            ) or name == "pytest"
        case ["apt-get", "install", *packages]:  # root, network
            assert f'gl="{" ".join(packages)}"' in setup
        case ["docker", "build", *_]:  # network
            (libraries,) = re.findall('gl="(.*)"', setup)
            assert libraries in (ROOT / "Dockerfile").read_text(encoding="utf-8")
        case ["docker", "run", "--rm", "-v", _, "hyrl-mj", *rest]:  # in no container
            call(rest)
        case ["tensorboard", "--logdir", folder]:  # serves for ever
            assert shutil.which("tensorboard", path=Path(sys.executable).parent)
            assert list(Path(folder).rglob("events.out.tfevents.*"))
        case ["python", script, *options] if script in TESTED:  # minutes
            text = (ROOT / script).read_text(encoding="utf-8")
            assert all(f'"{option}"' in text for option in options if option.startswith("--"))
        case ["hyrl-mj", "drive", _, "--field", file, *_]:  # it needs a field that was trained
            from hyrl_mj.fields import cautions, check_passable, read_field

            field = read_field(ROOT / file if (ROOT / file).exists() else file)
            check_passable(field, 0.1)
            assert cautions(field, 0.1) == []
        case [
            "hyrl-mj",
            "export",
            _,
            "--to",
            form,
            "--field",
            file,
            *_,
        ]:  # it needs such a run, too
            from hyrl_mj.export.forms import FORMS

            assert form in FORMS
            assert (ROOT / file).exists()
        # A minute, even with preset smoke.
        case ["hyrl-mj", "run", "field" | "rover" | "quadrotor" | "slalom" as task, *_]:
            from hyrl_mj import task_names

            assert task in task_names()
            shutil.copytree("runs/vehicle", Path("runs", task))
        # Minutes. The tests of environments try out what `arguments_of_environments` finds.
        case ["hyrl-mj", "diagnose" | "robustify", "--env", _, "--env-args", file, *options] if (
            "--explain" not in options
        ):
            assert Path(file).exists()
        case ["echo", text, ">", file]:
            Path(file).write_text(text)
        case ["mkdocs", "build", *_]:  # has a test of its own
            assert " ".join(words) in (ROOT / ".mkdocs.yml").read_text(encoding="utf-8")
        case _:
            return False
    return True


def run_command(words: list[str]) -> None:
    """Run a command of a block of bash, or what stands for it."""
    if instead(words):
        return
    match words:
        case ["hyrl-mj", *rest]:
            call(shortened(rest))
        case ["python", "scripts/plain_dqn.py", *rest]:
            sys.argv = ["plain_dqn.py", *rest, "--samples", "256"]
            runpy.run_path(str(ROOT / "scripts" / "plain_dqn.py"), run_name="__main__")
            if Path("made.zip").exists():  # the agent that a test has made robust already
                shutil.copy("made.zip", rest[0])
        case ["python", "-m", "pytest", *rest]:
            assert not pytest.main(["-q", *rest])
        case _:
            raise AssertionError(f"nothing says how to run {shlex.join(words)}")


def run(page: Path) -> None:
    """Run the blocks of a page. Those of Python share their names, as the cells of a notebook."""
    space: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(page):
        print(f"== {block}", flush=True)
        if block.language == "bash":
            for words in block.commands:
                print(f"$ {shlex.join(words)}", flush=True)
                run_command(words)
        elif block.language == "python":
            text = block.text
            for long, short in SHORTER.items():
                text = text.replace(long, short)
            exec(compile("\n" * (block.line - 1) + text, block.page, "exec"), space)
        elif block.language == "json":
            Path("field.json").write_text(block.text)


def agents() -> None:
    """Writes the two files of agents that the page about Python loads."""
    import numpy as np
    import onnx
    from stable_baselines3 import PPO

    import hyrl_mj
    from hyrl_mj.gym_export import BatchedEnv
    from hyrl_mj.gym_export.sb3_env import TaskVecEnv

    circle = hyrl_mj.get_task("unit_circle")
    PPO("MlpPolicy", TaskVecEnv(BatchedEnv(circle, 1)), device="cpu").save("agent.zip")
    observed, u = (
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["n", columns])
        for name, columns in (("observation", 2), ("u", 1))
    )
    weight = onnx.numpy_helper.from_array(np.ones((1, 2), dtype=np.float32), "weight")
    node = onnx.helper.make_node("Gemm", ["observation", "weight"], ["u"], transB=1)
    graph = onnx.helper.make_graph([node], "policy", [observed], [u], [weight])
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, ir_version=8, opset_imports=opset), "agent.onnx")


def few_of(beaten: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function that plays a few of the starts that are attacked, and calls the others lost."""

    def played(
        game: Any, controller: Any, starts: Any, modes: Any, noise: Any, few: int = 8
    ) -> Any:
        first = beaten(game, controller, starts[:few], modes[:few], noise)
        return np.append(first, np.ones(len(starts[few:]), dtype=bool))

    return played


def shorten() -> None:
    """Shortens what is trained and examined in this process and those that it forks."""
    import planted

    from hyrl_mj.judging import episodes
    from hyrl_mj.judging.game import resolution
    from hyrl_mj.judging.proof import counterexamples
    from hyrl_mj.pipeline import comparing, steps
    from hyrl_mj.system import cores
    from hyrl_mj.tasks.unit_circle import UnitCircle

    patch = pytest.MonkeyPatch()
    # In processes of a pool nothing of this would hold.
    patch.setattr(cores.Processes, "map", lambda pool, work, jobs: map(work, jobs))
    planted.shorten(patch)
    planted.coarsen(patch)
    planted.few_noises(patch)
    planted.spare(patch, **EFFORT)
    planted.few_trials(patch)
    patch.setattr(steps, "SPARING", replace(steps.SPARING, **EFFORT))
    patch.setattr(counterexamples, "MOST_CELLS", 2)
    patch.setattr(counterexamples, "beaten", few_of(counterexamples.beaten))
    patch.setattr(episodes, "JUDGED", 4)
    for dimension, few in ((1, 130), (2, 60)):
        patch.setitem(resolution.CURVE_CELLS, dimension, few)
    patch.setattr(UnitCircle, "max_steps", 40)
    for name, few in (("CHOICE_STARTS", 8), ("CHOICE_ROUNDS", 1), ("EPISODES", 16)):
        patch.setattr(comparing, name, few)


def main(pages: list[Path]) -> int:
    """Runs pages, each in a process forked from this one, which has imported everything.

    Returns the exit status: 1 if a page failed. What happened to each stands in its folder.
    """
    from attacks import child, small

    from hyrl_mj.viz import live, viewing

    small.import_late()
    shorten()
    # A viewer waits for a person, and the loops of a robot for the time to pass.
    viewing.view = lambda *arguments: print("viewed", arguments[1])
    live.live = lambda *arguments: print("served", arguments[0])
    made = child(lambda: call(shortened(["run", "vehicle"])), Path.cwd(), seconds=300)
    assert made.status == 0, made.out + made.err

    def work(page: Path) -> None:
        time.sleep = lambda seconds: None
        sys.path.insert(0, "")  # what a block has written can be imported
        if "agent.onnx" in page.read_text(encoding="utf-8"):
            agents()
        run(page)

    failed = 0
    for page in pages:
        folder = Path(page.stem)
        # What a test has made already is there.
        shutil.copytree("runs", folder / "runs", dirs_exist_ok=True)
        answer = child(lambda page=page: work(page), folder, seconds=300)
        failed |= answer.status != 0
        told = {"status": answer.status, "said": answer.out + answer.err, "seconds": answer.seconds}
        (folder / "answer.json").write_text(json.dumps(told))
        print(f"{page.name}: {'failed' if answer.status else 'done'}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main([Path(page).resolve() for page in sys.argv[1:]]))
