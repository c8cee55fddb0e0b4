"""Environments with traps and honest ones, and a judge of how hyrl_mj runs them against how they run alone.

    python tests/trapped_environments.py 300 100

tries 300 with traps and 100 honest ones, and prints the failures and a table. A third number is the seed; a
name of a case, as "trapped 17", in its place tries that one.
"""

import sys
from collections import Counter, defaultdict
from dataclasses import replace
from multiprocessing import get_context
from threading import RLock
from typing import Any

import numpy as np
from gymnasium import logger, spaces
from tqdm import tqdm
from traps import draws, memories
from traps.honest import HONEST
from traps.judge import STARTS, VERDICTS, Case, judged
from traps.kinds import ALL, BESIDE, TRAPS
from traps.pilots import Pilot
from traps.plans import Plan
from traps.worlds import World

# ---- what is drawn


def drawn_plan(rng, kinds):
    """Returns a plan of one of some kinds, at random."""
    kind = str(rng.choice(kinds))
    if kind == "hinge":
        force, damping = rng.uniform(1.0, 2.0), rng.uniform(0.3, 0.6)
        base = Plan(
            kind,
            force=float(force),
            damping=float(damping),
            goal=(float(rng.uniform(-3, 3)),),
            rated=bool(rng.random() < 0.3),
        )
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
    for one in planted:
        given |= one.given
    if not plan.turns and (plan.first or plan.goal_in == "qpos" or rng.random() < 0.5):
        given["chart"] = _chart(plan, rng)
    if plan.rated:
        given |= {"chart": {"angle": "turn", "rate": "qvel[0]"}, "bounds": {"rate": [-8, 8]}}
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
    looks = (memories.Cached, memories.LateEyes, draws.Inline)
    return 0 if issubclass(mixin, looks) else 1 if issubclass(mixin, memories.Looking) else 2


def _pilot(env, plan, frames, rng):
    inner = env.unwrapped
    sizes = inner.widths
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


def both(first, second, seed=0):
    """Returns a case with two traps, by their names."""
    rng = np.random.default_rng([3, seed, *f"{first}, {second}".encode()])
    kinds = [kind for kind in TRAPS[first].kinds if kind in TRAPS[second].kinds]
    while True:
        plan = drawn_plan(rng, kinds)
        planted = [TRAPS[name].plant(rng, plan) for name in (first, second)]
        if _fit(planted):
            return made(f"{first}, {second}", (first, second), plan, planted, rng)


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


def together(kinds, *plants):
    """Returns an honest case of one of some kinds, with all of some of `HONEST`."""
    rng = np.random.default_rng([4, *map(HONEST.index, plants)])
    plan = drawn_plan(rng, kinds)
    name = ", ".join(plant.__name__ for plant in plants)
    return made(name, ("honest",), plan, [plant(rng, plan) for plant in plants], rng)


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
    return verdict != "right" if found == ("honest",) else verdict in ("wrong", "crash")


def tried(case):
    """Returns the name of a case (kind, number, seed), its traps, the verdict, and why."""
    kind, number, seed = case
    made_case = {"trapped": trapped, "honest": honest}[kind](number, seed)
    return made_case.name, made_case.traps, *judged(made_case)


def main(argv):
    logger.min_level = logger.ERROR
    if len(argv) == 1:
        kind, number = argv[0].split()
        case = {"trapped": trapped, "honest": honest}[kind](int(number))
        print(case.traps, case.given, *judged(case), sep="\n")
        return 0
    n, m = int(argv[0]), int(argv[1])
    seed = int(argv[2]) if len(argv) > 2 else 0
    cases = [("trapped", i, seed) for i in range(n)] + [("honest", i, seed) for i in range(m)]
    verdicts, failures = [], 0
    # Each case in a process of its own, as it would be: what an environment leaves behind ends with it.
    # One that is forked while this one draws its bar would wait for ever for the lock that this one holds.
    own_lock = {"initializer": tqdm.set_lock, "initargs": (RLock(),)}
    with get_context("fork").Pool(maxtasksperchild=1, **own_lock) as processes:
        for name, traps, verdict, why in tqdm(processes.imap(tried, cases), total=len(cases)):
            verdicts.append((traps, verdict))
            if is_failure(traps, verdict):
                failures += 1
                print(f"{name} ({', '.join(traps)}): {verdict}: {why}", flush=True)
    print(f"\n{tabled(verdicts)}\n\n{failures} failures")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
