"""`hyrl-mj drive`: what a file of a field says, what is wrong with it, and how a drive is told and shown."""

import json
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from gl import needs_gl
from PIL import Image, ImageColor

import hyrl_mj
from hyrl_mj import BadInput, MlpPolicy, cli
from hyrl_mj.cli import parsing
from hyrl_mj.fields import (
    Bounds,
    DriveOptions,
    cautions,
    changes,
    check_passable,
    drive,
    drives,
    ending,
    least_clearance,
    noise_cautions,
    read_field,
)
from hyrl_mj.fields.controller import TangentLaw
from hyrl_mj.fields.drives import bounds_asked_for, bounds_made_for
from hyrl_mj.policies import ObservationPolicy
from hyrl_mj.simulation import AttackSettings
from hyrl_mj.simulation.rules import Rules
from hyrl_mj.tasks import LEFT, RIGHT, wrapped
from hyrl_mj.viz.colours import MODES
from hyrl_mj.viz.drives import drive_sentences
from hyrl_mj.viz.replay.panel import Track

BODY = 0.1
POST = {"radius_m": 0.5, "positions_m": [[-3.0, 0.0]]}
START = {"position_m": [-6.0, 0.1], "heading_rad": 0.0}
ONE = {"goal_m": [0.0, 0.0], "posts": [POST], "starts": [START]}


def post(x, y, radius=0.5):
    return {"radius_m": radius, "positions_m": [[x, y]]}


def start(x, y, heading=0.0):
    return {"position_m": [x, y], "heading_rad": heading}


def ring(count, radius=0.5, around=(0.0, 0.0), away=1.5):
    """Posts around a place."""
    angles = 2 * np.pi * np.arange(count) / count
    return [
        post(around[0] + away * np.cos(a), around[1] + away * np.sin(a), radius) for a in angles
    ]


@pytest.fixture
def written(tmp_path):
    """Writes a file of a field, and returns its path."""

    def write(content):
        path = tmp_path / "field.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return write


@pytest.fixture
def read(written):
    """Returns what a file of a field says."""
    return lambda **content: read_field(written({**ONE, **content}))


# ---- the file


def test_a_file_says_what_stands_where(read):
    field = read(
        posts=[POST, {"radius_m": 0.4, "positions_m": [[-4, 2], [-4, 1], [-3, 1]]}],
        starts=[START, start(-6, 1, 7.0)],
        interval_s=2,
        time_s=20,
    )
    assert (field.time, field.layouts.interval, len(field.layouts)) == (20, 2, 1)
    np.testing.assert_allclose(field.layouts.radii, [[0.5, 0.4]])
    np.testing.assert_allclose(field.starts, [[-6, 0.1, 0], [-6, 1, 7 - 2 * np.pi]])
    assert field.standing.tolist() == [True, False]
    number = np.zeros(4, dtype=int)
    places = field.layouts.positions(number, np.array([0.0, 1.0, 3.0, 99.0]))
    np.testing.assert_allclose(places[:, 0], np.tile([-3, 0], (4, 1)))
    np.testing.assert_allclose(places[:, 1], [[-4, 2], [-4, 1.5], [-3.5, 1], [-3, 1]])
    assert read().time == 15, "unless the file says otherwise"


def test_a_file_may_begin_with_the_mark_of_its_encoding(written):
    path = written("\ufeff" + json.dumps(ONE))
    assert read_field(path).layouts.posts == 1


def without(key):
    return {k: v for k, v in ONE.items() if k != key}


def with_post(**content):
    return {**ONE, "posts": [content]}


def with_start(**content):
    return {**ONE, "starts": [content]}


