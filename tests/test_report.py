"""The report: what is in the page, what is said of what is missing, and how it looks."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shutil
import subprocess
from base64 import b64decode
from dataclasses import asdict, replace
from html import escape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from command_line import contents
from PIL import Image
from planted import Cube, believe, decisions, extended, halves, without_pdfs, without_pictures

from hyrl_mj import BadArtifact, BadInput, MlpPolicy, load_run
from hyrl_mj.files.artifacts import replacing, write_json
from hyrl_mj.judging import Arrivals, ModeResult, Retraining
from hyrl_mj.learning.presets import preset
from hyrl_mj.pipeline import ExamineOptions, examine_run, run_stage, steps
from hyrl_mj.policies import Agent
from hyrl_mj.runs.directory import Run, write_config
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages.critical_set import CriticalSet
from hyrl_mj.stages.partition import Partition
from hyrl_mj.tasks import Scene, registry
from hyrl_mj.viz import tables
from hyrl_mj.viz.commands import beginning, changed as changed_settings
from hyrl_mj.viz.encoding import video
from hyrl_mj.viz.figures import CLASS_COLOURS
from hyrl_mj.viz.report import render, write_report

# The page tells what the game says, however coarse it is.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_runs")]
MAGENTA, GREEN = (230, 20, 200), (20, 200, 60)
POSTER = (642, 240)  # [pixels], like no other picture
VOID = {"meta", "img", "br", "link", "input", "hr", "source"}


# ---- a planted run


def linear(task, bias):
    """A policy without hidden layers that turns or steers away from the critical set, and drifts."""
    if task.learning.algorithm == "ppo":
        k = len(task.observation_low)
        weight = -np.eye(len(task.inputs), k, k - len(task.inputs))
        names, values = "action_net", (weight, np.full(len(weight), bias))
    else:
        levels = task.input_levels[:, 0]
        names = "q_net.q_net.0"
        values = np.outer(levels, [0, 0, 1]), bias * levels
    weights = {
        f"{names}.{part}": value.astype(np.float32)
        for part, value in zip(("weight", "bias"), values, strict=True)
    }
    return MlpPolicy(task, task.learning.algorithm, "relu", weights)


def plant(path, task, critical, partition, slack=0.2, **settings):
    """All but what noise can do, the replays and the video."""
    run = Run(path, replace(preset(task, "smoke"), **settings))
    write_config(run)
    with run.manifest.stage("train"):
        linear(task, 0.0).save(path / "policy.safetensors")
        Arrivals(990, 0, 1_000, trainings=1).save(path / "arrivals.json")
    with run.manifest.stage("critical-set"):
        critical.save(path / "critical_set.npz")
    with run.manifest.stage("partition"):
        partition.save(path / "partition.npz")
    with run.manifest.stage("extended-sets"):
        sets = [GridSet(partition.grid, part.values - slack) for part in partition.parts]
        extended(sets).save(path / "extended_sets.npz")
    with run.manifest.stage("retrain"):
        for q in partition.modes:
            linear(task, 0.3 - 0.6 * q).save(path / f"mode_{q}.safetensors")
        results = tuple(ModeResult(q, 1.0, 1) for q in partition.modes)
        Retraining(results).save(path / "retraining.json")
    return load_run(path)


def film(path):
    """A replay and its poster: magenta on the left, green on the right."""
    frame = np.full((POSTER[1], POSTER[0], 3), MAGENTA, dtype=np.uint8)
    frame[:, POSTER[0] // 2 :] = GREEN
    with load_run(path).manifest.stage("replay"):
        with video(path / "replay.mp4", *POSTER, 10) as add:
            for _ in range(5):
                add(frame)
        with replacing(path / "replay.png") as temporary:
            Image.fromarray(frame).save(temporary)


@pytest.fixture(scope="module")
def finished(small_runs, tmp_path_factory):
    """A run of the vehicle."""
    path, task = tmp_path_factory.mktemp("runs") / "vehicle", registry.get_task("vehicle")
    run = plant(path, task, decisions(task), halves(task, 60))
    run_stage(run, "simulate", say=str)
    with pytest.MonkeyPatch.context() as patch:
        without_pdfs(patch)  # the pictures are looked at
        examine_run(run, ExamineOptions(noise=("uniform",), episodes=40), say=str)
    film(path)
    return path


@pytest.fixture
def copied(finished, tmp_path):
    """A copy of it, to be damaged."""
    return shutil.copytree(finished, tmp_path / finished.name)


class Page(HTMLParser):
    """A page, taken apart: elements with their attributes, text, tables, entries of lists."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.texts, self.tables, self.numbers = [], [], {}, []
        self._open = []
        self.feed(text)
        assert self._open == [], "every element is closed"
        self.text = " ".join(" ".join(self.texts).split())

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)
        if tag == "table":
            self.rows = self.tables[self.last_caption] = []
        if tag == "dt":
            self.numbers.append("")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if "style" in self._open:
            return
        self.texts.append(data)
        if {"dt", "dd"} & set(self._open):
            self.numbers[-1] += data
        if {"td", "th"} & set(self._open):
            self.rows[-1][-1] += data
        elif self._open and self._open[-1] == "p":
            self.last_caption = data

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    def table(self, words):
        """The rows of the table under a caption with these words, as dicts."""
        (rows,) = [rows for caption, rows in self.tables.items() if words in caption]
        return [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]


