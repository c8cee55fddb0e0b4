"""Fields: layouts of posts, the ways round them, and which post is in focus."""

from dataclasses import replace
from runpy import run_path
from types import SimpleNamespace

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj.export import export_numpy, export_onnx
from hyrl_mj.fields import Driving, FocusController, decoded, encoded, for_posts
from hyrl_mj.fields.controller import GuardedPolicy, TangentLaw
from hyrl_mj.fields.focus import choose
from hyrl_mj.fields.guard import Guard
from hyrl_mj.fields.seen import Seen
from hyrl_mj.policies import HybridController, PolicyController
from hyrl_mj.sets import Everything
from hyrl_mj.simulation import LoopSettings, Noise, Recorded, closed_loop
from hyrl_mj.tasks import LEFT, RIGHT, Layouts, Outcome, length
from hyrl_mj.tasks.field import CLEAR, turns_to, ways_round


@pytest.fixture(scope="module")
def field():
    return hyrl_mj.get_task("field")


def measured(pose, posts, goal=(0.0, 0.0)):
    """Returns one measurement; the posts are (x, y, radius), or (x, y, vx, vy, radius)."""
    full = [p if len(p) == 5 else (*p[:2], 0.0, 0.0, p[2]) for p in posts]
    return np.array([[*pose, *goal, *np.ravel(full)]])


def chosen(pose, posts, focus=-1, side=-1):
    seen = Seen(measured(pose, posts))
    focuses, sides = choose(seen, np.array([focus]), np.array([side]), 0.28)
    return int(focuses[0]), int(sides[0])


def test_posts_follow_their_tracks():
    tracks = np.array([[[[0.0, 0.0]], [[1.0, 0.0]], [[1.0, 2.0]]]])
    layouts = Layouts(tracks, np.array([[0.5]]), np.zeros((1, 2)), interval=2.0)
    times = np.array([0.0, 1.0, 2.0, 3.0, 9.0])
    number = np.zeros(5, dtype=int)
    places = layouts.positions(number, times)[:, 0]
    np.testing.assert_allclose(places, [[0, 0], [0.5, 0], [1, 0], [1, 1], [1, 2]])
    speeds = layouts.velocities(number, times)[:, 0]
    np.testing.assert_allclose(speeds, [[0.5, 0], [0.5, 0], [0, 1], [0, 1], [0, 0]])


@pytest.mark.parametrize("name", ["field", "rover_field"])
def test_the_posts_of_the_plant_are_where_its_measurement_says(name):
    field = hyrl_mj.get_task(name)
    plant, rng = field.plant(50), np.random.default_rng(0)
    plant.set_state(*field.state(field.starts(50, rng), rng))
    before = plant.measurement
    for _ in range(20):
        plant.step(np.tile([[0.5, 0.3]], (50, 1)))
    after = plant.measurement
    np.testing.assert_allclose(after[:, 5:7], before[:, 5:7] + before[:, 7:9], atol=1e-5)
    seen = plant.geom_positions(list(field.obstacles.values()))[:, 0, :2]
    np.testing.assert_allclose(seen, after[:, 5:7], atol=1e-6)


def test_the_way_round_a_disc_is_the_shortest_on_its_side():
    rng = np.random.default_rng(0)
    robot, goal = rng.uniform(-4, 4, (2, 400, 2))
    radius = rng.uniform(0.3, 0.9, 400)
    away = np.minimum(*(np.linalg.norm(p, axis=1) for p in (robot, goal)))
    robot, goal, radius = (x[away > radius + 0.05] for x in (robot, goal, radius))
    directions, lengths = ways_round(-robot, goal - robot, radius)
    # A polygon around the disc, and the straight way if it is free.
    t = np.linspace(0, 1, 2_000)[:, None, None]
    straight = np.linalg.norm(robot + t * (goal - robot), axis=2).min(axis=0) >= radius
    direct = np.linalg.norm(goal - robot, axis=1)
    for side in (LEFT, RIGHT):
        direction, length = directions[:, side], lengths[:, side]
        np.testing.assert_allclose(length[straight], direct[straight])
        assert (length[~straight] > direct[~straight]).all()
        # A step along the way makes it shorter by its length.
        ahead = robot + 1e-4 * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        after = ways_round(-ahead, goal - ahead, radius)[1][:, side]
        near = np.abs(length - after - 1e-4) < 1e-6
        assert near.mean() > 0.99
    directions, _ = ways_round(np.array([[2.0, 0.0]]), np.array([[4.0, 0.0]]), np.array([1.0]))
    np.testing.assert_allclose(directions, [[np.pi / 6, -np.pi / 6]])


