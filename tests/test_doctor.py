"""`hyrl-mj doctor` finds what is missing, and says how to mend it."""

from __future__ import annotations

import imageio_ffmpeg
import pytest
from command_line import python
from gl import needs_gl

import hyrl_mj
from hyrl_mj.cli import doctor
from hyrl_mj.errors import NoRenderer
from hyrl_mj.physics import memory


@pytest.fixture
def healthy(monkeypatch):
    """A machine that renders and encodes, whatever this one can do."""
    monkeypatch.setattr(doctor, "_rendering", lambda: "a rasteriser")
    monkeypatch.setattr(doctor, "_encoding", lambda: "encoded")


@pytest.mark.slow
def test_versions_without_importing():
    code = (
        "import sys; from hyrl_mj.cli import doctor; lines, missing = doctor.versions();"
        "print(*lines, sep='\\n'); print('missing:', missing);"
        "print('imported:', {'torch', 'stable_baselines3', 'mediapy', 'matplotlib'} & set(sys.modules))"
    )
    *lines, missing, imported = python(code).stdout.splitlines()
    assert missing == "missing: []"
    assert imported == "imported: set()"
    named = [line.split()[0] for line in lines]
    assert named[:2] == ["python", "hyrl-mj"]
    assert {"cma", "gymnasium", "mujoco", "stable-baselines3", "torch"} <= {*named}
    assert not {"ray", "pytest"} & {*named}, "nobody needs those"
    assert all(line.split()[1][0].isdigit() for line in lines)


def test_a_healthy_machine(healthy):
    lines, well = doctor.report()
    text = "\n".join(lines)
    assert well, text
    assert "cure" not in text
    assert "a rasteriser" in text
    versions, _ = doctor.versions()
    assert lines[: len(versions)] == versions


def test_it_names_this_package_and_the_version_of_mujoco_that_is_wrong(healthy, monkeypatch):
    assert doctor.versions()[0][1].split() == ["hyrl-mj", hyrl_mj.__version__]
    monkeypatch.setattr(memory, "WRONG_VERSION", memory.mujoco.__version__)
    assert "sparse constraint Jacobian" in "\n".join(doctor.report()[0])
    monkeypatch.setattr(memory, "WRONG_VERSION", "0.0")
    assert "sparse" not in "\n".join(doctor.report()[0])


def test_a_missing_distribution(healthy, monkeypatch):
    needed = ["numpy<3,>=1.26", "no-such-distribution", "pytest; extra == 'test'"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: needed)
    lines, well = doctor.report()
    assert not well
    assert "cure: pip install no-such-distribution" in lines


@pytest.mark.slow
def test_no_gl(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    monkeypatch.setattr(doctor, "_encoding", lambda: "encoded")
    lines, well = doctor.report()
    assert not well
    (line,) = [line for line in lines if line.startswith("rendering")]
    assert "FAILED" in line
    assert line.count(doctor.GL_CURE) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "says"),
    [("import os; os.abort()", "SIGABRT"), ("import time; time.sleep(60)", "within")],
)
def test_a_gl_driver_that_crashes_or_hangs(monkeypatch, code, says):
    monkeypatch.setattr(doctor, "_FRAMES", code)
    monkeypatch.setattr(doctor, "RENDER_TIMEOUT", 2.0)
    with pytest.raises(NoRenderer, match=says) as refused:
        doctor._rendering()
    assert doctor.GL_CURE in str(refused.value)


def test_ffmpeg(monkeypatch, tmp_path):
    assert doctor._encoding() == "encoded"
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(tmp_path / "ffmpeg"))
    with pytest.raises(NoRenderer, match="pip install"):
        doctor._encoding()


@pytest.mark.slow
@needs_gl
def test_it_says_what_renders_and_how_fast():
    name, speed = doctor._rendering().rsplit(", ", 1)
    assert name
    assert float(speed.split()[0]) > 0
    assert speed.endswith("full frames/s at 640 x 480")