def page_of(path):
    return Page(render(load_run(path)))


def data(uri, kind):
    head, content = uri.split(",", 1)
    assert head == f"data:{kind};base64"
    return b64decode(content, validate=True)


# ---- what is in the page


def test_the_page_needs_nothing_but_itself(finished):
    text = render(load_run(finished))
    page = Page(text)
    assert not page.all("script")
    for _, attributes in page.elements:
        assert not [name for name in attributes if name.startswith("on")]
        for name in {"src", "href", "poster", "srcset", "data"} & attributes.keys():
            assert attributes[name].startswith("data:")
    assert "http" not in re.sub(r"base64,[^\"]*", "", text).replace("http-equiv", "")
    assert not re.search(r"url\(|@import", text)


def test_it_is_a_proper_document(finished):
    text = render(load_run(finished))
    page = Page(text)
    assert text.startswith("<!DOCTYPE html>")
    assert page.all("html") == [{"lang": "en"}]
    assert len(page.all("title")) == len(page.all("h1")) == len(page.all("main")) == 1
    names = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(names) == len(set(names))
    labelled = [a["aria-labelledby"] for _, a in page.elements if "aria-labelledby" in a]
    assert labelled
    assert set(labelled) <= set(names)
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in page.all(
        "meta"
    )


def test_pictures_and_video_are_the_files(finished):
    page = page_of(finished)
    pictures = {attributes["alt"]: attributes for attributes in page.all("img")}
    assert all(pictures)
    found = {}
    for alt, attributes in pictures.items():
        found[alt] = data(attributes["src"], "image/png")
        image = Image.open(io.BytesIO(found[alt]))
        image.load()
        assert (int(attributes["width"]), int(attributes["height"])) == image.size
    files = [finished / "figures" / f"robustness_{name}.png" for name in ("map", "curve")]
    poster = (finished / "replay.png").read_bytes()
    assert list(found.values()) == [poster, *(path.read_bytes() for path in files)]
    (film,) = page.all("video")
    assert data(film["src"], "video/mp4") == (finished / "replay.mp4").read_bytes()
    assert data(film["poster"], "image/png") == poster
    assert len(page.all("figcaption")) == 3


@pytest.mark.parametrize("problem", ["unit_circle", "vehicle"])
def test_the_scores_are_those_of_the_game(problem, copied, planted_circle, tmp_path):
    if problem == "unit_circle":  # on which runs last for ever
        copied = shutil.copytree(planted_circle[0].path, tmp_path / problem)
    content = asdict(load_run(copied).robustness)
    rng = np.random.default_rng(0)
    # Numbers of which no two are the same.
    for score in (score for scores in content["game"]["scores"].values() for score in scores):
        numbers = {key: rng.random() for key in score if key != "eps" and score[key] is not None}
        score.update(numbers)
    write_json(copied / "robustness.json", content, "robustness")
    believe(copied)
    page, run = page_of(copied), load_run(copied)
    game = run.robustness.game
    for who in ("policy", "hyrl"):
        last = game.scores[who][-1]
        assert tables.proved_text(last.proved) in page.numbers[0]
        assert f"{100 * (1 - last.not_broken):.2f}%" in page.numbers[1]
        assert tables.proved_text(last.proved_any) in page.numbers[2]
    rows = page.table("worst case")
    names = {"policy": "RL policy", "hyrl": "HyRL", "limit": "limit"}
    for who, name in names.items():
        for score in game.scores[who]:
            (row,) = [
                row
                for row in rows
                if row["controller"] == name and float(next(iter(row.values()))) == score.eps
            ]
            shares = {"open": "open", "winnable": "winnable"}
            for which in ("own", "any"):
                end = "_any" * (which == "any")
                shares[f"proved, {which} q0"] = f"proved{end}"
                shares[f"not broken, {which} q0"] = f"not_broken{end}"
            for heading, key in shares.items():
                value = getattr(score, key)
                assert (row[heading] == "-") == (value is None)
                if value is not None:
                    shown = float(row[heading].strip("<>%"))
                    assert shown == pytest.approx(100 * value, abs=0.0101)
            if score.excursion is not None:
                own, some = (
                    (score.proved_time or score.time),
                    (score.proved_time_any or score.time_any),
                )
                assert row["latest arrival, own q0"] == f"{own:.2f} s"
                assert row["latest, any q0"] == f"{some:.2f} s"
            if score.excursion is not None and who != "limit":
                assert float(row["excursion [rad]"]) == pytest.approx(score.excursion, abs=1e-3)
    for row, (who, margin) in zip(page.table("margins"), game.margin.items(), strict=True):
        assert row["controller"] == names[who]
        shown = row["largest noise without a lost state"]
        unit = run.task.chart.units[0]
        assert shown == ("none" if margin is None else f"{margin:.3g} {unit}")
        (off,) = [float(cell) for heading, cell in row.items() if "no noise" in heading]
        assert off == pytest.approx(game.miss_without_noise[who], abs=1e-3)