BAD = {
    "not JSON": ("{", ["not JSON", "give the JSON file"]),
    "deep": ("[" * 100_000, ["not JSON"]),
    "repeated": ('{"goal_m": [0, 0], "goal_m": [1, 1]}', ["'goal_m' twice"]),
    "list": ("[]", ["the file is []", "goal_m, posts, starts"]),
    "no goal": (without("goal_m"), ["the file has no goal_m", "[x, y] in m"]),
    "empty posts": ({**ONE, "posts": []}, ["posts has 0 posts", "from 1 to 100"]),
    "too many posts": ({**ONE, "posts": [POST] * 101}, ["posts has 101 posts", "to 100"]),
    "posts no list": ({**ONE, "posts": POST}, ["posts is {", "a list of posts"]),
    "post no object": ({**ONE, "posts": [1]}, ["posts[0] is 1", "radius_m, positions_m"]),
    "unknown": ({**ONE, "obstacles": []}, ["key of the file 'obstacles'", "interval_s, time_s"]),
    "near": ({**ONE, "post": [], "posts": [POST]}, ["'post'", "Did you mean 'posts'?"]),
    "cm": (
        with_post(radius_cm=50, positions_m=[[0, 0]]),
        ["posts[0] has 'radius_cm'", "measured in m", "give 'radius_m'"],
    ),
    "no unit": (with_post(radius=0.5, positions_m=[[0, 0]]), ["'radius'", "give 'radius_m'"]),
    "deg": (
        with_start(position_m=[0, 0], heading_deg=90),
        ["starts[0] has 'heading_deg'", "measured in rad", "'heading_rad'"],
    ),
    "no heading": (with_start(position_m=[0, 0]), ["starts[0] has no heading_rad"]),
    "radius 0": (with_post(radius_m=0, positions_m=[[0, 0]]), ["radius_m is 0", "> 0"]),
    "radius 1e-300": (with_post(radius_m=1e-300, positions_m=[[0, 0]]), ["is 1e-300", "at least"]),
    "radius true": (with_post(radius_m=True, positions_m=[[0, 0]]), ["radius_m is true"]),
    "radius text": (with_post(radius_m="0.5", positions_m=[[0, 0]]), ['radius_m is "0.5"']),
    "nan": (with_post(radius_m=0.5, positions_m=[[float("nan"), 0]]), ["[0][0] is NaN", "1000 m"]),
    "huge": ({**ONE, "goal_m": [10**400, 0]}, ["goal_m[0] is 1000", "from -1000 to 1000 m"]),
    "three numbers": ({**ONE, "goal_m": [0, 0, 0]}, ["goal_m is [0, 0, 0]", "two numbers"]),
    "no positions": (with_post(radius_m=1, positions_m=[]), ["has 0 positions"]),
    "one number": (with_post(radius_m=1, positions_m=[0, 0]), ["positions_m[0] is 0", "[x, y]"]),
    "no interval": (
        with_post(radius_m=1, positions_m=[[0, 0], [1, 0]]),
        ["posts[0] has 2 positions", "no interval_s"],
    ),
    "interval 0": ({**ONE, "interval_s": 0}, ["interval_s is 0", "> 0"]),
    "tiny interval": ({**ONE, "interval_s": 1e-320}, ["interval_s is", "> 0, at least 1e-09"]),
    "tiny time": (
        {**ONE, "time_s": 1e-320},
        ["time_s is", "> 0, at least 1e-09 and at most 3600 s"],
    ),
    "time": ({**ONE, "time_s": 1e6}, ["time_s is 1000000.0", "at most 3600 s"]),
    "memory": (
        {**ONE, "posts": [POST] * 96, "starts": [START] * 400},
        ["400 starts with runs of 15 s each, and 96 post(s)", "at most 5,000 s of all together"],
    ),
}


