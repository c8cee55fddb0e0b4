"""Checks that a task is complete and consistent, before anything is trained."""

import re
from collections.abc import Iterator
from contextlib import suppress
from difflib import get_close_matches
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj.errors import LARGEST_NUMBER, BadInput, brief, line_in, listed
from hyrl_mj.physics import memory, mjcf, mujoco_log
from hyrl_mj.ranges import Flag, Integer, Number, OneOf, Optional, Rule, Several, Text
from hyrl_mj.sets import MOST_DIMENSIONS, Chart
from hyrl_mj.tasks import trial
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import SEARCHES, Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.guard import unguarded
from hyrl_mj.tasks.mirrored import try_mirror
from hyrl_mj.tasks.obstacles import SIDES

# Number of starts that are tried, and of places at which robot and obstacles may overlap.
STARTS, OVERLAPS = 64, 512
LONGEST = 3_600  # time that is shown [s]
# What the values of a task's attributes may be.
RULES: dict[str, Rule] = {
    "max_steps": Integer(1, 100_000),
    "worst_reward": Number(-1e9, 1e9),
    "precision": Number(0, np.inf, above=True),
    "close": Number(0, np.inf, above=True),
    "steady_control": Flag(),
    "inputs": Several(Text(), 1, 100),
    "input_units": Several(Text(), 0, 100),
    "scene.time": Number(0, LONGEST, above=True),
    "learning.search": OneOf(SEARCHES),
    "learning.horizon": Number(0, LONGEST, above=True),
    "learning.cells": Optional(Integer(2, 10**6)),
    "learning.levels": Optional(Integer(1, 1_000)),
}
# What is computed of a task, so that a method or an attribute of that name means something else.
COMPUTED = (
    "dt", "measurement_columns", "has_inner_loop", "gives_direction", "kinematic", "chart_is_state",
    "obstacles", "plant", "placed", "tabulating", "verify", "draw_inputs", "check_measurement", "check_noise",
    "at", "perturbed", "outcome", "failed", "goes_on", "noise_in_chart", "noise_on", "noisy_everywhere",
    "with_noise", "with_sensor", "sensor_shares", "moves", "ends_well", "tells_arrival", "input_levels",
    "code", "spec",
)  # fmt: skip


def check_task(task: Task, played: bool = True) -> Task:
    """Returns the task itself, if it can be trained; episodes that are `played` take longest to check.

    Raises:
        BadInput: it cannot; the message names the file, the mistake, and the remedy.
    """
    where = task.source or task.name
    try:
        _check_names(task)
        _check_parts(task)
        _check_training(task)
        _check_model(task)
        if not task.gives_direction:
            _check_ways(task)
        _check_starts(task)
        if played:
            _check_episodes(task)
    except BadInput as error:
        raise BadInput(f"the task of {where} cannot be used: {error}") from error
    except (Exception, SystemExit) as error:  # whatever its own methods raise
        line = line_in(error, task.source)
        raise BadInput(f"the task of {where} cannot be used: {brief(error)}{line}") from error
    return task


def overlooked(task: Task) -> str:
    """Returns where `ending` lets a robot go on that is in the middle of an obstacle; "" if nowhere.

    That is where a geom of the robot is as deep inside of one whose name begins with "obstacle" as it is
    wide. Where contacts only stop a robot no episode comes to such places.
    """
    model = task.model
    obstacles = [model.geom(name).id for name in mjcf.obstacles(model)]
    moves = model.body_weldid[model.geom_bodyid] != 0
    meets = model.geom_contype | model.geom_conaffinity  # what only shows meets nothing
    own = np.setdiff1d(np.flatnonzero(moves & (meets != 0)), obstacles)
    if not obstacles or not len(own) or task.abilities.stopped_by_walls:
        return ""
    z = task.chart.draw(OVERLAPS, np.random.default_rng(0))
    plant, data = task.placed(z), mujoco.MjData(model)
    for i in np.flatnonzero(task.ending(plant.measurement) == Outcome.RUNNING):
        mjcf.place(model, data, plant.qpos[i], task.mocap)
        for geom in own:
            width = model.geom_size[geom][model.geom_size[geom] > 0].min(initial=np.inf)
            for obstacle in obstacles:
                deep = -mujoco.mj_geomDistance(model, data, geom, obstacle, 0.0, None)
                if deep >= width:
                    name = model.geom(geom).name or f"geom {geom}"
                    at = ", ".join(
                        map("{} {:.3g} {}".format, task.chart.names, z[i], task.chart.units)
                    )
                    return (
                        f"ending() lets a robot go on whose {name} is {deep:.2g} m inside of "
                        f"{model.geom(obstacle).name}, as at {at}: if it is to pass this obstacle, let the "
                        "episode end there"
                    )
    return ""