def test_settings_versions_and_the_command_are_told(finished):
    page, run = page_of(finished), load_run(finished)
    config = json.loads((finished / "config.json").read_text())
    rows = dict(tuple(row) for row in page.tables["Versions"])
    assert rows == config["versions"]
    rows = dict(tuple(row) for row in page.tables["Settings"])
    assert rows["seed"] == "0"
    assert rows["eps"] == f"0.1 {run.task.chart.units[0]}"
    training = {name: cells for name, *cells in page.tables["Training"]}
    stages = (run.settings.stage1, run.settings.stage6)
    assert training["gamma"] == [str(stage.gamma) for stage in stages]
    assert f"hyrl-mj run {finished.name} --eps 0.1 --seed 0 --preset smoke" in page.text
    assert "--episodes 40 --noise uniform --seed 0" in page.text
    assert run.critical_set.sentence(run.task) in page.text


def test_the_command_tells_what_is_not_the_default(copied):
    run = load_run(copied)
    settings = replace(run.settings, eps=0.05, seed=7, horizon=0.4)
    changed = Run(copied, settings)
    write_config(changed)
    believe(copied)
    text = page_of(copied).text
    assert f"run {copied.name} --eps 0.05 --seed 7 --preset smoke --horizon 0.4" in text
    assert "--eps 0.1" in text, "it was examined with another bound"
    assert "differ in" not in text
    write_config(Run(copied, replace(settings, cells=99)))
    believe(copied)
    text = page_of(copied).text
    assert "--horizon 0.4 --set cells=99" in text
    assert "differ in" not in text
    # Settings of an algorithm of others cannot be compared, but that of the lattice can, and is repeated.
    foreign = replace(settings.stage1, algorithm="mine:PPO")
    other = Run(copied, replace(run.settings, stage1=foreign, cells=99))
    assert beginning(other).endswith("--algorithm mine:PPO --set cells=99")
    assert changed_settings(other) == []


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("agent.onnx", "hyrl-mj robustify vehicle --policy agent.onnx .* --set cells=99"),
        ("", r"hyrl_mj\.robustify\('vehicle', policy, .* set=\{'cells': 99\}\)"),
    ],
)
def test_the_command_of_an_agent_repeats_what_was_set(source, told, copied):
    agent = Agent("onnx" if source else "function", source, "0" * 64)
    given = preset(load_run(copied).task, "smoke", eps=0.1, agent=agent)
    run = Run(copied, replace(given, cells=99))
    assert re.fullmatch(told, beginning(run))
    assert changed_settings(run) == []
    fewer = replace(given.stage6, options={})  # as another version has made it
    assert changed_settings(Run(copied, replace(given, stage6=fewer))) == ["stage6"]


def test_the_same_artifacts_give_the_same_bytes(copied):
    write_report(load_run(copied), copied / "report.html")
    first = (copied / "report.html").read_bytes()
    elsewhere = shutil.copytree(copied, copied.parent / "other" / copied.name)
    write_report(load_run(elsewhere), elsewhere / "again.html")
    assert (elsewhere / "again.html").read_bytes() == first