@pytest.mark.parametrize(("content", "parts"), BAD.values(), ids=BAD.keys())
def test_a_bad_file_is_one_sentence(content, parts, written):
    with pytest.raises(BadInput) as error:
        read_field(path := written(content))
    text = str(error.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    assert len(text) < len(str(path)) + 260
    assert [part for part in parts if part not in text] == []


def test_a_file_that_is_not_there_or_no_file_is_said(tmp_path):
    with pytest.raises(BadInput, match=r"cannot be read \(.*\): give the JSON file of a field"):
        read_field(tmp_path / "none.json")
    with pytest.raises(BadInput, match="is no file: give the JSON file of a field"):
        read_field(tmp_path)
    (tmp_path / "x.json").write_bytes(b"\xff\xfe{")
    with pytest.raises(BadInput, match="is not JSON"):
        read_field(tmp_path / "x.json")


# ---- what no robot can pass, and what the policies do not know


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ({"starts": [START, start(-3.55, 0)]}, ["post 0 is 0.05 m from start 1", "radius 0.1 m"]),
        ({"starts": [start(-3, 0)]}, ["post 0 is 0 m from start 0"]),
        ({"posts": [POST, post(0.5, 0)]}, ["post 1 is 0 m from the goal"]),
        ({"posts": ring(8)}, ["posts 0, 1, 2, 3 and 4 more shut the goal in", "more than 0.2 m"]),
        (
            {
                "posts": [*ring(8, around=(-6, 0)), post(5, 5)],
                "starts": [start(3, 0), start(-6, 0)],
            },
            ["and 4 more shut start 1 in"],
        ),
    ],
)
def test_what_cannot_be_passed_is_an_error(content, parts, read):
    with pytest.raises(BadInput) as error:
        check_passable(read(**content), BODY)
    assert [part for part in parts if part not in str(error.value)] == []


def test_what_can_be_passed_is_none(read):
    # Between neighbours of a ring of six there is a gap; the shut ring is around neither start nor goal.
    gap = 2 * 1.5 * np.sin(np.pi / 6) - 1.0
    check_passable(read(posts=[*ring(6, radius=0.5 + (gap - 0.24) / 2)]), BODY)
    with pytest.raises(BadInput, match="shut"):
        check_passable(read(posts=[*ring(6, radius=0.5 + (gap - 0.15) / 2)]), BODY)
    check_passable(read(posts=[*ring(8, around=(4, 4))]), BODY)
    # Moving posts may come and go.
    shut = ring(8)
    shut[0]["positions_m"] += [[9, 9]]
    check_passable(read(posts=shut, interval_s=1), BODY)


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ({"posts": [POST, post(-3, 1.15)]}, ["posts 0 and 1 are 0.15 m apart", "as one obstacle"]),
        ({"posts": [POST, post(-3, 0.5)]}, ["posts 0 and 1 overlap", "as one obstacle"]),
        ({"posts": [POST, post(-3, 1.5)]}, ["posts 0 and 1 are 0.5 m apart", "0.8 m"]),
        ({"posts": [post(-3, 0.4 * i) for i in range(5)]}, ["and 5 more pairs"]),
        ({"posts": [post(-3, 0, 0.2)]}, ["post 0 has a radius of 0.2 m", "0.3 to 0.9 m"]),
        (
            {"posts": [post(-3, 0, 0.2), post(-3, 5, 1.5)]},
            ["posts 0, 1 have radii of 0.2 to 1.5 m"],
        ),
        (
            {"posts": [{**POST, "positions_m": [[-3, 0], [-3, 1]]}], "interval_s": 2},
            ["post 0 moves at up to 0.5 m/s", "at most 0.4 m/s"],
        ),
        ({"posts": [post(0.65, 0)]}, ["post 0 ends 0.15 m from the goal", "may wait near it"]),
        (
            {"starts": [START, start(-16, 0)]},
            ["start 1 is 16 m from the goal", "1 m/s drives within 15 s", "time_s"],
        ),
    ],
)
def test_what_the_policies_do_not_know_is_said_with_figures(content, parts, read):
    assert cautions(read(posts=[POST, post(-3, 1.9)]), BODY) == [], "a usual field"
    texts = cautions(read(**content), BODY)
    assert any(all(part in text for part in parts) for text in texts), texts


# ---- the drive


