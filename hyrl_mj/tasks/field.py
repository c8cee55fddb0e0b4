"""Fields: drive to a goal past a post, with policies that serve any number of posts.

The chart is the frame of one post: its origin is the post, and its first axis points to the goal. What a
policy learns there holds for every post of a field that it is told to pass.
"""

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import Any, Self

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics import mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import FullState, Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.layouts import OF_POST, POSE, Layouts, posts_of
from hyrl_mj.tasks.obstacles import length, wrapped
from hyrl_mj.tasks.registry import register

# The radii of posts in training [m], and their greatest speed [m/s].
RADII, FASTEST = (0.3, 0.9), 0.4
# Distance of the robot's middle from a post's surface at which the shortest way passes it [m].
CLEAR = 0.35
# A post this close to the goal leaves no room to arrive [m].
TAKEN = 0.25
# What the post leaves the robot at the start, at least: this room [m], for so long [s].
ROOM = 0.05
HEADWAY = 0.8
# What both trainings share.
PPO: dict[str, Any] = {
    "hidden": (64, 64),
    "activation": "tanh",
    "spread": True,
    "normalize": True,
    "rehearse": 0.0,
    "options": {
        "n_steps": 32,
        "batch_size": 1024,
        "n_epochs": 8,
        "ent_coef": 0.005,
        "gae_lambda": 0.95,
    },
}
# How far ahead the way of a moving post counts [s].
PROJECTED = 2.0