def torn(task: Task) -> str:
    """Returns where `state` puts a robot that an equality constraint then pulls together; "" if nowhere."""
    model, chart, found = task.model, task.chart, []
    if type(task).plant is not Task.plant or not model.neq:
        return ""
    z, data = chart.draw(STARTS, np.random.default_rng(0)), mujoco.MjData(model)
    z = z[task.goes_on(z)]
    for point, qpos in zip(z, task.placed(z).qpos, strict=True):
        mjcf.place(model, data, qpos, task.mocap)
        mujoco.mj_fwdPosition(model, data)
        off = np.abs(data.efc_pos[: data.ne])
        if off.max(initial=0.0) > 0.01:  # [m, rad]; soft ones give a little
            found.append((float(off.max()), int(data.efc_id[off.argmax()]), chart.format(point)))
    if not found:
        return ""
    most, number, where = max(found)
    name = model.equality(number).name or f"equality constraint {number}"
    return (
        f"state() puts the robot where {name} is off by {most:.2g} (m or rad), as at {where}: MuJoCo pulls "
        "it together in the first samples, and moves it by that; let state() give the positions of all "
        "joints that belong to the chart point"
    )


def jumped_over(task: Task) -> str:
    """Returns where a robot jumps between two samples over what would end its episode; "" if nowhere.

    That is a wall or a post: as far to the left of the middle of it as a sample leads there is the same as to
    the right. Beside a corner that is cut, or a round obstacle that is grazed, one side is free.
    """
    if type(task).plant is not Task.plant:
        return ""
    rng, chart = np.random.default_rng(0), task.chart
    z = chart.draw(4 * OVERLAPS, rng)
    z = z[task.goes_on(z)]
    plant, u = task.placed(z, rng), task.draw_inputs(len(z), rng)
    with mujoco_log.kept(), suppress(BadInput):  # beside its chart a robot may be nowhere
        for _ in range(10):  # samples, in which most runs come past something
            before = plant.measurement
            plant.step(u)
            after = plant.measurement
            on = (task.ending(before) == Outcome.RUNNING) & ~task.failed(after) & ~plant.unstable
            z, seen = task.z(before)[on], after[on]
            hop = chart.difference(task.z(seen), z)
            for share in np.linspace(0, 1, 11)[1:-1]:
                middle = z + share * hop
                hit = np.flatnonzero(task.failed(task.with_z(seen, middle)))
                for row in hit[_is_thin(task, seen[hit], middle[hit], hop[hit])]:
                    return (
                        f"between two samples {task.name} jumps over what ends an episode, as from "
                        f"{chart.format(z[row])} to {chart.format((z + hop)[row])}: ending() sees it at "
                        "samples alone, so make that wider, or the sample time shorter"
                    )
    return ""