class Steering(ObservationPolicy):
    """Turns to the way on its side of the post, and drives."""

    def __init__(self, task, side):
        self.task, self.sign = task, 1 - 2 * side

    def inputs(self, observation):
        cos, sin = (observation[:, 10 + i] + self.sign * observation[:, 12 + i] for i in range(2))
        angle = np.arctan2(sin, cos)
        return np.stack([np.maximum(np.cos(angle), 0.0), np.clip(3 * angle, -1, 1)], axis=1)


def constant(task, *inputs):
    """A network that always gives one of the levels of a task."""
    levels, k = task.input_levels, len(task.observation_low)
    chosen = np.all(levels == inputs, axis=1).astype(np.float32)
    assert chosen.sum() == 1
    none = np.zeros((len(levels), k), dtype=np.float32)
    return MlpPolicy(task, "ppo", "tanh", {"action_net.weight": none, "action_net.bias": chosen})


@pytest.fixture(scope="module")
def planted():
    """A run of `field` whose policy drives straight on, and whose mode policies pass the post."""
    task = hyrl_mj.get_task("field")
    return SimpleNamespace(
        path=Path("runs/field"),
        task=task,
        policy=constant(task, 1.0, 0.0),
        policy_title="RL policy (PPO)",
        settings=SimpleNamespace(eps=0.1, attack=AttackSettings()),
        mode_networks={side: Steering(task, side) for side in (LEFT, RIGHT)},
    )


def driven(planted, field, **options):
    policies = planted.mode_networks
    chosen = DriveOptions(**options)
    return drive(planted.task, planted.policy, policies, 0.1, field, chosen)


def test_the_law_of_the_modes_turns_to_the_way_on_its_side():
    task = hyrl_mj.get_task("field")
    nothing, usual = np.zeros(50), np.full(50, len(task.layouts) - 1)
    measured = task.measured_at(task.starts(50, np.random.default_rng(0)), nothing, usual)
    measured = np.column_stack([measured, nothing])  # no sense of turning
    directions, _ = task.directions(measured)
    for side in (LEFT, RIGHT):
        turn = wrapped(directions[:, side] - measured[:, 2])
        expected = np.stack([np.maximum(np.cos(turn), 0), np.clip(4 * turn, -1, 1)], axis=1)
        np.testing.assert_allclose(TangentLaw(task, side).act(measured), expected, atol=1e-9)


@pytest.mark.slow
def test_both_controllers_drive_from_every_start(planted, read):
    field = read(posts=[POST, post(-4.5, 2)], starts=[start(-6, 0.3), start(-6, -0.3)])
    result = driven(planted, field)
    assert {name: len(arcs) for name, arcs in result.arcs.items()} == dict.fromkeys(
        ("policy", "hyrl", "law"), 2
    )
    assert result.attacked == {}
    task = result.task
    assert task.reached == pytest.approx(0.2)
    policy, hyrl = result.arcs["policy"][0], result.arcs["hyrl"][0]
    assert ending(policy) == "crashed"
    assert least_clearance(task, policy) <= 0
    assert ending(hyrl) == "arrived"
    assert least_clearance(task, hyrl) > 0.1
    # Noise of 0.1 m on the position and 0.05 rad on the heading, and none on the posts.
    noise = np.abs(hyrl.measured[:-1, :3] - hyrl.z[:-1])
    np.testing.assert_allclose(noise.max(axis=0), [0.1, 0.1, 0.05], atol=1e-9)
    # One comes by on the left of the post, the other on its right.
    sides = [task.mode_name(int(arc.q[0])) for arc in result.arcs["hyrl"]]
    assert sides == ["post 0, left", "post 0, right"]
    assert [changes(arc) for arc in result.arcs["hyrl"]] == [0, 0]


@pytest.mark.slow
def test_changes_of_focus_and_side_are_counted(planted, read):
    field = read(posts=[POST, post(-6.5, 0.1)], starts=[start(-8.5, 0.0)], time_s=7)
    result = driven(planted, field)
    arc = result.arcs["hyrl"][0]
    names = [result.task.mode_name(int(q)) for q in arc.q]
    assert changes(arc) == sum(a != b for a, b in pairwise(names)) > 0


