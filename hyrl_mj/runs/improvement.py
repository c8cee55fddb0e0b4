"""HyRL against the policy over the runs of a sweep: means, differences and how often it is better.

The intervals are those of a bootstrap over the seeds, stratified by the settings of the sweep, as Agarwal et
al. (2021, arXiv:2108.13264) ask for where there are few runs. How much the starts of one run vary is told by
the intervals of its own comparisons.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
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
    """Returns what HyRL improves, for each figure that both controllers have in all runs that are done."""
    done = [row for row in rows if row.done]
    found = []
    for figure, more in COMPARED.items():
        groups: dict[Setting, list[tuple[float, float]]] = {}
        for row in done:
            pair = (row.figures.get(f"policy_{figure}"), row.figures.get(f"hyrl_{figure}"))
            if pair[0] is not None and pair[1] is not None:
                groups.setdefault(row.setting, []).append((pair[0], pair[1]))
        if groups:
            found.append(_improvement(figure, more, [np.array(g) for g in groups.values()]))
    return found


def _improvement(figure: str, more: bool, groups: Sequence[np.ndarray]) -> Improvement:
    """Returns the improvement of a figure, from the pairs (seeds, 2) of each setting."""
    better = []
    for pairs in groups:
        apart = (pairs[None, :, 1] - pairs[:, None, 0]) * (1 if more else -1)
        better.append(float(np.mean((apart > 0) + (apart == 0) / 2)))
    policy, hyrl, difference = (
        _mean(groups, of)
        for of in (lambda p: p[:, 0], lambda p: p[:, 1], lambda p: p[:, 1] - p[:, 0])
    )
    runs = sum(map(len, groups))
    return Improvement(figure, runs, policy, hyrl, difference, float(np.mean(better)))


def _mean(groups: Sequence[np.ndarray], of: Callable[[np.ndarray], np.ndarray]) -> Mean:
    """Returns the mean of what `of` gives of each setting's pairs, with its interval."""
    from scipy.stats import bootstrap  # slow to import, and seldom needed

    def mean(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.mean([np.mean(sample, axis=axis) for sample in samples], axis=0)

    values = [of(pairs) for pairs in groups]
    whole = float(mean(*values))
    if min(map(len, values)) < LEAST_SEEDS:
        return Mean(whole, None)
    found = bootstrap(
        values,
        mean,
        n_resamples=9_999,
        method="percentile",
        vectorized=True,
        random_state=np.random.default_rng(0),
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
    done = [row.figures for row in rows if row.done]
    shares = {}
    for who in ("policy", "hyrl"):
        values = [value for own in done if (value := own.get(f"{who}_{figure}")) is not None]
        if values:
            shares[who] = np.mean(np.array(values)[:, None] >= thresholds, axis=0)
    return shares