def test_near_a_post_the_way_leads_out_without_a_jump():
    # The goal lies across; half way into the disc the way leads out by half a right angle.
    to_goal, radius = np.array([[0.0, 3.0]]), np.array([0.5 + CLEAR])
    for deep, angle in ((0.0, np.pi / 2), (CLEAR / 2, 3 * np.pi / 4), (CLEAR, np.pi)):
        to_post = np.array([[0.5 + CLEAR - deep, 0.0]])
        directions, _ = ways_round(to_post, to_goal, radius)
        np.testing.assert_allclose(directions[0, LEFT], angle, atol=1e-6)
    beside = np.column_stack([np.full(50, 0.7), np.linspace(-0.1, 0.1, 50)])
    directions, _ = ways_round(beside, np.tile(to_goal, (50, 1)), np.repeat(radius, 50))
    assert np.abs(np.diff(directions[:, LEFT])).max() < 0.05


def test_a_sense_of_turning_holds_beyond_a_right_angle():
    angles = np.array([0.5, -0.5, 2.5, -2.5, 3.1, -3.1])
    turns = turns_to(angles, np.ones(6))
    np.testing.assert_allclose(turns, [0.5, -0.5, 2.5, 2 * np.pi - 2.5, 3.1, 2 * np.pi - 3.1])
    np.testing.assert_allclose(turns_to(angles, np.zeros(6)), angles)


def test_the_post_that_blocks_the_way_first_is_in_focus():
    posts = [(-2.0, 0.1, 0.5), (-4.0, 0.2, 0.5), (-3.0, 3.0, 0.5)]
    assert chosen((-7.0, 0.0, 0.0), posts) == (1, RIGHT)
    assert chosen((-7.0, 0.4, 0.0), posts) == (1, LEFT)
    assert chosen((-3.0, 0.0, 0.0), posts) == (0, RIGHT)


def test_posts_without_room_between_them_are_passed_on_the_same_side():
    wall = [(-3.0, y, 0.5) for y in (-1.1, 0.0, 1.1, 2.2)]
    # The way leads past an end of the wall, on which its last post is in focus.
    assert chosen((-6.0, 0.3, 0.0), wall) == (0, RIGHT)
    assert chosen((-6.0, 1.2, 0.0), wall) == (3, LEFT)
    apart = [(x, 2 * y, r) for x, y, r in wall]
    assert chosen((-6.0, 0.3, 0.0), apart)[0] == 1


@pytest.mark.slow
def test_a_row_of_posts_is_passed_on_the_side_that_was_chosen(field):
    row = [(-3.0, y, 0.35) for y in np.arange(-2.4, 2.5, 0.8)]
    for side, y in ((LEFT, 0.85), (RIGHT, -0.85), (LEFT, 0.0), (RIGHT, 0.0)):
        for focus in range(2, 5):
            assert chosen((-3.7, y, 1.28), row, focus, side)[1] == side
    task = drive_of(field, row, time=25.0)
    controller = FocusController(task, {q: TangentLaw(field, q) for q in (LEFT, RIGHT)}, 0.1)
    starts = np.array([[-4.5, -1.0, 1.0]])
    run = closed_loop(task, controller, starts, None, settings=LoopSettings(quiet=True))
    assert run.outcome.tolist() == [Outcome.REACHED]


