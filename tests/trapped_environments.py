"""Environments with traps and honest ones, and a judge of how hyrl_mj runs them against how they run alone.

    python tests/trapped_environments.py 300 100

tries 300 with traps and 100 honest ones, and prints a table with the failures. A third number is the seed; a
name of a case, as "trapped 17", in its place tries that one.
"""

import sys
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import gymnasium as gym
import numpy as np
import traps
from gymnasium import spaces
from trap_kinds import ALL, BESIDE, HONEST, TRAPS
from trapped_worlds import Pilot, Plan, World

import hyrl_mj
from hyrl_mj import BadInput
from hyrl_mj.simulation.noise import Recorded

# Starts of a case, and how many of them are also tried alone and with the other agent.
STARTS, ALONE = 12, 3
# Bounds of the noise [m, rad].
SIGNALS = {"no noise": 0.0, "noise": 0.03, "larger noise": 0.15}
# Both do the same arithmetic, so they differ by rounding at most: where an offset of the chart is added and taken
# away again. So much of the larger of a value and 1 is far above that, and far below what any trap does.
SAME = 1e-9
VERDICTS = ("right", "refused", "refused at run", "wrong", "crash")
FAILURES = ("wrong", "crash")


@dataclass(frozen=True)
class Case:
    """An environment to be tried.

    Attributes:
        name: by which it is found again.
        traps: the names of its traps.
        factory: makes it.
        given: the arguments of `from_gymnasium`.
        pilot, other: two agents of it.
        starts: (n, d).
        steps: of an episode, at most.
        draws: whether each reset draws something that has to be told.
    """

    name: str
    traps: tuple[str, ...]
    factory: Callable[[], gym.Env]
    given: dict
    pilot: Pilot
    other: Pilot
    starts: np.ndarray
    steps: int
    draws: bool


@dataclass(frozen=True)
class Run:
    """What happened: t (K + 1,), z (K + 1, d), u (K, m), and the label of the outcome."""

    t: np.ndarray
    z: np.ndarray
    u: np.ndarray
    outcome: str


# ---- the truth


def played(case, agent, z0, noise, arrival_ends=False):
    """Returns how an environment that nobody else has touched runs from a start (d,) under noise (K + 1, d)."""
    traps.forget()
    env, inner = case.factory(), None
    inner = env.unwrapped
    samples = iter(noise)

    def next_sample():
        inner.sensor_offset = next(samples)

    inner.next_sample, inner.start = next_sample, z0
    observation, _ = env.reset(seed=case.given.get("seed", 0))
    begun = inner.data.time
    t, z, u = [0.0], [inner.place()], []
    for k in count(1):
        answer = agent(_flat(env, observation)[None].astype(np.float32))[0]
        u.append(np.atleast_1d(answer).astype(float))
        observation, reward, terminated, truncated, info = env.step(_action(env, answer))
        t.append(inner.data.time - begun)
        z.append(inner.place())
        holds, ends = _holds(case.given["success"], inner, reward, terminated, info)
        last = truncated or k == case.steps
        outcome = ("reached" if holds else "crashed") if terminated else None
        if holds and (ends or arrival_ends):
            outcome = "reached"
        if outcome is None and last:
            outcome = "reached" if holds else "stalled"
        if outcome is not None:
            return Run(np.array(t), np.array(z), np.array(u), outcome)


def _flat(env, observation):
    """Returns an observation as a vector, the parts of a Dict in the order of their space."""
    space = env.observation_space
    if isinstance(space, spaces.Dict):
        return np.concatenate([np.ravel(observation[key]) for key in space.spaces])
    return np.ravel(observation)


def _action(env, answer):
    space = env.action_space
    if isinstance(space, spaces.Discrete):
        return int(space.start + answer)
    return np.clip(answer, space.low, space.high).astype(space.dtype)