@pytest.mark.slow
def test_a_goal_that_a_post_stands_on_in_the_end_is_waited_for(planted, read):
    comes = {"radius_m": 0.5, "positions_m": [[2.0, 0.0], [0.0, 0.0]]}
    result = driven(planted, read(posts=[comes], interval_s=5, starts=[start(-7, 0)], time_s=8))
    assert ending(result.arcs["hyrl"][0]) == "waited"
    far = driven(planted, read(starts=[start(-90, 0)], time_s=1))
    assert ending(far.arcs["hyrl"][0]) == "stalled"


@pytest.mark.slow
def test_who_waits_near_the_goal_has_not_arrived(planted, read):
    """A robot that stands still is not led to the goal by a post that stands close to it."""
    starts = [start(-1.5, 0), start(-1.4, 0.2), start(-1.2, 1), start(-6, 0)]
    field = read(posts=[post(-0.7, 0)], starts=starts, time_s=1)
    for name in ("field", "rover_field"):
        task = hyrl_mj.get_task(name)
        steering = {side: Steering(task, side) for side in (LEFT, RIGHT)}
        result = drive(task, constant(task, 0.0, 0.0), steering, 0.1, field, DriveOptions())
        ends = [ending(arc) for arc in result.arcs["policy"]]
        assert ends == ["waited", "waited", "waited", "stalled"]
        assert [arc.outcome for arc in result.arcs["policy"]] == ends
        for arc in result.arcs["hyrl"]:
            near = np.hypot(*arc.z[-1, :2]) <= result.task.reached
            assert (ending(arc) == "arrived") == near
        said = drive_sentences(result)[0]
        assert said.startswith(
            "RL policy arrives from 0 of 4 starts and waits near a post at the goal from 3,"
        )


def test_a_post_far_from_the_goal_is_none_to_wait_for(planted, read):
    """Held by one post, while another one stands at the goal far away, a robot stalls."""
    shut_in = ring(8, radius=0.55, around=(-20, 0), away=1.5)
    field = read(posts=[*shut_in, post(-0.7, 0)], starts=[start(-20, 0)], time_s=1)
    result = driven(planted, field)
    assert ending(result.arcs["hyrl"][0]) == "stalled"


@pytest.mark.slow
@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_no_post_leaps_over_a_robot_between_two_samples(planted, read, phase):
    """At 100 m/s a post moves 5 m a sample: it is seen in touch with the robot at none of them."""
    y = -50.0 - 5 * phase
    fast = {"radius_m": 0.3, "positions_m": [[-6, y], [-6, y + 100]]}
    field = read(posts=[fast], interval_s=1, starts=[start(-6.3, 0)], time_s=3)
    result = driven(planted, field, noise="none")
    for arc in (result.arcs["policy"][0], result.arcs["hyrl"][0]):
        assert ending(arc) == "crashed"
        assert arc.t[-1] == pytest.approx(0.5 if phase == 0 else 0.55)
        assert least_clearance(result.task, arc) < 0
        assert np.isnan(arc.u[-1]).all()
        assert np.isnan(arc.measured[-1]).all()


@pytest.mark.slow
def test_the_least_clearance_is_that_of_a_fine_look(planted, read):
    moving = {"radius_m": 0.4, "positions_m": [[-3, 1.5], [-2.5, 0.9], [-3.2, 1.6], [-3, 1]]}
    field = read(posts=[moving, post(-4, -1)], interval_s=0.77, starts=[start(-5, 0)], time_s=6)
    result = driven(planted, field, noise="none")
    arc, layouts = result.arcs["policy"][0], field.layouts
    t = np.linspace(0, arc.t[-1], 20_001)
    place = np.stack([np.interp(t, arc.t, arc.z[:, i]) for i in range(2)], axis=1)
    posts = layouts.positions(np.zeros(len(t), dtype=int), t)
    fine = (np.linalg.norm(posts - place[:, None], axis=2) - layouts.radii[0] - BODY).min()
    assert least_clearance(result.task, arc) == pytest.approx(fine, abs=1e-4)
    assert least_clearance(result.task, arc) <= fine + 1e-9


