"""The settings of attacks: what signals they try, and how they go on from the most dangerous of them."""

from dataclasses import dataclass
from typing import Annotated

from hyrl_mj.ranges import Checked, Integer, Number


@dataclass(frozen=True)
class AttackSettings(Checked):
    """What an attack tries, in all stages that attack. No preset changes the defaults.

    Attributes:
        flips: times at which the sign of a signal changes once, spread over the length of a run.
        period_step: of two neighbouring periods of alternating signals the longer is longer by this share: a
            resonance with a quality factor of five still answers to the nearer of them.
        segments: segments of a programme of rules, each of the same time; together as long as a run without
            noise.
        population: signals that are tried in a round from each start, after one that won from a start nearby.
        elites: the best programmes so far, for each start and goal, that new ones are drawn from.
        explore: share of the segments of new programmes that take any rule instead.
        focused: open starts, the most dangerous ones, at which levels and switching times are evolved.
        offspring: signals in a generation of that evolution.
        pieces: pieces of such a signal, within each of which its level or its period stays.
        spread: standard deviation of the numbers with which the evolution begins. A level is twice its
            number, and beyond 1 the end of the bound: about a third of the first levels lie there.
    """

    flips: Annotated[int, Integer(1, 1_000)] = 8
    period_step: Annotated[float, Number(0.01, 10)] = 0.2
    segments: Annotated[int, Integer(1, 1_000)] = 10
    population: Annotated[int, Integer(1, 1_000)] = 8
    elites: Annotated[int, Integer(1, 1_000)] = 3
    explore: Annotated[float, Number(0, 1)] = 0.25
    focused: Annotated[int, Integer(1, 1_000)] = 16
    offspring: Annotated[int, Integer(2, 1_000)] = 12
    pieces: Annotated[int, Integer(1, 100)] = 4
    spread: Annotated[float, Number(0, 10, above=True)] = 0.5