def _holds(success, inner, reward, terminated, info):
    """Returns whether a step is a success, and whether such a success ends the episode."""
    if success == "info":
        return any(info.get(key, False) for key in ("success", "is_success")), True
    if success == "terminated":
        return terminated, True
    if success.startswith("terminated and reward >="):
        return terminated and reward >= float(success.split()[-1]), True
    if success.startswith("reward >="):
        return reward >= float(success.split()[-1]), False
    data, goal = inner.data, inner.plan.goal_in
    goal = data.body("goal").xpos if goal in ("mocap", "qpos", "body") else data.site("goal").xpos
    return np.linalg.norm(data.site("tip").xpos - goal) <= float(success.split()[-1]), False


# ---- the judge


def difference(arc, run):
    """Returns a sentence on the first difference of an arc from the truth; "" without one."""
    n = min(len(arc.t), len(run.t))
    for name, values, truth, rows in (("z", arc.z, run.z, n), ("u", arc.u, run.u, n - 1)):
        values, truth = values[:rows], truth[:rows]
        far = ~(np.abs(values - truth) <= SAME * np.maximum(np.abs(truth), 1.0))
        if far.any():
            k = int(far.any(axis=1).argmax())
            return f"{name} at sample {k} is {values[k].round(6)}, in truth {truth[k].round(6)}"
    if len(arc.t) != len(run.t):
        return f"{arc.outcome} after {len(arc.t) - 1} samples, in truth {run.outcome} after {len(run.t) - 1}"
    if not np.allclose(arc.t, run.t, rtol=0, atol=SAME):
        return f"the last sample is at {arc.t[-1]:g} s, in truth {run.t[-1]:g} s"
    return "" if arc.outcome == run.outcome else f"{arc.outcome}, in truth {run.outcome}"


def judged(case, starts=STARTS):
    """Returns the verdict on a case, and why."""
    traps.forget()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            task = hyrl_mj.from_gymnasium(case.factory, **case.given)
        except BadInput as refusal:
            return "refused", str(refusal)
        except Exception as error:
            return "crash", f"from_gymnasium raises {type(error).__name__}: {error}"
        try:
            wrong = _compared(case, task, case.starts[:starts])
        except BadInput as refusal:
            return "refused at run", str(refusal)
        except _Untrue as error:
            raise error.__cause__ from None
        except Exception as error:
            return "crash", f"simulate raises {type(error).__name__}: {error}"
    if not wrong and case.draws and "seed" not in case.given:
        told = " ".join(str(text) for text in getattr(task, "found", {}).values())
        wrong = "" if "seed" in told else "each reset draws something, and nothing tells which"
    return ("wrong", wrong) if wrong else ("right", "")


class _Untrue(Exception):
    """The truth itself cannot be had."""


def _compared(case, task, starts):
    rng = np.random.default_rng([7, *case.name.encode()])
    n, d = starts.shape
    signals = {
        name: bound * rng.uniform(-1, 1, (case.steps + 2, n, d)) for name, bound in SIGNALS.items()
    }
    truths = {}

    def truth(agent, name, i):
        key = agent.course, name, i
        if key not in truths:
            try:
                truths[key] = played(case, agent, starts[i], signals[name][:, i], task.arrival_ends)
            except Exception as error:
                raise _Untrue from error
        return truths[key]

    def compare(agent, name, rows, how):
        policy = hyrl_mj.from_callable(agent, task)
        noise = _recorded(task, signals[name][:, rows], SIGNALS[name])
        arcs = hyrl_mj.simulate(task, policy, starts[rows], noise, seed=0)
        for i, arc in zip(rows, arcs, strict=True):
            if wrong := difference(arc, truth(agent, name, i)):
                return f"start {i}, {name}{how}: {wrong}"
        return ""

    everyone, few = [*range(n)], [*range(min(ALONE, n))]
    order = rng.permutation(n).tolist()
    plays = [(case.pilot, name, everyone, "") for name in signals]
    plays += [(case.pilot, "noise", order, ", in another order")]
    plays += [(case.pilot, "larger noise", [i], ", alone") for i in few]
    plays += [(case.other, "noise", few, ", of the other agent")]
    plays += [(case.pilot, "noise", everyone, ", after the other agent")]
    return next((wrong for play in plays if (wrong := compare(*play))), "")


