"""The kinds of traps, each with variants that are drawn."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np

from hyrl_mj import from_gymnasium
from traps import draws, memories, wrappers
from traps.memories import planted
from traps.plans import Plan
from traps.storages import HIDDEN, VISIBLE

PUCKS = ("slides", "free", "cart", "door")
DRIVEN = ("slides", "cart", "door")
ALONE, BESIDE = ("slides", "free"), ("cart", "door")
ALL = (*PUCKS, "hinge")


# Expressions for success, with those for failure, where `from_gymnasium` takes them.
EXPRESSIONS = {"terminated and reward >= 1": "terminated and reward < 1"}
if "failure" not in inspect.signature(from_gymnasium).parameters:
    EXPRESSIONS.clear()


@dataclass(frozen=True)
class Planted:
    """What a trap changes.

    Attributes:
        mixins: classes that change a `World`.
        wrappers: functions of an environment, the innermost first.
        plan: changes of the plan.
        draws: whether each reset draws something that has to be told.
        frames: of the observation that are stacked.
        limit: whether the environment tells the length of its episodes.
        given: arguments of `from_gymnasium`.
    """

    mixins: tuple[type, ...] = ()
    wrappers: tuple[Callable[[gym.Env], gym.Env], ...] = ()
    plan: dict = field(default_factory=dict)
    draws: bool = False
    frames: int = 1
    limit: bool = False
    given: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Trap:
    """How a trap is planted, and in which worlds it can be."""

    plant: Callable[[np.random.Generator, Plan], Planted]
    kinds: tuple[str, ...]


TRAPS: dict[str, Trap] = {}


def trap(name, kinds=ALL):
    """Registers how a trap is planted."""

    def registered(plant):
        TRAPS[name] = Trap(plant, kinds)
        return plant

    return registered


def _one(rng, *values):
    return values[int(rng.integers(len(values)))]


def _region(rng, plan):
    """A place that runs come by: on the way, in a corner, or where some start."""
    if plan.turns:
        return {"where": (float(rng.uniform(-3, 3)),), "reach": float(rng.uniform(0.05, 0.3))}
    (hx, hy), (x, y, rx, ry) = plan.half, plan.rock
    side = _one(rng, -1, 1)
    corner = (x + rx + 0.3, y + side * (ry + 0.3))
    where = _one(rng, corner, corner, (hx - 0.2, side * (hy - 0.2)), (x - rx - 0.4, y))
    return {"where": tuple(map(float, where)), "reach": float(rng.uniform(0.2, 0.4))}


def _latch(rng, plan, storages):
    storage = _one(rng, *storages)
    kind = _one(rng, memories.Key, memories.Broken, memories.Waypoint)
    return planted(kind, storage, **_region(rng, plan))


@trap("latch")
def _(rng, plan):
    return Planted((_latch(rng, plan, VISIBLE),))


@trap("latch in the model")
def _(rng, plan):
    what = _one(rng, "dof_damping", "wind", *(() if plan.turns else ("rock",)))
    return Planted((planted(memories.Unlatched, unlatches=what, **_region(rng, plan)),))


@trap("sticky success")
def _(rng, plan):
    return Planted((planted(memories.Sticky, forgets=_one(rng, True, False)),))


@trap("action delay")
def _(rng, plan):
    delay, kind = int(rng.integers(1, 5)), _one(rng, "deque", "list", "ring")
    if rng.random() < 0.5 and not plan.levels:
        return Planted(wrappers=(lambda env: wrappers.Waits(env, delay, kind),))
    return Planted((planted(memories.LateAction, action_delay=delay, action_queue=kind),))


@trap("observation delay")
def _(rng, plan):
    delay, kind = int(rng.integers(1, 4)), _one(rng, "deque", "list", "ring")
    if rng.random() < 0.4:
        return Planted((planted(memories.LateEyes, eye_delay=delay, eye_queue=kind),))
    if rng.random() < 0.5:
        wrap = lambda env: gym.wrappers.DelayObservation(env, delay)  # noqa: E731
    else:
        wrap = lambda env: wrappers.Looks(env, delay, kind)  # noqa: E731
    return Planted(wrappers=(wrap,), plan={"view": "box"})


@trap("cached value")
def _(rng, plan):
    return Planted((planted(memories.Cached, caches=_one(rng, "step", "slow", "counter")),))


@trap("stored difference")
def _(rng, plan):
    differs = _one(rng, "step", "observation", "filter")
    return Planted((planted(memories.Difference, differs=differs),))


@trap("rare attribute")
def _(rng, plan):
    period = _one(rng, None, 61, 71, 97)
    storage = _one(rng, *VISIBLE)
    return Planted((planted(memories.Seldom, storage, period=period, **_region(rng, plan)),))


@trap("drawn model", DRIVEN)
def _(rng, plan):
    what = _one(rng, "damping", "mass", "rock", "friction", "gear", "wind", "timestep")
    return Planted((planted(draws.Drawn, drawn=what),), draws=True)


@trap("drawn goal", PUCKS)
def _(rng, plan):
    where = _one(rng, "site", "mocap", "qpos", "userdata", "attribute", "body")
    change = {"goal_in": where}
    if where in ("userdata", "attribute"):
        change["success"] = _one(rng, "info", "terminated", "reward >= 1")
    return Planted((planted(draws.DrawnGoal),), plan=change, draws=True)


@trap("step noise")
def _(rng, plan):
    values = {
        "rough_source": _one(
            rng, "np_random", "numpy", "random", "late", "space", "urandom", "time"
        ),
        "rough_everywhere": _one(rng, True, False, False),
        "rough_on": _one(rng, "drive", "sensor"),
    }
    return Planted((planted(draws.Rough, **values, **_region(rng, plan)),))


@trap("wrapper order")
def _(rng, plan):
    steps = int(plan.steps * rng.uniform(0.5, 0.9))
    own = rng.random() < 0.2
    limit = wrappers.Stops if own else gym.wrappers.TimeLimit
    frames = int(rng.integers(2, 5))
    outer = {
        "clip": gym.wrappers.ClipAction,
        "rescale": lambda env: gym.wrappers.RescaleAction(env, -1.0, 1.0),
        "stack": lambda env: gym.wrappers.FrameStackObservation(env, frames),
        "normalize": gym.wrappers.NormalizeObservation,
        "transform": scaled,
        "delay": lambda env: gym.wrappers.DelayObservation(env, 2),
        "ease": lambda env: wrappers.Eases(env, 0.4),
        "blend": lambda env: wrappers.Blends(env, 0.6),
        "append": wrappers.Appends,
        "reward": lambda env: gym.wrappers.NormalizeReward(env),
        "statistics": gym.wrappers.RecordEpisodeStatistics,
    }
    if not own:
        outer["time"] = gym.wrappers.TimeAwareObservation
    # What is below may be anything; what is stacked is stacked last, so that the last frame is the newest.
    names = [str(name) for name in rng.permutation([*outer])[: int(rng.integers(1, 4))]]
    names.sort(key=lambda name: name == "stack")
    if {"clip", "rescale"} <= {*names}:  # what has been clipped has no limits to be rescaled
        clip, rescale = sorted(map(names.index, ("clip", "rescale")))
        names[clip], names[rescale] = "rescale", "clip"
    chain = [outer[name] for name in names]
    chain.insert(
        int(rng.integers(len(chain) + 1)) if "time" not in names else 0, limited(limit, steps)
    )
    change = {"view": "box", "levels": False}
    if "reward" in names:
        change["success"] = "info"
    return Planted(
        wrappers=tuple(chain), plan=change, frames=frames if "stack" in names else 1, limit=True
    )


def limited(limit, steps):
    return lambda env: limit(env, steps)


def scaled(env):
    return gym.wrappers.TransformObservation(env, _at_nine_tenths, env.observation_space)


def _at_nine_tenths(observation):
    return 0.9 * observation


@trap("frames and filters")
def _(rng, plan):
    frames = int(rng.integers(2, 5))
    wrap, stacked = _one(
        rng,
        (lambda env: gym.wrappers.FrameStackObservation(env, frames), frames),
        (gym.wrappers.NormalizeObservation, 1),
        (lambda env: wrappers.Blends(env, 0.5), 1),
    )
    return Planted(wrappers=(wrap,), plan={"view": "box"}, frames=stacked)


@trap("stale fields", PUCKS)
def _(rng, plan):
    what = _one(rng, "site_xpos", "xpos", "sensordata", "forces", "substep")
    # A distance would be stale, too: which one counts is another question.
    change = {"forward": False, "success": _one(rng, "info", "reward >= 1")}
    if what == "forces":
        return Planted((planted(draws.Forces),), plan=change)
    if what == "substep":
        return Planted((planted(draws.Substep),), plan=change)
    return Planted((planted(draws.Stale, stale=what),), plan=change)


@trap("own clock")
def _(rng, plan):
    kinds = ("beacon", "beacon") if plan.kind in ALONE else ()
    kind = _one(rng, "wind", "wall", *kinds)
    change = {"beacon": beacon(plan, rng)} if kind == "beacon" else {}
    return Planted((planted(draws.Clock, clock=kind),), plan=change)


def beacon(plan, rng):
    x = plan.rock[0] + plan.rock[2] + 0.4
    return float(x), float(plan.rock[1] + rng.uniform(-0.6, 0.6))


@trap("outlives resets")
def _(rng, plan):
    kinds = ("goal", "wins", "learnt", *(("cart",) if plan.kind in BESIDE else ()))
    success = _one(rng, "info", "terminated", "reward >= 1")
    return Planted(
        (planted(draws.Surviving, survives=_one(rng, *kinds)),), plan={"success": success}
    )


@trap("initial motion", BESIDE)
def _(rng, plan):
    values = {
        "rolls_as_drawn": _one(rng, True, True, False),
        "rolls_by": _one(rng, "speed", "place"),
    }
    return Planted((planted(draws.Rolling, **values),))


@trap("recalled input or observation")
def _(rng, plan):
    recalls = _one(rng, "action", "seen", "tracked")
    if recalls == "tracked":
        return Planted((planted(memories.Tracked),))
    return Planted((planted(memories.Recalled, recalls=recalls),))


@trap("drawn bias of the sensor")
def _(rng, plan):
    return Planted((planted(draws.Bias),), draws=True)


@trap("smoothing")
def _(rng, plan):
    share = float(rng.uniform(0.2, 0.6))
    if rng.random() < 0.4 and not plan.levels:
        return Planted(wrappers=(lambda env: wrappers.Eases(env, share),))
    return Planted((planted(memories.Smooth, _one(rng, *VISIBLE), share_of_new=share),))


@trap("hidden memory")
def _(rng, plan):
    storage = _one(rng, *HIDDEN)
    kind = _one(rng, memories.Smooth, memories.Seldom, None)
    if kind is None:
        return Planted((_latch(rng, plan, (storage,)),))
    values = (
        {"share_of_new": 0.4} if kind is memories.Smooth else {"period": 61, **_region(rng, plan)}
    )
    return Planted((planted(kind, storage, **values),))


@trap("shared by instances")
def _(rng, plan):
    return Planted((planted(draws.Ageing),))


@trap("success and collision terminate", PUCKS)
def _(rng, plan):
    success = _one(rng, "info", "reward >= 1", "distance", *EXPRESSIONS)
    change = {"success": success, "crashes": True, "word": "success"}
    given = {"failure": EXPRESSIONS[success]} if success in EXPRESSIONS else {}
    return Planted((planted(draws.Both),), plan=change, given=given)


@trap("progress as reward")
def _(rng, plan):
    success = f"reward >= {float(rng.uniform(-0.1, 0.1)):.3f}"
    return Planted((planted(memories.Progress),), plan={"success": success})


@trap("order of a Dict")
def _(rng, plan):
    return Planted(plan={"view": "unsorted"})


@trap("no method observes")
def _(rng, plan):
    return Planted((planted(draws.Inline),))
