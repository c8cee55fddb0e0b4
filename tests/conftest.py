"""Fixtures that many tests share: the registered tasks."""

import ctypes
import gc
import json
import os
import platform
import shutil
from collections import Counter

# Before NumPy and torch are there: matrices are small here, and threads that wait for a busy core take
# ten times as long as none.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import memory
import numpy as np
import pytest
from filelock import FileLock

import hyrl_mj
from hyrl_mj.judging.game import Game
from hyrl_mj.physics import mjcf
from hyrl_mj.sets import Grid
from hyrl_mj.system import cores
from hyrl_mj.tasks.scaffold import write_task

# The same examples everywhere, whatever the speed of the machine; `scripts/test --long` tries others, too.
hypothesis.settings.register_profile(
    "repeatable", derandomize=True, deadline=None, database=None, max_examples=25
)
hypothesis.settings.register_profile("long", deadline=None, database=None, max_examples=1_000)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture(scope="session", autouse=True)
def no_trace_at_home(tmp_path_factory):
    """Which files of code have run is recorded in a folder of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session", autouse=True)
def own_cores():
    """A process of several that test side by side takes its share: threads that wait for a busy core cost."""
    with pytest.MonkeyPatch.context() as patch:
        if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
            share = cores.count() // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
            patch.setattr(cores, "allowed", max(share, 1))
        yield


@pytest.fixture(scope="module", autouse=True)
def memory_of_a_file():
    """What the tests of a file have freed goes back to the system, if it is much: each fork copies less.

    The simulations of hundreds of environments are freed in pieces between which others live, and glibc keeps
    all of it. What lives on then, as modules do, is not looked at again: that takes half a second each time.
    """
    yield
    if platform.libc_ver()[0] == "glibc" and memory.now("VmRSS") > 600:
        gc.collect()
        gc.freeze()
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="module", autouse=True)
def models_of_tests(request):
    """MJCFs of tests are compiled at once: to try each in a process with limits before takes half a second.

    In the files about what strangers wrote they are tried.
    """
    with pytest.MonkeyPatch.context() as patch:
        if "doors" not in request.path.stem:
            patch.setattr(mjcf, "_try", lambda path: None)
        yield


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """Returns a folder, by its name, that the first process that needs it has filled with make(folder)."""
    base = tmp_path_factory.getbasetemp()
    together = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "together"
    together.mkdir(exist_ok=True)

    def folder(name, make):
        path, made = together / name, together / f"{name}.made"
        with FileLock(together / f"{name}.lock"):
            if not made.exists():
                shutil.rmtree(path, ignore_errors=True)
                path.mkdir()
                make(path)
                made.touch()
        return path

    return folder


@pytest.fixture(scope="session", autouse=True)
def coarse_looks():
    """Figures have few pixels, and what is proved is replayed from few starts."""
    from planted import coarsen

    with pytest.MonkeyPatch.context() as patch:
        coarsen(patch)
        yield


@pytest.fixture(scope="session")
def circle():
    return hyrl_mj.get_task("unit_circle")


@pytest.fixture(scope="session")
def vehicle():
    return hyrl_mj.get_task("vehicle")


@pytest.fixture(scope="session", params=("unit_circle", "vehicle"))
def task(request):
    """Either of the paper's tasks."""
    return hyrl_mj.get_task(request.param)


@pytest.fixture(scope="session")
def game_on_vehicle(vehicle):
    """The worst-case game of the vehicle against planted controllers.

    All but the first line and the slanted one run between the nodes, where the plant's rounding errors do not
    matter.
    """
    from planted import halves, ideal_controller, one_way_policy, sign_policy

    rules = {
        "left": one_way_policy(vehicle, 1.0),
        "right": one_way_policy(vehicle, -1.0),
        "sign": sign_policy(vehicle),
        "sign off": sign_policy(vehicle, lambda x: 0.004 + 0 * x),
        "slanted": sign_policy(vehicle, lambda x: x - 0.3),
        "narrow": ideal_controller(vehicle, 0.054, 0.954),
        "ideal": ideal_controller(vehicle, 0.154, 1.004),
        "grazing": ideal_controller(vehicle, 0.204, 0.904),
    }
    return Game(vehicle, halves(vehicle), rules, 0.2, grid=Grid.with_cells(vehicle.chart, 240))


