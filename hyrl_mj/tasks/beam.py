"""A quadrotor: fly past the end of a beam at speed, on one of its four sides, to a gate behind it."""

from functools import cached_property

import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import FullState, Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.flight import Rotors
from hyrl_mj.tasks.registry import register


@register
class Beam(Task):
    name = "beam"
    description = "fly past the end of a beam: above, below, on its left or on its right (PPO)"
    inputs, input_units = ("lateral_velocity", "climb_rate"), ("m/s", "m/s")
    # Columns of the measurement: x, y, z, speeds to the side and upward.
    noisy = (1.0, 1.0, 1.0, 0.0, 0.0)
    max_steps = 64
    worst_reward = 0.0
    start_low, start_high = (0.0, -0.7, 0.9), (1.8, 0.7, 2.3)
    scene = Scene(
        starts=tuple(
            (x, y, 1.6 + z)
            for x, y, z in (
                (0.1, -0.03, 0.02),
                (0.25, 0.2, -0.2),
                (0.4, 0.3, 0.27),
                (0.5, -0.38, -0.34),
            )
        ),
        time=3.2,
        mode_names=("left", "above", "right", "below"),
        camera="three_quarter",
    )
    # The way lasts 60 samples, and only the last one tells whether a mode arrives.
    learning = Learning(levels=3, algorithm="ppo", modes={"gamma": 0.96, "samples": 240_000})
    mirror = Mirror((1, -1, 1, -1, 1), (-1, 1))
    # The opening of the gate, and where in it 0.2 m are left on every side [m].
    close, precision = 1.2, 1.0
    observation_low, observation_high = (-5.0, -4.0, -4.0, -6.0, -6.0), (5.0, 4.0, 4.0, 6.0, 6.0)

    @cached_property
    def chart(self) -> Chart:  # type: ignore[override]
        centre, half = mjcf.site_pos(self.model, "arena"), mjcf.site_size(self.model, "arena")
        low, high = tuple(centre - half), tuple(centre + half)
        return Chart(("x", "y", "z"), ("m", "m", "m"), low, high, (False,) * 3)

    @cached_property
    def set_point(self) -> np.ndarray:
        """The centre of the gate (3,) [m]."""
        return mjcf.site_pos(self.model, "set_point")

    @cached_property
    def beam(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre and half sizes of the beam (3,), (3,) [m]."""
        return mjcf.geom_pos(self.model, "obstacle"), mjcf.geom_size(self.model, "obstacle")

    @cached_property
    def passed(self) -> float:
        """Where the hull has left the beam behind: x [m]."""
        centre, half = self.beam
        return float(centre[0] + half[0] + mjcf.geom_size(self.model, "hull")[0])

    @cached_property
    def rotors(self) -> Rotors:
        """The rotors and the loop that commands them."""
        return Rotors(self.model, lift=(0.4, 1.6))

    @cached_property
    def speed(self) -> float:
        """Speed ahead [m/s]."""
        return float(mjcf.numeric(self.model, "speed", 1)[0])

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        return sensors[:, [0, 1, 2, 4, 5]]

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        velocity = np.column_stack([np.full(len(u), self.speed), u])
        return self.rotors.thrusts(velocity, qpos, qvel)

    def state(self, z: np.ndarray, rng: np.random.Generator | None = None) -> FullState:
        qpos, qvel = np.zeros((len(z), 7)), np.zeros((len(z), 6))
        qpos[:, :3], qpos[:, 3], qvel[:, 0] = z, 1.0, self.speed
        if rng is not None:
            qvel[:, 1:3] = rng.uniform(-0.1, 0.1, (len(z), 2))
        return qpos, qvel

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return np.hstack([measured[:, :3] - self.set_point, measured[:, 3:5]])

    def measured(self, observation: np.ndarray) -> np.ndarray:
        return np.hstack([observation[:, :3] + self.set_point, observation[:, 3:]])

    def clearance(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distance of the hull from the beam: (n,) [m]."""
        centre, half = self.beam
        outside = np.maximum(np.abs(measured[:, :3] - centre) - half, 0.0)
        return np.linalg.norm(outside, axis=1) - mjcf.geom_size(self.model, "hull")[0]

    def to_edge(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distance from the sides of the arena, and from its top and bottom: (n,) [m]."""
        low, high = np.array(self.chart.low[1:]), np.array(self.chart.high[1:])
        inside = np.minimum(measured[:, 1:3] - low, high - measured[:, 1:3])
        return np.asarray(inside.min(axis=1))

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        free = np.minimum(self.clearance(measurement), self.to_edge(measurement))
        near = 0.5 * np.clip(1 - free / 0.3, 0.0, 1.0)
        # Before the beam it pays to get clear of it on the nearest side, at once: a crash far ahead is
        # discounted, and a pull to the middle would make every way as good as the nearest.
        to_go = self.to_side(measurement, room=0.25).min(axis=1).clip(0.0)
        off = np.abs(measurement[:, 1:3] - self.set_point[1:]).sum(axis=1)
        before = 0.8 * to_go + 0.05 * np.abs(u).sum(axis=1)
        cost = np.where(measurement[:, 0] < self.passed, before, 0.5 * off)
        reward = np.maximum(1 - near - cost, 0.0)
        reward = np.where(measurement[:, 0] >= self.set_point[0], 10 * reward, reward)
        return np.where(self.failed(measurement), 0.0, reward)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        position = measurement[:, :3]
        ends = np.full(len(measurement), Outcome.RUNNING)
        at_gate = position[:, 0] >= self.set_point[0]
        ends[at_gate] = np.where(
            self.arrived(position[at_gate]), Outcome.REACHED, Outcome.OUT_OF_BOUNDS
        )
        ends[self.to_edge(measurement) <= 0] = Outcome.OUT_OF_BOUNDS
        ends[self.clearance(measurement) <= 0] = Outcome.CRASHED
        return ends

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.abs(z[:, 1:] - self.set_point[1:]).max(axis=1)

    def to_side(self, z: np.ndarray, room: float = 0.0) -> np.ndarray:
        """Returns how far to the side and in height (n, 2) [m] it is until the hull clears the beam.

        It clears the beam with some room [m] to spare where either is 0 or less.
        """
        centre, half = self.beam
        hull = mjcf.geom_size(self.model, "hull")[0]
        return half[1:] + hull + room - np.abs(z[:, 1:3] - centre[1:])

    def may_start(self, z: np.ndarray) -> np.ndarray:
        centre, half = self.beam
        left = centre[0] - half[0] - mjcf.geom_size(self.model, "hull")[0] - z[:, 0]
        to_side = (self.to_side(z) / self.input_limits[1]).min(axis=1)
        # Time to spare [s] is enough for the next side, too, where noise has picked the wrong one.
        return super().may_start(z) & (left / self.speed - 0.95 > np.maximum(to_side, 0.0))

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        drawn = np.empty((0, 3))
        while len(drawn) < n:
            z = rng.uniform(self.start_low, self.start_high, (2 * n, 3))
            drawn = np.vstack([drawn, z[self.may_start(z)]])
        return drawn[:n]

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        # Where it is near, the edge of the arena is as dangerous as the beam at four times the distance.
        return -np.minimum(self.clearance(measurement), 4.0 * self.to_edge(measurement))

    def direction(self, path: np.ndarray) -> np.ndarray:
        """Returns the side of the beam on which runs passed: the quarter of the angle about the axis.

        0 is on the left, 1 above, 2 on the right and 3 below; -1 for starts beside the beam or behind it, and
        for those that clear it at a corner, both to the side and in height.
        """
        centre, half = self.beam
        passing = np.abs(path[..., 0] - centre[0]).argmin(axis=0)
        y, z = (path[passing, np.arange(path.shape[1]), 1:] - centre[1:]).T
        quarter = np.round(np.arctan2(z, y) / (np.pi / 2)).astype(int) % 4
        hull, start = mjcf.geom_size(self.model, "hull")[0], path[0]
        at_corner = (self.to_side(start) <= 0).all(axis=1)
        open_ways = (start[:, 0] < centre[0] - half[0] - hull) & ~at_corner
        return np.where(open_ways, quarter, -1)
