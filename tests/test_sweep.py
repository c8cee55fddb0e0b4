"""Sweeps: what is planned, what is refused, and that their runs are those that are made one by one."""

import csv
import json
import os
import pickle
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from attacks.crafted_runs import MARKER
from attacks.doors import plant_modules
from command_line import call, listening
from planted import FEW_CELLS, TINY, coarsen, decisions, few_noises, halves, shorten, spare
from test_report import plant

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, pipeline
from hyrl_mj.files import artifacts
from hyrl_mj.judging import Regions, episodes, noisy_episodes
from hyrl_mj.judging.game import Comparison, Curve, EpisodeCount, WinningShares
from hyrl_mj.learning import changed, preset
from hyrl_mj.physics import mjcf
from hyrl_mj.pipeline import cluster, report
from hyrl_mj.pipeline.sweeping import Board, _seen
from hyrl_mj.policies import PolicyController
from hyrl_mj.runs import sweeps
from hyrl_mj.runs.directory import Run, write_config
from hyrl_mj.runs.sweeps import Common, Row, Setting, Sweep
from hyrl_mj.system import cores, progress
from hyrl_mj.viz import commands, sweep_tables, tables
from hyrl_mj.viz.sweep_page import draw_curves

CIRCLE = Setting("unit_circle", "", 0.1)
SMOKE = {"preset": "smoke", "set": TINY}


# ---- settings that are changed


def test_settings_are_changed_by_name(circle):
    settings = preset(circle, "smoke")
    new = changed(
        settings,
        {
            "stage1.samples": "3e5",
            "lattice": 240,
            "stage6.options.n_epochs": "4",
            "stage1.hidden": "[8, 8]",
        },
    )
    assert new.stage1.samples == 300_000
    assert new.stage1.hidden == (8, 8)
    assert new.lattice == 240
    assert new.stage6.options == settings.stage6.options | {"n_epochs": 4}
    assert new == replace(
        settings, lattice=240,
        stage1=replace(settings.stage1, samples=300_000, hidden=(8, 8)),
        stage6=replace(settings.stage6, options=new.stage6.options),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("stage1.sample", 1, "Did you mean 'stage1.samples'"),
        ("stage1.samples", "many", "stage1: samples 'many' cannot be used"),
        ("eps", 0.2, "give it with --eps"),
        ("stage1.algorithm", "sac", "give it with --algorithm"),
        ("stage1.options.nsteps", 3, "nsteps"),
    ],
)
def test_settings_that_cannot_be_changed(name, value, message, circle):
    with pytest.raises(BadInput, match=message):
        changed(preset(circle, "smoke"), {name: value})


# ---- the plan


@pytest.mark.slow
def test_bad_sweeps_make_nothing(tmp_path, monkeypatch):
    # Some of them import Ray, which then listens where the sweeps below need it to.
    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    out = tmp_path / "sweep"
    for tasks, changes, message in (
        ([], {}, "at least one task"),
        ("unit_circle", {"seeds": ()}, "at least one seed"),
        ("unit_circle", {"seeds": (1, 1)}, "the seed 1 is given twice"),
        ("unit_circle", {"seeds": 2**40}, "seed 1099511627776 cannot be used"),
        ("unit_circle", {"seeds": range(10**9)}, "at most 1,000 runs"),
        ("unit_circle", {"seeds": range(999), "eps": (0.1, 0.2)}, "this one would have 1,998"),
        ("unit_circle", {"eps": (0.1, 0.1)}, "two runs would be called unit_circle-0.1"),
        (("unit_circle", "unit_circle"), {}, "two runs would be called unit_circle-0.1"),
        ("unit_circle", {"eps": (-1.0,)}, "noise bound -1.0"),
        ("unit_circel", {}, "Did you mean 'unit_circle'"),
        ("unit_circle", {"algorithm": ("dqm",)}, "dqm"),
        ("unit_circle", {"set": {"latice": 1}}, "Did you mean 'lattice'"),
        ("unit_circle", {"cores": 0}, "cores 0 cannot be used"),
        ("unit_circle", {"memory": -1}, "memory -1 cannot be used"),
        ("unit_circle", {"address": "nowhere"}, "give HOST:PORT"),
        ("unit_circle", {"address": "127.0.0.1:1"}, "no Ray cluster answers at 127.0.0.1:1"),
        ("unit_circle", {"address": "a..b:1"}, "no Ray cluster answers at a..b:1"),
    ):
        with pytest.raises(BadInput, match=message):
            hyrl_mj.sweep(tasks, out=out, say=str, **{"preset": "smoke", **changes})
        assert not out.exists()