def _is_thin(task: Task, seen: np.ndarray, z: np.ndarray, hop: np.ndarray) -> np.ndarray:
    """Returns whether both or neither of the sides fail, a hop (n, d) away from failures z: (n,) bool."""
    thin, scale = np.ones(len(z), dtype=bool), np.array(task.chart.scale)
    way = np.linalg.norm(hop / scale, axis=1, keepdims=True)
    along = hop / scale / np.maximum(way, 1e-12)
    for axis in np.eye(len(scale)):
        across = axis - along * (along @ axis)[:, None]
        size = np.linalg.norm(across, axis=1, keepdims=True)
        aside = way * scale * across / np.maximum(size, 1e-12)
        left, right = (task.failed(task.with_z(seen, z + side)) for side in (aside, -aside))
        thin &= (left == right) | (size[:, 0] < 0.5)  # mostly along it
    return thin & (way[:, 0] > 0)


def hidden_goal(task: Task, eps: float, everywhere: bool = False) -> str:
    """Returns why noise of a bound may lose a robot at the set-point, whatever way it goes; "" if not.

    Where the set-point is measured the robot is up to the noise away from it. There it may be shown what it
    likes least, and goes on for a sample.
    """
    if type(task).verdict is not Task.verdict or task.ends_well:  # it need not stay there
        return ""
    chart, rng = task.chart, np.random.default_rng(0)
    noise = task.noise_in_chart(1.0, everywhere)
    box = rng.uniform(-1, 1, (OVERLAPS, chart.dimension))
    box[::2] = np.sign(box[::2])  # its corners, too
    goal = task.set_point
    if goal is None:
        z = chart.draw(OVERLAPS, rng)
        for share in (0.1, 0.01, 0.001):  # of the chart's sides
            goal = z[task.miss(z).argmin()]
            z = np.vstack([goal, goal + share * chart.sides * box])
    goal = np.asarray(goal)
    plant = task.plant(len(box))
    u = np.where(rng.random((len(box), len(task.inputs))) < 0.5, *task.input_limits)

    def farthest(bound: float, moves: bool = True) -> float:
        z = chart.wrap(goal + bound * noise * box)
        if moves:  # from the state in which a robot is put there, with inertia at rest
            plant.set_state(*task.state(z))
            plant.step(u)
            z = task.z(plant.measurement)
        return float(task.miss(z).max())

    if (most := farthest(eps)) <= task.close:
        return ""
    kept = [bound for bound in np.linspace(0, eps, 101) if farthest(bound) <= task.close]
    less = f", or noise of at most {_rounded(max(kept), np.floor):g}" if kept else ""
    return (
        f"{task.name} has arrived up to {task.close:g} from its set-point (close), and noise of {eps:g} "
        f"alone hides up to {farthest(eps, False):.3g} of that, and {most:.3g} with what it moves in "
        "one sample: there it may be lost whatever way it has gone. Give it a close of at least "
        f"{_rounded(most, np.ceil):g}{less}"
    )


def _rounded(x: float, way: np.ufunc) -> float:
    """Returns a number > 0 with two digits, the next one above (np.ceil) or below (np.floor)."""
    unit = 10.0 ** (np.floor(np.log10(x)) - 1) if x else 1.0
    return float(way(x / unit) * unit)


def _check_names(task: Task) -> None:
    """Raises `BadInput` if a user's task has a name of its own for what the package computes."""
    for name in unguarded(task):
        raise BadInput(
            f"its {name} is no method of its class, or was put there later: define it there, as "
            f"def {name}(self, ...)"
        )
    own = (kind for kind in type(task).__mro__ if not kind.__module__.startswith("hyrl_mj."))
    names = {name for kind in own for name in vars(kind)}
    if task.source is not None and (taken := sorted(names.intersection(COMPUTED))):
        raise BadInput(
            f"it defines {', '.join(taken)}, which hyrl_mj computes and asks for: give it another name"
        )
    if task.source is None or not task.source.is_file():
        return
    said, asked_for = task.source.read_text(encoding="utf-8", errors="replace"), [*_public(Task)]
    for name in sorted(names.difference(asked_for)):
        if name.startswith("_") or len(re.findall(rf"\b{re.escape(name)}\b", said)) > 1:
            continue
        if meant := get_close_matches(name, asked_for, 1, 0.85):
            raise BadInput(
                f"it defines {name}, which nothing uses: if {meant[0]} is meant, call it so, or leave it out"
            )


