"""What a stranger wrote runs no code, takes no more than its share, and overwrites nothing."""

import contextlib
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import replace
from pathlib import Path
from random import Random

import gymnasium as gym
import numpy as np
import pytest
from attacks import doors, folders
from command_line import call

from hyrl_mj.errors import BadInput
from hyrl_mj.fields import read_field
from hyrl_mj.fields.driving import Driving
from hyrl_mj.files import artifacts, trust
from hyrl_mj.gym_import import from_gymnasium, making, opening
from hyrl_mj.gym_import.making import from_spec
from hyrl_mj.physics import mjcf
from hyrl_mj.policies import pickled
from hyrl_mj.sets import Chart
from hyrl_mj.system import limits, streams
from hyrl_mj.tasks import ENVIRONMENT, get_task
from hyrl_mj.viz.tables import Table, markdown

pytestmark = pytest.mark.usefixtures("few_trials")
CIRCLE = "hyrl_mj/UnitCircle-v0"
LONGEST = 500  # of a sentence [characters], without the mark of what is left out


def spec_of(env, **given):
    return ENVIRONMENT + json.dumps({"env": env, **given})


def code(folder, name="notes.py"):
    """A file of code that leaves a file behind when it runs."""
    path = folder / name
    path.write_text(f"open({str(folder / 'executed')!r}, 'w').close()\n")
    return path


def refusal(work):
    """The sentence with which something is refused."""
    with pytest.raises(BadInput) as error:
        work()
    sentence = str(error.value)
    assert len(sentence) <= LONGEST + 10
    assert sentence.isprintable()
    return sentence


@pytest.fixture(autouse=True)
def hurried(monkeypatch):
    """What never ends is stopped after a second of the processor, and not after twelve."""
    monkeypatch.setitem(limits.tried.__kwdefaults__, "seconds", 1)
    monkeypatch.setattr(limits.limit, "__defaults__", (1, limits.MEMORY))


@pytest.fixture
def inspected(monkeypatch):
    """Returns a function after which environments are found to be as that of a task was."""

    def as_of(task):
        def inspect(description, untried):
            spec, pool = task.specification, copy(task._pool)
            pool.spec = replace(spec, description=description, max_steps=description.steps)
            return pool, task._instance

        monkeypatch.setattr(making, "inspect", inspect)
        monkeypatch.setattr(making, "_MADE", {})

    return as_of


# ---- what a file describes


