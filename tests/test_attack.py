"""The attack finds what breaks, and its short lane finds nothing."""

from __future__ import annotations

import importlib
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import unmeasured
from attacks import Answer, child, differences
from attacks.crafted_agents import Payload

from hyrl_mj.errors import BadInput

HERE = str(Path(__file__).parent)
# Weaknesses that are planted, and the attacks that must find them.
PLANTED = {
    "crashes": (
        "import re; from hyrl_mj.files.manifest import FILES, Manifest\n"
        "def there(self, stage):\n"
        "    names = [path.relative_to(self.folder).as_posix() for path in self.folder.rglob('*')]\n"
        "    return any(re.fullmatch(FILES[stage], name) for name in names)\n"
        "Manifest.is_done = there"
    ),
    "artifacts": "from hyrl_mj.files.manifest import Manifest; Manifest.checked = lambda self, path: path",
    "tasks": "from hyrl_mj.pipeline import runs; runs.check_task = lambda task, played: task",
}
# Mends that are taken out: the trials that find it, of so many, what they say, and how it is taken out.
OPENED = {
    "code of a stranger": (
        "^spec", 218, "was executed",
        "from hyrl_mj.files import trust; trust.is_received = lambda: False",
    ),
    "an environment without limits": (
        "^arguments", 58, "hangs",
        "from hyrl_mj.gym_import.pool import Pool; Pool.try_out = lambda *given: None",
    ),
    "modules in the current folder": (
        "^modules", 46, "was executed|has no attribute|is not a package",
        "from attacks import folders\n"
        "folders.PROGRAM = f'import sys; sys.path.insert(0, \"\"); {folders.PROGRAM}'",
    ),
    "an agent without end": (
        "^agent", 64, "hangs",
        "import inspect\n"
        "from hyrl_mj.policies import pickled\n"
        "source = inspect.getsource(pickled.entries).replace('{name:', '{str(name):')\n"
        "exec(source.replace(' if isinstance(name, str)', ''), vars(pickled))",
    ),
    "a name that doubles itself": (
        "^agent", 41, "MB more", "from hyrl_mj.policies import pickled; pickled.LONGEST = 10**12",
    ),
    "keys that are there twice": (
        "^field", 61, "hangs|to be refused",
        "from hyrl_mj.fields import files\n"
        "def counts(names):\n"
        "    names = list(names)\n"
        "    return {name: names.count(name) for name in names}\n"
        "files.Counter = counts",
    ),
    "a post thinner than its rim": (
        "^field", 61, "traceback",
        "import inspect\n"
        "from attacks import honest\n"
        "from hyrl_mj.fields import driving\n"
        "source = inspect.getsource(driving)\n"
        "thin = 'max(geom.size[0] + larger, radii[number] / 2, 1e-6)'\n"
        "assert thin in source\n"
        "exec(source.replace(thin, 'geom.size[0] + larger'), vars(driving))\n"
        "honest.Driving = driving.Driving",
    ),
    "a name that controls the terminal": (
        "^arguments", 81, "control characters",
        "import io\n"
        "from hyrl_mj import errors\n"
        "from hyrl_mj.gym_import import making\n"
        "from hyrl_mj.sets import chart\n"
        "from hyrl_mj.system import streams\n"
        "chart.has_controls = lambda text: False\n"
        "errors.printable = making.printable = str\n"
        "streams._Escaping.write = io.TextIOWrapper.write",
    ),
    "formulas in a table": (
        "^sweep", 115, "formula", "from hyrl_mj.runs import sweeps; sweeps._plain = str",
    ),
    "a file that is overwritten": (
        "^path", 115, "overwrites",
        "from contextlib import nullcontext\n"
        "from hyrl_mj.files import trust\n"
        "trust.output = lambda *paths, force=False: nullcontext()",
    ),
    "a sentence without end": (
        "^spec", 92, "a sentence of", "from hyrl_mj import errors; errors.LONGEST = 10**9",
    ),
    "a model without limits": (
        "^model", 46, "exit status -11|hangs",
        "from hyrl_mj.physics import mjcf; mjcf._try = lambda path: None",
    ),
}  # fmt: skip