def test_runs_for_which_no_machine_has_room_are_refused():
    nodes = [{"Alive": alive, "Resources": {"CPU": 4, "memory": 2e9}} for alive in (True, False)]
    ray = SimpleNamespace(nodes=lambda: nodes)
    assert [cluster.share(ray, runs, None, 1.0) for runs in (1, 2, 9)] == [4, 2, 1]
    assert cluster.share(ray, 1, 3, 1.0) == 3
    for wanted, memory in ((5, 1.0), (None, 3.0)):
        with pytest.raises(
            BadInput, match=r"no machine has \d cores and \d GB free .*4 and 2\.0 GB"
        ):
            cluster.share(ray, 1, wanted, memory)


@pytest.mark.parametrize("seeds", ["9-0", "", "a", "1-", "0-9-2", "0-99999999999"])
def test_ranges_of_seeds_on_the_command_line(seeds, tmp_path):
    done = call("sweep", "unit_circle", "--seeds", seeds, "--out", tmp_path / "sweep")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "sweep").exists()


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(BadInput, match="is not the folder of a sweep"):
        hyrl_mj.sweep("unit_circle", out=tmp_path, **SMOKE)


def test_another_sweep_is_refused_and_more_seeds_are_taken(tmp_path):
    rows = [Row(CIRCLE, 0)]
    common = Common("smoke", None, {})
    sweeps.opened(tmp_path, common, rows).save(tmp_path)
    with pytest.raises(BadInput, match="--preset smoke there, fast given"):
        sweeps.opened(tmp_path, replace(common, preset="fast"), rows)
    with pytest.raises(
        BadInput, match=r"a run unit_circle-0\.1-0 of unit_circle, and one of /elsewhere"
    ):
        sweeps.opened(tmp_path, common, [Row(replace(CIRCLE, task="/elsewhere/unit_circle.py"), 0)])
    with pytest.raises(BadInput, match="--all-coordinates not given there, given given"):
        sweeps.opened(tmp_path, replace(common, everywhere=True), rows)
    more = sweeps.opened(tmp_path, common, [Row(CIRCLE, 1), Row(replace(CIRCLE, eps=0.2), 1)])
    names = ["unit_circle-0.1-0", "unit_circle-0.1-1", "unit_circle-0.2-1"]
    assert [row.name for row in more.rows] == names


def test_options_of_one_value_and_of_several():
    one = hyrl_mj.SweepOptions(seeds=3, eps=0.2, algorithm="ppo", set={"lattice": "240"})
    several = hyrl_mj.SweepOptions(
        seeds=np.array([3]), eps=[0.2], algorithm=("ppo",), set={"lattice": 240}
    )
    assert one == several
    assert one.seeds == (3,)


def test_a_stranger_s_sweep_leads_nowhere_else(tmp_path):
    Sweep(Common("smoke", None, {}), (Row(CIRCLE, 0),)).save(tmp_path)
    content = json.loads((tmp_path / "sweep.json").read_text())
    content = {name: content[name] for name in ("common", "rows")}

    def reported(**setting):
        content["rows"][0]["setting"] |= setting
        artifacts.write_json(tmp_path / "sweep.json", content, kind="sweep")
        return report(tmp_path).rows

    for other in ("../../unit_circle", "", "/"):
        assert all(Path(row.name).name == row.name for row in reported(task=other))
    with pytest.raises(BadArtifact, match="cannot be the name of a folder"):
        reported(algorithm="a/../../b")
    (tmp_path / "unit_circle-0.1-0").symlink_to("/")
    with pytest.raises(BadArtifact, match="is a link"):
        report(tmp_path)


PLANTED = Common("smoke", None, FEW_CELLS)


