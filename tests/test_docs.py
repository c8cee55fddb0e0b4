"""README and the manual: every block runs, every command and name exists, and every number is true."""

import contextlib
import inspect
import io
import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib

import pytest
import unmeasured
from gl import needs_gl
from manual import LANGUAGES, PAGES, ROOT, SHORTER, blocks
from test_algorithms import make_sac_run
from test_robustify import make_robust
from test_sensors import make_late
from test_sweep import make_sweep

import hyrl_mj
from hyrl_mj import cli

MANUAL = ROOT / "docs"
# Processes find the package in this checkout.
PATH = os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", "")))
TASKS = ("unit_circle", "vehicle")
texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def prose(page):
    """A page without its blocks."""
    return re.sub(r"^```.*?^```$", "", texts[page], flags=re.MULTILINE | re.DOTALL)


def code(page):
    """The words in backticks of a page's prose."""
    return re.findall(r"`([^`]+)`", prose(page))


# ---- what is written


def test_the_readme_is_short():
    assert len(texts[ROOT / "README.md"].splitlines()) <= 90


def test_terms_come_before_the_first_table():
    before = texts[ROOT / "README.md"].split("\n|")[0]
    for term in (
        "chart",
        "Critical set",
        "Mode",
        "Own q0",
        "Any q0",
        "Winnable",
        "Proved",
        "Not broken",
    ):
        assert f"**{term}**" in before