def test_noise_does_not_change_focus_and_side():
    rng = np.random.default_rng(0)
    posts = [(-2.0, 0.7, 0.5), (-2.0, -0.7, 0.5), (-4.0, 0.0, 0.5)]
    for x in np.linspace(-6.0, -4.8, 5):
        first = chosen((x, 0.0, 0.0), posts)
        for noise in rng.uniform(-1, 1, (20, 3)) * (0.1, 0.1, 0.05):
            assert chosen(np.array([x, 0.0, 0.0]) + noise, posts, *first) == first


def test_where_the_straight_way_is_free_a_post_is_passed_on_its_side():
    # The robot was told to pass on the right, but the straight way just misses the disc on the left.
    post = [(-5.0, 0.0, 0.5)]
    free, blocked = (-8.0, 1.45, 0.0), (-8.0, 1.25, 0.0)
    assert chosen(free, post, 0, RIGHT) == (0, LEFT)
    assert chosen(blocked, post, 0, RIGHT) == (0, RIGHT)
    assert chosen(blocked, post, 0, LEFT) == (0, LEFT)


def test_modes_hold_focus_side_and_sense(field):
    modes = np.arange(48)
    np.testing.assert_array_equal(encoded(*decoded(modes)), modes)
    focus, side, sense = decoded(modes)
    assert set(focus) == set(range(12))
    assert set(side) == {LEFT, RIGHT}
    assert set(sense) == {1, -1}


class Straight:
    """Drives ahead, and remembers what it saw."""

    def inputs(self, observation):
        self.seen = observation
        return np.tile([1.0, 0.0], (len(observation), 1))


def drive_of(field, posts, goal=(0.0, 0.0), **options):
    """A field of standing posts (x, y, radius), as a task."""
    posts = np.array(posts, dtype=float)
    layouts = Layouts(posts[None, None, :, :2], posts[None, :, 2], np.array([goal]))
    return Driving(field, layouts, **options)


def straight(field, posts, noise=0.1, **options):
    """A controller of such a task, with policies that drive ahead."""
    task = drive_of(field, posts, **options)
    return FocusController(task, {LEFT: Straight(), RIGHT: Straight()}, noise)


def test_wrong_modes_and_measurements_are_refused(field):
    controller = straight(field, [(-2.0, 0.1, 0.5)])
    seen = measured((-7.0, 0.4, 0.0), [(-2.0, 0.1, 0.5)])
    with pytest.raises(hyrl_mj.BadInput, match="mode 4 is unknown"):
        controller.step(np.array([4]), seen)
    with pytest.raises(hyrl_mj.BadInput, match="shape"):
        controller.step(np.array([0]), seen[:, :9])
    with pytest.raises(hyrl_mj.BadInput, match="finite"):
        controller.initial_mode(np.full_like(seen, np.nan))


def test_a_policy_sees_the_post_in_focus_alone(field):
    posts = [(-2.0, 0.1, 0.5), (-4.0, 0.2, 0.6)]
    controller = straight(field, posts)
    seen = measured((-7.0, 0.4, 0.0), posts)
    u, q = controller.step(controller.initial_mode(seen), seen)
    focus, side, sense = decoded(q)
    assert (focus[0], side[0]) == (1, LEFT)
    alone = np.hstack([measured((-7.0, 0.4, 0.0), posts[1:]), sense[:, None]])
    np.testing.assert_allclose(controller.policies[LEFT].seen, field.observation(alone))
    np.testing.assert_allclose(u, [[1.0, 0.0]])


def test_the_first_side_can_be_chosen(field):
    posts = [(-2.0, 0.1, 0.5), (-4.0, 0.2, 0.6)]
    seen = measured((-7.0, 0.4, 0.0), posts)
    for side in (LEFT, RIGHT):
        q = straight(field, posts).on_side(side).initial_mode(seen)
        focus, chosen_side, _ = decoded(q)
        assert (focus[0], chosen_side[0]) == (1, side)