def _public(kind: type) -> Iterator[str]:
    """Yields the names of what a class has, or only declares, but for those that begin with "_"."""
    yield from (name for name in {*dir(kind), *kind.__annotations__} if not name.startswith("_"))


def _check_parts(task: Task) -> None:
    if missing := [name for name in Task.__annotations__ if not hasattr(task, name)]:
        raise BadInput(f"it has no {', '.join(missing)}: add what is missing")
    # What is found out about one task would be said of another.
    if type(task).__eq__ is not object.__eq__:
        raise BadInput(
            "its class says which tasks are equal (a dataclass, or __eq__): leave that out, as "
            "@dataclass(eq=False) does"
        )
    for name, kind in (("chart", Chart), ("scene", Scene), ("learning", Learning)):
        if not isinstance(value := getattr(task, name), kind):
            raise BadInput(f"{name} is {value!r}: give a hyrl_mj.{kind.__name__}(...)")
    if not re.fullmatch(r"\w[\w.-]*", str(task.name)):
        raise BadInput(f"its name is {task.name!r}: give letters, digits and _, as my_robot")
    for name, rule in RULES.items():
        rule.checked(name, attrgetter(name)(task))
    if len(set(task.inputs)) < len(task.inputs):
        raise BadInput(f"inputs is {task.inputs}: name each once")
    chart, d = task.chart, task.chart.dimension
    if d > MOST_DIMENSIONS:
        raise BadInput(
            f"its chart has {d} coordinates ({', '.join(chart.names)}): give at most {MOST_DIMENSIONS}, "
            "those in which the decision is made; the measurement may have more"
        )
    for name in ("units", "low", "high", "periodic", "scale"):
        if (count := np.size(getattr(chart, name))) != d:
            raise BadInput(f"its chart has {d} name(s) and {count} value(s) of {name}: give {d}")
    if len(set(chart.names)) < d or not all(isinstance(name, str) for name in chart.names):
        raise BadInput(
            f"its chart has the names {chart.names}: give each coordinate a text of its own"
        )
    if not (np.isfinite(chart.sides).all() and (chart.sides > 0).all()):
        raise BadInput("its chart has a side that is not positive: give low < high, both finite")
    if not (np.isfinite(chart.scale).all() and np.greater(chart.scale, 0).all()):
        raise BadInput(f"its chart has the scale {chart.scale}: give finite numbers > 0")
    for name in ("start_low", "start_high"):
        Several(Number(-LARGEST_NUMBER, LARGEST_NUMBER), d, d).checked(name, _plain(task, name))
    if np.greater(task.start_low, task.start_high).any():
        raise BadInput("start_low is greater than start_high: exchange them")
    if task.set_point is not None:
        _check_shape("set_point has", task.set_point, (d,))
        if not np.isfinite(task.set_point).all():
            raise BadInput(f"set_point is {task.set_point}: give finite numbers")
    low, high = np.array(task.observation_low), np.array(task.observation_high)
    if low.ndim != 1 or low.shape != high.shape or not len(low) or not (low < high).all():
        raise BadInput(
            f"observation_low is {task.observation_low} and observation_high {task.observation_high}: give "
            "as many numbers each as observation() has columns, the lower ones first"
        )
    _check_scene(task)
    shares = _plain(task, "noisy")
    if isinstance(shares, list | tuple):
        shares = [float(one) if isinstance(one, bool | np.bool_) else one for one in shares]
    if not any(Several(Number(0, 1e6), d, 1_000).checked("noisy", shares)):
        raise BadInput(
            f"noisy is {task.noisy}: give a share > 0 of the noise bound for one column or more"
        )
    # Tables and figures give the bound as the noise of the coordinates with share 1.
    if task.source is not None and 1 not in shares[:d]:
        remedy = "let the chart hold a column of the measurement on which noise acts"
        if most := max(shares[:d]):
            remedy = f"divide it by {most:g}, and give an eps that is {most:g} times as large"
        raise BadInput(
            f"noisy is {task.noisy}, so that --eps is the noise of none of {listed(chart.names)}: {remedy}"
        )