def test_odd_characters_are_escaped(finished, tmp_path):
    name = '<b>odd & "run"<script>\'\udcff'
    path = shutil.copytree(finished, tmp_path / name)
    write_report(load_run(path), path / "report.html")
    page = Page((path / "report.html").read_text(encoding="utf-8"))
    assert '<b>odd & "run"<script>\'\N{REPLACEMENT CHARACTER}' in page.text
    assert not page.all("script")


# ---- what is missing


MISSING = [
    (("replay.mp4", "replay.png"), "There is no video of the replay"),
    (("replay.png",), "There is no video of the replay"),
    (("robustness.json",), "It has not been examined yet"),
    (("figures/robustness_map.png", "figures/robustness_curve.png"), "There are no figures"),
    (("arcs/start1_hyrl_q0.npz",), "The replays have not been simulated"),
]


def test_of_a_whole_run_nothing_is_missing(finished):
    text = page_of(finished).text
    assert [words for _, words in MISSING if words in text] == []


@pytest.mark.parametrize(("lost", "words"), MISSING)
def test_what_is_missing_is_said_in_its_place(lost, words, copied):
    for name in lost:
        (copied / name).unlink()
    assert words in page_of(copied).text


def test_a_bare_controller_is_enough(copied):
    for name in ("arcs", "figures"):
        shutil.rmtree(copied / name)
    for name in ("robustness.json", "robustness.npz", "replay.mp4", "replay.png"):
        (copied / name).unlink()
    page = page_of(copied)
    assert not page.all("img") + page.all("video")
    assert page.text.count("hyrl-mj robustness RUN") == 2


def test_no_critical_set_is_said(copied):
    run = load_run(copied)
    d = run.task.chart.dimension
    none = replace(run.critical_set, points=np.empty((0, d)), component=np.zeros(0, dtype=int))
    none.save(copied / "critical_set.npz")
    believe(copied)
    page = page_of(copied)
    assert "no critical set found at this resolution" in page.text
    assert "on the critical set" not in page.text
    assert len(page.table("alternating noise")) == 5


class Rover(Cube):
    """A task with a chart of three dimensions, which has all that a run needs."""

    max_steps = 6
    start_low, start_high = (-0.5,) * 3, (0.5,) * 3
    observation_low, observation_high = (-1.0,) * 3, (1.0,) * 3
    scene = Scene(starts=((0.1, 0.0, 0.0), (-0.2, 0.1, 0.0)), time=0.3, mode_names=("up", "down"))

    def __init__(self):
        super().__init__(lambda z: z[:, 0])
        self.noisy = (True, False, False)


@pytest.mark.parametrize("game", [True, False])
def test_in_three_dimensions_the_game_is_an_estimate_beside_the_episodes(
    tmp_path, monkeypatch, game
):
    little = replace(steps.SPARING, nodes=4, attack_starts=8, attack_rounds=1)
    monkeypatch.setattr(steps, "SPARING", little)
    without_pictures(monkeypatch)
    monkeypatch.setitem(registry._REGISTRY, "cube", Rover)
    if not game:
        monkeypatch.setattr(Run, "why_no_game", "it is not wanted here")
    task, path = Rover(), tmp_path / "cube"
    grid = Grid.with_cells(task.chart, 6)
    up = grid.nodes[:, 0] >= 0
    parts = tuple(GridSet.from_mask(grid, part) for part in (up, ~up))
    critical = CriticalSet(np.zeros((1, 3)), np.zeros(1, dtype=int), resolution=0.1, spacing=0.3)
    run = plant(path, task, critical, Partition((0, 1), parts, np.ones(len(grid.nodes), bool)))
    run_stage(run, "simulate", say=str)
    examine_run(run, ExamineOptions(episodes=8), say=str)
    page = page_of(path)
    assert len(page.table("noisy episodes")) == len(run.robustness.episodes)
    assert ("This is an estimate" in page.text) == game
    said = page.text.replace("verdict: winnable", "")  # a setting
    assert ("winnable" in said) == game
    assert ("stand in for the worst case, because it is not wanted here." in page.text) != game
    assert not any("margins" in title for title in page.tables)


# ---- what goes wrong


@pytest.mark.parametrize("name", ["mode_0.safetensors", "critical_set.npz", "partition.npz"])
def test_an_unfinished_run_is_refused(name, copied):
    (copied / name).unlink()
    before = contents(copied)
    with pytest.raises(BadArtifact, match=re.escape(f"{copied / name}")):
        write_report(load_run(copied), copied / "report.html")
    assert contents(copied) == before


