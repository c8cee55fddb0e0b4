"""`scripts/fields.py`: the fields that it draws, and what it counts."""

import json
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj.fields import Driving
from hyrl_mj.tasks import LEFT, RIGHT, Layouts

SCRIPT = Path(__file__).parents[1] / "scripts" / "fields.py"


@pytest.fixture(scope="module")
def script():
    return runpy.run_path(str(SCRIPT))


def test_random_fields_have_gaps_and_starts_have_room(script):
    rng = np.random.default_rng(0)
    layouts = script["drawn"](rng, 5, 4, moving=False)
    for places, radii, goal in zip(layouts.tracks[:, 0], layouts.radii, layouts.goals, strict=True):
        gaps = np.linalg.norm(places[:, None] - places, axis=2) - radii[:, None] - radii
        assert gaps[np.triu_indices(5, 1)].min() >= 0.8
        assert (np.linalg.norm(places - goal, axis=1) - radii).min() >= 0.5
    z = script["starts"](layouts, 3, rng)
    assert z[:, 3].tolist() == np.repeat(range(4), 3).tolist()
    away = np.linalg.norm(layouts.tracks[z[:, 3].astype(int), 0] - z[:, None, :2], axis=2)
    assert (away - layouts.radii[z[:, 3].astype(int)]).min() >= 0.3
    moving = script["drawn"](rng, 4, 3, moving=True)
    number, still = np.arange(3), np.zeros(3)
    speeds = np.linalg.norm(moving.velocities(number, still), axis=2)
    assert (speeds[:, ::2] > 0).all()
    assert (speeds[:, 1::2] == 0).all()
    assert speeds.max() <= 0.4


def test_published_layouts_are_read(script, tmp_path):
    starts = {"radius_m": 4, "angles_over_pi": [1.0, 0.5]}
    swings = {"centre": [1, 0], "R": 1, "period_s": 12, "phase_over_pi": 0.5, "radius_m": 0.5}
    layouts = {
        "goal": [0, 0],
        "static": {"one": {"obstacles": [[-2, 0, 0.5]], "starts": starts}},
        "moving": {"two": {"obstacles": [swings], "starts": starts}},
    }
    path = tmp_path / "fields.json"
    path.write_text(json.dumps(layouts))
    (_, one, z), (_, two, _) = script["published"](path)
    np.testing.assert_allclose(z, [[-4, 0, 0], [0, 4, -np.pi / 2]], atol=1e-12)
    np.testing.assert_allclose(one.positions(np.zeros(1, int), np.ones(1)), [[[-2, 0]]])
    np.testing.assert_allclose(two.positions(np.zeros(1, int), np.array([6.0])), [[[1, -1]]])


class Ahead:
    """Drives ahead in one mode."""

    modes = (0,)

    def initial_mode(self, measured):
        return np.zeros(len(measured), dtype=int)

    def step(self, q, measured):
        return np.tile([1.0, 0.0], (len(measured), 1)), q


@pytest.mark.slow
def test_outcomes_are_counted(script):
    layouts = Layouts(np.array([[[[-2.0, 0.0]]]]), np.array([[0.5]]), np.zeros((1, 2)))
    z = np.array([[-4.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-4.0, 2.0, 0.0]])
    task = Driving(hyrl_mj.get_task("field"), layouts, time=5.0, starts=z)
    row = script["Row"]()
    script["drive"](task, Ahead(), z, hyrl_mj.Noise("none", 0.0), row)
    assert sorted(row.outcomes) == ["crashed", "reached", "stalled"]
    assert row.cells()[:4] == ["3", "1", "1", "0"]


def test_the_rows_lack_what_their_names_say(script):
    task = hyrl_mj.get_task("field")
    layouts = script["drawn"](np.random.default_rng(0), 4, 2, moving=False)
    ahead = SimpleNamespace(inputs=lambda observed: np.tile([1.0, 0.0], (len(observed), 1)))
    settings, policies = SimpleNamespace(eps=0.1), dict.fromkeys((LEFT, RIGHT), ahead)
    run = SimpleNamespace(settings=settings, policy=ahead, mode_policies=policies)
    loops = script["rows_of"](run, Driving(task, layouts), seed=0)
    # 0.15 m in front of the first post of the first field, with the face to it.
    post, radius = layouts.tracks[0, 0, 0], layouts.radii[0, 0]
    pose = np.array([[post[0] - radius - 0.25, post[1], 0.0]])
    measured = loops["law, both"].task.measured_at(pose, np.zeros(1), np.zeros(1, int))
    measured = np.column_stack([measured, [0]])
    q = np.array([2])  # the first post is in focus, and is passed on the right
    answers = {name: loops[name].step(q, measured) for name in list(loops)[1:-1]}
    speed = {name: u[0, 0] for name, (u, _) in answers.items()}
    assert speed["learned, neither"] == speed["learned, memory"] == 1.0
    assert speed["learned, guard"] == speed["learned, both (HyRL)"] < 0.1
    assert [answers[name][1][0] for name in ("learned, memory", "learned, both (HyRL)")] == [2, 2]
    left, right = (loops["learned, guard"].step(np.array([q]), measured) for q in (0, 2))
    np.testing.assert_array_equal(left[1], right[1])  # without a memory of the side