@pytest.mark.parametrize(
    ("row", "common", "differs"),
    [
        (Row(CIRCLE, 0), PLANTED, ""),
        (Row(replace(CIRCLE, eps=0.2), 0), PLANTED, "eps: 0.1 there, 0.2 given"),
        (Row(CIRCLE, 1), PLANTED, "seed: 0 there, 1 given"),
        (Row(CIRCLE, 0), replace(PLANTED, horizon=0.4), "horizon: None there, 0.4 given"),
        (Row(CIRCLE, 0), replace(PLANTED, set={}), "lattice: 130 there"),
        (Row(replace(CIRCLE, task="vehicle"), 0), PLANTED, "holds a run of unit_circle with other"),
        (Row(replace(CIRCLE, algorithm="a:B"), 0), PLANTED, "policy: training with ppo"),
    ],
)
def test_a_run_of_other_settings_is_not_shown(row, common, differs, planted_circle, tmp_path):
    shutil.copytree(planted_circle[0].path, tmp_path / row.name)
    found = row.on_disk(tmp_path, common)
    assert found.done == (not differs)
    assert differs in found.sentence


def test_a_run_whose_folder_is_gone_is_not_shown(tmp_path):
    done = Row(CIRCLE, 0, "done", "s", "WON", 1.0, {"hyrl_proved": 1.0})
    Sweep(PLANTED, (done,)).save(tmp_path)
    assert [row.state for row in report(tmp_path).rows] == ["open"]
    assert "unit_circle-0.1-0: open" in (tmp_path / "sweep.html").read_text()


def test_of_what_a_replay_refutes_nothing_is_told(planted_circle):
    """As in a comparison."""
    result = planted_circle[0].robustness
    assert result.game.replays_of("policy").failures
    found = sweeps._figures(result)
    assert found["policy_not_broken"] is found["policy_proved"] is None
    assert found["policy_won"] == result.game.scores["policy"][-1].won
    assert found["policy_not_broken_without_noise"] is not None


@pytest.mark.parametrize("bounded", [(True, True), (False, False), (True, False)])
def test_curves_of_controllers_of_which_nothing_is_proved(bounded):
    shares, drawn = (1.0, 0.5), []
    for one in bounded:
        known, none = (
            WinningShares(*4 * [shares], shares),
            WinningShares(shares, shares, (), (), shares),
        )
        wins = {"policy": none, "hyrl": known if one else none}
        drawn.append(Curve((0.0, 0.1), shares, wins))
    (panel,) = draw_curves({CIRCLE: drawn}).axes
    labels = {line.get_label() for line in panel.lines}
    assert (f"HyRL {'proved' if all(bounded) else 'won'}, own q0") in labels


def test_shares_of_episodes_are_of_all_start_regions():
    counts = tuple(
        EpisodeCount(
            "none", 0.1, False, "hyrl", region, 5, {"reached": n, "crashed": 5 - n}, n / 5, (0, 1)
        )
        for region, n in (("near M*", 0), ("elsewhere", 4))
    )
    found = sweeps._figures(hyrl_mj.Robustness(0.1, False, None, counts, 0))
    assert found == {"hyrl_reached_none": 0.4, "episodes_none": 10}


def test_where_nothing_could_be_compared_nothing_is_withstood():
    def found(compared, lost):
        none, times = {"policy": 0, "hyrl": 0}, {"policy": (1.0, 1.0), "hyrl": (1.0, 1.0)}
        one = Comparison(
            "attack", 5, lost, compared, lost if compared else none, none, 0.0, (-1.0, 1.0), none,
            times, times,
        )  # fmt: skip
        return sweeps._compared(hyrl_mj.Robustness(0.1, False, None, (), 0, comparisons=(one,)))

    lost_without_noise = {"policy_lost_without_noise": 1, "hyrl_lost_without_noise": 0.2}
    assert found(0, {"policy": 5, "hyrl": 1}) == lost_without_noise
    some = found(3, {"policy": 3, "hyrl": 0})
    assert (some["policy_withstood_attack"], some["hyrl_withstood_attack"]) == (0, 1)
    assert "hyrl_late" in some
    assert "policy_late" not in some, "no run arrives"


