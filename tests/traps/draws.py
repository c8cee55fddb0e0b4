"""What is not up to date, draws, clocks, and what outlives an episode: classes that change a `World`."""

import os
import random
import time

import mujoco
import numpy as np

from traps.memories import Looking, Region
from traps.storages import Classwide

# ---- what is not up to date


class Stale(Looking):
    """What it observes is what MuJoCo computed before the last physics step, as after `mj_step`."""

    stale = "site_xpos"

    def place_seen(self):
        if self.stale == "sensordata":
            return self.data.sensordata[:2].copy()
        if self.stale == "xpos":
            return self.data.body("puck").xpos[:2].copy()
        return self.data.site("tip").xpos[:2].copy()

    def sense(self):
        return self.place_seen() + self.sensor_offset


class Forces:
    """It observes contact forces, which only a step of its own computes."""

    def simulate(self):
        super().simulate()
        mujoco.mj_rnePostConstraint(self.model, self.data)

    def sizes(self):
        return {**super().sizes(), "forces": 6}

    def parts(self):
        return {**super().parts(), "forces": np.clip(self.data.body(self.body).cfrc_ext, -1, 1)}

    @property
    def body(self):
        return "arm" if self.plan.turns else "puck"


class Substep(Looking):
    """What it observes of its place was read before the last physics step of its step."""

    def begin(self):
        super().begin()
        self.read_at = super().place()

    def simulate(self):
        for _ in range(self.plan.frame_skip):
            self.read_at = super().place()
            mujoco.mj_step(self.model, self.data)

    def sense(self):
        return self.__dict__.get("read_at", self.place()) + self.sensor_offset


# ---- draws


class Drawn:
    """A reset draws something of the model."""

    drawn = "damping"

    def draw(self):
        super().draw()
        model, rng = self.model, self.np_random
        if self.drawn == "damping":
            model.dof_damping[self.rates] = self.plan.damping * rng.uniform(0.7, 1.4)
        elif self.drawn == "mass":
            model.body("arm" if self.plan.turns else "puck").mass[:] = rng.uniform(0.7, 1.5)
        elif self.drawn == "rock":
            model.geom("rock").pos[1] = self.plan.rock[1] + rng.uniform(-0.1, 0.1)
        elif self.drawn == "friction":
            model.geom_friction[:, 0] = rng.uniform(0.1, 2.0)
        elif self.drawn == "gear":
            model.actuator_gainprm[:, 0] *= rng.uniform(0.95, 1.02)
        elif self.drawn == "wind":
            model.opt.gravity[0] = rng.uniform(-0.5, 0.5)
        elif self.drawn == "timestep":
            usual = self.plan.dt / self.plan.frame_skip
            model.opt.timestep = round(rng.uniform(0.8, 1.0) * usual, 4)


class DrawnGoal:
    """A reset draws the goal."""

    spread = 0.3

    def draw(self):
        super().draw()
        shift = self.np_random.uniform(-self.spread, self.spread, self.plan.dimension)
        goal = np.array(self.plan.goal) + shift * [0.3, 1.0][: len(shift)]
        where = self.plan.goal_in
        if where == "attribute":
            self.target = goal
        elif where == "userdata":
            self.data.userdata[:2] = goal
        elif where == "qpos":
            self.data.qpos[self.goal_at : self.goal_at + 2] = goal
        elif where == "mocap":
            self.data.mocap_pos[self.goal_at, :2] = goal
        elif where == "body":
            self.model.body_pos[self.goal_at, :2] = goal
        else:
            self.model.site_pos[self.goal_at, :2] = goal


class Bias(Looking):
    """A reset draws by how much the sensor is wrong."""

    def draw(self):
        super().draw()
        self.bias = self.np_random.uniform(-0.15, 0.15, self.plan.dimension)

    def sense(self):
        return super().sense() + self.__dict__.get("bias", 0.0)


class Rolling:
    """What moves beside the robot moves already at the start, as drawn or always alike."""

    rolls_as_drawn, rolls_by = True, "speed"

    def draw(self):
        super().draw()
        value = self.np_random.uniform(0.3, 1.2) if self.rolls_as_drawn else 0.8
        if self.rolls_by == "speed":
            self.data.qvel[self.rest] = value
        else:
            goal = range(self.goal_at, self.goal_at + 2) if self.plan.goal_in == "qpos" else ()
            self.data.qpos[[i for i in self.beside if i not in goal]] = 0.4 * value