def test_the_version_is_the_same_everywhere():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    version = tomllib.loads(text)["project"]["version"]
    (day,) = re.findall(
        rf"^## \[{re.escape(version)}\] - (\d{{4}}-\d\d-\d\d)$",
        (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {version}\ndate-released: {day}\n" in cited


def test_the_gallery_shows_every_picture_and_these_are_small():
    pictures = {*(MANUAL / "images").iterdir()}
    shown = re.findall(r"\]\((images/[^)]+)\)", texts[MANUAL / "gallery.md"])
    assert {MANUAL / name for name in shown} == pictures
    assert all(path.stat().st_size < 400_000 for path in pictures)


@pytest.mark.slow
def test_the_script_of_the_gallery_draws_its_pictures(
    planted_circle, tmp_path, monkeypatch, capsys
):
    script = str(ROOT / "scripts" / "gallery.py")
    monkeypatch.setattr(sys, "argv", [script, str(planted_circle[0].path), "--out", str(tmp_path)])
    runpy.run_path(script, run_name="__main__")
    for picture in tmp_path.iterdir():
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert f"images/{picture.name}" in texts[MANUAL / "gallery.md"]
    assert len(capsys.readouterr().out.splitlines()) == len([*tmp_path.iterdir()]) == 3
    monkeypatch.setattr(sys, "argv", [script, "nowhere"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(script, run_name="__main__")
    assert end.value.code == 2
    assert "nowhere is not a run directory" in capsys.readouterr().err


@each_page
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    for link in links:
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.is_file(), f"{link} leads nowhere"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w]+", "-", heading.lower()) for heading in headings]


def test_every_page_is_linked_from_the_readme_and_in_the_navigation():
    navigation = (ROOT / ".mkdocs.yml").read_text(encoding="utf-8")
    for page in set(MANUAL.glob("*.md")):
        assert re.search(rf"^ +- (\w+: )?{page.name}$", navigation, re.MULTILINE)
        assert page.name == "index.md" or f"(docs/{page.name})" in texts[ROOT / "README.md"]


def test_every_public_name_is_in_the_reference():
    documented = re.findall(r"^::: hyrl_mj\.(\w+)$", texts[MANUAL / "reference.md"], re.MULTILINE)
    public = [name for name in hyrl_mj.__all__ if not inspect.ismodule(getattr(hyrl_mj, name))]
    assert sorted(documented) == sorted(public)


@each_page
def test_names_in_the_text_exist(page):
    for name in re.findall(r"`(hyrl_mj(?:\.\w+)+)", prose(page)):
        if name.startswith("hyrl_mj.tasks"):  # the group of entry points, too
            continue
        parent, _, last = name.rpartition(".")
        module = __import__(parent, fromlist=[last])
        assert hasattr(module, last), f"{name} does not exist"


def options_of(command):
    """The options that a command of `hyrl-mj` has, from its help."""
    told = io.StringIO()
    with contextlib.redirect_stdout(told), pytest.raises(SystemExit) as end:
        cli.dispatch([command, "--help"])
    assert not end.value.code
    return set(re.findall(r"--[a-z][\w-]*", told.getvalue()))


def test_every_command_and_option_exists():
    commands = [
        words[1:]
        for page in PAGES
        for block in blocks(page)
        if block.language == "bash"
        for words in block.commands
        if words[0] == "hyrl-mj"
    ]
    inline = [re.sub(r"[<>]", "", text) for page in PAGES for text in code(page)]
    commands += [shlex.split(text)[1:] for text in inline if text.startswith("hyrl-mj ")]
    known = {}
    for name, *rest in commands:
        options = {word for word in (name, *rest) if word.startswith("--")}
        if name.startswith("--"):
            known.setdefault(name, {"--help", "--version"})
        elif name not in known:
            assert name in cli.COMMANDS, f"hyrl-mj has no command {name}"
            known[name] = options_of(name)
        assert options <= known[name], f"hyrl-mj {name} has no {options - known[name]}"
    anywhere = set().union(*known.values(), {"--help", "--version"})
    alone = {text.split()[0] for text in inline if text.startswith("--")}
    assert alone <= anywhere, f"no command has {alone - anywhere}"


def test_blocks_have_a_language_that_is_run():
    for page in PAGES:
        for block in blocks(page):
            assert block.language in LANGUAGES, f"{block} is {block.language!r}"
        assert texts[page].count("```") == 2 * len(blocks(page))


def test_what_is_shortened_is_written_somewhere():
    assert all(any(long in text for text in texts.values()) for long in SHORTER)


def test_options_and_numbers_of_scripts_exist():
    for page in PAGES:
        for script in re.findall(r"scripts/\w+(?:\.py)?", texts[page]):
            assert (ROOT / script).is_file(), f"{page.name} names {script}"


# ---- what runs


RUN = [page for page in PAGES if any(block.language != "toml" for block in blocks(page))]
BROKEN = {
    "python": "```python\n1 / 0\n```\n",
    "command": "```bash\nhyrl-mj lists\n```\n",
    "unknown": "```bash\nls\n```\n",
}


@pytest.fixture(scope="module")
def answers(small_runs, made_once, tmp_path_factory):
    """What happened to the blocks of each page, and of broken ones, by its name without the suffix."""
    folder = tmp_path_factory.mktemp("manual")
    sweep = made_once("sweep", make_sweep) / "sweep"
    shutil.copytree(sweep, folder / "sweeps" / "runs" / "circle_seeds")
    sac = made_once("circle_sac", make_sac_run) / "run"
    shutil.copytree(sac, folder / "algorithms" / "runs" / "circle_sac")
    late = made_once("late", make_late) / "run"
    shutil.copytree(late, folder / "sensors" / "runs" / "vehicle_late")
    robust = made_once("robust", make_robust)
    shutil.copytree(robust / "run", folder / "your-agent" / "runs" / "vehicle_robust")
    shutil.copy(robust / "agent.zip", folder / "your-agent" / "made.zip")
    broken = [folder / f"broken_{name}.md" for name in BROKEN]
    for page, text in zip(broken, BROKEN.values(), strict=True):
        page.write_text(text)
    subprocess.run(
        [sys.executable, ROOT / "tests" / "manual.py", *RUN, *broken],
        # Ray starts a cluster of its own: one that a test beside this one has started may end at any time.
        cwd=folder, env=unmeasured.environment(PYTHONPATH=PATH, RAY_ADDRESS="local"), check=False,
    )  # fmt: skip
    return {path.parent.name: json.loads(path.read_text()) for path in folder.glob("*/answer.json")}


@pytest.mark.slow
@needs_gl
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
def test_the_blocks_of_a_page_run(page, answers):
    answer = answers[page.stem]
    assert answer["status"] == 0, answer["said"]
    assert "Traceback" not in answer["said"]


@pytest.mark.slow
@pytest.mark.parametrize("name", BROKEN)
def test_a_block_that_stops_working_is_noticed(name, answers):
    assert answers[f"broken_{name}"]["status"] == 1


@pytest.mark.slow
def test_the_manual_is_built_without_a_warning_and_asks_nobody(tmp_path):
    pages = tmp_path / "site"
    words = ("build", "-f", ".mkdocs.yml", "--strict", "-d", pages)
    # With --quiet there would be no warnings, which are errors here.
    environment = unmeasured.environment(PYTHONPATH=PATH, NO_MKDOCS_2_WARNING="1")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", *words],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert {page.with_suffix(".html").name for page in MANUAL.glob("*.md")} <= {
        path.name for path in pages.glob("*.html")
    }
    for path in pages.glob("*.html"):
        loaded = re.findall(
            r"<(?:link|script|img)[^>]*(?:href|src)=\"?(http[^\s\">]*)", path.read_text()
        )
        assert not loaded