def _plain(task: Task, name: str) -> Any:
    """Returns an attribute of a task, an array as a list."""
    value = getattr(task, name)
    return value.tolist() if isinstance(value, np.ndarray) else value


def _check_scene(task: Task) -> None:
    scene = task.scene
    if not len(scene.starts):
        raise BadInput("scene.starts is empty: name a chart point from which a replay starts")
    for start in (*scene.starts, *scene.policy_starts):
        task.chart.check(start, task.name)
    names = scene.mode_names
    if not names and not task.gives_direction:  # named after the obstacles
        return
    if isinstance(names, str) or len(names) < 2 or not all(isinstance(n, str) for n in names):
        raise BadInput(f"scene.mode_names is {names!r}: name two or more")
    if not task.gives_direction and tuple(name.lower() for name in names) == SIDES[::-1]:
        raise BadInput(
            f"scene.mode_names is {names!r}, and mode 0 passes the obstacle on its left: exchange them"
        )


def _check_training(task: Task) -> None:
    if task.input_units and len(task.input_units) != len(task.inputs):
        raise BadInput(
            f"input_units has {len(task.input_units)} value(s), and there are {len(task.inputs)} input(s): "
            "give one each, or none"
        )
    levels, most = task.learning.levels, 1_000
    if levels is not None and not 2 <= levels ** len(task.inputs) <= most:
        raise BadInput(
            f"{levels} levels of each of {len(task.inputs)} input(s) cannot be used: give 2 or "
            f"more, with at most {most:,} combinations, or none"
        )
    if task.mirror is not None and not isinstance(task.mirror, Mirror):
        raise BadInput(f"mirror is {task.mirror!r}: give a hyrl_mj.Mirror(...), or None")
    if task.mirror is not None:
        counts = {"observation": len(task.observation_low), "inputs": len(task.inputs)}
        for name, count in counts.items():
            signs = getattr(task.mirror, name)
            if len(signs) != count or not set(signs) <= {-1, 1}:
                raise BadInput(f"mirror.{name} is {signs}: give {count} values, each 1 or -1")


def _check_model(task: Task) -> None:
    model, path = task.model, task.model_path
    if task.source is not None and mjcf.origin(model) is None and not path.is_file():
        raise BadInput(
            f"there is no {path}, by which a run knows its robot: write the MJCF there, as "
            "MjSpec.to_xml() gives it, or load a file by hyrl_mj.mjcf.load"
        )
    if not model.nu:
        raise BadInput(f"{path.name} has no actuators: give the policy at least one to drive")
    if type(task).state is Task.state and model.nq != (d := task.chart.dimension):
        raise BadInput(
            f"its chart has {d} coordinate(s), and {path.name} {model.nq} positions of joints (qpos): give "
            "the task a state(z, rng) that returns them all"
        )
    low, high = task.input_limits
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise BadInput(
            f"its input limits are {low} and {high} in {path.name}: give finite ones, low < high"
        )
    if type(task).mocap is not Task.mocap and not model.nmocap:
        raise BadInput(
            f'it has a mocap() and {path.name} has no mocap body: give a body of the world mocap="true"'
        )
    # The replay needs both.
    mjcf.point_of(model, task.scene.tracked)
    mjcf.camera_of(model, task.scene.camera)
    for name in ("key_qpos", "key_qvel", "key_ctrl", "body_mass", "body_inertia"):
        if not np.isfinite(getattr(model, name)).all():
            raise BadInput(f"{name} in {path.name} has values that are not finite: give numbers")
    for name, value in (("timestep", model.opt.timestep), ("sample_time", task.dt)):
        Number(0, LONGEST, above=True).checked(f"{name} in {path.name}", value)
    if (steps := mjcf.substeps(model)) > (most := 5_000):
        raise BadInput(
            f"its sample time {task.dt:g} s takes {steps:,.0f} physics steps of {model.opt.timestep:g} s in "
            f"{path.name}: give at most {most:,}"
        )
    if problem := memory.unusable(model):
        raise BadInput(problem)


