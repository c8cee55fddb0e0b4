"""Files that lie in the way, fill the memory, speak to the terminal, or belong to somebody else."""

import contextlib
import csv
import errno
import importlib.util
import io
import json
import marshal
import multiprocessing
import os
import resource
import shutil
import struct
import subprocess
import sys
import time
import zipfile
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from attacks import MARKER, child, crafted_agents, forgery
from attacks.folders import plant_modules
from command_line import call, python
from environments import Puck
from PIL import Image

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, HyrlError, from_gymnasium
from hyrl_mj.cli import parsing
from hyrl_mj.export import export_numpy
from hyrl_mj.files import archives, artifacts, trust
from hyrl_mj.files.manifest import Manifest, locked
from hyrl_mj.files.sources import digest_of
from hyrl_mj.gym_import import EnvironmentOptions, chosen_task, making
from hyrl_mj.gym_import.making import explained
from hyrl_mj.gym_import.opening import with_arrays
from hyrl_mj.physics import mjcf
from hyrl_mj.policies import agent_at, algorithms
from hyrl_mj.policies.preprocessing import Normalization
from hyrl_mj.runs.sweeps import MOST_RUNS, Common, Row, Setting, Sweep
from hyrl_mj.stages import ExtendedSets
from hyrl_mj.system import cores, limits
from hyrl_mj.system.streams import _SEQUENCES, Streams
from hyrl_mj.tasks import described_task, registry
from hyrl_mj.tasks.scaffold import write_task
from hyrl_mj.viz import pages
from hyrl_mj.viz.encoding import video
from hyrl_mj.viz.figures import style

ENV = "hyrl_mj/UnitCircle-v0"


def sweep_of(*rows):
    return Sweep(Common("smoke", None, {}), rows)


# ---- what belongs to somebody else


def test_what_does_not_begin_leaves_what_others_have_put_there_and_nothing_else(tmp_path):
    folder = tmp_path / "sweep"

    def put() -> None:
        (folder / "mine").mkdir()
        (folder / "mine" / "data.txt").write_text("mine")
        raise BadInput("not now")

    with pytest.raises(BadInput, match="not now"), locked(folder):
        put()
    assert (folder / "mine" / "data.txt").read_text() == "mine"
    with pytest.raises(BadInput, match="not now"), locked(tmp_path / "other"):
        raise BadInput("not now")
    assert not (tmp_path / "other").exists()
    (tmp_path / "empty").mkdir()
    with locked(tmp_path / "empty"):
        pass
    assert os.listdir(tmp_path / "empty") == []


@pytest.mark.slow
def test_the_folder_of_another_process_that_is_at_work_stays(tmp_path, monkeypatch):
    folder = tmp_path / "sweep"
    with locked(folder):
        monkeypatch.setattr(Path, "exists", lambda path: False)  # as it was a moment before
        code = "import sys; from pathlib import Path; from hyrl_mj.files.manifest import locked\n"
        code += "Path.exists = lambda path: False\nwith locked(Path(sys.argv[1])): pass"
        assert "another process is working" in python(code, folder).stderr
        assert os.listdir(folder) == [".lock"]


def test_temporary_files_of_runs_that_are_at_work_stay(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / ".lock").write_text("")
    names = [tmp_path / ".a.mp4.0123456789ab.partial", run / ".b.mp4.0123456789ab.partial"]
    assert artifacts.TEMPORARY.fullmatch(names[0].name)
    for path in names:
        path.write_text("half")
    with locked(tmp_path):
        assert [path.exists() for path in names] == [False, True]


def test_a_link_that_leads_to_nothing_is_not_replaced(tmp_path):
    path = tmp_path / "a.html"
    path.symlink_to(tmp_path / "elsewhere.html")
    with pytest.raises(BadInput, match="has not written it"), trust.output(path):
        pass


@pytest.mark.parametrize(("form", "last"), [("text", ".xml"), ("bytes", ".py")])
def test_files_that_belong_together_are_written_together(
    form, last, planted_circle, tmp_path, monkeypatch
):
    write = getattr(Path, f"write_{form}")

    def on_full_disk(path, *content, **options):
        if path.suffix == last and tmp_path in path.parents:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, *content, **options)

    controller = planted_circle[0].controller
    monkeypatch.setattr(Path, f"write_{form}", on_full_disk)
    with pytest.raises(BadInput, match="No space left"):
        write_task("robot_4", tmp_path) if form == "text" else export_numpy(controller, tmp_path)
    assert not os.listdir(tmp_path)


