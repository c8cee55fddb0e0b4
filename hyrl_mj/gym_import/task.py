"""A task whose plant is an environment of Gymnasium, as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from hashlib import sha256
from typing import Any, Self

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.attributes import settings_of
from hyrl_mj.gym_import.fingerprint import code_of, differing, is_shared, of_model
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.observations import parts_of
from hyrl_mj.gym_import.plant import EnvironmentPlant
from hyrl_mj.gym_import.pool import Pool
from hyrl_mj.gym_import.stage import Played
from hyrl_mj.gym_import.trials import goes_on
from hyrl_mj.physics import mjcf
from hyrl_mj.tasks import ANY, SPARING, Abilities, Learning, Outcome, Scene, Task, get_task

# Where every episode takes all of its samples, runs from all nodes of the chart take about so many together.
SAMPLES_OF_NODES = 800_000
# A run that turns by less than this decides nothing [rad].
DECIDED = 0.5


class EnvironmentTask(Task):
    """An environment of Gymnasium as a task; `from_gymnasium` makes it.

    Its plant is the environment itself: each episode is played by an instance of it. Noise on a coordinate
    of the chart changes the state at which the innermost environment computes its observation, so that every
    copy of a position in it is changed alike, and its wrappers see what a sensor would have sent.

    A measurement holds the chart point, the observation, the reward, whether the condition of success holds,
    and the outcome.

    Attributes:
        specification: what is known of the environment.
        found: what was filled in, with the reason, by name.
        made_of: what the environment was made of beside its description, to compare it.
    """

    scene: Scene
    effort = SPARING
    _original: Task | None = None
    learning = Learning()

    def __init__(self, pool: Pool, instance: Instance, spec: str, made_of: tuple[Any, ...]):
        self.specification = specification = pool.spec
        self._pool, self._instance, self.made_of = pool, instance, made_of
        self.model, self._memory = instance.model, instance.memory()
        twin, own = Instance(pool.spec), settings_of(instance.env)
        twin.reset()
        # Of any two some are others, such as the time when they were made.
        self._settings = dict(own.items() & settings_of(twin.env).items())
        # What a task and a specification call alike.
        for name in (
            "name", "chart", "inputs", "start_low", "start_high", "max_steps", "dt", "worst_reward",
        ):  # fmt: skip
            setattr(self, name, getattr(specification, name))
        env = specification.description.env
        self.spec, self.env_id = spec, env if isinstance(env, str) else self.name
        self.found = dict(specification.found)
        self.description = f"the environment {self.name}"
        self.input_limits = specification.low, specification.high
        self.abilities = Abilities(
            stopped_by_walls=True,
            restarts=specification.memoryless,
            arrival_ends=specification.criterion.ends,
            side_by_side=128,
        )
        self.noisy = (*specification.noisy, *([0.0] * (specification.columns + 3)))
        self.observation_parts = specification.parts
        self.observation_low = tuple(specification.observation_low)
        self.observation_high = tuple(specification.observation_high)
        self.learning = Learning(levels=specification.levels)
        if not self.abilities.arrival_ends:
            nodes = int((SAMPLES_OF_NODES / self.max_steps) ** (1 / self.chart.dimension))
            self.learning = replace(self.learning, cells=max(nodes, 2))
        if specification.plane:
            first, second = sorted(axis.number for axis in specification.plane)
            self.plane = first, second
        self._set_scene(specification.tracked)

    def is_as_made(self) -> bool:
        """Returns whether a new environment has the model, the settings, and what is shared, as at first."""
        new = Instance(self.specification)
        new.reset()
        changed = differing(new.memory(), self._memory)
        if self._settings.items() - settings_of(new.env).items():
            return False
        return not any(is_shared(name) or name.endswith(" of its model") for name in changed)

    def __reduce__(self) -> tuple[Callable[..., Task], tuple[Any, ...]]:
        return _again, (self.spec, self.noisy, self.sensor, self.sensor_shares)

    def with_noise(self, shares: Sequence[float]) -> Self:
        task = super().with_noise(shares)
        task._original = self  # by which its text is found as long as somebody has this one
        return task

    def _set_scene(self, tracked: str) -> None:
        if self._in_plane:
            self._widen_view()
        starts = self.starts(5, np.random.default_rng(0))
        ways: tuple[str, ...] = ()
        if self.obstacles:
            self.found["ways"] = f"past {', '.join(self.obstacles)}, of walls that touch each other"
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
        shown, seen = self.model.stat, 1.2  # how much such a camera shows, as a share of the extent
        ends = self.where(np.array([self.chart.low, self.chart.high]))
        low, high = ends.min(axis=0), ends.max(axis=0)
        reach = shown.extent * seen / 2
        low = np.minimum(low, shown.center[:2] - reach)
        high = np.maximum(high, shown.center[:2] + reach)
        shown.center[:2], shown.extent = (low + high) / 2, (high - low).max() / seen

    def _camera(self) -> str:
        """Returns the camera of replays: from above on a plane, else the model's first, or the free one."""
        own = [
            n for n in mjcf.names(self.model, mujoco.mjtObj.mjOBJ_CAMERA) if not n.startswith("(")
        ]
        axis = self.model.jnt_axis[self.specification.coordinates[0].joint]
        flat = self._in_plane or abs(axis[2]) > 0.9  # it turns in the plane of the floor
        if "overhead" in own or (flat and not own):
            return "overhead"
        return own[0] if own else "free"

    # ---- the task

    @property
    def _in_plane(self) -> bool:
        """Whether the chart's first two coordinates are a place on the floor."""
        return bool(self.specification.plane) and self.plane == (0, 1)

    @property
    def _turning(self) -> int | None:
        """The coordinate of the chart that turns freely; None if none does."""
        joints = [
            c.joint if c.kind == "qpos" and c.axis is None else None
            for c in self.specification.coordinates
        ]
        free = (i for i, j in enumerate(joints) if j is not None and not self.model.jnt_limited[j])
        return next(free, None)

    @cached_property
    def code(self) -> str:
        digest = sha256(b"".join(of_model(self.model).values()))
        env = self.specification.description.env
        digest.update(code_of(self._instance.env, env).encode())
        for name, setting in sorted(self._settings.items()):
            digest.update(ascii(name).encode() + setting)
        return digest.hexdigest()

    @property
    def observation_dtype(self) -> str:  # type: ignore[override]
        parts = parts_of(self._instance.env.observation_space).values()
        types = {str(part.dtype) for part in parts}
        return types.pop() if len(types) == 1 else ""

    def plant(self, n: int, threads: int = 0) -> Any:
        return EnvironmentPlant(self._pool, self.model, n)

    def tabulating(self, n: int) -> Any:
        return EnvironmentPlant(self._pool, self.model, n, written=True)

    @cached_property
    def kinematic(self) -> bool:
        return False

    @cached_property
    def chart_is_state(self) -> bool:
        """As of other tasks; it is tried out, by runs that begin anew at the chart point of others."""
        spec, can = self.specification, self.abilities
        whole = sorted(c.index for c in spec.coordinates if c.kind == "qpos")
        if whole != list(range(self.model.nq)) or not (can.arrival_ends and can.restarts):
            return False
        return goes_on(self._pool, of_chart=True)

    def verify(self, z0: np.ndarray, runs: Any, rows: Sequence[int] | np.ndarray) -> None:
        starts, d = self.specification.state_at(z0), self.chart.dimension
        inputs, seen = np.clip(runs.u, *self.input_limits), slice(d, d + self.specification.columns)
        played = []
        for i in rows:
            k = int(runs.length[i])
            if not np.isfinite(inputs[:k, i]).all():
                continue
            cut = k == runs.limit[i]
            noise = np.zeros((k + 1, d))
            # What wrappers observed at an end is known where the run went on to it.
            last = k if cut or not self.specification.wrapped else k + 1
            known = runs.noise[:last, i, :d]
            noise[: len(known)] = known
            played.append(
                Played(
                    starts[i],
                    inputs[:k, i],
                    runs.path[: k + 1, i],
                    outcome=int(runs.outcome[i]),
                    cut=cut,
                    observations=runs.measured[:k, i, seen],
                    noise=np.nan_to_num(noise),
                )
            )
        if played:
            self._pool.check(played)

    def at(self, z: np.ndarray) -> np.ndarray:
        rest = np.tile([0.0, 0.0, float(Outcome.RUNNING)], (len(z), 1))
        return np.column_stack([z, self._begun(z)[0], rest])

    def _begun(self, z: np.ndarray) -> Any:
        """Returns what robots at rest at chart points (n, d) observe (n, o), and their depths (n,) [m]."""
        return self._pool.scatter("rest", self.specification.state_at(z))

    def with_z(self, measured: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Returns measurements (n, p) with what a robot at rest at chart points z (n, d) would observe.

        The columns of the observation that do not follow the chart at rest stay as they are.
        """
        d = self.chart.dimension
        changed, found = np.flatnonzero((measured[:, :d] != z).any(axis=1)), measured.copy()
        if len(changed):
            spec, z_now = self.specification, z[changed]
            fitted = spec.at_rest is not None
            seen = spec.terms(z_now) @ spec.at_rest if fitted else self._begun(z_now)[0]
            moves = d + np.flatnonzero(self.specification.moves)
            found[changed[:, None], moves] = seen[:, self.specification.moves]
            found[changed, :d] = z_now
        return found

    def noisy_everywhere(self) -> Self:
        d, columns = self.chart.dimension, len(self.noisy)
        return self.with_noise((True,) * d + (False,) * (columns - d))

    def perturbed(self, measured: np.ndarray, noise: np.ndarray) -> np.ndarray:
        d = self.chart.dimension
        return self.with_z(measured, measured[:, :d] + noise[:, :d])

    def state(
        self, z: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        states = self.specification.state_at(z)
        return states[:, self.specification.qpos], states[:, self.specification.qvel]

    def observation(self, measured: np.ndarray) -> np.ndarray:
        d = self.chart.dimension
        return measured[:, d : d + self.specification.columns]

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.maximum(measurement[:, -3], self.worst_reward)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        return np.rint(measurement[:, -1]).astype(int)

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        return self.specification.criterion.verdict(measurement[:, -2] > 0)

    def arrived(self, z: np.ndarray) -> np.ndarray:
        return np.ones(len(z), dtype=bool)  # its own criterion tells

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.zeros(len(z))

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        return -measurement[:, -3]

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        z = super().starts(n, rng)
        for _ in range(200):
            inside = np.flatnonzero(self._begun(z)[1] > self.specification.depth)
            if not len(inside):
                return z
            z[inside] = super().starts(len(inside), rng)
        raise BadInput(
            f"hardly a start of {self.name} is free of walls: name another chart, or its bounds"
        )

    def where(self, measured: np.ndarray) -> np.ndarray:
        axes = sorted(enumerate(self.specification.plane), key=lambda pair: pair[1].number)
        z = self.z(measured)
        return np.column_stack([axis.world(z[:, i]) for i, axis in axes]) if axes else z[:, :2]

    @property
    def obstacles(self) -> Mapping[str, int]:  # type: ignore[override]
        return self.specification.islands

    @property
    def gives_direction(self) -> bool:
        return not self.obstacles

    def direction(self, path: np.ndarray) -> np.ndarray:
        if self.obstacles:
            return super().direction(path)
        turned = path[-1, :, self._turning] - path[0, :, self._turning]
        return np.where(np.abs(turned) < DECIDED, ANY, (turned > 0).astype(int))


def _again(
    spec: str, noisy: tuple[float, ...], sensor: str, sensor_shares: tuple[float, ...]
) -> Task:
    """Returns the task that a text describes, with its noise, in this or another process."""
    task = get_task(spec).with_noise(noisy)
    task.sensor, task.sensor_shares = sensor, sensor_shares
    return task