@pytest.mark.slow
def test_the_guard_keeps_robots_off_posts_whatever_the_noise(field):
    rng, noise = np.random.default_rng(0), 0.1
    posts = [(-2.0, 0.0, 0.5), (0.0, 1.7, 0.9), (0.3, -1.4, 0.3), (-3.0, 2.0, 0.4)]
    controller = straight(field, posts, noise, time=5.0)
    task, n = controller.task, 50
    z = np.column_stack([rng.uniform(-4, 2, (4 * n, 2)), rng.uniform(-np.pi, np.pi, 4 * n)])
    places = np.array(posts)
    room = np.linalg.norm(z[:, None, :2] - places[:, :2], axis=2) - places[:, 2]
    z = z[room.min(axis=1) > 0.3][:n]
    for kind in ("uniform", "bias"):
        settings = LoopSettings(quiet=True)
        given = Noise(kind, noise) if kind != "bias" else away_from(task, z, places, noise)
        run = closed_loop(task, controller, z, given, settings=settings)
        assert not (run.outcome == Outcome.CRASHED).any()
    free = replace(controller, eps=-10.0)
    run = closed_loop(task, free, z, None, settings=LoopSettings(quiet=True))
    assert (run.outcome == Outcome.CRASHED).sum() > n / 8


def away_from(task, z, places, noise):
    """Returns noise that always shows the robot farther from the post ahead of it than it is."""
    heading = np.stack([np.cos(z[:, 2]), np.sin(z[:, 2])], axis=1)
    signal = np.zeros((task.max_steps, len(z), task.measurement_columns))
    signal[:, :, :2] = -noise * np.sign(heading)
    return Recorded(signal, noise, "bias")


def guard(noise=0.1):
    return Guard(body=0.1, eps=noise, low=-1.0, high=1.0, rate=1.0)


def guarded(pose, posts, u, turn, sense=1, goal=(5.0, 0.0), noise=0.1):
    """Returns the inputs that the guard makes of inputs u, with the goal ahead."""
    seen = Seen(measured(pose, posts, goal))
    values = np.array([u]), np.array([turn]), np.array([sense])
    return guard(noise).inputs(seen, *values)[0]


FAR_OFF = [(0.0, 50.0, 0.5)]


# Posts, the inputs of a policy, the angle to the way, other options, and the inputs that are let through.
GUARDED = {
    "posts that are too near to each other": (
        [(0.6, 0.3, 0.4), (0.6, -0.3, 0.4)], (1.0, -1.0), 0.1, {"noise": 0.15}, [0.0, -1.0]
    ),
    "its back to its way": (FAR_OFF, (0.5, -1.0), -3.0, {}, [0.0, 1.0]),
    "its face to its way": (FAR_OFF, (-1.0, 0.2), 0.0, {}, [0.3, 0.2]),
    "held by a post on its left": ([(-0.05, 0.6, 0.5)], (1.0, 0.5), 0.0, {}, [0.0, -1.0]),
    "held by a post on its right": ([(-0.05, -0.6, 0.5)], (1.0, -0.5), 0.0, {}, [0.0, 1.0]),
    # A circle of radius 0.2 m leads to a goal that is 0.4 m to the left.
    "near the goal": (FAR_OFF, (1.0, 1.0), 1.5, {"goal": (0.0, 0.4)}, [0.2, 1.0]),
    "near the goal ahead": (FAR_OFF, (1.0, 0.0), 0.0, {"goal": (0.4, 0.0)}, [1.0, 0.0]),
    "slow, and held by no post": (
        FAR_OFF, (1.0, 1.0), 0.9, {"goal": (0.1, 0.12)}, [0.10167, 1.0]
    ),
}  # fmt: skip


@pytest.mark.parametrize("robot", GUARDED)
def test_the_guard_lets_through_what_is_safe_and_goes_on(robot):
    posts, u, turn, options, expected = GUARDED[robot]
    np.testing.assert_allclose(guarded((0, 0, 0.0), posts, u, turn, **options), expected, atol=1e-4)


@pytest.mark.parametrize("turn", [-1.5, 0.8])
def test_a_robot_that_stands_beside_its_way_turns_to_it(turn):
    speed, rate = guarded((0, 0, 0.0), FAR_OFF, (0.0, 0.0), turn)
    assert speed * np.cos(turn) + rate * np.sin(turn) >= 0.3 - 1e-9
    # One that goes on is left alone, also where it turns away for a while.
    u = (0.3 / np.cos(turn) + 0.3, -0.1 * np.sign(turn)) if abs(turn) < 1 else (0.0, np.sign(turn))
    np.testing.assert_allclose(guarded((0, 0, 0.0), FAR_OFF, u, turn)[1], u[1])