def test_runs_without_a_figure_are_counted():
    rows = [row(0, hyrl_margin=0.1), row(1, hyrl_margin=None), row(2, hyrl_margin=None)]
    (*_, cells) = sweep_tables.summary_table(Sweep(Common("fast", None, {}), tuple(rows))).rows
    assert cells == ["HyRL margin", "0.1, none in 2 of 3 runs"]


def test_without_ray_one_sentence_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    done = call("sweep", "unit_circle", "--preset", "smoke", "--out", tmp_path / "sweep")
    assert done.returncode == 2
    assert done.stderr == (
        'hyrl-mj: sweep needs Ray, which is not installed: pip install "hyrl-mj[sweep]"\n'
    )


# ---- the tables


def row(seed, **figures):
    return Row(CIRCLE, seed, "done", "all is well", "WON", 10.0, figures)


def test_tables_show_median_least_and_greatest():
    rows = (*(row(i, hyrl_proved=x) for i, x in enumerate((1.0, 0.5, 0.75))), Row(CIRCLE, 3))
    sweep = Sweep(Common("fast", None, {}), rows)
    table = sweep_tables.summary_table(sweep)
    assert table.headings == ["figure", "unit_circle, noise 0.1"]
    assert table.rows == [
        ["runs", "3 of 4"], ["verdicts", "3 WON"], ["HyRL proved, own q0", "75.00% (50.00% to 100%)"],
    ]  # fmt: skip
    assert sweep_tables.worst(rows).seed == 1
    assert tables.markdown(table).splitlines()[1] == "| --- | --- |"


def test_what_runs_say_reads_well_in_a_log():
    lines = []
    with Board(lines.append, 2) as board:
        board.tell(Row(CIRCLE, 0), "begins")
        board.end(row(0))
        board.end(replace(Row(CIRCLE, 1), state="stopped", sentence="no room"))
    assert lines == [
        "unit_circle-0.1-0: 0 s: begins",
        "unit_circle-0.1-0: 10 s: WON: all is well (1 of 2)",
        "unit_circle-0.1-1: 0 s: stopped: no room (2 of 2)",
    ]


# ---- whole sweeps


