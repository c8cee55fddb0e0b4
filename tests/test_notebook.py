"""A run in Python: its figures, replays, simulations and tables, and one sentence for each misuse."""

import sys
from base64 import b64decode
from types import SimpleNamespace

import numpy as np
import pytest
from gl import needs_gl
from matplotlib.figure import Figure

import hyrl_mj
from hyrl_mj import BadInput, Noise
from hyrl_mj.viz import figures, notebook
from hyrl_mj.viz.tables import robustness_rows


@pytest.fixture(scope="module")
def run(planted_circle):
    return planted_circle[0]


def test_it_lists_what_is_there_and_says_so(run):
    assert dir(run) == sorted(notebook.ATTRIBUTES)
    assert not [name for name in dir(run) if name.startswith("_") or not hasattr(run, name)]
    with pytest.raises(AttributeError, match=r"run 'polt': choose one of path, .*mean 'plot'"):
        _ = run.polt
    assert run.anew().plot, "a run that is read anew has the same methods"


def test_what_a_run_holds_shows_itself_in_one_line(run):
    for name in notebook.ATTRIBUTES:
        assert "\n" not in repr(getattr(run, name)), name
    assert repr(run.controller) == "HybridController(unit_circle, modes 0, 1)"


def test_an_error_of_its_own_is_not_taken_for_an_unknown_attribute(run, monkeypatch):
    broken = property(lambda self: self.task.nonsense)
    monkeypatch.setattr(notebook.Run, "broken", broken, raising=False)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = run.broken


@pytest.mark.slow
@pytest.mark.parametrize("name", figures.FIGURES)
def test_it_draws_its_figures(run, name):
    assert isinstance(run.plot(name), Figure)


def test_it_simulates_both_controllers(run):
    one = run.simulate([3.0], "uniform", eps=0.05, q0=1, horizon=0.5)
    assert [*one] == ["policy", "hyrl"]
    assert (one["hyrl"].q[0], one["hyrl"].noise, one["hyrl"].bound) == (1, "uniform", 0.05)
    several = run.simulate([[3.0], [3.1]], Noise("alternating", 0.1), horizon=0.5)
    assert [len(arcs) for arcs in several.values()] == [2, 2]
    np.testing.assert_array_equal(several["policy"][1].z[0], [3.1])


def test_its_examination_is_a_table(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=list))
    rows = run.to_dataframe()
    game = run.robustness.game
    worst = [row for row in rows if row["noise"] == "worst"]
    assert len(worst) == sum(map(len, game.scores.values()))
    for row in worst:
        score = next(s for s in game.scores[row["controller"]] if s.eps == row["eps"])
        assert row["proved"] == score.proved
        assert row["lost"] == 1 - score.not_broken
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(BadInput, match="pip install pandas"):
        run.to_dataframe()


def test_episodes_and_attacks_are_rows_of_the_table():
    episode = SimpleNamespace(
        noise="uniform", controller="hyrl", eps=0.1, region="near M*", episodes=8, reached=0.75,
        interval=(0.4, 0.9),
    )  # fmt: skip
    attack = SimpleNamespace(
        controller="policy",
        eps=0.1,
        attacked=20,
        lost=5,
        interval=(0.1, 0.5),
        tried={"a": 3, "b": 4},
    )
    one, other = robustness_rows(SimpleNamespace(game=None, episodes=[episode], attacks=[attack]))
    assert (one["lost"], one["runs"], one["starts"]) == (0.25, 8, "near M*")
    np.testing.assert_allclose((one["lost_low"], one["lost_high"]), (0.1, 0.6))
    assert (other["noise"], other["lost"], other["runs"]) == ("attack", 0.25, 20)
    never = SimpleNamespace(**(vars(attack) | {"attacked": 0, "lost": 0}))
    (row,) = robustness_rows(SimpleNamespace(game=None, episodes=[], attacks=[never]))
    assert np.isnan(row["lost"]), "what never arrives is not called unbroken"


@pytest.mark.slow
@needs_gl
def test_its_replay_is_shown_by_a_notebook_and_saved(run, tmp_path):
    replay = run.replay(np.array([[3.0], [3.2]]), "uniform", size=(480, 160), fps=1)
    page = replay._repr_html_()
    assert page.startswith("<video")
    assert b64decode(page.split("base64,")[1].split('"')[0]) == replay.content
    assert "\n" not in repr(replay)
    replay.save(str(tmp_path / "mine.gif"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.gif", "mine.png"]
    with pytest.raises(BadInput, match="give a name that ends in one of"):
        replay.save(tmp_path / "mine.avi")
    with pytest.raises(BadInput, match="3 is no file: give its path"):
        replay.save(3)


def test_the_video_of_the_run_is_not_rendered_again(run, monkeypatch):
    has = type(run.manifest).has
    monkeypatch.setattr(
        type(run.manifest), "has", lambda m, path: path.suffix == ".mp4" or has(m, path)
    )
    monkeypatch.setattr(notebook, "Replay", lambda render, path=None: path)
    assert run.replay() == run.path / "replay.mp4"
    assert run.replay(fps=10) is None


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda run: run.plot("x"), "unknown figure 'x': choose one of overview, "),
        (lambda run: run.plot(["overview"]), "unknown figure .*: choose one of overview, "),
        (lambda run: run.simulate(np.empty((0, 1))), "no start is given"),
        (lambda run: run.replay(size=((1,), (2, 3))), "size .* cannot be used"),
        (lambda run: run.simulate([3.0, 1.0]), "a state of unit_circle is 1 number"),
        (lambda run: run.simulate([3.0], 3), "noise 3 cannot be used"),
        (lambda run: run.simulate([3.0], Noise(), eps=1), "tells its own bounds: leave eps out"),
        (lambda run: run.replay("best"), "unknown starts 'best': choose one of critical, paper"),
        (lambda run: run.replay([[7.0, 1.0]]), "a state of unit_circle is 1 number"),
        (lambda run: run.replay(fps="a"), "fps 'a' cannot be used"),
        (lambda run: run.replay(slow_motion=None), "slow_motion None cannot be used"),
        (lambda run: run.replay(size=3), "size 3 cannot be used: give width and height"),
        (lambda run: run.replay(size=(480.5, 160)), "size .* cannot be used"),
        (lambda run: hyrl_mj.load_run(3), "3 is no run directory: give its path"),
        (lambda run: hyrl_mj.vector_field("runs/x"), "'runs/x' is no run: give that of"),
    ],
)
def test_a_misuse_gets_one_sentence(run, call, message):
    with pytest.raises(BadInput, match=message):
        call(run)