@pytest.mark.slow
def test_the_bounds_are_those_that_were_asked_for(planted, read):
    made_for = bounds_made_for(planted.task, 0.1)
    assert made_for == Bounds(0.1, 0.05, 0.0, 0.0)
    bounds = bounds_asked_for(DriveOptions(eps=0.2, eps_posts=0.3), made_for)
    assert bounds == Bounds(0.2, 0.1, 0.3, 0.0)
    assert str(bounds) == "0.2 m, 0.1 rad, 0.3 m on the posts"
    # Without noise on the position, the others still act.
    moving = {**POST, "positions_m": [[-3, 0], [-3, 0.5]]}
    field = read(posts=[moving], interval_s=5, time_s=3)
    options = {"eps": 0.0, "eps_heading": 0.02, "eps_posts": 0.05, "eps_speeds": 0.04}
    result = driven(planted, field, **options, noise="uniform")
    task, arc = result.task, result.arcs["hyrl"][0]
    plain = task.measure(np.column_stack([arc.z, arc.t, np.zeros(len(arc.t))]))
    off = np.abs(arc.measured[:-1] - plain[:-1]).max(axis=0)
    assert (off <= np.array([0, 0, 0.02, 0, 0, 0.05, 0.05, 0.04, 0.04, 0]) + 1e-9).all()
    assert (off[[2, 5, 6, 7, 8]] > [0.015, 0.04, 0.04, 0.03, 0.03]).all()


def test_noise_on_robot_and_posts_adds_up_in_the_way_to_a_post(planted, read):
    result = driven(planted, read(time_s=0.2), eps_posts=0.05)
    arc, columns = result.arcs["hyrl"][0], result.task.noisy
    off = arc.measured[:-1, 5:7] - arc.measured[:-1, :2] - ([-3.0, 0.0] - arc.z[:-1, :2])
    np.testing.assert_allclose(np.abs(off), 0.15)
    rules = Rules(result.task, SimpleNamespace(modes=(0,)), 0.1, np.array(columns))
    together = rules.noise[(rules.noise != 0).sum(axis=1) == 5]
    np.testing.assert_allclose(np.abs(together[:, 5:7] - together[:, :2]), 0.15)


def test_a_run_that_is_over_before_it_began_is_shown_in_no_mode(planted, read):
    result = driven(planted, read(starts=[start(0, 0)]))
    track = Track(result.task, result.arcs["hyrl"][0])
    assert (track.modes, track.tinted(0), len(track.jumps)) == (False, frozenset(), 0)


def test_more_noise_than_that_of_the_run_is_said(planted):
    options = DriveOptions(eps=0.2, eps_heading=0.01, eps_posts=0.05)
    texts = noise_cautions(planted.task, 0.1, options)
    assert len(texts) == 2
    assert "0.2 m on the robot's position is more than the 0.1 m" in texts[0]
    assert "0.05 m on the posts' positions is more than the 0 m" in texts[1]
    assert noise_cautions(planted.task, 0.1, DriveOptions()) == []
    assert noise_cautions(planted.task, 0.1, replace(options, noise="none")) == []


@pytest.mark.slow
def test_an_attack_is_at_least_as_bad(planted, read, monkeypatch):
    monkeypatch.setattr(drives, "ROUNDS", 1)
    result = driven(planted, read(time_s=1), attack=True, eps=0.05)
    assert set(result.attacked) == {"policy", "hyrl", "law"}
    assert result.attacked["hyrl"][0].noise == "attack"
    clearance = [
        least_clearance(result.task, arcs["hyrl"][0]) for arcs in (result.attacked, result.arcs)
    ]
    assert clearance[0] < clearance[1] + 0.05


