"""What honest environments are made of: nothing that a run from start to end would not bear."""

import gymnasium as gym
import numpy as np

from traps import draws
from traps.kinds import ALONE, Planted, beacon, limited, scaled
from traps.memories import planted


def _plain(rng, plan):
    return Planted()


def _limited_in_time(rng, plan):
    steps = int(plan.steps * rng.uniform(0.7, 1.0))
    return Planted(wrappers=(limited(gym.wrappers.TimeLimit, steps),), limit=True)


def _rescaled(rng, plan):
    return Planted(
        wrappers=(lambda env: gym.wrappers.RescaleAction(env, -0.5, 0.5),), plan={"levels": False}
    )


def _flattened(rng, plan):
    return Planted(wrappers=(gym.wrappers.FlattenObservation,))


def _counting(rng, plan):
    return Planted((draws.Counting,))


def _single(rng, plan):
    wrap = lambda env: gym.wrappers.DtypeObservation(env, np.float32)  # noqa: E731
    return Planted(wrappers=(wrap,), plan={"view": "box"})


def _recorded(rng, plan):
    return Planted(wrappers=(gym.wrappers.RecordEpisodeStatistics, gym.wrappers.OrderEnforcing))


def _fresh_fields(rng, plan):
    if plan.turns:
        return Planted(plan={"forward": True})
    return Planted((planted(draws.Stale, stale="site_xpos"),), plan={"forward": True})


def _timed(rng, plan):
    if plan.kind not in ALONE:
        return Planted(plan={"forward": True})
    change = {"beacon": beacon(plan, rng), "scan": True, "forward": True}
    return Planted((draws.Timed,), plan=change)


def _scaled_observation(rng, plan):
    return Planted(wrappers=(scaled,), plan={"view": "box"})


HONEST = (
    _plain, _limited_in_time, _rescaled, _flattened, _counting, _single, _recorded, _fresh_fields, _timed,
    _scaled_observation,
)  # fmt: skip