def _check_starts(task: Task) -> None:
    d, p = task.chart.dimension, task.measurement_columns
    z = task.starts(STARTS, np.random.default_rng(0))
    _check_shape(f"starts({STARTS}) gives", z, (STARTS, d))
    if not np.array_equal(z, task.starts(STARTS, np.random.default_rng(0))):
        raise BadInput(
            "starts() draws other starts from a generator of the same seed: let it draw from that alone"
        )
    if type(task).plant is Task.plant:  # a reset may take long
        rng = np.random.default_rng(5)
        alone = np.vstack([task.starts(1, rng) for _ in range(STARTS)])
        if (held := np.flatnonzero((np.ptp(alone, axis=0) == 0) & (np.ptp(z, axis=0) > 0))).size:
            raise BadInput(
                f"starts(1) gives {task.chart.names[held[0]]} = {alone[0, held[0]]:.4g} each time, and "
                f"starts({STARTS}) others, too: draw each start by itself from the generator"
            )
    outside = z[~task.chart.contains(z)]
    if len(outside):
        point = task.chart.format(outside[0])
        raise BadInput(f"it starts outside its chart, at {point}: change one of them")
    drawn = _check_box(task)
    plant = task.placed(z, np.random.default_rng(1))
    moves = task.model.nkey and task.model.key_qvel[0].any()
    if type(task).plant is Task.plant and moves and task.state(z)[1] is None:
        raise BadInput(
            f"the first keyframe in {task.model_path.name} has velocities (qvel), and its episodes begin at "
            "rest: let state() give them, or leave them out"
        )
    measurement = plant.measurement
    if measurement.shape != (STARTS, p):
        raise BadInput(
            f"it measures {measurement.shape[1]} column(s), and `noisy` has {p}: make them as many"
        )
    moved = task.z(task.with_z(measurement, z[::-1]))
    _check_round_trip(task, z, task.z(measurement))
    _check_round_trip(task, z[::-1], moved, "with_z() and z()")
    _check_inverse(task, measurement)
    _check_noise_of_chart(task, measurement)
    if task.effort.everywhere:
        anywhere = task.chart.draw(task.effort.starts, np.random.default_rng(3))
        everywhere = task.placed(anywhere).measurement
        _check_round_trip(task, anywhere, task.z(everywhere))
        _check_noise_of_chart(task, everywhere)
        _check_noise_is_seen(task, everywhere)
    if type(task).plant is Task.plant:
        _check_turns(task, np.vstack([z, task.chart.draw(STARTS, np.random.default_rng(4))]))
        z, measurement = drawn, task.placed(drawn).measurement  # of which few may be over
    ending = task.ending(measurement)
    over = np.flatnonzero(ending != Outcome.RUNNING)
    if len(over):
        raise BadInput(
            f"{len(over):,} of {len(z):,} starts are over before they begin: {task.chart.format(z[over[0]])} "
            f"is {Outcome(ending[over[0]]).label}; start elsewhere, or change ending()"
        )


def _check_round_trip(
    task: Task, z: np.ndarray, back: np.ndarray, methods: str = "state() and z()"
) -> None:
    """Raises `BadInput` unless chart points (n, d) are measured as what they are."""
    off = np.abs(task.chart.difference(back, z)).max(axis=1)
    if off.max() > 1e-6:
        worst = int(off.argmax())
        raise BadInput(
            f"{methods} do not belong to each other: {task.chart.format(z[worst])} is measured as "
            f"{task.chart.format(back[worst])}; let them agree all over the chart, with sensors that do not "
            "clip there (cutoff)"
        )


