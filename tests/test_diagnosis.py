"""A diagnosis of planted policies finds a start that noise makes them lose, and says and shows how."""

from dataclasses import replace

import numpy as np
import pytest
from planted import ChartPolicy, homing_policy, no_renderer, sign_policy

import hyrl_mj
from hyrl_mj import HybridArc
from hyrl_mj.learning import presets
from hyrl_mj.runs.diagnosis import losses_of, losses_sentence, usual_arc, worst_arc
from hyrl_mj.viz import diagnosis

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_runs")]  # a diagnosis of each task

EPS = 0.1
PLANTED = {"unit_circle": homing_policy, "vehicle": sign_policy}


@pytest.fixture(scope="module", params=["unit_circle", "vehicle"])
def diagnosed(request, small_runs, tmp_path_factory):
    """The diagnosis of a policy that decides at pi, or on y = 0: the run, and what was said.

    As on a machine that cannot draw: no video is waited for.
    """
    task, said = hyrl_mj.get_task(request.param), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnosis, "render_replay", no_renderer)
        patch.setitem(presets._LATTICE_SMOKE, 1, 1_200)  # fewer nodes would tell another margin
        run = hyrl_mj.diagnose(
            task.name,
            PLANTED[task.name](task),
            out=tmp_path_factory.mktemp("runs") / task.name,
            preset="smoke",
            say=said.append,
        )
    return run, [line.removeprefix("diagnose: ") for line in said]


@pytest.fixture
def run(diagnosed):
    return diagnosed[0]


@pytest.fixture
def worst(run):
    return HybridArc.load(run.path / diagnosis.FOLDER / "worst.npz")


def from_critical_set(run, arc):
    """How far off M* an arc begins."""
    difference = run.task.chart.difference(run.critical_set.points, arc.z[0])
    return np.linalg.norm(difference, axis=1).min()


# ---- the arcs


@pytest.mark.first(1)
def test_the_worst_arc_is_lost_to_the_worst_noise_within_its_bound(run, worst):
    assert worst.outcome == {"unit_circle": "stalled", "vehicle": "crashed"}[run.task.name]
    assert worst.noise == "worst"
    off = run.task.chart.difference(worst.measured[:-1], worst.z[:-1])
    assert 0.5 * EPS < np.abs(off).max() <= EPS + 1e-9
    np.testing.assert_array_equal(off[:, ~np.array(run.task.noisy)], 0)


def test_it_begins_where_the_policy_decides(run, worst):
    assert from_critical_set(run, worst) <= EPS


def test_without_noise_the_same_start_is_won(run, worst):
    assert hyrl_mj.simulate(run.task, run.policy, worst.z[0]).outcome == "reached"


def test_without_noise_nothing_is_lost(run):
    quiet = replace(run, settings=replace(run.settings, eps=0.0))
    # Its files were made with other settings, so they are not read again.
    results = ("policy", "critical_set", "partition")
    vars(quiet).update({name: getattr(run, name) for name in results})
    losses = losses_of(quiet)
    assert worst_arc(quiet, losses) is None
    assert losses_sentence(losses) == "it loses none of them on the nodes"


def test_the_usual_arc_begins_on_the_critical_set_under_alternating_noise(run):
    arc = usual_arc(run)
    assert from_critical_set(run, arc) == pytest.approx(0, abs=1e-9)
    off = (arc.measured[:-1] - arc.z[:-1])[:, np.array(run.task.noisy)]
    np.testing.assert_allclose(off[::2], EPS)
    np.testing.assert_allclose(off[1::2], -EPS)


# ---- what is written and said


@pytest.mark.long
def test_what_is_lost_without_noise_is_said_first(tmp_path, circle, monkeypatch):
    monkeypatch.setattr(diagnosis, "render_replay", no_renderer)
    still = ChartPolicy(circle, lambda z: np.zeros((len(z), 1)))
    said = []
    hyrl_mj.diagnose("unit_circle", still, out=tmp_path / "still", preset="smoke", say=said.append)
    lines = [line.removeprefix("diagnose: ") for line in said]
    first = next(i for i, line in enumerate(lines) if line.startswith("without noise it loses"))
    assert all("on theta are known" not in line for line in lines[:first])
    assert any("lost nodes without noise, too" in line for line in lines)
    assert any(line.endswith("under worst noise, and without noise, too") for line in lines)
    assert not any("closer than the noise" in line for line in lines)


def test_what_is_said_is_on_the_page(diagnosed):
    run, said = diagnosed
    page = (run.path / diagnosis.PAGE).read_text()
    assert said[-1] == f"page at {run.path / diagnosis.PAGE}"
    first = next(i for i, line in enumerate(said) if line == "no video: no GL library here")
    sentences = said[first + 1 : -1]
    name = {"unit_circle": "theta", "vehicle": "y"}[run.task.name]
    unit = run.task.chart.units[-1]
    # The game of the vehicle has nodes on y = 0, where this policy decides.
    margin = {"unit_circle": "0.02", "vehicle": "0 m"}[run.task.name]
    for words in (
        "critical set of 1 piece",
        f"signals of noise of up to 0.1 {unit} on {name} are known that make it lose",
        f"it wins all of them up to noise {margin}",
        "under worst noise",
    ):
        assert any(words in sentence for sentence in sentences)
    assert [sentence for sentence in sentences if sentence[1:] not in page] == []


def test_its_pictures_are_on_the_page_and_no_video(run):
    page, folder = (run.path / diagnosis.PAGE).read_text(), run.path / diagnosis.FOLDER
    names = ("overview", "policy", "robustness_map", "robustness_curve")
    assert [name for name in names if not (folder / f"{name}.png").is_file()] == []
    assert page.count('<img src="data:image/png') == len(names)
    assert "<video" not in page
    assert not list(folder.glob("*.mp4"))


def test_a_diagnosis_that_finds_nothing_removes_what_an_earlier_one_has_left(run, tmp_path):
    elsewhere, said = replace(run, path=tmp_path), []
    folder = tmp_path / diagnosis.FOLDER
    folder.mkdir()
    for suffix in (".npz", ".mp4", ".png"):
        (folder / f"worst{suffix}").write_bytes(b"of an earlier diagnosis")
    diagnosis.write_worst(elsewhere, None, said.append)
    assert list(folder.iterdir()) == []
    assert said == []