def test_a_robot_retreats_from_a_post_that_comes():
    seen = Seen(measured((0, 0, 0.0), [(0.8, 0.0, -0.4, 0.0, 0.5)]))
    _, most, _ = guard().bounds(seen)
    assert -0.5 < most[0] < 0


def test_a_robot_drives_out_of_the_way_of_a_post_that_comes_from_its_side():
    # The robot turns round, and would stand meanwhile.
    for across in (1, -1):
        comes = [(0.0, 0.8 * across, 0.0, -0.4 * across, 0.5)]
        speed, _ = guarded((0, 0, 0.0), comes, (0.0, 1.0), 3.0, goal=(-5.0, 0.0))
        assert abs(speed) == 1.0
        stands = [(0.0, 0.8 * across, 0.5)]
        speed, _ = guarded((0, 0, 0.0), stands, (0.0, 1.0), 3.0, goal=(-5.0, 0.0))
        assert speed == 0.0


class Weighted:
    """Any smooth function of what it observes."""

    def __init__(self, seed):
        self.weights = np.random.default_rng(seed).normal(size=(17, 2))

    def inputs(self, observation):
        return np.tanh(observation @ self.weights)


@pytest.mark.parametrize("posts", [1, 5])
def test_a_robot_is_driven_alone_as_among_others(field, posts):
    rng, n = np.random.default_rng(posts), 60
    task = drive_of(field, np.column_stack([rng.uniform(-4, 4, (posts, 2)), np.full(posts, 0.4)]))
    controller = FocusController(task, {LEFT: Weighted(0), RIGHT: Weighted(1)}, 0.1)
    poses = np.column_stack([rng.uniform(-6, 6, (n, 2)), rng.uniform(-4, 4, n)])
    goals = rng.uniform(-6, 6, (n, 2))
    # Of some rows all posts stand, and in some others they touch one another and the robot.
    speeds = rng.uniform(-0.4, 0.4, (n, posts, 2)) * (rng.random((n, 1, 1)) < 0.7)
    places, radii = rng.uniform(-5, 5, (n, posts, 2)), rng.uniform(0.2, 1.2, (n, posts, 1))
    columns = np.concatenate([places, speeds, radii], axis=2).reshape(n, -1)
    seen, q = np.hstack([poses, goals, columns]), rng.choice(controller.modes, n)
    u, after = controller.step(q, seen)
    for i in range(n):
        one_u, one_q = controller.step(q[i : i + 1], seen[i : i + 1])
        assert one_q[0] == after[i]
        np.testing.assert_allclose(one_u[0], u[i], atol=1e-12)


@pytest.mark.slow
def test_a_controller_of_fields_is_exported(field, tmp_path):
    from onnxruntime import InferenceSession

    controller = for_posts(field, {LEFT: Weighted(0), RIGHT: Weighted(1)}, 0.1, 2)
    task, rng = controller.task, np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(-6, 2, (40, 2)), rng.uniform(-3, 3, 40)])
    plant = task.plant(40)
    plant.set_state(*task.state(poses))
    seen, q = plant.measurement, rng.choice(controller.modes, 40)
    seen[:, 7] = 0.3  # the first post moves
    u, after = controller.step(q, seen)
    export_numpy(controller, tmp_path / "exported")
    module = run_path(str(tmp_path / "exported" / "controller.py"))
    session = InferenceSession(export_onnx(controller, tmp_path / "controller.onnx"))
    for exported in (module["step"](q, seen), session.run(None, {"q": q, "measured": seen})):
        np.testing.assert_allclose(exported[0], u, atol=1e-5)
        np.testing.assert_array_equal(exported[1], after)
    first = controller.initial_mode(seen)
    np.testing.assert_array_equal(module["initial_mode"](seen), first)
    begun = session.run(None, {"q": np.full(40, -1), "measured": seen})
    np.testing.assert_array_equal(begun[1], first)