def own_addresses():
    """The addresses, as in /proc/net/tcp, at which the processes listen that belong to this one."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parents[int(folder.name)] = int(
                (folder / "stat").read_text().rpartition(")")[2].split()[1]
            )
    own = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in own} - own:
        own |= more
    sockets = set()
    for pid in own:
        with suppress(OSError):
            sockets |= {os.readlink(path) for path in Path(f"/proc/{pid}/fd").iterdir()}
    return {address for address, _, inode in listening() if f"socket:[{inode}]" in sockets}


def made_shortly(row, options, *more):
    """Does a run as the processes of a sweep do, but shorter."""
    shorten(patch := pytest.MonkeyPatch())
    coarsen(patch)
    few_noises(patch)
    spare(patch, nodes=6, episodes=20, attack_starts=12)
    return cluster.make(row, options, *more)


def make_sweep(folder):
    """Makes a sweep over two seeds, and notes what it said, and where its processes listened.

    In the current folder lie modules of the names of installed ones, and of one that is not installed.
    """
    said, addresses, here = [], set(), folder / "stranger"
    here.mkdir()
    plant_modules(here)

    def say(text):
        said.append(text)
        addresses.update(own_addresses())

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        patch.setenv("MUJOCO_GL", "disable")  # videos take long
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(os.path.isabs, sys.path)))
        patch.setattr(cluster, "make", made_shortly)
        result = hyrl_mj.sweep("unit_circle", seeds=(0, 1), out=folder / "sweep", say=say, **SMOKE)
    assert not (here / MARKER).exists(), "a module in the current folder was imported"
    (folder / "told").write_bytes(pickle.dumps((result, said, addresses)))


@pytest.fixture(scope="module")
def swept(small_runs, made_once):
    folder = made_once("sweep", make_sweep)
    return folder / "sweep", *pickle.loads((folder / "told").read_bytes())


@pytest.mark.slow
def test_a_changed_setting_stands_in_the_run_and_in_the_message_about_another(swept):
    run = hyrl_mj.load_run(swept[0] / "unit_circle-0.1-0")
    assert run.settings.stage1.samples == TINY["stage1.samples"]
    assert commands.changed(run) == []
    for name in ("rods", "cells"):  # the others are as in the preset, which is shortened here
        assert f"{name}={TINY[name]}" in commands.beginning(run)
    other = {**TINY, "stage1.samples": 8192}
    with pytest.raises(BadInput, match=r"stage1\.samples: 2048 there, 8192 given"):
        hyrl_mj.run("unit_circle", preset="smoke", set=other, out=run.path)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has /proc")
def test_nobody_else_can_reach_it(swept):
    loopback = {"0100007F", "0" * 24 + "01000000", "0000000000000000FFFF00000100007F"}
    assert swept[3]
    assert swept[3] <= loopback


@pytest.mark.slow
def test_a_sweep_makes_the_runs_that_are_made_one_by_one(swept, circle, tmp_path):
    out, result, said, _ = swept
    assert [row.state for row in result.rows] == ["done", "done"]
    assert any("unit_circle-0.1-1" in line and "retrain" in line for line in said)
    run = Run(tmp_path, changed(replace(preset(circle, "smoke"), seed=1), TINY))
    write_config(run)
    for stage in ("train", "critical-set", "partition", "extended-sets", "retrain"):
        run = pipeline.run_stage(run, stage, str)
    made = hyrl_mj.load_run(out / "unit_circle-0.1-1")
    names = ("policy.safetensors", "mode_0.safetensors", "mode_1.safetensors")
    for name in (*names, "extended_sets.npz", "critical_set.npz"):
        assert (run.path / name).read_bytes() == (made.path / name).read_bytes()
    assert result.rows[1].verdict == made.verdict.word


@pytest.mark.slow
def test_what_is_done_is_not_done_again_and_tables_are_made_from_what_is_there(swept):
    out, result, *_ = swept
    before = {path: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}
    said = []
    again = hyrl_mj.sweep("unit_circle", seeds=(0, 1), out=out, say=said.append, **SMOKE)
    assert len(said) == 2
    assert all("done before" in line for line in said)
    assert again == result == report(out)
    assert {path: path.read_bytes() for path in before} == before
    with (out / "sweep.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["seed"] for line in lines] == ["0", "1"]
    assert float(lines[0]["hyrl_won"]) == pytest.approx(
        result.rows[0].figures["hyrl_won"], rel=1e-4
    )
    page = (out / "sweep.html").read_text()
    assert 'href="unit_circle-0.1-0/report.html"' in page
    assert "data:image/png;base64" in page


RAYLETS = """
import sys
from ray.cluster_utils import Cluster

quiet = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 80 * 2**20}
cluster = Cluster(initialize_head=True, head_node_args=quiet)
cluster.add_node(**quiet)
print(cluster.address, flush=True)
sys.stdin.read()
cluster.shutdown()
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Ray has no clusters elsewhere")
def test_a_cluster_of_two_machines_makes_runs_on_both_and_goes_on_after_one_that_fails(
    swept, tmp_path, monkeypatch
):
    """Two of its runs have still to write their pages, and the last one cannot begin."""
    out = shutil.copytree(swept[0], tmp_path / "sweep")
    for page in out.glob("*/report.html"):
        page.rename(page.with_name("hidden"))
    broken = out / "unit_circle-0.1-2"
    broken.write_text("a file where the run directory should be")
    Sweep(Common("smoke", None, TINY), tuple(Row(CIRCLE, seed) for seed in (0, 1))).save(out)

    def make(row, options, *_):
        """Finds the page of a run again, while another machine does the same."""
        import ray

        (options.out / "hidden").rename(options.out / "report.html")
        (options.out / "where").write_text(ray.get_runtime_context().get_node_id())
        other = options.out.with_name(f"unit_circle-0.1-{1 - row.seed}") / "where"
        until = time.monotonic() + 120
        while not other.exists() and time.monotonic() < until:
            time.sleep(0.1)
        return row

    monkeypatch.setattr(cluster, "make", make)
    # Both listen where this process can reach them, whatever has been imported before.
    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", RAYLETS], stdin=pipe, stdout=pipe, text=True
    ) as two:
        words = ["sweep", "unit_circle", "--seeds", "0-2", "--preset", "smoke", "--out", out]
        words += ["--address", two.stdout.readline().strip()]
        done = call(*words, "--set", *(f"{k}={v}" for k, v in TINY.items()))
        two.stdin.close()
    assert done.returncode == 1, done.stderr
    rows = Sweep.load(out).rows
    assert [row.state for row in rows] == ["done", "done", "stopped"], done.stdout
    assert len({path.read_text() for path in out.glob("*/where")}) == 2
    assert str(broken) in rows[2].sentence


