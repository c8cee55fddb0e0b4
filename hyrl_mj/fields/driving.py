"""The task of driving through a field with any number of posts, with what was trained on one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from mujoco import mjtProjection

from hyrl_mj.fields.focus import decoded
from hyrl_mj.physics import mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.tasks import Field, FieldTask, FullState, Layouts, Scene, length


@dataclass(frozen=True)
class Bounds:
    """Bounds of the noise on what a robot measures; a task takes no more from them than their ratios.

    Attributes:
        place: of the robot's position [m].
        heading: of its heading [rad].
        posts: of the posts' positions [m].
        speeds: of the posts' velocities [m/s].
    """

    place: float = 1.0
    heading: float = 0.5
    posts: float = 0.0
    speeds: float = 0.0

    @property
    def largest(self) -> float:
        """The bound that the others are shares of: that on the position, unless it is 0."""
        return self.place or max(self.heading, self.posts, self.speeds)

    def shares(self, posts: int) -> tuple[float, ...]:
        """Returns which share of `largest` acts on each column of a measurement of so many posts."""
        # Of signs with which what is the same in all columns does not cancel in the ways to posts.
        each = (-self.posts, -self.posts, self.speeds, self.speeds, 0.0)
        columns = (self.place, self.place, self.heading, 0.0, 0.0, *(each * posts))
        return tuple(bound / (self.largest or 1.0) for bound in columns)

    def __str__(self) -> str:
        parts = {
            f"{self.place:g} m": self.place,
            f"{self.heading:g} rad": self.heading,
            f"{self.posts:g} m on the posts": self.posts,
            f"{self.speeds:g} m/s on their velocities": self.speeds,
        }
        return ", ".join(text for text, bound in parts.items() if bound) or "0 m"


class Driving(FieldTask):
    """A robot that drives to a goal through one of the fields of `layouts`.

    Its chart is the robot's pose and, where there are several fields, the number of the field. A measurement
    (n, 5 + 5 K) is as that of `FieldTask`; where there are several fields, their number is its last column.
    An observation is a measurement.

    Args:
        local: the task on which the policies were trained.
        layouts: the fields.
        bounds: of the noise; the shares of its bound that act on the columns follow from them.
        reached: distance from the goal at which the robot has arrived [m].
        time: longest time of a run [s].
        starts: (n, 3) poses x, y, heading that have to lie in the chart.

    Raises:
        BadInput: there is no post, or the model cannot be compiled.
    """

    name = "drive"
    description = "drive to a goal through a field of posts"
    worst_reward = -1.0

    def __init__(
        self,
        local: Field,
        layouts: Layouts,
        bounds: Bounds = Bounds(),
        reached: float = 0.1,
        time: float = 15.0,
        starts: np.ndarray | None = None,
    ):
        self.local, self.robot, self.layouts = local, local.robot, layouts
        places = [layouts.tracks.reshape(-1, 2), layouts.goals]
        if starts is not None:
            places.append(np.asarray(starts)[:, :2])
        known = np.vstack(places)
        middle, half = (known.min(axis=0) + known.max(axis=0)) / 2, np.ptp(known, axis=0) / 2
        self._middle, self._half = middle, float(half.max())
        several = self._several = len(layouts) > 1
        # The world reaches 6 m beyond them.
        low, high = middle - self._half - 6.0, middle + self._half + 6.0
        self.start_low = (*low, -np.pi, *[0.0] * several)
        self.start_high = (*high, np.pi, *[len(layouts) - 1.0] * several)
        d = 3 + several
        self.chart = Chart(
            ("x", "y", "heading", "field")[:d], ("m", "m", "rad", "")[:d],
            self.start_low, self.start_high,
            (False, False, True, False)[:d], scale=(1.0, 1.0, 0.5, 1.0)[:d],
        )  # fmt: skip
        self.noisy = (*bounds.shares(layouts.posts), *[0.0] * several)
        self.reached = reached
        self.max_steps = max(round(time / self.dt), 1)
        first = np.zeros((1, 3)) if starts is None else np.asarray(starts, dtype=float)[:1]
        self.scene = Scene(starts=np.pad(first, ((0, 0), (0, several))).tolist(), time=time)
        self.learning = local.learning
        self.observation_low, self.observation_high = self._observed()

    def _observed(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Returns the limits of observations."""
        layouts, (low, high) = self.layouts, (self.start_low, self.start_high)
        # Headings are not wrapped.
        turned = np.pi + self.max_steps * self.dt * float(np.abs(self.input_limits).max())
        number = np.arange(len(layouts))
        fastest = max(
            float(np.abs(layouts.velocities(number, np.full(len(layouts), k))).max())
            for k in layouts.interval * np.arange(layouts.tracks.shape[1])
        )
        radius = float(layouts.radii.max())
        lowest = (*low[:2], -turned, *low[:2], *(*low[:2], -fastest, -fastest, 0.0) * layouts.posts)
        highest = (
            *high[:2], turned, *high[:2], *(*high[:2], fastest, fastest, radius) * layouts.posts
        )  # fmt: skip
        return (*lowest, *low[3:]), (*highest, *high[3:])

    @cached_property
    def dt(self) -> float:
        return self.local.dt

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The MJCF of the local task, with the posts of the first field."""
        spec = mujoco.MjSpec.from_file(str(self.local.model_path))
        first = spec.body("post")
        radii, goal = self.layouts.radii[0], self.layouts.goals[0]
        for number in range(1, self.layouts.posts):
            post = spec.worldbody.add_body(name=f"post_{number}", mocap=True)
            for geom in first.geoms:
                post.add_geom(
                    name=f"{geom.name}_{number}", type=geom.type, size=geom.size, pos=geom.pos,
                    material=geom.material, rgba=geom.rgba, contype=0, conaffinity=0, mass=0,
                )  # fmt: skip
        for body in spec.bodies:
            if body.mocap:
                number = int(body.name.partition("_")[2] or 0)
                for geom in body.geoms:
                    larger = radii[number] - mjcf.geom_size(self.local.model, "obstacle")[0]
                    # The rim of a thin post is thinner, too. MuJoCo refuses a radius of 0.
                    geom.size[0] = max(geom.size[0] + larger, radii[number] / 2, 1e-6)
        for geom in spec.worldbody.geoms:
            if geom.name.startswith("goal"):
                geom.pos[:2] += goal
        wide = self._half + max(1.0, float(self.layouts.radii.max()) + 0.1)
        self._aim(spec, wide)
        model = spec.compile()
        # What an orthographic camera sees is a length, but the compiler refuses 180 m as if it were an angle.
        model.cam_fovy[model.cam_projection == mjtProjection.mjPROJ_ORTHOGRAPHIC] = 2 * wide
        return model

    def _aim(self, spec: mujoco.MjSpec, wide: float) -> None:
        """Moves the cameras that stay so that they see `wide` metres around the middle of the field.

        A camera on the robot looks from the first start to the goal.
        """
        overhead = self.local.model.cam("overhead")
        seen = np.append(overhead.pos[:2], 0.0)
        for camera in spec.worldbody.cameras:
            if camera.proj == mjtProjection.mjPROJ_ORTHOGRAPHIC:
                camera.pos[:2] = self._middle
            else:
                closer = (camera.pos - seen) * 2 * wide / overhead.fovy[0]
                camera.pos = np.append(self._middle, 0.0) + closer
        x, y = self.layouts.goals[0] - self.scene.starts[0][:2]
        angle = np.arctan2(y, x)
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        for camera in spec.cameras:
            if camera.mode == mujoco.mjtCamLight.mjCAMLIGHT_TRACK:
                camera.pos = turn @ camera.pos
                camera.alt.xyaxes = (np.reshape(camera.alt.xyaxes, (2, 3)) @ turn.T).ravel()

    @property
    def obstacles(self) -> dict[str, int]:
        """No obstacle: a run through many posts is not told apart by its way past each of them."""
        return {}

    def mode_name(self, mode: int) -> str:
        """Returns post and side of a mode: "post 3, left"."""
        focus, side, _ = (int(part[0]) for part in decoded(np.array([mode])))
        return f"post {focus}, {('left', 'right')[side]}"

    def colour_of(self, mode: int, modes: Sequence[int]) -> int:
        """The colour of a mode is that of its side."""
        return int(decoded(np.array([mode]))[1][0])

    def tinted(self, mode: int) -> tuple[str, ...]:
        """The post in focus has the colour of its side."""
        post = int(decoded(np.array([mode]))[0][0])
        return tuple(f"{name}_{post}" if post else name for name in ("obstacle", "cap"))

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        measured = super().measure(sensors)
        number = np.rint(self.robot.sensed(sensors)[:, 4:])
        return np.hstack([measured, number]) if self._several else measured

    def state(self, z: np.ndarray, rng: np.random.Generator | None = None) -> FullState:
        number = z[:, 3] if self._several else np.zeros(len(z))
        return self.robot.state(z[:, :3], np.rint(number))

    def z(self, measured: np.ndarray) -> np.ndarray:
        pose, number = measured[:, :3], measured[:, -1:]
        return np.hstack([pose, number]) if self._several else pose

    def with_z(self, measured: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.hstack([z[:, :3], measured[:, 3:]])

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return measured

    def measured(self, observation: np.ndarray) -> np.ndarray:
        return observation

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.full(len(u), self.worst_reward)  # the time

    def miss(self, z: np.ndarray) -> np.ndarray:
        number = z[:, 3].astype(int) if self._several else np.zeros(len(z), dtype=int)
        return np.asarray(length(z[:, :2] - self.layouts.goals[number]))
