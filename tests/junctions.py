"""Planted truths for more than two ways: sectors that meet in a point, and gates between posts."""

from itertools import product

import numpy as np
from planted import AnalyticSet, ChartPolicy, Cube

from hyrl_mj.policies.hybrid import HybridController
from hyrl_mj.tasks import Outcome, Scene

# The numbers of the modes have gaps.
NUMBERS = (1, 4, 6, 9)
EPS = 0.1


class Plane(Cube):
    """A point that moves at will in the plane, until it leaves the square."""

    max_steps = 40
    start_low, start_high = (-0.5, -0.5), (0.5, 0.5)
    scene = Scene(starts=((0.1, 0.2),), time=3.0)

    def __init__(self):
        super().__init__(lambda z: z[..., 0], 2)

    def ending(self, measurement):
        out = np.abs(measurement).max(axis=1) >= 0.95
        return np.where(out, Outcome.REACHED, Outcome.RUNNING)

    def verdict(self, measurement):
        return np.full(len(measurement), Outcome.STALLED)


class Junction(Plane):
    """Sectors of the plane that meet in the origin: the way of a run is the sector in which it ends.

    Args:
        edges: (k,) angles at which the sectors begin, in ascending order [rad].
    """

    name = "junction"

    def __init__(self, edges):
        super().__init__()
        self.edges = np.array(edges)
        self.modes = NUMBERS[: len(edges)]
        self.ends = np.append(self.edges[1:], self.edges[0] + 2 * np.pi)
        middles = (self.edges + self.ends) / 2
        # Modes go out along the middles of their sectors: (k, 2).
        self.out = np.stack([np.cos(middles), np.sin(middles)], axis=1)

    def sector(self, z):
        """The index (n,) of the sector that holds points (n, 2)."""
        turned = (np.arctan2(z[:, 1], z[:, 0]) - self.edges[0]) % (2 * np.pi)
        return np.searchsorted(self.edges - self.edges[0], turned, side="right") - 1

    def direction(self, path):
        return np.array(self.modes)[self.sector(path[-1])]

    def policy(self):
        """Goes out along the middle of the sector that holds the state."""
        return ChartPolicy(self, lambda z: self.out[self.sector(z)])

    def controller(self, sets):
        """Each mode goes out its own way, on one of the sets, in the order of the modes."""
        policies = {
            q: ChartPolicy(self, lambda z, way=way: np.tile(way, (len(z), 1)))
            for q, way in zip(self.modes, self.out, strict=True)
        }
        return HybridController(self, policies, dict(zip(self.modes, sets, strict=True)))

    def widened(self, by):
        """The sectors with their edges moved out so far that all within a box of half side `by` is held."""
        return tuple(
            AnalyticSet(lambda z, k=k: self.beyond(k, z, by)) for k in range(len(self.modes))
        )

    def within(self, k, z, half):
        """Whether a box of half side `half` around points (n, 2) meets a sector: (n,) bool."""
        box = half * np.array(list(product(np.linspace(-1, 1, 21), repeat=2)))
        return (
            self.beyond(k, (z[:, None] + box).reshape(-1, 2)).reshape(len(z), -1).min(axis=1) <= 0
        )

    def beyond(self, k, z, by=0.0):
        """How far (n,) points (n, 2) lie beyond the edges, moved out, of a sector below half a turn."""
        begin, end = self.edges[k], self.ends[k]
        normals = np.array([[np.sin(begin), -np.cos(begin)], [-np.sin(end), np.cos(end)]])
        return (z @ normals.T - by * np.abs(normals).sum(axis=1)).max(axis=1)


def three_ways():
    """Three sectors of a third of a turn; an edge points up."""
    return Junction(np.pi / 2 + 2 * np.pi / 3 * np.arange(3) - 2 * np.pi / 3)


def four_ways():
    """Four sectors, whose edges are the diagonals."""
    return Junction(-np.pi / 4 + np.pi / 2 * np.arange(4))


class Gates(Plane):
    """Four gates between three posts abreast, towards which a point drives at full speed.

    Coordinate a grows by 1 m/s, and b by at most as much. A run that is not off the posts by `HALF` from
    a = 0 on crashes.
    """

    name = "gates"
    POSTS, HALF = (-0.5, 0.0, 0.5), 0.1

    def ending(self, measurement):
        a, b = measurement.T
        at_post = np.abs(b[:, None] - self.POSTS).min(axis=1) < self.HALF - 1e-6
        ends = np.where(a >= 0.5, Outcome.REACHED, Outcome.RUNNING)
        return np.where((a >= -1e-6) & (a < 0.3) & at_post, Outcome.CRASHED, ends)

    def gate(self, b):
        """The index (n,) of the gate that lies ahead at b (n,)."""
        return np.searchsorted(self.POSTS, b)

    def direction(self, path):
        behind = path[0, :, 0] > 0.3
        return np.where(behind, -1, np.array(NUMBERS)[self.gate(path[-1, :, 1])])

    def policy(self):
        """Drives to the middle of the gate that lies ahead."""

        def rule(z):
            away = np.array((-0.75, -0.25, 0.25, 0.75))[self.gate(z[:, 1])] - z[:, 1]
            return np.stack([np.ones(len(z)), np.clip(away / 0.05, -1, 1)], axis=1)

        return ChartPolicy(self, rule)


def thin_way():
    """Three sectors of which the first, downward, is so thin that noise can pass over it."""
    half = np.radians(15)
    return Junction((-np.pi / 2 - half, -np.pi / 2 + half, np.pi / 2))