@pytest.mark.slow
def test_what_the_noise_of_the_options_loses_is_lost_to_the_worst_noise(planted, read, monkeypatch):
    field = read(starts=[start(-5, 0.3)], time_s=6)
    plain = driven(planted, field).arcs
    assert [arcs[0].outcome for arcs in plain.values()] == ["crashed", "reached", "reached"]
    nothing = dict.fromkeys(plain, SimpleNamespace(arcs=plain["hyrl"]))
    monkeypatch.setattr(drives, "attack", lambda *_, **__: nothing)
    attacked = driven(planted, field, attack=True).attacked
    assert [arcs[0].outcome for arcs in attacked.values()] == ["crashed", "reached", "reached"]


# ---- fields that nobody would draw: who arrives has come to the goal and touched nothing on its way

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
        "time_s": rng.choice([0.01, 2.0, 5.0]),
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


@pytest.mark.slow
@pytest.mark.first(2)
@pytest.mark.parametrize("seed", range(40))
def test_what_is_said_of_a_run_is_so(planted, tmp_path, seed):
    rng, ends = np.random.default_rng(seed), []
    for number in range(2):
        path, content = tmp_path / f"{number}.json", drawn(rng)
        path.write_text(json.dumps(content))
        noise = str(rng.choice(["none", "alternating", "uniform"]))
        result = driven(planted, read_field(path), noise=noise)
        for arc in (*result.arcs["policy"], *result.arcs["hyrl"]):
            end, (away, least, moved) = ending(arc), looked_at(content, arc)
            ends.append(end)
            if end == "arrived":
                assert away <= result.task.reached + 1e-6
            if end == "crashed":
                assert least <= moved / 2 + 1e-6  # it touches between two looks
            else:
                assert least > -1e-6
    assert len(ends) == 20


@pytest.mark.parametrize("one", [post(-3, 0, 1e-9), post(900, -900), post(-3, 0, 999)])
def test_posts_of_any_size_anywhere_are_driven_past(planted, tmp_path, one):
    path = tmp_path / "field.json"
    content = {"goal_m": [0, 0], "posts": [one], "starts": [start(-3, 2)], "time_s": 0.2}
    path.write_text(json.dumps(content))
    result = driven(planted, read_field(path))
    said = "crashed" if one["radius_m"] > 2 else "stalled"
    assert [ending(arc) for arc in result.arcs["hyrl"]] == [said]
    # The picture from above shows all of it.
    model, far = result.task.model, np.abs(one["positions_m"][0]).max()
    assert model.cam("overhead").fovy[0] > far


# ---- the command


@pytest.fixture
def command(planted, monkeypatch, capsys):
    """Calls hyrl-mj drive on the planted run, and returns exit status, output and errors."""

    def call(*words, run=planted):
        monkeypatch.setattr(parsing, "load_run", lambda path, task=None: run)
        monkeypatch.setattr(sys, "argv", ["hyrl-mj", "drive", "runs/field", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        said = capsys.readouterr()
        return end.value.code, said.out, said.err

    return call


@pytest.mark.slow
def test_the_command_prints_a_table_and_writes_nothing(command, written, tmp_path, caplog):
    path = written({**ONE, "posts": [POST, post(-3, 1.5)]})
    status, out, _ = command("--field", path, "--eps", "0.12")
    assert status == 0
    flat = " ".join(out.split())
    assert "2 posts: alternating noise of 0.12 m, 0.06 rad, seed 0" in flat
    assert "-6.00 m, 0.10 m, 0.00 rad" in flat
    assert "RL policy arrives from 0 of 1 starts, HyRL from 1, and HyRL from 1 if its modes" in flat
    assert any("0.5 m apart" in record.getMessage() for record in caplog.records)
    assert any("noise of 0.12 m" in record.getMessage() for record in caplog.records)
    assert [p.name for p in tmp_path.iterdir()] == ["field.json"]


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--noise", "white"], ["'white'", "alternating"]),
        (["--eps", "-1"], ["-1", ">= 0"]),
        (["--eps-heading", "4"], ["4 rad hides the heading", "below 3.14"]),
        (["--eps-posts", "nan"], ["nan", "finite"]),
        (["--seed", "-1"], ["seed -1"]),
        (["--eps", "0", "--attack"], ["--attack", "--eps > 0"]),
        (["--out", "x.avi"], ["x.avi", ".mp4, .gif, .png"]),
        (["--out", "x.png", "--camera", "top"], ["'top'", "overhead"]),
        (["--out", "x.png", "--layout", "overlay"], ["'overlay'", "side-by-side"]),
        (["--out", "x.png", "--shown", "3"], ["--shown 3", "from 0 to 0"]),
        (["--shown", "0"], ["--out"]),
        (["--size", "640x480"], ["--out"]),
    ],
)
def test_what_is_wrong_with_the_words_is_one_sentence(words, parts, command, written, tmp_path):
    status, _, errors = command("--field", written(ONE), *words)
    assert status == 2
    assert errors.count("\n") == 1
    assert [part for part in parts if part not in errors] == []
    assert [p.name for p in tmp_path.iterdir()] == ["field.json"]


