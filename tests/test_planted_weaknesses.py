"""Controllers that one known noise signal breaks are broken by an attack of the default budget."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import cycle

import numpy as np
import pytest

from hyrl_mj import Recorded, simulate_batch
from hyrl_mj.judging import Budget, attack
from hyrl_mj.policies import PolicyController
from hyrl_mj.tasks import Effort

EPS, WINDOW, FIRST = 0.1, 16, 4
STARTS = np.array([[0.0, 1.0], [0.0, 1.01]])
# By so much of its window a signal has to be the known one.
ENOUGH = 13
K = np.arange(WINDOW)
# The known signals, as signs on the columns x and y; the sign of a whole signal does not matter.
SIGNALS = {
    "constant": np.stack([0 * K, np.ones(WINDOW)], axis=1),
    "alternating": np.stack([0 * K, (-1.0) ** K], axis=1),
    "one flip": np.stack([0 * K, np.where(K < 9, 1.0, -1.0)], axis=1),
    "an early flip": np.stack([0 * K, np.where(K < 4, 1.0, -1.0)], axis=1),
    "resonance at period 6": np.stack([0 * K, np.where(2 * (K + FIRST) // 6 % 2, -1.0, 1.0)], axis=1),
    "resonance at period 9": np.stack([0 * K, np.where(2 * (K + FIRST) // 9 % 2, -1.0, 1.0)], axis=1),
    "the second column alone": np.stack([0 * K, np.ones(WINDOW)], axis=1),
}  # fmt: skip


def matches(noise, signal, everywhere):
    """Whether noise (n, ..., 2) has the sign of the known signal (..., 2), and no noise on x."""
    right = np.sign(np.round(noise[..., 1], 6)) == signal[..., 1]
    return right & (np.abs(noise[..., 0]) < EPS / 2) if everywhere else right


@dataclass(frozen=True)
class Watcher:
    """A controller of the vehicle with many modes, which count samples, and those of the known signal.

    It drives straight on, and leaves the arena once the signal was there. So its noise is what it measures
    less where it is by itself.
    """

    signal: np.ndarray
    y: float
    everywhere: bool = False
    modes: tuple[int, ...] = field(default=tuple(range(3 * 61 * (WINDOW + 1))), repr=False)

    def initial_mode(self, measured):
        return np.zeros(len(measured), dtype=int)

    def step(self, q, measured):
        k, count = np.divmod(q, WINDOW + 1)
        noise = measured - np.stack([0.05 * k, np.full(len(k), self.y)], axis=1)
        at = np.clip(k - FIRST, 0, WINDOW - 1)
        inside = (k >= FIRST) & (k < FIRST + WINDOW)
        more = inside & matches(noise, self.signal[at], self.everywhere)
        leaves = (k >= FIRST + WINDOW) & (count >= ENOUGH)
        following = (k + 1) * (WINDOW + 1) + np.minimum(count + more, WINDOW)
        return np.where(leaves, 1.0, 0.0)[:, None], following


@dataclass(frozen=True)
class Rememberer:
    """As `Watcher`, a policy with one mode that remembers what it measured."""

    signal: np.ndarray
    y: float
    everywhere: bool = False

    def start(self, n):
        return np.full((n, 60, 2), np.nan)

    def act(self, measured):
        return np.zeros((len(measured), 1))

    def act_after(self, past, measured):
        k = np.isfinite(past[:, :, 1]).sum(axis=1)
        u = np.zeros((len(measured), 1))
        for row in np.flatnonzero(k >= FIRST + WINDOW):
            seen = past[row, 60 - k[row] :][FIRST : FIRST + WINDOW]
            x = 0.05 * np.arange(FIRST, FIRST + WINDOW)
            noise = seen - np.stack([x, np.full(WINDOW, self.y)], axis=1)
            u[row] = matches(noise, self.signal, self.everywhere).sum() >= ENOUGH
        return u, np.concatenate([past[:, 1:], measured[:, None]], axis=1)


@dataclass(frozen=True)
class Turner:
    """A controller that leaves the arena if the noise is +eps in mode 0, and -eps after its jump."""

    modes = (0, 1, 2, 3)

    def initial_mode(self, measured):
        return np.zeros(len(measured), dtype=int)

    def step(self, q, measured):
        x, y = measured.T
        jumps = np.where((q == 0) & (x > 0.9), np.where(y > 1.05, 1, 3), q)
        following = np.where((q == 1) & (x > 1.5), np.where(y < 0.95, 2, 3), jumps)
        return np.where(following == 2, 1.0, 0.0)[:, None], following


def default(**options):
    return Budget(rounds=Effort().attack_rounds, **options)


@pytest.mark.parametrize(("name", "make"), [*zip(SIGNALS, cycle(["one mode", "several modes"]))])
def test_what_one_signal_breaks_is_broken(vehicle, name, make):
    signal, everywhere = SIGNALS[name], name == "the second column alone"
    start = STARTS[:1]
    if make == "one mode":
        loop = PolicyController(Rememberer(signal, start[0, 1], everywhere))
    else:
        loop = Watcher(signal, start[0, 1], everywhere)
    # The known signal alone breaks it, and none does not.
    known = np.zeros((60, 1, 2))
    known[FIRST : FIRST + WINDOW, 0] = EPS * signal
    (arc,) = simulate_batch(vehicle, loop, start, Recorded(known, EPS))
    assert arc.outcome == "out_of_bounds"
    (arc,) = simulate_batch(vehicle, loop, start)
    assert arc.outcome == "reached"
    found = attack(vehicle, {"it": loop}, start, EPS, default(), everywhere)["it"]
    assert found.count.lost == 1, found.count
    assert found.arcs[0].outcome == "out_of_bounds"


def test_a_bias_that_turns_at_the_jump_is_found(vehicle):
    found = attack(vehicle, {"it": Turner()}, STARTS, EPS, default())["it"]
    assert found.count.lost == len(STARTS)


def test_all_are_tried_with_the_same_rules_and_several_modes_with_more(vehicle):
    signal = SIGNALS["constant"]
    loops = {
        # Noise of y = 2 is never measured: nothing breaks them.
        "one": PolicyController(Rememberer(-5 * signal, 1.0)),
        "several": Watcher(-5 * signal, 1.0),
    }
    found = attack(vehicle, loops, STARTS[:1], EPS, Budget(rounds=6))
    one, several = (found[name].count for name in loops)
    assert one.lost == several.lost == 0
    assert set(several.tried) - set(one.tried) == {"jump", "stay", "turn"}
    assert {kind: several.tried[kind] for kind in one.tried} == one.tried
    assert one.rounds == several.rounds
    assert several.samples > one.samples > 60