def test_a_path_without_a_name_is_one_sentence():
    with pytest.raises(BadInput, match="is no name of a file"), artifacts.replacing(Path()):
        pass


# ---- code


@pytest.mark.parametrize(
    ("named", "changed"),
    [
        ("robot", "helper.py"),
        ("robot", "entry.py"),
        ("robot", "late.py"),
        ("package:Env-v0", "package/part.py"),
        ("package:Env-v0", "beside.py"),
        ("package:Env-v0", "entry.py"),
    ],
)
def test_code_is_known_with_all_that_is_imported_with_it(named, changed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = "import helper; gym.register('R-v0', 'entry.sub:Env'); importlib.import_module('late')\n"
    (tmp_path / "package").mkdir()
    (tmp_path / "robot.py").write_text(text)
    (tmp_path / "package" / "part.py").write_text("import beside; name = 'entry:Env'\n")
    for name in ("helper", "entry", "late", "beside", "other", "package/__init__"):
        (tmp_path / f"{name}.py").write_text("")
    path = trust.module_file(named)
    trust.remember(path)
    (tmp_path / "other.py").write_text("# another one\n")
    assert trust.is_known(path)
    (tmp_path / changed).write_text("# another one\n")
    assert not trust.is_known(path)


def test_compiled_code_beside_a_file_is_not_executed(tmp_path, monkeypatch):
    """`__pycache__` comes with a folder, and says itself of which file it is."""
    monkeypatch.chdir(tmp_path)
    robot = write_task("robot_3", tmp_path)[0]
    robot.write_text("import help3.part\n" + robot.read_text())
    (tmp_path / "help3").mkdir()
    (tmp_path / "module3.py").write_text("import help4\nclass X: pass\n")
    for name in ("help3/__init__.py", "help3/part.py", "help4.py"):
        (tmp_path / name).write_text("")
    for path in tmp_path.rglob("*.py"):
        status, compiled = path.stat(), Path(importlib.util.cache_from_source(str(path)))
        compiled.parent.mkdir(exist_ok=True)
        head = struct.pack("<LLL", 0, int(status.st_mtime), status.st_size)
        code = compile(f"open({path.stem!r}, 'w').close()\n{path.read_text()}", path, "exec")
        compiled.write_bytes(importlib.util.MAGIC_NUMBER + head + marshal.dumps(code))
    before = {*os.listdir(tmp_path)}
    assert hyrl_mj.get_task(robot).name == "robot_3"
    assert algorithms.imported("module3:X", "it").__name__ == "X"
    assert {*os.listdir(tmp_path)} == before


def test_code_that_a_file_names_is_not_even_read(tmp_path, monkeypatch):
    path = tmp_path / "robot.py"
    path.write_text("-" * 200_000 + "1")  # Python's parser gives up
    monkeypatch.setattr(registry, "digest_of", None)
    with pytest.raises(BadInput, match="executes no file"):
        described_task(str(path))
    assert len(digest_of(path)) == 64


@pytest.mark.slow
def test_a_session_in_a_folder_of_a_stranger_takes_no_package_from_it(tmp_path):
    for name in ("gymnasium_robotics", "ogbench", "shimmy", "evil_task"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w').close()")
    (tmp_path / "evil-1.dist-info").mkdir()
    text = "[hyrl_mj.tasks]\nevil = evil_task:Task\n"
    (tmp_path / "evil-1.dist-info" / "entry_points.txt").write_text(text)
    (tmp_path / "evil-1.dist-info" / "METADATA").write_text("Name: evil\nVersion: 1\n")
    code = """if True:
        from hyrl_mj.errors import BadInput
        from hyrl_mj.tasks import described_task
        for name in ('evil', 'env:{"env": "NoSuch-v4"}'):
            try:
                described_task(name)
            except BadInput:
                print("refused")
    """
    assert python(code, cwd=tmp_path).stdout == "refused\n" * 2
    assert not (tmp_path / "executed").exists()


@pytest.mark.slow
@pytest.mark.parametrize("ended", [False, True])
def test_processes_of_a_command_import_nothing_and_end_with_it(ended, tmp_path):
    plant_modules(tmp_path)
    code = f"""if True:
        import os, time
        from hyrl_mj.system import cores
        with cores.Processes() as pool:
            print(*pool.map(os.getppid, []), flush=True)
            for worker in pool.map(eval, ["__import__('os').getpid()"]):
                print(worker, flush=True)
            if {ended}:
                pool.map(time.sleep, [600])
                os._exit(0)
    """
    words = [sys.executable, "-P", "-c", code]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert not (tmp_path / MARKER).exists()
    for _ in range(100):
        if not (alive := Path(f"/proc/{int(done.stdout)}").exists()):
            break
        time.sleep(0.1)
    assert not alive


def test_a_process_of_a_pool_that_is_ended_is_one_sentence():
    class Broken:
        def map(self, work, jobs):
            raise BrokenProcessPool("a process died")

    with cores.using_pool(Broken()), pytest.raises(HyrlError, match="run it again to resume"):
        [*cores.in_processes(abs, [1])]


def test_the_name_of_a_file_that_is_missing_is_no_module(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil_agent.py").write_text("open('executed', 'w')")
    with pytest.raises(BadArtifact, match=r"there is no file evil_agent:best\.zip"):
        agent_at(Path("evil_agent:best.zip"))
    assert not (tmp_path / "executed").exists()


def test_a_command_that_is_shown_can_be_copied(tmp_path):
    with pytest.raises(BadInput, match=r"--algorithm '\$\(touch x\):X'$"):
        algorithms.check_named("$(touch x):X")
    folder = tmp_path / "a;touch x"
    with pytest.raises(BadArtifact, match=r"with hyrl-mj partition '.*/a;touch x' or"):
        Manifest(folder, {}).checked(folder / "partition.npz")


# ---- names


@pytest.mark.parametrize("name", ["a:b.gif", "http:c.gif"])
def test_a_name_of_a_video_is_no_protocol(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with video(Path(name), 16, 16, 5) as add:
        add(np.zeros((16, 16, 3), dtype=np.uint8))
    assert os.listdir(tmp_path) == [name]


def test_options_are_shown_without_docstrings():  # as under PYTHONOPTIMIZE=2
    option = parsing.Argument("eps", parsing.KINDS[float], None, "a number", positional=False)
    assert option.field(helping=True)[0] == "eps"


def test_a_name_is_no_formula(tmp_path, circle):
    with style.drawing(3.0, circle, "$\\frac{$") as figure:
        figure.subplots().set_xlabel("$$")
    style.write(figure, tmp_path / "a.png")
    assert (tmp_path / "a.pdf").exists()


def test_the_name_of_an_agent_that_no_file_can_hold_leaves_no_folder(tmp_path):
    crafted_agents.write_zip(tmp_path)
    (tmp_path / "agent.zip").rename(tmp_path / "a\nb.zip")
    words = ("unit_circle", "--policy", "a\nb.zip", "--vecnormalize", "none", "--out", "out")
    done = call("diagnose", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert "config.json cannot hold 'a\\nb.zip'" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_task_in_a_folder_that_is_not_in_utf_8_is_one_sentence(tmp_path):
    folder = tmp_path / "x\udcff"  # as Python reads a byte that is no character
    done = call("new-task", "robot_1", "--folder", folder)
    assert done.stdout.count("\n") == 3
    assert "x\\udcff/robot_1.py" in done.stdout
    with pytest.raises(BadInput, match=r"is not in UTF-8.*export LC_ALL=C\.UTF-8"):
        _ = hyrl_mj.get_task(folder / "robot_1.py").model


def test_the_hint_of_a_new_task_can_be_copied(tmp_path):
    done = call("new-task", "robot_2", "--folder", "a b\nc", cwd=tmp_path)
    assert done.stdout.count("\n") == 3
    assert "hyrl-mj run 'a b\\nc/robot_2.py'\n" in done.stdout


def test_a_path_that_no_file_can_have_is_one_sentence(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    long, deep, odd, loop = "x" * 300, "a/" * 3_000, "\u202e" * 90, "loop/x.py"
    for words in (
        ("report", long), ("report", odd), ("report", loop), ("report", "a\n" * 200),
        ("run", "unit_circle", "--out", deep), ("run", "unit_circle", "--out", loop), ("noise", long),
    ):  # fmt: skip
        done = call(*words, cwd=tmp_path)
        assert done.returncode == 2, words
        assert done.stderr.startswith("hyrl-mj: ")
        assert done.stderr.count("\n") == 1
        assert len(done.stderr) < 530


def test_a_full_memory_is_one_sentence():
    def work():
        raise MemoryError

    err = io.StringIO()
    with contextlib.redirect_stderr(err):
        assert Streams().run(work) == 1
    assert err.getvalue().startswith("hyrl-mj: there is not enough memory")


@pytest.mark.slow
def test_a_run_in_a_folder_that_is_not_in_utf_8_is_reported(planted_circle, tmp_path):
    path = shutil.copytree(planted_circle[0].path, tmp_path / "x\udcff")
    assert call("report", path).returncode == 0
    assert (path / "report.html").exists()


# ---- what lies in the way


@pytest.mark.slow
def test_a_matplotlibrc_of_the_current_folder_has_no_part(tmp_path):
    code = "from hyrl_mj.system.gl import spare_matplotlib; spare_matplotlib()\n"
    code += (
        "from hyrl_mj.viz.figures import style; import matplotlib; print(matplotlib.get_backend())"
    )
    os.mkfifo(tmp_path / "matplotlibrc")  # who reads it waits for ever
    done = python(code, cwd=tmp_path, env=os.environ | {"MPLBACKEND": "nonsense"})
    assert (done.stdout, done.stderr) == ("agg\n", "")


def test_a_pipe_in_place_of_a_file_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    done = call("diagnose", "--explain", "--env", ENV, "--env-args", "pipe", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (2, "hyrl-mj: pipe is no file: give a JSON file\n")


# ---- processes of others


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_an_async_vector_env_plays_what_a_sync_one_does(context):
    def played(mode, **options):
        envs = gym.make_vec(ENV, 2, vectorization_mode=mode, **options)
        found, rng = [envs.reset(seed=1)[0]], np.random.default_rng(0)
        for _ in range(160):  # past the end of an episode
            found += envs.step(rng.uniform(-1, 1, (2, 1)).astype(np.float32))[:4]
        envs.close()
        return np.concatenate([np.ravel(part) for part in found])

    ours = played("async", vector_kwargs={"context": context})
    np.testing.assert_array_equal(ours, played("sync"))


@pytest.mark.slow
def test_an_environment_that_a_daemon_makes_has_limits(monkeypatch):
    monkeypatch.setattr(limits.limit, "__defaults__", (1, limits.MEMORY))
    with multiprocessing.get_context("fork").Pool(1) as pool:
        given = {"kwargs": {"frame_skip": 10**9}}
        with pytest.raises(BadInput, match="takes longer than"):
            pool.apply(from_gymnasium, ("Reacher-v5",), given)


# ---- what fills the disk and the memory


def test_an_array_holds_numbers():
    texts = ["a" * 1_000_000] + [""] * 400  # as an array they would take 1.6 GB
    assert with_arrays({"array": [[6, 6]]}).dtype == int
    with pytest.raises(ValueError, match="numbers alone"):
        with_arrays({"array": texts})
    with pytest.raises(BadInput, match="a finite number"):
        from_gymnasium(ENV, pinned={"qpos[0]": texts})
    assert not making._is_plain(np.array(["/home/u/x.xml"]))
    assert making._is_plain(np.array([6, 6]))
    for spec in ('env:{"array": ["a"]}', 'env:{"array": [1]}'):
        with pytest.raises(BadInput, match="describes no environment"):
            making.from_spec(spec)


@pytest.mark.slow
def test_arguments_have_a_length():
    with pytest.raises(BadInput, match="take more than 1,048,576 characters"):
        from_gymnasium(ENV, pinned={f"k{i}": 1 for i in range(200_000)})


def test_arguments_that_are_nested_far_are_one_sentence():
    deep = []
    for _ in range(3_000):
        deep = [deep]
    with pytest.raises(BadInput, match="cannot be made as it is described"):
        from_gymnasium(ENV, kwargs={"a": deep})


def test_a_video_that_fills_the_memory_is_not_shown(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "replay.png")
    (tmp_path / "replay.mp4").write_bytes(b"video")
    assert pages.film(tmp_path / "replay.mp4", "", "") is not None
    with (tmp_path / "replay.mp4").open("r+b") as file:
        file.truncate(pages.VIDEO + 1)
    assert pages.film(tmp_path / "replay.mp4", "", "") is None


def test_a_figure_on_a_full_disk_is_one_sentence(tmp_path, monkeypatch, circle):
    monkeypatch.setattr(style, "DPI", 5)

    def work():
        with style.drawing(3.0, circle, "title") as figure:
            style.write(figure, Path("a.png"))
        room = (Path("a.png").stat().st_size + Path("a.pdf").stat().st_size) // 2
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))  # the PNG is the smaller one
        style.write(figure, Path("b.png"))

    answer = child(work, tmp_path)
    assert answer.err.splitlines()[-1].startswith(
        "hyrl_mj.errors.BadInput: b.pdf cannot be written"
    )
    assert sorted(os.listdir(tmp_path)) == ["a.pdf", "a.png"]


@pytest.mark.parametrize(
    ("size", "message"), [(400_000, "is larger than 1 MiB"), (20_000, "more than 10,000 parts")]
)
def test_arguments_of_an_environment_have_a_limit(size, message, tmp_path):
    (tmp_path / "large.json").write_text(json.dumps({"kwargs": {"a": [[]] * size}}))
    options = EnvironmentOptions(ENV, env_args=tmp_path / "large.json")
    with pytest.raises(BadInput, match=message):
        chosen_task(None, options)


@pytest.mark.slow
def test_a_model_that_is_large_is_refused(tmp_path):
    write_task("big", tmp_path)
    path = tmp_path / "big.xml"
    texture = '<texture name="t" type="2d" builtin="flat" width="8000" height="8000"/>'
    path.write_text(path.read_text().replace("<worldbody>", f"<asset>{texture}</asset><worldbody>"))
    with pytest.raises(BadInput, match=r"its model takes 18. MiB, more than 128"):
        mjcf.load(path)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"mean": np.zeros(2, dtype=complex)}, "its mean holds no numbers"),
        ({"var": np.ones(2, dtype="m8[s]")}, "its var holds no numbers"),
        ({"mean": np.array([1e308, -1e308])}, "numbers up to 1e\\+30"),
        ({"var": np.array([0, 1]), "epsilon": np.array(5e-324)}, "cannot be statistics"),
    ],
)
def test_statistics_are_numbers_of_a_size_that_can_be_reckoned_with(arrays, message, tmp_path):
    usual = {"mean": np.zeros(2), "var": np.ones(2), "clip": np.array(10.0)}
    np.savez(tmp_path / "s.npz", **usual | arrays)
    with pytest.raises(BadArtifact, match=message):
        Normalization.load(tmp_path / "s.npz")


@pytest.mark.parametrize(
    ("shape", "kind"), [((2**34, 0), "<f8"), ((0, 2**34), "<f8"), ((2**34,), "<U0")]
)
def test_rows_and_numbers_without_a_byte_count(shape, kind, tmp_path):
    header = {"shape": shape, "fortran_order": False, "descr": kind}
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file, file.open("a.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, header)
    with pytest.raises(BadArtifact, match="unpacks to more than 1 MiB"):
        archives.read_npz(tmp_path / "a.npz", 2**20)


@pytest.mark.parametrize("kind", [complex, "m8[s]", "S1", [("a", float)]])
def test_arrays_of_a_run_hold_real_numbers_or_texts(kind, tmp_path):
    artifacts.write_arrays(tmp_path / "a.npz", {"a": np.zeros(2, dtype=kind)}, "kind")
    with pytest.raises(BadArtifact, match="its a holds neither real numbers nor a text"):
        artifacts.read_arrays(tmp_path / "a.npz", "kind")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("modes", [np.array([0.0, 1.0]), np.array([0.0, 0.5])])
def test_modes_are_integers(modes, planted_circle, tmp_path):
    with np.load(planted_circle[0].path / "extended_sets.npz", allow_pickle=False) as arrays:
        np.savez(tmp_path / "e.npz", **{**arrays, "modes": modes})
    with pytest.raises(BadArtifact, match="its modes cannot be used: its numbers are no integers"):
        ExtendedSets.load(tmp_path / "e.npz", hyrl_mj.get_task("unit_circle"))


@pytest.mark.parametrize(
    ("name", "arrays"),
    [
        ("critical_set", {"points": np.ones((1, 1), bool)}),
        ("critical_set", {"points": np.full((1, 1), 1e308)}),
        ("critical_set", {"component": np.array(["x"])}),
        ("critical_set", {"component": np.full(1, 2**64 - 1, np.uint64)}),
        ("critical_set", {"resolution": np.array(np.nan)}),
        ("extended_sets", {"room": np.empty(0, "U1")}),
        (
            "extended_sets",
            {"points": np.zeros((1, 1)), "room": np.zeros(1), "between": np.array([[7, 8]])},
        ),
        ("arcs/start0_policy", {}),
    ],
)
def test_numbers_of_a_run_are_of_their_kind(name, arrays, planted_circle, tmp_path):
    run = hyrl_mj.load_run(shutil.copytree(planted_circle[0].path, tmp_path / "run"))
    if name.startswith("arcs"):
        arrays = {"z": np.ones(run.arc(run.path / f"{name}.npz").z.shape, bool)}
    forgery.arrays(run.path, f"{name}.npz", **arrays)
    with pytest.raises(BadInput, match=r"make no|does not fit"):
        _ = run.anew().critical_set, run.extended_sets, run.arcs()


def test_an_arc_is_as_long_as_its_run_at_most(planted_circle, tmp_path):
    run = hyrl_mj.load_run(shutil.copytree(planted_circle[0].path, tmp_path / "run"))
    path = next(iter(run.arc_paths().values()))
    arc = run.arc(path)
    n = 10 * len(arc.t)
    long = {
        name: np.zeros((n, getattr(arc, name).shape[1])) for name in ("z", "measured", "u", "state")
    }
    rows = {"t": np.arange(n) * 0.05, "j": np.zeros(n, dtype=int), "q": np.zeros(n, dtype=int)}
    longer = replace(arc, **long, **rows)
    with run.manifest.stage("simulate"):
        for other in run.arc_paths().values():
            longer.save(other)
    with pytest.raises(BadArtifact, match=r"unpacks to more than|is longer than"):
        run.anew().arc(path)


@pytest.mark.parametrize(
    ("seeds", "message"),
    [(range(MOST_RUNS + 1), "at most 1,000 runs"), ((0, 0), "twice: make the sweep again")],
)
def test_a_sweep_that_nobody_makes_is_refused(seeds, message, tmp_path):
    rows = (Row(Setting("unit_circle", "", 0.1), seed) for seed in seeds)
    sweep_of(*rows).save(tmp_path)
    with pytest.raises(BadInput, match=message):
        Sweep.load(tmp_path)


# ---- what speaks to the terminal, or to a spreadsheet


@pytest.mark.long
def test_what_is_explained_cannot_control_the_terminal(few_trials):
    task = from_gymnasium(Puck, success='info["success"] #\x1b[2J', steps=20)
    assert "\x1b" not in explained(task)


def test_only_colours_and_movements_reach_a_terminal():
    kept = ["\x1b[31m", "\x1b[1A", "\x1b[2K", "\x1b[?25l", "\n"]
    assert all(_SEQUENCES.fullmatch(text) for text in kept)
    assert not any(_SEQUENCES.fullmatch(text) for text in ("\x1b[6n", "\x1b[c", "\x1b[2J"))


@pytest.mark.parametrize("text", [" =1+1", "\u3000@x", "\uff1d1", "=1", "+1+1", "-1+cmd"])
def test_a_spreadsheet_takes_no_text_for_a_formula(text, tmp_path):
    sweep_of(Row(Setting(text, "", 0.1), 0, "stopped", text, text, 1e308)).write_csv(tmp_path)
    with (tmp_path / "sweep.csv").open(newline="", encoding="utf-8") as file:
        (line,) = csv.DictReader(file)
    assert {line[name] for name in ("task", "verdict", "sentence")} == {f"'{text}"}
    assert line["seconds"] == "1e+308"