def ways_round(
    to_post: np.ndarray, to_goal: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns where the shortest ways to the goal past a disc begin, and how long they are.

    Args:
        to_post, to_goal: (n, 2) from the robot to the middle of the disc and to the goal [m].
        radius: (n,) of the disc [m].

    Returns:
        (n, 2) directions of the ways that pass the disc on its `LEFT` and on its `RIGHT` [rad]; (n, 2) their
        lengths [m].
    """
    post_x, post_y, goal_x, goal_y = (v[:, i : i + 1] for v in (to_post, to_goal) for i in (0, 1))
    from_x, from_y = goal_x - post_x, goal_y - post_y
    away, far, goal_away = (
        np.sqrt(x * x + y * y) for x, y in ((post_x, post_y), (goal_x, goal_y), (from_x, from_y))
    )
    # Where robot or goal is inside of the disc, the way follows a smaller one.
    radius = np.minimum(radius[:, None], goal_away)
    deep = np.maximum(radius - away, 0.0)
    away = np.maximum(away, 1e-9)
    radius = np.minimum(radius, away)
    bearing, goal = np.arctan2(post_y, post_x), np.arctan2(goal_y, goal_x)
    # The angle to turn about the disc, against the clock on its right.
    signs = np.array([1.0, -1.0])
    turn = signs * (np.arctan2(-post_y, -post_x) - np.arctan2(from_y, from_x))
    own = np.arccos(radius / away)
    both = own + np.arccos(radius / np.maximum(goal_away, 1e-9))
    free = np.abs(wrapped(turn)) <= both
    # Inside of the disc the way leads out of it, the more so the deeper it is, and no nearer to the post.
    half = np.pi / 2 - own + np.minimum(deep / CLEAR, 1.0) * (np.pi / 2)
    off = wrapped(goal - bearing)
    out = bearing + np.where(free, np.where(off >= 0, 1.0, -1.0), signs) * half
    direction = np.where(free & ((np.abs(off) >= half) | (deep == 0)), goal, out)
    legs = np.sqrt(away * away - radius * radius) + np.sqrt(goal_away * goal_away - radius * radius)
    around = radius * np.maximum(turn % (2 * np.pi) - both, 0.0)
    return direction, np.where(free, far, legs + around)


def turns_to(angle: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns by how much to turn for headings that are off by angles (...) [rad].

    A turn of more than a right angle goes the way of `sense` (...): 1 against the clock, -1 with it, 0 the
    shorter way.
    """
    offset = sense * np.pi / 2
    return wrapped(angle - offset) + offset


class FieldRobot:
    """A robot with a heading h, that a forward speed v and a rate of turn w drive.

    This one follows them without inertia, x' = v cos h, y' = v sin h, h' = w; others have methods of their
    own. The last two joints of a model are a clock [s], and the number of the layout.

    Attributes:
        hull: the cylinder of the model that touches posts; its middle is where the pose is taken.
    """

    hull = "hull"

    def sensed(self, sensors: np.ndarray) -> np.ndarray:
        """Returns x, y, heading, clock and number of the layout (n, 5) [m, m, rad, s, 1]."""
        return sensors

    def state(self, pose: np.ndarray, number: np.ndarray) -> FullState:
        """Returns qpos (n, nq) and qvel (n, nv) of robots at rest, None for zero.

        Args:
            pose: (n, 3) x, y, heading [m, m, rad].
            number: (n,) of the layout.
        """
        return np.column_stack([pose, np.zeros(len(pose)), number]), None

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Returns the controls (n, nu) for forward speeds and rates of turn u (n, 2) [m/s, rad/s]."""
        speed, heading = u[:, 0], qpos[:, 2]
        ahead = speed * np.cos(heading), speed * np.sin(heading)
        return np.stack([*ahead, u[:, 1], np.ones(len(u)), np.zeros(len(u))], axis=1)


class FieldTask(Task):
    """A robot among round posts, which stand or move.

    Its measurement (n, 5 + 5 K) is the pose x, y, heading [m, m, rad], x and y of the goal [m], and of each
    post x, y [m], their velocities [m/s], and its radius [m]. The posts follow the tracks of `layouts`: the
    state holds a clock, and the number of the layout.
    """

    inputs, input_units = ("forward_speed", "turn_rate"), ("m/s", "rad/s")
    layouts: Layouts
    robot: FieldRobot

    @cached_property
    def body(self) -> float:
        """Radius of the robot [m]."""
        return float(mjcf.geom_size(self.model, self.robot.hull)[0])

    @cached_property
    def reached(self) -> float:
        """Distance from the goal at which the robot has arrived [m]."""
        return float(mjcf.numeric(self.model, "reached", 1)[0])

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        sensed = self.robot.sensed(sensors)
        return self.measured_at(sensed[:, :3], sensed[:, 3], np.rint(sensed[:, 4]).astype(int))

    def measured_at(self, pose: np.ndarray, clock: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Returns the measurements (n, 5 + 5 K) at poses (n, 3) and times (n,) [s] in layouts (n,) int."""
        posts = np.empty((len(pose), self.layouts.posts, OF_POST))
        posts[..., :2] = self.layouts.positions(number, clock)
        posts[..., 2:4] = self.layouts.velocities(number, clock)
        posts[..., 4] = self.layouts.radii[number]
        return np.hstack([pose, self.layouts.goals[number], posts.reshape(len(pose), -1)])

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return self.robot.control(u, qpos, qvel)

    def mocap(self, qpos: np.ndarray) -> np.ndarray:
        clock, number = qpos[:, -2], np.rint(qpos[:, -1]).astype(int)
        flat = self.layouts.positions(number, clock)
        return np.concatenate([flat, np.zeros_like(flat[..., :1])], axis=2)

    def clearances(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distances (n, K) [m] of the robot's hull from the posts."""
        posts = posts_of(measured)
        return length(posts[..., :2] - measured[:, None, :2]) - posts[..., 4] - self.body

    def to_goal(self, measured: np.ndarray) -> np.ndarray:
        """Returns the ways (n, 2) from the robot to the goal [m]."""
        return measured[:, 3:5] - measured[:, :2]

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        ends = np.full(len(measurement), Outcome.RUNNING)
        ends[length(self.to_goal(measurement)) <= self.reached] = Outcome.REACHED
        ends[self.clearances(measurement).min(axis=1) <= 0] = Outcome.CRASHED
        return ends

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        # Where time is over, a robot has not arrived, whatever the chart says.
        return np.full(len(measurement), Outcome.STALLED)

    def waits(self, measurement: np.ndarray) -> np.ndarray:
        """Returns (n,) bool: whether a robot is near a post that leaves no room at the goal."""
        posts = posts_of(measurement)
        away = length(posts[..., :2] - measurement[:, None, 3:5])
        at_goal = away < posts[..., 4] + TAKEN
        # Up to 1 m from such a post a robot waits for it to go.
        return np.asarray((at_goal & (self.clearances(measurement) < 1.0)).any(axis=1))

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        return -self.clearances(measurement).min(axis=1)

    def where(self, measured: np.ndarray) -> np.ndarray:
        return measured[:, :2]

    def arrived(self, z: np.ndarray) -> np.ndarray:
        return np.ones(len(z), dtype=bool)  # episodes end at the goal


@register
class Field(FieldTask):
    name = "field"
    robot = FieldRobot()
    description = "drive to a goal among posts, with policies trained on one (PPO)"
    noisy = (1.0, 1.0, 0.5, *[0.0] * 8)
    max_steps = 300
    worst_reward = -10.0
    start_low, start_high = (-4.0, -3.0, -np.pi), (3.0, 3.0, np.pi)
    scene = Scene(
        starts=tuple((-3.0, y, 0.0) for y in (-0.3, -0.1, 0.0, 0.1, 0.3)),
        time=8.0,
        mode_names=("left", "right"),
    )
    learning = Learning(
        levels=5,
        training={**PPO, "samples": 500_000, "learning_rate": 1e-3, "gamma": 0.98, "episode": 60},
        modes={**PPO, "samples": 1_000_000, "learning_rate": 2e-3, "gamma": 0.99, "episode": 120},
    )
    mirror = Mirror((1, -1, 1, 1, -1, 1, 1, 1, 1, -1, 1, -1, -1, 1, -1, -1, 1), (1, -1))
    precision, close = 0.1, 0.1
    observation_low = (-1.2,) * 17
    observation_high = (1.2,) * 17
    side: int | None = None

    @cached_property
    def chart(self) -> Chart:  # type: ignore[override]
        return Chart(
            ("along", "across", "heading"), ("m", "m", "rad"), self.start_low, self.start_high,
            (False, False, True), scale=(1.0, 1.0, 0.5),
        )  # fmt: skip

    @cached_property
    def layouts(self) -> Layouts:  # type: ignore[override]
        """Layouts with one post, by the room that it needs; the usual one is the last."""
        rng, drawn = np.random.default_rng(0), 4_096
        radii = rng.uniform(*RADII, drawn)
        # From the post's surface to the goal [m]. One post in ten leaves no room there.
        distance = rng.uniform(0.35, 8.0, drawn)
        on_goal = rng.uniform(-RADII[0] / 2, 0.35, drawn)
        distance = np.where(rng.random(drawn) < 0.1, on_goal, distance)
        # Two in five posts stand, and one in five comes towards the goal.
        speed = np.where(rng.random(drawn) < 0.4, 0.0, rng.uniform(0, FASTEST, drawn))
        course = rng.uniform(-np.pi, np.pi, drawn)
        course = np.where(rng.random(drawn) < 0.2, rng.normal(0, 0.3, drawn), course)
        order = np.argsort(radii + HEADWAY * speed)
        radii, distance, speed, course = (x[order] for x in (radii, distance, speed, course))
        radii[-1], distance[-1], speed[-1] = 0.5, 3.0, 0.0
        first = np.stack([-radii - distance, np.zeros(drawn)], axis=1)
        slope = speed[:, None] * np.stack([np.cos(course), np.sin(course)], axis=1)
        tracks = np.stack([first, first + 100 * slope], axis=1)[:, :, None]
        return Layouts(tracks, radii[:, None], np.zeros((drawn, 2)), interval=100.0)

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        # A mode is trained with both senses of turning, by turns.
        sense = np.zeros(len(sensors))
        if self.side is not None:
            sense = 1 - 2 * (np.rint(self.robot.sensed(sensors)[:, 4]) % 2)
        return np.hstack([super().measure(sensors), sense[:, None]])

    def state(self, z: np.ndarray, rng: np.random.Generator | None = None) -> FullState:
        number = np.full(len(z), len(self.layouts) - 1)
        if rng is not None:  # a post that leaves the robot room to act
            fits = np.maximum(np.searchsorted(self._needs, length(z[:, :2]) - self.body - ROOM), 1)
            number = (rng.random(len(z)) * fits).astype(int)
        post = self.layouts.tracks[number, 0, 0]
        return self.robot.state(np.column_stack([z[:, :2] + post, z[:, 2]]), number)

    @cached_property
    def _needs(self) -> np.ndarray:
        """How far each layout's post reaches within a moment (F - 1,), growing [m]."""
        number = np.arange(len(self.layouts))
        speed = length(self.layouts.velocities(number, np.zeros(len(number))))[:, 0]
        return (self.layouts.radii[:, 0] + HEADWAY * speed)[:-1]

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        z = super().starts(n, rng)
        # Starts hold for the usual layout, too.
        least = self.layouts.radii[-1, 0] + self.body + ROOM
        while (inside := length(z[:, :2]) < least).any():
            z[inside] = super().starts(int(inside.sum()), rng)
        return z

    def z(self, measured: np.ndarray) -> np.ndarray:
        axis, away = self._frame(measured)
        turned = wrapped(measured[:, 2] - np.arctan2(axis[:, 1], axis[:, 0]))
        along = (away * axis).sum(axis=1)
        across = away[:, 1] * axis[:, 0] - away[:, 0] * axis[:, 1]
        return np.stack([along, across, turned], axis=1)

    def with_z(self, measured: np.ndarray, z: np.ndarray) -> np.ndarray:
        (x, y), post = self._frame(measured)[0].T, measured[:, POSE : POSE + 2]
        places = post + np.stack([z[:, 0] * x - z[:, 1] * y, z[:, 0] * y + z[:, 1] * x], axis=1)
        return np.hstack([places, (z[:, 2] + np.arctan2(y, x))[:, None], measured[:, 3:]])

    def _frame(self, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the direction (n, 2) from the post to the goal, and that (n, 2) to the robot [m]."""
        post = measured[:, POSE : POSE + 2]
        axis = measured[:, 3:5] - post
        axis = axis / np.maximum(length(axis), 1e-9)[:, None]
        return axis, measured[:, :2] - post

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return self.observed(measured, *self.directions(measured))

    def observed(
        self, measured: np.ndarray, directions: np.ndarray, lengths: np.ndarray
    ) -> np.ndarray:
        """Returns the observations (n, 17) of measurements, with what `directions` gives for them."""
        heading, goal, post = measured[:, 2], self.to_goal(measured), posts_of(measured)[:, 0]
        to_post = post[:, :2] - measured[:, :2]
        left, right = (directions - heading[:, None]).T
        turns = turns_to(directions - heading[:, None], measured[:, -1:])
        cos, sin = np.cos(heading), np.sin(heading)

        def turned(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return v[:, 0] * cos + v[:, 1] * sin, v[:, 1] * cos - v[:, 0] * sin

        far, away = length(goal), length(to_post)
        (goal_x, goal_y), (post_x, post_y) = turned(goal), turned(to_post)
        speed_x, speed_y = turned(post[:, 2:4])
        room = np.maximum(away - post[:, 4], 0.0)
        # Whether the post leaves room at the goal: no noise of the robot's pose acts on that.
        at_goal = np.maximum(length(post[:, :2] - measured[:, 3:5]) - post[:, 4], 0.0)
        columns = [
            goal_x / np.maximum(far, 1e-6), goal_y / np.maximum(far, 1e-6), far / (0.5 + far),
            post_x / np.maximum(away, 1e-6), post_y / np.maximum(away, 1e-6), room / (0.5 + room),
            post[:, 4], at_goal / (0.5 + at_goal), speed_x, speed_y,
            (np.cos(left) + np.cos(right)) / 2, (np.sin(left) + np.sin(right)) / 2,
            (np.cos(left) - np.cos(right)) / 2, (np.sin(left) - np.sin(right)) / 2,
            np.tanh(lengths[:, 0] - lengths[:, 1]),
            (turns[:, 0] + turns[:, 1]) / 8, (turns[:, 0] - turns[:, 1]) / 8,
        ]  # fmt: skip
        return np.stack(columns, axis=1)

    def directions(self, measurement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns directions (n, 2) [rad] and lengths (n, 2) [m] of the ways left and right of the post."""
        post, goal = posts_of(measurement)[:, 0], self.to_goal(measurement)
        to_post = post[:, :2] - measurement[:, :2]
        radius = post[:, 4] + CLEAR
        soon = np.clip(length(to_post) - radius, 0.0, PROJECTED)[:, None]
        return ways_round(to_post + soon * post[:, 2:4], goal, radius)

    def with_sensor(self, sensor: str, shares: Sequence[float]) -> Self:
        """Refuses: modes are trained under noise of their own, which follows from its bound."""
        raise BadInput(f"{self.name} takes a bound of noise, and no sensor: give --eps")

    def for_mode(self, mode: int) -> Self:
        task = copy(self)
        # More noise on x, y and heading than the mode has to bear.
        vars(task).update(side=mode, noisy=(1.5, 1.5, 2.5, *self.noisy[3:]))
        return task

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        directions, lengths = self.directions(measurement)
        side = lengths.argmin(axis=1) if self.side is None else np.full(len(u), self.side)
        direction = directions[np.arange(len(u)), side]
        progress = np.maximum(u[:, 0], 0.0) * np.cos(direction - measurement[:, 2])
        # The last 0.2 m to a post cost up to 2.
        clearance = self.clearances(measurement).min(axis=1)
        near = 2.0 * np.clip(1 - clearance / 0.2, 0.0, 1.0)
        # Backward, at up to 3: what is behind may be another post than the one that the robot knows of.
        backward = 3.0 * np.maximum(-u[:, 0], 0.0)
        # Turning the other way, at up to 3, where more than a right angle is left.
        turn = turns_to(direction - measurement[:, 2], measurement[:, -1])
        wrong = np.where(np.abs(turn) > np.pi / 2, np.maximum(-np.sign(turn) * u[:, 1], 0.0), 0.0)
        # Where a post stands on the goal, waiting in front of it costs nothing.
        base = np.where(self.waits(measurement), 0.0, progress - 1)
        reward = base - 3.0 * wrong - backward - near
        # A crash costs more than any way round.
        return np.where(self.ending(measurement) == Outcome.CRASHED, -100.0, reward)

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        # The training asks a robot to wait where a post stands on the goal.
        return np.where(self.waits(measurement), Outcome.REACHED, super().verdict(measurement))

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.zeros(len(z))
