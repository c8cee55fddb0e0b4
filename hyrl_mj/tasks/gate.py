"""A pillar that swings across the way: drive past it on its left or on its right, to a goal behind it."""

from functools import cached_property

import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.tasks.description import FullState, Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.pillar import PillarTask
from hyrl_mj.tasks.registry import register


@register
class Gate(PillarTask):
    """The vehicle (x, y) and the pillar's phase: the pillar is at y = swing * sin(phase)."""

    name = "gate"
    description = "drive past a pillar that swings across the way (PPO)"
    coordinates, units, largest, periodic = ("x", "y", "phase"), ("m", "m", "rad"), (np.pi,), True
    inputs, input_units = ("lateral_velocity",), ("m/s",)
    noisy = (0.0, 1.0, 0.0)
    max_steps = 65
    worst_reward = 0.0
    start_low, start_high = (0.0, -0.8, -np.pi), (0.5, 0.8, np.pi)
    # The pillar will be at y = 0.354 m when a vehicle from x = 0 at phase 0 is beside it.
    scene = Scene(
        starts=tuple((0.0, y, 0.0) for y in (0.2, 0.3, 0.35, 0.4, 0.5)),
        time=3.2,
        mode_names=("left", "right"),
    )
    learning = Learning(algorithm="ppo", levels=5)
    # Half a period later the pillar is on the other side.
    mirror = Mirror((1, -1, -1, -1), (-1,))
    close, on_the_line = 0.3, 1e-6
    observation_low = (-5.0, -4.0, -1.0, -1.0)
    observation_high = (5.0, 4.0, 1.0, 1.0)

    @cached_property
    def obstacle(self) -> np.ndarray:
        """Centre of the pillar (2,) [m] in the middle of its swing."""
        return np.asarray(self.model.body("pillar").pos[:2])

    @cached_property
    def speeds(self) -> tuple[float, float, float]:
        """Speed ahead [m/s], half the width of the swing [m], and rate of the phase [rad/s]."""
        speed, swing, rate = (mjcf.numeric(self.model, n, 1)[0] for n in ("speed", "swing", "rate"))
        return float(speed), float(swing), float(rate)

    def pillar(self, phase: np.ndarray) -> np.ndarray:
        """Returns how far the pillar is off the middle of its swing at phases (...) [rad]: (...) [m]."""
        return np.asarray(self.speeds[1] * np.sin(phase))

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        (speed, _, rate), step = self.speeds, self.model.opt.timestep
        # At the end of the step the pillar is where its phase then says.
        phase = qpos[:, 3]
        swinging = (self.pillar(phase + rate * step) - self.pillar(phase)) / step
        ahead, turning = np.full(len(u), speed), np.full(len(u), rate)
        return np.column_stack([ahead, u[:, 0], swinging, turning])

    def state(self, z: np.ndarray, rng: np.random.Generator | None = None) -> FullState:
        return np.column_stack([z[:, :2], self.pillar(z[:, 2]), z[:, 2]]), None

    def observation(self, measured: np.ndarray) -> np.ndarray:
        x, y, phase = measured.T
        return np.stack([self.obstacle[0] - x, y, np.sin(phase), np.cos(phase)], axis=1)

    def measured(self, observation: np.ndarray) -> np.ndarray:
        ahead, y, sin, cos = observation.T
        return np.stack([self.obstacle[0] - ahead, y, np.arctan2(sin, cos)], axis=1)

    def clearance(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distance from the pillar's surface: (n,) [m]."""
        x, y, phase = measured.T
        away = np.hypot(x - self.obstacle[0], y - self.obstacle[1] - self.pillar(phase))
        return np.asarray(away - mjcf.geom_size(self.model, "obstacle")[0])

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        x, y = measurement[:, :2].T
        near = np.clip(1 - self.clearance(measurement) / 0.25, 0.0, 1.0)
        # A weight before the pillar, too, would draw the vehicle to one side, wherever it starts.
        off = np.abs(y) * np.where(x < self.obstacle[0], 0.0, 0.3)
        reward = np.maximum(3 - off - near, 0.0)
        # Arriving must pay more than going on.
        reward = np.where(self.ending(measurement) == Outcome.REACHED, 10 * reward, reward)
        return np.where(self.failed(measurement), 0.0, reward)