def test_what_is_wrong_with_the_run_or_the_file_is_one_sentence(command, written, planted, vehicle):
    path = written(ONE)
    other = SimpleNamespace(**{**vars(planted), "task": vehicle})
    one_sided = SimpleNamespace(**{**vars(planted), "mode_networks": {LEFT: planted.policy}})
    agent = SimpleNamespace(**{**vars(planted), "policy": Steering(planted.task, LEFT)})
    for run, part in (
        (other, "is a run of vehicle"),
        (one_sided, "has 1 mode(s)"),
        (agent, "is a run of an agent"),
    ):
        status, _, errors = command("--field", path, run=run)
        assert status == 2
        assert part in errors
        assert "hyrl-mj run field" in errors
    status, _, errors = command()
    assert (status, "drive needs --field" in errors) == (2, True)


# ---- the picture


def near(picture, colour, off=60):
    """(height, width) bool: which pixels are about of a colour, in the light of the scene."""
    return np.abs(picture.astype(int) - ImageColor.getrgb(colour)).sum(axis=2) < off


@pytest.mark.long
@needs_gl
def test_the_post_in_focus_has_the_colour_of_its_side(command, written, tmp_path):
    shares = []
    for y in (0.3, -0.3):
        path = written({**ONE, "starts": [start(-6, y)]})
        status, out, errors = command(
            "--field", path, "--out", tmp_path / "x.png", "--size", "640x360"
        )
        assert (status, errors) == (0, "")
        assert f"picture at {tmp_path / 'x.png'}" in out
        with Image.open(tmp_path / "x.png") as image:
            picture = np.asarray(image.convert("RGB"))
        # The middle of the post is in the middle of each panel, which both show the same field.
        panels = picture[40:-40, :320], picture[40:-40, 320:]
        shares.append([[near(panel, colour).mean() for colour in MODES[:2]] for panel in panels])
    (policy, left), (_, right) = shares
    assert max(policy) < 0.001  # the policy has no focus
    assert left[0] > 0.005 > 0.001 > left[1]
    assert right[1] > 0.005 > 0.001 > right[0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["field.json", "x.png"]


@pytest.mark.long
@needs_gl
def test_a_start_at_the_goal_and_moving_posts_are_rendered(command, written, tmp_path):
    moving = {"radius_m": 0.5, "positions_m": [[-3, 0], [-3, 1]]}
    content = {
        **ONE,
        "posts": [moving],
        "interval_s": 4,
        "time_s": 7,
        "starts": [start(0, 0), START],
    }
    words = ["--out", tmp_path / "x.gif", "--size", "480x240", "--fps", "2", "--camera", "chase"]
    status, _, errors = command("--field", written(content), *words, "--shown", "0-1")
    assert (status, errors) == (0, "")
    with Image.open(tmp_path / "x.gif") as image:
        assert image.size == (480, 240)
        assert image.n_frames > 10