def test_a_machine_that_keeps_its_files_is_told_of(tmp_path):
    kept = _seen(row(0), tmp_path, PLANTED)
    assert kept.state == "stopped"
    assert "share" in kept.sentence


@pytest.mark.slow
def test_a_run_directory_that_is_held_is_waited_for(monkeypatch, tmp_path):
    from hyrl_mj.files.manifest import Busy

    tries = []

    def busy(task, options, say):
        tries.append(time.monotonic())
        if len(tries) < 2:
            raise Busy("another process is working there")
        raise BadInput("no more")

    monkeypatch.setattr(cluster, "run", busy)
    monkeypatch.setattr(cores, "allowed", 0)
    ended = cluster.make(Row(CIRCLE, 0), hyrl_mj.RunOptions(out=Path(tmp_path)), 1)
    assert (ended.state, ended.sentence) == ("stopped", "no more")
    assert len(tries) == 2


# ---- a pool inside a run


LOPSIDED = """
from hyrl_mj.tasks.unit_circle import UnitCircle


class Lopsided(UnitCircle):
    name = "lopsided"
    env_id = "hyrl_mj/Lopsided-v0"
    mirror = None
"""


class Still:
    """A policy that never moves."""

    def act(self, measured):
        return np.zeros((len(measured), 1))


class Doubled:
    """A pool of one process, this one, to which everything is sent as to another one."""

    def __init__(self):
        self.jobs = 0

    def map(self, work, jobs):
        for job in jobs:
            self.jobs += 1
            sent, what = pickle.loads(pickle.dumps((work, job)))
            yield pickle.loads(pickle.dumps(sent(what)))


@pytest.fixture
def doubled(monkeypatch):
    """Such a pool, after which this process uses its cores again."""
    monkeypatch.setattr(cores, "allowed", 0)
    monkeypatch.setattr(progress, "shown", progress.shown)
    return Doubled()


@pytest.mark.slow
def test_episodes_are_the_same_with_a_pool(circle, doubled, monkeypatch):
    monkeypatch.setattr(type(circle), "max_steps", 20)
    monkeypatch.setattr(episodes, "BATCH", 64)
    count = partial(
        noisy_episodes,
        circle,
        Regions(np.array([[np.pi]])),
        {"still": PolicyController(Still()), "other": PolicyController(Still())},
        (hyrl_mj.Noise("uniform", 0.1), hyrl_mj.Noise("none", 0.1)),
        150,
    )
    plain = count()
    with hyrl_mj.using_pool(doubled):
        assert count() == plain
    assert doubled.jobs == 2 * 2 * 3
    assert not cores.has_pool()


@pytest.mark.slow
def test_modes_are_the_same_with_a_pool(small_runs, doubled, circle, tmp_path):
    """The lopsided circle has no mirror, so that its modes are trained side by side."""
    path = tmp_path / "lopsided.py"
    path.write_text(LOPSIDED)
    shutil.copy(mjcf.models_dir() / "unit_circle.xml", tmp_path / "lopsided.xml")
    shutil.copytree(mjcf.models_dir() / "common", tmp_path / "common")
    task = hyrl_mj.get_task(path)
    few = replace(preset(task, "smoke").stage6, samples=2_048)
    plain = plant(tmp_path / "plain", task, decisions(circle), halves(circle), stage6=few)
    pooled = hyrl_mj.load_run(shutil.copytree(plain.path, tmp_path / "pooled"))
    pipeline.run_stage(plain, "retrain", str)
    with hyrl_mj.using_pool(doubled):
        pipeline.run_stage(pooled, "retrain", str)
    assert doubled.jobs == 2
    for name in ("mode_0.safetensors", "mode_1.safetensors", "retraining.json"):
        assert (pooled.path / name).read_bytes() == (plain.path / name).read_bytes()
