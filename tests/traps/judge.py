"""How environments run alone, which is the truth, and how hyrl_mj runs them."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

import gymnasium as gym
import numpy as np
from gymnasium import spaces

import hyrl_mj
from hyrl_mj import BadInput
from hyrl_mj.simulation import Recorded
from traps.pilots import Pilot
from traps.storages import new_process

# Starts of a case, and how many of them are also tried alone and with the other agent.
STARTS, ALONE = 12, 3
# Bounds of the noise [m, rad].
SIGNALS = {"no noise": 0.0, "noise": 0.03, "larger noise": 0.15}
# Both do the same arithmetic, so they differ by rounding at most, where the offset of a coordinate is added
# and taken away again. This share of the larger of a value and 1 is far above rounding, and below what traps
# do.
SAME = 1e-9
# "Said" is what differs under noise where `task.found` tells that an observation lags behind the state.
VERDICTS = ("right", "refused", "refused at run", "said", "wrong", "crash")


@dataclass(frozen=True)
class Case:
    """An environment to be tried.

    Attributes:
        name: by which it is found again.
        traps: the names of its traps.
        factory: makes it.
        given: the arguments of `from_gymnasium`.
        pilot, other: two agents of it.
        starts: (n, c) in the chart.
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
    """What happened: t (K + 1,), z (K + 1, c), u (K, m), and the label of the outcome."""

    t: np.ndarray
    z: np.ndarray
    u: np.ndarray
    outcome: str


# ---- the truth


@new_process()
def played(case, agent, z0, noise, arrival_ends=False, env=None):
    """Returns how an environment that nothing else has touched runs.

    Args:
        case: what is tried.
        agent: what drives it.
        z0: (c,) start.
        noise: (K + 1, d) on the reading of the sensor at each sample.
        arrival_ends: whether a success ends the episode, whatever it is told by.
        env: the environment, by default a new one.
    """
    env = env or case.factory()
    inner, samples = env.unwrapped, iter(noise)

    def next_sample():
        inner.sensor_offset = next(samples)

    inner.next_sample, inner.start = next_sample, z0
    observation, _ = env.reset(seed=case.given.get("seed", 0))
    begun = inner.data.time
    t, z, u = [0.0], [inner.charted()], []
    for k in count(1):
        answer = agent(_flat(env, observation)[None])[0]
        u.append(np.atleast_1d(answer).astype(float))
        observation, reward, terminated, truncated, info = env.step(_action(env, answer))
        t.append(inner.data.time - begun)
        z.append(inner.charted())
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
    parts = list(space.spaces) if isinstance(space, spaces.Dict) else [...]
    kinds = {(space[p] if p is not ... else space).dtype for p in parts}
    kind = np.float64 if kinds == {np.dtype(np.float64)} else np.float32
    found = [np.ravel(observation[p] if p is not ... else observation) for p in parts]
    return np.concatenate(found).astype(kind)


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
            return f"{name} at sample {k} is {values[k].round(9)}, in truth {truth[k].round(9)}"
    if len(arc.t) != len(run.t):
        return f"{arc.outcome} after {len(arc.t) - 1} samples, in truth {run.outcome} after {len(run.t) - 1}"
    if not np.allclose(arc.t, run.t, rtol=0, atol=SAME):
        return f"the last sample is at {arc.t[-1]:g} s, in truth {run.t[-1]:g} s"
    return "" if arc.outcome == run.outcome else f"{arc.outcome}, in truth {run.outcome}"


@new_process()
def judged(case, starts=STARTS):
    """Returns the verdict on a case, and why, from so many of its starts."""
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
            if "lag" in task.found and "no noise" not in wrong and wrong:
                return "said", wrong
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
    n, d = len(starts), case.pilot.plan.dimension
    signals = {
        name: bound * rng.uniform(-1, 1, (case.steps + 2, n, d)) for name, bound in SIGNALS.items()
    }
    truths = {}

    def truth(agent, name, i):
        key = agent.course, name, i
        if key not in truths:
            try:
                ends = task.abilities.arrival_ends
                truths[key] = played(case, agent, starts[i], signals[name][:, i], ends)
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