def test_a_failed_write_leaves_the_last_report(copied, monkeypatch):
    (copied / "report.html").write_text("the last one")
    (copied / "taken.html").mkdir()
    before = contents(copied)
    run = load_run(copied)
    with pytest.raises(BadInput, match=r"taken.html cannot be written"):
        write_report(run, copied / "taken.html")
    with pytest.raises(BadInput, match=r"page.pdf is not: give a name that ends in .html"):
        write_report(run, copied / "page.pdf")
    write = Path.write_text

    def full(path, text, **options):
        write(path, text[:100], **options)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(BadInput, match="No space left on device"):
        write_report(run, copied / "report.html")
    assert contents(copied) == before


# ---- how it looks

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)

needs_chromium = pytest.mark.skipif(
    "CI" not in os.environ and CHROMIUM is None, reason="no chromium on this machine"
)


def chromium(page, profile, width=1280, height=6000, *arguments):
    """Open a page; what the browser wrote to its standard output."""
    assert CHROMIUM is not None, "apt-get install chromium"
    done = subprocess.run(
        [
            CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--disable-dev-shm-usage", "--no-first-run", f"--user-data-dir={profile}",
            f"--window-size={width},{height}", *arguments, page.as_uri(),
        ],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


PROBE = """<script>
const inside = e => e.parentElement.closest(".scroll, pre");
const wide = [...document.body.querySelectorAll("*")].filter(
  e => !inside(e) && e.getBoundingClientRect().right > innerWidth + 0.5);
parent.document.body.dataset["at" + innerWidth] = JSON.stringify(
  {page: document.documentElement.scrollWidth, wide: wide.map(e => e.tagName),
   boxes: [...document.querySelectorAll(".scroll")].filter(e => e.scrollWidth > e.clientWidth).length});
</script>"""


@pytest.fixture(scope="module")
def written(finished):
    write_report(load_run(finished), finished / "report.html")
    return finished / "report.html"


def count(picture, colour):
    """Pixels of nearly that colour."""
    return int((np.abs(picture.astype(int) - colour).max(axis=-1) < 12).sum())


@needs_chromium
def test_nothing_is_wider_than_the_window(written, tmp_path):
    text = re.sub(r"<meta http-equiv=[^>]*>", "", written.read_text(encoding="utf-8"))
    inner = escape(text.replace("</body>", f"{PROBE}</body>"))
    # The browser's own window cannot be as narrow as a telephone, a frame can.
    frames = [
        f'<iframe style="border:0;width:{width}px;height:800px" srcdoc="{inner}"></iframe>'
        for width in (360, 1280)
    ]
    probed = tmp_path / "probed.html"
    probed.write_text(f"<!DOCTYPE html><body>{''.join(frames)}</body>", encoding="utf-8")
    dom = chromium(probed, tmp_path / "profile", 1800, 1000, "--dump-dom")
    (body,) = Page(dom).all("body")
    for width in (360, 1280):
        found = json.loads(body[f"data-at{width}"])
        assert found["page"] <= width
        assert found["wide"] == []
        assert (found["boxes"] > 0) == (width == 360), "wide tables scroll inside themselves"


@needs_chromium
def test_the_figures_are_seen(written, tmp_path):
    shot, width, height = tmp_path / "shot.png", 360, 3600
    chromium(written, tmp_path / "profile", width, height, f"--screenshot={shot}")
    picture = np.asarray(Image.open(shot).convert("RGB"))
    assert picture.shape == (height, width, 3)
    # The poster is more than half as wide as the window; the controls of the video hide some of it.
    area = (width / 2) ** 2 * POSTER[1] / POSTER[0]
    assert count(picture, MAGENTA) > area / 8
    assert count(picture, GREEN) > area / 8
    classes = [tuple(bytes.fromhex(colour[1:])) for colour in CLASS_COLOURS]
    assert sum(count(picture, colour) for colour in classes) > area / 4


@needs_chromium
def test_on_paper_the_video_is_its_poster(written, tmp_path):
    paper = tmp_path / "paper.pdf"
    chromium(written, tmp_path / "profile", 1280, 6000, f"--print-to-pdf={paper}")
    content = paper.read_bytes()
    assert content.startswith(b"%PDF")
    sizes = set(re.findall(rb"/Width (\d+)\s*/Height (\d+)", content))
    figures = [Image.open(p).size for p in (written.parent / "figures").glob("*.png")]
    assert len(figures) == 2
    for width, height in (POSTER, *figures):
        assert (b"%d" % width, b"%d" % height) in sizes