def test_what_a_controller_begins_with_the_same_measurement_does_not_change(field):
    rng, n = np.random.default_rng(0), 400
    posts = np.column_stack([rng.uniform(-5, 5, (12, 2)), rng.uniform(0.3, 0.9, 12)])
    seen = np.vstack(
        [measured((*rng.uniform(-7, 7, 2), rng.uniform(-3, 3)), posts) for _ in range(n)]
    )
    seen = seen[Seen(seen).room.min(axis=1) > 0.3]
    controller = straight(field, posts)
    first = controller.initial_mode(seen)
    assert (controller.step(first, seen)[1] // 2 != first // 2).mean() < 0.01
    at_first_sight = controller.answer(np.full(len(seen), -1), seen)[1]
    assert (at_first_sight // 2 != first // 2).mean() > 0.02


def test_the_controller_of_a_run_is_exported_as_that_of_fields(field, tmp_path):
    acting = {q: GuardedPolicy(field, Weighted(q), q, 0.1) for q in (LEFT, RIGHT)}
    written, sides = tmp_path / "field.json", {q: Everything() for q in acting}
    written.write_text(
        '{"goal_m": [0, 0], "posts": [{"radius_m": 0.5, "positions_m": [[-3, 0]]}, {"radius_m": 0.5, '
        '"positions_m": [[-3, 3]]}], "starts": [{"position_m": [-6, 0], "heading_rad": 0}]}'
    )
    export_numpy(HybridController(field, acting, sides), tmp_path / "two", written)
    step = run_path(str(tmp_path / "two" / "controller.py"))["step"]
    seen = measured((-6, 0.2, 0.5), [(-3, 0, 0.5), (-3, 3, 0.5)])
    controller = for_posts(field, {q: Weighted(q) for q in acting}, 0.1, 2)
    for found, right in zip(step([7], seen), controller.step(np.array([7]), seen), strict=True):
        np.testing.assert_allclose(found, right, atol=1e-9)
    one_sided = HybridController(field, {0: acting[0]}, {0: Everything()})
    for export in (export_numpy, export_onnx):
        with pytest.raises(hyrl_mj.BadInput, match=r"has 1 mode.*hyrl-mj run field"):
            export(one_sided, tmp_path / "one")


def test_a_field_has_from_one_to_a_hundred_posts(field):
    for posts in (0, 101):
        with pytest.raises(hyrl_mj.BadInput, match=f"{posts} posts: give from 1 to 100"):
            for_posts(field, {LEFT: Weighted(0), RIGHT: Weighted(1)}, 0.1, posts)


def test_the_reward_of_a_mode_leads_its_own_way(field):
    place = np.array([[-3.0, 0.0, 0.0, 0, 0, -1.5, 0, 0, 0, 0.5, 1.0]])
    turned = np.array([0.5, -0.5])
    seen = np.repeat(place, 2, axis=0)
    seen[:, 2] = turned
    u = np.tile([1.0, 0.0], (2, 1))
    left, right = (field.for_mode(mode).reward(seen, u) for mode in (LEFT, RIGHT))
    assert left[0] > left[1]
    assert right[0] < right[1]
    np.testing.assert_allclose(left, right[::-1])


# ---- the rover among posts: its wheels follow speed and turn rate

# Far from all posts of the usual layout.
FREE = np.array([[-4.0, 3.0, 0.3]])


@pytest.fixture(scope="module")
def rover():
    return hyrl_mj.get_task("rover_field")


def poses(task, z, inputs, samples):
    """Returns poses x, y, heading (samples + 1, n, 3) under constant inputs (2,)."""
    plant = task.plant(len(z))
    plant.set_state(*task.state(np.asarray(z)))
    path = [plant.measurement[:, :3]]
    for _ in range(samples):
        plant.step(np.tile(inputs, (len(z), 1)))
        path.append(plant.measurement[:, :3])
    return np.array(path)


@pytest.mark.parametrize("speed", [-1.0, 0.5])
def test_it_reaches_the_speed_that_is_asked_for(rover, speed):
    path = poses(rover, FREE, (speed, 0.0), 30)[:, 0]
    course = np.array([np.cos(path[0, 2]), np.sin(path[0, 2])])
    speeds = np.diff(path[:, :2] @ course) / rover.dt
    np.testing.assert_allclose(speeds[-10:], speed, rtol=0.03)
    # It takes a while: what has inertia does not jump.
    assert abs(speeds[0]) < 0.3 * abs(speed)
    np.testing.assert_allclose(path[:, 2], path[0, 2], atol=1e-3)


@pytest.mark.parametrize(("speed", "rate"), [(-1.0, -1.0), (0.0, 0.5), (1.0, 1.0)])
def test_it_turns_at_the_rate_that_is_asked_for(rover, speed, rate):
    heading = np.unwrap(poses(rover, FREE, (speed, rate), 30)[:, 0, 2])
    assert (heading[-1] - heading[10]) / (20 * rover.dt) == pytest.approx(rate, rel=0.1)
    assert abs(heading[1] - heading[0]) < 0.8 * abs(rate) * rover.dt


def test_no_sequence_of_inputs_tips_it_over(rover):
    n, rng, low, high = 30, np.random.default_rng(0), *rover.input_limits
    plant = rover.plant(n)
    plant.set_state(*rover.state(rover.starts(n, rng)))
    for k in range(100):
        if k % 7 == 0:
            u = np.where(rng.random((n, 2)) < 0.5, low, high)
        plant.step(u)
        upright = 1 - 2 * (plant.qpos[:, 4:6] ** 2).sum(axis=1)
        assert (upright > np.cos(np.radians(6))).all()


def test_its_pose_is_that_of_the_middle_of_its_bumper(rover):
    plant = rover.plant(20)
    plant.set_state(*rover.state(rover.starts(20, np.random.default_rng(0))))
    bumper = plant.model.geom("bumper").id
    for _ in range(5):
        plant.step(np.tile([[1.0, 1.0]], (20, 1)))
    seen = plant.geom_positions([bumper])[:, 0, :2]
    np.testing.assert_allclose(seen, plant.measurement[:, :2], atol=2e-3)


def test_it_drives_through_a_field_of_several_posts(rover):
    places = np.array([[-2.0, 2.0], [0.0, -1.0], [2.0, 2.5]])
    tracks = np.stack([places, places - [0.0, 1.0]])[None, :, :]
    layouts = Layouts(tracks, np.array([[0.3, 0.5, 0.9]]), np.array([[4.0, 0.0]]), interval=4.0)
    starts = np.array([[-4.0, 0.0, 0.0], [-4.0, 1.5, 0.0]])
    task = Driving(rover, layouts, starts=starts)
    posts = [f"obstacle{k}" for k in ("", "_1", "_2")]
    assert [task.model.geom(name).size[0] for name in posts] == [0.3, 0.5, 0.9]
    plant = task.plant(2)
    plant.set_state(*task.state(starts))
    np.testing.assert_allclose(plant.measurement[:, :3], starts, atol=1e-12)
    for _ in range(20):
        plant.step(np.tile([[1.0, 0.0]], (2, 1)))
    seen = plant.measurement
    known = seen[:, 5:].reshape(2, 3, 5)
    np.testing.assert_allclose(known[0, :, :2], places - [0.0, 0.25], atol=1e-5)
    ids = [task.model.geom(name).id for name in posts]
    np.testing.assert_allclose(plant.geom_positions(ids)[..., :2], known[..., :2], atol=1e-6)
    away = length(known[..., :2] - seen[:, None, :2])
    np.testing.assert_allclose(task.clearances(seen), away - [0.3, 0.5, 0.9] - 0.16)
    settings = LoopSettings(quiet=True)
    ahead = PolicyController(SimpleNamespace(act=Straight().inputs))
    run = closed_loop(task, ahead, starts, settings=settings)
    assert run.outcome.tolist() == [Outcome.REACHED, Outcome.CRASHED]