class Rough(Region, Looking):
    """Steps draw random numbers, everywhere or in a region, for the drive or for the sensor."""

    rough_source, rough_everywhere, rough_on = "np_random", False, "drive"

    def begin(self):
        super().begin()
        self.felt = np.zeros(self.plan.dimension)

    def number(self):
        if self.rough_source == "np_random":
            return self.np_random.uniform(-1, 1)
        if self.rough_source == "numpy":
            return np.random.uniform(-1, 1)
        if self.rough_source == "random":
            return random.uniform(-1, 1)
        if self.rough_source == "late":
            if "late" not in self.__dict__:
                self.late = np.random.default_rng(7)
            return self.late.uniform(-1, 1)
        if self.rough_source == "space":
            return float(np.ravel(self.action_space.sample())[0]) / 4
        if self.rough_source == "urandom":
            return int.from_bytes(os.urandom(4), "little") / 2**31 - 1
        return (time.perf_counter_ns() % 1000) / 500 - 1

    def drive(self, share):
        if self.rough_on == "drive" and (self.rough_everywhere or self.near()):
            share = share * (1 + 0.3 * self.number())
        super().drive(share)

    def remember(self):
        super().remember()
        if self.rough_on == "sensor" and (self.rough_everywhere or self.near()):
            self.felt = np.full(self.plan.dimension, 0.05 * self.number())

    def sense(self):
        return super().sense() + self.__dict__.get("felt", 0.0)


# ---- clocks, and what outlives an episode


class Clock:
    """Something moves with a clock of its own: steps that it counts, or the clock on the wall."""

    clock = "beacon"

    def begin(self):
        super().begin()
        self.ticks, self.begun = 0, time.perf_counter()

    def simulate(self):
        self.ticks += 1
        on_wall = self.clock == "wall"
        passed = 100 * (time.perf_counter() - self.begun) if on_wall else self.ticks * self.plan.dt
        if self.clock == "beacon":
            sway = 0.5 * np.sin(2 * passed)
            self.data.mocap_pos[self.model.body("beacon").mocapid[0], 1] = (
                self.plan.beacon[1] + sway
            )
        else:
            self.model.opt.gravity[0] = 0.6 * np.sin(3 * passed)
        super().simulate()


class Timed:
    """A mocap body moves with MuJoCo's time: no trap."""

    def simulate(self):
        sway = 0.5 * np.sin(2 * self.data.time)
        self.data.mocap_pos[self.model.body("beacon").mocapid[0], 1] = self.plan.beacon[1] + sway
        super().simulate()


class Counting:
    """Counts its steps and notes its last action, for its info alone: no trap."""

    def begin(self):
        super().begin()
        self.elapsed, self.last_action = 0, np.zeros(self.plan.dimension)

    def drive(self, share):
        self.elapsed += 1
        self.last_action = np.array(share)
        super().drive(share)

    def judged(self):
        reward, terminated, truncated, info = super().judged()
        info |= {"elapsed": self.elapsed, "effort": float(np.abs(self.last_action).sum())}
        return reward, terminated, truncated, info


class Surviving:
    """Something outlives the reset: where the next goal is, what was learnt, where the cart was left."""

    survives = "goal"

    def __init__(self):
        super().__init__()
        self.episodes, self.wins, self.learnt, self.left = 0, 0, 0.0, None

    def draw(self):
        super().draw()
        if self.survives == "cart" and self.left is not None:
            self.data.qpos[:] = self.left
        self.episodes += 1

    def remember(self):
        super().remember()
        self.learnt += 0.001
        self.left = self.data.qpos.copy()
        if super().arrived():
            self.wins += 1

    def goal(self):
        goal = super().goal()
        if self.survives == "goal":
            goal = goal + 0.1 * ((self.episodes - 1) % 5)
        if self.survives == "wins":
            goal = goal - 0.05 * min(self.wins, 8)
        return goal

    def drive(self, share):
        weak = 1 / (1 + self.learnt) if self.survives == "learnt" else 1.0
        super().drive(share * weak)


class Ageing:
    """All instances of this process grow weaker with each step of one of them."""

    def drive(self, share):
        age = Classwide.held.get("age", 0) + 1
        Classwide.held["age"] = age
        super().drive(share / (1 + 1e-4 * age))


class Both:
    """Arriving terminates, and so does touching the island."""

    def judged(self):
        reward, terminated, truncated, info = super().judged()
        return reward, terminated or self.arrived(), truncated, info


class Inline:
    """What it observes is computed by no method of a known name."""

    _get_obs = None
