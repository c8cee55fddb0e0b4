"""A task whose plant is an environment of Gymnasium, as it is."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from hashlib import sha256
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj import mjcf
from hyrl_mj.chart import Chart
from hyrl_mj.environments.coordinates import AnyChart, Coordinate, all_names, coordinates
from hyrl_mj.environments.copies import Host
from hyrl_mj.environments.layout import Layout
from hyrl_mj.environments.opening import Source, code_of
from hyrl_mj.environments.plant import EnvironmentPlant
from hyrl_mj.environments.success import FORMS, INFO, Success, success_of
from hyrl_mj.environments.surroundings import (
    Bound,
    bounds_of,
    drawn_goals,
    heeds_options,
    islands_of,
    sampled_runs,
    starts_of,
)
from hyrl_mj.errors import BadInput
from hyrl_mj.tasks import ANY, Learning, Outcome, Scene, Task, get_task

# Samples of an episode of an environment that never ends by itself.
STEPS_WITHOUT_END = 1_000
# Where every episode takes all of its samples, runs from all nodes of the chart take about so many together.
SAMPLES_OF_NODES = 800_000
# Times that starts are drawn again because they are inside of walls.
DRAWS = 200
# Where episodes start.
CHART, RESET = "chart", "reset"
# Copies that are compared with others at the same chart points, for so many steps, under inputs that are held
# for some of them, and how much they may differ.
COMPARED, STEPS_COMPARED, HELD, SAME = 48, 60, 12, 1e-9
# A joint turns in the plane of the floor if its axis is as upright as this, as a cosine.
UPRIGHT = 0.9
# How much a free camera shows, as a share of the extent of a model.
SEEN = 1.2
# A run that turns by less than this decides nothing [rad].
DECIDED = 0.5


class EnvironmentTask(Task):
    """An environment of Gymnasium as a task; `from_gymnasium` makes it.

    Its plant is the environment itself, which many copies take turns in. Noise on a coordinate of the chart
    changes the state at which the environment computes its observation, so that every copy of a position in
    it is changed alike.

    Attributes:
        host: the environment.
        found: what was filled in, with the reason, by name.
    """

    scene: Scene
    slow = stopped_by_walls = True
    learning = Learning()

    def __init__(
        self,
        source: Source,
        chart: AnyChart | None,
        noisy: Sequence[float] | None,
        success: str | None,
        bounds: Mapping[str, tuple[float, float]],
        steps: int | None,
        starts: str,
        spec: str,
    ):
        self.host = Host(source)
        self.name, self.spec = source.name, spec
        self.env_id = source.make if isinstance(source.make, str) else source.name
        self.found: dict[str, str] = {}
        self.description = f"the environment {source.name}"
        self._coordinates = self._charted(chart)
        self.input_limits = self._limits()
        resets = starts_of(self.host)
        runs = sampled_runs(self.host, self._coordinates)
        self._criterion = self._success(success)
        self.arrival_ends = self._criterion.ends
        self._check_goal(resets, runs.moved)
        self._usual = self._at_rest(resets)
        self._measure_bounds(resets, runs.points, dict(bounds), starts)
        self._count(steps)
        self.noisy = self._shares(noisy)
        self.worst_reward = min(runs.worst_reward, 0.0)
        self.inputs = self._input_names()
        self._islands = islands_of(self.host, runs.points[:, :2]) if self._in_plane else {}
        self._set_scene(runs.farthest)

    def __reduce__(self) -> tuple[Callable[..., Task], tuple[Any, ...]]:
        return _again, (self.spec, self.noisy)

    # ---- what was filled in

    def _charted(self, chart: AnyChart | None) -> tuple[Coordinate, ...]:
        if chart is not None:
            return coordinates(self.host, chart)
        space = self.host.env.observation_space
        if isinstance(space, spaces.Dict) and "achieved_goal" in space.spaces:
            proposed: AnyChart = "achieved_goal"
        else:
            proposed = [f"qpos[{i}]" for i in range(min(self.host.model.nq, 2))]
        found = coordinates(self.host, proposed)
        names = [c.described() for c in found]
        chosen = (
            f"{proposed} ({', '.join(names)})" if isinstance(proposed, str) else ", ".join(names)
        )
        others = [name for name in all_names(self.host) if name not in (*names, proposed)]
        self.found["chart"] = f"{chosen}; others are {', '.join(others[:12])}"
        return found

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        space = self.host.env.action_space
        if isinstance(space, spaces.Discrete):
            self.learning = Learning(levels=int(space.n))
            return np.zeros(1), np.array([float(space.n - 1)])
        assert isinstance(space, spaces.Box)
        return np.ravel(space.low).astype(float), np.ravel(space.high).astype(float)

    def _success(self, success: str | None) -> Success:
        if success is None:
            if self.host.success_key is None:
                raise BadInput(
                    f"{self.name} does not tell in its info when it succeeds: say so with success, as {FORMS}"
                )
            success = INFO
            self.found["success"] = f'info["{self.host.success_key}"]; or give {FORMS}'
        return success_of(self.host, success)

    def _check_goal(self, resets: np.ndarray, moved: np.ndarray) -> None:
        """Raises `BadInput` if resets draw a goal that nothing pins."""
        source = self.host.source
        names = drawn_goals(self.host, resets, moved)
        for c in self._coordinates:
            if (pinned := f"{c.kind}[{c.index}]") in source.pinned:
                raise BadInput(
                    f"{pinned} is the coordinate {c.name} of the chart, where runs begin anywhere: leave "
                    "it out of what is pinned, or name another chart"
                )
        if source.reset and not heeds_options(self.host):
            draws = f", which draws {', '.join(names)}" if names else ""
            raise BadInput(
                f"the options of reset {dict(source.reset)} change nothing in {self.name}{draws}: name the "
                "options as its reset does"
            )
        if not names:
            return
        if not source.pins:
            how = 'with options of reset as {"reset": {"goal_cell": [6, 6]}}'
            if positions := {name: 0.1 for name in names if name.startswith("qpos[")}:
                how = f"with values as {json.dumps({'pinned': positions})}"
            raise BadInput(
                f"each reset of {self.name} draws {', '.join(names)}, and what is to be done depends on it: "
                f'pin it, {how}, or as the reset with a seed draws it as {{"seed": 0}}'
            )
        given = f" and {dict(source.reset)}" if source.reset else ""
        pinned = f", with {dict(source.pinned)}" if source.pinned else ""
        self.found["goal"] = (
            f"{', '.join(names)} as the reset with seed {source.first}{given} draws it{pinned}"
        )

    def _at_rest(self, resets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns state and memory of the base, with the usual positions and at rest."""
        model = self.host.model
        usual = np.median(resets, axis=0)
        self.host.write(*self.host.base)
        self.host.data.qpos[:], self.host.data.qvel[:] = usual[: model.nq], 0.0
        state, memory = self.host.read()
        self.host.write(*self.host.base)
        return state, memory

    def _measure_bounds(
        self,
        resets: np.ndarray,
        runs: np.ndarray,
        given: dict[str, tuple[float, float]],
        starts: str,
    ) -> None:
        chosen = self._coordinates
        names = [c.name for c in chosen]
        for name in given:
            if name not in names:
                raise BadInput(
                    f"bounds for {name} cannot be used: the chart has {', '.join(names)}"
                )
        where = [c.index + (c.kind == "qvel") * self.host.model.nq for c in chosen]
        begun = resets[:, where] + [c.offset for c in chosen]
        bounds: list[Bound] = bounds_of(self.host, chosen, np.vstack([runs, begun]), given)
        self.found["bounds"] = ", ".join(
            f"{c.name} {b.low:.3g} to {b.high:.3g} (from {b.why})"
            for c, b in zip(chosen, bounds, strict=True)
        )
        low, high = tuple(b.low for b in bounds), tuple(b.high for b in bounds)
        units = tuple(c.unit for c in chosen)
        self.chart = Chart(tuple(names), units, low, high, tuple(b.periodic for b in bounds))
        first, last = begun.min(axis=0), begun.max(axis=0)
        self.start_low, self.start_high = low, high
        if starts == RESET:
            self.start_low = tuple(np.clip(first, low, high).tolist())
            self.start_high = tuple(np.clip(last, low, high).tolist())
        resets_lead_to = ", ".join(
            f"{n} {a:.3g} to {b:.3g}" for n, a, b in zip(names, first, last, strict=True)
        )
        self.found["starts"] = (
            f"all over the chart; with {RESET!r} where resets lead to: {resets_lead_to}"
        )

    def _count(self, steps: int | None) -> None:
        self.max_steps = steps or self.host.steps or STEPS_WITHOUT_END
        self.found["sample time"] = f"{self.dt:g} s, of a step"
        if steps is None:
            self.found["steps"] = f"{self.max_steps} ({self.max_steps * self.dt:g} s) of an episode"
        if not self.arrival_ends:
            nodes = SAMPLES_OF_NODES / self.max_steps
            self.learning = replace(
                self.learning, cells=max(int(nodes ** (1 / self.chart.dimension)), 2)
            )

    def _shares(self, noisy: Sequence[float] | None) -> tuple[float, ...]:
        chosen = self._coordinates
        if noisy is None:
            noisy = [float(c.kind == "qpos") for c in chosen]
            on = ", ".join(c.name for c in chosen if c.kind == "qpos")
            self.found["noise"] = (
                f"on {on}, in the unit of each; or give the share of each with noisy"
            )
        if len(noisy) != len(chosen):
            raise BadInput(
                f"noisy has {len(noisy)} share(s), and the chart {len(chosen)} coordinate(s) "
                f"({', '.join(c.name for c in chosen)}): give one for each"
            )
        return (*(float(share) for share in noisy), *([0.0] * sum(self.layout.sizes[1:])))

    def _input_names(self) -> tuple[str, ...]:
        model, m = self.host.model, len(self.input_limits[0])
        names = [model.actuator(i).name.rpartition("/")[2] for i in range(model.nu)]
        return (
            tuple(names)
            if len(names) == m and all(names)
            else tuple(f"action[{i}]" for i in range(m))
        )

    def _set_scene(self, tracked: str) -> None:
        if self._in_plane:
            self._widen_view()
        starts = self.starts(5, np.random.default_rng(0))
        ways: tuple[str, ...] = ()
        if self._islands:
            self.found["ways"] = f"past {', '.join(self._islands)}, of walls that touch each other"
        elif (turning := self._turning) is not None:
            ways = "clockwise", "counter-clockwise"
            self.found["ways"] = f"{self.chart.names[turning]} turns one way or the other"
        else:
            raise BadInput(
                f"nothing is decided on the chart {', '.join(self.chart.names)} of {self.name}, which has no "
                "walls that can be passed on both sides and no joint that turns freely: name another chart, "
                "if there is a decision elsewhere"
            )
        self.scene = Scene(
            starts=tuple(map(tuple, starts.tolist())),
            time=min(self.max_steps * self.dt, 20.0),
            mode_names=ways,
            title=self.name,
            camera=self._camera(),
            tracked=tracked or "tracked",
        )
        self.found["camera"] = f"{self.scene.camera}, with the path of {self.scene.tracked}"

    def _widen_view(self) -> None:
        """Lets the free cameras see all of a chart in the plane."""
        shown = self.model.stat
        low, high = np.array(self.chart.low[:2]), np.array(self.chart.high[:2])
        reach = shown.extent * SEEN / 2
        low = np.minimum(low, shown.center[:2] - reach)
        high = np.maximum(high, shown.center[:2] + reach)
        shown.center[:2], shown.extent = (low + high) / 2, (high - low).max() / SEEN

    def _camera(self) -> str:
        """Returns the camera of replays: from above on a plane, else the model's first, or the free one."""
        own = [
            n for n in mjcf.names(self.model, mujoco.mjtObj.mjOBJ_CAMERA) if not n.startswith("(")
        ]
        axis = self.model.jnt_axis[self._coordinates[0].joint]
        flat = self._in_plane or abs(axis[2]) > UPRIGHT
        if "overhead" in own or (flat and not own):
            return "overhead"
        return own[0] if own else "free"

    # ---- the task

    @cached_property
    def layout(self) -> Layout:
        """What a measurement holds."""
        return Layout(
            self.host, self._coordinates, self._criterion, self._usual, *self.input_limits
        )

    @property
    def _in_plane(self) -> bool:
        """Whether the chart's first two coordinates are a place."""
        first = self._coordinates[:2]
        return len(first) == 2 and all(c.unit == "m" for c in first)

    @property
    def _turning(self) -> int | None:
        """The coordinate of the chart that turns freely; None if none does."""
        return next((i for i, wraps in enumerate(self.chart.periodic) if wraps), None)

    @cached_property
    def model(self) -> Any:
        return self.host.model

    @cached_property
    def code(self) -> str:
        digest = sha256()
        for name in ("qpos0", "body_mass", "geom_size", "geom_pos", "site_pos", "actuator_gear"):
            digest.update(np.ascontiguousarray(getattr(self.model, name)).tobytes())
        digest.update("".join(code_of(self.host.env)).encode())
        return digest.hexdigest()

    @cached_property
    def dt(self) -> float:
        """Time of a step [s]."""
        self.host.write(*self.host.base)
        before = self.host.data.time
        self.host.step(self.host.drawn(np.random.default_rng(0)))
        passed = self.host.data.time - before
        self.host.write(*self.host.base)
        return round(float(passed), 9)

    @cached_property
    def observation_parts(self) -> Mapping[str, int]:  # type: ignore[override]
        space = self.host.env.observation_space
        if not isinstance(space, spaces.Dict):
            return {}
        return {key: spaces.flatdim(part) for key, part in sorted(space.spaces.items())}

    @cached_property
    def observation_dtype(self) -> str:  # type: ignore[override]
        space = self.host.env.observation_space
        parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
        types = {str(part.dtype) for part in parts}
        return types.pop() if len(types) == 1 else ""

    @cached_property
    def observation_low(self) -> tuple[float, ...]:  # type: ignore[override]
        return tuple(self._flat_limits("low"))

    @cached_property
    def observation_high(self) -> tuple[float, ...]:  # type: ignore[override]
        return tuple(self._flat_limits("high"))

    def _flat_limits(self, end: str) -> np.ndarray:
        space = self.host.env.observation_space
        parts = (
            [space.spaces[key] for key in sorted(space.spaces)]
            if isinstance(space, spaces.Dict)
            else [space]
        )
        return np.concatenate([np.ravel(getattr(part, end)) for part in parts]).astype(float)

    def plant(self, n: int, threads: int = 0) -> Any:
        return EnvironmentPlant(self.host, self.layout, n)

    @cached_property
    def kinematic(self) -> bool:
        return False

    @cached_property
    def chart_is_state(self) -> bool:
        """As of other tasks; it is tried out, by copies that are made anew at the chart point of others."""
        chart, whole = self._coordinates, list(range(self.model.nq))
        if sorted(c.index for c in chart if c.kind == "qpos") != whole or not self.arrival_ends:
            return False
        rng = np.random.default_rng(0)
        plant, fresh = self.plant(COMPARED), self.plant(COMPARED)
        plant.set_state(*self.state(self.starts(COMPARED, rng)))
        for k in range(STEPS_COMPARED):
            if k % HELD == 0:
                u = rng.uniform(*self.input_limits, (COMPARED, len(self.inputs)))
            before = plant.measurement
            goes_on = np.flatnonzero(self.ending(before) == Outcome.RUNNING)
            fresh.set_state(*self.state(self.z(before)))
            plant.step(u[goes_on], goes_on)
            fresh.step(u[goes_on], goes_on)
            a, b = (self._told(copies.measurement[goes_on]) for copies in (plant, fresh))
            if not np.allclose(a, b, rtol=0, atol=SAME, equal_nan=True):
                return False
        return True

    def _told(self, measurement: np.ndarray) -> np.ndarray:
        """Returns of measurements (k, p) what a game and a controller look at: (k, ...)."""
        observed = self.layout.parts(measurement)[3]
        return np.column_stack([self.z(measurement), observed, self.ending(measurement)])

    def at(self, z: np.ndarray) -> np.ndarray:
        (state, memory), n = self._usual, len(z)
        states = np.tile(state, (n, 1))
        # Not the state at z: what differs from the chart point is observed anew, at the chart point.
        states[:, self.layout.of_chart] = z - self.layout.offset + 1.0
        report = np.zeros((n, self.host.width + 5))
        running = np.full((n, 1), float(Outcome.RUNNING))
        return np.column_stack([z, states, np.tile(memory, (n, 1)), report, running])

    def state(
        self, z: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        state = np.tile(self._usual[0], (len(z), 1))
        state[:, self.layout.of_chart] = z - self.layout.offset
        return state[:, self.layout.qpos], state[:, self.layout.qvel]

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return self.layout.observation(measured)

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.maximum(self.layout.report(measurement).reward, self.worst_reward)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        return np.rint(measurement[:, -1]).astype(int)

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        holds = self._criterion.holds(self.layout.report(measurement))
        return np.where(holds & ~self._criterion.ends, Outcome.REACHED, Outcome.STALLED)

    def arrived(self, z: np.ndarray) -> np.ndarray:
        return np.ones(len(z), dtype=bool)  # its own criterion tells

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.zeros(len(z))

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        return -self.layout.report(measurement).reward

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        z = super().starts(n, rng)
        for _ in range(DRAWS):
            plant = self.plant(n)
            plant.set_state(*self.state(z))
            inside = np.flatnonzero(self.ending(plant.measurement) != Outcome.RUNNING)
            if not len(inside):
                return z
            z[inside] = super().starts(len(inside), rng)
        raise BadInput(
            f"hardly a start of {self.name} is free of walls: name another chart, or its bounds"
        )

    @property
    def obstacles(self) -> dict[str, int]:
        return self._islands

    @property
    def gives_direction(self) -> bool:
        return not self._islands

    def direction(self, path: np.ndarray) -> np.ndarray:
        if self._islands:
            return super().direction(path)
        turned = path[-1, :, self._turning] - path[0, :, self._turning]
        return np.where(np.abs(turned) < DECIDED, ANY, (turned > 0).astype(int))


def _again(spec: str, noisy: tuple[float, ...]) -> Task:
    """Returns the task that a text describes, with shares of the noise (p,), in this or another process."""
    return get_task(spec).with_noise(noisy)