def _recorded(task, noise, bound):
    """Returns noise (K, n, d) on the chart as a signal; None without noise."""
    if not bound:
        return None
    values = np.zeros((*noise.shape[:2], len(task.noisy)))
    values[:, :, : noise.shape[2]] = noise
    return Recorded(values, bound)


# ---- what is drawn


def drawn_plan(rng, kinds):
    """Returns a plan of one of some kinds, at random."""
    kind = str(rng.choice(kinds))
    if kind == "hinge":
        force, damping = rng.uniform(1.0, 2.0), rng.uniform(0.3, 0.6)
        base = Plan(kind, force=float(force), damping=float(damping), goal=(rng.uniform(-3, 3),))
    else:
        rock = rng.uniform((-0.25, -0.15, 0.2, 0.2), (0.05, 0.15, 0.35, 0.4))
        half = (float(rng.uniform(1.5, 1.8)), float(rng.uniform(1.2, 1.5)))
        goal = (half[0] - float(rng.uniform(0.3, 0.45)), float(rng.uniform(-0.3, 0.3)))
        base = Plan(
            kind,
            half=half,
            rock=tuple(rock.tolist()),
            goal=goal,
            force=float(rng.uniform(2.5, 4.0)),
            damping=float(rng.uniform(1.5, 2.5)),
        )
    scan = bool(rng.random() < 0.3) and kind != "hinge"
    return replace(
        base,
        actuator=str(rng.choice(["motor", "motor", "velocity", "position", "filtered"])),
        frame_skip=int(rng.integers(1, 6)),
        view=str(rng.choice(["box", "dict"])),
        levels=bool(rng.random() < 0.15),
        scale=float(rng.choice([1.0, 2.5])),
        success=str(rng.choice(["info", "info", "terminated", "reward >= 1", "distance"])),
        word=str(rng.choice(["success", "is_success"])),
        crashes=bool(rng.random() < 0.3),
        scan=scan,
        forward=scan and kind in BESIDE,  # rays meet what moves where it is now
        first=bool(rng.random() < 0.3),
    )


def made(name, found, plan, planted, rng):
    """Returns the case of a plan in which something was planted."""
    for one in planted:
        plan = replace(plan, **one.plan)
    if plan.success == "distance":
        plan = replace(plan, success="distance(tip, goal) <= 0.25", forward=True)
    if plan.success == "terminated":
        plan = replace(plan, crashes=False)
    mixins = tuple(sorted((m for one in planted for m in one.mixins), key=_rank))
    kind = type("Planted", (*mixins, World), {"plan": plan})
    outside = [wrap for one in planted for wrap in one.wrappers]

    def environment():
        env = kind()
        for wrap in outside:
            env = wrap(env)
        return env

    given: dict[str, Any] = {"success": plan.success}
    if not plan.turns and (plan.first or plan.goal_in == "qpos" or rng.random() < 0.5):
        given["chart"] = _chart(plan, rng)
    if not any(one.limit for one in planted):
        given["steps"] = plan.steps
    draws = any(one.draws for one in planted)
    if draws and rng.random() < 0.6:
        given["seed"] = int(rng.integers(100))
    frames = max(one.frames for one in planted) if planted else 1
    env = environment()
    pilot = _pilot(env, plan, frames, rng)
    corner = rng.choice([-1.0, 1.0], plan.dimension)
    starts = plan.starts(STARTS, rng)
    other = replace(pilot, course=tuple(corner.tolist()))
    return Case(name, found, environment, given, pilot, other, starts, plan.steps, draws)


def _chart(plan, rng):
    if plan.kind == "free":
        return {"east": "qpos[0]", "north": "qpos[1]"} if not plan.first else ["tip"]
    return [["x", "y"], {"east": "x", "north": "y"}, "puck"][int(rng.integers(3))]