def attack(*words, weakness=""):
    code = f"import sys; sys.path.insert(0, {HERE!r}); import attack\n{weakness}\n"
    return subprocess.run(
        [sys.executable, "-P", "-c", f"{code}sys.exit(attack.main())", *words],
        env=unmeasured.environment(),
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_the_short_lane_finds_nothing():
    answer = attack("--short")
    assert answer.returncode == 0, answer.stdout + answer.stderr


@pytest.mark.long
def test_planted_weaknesses_are_found():
    words = ("--count", "6", "--only", ",".join(PLANTED))
    answer = attack(*words, weakness="\n".join(PLANTED.values()))
    assert answer.returncode == 1, answer.stdout + answer.stderr
    assert all(f"{name}: " in answer.stdout for name in PLANTED)


@pytest.mark.long
@pytest.mark.parametrize("door", OPENED)
def test_a_door_that_is_opened_again_is_found(door):
    trials, count, said, weakness = OPENED[door]
    words = ("--only", "doors", "--match", trials, "--count", str(count))
    answer = attack(*words, weakness=weakness)
    assert answer.returncode == 1, answer.stdout + answer.stderr
    assert re.search(f"^doors: .*({said})", answer.stdout, re.MULTILINE), answer.stdout


# ---- one process


def answered(work, folder, **more):
    return child(work, folder, **more).broke()


def test_what_a_process_does_is_told(tmp_path):
    def work():
        print("out")
        print("hyrl-mj: err", file=sys.stderr)
        Path("file").touch()
        sys.exit(2)

    answer = child(work, tmp_path)
    assert (answer.status, answer.out, answer.err) == (2, "out\n", "hyrl-mj: err\n")
    assert (tmp_path / "file").exists()
    assert answer.broke() == ""


def test_a_traceback_is_no_sentence(tmp_path):
    def work():
        raise BadInput("not caught")

    assert "traceback" in answered(work, tmp_path)


@pytest.mark.slow
def test_a_process_that_hangs_is_ended_with_those_that_it_began(tmp_path):
    def work():
        subprocess.run(["sleep", "60"], check=False)

    began = time.monotonic()
    assert "hangs" in answered(work, tmp_path, seconds=0.2)
    assert time.monotonic() - began < 30


@pytest.mark.slow
def test_a_process_that_is_busy_for_ever_is_ended(tmp_path):
    def work():
        while True:
            pass

    assert "hangs" in answered(work, tmp_path, seconds=1)


def test_a_signal_ends_a_process(tmp_path):
    answer = child(lambda: time.sleep(60), tmp_path, sent=(0.1, int(signal.SIGTERM)))
    assert answer.status == -signal.SIGTERM
    assert "exit status -15" in answer.broke()


@pytest.mark.slow
def test_memory_is_that_of_the_process(tmp_path):
    # In a process as small as that of an attack: a fork begins with the memory of the one that forks.
    code = (
        f"import sys; sys.path.insert(0, {HERE!r})\n"
        "from pathlib import Path\n"
        "from attacks import child\n"
        "works = (lambda: None, lambda: len(b'x' * 300 * 2**20))\n"
        "print(*(child(work, Path()).memory for work in works))"
    )
    words = [sys.executable, "-P", "-c", code]
    options = {"cwd": tmp_path, "env": unmeasured.environment(), "check": True}
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, **options)
    usual, more = map(float, done.stdout.split())
    assert more > usual + 250


@pytest.mark.parametrize(
    ("err", "found"),
    [
        ("hyrl-mj: one\nhyrl-mj: two\n", r"not 1 sentence"),
        ("", r"not 1 sentence"),
        ("hyrl-mj: \x1b[31mred\n", "control characters"),
    ],
)
def test_what_is_no_sentence_is_found(err, found):
    assert found in Answer(2, "", err, (0.1, 0.1), 1.0, False).broke()


def test_a_payload_leaves_its_mark(tmp_path):
    import pickle

    child(lambda: pickle.loads(pickle.dumps(Payload())), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["executed"]


def test_run_directories_are_compared_by_their_bytes(tmp_path):
    for name in ("one", "other"):
        for file in ("same", "logs/progress.csv", ".lock"):
            path = tmp_path / name / file
            path.parent.mkdir(exist_ok=True, parents=True)
            path.write_text(name if file != "same" else "same")
    one, other = tmp_path / "one", tmp_path / "other"
    assert differences(one, other) == ""
    (one / "same").write_text("else")
    (one / "more").touch()
    (other / "less").touch()
    text = "less is missing, more is left over, same has other bytes"
    assert differences(one, other) == text


def test_unknown_attacks_are_named(monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "egl")  # as the program sets it where it is not set
    monkeypatch.setattr(sys, "argv", ["attack.py", "--only", "attacks"])
    with pytest.raises(SystemExit) as end:
        importlib.import_module("attack").main()
    assert end.value.code == 2
    assert "unknown attack attacks: choose some of crashes, kills" in capsys.readouterr().err