def _check_turns(task: Task, z: np.ndarray) -> None:
    """Raises `BadInput` unless whole turns of periodic coordinates lead chart points (n, d) to themselves."""
    chart, model = task.chart, task.model
    data = mujoco.MjData(model)

    def seen(z: np.ndarray) -> np.ndarray:
        """Returns where all bodies are, how they are turned, and how an episode ends: (n, k)."""
        plant, poses = task.placed(z), []
        for qpos in plant.qpos:
            mjcf.place(model, data, qpos, task.mocap)
            poses.append(np.append(data.xpos, data.xmat))
        return np.column_stack([poses, task.ending(plant.measurement)])

    without = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    limited = model.jnt_limited.astype(bool) & (not model.opt.disableflags & without)
    for axis in np.flatnonzero(chart.periodic):
        turn = chart.sides * (np.arange(chart.dimension) == axis)
        turned = np.abs(task.placed(z + turn).qpos - task.placed(z).qpos).max(axis=0) > 1e-6
        if (stopped := np.flatnonzero(limited & turned[model.jnt_qposadr])).size:
            joint = mjcf.names(model, mujoco.mjtObj.mjOBJ_JOINT)[stopped[0]]
            raise BadInput(
                f"its chart says that {chart.names[axis]} is periodic, and joint {joint} has a range, which "
                "stops it: leave the range out, or say that it is not periodic"
            )
        unit, side = chart.units[axis].strip("[] ").lower()[:3], chart.sides[axis]
        of_others = {"rad": 360.0, "deg": 2 * np.pi, "°": 2 * np.pi}
        if abs(side - of_others.get(unit, 0.0)) < 0.01:
            raise BadInput(
                f"its chart says that {chart.names[axis]} is in {chart.units[axis]} and comes back after "
                f"{side:.6g}: a whole turn is 360 in degrees and 2 pi in rad, so correct one of them"
            )
        off = np.abs(seen(z + turn) - seen(z)).max(axis=1)
        if off.max() > 1e-3:  # 3.1416 will do
            raise BadInput(
                f"its chart says that {chart.names[axis]} is periodic and comes back after "
                f"{chart.sides[axis]:.6g} {chart.units[axis]}, but that much on from "
                f"{chart.format(z[int(off.argmax())])} the robot is elsewhere or ends otherwise: let the "
                "period be a whole turn, 2 pi for an angle in rad, or say that it is not periodic"
            )


def _check_inverse(task: Task, measurement: np.ndarray) -> None:
    """Raises `BadInput` unless measured(), if there is one, is the inverse of observation()."""
    if type(task).measured is Task.measured:
        return
    seen = task.observation(measurement)
    again = task.observation(task.measured(seen))
    if not np.allclose(again, seen, rtol=1e-5, atol=1e-5):  # single precision will do
        row, column = np.unravel_index(np.abs(again - seen).argmax(), seen.shape)
        raise BadInput(
            f"measured() is not the inverse of observation(): observation[{column}] is "
            f"{seen[row, column]:g}, and {again[row, column]:g} of what measured() makes of it"
        )


def _check_noise_of_chart(task: Task, measurement: np.ndarray) -> None:
    """Raises `BadInput` unless noise moves chart points by about the shares that `noisy` begins with."""
    if type(task).z is Task.z:
        return
    z, step, shares = task.z(measurement), 1e-6, np.array(task.noisy, dtype=float)
    by = np.array(
        [
            np.abs(task.chart.difference(task.z(measurement + column), z)) / step
            for column in step * np.diag(shares)
        ]
    )
    moved, said = by.sum(axis=0).max(axis=0), shares[: task.chart.dimension]
    # Cosine and sine together move their angle by the root of 2 times their share of the noise. What another
    # column moves alone has to be moved as far as is said.
    own = np.array([by[i, :, i].any() for i in range(len(said))])
    apart = np.where(own, np.sqrt(2) + 1e-3, 1.0)
    wrong = (moved > apart * said + 1e-6) | (moved * apart < said - 1e-6)
    if wrong.any():
        i = int(wrong.argmax())
        raise BadInput(
            f"noise of 1 in the noisy columns moves the chart's {task.chart.names[i]} by {moved[i]:.3g}, and "
            f"its share in noisy is {said[i]:g}: let the measurement begin with the columns of the chart, in "
            "its units"
        )