@pytest.mark.parametrize(
    ("env", "given"),
    [
        (CIRCLE, {"kwargs": {"task": "notes.py"}}),
        (CIRCLE, {"kwargs": {"task": spec_of(CIRCLE, kwargs={"task": "notes.py"})}}),
        ("Reacher-v5", {"kwargs": {"xml_file": "robot.xml"}}),
        ("Reacher-v5", {"kwargs": {"xml_file": "robot"}}),
        ("notes:Env-v0", {}),
        ("notes", {}),
        ("Reacher-v5", {"kwargs": {"noise": ["a/b"]}}),
    ],
)
def test_a_received_environment_runs_no_code_and_opens_no_file(env, given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = code(tmp_path)
    (tmp_path / "robot").write_text("<mujoco/>")
    with trust.received():
        sentence = refusal(lambda: get_task(spec_of(env, **given)))
    assert "hyrl-mj diagnose --explain --env" in sentence
    assert not (tmp_path / "executed").exists()
    assert not trust.is_known(path)


def test_an_environment_runs_no_task_file_that_a_file_or_an_argument_names(tmp_path):
    path = code(tmp_path)
    with trust.received():
        assert "executes no file" in refusal(lambda: gym.make(CIRCLE, task=str(path)))
    refusal(lambda: from_gymnasium(CIRCLE, kwargs={"task": str(path)}))
    assert not (tmp_path / "executed").exists()


@pytest.mark.slow
def test_a_file_in_another_folder_is_another_file(tmp_path, monkeypatch, inspected):
    path = Path(gym.envs.mujoco.__file__).parent / "assets" / "reacher.xml"
    folders = [tmp_path / name for name in ("own", "theirs")]
    for folder in folders:
        folder.mkdir()
        (folder / "r.xml").write_text(path.read_text())
    monkeypatch.chdir(folders[0])
    chart = {"shoulder": "qpos[0]", "elbow": "qpos[1]"}
    pinned = {"qpos[2]": -0.15, "qpos[3]": 0.0}
    own = from_gymnasium(
        "Reacher-v5", kwargs={"xml_file": "./r.xml"}, chart=chart, pinned=pinned,
        success="distance(fingertip, target) <= 0.05", steps=9,
    )  # fmt: skip
    inspected(own)
    monkeypatch.chdir(folders[1])
    with trust.received():
        refusal(lambda: from_spec(own.spec))
    monkeypatch.chdir(folders[0])
    with trust.received():
        assert from_spec(own.spec).spec == own.spec


@pytest.mark.slow
def test_what_this_machine_has_described_opens_again(inspected):
    spec = spec_of(CIRCLE, kwargs={"task": "unit_circle"}, steps=17, seed=3)
    with trust.received():
        task = from_spec(spec)  # plain words
    assert task.max_steps == 17
    assert not trust.is_known_text(task.spec)
    inspected(task)
    own = from_gymnasium(CIRCLE, kwargs={"task": "unit_circle", "camera": None}, steps=18)
    assert trust.is_known_text(own.spec)
    making._MADE.clear()
    with trust.received():
        assert from_spec(own.spec).max_steps == 18


def test_what_a_file_asks_for_is_not_recorded(tmp_path):
    path = tmp_path / "code.py"
    path.write_text("")
    with trust.received():
        trust.remember(path)
        trust.remember_text("text")
    assert not trust.is_known(path)
    assert not trust.is_known_text("text")


@pytest.mark.slow
@pytest.mark.parametrize("given", doors.WRONG)
def test_an_argument_that_is_none_is_one_sentence(given):
    refusal(lambda: from_gymnasium(CIRCLE, **given))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"env":', "null", '{"env": {"a": 1}}', "[]", "1"])
def test_a_damaged_description_is_one_sentence(text):
    refusal(lambda: get_task(ENVIRONMENT + text))


# ---- limits


@pytest.mark.slow
@pytest.mark.parametrize("name", doors.MODELS)
def test_a_hostile_model_is_one_sentence(name, tmp_path, monkeypatch):
    monkeypatch.setattr(doors, "MODELS", {name: doors.MODELS[name]})
    monkeypatch.setitem(limits.tried.__kwdefaults__, "seconds", 1)
    monkeypatch.setitem(limits.tried.__kwdefaults__, "longest", 3)
    path = doors._written(Random(0), tmp_path)
    began = time.monotonic()
    refusal(lambda: mjcf.load(path))
    assert time.monotonic() - began < doors.LONGEST


def test_a_model_of_the_users_own_is_tried_once(tmp_path, monkeypatch):
    path = tmp_path / "robot.xml"
    path.write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    assert mjcf.load(path).ngeom == 1
    monkeypatch.setattr("hyrl_mj.system.limits.tried", None)  # not called again
    mjcf._LOADED.clear()
    assert mjcf.load(path).ngeom == 1


@pytest.mark.slow
def test_an_environment_of_a_hostile_model_is_one_sentence(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(f"<mujoco>{doors.MODELS['attaches itself']}</mujoco>")
    sentence = refusal(lambda: from_gymnasium("Reacher-v5", kwargs={"xml_file": str(path)}))
    assert "crash" in sentence


@pytest.mark.slow
def test_an_environment_that_this_process_registered_takes_arguments_also_arrays():
    def make(goal, **kwargs):
        assert isinstance(goal, np.ndarray)
        return gym.make("Reacher-v5", **kwargs).unwrapped

    gym.register("OwnReacher-v0", make, max_episode_steps=50)
    chart = {"shoulder": "qpos[0]", "elbow": "qpos[1]"}
    pinned = {"qpos[2]": -0.15, "qpos[3]": 0.0}
    task = from_gymnasium(
        "OwnReacher-v0", kwargs={"goal": np.array([1.0, 2.0]), "frame_skip": 3}, chart=chart,
        pinned=pinned, success="distance(fingertip, target) <= 0.05",
    )  # fmt: skip
    assert task.max_steps == 50


@pytest.mark.slow
def test_a_step_that_takes_long_is_one_sentence(monkeypatch):
    monkeypatch.setitem(limits.tried.__kwdefaults__, "seconds", limits.SECONDS)
    monkeypatch.setattr(limits.limit, "__defaults__", (limits.SECONDS, limits.MEMORY))
    given = {"pinned": {"qpos[2]": -0.15, "qpos[3]": 0.0}, "success": "reward >= 1"}
    sentence = refusal(lambda: from_gymnasium("Reacher-v5", kwargs={"frame_skip": 60_000}, **given))
    assert "whose step takes less than" in sentence


@pytest.mark.slow
def test_an_environment_that_never_ends_a_step_is_one_sentence():
    given = {"pinned": {"qpos[2]": 0.1, "qpos[3]": 0.1}, "kwargs": {"frame_skip": 2_000_000_000}}
    sentence = refusal(lambda: from_gymnasium("Reacher-v5", success="reward >= 1", **given))
    assert "takes longer than" in sentence


@pytest.mark.slow
def test_a_model_writes_no_warnings_into_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "robot.xml"
    path.write_text(
        '<mujoco><option timestep="1" gravity="1e20 0 0"/><worldbody><body><freejoint/>'
        '<geom size="1"/></body></worldbody></mujoco>'
    )
    mjcf.load(path)
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_model_beside_a_link_is_read_beside_it(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "part.xml").write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    real = tmp_path / "real" / "robot.xml"
    real.write_text('<mujoco><include file="part.xml"/></mujoco>')
    (tmp_path / "robot.xml").symlink_to(real)
    assert mjcf.load(tmp_path / "robot.xml").ngeom == 1


@pytest.mark.parametrize("seed", range(8))
def test_a_nested_pickle_takes_no_time(seed):
    began = time.monotonic()
    found = pickled.arrays(doors._pickle(Random(seed)))
    assert all(isinstance(value, np.ndarray) for value in found.values())
    assert time.monotonic() - began < 5


# ---- modules in the current folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("doctor",),
        ("diagnose", "--env", "Reacher-v5"),
        ("sweep", "unit_circle", "--address", "127.0.0.1:{port}"),
    ],
)
def test_nothing_is_imported_from_the_current_folder(words, tmp_path):
    for name in folders.MODULES:
        code(tmp_path, f"{name}.py")
    with socket.create_server(("127.0.0.1", 0)) as listener:  # it answers, and is no cluster
        port = listener.getsockname()[1]
        program = [sys.executable, "-P", "-c", folders.PROGRAM]
        words = [word.format(port=port) for word in words]
        subprocess.run([*program, *words], cwd=tmp_path, capture_output=True, check=False)
    assert not (tmp_path / "executed").exists()