@pytest.fixture(scope="session")
def game_on_circle(circle):
    """The same of the unit circle, on nodes between which samples at full speed lead."""
    from planted import EXACT, circle_controller, circle_policy, halves, homing_controller

    rules = {
        "sign": circle_policy(circle, np.pi + 0.003),
        "hysteresis": circle_controller(circle, 0.4 + 0.003),
        "homing": homing_controller(circle, 0.4 + 0.003),
    }
    return Game(circle, halves(circle), rules, 0.3, grid=Grid.with_cells(circle.chart, EXACT))


@pytest.fixture(scope="session")
def puck(tmp_path_factory):
    """A robot with inertia: what `hyrl-mj new-task` writes, with continuous inputs."""
    folder = tmp_path_factory.mktemp("puck")
    write_task("puck", folder)
    path = folder / "puck.py"
    text = path.read_text()
    continuous = text.replace("levels=5, ", "")
    assert continuous != text
    path.write_text(continuous)
    return hyrl_mj.get_task(path)


@pytest.fixture(scope="session")
def planted_circle(made_once):
    """A run of the circle whose policies are planted and whose other stages ran; and what was said.

    As on a machine that cannot draw: there is no video.
    """
    from planted import FEW_CELLS, decisions, halves, without_pictures, without_videos
    from test_report import plant

    def make(folder):
        task, said, path = hyrl_mj.get_task("unit_circle"), [], folder / "unit_circle"
        plant(path, task, decisions(task), halves(task), **FEW_CELLS)
        with pytest.MonkeyPatch.context() as patch:
            without_videos(patch)
            without_pictures(patch)
            hyrl_mj.run("unit_circle", preset="smoke", set=FEW_CELLS, out=path, say=said.append)
        (folder / "said.json").write_text(json.dumps(said))

    folder = made_once("planted", make)
    return hyrl_mj.load_run(folder / "unit_circle"), json.loads((folder / "said.json").read_text())


@pytest.fixture(scope="module")
def small_runs(planted_circle):
    """While the tests of a file run, runs of preset smoke are shorter still, but for the planted one."""
    from planted import shorten

    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        yield


@pytest.fixture(scope="module")
def few_steps():
    """While the tests of a file run, tasks are tried out for a shorter time."""
    from planted import few_steps

    with pytest.MonkeyPatch.context() as patch:
        few_steps(patch)
        yield


@pytest.fixture
def quickly_judged(monkeypatch):
    """Judging policies takes most of the time of a short training: it is done seldom, in short episodes."""
    from planted import spare

    from hyrl_mj.learning import training

    spare(monkeypatch, checkpoints=2)
    monkeypatch.setattr(training, "EPISODES", 64)
    for name in ("unit_circle", "vehicle"):
        monkeypatch.setattr(type(hyrl_mj.get_task(name)), "max_steps", 40)


@pytest.fixture(scope="session", autouse=True)
def few_trials():
    """Environments are looked at for a shorter time."""
    from planted import few_trials

    with pytest.MonkeyPatch.context() as patch:
        few_trials(patch)
        yield patch


@pytest.fixture
def all_trials(few_trials):
    """In a test environments are looked at for as long as users' are."""
    from planted import few_trials as shorten_trials

    few_trials.undo()
    yield
    shorten_trials(few_trials)


# The files that take longest, in this order, each more than half a minute.
LONGEST = ("demo", "attack", "environments", "wrapped_environments", "refused_environments")
LONGEST += ("starts_of_environments", "trapped_environments", "robustify", "sweep", "retraining")
LONGEST += ("algorithms", "sensors")
# The pages of the manual are run with runs that tests of those before have made.
LONGEST += ("docs", "surroundings", "cli", "report", "training", "tables", "doors")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Of the cases of a test marked `first(n)` or `fast(n)`, those after the n-th are `long` or `slow`.

    Files with slow tests come first, the longest before all: no process ends long after the other.
    """
    seen = Counter()
    for item in items:
        for name, then in (("first", pytest.mark.long), ("fast", pytest.mark.slow)):
            if mark := item.get_closest_marker(name):
                seen[name, item.path, item.originalname] += 1
                if seen[name, item.path, item.originalname] > mark.args[0]:
                    item.add_marker(then)
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    places = {f"test_{name}": place for place, name in enumerate(LONGEST)}

    def place(item):
        return item.path not in slow, places.get(item.path.stem, len(places))

    items.sort(key=place)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """In CI a skipped test has failed: everything that the tests need is installed there."""
    report = yield
    if "CI" in os.environ and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome, report.longrepr = "failed", f"skipped in CI: {report.longrepr}"
    return report