def _check_noise_is_seen(task: Task, measurement: np.ndarray) -> None:
    """Raises `BadInput` if noise in the noisy columns changes no observation of measurements (n, p)."""
    shares = np.array(task.noisy, dtype=float)
    # As much as moves the chart by a hundredth of its sides.
    with np.errstate(divide="ignore"):
        bound = float((task.chart.sides / shares[: task.chart.dimension]).min()) / 100
    drawn = np.random.default_rng(0).uniform(-1, 1, measurement.shape)
    noisy = measurement + min(bound, 1.0) * shares * drawn
    if np.array_equal(task.observation(noisy), task.observation(measurement)):
        raise BadInput(
            f"noise in the noisy columns {np.flatnonzero(shares).tolist()} of the measurement changes no "
            "observation, so that no network would see it: let observation() use them, or say in noisy "
            "which columns it uses"
        )


def _check_box(task: Task) -> np.ndarray:
    """Returns starts (n, d) that are drawn; raises `BadInput` unless the task says that they may be."""
    drawn = task.starts(task.effort.starts, np.random.default_rng(2))
    off = ~(task.chart.contains(drawn) & task.may_start(drawn))
    if off.any():
        low, high = (task.chart.format(np.array(end)) for end in (task.start_low, task.start_high))
        raise BadInput(
            f"{off.sum():,} of {len(drawn):,} starts that starts() draws lie outside of its box, as "
            f"{task.chart.format(drawn[off][0])}: what is not in the box from {low} to {high} (start_low, "
            "start_high, may_start) is not examined; change one of them"
        )
    return drawn


def _check_ways(task: Task) -> None:
    """Raises `BadInput` unless ways past the obstacles of the MJCF can be told apart in the task's plane."""
    own = "or give the task a direction() of its own"
    if not task.obstacles:
        raise BadInput(
            f'{task.model_path.name} has no obstacle: begin the name of a geom with "obstacle", {own}'
        )
    if [*task.plane] not in ([0, 1], [0, 2], [1, 2]):  # seen from behind, left would be right
        raise BadInput(
            f"plane is {task.plane!r}: give two of the axes 0 (x), 1 (y) and 2 (z), in this order"
        )
    if type(task).where is Task.where and task.chart.dimension < 2:
        raise BadInput(
            f"its chart has one coordinate ({task.chart.names[0]}), and ways past obstacles are told apart "
            f"in a plane: give the task a where(measured), {own}"
        )


def _check_episodes(task: Task) -> None:
    trial.try_random(task)
    trial.try_extreme(task)
    trial.try_methods(task)
    trial.try_inputs(task)
    trial.try_control(task)
    try_mirror(task)
    if not task.gives_direction:
        trial.try_where(task)
        trial.try_place(task)
    z = task.starts(STARTS, np.random.default_rng(0))
    arrived = task.arrived(z)
    # Where the end says which runs have arrived, any start may be as near to the set-point as they are.
    own = type(task).verdict is not Task.verdict
    if np.mean(arrived) > 0.5 and not own and not task.ends_well:
        raise BadInput(
            f"{arrived.sum()} of {STARTS} starts already count as arrived, as "
            f"{task.chart.format(z[arrived][0])}: start elsewhere, or make `close` smaller"
        )


def _check_shape(what: str, values: ArrayLike, shape: tuple[int, ...]) -> None:
    if np.shape(values) != shape:
        raise BadInput(f"{what} shape {np.shape(values)}: the task needs {shape}")