def test_a_module_that_the_user_names_comes_last(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = [*sys.path]
    with trust.current_folder("my_module:Puck-v0"):
        assert sys.path == [*before, ""]
    with trust.current_folder("mujoco.batch:Batch"):  # what is installed imports nothing from here
        assert sys.path == before
    assert sys.path == before
    path = code(tmp_path, "my_module.py")
    assert trust.module_file("my_module.sub:Puck-v0").resolve() == path.resolve()
    assert trust.module_file("mujoco:X").parent.name == "mujoco"
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)  # `python -m pytest` has one
    for name in ("", "__main__", "no_such_module"):
        assert trust.module_file(name) is None


def test_an_environment_whose_class_lies_beside_its_registration_is_made_again(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    text = "import gymnasium\ngymnasium.register('Two-v0', 'two_class:Two')\n"
    (tmp_path / "two_entry.py").write_text(text)
    text = "from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv as Two\n"
    (tmp_path / "two_class.py").write_text(text)
    before, description = [*sys.path], opening.Description("two_entry:Two-v0")
    opening.preload(description)
    sys.modules.pop("two_class", None)
    assert type(opening.made(description).unwrapped).__name__ == "ReacherEnv"
    assert sys.path == before


# ---- fields


@pytest.mark.parametrize("radius", [1e-9, 0.01, 0.02, 0.04, 300.0])
@pytest.mark.parametrize(
    ("post", "start"), [((3, 0), (-6, 0)), ((200, 0), (-6, 0)), ((3, 1), (-300, 0))]
)
def test_a_field_at_its_limits_can_be_drawn(radius, post, start, tmp_path):
    path = tmp_path / "field.json"
    content = {
        "goal_m": [0, 0],
        "posts": [{"radius_m": radius, "positions_m": [post]}],
        "starts": [{"position_m": start, "heading_rad": 0}],
    }
    path.write_text(json.dumps(content))
    field = read_field(path)
    task = Driving(get_task("field"), field.layouts, time=field.time, starts=field.starts)
    assert task.model.ncam >= 1


def test_many_keys_twice_take_no_time(tmp_path):
    path = tmp_path / "field.json"
    path.write_text("{" + ",".join(f'"k{i % 20_000}": 1' for i in range(40_000)) + "}")
    began = time.monotonic()
    assert "'k0' twice" in refusal(lambda: read_field(path))
    assert time.monotonic() - began < 5


# ---- what is shown and written


def test_a_name_controls_no_terminal():
    for names, units in ((("\x1b[31mx",), ("m",)), (("x",), ("\x07",)), (("x" * 81,), ("m",))):
        refusal(lambda names=names, units=units: Chart(names, units, (0.0,), (1.0,), (False,)))


def test_a_table_in_markdown_holds_no_other_column_link_or_element():
    text = markdown(Table("", ["a"], [["x | y"], ["[x](javascript:1)"], ["<img src=x>"]]))
    assert text.splitlines()[2:] == [
        r"| x \| y |",
        r"| \[x\](javascript:1) |",
        r"| \<img src=x\> |",
    ]


def test_a_long_sentence_is_cut_in_the_middle():
    text = str(BadInput(f"begin {'x' * 3_000_000} end"))
    assert text.startswith("begin x")
    assert text.endswith("x end")
    assert len(text) <= LONGEST + 10 >= len(str(BadInput("\U000e0001" * 500)))  # also with escapes


def write(path, text):
    with artifacts.replacing(path) as temporary:
        temporary.write_text(text)


def test_what_was_not_written_here_is_not_overwritten(tmp_path):
    path = tmp_path / "page.html"
    with trust.output(path):
        write(path, "ours")
    with trust.output(path):  # as it was written
        write(path, "ours again")
    path.write_text("theirs")
    with pytest.raises(BadInput, match="--force"), trust.output(path):
        raise AssertionError
    with trust.output(path, force=True):
        write(path, "ours")
    assert path.read_text() == "ours"


@pytest.mark.parametrize("when", ["before", "in between", "after"])
def test_what_somebody_writes_meanwhile_is_not_overwritten(when, tmp_path, monkeypatch):
    path, mark = tmp_path / "page.html", trust._mark

    def marked(*paths):  # just before it is written
        if when == "in between":
            path.write_text("theirs")
        return mark(*paths)

    monkeypatch.setattr(trust, "_mark", marked)
    with contextlib.suppress(BadInput), trust.output(path):
        if when == "before":
            path.write_text("theirs")
        write(path, "ours")
        path.write_text("theirs")
    with pytest.raises(BadInput, match="has not written it"), trust.output(path):
        pass
    assert path.read_text() == "theirs"


def test_what_was_forced_and_failed_is_still_theirs(tmp_path):
    path = tmp_path / "page.html"
    path.write_text("theirs")
    with pytest.raises(ZeroDivisionError), trust.output(path, force=True):
        raise ZeroDivisionError
    with pytest.raises(BadInput, match="has not written it"), trust.output(path):
        pass


def test_what_is_recorded_at_the_same_time_is_recorded():
    texts = [f"text {number}" for number in range(16)]
    with ThreadPoolExecutor(4) as pool:
        [*pool.map(trust.remember_text, texts)]
    assert all(map(trust.is_known_text, texts))


@pytest.mark.slow
def test_export_overwrites_no_file_of_a_run(planted_circle, tmp_path):
    run = shutil.copytree(planted_circle[0].path, tmp_path / "run")
    before = (run / "config.json").read_bytes()
    done = call("export", run, "--to", "onnx", "--out", run / "config.json")
    assert done.returncode == 2
    assert "--force" in done.stderr
    assert (run / "config.json").read_bytes() == before


def test_a_file_without_an_end_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(BadInput, match="no MJCF model"):
        mjcf.load(tmp_path / "fifo")
    assert not trust.is_known(tmp_path / "fifo")


@pytest.mark.parametrize(
    ("terminal", "shown"),
    [
        (True, "\x1b[31mred\n\\x1b]0;owned\\x07\r\\u202egnp"),
        (False, "\\x1b[31mred\n\\x1b]0;owned\\x07\r\\u202egnp"),
    ],
)
def test_a_stream_shows_what_controls_a_terminal_as_escapes(terminal, shown):
    raw = io.BytesIO()
    raw.isatty = lambda: terminal
    stream = streams._Escaping(raw, encoding="utf-8", newline="")
    stream.write("\x1b[31mred\n\x1b]0;owned\x07\r\u202egnp")
    stream.flush()
    assert raw.getvalue().decode() == shown
