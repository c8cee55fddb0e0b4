"""HyRL against the policy over the runs of a sweep: means, differences and how often it is better.

The intervals are those of a bootstrap over the seeds, stratified by the settings of the sweep, as Agarwal et
al. (2021, arXiv:2108.13264) ask for where there are few runs. Where a run has tried a sample of its starts,
these are drawn again, too: of n starts of which a share s is won, n are won with probability s. Both
controllers are drawn apart, although they were tried from the same starts: if what one of them loses is more
likely lost by the other, the interval of their difference is wider than it needs to be.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hyrl_mj.runs.sweeps import Row, Setting
from hyrl_mj.simulation import KINDS

# Figures that both controllers have, without their names, and whether more of it is better.
COMPARED = {
    "proved": True,
    "not_broken": True,
    "margin": True,
    **{f"reached_{kind}": True for kind in KINDS},
    "withstood_attack": True,
    "late": False,
    "longest": False,
}
# The figures that are shares of a sample of starts, and the one that tells of how many.
SAMPLED = {
    **{f"reached_{kind}": f"episodes_{kind}" for kind in KINDS},
    "withstood_attack": "attacked",
}
# Seeds of each setting from which an interval is computed.
LEAST_SEEDS = 3


@dataclass(frozen=True)
class Mean:
    """A mean over runs with its 95% interval; the interval is None with too few seeds."""

    value: float
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class Improvement:
    """One figure of both controllers over the runs of a sweep.

    Attributes:
        figure: its name in `COMPARED`.
        runs: number of runs that have it.
        policy, hyrl: the means of both controllers, over the seeds and then over the settings.
        difference: of HyRL less the policy, in the same runs.
        better: the probability that HyRL is better than the policy in a run of the same setting with
            another seed or the same, ties counted one half, averaged over the settings.
    """

    figure: str
    runs: int
    policy: Mean
    hyrl: Mean
    difference: Mean
    better: float


def improvements(rows: Iterable[Row]) -> list[Improvement]:
    """Returns what HyRL improves, for each figure by which both controllers of a run can be compared."""
    done = [row for row in rows if row.done]
    found = []
    for figure, more in COMPARED.items():
        # Of policy and HyRL, and the number of starts that were tried, 0 where the figure is no share.
        by_setting: dict[Setting, list[tuple[float, float, float]]] = {}
        for row in done:
            if (both := _of_both(row, figure)) is not None:
                starts = row.figures.get(SAMPLED.get(figure, "")) or 0.0
                by_setting.setdefault(row.setting, []).append((*both, starts))
        if not by_setting:
            continue
        groups, better = [np.array(group) for group in by_setting.values()], []
        for runs in groups:
            apart = (runs[None, :, 1] - runs[:, None, 0]) * (1 if more else -1)
            better.append(float(np.mean((apart > 0) + (apart == 0) / 2)))
        policies, hyrls, apart = (mean(groups, np.array(by)) for by in ((1, 0), (0, 1), (-1, 1)))
        count, probability = sum(map(len, groups)), float(np.mean(better))
        found.append(Improvement(figure, count, policies, hyrls, apart, probability))
    return found


def mean(groups: Sequence[np.ndarray], by: np.ndarray) -> Mean:
    """Returns the mean of policy and HyRL, times `by` (2,), over the seeds and then over the settings.

    Args:
        groups: for each setting the values (seeds, 3) of policy and HyRL, and the number of starts that were
            tried.
        by: factors of the values.
    """
    from scipy.stats import bootstrap  # slow to import, and seldom needed

    rng = np.random.default_rng(0)

    def of_drawn(*chosen: np.ndarray, axis: int = -1) -> np.ndarray:
        means = []
        for runs, numbers in zip(groups, chosen, strict=True):
            drawn = runs[numbers.astype(int)]
            values, starts = drawn[..., :2], drawn[..., 2:]
            sampled = starts[..., 0] > 0
            n = starts[sampled].astype(int)
            values[sampled] = rng.binomial(n, values[sampled]) / n
            means.append((values @ by).mean(axis=axis))
        return np.mean(means, axis=0)

    whole = float(np.mean([(runs[:, :2] @ by).mean() for runs in groups]))
    if min(map(len, groups)) < LEAST_SEEDS:
        return Mean(whole, None)
    found = bootstrap(
        [np.arange(len(runs)) for runs in groups],
        of_drawn,
        n_resamples=9_999,
        method="percentile",
        vectorized=True,
        random_state=rng,
    ).confidence_interval
    return Mean(whole, (float(found.low), float(found.high)))


def profile(rows: Iterable[Row], figure: str, thresholds: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the performance profile of both controllers.

    Args:
        rows: the runs.
        figure: the name of a figure in `COMPARED`.
        thresholds: (k,) values of it.

    Returns:
        By controller the share (k,) of the runs in which its figure is at least as large; {} if no run has
        the figure.
    """
    found = [both for row in rows if row.done and (both := _of_both(row, figure)) is not None]
    if not found:
        return {}
    shares = np.mean(np.array(found)[:, :, None] >= thresholds, axis=0)
    return dict(zip(("policy", "hyrl"), shares, strict=True))


def _of_both(row: Row, figure: str) -> tuple[float, float] | None:
    """Returns a figure of policy and HyRL in a run; None if they cannot be compared by it.

    Where one of them alone has none because it loses a start without noise, or because a replay refuted what
    the game says of it, its figure is 0: to leave the run out would favour it. What was refuted has no share
    that is not broken, and what could not be proved has one.
    """
    found = {who: row.figures.get(f"{who}_{figure}") for who in ("policy", "hyrl")}
    lacking = [who for who, value in found.items() if value is None]
    if len(lacking) == 1:
        refuted = row.figures.get(f"{lacking[0]}_not_broken", 1.0) is None
        if figure == "margin" or (refuted and figure in ("proved", "not_broken")):
            found[lacking[0]] = 0.0
    policy, hyrl = found.values()
    return None if policy is None or hyrl is None else (policy, hyrl)
