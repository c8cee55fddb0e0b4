"""Fields that nobody would draw: a run that arrives has come to the goal and touched nothing on its way."""

import json

import numpy as np
import pytest
from test_drive import BODY, driven, planted, post, start  # noqa: F401

from hyrl_mj.fields import ending, read_field

DT = 0.05
FINER = 400  # looks at a run for each sample

RADII = (1e-9, 0.05, 0.3, 0.9, 2.0)
SPEEDS = (0.0, 0.0, 0.01, 0.4, 3.0, 50.0, 900.0)  # [m] from a position to the next


def drawn(rng):
    """A field whose posts overlap goal, starts and each other, rush about, or stand far away."""
    posts, kind = [], rng.integers(4)
    for _ in range(rng.integers(1, 6)):
        radius, angle = rng.choice(RADII), rng.uniform(-np.pi, np.pi)
        beside = (radius + rng.uniform(-0.1, 0.4)) * np.array([np.cos(angle), np.sin(angle)])
        near = rng.uniform((-4, -1.5), (1, 1.5))
        first = (beside, beside - [4, 0], near, 200 * near)[kind]
        steps = rng.normal(0, rng.choice(SPEEDS), (rng.integers(1, 30), 2))
        track = np.clip(np.vstack([first, first + steps.cumsum(axis=0)]), -1000, 1000)
        posts.append({"radius_m": radius, "positions_m": track.tolist()})
    places = [(-4, 0), (-4, 0.1), *rng.uniform((-5, -1.5), (-3, 1.5), (2, 2)), (0.25, 0.0)]
    return {
        "goal_m": [0, 0],
        "posts": posts,
        "starts": [start(*place, rng.uniform(-7, 7)) for place in places],
        "interval_s": rng.choice([0.001, 0.01, 0.05, 0.3, 1.0]),
        "time_s": rng.choice([0.01, 2.0, 8.0]),
    }


def looked_at(content, arc):
    """What the inputs and the file alone tell: how far from the goal a run ends, and its least clearance.

    The third number is the way that a post moves between two looks, at most.
    """
    pose, path = arc.z[0, :3].copy(), [arc.z[0, :2]]
    for speed, rate in arc.u[np.isfinite(arc.u).all(axis=1)]:
        pose += DT * np.array([speed * np.cos(pose[2]), speed * np.sin(pose[2]), rate])
        path.append(pose[:2].copy())
    t = DT * np.arange(len(path))
    fine = np.linspace(0, t[-1], (len(path) - 1) * FINER + 1)
    least, moved = np.inf, 0.0
    for one in content["posts"]:
        track = np.array(one["positions_m"])
        turns = content["interval_s"] * np.arange(len(track))
        at = np.union1d(fine, turns[turns <= t[-1]])
        away = [
            np.interp(at, turns, track[:, i]) - np.interp(at, t, np.array(path)[:, i])
            for i in (0, 1)
        ]
        least = min(least, (np.hypot(*away) - one["radius_m"] - BODY).min())
        moved = max(moved, np.hypot(*np.diff(away, axis=1)).max(initial=0.0))
    return np.hypot(*path[-1]), least, moved


@pytest.mark.first(3)
@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [*range(8), *(pytest.param(i, marks=pytest.mark.long) for i in range(8, 40))]
)
def test_what_is_said_of_a_run_is_so(planted, tmp_path, seed):  # noqa: F811
    rng, ends = np.random.default_rng(seed), []
    for number in range(2):
        path, content = tmp_path / f"{number}.json", drawn(rng)
        path.write_text(json.dumps(content))
        noise = str(rng.choice(["none", "alternating", "uniform"]))
        result = driven(planted, read_field(path), noise=noise)
        for arc in (*result.arcs["policy"], *result.arcs["hyrl"]):
            end, (away, least, moved) = ending(result.task, arc), looked_at(content, arc)
            ends.append(end)
            if end == "arrived":
                assert away <= result.task.reached + 1e-6
            if end == "crashed":
                assert least <= moved / 2 + 1e-6  # it touches between two looks
            else:
                assert least > -1e-6
    assert len(ends) == 20


@pytest.mark.parametrize(
    "one", [post(-3, 0, 1e-9), post(-3, 0, 0.03), post(900, -900), post(-3, 0, 999)]
)
def test_posts_of_any_size_anywhere_are_driven_past(planted, tmp_path, one):  # noqa: F811
    path = tmp_path / "field.json"
    content = {"goal_m": [0, 0], "posts": [one], "starts": [start(-3, 2)], "time_s": 0.2}
    path.write_text(json.dumps(content))
    result = driven(planted, read_field(path))
    said = "crashed" if one["radius_m"] > 2 else "stalled"
    assert [ending(result.task, arc) for arc in result.arcs["hyrl"]] == [said]
    # The picture from above shows all of it.
    model, far = result.task.model, np.abs(one["positions_m"][0]).max()
    assert model.cam("overhead").fovy[0] > far