def _rank(mixin):
    """Those that look at what others do come first, so that these are ready when they look."""
    looks = (traps.Cached, traps.LateEyes, traps.Inline)
    return 0 if issubclass(mixin, looks) else 1 if issubclass(mixin, traps.Looking) else 2


def _pilot(env, plan, frames, rng):
    inner = env.unwrapped
    sizes = inner.sizes()
    names = [*sizes] if plan.view == "box" else [*inner.observation_space.spaces]
    width = spaces.flatdim(env.observation_space)
    at, columns = width - width // frames, {}
    for name in names:
        columns[name] = list(range(at, at + sizes[name]))
        at += sizes[name]
    used = {name: columns[name] for name in ("velocity", "position", "to_goal")}
    space = env.action_space
    scale = plan.scale
    if isinstance(space, spaces.Box) and np.isfinite(space.high).all():
        scale = float(space.high[0])
    return Pilot(replace(plan, scale=scale), used, rng.uniform(-1, 1, width))


def trapped(i, seed=0):
    """Returns the case `i` with one trap, or with two where i is odd."""
    rng = np.random.default_rng([seed, 1, i])
    names = [*TRAPS]
    first = names[i // 2 % len(names)]
    while True:
        found = (first,)
        if i % 2:
            found = (first, str(rng.choice([name for name in names if name != first])))
        kinds = [kind for kind in ALL if all(kind in TRAPS[name].kinds for name in found)]
        if not kinds:
            continue
        plan = drawn_plan(rng, kinds)
        planted = [TRAPS[name].plant(rng, plan) for name in found]
        if _fit(planted):
            return made(f"trapped {i}", found, plan, planted, rng)


def _fit(planted):
    """Whether traps can be in one environment."""
    changed = [name for one in planted for name in one.plan]
    mixins = [m.__bases__[0] for one in planted for m in one.mixins]
    wrapped = [one for one in planted if one.wrappers]
    return len(wrapped) < 2 and all(len({*names}) == len(names) for names in (changed, mixins))


def honest(i, seed=0):
    """Returns the honest case `i`."""
    rng = np.random.default_rng([seed, 2, i])
    plan = drawn_plan(rng, ALL)
    if rng.random() < 0.15:
        plan = replace(plan, view="unsorted")
    planted = HONEST[i % len(HONEST)](rng, plan)
    return made(f"honest {i}", ("honest",), plan, [planted], rng)


# ---- the table


def tabled(verdicts):
    """Returns a table of verdicts (traps, verdict) by trap, with those of all that have traps at its end."""
    by_trap = defaultdict(Counter)
    for found, verdict in verdicts:
        for name in found if found == ("honest",) else (*found, "all with traps"):
            by_trap[name][verdict] += 1
    last = [name for name in ("all with traps", "honest") if name in by_trap]
    names = [name for name in by_trap if name not in last] + last
    lines = [" " * 32 + "".join(f"{verdict:>16}" for verdict in VERDICTS)]
    lines += [
        f"{name:32}" + "".join(f"{by_trap[name][verdict]:16}" for verdict in VERDICTS)
        for name in names
    ]
    return "\n".join(lines)


def is_failure(found, verdict):
    """Returns whether a verdict must not be: honest environments have to be accepted, too."""
    return verdict != "right" if found == ("honest",) else verdict in FAILURES


def main(argv):
    if len(argv) == 1:
        kind, number = argv[0].split()
        case = {"trapped": trapped, "honest": honest}[kind](int(number))
        print(case.traps, case.given, *judged(case), sep="\n")
        return
    n, m = int(argv[0]), int(argv[1])
    seed = int(argv[2]) if len(argv) > 2 else 0
    verdicts, failures = [], []
    for made_case, cases in ((trapped, n), (honest, m)):
        for i in range(cases):
            case = made_case(i, seed)
            verdict, why = judged(case)
            verdicts.append((case.traps, verdict))
            if is_failure(case.traps, verdict):
                failures.append(f"{case.name} ({', '.join(case.traps)}): {verdict}: {why}")
    print(tabled(verdicts))
    print(f"\n{len(failures)} failures", *failures, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
